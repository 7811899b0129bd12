"""Boxes and their surroundings, warped to grids of cells: edge and color features."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.mixture.features import COARSE, PLANES, feature_planes

CROP = 12
"""Cells of a side of the crop that corrects a box: the box fills 8 of them."""

CROP_LENGTH = PLANES * CROP * CROP + 4
"""Features of a crop."""

EDGES, COLORS = PLANES * CROP * CROP, 3 * CROP * CROP
"""Values of a crop's edges, and of its colors."""

_INSIDE = (8.0, 8.0)

Floats = NDArray[np.float64]


def crop_features(image: NDArray[np.uint8], boxes: Floats) -> NDArray[np.float32]:
    """Features of boxes and what is around them, each warped to 12x12 cells of which the box fills 8x8.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    boxes
        ``(N, 4)``, with any part outside.

    Returns
    -------
    numpy.ndarray
        ``(N, 28 * 12 * 12 + 4)`` float32; the last four tell by how much of its sides a box lies outside.
    """
    features = np.empty((len(boxes), CROP_LENGTH), np.float32)
    height, width = image.shape[:2]
    for row, (x1, y1, x2, y2) in zip(features, boxes):
        row[:-4] = box_planes(image, (x1, y1, x2, y2), _INSIDE, (CROP, CROP), COARSE).ravel()
        outside = (-x1 / (x2 - x1), -y1 / (y2 - y1), (x2 - width) / (x2 - x1), (y2 - height) / (y2 - y1))
        row[-4:] = np.clip(outside, 0, 1)
    return features


def crop_views(image: NDArray[np.uint8], boxes: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Edges and colors of boxes and what is around them, of the same 12x12 cells as in `crop_features`.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB; beyond its border the outermost pixels go on.
    boxes
        ``(N, 4)``, with any part outside.

    Returns
    -------
    tuple of numpy.ndarray
        ``(N, 28 * 12 * 12)`` and ``(N, 3 * 12 * 12)`` float32. The colors are the mean lightness of each
        cell, by how many standard deviations it is above the crop's, and its CIELAB a and b in steps of 20.
    """
    count = len(boxes)
    edges = np.empty((count, EDGES), np.float32)
    means = np.empty((count, CROP, CROP, 3), np.uint8)
    for row, mean, box in zip(edges, means, boxes):
        patch = _around(image, box.tolist(), _INSIDE, (CROP, CROP), COARSE)
        row[:] = _planes(patch, COARSE).ravel()
        cv2.resize(patch[COARSE:-COARSE, COARSE:-COARSE], (CROP, CROP), mean, interpolation=cv2.INTER_AREA)
    if not count:
        return edges, np.empty((0, COLORS), np.float32)
    # All crops at once, one below the other.
    values = means.reshape(-1, CROP, 3).astype(np.float32) / 255
    lab = cv2.cvtColor(values, cv2.COLOR_RGB2LAB).reshape(count, -1, 3).transpose(2, 0, 1)
    lightness, a, b = lab
    # Of a plain crop the noise is not stretched to full contrast.
    spread = lightness.std(axis=1, keepdims=True) + 5
    lightness = (lightness - lightness.mean(axis=1, keepdims=True)) / spread
    return edges, np.hstack([lightness, a / 20, b / 20], dtype=np.float32)


def box_planes(
    image: NDArray[np.uint8],
    box: Sequence[float],
    inside: tuple[float, float],
    cells: tuple[int, int],
    cell: int,
) -> NDArray[np.float32]:
    """Compute the features of one box, warped to a grid of cells with what is around it.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    box
        ``(x1, y1, x2, y2)``.
    inside
        Columns and rows of cells that the box fills.
    cells
        Columns and rows of the grid, around the same center.
    cell
        Side of a cell in pixels of the warped box.

    Returns
    -------
    numpy.ndarray
        ``(28, rows, columns)`` float32.
    """
    return _planes(_around(image, box, inside, cells, cell), cell)


def _planes(patch: NDArray[np.uint8], cell: int) -> NDArray[np.float32]:
    return feature_planes(patch, cell)[:, 1:-1, 1:-1]


def _around(
    image: NDArray[np.uint8],
    box: Sequence[float],
    inside: tuple[float, float],
    cells: tuple[int, int],
    cell: int,
) -> NDArray[np.uint8]:
    """Warp a box to a grid of cells, with one more on each side.

    So the normalization of the outermost one sees its neighbors.
    """
    x1, y1, x2, y2 = box
    step_x, step_y = (x2 - x1) / inside[0], (y2 - y1) / inside[1]
    columns, rows = cells[0] + 2, cells[1] + 2
    left = x1 - (columns - inside[0]) / 2 * step_x
    top = y1 - (rows - inside[1]) / 2 * step_y
    return _warp(image, (left, top), (step_x / cell, step_y / cell), (columns * cell, rows * cell))


def _warp(
    image: NDArray[np.uint8], corner: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> NDArray[np.uint8]:
    """Take ``size * scale`` pixels of an image from `corner` on as an image of `size`, without aliasing."""
    origin, real = np.array(corner), np.array(scale)
    if real.max() > 1.5:
        # Reduce the part first: the warp alone looks at four pixels only.
        low = np.clip(np.floor(origin), 0, None).astype(int)
        high = np.clip(np.ceil(origin + real * size), 0, image.shape[1::-1]).astype(int)
        if (high - low >= 2).all():
            part = image[low[1] : high[1], low[0] : high[0]]
            reduced = np.maximum(np.rint((high - low) / np.maximum(real, 1)), 1).astype(int)
            small = cv2.resize(part, (int(reduced[0]), int(reduced[1])), interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
            factor = (high - low) / reduced
            origin, real = (origin - low) / factor, real / factor
    shift = origin + real / 2 - 0.5
    matrix = np.array([[real[0], 0, shift[0]], [0, real[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)
