"""The road from above: positions of tracks in meters, with their errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vehicle_detection._common import check_number, check_sequence, check_shape, check_type
from vehicle_detection.annotator import (
    LANE_WIDTH_M,
    MAX_SPEED_STD,
    TRAIL_SECONDS,
    RoadPosition,
    road_position,
    track_color,
)
from vehicle_detection.camera import Camera
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.notebook import style
from vehicle_detection.tracking import FrameResult, Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Lanes drawn on either side, and the smallest distance that the figure covers (m).
_LANES, _MIN_AHEAD_M = 3, 40.0
_OWN_LENGTH_M = 4.5


def plot_birds_eye(
    results: FrameResult | Sequence[FrameResult],
    camera: Camera | None = None,
    *,
    shape: tuple[int, ...] = (720, 1280),
    fps: float = 25.0,
    trail_seconds: float = TRAIL_SECONDS,
    ax: Axes | None = None,
) -> Axes:
    """Plot the shown tracks of a frame from above, in meters, in the colors of the video.

    The camera is at the origin, in the middle of its lane. Each vehicle has its number, an ellipse of one
    standard error around the middle of its near end, and an arrow to where it is in a second, relative to the
    camera. Vehicles without a known distance are left out.

    Parameters
    ----------
    results
        The detector's result of a frame, or those of consecutive frames: the last one is plotted, and the
        others give the trails.
    camera, shape
        The camera, by default a typical dash-cam; and ``(height, width, ...)`` of the frames.
    fps, trail_seconds
        Frame rate, for results without a time; and the time that the trails cover.

    Examples
    --------
    >>> from vehicle_detection import Detections, Tracker
    >>> tracker = Tracker(fps=25)
    >>> for frame in range(25):
    ...     found = Detections([[700, 400, 800, 490]], [1.0])
    ...     tracks = tracker.update(found, (720, 1280, 3))
    >>> axes = plot_birds_eye(FrameResult(0, 0.0, found, found, tracks))
    >>> [text.get_text() for text in axes.texts]
    ['#1']
    """
    if isinstance(results, FrameResult):
        results = [results]
    listed = list(check_sequence(results, "results", "FrameResult"))
    for result in listed:
        check_type(result, "results", FrameResult, "pass what detector.process returns")
    if not listed:
        raise InvalidInputError("results must hold at least one frame, got none; pass a FrameResult")
    rate = check_number(fps, "fps", above=0, high=1e6)
    seconds = check_number(trail_seconds, "trail_seconds", low=0)
    frame = check_shape(shape)
    if camera is None:
        camera = Camera.for_frame(frame)
    check_type(camera, "camera", Camera, "pass a Camera, or None for a typical dash-cam")
    camera = camera.for_shape(frame)

    axes = style.new_axes(ax, 4.5, 7.0)
    last = listed[-1]
    times = [result.index / rate if result.time is None else result.time for result in listed]
    trails: dict[int, list[RoadPosition]] = {}
    for result, time in zip(listed, times):
        if times[-1] - seconds <= time <= times[-1]:
            for track in result.shown:
                position = road_position(track, camera, frame)
                if position is not None:
                    trails.setdefault(track.id, []).append(position)
    farthest = _MIN_AHEAD_M
    for track in last.shown:
        if road_position(track, camera, frame) is not None:
            trail = trails[track.id]
            _add_vehicle(axes, track, trail, camera)
            farthest = max(farthest, trail[-1].distance_m + camera.vehicle_length_m + trail[-1].radial_std_m)
    _add_road(axes)
    axes.set(
        xlim=(-(_LANES + 0.5) * LANE_WIDTH_M, (_LANES + 0.5) * LANE_WIDTH_M),
        ylim=(-1.5 * _OWN_LENGTH_M, 10 * math.ceil(farthest / 10)),
        aspect="equal",
        xlabel="to the right (m)",
        ylabel="distance (m)",
    )
    return axes


def _add_road(axes: Axes) -> None:
    """Add lines between lanes, and the own car."""
    from matplotlib.patches import Rectangle

    for lane in range(-_LANES, _LANES):
        axes.axvline((lane + 0.5) * LANE_WIDTH_M, color="0.8", linewidth=0.8, linestyle="--", zorder=0)
    axes.grid(axis="y", alpha=0.3)
    axes.add_patch(Rectangle((-0.9, -_OWN_LENGTH_M), 1.8, _OWN_LENGTH_M, facecolor="0.3"))


def _add_vehicle(axes: Axes, track: Track, trail: list[RoadPosition], camera: Camera) -> None:
    """Add a vehicle with its error ellipse, motion, number and trail, which ends at its position."""
    from matplotlib.patches import Ellipse, Rectangle

    color = [value / 255 for value in track_color(track)]
    x, z, radial_std, tangential_std = trail[-1]
    width, length = camera.vehicle_width_m, camera.vehicle_length_m
    angle = math.degrees(math.atan2(z, x))
    ellipse = Ellipse((x, z), 2 * radial_std, 2 * tangential_std, angle=angle, color=color, alpha=0.3, lw=0)
    axes.add_patch(ellipse)
    look: dict[str, Any] = {"facecolor": color, "edgecolor": "black"}
    if track.state == "coasting":
        look = {"facecolor": "none", "edgecolor": color, "linestyle": "--"}
    axes.add_patch(Rectangle((x - width / 2, z), width, length, linewidth=1.0, **look))
    axes.plot([each.lateral_m for each in trail], [each.distance_m for each in trail], color=color, lw=1.5)
    speed = track.speed_mps
    if speed is not None and abs(speed) > 1.0 and (track.speed_std_mps or 0.0) <= MAX_SPEED_STD:
        start = z + length if speed > 0 else z
        arrow = {"arrowstyle": "->", "color": "black", "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x, start + speed), (x, start), arrowprops=arrow)
    axes.text(x + 0.7 * width, z + length / 2, f"#{track.id}", va="center", fontsize=9, clip_on=True)
