"""Tracks over a whole video, and their motion: distance, lateral position and time to collision.

At a constant relative speed, the reciprocal of a vehicle's size in the image is a straight line over time,
and its zero is the moment of the collision. This needs neither the focal length nor the vehicle's size: Lee,
"A theory of visual control of braking based on information about time-to-collision" (Perception 1976).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.drawing import color_index
from vehicle_detection.tables import TrackTable

COLUMNS = ("distance_m", "distance_std_m", "speed_mps", "speed_std_mps", "confidence", "time_since_update")
"""Values of a track in each frame; NaN if unknown."""


class ClosestApproach(NamedTuple):
    """Smallest distance of a track."""

    frame: int
    distance_m: float
    std_m: float | None


@dataclass(frozen=True, eq=False)
class TrackHistory:
    """One track over the whole video."""

    id: int
    frames: NDArray[np.int64]  # (N,) indices of the frames that show the track, ascending
    boxes: Floats  # (N, 4) [x1, y1, x2, y2]; NaN if unknown
    columns: dict[str, Floats]  # (N,) for each name of COLUMNS
    times: Floats | None = None  # (N,) seconds; None: frames are evenly spaced

    @property
    def first(self) -> int:
        """First frame that shows the track."""
        return int(self.frames[0])

    @property
    def last(self) -> int:
        """Last frame that shows the track."""
        return int(self.frames[-1])

    @property
    def color(self) -> int:
        """Index of the track's color in `TRACK_COLORS`, as in the video."""
        return color_index(self.id)

    @property
    def mean_confidence(self) -> float | None:
        """Mean of the known confidences; None if none is known."""
        confidences = self.columns["confidence"]
        known = confidences[np.isfinite(confidences)]
        return float(known.mean()) if known.size else None

    def spans(self, max_step: int = 1) -> list[tuple[int, int]]:
        """Half-open ranges of frames that show the track; frames up to `max_step` apart share a range."""
        runs = [self.frames[run] for run in split_runs(self.frames, max_step)]
        return [(int(run[0]), int(run[-1]) + 1) for run in runs]

    def closest_approach(self, fps: float) -> ClosestApproach | None:
        """Minimum of the running median of the distance; None if no distance is known."""
        distances, stds = self.columns["distance_m"], self.columns["distance_std_m"]
        known = np.flatnonzero(np.isfinite(distances))
        if not known.size:
            return None
        # A median over a third of a second, so that a single outlier does not count.
        width = min(max(round(1 / 3 * fps), 1), known.size)
        width -= 1 - width % 2  # so that the median is the distance of one frame
        medians = np.median(np.lib.stride_tricks.sliding_window_view(distances[known], width), axis=1)
        start = int(np.argmin(medians))
        window = known[start : start + width]
        # The frame to seek to: the one whose distance is closest to the median.
        best = window[int(np.argmin(np.abs(distances[window] - medians[start])))]
        std = float(np.median(stds[window]))
        frame, distance = int(self.frames[best]), float(medians[start])
        return ClosestApproach(frame, distance, std if math.isfinite(std) else None)


def track_histories(table: TrackTable) -> list[TrackHistory]:
    """Return the tracks of a table in the order of their first frames."""
    times = table.times()
    histories = []
    for track_id, rows in table.by_track().items():
        frames, columns = rows["frame"].astype(np.int64), {name: rows[name] for name in COLUMNS}
        of_frames = None if times is None else times[frames]
        histories.append(TrackHistory(track_id, frames, rows.boxes, columns, of_frames))
    return histories


def bin_means(frames: NDArray[np.int64], values: Floats, width: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the bins of `width` frames that have known values, and the means of these values."""
    known = np.isfinite(values)
    bins, inverse, counts = np.unique(frames[known] // width, return_inverse=True, return_counts=True)
    return bins, np.bincount(inverse, values[known], len(bins)) / counts


def split_runs(numbers: NDArray[np.int64], max_step: int = 1) -> list[slice]:
    """Slices of an ascending array in which each number is at most `max_step` above the one before."""
    edges = [0, *(np.flatnonzero(np.diff(numbers) > max_step) + 1).tolist(), len(numbers)]
    return [slice(start, stop) for start, stop in pairwise(edges) if stop > start]


Bools = NDArray[np.bool_]

LANE_HALF_WIDTH_M = 1.8
"""Half of the width of a lane."""

# Half of the span (s) of a local line, and the shortest span that gives a slope.
_HALF_SPAN, _MIN_SPAN = 0.75, 0.2
# Least relative standard error of a box's size, and time (s) over which it is correlated.
_SIZE_STD, _SIZE_TIME = 0.04, 0.5
# Standard errors of the camera's heading (rad), and of the column of a vehicle's middle (m).
_HEADING_STD, _MIDDLE_STD = math.radians(1.5), 0.3
# Height of a vehicle (m) whose distance is never known, and its relative standard error.
_HEIGHT_M, _HEIGHT_STD = 1.55, 0.25


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of one track relative to the camera, ``(N,)`` arrays by frame; NaN if unknown."""

    track: TrackHistory
    seconds: Floats  # time since the first frame of the video
    distance: Floats  # m along the road
    distance_std: Floats
    closing: Floats  # m/s, positive when approaching
    closing_std: Floats
    lateral: Floats  # m from the camera to the vehicle's middle, positive to the right
    lateral_std: Floats
    lateral_rate: Floats  # m/s
    time_to_collision: Floats  # s; negative when moving away: time since the vehicle was beside the camera
    time_to_collision_std: Floats
    slope_error: Floats  # relative standard error of the rate at which the vehicle grows or shrinks
    at_side: NDArray[np.int64]  # -1 and 1 where the left and the right border of the frame truncates the box
    is_cut: Bools  # where any border of the frame truncates the box
    outward: (
        Floats  # column of the box's middle: 0 at the middle of the frame, 1 at its left and right border
    )

    @property
    def in_path(self) -> Bools:
        """Where the vehicle is in the lane of the camera, by at least one standard error."""
        return np.asarray(np.abs(self.lateral) < LANE_HALF_WIDTH_M - self.lateral_std)

    @property
    def beside_path(self) -> Bools:
        """Where the vehicle is in another lane, by at least one standard error."""
        return np.asarray(np.abs(self.lateral) > LANE_HALF_WIDTH_M + self.lateral_std)


def estimate_motion(track: TrackHistory, *, fps: float, shape: tuple[int, int], camera: Camera) -> Motion:
    """Estimate the motion of a track in frames of this shape."""
    boxes, seconds = track.boxes, track.frames / fps if track.times is None else track.times
    truncated = truncated_edges(boxes, shape)
    boxes = camera.rectify_boxes(boxes, shape)
    width, height = (np.maximum(boxes[:, axis + 2] - boxes[:, axis], 1.0) for axis in (0, 1))
    cut_above, cut_beside = truncated[:, [1, 3]].any(axis=1), truncated[:, [0, 2]].any(axis=1)
    # In other lanes a box shows the vehicle's side too, which makes its width unsuitable.
    size = np.where(cut_above, np.nan, height)
    scale, scale_std = _scale(track, size, camera)
    distance = scale / size
    lateral, lateral_std = _lateral(boxes, distance, scale_std, shape, camera)
    ahead = (np.abs(lateral) < LANE_HALF_WIDTH_M) & ~cut_beside & ~cut_above
    inverse = np.where(ahead, 1 / np.sqrt(width * height), np.nan)
    # Both inverse sizes have the unit of the reciprocal height, so that a track may change between them.
    ratio = np.nanmedian(inverse * size) if np.isfinite(inverse * size).any() else 1.0
    inverse = np.where(np.isfinite(inverse), inverse / ratio, 1 / size)
    # The border of the frame cuts the height and the outer edge of a vehicle off, too.
    inverse, uncut = (np.where(cut_beside, np.nan, each) for each in (inverse, lateral))
    value, slope, span, mean, scatter = local_lines(seconds, inverse)
    with np.errstate(divide="ignore", invalid="ignore"):
        time = -value / slope
        count = np.maximum(span / _SIZE_TIME, 2.0)
        # The mean of the values and the slope have independent errors, unlike the value at an end of the
        # track, so that the error of the zero is relative to its distance from the mean time (Draper and
        # Smith, *Applied Regression Analysis*, chapter 3, inverse regression).
        mean_std = np.maximum(_SIZE_STD * mean, scatter) / np.sqrt(count)
        slope_std = mean_std * np.sqrt(12) / span
        slope_error = slope_std / np.abs(slope)
        time_std = np.hypot(mean_std, slope_std * mean / slope) / np.abs(slope)
    closing = -scale * slope
    return Motion(
        track=track,
        seconds=seconds,
        distance=distance,
        distance_std=distance * scale_std,
        closing=closing,
        closing_std=np.hypot(scale * slope_std, closing * scale_std),
        lateral=lateral,
        lateral_std=lateral_std,
        lateral_rate=local_lines(seconds, uncut)[1],
        time_to_collision=time,
        time_to_collision_std=time_std,
        slope_error=slope_error,
        at_side=truncated[:, 2].astype(np.int64) - truncated[:, 0],
        is_cut=np.asarray(truncated.any(axis=1)),
        outward=np.abs(track.boxes[:, [0, 2]].mean(axis=1) / (shape[1] / 2) - 1),
    )


def _scale(track: TrackHistory, size: Floats, camera: Camera) -> tuple[float, float]:
    """Distance times size in pixels, which is constant for a vehicle, and its relative standard error."""
    distance = track.columns["distance_m"]
    products = distance * size
    known = np.isfinite(products)
    if not known.any():
        return camera.focal_px * _HEIGHT_M, _HEIGHT_STD
    stds = track.columns["distance_std_m"][known] / distance[known]
    usual = float(np.nanmedian(stds)) if np.isfinite(stds).any() else _HEIGHT_STD
    return float(np.median(products[known])), usual


def _lateral(
    boxes: Floats, distance: Floats, distance_std: float, shape: tuple[int, int], camera: Camera
) -> tuple[Floats, Floats]:
    """Lateral position of the vehicle's near end, which lies at the outer edge of its rectified box."""
    middle = shape[1] / 2
    width = np.maximum(boxes[:, 2] - boxes[:, 0], 1.0)
    face = np.minimum(camera.focal_px * camera.vehicle_width_m / distance, width)
    right = (boxes[:, 0] + boxes[:, 2]) / 2 > middle
    column = np.where(right, boxes[:, 2] - face / 2, boxes[:, 0] + face / 2)
    lateral = (column - middle) * distance / camera.focal_px
    std = np.sqrt(np.square(_HEADING_STD * distance) + _MIDDLE_STD**2 + np.square(lateral * distance_std))
    return lateral, std


def local_lines(seconds: Floats, values: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Straight lines through the values around each time; NaN if unknown.

    Returns the value and the slope of each, the span (s) and the mean of its values, and their standard
    deviation from it.
    """
    known = np.isfinite(values)
    t, y = np.where(known, seconds - seconds[0], 0.0), np.where(known, values, 0.0)
    sums = [np.concatenate(([0.0], np.cumsum(each))) for each in (known, t, y, t * t, t * y, y * y)]
    first = np.searchsorted(seconds, seconds - _HALF_SPAN - 1e-9)
    last = np.searchsorted(seconds, seconds + _HALF_SPAN + 1e-9)
    count, st, sy, stt, sty, syy = (each[last] - each[first] for each in sums)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = stt - st * st / count
        slope = (sty - st * sy / count) / variance
        mean = sy / count
        value = mean + slope * (seconds - seconds[0] - st / count)
        span = np.sqrt(12 * variance / count)  # of as many values, evenly spread
        squares = syy - sy * mean - slope * (sty - st * mean)
        scatter = np.sqrt(np.maximum(squares, 0.0) / np.maximum(count - 2, 1))
    slope = np.where((span >= _MIN_SPAN) & (count >= 3), slope, np.nan)
    return np.where(count > 0, value, np.nan), slope, span, mean, scatter
