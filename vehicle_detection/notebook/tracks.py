"""Figures of a video: tracks over time, and the time of each processing stage."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from vehicle_detection._common import Floats, check
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import COLORS, LINESTYLES, YELLOW, FigureLike
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import FrameResult

_LABELS = (
    "center of the box, x (px)",
    "width of the box (px)",
    "distance (m)",
    "speed relative to\nthe camera (m/s)",
)
# A line is interrupted where consecutive rows are more than this many frames apart.
_MAX_GAP = 1.5
# Replaces the yellow of the video, which is hard to see on white.
_DARK_YELLOW = (0.80, 0.73, 0.1)

# Rows of the legend of the tracks that fit beside the panels.
_LEGEND_ROWS = 38


def plot_tracks(
    results: Iterable[FrameResult] | TrackTable,
    *,
    truth: TrackTable | None = None,
    fps: float = 25.0,
    min_frames: int = 1,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Plot position, width, distance and speed of each track over time, in the colors of the video.

    `results` are those of each frame, whose shown tracks are plotted, with bands of one standard error; or
    the boxes of a tracks file with numbered frames, as `read_labels` returns. `truth` are true boxes, drawn
    as black dots, such as the ``labels`` of a rendered drive, which include distances and speeds; ignored
    boxes are left out, and tracks in less than `min_frames`. `fps` is for frames without a time.

    >>> boxes = [[10.0 + frame, 20.0, 60.0 + frame, 60.0] for frame in range(5)]
    >>> figure = plot_tracks(TrackTable(range(5), [1] * 5, boxes), fps=10)
    >>> figure.axes[0].lines[0].get_xydata()[-1].tolist()
    [0.4, 39.0]
    """
    rate = check.number(fps, "fps", above=0, high=1e6)
    shortest = check.number(min_frames, "min_frames", low=1)
    table = results if isinstance(results, TrackTable) else TrackTable.from_results(results)
    found = _columns_by_track(table, "results", rate)
    tracks = {number: columns for number, columns in found.items() if columns.shape[1] >= shortest}
    if not tracks:
        raise InvalidInputError(
            "results must hold at least one track to plot, got none; pass results with shown tracks"
        )
    figure, grid = style.new_panels(figure, (10, 9), 4, 1, sharex=True)
    for number, known in tracks.items():
        # Color of the track as in the video; the line style differs between tracks of one color.
        cycle, index = divmod(number - 1, len(COLORS))
        color = _DARK_YELLOW if COLORS[index] == YELLOW else COLORS[index]
        dash = LINESTYLES[cycle % len(LINESTYLES)]
        time, *columns = _insert_gaps(known, rate)
        for panel, values, stds in zip(grid.flat, columns[:4], columns[4:]):
            panel.plot(time, values, color=color, linestyle=dash, linewidth=1.8, label=f"#{number}")
            if not np.isnan(stds).all():
                panel.fill_between(time, values - stds, values + stds, color=color, alpha=0.25, linewidth=0)
    check.instance(truth, "truth", TrackTable | None, "read a file with read_labels or pass drive.labels")
    if truth is not None:
        true = _columns_by_track(truth[~truth["ignore"]], "truth", rate)
        for index, (time, *columns) in enumerate(true.values()):
            for panel, values in zip(grid.flat, columns):
                panel.plot(time, values, "k.", markersize=2, label=None if index else "truth")
    for panel, label in zip(grid.flat, _LABELS):
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    grid[-1, 0].axhline(0, color="black", linewidth=0.6)
    grid[-1, 0].set_xlabel("time (s)")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    options: dict[str, Any] = {"fontsize": 9, "title": "track", "columnspacing": 1.0}
    options["ncols"] = math.ceil(len(labels) / _LEGEND_ROWS)
    figure.legend(handles, labels, loc="outside right upper", **options)
    return figure


def _columns_by_track(table: TrackTable, name: str, rate: float) -> dict[int, Floats]:
    """``(9, N)`` columns of each track: time, the values of the panels, and their standard errors."""
    if any(isinstance(key, str) for key in table.frame_keys):
        raise InvalidInputError(
            f"{name} must have numbered frames, got names such as {table.frame_keys[0]!r}; "
            "convert them with TrackTable.renamed"
        )
    times, tracks = table.times(), {}
    for number, rows in sorted(table.by_track().items()):
        frames, (left, _, right, _) = rows["frame"].astype(int), rows.boxes.T
        unknown = np.full(len(rows), np.nan)
        columns = [frames / rate if times is None else times[frames], (left + right) / 2, right - left]
        columns += [rows["distance_m"], rows["speed_mps"], unknown, unknown]
        tracks[number] = np.stack([*columns, rows["distance_std_m"], rows["speed_std_mps"]])
    return tracks


def _insert_gaps(columns: Floats, rate: float) -> Floats:
    """Insert NaN where frames are missing, so that the line is interrupted."""
    time = columns[0]
    steps = np.diff(time)
    usual = max(1 / rate, steps.min(initial=math.inf))
    after = np.flatnonzero(steps > _MAX_GAP * usual) + 1
    result = np.insert(columns, after, math.nan, axis=1)
    result[0] = np.insert(time, after, (time[after - 1] + time[after]) / 2)
    return result
