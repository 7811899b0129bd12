"""The numba kernels of the road features: signed and unsigned orientations, normalised four ways."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels import jit

# Columns whose sums of all orientations stay in the first-level cache.
_COLUMNS = 256


@jit
def orientation_sums(channels, part, cotangents, sums):
    """Sum gradient magnitudes into 16 signed orientations over squares of `part` pixels.

    Of the channels the one with the longest gradient decides (Dalal and Triggs, CVPR 2005, section 6.2). The
    bins are centred: bin `k` holds the angles within 11.25 degrees of ``22.5 k``, bin ``k + 8`` the opposite
    ones. So upright and level edges lie in the middle of a bin, and the features of a mirrored image are
    those of the image, mirrored and in another order.

    Parameters
    ----------
    channels
        ``(C, H, W)`` uint8.
    part
        Side of a square in pixels, an even number.
    cotangents
        ``(8,)`` float32, of the angles 11.25, 33.75, ..., 168.75 degrees.
    sums
        Output, ``(16, rows, columns)`` float32; the image has ``rows * part`` rows or more.
    """
    count, height, width = channels.shape
    rows, columns = sums.shape[1:]
    per_tile = max(1, _COLUMNS // part)
    size = per_tile * part
    quotient = np.empty(size, np.float32)
    squared = np.empty(size, np.float32)
    across = np.empty(size, np.float32)
    down = np.empty(size, np.float32)
    ahead = np.empty(size, np.float32)
    back = np.empty(size, np.float32)
    # Cumulative over the bounds: what points ahead (or down) past each bound, and what points back.
    totals = np.empty((18, size), np.float32)
    zero = np.float32(0)
    infinite = np.float32(np.inf)
    for row in range(rows):
        for first in range(0, columns, per_tile):
            cells = min(per_tile, columns - first)
            start = first * part
            n = cells * part
            totals[:] = zero
            for y in range(row * part, (row + 1) * part):
                low = 1 if start == 0 else 0
                high = n - 1 if start + n == width else n
                inside = 0 < y < height - 1
                squared[:n] = np.float32(-1)
                for c in range(count):
                    above = channels[c, y - 1 if inside else y, start : start + n]
                    below = channels[c, y + 1 if inside else y, start : start + n]
                    left = channels[c, y, start + low - 1 : start + high - 1]
                    right = channels[c, y, start + low + 1 : start + high + 1]
                    quotient[:low] = zero
                    quotient[high:n] = zero
                    inner = quotient[low:high]
                    for i in range(high - low):
                        inner[i] = np.float32(right[i]) - np.float32(left[i])
                    for i in range(n):
                        gx = quotient[i]
                        gy = np.float32(below[i]) - np.float32(above[i])
                        length = gx * gx + gy * gy
                        longer = length > squared[i]
                        squared[i] = length if longer else squared[i]
                        across[i] = gx if longer else across[i]
                        down[i] = gy if longer else down[i]
                for i in range(n):
                    gx, gy = across[i], down[i]
                    magnitude = np.sqrt(squared[i])
                    # Along the row the angle is 0, whichever way it points.
                    quotient[i] = gx / gy if gy != zero else infinite
                    forth = gx if gy == zero else gy
                    ahead[i] = magnitude if forth > zero else zero
                    back[i] = zero if forth > zero else magnitude
                t0, t1 = totals[0], totals[9]
                for i in range(n):
                    t0[i] += ahead[i]
                    t1[i] += back[i]
                for k in range(0, 8, 2):
                    c0, c1 = cotangents[k], cotangents[k + 1]
                    a0, a1 = totals[k + 1], totals[k + 2]
                    b0, b1 = totals[k + 10], totals[k + 11]
                    for i in range(n):
                        q, a, b = quotient[i], ahead[i], back[i]
                        a0[i] += a if q <= c0 else zero
                        b0[i] += b if q <= c0 else zero
                        a1[i] += a if q <= c1 else zero
                        b1[i] += b if q <= c1 else zero
            for side in range(2):
                for k in range(8):
                    over, under = totals[side * 9 + k], totals[side * 9 + k + 1]
                    out = sums[side * 8 + k, row, first : first + cells]
                    for i in range(n):
                        quotient[i] = over[i] - under[i]
                    if k == 0:
                        # Past the last bound lies the first bin of the other way.
                        other = totals[17 - side * 9]
                        for i in range(n):
                            quotient[i] += other[i]
                    # Pairs for all columns at once, of which every other one is wanted.
                    even, odd, pairs = quotient[: n - 1], quotient[1:n], across[: n - 1]
                    for i in range(n - 1):
                        pairs[i] = even[i] + odd[i]
                    for column in range(cells):
                        value = zero
                        for x in range(column * part, (column + 1) * part, 2):
                            value += across[x]
                        out[column] = value


@jit
def spread_cells(sums, scale, cells):
    """Add up cells of 2x2 squares and what is around them, the nearer squares with more weight.

    The weights 1, 3, 3, 1 along either axis are the bilinear shares of a square's pixels in the cells around
    it, taken at its middle.

    Parameters
    ----------
    sums
        ``(16, 2 * rows, 2 * columns)`` float32, or a row or column more.
    scale
        Factor of the weighted sums.
    cells
        Output, ``(16, rows, columns)`` float32. Beyond the border the outermost squares go on.
    """
    count, rows, columns = cells.shape
    line = np.empty(2 * columns, np.float32)
    three = np.float32(3)
    for k in range(count):
        for y in range(rows):
            a = sums[k, max(2 * y - 1, 0)]
            b, c = sums[k, 2 * y], sums[k, 2 * y + 1]
            d = sums[k, min(2 * y + 2, 2 * rows - 1)]
            for x in range(2 * columns):
                line[x] = (a[x] + d[x]) + three * (b[x] + c[x])
            out = cells[k, y]
            for x in range(columns):
                ends = line[max(2 * x - 1, 0)] + line[min(2 * x + 2, 2 * columns - 1)]
                out[x] = (ends + three * (line[2 * x] + line[2 * x + 1])) * scale


@jit
def smooth_cells(sums, scale, cells):
    """Add up cells of one square and a little of its neighbours: 1, 6, 1 along either axis.

    These are the bilinear shares of a cell's pixels in itself and in the cells beside it, on average.

    Parameters
    ----------
    sums
        ``(16, rows, columns)`` float32.
    scale, cells
        As for `spread_cells`.
    """
    count, rows, columns = cells.shape
    line = np.empty(columns + 2, np.float32)
    six = np.float32(6)
    for k in range(count):
        for y in range(rows):
            above, middle, below = sums[k, max(y - 1, 0)], sums[k, y], sums[k, min(y + 1, rows - 1)]
            inner = line[1 : columns + 1]
            for x in range(columns):
                inner[x] = (above[x] + below[x]) + six * middle[x]
            line[0], line[columns + 1] = line[1], line[columns]
            left, right, out = line[:columns], line[2:], cells[k, y]
            for x in range(columns):
                out[x] = ((left[x] + right[x]) + six * inner[x]) * scale


@jit
def normalise_four_ways(cells, eps, planes):
    """Normalise each cell by the four blocks of 2x2 cells that hold it; clip at 0.2.

    Felzenszwalb et al., "Object detection with discriminatively trained part-based models" (PAMI 2010),
    section 6.2: sums over the normalisations for each of 16 signed and 8 unsigned orientations, and sums over
    the orientations for each of the four normalisations.

    Parameters
    ----------
    cells
        ``(16, rows, columns)`` float32.
    eps
        Added to the energy of a block.
    planes
        Output, ``(28, rows, columns)`` float32 or more planes, of which the rest stays as it is.
    """
    rows, columns = cells.shape[1:]
    energy = np.zeros((rows + 2, columns + 2), np.float32)
    blocks = np.empty((2, columns + 1), np.float32)
    texture = np.empty((4, columns), np.float32)
    clip, half, share = np.float32(0.2), np.float32(0.5), np.float32(0.2357)
    one = np.float32(1)
    for k in range(8):
        for y in range(rows):
            out = energy[y + 1, 1 : columns + 1]
            forth, back = cells[k, y], cells[k + 8, y]
            for x in range(columns):
                both = forth[x] + back[x]
                out[x] += both * both
    # Beyond the border the outermost cells go on.
    energy[0] = energy[1]
    energy[rows + 1] = energy[rows]
    energy[:, 0] = energy[:, 1]
    energy[:, columns + 1] = energy[:, columns]
    for y in range(rows):
        for side in range(2):
            upper, lower = energy[y + side], energy[y + side + 1]
            out = blocks[side]
            for x in range(columns + 1):
                out[x] = one / np.sqrt(upper[x] + upper[x + 1] + lower[x] + lower[x + 1] + eps)
        n0, n1 = blocks[0, :columns], blocks[0, 1:]
        n2, n3 = blocks[1, :columns], blocks[1, 1:]
        texture[:] = np.float32(0)
        t0, t1, t2, t3 = texture[0], texture[1], texture[2], texture[3]
        for k in range(16):
            line, out = cells[k, y], planes[k, y]
            for x in range(columns):
                value = line[x]
                q0, q1 = min(value * n0[x], clip), min(value * n1[x], clip)
                q2, q3 = min(value * n2[x], clip), min(value * n3[x], clip)
                t0[x] += q0
                t1[x] += q1
                t2[x] += q2
                t3[x] += q3
                out[x] = half * ((q0 + q1) + (q2 + q3))
        for k in range(8):
            forth, back, out = cells[k, y], cells[k + 8, y], planes[16 + k, y]
            for x in range(columns):
                value = forth[x] + back[x]
                q0, q1 = min(value * n0[x], clip), min(value * n1[x], clip)
                q2, q3 = min(value * n2[x], clip), min(value * n3[x], clip)
                out[x] = half * ((q0 + q1) + (q2 + q3))
        for k in range(4):
            line, out = texture[k], planes[24 + k, y]
            for x in range(columns):
                out[x] = share * line[x]


@jit
def correlate(planes, weights, bias, scores):
    """Score every window of a map: the sum of weights times planes over the window's cells.

    Two rows of windows and four planes are worked on at once, so that a value that is loaded is used twice
    and a sum that is loaded takes four products.

    Parameters
    ----------
    planes
        ``(planes, rows, columns)`` float32, a multiple of four planes.
    weights
        ``(window rows, window columns, planes)`` float32.
    bias
        Added to every score.
    scores
        Output, ``(rows - window rows + 1, columns - window columns + 1)`` float32.
    """
    count = planes.shape[0]
    rows, columns = weights.shape[:2]
    height, width = scores.shape
    for y in range(0, height, 2):
        two = y + 1 < height
        out0, out1 = scores[y], scores[y + 1 if two else y]
        for x in range(width):
            out0[x] = bias
            out1[x] = bias
        for i in range(rows + 1 if two else rows):
            # Row `i` of the first windows is row `i - 1` of those below them.
            for j in range(columns):
                for k in range(0, count, 4):
                    b0 = planes[k, y + i, j : j + width]
                    b1 = planes[k + 1, y + i, j : j + width]
                    b2 = planes[k + 2, y + i, j : j + width]
                    b3 = planes[k + 3, y + i, j : j + width]
                    upper, lower = weights[min(i, rows - 1), j], weights[max(i - 1, 0), j]
                    w0, w1, w2, w3 = upper[k], upper[k + 1], upper[k + 2], upper[k + 3]
                    v0, v1, v2, v3 = lower[k], lower[k + 1], lower[k + 2], lower[k + 3]
                    if i == 0 or not two:
                        for x in range(width):
                            out0[x] += w0 * b0[x] + w1 * b1[x] + w2 * b2[x] + w3 * b3[x]
                    elif i == rows:
                        for x in range(width):
                            out1[x] += v0 * b0[x] + v1 * b1[x] + v2 * b2[x] + v3 * b3[x]
                    else:
                        for x in range(width):
                            x0, x1, x2, x3 = b0[x], b1[x], b2[x], b3[x]
                            out0[x] += w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3
                            out1[x] += v0 * x0 + v1 * x1 + v2 * x2 + v3 * x3
