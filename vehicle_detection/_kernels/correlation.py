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
from vehicle_detection._kernels.vector import (
    BYTE_LIMIT,
    GROUP,
    MAX_FACTORS,
    block_adder,
    byte_block,
    float_block,
    pack_bytes,
    unpack_bytes,
)

_FLOATS, _BYTES = float_block(), byte_block()
_add_products = block_adder(_FLOATS, _BYTES)

Blocks = NDArray[np.int64]
"""What to multiply, one block of rows of a template in each row: first and last of its entries of `weights`,
first channel, first and last row of the map, number of windows in a row, and position in the sums."""


class _FilterBlocks:
    """The rows of a template in blocks of as many as the registers hold.

    `weights` is ``(rows, columns, depth)``; neighboring cells of a window are `dilation` cells apart. The
    channels are in groups of `group`, which divides the depth.
    """

    def __init__(self, weights: NDArray[Any], group: int, dilation: int = 1) -> None:
        rows, columns, depth = weights.shape
        size, groups = (_FLOATS if weights.dtype == np.float32 else _BYTES).rows, depth // group
        count = -(-rows // size)
        padded = np.zeros((count * size, columns, depth), weights.dtype)
        padded[:rows] = weights
        split = padded.reshape(count, size, columns, groups, group).transpose(0, 3, 2, 4, 1)
        self.weights = np.ascontiguousarray(split).reshape(-1, group, size)
        self.dilation = dilation
        self.last_row, self.last_column = (rows - 1) * dilation, (columns - 1) * dilation
        # Rows of sums before and after those of the windows, because blocks have rows of weights 0.
        self.margin = (size - 1) * dilation
        number, part = np.divmod(np.arange(count * groups), groups)
        self._first_weights, self._columns = np.arange(count * groups) * columns, columns
        self._first_rows, self._first_channels = number * size * dilation, part * group

    def blocks(self, rows: tuple[int, int], width: int, place: int, stride: int) -> Blocks:
        """List the products for the windows of some rows, the first of which is at `place` in the sums.

        The sums have rows of `stride` entries. There are `margin` rows more before and after.
        """
        first, last = rows
        tops = self._first_rows
        stops = last + tops + self.margin if last > first else first + tops
        stops = np.minimum(stops, last + self.last_row)
        columns = (
            self._first_weights,
            self._first_weights + self._columns,
            self._first_channels,
            first + tops,
            stops,
            np.full(len(tops), width),
            place - (first + tops) * stride,
        )
        return np.column_stack(columns).astype(np.int64)


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
        self._blocks = _FilterBlocks(weights.astype(np.float32), weights.shape[-1], dilation)

    def add_to(
        self, channels: NDArray[np.float32], scores: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS
    ) -> None:
        """Add each window's weighted sum of channels to its score, in place.

        `channels` is ``(channels, rows, columns)`` and C-contiguous, `scores`
        ``(window rows, window columns)`` with at most as many windows as fit.
        """
        filters, (height, width) = self._blocks, scores.shape
        stride, margin = width + _FLOATS.columns, filters.margin
        sums = workspace.take(((height + 2 * margin) * stride,), np.float32, "window sums")
        blocks = filters.blocks((0, height), width, margin * stride, stride)
        _kernel()(channels, filters.weights, blocks, sums, stride, filters.dilation, _FLOATS.columns)
        scores += sums.reshape(-1, stride)[margin : margin + height, :width]


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
        self._weights = _FilterBlocks(weights[:, None].astype(np.float32), depth).weights

    def __call__(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Multiply by ``(inputs, N)``, C-contiguous; returns ``(outputs, N)``."""
        depth, count = matrix.shape
        number, _, size = self._weights.shape
        index, stride = np.arange(number), count + _FLOATS.columns
        sums = np.empty(number * size * stride, np.float32)
        # The outputs are rows of a template, whose windows lie in the opposite order.
        places = ((number - index) * size - 1) * stride
        blocks = np.column_stack([index, index + 1, *np.tile([[0], [0], [1], [count]], number), places])
        _kernel()(matrix.reshape(depth, 1, count), self._weights, blocks, sums, stride, 1, _FLOATS.columns)
        return sums.reshape(-1, stride)[::-1][: self._outputs, :count]


class PackedFilters:
    """Templates over maps of packed channels: the windows with a high score, as integers.

    The weights of a template are rounded to one signed byte each. A window's score is its integer times the
    template's entry of `units`. The integers are the same on every processor: none is rounded or saturated.

    `weights` are ``(rows, columns, channels)`` for each template, in units of the packed channels, which have
    values up to `BYTE_LIMIT`.
    """

    def __init__(self, weights: Sequence[NDArray[np.floating]]) -> None:
        self.units = np.array([_unit(each) for each in weights])
        words = [
            pack_bytes(np.rint(each / unit).astype(np.int8))
            for each, unit in zip(weights, self.units.tolist())
        ]
        self._templates = [_FilterBlocks(each, _group(each.shape[-1])) for each in words]

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
        widths = [max(columns - each.last_column, 0) for each in templates]
        stride = max(widths) + _BYTES.columns
        blocks, planes, start, weights = [], [], 0, 0
        for number, (template, (first, last)) in enumerate(zip(templates, row_ranges, strict=True)):
            last = max(last - template.last_row, first)
            place = start + template.margin * stride
            table = template.blocks((first, last), widths[number], place, stride)
            table[:, :2] += weights
            blocks.append(table)
            limit = math.floor(bounds[number] / self.units[chosen[number]])
            limit = min(max(limit, -(2**31)), 2**31 - 1)
            planes.append((place - first * stride, first, last, widths[number], limit))
            start += (last - first + 2 * template.margin) * stride
            weights += len(template.weights)
        return PackedSearch(
            np.concatenate([each.weights for each in templates]),
            np.concatenate(blocks),
            stride,
            start,
            np.array(planes, np.int64),
            sum((last - first) * width for _, first, last, width, _ in planes),
        )


def _group(words: int) -> int:
    """Divide a depth into groups: the largest number of words up to `GROUP` that divides it."""
    return max(each for each in range(1, GROUP + 1) if words % each == 0)


def _unit(weights: NDArray[np.floating]) -> float:
    """Smallest unit in which the weights are bytes, and no sum of their products in 16 bits overflows."""
    words = weights.reshape(*weights.shape[:2], -1, _group(weights.shape[-1] // 4), 2, 2)
    # The first and the second halves of the words of a group.
    sums = [np.maximum(each, 0).sum(axis=(3, 5)).max() for each in (words, -words)]
    # Each of the ten weights is rounded by at most a half.
    return max(float(np.abs(weights).max()) / BYTE_LIMIT, float(max(sums)) / (MAX_FACTORS - GROUP), 1e-12)


_ALL_COLUMNS = np.empty(0, np.intp)


@dataclass(frozen=True, eq=False)
class PackedSearch:
    """A search of maps of one size with several templates."""

    weights: NDArray[np.int32]
    blocks: Blocks
    stride: int
    length: int  # of the sums of all windows
    planes: NDArray[np.int64]  # for each template: place of its first window, rows, columns, score limit
    windows: int

    def find(
        self,
        packed: NDArray[np.int32],
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
        _packed_kernel()(cells, self.weights, self.blocks, sums, self.stride, 1, _BYTES.columns)
        return found[: _find_windows(sums, self.stride, self.planes, found)].copy()


@functools.cache
def _packed_kernel() -> Callable[..., None]:
    """Return the block kernel for packed numbers, or plain loops if it does not compile."""
    try:
        _compile_blocks(numba.int32, numba.int32)
    except (numba.core.errors.NumbaError, RuntimeError) as error:  # LLVM's are RuntimeErrors
        logging.getLogger(__name__).warning("correlation uses plain, slower loops: %s", error)
        return _correlate_unpacked
    return _correlate_blocks


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
    cast("Any", _correlate_blocks).compile((maps, maps, table, total[::1], *[numba.intp] * 3))


@jit
def _correlate_blocks(channels, weights, blocks, sums, stride, dilation, tile):
    """Compute the sums of products of all windows.

    `channels` is ``(depth, rows, columns)``, `weights` ``(N, channels of a group, rows of a block)``, and
    `blocks` as in `Blocks`. `sums` is the output, with rows of `stride` entries. Numbers are float32, or
    packed, and `tile` is the columns of their block, see `block_adder`.
    """
    depth, rows, columns = channels.shape
    group = weights.shape[1]
    total = rows * columns
    flat = channels.reshape(depth * total)
    end, end_start, end_extent = flat, -1, -1
    for position in range(len(sums)):
        sums[position] = 0
    widest = 0
    for block in range(len(blocks)):
        widest = max(widest, blocks[block, 5])
    for y in range(rows):
        for x in range(0, widest, tile):
            for block in range(len(blocks)):
                first, last, channel, row_start, row_stop, width, place = blocks[block]
                if x < width and row_start <= y < row_stop:
                    # Values beyond the last cell of a row are added where no window is.
                    cells, start, step = flat, channel * total + y * columns + x, total
                    extent = (last - first - 1) * dilation + tile
                    if start + (group - 1) * total + extent > depth * total:
                        if start != end_start or extent != end_extent:
                            end = _end_of_cells(flat, start, total, group, extent)
                            end_start, end_extent = start, extent
                        cells, start, step = end, 0, extent
                    position, row_step = place + y * stride + x, dilation * stride
                    _add_products(
                        weights, first, last, cells, start, step, dilation, sums, position, row_step
                    )


@jit
def _end_of_cells(flat, start, step, count, length):
    """Copy parts of the channels, of `length` cells, that go beyond the end; the last cell is repeated."""
    copy = np.empty(count * length, flat.dtype)
    for channel in range(count):
        for cell in range(length):
            position = min(start + channel * step + cell, len(flat) - 1)
            copy[channel * length + cell] = flat[position]
    return copy


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
def _correlate_plain(channels, weights, blocks, sums, stride, dilation, tile):
    """`_correlate_blocks` without vector intrinsics, for numbers that are not packed."""
    rows = channels.shape[1]
    for position in range(len(sums)):
        sums[position] = 0
    for block in range(len(blocks)):
        first, last, channel, row_start, row_stop, width, place = blocks[block]
        for y in range(row_start, min(row_stop, rows)):
            for row in range(weights.shape[2]):
                position = place + y * stride - row * dilation * stride
                line = sums[position : position + width]
                for k in range(weights.shape[1]):
                    for number in range(first, last):
                        weight = weights[number, k, row]
                        values = channels[channel + k, y, (number - first) * dilation :]
                        for x in range(width):
                            line[x] += weight * values[x]


def _correlate_unpacked(
    channels: NDArray[np.int32],
    weights: NDArray[np.int32],
    blocks: Blocks,
    sums: NDArray[np.int32],
    stride: int,
    dilation: int,
    tile: int,
) -> None:
    """`_correlate_plain` for packed numbers."""
    numbers = [
        np.ascontiguousarray(np.moveaxis(unpack_bytes(np.moveaxis(each, axis, -1)), -1, axis))
        for each, axis in ((channels, 0), (weights, 1))
    ]
    blocks = blocks.copy()
    blocks[:, 2] *= 4
    _correlate_plain(*numbers, blocks, sums, stride, dilation, tile)
