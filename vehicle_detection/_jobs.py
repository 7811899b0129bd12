"""How many threads work, and how BLAS is kept from starting its own beside them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from typing import Any

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
    if not text.isdigit() or int(text) < 1:
        raise InvalidInputError(f"{JOBS_VARIABLE} must be a whole number of threads from 1; got {text!r}")
    return int(text)


class _SingleThreadedBlas:
    """Holds BLAS at one thread while anybody is inside, whichever threads come and go."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._limits: contextlib.AbstractContextManager[object] | None = None
        self._controller: Any = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._inside == 0:
                self._enter()
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0 and self._limits is not None:
                    self._limits.__exit__(None, None, None)

    def _enter(self) -> None:
        from threadpoolctl import ThreadpoolController

        # Looking for the loaded BLAS libraries takes a millisecond: once is enough.
        self._controller = self._controller or ThreadpoolController()
        self._limits = self._controller.limit(limits=1, user_api="blas")


single_threaded_blas = _SingleThreadedBlas()
