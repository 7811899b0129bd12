"""Charts over the time of a video, as SVG.

Times are shares of the chart's width, so that a chart fits a telephone as well as a screen; texts and the
height are in pixels, so that they stay readable on both. Curves stand in a frame of their own that is
stretched to the width, and their lines are not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.report.history import Floats, TrackHistory, binned, runs
from vehicle_detection.report.html import clock, tag, text

COLORS = 7
"""Number of colors, as many as `draw_tracks` has; classes ``c0``, ``c1``, ..."""

ROWS = 14
"""Tracks that have a row each; more of them share rows."""

_WIDTH = 1000  # of a curve's frame
_POINTS = 800  # at most, along a curve
_FOOT = 20  # pixels below a chart for its times
_ROW, _BAR = 22, 14  # pixels of a track's row and of its bar
_LABEL_SHARE, _LABEL_HEIGHT = 5.0, 13.0  # percent and pixels that a label takes
_NAME_SHARE = 0.08  # of the video that a track needs to be named, where that is not the only name
_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200)


class Label(NamedTuple):
    """A text at a point of a chart: percent across, pixels down, and the track it names."""

    x: float
    y: float
    track: int


@dataclass(frozen=True)
class Clock:
    """The time axis: frames and their rate.

    Attributes
    ----------
    frames
        Number of frames, at least 1.
    fps
        Frames a second.
    """

    frames: int
    fps: float

    @property
    def seconds(self) -> float:
        """Length of the video."""
        return self.frames / self.fps

    @property
    def step(self) -> int:
        """Frames that share a point of a curve."""
        return math.ceil(self.frames / _POINTS)

    def percent(self, frame: float) -> str:
        """Place of a frame's beginning in percent of the width."""
        return f"{_short(frame / self.frames * 100)}%"

    def ticks(self, most: int = 6) -> list[float]:
        """Round seconds along the axis, from 0 on, about `most` of them at the most."""
        step = next((step for step in _STEPS if self.seconds / step < most), 0)
        step = step or 3600 * math.ceil(self.seconds / 3600 / most)
        return [number * step for number in range(int(self.seconds / step) + 1)]


@dataclass(frozen=True)
class Scale:
    """The value axis: round numbers from `low` at the bottom to `high` at the top.

    Attributes
    ----------
    low, high
        Ends of the axis.
    height
        Pixels between them.
    ticks
        Round values from `low` to `high`.
    """

    low: float
    high: float
    height: int
    ticks: tuple[float, ...]

    @classmethod
    def around(cls, low: float, high: float, height: int, *, whole: bool = False, most: int = 4) -> Scale:
        """Make the least round axis that holds `low` and `high`."""
        reach = max(high - low, 1e-6)
        power = 10.0 ** math.floor(math.log10(reach / most))
        step = next(factor * power for factor in (1, 2, 5, 10) if factor * power * most >= reach * 0.999)
        step = max(step, 1.0) if whole else step
        first = math.floor(low / step + 1e-9)
        last = max(math.ceil(high / step - 1e-9), first + 1)
        return cls(first * step, last * step, height, tuple(n * step for n in range(first, last + 1)))

    def y(self, value: float) -> float:
        """Pixels from the top."""
        return (self.high - value) / (self.high - self.low) * self.height


def chart(content: str, axis: Clock, scale: Scale, *, label: str, labels: Iterable[Label] = ()) -> str:
    """Put curves on axes: `content` stands in a frame of 1000 by the scale's height."""
    lines = [
        tag("line", class_="zero" if not value and scale.low < 0 else "grid", x1=0, x2="100%", y1=y, y2=y)
        for value in scale.ticks
        for y in [_short(scale.y(value))]
    ]
    curves = tag(
        "svg",
        content,
        viewBox=f"0 0 {_WIDTH} {scale.height}",
        preserveAspectRatio="none",
        width="100%",
        height=scale.height,
    )
    names = [
        tag("text", f"#{each.track}", class_="name", x=f"{_short(each.x)}%", y=_short(each.y), dx=dx, **rest)
        for each in _apart(labels, scale.height)
        for dx, rest in [(4, {}) if each.x < 90 else (-4, {"text_anchor": "end"})]
    ]
    values = [
        tag("text", _plain(value), x="100%", dx=-6, y=_short(scale.y(value) + 4), text_anchor="end")
        for value in scale.ticks
    ]
    return _graph(values, [*lines, curves, *names], axis, scale.height, role="img", label=label)


def gantt(tracks: Sequence[TrackHistory], axis: Clock, *, label: str) -> str:
    """Draw a bar for each time that a track is shown: a row for each track, or a shared one if they are many.

    Parameters
    ----------
    tracks
        In the order in which they appeared.
    axis
        The time axis.
    label
        What the chart shows, for those who do not see it.
    """
    shared = len(tracks) > ROWS
    rows = _lanes(tracks, axis) if shared else range(len(tracks))
    sides, bars, names = [], [], []
    for track, row in zip(tracks, rows):
        middle = (row + 0.5) * _ROW
        name = {"y": _short(middle + 4)}
        if not shared:
            sides.append(tag("text", f"#{track.id}", x="100%", dx=-6, text_anchor="end", **name))
        elif len(track.frames) > _NAME_SHARE * axis.frames:
            place = axis.percent(track.first)
            names.append(tag("text", f"#{track.id}", class_="name", x=place, dx=3, **name))
        begin, end = clock(track.first / axis.fps), clock((track.last + 1) / axis.fps)
        bars.append(
            tag(
                "g",
                tag("title", f"#{track.id}, {begin} to {end}"),
                *_bar(track, middle - _BAR / 2, axis),
                class_=_class("bar", track),
                role="button",
                tabindex=0,
                aria_label=f"Track {track.id}, {begin} to {end}: show in the video",
                data_frame=track.first,
                data_track=track.id,
            )
        )
    height = _ROW * (max(rows, default=-1) + 1)
    return _graph(sides, [*bars, *names], axis, height, role="group", label=label)


def _lanes(tracks: Sequence[TrackHistory], axis: Clock) -> list[int]:
    """Choose a row for each track: the first one in which it does not touch another."""
    gap = axis.frames // 200
    ends: list[int] = []
    lanes = []
    for track in tracks:
        free = (lane for lane, end in enumerate(ends) if end + gap < track.first)
        lane = next(free, len(ends))
        ends[lane:] = [track.last, *ends[lane + 1 :]]
        lanes.append(lane)
    return lanes


def _bar(track: TrackHistory, y: float, axis: Clock) -> list[str]:
    gap = max(1, axis.frames // _WIDTH)
    return [
        tag(
            "rect",
            x=axis.percent(start),
            width=axis.percent(stop - start),
            y=_short(y),
            height=_BAR,
            rx=3,
        )
        for start, stop in track.spans(gap)
    ]


def _graph(values: list[str], parts: list[str], axis: Clock, height: int, *, role: str, label: str) -> str:
    """Put a chart beside its values and over its times, with the marks that the script moves."""
    times = []
    tenths = axis.ticks()[1:2] < [1.0]
    for seconds in axis.ticks():
        x = seconds * axis.fps / axis.frames * 100
        anchor = "end" if x > 97 else "middle"
        place = axis.percent(seconds * axis.fps)
        times.append(tag("line", class_="grid", x1=place, x2=place, y1=0, y2=height))
        name = clock(seconds, tenths=tenths)
        times.append(tag("text", name, x=place, y=height + 15, text_anchor=anchor))
    marks = [tag("line", class_=name, x1=0, x2=0, y1=0, y2=height) for name in ("mark", "now")]
    side = tag("svg", *values, class_="values", width=44, height=height + _FOOT, aria_hidden="true")
    plot = tag(
        "svg",
        *times,
        *parts,
        *marks,
        class_="plot",
        width="100%",
        height=height + _FOOT,
        role=role,
        aria_label=label,
    )
    return tag("div", side, plot, class_="graph")


def curve(track: TrackHistory, name: str, axis: Clock, scale: Scale, *, band: str | None = None) -> str:
    """Draw a column of a track as a line, and another one as a band of that width on either side of it."""
    bins, values = binned(track.frames, track.columns[name], axis.step)
    lines, bands = [], []
    errors = np.zeros(len(bins))
    if band is not None:
        # The same frames for both: an error without its value says nothing.
        known = np.where(np.isfinite(track.columns[name]), track.columns[band], np.nan)
        error_bins, error_values = binned(track.frames, known, axis.step)
        errors[np.searchsorted(bins, error_bins)] = error_values
    for part in runs(bins):
        lines.append(_line(_points(bins[part], values[part], axis, scale), axis))
        if band is not None:
            upper = _points(bins[part], values[part] + errors[part], axis, scale)
            lower = _points(bins[part], values[part] - errors[part], axis, scale)
            bands.append(f"M{' '.join(upper + lower[::-1])}Z")
    pieces = [tag("path", class_="band", d="".join(bands))] if bands else []
    pieces += [tag("path", class_="line", d="".join(lines))] if lines else []
    return tag("g", *pieces, class_=_class("curve", track), data_track=track.id) if pieces else ""


def end_label(track: TrackHistory, name: str, axis: Clock, scale: Scale) -> Label | None:
    """Name a track at the end of its line, unless it is too short for a name."""
    known = np.flatnonzero(np.isfinite(track.columns[name]))
    if not known.size or track.frames[known[-1]] - track.frames[known[0]] < _NAME_SHARE * axis.frames:
        return None
    bins, values = binned(track.frames, track.columns[name], axis.step)
    x = min((bins[-1] + 0.5) * axis.step / axis.frames, 1.0) * 100
    return Label(float(x), scale.y(float(values[-1])) - 4, track.id)


def steps(heights: Sequence[float], edges: Sequence[float], axis: Clock, scale: Scale) -> str:
    """Draw a bar from each of the `edges`, in frames, to the next."""
    down = _short(scale.y(0))
    pieces = [
        f"M{_x(start, axis)},{down}V{_short(scale.y(height))}H{_x(stop, axis)}V{down}Z"
        for height, start, stop in zip(heights, edges, edges[1:])
        if height
    ]
    return tag("path", class_="count", d="".join(pieces))


def share_bar(share: float) -> str:
    """Draw a share, 0-1, as a small bar."""
    bar = tag("rect", class_="count", width=f"{_short(min(max(share, 0), 1) * 100)}%", height=10)
    return tag("svg", bar, class_="share", height=10, aria_hidden="true")


def _apart(labels: Iterable[Label], height: int) -> list[Label]:
    """Move labels down, or up where the chart ends, until none lies on another."""
    placed: list[Label] = []
    for label in sorted(labels, key=lambda each: (each.y, each.x)):
        near = sorted(other.y for other in placed if abs(other.x - label.x) < _LABEL_SHARE)
        y = max(label.y, _LABEL_HEIGHT)
        for taken in near:
            if abs(taken - y) < _LABEL_HEIGHT:
                y = taken + _LABEL_HEIGHT
        if y > height - 2:  # no room below: the first free place above
            y = height - 2.0
            for taken in reversed(near):
                if abs(taken - y) < _LABEL_HEIGHT:
                    y = taken - _LABEL_HEIGHT
        if y >= _LABEL_HEIGHT - 2:
            placed.append(label._replace(y=y))
    return placed


def _points(bins: NDArray[np.int64], values: Floats, axis: Clock, scale: Scale) -> list[str]:
    reach = scale.high - scale.low  # far outside, a number has no more digits than inside
    inside = np.clip(values, scale.low - reach, scale.high + reach)
    return [
        f"{_x((number + 0.5) * axis.step, axis)},{_short(scale.y(value))}"
        for number, value in zip(bins.tolist(), inside.tolist())
    ]


def _line(points: list[str], axis: Clock) -> str:
    if len(points) > 1:
        return f"M{' '.join(points)}"
    wide = _short(max(axis.step / axis.frames * _WIDTH, 2))
    return f"M{points[0]}h{wide}"  # a line without length would not be seen


def _x(frame: float, axis: Clock) -> str:
    return _short(min(frame / axis.frames, 1.0) * _WIDTH)


def _class(name: str, track: TrackHistory) -> str:
    return f"{name} c{(track.id - 1) % COLORS}"


def _short(value: float) -> str:
    """Write a number with two decimals at the most."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def _plain(value: float) -> str:
    return text(f"{value:g}".replace("-", "\N{MINUS SIGN}"))
