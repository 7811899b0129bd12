"""Sensor noise: its estimate, and the smoothing of noisy frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Noise level from which a frame is smoothed, level from which it is smoothed fully, and the sigma of the
# Gaussian in pixels. Dash-cam frames by day and at dusk are below 3, rendered night frames at 8; a few small,
# richly textured images reach 7.
_NOISE_MIN, _NOISE_FULL, _SIGMA = 3.0, 6.0, 0.9
# Sampling of the estimate.
_ROW_STEP, _COLUMN_STEP = 24, 2

_ROOTS = np.sqrt(255 * np.arange(256, dtype=np.float32))


def estimate_noise(image: NDArray[np.uint8]) -> float:
    """Estimate the standard deviation of the noise of ``sqrt(255 * value)``, in the green channel.

    The difference of two Laplacians is zero on constant, linear and quadratic image content: Immerkaer, "Fast
    noise variance estimation" (CVIU 64, 1996). The median, instead of the mean, excludes edges. The estimate
    is 0 for an image with fewer than three rows or columns.

    >>> gray = np.full((90, 120, 3), 60.0)
    >>> noisy = gray + np.random.default_rng(0).normal(0, 4, gray.shape)
    >>> estimate_noise(gray.astype(np.uint8)), round(estimate_noise(noisy.astype(np.uint8)))
    (0.0, 4)
    """
    if min(image.shape[:2]) < 3:
        return 0.0
    rows = np.arange(1, image.shape[0] - 1, _ROW_STEP)
    above, middle, below = (
        np.asarray(cv2.LUT(image[rows + shift, :, 1], _ROOTS), np.float32) for shift in (-1, 0, 1)
    )
    middle *= 2
    above -= middle
    above += below
    left, center, right = (above[:, shift : above.shape[1] - 2 + shift : _COLUMN_STEP] for shift in range(3))
    # The squared weights sum to 36, and half of a normal distribution lies within 0.6745 standard deviations.
    return float(np.median(np.abs(left - 2 * center + right))) / (6 * 0.6745)


def denoise(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Smooth a noisy image; return an image with little noise itself.

    >>> gray = np.full((90, 120, 3), 60, np.uint8)
    >>> denoise(gray) is gray
    True
    """
    weight = (estimate_noise(image) - _NOISE_MIN) / (_NOISE_FULL - _NOISE_MIN)
    if weight <= 0:
        return image
    weight = min(weight, 1.0)
    smooth = cv2.GaussianBlur(image, (5, 5), _SIGMA)
    return np.asarray(cv2.addWeighted(smooth, weight, image, 1 - weight, 0), np.uint8)
