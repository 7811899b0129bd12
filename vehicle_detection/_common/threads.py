"""Threads: their number, a team that shares work, their scratch arrays, and OpenCV without threads.

Arrays are reused from call to call: allocating large ones costs as much as computing their content.
"""

from __future__ import annotations

import _thread
import contextlib
import functools
import math
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check

Item = TypeVar("Item")
Result = TypeVar("Result")

JOBS_VARIABLE = "VEHICLE_DETECTION_JOBS"
_MAX_JOBS = 1024


def call_in_thread(function: Callable[[], Result]) -> Result:
    """Call a function in another thread, where no KeyboardInterrupt is raised, and wait for it.

    Only C code waits for the thread. An interrupt of ``Thread.start`` or ``Future.result`` can leave a lock
    acquired, and the thread then waits for it for ever (https://bugs.python.org/issue29988).
    """
    results: list[Result] = []
    errors: list[BaseException] = []
    done = _thread.allocate_lock()
    done.acquire()

    def call() -> None:
        try:
            results.append(function())
        except BaseException as error:
            errors.append(error)
        finally:
            done.release()

    _thread.start_new_thread(call, ())
    try:
        done.acquire()
    except BaseException:
        if not results and not errors:  # otherwise the lock may be acquired already
            done.acquire()
        raise
    if errors:
        raise errors.pop()
    return results[0]


def available_cores(root: Path = Path("/")) -> int:
    """Return the number of cores that this process may use: its affinity, and the CPU quota of its container.

    `root` is the folder of ``proc`` and ``sys``.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, math.ceil(_cpu_quota(root))))


@functools.cache
def _cpu_quota(root: Path) -> float:
    """Lowest CPU quota of this process's Linux control groups, versions 2 and 1, in cores; or 1 million."""
    groups, lowest = root / "sys/fs/cgroup", 1e6
    try:
        # Version 2: a line "0::/group"; a quota of a parent group applies too.
        own = (root / "proc/self/cgroup").read_text().rpartition("0::")[2].strip().strip("/")
    except OSError:
        return lowest
    folders = [groups / own, *(groups / own).parents]
    files = [folder / "cpu.max" for folder in folders if folder.is_relative_to(groups)]
    for file in (*files, groups / "cpu/cpu.cfs_quota_us"):
        try:
            words = file.read_text().split()
            if file.name != "cpu.max":
                words += file.with_name("cpu.cfs_period_us").read_text().split()
            quota, period = float(words[0]), float(words[1])
        except (OSError, ValueError, IndexError):  # no such version, or "max": no limit
            continue
        if quota > 0 and period > 0:
            lowest = min(lowest, quota / period)
    return lowest


def resolve_jobs(jobs: int | None = None) -> int:
    """Return `jobs`, else the environment variable ``VEHICLE_DETECTION_JOBS``, else all cores."""
    if jobs is not None:
        return check.integer(jobs, "jobs", low=1, high=_MAX_JOBS)
    text = os.environ.get(JOBS_VARIABLE, "")
    if not text:
        return available_cores()
    # The length first: Python refuses to convert thousands of digits.
    if not text.isdecimal() or len(text) > 9 or not 1 <= int(text) <= _MAX_JOBS:
        raise check.invalid(JOBS_VARIABLE, f"be a number of threads from 1 to {_MAX_JOBS}", text)
    return int(text)


class _SingleThreadedOpenCV:
    """Context that limits OpenCV to one thread until the last of all threads has left it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entered = 0
        self._threads = 1

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._entered == 0:
                self._threads = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._entered += 1
        try:
            yield
        finally:
            with self._lock:
                self._entered -= 1
                if self._entered == 0:
                    cv2.setNumThreads(self._threads)


single_threaded_opencv = _SingleThreadedOpenCV()
if hasattr(os, "register_at_fork"):
    # The threads that entered the context do not exist in a forked child.
    os.register_at_fork(after_in_child=single_threaded_opencv.__init__)  # type: ignore[misc]


class Closing:
    """Base of objects whose `close` a ``with`` block calls."""

    def close(self) -> None:
        """Release everything."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ThreadTeam(Closing):
    """`jobs` threads, including the calling one, that process a list of items; kept for the next list."""

    def __init__(self, jobs: int | None = None, *, name: str) -> None:
        self._helpers = resolve_jobs(jobs) - 1
        self._name = name
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()
        self._callers = 0

    @property
    def n_threads(self) -> int:
        """Number of threads."""
        return self._helpers + 1

    def map(
        self, function: Callable[[Item], Result], items: Sequence[Item], *, cost: Callable[[Item], float]
    ) -> list[Result]:
        """Apply `function` to each item, in order of decreasing cost so that the threads finish together.

        While several threads call this method, the later callers use no helpers: the cores are busy already.
        """
        if not self._helpers:
            return [function(item) for item in items]
        pending = deque(sorted(range(len(items)), key=lambda index: -cost(items[index])))
        results: dict[int, Result] = {}

        def work() -> None:
            while pending:
                try:
                    index = pending.popleft()
                except IndexError:  # another thread took the last item
                    return
                results[index] = function(items[index])

        with self._lock:
            self._callers += 1
            count = min(self._helpers, len(items) - 1) if self._callers == 1 else 0
            if count > 0 and self._pool is None:
                self._pool = ThreadPoolExecutor(self._helpers, thread_name_prefix=self._name)
            helpers = [self._pool.submit(work) for _ in range(count)] if self._pool is not None else []
        try:
            work()
        finally:
            pending.clear()
            with self._lock:
                self._callers -= 1
            for helper in helpers:
                if not helper.cancel():
                    helper.result()
        return [results[index] for index in range(len(items))]

    def close(self) -> None:
        """Stop the threads; the next call of `map` starts new ones."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown()


# Shapes of arrays that a workspace remembers: those of a frame are the same from frame to frame.
_MAX_VIEWS = 4096


class Workspace(threading.local):
    """Scratch arrays by name, of each thread its own; with ``reuse=False`` each array is newly allocated."""

    def __init__(self, *, reuse: bool = True) -> None:
        self._reuse = reuse
        self._arrays: dict[tuple[Any, str], NDArray[Any]] = {}
        self._views: dict[tuple[Any, str, tuple[int, ...]], NDArray[Any]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(Workspace, reuse=self._reuse), ()

    def take(self, shape: tuple[int, ...], dtype: Any, name: str) -> NDArray[Any]:
        """Return an uninitialized array of `shape`; arrays of the same name and dtype share their memory."""
        if not self._reuse:
            return np.empty(shape, dtype)
        size = math.prod(shape)
        view = self._views.get((dtype, name, shape))
        if view is None:
            array = self._arrays.get((dtype, name))
            if array is None or array.size < size or len(self._views) == _MAX_VIEWS:
                self._views.clear()  # also those of the smaller array
            if array is None or array.size < size:
                array = self._arrays[dtype, name] = np.empty(size, dtype)
            view = self._views[dtype, name, shape] = array[:size].reshape(shape)
        return view


NEW_ARRAYS = Workspace(reuse=False)
"""The default workspace of functions that may be called without one."""
