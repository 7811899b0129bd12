"""Numba kernels of the features, of patches and of all windows of a band, and of the scores of the windows.

All arrays are row-major and images interleaved: a row of an ``(H, W, C)`` image is ``W * C`` values, in which
the left and right neighbors of a value are `C` positions away. Every inner loop runs over adjacent values,
which the compiler vectorizes, for any number of channels.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels.jit import jit
from vehicle_detection.errors import InvalidInputError


@functools.cache
def orientation_cotangents(orient: int) -> NDArray[np.float32]:
    """Cotangent of the lower bound of each orientation bin, infinite for the first."""
    angles = np.arange(orient) * (np.pi / orient)
    # Rounding makes the cotangent of 90 degrees exactly zero.
    cosines, sines = np.cos(angles).round(15), np.sin(angles)
    cotangents = np.full(orient, np.inf)
    np.divide(cosines, sines, out=cotangents, where=sines > 0)
    return cotangents.astype(np.float32)


@functools.cache
def degree_bounds(orient: int) -> NDArray[np.float64]:
    """Bounds of the orientation bins in degrees, ``(orient + 1,)``, as scikit-image rounds them."""
    return np.asarray((180.0 / orient) * np.arange(orient + 1), np.float64)


@functools.cache
def bin_of_value(bins: int) -> NDArray[np.intp]:
    """Histogram bin of each value 0-255 when `bins` bins cover ``[0, 256)``; ``(256,)`` intp."""
    return np.arange(256, dtype=np.intp) * bins // 256


def sqrt_gradients(image: NDArray[np.uint8 | np.floating]) -> tuple[NDArray[np.float64], ...]:
    """Gradients of the square root of an image, and their arctangents, as scikit-image computes them.

    `image` is ``(H, W, C)`` uint8 or float, not negative. Returns ``gx``, ``gy`` and ``arctan2(gy, gx)``,
    ``(H, W * C)`` float64.
    """
    root = np.sqrt(np.arange(256.0))[image] if image.dtype == np.uint8 else np.sqrt(image)
    gx, gy = np.zeros_like(root), np.zeros_like(root)
    np.subtract(root[:, 2:], root[:, :-2], out=gx[:, 1:-1])
    np.subtract(root[2:], root[:-2], out=gy[1:-1])
    gx, gy = (part.reshape(len(root), -1).astype(np.float64, copy=False) for part in (gx, gy))
    return gx, gy, np.arctan2(gy, gx)


def hog_cells(image: NDArray[Any], orient: int, cell: int, transform_sqrt: bool) -> NDArray[np.float32]:
    """Orientation histograms of an image's cells: ``(channels, orient, rows, columns)``.

    Equals the first stage of scikit-image's HOG; `image` is ``(H, W, channels)``, uint8 or float.
    Without `transform_sqrt`, a gradient of floats exactly on a bound of bins may fall into the other one.
    """
    height, width, channels = image.shape
    cells = np.empty((channels, orient, height // cell, width // cell), np.float32)
    if transform_sqrt:
        if image.dtype != np.uint8 and image.min() < 0:
            raise InvalidInputError(
                "transform_sqrt must be False for negative values, which float LUV and LAB images have; "
                "convert a uint8 image, or switch it off"
            )
        sum_orientations(*sqrt_gradients(image), degree_bounds(orient), channels, cell, cells)
    else:
        flat = np.ascontiguousarray(image).reshape(height, -1)
        sum_magnitudes(flat, channels, cell, orientation_cotangents(orient), cells)
    return cells


# Columns of a tile: its gradients and histograms (10 rows of floats) fit into the first-level cache.
_TILE = 768


@jit
def sum_magnitudes(image, channels, cell, cotangents, cells):
    """Sum gradient magnitudes into the orientation histograms of cells.

    `image` is ``(H, W * channels)`` uint8 or float and at least as large as the cells, `cell` their side in
    pixels, `cotangents` ``(orient,)`` float32 those of the orientations' lower bounds (infinite for the
    first), and `cells` the output ``(channels, orient, cell rows, cell columns)`` float32, means over the
    cells' pixels.

    The reference is ``skimage.feature.hog``: central differences without halving, zero at the array's border,
    unsigned orientation, hard binning. Orientation `k` starts at ``k * 180 / orient`` degrees; an angle in
    (0, 180) is beyond that bound if ``gx / gy`` is at most its cotangent. This needs one division and no
    arctangent, and is equal for opposite gradients. The quotients of integers up to 255 are too far from the
    cotangents for rounding to matter; of floats, a gradient exactly on a bound may fall into the other bin.
    Sums are cumulative over the bounds and differenced at the end.
    """
    orient, rows, columns = cells.shape[1], cells.shape[2], cells.shape[3]
    span = cell * channels
    per_tile = max(1, _TILE // span)
    size = per_tile * span
    quotient, magnitude = np.empty(size, np.float32), np.empty(size, np.float32)
    fours, eights = np.empty(size, np.float32), np.empty(size, np.float32)
    reduced = np.zeros((orient + 1, channels, per_tile), np.float32)  # nothing is beyond the last bound
    sums = np.empty((orient, size), np.float32)
    scale = np.float32(1.0 / (cell * cell))
    for row in range(rows):
        for first in range(0, columns, per_tile):
            count = min(per_tile, columns - first)
            start, n = first * span, count * span
            sums.fill(np.float32(0))
            for y in range(row * cell, (row + 1) * cell):
                _row_gradients(image, channels, y, start, n, quotient, magnitude)
                _add_beyond_bounds(quotient, magnitude, cotangents, n, sums)
            _sum_columns(sums, cell, channels, count, fours, eights, reduced)
            for channel in range(channels):
                for k in range(orient):
                    out = cells[channel, k, row, first : first + count]
                    within, past = reduced[k, channel], reduced[k + 1, channel]
                    for column in range(count):
                        out[column] = (within[column] - past[column]) * scale


@jit
def _row_gradients(image, channels, y, start, n, quotient, magnitude):
    """Write ``gx / gy`` and the magnitude of the gradients of `n` values of row `y`, from `start`."""
    height, width = image.shape
    zero, infinite = np.float32(0), np.float32(np.inf)
    # The gradient at the array's border is zero.
    low = channels if start == 0 else 0
    high = n - channels if start + n == width else n
    inside = 0 < y < height - 1
    above = image[y - 1 if inside else y, start : start + n]
    below = image[y + 1 if inside else y, start : start + n]
    left = image[y, start + low - channels : start + high - channels]
    right = image[y, start + low + channels : start + high + channels]
    quotient[:low] = zero
    quotient[high:n] = zero
    inner = quotient[low:high]
    for i in range(high - low):
        inner[i] = np.float32(right[i]) - np.float32(left[i])
    for i in range(n):
        gx = quotient[i]
        gy = np.float32(below[i]) - np.float32(above[i])
        magnitude[i] = np.sqrt(gx * gx + gy * gy)
        # A horizontal gradient has angle 0, for either sign.
        quotient[i] = gx / gy if gy != zero else infinite


@jit
def _add_beyond_bounds(quotient, magnitude, cotangents, n, sums):
    """Add each magnitude to ``sums[k]`` for every bound `k` that its angle is beyond."""
    orient, zero = len(cotangents), np.float32(0)
    total = sums[0]
    for i in range(n):
        total[i] += magnitude[i]
    # Four bounds at a time: each loaded quotient is compared four times.
    single = 1 + (orient - 1) // 4 * 4
    for k in range(1, single, 4):
        c0, c1 = cotangents[k], cotangents[k + 1]
        c2, c3 = cotangents[k + 2], cotangents[k + 3]
        t0, t1, t2, t3 = sums[k], sums[k + 1], sums[k + 2], sums[k + 3]
        for i in range(n):
            q, m = quotient[i], magnitude[i]
            t0[i] += m if q <= c0 else zero
            t1[i] += m if q <= c1 else zero
            t2[i] += m if q <= c2 else zero
            t3[i] += m if q <= c3 else zero
    for k in range(single, orient):
        c0, t0 = cotangents[k], sums[k]
        for i in range(n):
            t0[i] += magnitude[i] if quotient[i] <= c0 else zero


@jit
def _sum_columns(sums, cell, channels, count, fours, eights, reduced):
    """Sum the columns of `count` cells: ``reduced[k, channel, column]`` from rows of sums ``(orient, n)``.

    First the sums of four and of eight columns at every position, of which one for each cell is used:
    adjacent values, unlike the columns of a cell, are added as vectors.
    """
    span = cell * channels
    ahead = (count * cell - 3) * channels
    for k in range(len(sums)):
        total = sums[k]
        single, step = total, 1
        if cell % 4 == 0:
            s1, s2, s3 = total[channels:], total[2 * channels :], total[3 * channels :]
            for i in range(ahead):
                fours[i] = (total[i] + s1[i]) + (s2[i] + s3[i])
            single, step = fours, 4
            if cell % 8 == 0:
                other = fours[4 * channels :]
                for i in range(ahead - 4 * channels):
                    eights[i] = fours[i] + other[i]
                single, step = eights, 8
        for channel in range(channels):
            for column in range(count):
                at = column * span + channel
                value = single[at]
                for x in range(step, cell, step):
                    value += single[at + x * channels]
                reduced[k, channel, column] = value


@jit
def sum_orientations(gx, gy, angles, bounds, channels, cell, cells):
    """Sum gradient magnitudes into the orientation histograms of cells, from known angles.

    `gx`, `gy` and `angles` (radians) are ``(H, W * channels)`` float64, `bounds` ``(orient + 1,)`` float64 in
    degrees; the rest is as for `sum_magnitudes`. This is for square-rooted images: their gradients are often
    exactly on a bound, where only the reference's own arctangent gives the reference's bin.
    """
    orient, rows, columns = cells.shape[1], cells.shape[2], cells.shape[3]
    cells[:] = 0
    for y in range(rows * cell):
        for column in range(columns):
            for i in range(column * cell * channels, (column + 1) * cell * channels):
                degrees = angles[y, i] * (180.0 / np.pi)
                if degrees < 0:
                    degrees += 180.0
                elif degrees >= 180.0:
                    degrees -= 180.0
                k = min(int(degrees * orient / 180.0), orient - 1)
                if degrees < bounds[k]:
                    k -= 1
                elif degrees >= bounds[k + 1] and k < orient - 1:
                    k += 1
                magnitude = np.sqrt(gx[y, i] * gx[y, i] + gy[y, i] * gy[y, i])
                cells[i % channels, k, y // cell, column] += magnitude
    cells *= np.float32(1.0 / (cell * cell))


def pool_cells(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average each cell with its neighbors to the right, below and diagonally: cells of twice the side.

    ``pooled[c, k, y, x]`` is the mean of ``cells[c, k, y : y + 2, x : x + 2]``; the last row and column are
    zero.
    """
    pooled = np.zeros_like(cells)
    pairs = cells[..., :-1] + cells[..., 1:]
    pooled[..., :-1, :-1] = (pairs[..., :-1, :] + pairs[..., 1:, :]) * np.float32(0.25)
    return pooled


def hog_blocks(cells: NDArray[np.float32], block: int, dilation: int = 1) -> NDArray[np.float32]:
    """Normalize the blocks that start at each cell: ``(channels, block, block, orient, rows, columns)``."""
    channels, orient, rows, columns = cells.shape
    blocks = np.empty((channels, block, block, orient, rows, columns), np.float32)
    normalize_blocks(cells, block, dilation, blocks)
    return blocks


@jit
def normalize_blocks(cells, block, dilation, blocks):
    """Normalize overlapping blocks of cells by L2-Hys: L2, clip at 0.2, L2 again.

    `block` is the side of a block in cells and `dilation` the distance of its cells: 1, or 2 for
    pooled ones. `blocks` is the output ``(channels, block, block, orient, cell rows, cell columns)``
    float32: ``blocks[c, i, j, k, y, x]`` is the value of cell ``[y + i * dilation, x + j * dilation]`` in the
    block that starts at cell ``[y, x]``. The last ``(block - 1) * dilation`` rows and columns start no block
    and are zero.

    Dalal and Triggs, "Histograms of oriented gradients for human detection" (CVPR 2005), section 6.4, with
    the constants of scikit-image.
    """
    channels, orient, rows, columns = cells.shape
    height, width = rows - (block - 1) * dilation, columns - (block - 1) * dilation
    eps, clip, one = np.float32(1e-10), np.float32(0.2), np.float32(1)
    energy = np.empty((rows, columns), np.float32)
    scale = np.empty(width, np.float32)
    clipped = np.empty(width, np.float32)
    blocks[:, :, :, :, height:] = 0
    for channel in range(channels):
        energy.fill(np.float32(0))
        for k in range(orient):
            for y in range(rows):
                line = cells[channel, k, y]
                sums = energy[y]
                for x in range(columns):
                    sums[x] += line[x] * line[x]
        for y in range(height):
            scale.fill(eps)
            for i in range(block):
                for j in range(block):
                    line = energy[y + i * dilation, j * dilation : j * dilation + width]
                    for x in range(width):
                        scale[x] += line[x]
            for x in range(width):
                scale[x] = one / np.sqrt(scale[x])
            clipped.fill(eps)
            for i in range(block):
                for j in range(block):
                    for k in range(orient):
                        line = cells[channel, k, y + i * dilation, j * dilation : j * dilation + width]
                        out = blocks[channel, i, j, k, y]
                        for x in range(width):
                            value = min(line[x] * scale[x], clip)
                            out[x] = value
                            clipped[x] += value * value
            for x in range(width):
                clipped[x] = one / np.sqrt(clipped[x])
            for i in range(block):
                for j in range(block):
                    for k in range(orient):
                        out = blocks[channel, i, j, k, y]
                        for x in range(width):
                            out[x] *= clipped[x]
                        out[width:].fill(np.float32(0))


@jit
def value_counts(image, counts):
    """Count the values of each channel: `image` ``(H, W, 3)`` uint8, `counts` ``(3, 256)`` output."""
    counts[:] = 0
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            counts[0, image[y, x, 0]] += 1
            counts[1, image[y, x, 1]] += 1
            counts[2, image[y, x, 2]] += 1


@jit
def patch_histograms(patches, bin_of_value, bins, features):
    """Color histograms of ``(N, side, side, 3)`` uint8 patches, channel by channel.

    `bin_of_value` is ``(256,)`` intp, and `features` the output ``(N, 3 * bins)`` float32.
    """
    counts = np.empty((3, 256), np.int64)
    for index in range(len(patches)):
        value_counts(patches[index], counts)
        out = features[index]
        out[:] = 0
        for channel in range(3):
            for value in range(256):
                out[channel * bins + bin_of_value[value]] += counts[channel, value]


@jit
def find_bins(image, edges, indices):
    """Find the bin of each value between equally spaced `edges`, as `numpy.histogram` does.

    `image` and the output `indices` are ``(H, W, C)``, numbers and intp, and `edges` ``(bins + 1,)`` float64.
    Values out of range get the index `bins`.
    """
    bins = len(edges) - 1
    factor = bins / (edges[bins] - edges[0])
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for c in range(image.shape[2]):
                value = np.float64(image[y, x, c])
                index = bins
                if edges[0] <= value <= edges[bins]:
                    index = min(int((value - edges[0]) * factor), bins - 1)
                    # Rounding may miss the bin by one.
                    if value < edges[index]:
                        index -= 1
                    elif index < bins - 1 and value >= edges[index + 1]:
                        index += 1
                indices[y, x, c] = index


@jit
def histogram_cells(image, table, cell, cells):
    """Sum, over each cell, the weights of the pixel values of all channels.

    `image` is ``(H, W, 3)`` integer, `table` ``(3, values)`` float32 the weight of each value, `cell` the
    side of a cell in pixels, and `cells` the output ``(cell rows, cell columns)`` float32.
    """
    rows, columns = cells.shape
    cells[:] = 0
    for row in range(rows):
        for y in range(row * cell, (row + 1) * cell):
            line = image[y]
            for column in range(columns):
                first, second, third = np.float32(0), np.float32(0), np.float32(0)
                for x in range(column * cell, (column + 1) * cell):
                    first += table[0, line[x, 0]]
                    second += table[1, line[x, 1]]
                    third += table[2, line[x, 2]]
                cells[row, column] += first + second + third


@jit
def add_root_histograms(image, bin_of_value, weights, cell, window, scores):
    """Add, to each window's score, the weighted square roots of its histogram's counts, in place.

    `image` is ``(H, W, 3)`` uint8, `bin_of_value` ``(256,)`` intp, `weights` ``(templates, 3, bins)``
    float32, `cell` the side of a cell in pixels, `window` the side of a window in cells (a power of two, at
    most 64 pixels), and `scores` ``(templates, cell rows - window + 1, cell columns - window + 1)`` float32.

    The counts of the last `window` rows of cells are stored by bin, summed over the width of a window: moving
    down by a row of cells adds one row and subtracts another. Bins without a pixel in those rows, which are
    most of them, are skipped.
    """
    templates, bins = len(weights), weights.shape[2]
    rows, width = scores.shape[1] + window - 1, scores.shape[2]
    columns = width + window - 1
    # A window has at most 64x64 pixels, so 16 bits are enough.
    counts = np.empty((3 * bins, columns), np.uint16)
    flat = counts.reshape(-1)
    # Start of each bin's counts. Unsigned indices avoid the check for negative ones.
    starts = np.empty((3, 256), np.uintp)
    for channel in range(3):
        for value in range(256):
            starts[channel, value] = (channel * bins + bin_of_value[value]) * columns
    wide = np.empty(columns, np.uint16)
    recent = np.zeros((window, 3 * bins, width), np.uint16)
    filled = np.zeros((window, 3 * bins), np.bool_)
    sums = np.zeros((3 * bins, width), np.uint16)
    roots = np.empty(width, np.float32)
    flat_weights = weights.reshape(templates, 3 * bins)
    for row in range(rows):
        counts.fill(np.uint16(0))
        for y in range(row * cell, (row + 1) * cell):
            _count_by_bin(image[y], starts, cell, columns, flat)
        slot = row % window
        for k in range(3 * bins):
            count = counts[k]
            any_count = np.uint16(0)
            for x in range(columns):
                any_count |= count[x]
            total, last = sums[k], recent[slot, k]
            if filled[slot, k]:
                for x in range(width):
                    total[x] -= last[x]
            filled[slot, k] = any_count > 0
            if any_count > 0:
                _sum_windows(count, window, wide)
                for x in range(width):
                    last[x] = count[x]
                    total[x] += count[x]
            used = False
            for i in range(window):
                used |= filled[i, k]
            if used and row >= window - 1:
                for x in range(width):
                    roots[x] = np.sqrt(np.float32(total[x]))
                for template in range(templates):
                    weight = flat_weights[template, k]
                    out = scores[template, row - window + 1]
                    for x in range(width):
                        out[x] += weight * roots[x]


@jit
def _count_by_bin(line, starts, cell, columns, counts):
    """Count the values of a row of pixels ``(W, 3)`` by bin and cell; `counts` holds bin after bin."""
    first, second, third = starts[0], starts[1], starts[2]
    one = np.uint16(1)
    for column in range(columns):
        offset = np.uintp(column)
        for x in range(column * cell, (column + 1) * cell):
            counts[first[line[x, 0]] + offset] += one
            counts[second[line[x, 1]] + offset] += one
            counts[third[line[x, 2]] + offset] += one


@jit
def _sum_windows(count, window, wide):
    """Sum the counts of `window` cells from each cell on, in place: of two cells, of four and so on."""
    span = 1
    while span < window:
        reach = len(count) - span
        left, right = count[:reach], count[span:]
        for x in range(reach):
            wide[x] = left[x] + right[x]
        for x in range(reach):
            left[x] = wide[x]
        span *= 2


@functools.partial(jit, reorder=True)
def add_correlation(channels, weights, dilation, scores):
    """Add each window's weighted sum of channels to its score, in place.

    `channels` is ``(channels, rows, columns)``, `weights` ``(window rows, window columns, channels)``, both
    float32, and `scores` has a row and a column for each position of the window. Neighboring cells of a
    window are `dilation` cells apart. Four channels are added at a time, so that a score is loaded and stored
    once for four products, and all columns of the weights before the next channels, which stay in the cache.
    """
    depth, (height, width) = channels.shape[0], scores.shape
    whole = depth - depth % 4
    for y in range(height):
        out = scores[y]
        for row in range(weights.shape[0]):
            line = y + row * dilation
            for k in range(0, whole, 4):
                for column in range(weights.shape[1]):
                    x, w = column * dilation, weights[row, column, k : k + 4]
                    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
                    v0, v1 = channels[k, line, x:], channels[k + 1, line, x:]
                    v2, v3 = channels[k + 2, line, x:], channels[k + 3, line, x:]
                    for i in range(width):
                        out[i] += (w0 * v0[i] + w1 * v1[i]) + (w2 * v2[i] + w3 * v3[i])
            for k in range(whole, depth):
                for column in range(weights.shape[1]):
                    weight, values = weights[row, column, k], channels[k, line, column * dilation :]
                    for i in range(width):
                        out[i] += weight * values[i]
