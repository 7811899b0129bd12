"""What pictures are drawn with: frames of boxes and text on a ground, sized to the image."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Rectangle = tuple[int, int, int, int]

BLACK, WHITE = (0, 0, 0), (255, 255, 255)

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def line_width(image: Image) -> int:
    """Width of a box's lines in pixels."""
    return max(2, round(math.sqrt(image.shape[0] * image.shape[1]) / 320))


def text_scale(image: Image) -> float:
    """Scale of the font, whose capitals are 22 pixels high at 1."""
    return min(max(math.sqrt(image.shape[0] * image.shape[1]) / 1600, 0.36), 4.0)


def rounded(box: NDArray[Any]) -> Rectangle:
    """Whole pixels, as Python's integers: a box far outside must not overflow."""
    x1, y1, x2, y2 = (math.floor(float(value) + 0.5) for value in box)
    return x1, y1, x2, y2


def touch(first: Rectangle, second: Rectangle) -> bool:
    """Whether two rectangles have a pixel in common."""
    across = first[0] < second[2] and second[0] < first[2]
    return across and first[1] < second[3] and second[1] < first[3]


def frame_box(image: Image, box: Rectangle, color: Color, width: int, alpha: float = 1.0) -> None:
    """Draw the four sides of a box, `width` pixels inwards from its edge."""
    x1, y1, x2, y2 = box
    if x2 <= x1 or y2 <= y1:
        return
    thick_x, thick_y = min(width, (x2 - x1 + 1) // 2), min(width, (y2 - y1 + 1) // 2)
    low, high = y1 + thick_y, y2 - thick_y
    _fill(image, (x1, y1, x2, low), color, alpha)
    _fill(image, (x1, max(high, low), x2, y2), color, alpha)
    _fill(image, (x1, low, x1 + thick_x, high), color, alpha)
    _fill(image, (max(x2 - thick_x, x1 + thick_x), low, x2, high), color, alpha)


def put_text(
    image: Image, text: str, ink: Color, x: int, y: int, scale: float, ground: Color, alpha: float
) -> Rectangle:
    """Write text on a ground whose upper left corner is ``(x, y)``; return the ground's rectangle."""
    width, height, margin = text_size(text, scale)
    rectangle = (x, y, x + width, y + height)
    _fill(image, rectangle, ground, alpha)
    foot = (x + margin, y + height - margin)
    cv2.putText(image, text, foot, _FONT, scale, ink, _text_weight(scale), cv2.LINE_AA)
    return rectangle


def text_size(text: str, scale: float) -> tuple[int, int, int]:
    """Width, height and margin of a label in pixels."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, _text_weight(scale))
    margin = max(2, round(8 * scale))
    return width + 2 * margin, height + 2 * margin, margin


def _fill(image: Image, rectangle: Rectangle, color: Color, alpha: float = 1.0) -> None:
    """Blend a rectangle into an image, as far as it lies inside."""
    x1, y1, x2, y2 = rectangle
    view = image[max(y1, 0) : max(y2, 0), max(x1, 0) : max(x2, 0)]
    if not view.size:
        return
    if alpha < 1:
        paint = np.empty_like(view)
        paint[:] = color
        view[:] = cv2.addWeighted(view, 1 - alpha, paint, alpha, 0)
    else:
        view[:] = color


def _text_weight(scale: float) -> int:
    return max(1, round(1.6 * scale))
