"""Features of boxes: grids of cells around each box, for training and rescoring."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels import cell_means
from vehicle_detection.mixture.features import N_CHANNELS, CellGrid, EdgePyramid

CROP_CELLS = 12
"""Side in cells of the crops for rescoring; the box fills the 8x8 cells in the middle."""

N_EDGE_FEATURES, N_COLOR_FEATURES = N_CHANNELS * CROP_CELLS**2, 3 * CROP_CELLS**2
"""Edge (FHOG) and color features of a crop."""

_BOX_CELLS = (8.0, 8.0)
# Lower bound of the divisor of lightness, in addition to its standard deviation: noise is not amplified.
_LIGHTNESS_STD = 5

Floats = NDArray[np.float64]


def edge_features(pyramid: EdgePyramid, boxes: Floats) -> NDArray[np.float32]:
    """FHOG channels of boxes and their surroundings, ``(N, 20 * 12 * 12)``."""
    grids = _grids(boxes, _BOX_CELLS, (CROP_CELLS, CROP_CELLS))
    return pyramid.crops(grids, CROP_CELLS, CROP_CELLS).reshape(len(boxes), N_EDGE_FEATURES)


def rescoring_features(
    pyramid: EdgePyramid, boxes: Floats
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Edge and color features of boxes for rescoring, ``(N, 20 * 12 * 12)`` and ``(N, 3 * 12 * 12)``.

    Colors are CIELAB means of cells: lightness is standardized over the crop, a and b are divided by 20.
    """
    count = len(boxes)
    edges = edge_features(pyramid, boxes)
    if not count:
        return edges, np.empty((0, N_COLOR_FEATURES), np.float32)
    means = np.empty((count, CROP_CELLS, CROP_CELLS, 3), np.float32)
    grids = _grids(boxes, _BOX_CELLS, (CROP_CELLS, CROP_CELLS))
    # Means need less detail than edges do: cells of two to six pixels a side.
    numbers = np.array([pyramid.octave_of(size) for size in 2 * np.sqrt(grids[:, 2] * grids[:, 3])], np.intp)
    for number in np.unique(numbers).tolist():
        chosen = np.flatnonzero(numbers == number)
        found = np.empty((len(chosen), *means.shape[1:]), np.float32)
        cell_means(pyramid.octaves[number].planes, grids[chosen] / 2**number, found)
        means[chosen] = found
    # One conversion for all crops, one below the other.
    values = means.reshape(-1, CROP_CELLS, 3) / 255
    lab = cv2.cvtColor(values, cv2.COLOR_RGB2LAB).reshape(count, -1, 3).transpose(2, 0, 1)
    lightness, a, b = lab
    std = lightness.std(axis=1, keepdims=True) + _LIGHTNESS_STD
    lightness = (lightness - lightness.mean(axis=1, keepdims=True)) / std
    return edges, np.hstack([lightness, a / 20, b / 20], dtype=np.float32)


def window_grid(box: Sequence[float], box_cells: tuple[float, float], cells: tuple[int, int]) -> CellGrid:
    """Grid of `cells` (columns, rows) in whose middle a box ``(x1, y1, x2, y2)`` fills `box_cells`."""
    ((left, top, step_x, step_y),) = _grids(np.array([box], np.float64), box_cells, cells).tolist()
    return CellGrid(left, top, step_x, step_y, cells[1], cells[0])


def _grids(boxes: Floats, box_cells: tuple[float, float], cells: tuple[int, int]) -> Floats:
    """Grids of `cells` (columns, rows) in whose middle a box fills `box_cells`: left, top and cell size."""
    steps = (boxes[:, 2:] - boxes[:, :2]) / box_cells
    corners = boxes[:, :2] - (np.array(cells) - box_cells) / 2 * steps
    return np.hstack([corners, steps])
