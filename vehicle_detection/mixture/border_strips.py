"""Maps next to the left and right border of a frame, for vehicles that it cuts.

Of a vehicle that comes into the picture only a part is seen, and the part ends at the border. A template of
such parts is compared with the columns of cells next to the border alone; at the left border they are turned
round, so that one template serves both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.mixture.features import FeatureMap, mirror_planes


def border_strip(level: FeatureMap, columns: int, end: float, *, left: bool) -> NDArray[np.float32] | None:
    """Take the columns of a map that end at a border, turned so that it is at their right.

    Parameters
    ----------
    level
        The map.
    columns
        Number of columns.
    end
        Place of the border in pixels of the frame; the nearest border of cells is taken.
    left
        Whether the frame lies at the right of it.

    Returns
    -------
    numpy.ndarray or None
        ``(28, rows, columns)`` float32; None where the map has too few columns.
    """
    first = round((end - level.left) / level.step_x) - (0 if left else columns)
    if first < 0 or first + columns > level.planes.shape[2]:
        return None
    strip = level.planes[:, :, first : first + columns]
    return mirror_planes(strip) if left else np.ascontiguousarray(strip)


def strip_boxes(
    level: FeatureMap,
    rows: NDArray[np.intp],
    end: float,
    *,
    left: bool,
    cells: tuple[float, float],
    above: float,
) -> NDArray[np.float64]:
    """Boxes of windows of a strip, in pixels of the frame, ``(N, 4)``: each ends at the border.

    Parameters
    ----------
    level
        The map of which the strip was taken.
    rows
        First row of cells of each window.
    end, left
        As for `border_strip`.
    cells
        Columns and rows of cells that a box fills.
    above
        Rows of cells of a window above its box.
    """
    width = cells[0] * level.step_x
    top = level.top + (rows + above) * level.step_y
    boxes = np.empty((len(rows), 4))
    boxes[:, 0], boxes[:, 2] = (end, end + width) if left else (end - width, end)
    boxes[:, 1], boxes[:, 3] = top, top + cells[1] * level.step_y
    return boxes
