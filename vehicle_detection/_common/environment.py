"""Environment variables of numba that the compiled kernels do not work with."""

from __future__ import annotations

import os

from vehicle_detection.errors import InvalidInputError


def check_environment() -> None:
    """Raise if numba would fail, or run the kernels, which need its compiler, as Python."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise InvalidInputError(
            "NUMBA_DISABLE_JIT must be unset or 0, because the kernels need numba's compiler; "
            f"got {os.environ['NUMBA_DISABLE_JIT']!r}"
        )
    threads = os.environ.get("NUMBA_NUM_THREADS", "")
    if threads and not (threads.isdecimal() and int(threads[:9]) >= 1):
        raise InvalidInputError(
            f"NUMBA_NUM_THREADS must be unset or a number of threads, at least 1; got {threads!r}"
        )
