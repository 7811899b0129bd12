"""Arrays reused from call to call: allocating large arrays costs as much as computing their content."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Workspace:
    """The scratch arrays of one thread, by name; with ``reuse=False`` each array is newly allocated."""

    def __init__(self, *, reuse: bool = True) -> None:
        self._reuse = reuse
        self._arrays: dict[tuple[Any, ...], NDArray[Any]] = {}

    def take(self, shape: tuple[int, ...], dtype: Any, name: str) -> NDArray[Any]:
        """Return an uninitialized array of `shape`; arrays of the same name and dtype share their memory."""
        if not self._reuse:
            return np.empty(shape, dtype)
        size = math.prod(shape)
        array = self._arrays.get((name, dtype))
        if array is None or array.size < size:
            array = self._arrays[name, dtype] = np.empty(size, dtype)
        return array[:size].reshape(shape)


NEW_ARRAYS = Workspace(reuse=False)
"""The default workspace of functions that may be called without one."""
