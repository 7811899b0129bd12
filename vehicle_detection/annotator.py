"""Annotating the frames of a video: tracks with labels, bird's-eye view, diagnostics."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection import drawing
from vehicle_detection._common import UNITS, check, describe, fields, invalid, is_listing
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.drawing import Color, Image, Rectangle
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.heatmap import HeatParams, frame_heat
from vehicle_detection.tracking import USUAL_FPS, FrameResult, Track

LABEL_FIELDS = ("id", "score", "distance", "speed", "std")
"""Fields of a track's label; ``"std"`` adds standard errors to distance and speed."""


def _check_labels(value: Any, name: str) -> tuple[str, ...]:
    if not isinstance(value, Collection) or getattr(value, "ndim", 1) == 0:
        raise invalid(name, "be a list of fields", value, f"pass some of {LABEL_FIELDS}")
    fields = (value,) if isinstance(value, str) else tuple(value)
    for field in fields:
        check.choice(field, name, LABEL_FIELDS)
    return fields


@dataclass(frozen=True, kw_only=True)
class DrawParams(fields.Checked):
    """How tracks are drawn.

    Attributes
    ----------
    labels
        Fields of a label: ``"id"`` with the class, ``"score"`` (the confidence), ``"distance"`` (``~`` where
        its standard error exceeds 20%), ``"speed"`` (relative to the camera, positive when moving away) and
        ``"std"`` (adds standard errors). Unknown values are omitted; without a field there is no label.
    line_width
        Width of the boxes' lines in pixels; None: chosen for the size of the image.
    color_by
        ``"id"``: each track has a color of its own. ``"distance"``: from vermilion (10 m and nearer) over
        orange (20 m) and yellow (35 m) to blue (60 m and farther), gray where the distance is unknown.
    panel
        Bird's-eye view in the frame's upper right ``"corner"``, or at its right ``"side"``, which makes the
        video wider; or ``"none"``.
    units
        ``"metric"`` (m and km/h) or ``"imperial"`` (ft and mph), in labels and bird's-eye view.

    >>> DrawParams(labels=("id", "distance"), color_by="distance").panel
    'none'
    """

    labels: Collection[str] = fields.checked_field(("id", "distance", "speed"), _check_labels)
    line_width: int | None = fields.integer(None, low=1, high=1000)
    color_by: Literal["id", "distance"] = fields.choice("id", ("id", "distance"))
    panel: Literal["none", "corner", "side"] = fields.choice("none", ("none", "corner", "side"))
    units: Literal["metric", "imperial"] = fields.choice("metric", UNITS)


Point = tuple[int, int]
Trail = deque[tuple[float, Point]]  # times (s) and positions (pixels) of a track in the last frames

# Distance between the lines of the grid (the camera is in the middle of its lane), largest standard error of
# a speed that is shown (m/s), and time that a trail covers.
_LANE_WIDTH_M, MAX_SPEED_STD, _TRAIL_SECONDS = 3.6, 3.0, 1.5
# Distances with a line and a number, by units; and distance (m) that the view covers ahead of the camera and
# behind it.
_RANGES = {"metric": (20, 40, 60), "imperial": (75, 150, 225)}
_AHEAD_M, _BEHIND_M = 80.0, 6.0
_OWN_COLOR, _GRID_COLOR, _TEXT_COLOR = (235, 235, 235), (72, 78, 86), (170, 176, 184)
_BACKGROUND, _BACKGROUND_ALPHA, _ELLIPSE_ALPHA = (26, 29, 33), 0.78, 0.4
# Sides of the view as fractions of the frame's height, and of its own height.
_CORNER_HEIGHT, _SIDE_WIDTH, _ASPECT = 0.42, 0.3, 0.42
# Lookup table of the frame's brightness behind the view.
_DIMMED = np.rint(np.arange(256) * (1 - _BACKGROUND_ALPHA)).astype(np.uint8)
_MIN_TEXT_HEIGHT = 140  # pixels of a view that has room for numbers
_LINE_HEIGHT = 500  # pixels of a view for each pixel of the width of its lines
_TRAIL_STEP = 0.08  # s
_SHIFT = 4  # fractional bits of coordinates in OpenCV
_FAR = 1e6  # limit of such coordinates


class RoadPosition(NamedTuple):
    """Position of a vehicle on the road; the camera is at the origin."""

    lateral_m: float  # middle of the near end, positive to the right
    distance_m: float  # along the road to the near end
    radial_std_m: float  # standard error along the ray from the camera
    tangential_std_m: float  # and across it


def road_position(track: Track, camera: Camera, shape: tuple[int, ...]) -> RoadPosition | None:
    """Position of a track on the road, for frames of ``(height, width, ...)``; None if it is unknown.

    The box of a vehicle in another lane also shows its side, at the edge towards the middle of the frame, so
    the near end is at the outer part of the box. Where the frame truncates that part, the far end of the side
    gives the position.
    """
    distance, std = track.distance_m, track.distance_std_m
    if distance is None or std is None:
        return None
    left, _, right, _ = camera.rectify_boxes(track.box[None], shape)[0].tolist()
    middle, focal = shape[1] / 2, camera.focal_px
    to_right = left + right > 2 * middle
    # Mirrored, if necessary, so that the vehicle is on the right.
    inner, outer = (left - middle, right - middle) if to_right else (middle - right, middle - left)
    width = outer - inner
    if inner > 0 and truncated_edges(track.box[None], (shape[0], shape[1]))[0, 2 if to_right else 0]:
        lateral = inner * (distance + camera.vehicle_length_m) / focal + camera.vehicle_width_m / 2
    else:
        side_px = min(camera.vehicle_length_m * max(inner, 0.0) / distance, 0.6 * width)
        lateral = (inner + outer + side_px) / 2 * distance / focal
    edge_px = math.hypot(camera.bottom_std_px * camera.pixel_scale, camera.box_std * width)
    slant = math.hypot(1.0, lateral / distance)
    return RoadPosition(
        lateral if to_right else -lateral, distance, std * slant, edge_px * distance / focal * slant
    )


class BirdsEyePanel:
    """Draws a bird's-eye view into frames of ``(height, width, ...)``: in their corner, or beside them."""

    def __init__(
        self,
        shape: tuple[int, ...],
        place: Literal["corner", "side"],
        units: Literal["metric", "imperial"] = "metric",
    ) -> None:
        self.shape, self._place = shape[:2], place
        height, width = self.side_size(shape) if place == "side" else self.corner_size(shape)
        self._width = width
        self._scale = height / (_AHEAD_M + _BEHIND_M)  # pixels per meter
        # Large frames are shown smaller than small ones.
        enlarged = math.sqrt(max(shape[0] / 1080, 1.0))
        self._text_scale = max(0.3, min(0.4 * math.sqrt(height / 300) * enlarged, 4.0))
        self._line = max(1, round(height / _LINE_HEIGHT))
        self._has_text = height >= _MIN_TEXT_HEIGHT
        self._texts: list[Rectangle] = []  # of the grid
        self._grid = self._draw_grid(height, width, units)
        self._dark = (self._grid * _BACKGROUND_ALPHA).astype(np.uint8)
        self._trails: dict[int, Trail] = {}  # by track id

    @staticmethod
    def side_size(shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width of a view beside frames of this shape, which makes the whole width even."""
        width = max(32, round(_SIDE_WIDTH * shape[0]))
        return shape[0], width + (shape[1] + width) % 2

    @staticmethod
    def corner_size(shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width of a view in the corner of frames of this shape."""
        height = max(32, round(_CORNER_HEIGHT * shape[0]))
        return min(height, shape[0]), min(max(16, round(_ASPECT * height)), shape[1])

    def draw(
        self,
        canvas: Image,
        tracks: Sequence[Track],
        colors: Sequence[Color],
        camera: Camera,
        shape: tuple[int, ...],
        time: float,
    ) -> Rectangle:
        """Draw tracks into a canvas, which is wider than the frame for a view beside it; return the place."""
        height, width = self._grid.shape[:2]
        left = shape[1] if self._place == "side" else shape[1] - width
        view = canvas[:height, left : left + width]
        view[:] = self._grid if self._place == "side" else cv2.add(cv2.LUT(view, _DIMMED), self._dark)
        positions = {track.id: road_position(track, camera, shape) for track in tracks}
        points = {key: position and self._point(*position[:2]) for key, position in positions.items()}
        self._update_trails(time, points)
        shown = [  # the vehicles that lie in the view as a whole
            (position, track, color)
            for track, color in zip(tracks, colors, strict=True)
            if (position := positions[track.id]) is not None
            and position.distance_m + camera.vehicle_length_m <= _AHEAD_M
            and abs(position.lateral_m) + camera.vehicle_width_m / 2 <= self._width / 2 / self._scale
        ]
        # Far to near, and all ellipses below all vehicles.
        shown.sort(key=lambda entry: -entry[0].distance_m)
        for position, _, color in shown:
            self._draw_ellipse(view, position, color)
        for position, track, color in shown:
            trail = [*(point for _, point in self._trails[track.id]), points[track.id]]
            cv2.polylines(view, [np.array(trail, np.int32)], False, color, self._line, cv2.LINE_AA, _SHIFT)
            self._draw_vehicle(view, track, position, color, camera)
        if self._has_text:
            self._write_numbers(view, [(position, track.id) for position, track, _ in shown], camera)
        return left, 0, left + width, height

    def _update_trails(self, time: float, points: Mapping[int, Point | None]) -> None:
        """Add the points of a frame, at most one per 0.08 s and track."""
        self._trails = {key: self._trails.get(key) or deque() for key in points}
        for key, trail in self._trails.items():
            point = points[key]
            if point is not None and not (trail and time < trail[-1][0] + _TRAIL_STEP):
                trail.append((time, point))
            while trail and trail[0][0] < time - _TRAIL_SECONDS:
                trail.popleft()

    def _draw_grid(self, height: int, width: int, units: str) -> Image:
        """Draw lanes, lines across the road with their distances, and the own car."""
        grid = np.full((height, width, 3), _BACKGROUND, np.uint8)
        lanes = int(width / 2 / self._scale / _LANE_WIDTH_M + 0.5)
        for number in range(-lanes, lanes):
            x = self._column((number + 0.5) * _LANE_WIDTH_M)
            cv2.line(grid, (x, 0), (x, height), _GRID_COLOR, self._line)
        chosen = UNITS[units]
        for distance in _RANGES[units]:
            y = self._row(distance / chosen.distance)
            cv2.line(grid, (0, y), (width, y), _GRID_COLOR, self._line)
            scale = self._text_scale
            text = f"{distance} {chosen.distance_symbol}"
            if self._has_text:
                top = y - drawing.cap_height(scale) - 6
                drawing.draw_text(grid, [text], 0, top, scale, _TEXT_COLOR)
                right, bottom = np.add((0, top), drawing.text_size([text], scale)).tolist()
                self._texts.append((0, top, right, bottom))
        length, half = 4.2, 0.9
        corners = [(-half, -length), (half, -length), (half, -1.2), (0.0, 0.3), (-half, -1.2)]
        cv2.fillPoly(grid, [self._pixels(corners)], _OWN_COLOR, cv2.LINE_AA, _SHIFT)
        return grid

    def _draw_ellipse(self, panel: Image, position: RoadPosition, color: Color) -> None:
        """Fill the area within one standard error of a position, in a dark shade."""
        x, z = position.lateral_m, position.distance_m
        shade = tuple(
            round(_ELLIPSE_ALPHA * value + (1 - _ELLIPSE_ALPHA) * dark)
            for value, dark in zip(color, _BACKGROUND, strict=True)
        )
        center = self._point(x, z)
        unit = self._scale * (1 << _SHIFT)
        axes = [max(1, round(min(std * unit, 1e6))) for std in position[2:]]
        angle = math.degrees(math.atan2(-z, x))
        cv2.ellipse(panel, center, axes, angle, 0, 360, shade, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def _draw_vehicle(
        self, panel: Image, track: Track, position: RoadPosition, color: Color, camera: Camera
    ) -> None:
        """Draw a vehicle, filled unless it is coasting, and an arrow to where it is in a second."""
        x, z = position.lateral_m, position.distance_m
        half, length = camera.vehicle_width_m / 2, camera.vehicle_length_m
        corners = self._pixels([(x - half, z), (x + half, z), (x + half, z + length), (x - half, z + length)])
        if track.state == "coasting":
            cv2.polylines(panel, [corners], True, color, self._line, cv2.LINE_AA, _SHIFT)
        else:
            cv2.fillPoly(panel, [corners], color, cv2.LINE_AA, _SHIFT)
        speed = track.speed_mps
        if speed is not None and abs(speed) > 1.0 and (track.speed_std_mps or 0.0) <= MAX_SPEED_STD:
            start = z + length if speed > 0 else z
            first, last = (self._column(x), self._row(start)), (self._column(x), self._row(start + speed))
            tip = min(0.4, max(3.0, self._scale) / max(abs(last[1] - first[1]), 1))
            cv2.arrowedLine(panel, first, last, _OWN_COLOR, self._line, cv2.LINE_AA, 0, tip)

    def _write_numbers(self, panel: Image, shown: list[tuple[RoadPosition, int]], camera: Camera) -> None:
        """Write the numbers of tracks beside their vehicles, nearest ones first, where nothing is hidden."""
        half, length = camera.vehicle_width_m / 2 + 0.3, camera.vehicle_length_m
        taken: list[Rectangle] = list(self._texts)
        for (x, z, *_), _ in shown:
            left, right = self._column(x - half), self._column(x + half)
            taken.append((left, self._row(z + length), right, self._row(z)))
        vehicles = taken[len(self._texts) :]
        for (_, track_id), (left, top, right, bottom) in reversed(list(zip(shown, vehicles))):
            text = [str(track_id)]
            width, height = drawing.text_size(text, self._text_scale)
            row, column = (top + bottom - height) // 2, (left + right - width) // 2
            for x, y in ((right, row), (left - width, row), (column, bottom), (column, top - height)):
                place = x, y, x + width, y + height
                inside = x >= 0 and y >= 0 and place[2] <= self._width and place[3] <= len(panel)
                if inside and not drawing.hidden_area(place, taken):
                    drawing.draw_text(panel, text, x, y, self._text_scale, _OWN_COLOR)
                    taken.append(place)
                    break

    def _column(self, lateral_m: float) -> int:
        return round(self._width / 2 + lateral_m * self._scale)

    def _row(self, distance_m: float) -> int:
        return round((_AHEAD_M - distance_m) * self._scale)

    def _point(self, lateral_m: float, distance_m: float) -> Point:
        """Fixed-point pixel of a position in meters."""
        unit, middle = self._scale * (1 << _SHIFT), self._width / 2 * (1 << _SHIFT)
        column, row = middle + lateral_m * unit, (_AHEAD_M - distance_m) * unit
        return round(min(max(column, -_FAR), _FAR)), round(min(max(row, -_FAR), _FAR))

    def _pixels(self, points: Iterable[tuple[float, float]]) -> NDArray[np.int32]:
        """``(N, 2)`` fixed-point pixels of points given by lateral position and distance in meters."""
        return np.array([self._point(*point) for point in points], np.int32)


class OwnSpeed(Protocol):
    """Speed of the camera's own vehicle."""

    def at(self, times: float, /) -> Any:
        """Speed in m/s at a time of the video in seconds; NaN if unknown."""


class Annotator:
    """Draws everything that an annotated video shows, and remembers what the next frame needs.

    These are the places of the labels and the trails of the bird's-eye view, so the frames of a video are
    drawn in their order. A frame drawn again is drawn alike; an earlier frame starts anew.

    Parameters
    ----------
    style
        Labels, lines, colors and bird's-eye view.
    camera
        The camera, for the bird's-eye view; None: a typical dash-cam.
    heat
        How windows become the heat map of `diagnostics`.
    own_speed
        Speed of the camera's own vehicle over the time of the video (`read_own_speed`). Where it is known,
        labels state speeds over ground, without a sign; otherwise speeds relative to the camera.
    blur
        Blur the vehicles, ``"vehicles"``, or the region of their license plates, ``"plates"``: of every
        detection and track of the frame, also of tracks that are not detected or not shown. Vehicles that are
        not found are not blurred: check the result before you publish it.
    diagnostics
        Show the frame, its positive windows, the heat map and the tracks side by side, as `draw_diagnostics`.

    >>> Annotator(DrawParams(panel="side")).output_shape((720, 1280))
    (720, 1496, 3)
    """

    def __init__(
        self,
        style: DrawParams | None = None,
        *,
        camera: Camera | None = None,
        heat: HeatParams | None = None,
        own_speed: OwnSpeed | None = None,
        blur: Literal["vehicles", "plates"] | None = None,
        diagnostics: bool = False,
    ) -> None:
        check.instance(style, "style", DrawParams | None, "omit it for the default")
        check.instance(heat, "heat", HeatParams | None, "omit it for the default")
        check.instance(camera, "camera", Camera | None, "pass what open_camera returns")
        if own_speed is not None and not callable(getattr(own_speed, "at", None)):
            got = describe(own_speed)
            raise InvalidInputError(f"own_speed must have a method at, got {got}; pass read_own_speed(...)")
        if blur is not None:
            check.choice(blur, "blur", drawing.BLUR_REGIONS)
        check.flags(diagnostics=diagnostics)
        self.style = style or DrawParams()
        self.camera, self.heat, self.own_speed = camera, heat, own_speed
        self.blur, self.diagnostics = blur, diagnostics
        self.reset()

    def with_defaults(self, *, camera: Camera, heat: HeatParams | None) -> Self:
        """Return a copy, without memory, that has a camera and heat parameters where this has none."""
        other = copy.copy(self)
        other.camera, other.heat = self.camera or camera, self.heat or heat
        other.reset()
        return other

    @property
    def needs_every_frame(self) -> bool:
        """Whether frames that are not searched lack something to draw: windows, or boxes to blur."""
        return self.diagnostics or self.blur is not None

    def reset(self, *, fps: float | None = None) -> None:
        """Forget all frames, before the first frame of another video; `fps` is for results without times."""
        self._fps = USUAL_FPS if fps is None else check.number(fps, "fps", above=0)
        self._placer = drawing.LabelPlacer()
        self._panel: BirdsEyePanel | None = None
        self._time = -math.inf
        self._coasting: set[int] = set()  # in the last searched frame

    def output_shape(self, shape: tuple[int, ...]) -> tuple[int, int, int]:
        """Shape of a picture for frames of ``(height, width, ...)``; a view beside it adds columns."""
        height, width = check.shape(shape)
        beside = self.style.panel == "side" and not self.diagnostics
        return height, width + (BirdsEyePanel.side_size(shape)[1] if beside else 0), 3

    def draw(self, frame: Image, result: FrameResult) -> Image:
        """Draw a result on a copy of its ``(H, W, 3)`` uint8 RGB frame."""
        check.image(frame, "frame")
        check.instance(result, "result", FrameResult, "pass what process or track returns")
        if self.blur is not None:
            tracked = np.array([track.box for track in result.tracks]).reshape(-1, 4)
            frame = drawing.blur_boxes(
                frame, np.concatenate([tracked, result.detections.boxes]), region=self.blur
            )
        if self.diagnostics:
            heat = frame_heat(frame.shape, result.windows, self.heat or HeatParams())
            return draw_diagnostics(frame, result.windows, heat, result.tracks, params=self.style)
        time = result.index / self._fps if result.time is None else result.time
        return self.draw_tracks(frame, result.tracks, time=time, searched=result.searched)

    def draw_tracks(
        self, image: Image, tracks: Iterable[Track], *, time: float | None = None, searched: bool = True
    ) -> Image:
        """Draw the tracks of a frame at `time` seconds on a copy of it; None: it follows no other frame.

        If the frame was not searched, the boxes are dashed that were not detected in the last searched one.
        """
        shape, style = check.image(image).shape, self.style
        time = None if time is None else check.number(time, "time")
        searched = check.boolean(searched, "searched")
        shown = sorted((track for track in _check_tracks(tracks) if track.shown), key=lambda track: track.id)
        own_mps = math.nan if self.own_speed is None or time is None else float(self.own_speed.at(time))
        if time is None or time < self._time:
            self.reset(fps=self._fps)
        self._time = -math.inf if time is None else time
        coasting = {track.id for track in shown if track.state == "coasting"}
        if searched:
            self._coasting = coasting
        colors = [drawing.track_color(track, style.color_by) for track in shown]
        beside = BirdsEyePanel.side_size(shape)[1] if style.panel == "side" else 0
        result = np.empty((shape[0], shape[1] + beside, 3), np.uint8)
        frame = result[:, : shape[1]]
        frame[:] = image
        blocked: list[Rectangle] = []
        if style.panel != "none":
            if self._panel is None or self._panel.shape != shape[:2]:
                self._panel = BirdsEyePanel(shape, style.panel, style.units)
            view = Camera.for_frame(shape) if self.camera is None else self.camera.for_shape(shape)
            blocked.append(self._panel.draw(result, shown, colors, view, shape, self._time))
        width = style.line_width or drawing.line_width_for(shape)
        dashed = coasting & self._coasting
        # Far to near: the boxes of near vehicles cover those behind them.
        for track, color in sorted(zip(shown, colors), key=lambda pair: float(pair[0].box[3])):
            drawing.draw_outline(frame, drawing.round_box(track.box), color, width, dashed=track.id in dashed)
        speed = own_mps if math.isfinite(own_mps) else None
        fields = [tuple(track_fields(track, style.labels, style.units, speed)) for track in shown]
        requests = [
            drawing.LabelRequest(track.id, each, drawing.round_box(track.box))
            for track, each in zip(shown, fields)
        ]
        drawing.draw_labels(frame, self._placer.place(requests, shape, blocked), colors, width)
        return result


def draw_tracks(
    image: Image,
    tracks: Iterable[Track],
    *,
    labels: Collection[str] = ("id", "distance", "speed"),
    line_width: int | None = None,
    color_by: Literal["id", "distance"] = "id",
) -> Image:
    """Draw tracks on a copy of an image, each with a box and a label; options as in `DrawParams`.

    Only tracks with ``track.shown`` are drawn; those without a detection in this frame have dashed boxes.
    Labels are placed where they hide neither other labels nor other vehicles, if necessary on leader lines or
    without their last fields. In a video, an `Annotator` also keeps each label in its place.

    >>> from vehicle_detection import Detections, Tracker
    >>> road = np.zeros((720, 1280, 3), np.uint8)
    >>> tracks = Tracker().update(Detections([[600, 400, 700, 480]], [2.0]), road.shape)
    >>> draw_tracks(road, tracks, labels=["id"])[400, 650].tolist(), road[400, 650].tolist()
    ([230, 159, 0], [0, 0, 0])
    """
    style = DrawParams(labels=labels, line_width=line_width, color_by=color_by)
    return Annotator(style).draw_tracks(image, tracks)


def track_fields(
    track: Track, fields: Collection[str], units: str = "metric", own_mps: float | None = None
) -> list[str]:
    """Texts of the known fields of a track's label, such as ["#3", "24 m", "-6 km/h"].

    With the own speed the speed is that over ground, such as "94 km/h".
    """
    with_std, chosen = "std" in fields, UNITS[units]
    parts = [track.name] if "id" in fields else []
    if "score" in fields:
        parts.append(f"{track.score:.1f}" if track.confidence is None else f"{track.confidence:.0%}")
    if "distance" in fields and track.distance_m is not None and track.distance_std_m is not None:
        parts.append(chosen.distance_text(track.distance_m, track.distance_std_m, with_std=with_std))
    if "speed" in fields and track.speed_mps is not None and (track.speed_std_mps or 0) <= MAX_SPEED_STD:
        relative = own_mps is None
        speed = track.speed_mps if own_mps is None else abs(own_mps + track.speed_mps)
        parts.append(chosen.speed_text(speed, track.speed_std_mps, with_std=with_std, signed=relative))
    return parts


def _check_tracks(tracks: object) -> list[Track]:
    """Return tracks as a list."""
    listed: list[Any] = list(tracks) if is_listing(tracks) else [None]
    if not all(isinstance(track, Track) for track in listed):
        raise invalid("tracks", "be Track objects", tracks, "pass what update returns")
    return listed


def draw_diagnostics(
    frame: Image,
    windows: Detections | ArrayLike,
    heat: NDArray[Any],
    tracks: Iterable[Track],
    *,
    params: DrawParams | None = None,
) -> Image:
    """Draw a 2x2 mosaic of the frame's shape: the frame, its positive windows, the heat map, the tracks.

    `windows` are boxes as in `draw_boxes`; `heat` holds ``(h, w)`` finite numbers, of the frame's size or
    smaller, drawn from black (0) to yellow (maximum); `params` says how tracks are drawn.

    >>> road, windows = np.zeros((720, 1280, 3), np.uint8), [[600, 400, 700, 480]]
    >>> draw_diagnostics(road, windows, np.zeros((90, 160)), []).shape
    (720, 1280, 3)
    """
    if params is not None:
        check.instance(params, "params", DrawParams, "omit it for the defaults")
    checked = check.image(frame, "frame")
    height, width = (side // 2 for side in checked.shape[:2])
    if min(height, width) < 2:
        raise invalid("frame", "be at least 4x4 pixels", frame, "pass a larger image")
    # Draw at the panels' size, so that lines and text stay sharp.
    small = np.asarray(cv2.resize(checked, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    scale = np.array([width, height, width, height]) / np.array(checked.shape[:2] * 2)[[1, 0, 1, 0]]
    boxes = check.boxes(windows)
    scaled = [dataclasses.replace(track, box=track.box * scale) for track in _check_tracks(tracks)]
    style = dataclasses.replace(params or DrawParams(), panel="none")
    panels = {
        "frame": small,
        "windows": drawing.draw_boxes(small, boxes * scale, color=drawing.TRACK_COLORS[1], thickness=1),
        "heat": cv2.resize(drawing.heat_image(heat), (width, height)),
        "tracks": Annotator(style).draw_tracks(small, scaled),
    }
    mosaic = np.zeros(checked.shape, np.uint8)  # not zeros_like: OpenCV needs rows in C order
    for index, (title, panel) in enumerate(panels.items()):
        top, left = index // 2 * height, index % 2 * width
        view = mosaic[top : top + height, left : left + width]
        view[:] = panel
        scale = drawing.text_scale(view.shape)
        title_width, title_height = drawing.text_size([title], scale)
        drawing.fill_rectangle(view, (0, 0, title_width, title_height), drawing.BLACK, 0.6)
        drawing.draw_text(view, [title], 0, 0, scale, drawing.WHITE)
    return mosaic
