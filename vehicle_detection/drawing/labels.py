"""Placement of labels beside boxes, so that they hide neither each other nor other vehicles."""

from __future__ import annotations

import functools
import re
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2

from vehicle_detection.drawing.primitives import (
    Color,
    Image,
    Rectangle,
    draw_text,
    fill_rectangle,
    ink_on,
    text_margin,
    text_scale,
    text_size,
)

Place = tuple[int, Rectangle]
"""A place for a label: its number, the same for all labels, and the rectangle there."""

# Width in pixels up to which a label may be wider than its box, at font scale 1; to get another line, a label
# must be this much too wide.
_FREE_WIDTH, _TOLERANCE = 180, 1.15
# Factor of the margin around a place for a label with more fields than in the last frame.
_GROWTH = 4
# Weight of the hidden area at a label's last place.
_LAST_WEIGHT = 0.7
# Fraction of a box that a label inside may cover.
_MAX_INSIDE = 0.12
# Rows of labels on leader lines above and below a box.
_ROWS_ABOVE, _ROWS_BELOW = 6, 3
# Numbers of the place inside a box, and of that for a label without a place in the image.
_INSIDE, _ELSEWHERE = 6, 99
_DIGIT = re.compile(r"\d")


@dataclass(frozen=True)
class Label:
    """A placed label."""

    lines: tuple[str, ...]
    rectangle: Rectangle
    scale: float
    leader: tuple[tuple[int, int], tuple[int, int]] | None = None  # line from the box to the label


@dataclass(frozen=True)
class LabelRequest:
    """A label to place: fields of text, at the box of a track with a constant key."""

    key: Hashable
    fields: tuple[str, ...]
    box: Rectangle


class LabelPlacer:
    """Places the labels of a frame; a label keeps its place at its box while that place is free.

    The places, in order of preference: above, below and beside the box, inside if that covers little of it,
    then farther up or down on a leader line. If none is free, the last fields are left out; if even the first
    one has no free place, it goes where it hides least.
    """

    def __init__(self) -> None:
        # Numbers of fields and lines, and place, of each label in the last frame.
        self._last: dict[Hashable, tuple[int, int, int]] = {}

    def place(
        self, requests: list[LabelRequest], shape: tuple[int, ...], blocked: Sequence[Rectangle] = ()
    ) -> list[Label | None]:
        """Place labels in an image of this shape, outside `blocked` rectangles; None for one without text.

        Earlier requests choose first, so that tracks by age give labels that stay where they are.
        """
        scale = text_scale(shape)
        labels: list[Label | None] = []
        last: dict[Hashable, tuple[int, int, int]] = {}
        for number, request in enumerate(requests):
            if not request.fields:
                labels.append(None)
                continue
            last_fields, last_lines, last_place = self._last.get(request.key, (None, None, None))
            obstacles = [other.box for other in requests[:number] + requests[number + 1 :]]
            obstacles += [label.rectangle for label in labels if label is not None]
            obstacles += blocked
            for count in range(len(request.fields), 0, -1):
                lines, size, fitted = _break_lines(
                    request.fields[:count], request.box, shape[1], scale, last_lines
                )
                # Another number of fields is like another place.
                before = last_place if last_fields in (None, count) else -1
                margin, places = text_margin(scale), functools.partial(_places, request.box, size, shape)
                grows = last_fields is not None and count > last_fields
                # More fields than before need more space, so that they do not come and go.
                if grows and _free_place(places(), obstacles, -1, _GROWTH * margin) is None:
                    continue
                found = _free_place(places(), obstacles, before, margin)
                if found is not None:
                    break
            else:
                found = _least_hiding(places(), obstacles, before)
            place, rectangle = found
            labels.append(Label(lines, rectangle, fitted, _leader(request.box, rectangle)))
            last[request.key] = count, len(lines), place
        self._last = last
        return labels


def _break_lines(
    fields: Sequence[str], box: Rectangle, image_width: int, scale: float, last_count: int | None
) -> tuple[tuple[str, ...], tuple[int, int], float]:
    """Lines of a label that is not much wider than its box, their size in pixels, and the font scale."""
    wide = max(box[2] - box[0], _FREE_WIDTH * scale)
    for count in range(1, len(fields) + 1):
        lines = _split(fields, count)
        # All digits count as the widest one, so that the size does not change with every number.
        size = text_size([_DIGIT.sub("0", line) for line in lines], scale)
        if size[0] <= wide * (_TOLERANCE if count == last_count else 1.0):
            break
    while size[0] > image_width and scale > 0.2:
        scale *= 0.9
        size = text_size([_DIGIT.sub("0", line) for line in lines], scale)
    return lines, size, scale


def _split(fields: Sequence[str], count: int) -> tuple[str, ...]:
    """Join fields to `count` lines, the first lines with more fields."""
    per_line, longer = divmod(len(fields), count)
    lines, start = [], 0
    for number in range(count):
        end = start + per_line + (number < longer)
        lines.append("  ".join(fields[start:end]))
        start = end
    return tuple(lines)


def _free_place(
    places: Iterable[Place], obstacles: Sequence[Rectangle], last: int | None, margin: int
) -> Place | None:
    """Return the best place without obstacles; None if there is none."""
    for place, rectangle in places:
        # A better place than the last one needs some more space, so that a label does not switch to and fro.
        space = 0 if last is None or place == last else margin
        if not any(_intersect(rectangle, other, space) for other in obstacles):
            return place, rectangle
    return None


def _least_hiding(places: Iterable[Place], obstacles: Sequence[Rectangle], last: int | None) -> Place:
    """Return the place that hides least, where the last one counts less."""

    def cost(place: Place) -> tuple[float, int]:
        number, rectangle = place
        return _hidden_area(rectangle, obstacles) * (_LAST_WEIGHT if number == last else 1.0), number

    return min(places, key=cost)


def _places(box: Rectangle, size: tuple[int, int], shape: tuple[int, ...]) -> Iterator[Place]:
    """Yield numbered places for a label inside the image, best first."""
    (width, height), (rows, columns) = size, shape[:2]
    found = False
    for place, (x, y) in enumerate(_corners(box, size)):
        inside = place == _INSIDE
        if inside and width * height > _MAX_INSIDE * (box[2] - box[0]) * (box[3] - box[1]):
            continue
        # Above, below and inside, a label may be moved sideways into the image.
        left = min(max(x, 0), max(columns - width, 0)) if place < 4 or inside else x
        if left >= 0 and left + width <= columns and y >= 0 and y + height <= rows:
            found = True
            yield place, (left, y, left + width, y + height)
    if not found:
        left, top = min(max(box[0], 0), max(columns - width, 0)), min(max(box[1], 0), max(rows - height, 0))
        yield _ELSEWHERE, (left, top, left + width, top + height)


def _corners(box: Rectangle, size: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield the upper left corners of a label's places."""
    (x1, y1, x2, y2), (width, height) = box, size
    yield from ((x1, y1 - height), (x2 - width, y1 - height), (x1, y2), (x2 - width, y2))
    yield from ((x2, y1), (x1 - width, y1), (x1, y1))
    gap = height // 2
    columns = ((x1 + x2 - width) // 2, x2 + gap, x1 - width - gap)
    farther = (x2 + 2 * gap + width, x1 - 2 * (width + gap))
    for row in range(1, _ROWS_ABOVE + 1):
        y = y1 - (row + 1) * (height + gap // 2)
        yield from ((x, y) for x in columns + farther)
    for row in range(1, _ROWS_BELOW + 1):
        y = y2 + row * (height + gap // 2)
        yield from ((x, y) for x in columns)


def _leader(box: Rectangle, label: Rectangle) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Line from the nearest points of a box to a label that does not touch it; None if it does."""
    if _intersect(box, label, 1):
        return None
    x = min(max((box[0] + box[2]) // 2, label[0]), label[2] - 1)
    start, end = (box[3] - 1, label[1]) if label[1] >= box[3] else (box[1], label[3])
    return (min(max(x, box[0]), box[2] - 1), start), (x, end)


def _hidden_area(label: Rectangle, obstacles: Sequence[Rectangle]) -> int:
    areas = (
        max(min(label[2], other[2]) - max(label[0], other[0]), 0)
        * max(min(label[3], other[3]) - max(label[1], other[1]), 0)
        for other in obstacles
    )
    return sum(areas)


def _intersect(first: Rectangle, second: Rectangle, space: int = 0) -> bool:
    """Whether two rectangles are less than `space` pixels apart, or for 0 have a pixel in common."""
    overlap_x = first[0] < second[2] + space and second[0] < first[2] + space
    return overlap_x and first[1] < second[3] + space and second[1] < first[3] + space


def draw_labels(image: Image, labels: Sequence[Label | None], colors: Sequence[Color], width: int) -> None:
    """Draw placed labels and their leader lines into an image."""
    drawn = [(label, color) for label, color in zip(labels, colors, strict=True) if label is not None]
    for label, color in drawn:
        if label.leader is not None:
            cv2.line(image, *label.leader, color, max(1, width // 2), cv2.LINE_AA)
    for label, color in drawn:
        fill_rectangle(image, label.rectangle, color)
        draw_text(image, list(label.lines), *label.rectangle[:2], label.scale, ink_on(color))
