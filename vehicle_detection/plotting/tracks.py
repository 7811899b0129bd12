"""Figures of a video: tracks over time, and where the time goes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, check_type, describe
from vehicle_detection.detector import FrameResult
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import NO_TRACK, FrameBoxes
from vehicle_detection.plotting.style import (
    COLORS,
    DASHES,
    YELLOW,
    Paint,
    Sheet,
    new_axes,
    new_figure,
    panels,
)
from vehicle_detection.synthetic import VehicleTruth
from vehicle_detection.video import VideoReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

_PANELS = (
    ("middle", "middle of the box, x (px)"),
    ("width", "width of the box (px)"),
    ("distance", "distance (m)"),
    ("speed", "speed relative to\nthe camera (m/s)"),
)
# Two rows of a track that lie farther apart than this many frames are not joined by a line.
_LONGEST_GAP = 1.5
# The video's yellow is hardly seen on white.
_DARK_YELLOW = (0.80, 0.73, 0.1)

_STAGES = ("decode", "search", "regions", "track", "draw", "encode")


class _Course(NamedTuple):
    """One track over time: columns of the same length, NaN where a value is unknown."""

    time: Floats
    values: dict[str, Floats]
    errors: dict[str, Floats]


def plot_tracks(
    results: Iterable[FrameResult] | FrameBoxes,
    *,
    truth: FrameBoxes | Sequence[Sequence[VehicleTruth]] | None = None,
    fps: float = 25.0,
    least: int = 1,
    figure: Sheet | None = None,
) -> Sheet:
    """Plot place, size, distance and speed of each track over time, in the colors of the video.

    Parameters
    ----------
    results
        What the detector returned for each frame, of which the tracks that are shown are drawn; or the
        boxes of a tracks file, as `read_labels` returns them, whose frames are numbers.
    truth
        True boxes, drawn with black dots: those of a labels file, or the ``truth`` of a drawn drive, which
        knows distances and speeds as well. What is to be ignored is left out.
    fps
        Frames a second, for frames without a time.
    least
        Tracks with fewer frames are left out.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Four panels over a common time. Distance and speed of results have bands of one standard error.

    Raises
    ------
    InvalidInputError
        If an argument is of another kind, or there is no track to draw.

    Examples
    --------
    >>> boxes = [[10.0 + frame, 20.0, 60.0 + frame, 60.0] for frame in range(5)]
    >>> figure = plot_tracks(Labels(range(5), [1] * 5, boxes), fps=10)
    >>> figure.axes[0].lines[0].get_xydata()[-1].tolist()
    [0.4, 39.0]
    """
    rate = check_number(fps, "fps", above=0, high=1e6)
    shortest = check_number(least, "least", low=1)
    if isinstance(results, FrameBoxes):
        courses = _courses_of_labels(results, rate, "results")
    else:
        courses = _courses_of_results(results, rate)
    courses = {track: course for track, course in courses.items() if len(course.time) >= shortest}
    if not courses:
        raise InvalidInputError(
            "results must hold at least one track to draw; got none: is it a video, and are its tracks shown?"
        )
    sheet = new_figure(figure, 10, 9)
    axes = panels(sheet, len(_PANELS), 1, sharex=True)[:, 0]
    for track, course in sorted(courses.items()):
        color, dash = _look(track)
        joined = _with_gaps(course, rate)
        for panel, (name, _) in zip(axes, _PANELS):
            value, error = joined.values[name], joined.errors.get(name)
            panel.plot(joined.time, value, color=color, linestyle=dash, linewidth=1.8, label=f"#{track}")
            if error is not None:
                panel.fill_between(
                    joined.time, value - error, value + error, color=color, alpha=0.25, linewidth=0
                )
    if truth is not None:
        _put_truth(axes, _courses_of_labels(_truth_labels(truth), rate, "truth"))
    for panel, (_, label) in zip(axes, _PANELS):
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    axes[-1].axhline(0, color="black", linewidth=0.6)
    axes[-1].set_xlabel("time (s)")
    handles, names = axes[0].get_legend_handles_labels()
    sheet.legend(handles, names, loc="outside right upper", fontsize=9, title="track")
    return sheet


def _look(track: int) -> tuple[Paint, str]:
    """Color of a track as in the video, and dashes that tell those of one color apart."""
    turn, place = divmod(track - 1, len(COLORS))
    color = _DARK_YELLOW if COLORS[place] == YELLOW else COLORS[place]
    return color, DASHES[turn % len(DASHES)]


def _put_truth(axes: NDArray[Any], courses: Mapping[int, _Course]) -> None:
    for number, course in enumerate(courses.values()):
        for panel, (name, _) in zip(axes, _PANELS):
            label = "truth" if number == 0 else None
            panel.plot(course.time, course.values[name], "k.", markersize=2, label=label)


def _truth_labels(truth: object) -> FrameBoxes:
    """Labels that are not to be ignored, out of labels or the rows of each frame of a drawn drive."""
    if isinstance(truth, FrameBoxes):
        return truth[~truth.ignore]
    if not isinstance(truth, Sequence) or not all(
        isinstance(row, VehicleTruth) for rows in truth for row in rows
    ):
        raise InvalidInputError(
            f"truth must be Labels or the truth of a drawn drive, got {describe(truth)}; "
            "read a file with read_labels or pass drive.truth"
        )
    listed = [(frame, row) for frame, rows in enumerate(truth) for row in rows if not row.ignore]
    return FrameBoxes(
        [frame for frame, _ in listed],
        np.array([row.track for _, row in listed], np.int64),
        np.array([row.box for _, row in listed], np.float64).reshape(-1, 4),
        distance_m=np.array([row.distance_m for _, row in listed]),
        speed_mps=np.array([row.speed_mps for _, row in listed]),
    )


def _courses_of_results(results: object, rate: float) -> dict[int, _Course]:
    if not isinstance(results, Iterable):
        raise InvalidInputError(
            f"results must be the FrameResult of each frame, or Labels; got {describe(results)}; "
            "collect what detector.process returns"
        )
    rows: dict[int, list[tuple[float, ...]]] = {}
    for result in results:
        check_type(result, "results", FrameResult, "collect what detector.process returns")
        time = result.index / rate if result.time is None else result.time
        for track in result.shown:
            x1, _, x2, _ = track.box.tolist()
            known = (track.distance_m, track.distance_std_m, track.speed_mps, track.speed_std_mps)
            told = (math.nan if value is None else value for value in known)
            rows.setdefault(track.id, []).append((time, (x1 + x2) / 2, x2 - x1, *told))
    courses = {}
    for number, told_rows in rows.items():
        time, middle, width, distance, distance_error, speed, speed_error = np.array(told_rows).T
        courses[number] = _Course(
            time,
            {"middle": middle, "width": width, "distance": distance, "speed": speed},
            {"distance": distance_error, "speed": speed_error},
        )
    return courses


def _courses_of_labels(labels: FrameBoxes, rate: float, name: str) -> dict[int, _Course]:
    if any(isinstance(key, str) for key in labels.frame_keys):
        raise InvalidInputError(
            f"{name} must number its frames, got names such as {labels.frame_keys[0]!r}; "
            "convert them with Labels.renamed"
        )
    times = np.array([int(key) for key in labels.frames], np.float64) / rate
    unknown = np.full(len(labels), math.nan)
    distance = unknown if labels.distance_m is None else labels.distance_m
    speed = unknown if labels.speed_mps is None else labels.speed_mps
    courses = {}
    for track in np.unique(labels.tracks[labels.tracks != NO_TRACK]).tolist():
        rows = np.flatnonzero(labels.tracks == track)
        rows = rows[np.argsort(times[rows], kind="stable")]
        boxes = labels.boxes[rows]
        values = {
            "middle": (boxes[:, 0] + boxes[:, 2]) / 2,
            "width": boxes[:, 2] - boxes[:, 0],
            "distance": distance[rows],
            "speed": speed[rows],
        }
        courses[track] = _Course(times[rows], values, {})
    return courses


def _with_gaps(course: _Course, rate: float) -> _Course:
    """Put a row without values where frames are missing, so that the line breaks."""
    usual = max(1 / rate, float(np.diff(course.time).min()) if len(course.time) > 1 else 0.0)
    after = np.flatnonzero(np.diff(course.time) > _LONGEST_GAP * usual) + 1

    def torn(values: Floats) -> Floats:
        return np.insert(values, after, math.nan)

    return _Course(
        np.insert(course.time, after, (course.time[after - 1] + course.time[after]) / 2),
        {name: torn(values) for name, values in course.values.items()},
        {name: torn(values) for name, values in course.errors.items()},
    )


Run = VideoReport | Sequence[FrameResult]


def plot_stage_times(runs: Run | Mapping[str, Run], *, ax: Axes | None = None) -> Axes:
    """Plot how much work each stage is for a frame, run by run.

    Parameters
    ----------
    runs
        The report of `process_video`, or the results of the detector for each frame; or several of them by
        name.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        A stacked bar for each run, in milliseconds a frame. Stages of a video run side by side: the bar may
        be longer than a frame takes.

    Raises
    ------
    InvalidInputError
        If a run is of another kind, or without frames.

    Examples
    --------
    >>> result = FrameResult(0, 0.0, None, None, (), {"search": 0.012, "track": 0.002})
    >>> axes = plot_stage_times([result])
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['search', 'track']
    """
    named = runs if isinstance(runs, Mapping) else {"": runs}
    if not named:
        raise InvalidInputError("runs must hold at least one run; got none")
    each = {str(name): _stage_milliseconds(run) for name, run in named.items()}
    met = dict.fromkeys(stage for times in each.values() for stage in times)
    stages = sorted(met, key=lambda stage: _STAGES.index(stage) if stage in _STAGES else len(_STAGES))
    axes = new_axes(ax, 9, 1.3 + 0.55 * len(each))
    left = np.zeros(len(each))
    for place, stage in enumerate(stages):
        values = np.array([times.get(stage, 0.0) for times in each.values()])
        color = COLORS[place % len(COLORS)]
        bars = axes.barh(range(len(each)), values, 0.6, left=left, color=color, label=stage)
        # A number that does not fit into its bar is left out; the least share that holds one is a guess.
        widest = max(sum(times.values()) for times in each.values())
        texts = [f"{value:.1f}" if value > 0.05 * widest else "" for value in values]
        axes.bar_label(bars, texts, label_type="center", fontsize=8)
        left += values
    for place, total in enumerate(left):
        axes.text(total, place, f"  {total:.1f} ms", va="center", fontsize=9)
    axes.set_yticks(range(len(each)), list(each))
    axes.invert_yaxis()
    axes.margins(x=0.12)
    axes.set_xlabel("work (ms a frame)")
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=max(len(stages), 1), fontsize=9, frameon=False
    )
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _stage_milliseconds(run: object) -> dict[str, float]:
    """Milliseconds a frame by stage, in the order of the stages."""
    if isinstance(run, VideoReport):
        frames, listed = run.frames, [run.stages]
    elif isinstance(run, (list, tuple)) and all(isinstance(result, FrameResult) for result in run):
        frames, listed = len(run), [result.seconds for result in run]
    else:
        raise InvalidInputError(
            f"runs must be a VideoReport or a list of FrameResult, or a mapping from names to them; "
            f"got {describe(run)}"
        )
    if not frames:
        raise InvalidInputError("runs must have at least one frame each; got a run without any")
    sums: dict[str, float] = {}
    for seconds in listed:
        for stage, value in seconds.items():
            sums[stage] = sums.get(stage, 0.0) + value
    return {stage: 1000 * value / frames for stage, value in sums.items()}
