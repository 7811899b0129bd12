"""Features of boxes: crops warped to a grid of cells, for box regression and rescoring."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.mixture.features import COARSE, N_CHANNELS, fhog_channels

CROP_CELLS = 12
"""Side in cells of the crops for regression and rescoring; the box fills the 8x8 cells in the middle."""

N_EDGE_FEATURES, N_COLOR_FEATURES = N_CHANNELS * CROP_CELLS**2, 3 * CROP_CELLS**2
"""Edge (FHOG) and color features of a crop."""

N_REGRESSION_FEATURES = N_EDGE_FEATURES + 4
"""Features of a crop for box regression."""

# Lower bound of the divisor of lightness, in addition to its standard deviation: noise is not amplified.
_LIGHTNESS_STD = 5

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]


def regression_features(image: Image, boxes: Floats) -> NDArray[np.float32]:
    """Features of boxes and their surroundings for box regression, ``(N, 28 * 12 * 12 + 4)``.

    The last four are the fractions of each box's width or height beyond the image's left, top, right and
    bottom border, which is replicated there.
    """
    features = np.empty((len(boxes), N_REGRESSION_FEATURES), np.float32)
    for row, crop in zip(features, _crops(image, boxes)):
        row[:-4] = _inner_channels(crop, COARSE).ravel()
    height, width = image.shape[:2]
    outside = np.hstack([-boxes[:, :2], boxes[:, 2:] - (width, height)])
    features[:, -4:] = np.clip(outside / np.tile(boxes[:, 2:] - boxes[:, :2], 2), 0, 1)
    return features


def rescoring_features(image: Image, boxes: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Edge and color features of boxes for rescoring, ``(N, 28 * 12 * 12)`` and ``(N, 3 * 12 * 12)``.

    Colors are CIELAB means of cells: lightness is standardized over the crop, a and b are divided by 20.
    """
    count = len(boxes)
    edges = np.empty((count, N_EDGE_FEATURES), np.float32)
    means = np.empty((count, CROP_CELLS, CROP_CELLS, 3), np.uint8)
    for row, mean, crop in zip(edges, means, _crops(image, boxes)):
        row[:] = _inner_channels(crop, COARSE).ravel()
        inner = crop[COARSE:-COARSE, COARSE:-COARSE]
        cv2.resize(inner, (CROP_CELLS, CROP_CELLS), mean, interpolation=cv2.INTER_AREA)
    if not count:
        return edges, np.empty((0, N_COLOR_FEATURES), np.float32)
    # One conversion for all crops, one below the other.
    values = means.reshape(-1, CROP_CELLS, 3).astype(np.float32) / 255
    lab = cv2.cvtColor(values, cv2.COLOR_RGB2LAB).reshape(count, -1, 3).transpose(2, 0, 1)
    lightness, a, b = lab
    std = lightness.std(axis=1, keepdims=True) + _LIGHTNESS_STD
    lightness = (lightness - lightness.mean(axis=1, keepdims=True)) / std
    return edges, np.hstack([lightness, a / 20, b / 20], dtype=np.float32)


def crop_channels(
    image: Image, box: Sequence[float], box_cells: tuple[float, float], cells: tuple[int, int], cell: int
) -> NDArray[np.float32]:
    """FHOG channels of one box and its surroundings, ``(28, rows, columns)``.

    The box ``(x1, y1, x2, y2)`` fills `box_cells` (columns, rows) in the middle of a grid of `cells`
    (columns, rows), each with a side of `cell` pixels in the warped crop.
    """
    return _inner_channels(_crop(image, box, box_cells, cells, cell), cell)


def _crops(image: Image, boxes: Floats) -> Iterator[Image]:
    """Crops of coarse cells for regression and rescoring."""
    for box in boxes.tolist():
        yield _crop(image, box, (8.0, 8.0), (CROP_CELLS, CROP_CELLS), COARSE)


def _inner_channels(crop: Image, cell: int) -> NDArray[np.float32]:
    """FHOG channels of a crop without its outermost cells."""
    return fhog_channels(crop, cell)[:, 1:-1, 1:-1]


def _crop(
    image: Image, box: Sequence[float], box_cells: tuple[float, float], cells: tuple[int, int], cell: int
) -> Image:
    """Warp a box to a grid of cells, with one more cell on each side as context for the normalization."""
    x1, y1, x2, y2 = box
    step_x, step_y = (x2 - x1) / box_cells[0], (y2 - y1) / box_cells[1]
    columns, rows = cells[0] + 2, cells[1] + 2
    left = x1 - (columns - box_cells[0]) / 2 * step_x
    top = y1 - (rows - box_cells[1]) / 2 * step_y
    return _warp(image, (left, top), (step_x / cell, step_y / cell), (columns * cell, rows * cell))


def _warp(
    image: Image, corner: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> Image:
    """Resample ``size * scale`` pixels from `corner` on to `size` (width, height), without aliasing."""
    origin, step = np.array(corner), np.array(scale)
    if step.max() > 1.5:
        # The warp interpolates between four pixels only, so reduce the region by area averaging first.
        low = np.clip(np.floor(origin), 0, None).astype(int)
        high = np.clip(np.ceil(origin + step * size), 0, image.shape[1::-1]).astype(int)
        if (high - low >= 2).all():
            region = image[low[1] : high[1], low[0] : high[0]]
            reduced = np.maximum(np.rint((high - low) / np.maximum(step, 1)), 1).astype(int)
            small = cv2.resize(region, (int(reduced[0]), int(reduced[1])), interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
            factor = (high - low) / reduced
            origin, step = (origin - low) / factor, step / factor
    shift = origin + step / 2 - 0.5
    matrix = np.array([[step[0], 0, shift[0]], [0, step[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)
