"""The numba kernels of the road features: signed and unsigned orientations, normalized four ways."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import jit

# Columns whose sums of all orientations stay in the first-level cache.
_COLUMNS = 512


@jit
def _take_roots(own, line):
    """Write the square roots of a row's values, and beyond either end what makes the gradient zero there."""
    width = len(own)
    scale = np.float32(255)
    for x in range(width):
        line[x + 1] = np.sqrt(scale * np.float32(own[x]))
    line[0], line[width + 1] = line[2], line[width - 1]


@jit
def orientation_sums(channels, cotangents, sums):
    """Sum gradient magnitudes into 16 signed orientations over squares of 4x4 pixels.

    The gradients are those of the square roots of the values, ``sqrt(255 * value)``: so the edges of what is
    dark count for more (Dalal and Triggs, CVPR 2005, section 6.1). Of the channels the one with the longest
    gradient decides (section 6.2). The bins are centerd: bin `k` holds the angles within 11.25 degrees of
    ``22.5 k``, bin ``k + 8`` the opposite ones. So upright and level edges lie in the middle of a bin, and
    the features of a mirrored image are those of the image, mirrored and in another order. A bin's sum is
    the difference of what lies past its two bounds, and these sums stay in registers over the four rows of a
    square.

    Parameters
    ----------
    channels
        ``(3, H, W)`` uint8.
    cotangents
        ``(8,)`` float32, of the angles 11.25, 33.75, ..., 168.75 degrees.
    sums
        Output, ``(16, rows, columns)`` float32; the image has four times as many rows and columns, or more.
    """
    height, width = channels.shape[1:]
    rows, columns = sums.shape[1:]
    wide = 4 * columns
    # Roots of the rows above, at and below, in turns.
    roots = np.empty((3, 3, width + 2), np.float32)
    for c in range(3):
        _take_roots(channels[c, 0], roots[c, 0])
    # Cotangents of four rows; lengths of what points down (or ahead, along the row), and of what points back.
    angles = np.empty((4, wide), np.float32)
    lengths = np.empty((2, 4, wide), np.float32)
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
                    _take_roots(channels[c, y + 1], roots[c, (y + 1) % 3])
            own = y % 3
            up, down = ((y - 1) % 3, (y + 1) % 3) if 0 < y < height - 1 else (own, own)
            left0, left1, left2 = roots[0, own], roots[1, own], roots[2, own]
            right0, right1, right2 = left0[2:], left1[2:], left2[2:]
            up0, up1, up2 = roots[0, up, 1:], roots[1, up, 1:], roots[2, up, 1:]
            down0, down1, down2 = roots[0, down, 1:], roots[1, down, 1:], roots[2, down, 1:]
            angle, ahead, back = angles[part], lengths[0, part], lengths[1, part]
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
                across = hx if other > squared else gx
                along = hy if other > squared else gy
                size = np.sqrt(other if other > squared else squared)
                # Along the row the angle is 0, whichever way it points.
                angle[x] = across / along if along != zero else infinite
                forth = across if along == zero else along
                ahead[x] = size if forth > zero else zero
                back[x] = zero if forth > zero else size
        for first in range(0, wide, _COLUMNS):
            n = min(_COLUMNS, wide - first)
            tile = angles[:, first : first + n]
            for way in range(2):
                length, out, rest = lengths[way, :, first : first + n], bins[way], beyond[way]
                for x in range(n):
                    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = zero
                    for part in range(4):
                        q, s = tile[part, x], length[part, x]
                        s0 += s
                        s1 += s if q <= c0 else zero
                        s2 += s if q <= c1 else zero
                        s3 += s if q <= c2 else zero
                        s4 += s if q <= c3 else zero
                        s5 += s if q <= c4 else zero
                        s6 += s if q <= c5 else zero
                        s7 += s if q <= c6 else zero
                        s8 += s if q <= c7 else zero
                    out[0, x] = s0 - s1
                    out[1, x] = s1 - s2
                    out[2, x] = s2 - s3
                    out[3, x] = s3 - s4
                    out[4, x] = s4 - s5
                    out[5, x] = s5 - s6
                    out[6, x] = s6 - s7
                    out[7, x] = s7 - s8
                    rest[x] = s8
            for way in range(2):
                # Past the last bound lies the first bin of the other way.
                line, rest = bins[way, 0], beyond[1 - way]
                for x in range(n):
                    line[x] += rest[x]
                for k in range(8):
                    line, out = bins[way, k], sums[8 * way + k, row, first // 4 : (first + n) // 4]
                    for x in range(n // 4):
                        out[x] = (line[4 * x] + line[4 * x + 1]) + (line[4 * x + 2] + line[4 * x + 3])


@jit
def pool_bilinear(sums, scale, cells):
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
    """Add up cells of one square and a little of its neighbors: 1, 6, 1 along either axis.

    These are the bilinear shares of a cell's pixels in itself and in the cells beside it, on average.

    Parameters
    ----------
    sums
        ``(16, rows, columns)`` float32.
    scale, cells
        As for `pool_bilinear`.
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
def fhog_normalize(cells, eps, planes):
    """Normalize each cell by the four blocks of 2x2 cells that hold it; clip at 0.2.

    Felzenszwalb et al., "Object detection with discriminatively trained part-based models" (PAMI 2010),
    section 6.2: sums over the normalizations for each of 16 signed and 8 unsigned orientations, and sums over
    the orientations for each of the four normalizations.

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
    zero, one = np.float32(0), np.float32(1)
    for k in range(8):
        for y in range(rows):
            out = energy[y + 1, 1 : columns + 1]
            forth, back = cells[k, y], cells[k + 8, y]
            for x in range(columns):
                both = forth[x] + back[x]
                out[x] += both * both
    # Beyond the border the outermost cells go on. Loops: to assign parts of arrays takes seconds to compile.
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
