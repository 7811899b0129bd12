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
        self._shape = rows, columns, dilation
        # Rows of sums before and after those of the windows, because blocks have rows of weights 0.
        self._margin = (size - 1) * dilation

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
        _kernel()(with_spare(channels), self._weights, sums, height, width, _COLUMNS, *self._shape)
        scores += sums.reshape(-1, stride)[margin : margin + height, :width]


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return the block kernel for float32, or plain loops if it does not compile."""
    values = numba.float32[:, :, ::1]
    types = values, values, numba.float32[::1], *[numba.intp] * 6
    return _correlate_blocks if compiles(_correlate_blocks, *types) else _correlate_plain


@jit
def _correlate_blocks(channels, weights, sums, height, width, tile, window_rows, window_columns, dilation):
    """Compute the sums of products of ``height * width`` windows of ``window_rows * window_columns`` cells.

    `channels` is ``(depth, rows, columns)`` and `weights` ``(N, depth, rows of a block)``, `window_columns`
    entries for each block. `sums` is the output, with rows of ``width + tile`` entries. `tile` is the columns
    of a block, see `block_adder`. Values are read up to a tile beyond the end of a row, also of the last one
    (`with_spare`), and added where no window is.
    """
    depth, rows, columns = channels.shape
    total, size = rows * columns, weights.shape[2]
    cells = channels.reshape(depth * total)
    stride, margin = width + tile, (size - 1) * dilation
    for position in range(len(sums)):
        sums[position] = 0
    for y in range(rows):
        for x in range(0, width, tile):
            for first in range(0, len(weights), window_columns):
                last, top = first + window_columns, first // window_columns * size * dilation
                if top <= y < height + min(top + margin, (window_rows - 1) * dilation):
                    start = y * columns + x
                    position, row_step = (margin - top + y) * stride + x, dilation * stride
                    if width - x > _LANES:
                        _add_products(
                            weights, first, last, cells, start, total, dilation, sums, position, row_step
                        )
                    else:
                        _add_few(
                            weights, first, last, cells, start, total, dilation, sums, position, row_step
                        )


@jit
def _correlate_plain(channels, weights, sums, height, width, tile, window_rows, window_columns, dilation):
    """`_correlate_blocks` without vector intrinsics."""
    size, stride = weights.shape[2], width + tile
    margin = (size - 1) * dilation
    for position in range(len(sums)):
        sums[position] = 0
    for first in range(0, len(weights), window_columns):
        top = first // window_columns * size * dilation
        for y in range(top, height + min(top + margin, (window_rows - 1) * dilation)):
            for row in range(size):
                position = (margin - top + y - row * dilation) * stride
                line = sums[position : position + width]
                for k in range(weights.shape[1]):
                    for column in range(window_columns):
                        weight = weights[first + column, k, row]
                        values = channels[k, y, column * dilation :]
                        for x in range(width):
                            line[x] += weight * values[x]
