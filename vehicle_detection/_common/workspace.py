"""Arrays that are used again: fresh memory costs as much as the work in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Take = Callable[..., NDArray[Any]]
"""``take(shape, dtype, name)`` hands out an array with whatever was in it."""


def new_array(shape: tuple[int, ...], dtype: Any, _name: str = "") -> NDArray[Any]:
    """Take fresh memory."""
    return np.empty(shape, dtype)


class Buffers:
    """The arrays of one thread, by name."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[Any, ...], NDArray[Any]] = {}

    def take(self, shape: tuple[int, ...], dtype: Any, name: str = "") -> NDArray[Any]:
        """Hand out an array of `shape`, of the same memory for the same name."""
        size = math.prod(shape)
        array = self._arrays.get((name, dtype))
        if array is None or array.size < size:
            array = self._arrays[name, dtype] = np.empty(size, dtype)
        return array[:size].reshape(shape)
