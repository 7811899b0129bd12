"""Linear templates as filters over maps of cells: the scores of all windows at once."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace, with_spare
from vehicle_detection._kernels.jit import compiles, jit
from vehicle_detection._kernels.vector import block_adder, float_block

_BLOCK = float_block()
_LANES, _COLUMNS = _BLOCK.lanes, _BLOCK.columns
_add_products = block_adder(_BLOCK)
# For at most one vector of each row.
_add_few = block_adder(_BLOCK._replace(vectors=1))

Blocks = NDArray[np.int64]
"""What to multiply, one block of rows of a template in each row: first and last of its entries of `weights`,
first and last row of the map, number of windows in a row, and position in the sums."""


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
        # Blocks of as many rows as the registers hold.
        size = _BLOCK.rows
        count = -(-rows // size)
        padded = np.zeros((count * size, columns, depth), np.float32)
        padded[:rows] = weights
        split = padded.reshape(count, size, columns, depth).transpose(0, 2, 3, 1)
        self._weights = np.ascontiguousarray(split).reshape(-1, depth, size)
        self._dilation, self._last_row, self._columns = dilation, (rows - 1) * dilation, columns
        # Rows of sums before and after those of the windows, because blocks have rows of weights 0.
        self._margin = (size - 1) * dilation
        self._first_rows = np.arange(count) * size * dilation

    def add_to(
        self, channels: NDArray[np.float32], scores: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS
    ) -> None:
        """Add each window's weighted sum of channels to its score, in place.

        `channels` is ``(channels, rows, columns)`` and C-contiguous, `scores`
        ``(window rows, window columns)`` with at most as many windows as fit.
        """
        (height, width), margin = scores.shape, self._margin
        stride = width + _COLUMNS
        sums = workspace.take(((height + 2 * margin) * stride,), np.float32, "window sums")
        blocks = self._list_blocks(height, width, stride)
        _kernel()(with_spare(channels), self._weights, blocks, sums, stride, self._dilation, _COLUMNS)
        scores += sums.reshape(-1, stride)[margin : margin + height, :width]

    def _list_blocks(self, height: int, width: int, stride: int) -> Blocks:
        """List the products for windows whose sums have rows of `stride` entries, after `margin` rows."""
        tops = self._first_rows
        first_weights = np.arange(len(tops)) * self._columns
        stops = np.minimum(height + tops + self._margin if height else tops, height + self._last_row)
        columns = (
            first_weights,
            first_weights + self._columns,
            tops,
            stops,
            np.full(len(tops), width),
            (self._margin - tops) * stride,
        )
        return np.column_stack(columns).astype(np.int64)


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return the block kernel for float32, or plain loops if it does not compile."""
    values, table = numba.float32[:, :, ::1], numba.int64[:, ::1]
    types = values, values, table, numba.float32[::1], *[numba.intp] * 3
    return _correlate_blocks if compiles(_correlate_blocks, *types) else _correlate_plain


@jit
def _correlate_blocks(channels, weights, blocks, sums, stride, dilation, tile):
    """Compute the sums of products of all windows.

    `channels` is ``(depth, rows, columns)``, `weights` ``(N, depth, rows of a block)``, and
    `blocks` as in `Blocks`. `sums` is the output, with rows of `stride` entries. `tile` is the columns of a
    block, see `block_adder`. Values are read up to a tile beyond the end of a row, also of the last one
    (`with_spare`), and added where no window is.
    """
    depth, rows, columns = channels.shape
    total = rows * columns
    cells = channels.reshape(depth * total)
    for position in range(len(sums)):
        sums[position] = 0
    widest = 0
    for block in range(len(blocks)):
        widest = max(widest, blocks[block, 4])
    for y in range(rows):
        for x in range(0, widest, tile):
            for block in range(len(blocks)):
                first, last, row_start, row_stop, width, place = blocks[block]
                if x < width and row_start <= y < row_stop:
                    start = y * columns + x
                    position, row_step = place + y * stride + x, dilation * stride
                    if width - x > _LANES:
                        _add_products(
                            weights, first, last, cells, start, total, dilation, sums, position, row_step
                        )
                    else:
                        _add_few(
                            weights, first, last, cells, start, total, dilation, sums, position, row_step
                        )


@jit
def _correlate_plain(channels, weights, blocks, sums, stride, dilation, tile):
    """`_correlate_blocks` without vector intrinsics."""
    rows = channels.shape[1]
    for position in range(len(sums)):
        sums[position] = 0
    for block in range(len(blocks)):
        first, last, row_start, row_stop, width, place = blocks[block]
        for y in range(row_start, min(row_stop, rows)):
            for row in range(weights.shape[2]):
                position = place + y * stride - row * dilation * stride
                line = sums[position : position + width]
                for k in range(weights.shape[1]):
                    for number in range(first, last):
                        weight = weights[number, k, row]
                        values = channels[k, y, (number - first) * dilation :]
                        for x in range(width):
                            line[x] += weight * values[x]
