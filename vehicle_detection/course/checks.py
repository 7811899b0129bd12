"""Argument checks of the lesson functions, which accept more forms than the main API."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_array,
    check_integer,
    check_number,
    describe,
)
from vehicle_detection.errors import InvalidInputError

Image = NDArray[Any]


def check_lesson_image(img: Any, name: str = "img", *, drop_alpha: bool = False) -> Image:
    """Return an ``(H, W, 3)`` image as uint8 or float32; `drop_alpha` accepts a fourth channel."""
    has_alpha = isinstance(img, np.ndarray) and img.ndim == 3 and img.shape[2] == 4
    if has_alpha and drop_alpha:
        img = np.ascontiguousarray(img[..., :3])
    elif has_alpha:
        raise InvalidInputError(
            f"{name} must be an (H, W, 3) RGB array, got {describe(img)}; drop the alpha channel with "
            f"{name}[..., :3]"
        )
    if not isinstance(img, np.ndarray) or img.ndim != 3 or img.shape[2] != 3 or not img.size:
        raise InvalidInputError(f"{name} must be an (H, W, 3) RGB array; got {describe(img)}")
    if img.dtype in (np.uint8, np.float32):
        return img
    if img.dtype.kind != "f":
        raise InvalidInputError(
            f"{name} must be uint8 or float, got {img.dtype}; convert it with {name}.astype(numpy.uint8)"
        )
    return img.astype(np.float32)


def check_size(size: Any, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of a pair or of one number."""
    pair = (size, size) if check_array(size, name).ndim == 0 else tuple(size)
    if len(pair) != 2:
        raise InvalidInputError(f"{name} must be (width, height); got {describe(size)}")
    return check_integer(pair[0], name, low=1), check_integer(pair[1], name, low=1)


def check_range(limits: Any, name: str) -> tuple[float, float] | None:
    """Return the range of a histogram; None stands for the range of the values."""
    if limits is None:
        return None
    if check_array(limits, name).shape != (2,):
        raise InvalidInputError(f"{name} must be (low, high) or None; got {describe(limits)}")
    low = check_number(limits[0], name)
    return low, check_number(limits[1], name, above=low)


def box_rows(boxes: Any) -> Any:
    """Return the boxes of `Detections` or ``supervision.Detections``, other values as they are."""
    boxes = getattr(boxes, "boxes", boxes)
    return getattr(boxes, "xyxy", boxes)


def _contains_image(rows: Any) -> bool:
    """Whether boxes are an RGB image, or a list with images or rows of one, as by ``boxes.extend(image)``."""
    items = rows if isinstance(rows, list) or (isinstance(rows, np.ndarray) and rows.ndim) else ()
    return any(isinstance(item, np.ndarray) and item.ndim >= 2 and item.shape[-1] == 3 for item in items)


def _first_corners(boxes: list[Any]) -> NDArray[Any]:
    """Return the first two items of each box, its corners; an array of no boxes if there are none."""
    try:
        return np.array([(box[0], box[1]) for box in boxes])
    except (TypeError, IndexError, KeyError, ValueError):
        return np.array(None)


def corner_array(boxes: Any, name: str) -> NDArray[np.int64]:
    """Return boxes as ``(N, 4)`` whole pixels, from corner pairs, an array or detections."""
    rows = box_rows(boxes)
    if isinstance(rows, Iterable) and not isinstance(rows, (str, np.ndarray)):
        rows = list(rows)
    if _contains_image(rows):
        raise InvalidInputError(
            f"{name} must be a list of corner pairs ((x1, y1), (x2, y2)), got an image or rows of one; "
            "find_cars returns a picture, find_car_windows returns the boxes"
        )
    try:
        array = np.asarray(rows)
    except ValueError:  # rows of different lengths, such as boxes with scores
        array = _first_corners(rows)
    if array.size == 0:
        return np.empty((0, 4), np.int64)
    if array.shape[1:] not in ((4,), (2, 2)) or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise InvalidInputError(
            f"{name} must be a list of corner pairs ((x1, y1), (x2, y2)); got {describe(boxes)}"
        )
    return np.asarray(np.rint(array).astype(np.int64).reshape(-1, 4))
