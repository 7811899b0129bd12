"""The numba kernels of color: histograms of patches and of all windows of a band, and spatial bins."""

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
    """Color histogram of each patch, channel by channel.

    Parameters
    ----------
    patches
        ``(N, side, side, 3)`` uint8.
    bin_of_value
        ``(256,)`` intp, the bin of each value.
    bins
        Number of bins.
    features
        Output, ``(N, 3 * bins)`` float32.
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
def histogram_cells(image, table, cell, cells):
    """Sum, over each cell, the table's weights of the pixel values of all channels.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8.
    table
        ``(3, 256)`` float32, the weight of each value.
    cell
        Side of a cell in pixels.
    cells
        Output, ``(cell rows, cell columns)`` float32.
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
    """Add, to each window's score, the weighted square roots of its histogram's counts.

    Counts are kept bin by bin for the last rows of cells, already summed over the width of a window: a step
    down adds one row and takes one away. Bins without a pixel in those rows, most of them in a color
    channel, cost nothing more.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8.
    bin_of_value
        ``(256,)`` intp, the bin of each value.
    weights
        ``(templates, 3, bins)`` float32, of a count's root.
    cell
        Side of a cell in pixels.
    window
        Side of a window in cells, a power of two, of at most 64 pixels.
    scores
        Changed in place, ``(templates, cell rows - window + 1, cell columns - window + 1)`` float32.
    """
    templates, bins = len(weights), weights.shape[2]
    rows, width = scores.shape[1] + window - 1, scores.shape[2]
    columns = width + window - 1
    # A window of 64x64 pixels counts to 4096: 16 bits hold it.
    counts = np.empty((3 * bins, columns), np.uint16)
    flat = counts.reshape(-1)
    # Where a bin's counts start; unsigned, or each access would ask whether it counts from the end.
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
                at = np.uintp(column)
                for x in range(column * cell, (column + 1) * cell):
                    flat[first[line[x, 0]] + at] += one
                    flat[second[line[x, 1]] + at] += one
                    flat[third[line[x, 2]] + at] += one
        slot = row % window
        for k in range(3 * bins):
            count = counts[k]
            some = np.uint16(0)
            for x in range(columns):
                some |= count[x]
            total, last = sums[k], recent[slot, k]
            if filled[slot, k]:
                for x in range(width):
                    total[x] -= last[x]
            filled[slot, k] = some > 0
            if some > 0:
                # Sums of two cells, of four, of eight, until they are as wide as a window.
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
    """Deal the spatial bins of a band out to planes: one plane for each place of a bin in its cell.

    Parameters
    ----------
    bins
        ``(H, W, 3)`` uint8, the band resized to the bin grid.
    per_cell
        Bins along a cell's side.
    cells
        Output, ``(3, per_cell, per_cell, cell rows, cell columns)`` float32.
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
