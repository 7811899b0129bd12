"""How many threads work, and how OpenCV is kept from starting its own beside them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

from vehicle_detection._common.checks import check_integer
from vehicle_detection.errors import InvalidInputError

Item = TypeVar("Item")
Result = TypeVar("Result")

JOBS_VARIABLE = "VEHICLE_DETECTION_JOBS"


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def resolve_jobs(n_jobs: int | None = None) -> int:
    """Decide the number of threads: `n_jobs`, else ``VEHICLE_DETECTION_JOBS``, else all cores."""
    if n_jobs is not None:
        return check_integer(n_jobs, "n_jobs", low=1, high=1024)
    text = os.environ.get(JOBS_VARIABLE, "")
    if not text:
        return available_cores()
    if not text.isdecimal() or int(text) < 1:
        raise InvalidInputError(f"{JOBS_VARIABLE} must be a whole number of threads from 1; got {text!r}")
    return int(text)


class _SingleThreadedOpenCV:
    """Holds OpenCV at one thread while anybody is inside, whichever threads come and go."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._threads = 1

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._inside == 0:
                self._threads = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0:
                    cv2.setNumThreads(self._threads)


single_threaded_opencv = _SingleThreadedOpenCV()
if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork: nobody is inside in the child.
    os.register_at_fork(after_in_child=single_threaded_opencv.__init__)  # type: ignore[misc]


class ThreadTeam:
    """Threads that share the parts of one piece of work, with the calling thread as one of them.

    Parameters
    ----------
    n_jobs
        Threads in all; None: as `resolve_jobs` decides.
    name
        Prefix of the threads' names.
    """

    def __init__(self, n_jobs: int | None = None, *, name: str) -> None:
        self._helpers = resolve_jobs(n_jobs) - 1
        self._name = name
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()
        self._callers = 0

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item], *, cost: Callable[[Item], float]
    ) -> list[Result]:
        """Apply `function` to the items, the costly ones first so that the threads end together.

        Callers that come while another one is at work keep the cores busy by themselves: each of them
        works alone.
        """
        waiting = deque(sorted(range(len(items)), key=lambda place: -cost(items[place])))
        results: dict[int, Result] = {}

        def work() -> None:
            while waiting:
                try:
                    place = waiting.popleft()
                except IndexError:  # another thread was faster
                    return
                results[place] = function(items[place])

        with self._lock:
            self._callers += 1
            alone = self._callers == 1
            count = min(self._helpers, len(items) - 1) if alone else 0
            if count > 0 and self._pool is None:
                self._pool = ThreadPoolExecutor(self._helpers, thread_name_prefix=self._name)
            helpers = [self._pool.submit(work) for _ in range(count)] if self._pool is not None else []
        try:
            work()
        finally:
            waiting.clear()
            with self._lock:
                self._callers -= 1
            for helper in helpers:
                if not helper.cancel():
                    helper.result()
        return [results[place] for place in range(len(items))]

    def close(self) -> None:
        """End the threads; the next piece of work starts them again."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown()
