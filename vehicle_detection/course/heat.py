"""Heat maps in place, and drawing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection import heatmap as library
from vehicle_detection._common import (
    check_array,
    check_integer,
    describe,
)
from vehicle_detection.course.checks import Image, check_lesson_image, corner_array
from vehicle_detection.errors import InvalidInputError

_BLUE = (0, 0, 255)
_THICKNESS = 6


def add_heat(heatmap: NDArray[Any], bbox_list: Any) -> NDArray[Any]:
    """Add 1 to the pixels of each box, in place: `add_heat` of the main API for corner pairs.

    Parameters
    ----------
    heatmap
        ``(H, W)``; changed.
    bbox_list
        Corner pairs, an ``(N, 4)`` array, or `Detections`; parts outside the map are cut off.

    Returns
    -------
    numpy.ndarray
        The same array, `heatmap`.

    Raises
    ------
    InvalidInputError
        If the map is not a writable 2-D array of numbers or the boxes are malformed.

    Examples
    --------
    >>> heat = np.zeros((2, 4))
    >>> add_heat(heat, [((0, 0), (2, 2)), ((1, 0), (3, 1))]) is heat
    True
    >>> heat
    array([[1., 2., 1., 0.],
           [1., 1., 0., 0.]])
    """
    return library.add_heat(heatmap, corner_array(bbox_list, "bbox_list"))


apply_threshold = library.apply_threshold


def draw_boxes(img: Image, bboxes: Any, color: Sequence[float] = _BLUE, thick: int = _THICKNESS) -> Image:
    """Draw boxes on a copy of an image; the lines are centered on the box's edges, as by ``cv2.rectangle``.

    Parameters
    ----------
    img
        ``(H, W, 3)``, uint8 or float.
    bboxes
        Corner pairs, an ``(N, 4)`` array, or `Detections`.
    color
        RGB, 0-255 each.
    thick
        Width of the lines in pixels; -1 fills the boxes.

    Returns
    -------
    numpy.ndarray
        A new image of the same dtype.

    Examples
    --------
    >>> drawn = draw_boxes(np.zeros((40, 60, 3), np.uint8), [((10, 5), (30, 25))], thick=1)
    >>> drawn[25, 30].tolist()
    [0, 0, 255]
    """
    check_lesson_image(img)
    result: Image = np.array(img, order="C")
    _draw(result, corner_array(bboxes, "bboxes"), color, thick)
    return result


def draw_labeled_bboxes(img: Image, labels: Any) -> Image:
    """Draw the bounding box of each labeled region on the image itself.

    Parameters
    ----------
    img
        ``(H, W, 3)``, uint8 or float; changed.
    labels
        The label array ``(H, W)`` and the number of regions, as ``scipy.ndimage.label`` returns them.

    Returns
    -------
    numpy.ndarray
        The same array, `img`, with blue rectangles, 6 pixels thick. Their corners are a region's first and
        last pixels, so they are one pixel smaller than the half-open boxes of the main API.

    Raises
    ------
    InvalidInputError
        If the image is read-only or its rows are not contiguous, or `labels` is not such a pair for its size.

    Examples
    --------
    >>> from scipy.ndimage import label
    >>> heat = np.zeros((40, 60))
    >>> heat[10:30, 20:50] = 1
    >>> image = np.zeros((40, 60, 3), np.uint8)
    >>> draw_labeled_bboxes(image, label(heat)) is image, image[29, 49].tolist()
    (True, [0, 0, 255])
    """
    from scipy.ndimage import find_objects

    check_lesson_image(img)
    rows = img.strides[0] > 0 and img.strides[1:] == (3 * img.itemsize, img.itemsize)
    array, count = labels if isinstance(labels, (tuple, list)) and len(labels) == 2 else (None, 0)
    if not isinstance(array, np.ndarray) or array.shape != img.shape[:2] or array.dtype.kind not in "iu":
        raise InvalidInputError(
            f"labels must be the pair that scipy.ndimage.label returns for a map of {img.shape[:2]}; "
            f"got {describe(labels)}"
        )
    regions = find_objects(array, max_label=check_integer(count, "the number of labels", low=0))
    corners = [[x.start, y.start, x.stop - 1, y.stop - 1] for y, x in filter(None, regions)]
    if corners and not (img.flags.writeable and rows):
        raise InvalidInputError("img must be writable and contiguous to be drawn on; pass numpy.copy(img)")
    _draw(img, corner_array(corners, "labels"), _BLUE, _THICKNESS)
    return img


def _draw(image: Image, corners: NDArray[np.int64], color: Sequence[float], thick: int) -> None:
    given = check_array(color, "color")
    if given.shape not in ((), (3,)) or given.dtype.kind not in "iuf" or not np.isfinite(given).all():
        raise InvalidInputError(f"color must be (red, green, blue); got {describe(color)}")
    values = [float(given), 0.0, 0.0] if given.ndim == 0 else given.astype(float).tolist()
    check_integer(thick, "thick", low=-1)
    for x1, y1, x2, y2 in corners.tolist():
        cv2.rectangle(image, (x1, y1), (x2, y2), values, thick)
