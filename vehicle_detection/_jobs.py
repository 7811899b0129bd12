"""How many threads work, and how BLAS and OpenCV are kept from starting their own beside them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2

from vehicle_detection._checks import check_integer
from vehicle_detection.errors import InvalidInputError

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


class _SingleThreadedLibraries:
    """Holds BLAS and OpenCV at one thread while anybody is inside, whichever threads come and go."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._controller: Any = None
        self._limits: Any = None
        self._opencv_threads = 0
        self._keeper: ThreadPoolExecutor | None = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._inside == 0:
                self._keep(self._limit)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0:
                    self._keep(self._lift)

    def _keep(self, function: Callable[[], None]) -> None:
        """Call `function` on a thread of our own: only the thread that set a limit can lift it."""
        self._keeper = self._keeper or ThreadPoolExecutor(1, thread_name_prefix="blas")
        try:
            job = self._keeper.submit(function)
        except RuntimeError:  # The interpreter is ending: limits do not matter any more.
            return
        job.result()

    def _limit(self) -> None:
        from threadpoolctl import ThreadpoolController

        # Looking for the loaded BLAS libraries takes a millisecond: once is enough.
        self._controller = self._controller or ThreadpoolController()
        # An interrupt may have kept an earlier limit from being lifted.
        if self._limits is None:
            self._limits = self._controller.limit(limits=1, user_api="blas").__enter__()
            self._opencv_threads = cv2.getNumThreads()
            cv2.setNumThreads(1)

    def _lift(self) -> None:
        if self._limits is not None:
            self._limits.__exit__(None, None, None)
            self._limits = None
            cv2.setNumThreads(self._opencv_threads)


single_threaded_libraries = _SingleThreadedLibraries()
if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork: the child needs a keeper of its own.
    os.register_at_fork(after_in_child=single_threaded_libraries.__init__)  # type: ignore[misc]
