"""Drawing of tracks, each with a box and a label."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable
from typing import Any, Literal

import numpy as np

from vehicle_detection._common import check_image, describe, is_listing
from vehicle_detection.camera import Camera
from vehicle_detection.drawing.birds_eye import MAX_SPEED_STD, BirdsEyePanel
from vehicle_detection.drawing.labels import LabelPlacer, LabelRequest, draw_labels
from vehicle_detection.drawing.primitives import (
    Color,
    Image,
    Rectangle,
    draw_outline,
    line_width_for,
    round_box,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import DrawParams
from vehicle_detection.tracking import Track
from vehicle_detection.units import UNITS

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

_UNKNOWN_COLOR: Color = (160, 160, 160)
# Distances (m) and their colors; between them, colors are interpolated over the logarithm of the distance.
_DISTANCES = (10.0, 20.0, 35.0, 60.0)
_DISTANCE_COLORS = ((213, 94, 0), (230, 159, 0), (240, 228, 66), (86, 180, 233))


def draw_tracks(
    image: Image,
    tracks: Iterable[Track],
    *,
    labels: Collection[str] = ("id", "distance", "speed"),
    line_width: int | None = None,
    color_by: Literal["id", "distance"] = "id",
) -> Image:
    """Draw tracks on a copy of an image, each with a box and a label, sized to the image.

    Only tracks with ``track.shown`` are drawn; those without a detection in this frame have dashed boxes.
    Labels are placed where they hide neither other labels nor other vehicles, if necessary on leader lines or
    without their last fields.

    Parameters
    ----------
    image, tracks
        ``(H, W, 3)`` uint8 RGB, and what `Tracker.update` returned for it.
    labels, line_width, color_by
        Fields of the labels, width of the lines in pixels, and meaning of the colors; see `DrawParams`.

    Returns
    -------
    numpy.ndarray
        A new image of the same shape.

    Raises
    ------
    InvalidInputError
        If the image is malformed, `tracks` holds something else, or an option has an unknown value.

    Notes
    -----
    In a video, `VehicleDetector.annotate` also keeps each label in its place from frame to frame. Short lines
    are wrapped, so that a label is not much wider than its box.
    """
    params = DrawParams(labels=labels, line_width=line_width, color_by=color_by)
    return TrackDrawer(params).draw(image, tracks)


class TrackDrawer:
    """Draws the tracks of a video's frames, and remembers the places of the labels and the recent positions.

    Parameters
    ----------
    params
        Labels, lines, colors and bird's-eye view.

    Notes
    -----
    The frames of a video are drawn in their order. A frame drawn again is drawn alike; an earlier frame
    starts anew.
    """

    def __init__(self, params: DrawParams | None = None) -> None:
        self.params = params or DrawParams()
        self.forget()

    def forget(self) -> None:
        """Forget all frames, before the first frame of another video."""
        self._placer = LabelPlacer()
        self._panel: BirdsEyePanel | None = None
        self._time = -math.inf
        self._coasting: set[int] = set()  # in the last searched frame

    def output_shape(self, shape: tuple[int, ...]) -> tuple[int, int, int]:
        """Shape of what `draw` returns for an image of this shape."""
        height, width = shape[:2]
        beside = self.params.panel == "side"
        return height, width + (BirdsEyePanel.side_size(shape)[1] if beside else 0), 3

    def draw(
        self,
        image: Image,
        tracks: Iterable[Track],
        *,
        time: float | None = None,
        searched: bool = True,
        camera: Camera | None = None,
        own_mps: float | None = None,
    ) -> Image:
        """Draw tracks on a copy of the next frame.

        Parameters
        ----------
        image, tracks
            ``(H, W, 3)`` uint8 RGB, and its tracks.
        time
            Time of the frame in seconds; None: the frame follows no other one.
        searched
            Whether the frame was searched; in a frame that was not, the boxes are dashed that were not
            detected in the last searched one.
        camera
            The camera, for the bird's-eye view; by default a typical dash-cam.
        own_mps
            Speed of the camera's vehicle in m/s: labels then state speeds over ground. None: unknown.
        """
        shape = check_image(image).shape
        shown = sorted((track for track in check_tracks(tracks) if track.shown), key=lambda track: track.id)
        if time is None or time < self._time:
            self.forget()
        self._time = -math.inf if time is None else time
        coasting = {track.id for track in shown if track.state == "coasting"}
        if searched:
            self._coasting = coasting
        params = self.params
        colors = [track_color(track, params.color_by) for track in shown]
        result = self._canvas(image)
        blocked: list[Rectangle] = []
        if params.panel != "none":
            if self._panel is None or not self._panel.fits(shape):
                self._panel = BirdsEyePanel(shape, params.panel, params.units)
            view = Camera.for_frame(shape) if camera is None else camera.for_shape(shape)
            blocked.append(self._panel.draw(result, shown, colors, view, shape, self._time))
        frame = result[:, : shape[1]]
        width = params.line_width or line_width_for(shape)
        dashed = coasting & self._coasting
        # Far to near: the boxes of near vehicles cover those behind them.
        for track, color in sorted(zip(shown, colors), key=lambda pair: float(pair[0].box[3])):
            draw_outline(frame, round_box(track.box), color, width, dashed=track.id in dashed)
        requests = [
            LabelRequest(
                track.id,
                tuple(track_fields(track, params.labels, params.units, own_mps)),
                round_box(track.box),
            )
            for track in shown
        ]
        draw_labels(frame, self._placer.place(requests, shape, blocked), colors, width)
        return result

    def _canvas(self, image: Image) -> Image:
        """Copy of an image, with room for a bird's-eye view beside it."""
        shape = self.output_shape(image.shape)
        if shape == image.shape:
            return image.copy()
        canvas = np.empty(shape, np.uint8)
        canvas[:, : image.shape[1]] = image
        return canvas


def color_index(track_id: int) -> int:
    """Index of the color of a track with an id in `TRACK_COLORS`."""
    return (track_id - 1) % len(TRACK_COLORS)


def track_color(track: Track, color_by: Literal["id", "distance"] = "id") -> Color:
    """RGB color of a track, chosen by its id or its distance; gray for a tentative track."""
    if color_by == "distance":
        return _distance_color(track.distance_m)
    return TRACK_COLORS[color_index(track.id)] if track.id > 0 else _UNKNOWN_COLOR


def _distance_color(distance_m: float | None) -> Color:
    if distance_m is None:
        return _UNKNOWN_COLOR
    value = math.log(max(distance_m, _DISTANCES[0]))
    known = [math.log(distance) for distance in _DISTANCES]
    for (low, high), (first, second) in zip(
        itertools.pairwise(known), itertools.pairwise(_DISTANCE_COLORS), strict=True
    ):
        if value <= high:
            share = (value - low) / (high - low)
            red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second))
            return red, green, blue
    return _DISTANCE_COLORS[-1]


def track_fields(
    track: Track, fields: Collection[str], units: str = "metric", own_mps: float | None = None
) -> list[str]:
    """Texts of the known fields of a track's label, such as ["#3", "24 m", "-6 km/h"].

    With the own speed the speed is that over ground, such as "94 km/h".
    """
    with_std, chosen = "std" in fields, UNITS[units]
    parts = [f"#{track.id}"] if "id" in fields else []
    if "score" in fields:
        parts.append(f"{track.score:.1f}" if track.confidence is None else f"{track.confidence:.0%}")
    if "distance" in fields and track.distance_m is not None and track.distance_std_m is not None:
        parts.append(chosen.distance_text(track.distance_m, track.distance_std_m, with_std=with_std))
    if "speed" in fields and track.speed_mps is not None and (track.speed_std_mps or 0) <= MAX_SPEED_STD:
        relative = own_mps is None
        speed = track.speed_mps if own_mps is None else abs(own_mps + track.speed_mps)
        parts.append(chosen.speed_text(speed, track.speed_std_mps, with_std=with_std, signed=relative))
    return parts


def check_tracks(tracks: object) -> list[Track]:
    """Return tracks as a list."""
    listed: list[Any] = list(tracks) if is_listing(tracks) else [None]
    if not all(isinstance(track, Track) for track in listed):
        raise InvalidInputError(
            f"tracks must be Track objects, got {describe(tracks)}; pass what update returns"
        )
    return listed
