"""Charts over the time of a video: where the template ``report.html.j2`` draws what, as SVG.

Horizontal positions are percentages of the width, so that a chart fits any screen; text sizes and heights are
pixels. Curves are drawn in a nested SVG that is stretched to the width, with lines of constant width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.drive.motion import TrackHistory, bin_means, split_runs

MAX_ROWS = 14
"""Largest number of tracks that get a row each; more tracks share rows."""

MIN_LABELED = 0.08
"""Fraction of the video that a track must last to be labeled inside a chart."""

_CURVE_WIDTH = 1000  # units across the nested SVG of the curves
_LABEL_WIDTH, _LABEL_HEIGHT = 5.0, 13.0  # percent of the chart's width, pixels
_MAX_SHIFT = 1.5 * _LABEL_HEIGHT  # largest distance of a label from the end of its line
_TICK_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200)  # seconds


class Label(NamedTuple):
    """The label of a track in a chart."""

    x: float  # percent
    y: float  # pixels from the top
    track: int


@dataclass(frozen=True)
class TimeAxis:
    """The horizontal axis: at least one frame, and the frame rate."""

    frames: int
    fps: float

    @property
    def seconds(self) -> float:
        """Duration of the video."""
        return self.frames / self.fps

    @property
    def bin_width(self) -> int:
        """Frames per point of a curve, of which there are at most 2000."""
        return math.ceil(self.frames / 2000)

    def percent(self, frame: float) -> float:
        """Position of the beginning of a frame, as a percentage of the width."""
        return frame / self.frames * 100

    def x(self, frame: float) -> str:
        """Position of a frame in the nested SVG of the curves."""
        return decimal(min(frame / self.frames, 1.0) * _CURVE_WIDTH)

    def ticks(self, max_ticks: int = 6) -> list[float]:
        """Round times in seconds from 0 on, at most about `max_ticks`."""
        step = next((step for step in _TICK_STEPS if self.seconds / step < max_ticks), 0)
        step = step or 3600 * math.ceil(self.seconds / 3600 / max_ticks)
        return [number * step for number in range(int(self.seconds / step) + 1)]

    def marks(self) -> list[tuple[float, str]]:
        """Positions (percent) and texts of the times below a chart."""
        ticks = self.ticks()
        tenths = ticks[1:2] < [1.0]
        return [(self.percent(each * self.fps), format_time(each, tenths=tenths)) for each in ticks]


@dataclass(frozen=True)
class ValueAxis:
    """The vertical axis: round values from `low` (bottom) to `high` (top), `height` pixels apart."""

    low: float
    high: float
    height: int
    ticks: tuple[float, ...]

    @classmethod
    def covering(
        cls, low: float, high: float, height: int, *, integers: bool = False, max_steps: int = 4
    ) -> ValueAxis:
        """Smallest axis with round ticks that contains `low` and `high`."""
        extent = max(high - low, 1e-6)
        power = 10.0 ** math.floor(math.log10(extent / max_steps))
        step = next(each * power for each in (1, 2, 5, 10) if each * power * max_steps >= extent * 0.999)
        step = max(step, 1.0) if integers else step
        first = math.floor(low / step + 1e-9)
        last = max(math.ceil(high / step - 1e-9), first + 1)
        return cls(first * step, last * step, height, tuple(n * step for n in range(first, last + 1)))

    def y(self, value: float) -> float:
        """Pixels from the top."""
        return (self.high - value) / (self.high - self.low) * self.height

    def marks(self) -> list[tuple[float, str]]:
        """Positions and texts of the ticks."""
        return [(self.y(tick), format_value(float(tick))) for tick in self.ticks]


def assign_rows(tracks: Sequence[TrackHistory], axis: TimeAxis) -> list[int]:
    """Row of each track: its own, or of many tracks the first in which it does not touch an earlier one."""
    if len(tracks) <= MAX_ROWS:
        return list(range(len(tracks)))
    min_gap = axis.frames // 200
    ends: list[int] = []  # last frame in each row
    rows = []
    for track in tracks:
        free = (row for row, end in enumerate(ends) if end + min_gap < track.first)
        rows.append(next(free, len(ends)))
        ends[rows[-1] : rows[-1] + 1] = [track.last]
    return rows


def curve_paths(
    frames: NDArray[np.int64], series: Floats, time_axis: TimeAxis, value_axis: ValueAxis,
    stds: Floats | None = None,
) -> dict[str, str]:  # fmt: skip
    """Values of frames as a line, with a band of their standard errors; nothing if all are NaN."""
    bins, values = bin_means(frames, series, time_axis.bin_width)
    half_widths = np.zeros(len(bins))
    if stds is not None:
        # Standard errors of the frames with a known value only, as for the line.
        known = np.where(np.isfinite(series), stds, np.nan)
        std_bins, std_values = bin_means(frames, known, time_axis.bin_width)
        half_widths[np.searchsorted(bins, std_bins)] = std_values
    lines, bands = [], []
    for run in split_runs(bins):
        points = _points(bins[run], values[run], time_axis, value_axis)
        # A single point gets a short line, as a line without length is invisible.
        end = max(time_axis.bin_width / time_axis.frames * _CURVE_WIDTH, 2) if len(points) == 1 else 0
        lines.append(f"M{' '.join(points)}" + (f"h{decimal(end)}" if end else ""))
        if stds is not None:
            upper = _points(bins[run], values[run] + half_widths[run], time_axis, value_axis)
            lower = _points(bins[run], values[run] - half_widths[run], time_axis, value_axis)
            bands.append(f"M{' '.join(upper + lower[::-1])}Z")
    shapes = {"band": "".join(bands), "line": "".join(lines)}
    return {name: shape for name, shape in shapes.items() if shape}


def end_labels(
    tracks: Iterable[TrackHistory], name: str, time_axis: TimeAxis, value_axis: ValueAxis
) -> list[Label]:
    """Labels at the ends of the tracks' lines; short lines get none."""
    labels = []
    for track in tracks:
        known = np.flatnonzero(np.isfinite(track.columns[name]))
        if known.size and np.ptp(track.frames[known]) >= MIN_LABELED * time_axis.frames:
            bins, values = bin_means(track.frames, track.columns[name], time_axis.bin_width)
            x = min((bins[-1] + 0.5) * time_axis.bin_width / time_axis.frames, 1.0) * 100
            labels.append(Label(float(x), value_axis.y(float(values[-1])) - 4, track.id))
    return labels


def count_path(
    heights: Sequence[float], edges: Sequence[float], time_axis: TimeAxis, value_axis: ValueAxis
) -> str:
    """Path of a bar from each edge (in frames) to the next."""
    bottom = decimal(value_axis.y(0))
    bars = [
        f"M{time_axis.x(start)},{bottom}V{decimal(value_axis.y(height))}H{time_axis.x(stop)}V{bottom}Z"
        for height, start, stop in zip(heights, edges, edges[1:])
        if height
    ]
    return "".join(bars)


def separate_labels(labels: Iterable[Label], height: int) -> list[Label]:
    """Move labels up or down until none overlap; drop those that would be far from their lines."""
    placed: list[Label] = []
    for label in sorted(labels, key=lambda each: (each.y, each.x)):
        start = min(max(label.y, _LABEL_HEIGHT), height - 2.0)
        near = [other.y for other in placed if abs(other.x - label.x) < _LABEL_WIDTH]
        free = [
            y
            for y in (start, *(taken + step for taken in near for step in (_LABEL_HEIGHT, -_LABEL_HEIGHT)))
            if abs(y - start) <= _MAX_SHIFT
            and _LABEL_HEIGHT - 2 <= y <= height - 2
            and all(abs(y - taken) >= _LABEL_HEIGHT - 1e-6 for taken in near)
        ]
        if free:
            placed.append(label._replace(y=min(free, key=lambda y: abs(y - start))))
    return placed


def _points(bins: NDArray[np.int64], values: Floats, time_axis: TimeAxis, value_axis: ValueAxis) -> list[str]:
    """Coordinates of the points of a curve, in the middle of each bin."""
    extent = value_axis.high - value_axis.low
    # Clip values far outside the axis, whose coordinates would have many digits.
    clipped = np.clip(values, value_axis.low - extent, value_axis.high + extent)
    return [
        f"{time_axis.x((number + 0.5) * time_axis.bin_width)},{decimal(value_axis.y(value))}"
        for number, value in zip(bins.tolist(), clipped.tolist())
    ]


def decimal(value: float) -> str:
    """Format a number with at most two decimals."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def format_time(seconds: float, *, tenths: bool = True) -> str:
    """Format a time of a video, such as "0:03.2" or "1:02:06"."""
    total = round(seconds, 1 if tenths else 0)
    minutes, rest = divmod(total, 60)
    hours, minutes = divmod(int(minutes), 60)
    end = f"{rest:04.1f}" if tenths else f"{int(rest):02d}"
    return f"{hours}:{minutes:02d}:{end}" if hours else f"{minutes}:{end}"


def format_value(value: object) -> str:
    """Format a parameter or a value of a model's metadata."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_value(each)}" for key, each in value.items())
    if isinstance(value, (tuple, list)):
        return ", ".join(map(format_value, value))
    return str(value)
