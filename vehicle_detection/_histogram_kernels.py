"""The numba kernel of square-rooted histograms: counts that slide over a band, and their weighted roots."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels import jit


@jit
def add_root_histograms(image, bin_of_value, weights, cell, window, scores):
    """Add, to each window's score, the weighted square roots of its histogram's counts.

    Counts are kept bin by bin for the last rows of cells, already summed over the width of a window: a step
    down adds one row and takes one away. Bins without a pixel in those rows, most of them in a colour
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
