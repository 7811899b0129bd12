"""Linear templates as filters over maps of cells: the scores of all windows at once."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
from vehicle_detection._kernels.jit import jit
from vehicle_detection._kernels.vector import block_adder, host_block

_BLOCK = host_block()
_ROWS, _COLUMNS = _BLOCK.rows, _BLOCK.columns
_add_products = block_adder(_BLOCK)


class Filter:
    """The weights of a template, arranged for the processor's vector registers.

    `weights` is ``(rows, columns, channels)``; neighboring cells of a window are `dilation` cells apart.

    >>> scores = np.zeros((2, 3), np.float32)
    >>> Filter(np.ones((2, 2, 1))).add_to(np.ones((1, 3, 4), np.float32), scores)
    >>> scores
    array([[4., 4., 4.],
           [4., 4., 4.]], dtype=float32)
    """

    def __init__(self, weights: NDArray[np.floating], *, dilation: int = 1) -> None:
        rows, columns, depth = weights.shape
        # Column-major order: consecutive cells update different rows of sums, which avoids store-load stalls.
        cells = weights.swapaxes(0, 1).reshape(rows * columns, depth)
        blocks = -(-len(cells) // _ROWS)
        padded = np.zeros((blocks * _ROWS, depth), np.float32)
        padded[: len(cells)] = cells
        self._weights = np.ascontiguousarray(padded.reshape(blocks, _ROWS, depth).swapaxes(1, 2))
        self._last_row, self._last_column = (rows - 1) * dilation, (columns - 1) * dilation
        self._cell_rows, self._cell_columns = np.zeros((2, blocks * _ROWS), np.intp)
        positions = np.indices((columns, rows)).reshape(2, -1) * dilation
        self._cell_columns[: len(cells)], self._cell_rows[: len(cells)] = positions

    def add_to(
        self, channels: NDArray[np.float32], scores: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS
    ) -> None:
        """Add each window's weighted sum of channels to its score, in place.

        `channels` is ``(channels, rows, columns)`` and C-contiguous, `scores`
        ``(window rows, window columns)`` with at most as many windows as fit.
        """
        _, rows, columns = channels.shape
        stride = columns + self._last_column + _COLUMNS
        # The sums include windows that extend beyond the map, so that no product needs a bounds check.
        sums = workspace.take((rows + self._last_row, stride), np.float32, "window sums")
        offsets = (self._last_row - self._cell_rows) * stride + self._last_column - self._cell_columns
        _kernel()(channels, self._weights, offsets.reshape(-1, _ROWS), sums)
        height, width = scores.shape
        top, left = self._last_row, self._last_column
        scores += sums[top : top + height, left : left + width]


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return the block kernel, or plain loops if the block kernel does not compile."""
    floats, kernel = numba.float32, cast("Any", _correlate_blocks)
    try:
        kernel.compile((floats[:, :, ::1], floats[:, :, ::1], numba.intp[:, ::1], floats[:, ::1]))
    except numba.core.errors.NumbaError as error:
        logging.getLogger(__name__).warning("correlation uses plain, slower loops: %s", error)
        return _correlate_plain
    return _correlate_blocks


@jit
def _correlate_blocks(channels, weights, offsets, sums):
    """Add the products of every cell to the sums of the windows that contain it.

    `channels` is ``(depth, rows, columns)``, `weights` ``(blocks, depth, rows of a block)``. `offsets`
    ``(blocks, rows of a block)`` is the position of each weight's window relative to the cell's in `sums`.
    """
    depth, rows, columns = channels.shape
    total = rows * columns
    flat = channels.reshape(depth, total)
    stride = sums.shape[1]
    out = sums.reshape(-1)
    for position in range(len(out)):
        out[position] = np.float32(0)
    # A block may read beyond the last cell of a row; those products are added where no window is.
    tail = np.zeros((depth, _COLUMNS), np.float32)
    for y in range(rows):
        for x in range(0, columns, _COLUMNS):
            first = y * columns + x
            if first + _COLUMNS <= total:
                for block in range(len(weights)):
                    _add_products(weights, block, flat, first, out, offsets, y * stride + x)
            else:
                for channel in range(depth):
                    for position in range(first, total):
                        tail[channel, position - first] = flat[channel, position]
                for block in range(len(weights)):
                    _add_products(weights, block, tail, 0, out, offsets, y * stride + x)


@jit
def _correlate_plain(channels, weights, offsets, sums):
    """`_correlate_blocks` without vector intrinsics."""
    depth, rows, columns = channels.shape
    stride = sums.shape[1]
    out = sums.reshape(-1)
    for position in range(len(out)):
        out[position] = np.float32(0)
    for y in range(rows):
        for block in range(len(weights)):
            for row in range(weights.shape[2]):
                first = y * stride + offsets[block, row]
                line = out[first : first + columns]
                for channel in range(depth):
                    weight, values = weights[block, channel, row], channels[channel, y]
                    for x in range(columns):
                        line[x] += weight * values[x]
