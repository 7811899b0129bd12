"""Arrays reused from call to call: allocating large arrays costs as much as computing their content."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Shapes of arrays that a workspace remembers: those of a frame are the same from frame to frame.
_MAX_VIEWS = 4096


class Workspace:
    """The scratch arrays of one thread, by name; with ``reuse=False`` each array is newly allocated."""

    def __init__(self, *, reuse: bool = True) -> None:
        self._reuse = reuse
        self._arrays: dict[tuple[Any, str], NDArray[Any]] = {}
        self._views: dict[tuple[Any, str, tuple[int, ...]], NDArray[Any]] = {}

    def take(self, shape: tuple[int, ...], dtype: Any, name: str) -> NDArray[Any]:
        """Return an uninitialized array of `shape`; arrays of the same name and dtype share their memory."""
        if not self._reuse:
            return np.empty(shape, dtype)
        view = self._views.get((dtype, name, shape))
        if view is None:
            size = math.prod(shape)
            array = self._arrays.get((dtype, name))
            if array is None or array.size < size or len(self._views) == _MAX_VIEWS:
                self._views.clear()  # also those of the smaller array
            if array is None or array.size < size:
                array = self._arrays[dtype, name] = np.empty(size, dtype)
            view = self._views[dtype, name, shape] = array[:size].reshape(shape)
        return view


NEW_ARRAYS = Workspace(reuse=False)
"""The default workspace of functions that may be called without one."""
