"""Numba kernels of color histograms, of patches and of all windows of a band, and of spatial bins."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import jit


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
    for row in range(rows):
        for column in range(columns):
            cells[row, column] = 0
        for y in range(row * cell, (row + 1) * cell):
            line = image[y]
            for column in range(columns):
                first = np.float32(0)
                second = np.float32(0)
                third = np.float32(0)
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
    first, second, third = (
        np.empty(256, np.uintp),
        np.empty(256, np.uintp),
        np.empty(256, np.uintp),
    )
    for value in range(256):
        first[value] = bin_of_value[value] * columns
        second[value] = first[value] + np.uintp(bins * columns)
        third[value] = second[value] + np.uintp(bins * columns)
    one = np.uint16(1)
    wide = np.empty(columns, np.uint16)
    recent = np.zeros((window, 3 * bins, width), np.uint16)
    filled = np.zeros((window, 3 * bins), np.bool_)
    sums = np.zeros((3 * bins, width), np.uint16)
    roots = np.empty(width, np.float32)
    flat_weights = weights.reshape(templates, 3 * bins)
    for row in range(rows):
        counts.fill(np.uint16(0))
        for y in range(row * cell, (row + 1) * cell):
            line = image[y]
            for column in range(columns):
                offset = np.uintp(column)
                for x in range(column * cell, (column + 1) * cell):
                    flat[first[line[x, 0]] + offset] += one
                    flat[second[line[x, 1]] + offset] += one
                    flat[third[line[x, 2]] + offset] += one
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
                # Sums of two cells, of four, of eight, up to the width of a window.
                span = 1
                while span < window:
                    reach = columns - span
                    left, right = count[:reach], count[span:]
                    for x in range(reach):
                        wide[x] = left[x] + right[x]
                    for x in range(reach):
                        left[x] = wide[x]
                    span *= 2
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
def spatial_cells(bins, per_cell, cells):
    """Split the spatial bins of a band into one channel for each position of a bin in its cell.

    `bins` is ``(H, W, 3)`` uint8, the band resized to the bin grid, `per_cell` the number of bins along a
    cell's side, and `cells` the output ``(3, per_cell, per_cell, cell rows, cell columns)`` float32.
    """
    rows, columns = cells.shape[3], cells.shape[4]
    for channel in range(3):
        for i in range(per_cell):
            for j in range(per_cell):
                for y in range(rows):
                    line = bins[y * per_cell + i]
                    out = cells[channel, i, j, y]
                    for x in range(columns):
                        out[x] = line[x * per_cell + j, channel]
