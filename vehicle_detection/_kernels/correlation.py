"""Linear templates as filters over maps of cells: the scores of all windows at once."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, SPARE, Workspace, with_spare
from vehicle_detection._kernels.jit import compiles, inlined, jit
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
_LANES = _FLOATS.lanes
_add_products = block_adder(_FLOATS, _BYTES)
# For at most one vector of each row.
_add_few = block_adder(_FLOATS._replace(vectors=1), _BYTES._replace(vectors=1))

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
        _kernel()(
            with_spare(channels), filters.weights, blocks, sums, stride, filters.dilation, _FLOATS.columns
        )
        scores += sums.reshape(-1, stride)[margin : margin + height, :width]


_NO_COLUMNS = np.empty(0, np.intp)


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
        merged: NDArray[np.intp] = _NO_COLUMNS,
    ) -> PackedSearch | None:
        """Prepare the search of maps of `columns` cells in a row with the `chosen` templates.

        It finds the windows inside the half-open `row_ranges` with scores above `bounds`, one of each for
        each chosen template. With `merged`, these columns of a map become one cell in each row, with the
        channels of one column after those of the other, and the rows lie side by side: `columns` is then the
        number of rows of the map. None without templates.
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
        sizes = [sum(len(each) for each in blocks), len(planes), len(merged), start, stride]
        return PackedSearch(
            np.concatenate([each.weights for each in templates]),
            np.concatenate(blocks),
            np.array(planes, np.int64),
            merged.astype(np.int64),
            np.array([sizes], np.int64),
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


@dataclass(frozen=True, eq=False)
class PackedSearch:
    """Searches of maps of one size, each with several templates."""

    weights: NDArray[np.int32]
    blocks: Blocks
    planes: NDArray[np.int64]  # for each template: place of its first window, rows, columns, score limit
    merged: NDArray[np.int64]  # columns
    sizes: NDArray[np.int64]  # for each search: blocks, planes, merged columns, length and stride of the sums

    @classmethod
    def join(cls, searches: Sequence[PackedSearch]) -> PackedSearch:
        """Join at least one search into one call; their depths are divided into the same groups."""
        weights, blocks, planes, merged, sizes = (
            [getattr(each, name.name) for each in searches] for name in fields(cls)
        )
        first = 0
        for number, each in enumerate(weights):
            blocks[number] = blocks[number] + first * np.array([1, 1, 0, 0, 0, 0, 0])
            first += len(each)
        return cls(*map(np.concatenate, (weights, blocks, planes, merged, sizes)))

    @functools.cached_property
    def _memory(self) -> tuple[int, int]:
        """Length of the longest sums, and largest number of windows."""
        windows = (self.planes[:, 2] - self.planes[:, 1]) * self.planes[:, 3]
        return int(self.sizes[:, 3].max()), int(windows.sum())

    def find(self, packed: NDArray[np.int32], workspace: Workspace = NEW_ARRAYS) -> NDArray[np.int32]:
        """Windows of a map ``(words, rows, columns)``: search, template, row, column and score; ``(N, 5)``.

        Templates are counted in the chosen order.
        """
        length, windows = self._memory
        sums = workspace.take((length,), np.int32, "window sums")
        found = workspace.take((windows, 5), np.int32, "windows")
        tables = self.weights, self.blocks, self.planes, self.merged, self.sizes
        return found[: _packed_kernel()(with_spare(packed), *tables, sums, _BYTES.columns, found)].copy()


@functools.cache
def _packed_kernel() -> Callable[..., int]:
    """Return the kernel of `PackedSearch.find`, or plain loops if it does not compile."""
    words, table = numba.int32[:, :, ::1], numba.int64[:, ::1]
    types = words, words, table, table, numba.int64[::1], table, numba.int32[::1], numba.intp
    return _find_windows if compiles(_find_windows, *types, numba.int32[:, ::1]) else _find_windows_plain


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return the block kernel for float32, or plain loops if it does not compile."""
    values, table = numba.float32[:, :, ::1], numba.int64[:, ::1]
    types = values, values, table, numba.float32[::1], *[numba.intp] * 3
    return _correlate_blocks if compiles(_correlate_blocks, *types) else _correlate_plain


@inlined
def _sum_blocks(channels, weights, blocks, sums, stride, dilation, tile):
    """Compute the sums of products of all windows.

    `channels` is ``(depth, rows, columns)``, `weights` ``(N, channels of a group, rows of a block)``, and
    `blocks` as in `Blocks`. `sums` is the output, with rows of `stride` entries. Numbers are float32, or
    packed, and `tile` is the columns of their block, see `block_adder`. Values are read up to a tile beyond
    the end of a row, also of the last one (`with_spare`), and added where no window is.
    """
    depth, rows, columns = channels.shape
    total = rows * columns
    cells = channels.reshape(depth * total)
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
                    start = channel * total + y * columns + x
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
def _correlate_blocks(channels, weights, blocks, sums, stride, dilation, tile):
    """`_sum_blocks` as a kernel of its own."""
    _sum_blocks(channels, weights, blocks, sums, stride, dilation, tile)


@jit
def _find_windows(packed, weights, blocks, planes, merged, sizes, sums, tile, found):
    """List the windows of all searches in `found`, and return their number; see `PackedSearch`."""
    count = first_block = first_plane = first_column = 0
    for search in range(len(sizes)):
        n_blocks, n_planes, n_columns, length, stride = sizes[search]
        cells = packed
        if n_columns:
            cells = _merge_columns(packed, merged[first_column : first_column + n_columns])
        part = blocks[first_block : first_block + n_blocks]
        _sum_blocks(cells, weights, part, sums[:length], stride, 1, tile)
        count = _list_windows(
            sums, stride, planes[first_plane : first_plane + n_planes], search, found, count
        )
        first_block, first_plane, first_column = (
            first_block + n_blocks,
            first_plane + n_planes,
            first_column + n_columns,
        )
    return count


@inlined
def _merge_columns(packed, merged):
    """Make the columns of a map one cell in each row; the rows lie side by side."""
    words, rows, columns = packed.shape
    flat = packed.reshape(packed.size)
    size = len(merged) * words * rows
    cells = np.empty(size + SPARE, packed.dtype)
    place = 0
    for column in merged:
        for start in range(column, column + words * rows * columns, columns):
            cells[place] = flat[start]
            place += 1
    return cells[:size].reshape(len(merged) * words, 1, rows)


@inlined
def _list_windows(sums, stride, planes, search, found, count):
    """List the windows with a score above the limit of their template, after `count` others."""
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
                        found[count, 0], found[count, 1] = search, template
                        found[count, 2], found[count, 3], found[count, 4] = row, column, line[column]
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


def _find_windows_plain(
    packed: NDArray[np.int32],
    weights: NDArray[np.int32],
    blocks: Blocks,
    planes: NDArray[np.int64],
    merged: NDArray[np.int64],
    sizes: NDArray[np.int64],
    sums: NDArray[np.int32],
    _tile: int,
    found: NDArray[np.int32],
) -> int:
    """`_find_windows` without vector intrinsics."""
    factors = _unpack_axis(weights, 1)
    count = first_block = first_plane = first_column = 0
    for search, (n_blocks, n_planes, n_columns, length, stride) in enumerate(sizes.tolist()):
        columns = merged[first_column : first_column + n_columns]
        cells = _unpack_axis(_merge_columns(packed, columns) if n_columns else packed, 0)
        part = blocks[first_block : first_block + n_blocks] * np.array([1, 1, 4, 1, 1, 1, 1])
        _correlate_plain(cells, factors, part, sums[:length], stride, 1, 1)
        part = planes[first_plane : first_plane + n_planes]
        count = _list_windows(sums, stride, part, search, found, count)
        first_block, first_plane = first_block + n_blocks, first_plane + n_planes
        first_column += n_columns
    return count


def _unpack_axis(words: NDArray[np.int32], axis: int) -> NDArray[np.int32]:
    """Replace each word by its four bytes along an axis."""
    return np.ascontiguousarray(np.moveaxis(unpack_bytes(np.moveaxis(words, axis, -1)), -1, axis))
