"""Numba kernels of the features, of patches and of all windows of a band, and of the scores of the windows.

All arrays are row-major and images interleaved: a row of an ``(H, W, C)`` image is ``W * C`` values, in which
the left and right neighbors of a value are `C` positions away. Every inner loop runs over adjacent values,
which the compiler vectorizes, for any number of channels.
"""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
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


def hog_cells(
    image: NDArray[Any], orient: int, cell: int, transform_sqrt: bool, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """Orientation histograms of an image's cells: ``(channels, orient, rows, columns)``.

    Equals the first stage of scikit-image's HOG; `image` is ``(H, W, channels)``, uint8 or float.
    Without `transform_sqrt`, a gradient of floats exactly on a bound of bins may fall into the other one.
    """
    height, width, channels = image.shape
    shape = channels, orient, height // cell, width // cell
    cells: NDArray[np.float32] = workspace.take(shape, np.float32, "cells")
    if transform_sqrt:
        if image.dtype != np.uint8 and image.min() < 0:
            raise InvalidInputError(
                "transform_sqrt must be False for negative values, which float LUV and LAB images have; "
                "convert a uint8 image, or switch it off"
            )
        sum_orientations(*sqrt_gradients(image), degree_bounds(orient), channels, cell, cells)
    else:
        _sum_magnitudes(image, cell, cells, workspace)
    return cells


# Values of a row that are processed together: a multiple of 64, which vectors divide without rest. The rows
# of their gradients and sums stay in the first cache.
_TILE = 576


def _sum_magnitudes(image: NDArray[Any], cell: int, cells: NDArray[np.float32], workspace: Workspace) -> None:
    """Fill `cells` with the gradient magnitudes of an image that is not square-rooted."""
    height, width, channels = image.shape
    orient = cells.shape[1]
    # Mirrored: the gradient at the image's border is zero.
    memory = workspace.take((height + 2, width + 2, channels), image.dtype, "bordered")
    bordered = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REFLECT_101, memory).ravel()
    bounds = orientation_cotangents(orient)
    columns = max(1, _TILE // (cell * channels))
    values, sums = (np.empty((n, columns * cell * channels), np.float32) for n in (3, orient))
    past, stride = np.empty((channels, columns), np.float32), (width + 2) * channels
    sum_magnitudes(bordered, stride, channels, cell, bounds, *values, sums, past, cells)


@jit
def sum_magnitudes(image, stride, channels, cell, bounds, quotients, magnitudes, fours, sums, past, cells):
    """Sum gradient magnitudes into the orientation histograms of cells.

    `image` is flat, with a border of a pixel and `stride` values in a row, `cell` the side of a cell in
    pixels, `bounds` the cotangents of the orientations' lower bounds, and `cells` the output
    ``(channels, orient, cell rows, cell columns)`` float32, means over the cells' pixels. The other arrays
    are memory for a tile: some cells of a row.

    The reference is ``skimage.feature.hog``: central differences without halving, unsigned orientation, hard
    binning. Orientation `k` starts at ``k * 180 / orient`` degrees; an angle in (0, 180) is beyond that bound
    if ``gx / gy`` is at most its cotangent. This needs one division and no arctangent, and is equal for
    opposite gradients. The quotients of integers up to 255 are too far from the cotangents for rounding to
    matter; of floats, a gradient exactly on a bound may fall into the other bin. Sums are cumulative over the
    bounds and differenced at the end.
    """
    orient, rows, columns = cells.shape[1], cells.shape[2], cells.shape[3]
    span, size = cell * channels, len(magnitudes)
    zero, scale, total = np.float32(0), np.float32(1.0 / (cell * cell)), sums[0]
    # Unsigned indices avoid the check for negative ones, which prevents vectors.
    one, two, three = np.uintp(channels), np.uintp(2 * channels), np.uintp(3 * channels)
    for row in range(rows):
        for start in range(0, columns * span, size):
            n = min(size, columns * span - start)
            sums[:] = zero
            for y in range(row * cell, (row + 1) * cell):
                left = np.uintp((y + 1) * stride + start)
                above, below = np.uintp(y * stride + start), np.uintp((y + 2) * stride + start)
                for i in range(np.uintp(n)):
                    gx = np.float32(image[left + two + i]) - np.float32(image[left + i])
                    gy = np.float32(image[below + one + i]) - np.float32(image[above + one + i])
                    magnitude = np.sqrt(gx * gx + gy * gy)
                    # A horizontal gradient has angle 0, for either sign.
                    quotients[i] = gx / gy if gy != zero else np.float32(np.inf)
                    magnitudes[i] = magnitude
                    total[i] += magnitude
                # Four bounds at a time, so that a quotient is loaded once for four comparisons.
                left_over = 1 + (orient - 1) // 4 * 4
                for k in range(1, left_over, 4):
                    b0, b1, b2, b3 = bounds[k], bounds[k + 1], bounds[k + 2], bounds[k + 3]
                    w0, w1, w2, w3 = sums[k], sums[k + 1], sums[k + 2], sums[k + 3]
                    for i in range(n):
                        quotient, magnitude = quotients[i], magnitudes[i]
                        w0[i] += magnitude if quotient <= b0 else zero
                        w1[i] += magnitude if quotient <= b1 else zero
                        w2[i] += magnitude if quotient <= b2 else zero
                        w3[i] += magnitude if quotient <= b3 else zero
                for k in range(left_over, orient):
                    bound, within = bounds[k], sums[k]
                    for i in range(n):
                        within[i] += magnitudes[i] if quotients[i] <= bound else zero
            past[:] = zero  # nothing is beyond the last bound
            for k in range(orient - 1, -1, -1):
                within, source, parts, jump = sums[k], sums[k], cell, one
                # Sums of four columns at every position: adjacent values, unlike the columns of a cell, are
                # added as vectors.
                if cell % 4 == 0:
                    source, parts, jump = fours, cell // 4, np.uintp(4 * channels)
                    for i in range(np.uintp(n) - three):
                        fours[i] = (within[i] + within[i + one]) + (within[i + two] + within[i + three])
                for channel in range(channels):
                    out, beyond = cells[channel, k, row, start // span :], past[channel]
                    for column in range(n // span):
                        at = np.uintp(column * span + channel)
                        part = source[at]
                        for _ in range(1, parts):
                            at += jump
                            part += source[at]
                        out[column] = (part - beyond[column]) * scale
                        beyond[column] = part


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


def pool_cells(cells: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS) -> NDArray[np.float32]:
    """Average each cell with its neighbors to the right, below and diagonally: cells of twice the side.

    ``pooled[c, k, y, x]`` is the mean of ``cells[c, k, y : y + 2, x : x + 2]``; the last row and column are
    zero.
    """
    pooled: NDArray[np.float32] = workspace.take(cells.shape, np.float32, "pooled")
    pooled[..., -1:, :], pooled[..., -1:] = 0, 0
    shape = -1, *cells.shape[2:]
    mean_cells(cells.reshape(shape), pooled.reshape(shape))
    return pooled


@jit
def mean_cells(cells, pooled):
    """Fill ``(maps, rows, columns)`` but its last row and column with means; see `pool_cells`."""
    one, quarter = np.uintp(1), np.float32(0.25)
    for k in range(cells.shape[0]):
        for y in range(cells.shape[1] - 1):
            upper, lower, out = cells[k, y], cells[k, y + 1], pooled[k, y]
            for x in range(np.uintp(cells.shape[2] - 1)):
                out[x] = ((upper[x] + upper[x + one]) + (lower[x] + lower[x + one])) * quarter


def hog_blocks(
    cells: NDArray[np.float32], block: int, dilation: int = 1, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """Normalize overlapping blocks of cells by L2-Hys: L2, clip at 0.2, L2 again.

    `block` is the side of a block in cells and `dilation` the distance of its cells: 1, or 2 for pooled ones.
    Returns ``(channels, block, block, orient, cell rows, cell columns)`` float32:
    ``blocks[c, i, j, k, y, x]`` is the value of cell ``[y + i * dilation, x + j * dilation]`` in the block
    that starts at cell ``[y, x]``.
    The last ``(block - 1) * dilation`` rows and columns start no block and are zero.

    Dalal and Triggs, "Histograms of oriented gradients for human detection" (CVPR 2005), section 6.4, with
    the constants of scikit-image.
    """
    channels, orient, rows, columns = cells.shape
    # To get as much new memory from the system takes longer than all that follows.
    shape = channels, block, block, orient, rows, columns
    blocks: NDArray[np.float32] = workspace.take(shape, np.float32, f"blocks {dilation}")
    height, width = rows - (block - 1) * dilation, columns - (block - 1) * dilation
    blocks[..., height:, :], blocks[..., width:] = 0, 0
    # Positions count through all rows; blocks across the ends of rows are not used.
    offsets = [(i * columns + j) * dilation for i in range(block) for j in range(block)]
    energy = workspace.take((rows * columns,), np.float32, "energy")
    memory = np.empty((2, max(0, width)), np.float32)
    flat, flat_blocks = (each.reshape(channels, -1, rows * columns) for each in (cells, blocks))
    normalize_blocks(flat, np.array(offsets, np.uintp), height, columns, energy, *memory, flat_blocks)
    return blocks


@jit
def normalize_blocks(cells, offsets, height, columns, energy, scales, squares, blocks):
    """Scale, clip and scale again `height` rows of blocks; see `hog_blocks`.

    `cells` is ``(channels, orient, n)``, with the rows of cells one after the other, `offsets` the distances
    of a block's cells from its first one, and `blocks` the output ``(channels, cells of a block * orient,
    n)``. The other arrays are memory: `energy` for all cells, `scales` and `squares` for a row of blocks.
    """
    zero, one, eps, clip = np.float32(0), np.float32(1), np.float32(1e-10), np.float32(0.2)
    orient, width = cells.shape[1], np.uintp(len(squares))
    for channel in range(cells.shape[0]):
        energy[:] = zero
        for k in range(orient):
            values = cells[channel, k]
            for i in range(len(energy)):
                energy[i] += values[i] * values[i]
        for y in range(height):
            start = np.uintp(y * columns)
            scales[:] = eps
            for offset in offsets:
                for x in range(width):
                    scales[x] += energy[start + offset + x]
            for x in range(width):
                scales[x] = one / np.sqrt(scales[x])
            squares[:] = eps
            for index in range(blocks.shape[1]):
                values, out = cells[channel, index % orient], blocks[channel, index]
                at = start + offsets[index // orient]
                for x in range(width):
                    value = values[at + x] * scales[x]
                    value = value if value < clip else clip
                    out[start + x] = value
                    squares[x] += value * value
            for x in range(width):
                squares[x] = one / np.sqrt(squares[x])
            for index in range(blocks.shape[1]):
                out = blocks[channel, index]
                for x in range(width):
                    out[start + x] *= squares[x]


def count_bins(image: NDArray[np.uint8], bins: int, cell: int) -> NDArray[np.uint16]:
    """Color histograms of an image's cells: ``(cell rows, 3 * bins, cell columns)``.

    `image` is ``(H, W, 3)``, and `cell` the side of a cell, at most 255 pixels.
    """
    rows, columns = image.shape[0] // cell, image.shape[1] // cell
    counts = np.zeros((rows, 3 * bins, columns), np.uint16)
    # Unsigned indices avoid the check for negative ones.
    starts = ((np.arange(3)[:, None] * bins + bin_of_value(bins)) * columns).astype(np.uintp)
    add_counts(image, starts, cell, columns, counts.reshape(rows, -1))
    return counts


@jit
def add_counts(image, starts, cell, columns, counts):
    """Count the values of cells by bin, in place.

    `counts` is ``(cell rows, 3 * bins * columns)``, bin after bin, and `starts` ``(3, 256)`` where the counts
    of a channel's value start.
    """
    one = np.uint16(1)
    for row in range(counts.shape[0]):
        out = counts[row]
        for y in range(row * cell, (row + 1) * cell):
            line = image[y]
            for column in range(columns):
                offset = np.uintp(column)
                for x in range(column * cell, (column + 1) * cell):
                    out[starts[0, line[x, 0]] + offset] += one
                    out[starts[1, line[x, 1]] + offset] += one
                    out[starts[2, line[x, 2]] + offset] += one


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


def add_root_histograms(
    image: NDArray[np.uint8],
    weights: NDArray[np.float32],
    cell: int,
    window: int,
    scores: NDArray[np.float32],
) -> None:
    """Add, to each window's score, the weighted square roots of its histogram's counts, in place.

    `image` is ``(H, W, 3)``, `weights` ``(templates, 3, bins)``, `cell` the side of a cell in pixels,
    `window` the side of a window in cells (a power of two, at most 64 pixels), and `scores`
    ``(templates, cell rows - window + 1, cell columns - window + 1)``.
    """
    counts = count_bins(image, weights.shape[2], cell)
    roots = np.empty((counts.shape[1], *scores.shape[1:]), np.float32)
    root_windows(counts, window, np.empty((3, counts.shape[2]), np.uint16), roots)
    # A window of one cell: its bins are the channels.
    for each, out in zip(weights.reshape(len(weights), 1, 1, -1), scores):
        add_correlation(roots, each, 1, out)


@jit
def root_windows(counts, window, memory, roots):
    """Compute the square roots of the counts of windows; see `add_root_histograms`.

    `counts` is ``(cell rows, bins, cell columns)``, and `roots` the output ``(bins, rows, columns)`` for each
    cell at which a window starts. `memory` holds three rows of cells.
    """
    column_sums, columns, width = memory[0], memory.shape[1], roots.shape[2]
    for k in range(counts.shape[1]):
        column_sums[:] = 0
        for y in range(counts.shape[0]):
            entering = counts[y, k]
            for x in range(columns):
                column_sums[x] += entering[x]
            first = y - window + 1
            if first < 0:
                continue
            sums, span, turn = column_sums, 1, 1
            while span < window:  # sums of two columns of cells, of four and so on
                source, sums, ahead = sums, memory[turn], np.uintp(span)
                for x in range(np.uintp(columns - span)):
                    sums[x] = source[x] + source[x + ahead]
                span, turn = 2 * span, 3 - turn
            leaving, out = counts[first, k], roots[k, first]
            for x in range(width):
                out[x] = np.sqrt(np.float32(sums[x]))
            for x in range(columns):
                column_sums[x] -= leaving[x]


def add_correlation(
    channels: NDArray[np.float32], weights: NDArray[np.float32], dilation: int, scores: NDArray[np.float32]
) -> None:
    """Add each window's weighted sum of channels to its score, in place.

    `channels` is ``(channels, rows, columns)``, `weights` ``(window rows, window columns, channels)``, and
    `scores` has a row and a column for each position of the window. Neighboring cells of a window are
    `dilation` cells apart.
    """
    (height, width), columns = scores.shape, channels.shape[2]
    if not scores.size:
        return
    # Positions count through all rows; windows across the ends of rows are not used.
    sums = np.zeros((height, columns), np.float32)
    used = sums.reshape(-1)[: (height - 1) * columns + width]
    correlate(channels.reshape(len(channels), -1), weights, columns, dilation, used)
    scores += sums[:, :width]


# Positions that are summed together: their sums and the values of four channels stay in the first cache.
_POSITIONS = 1024


@functools.partial(jit, reorder=True)
def correlate(channels, weights, columns, dilation, sums):
    """Add the correlation of channels with weights; see `add_correlation`.

    `channels` is ``(channels, cells)``, with rows of `columns` cells one after the other, and `sums` has a
    value for each cell at which a window starts. Four channels are added at a time, so that a sum is loaded
    and stored once for four products, and those that are left one by one.
    """
    fours = len(channels) // 4 * 4
    for start in range(0, len(sums), _POSITIONS):
        out = sums[start : start + _POSITIONS]
        for k in range(0, fours, 4):
            for row in range(weights.shape[0]):
                for column in range(weights.shape[1]):
                    cell, w = start + (row * columns + column) * dilation, weights[row, column, k:]
                    w0, w1, w2, w3 = w[0], w[1], w[2], w[3]
                    v0, v1 = channels[k, cell:], channels[k + 1, cell:]
                    v2, v3 = channels[k + 2, cell:], channels[k + 3, cell:]
                    for i in range(len(out)):
                        out[i] += (w0 * v0[i] + w1 * v1[i]) + (w2 * v2[i] + w3 * v3[i])
        for k in range(fours, len(channels)):
            for row in range(weights.shape[0]):
                for column in range(weights.shape[1]):
                    values = channels[k, start + (row * columns + column) * dilation :]
                    weight = weights[row, column, k]
                    for i in range(len(out)):
                        out[i] += weight * values[i]
