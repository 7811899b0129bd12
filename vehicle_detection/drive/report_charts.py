"""SVG charts over the time of a video.

Horizontal positions are percentages of the width, so that a chart fits any screen; text sizes and heights are
pixels. Curves are drawn in a nested SVG that is stretched to the width, with lines of constant width.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, Units
from vehicle_detection.drawing import color_index
from vehicle_detection.drive.events import KINDS, Event
from vehicle_detection.drive.history import TrackHistory, bin_means, split_runs

MAX_ROWS = 14
"""Largest number of tracks that get a row each in `gantt`; more tracks share rows."""

_CURVE_WIDTH = 1000  # units across the nested SVG of the curves
_ROW_HEIGHT, _BAR_HEIGHT = 22, 14  # pixels
_KIND_HEIGHT = 34  # pixels of a kind of event: its name, and its markers below
_LABEL_WIDTH, _LABEL_HEIGHT = 5.0, 13.0  # percent of the chart's width, pixels
_MAX_SHIFT = 1.5 * _LABEL_HEIGHT  # largest distance of a label from the end of its line
_MIN_LABELED = 0.08  # fraction of the video that a track must last to be labeled inside a chart
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

    def percent(self, frame: float) -> str:
        """Position of the beginning of a frame, as a percentage of the width."""
        return f"{_decimal(frame / self.frames * 100)}%"

    def x(self, frame: float) -> str:
        """Position of a frame in the nested SVG of the curves."""
        return _decimal(min(frame / self.frames, 1.0) * _CURVE_WIDTH)

    def ticks(self, max_ticks: int = 6) -> list[float]:
        """Round times in seconds from 0 on, at most about `max_ticks`."""
        step = next((step for step in _TICK_STEPS if self.seconds / step < max_ticks), 0)
        step = step or 3600 * math.ceil(self.seconds / 3600 / max_ticks)
        return [number * step for number in range(int(self.seconds / step) + 1)]


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


def chart(
    content: str, time_axis: TimeAxis, value_axis: ValueAxis, *, label: str, names: Iterable[Label] = ()
) -> str:
    """Draw curves or bars (markup) with the names of tracks on their axes; `label` describes the chart."""
    height = value_axis.height
    grid, values = [], []
    for value in value_axis.ticks:
        y = value_axis.y(value)
        line = "zero" if not value and value_axis.low < 0 else "grid"
        grid.append(svg_element("line", class_=line, x1=0, x2="100%", y1=_decimal(y), y2=_decimal(y)))
        text = format_value(float(value))
        values.append(svg_element("text", text, x="100%", dx=-6, y=_decimal(y + 4), text_anchor="end"))
    nested = {"viewBox": f"0 0 {_CURVE_WIDTH} {height}", "preserveAspectRatio": "none"}
    curves = svg_element("svg", content, **nested, width="100%", height=height)
    texts = []
    for each in _separate_labels(names, height):
        place: dict[str, object] = {"class_": f"track-name c{color_index(each.track)}"}
        place |= {"dx": 4} if each.x < 90 else {"dx": -4, "text_anchor": "end"}
        place |= {"x": f"{_decimal(each.x)}%", "y": _decimal(each.y)}
        texts.append(svg_element("text", f"#{each.track}", **place))
    return _graph(values, [*grid, curves, *texts], time_axis, height, role="img", label=label)


def gantt(tracks: Sequence[TrackHistory], axis: TimeAxis, *, label: str) -> str:
    """Draw bars of the times at which tracks are shown; `tracks` are in the order of their first frames."""
    share_rows = len(tracks) > MAX_ROWS
    rows = _assign_rows(tracks, axis) if share_rows else range(len(tracks))
    row_names, bars, names = [], [], []
    for track, row in zip(tracks, rows):
        middle = (row + 0.5) * _ROW_HEIGHT
        name, y = f"#{track.id}", _decimal(middle + 4)
        if not share_rows:
            row_names.append(svg_element("text", name, x="100%", dx=-6, y=y, text_anchor="end"))
        elif len(track.frames) > _MIN_LABELED * axis.frames:
            x = axis.percent(track.first)
            names.append(svg_element("text", name, class_="track-name", x=x, dx=3, y=y))
        times = f"{format_time(track.first / axis.fps)} to {format_time((track.last + 1) / axis.fps)}"
        parts = [svg_element("title", f"{name}, {times}")]
        bar = {"y": _decimal(middle - _BAR_HEIGHT / 2), "height": _BAR_HEIGHT, "rx": 3}
        for start, stop in track.spans(axis.bin_width):
            parts.append(svg_element("rect", x=axis.percent(start), width=axis.percent(stop - start), **bar))
        bars.append(_seek_button(parts, f"Track {track.id}, {times}", track.first, track.id))
    height = _ROW_HEIGHT * (max(rows, default=-1) + 1)
    return _graph(row_names, [*bars, *names], axis, height, role="group", label=label)


def event_markers(events: Sequence[Event], axis: TimeAxis, units: Units, *, label: str) -> str:
    """Draw a marker for each event, below the name of its kind."""
    kinds = [kind for kind in KINDS if any(event.kind == kind for event in events)]
    names, markers = [], []
    for row, kind in enumerate(kinds):
        top = row * _KIND_HEIGHT
        if row:
            names.append(svg_element("line", class_="grid", x1=0, x2="100%", y1=top, y2=top))
        names.append(
            svg_element("text", KINDS[kind].capitalize(), class_="track-name", x=0, dx=4, y=top + 13)
        )
        for event in (each for each in events if each.kind == kind):
            text, x = event.text(units), axis.percent(event.frame)
            parts = [svg_element("title", text), svg_element("circle", cx=x, cy=top + 24, r=5)]
            markers.append(_seek_button(parts, text, event.frame, event.track_id))
    return _graph([], [*names, *markers], axis, _KIND_HEIGHT * len(kinds), role="group", label=label)


def _seek_button(parts: Iterable[str], text: str, frame: int, track: int) -> str:
    """Group of elements in the color of a track that shows a frame in the video."""
    button = {"role": "button", "tabindex": 0, "aria_label": f"{text}: show in the video"}
    seek = {"data_frame": frame, "data_track": track}
    return svg_element("g", *parts, class_=f"bar c{color_index(track)}", **button, **seek)


def _assign_rows(tracks: Sequence[TrackHistory], axis: TimeAxis) -> list[int]:
    """Row of each track: the first in which it does not touch an earlier track."""
    min_gap = axis.frames // 200
    ends: list[int] = []  # last frame in each row
    rows = []
    for track in tracks:
        free = (row for row, end in enumerate(ends) if end + min_gap < track.first)
        rows.append(next(free, len(ends)))
        ends[rows[-1] : rows[-1] + 1] = [track.last]
    return rows


def _graph(
    values: list[str], content: list[str], axis: TimeAxis, height: int, *, role: str, label: str
) -> str:
    """Put a chart beside its values and above its times, with the two lines that the script moves."""
    times = []
    ticks = axis.ticks()
    tenths = ticks[1:2] < [1.0]
    for seconds in ticks:
        frame = seconds * axis.fps
        x, anchor = axis.percent(frame), "end" if frame / axis.frames > 0.97 else "middle"
        times.append(svg_element("line", class_="grid", x1=x, x2=x, y1=0, y2=height))
        text = format_time(seconds, tenths=tenths)
        times.append(svg_element("text", text, x=x, y=height + 15, text_anchor=anchor))
    lines = [svg_element("line", class_=name, x1=0, x2=0, y1=0, y2=height) for name in ("cursor", "playhead")]
    total = height + 20  # the times are below the chart
    side = svg_element("svg", *values, class_="values", width=44, height=total, aria_hidden="true")
    parts = [svg_element("g", *times, class_="times"), *content, *lines]
    plot = svg_element("svg", *parts, class_="plot", width="100%", height=total, role=role, aria_label=label)
    return f'<div class="graph">{side}<div class="scroll">{plot}</div></div>'


def curve(
    track: TrackHistory, name: str, time_axis: TimeAxis, value_axis: ValueAxis, *, std: str | None = None
) -> str:
    """Draw a column of a track as a line; `std` names the column whose values give a band around it."""
    stds = None if std is None else track.columns[std]
    paths = curve_paths(track.frames, track.columns[name], time_axis, value_axis, stds=stds)
    return svg_element("g", *paths, class_=f"curve c{track.color}", data_track=track.id) if paths else ""


def curve_paths(
    frames: NDArray[np.int64],
    series: Floats,
    time_axis: TimeAxis,
    value_axis: ValueAxis,
    *,
    stds: Floats | None = None,
) -> list[str]:
    """Draw values of frames as a line, with a band of their standard errors; nothing if all are NaN."""
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
        lines.append(f"M{' '.join(points)}" + (f"h{_decimal(end)}" if end else ""))
        if stds is not None:
            upper = _points(bins[run], values[run] + half_widths[run], time_axis, value_axis)
            lower = _points(bins[run], values[run] - half_widths[run], time_axis, value_axis)
            bands.append(f"M{' '.join(upper + lower[::-1])}Z")
    shapes = {"band": "".join(bands), "line": "".join(lines)}
    return [svg_element("path", class_=name, d=shape) for name, shape in shapes.items() if shape]


def end_labels(
    tracks: Iterable[TrackHistory], name: str, time_axis: TimeAxis, value_axis: ValueAxis
) -> list[Label]:
    """Labels at the ends of the tracks' lines; short lines get none."""
    labels = []
    for track in tracks:
        known = np.flatnonzero(np.isfinite(track.columns[name]))
        if known.size and np.ptp(track.frames[known]) >= _MIN_LABELED * time_axis.frames:
            bins, values = bin_means(track.frames, track.columns[name], time_axis.bin_width)
            x = min((bins[-1] + 0.5) * time_axis.bin_width / time_axis.frames, 1.0) * 100
            labels.append(Label(float(x), value_axis.y(float(values[-1])) - 4, track.id))
    return labels


def count_bars(
    heights: Sequence[float], edges: Sequence[float], time_axis: TimeAxis, value_axis: ValueAxis
) -> str:
    """Draw a bar from each edge (in frames) to the next."""
    bottom = _decimal(value_axis.y(0))
    bars = [
        f"M{time_axis.x(start)},{bottom}V{_decimal(value_axis.y(height))}H{time_axis.x(stop)}V{bottom}Z"
        for height, start, stop in zip(heights, edges, edges[1:])
        if height
    ]
    return svg_element("path", class_="count", d="".join(bars))


def fraction_bar(fraction: float) -> str:
    """Draw a fraction in [0, 1] as a small bar."""
    width = f"{_decimal(min(max(fraction, 0), 1) * 100)}%"
    bar = svg_element("rect", class_="count", width=width, height=10)
    return svg_element("svg", bar, class_="fraction", height=10, aria_hidden="true")


def _separate_labels(labels: Iterable[Label], height: int) -> list[Label]:
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
        f"{time_axis.x((number + 0.5) * time_axis.bin_width)},{_decimal(value_axis.y(value))}"
        for number, value in zip(bins.tolist(), clipped.tolist())
    ]


def _decimal(value: float) -> str:
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


def svg_element(name: str, *content: str, **attributes: object) -> str:
    """Write an SVG element around `content` (markup); attributes are escaped, underscores are hyphens."""
    pairs = (
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
    )
    return f"<{name}{''.join(pairs)}>{''.join(content)}</{name}>"
