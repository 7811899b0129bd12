"""The course's search as the reference of the speed comparison, independent of the library.

For each scale, scikit-image computes the HOG of the whole band once. Then, for each window, its HOG blocks
are cropped, its spatial bins and histograms computed, and scaler and classifier called. The features are
those of the course's third system: YCrCb, 32x32 spatial bins, 32 histogram bins, HOG of all channels with 9
orientations, 8 pixels per cell and 2 cells per block; 8460 values.

Unlike in the course, the band is resized before its colors are converted, so that rounding gives the same
pixels in both searches. The cost is the same.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.feature import hog

from vehicle_detection.search import PixelBand

WINDOW, CELL, BLOCK, ORIENT = 64, 8, 2, 9
SPATIAL, BINS = (32, 32), 32
BLOCKS = WINDOW // CELL - BLOCK + 1


@dataclass(frozen=True)
class CourseSearch:
    """All windows of a frame, ordered by band and row, and the seconds that their HOG took."""

    boxes: NDArray[np.float64]  # (N, 4) in pixels of the frame
    scores: NDArray[np.float64]  # (N,)
    hog_seconds: float


def search_course(
    frame: NDArray[np.uint8], bands: Sequence[PixelBand], scaler: Any, svc: Any
) -> CourseSearch:
    """Score every window of the bands at a step of one cell."""
    boxes: list[tuple[float, float, float, float]] = []
    scores: list[float] = []
    hog_seconds = 0.0
    for band in bands:
        strip = frame[band.y1 : band.y2, band.x1 : band.x2]
        width = round(strip.shape[1] * WINDOW / band.window[0])
        height = round(strip.shape[0] * WINDOW / band.window[1])
        scale_x, scale_y = strip.shape[1] / width, strip.shape[0] / height
        if strip.shape[:2] != (height, width):
            strip = np.asarray(cv2.resize(strip, (width, height)), np.uint8)
        converted = np.asarray(cv2.cvtColor(strip, cv2.COLOR_RGB2YCrCb), np.uint8)

        began = time.perf_counter()
        hogs = [hog_of(converted[:, :, channel]) for channel in range(3)]
        hog_seconds += time.perf_counter() - began

        for row in range(height // CELL - WINDOW // CELL + 1):
            for column in range(width // CELL - WINDOW // CELL + 1):
                blocks = [h[row : row + BLOCKS, column : column + BLOCKS].ravel() for h in hogs]
                x, y = column * CELL, row * CELL
                patch = converted[y : y + WINDOW, x : x + WINDOW]
                vector: NDArray[np.float64] = np.concatenate(
                    (spatial_of(patch), histogram_of(patch), *blocks)
                )
                scaled = scaler.transform(vector.reshape(1, -1))
                scores.append(svc.decision_function(scaled)[0])
                left, top = band.x1 + x * scale_x, band.y1 + y * scale_y
                boxes.append((left, top, left + WINDOW * scale_x, top + WINDOW * scale_y))
    return CourseSearch(np.array(boxes), np.array(scores), hog_seconds)


def hog_of(channel: NDArray[np.uint8]) -> NDArray[np.float64]:
    """HOG of one channel, ``(block rows, block columns, 2, 2, 9)``."""
    blocks: NDArray[np.float64] = hog(
        channel,
        orientations=ORIENT,
        pixels_per_cell=(CELL, CELL),
        cells_per_block=(BLOCK, BLOCK),
        block_norm="L2-Hys",
        feature_vector=False,
    )
    return blocks


def spatial_of(patch: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Spatial bins, channel by channel."""
    small = cv2.resize(patch, SPATIAL)
    return np.concatenate([small[:, :, channel].ravel() for channel in range(3)])


def histogram_of(patch: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Histograms of the three channels."""
    return np.concatenate(
        [np.histogram(patch[:, :, channel], bins=BINS, range=(0, 256))[0] for channel in range(3)]
    )
