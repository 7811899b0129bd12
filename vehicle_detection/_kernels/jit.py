"""Compilation of the numba kernels: without the GIL, once, into a cache on disk.

The cache notices changes of a kernel's own file only, so kernels that call each other are in one file.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba


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
