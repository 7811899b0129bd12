"""Shapes and text drawn into an image in place: outlines, filled rectangles, lines of text."""

from __future__ import annotations

import functools
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Rectangle = tuple[int, int, int, int]

BLACK: Color = (0, 0, 0)
WHITE: Color = (255, 255, 255)

_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Length of a dash in line widths, and at most as a fraction of a side.
_DASH_WIDTHS, _DASH_FRACTION = 4, 0.2


def blend(image: NDArray[Any], overlay: ArrayLike, alpha: float) -> NDArray[Any]:
    """Return ``(1 - alpha) * image + alpha * overlay``; `overlay` is a color or an image of that shape."""
    return np.asarray(cv2.addWeighted(image, 1 - alpha, np.full_like(image, overlay), alpha, 0))


def draw_outline(image: Image, box: Rectangle, color: Color, width: int, *, dashed: bool = False) -> None:
    """Draw the four sides of a box, `width` pixels inwards from its edge."""
    x1, y1, x2, y2 = box
    if x2 <= x1 or y2 <= y1:
        return
    width_x, width_y = min(width, (x2 - x1 + 1) // 2), min(width, (y2 - y1 + 1) // 2)
    fill = _fill_dashed if dashed else fill_rectangle
    top, bottom = y1 + width_y, y2 - width_y
    fill(image, (x1, y1, x2, top), color)
    fill(image, (x1, max(bottom, top), x2, y2), color)
    fill(image, (x1, top, x1 + width_x, bottom), color)
    fill(image, (max(x2 - width_x, x1 + width_x), top, x2, bottom), color)


def fill_rectangle(image: Image, rectangle: Rectangle, color: Color, alpha: float = 1.0) -> None:
    """Blend a rectangle into an image, clipped to the image."""
    x1, y1 = max(rectangle[0], 0), max(rectangle[1], 0)
    x2, y2 = min(rectangle[2], image.shape[1]), min(rectangle[3], image.shape[0])
    if x1 >= x2 or y1 >= y2:
        return
    if alpha < 1:
        image[y1:y2, x1:x2] = blend(image[y1:y2, x1:x2], color, alpha)
    else:
        cv2.rectangle(image, (x1, y1), (x2 - 1, y2 - 1), color, cv2.FILLED)


def _fill_dashed(image: Image, line: Rectangle, color: Color) -> None:
    """Fill every other part of a thin rectangle, from both ends, so that the corners of a box stay drawn."""
    x1, y1, x2, y2 = line
    horizontal = x2 - x1 >= y2 - y1
    length, width = max(x2 - x1, y2 - y1), min(x2 - x1, y2 - y1)
    dash = max(1, min(_DASH_WIDTHS * width, int(_DASH_FRACTION * length)))
    count = max(1, round((length / dash + 1) / 2))  # dashes; the gaps between them are about as long
    pitch = (length - dash) / max(count - 1, 1)
    for index in range(count):
        start = round(index * pitch)
        if horizontal:
            fill_rectangle(image, (x1 + start, y1, x1 + start + dash, y2), color)
        else:
            fill_rectangle(image, (x1, y1 + start, x2, y1 + start + dash), color)


@functools.lru_cache(maxsize=4096)
def ink_on(background: Color) -> Color:
    """Black or white, whichever contrasts more with a background (WCAG 2.2)."""
    red, green, blue = (
        value / 3294.6 if value <= 10 else ((value / 255 + 0.055) / 1.055) ** 2.4 for value in background
    )
    # The contrast is (lighter + 0.05) / (darker + 0.05), for relative luminances.
    return BLACK if (0.2126 * red + 0.7152 * green + 0.0722 * blue + 0.05) ** 2 > 0.05 * 1.05 else WHITE


def draw_text(image: Image, lines: list[str], x: int, y: int, scale: float, ink: Color) -> None:
    """Write lines of text, with the upper left corner of the block of `text_size` at ``(x, y)``."""
    thickness, margin, pitch = text_thickness(scale), text_margin(scale), _line_pitch(scale)
    for number, line in enumerate(lines):
        baseline = y + margin + cap_height(scale) + number * pitch
        # The font has no plus-minus sign: it is a plus over a line.
        ascii_line, origin = line.replace("±", "+"), (x + margin, baseline)
        cv2.putText(image, ascii_line, origin, _FONT, scale, ink, thickness, cv2.LINE_AA)
        for column in (index for index, letter in enumerate(line) if letter == "±"):
            left = x + margin + _line_width(line[:column], scale)
            right = left + _line_width("+", scale)
            cv2.line(image, (left + 1, baseline), (right - 1, baseline), ink, thickness)


def text_size(lines: list[str], scale: float) -> tuple[int, int]:
    """Width and height in pixels of lines of text with their margin."""
    margin = text_margin(scale)
    width = max(_line_width(line, scale) for line in lines)
    return width + 2 * margin, cap_height(scale) + (len(lines) - 1) * _line_pitch(scale) + 2 * margin


def text_scale(shape: tuple[int, ...]) -> float:
    """Font scale for an image of this shape; at scale 1, capitals are 22 pixels high."""
    return min(max(math.sqrt(shape[0] * shape[1]) / 1800, 0.36), 4.0)


def text_thickness(scale: float) -> int:
    """Width of the strokes in pixels."""
    return max(1, round(1.8 * scale))


def text_margin(scale: float) -> int:
    """Space around a block of text in pixels."""
    return max(2, round(7 * scale))


def cap_height(scale: float) -> int:
    """Height of capitals in pixels."""
    return max(1, round(22 * scale))


def _line_pitch(scale: float) -> int:
    return cap_height(scale) + max(3, round(12 * scale))


@functools.lru_cache(maxsize=4096)
def _line_width(line: str, scale: float) -> int:
    if not line:
        return 0
    (width, _), _ = cv2.getTextSize(line.replace("±", "+"), _FONT, scale, text_thickness(scale))
    return int(width)


def round_box(box: NDArray[Any]) -> Rectangle:
    """Round to Python integers, which do not overflow for boxes far outside the image."""
    x1, y1, x2, y2 = (math.floor(float(value) + 0.5) for value in box)
    return x1, y1, x2, y2


def line_width_for(shape: tuple[int, ...]) -> int:
    """Width in pixels of the lines of boxes in an image of this shape."""
    return max(2, round(math.sqrt(shape[0] * shape[1]) / 400))
