"""Blurring of vehicles or of the region of their license plates."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_choice, check_image
from vehicle_detection.boxes import Detections

BLUR_REGIONS = ("vehicles", "plates")
"""What `blur_boxes` can blur."""

# Margin around a box, as a fraction of its sides: boxes and predictions have errors.
_MARGIN = 0.08
# Cells that remain across the longer side of a vehicle and of a plate's region: a plate is 1/4 of a vehicle
# wide, and has at most two cells.
_CELLS = {"vehicles": 8, "plates": 6}
# Region of the plate in the box of a vehicle seen from behind or in front, as fractions of its sides. Wider
# boxes show the side too, so that the plate may be at either end.
_PLATE_ROWS, _PLATE_COLUMNS, _SIDE_ASPECT = (0.4, 1.0), (0.12, 0.88), 1.5


def blur_boxes(
    image: NDArray[np.uint8], boxes: Detections | ArrayLike, *, region: str = "vehicles"
) -> NDArray[np.uint8]:
    """Blur the vehicles in boxes, or the region of their license plates, on a copy of an image.

    The region is reduced to a few averaged cells, from which no characters can be recovered.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]`` of vehicles; parts outside the image are clipped.
    region
        ``"vehicles"``: the whole boxes and a margin of 8%. ``"plates"``: the lower part of each box, where a
        plate is; it is not searched for.

    Returns
    -------
    numpy.ndarray
        A new image of the same shape.

    Raises
    ------
    InvalidInputError
        If an argument is malformed.

    Examples
    --------
    >>> image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    >>> blurred = blur_boxes(image, [[20, 10, 60, 50]])
    >>> bool(blurred[20:40, 30:50].std() < 0.3 * image.std()), bool((blurred[:, :10] == image[:, :10]).all())
    (True, True)
    """
    result = check_image(image).copy()
    check_choice(region, "region", BLUR_REGIONS)
    height, width = result.shape[:2]
    for x1, y1, x2, y2 in _regions(check_boxes(boxes).astype(np.float64), region).tolist():
        left, top = max(int(np.floor(x1)), 0), max(int(np.floor(y1)), 0)
        right, bottom = min(int(np.ceil(x2)), width), min(int(np.ceil(y2)), height)
        if right > left and bottom > top:
            view = result[top:bottom, left:right]
            cell = max(x2 - x1, y2 - y1, 1.0) / _CELLS[region]
            view[:] = _average_cells(view, cell)
    return result


def _regions(boxes: NDArray[np.float64], region: str) -> NDArray[np.float64]:
    """Regions to blur, which may extend beyond the image."""
    sides = boxes[:, 2:] - boxes[:, :2]
    if region == "plates":
        frontal = sides[:, 0] < _SIDE_ASPECT * sides[:, 1]
        columns = np.where(frontal[:, None], _PLATE_COLUMNS, (0.0, 1.0))
        x = boxes[:, :1] + columns * sides[:, :1]
        y = boxes[:, 1:2] + np.array(_PLATE_ROWS) * sides[:, 1:]
        boxes = np.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], axis=1)
    return boxes + _MARGIN * np.tile(sides, 2) * (-1, -1, 1, 1)


def _average_cells(view: NDArray[np.uint8], cell: float) -> NDArray[np.uint8]:
    """Average square cells of an image, and interpolate between them."""
    height, width = view.shape[:2]
    size = tuple(min(max(round(side / cell), 1), side) for side in (width, height))
    cells = cv2.resize(view, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
