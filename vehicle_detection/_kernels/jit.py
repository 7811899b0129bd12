"""How the numba kernels are compiled: without the GIL, and once, into a cache on disk.

Kernels that call each other best stand in one file: the cache notices a change of a kernel's own file alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba


def jit(function: Callable[..., Any], *, reorder: bool = False) -> Callable[..., Any]:
    """Compile a kernel when it is first called, into a cache on disk wherever one can be kept.

    With `reorder`, sums may be taken in another order: a long one fills a vector register.
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
        # Neither the package's folder nor the user's cache can be written: compile in every process.
        return compiler()(function)  # type: ignore[no-any-return]
