"""Drawing into one image: text, labels, boxes, detections, blurred vehicles, heat maps.

The public functions take an ``(H, W, 3)`` uint8 RGB image and return a new one of the same shape; malformed
arguments raise an `InvalidInputError`. The others draw into the image that they are given.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check, describe, invalid
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import Track

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Rectangle = tuple[int, int, int, int]

BLACK: Color = (0, 0, 0)
WHITE: Color = (255, 255, 255)

TRACK_COLORS: tuple[Color, ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178),
    (213, 94, 0), (204, 121, 167),
)  # fmt: skip
"""RGB colors that color-blind viewers can tell apart (Okabe and Ito, *Color Universal Design*, 2008)."""

_UNKNOWN_COLOR: Color = (160, 160, 160)
# Distances (m) and their colors; between them, colors are interpolated over the logarithm of the distance.
_DISTANCES = (10.0, 20.0, 35.0, 60.0)
_DISTANCE_COLORS = ((213, 94, 0), (230, 159, 0), (240, 228, 66), (86, 180, 233))
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Length of a dash in line widths, and at most as a fraction of a side.
_DASH_WIDTHS, _DASH_FRACTION = 4, 0.2


def color_index(track_id: int) -> int:
    """Index of the color of a track with an id in `TRACK_COLORS`."""
    return (track_id - 1) % len(TRACK_COLORS)


def track_color(track: Track, color_by: Literal["id", "distance"] = "id") -> Color:
    """RGB color of a track, chosen by its id or its distance; gray for a tentative track."""
    if color_by == "id":
        return TRACK_COLORS[color_index(track.id)] if track.id > 0 else _UNKNOWN_COLOR
    if track.distance_m is None:
        return _UNKNOWN_COLOR
    position = math.log(max(track.distance_m, _DISTANCES[0]))
    red, green, blue = (
        round(float(np.interp(position, np.log(_DISTANCES), values))) for values in zip(*_DISTANCE_COLORS)
    )
    return red, green, blue


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
    thickness, margin, pitch = max(1, round(1.8 * scale)), text_margin(scale), _line_pitch(scale)
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
    (width, _), _ = cv2.getTextSize(line.replace("±", "+"), _FONT, scale, max(1, round(1.8 * scale)))
    return int(width)


def round_box(box: NDArray[Any]) -> Rectangle:
    """Round to Python integers, which do not overflow for boxes far outside the image."""
    x1, y1, x2, y2 = (math.floor(float(value) + 0.5) for value in box)
    return x1, y1, x2, y2


def line_width_for(shape: tuple[int, ...]) -> int:
    """Width in pixels of the lines of boxes in an image of this shape."""
    return max(2, round(math.sqrt(shape[0] * shape[1]) / 400))


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


class Label(NamedTuple):
    """A placed label."""

    lines: tuple[str, ...]
    rectangle: Rectangle
    scale: float
    leader: tuple[tuple[int, int], tuple[int, int]] | None = None  # line from the box to the label


class LabelRequest(NamedTuple):
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
                fields, margin = request.fields[:count], text_margin(scale)
                lines, size, fitted = _break_lines(fields, request.box, shape[1], scale, last_lines)
                places = list(_places(request.box, size, shape))
                # Another number of fields is like another place.
                before = last_place if last_fields in (None, count) else -1
                grows = last_fields is not None and count > last_fields
                # More fields than before need more space, so that they do not come and go.
                if grows and _free_place(places, obstacles, -1, _GROWTH * margin) is None:
                    continue
                found = _free_place(places, obstacles, before, margin)
                if found is not None:
                    break
            else:  # the place that hides least, where the last one counts less; the best one of equals
                weights = {before: _LAST_WEIGHT}
                found = min(places, key=lambda at: hidden_area(at[1], obstacles) * weights.get(at[0], 1.0))
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
        lines = tuple("  ".join(part) for part in np.array_split(fields, count))  # the first ones are longer
        # All digits count as the widest one, so that the size does not change with every number.
        size = text_size([_DIGIT.sub("0", line) for line in lines], scale)
        if size[0] <= wide * (_TOLERANCE if count == last_count else 1.0):
            break
    while size[0] > image_width and scale > 0.2:
        scale *= 0.9
        size = text_size([_DIGIT.sub("0", line) for line in lines], scale)
    return lines, size, scale


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


def hidden_area(label: Rectangle, obstacles: Sequence[Rectangle]) -> int:
    """Pixels of obstacles that a label covers."""
    area = 0
    for x1, y1, x2, y2 in obstacles:
        width, height = min(label[2], x2) - max(label[0], x1), min(label[3], y2) - max(label[1], y1)
        area += max(width, 0) * max(height, 0)
    return area


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


def draw_boxes(
    image: Image, boxes: Detections | ArrayLike, *, color: Color = (0, 0, 255), thickness: int = 6
) -> Image:
    """Draw boxes on a copy of an image.

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, or a list of ``((x1, y1), (x2, y2))`` as in the course; parts
        outside the image are clipped.
    color, thickness
        RGB, 0-255 each, and width in pixels of the lines, which lie inside the box.

    Examples
    --------
    >>> drawn = draw_boxes(np.zeros((40, 60, 3), np.uint8), [[10, 5, 30, 25]], thickness=1)
    >>> drawn[5, 10].tolist(), drawn[24, 29].tolist(), int(drawn.any(axis=2).sum())
    ([0, 0, 255], [0, 0, 255], 76)
    """
    result = check.image(image).copy()
    rgb = _check_color(color)
    width = check.integer(thickness, "thickness", low=1, high=10_000)
    for box in check.boxes(boxes):
        draw_outline(result, round_box(box), rgb, width)
    return result


def _check_color(color: Color) -> Color:
    """Return a color as Python's integers, which OpenCV needs."""
    if check.array(color, "color").shape != (3,):
        raise InvalidInputError(f"color must be (red, green, blue), 0-255 each; got {describe(color)}")
    red, green, blue = (check.integer(value, "color", low=0, high=255) for value in color)
    return red, green, blue


def score_texts(detections: Detections) -> list[str]:
    """Confidence of each detection, such as "87%" or "car 87%"; its score if the confidence is unknown."""
    known, labels = detections.confidences, detections.labels
    texts = [f"{score:.2f}" for score in detections.scores] if known is None else [f"{p:.0%}" for p in known]
    kinds = ["vehicle"] * len(texts) if labels is None else labels.tolist()
    return [text if kind == "vehicle" else f"{kind} {text}" for kind, text in zip(kinds, texts)]


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
    color, line_width
        RGB, 0-255 each, and width of the lines in pixels; None: chosen for the size of the image.
    scores
        Whether to write them, where they hide neither other boxes nor each other.

    Examples
    --------
    >>> found = Detections([[40, 40, 90, 80]], [1.25])
    >>> drawn = draw_detections(np.zeros((90, 160, 3), np.uint8), found, scores=False)
    >>> np.argwhere(drawn.any(axis=2)).min(axis=0).tolist()
    [40, 40]
    """
    check.instance(detections, "detections", Detections, "pass what detect returns")
    shape = check.image(image).shape
    check.flags(scores=scores)
    if line_width is not None:
        check.integer(line_width, "line_width", low=1, high=1000)
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


# Margin around a box, as a fraction of its sides: boxes and predictions have errors.
_MARGIN = 0.08
# Cells that remain across the longer side of a vehicle and of a plate's region: a plate is 1/4 of a vehicle
# wide, and has at most two cells.
_CELLS = {"vehicles": 8, "plates": 6}
BLUR_REGIONS = tuple(_CELLS)
"""What `blur_boxes` can blur."""

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
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]`` of vehicles; parts outside the image are clipped.
    region
        ``"vehicles"``: the whole boxes and a margin of 8%. ``"plates"``: the lower part of each box, where a
        plate is; it is not searched for.

    Examples
    --------
    >>> image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    >>> blurred = blur_boxes(image, [[20, 10, 60, 50]])
    >>> bool(blurred[20:40, 30:50].std() < 0.3 * image.std()), bool((blurred[:, :10] == image[:, :10]).all())
    (True, True)
    """
    result = check.image(image).copy()
    check.choice(region, "region", BLUR_REGIONS)
    height, width = result.shape[:2]
    for x1, y1, x2, y2 in _regions(check.boxes(boxes).astype(np.float64), region).tolist():
        left, top = max(int(np.floor(x1)), 0), max(int(np.floor(y1)), 0)
        right, bottom = min(int(np.ceil(x2)), width), min(int(np.ceil(y2)), height)
        if right > left and bottom > top:
            view, cell = result[top:bottom, left:right], max(x2 - x1, y2 - y1, 1.0) / _CELLS[region]
            sides = right - left, bottom - top
            cells = tuple(min(max(round(side / cell), 1), side) for side in sides)
            # Average square cells, and interpolate between them.
            small = cv2.resize(view, cells, interpolation=cv2.INTER_AREA)
            view[:] = cv2.resize(small, sides, interpolation=cv2.INTER_LINEAR)
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


# Colors of cells that speak for and against a vehicle, and opacity of the one with the largest share.
_FOR_COLOR, _AGAINST_COLOR, _MAX_ALPHA = TRACK_COLORS[5], TRACK_COLORS[4], 0.75


def draw_cell_shares(image: Image, window: ArrayLike, cells: NDArray[Any]) -> Image:
    """Draw the shares of a window's cells in its score on a copy of an image, as `Explanation` holds them.

    Orange cells raise the score and blue ones lower it, the stronger the more. `window` is
    ``[x1, y1, x2, y2]`` in pixels, and `cells` are ``(rows, columns)``.
    """
    result = check.image(image).copy()
    x1, y1, x2, y2 = check.boxes([window], "window")[0].astype(np.float64).tolist()
    rows, columns = cells.shape
    peak = float(np.abs(cells).max()) or 1.0
    xs, ys = np.linspace(x1, x2, columns + 1).round(), np.linspace(y1, y2, rows + 1).round()
    for (row, column), share in np.ndenumerate(cells):
        place = int(xs[column]), int(ys[row]), int(xs[column + 1]), int(ys[row + 1])
        color = _FOR_COLOR if share > 0 else _AGAINST_COLOR
        fill_rectangle(result, place, color, _MAX_ALPHA * abs(float(share)) / peak)
    return result


def heat_image(heat: NDArray[Any]) -> Image:
    """Color an ``(h, w)`` heat map from black (0) to yellow (its maximum), as ``(h, w, 3)`` uint8 RGB."""
    values = check.array(heat, "heat")
    if values.ndim != 2 or not values.size or values.dtype.kind not in "iufb":
        raise invalid("heat", "be an (h, w) array of numbers", heat, "pass a heat map")
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise InvalidInputError("heat must be finite, got NaN or infinity; build it with add_heat")
    peak = float(values.max())
    gray = np.clip(values * (255 / peak if peak > 0 else 0.0), 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO)
    return np.asarray(cv2.cvtColor(colored, cv2.COLOR_BGR2RGB), np.uint8)
