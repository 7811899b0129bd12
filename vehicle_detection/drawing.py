"""Drawing on images: boxes, labeled regions, tracks with their labels, and a diagnostic mosaic."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_choice, check_image, check_integer, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import Track

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Rectangle = tuple[int, int, int, int]

TRACK_COLORS: tuple[Color, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)
"""RGB colors that color-blind viewers can tell apart (Okabe and Ito, *Color Universal Design*, 2008)."""

MAX_SPEED_STD = 3.0
"""Speeds with a larger standard error, in m/s, are not shown."""

LABEL_FIELDS = ("id", "score", "distance", "speed", "std")
"""Fields of a track's label; ``"std"`` adds standard errors to distance and speed."""

_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_boxes(image: Image, boxes: ArrayLike, *, color: Color = (0, 0, 255), thickness: int = 6) -> Image:
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
    if np.shape(color) != (3,):
        raise InvalidInputError(f"color must be (red, green, blue), 0-255 each; got {describe(color)}")
    red, green, blue = (check_integer(value, "color", low=0, high=255) for value in color)
    width = check_integer(thickness, "thickness", low=1, high=10_000)
    for box in check_boxes(boxes):
        _draw_outline(result, _round_box(box), (red, green, blue), width)
    return result


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


def draw_tracks(
    image: Image, tracks: Iterable[Track], *, show: Collection[str] = ("id", "distance", "speed")
) -> Image:
    """Draw tracks on a copy of an image, each with a box and a label in its own color, sized to the image.

    Only tracks with ``track.shown`` are drawn; coasting tracks fade.

    Parameters
    ----------
    image, tracks
        ``(H, W, 3)`` uint8 RGB, and what `Tracker.update` returned for it.
    show
        Fields of the label: ``"id"``, ``"score"``, ``"distance"`` (m), ``"speed"`` (m/s relative to the
        camera, positive when moving away) and ``"std"`` (adds standard errors). Unknown values are omitted.

    Returns
    -------
    numpy.ndarray
        A new image of the same shape.

    Raises
    ------
    InvalidInputError
        If the image is malformed, `tracks` holds something else, or `show` names an unknown field.
    """
    result = check_image(image).copy()
    for name in (show,) if isinstance(show, str) else show:
        check_choice(name, "show", LABEL_FIELDS)
    shown = sorted((track for track in _check_tracks(tracks) if track.shown), key=lambda track: track.box[3])
    scale = _text_scale(result)
    width = max(2, round(math.sqrt(result.shape[0] * result.shape[1]) / 320))
    # Far to near: the boxes of near vehicles cover those behind them.
    for track in shown:
        _draw_outline(result, _round_box(track.box), track_color(track), width, _alpha(track))
    occupied: list[Rectangle] = []
    for track in reversed(shown):
        text = track_text(track, show)
        if text:
            occupied.append(_draw_label(result, track, text, scale, occupied))
    return result


def draw_diagnostics(
    frame: Image, windows: Detections | ArrayLike, heat: NDArray[Any], tracks: Iterable[Track]
) -> Image:
    """Draw a 2x2 mosaic: the frame, its positive windows, the heat map, the tracks.

    Parameters
    ----------
    frame, tracks
        ``(H, W, 3)`` uint8 RGB, and its tracks.
    windows
        Positive windows, as `Detections` or boxes in any form that `draw_boxes` accepts.
    heat
        ``(h, w)`` finite numbers, of the frame's size or smaller; drawn from black (0) to yellow (maximum).

    Returns
    -------
    numpy.ndarray
        An image of the frame's shape; an odd side ends with a black line.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the frame is smaller than 4x4 pixels.
    """
    checked = check_image(frame, "frame")
    height, width = (side // 2 for side in checked.shape[:2])
    if min(height, width) < 2:
        raise InvalidInputError(
            f"frame must be at least 4x4 pixels, got {describe(frame)}; pass a larger image"
        )
    # Draw at the panels' size, so that lines and text stay sharp.
    small = np.asarray(cv2.resize(checked, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    scale = np.array([width, height, width, height]) / np.array(checked.shape[:2] * 2)[[1, 0, 1, 0]]
    boxes = check_boxes(windows)
    scaled = [dataclasses.replace(track, box=track.box * scale) for track in _check_tracks(tracks)]
    panels = [
        ("frame", small),
        ("windows", draw_boxes(small, boxes * scale, color=TRACK_COLORS[1], thickness=1)),
        ("heat", np.asarray(cv2.resize(heat_image(heat), (width, height)), np.uint8)),
        ("tracks", draw_tracks(small, scaled, show=("id", "distance"))),
    ]
    mosaic = np.zeros_like(checked)
    for index, (title, panel) in enumerate(panels):
        top, left = index // 2 * height, index % 2 * width
        view = mosaic[top : top + height, left : left + width]
        view[:] = panel
        _draw_text(view, title, _WHITE, 0, 0, _text_scale(view), _BLACK, 0.6)
    return mosaic


def blend(image: NDArray[Any], overlay: ArrayLike, alpha: float) -> NDArray[Any]:
    """Return ``(1 - alpha) * image + alpha * overlay``; `overlay` is a color or an image of that shape."""
    return np.asarray(cv2.addWeighted(image, 1 - alpha, np.full_like(image, overlay), alpha, 0))


def heat_image(heat: NDArray[Any]) -> Image:
    """Color an ``(h, w)`` heat map from black (0) to yellow (its maximum), as ``(h, w, 3)`` uint8 RGB."""
    values = np.asarray(heat)
    if values.ndim != 2 or not values.size or values.dtype.kind not in "iufb":
        raise InvalidInputError(
            f"heat must be an (h, w) array of numbers, got {describe(heat)}; pass a heat map"
        )
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise InvalidInputError("heat must be finite, got NaN or infinity; build it with add_heat")
    peak = float(values.max())
    gray = np.clip(values * (255 / peak if peak > 0 else 0.0), 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO)
    return np.asarray(cv2.cvtColor(colored, cv2.COLOR_BGR2RGB), np.uint8)


def track_color(track: Track) -> Color:
    """RGB color of a track, chosen by its id; gray for a tentative track."""
    return TRACK_COLORS[(track.id - 1) % len(TRACK_COLORS)] if track.id > 0 else (160, 160, 160)


def track_text(track: Track, show: Collection[str]) -> str:
    """Text of a track's label, such as "#3  24 m  -1.2 m/s"; empty if no field of `show` is known."""
    with_std = "std" in show
    parts = [f"#{track.id}"] if "id" in show else []
    if "score" in show:
        parts.append(f"{track.score:.1f}")
    if "distance" in show and track.distance_m is not None and track.distance_std_m is not None:
        parts.append(f"{track.distance_m:.0f}{f' +-{track.distance_std_m:.0f}' if with_std else ''} m")
    if "speed" in show and track.speed_mps is not None and (track.speed_std_mps or 0) <= MAX_SPEED_STD:
        parts.append(f"{track.speed_mps:+.1f}{f' +-{track.speed_std_mps or 0:.1f}' if with_std else ''} m/s")
    return "  ".join(parts)


def _alpha(track: Track) -> float:
    """Opacity of a track, which decreases to 0.35 within half a second while it coasts."""
    return max(0.35, 1 - track.time_since_update / 0.5 * (1 - 0.35))


def _draw_label(
    image: Image, track: Track, text: str, scale: float, occupied: Sequence[Rectangle]
) -> Rectangle:
    """Write a label above, below or inside the track's box, where no other label is; return its rectangle."""
    rows, columns = image.shape[:2]
    box, color = _round_box(track.box), track_color(track)
    while scale > 0.2 and _text_size(text, scale)[0] > columns:
        scale *= 0.9
    width, height, _ = _text_size(text, scale)
    x = min(max(box[0], 0), max(columns - width, 0))
    tops = [min(max(y, 0), max(rows - height, 0)) for y in (box[1] - height, box[3], box[1])]
    rectangles = [(x, y, x + width, y + height) for y in tops]
    free = [one for one in rectangles if not any(_intersect(one, other) for other in occupied)]
    x, y, *_ = (free or rectangles)[0]
    ink = _BLACK if np.dot(color, (0.299, 0.587, 0.114)) > 110 else _WHITE
    return _draw_text(image, text, ink, x, y, scale, color, _alpha(track))


def _draw_text(
    image: Image, text: str, color: Color, x: int, y: int, scale: float, background: Color, alpha: float
) -> Rectangle:
    """Write text on a filled rectangle whose upper left corner is ``(x, y)``; return the rectangle."""
    width, height, margin = _text_size(text, scale)
    rectangle = (x, y, x + width, y + height)
    _fill(image, rectangle, background, alpha)
    origin = (x + margin, y + height - margin)
    cv2.putText(image, text, origin, _FONT, scale, color, _text_thickness(scale), cv2.LINE_AA)
    return rectangle


def _text_size(text: str, scale: float) -> tuple[int, int, int]:
    """Width, height and margin of a label in pixels."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, _text_thickness(scale))
    margin = max(2, round(8 * scale))
    return width + 2 * margin, height + 2 * margin, margin


def _text_scale(image: Image) -> float:
    """Font scale for an image; at scale 1, capitals are 22 pixels high."""
    return min(max(math.sqrt(image.shape[0] * image.shape[1]) / 1600, 0.36), 4.0)


def _text_thickness(scale: float) -> int:
    return max(1, round(1.6 * scale))


def _draw_outline(image: Image, box: Rectangle, color: Color, width: int, alpha: float = 1.0) -> None:
    """Draw the four sides of a box, `width` pixels inwards from its edge."""
    x1, y1, x2, y2 = box
    if x2 <= x1 or y2 <= y1:
        return
    width_x, width_y = min(width, (x2 - x1 + 1) // 2), min(width, (y2 - y1 + 1) // 2)
    top, bottom = y1 + width_y, y2 - width_y
    _fill(image, (x1, y1, x2, top), color, alpha)
    _fill(image, (x1, max(bottom, top), x2, y2), color, alpha)
    _fill(image, (x1, top, x1 + width_x, bottom), color, alpha)
    _fill(image, (max(x2 - width_x, x1 + width_x), top, x2, bottom), color, alpha)


def _fill(image: Image, rectangle: Rectangle, color: Color, alpha: float) -> None:
    """Blend a rectangle into an image, clipped to the image."""
    x1, y1, x2, y2 = rectangle
    view = image[max(y1, 0) : max(y2, 0), max(x1, 0) : max(x2, 0)]
    if view.size:
        view[:] = blend(view, color, alpha) if alpha < 1 else color


def _round_box(box: NDArray[Any]) -> Rectangle:
    """Round to Python integers, which do not overflow for boxes far outside the image."""
    x1, y1, x2, y2 = (math.floor(float(value) + 0.5) for value in box)
    return x1, y1, x2, y2


def _intersect(first: Rectangle, second: Rectangle) -> bool:
    """Whether two rectangles have a pixel in common."""
    overlap_x = first[0] < second[2] and second[0] < first[2]
    return overlap_x and first[1] < second[3] and second[1] < first[3]


def _check_tracks(tracks: object) -> list[Track]:
    listed = list(tracks) if isinstance(tracks, Iterable) else None
    if listed is None or not all(isinstance(track, Track) for track in listed):
        raise InvalidInputError(
            f"tracks must be Track objects, got {describe(tracks)}; pass what update returns"
        )
    return listed
