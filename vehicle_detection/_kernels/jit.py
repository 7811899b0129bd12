"""Compilation of the numba kernels: without the GIL, once, into a cache on disk."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

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
        kernel = compiler(cache=True)(function)
    except RuntimeError:
        # Neither the package's folder nor the user's cache is writable: compile in every process.
        return compiler()(function)  # type: ignore[no-any-return]
    # numba would notice changes of the kernel's own file only, not of those that it calls. Without this
    # attribute, which is not public, it does that.
    with contextlib.suppress(AttributeError):
        kernel._cache._cache_file._source_stamp = source_stamp()
    return kernel  # type: ignore[no-any-return]


inlined = functools.partial(numba.njit, inline="always")
"""Compile a function as a part of each kernel that calls it, instead of by itself."""


def compiles(kernel: Callable[..., Any], *types: Any) -> bool:
    """Compile a kernel for arguments of these types; log a warning and return False if that fails."""
    try:
        cast("Any", kernel).compile(types)
    except (numba.core.errors.NumbaError, RuntimeError) as error:  # LLVM's are RuntimeErrors
        log.warning("products are computed without vector instructions, which is slower: %s", error)
        return False
    return True


@functools.cache
def source_stamp() -> tuple[float, int]:
    """Return the newest time of a change of the kernels' files, and their total size."""
    files = [file.stat() for file in Path(__file__).parent.glob("*.py")]
    return max((file.st_mtime for file in files), default=0.0), sum(file.st_size for file in files)


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
