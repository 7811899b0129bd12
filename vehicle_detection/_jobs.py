"""How many threads work, and how OpenCV is kept from starting its own beside them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

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
