"""Haze: its estimate, and the equalization of hazy frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.mixture.denoise import denoise

# Relative contrast from which downwards a frame is equalized, and from which on fully. Dash-cam frames in
# clear weather, in rain and at night are above 0.025, three of four frames in fog are below 0.021.
_CLEAR, _HAZY = 0.03, 0.02
# Equalization: limit of the slope of the tone curve, and tiles across and down.
_CLIP_LIMIT, _TILES = 2.0, (8, 8)
# Sampling of the estimate: rows, and columns of blocks across the frame.
_ROW_STEP, _BLOCKS = 16, 160


def relative_contrast(image: NDArray[np.uint8]) -> float:
    """Mean difference of neighboring blocks of the green channel, divided by their mean.

    Haze scatters light toward the camera: it adds brightness and takes contrast (Koschmieder's law). A dark
    frame loses both. The value is 1 for an image too small to tell.

    >>> checks = np.kron(np.indices((90, 160)).sum(axis=0) % 2, np.ones((8, 8)))[..., None] * np.ones(3)
    >>> clear, hazy = (np.uint8(low + 60 * checks) for low in (20, 180))
    >>> round(relative_contrast(clear), 1), round(relative_contrast(hazy), 1)
    (1.2, 0.3)
    """
    size = max(image.shape[1] // _BLOCKS, 1)
    count = image.shape[1] // size
    rows = image[_ROW_STEP // 2 :: _ROW_STEP, : count * size, 1]
    if not rows.size or count < 2:
        return 1.0
    sums = np.zeros((len(rows), count), np.uint32)
    for column in range(size):
        sums += rows[:, column::size]
    blocks = (sums / size).astype(np.float32)
    return float(np.abs(np.diff(blocks, axis=1)).mean() / (blocks.mean() + 1))


def reduce_haze(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Equalize the lightness of a hazy image locally; return a clear image itself.

    Contrast-limited adaptive histogram equalization: Zuiderveld, in "Graphics Gems IV" (1994), chapter
    VIII.5.

    >>> gray = np.full((90, 120, 3), 60, np.uint8)
    >>> reduce_haze(gray) is gray
    False
    """
    weight = min((_CLEAR - relative_contrast(image)) / (_CLEAR - _HAZY), 1.0)
    if weight <= 0:
        return image
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(_CLIP_LIMIT, _TILES).apply(lab[..., 0])
    equalized = cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)
    return np.asarray(cv2.addWeighted(equalized, weight, image, 1 - weight, 0), np.uint8)


def prepare(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Remove sensor noise and haze; return an image without them itself."""
    return reduce_haze(denoise(image))
