"""Numba kernels of FHOG: signed and unsigned orientations of cells, with four normalizations.

Loops over channels take their number from an array: with a number in the code, the compiler unrolls them,
which takes seconds.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vehicle_detection._kernels.jit import inlined, jit
from vehicle_detection._kernels.vector import float_block, transposer, weighted_sum

SQUARE, SMALL_SQUARE = 4, 2
"""Sides in pixels of the squares over which gradients are summed, and of those for crops of small cells."""

# Numbers of a vector, and the transposition of a square of as many a side.
_LANES = float_block().lanes
_transpose = transposer(_LANES)
# Replicated pixels left of the image in a row of square roots: a square, and a neighbor for its gradients.
_LEFT = SQUARE + 1


@jit
def split_channels(image, first, last, channels, halves):
    """Copy the channels of an image ``(H, W, 3)`` to ``(3, H, W)``, and average 2x2 pixels of each.

    Only the rows from `first`, an even number, to before `last` are copied. An odd last row or column is
    replicated. `halves` may have no rows: then nothing is averaged. OpenCV's functions take longer because
    they do not leave the channels in the processor's cache in between.
    """
    height, width = channels.shape[1:]
    for y in range(first, last):
        row, red, green, blue = image[y].reshape(-1), channels[0, y], channels[1, y], channels[2, y]
        for x in range(width):
            red[x] = row[3 * x]
            green[x] = row[3 * x + 1]
            blue[x] = row[3 * x + 2]
        if y // 2 < halves.shape[1] and (y % 2 or y + 1 == height):
            for c in range(len(channels)):
                above, below, half = channels[c, y - y % 2], channels[c, y], halves[c, y // 2]
                for x in range(width // 2):
                    sums = np.int32(above[2 * x]) + above[2 * x + 1] + below[2 * x] + below[2 * x + 1]
                    half[x] = (sums + 2) >> 2
                if width % 2:
                    half[width // 2] = (np.int32(above[width - 1]) + below[width - 1] + 1) >> 1


@jit
def _sqrt_row(row, left, right, roots):
    """Write ``sqrt(255 * value)`` of a part of a row of pixels after `_LEFT` others; replicate its ends."""
    width, row = right - left, row[left:right]
    scale = np.float32(255)
    inner = roots[_LEFT:]
    for x in range(width):
        inner[x] = np.sqrt(scale * np.float32(row[x]))
    for x in range(_LEFT):
        roots[x] = inner[0]
    for x in range(width, len(inner)):
        inner[x] = inner[width - 1]


@jit
def orientation_sums(channels, regions, cotangents, square, sums):
    """Sum gradient magnitudes by 16 signed orientations over squares of `square` pixels a side.

    `channels` is ``(3, H, W)`` uint8, `cotangents` ``(8,)`` float32 of the angles 11.25, 33.75, ..., 168.75
    degrees, and `square` 4 or 2. `regions` ``(N, 8)`` are parts of the image: left, top, right and bottom in
    pixels; the first row of squares whose sums are computed, from -1 on, and the number of rows; the number
    of columns, of which the first is -1; and the place of the region's first sum in `sums`, the output, a
    float32 array ``(rows, columns, 16)`` for each region. Squares may lie beyond the region, whose borders
    are replicated.

    The gradients are those of ``sqrt(255 * value)``, which gives dark regions more weight; of the three
    channels, the one with the longest gradient is used (Dalal and Triggs, CVPR 2005, sections 6.1 and 6.2).
    Bin `k` is centered on ``22.5 k`` degrees and bin ``k + 8`` is opposite to it, so vertical and horizontal
    edges are in the middle of a bin, and mirroring an image permutes the bins. A gradient is beyond a bound
    if the ratio ``gx / gy`` is at most its cotangent; the number of these bounds is its bin.
    """
    skipped = SQUARE - square
    widest = longest = 0
    for region in regions:
        widest = max(widest, square * region[6])
        longest = max(longest, widest + skipped + 2, region[2] - region[0] + _LEFT + 1)
    # Square roots of three successive rows, in a ring; row y is in place (y + 6) % 3, which is not negative.
    roots = np.empty((3, 3, longest), np.float32)
    magnitudes, bins = np.empty(widest, np.float32), np.empty(widest, np.int32)
    c0, c1, c2, c3 = cotangents[0], cotangents[1], cotangents[2], cotangents[3]
    c4, c5, c6, c7 = cotangents[4], cotangents[5], cotangents[6], cotangents[7]
    zero, infinite = np.float32(0), np.float32(np.inf)
    for region in regions:
        left, top, right, bottom = region[0], region[1], region[2], region[3]
        first, rows, columns, place = region[4], region[5], region[6], region[7]
        wide = square * columns
        for y in range(square * first - 1, square * first + 1):
            for c in range(3):
                _sqrt_row(channels[c, min(max(top + y, top), bottom - 1)], left, right, roots[(y + 6) % 3, c])
        for row in range(rows):
            out = sums[place + 16 * columns * row : place + 16 * columns * (row + 1)]
            for i in range(16 * columns):
                out[i] = zero
            for part in range(square):
                y = square * (first + row) + part
                for c in range(3):
                    line = channels[c, min(max(top + y + 1, top), bottom - 1)]
                    _sqrt_row(line, left, right, roots[(y + 7) % 3, c])
                middle, up, down = roots[(y + 6) % 3], roots[(y + 5) % 3], roots[(y + 7) % 3]
                left0, left1, left2 = middle[0, skipped:], middle[1, skipped:], middle[2, skipped:]
                right0, right1, right2 = left0[2:], left1[2:], left2[2:]
                up0, up1, up2 = up[0, skipped + 1 :], up[1, skipped + 1 :], up[2, skipped + 1 :]
                down0, down1, down2 = down[0, skipped + 1 :], down[1, skipped + 1 :], down[2, skipped + 1 :]
                for x in range(wide):
                    gx, gy = right0[x] - left0[x], down0[x] - up0[x]
                    squared = gx * gx + gy * gy
                    hx, hy = right1[x] - left1[x], down1[x] - up1[x]
                    other = hx * hx + hy * hy
                    gx = hx if other > squared else gx
                    gy = hy if other > squared else gy
                    squared = other if other > squared else squared
                    hx, hy = right2[x] - left2[x], down2[x] - up2[x]
                    other = hx * hx + hy * hy
                    gx = hx if other > squared else gx
                    gy = hy if other > squared else gy
                    magnitudes[x] = np.sqrt(other if other > squared else squared)
                    # A horizontal gradient counts as angle 0 here; its sign selects the half circle.
                    q = gx / gy if gy != zero else infinite
                    low = np.int32(q <= c0) + np.int32(q <= c1) + np.int32(q <= c2) + np.int32(q <= c3)
                    high = np.int32(q <= c4) + np.int32(q <= c5) + np.int32(q <= c6) + np.int32(q <= c7)
                    half = np.int32(0) if (gx if gy == zero else gy) > zero else np.int32(8)
                    # Beyond the last bound lies the first bin of the other half circle.
                    bins[x] = (low + high + half) & np.int32(15)
                # Unsigned places: a signed one might be negative, which takes a test.
                if square == SQUARE:
                    for x in range(columns):
                        start = np.uint64(16 * x)
                        out[start + np.uint64(bins[4 * x])] += magnitudes[4 * x]
                        out[start + np.uint64(bins[4 * x + 1])] += magnitudes[4 * x + 1]
                        out[start + np.uint64(bins[4 * x + 2])] += magnitudes[4 * x + 2]
                        out[start + np.uint64(bins[4 * x + 3])] += magnitudes[4 * x + 3]
                else:
                    for x in range(columns):
                        start = np.uint64(16 * x)
                        out[start + np.uint64(bins[2 * x])] += magnitudes[2 * x]
                        out[start + np.uint64(bins[2 * x + 1])] += magnitudes[2 * x + 1]


@inlined
def _tent_taps(start, step, squares, taps, index, weights):
    """Weights of the squares around each cell, along one axis, by bilinear interpolation.

    `start` and `step` are the first cell's corner and the size of a cell, in squares. A square's weight is
    the integral of a tent over it, whose base is two cells wide and whose area is 1. Squares beyond -1 and
    `squares` are replicas of these. `index` and `weights` are the outputs, ``(cells, >= taps)``; indices
    count from the square -1.
    """
    for cell in range(len(index)):
        center = start + (cell + 0.5) * step
        low = math.floor(center - step)
        before = 0.0
        for tap in range(taps):
            # Integral of the tent up to the square's end.
            end = min(max((low + tap + 1 - center) / step, -1.0), 1.0)
            area = 0.5 * (1 + end) * (1 + end) if end < 0 else 1 - 0.5 * (1 - end) * (1 - end)
            index[cell, tap] = min(max(low + tap, -1), squares) + 1
            weights[cell, tap] = np.float32(area - before)
            before = area


@jit
def _resample(sums, square, first, squares, grid, cells):
    """Interpolate the sums of squares at the cells of a grid, and at one cell more on each side.

    `sums` ``(rows, columns, 16)`` are `orientation_sums` of a region, with one column of squares beyond each
    side; `first` is the first row, and `squares` the number of rows that the region has. `grid` is ``(4,)``
    float64: left, top, width and height of its first cell in squares. `cells` is the output
    ``(16, rows, columns)`` of at least `_LANES` columns, in gray levels of the mean gradient.
    """
    _, rows, columns = cells.shape
    step_x, step_y = grid[2], grid[3]
    left, top = grid[0] - step_x, grid[1] - step_y
    # Two taps at a time along a row, at first three along a column; those beyond the tent have no weight.
    taps_x, taps_y = 2 * math.ceil((2 * step_x + 1) / 2), max(3, math.ceil(2 * step_y) + 1)
    index_x, weights_x = np.empty((columns, taps_x), np.int64), np.empty((columns, taps_x), np.float32)
    index_y, weights_y = np.empty((rows, taps_y), np.int64), np.empty((rows, taps_y), np.float32)
    _tent_taps(left, step_x, sums.shape[1] - 2, taps_x, index_x, weights_x)
    _tent_taps(top, step_y, squares, taps_y, index_y, weights_y)
    low, high = index_x[0, 0], index_x[columns - 1, taps_x - 1] + 1
    for x in range(columns):
        for tap in range(taps_x):
            index_x[x, tap] = 16 * (index_x[x, tap] - low)
    count = 16 * (high - low)
    flat = sums.reshape(len(sums), -1)
    line, row = np.empty(count, np.float32), np.empty((columns, 16), np.float32)
    row_values, cell_values, size = row.reshape(-1), cells.reshape(-1), rows * columns
    scale = np.float32(1 / (square * square))
    for y in range(rows):
        for tap in range(taps_y):
            # Rows that were not computed are replaced by the closest one.
            index_y[y, tap] = min(max(index_y[y, tap] - 1 - first, 0), len(sums) - 1)
        above = flat[index_y[y, 0], 16 * low : 16 * high]
        middle = flat[index_y[y, 1], 16 * low : 16 * high]
        below = flat[index_y[y, 2], 16 * low : 16 * high]
        wa, wb, wc = weights_y[y, 0] * scale, weights_y[y, 1] * scale, weights_y[y, 2] * scale
        for i in range(count):
            line[i] = wa * above[i] + wb * middle[i] + wc * below[i]
        for tap in range(3, taps_y):
            source, weight = flat[index_y[y, tap], 16 * low : 16 * high], weights_y[y, tap] * scale
            if weight != 0:
                for i in range(count):
                    line[i] += weight * source[i]
        for x in range(columns):
            weighted_sum(line, index_x[x], weights_x[x], taps_x, row[x])
        # The last squares of numbers overlap those before.
        for k in range(0, len(cells), _LANES):
            for first_x in range(0, columns, _LANES):
                x = min(first_x, columns - _LANES)
                _transpose(row_values, 16 * x + k, 16, cell_values, (k * rows + y) * columns + x, size)


@inlined
def _block_factors(cells, eps, factors):
    """Write the normalization of each block of 2x2 cells, ``1 / sqrt(energy + eps)``."""
    rows, columns = cells.shape[1:]
    energy = np.empty((2, columns), np.float32)
    one = np.float32(1)
    for y in range(rows):
        line, above = energy[y % 2], energy[(y + 1) % 2]
        for x in range(columns):
            line[x] = np.float32(0)
        for k in range(len(cells) // 2):
            positive, negative = cells[k, y], cells[k + 8, y]
            for x in range(columns):
                both = positive[x] + negative[x]
                line[x] += both * both
        if y:
            out = factors[y - 1]
            for x in range(columns - 1):
                out[x] = one / np.sqrt(above[x] + above[x + 1] + line[x] + line[x + 1] + eps)


@inlined
def _normalize_row(cells, factors, y, channels):
    """Normalize the cells of row `y` by the four blocks of 2x2 cells that contain each, and clip at 0.2.

    `cells` ``(16, rows, columns)`` and `factors` ``(rows - 1, columns - 1)`` include one cell more on each
    side than `channels`, the output ``(20, columns - 2)``: sums over the normalizations for each of 16
    orientations, and sums over the orientations for each of the four normalizations. Felzenszwalb et al.,
    "Object detection with discriminatively trained part-based models" (PAMI 2010), section 6.2.
    """
    columns = channels.shape[1]
    clip, half, texture_scale = np.float32(0.2), np.float32(0.5), np.float32(0.2357)
    n0, n1 = factors[y, :columns], factors[y, 1:]
    n2, n3 = factors[y + 1, :columns], factors[y + 1, 1:]
    t0, t1, t2, t3 = channels[16], channels[17], channels[18], channels[19]
    for x in range(columns):
        t0[x] = t1[x] = t2[x] = t3[x] = np.float32(0)
    for k in range(len(cells)):
        line, out = cells[k, y + 1, 1:], channels[k]
        for x in range(columns):
            value = line[x]
            q0, q1 = min(value * n0[x], clip), min(value * n1[x], clip)
            q2, q3 = min(value * n2[x], clip), min(value * n3[x], clip)
            t0[x] += q0
            t1[x] += q1
            t2[x] += q2
            t3[x] += q3
            out[x] = half * ((q0 + q1) + (q2 + q3))
    for k in range(len(cells), len(channels)):
        out = channels[k]
        for x in range(columns):
            out[x] *= texture_scale


def cells_shape(rows: int, columns: int) -> tuple[int, int, int]:
    """Shape of the memory of `cell_channels`, with cells around the grid and at least a vector of columns."""
    return 16, rows + 2, max(columns + 2, _LANES)


@jit
def cell_channels(sums, regions, square, grids, chosen, eps, scales, cells, channels, packed):
    """FHOG channels of several grids of cells, as numbers or as bytes in words of 32 bits.

    `sums`, `regions` and `square` are as in `orientation_sums`, `grids` is ``(N, 4)``, in squares from the
    corner of a region, and `chosen` lists those to compute. There is a region for each of these, or one for
    all. `eps` is added to the energy of a block. `cells` is memory for one grid, float32 of the shape that
    `cells_shape` returns.

    One of the outputs may be empty: `channels` is ``(N, 20, rows, columns)`` float32, and `packed`
    ``(N, 5, rows, columns)`` int32: the value of channel `k` is multiplied by ``scales[k]`` and rounded; the
    first of a word's 4 channels is in the lowest bits. Both are one kernel because most of the time of
    compiling it goes into what they share.
    """
    rows = max(channels.shape[2], packed.shape[2])
    columns = max(channels.shape[3], packed.shape[3])
    factors = np.empty((rows + 1, cells.shape[2] - 1), np.float32)
    line = np.empty((20, columns), np.float32)
    half, limit = np.float32(0.5), np.float32(127)
    for k in range(len(chosen)):
        number = chosen[k]
        region = regions[k if len(regions) > 1 else 0]
        high, wide, start = region[5], region[6], region[7]
        of_region = sums[start : start + 16 * high * wide].reshape(high, wide, 16)
        squares = (region[3] - region[1] + square - 1) // square
        _resample(of_region, square, region[4], squares, grids[number], cells)
        _block_factors(cells, eps, factors)
        for y in range(rows):
            _normalize_row(cells, factors, y, line)
            if len(packed):
                for word in range(packed.shape[1]):
                    out, channel = packed[number, word, y], 4 * word
                    a, b, c, d = line[channel], line[channel + 1], line[channel + 2], line[channel + 3]
                    sa, sb = scales[channel], scales[channel + 1]
                    sc, sd = scales[channel + 2], scales[channel + 3]
                    for x in range(columns):
                        low = numba.int32(min(a[x] * sa + half, limit)) | (
                            numba.int32(min(b[x] * sb + half, limit)) << 8
                        )
                        high = numba.int32(min(c[x] * sc + half, limit)) | (
                            numba.int32(min(d[x] * sd + half, limit)) << 8
                        )
                        out[x] = low | (high << 16)
            else:
                for channel in range(channels.shape[1]):
                    source, target = line[channel], channels[number, channel, y]
                    for x in range(columns):
                        target[x] = source[x]


@jit
def cell_means(planes, grids, chosen, means):
    """Mean values of an image in the cells of several grids, with replicated borders.

    `planes` is ``(3, H, W)`` uint8, `grids` ``(N, 4)`` the left, top, width and height of their first cells
    in pixels, `chosen` those to compute, and `means` the output ``(N, rows, columns, 3)`` float32. Cells are
    rounded to whole pixels.
    """
    height, width = planes.shape[1:]
    rows, columns = means.shape[1:3]
    sums, bounds = np.empty(width, np.int32), np.empty((columns, 2), np.int64)
    for number in chosen:
        left, top, step_x, step_y = grids[number, 0], grids[number, 1], grids[number, 2], grids[number, 3]
        for column in range(columns):
            start = math.floor(left + column * step_x + 0.5)
            bounds[column, 0] = start
            bounds[column, 1] = max(math.floor(left + (column + 1) * step_x + 0.5), start + 1)
        low = min(max(bounds[0, 0], 0), width - 1)
        count = max(min(bounds[columns - 1, 1], width) - low, 1)
        for row in range(rows):
            start_y = math.floor(top + row * step_y + 0.5)
            stop_y = max(math.floor(top + (row + 1) * step_y + 0.5), start_y + 1)
            for c in range(len(planes)):
                # Down the columns of pixels first, many at a time.
                for x in range(count):
                    sums[x] = 0
                for y in range(start_y, stop_y):
                    line = planes[c, min(max(y, 0), height - 1), low : low + count]
                    for x in range(count):
                        sums[x] += line[x]
                for column in range(columns):
                    start_x, stop_x = bounds[column, 0], bounds[column, 1]
                    total = 0
                    for x in range(start_x, stop_x):
                        total += sums[min(max(x - low, 0), count - 1)]
                    means[number, row, column, c] = total / ((stop_y - start_y) * (stop_x - start_x))
