"""Drawing of boxes: plain ones, those of labeled regions, and detections with their scores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    check_array,
    check_boxes,
    check_flags,
    check_image,
    check_integer,
    check_type,
    describe,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing.labels import LabelPlacer, LabelRequest, draw_labels
from vehicle_detection.drawing.primitives import Color, Image, draw_outline, line_width_for, round_box
from vehicle_detection.errors import InvalidInputError


def draw_boxes(
    image: Image, boxes: Detections | ArrayLike, *, color: Color = (0, 0, 255), thickness: int = 6
) -> Image:
    """Draw boxes on a copy of an image.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, or a list of ``((x1, y1), (x2, y2))`` as in the course; parts
        outside the image are clipped.
    color, thickness
        RGB, 0-255 each, and width in pixels of the lines, which lie inside the box.

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
    >>> import numpy as np
    >>> drawn = draw_boxes(np.zeros((40, 60, 3), np.uint8), [[10, 5, 30, 25]], thickness=1)
    >>> drawn[5, 10].tolist(), drawn[24, 29].tolist(), int(drawn.any(axis=2).sum())
    ([0, 0, 255], [0, 0, 255], 76)
    """
    result = check_image(image).copy()
    rgb = _check_color(color)
    width = check_integer(thickness, "thickness", low=1, high=10_000)
    for box in check_boxes(boxes):
        draw_outline(result, round_box(box), rgb, width)
    return result


def _check_color(color: Color) -> Color:
    """Return a color as Python's integers, which OpenCV needs."""
    if np.shape(check_array(color, "color")) != (3,):
        raise InvalidInputError(f"color must be (red, green, blue), 0-255 each; got {describe(color)}")
    red, green, blue = (check_integer(value, "color", low=0, high=255) for value in color)
    return red, green, blue


def score_texts(detections: Detections) -> list[str]:
    """Confidence of each detection, such as "87%"; or its score if the confidence is unknown."""
    known = detections.confidences
    return [f"{score:.2f}" for score in detections.scores] if known is None else [f"{p:.0%}" for p in known]


def draw_labeled_bboxes(image: Image, labels: tuple[NDArray[Any], int]) -> Image:
    """Draw the bounding box of each labeled region on a copy of an image, as the course does.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    labels
        The label array ``(H, W)`` and the number of regions, as ``scipy.ndimage.label`` returns them.

    Returns
    -------
    numpy.ndarray
        A new image of the same shape.

    Raises
    ------
    InvalidInputError
        If `labels` is not such a pair, or its array does not have the image's height and width.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import ndimage
    >>> heat = np.zeros((40, 60))
    >>> heat[10:30, 20:50] = 1
    >>> drawn = draw_labeled_bboxes(np.zeros((40, 60, 3), np.uint8), ndimage.label(heat))
    >>> np.argwhere(drawn.any(axis=2)).min(axis=0).tolist()
    [10, 20]
    """
    given: Any = labels
    if not isinstance(given, tuple) or len(given) != 2 or not isinstance(given[0], np.ndarray):
        raise InvalidInputError(
            f"labels must be the pair (label array, number of regions), got {describe(labels)}; "
            "pass what scipy.ndimage.label returns"
        )
    array, count = labels[0], check_integer(labels[1], "labels[1]", low=0)
    shape = check_image(image).shape[:2]
    if array.shape != shape or array.dtype.kind not in "iu":
        raise InvalidInputError(
            f"labels[0] must be integers of the image's shape {shape}, got {describe(array)}; "
            "label the heat map of this image"
        )
    from scipy.ndimage import find_objects

    regions = [region for region in find_objects(array, max_label=count) if region is not None]
    return draw_boxes(image, [[x.start, y.start, x.stop, y.stop] for y, x in regions])


def draw_detections(
    image: Image,
    detections: Detections,
    *,
    color: Color = (230, 159, 0),
    line_width: int | None = None,
    scores: bool = True,
) -> Image:
    """Draw detections on a copy of an image, each with its confidence or, if that is unknown, its score.

    Parameters
    ----------
    image, detections
        ``(H, W, 3)`` uint8 RGB, and its boxes with scores.
    color, line_width
        RGB, 0-255 each, and width of the lines in pixels; None: chosen for the size of the image.
    scores
        Whether to write them, where they hide neither other boxes nor each other.

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
    >>> import numpy as np
    >>> found = Detections([[40, 40, 90, 80]], [1.25])
    >>> drawn = draw_detections(np.zeros((90, 160, 3), np.uint8), found, scores=False)
    >>> np.argwhere(drawn.any(axis=2)).min(axis=0).tolist()
    [40, 40]
    """
    check_type(detections, "detections", Detections, "pass what detect returns")
    shape = check_image(image).shape
    check_flags(scores=scores)
    if line_width is not None:
        check_integer(line_width, "line_width", low=1, high=1000)
    width = line_width or line_width_for(shape)
    result = draw_boxes(image, detections.boxes, color=color, thickness=width)
    if scores:
        draw_texts(result, detections.boxes, score_texts(detections), _check_color(color), width)
    return result


def draw_texts(image: Image, boxes: Floats, texts: Sequence[str], color: Color, width: int) -> None:
    """Write a text at each box into an image, where they hide neither other boxes nor each other."""
    requests = [
        LabelRequest(row, (text,), round_box(box)) for row, (box, text) in enumerate(zip(boxes, texts))
    ]
    placed = LabelPlacer().place(requests, image.shape)
    draw_labels(image, placed, [color] * len(placed), width)
