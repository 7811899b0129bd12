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
# Median of the differences at a noise of 1: the squared weights sum to 36, and half of a normal distribution
# lies within 0.6745 standard deviations.
_MEDIAN = 6 * 0.6745

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
    return _noise_of(_differences(image))


def denoise(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Smooth a noisy image; return an image with little noise itself.

    >>> gray = np.full((90, 120, 3), 60, np.uint8)
    >>> denoise(gray) is gray
    True
    """
    # Counting takes less time than the median, and usually suffices.
    differences = _differences(image)
    if 2 * np.count_nonzero(differences > _NOISE_MIN * _MEDIAN) < differences.size:
        return image
    weight = (_noise_of(differences) - _NOISE_MIN) / (_NOISE_FULL - _NOISE_MIN)
    if weight <= 0:
        return image
    weight = min(weight, 1.0)
    smooth = cv2.GaussianBlur(image, (5, 5), _SIGMA)
    return np.asarray(cv2.addWeighted(smooth, weight, image, 1 - weight, 0), np.uint8)


def _noise_of(differences: NDArray[np.float32]) -> float:
    return float(np.median(differences)) / _MEDIAN if differences.size else 0.0


def _differences(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Absolute differences of the Laplacians at some pixels; none for fewer than three rows or columns."""
    height, width = image.shape[0] - 2, image.shape[1] - 2
    if height < 1 or width < 1:
        return np.empty((0, 0), np.float32)
    # Slices are copied first: OpenCV takes longer for pixels that are not side by side.
    above, middle, below = (
        np.asarray(cv2.LUT(image[top : top + height : _ROW_STEP, :, 1].copy(), _ROOTS), np.float32)
        for top in range(3)
    )
    middle *= 2
    above -= middle
    above += below
    left, center, last = (above[:, first : first + width : _COLUMN_STEP] for first in range(3))
    return np.asarray(np.abs(left - 2 * center + last))
