"""Numba kernels that convert between YUV 4:2:0 planes and RGB channels, in fixed-point arithmetic."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import jit


@jit
def channels_from_planes(luma, blue, red, zero, gain, to_red, blue_to_green, red_to_green, to_blue, channels):
    """Convert luma and chroma planes to ``(3, H, W)`` RGB channels; the factors are scaled by 2**14."""
    height, width = luma.shape
    half = np.int32(1 << 13)
    shift, low, high, middle = np.int32(14), np.int32(0), np.int32(255), np.int32(128)
    # Contribution of chroma to each channel, for two rows of pixels.
    in_red = np.empty(width, np.int32)
    in_green = np.empty(width, np.int32)
    in_blue = np.empty(width, np.int32)
    for y in range(height):
        if y % 2 == 0:
            for i in range(width // 2):
                u = np.int32(blue[y // 2, i]) - middle
                v = np.int32(red[y // 2, i]) - middle
                for x in range(2 * i, 2 * i + 2):
                    in_red[x] = to_red * v + half
                    in_green[x] = blue_to_green * u + red_to_green * v + half
                    in_blue[x] = to_blue * u + half
        row = luma[y]
        r, g, b = channels[0, y], channels[1, y], channels[2, y]
        for x in range(width):
            light = (np.int32(row[x]) - zero) * gain
            r[x] = min(max((light + in_red[x]) >> shift, low), high)
            g[x] = min(max((light + in_green[x]) >> shift, low), high)
            b[x] = min(max((light + in_blue[x]) >> shift, low), high)


@jit
def planes_from_channels(channels, luma, blue, red):
    """Convert ``(3, H, W)`` RGB channels to BT.601 planes, 16-235; the factors are scaled by 2**16."""
    height, width = luma.shape
    shift, shift_of_four = np.int32(16), np.int32(18)
    zero = np.int32((16 << 16) + (1 << 15))
    middle = np.int32((128 << 18) + (1 << 17))
    # Luma: 219 / 255 * (0.299, 0.587, 0.114). Chroma: 112 / 255 * (B - Y) / 0.886 and (R - Y) / 0.701.
    yr, yg, yb = np.int32(16829), np.int32(33039), np.int32(6416)
    ur, ug, ub = np.int32(-9714), np.int32(-19070), np.int32(28784)
    vr, vg, vb = np.int32(28784), np.int32(-24103), np.int32(-4681)
    sums = np.empty((3, width), np.int32)
    for pair in range(height // 2):
        for y in range(2 * pair, 2 * pair + 2):
            r, g, b = channels[0, y], channels[1, y], channels[2, y]
            row = luma[y]
            for x in range(width):
                light = yr * np.int32(r[x]) + yg * np.int32(g[x]) + yb * np.int32(b[x])
                row[x] = (light + zero) >> shift
        for c in range(3):
            above, below, both = channels[c, 2 * pair], channels[c, 2 * pair + 1], sums[c]
            for x in range(width):
                both[x] = np.int32(above[x]) + np.int32(below[x])
        r4, g4, b4 = sums[0], sums[1], sums[2]
        u, v = blue[pair], red[pair]
        for i in range(width // 2):
            r_sum = r4[2 * i] + r4[2 * i + 1]
            g_sum = g4[2 * i] + g4[2 * i + 1]
            b_sum = b4[2 * i] + b4[2 * i + 1]
            u[i] = (ur * r_sum + ug * g_sum + ub * b_sum + middle) >> shift_of_four
            v[i] = (vr * r_sum + vg * g_sum + vb * b_sum + middle) >> shift_of_four
