"""Bird's-eye view of tracks: their positions on the road in meters, and a top view drawn into a video."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.drawing.primitives import (
    Color,
    Image,
    Rectangle,
    cap_height,
    draw_text,
    text_size,
)
from vehicle_detection.tracking import Track
from vehicle_detection.units import UNITS

Point = tuple[int, int]
Trail = deque[tuple[float, Point]]
"""Times in seconds, and positions in pixels, of a track in the last frames."""

LANE_WIDTH_M = 3.6
"""Distance between the lines of the grid, where the camera is in the middle of its lane."""

MAX_SPEED_STD = 3.0
"""Speeds with a larger standard error, in m/s, are not shown."""

TRAIL_SECONDS = 1.5
"""Time that a trail covers."""

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


class Trails:
    """Positions of tracks in the last frames."""

    def __init__(self) -> None:
        self._trails: dict[int, Trail] = {}

    def update(self, time: float, points: Mapping[int, Point | None]) -> dict[int, Trail]:
        """Add the points of a frame by track id, at most one per 0.08 s; return all trails."""
        trails = {key: self._trails.get(key) or deque() for key in points}
        for key, trail in trails.items():
            point = points[key]
            if point is not None and not (trail and time < trail[-1][0] + _TRAIL_STEP):
                trail.append((time, point))
            while trail and trail[0][0] < time - TRAIL_SECONDS:
                trail.popleft()
        self._trails = trails
        return trails


class BirdsEyePanel:
    """Draws a bird's-eye view into a video: in a corner of the frame, or beside it.

    Parameters
    ----------
    shape, place
        ``(height, width, ...)`` of the frames, and where to draw.
    units
        Units of the distances, ``"metric"`` or ``"imperial"``.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        place: Literal["corner", "side"],
        units: Literal["metric", "imperial"] = "metric",
    ) -> None:
        self._shape, self._place = shape[:2], place
        height, width = self.side_size(shape) if place == "side" else self.corner_size(shape)
        self._width = width
        self._scale = height / (_AHEAD_M + _BEHIND_M)  # pixels per meter
        # Large frames are shown smaller than small ones.
        enlarged = math.sqrt(max(shape[0] / 1080, 1.0))
        self._text_scale = max(0.3, min(0.4 * math.sqrt(height / 300) * enlarged, 4.0))
        self._line = max(1, round(height / _LINE_HEIGHT))
        self._has_text = height >= _MIN_TEXT_HEIGHT
        self._grid = self._draw_grid(height, width, units)
        self._dark = (self._grid * _BACKGROUND_ALPHA).astype(np.uint8)
        self._trails = Trails()

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

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether the view was made for frames of this shape."""
        return self._shape == shape[:2]

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
        trails = self._trails.update(time, points)
        shown = [
            (position, track, color)
            for track, color in zip(tracks, colors, strict=True)
            if (position := positions[track.id]) is not None and position.distance_m < _AHEAD_M
        ]
        # Far to near, and all ellipses below all vehicles.
        shown.sort(key=lambda entry: -entry[0].distance_m)
        for position, _, color in shown:
            self._draw_ellipse(view, position, color)
        for position, track, color in shown:
            trail = [*(point for _, point in trails[track.id]), points[track.id]]
            cv2.polylines(view, [np.array(trail, np.int32)], False, color, self._line, cv2.LINE_AA, _SHIFT)
            self._draw_vehicle(view, track, position, color, camera)
        if self._has_text:
            for position, track, _ in shown:
                self._write_number(view, track, position)
        return left, 0, left + width, height

    def _draw_grid(self, height: int, width: int, units: str) -> Image:
        """Draw lanes, lines across the road with their distances, and the own car."""
        grid = np.full((height, width, 3), _BACKGROUND, np.uint8)
        lanes = int(width / 2 / self._scale / LANE_WIDTH_M + 0.5)
        for number in range(-lanes, lanes):
            x = self._column((number + 0.5) * LANE_WIDTH_M)
            cv2.line(grid, (x, 0), (x, height), _GRID_COLOR, self._line)
        chosen = UNITS[units]
        for distance in _RANGES[units]:
            y = self._row(distance / chosen.distance)
            cv2.line(grid, (0, y), (width, y), _GRID_COLOR, self._line)
            scale = self._text_scale
            text = f"{distance} {chosen.distance_symbol}"
            if self._has_text:
                draw_text(grid, [text], 0, y - cap_height(scale) - 6, scale, _TEXT_COLOR)
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

    def _write_number(self, panel: Image, track: Track, position: RoadPosition) -> None:
        """Write the number of a track beside its vehicle."""
        text = [f"{track.id}"]
        width, height = text_size(text, self._text_scale)
        x = min(max(self._column(position.lateral_m + 1.2), 0), self._width - width)
        y = min(max(self._row(position.distance_m) - height, 0), len(panel) - height)
        draw_text(panel, text, x, y, self._text_scale, _OWN_COLOR)

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
