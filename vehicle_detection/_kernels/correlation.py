"""Linear templates as filters over maps of cells: the scores of all windows at once."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numba
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
from vehicle_detection._kernels.jit import jit
from vehicle_detection._kernels.vector import HALF_WORDS, PackedFormat, block_adder, host_block, host_packing

_BLOCK = host_block()
_ROWS, _COLUMNS = _BLOCK.rows, _BLOCK.columns
_add_products = block_adder(_BLOCK)


class _FilterBlocks:
    """The cells of a template in blocks of as many as the registers hold.

    `weights` is ``(rows, columns, depth)``; neighboring cells of a window are `dilation` cells apart.
    """

    def __init__(self, weights: NDArray[Any], dilation: int = 1) -> None:
        rows, columns, depth = weights.shape
        # Column-major order: consecutive cells update different rows of sums, which avoids store-load stalls.
        cells = weights.swapaxes(0, 1).reshape(rows * columns, depth)
        blocks = -(-len(cells) // _ROWS)
        padded = np.zeros((blocks * _ROWS, depth), weights.dtype)
        padded[: len(cells)] = cells
        self.weights = np.ascontiguousarray(padded.reshape(blocks, _ROWS, depth).swapaxes(1, 2))
        self.last_row, self.last_column = (rows - 1) * dilation, (columns - 1) * dilation
        self._rows, self._columns = np.zeros((2, blocks * _ROWS), np.intp)
        positions = np.indices((columns, rows)).reshape(2, -1) * dilation
        self._columns[: len(cells)], self._rows[: len(cells)] = positions

    def offsets(self, stride: int) -> NDArray[np.intp]:
        """Position of each weight's window relative to the cell's, in sums with rows of `stride`.

        The sums include windows that extend beyond the map, so that no product needs a bounds check.
        """
        offsets = (self.last_row - self._rows) * stride + self.last_column - self._columns
        return np.asarray(offsets.reshape(-1, _ROWS), np.intp)


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
        self._blocks = _FilterBlocks(weights.astype(np.float32), dilation)

    def add_to(
        self, channels: NDArray[np.float32], scores: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS
    ) -> None:
        """Add each window's weighted sum of channels to its score, in place.

        `channels` is ``(channels, rows, columns)`` and C-contiguous, `scores`
        ``(window rows, window columns)`` with at most as many windows as fit.
        """
        _, rows, columns = channels.shape
        blocks = self._blocks
        stride = columns + blocks.last_column + _COLUMNS
        sums = workspace.take(((rows + blocks.last_row) * stride,), np.float32, "window sums")
        spans = np.array([(0, len(blocks.weights), 0, rows)])
        _kernel()(channels, blocks.weights, blocks.offsets(stride), spans, sums, stride)
        height, width = scores.shape
        top, left = blocks.last_row, blocks.last_column
        scores += sums.reshape(-1, stride)[top : top + height, left : left + width]


class DenseLayer:
    """A matrix that multiplies others, arranged for the processor's vector registers.

    Unlike BLAS it uses one thread, and the result does not depend on the number of columns.

    >>> DenseLayer(np.float32([[1, 2], [0, 1], [1, 0]]))(np.float32([[1, 0], [2, 3]]))
    array([[5., 6.],
           [2., 3.],
           [1., 0.]], dtype=float32)
    """

    def __init__(self, weights: NDArray[np.floating]) -> None:
        self._outputs, depth = weights.shape
        blocks = -(-self._outputs // _ROWS)
        padded = np.zeros((blocks * _ROWS, depth), np.float32)
        padded[: self._outputs] = weights
        self._weights = np.ascontiguousarray(padded.reshape(blocks, _ROWS, depth).swapaxes(1, 2))

    def __call__(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Multiply by ``(inputs, N)``, C-contiguous; returns ``(outputs, N)``."""
        depth, count = matrix.shape
        stride = count + _COLUMNS
        sums = np.empty(self._weights.shape[0] * _ROWS * stride, np.float32)
        offsets = np.arange(self._weights.shape[0] * _ROWS).reshape(-1, _ROWS) * stride
        spans = np.array([(0, len(self._weights), 0, 1)])
        _kernel()(matrix.reshape(depth, 1, count), self._weights, offsets, spans, sums, stride)
        return sums.reshape(-1, stride)[: self._outputs, :count]


class PackedFilters:
    """Templates over maps of packed channels: the windows with a high score, as integers.

    The weights of a template are rounded to one signed byte each. A window's score is its integer times the
    template's entry of `units`. The integers do not depend on the format.

    Parameters
    ----------
    weights
        ``(rows, columns, channels)`` for each template, in units of the packed channels.
    packing
        Format of the channels; None chooses the fastest of this processor.
    """

    def __init__(
        self, weights: Sequence[NDArray[np.floating]], *, packing: PackedFormat | None = None
    ) -> None:
        self.packing = _packed_format() if packing is None else packing
        self.units = np.array([max(float(np.abs(each).max()), 1e-12) / 127 for each in weights])
        self._templates = [
            _FilterBlocks(self.packing.pack(np.rint(each / unit).astype(np.int8)))
            for each, unit in zip(weights, self.units.tolist())
        ]

    def on_map(
        self,
        columns: int,
        chosen: Sequence[int],
        row_ranges: Sequence[tuple[int, int]],
        bounds: Sequence[float],
    ) -> PackedSearch | None:
        """Prepare the search of maps of `columns` cells in a row with the `chosen` templates.

        It finds the windows inside the half-open `row_ranges` with scores above `bounds`, one of each for
        each chosen template. None without templates.
        """
        templates = [self._templates[index] for index in chosen]
        if not templates:
            return None
        rows = max(last for _, last in row_ranges)
        stride = columns + max(each.last_column for each in templates) + _COLUMNS
        starts = np.cumsum([0] + [(rows + each.last_row) * stride for each in templates]).tolist()
        counts = np.cumsum([0] + [len(each.weights) for each in templates]).tolist()
        planes, spans = [], []
        for number, (template, (first, last)) in enumerate(zip(templates, row_ranges, strict=True)):
            corner = starts[number] + template.last_row * stride + template.last_column
            limit = math.floor(bounds[number] / self.units[chosen[number]])
            limit = min(max(limit, -(2**31)), 2**31 - 1)
            planes.append((corner, first, last - template.last_row, columns - template.last_column, limit))
            spans.append((counts[number], counts[number + 1], first, last))
        return PackedSearch(
            np.concatenate([each.weights for each in templates]),
            np.concatenate([each.offsets(stride) + start for each, start in zip(templates, starts)]),
            np.array(spans, np.int64),
            stride,
            starts[-1],
            np.array(planes, np.int64),
            sum(max(stop - first, 0) * max(width, 0) for _, first, stop, width, _ in planes),
        )


_ALL_COLUMNS = np.empty(0, np.intp)


@dataclass(frozen=True, eq=False)
class PackedSearch:
    """A search of maps of one size with several templates."""

    weights: NDArray[Any]
    offsets: NDArray[np.intp]
    spans: NDArray[np.int64]  # for each template: range of its blocks, range of the map's rows
    stride: int
    length: int  # of the sums of all windows
    planes: NDArray[np.int64]  # for each template: place of its first window, rows, columns, score limit
    windows: int

    def find(
        self,
        packed: NDArray[Any],
        columns: NDArray[np.intp] = _ALL_COLUMNS,
        workspace: Workspace = NEW_ARRAYS,
    ) -> NDArray[np.int32]:
        """Windows of a map ``(words, rows, columns)``: template, row, column and score; ``(N, 4)``.

        Templates are counted in the chosen order. With `columns`, these columns of the map become one cell
        in each row, with the channels of one column after those of the other; the rows lie side by side.
        """
        cells = packed
        if len(columns):
            cells = packed.transpose(2, 0, 1)[columns].reshape(-1, 1, packed.shape[1])
        sums = workspace.take((self.length,), np.int32, "window sums")
        found = workspace.take((self.windows, 4), np.int32, "windows")
        _correlate_blocks(cells, self.weights, self.offsets, self.spans, sums, self.stride)
        return found[: _find_windows(sums, self.stride, self.planes, found)].copy()


@functools.cache
def _packed_format() -> PackedFormat:
    """Return the host's format, or half-words if its instruction does not compile."""
    packing = host_packing()
    try:
        _compile_blocks(numba.from_dtype(np.dtype(packing.dtype)), numba.int32)
    except (numba.core.errors.NumbaError, RuntimeError) as error:  # LLVM's are RuntimeErrors
        logging.getLogger(__name__).warning("correlation uses slower instructions: %s", error)
        return HALF_WORDS
    return packing


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return the block kernel, or plain loops if the block kernel does not compile."""
    try:
        _compile_blocks(numba.float32, numba.float32)
    except numba.core.errors.NumbaError as error:
        logging.getLogger(__name__).warning("correlation uses plain, slower loops: %s", error)
        return _correlate_plain
    return _correlate_blocks


def _compile_blocks(number: Any, total: Any) -> None:
    """Compile the block kernel for numbers and sums of these types."""
    maps, table = number[:, :, ::1], numba.int64[:, ::1]
    cast("Any", _correlate_blocks).compile((maps, maps, numba.intp[:, ::1], table, total[::1], numba.intp))


@jit
def _correlate_blocks(channels, weights, offsets, spans, sums, stride):
    """Add the products of every cell to the sums of the windows that contain it.

    `channels` is ``(depth, rows, columns)``, `weights` ``(blocks, depth, rows of a block)``. `offsets`
    ``(blocks, rows of a block)`` is the position of each weight's window relative to the cell's in `sums`,
    whose rows have `stride` entries. `spans` ``(templates, 4)`` is the range of the blocks of each template,
    and that of the rows of the map on which they are used. Numbers are float32, or packed, see `block_adder`.
    """
    depth, rows, columns = channels.shape
    total = rows * columns
    flat = channels.reshape(depth, total)
    for position in range(len(sums)):
        sums[position] = 0
    # A block may read beyond the last cell of a row; those products are added where no window is.
    tail = np.empty((depth, _COLUMNS), channels.dtype)
    for y in range(rows):
        for x in range(0, columns, _COLUMNS):
            cells, first = flat, y * columns + x
            if first + _COLUMNS > total:
                for channel in range(depth):
                    for column in range(_COLUMNS):
                        position = min(first + column, total - 1)
                        tail[channel, column] = flat[channel, position]
                cells, first = tail, 0
            for block_start, block_stop, row_start, row_stop in spans:
                if row_start <= y < row_stop:
                    for block in range(block_start, block_stop):
                        _add_products(weights, block, cells, first, sums, offsets, y * stride + x)


@jit
def _find_windows(sums, stride, planes, found):
    """List the windows with a score above the limit of their template; returns their number.

    `sums` and `stride` are those of `_correlate_blocks`, and `found` is the output ``(windows, 4)``, see
    `PackedSearch.find`.
    """
    count = 0
    for template in range(len(planes)):
        corner, first, last, width, limit = planes[template]
        for row in range(first, last):
            line = sums[corner + row * stride : corner + row * stride + width]
            best = -0x80000000
            for column in range(width):
                best = max(best, line[column])
            if best > limit:
                for column in range(width):
                    if line[column] > limit:
                        found[count, 0], found[count, 1] = template, row
                        found[count, 2], found[count, 3] = column, line[column]
                        count += 1
    return count


@jit
def _correlate_plain(channels, weights, offsets, spans, sums, stride):
    """`_correlate_blocks` without vector intrinsics."""
    depth, rows, columns = channels.shape
    for position in range(len(sums)):
        sums[position] = 0
    for y in range(rows):
        for block in range(len(weights)):
            for row in range(weights.shape[2]):
                first = y * stride + offsets[block, row]
                line = sums[first : first + columns]
                for channel in range(depth):
                    weight, values = weights[block, channel, row], channels[channel, y]
                    for x in range(columns):
                        line[x] += weight * values[x]
