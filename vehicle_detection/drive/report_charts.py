"""Charts over the time of a video: positions and texts for the SVG in the template ``report.html.j2``.

Horizontal positions are percentages of the width, so that a chart fits any screen; text sizes and heights are
pixels. ``report.js`` draws the curves from the numbers that the page holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from vehicle_detection.drive.motion import TrackHistory

MAX_ROWS = 14
"""Largest number of tracks that get a row each; more tracks share rows."""

MIN_LABELED = 0.08
"""Fraction of the video that a track must last to be labeled inside a chart."""

_TICK_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200)  # seconds


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

    def ticks(self, max_ticks: int = 6) -> list[float]:
        """Round times in seconds from 0 on, at most about `max_ticks`."""
        hours = 3600 * math.ceil(self.seconds / 3600 / max_ticks)
        step = next((step for step in _TICK_STEPS if self.seconds / step < max_ticks), hours)
        return [number * step for number in range(int(self.seconds / step) + 1)]

    def marks(self) -> list[tuple[float, str]]:
        """Positions (percent) and texts of the times below a chart."""
        ticks = self.ticks()
        tenths = len(ticks) == 1 or ticks[1] < 1
        return [(self.percent(each * self.fps), format_time(each, tenths=tenths)) for each in ticks]


def assign_rows(tracks: Sequence[TrackHistory], axis: TimeAxis) -> list[int]:
    """Row of each track: its own, or if there are many, the first that is free again when it begins."""
    if len(tracks) <= MAX_ROWS:
        return list(range(len(tracks)))
    min_gap = axis.frames // 200
    ends: dict[int, int] = {}  # last frame in each row
    rows = []
    for track in tracks:
        row = next(row for row in count() if row not in ends or ends[row] + min_gap < track.first)
        rows.append(row)
        ends[row] = track.last
    return rows


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
