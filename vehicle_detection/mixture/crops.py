"""Features of boxes: grids of cells around each box, for training and rescoring."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection._kernels import cell_means
from vehicle_detection.mixture.features import N_CHANNELS, CellGrid, EdgePyramid

CROP_CELLS = 12
"""Side in cells of the crops for rescoring; the box fills the 8x8 cells in the middle."""

N_EDGE_FEATURES = N_CHANNELS * CROP_CELLS**2
"""Edge features (FHOG) of a crop."""

N_INPUTS = N_CHANNELS + 3
"""Channels of a crop for rescoring: edges and colors."""

EDGE_OFFSET = -0.5
"""Input for rescoring where there is no edge."""

_BOX_CELLS = (8.0, 8.0)
# Lower bound of the divisor of lightness, in addition to its standard deviation: noise is not amplified.
_LIGHTNESS_STD = 5
# Range of edges to about 0 to 2, and of lightness, a and b to about -1 to 1.
_EDGE_SCALE, _COLOR_UNITS = 5, (np.float32(2), np.float32(40), np.float32(40))


def edge_features(pyramid: EdgePyramid, boxes: Floats) -> NDArray[np.float32]:
    """FHOG channels of boxes and their surroundings, ``(N, 20 * 12 * 12)``, see `EdgePyramid.crops`."""
    grids = _grids(boxes, _BOX_CELLS, (CROP_CELLS, CROP_CELLS))
    return pyramid.crops(grids, CROP_CELLS, CROP_CELLS).reshape(len(boxes), N_EDGE_FEATURES)


def rescoring_inputs(pyramid: EdgePyramid, boxes: Floats) -> NDArray[np.float32]:
    """Edges and colors of boxes and their surroundings for rescoring: ``(12 rows, 23, 12 columns, N)``.

    Edges are FHOG channels from about -0.5 to 1.5. Colors are CIELAB means of cells, from about -1 to 1:
    lightness is standardized over the crop, a and b are divided by 40. The boxes come last because vectors of
    numbers of several boxes are faster. With a workspace for the pyramid, the inputs are valid until the next
    call in the same thread.
    """
    count = len(boxes)
    inputs = pyramid.workspace.take((CROP_CELLS, N_INPUTS, CROP_CELLS, count), np.float32, "inputs")
    if not count:
        return inputs
    grids = _grids(boxes, _BOX_CELLS, (CROP_CELLS, CROP_CELLS))
    edges, colors = inputs[:, :N_CHANNELS], inputs[:, N_CHANNELS:]
    channels = pyramid.crops(grids, CROP_CELLS, CROP_CELLS)
    np.multiply(channels.transpose(2, 1, 3, 0), np.float32(_EDGE_SCALE), out=edges)
    edges += np.float32(EDGE_OFFSET)
    means = np.empty((count, CROP_CELLS, CROP_CELLS, 3), np.float32)
    # Means need less detail than edges do: cells of two to six pixels a side.
    for number, chosen in pyramid.by_octave(2 * np.sqrt(grids[:, 2] * grids[:, 3])):
        cell_means(pyramid.octaves[number].planes, grids / 2**number, chosen, means)
    means /= 255
    # One conversion for all crops, one below the other.
    lab = cv2.cvtColor(means.reshape(-1, CROP_CELLS, 3), cv2.COLOR_RGB2LAB)
    lightness, *others = np.ascontiguousarray(lab.reshape(count, -1, 3).transpose(2, 0, 1))
    std = lightness.std(axis=1, keepdims=True) + np.float32(_LIGHTNESS_STD)
    lightness -= lightness.mean(axis=1, keepdims=True)
    lightness /= std
    for number, (values, unit) in enumerate(zip((lightness, *others), _COLOR_UNITS)):
        np.divide(values.reshape(count, CROP_CELLS, -1).transpose(1, 2, 0), unit, out=colors[:, number])
    return inputs


def window_grid(box: Sequence[float], box_cells: tuple[float, float], cells: tuple[int, int]) -> CellGrid:
    """Grid of `cells` (columns, rows) in whose middle a box ``(x1, y1, x2, y2)`` fills `box_cells`."""
    ((left, top, step_x, step_y),) = _grids(np.array([box], np.float64), box_cells, cells).tolist()
    return CellGrid(left, top, step_x, step_y, cells[1], cells[0])


def _grids(boxes: Floats, box_cells: tuple[float, float], cells: tuple[int, int]) -> Floats:
    """Grids of `cells` (columns, rows) in whose middle a box fills `box_cells`: left, top and cell size."""
    steps = (boxes[:, 2:] - boxes[:, :2]) / box_cells
    corners = boxes[:, :2] - (np.array(cells) - box_cells) / 2 * steps
    return np.hstack([corners, steps])
