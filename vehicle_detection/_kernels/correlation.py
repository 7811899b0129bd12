"""Linear templates as filters over maps of cells: the scores of all windows at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
from vehicle_detection._kernels.jit import jit
from vehicle_detection._kernels.vector import block_adder, host_block

_BLOCK = host_block()
_ROWS, _COLUMNS = _BLOCK.rows, _BLOCK.columns
_add_products = block_adder(_BLOCK)


class Filter:
    """The weights of a template's cells, laid out for the processor.

    Parameters
    ----------
    weights
        ``(rows, columns, planes)``: what each cell of a window adds to its score.
    spread
        Cells from one cell of a window to the next.

    Examples
    --------
    >>> scores = np.zeros((2, 3), np.float32)
    >>> Filter(np.ones((2, 2, 1))).add_to(np.ones((1, 3, 4), np.float32), scores)
    >>> scores
    array([[4., 4., 4.],
           [4., 4., 4.]], dtype=float32)
    """

    def __init__(self, weights: NDArray[np.floating], *, spread: int = 1) -> None:
        rows, columns, depth = weights.shape
        # Down the columns: cells above each other add to different rows of scores, and nobody waits.
        cells = weights.swapaxes(0, 1).reshape(rows * columns, depth)
        blocks = -(-len(cells) // _ROWS)
        padded = np.zeros((blocks * _ROWS, depth), np.float32)
        padded[: len(cells)] = cells
        self._weights = np.ascontiguousarray(padded.reshape(blocks, _ROWS, depth).swapaxes(1, 2))
        self._reach = (rows - 1) * spread, (columns - 1) * spread
        places = np.indices((columns, rows)).reshape(2, -1) * spread
        self._across, self._down = np.zeros((2, blocks * _ROWS), np.intp)
        self._across[: len(cells)], self._down[: len(cells)] = places

    def add_to(
        self, planes: NDArray[np.float32], scores: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS
    ) -> None:
        """Add, to each window's score, the products of its cells.

        Parameters
        ----------
        planes
            ``(planes, rows, columns)`` float32, C-contiguous.
        scores
            Changed in place, ``(window rows, window columns)`` float32; at most as many as fit the map.
        workspace
            Provides the scratch arrays.
        """
        down, across = self._reach
        _, rows, columns = planes.shape
        stride = columns + across + _COLUMNS
        # Sums also of windows that hang over on any side: so no product needs to ask.
        sums = workspace.take((rows + down, stride), np.float32, "window sums")
        offsets = (down - self._down) * stride + across - self._across
        _correlate(planes, self._weights, offsets.reshape(-1, _ROWS), sums)
        height, width = scores.shape
        scores += sums[down : down + height, across : across + width]


@jit
def _correlate(planes, weights, offsets, sums):
    """Add the products of every cell to the sums of the windows that hold it.

    Parameters
    ----------
    planes
        ``(depth, rows, columns)`` float32.
    weights, offsets
        ``(blocks, depth, rows of a block)`` float32, and for each row the place of its window, relative to
        the cell's in `sums`.
    sums
        Output, ``(more than rows, more than columns)`` float32.
    """
    depth, rows, columns = planes.shape
    total = rows * columns
    flat = planes.reshape(depth, total)
    stride = sums.shape[1]
    out = sums.reshape(-1)
    for place in range(len(out)):
        out[place] = np.float32(0)
    # What lies behind the last cell is read, and added where no window is.
    tail = np.zeros((depth, _COLUMNS), np.float32)
    for y in range(rows):
        for x in range(0, columns, _COLUMNS):
            first = y * columns + x
            if first + _COLUMNS <= total:
                for block in range(len(weights)):
                    _add_products(weights, block, flat, first, out, offsets, y * stride + x)
            else:
                for plane in range(depth):
                    for place in range(first, total):
                        tail[plane, place - first] = flat[plane, place]
                for block in range(len(weights)):
                    _add_products(weights, block, tail, 0, out, offsets, y * stride + x)
