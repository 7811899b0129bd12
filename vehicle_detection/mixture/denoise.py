"""Noise of a frame's sensor: how much there is, and a frame without most of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Levels of noise from which on a frame is smoothed, and from which on it is smoothed as much as it ever is;
# then by how many pixels. Frames of dash-cams by day and at dusk lie below 3, drawn ones by night at 8; a few
# small pictures full of texture come up to 7.
_SOME, _MUCH, _SIGMA = 3.0, 6.0, 0.9
# Every so many rows and columns are looked at.
_ROW_STEP, _COLUMN_STEP = 24, 2

_ROOTS = np.sqrt(255 * np.arange(256, dtype=np.float32))


def noise_level(image: NDArray[np.uint8]) -> float:
    """Estimate the noise of an image, as the templates see it: of the square roots of its values.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.

    Returns
    -------
    float
        Standard deviation of ``sqrt(255 * value)`` in what is plain, of the green channel; 0 for an image of
        fewer than three rows or columns.

    Notes
    -----
    The difference of two Laplacians takes no notice of what the image shows where that is even, slanted or
    curved: Immerkaer, "Fast noise variance estimation" (CVIU 64, 1996). The median instead of the mean leaves
    out edges.

    Examples
    --------
    >>> plain = np.full((90, 120, 3), 60.0)
    >>> noisy = plain + np.random.default_rng(0).normal(0, 4, plain.shape)
    >>> noise_level(plain.astype(np.uint8)), round(noise_level(noisy.astype(np.uint8)))
    (0.0, 4)
    """
    if min(image.shape[:2]) < 3:
        return 0.0
    rows = np.arange(1, image.shape[0] - 1, _ROW_STEP)
    above, middle, below = (_ROOTS[image[rows + shift, :, 1]] for shift in (-1, 0, 1))
    down = above - 2 * middle + below
    both = down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:]
    # The weights' squares sum to 36, and half of a normal distribution lies within 0.6745 deviations.
    return float(np.median(np.abs(both[:, ::_COLUMN_STEP]))) / (6 * 0.6745)


def without_noise(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Smooth an image in which noise would hide edges; any other is returned as it is.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.

    Returns
    -------
    numpy.ndarray
        An image of the same shape, uint8, or `image` itself.

    Examples
    --------
    >>> plain = np.full((90, 120, 3), 60, np.uint8)
    >>> without_noise(plain) is plain
    True
    """
    share = (noise_level(image) - _SOME) / (_MUCH - _SOME)
    if share <= 0:
        return image
    share = min(share, 1.0)
    smooth = cv2.GaussianBlur(image, (5, 5), _SIGMA)
    return np.asarray(cv2.addWeighted(smooth, share, image, 1 - share, 0), np.uint8)
