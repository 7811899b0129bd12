"""Compilation of the numba kernels: without the GIL, once, into a cache on disk.

The cache notices changes of a kernel's own file only, so kernels that call each other are in one file.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any

import numba
from numba.core import event

log = logging.getLogger(__name__)


def jit(function: Callable[..., Any], *, reorder: bool = False) -> Callable[..., Any]:
    """Compile a kernel on its first call, cached on disk where possible.

    With `reorder`, the terms of sums may be added in another order, which allows vectorization.
    """
    compiler = functools.partial(
        numba.njit,
        nogil=True,
        error_model="numpy",
        boundscheck=False,
        fastmath={"reassoc", "contract", "nsz"} if reorder else False,
    )
    try:
        return compiler(cache=True)(function)  # type: ignore[no-any-return]
    except RuntimeError:
        # Neither the package's folder nor the user's cache is writable: compile in every process.
        return compiler()(function)  # type: ignore[no-any-return]


class _Announcement(event.Listener):  # type: ignore[misc]
    """Logs that kernels of this package are compiled, once in a process."""

    def __init__(self) -> None:
        self._announced = False

    def on_start(self, event: Any) -> None:
        """Log the first kernel that is not in the cache."""
        # Functions that `exec` defines may have no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if not self._announced and module.startswith(__package__):
            self._announced = True
            log.info("compiling for this processor at the first use, which takes up to 15 seconds")

    def on_end(self, event: Any) -> None:
        """Do nothing; numba calls it."""


event.register("numba:compile", _Announcement())
