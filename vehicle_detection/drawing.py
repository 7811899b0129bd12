"""Pixels on a copy of a frame: boxes, labelled regions, tracks with what is known of them, diagnostics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from vehicle_detection._common import check_boxes, check_choice, check_image, check_integer, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import Track

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


TRACK_COLORS: tuple[Color, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
)
"""RGB colors that stay apart for color-blind eyes (Okabe and Ito, *Color Universal Design*, 2008)."""

_VAGUE_SPEED = 3.0
"""A speed with a greater standard error, in meters a second, is not worth showing."""

FIELDS = ("id", "score", "distance", "speed", "errors")
"""What a track's label can show; ``"errors"`` adds standard errors to distance and speed."""

_TENTATIVE: Color = (160, 160, 160)
# Seconds in which a track that is not seen fades, and how far.
_FADE_SECONDS, _FAINTEST = 0.5, 0.35


def draw_boxes(image: Image, boxes: ArrayLike, *, color: Color = (0, 0, 255), thickness: int = 6) -> Image:
    """Draw boxes on a copy of an image.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, or a list of ``((x1, y1), (x2, y2))`` as in the course; parts
        outside the image are left out.
    color
        RGB, 0-255 each.
    thickness
        Width of the lines in pixels; they lie inside the box.

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
    rgb, width = _check_color(color), check_integer(thickness, "thickness", low=1, high=10_000)
    for box in _corner_array(boxes):
        frame_box(result, rounded(box), rgb, width)
    return result


def draw_labeled_bboxes(image: Image, labels: tuple[NDArray[Any], int]) -> Image:
    """Draw the bounding box of each labelled region on a copy of an image, as the course does.

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
        If `labels` is no such pair, or its array does not have the image's height and width.

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
    picture = check_image(image)
    array, count = _check_labels(labels, picture.shape[:2])
    regions = [found for found in ndimage.find_objects(array, max_label=count) if found is not None]
    return draw_boxes(picture, [[x.start, y.start, x.stop, y.stop] for y, x in regions])


def draw_tracks(
    image: Image, tracks: Iterable[Track], *, show: Collection[str] = ("id", "distance", "speed")
) -> Image:
    """Draw tracks on a copy of an image, each with a box and a label in its own color, sized to the image.

    Tracks that are not to be shown are left out; one that is not seen in this frame fades.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    tracks
        What `Tracker.update` returned for this frame.
    show
        What the label holds, out of ``FIELDS``; distances in meters, speeds relative to the camera in meters
        a second, positive when moving away. What is unknown is left out.

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
    draw_tracks_onto(result, tracks, show=show)
    return result


def draw_tracks_onto(
    image: Image, tracks: Iterable[Track], *, show: Collection[str] = ("id", "distance", "speed")
) -> None:
    """Draw tracks as `draw_tracks` does, into `image` itself: for a loop that owns its frames."""
    picture = check_image(image)
    if not picture.flags.writeable:
        raise InvalidInputError("image must be writeable to be drawn on; use draw_tracks, or pass a copy")
    for name in (show,) if isinstance(show, str) else show:
        check_choice(name, "show", FIELDS)
    drawn = sorted((track for track in _check_tracks(tracks) if track.shown), key=lambda track: track.box[3])
    scale = text_scale(picture)
    occupied: list[Rectangle] = []
    # Near vehicles last: their boxes lie over those of the ones behind them.
    for track in drawn:
        frame_box(picture, rounded(track.box), track_color(track), line_width(picture), _alpha(track))
    for track in reversed(drawn):
        text = track_text(track, show)
        if text:
            _put_label(picture, track, text, scale, occupied)


def _put_label(image: Image, track: Track, text: str, scale: float, occupied: list[Rectangle]) -> None:
    """Write a label above its box, or below, or inside: where it hides no other one and fits."""
    rows, columns = image.shape[:2]
    box, color = rounded(track.box), track_color(track)
    while scale > 0.2 and text_size(text, scale)[0] > columns:
        scale *= 0.9
    width, height, _ = text_size(text, scale)
    x = min(max(box[0], 0), max(columns - width, 0))
    places = [min(max(y, 0), max(rows - height, 0)) for y in (box[1] - height, box[3], box[1])]
    rectangles = [(x, y, x + width, y + height) for y in places]
    free = [one for one in rectangles if not any(touch(one, other) for other in occupied)]
    x, y, *_ = (free or rectangles)[0]
    red, green, blue = color
    ink = BLACK if 0.299 * red + 0.587 * green + 0.114 * blue > 110 else WHITE
    occupied.append(put_text(image, text, ink, x, y, scale, color, _alpha(track)))


def track_color(track: Track) -> Color:
    """RGB color of a track, the same in every frame: by its id, gray while tentative."""
    return TRACK_COLORS[(track.id - 1) % len(TRACK_COLORS)] if track.id > 0 else _TENTATIVE


def _alpha(track: Track) -> float:
    return max(_FAINTEST, 1 - track.time_since_update / _FADE_SECONDS * (1 - _FAINTEST))


def track_text(track: Track, show: Collection[str]) -> str:
    """Text of a track's label; empty where nothing of `show` is known.

    Examples
    --------
    >>> import numpy as np
    >>> track = Track(
    ...     id=3, box=np.array([0.0, 0, 9, 9]), score=1.5, state="confirmed", shown=True, age=1.0, misses=0,
    ...     time_since_update=0.0, velocity=(0.0, 0.0), distance_m=23.6, distance_std_m=2.2, speed_mps=-1.25,
    ...     speed_std_mps=0.5,
    ... )
    >>> track_text(track, ("id", "score", "distance", "speed"))
    '#3  1.5  24 m  -1.2 m/s'
    """
    errors = "errors" in show
    parts = [f"#{track.id}"] if "id" in show else []
    if "score" in show:
        parts.append(f"{track.score:.1f}")
    if "distance" in show and track.distance_m is not None and track.distance_std_m is not None:
        parts.append(f"{track.distance_m:.0f}{f' +-{track.distance_std_m:.0f}' if errors else ''} m")
    if "speed" in show and track.speed_mps is not None and (track.speed_std_mps or 0) <= _VAGUE_SPEED:
        parts.append(f"{track.speed_mps:+.1f}{f' +-{track.speed_std_mps or 0:.1f}' if errors else ''} m/s")
    return "  ".join(parts)


def draw_diagnostics(
    frame: Image, windows: Detections | ArrayLike, heat: NDArray[Any], tracks: Iterable[Track]
) -> Image:
    """Draw a 2x2 mosaic: the frame, its positive windows, the heat map, the tracks.

    Parameters
    ----------
    frame
        ``(H, W, 3)`` uint8 RGB.
    windows
        Positive windows, as `Detections` or boxes in any form that `draw_boxes` takes.
    heat
        ``(h, w)`` finite numbers, of the frame's size or smaller; drawn from black (0) to yellow (its peak).
    tracks
        The tracks of this frame.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` uint8 RGB, of the frame's shape: an odd side has a black line at its end.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the frame is smaller than 4x4 pixels.
    """
    picture = check_image(frame, "frame")
    height, width = (side // 2 for side in picture.shape[:2])
    if min(height, width) < 2:
        raise InvalidInputError(
            f"frame must have 4x4 pixels or more, got {describe(frame)}; pass a larger one"
        )
    # Drawn at the panels' size, so that lines and text stay sharp.
    small = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    shrink = np.array([width, height, width, height]) / np.array(picture.shape[:2] * 2)[[1, 0, 1, 0]]
    boxes = check_boxes(windows.boxes) if isinstance(windows, Detections) else _corner_array(windows)
    followed = [dataclasses.replace(track, box=track.box * shrink) for track in _check_tracks(tracks)]
    panels = [
        ("frame", small),
        ("windows", draw_boxes(small, boxes * shrink, color=TRACK_COLORS[1], thickness=1)),
        ("heat", np.asarray(cv2.resize(_heat_picture(heat), (width, height)), np.uint8)),
        ("tracks", draw_tracks(small, followed, show=("id", "distance"))),
    ]
    mosaic = np.zeros_like(picture)
    for index, (title, panel) in enumerate(panels):
        top, left = index // 2 * height, index % 2 * width
        view = mosaic[top : top + height, left : left + width]
        view[:] = panel
        put_text(view, title, WHITE, 0, 0, text_scale(view), BLACK, 0.6)
    return mosaic


def _heat_picture(heat: NDArray[Any]) -> Image:
    values = _check_heat(heat)
    if not np.isfinite(values).all():
        raise InvalidInputError("heat must be finite, got NaN or infinity; build it with add_heat")
    peak = float(values.max())
    gray = np.clip(values * (255 / peak if peak > 0 else 0.0), 0, 255).astype(np.uint8)
    return np.asarray(
        cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB), np.uint8
    )


def _check_color(color: object) -> Color:
    if not isinstance(color, (tuple, list)) or len(color) != 3:
        raise InvalidInputError(f"color must be (red, green, blue), 0-255 each; got {describe(color)}")
    red, green, blue = (check_integer(value, "color", low=0, high=255) for value in color)
    return red, green, blue


def _check_labels(labels: object, shape: tuple[int, ...]) -> tuple[NDArray[Any], int]:
    if not isinstance(labels, tuple) or len(labels) != 2 or not isinstance(labels[0], np.ndarray):
        raise InvalidInputError(
            f"labels must be the pair (label array, number of regions), got {describe(labels)}; "
            "pass what scipy.ndimage.label returns"
        )
    array, count = labels[0], check_integer(labels[1], "labels[1]", low=0)
    if array.shape != shape or array.dtype.kind not in "iu":
        raise InvalidInputError(
            f"labels[0] must be integers of the image's shape {shape}, got {describe(array)}; "
            "label the heat map of this image"
        )
    return array, count


def _check_heat(heat: object) -> NDArray[np.float32]:
    if not isinstance(heat, np.ndarray) or heat.ndim != 2 or not heat.size or heat.dtype.kind not in "iufb":
        raise InvalidInputError(
            f"heat must be an (h, w) array of numbers, got {describe(heat)}; pass a heat map"
        )
    return heat.astype(np.float32)


def _check_tracks(tracks: object) -> list[Track]:
    listed = list(tracks) if isinstance(tracks, Iterable) else None
    if listed is None or not all(isinstance(track, Track) for track in listed):
        raise InvalidInputError(
            f"tracks must be Track objects, got {describe(tracks)}; pass what update returns"
        )
    return listed


def _corner_array(boxes: ArrayLike) -> NDArray[Any]:
    """Boxes as ``(N, 4)``; the course's pairs of corners may come in any order."""
    if isinstance(boxes, Sequence) and len(boxes) and np.shape(boxes)[1:] == (2, 2):
        corners = np.asarray(boxes)
        return check_boxes(np.concatenate((corners.min(axis=1), corners.max(axis=1)), axis=1))
    return check_boxes(boxes)
