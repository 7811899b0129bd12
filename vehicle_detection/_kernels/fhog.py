"""Numba kernels of FHOG: signed and unsigned orientations of cells, with four normalizations."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import jit

# Columns whose sums of all orientations fit into the first-level cache.
_COLUMNS = 512


@jit
def _sqrt_row(row, out):
    """Write ``sqrt(255 * value)`` of a row; the two values beyond its ends make the gradient there zero."""
    width = len(row)
    scale = np.float32(255)
    for x in range(width):
        out[x + 1] = np.sqrt(scale * np.float32(row[x]))
    out[0], out[width + 1] = out[2], out[width - 1]


@jit
def orientation_sums(channels, cotangents, sums):
    """Sum gradient magnitudes by 16 signed orientations over squares of 4x4 pixels.

    `channels` is ``(3, H, W)`` uint8, `cotangents` ``(8,)`` float32 of the angles 11.25, 33.75, ..., 168.75
    degrees, and `sums` the output ``(16, rows, columns)`` float32, at most a quarter of the image's size.

    The gradients are those of ``sqrt(255 * value)``, which gives dark regions more weight; of the three
    channels, the one with the longest gradient is used (Dalal and Triggs, CVPR 2005, sections 6.1 and 6.2).
    Bin `k` is centered on ``22.5 k`` degrees and bin ``k + 8`` is opposite to it, so vertical and horizontal
    edges are in the middle of a bin, and mirroring an image permutes the bins. A gradient is beyond a bound
    if the ratio ``gx / gy`` is at most its cotangent. The sum of a bin is the difference of the sums beyond
    its two bounds, which stay in registers over the four rows of a square.
    """
    height, width = channels.shape[1:]
    rows, columns = sums.shape[1:]
    wide = 4 * columns
    # Square roots of three successive rows, in a ring.
    roots = np.empty((3, 3, width + 2), np.float32)
    for c in range(3):
        _sqrt_row(channels[c, 0], roots[c, 0])
    # Ratios of four rows; magnitudes of gradients with angles in [0, 180) degrees, and of the opposite ones.
    ratios = np.empty((4, wide), np.float32)
    magnitudes = np.empty((2, 4, wide), np.float32)
    bins = np.empty((2, 8, _COLUMNS), np.float32)
    beyond = np.empty((2, _COLUMNS), np.float32)
    c0, c1, c2, c3 = cotangents[0], cotangents[1], cotangents[2], cotangents[3]
    c4, c5, c6, c7 = cotangents[4], cotangents[5], cotangents[6], cotangents[7]
    zero, infinite = np.float32(0), np.float32(np.inf)
    for row in range(rows):
        for part in range(4):
            y = 4 * row + part
            if y + 1 < height:
                for c in range(3):
                    _sqrt_row(channels[c, y + 1], roots[c, (y + 1) % 3])
            middle = y % 3
            up, down = ((y - 1) % 3, (y + 1) % 3) if 0 < y < height - 1 else (middle, middle)
            left0, left1, left2 = roots[0, middle], roots[1, middle], roots[2, middle]
            right0, right1, right2 = left0[2:], left1[2:], left2[2:]
            up0, up1, up2 = roots[0, up, 1:], roots[1, up, 1:], roots[2, up, 1:]
            down0, down1, down2 = roots[0, down, 1:], roots[1, down, 1:], roots[2, down, 1:]
            ratio, positive, negative = ratios[part], magnitudes[0, part], magnitudes[1, part]
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
                longest_x = hx if other > squared else gx
                longest_y = hy if other > squared else gy
                magnitude = np.sqrt(other if other > squared else squared)
                # A horizontal gradient counts as angle 0 here; its sign selects the half circle.
                ratio[x] = longest_x / longest_y if longest_y != zero else infinite
                sign = longest_x if longest_y == zero else longest_y
                positive[x] = magnitude if sign > zero else zero
                negative[x] = zero if sign > zero else magnitude
        for first in range(0, wide, _COLUMNS):
            n = min(_COLUMNS, wide - first)
            tile = ratios[:, first : first + n]
            for half in range(2):
                magnitude, out, last = magnitudes[half, :, first : first + n], bins[half], beyond[half]
                for x in range(n):
                    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = zero
                    for part in range(4):
                        q, m = tile[part, x], magnitude[part, x]
                        s0 += m
                        s1 += m if q <= c0 else zero
                        s2 += m if q <= c1 else zero
                        s3 += m if q <= c2 else zero
                        s4 += m if q <= c3 else zero
                        s5 += m if q <= c4 else zero
                        s6 += m if q <= c5 else zero
                        s7 += m if q <= c6 else zero
                        s8 += m if q <= c7 else zero
                    out[0, x] = s0 - s1
                    out[1, x] = s1 - s2
                    out[2, x] = s2 - s3
                    out[3, x] = s3 - s4
                    out[4, x] = s4 - s5
                    out[5, x] = s5 - s6
                    out[6, x] = s6 - s7
                    out[7, x] = s7 - s8
                    last[x] = s8
            for half in range(2):
                # Gradients beyond the last bound belong to the first bin of the other half circle.
                line, last = bins[half, 0], beyond[1 - half]
                for x in range(n):
                    line[x] += last[x]
                for k in range(8):
                    line, out = bins[half, k], sums[8 * half + k, row, first // 4 : (first + n) // 4]
                    for x in range(n // 4):
                        out[x] = (line[4 * x] + line[4 * x + 1]) + (line[4 * x + 2] + line[4 * x + 3])


@jit
def pool_bilinear(sums, scale, cells):
    """Pool squares into cells of 2x2 squares by bilinear interpolation, with replicated borders.

    `sums` is ``(16, 2 * rows, 2 * columns)`` float32 or larger, `cells` the output ``(16, rows, columns)``.
    The weights along each axis, 1, 3, 3, 1 times `scale`, are those of bilinear interpolation at the squares'
    centers.
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
    """Smooth cells of one square, ``(16, rows, columns)`` float32, with replicated borders.

    The weights along each axis, 1, 6, 1 times `scale`, are the average weights of bilinear interpolation of a
    cell's pixels between the cell and its neighbors.
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
def fhog_normalize(cells, eps, channels):
    """Normalize each cell by the four blocks of 2x2 cells that contain it, and clip at 0.2.

    `cells` is ``(16, rows, columns)`` float32, `eps` is added to the energy of a block, and `channels` is the
    output ``(28, rows, columns)``: sums over the normalizations for each of 16 signed and 8 unsigned
    orientations, and sums over the orientations for each of the four normalizations. Felzenszwalb et al.,
    "Object detection with discriminatively trained part-based models" (PAMI 2010), section 6.2.
    """
    rows, columns = cells.shape[1:]
    energy = np.zeros((rows + 2, columns + 2), np.float32)
    blocks = np.empty((2, columns + 1), np.float32)
    texture = np.empty((4, columns), np.float32)
    clip, half, texture_scale = np.float32(0.2), np.float32(0.5), np.float32(0.2357)
    zero, one = np.float32(0), np.float32(1)
    for k in range(8):
        for y in range(rows):
            out = energy[y + 1, 1 : columns + 1]
            positive, negative = cells[k, y], cells[k + 8, y]
            for x in range(columns):
                both = positive[x] + negative[x]
                out[x] += both * both
    # Replicate the border. Loops, because slice assignments take seconds to compile.
    for x in range(1, columns + 1):
        energy[0, x] = energy[1, x]
        energy[rows + 1, x] = energy[rows, x]
    for y in range(rows + 2):
        energy[y, 0] = energy[y, 1]
        energy[y, columns + 1] = energy[y, columns]
    for y in range(rows):
        for side in range(2):
            upper, lower = energy[y + side], energy[y + side + 1]
            out = blocks[side]
            for x in range(columns + 1):
                out[x] = one / np.sqrt(upper[x] + upper[x + 1] + lower[x] + lower[x + 1] + eps)
        n0, n1 = blocks[0, :columns], blocks[0, 1:]
        n2, n3 = blocks[1, :columns], blocks[1, 1:]
        t0, t1, t2, t3 = texture[0], texture[1], texture[2], texture[3]
        for x in range(columns):
            t0[x] = t1[x] = t2[x] = t3[x] = zero
        for k in range(16):
            line, out = cells[k, y], channels[k, y]
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
            positive, negative, out = cells[k, y], cells[k + 8, y], channels[16 + k, y]
            for x in range(columns):
                value = positive[x] + negative[x]
                q0, q1 = min(value * n0[x], clip), min(value * n1[x], clip)
                q2, q3 = min(value * n2[x], clip), min(value * n3[x], clip)
                out[x] = half * ((q0 + q1) + (q2 + q3))
        for k in range(4):
            line, out = texture[k], channels[24 + k, y]
            for x in range(columns):
                out[x] = texture_scale * line[x]
