"""Arrays reused from call to call: allocating large arrays costs as much as computing their content."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Shapes of arrays that a workspace remembers: those of a frame are the same from frame to frame.
_MAX_VIEWS = 4096


SPARE = 64
"""Entries beyond the end of each array of a workspace: vectors are loaded there, and not used."""


class Workspace(threading.local):
    """Scratch arrays by name, of each thread its own; with ``reuse=False`` each array is newly allocated."""

    def __init__(self, *, reuse: bool = True) -> None:
        self._reuse = reuse
        self._arrays: dict[tuple[Any, str], NDArray[Any]] = {}
        self._views: dict[tuple[Any, str, tuple[int, ...]], NDArray[Any]] = {}

    def take(self, shape: tuple[int, ...], dtype: Any, name: str) -> NDArray[Any]:
        """Return an uninitialized array of `shape`; arrays of the same name and dtype share their memory."""
        size = math.prod(shape)
        if not self._reuse:
            return np.empty(size + SPARE, dtype)[:size].reshape(shape)
        view = self._views.get((dtype, name, shape))
        if view is None:
            array = self._arrays.get((dtype, name))
            if array is None or array.size < size + SPARE or len(self._views) == _MAX_VIEWS:
                self._views.clear()  # also those of the smaller array
            if array is None or array.size < size + SPARE:
                array = self._arrays[dtype, name] = np.empty(size + SPARE, dtype)
            view = self._views[dtype, name, shape] = array[:size].reshape(shape)
        return view


def with_spare(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array itself if its memory goes on for `SPARE` entries, as in a workspace, else a copy."""
    if isinstance(array.base, np.ndarray) and array.base.flags.c_contiguous:
        start, base_start = (each.__array_interface__["data"][0] for each in (array, array.base))
        if base_start + array.base.nbytes - start - array.nbytes >= SPARE * array.itemsize:
            return array
    copy = NEW_ARRAYS.take(array.shape, array.dtype, "")
    copy[...] = array
    return copy


NEW_ARRAYS = Workspace(reuse=False)
"""The default workspace of functions that may be called without one."""
