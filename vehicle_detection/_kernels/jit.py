"""Compilation of the numba kernels: without the GIL, once, into a cache on disk."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from vehicle_detection._common import private_folder

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
        no_cfunc_wrapper=True,
        fastmath={"reassoc", "contract", "nsz"} if reorder else False,
    )
    kernel: Any = None
    with contextlib.suppress(RuntimeError):  # neither the package's folder nor the user's cache is writable
        kernel = compiler(cache=True)(function)
    if kernel is None and (folder := _temporary_cache()):
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, folder
        with contextlib.suppress(RuntimeError):
            kernel = compiler(cache=True)(function)
        numba.config.CACHE_DIR = before
    if kernel is None:
        return compiler()(function)  # type: ignore[no-any-return]
    # These attributes are not public. Without them, numba notices changes of the kernel's own file only, not
    # of those that it calls, and fails on a full disk.
    with contextlib.suppress(AttributeError):
        kernel._cache._cache_file._source_stamp = source_stamp()
        kernel._cache.save_overload = functools.partial(_save, kernel._cache.save_overload)
    return kernel  # type: ignore[no-any-return]


@functools.cache
def _temporary_cache() -> str:
    """Return a temporary folder for compiled kernels, and say so; empty if there is none."""
    folder = private_folder("vehicle-detection-kernels")
    where = f"kept in {folder}" if folder else "compiled in every process, which takes 15 seconds"
    log.warning("the package and the user's cache are not writable: kernels are %s", where)
    return folder


def _save(save: Callable[..., None], *overload: Any) -> None:
    """Save a compiled kernel if there is space for it."""
    try:
        save(*overload)
    except OSError as error:
        log.info("compiled kernels are not kept: %s", error)


@functools.cache
def source_stamp() -> tuple[float, int]:
    """Return the newest time of a change of the kernels' files, and their total size."""
    files = [file.stat() for file in Path(__file__).parent.glob("*.py")]
    return max((file.st_mtime for file in files), default=0.0), sum(file.st_size for file in files)


class _Compilation(event.Listener):  # type: ignore[misc]
    """Logs once in a process that kernels of this package are compiled, and pauses the garbage collector.

    A compilation creates millions of objects that stay; to look through them takes a tenth of its time.
    """

    def __init__(self) -> None:
        self._announced = False
        self._depth = 0  # a kernel compiles the functions that it calls; only one thread compiles at a time
        self._paused = False

    def on_start(self, event: Any) -> None:
        """Log the first kernel that is not in the cache."""
        # Functions that `exec` defines may have no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if not self._announced and module.startswith(__package__):
            self._announced = True
            log.info("compiling for this processor at the first use, which takes up to 15 seconds")
        if not self._depth:
            self._paused = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Let the garbage collector go on."""
        self._depth -= 1
        if not self._depth and self._paused:
            gc.enable()


event.register("numba:compile", _Compilation())
