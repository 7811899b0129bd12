"""Figures of quality on labelled frames: curves, bars, and the worst mistakes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_integer, check_number, check_type, describe
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import (
    DetectionScores,
    FrameBoxes,
    FrameKey,
    LabelledFrames,
    match_detections,
    prepare_sides,
)
from vehicle_detection.plotting.style import (
    LINE_COLORS,
    SKY,
    TRUTH,
    VERMILION,
    line_looks,
    new_axes,
    put_boxes,
    put_tiles,
    tile_axes,
)
from vehicle_detection.tuning import numeric_column, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

Curve = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_METRICS = ("f1", "precision", "recall", "average_precision", "mean_iou")
_METRIC_NAMES = {"f1": "F1", "average_precision": "average precision", "mean_iou": "mean IoU"}


def plot_precision_recall(
    curves: Mapping[str, Curve] | Curve, *, threshold: float | None = None, ax: Axes | None = None
) -> Axes:
    """Plot precision against recall for every threshold on the scores, over lines of equal F1.

    Parameters
    ----------
    curves
        What `precision_recall_curve` returns, or several by name.
    threshold
        The threshold in use, marked with a square; a dot marks the best F1.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        The legend tells the best F1 of each curve and its threshold.

    Raises
    ------
    InvalidInputError
        If a curve is no such triple, or empty, or of frames without a labelled vehicle.

    Examples
    --------
    >>> curve = np.array([1.0, 0.5]), np.array([0.5, 0.5]), np.array([2.0, 0.5])
    >>> axes = plot_precision_recall({"road": curve})
    >>> axes.get_legend().get_texts()[0].get_text()
    'road: best F1 0.67 at 2.00'
    """
    named = curves if isinstance(curves, Mapping) else {"": curves}
    if not named:
        raise InvalidInputError("curves must hold at least one curve; got none")
    checked = {str(name): _check_curve(curve, str(name)) for name, curve in named.items()}
    limit = None if threshold is None else check_number(threshold, "threshold")
    axes = new_axes(ax, 6.5, 6)
    _put_f1_lines(axes)
    for (name, (precision, recall, thresholds)), (color, dash) in zip(checked.items(), line_looks()):
        total = precision + recall
        f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
        best = int(f1.argmax())
        text = f"best F1 {f1[best]:.2f} at {thresholds[best]:.2f}"
        label = f"{name}: {text}" if name else text
        axes.plot(recall, precision, color=color, linestyle=dash, linewidth=1.8, label=label, zorder=3)
        axes.plot(recall[best], precision[best], "o", color=color, zorder=4)
        used = np.flatnonzero(thresholds > limit) if limit is not None else np.empty(0, np.intp)
        if len(used):
            axes.plot(recall[used[-1]], precision[used[-1]], "s", color=color, mfc="white", zorder=4)
    axes.set_xlim(0, 1.01)
    axes.set_ylim(0, 1.01)
    axes.set_aspect("equal")
    axes.set_xlabel("recall (share of the vehicles found)")
    axes.set_ylabel("precision (share of the boxes that are right)")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=8, frameon=False)
    return axes


def _check_curve(curve: object, name: str) -> Curve:
    text = f"curves[{name!r}]" if name else "curves"
    if not isinstance(curve, tuple) or len(curve) != 3 or len({np.shape(part) for part in curve}) > 1:
        raise InvalidInputError(
            f"{text} must be (precision, recall, thresholds), got {describe(curve)}; "
            "pass what precision_recall_curve returns"
        )
    precision, recall, thresholds = (np.asarray(part, np.float64) for part in curve)
    if precision.ndim != 1 or not precision.size or np.isnan(recall).any():
        raise InvalidInputError(f"{text} must hold detections and labelled vehicles; got none to compare")
    return precision, recall, thresholds


def _put_f1_lines(axes: Axes) -> None:
    for f1 in (0.2, 0.4, 0.6, 0.8, 0.9):
        recall = np.linspace(f1 / (2 - f1), 1, 100)
        axes.plot(recall, f1 * recall / (2 * recall - f1), color="0.85", linewidth=0.8, zorder=1)
        axes.annotate(f"F1 {f1:g}", (1, f1 / (2 - f1)), fontsize=7, color="0.5", ha="right", va="bottom")


def plot_f1(
    scores: Mapping[str, DetectionScores] | Mapping[str, Mapping[str, DetectionScores]],
    *,
    metric: str = "f1",
    ax: Axes | None = None,
) -> Axes:
    """Plot the quality on each source of frames as bars, of one detector or of several side by side.

    Parameters
    ----------
    scores
        What `evaluate_detections` returns by source; or by detector, and in it by source.
    metric
        ``"f1"``, ``"precision"``, ``"recall"``, ``"average_precision"`` or ``"mean_iou"``.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        A group of bars for each source; a value that is unknown has none.

    Raises
    ------
    InvalidInputError
        If `scores` or `metric` is something else.

    Examples
    --------
    >>> from vehicle_detection import evaluate_detections
    >>> labels = Labels([0], None, [[0, 0, 50, 40]])
    >>> axes = plot_f1({"road": evaluate_detections(labels, labels)})
    >>> [text.get_text() for text in axes.texts]
    ['1.00']
    """
    check_choice(metric, "metric", _METRICS)
    given: object = scores
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(f"scores must map sources to DetectionScores, got {describe(given)}")
    nested = all(isinstance(value, Mapping) for value in given.values())
    detectors: dict[str, Any] = dict(given) if nested else {"": given}
    sources = list(dict.fromkeys(source for each in detectors.values() for source in each))
    for each in detectors.values():
        for source, value in each.items():
            check_type(value, f"scores[{source!r}]", DetectionScores, "pass what evaluate_detections returns")
    if not sources:
        raise InvalidInputError("scores must hold at least one source; got none")
    axes = new_axes(ax, 2.5 + 1.3 * len(sources), 4)
    wide = 0.8 / len(detectors)
    for place, (name, each) in enumerate(detectors.items()):
        values = np.array([getattr(each[s], metric) if s in each else np.nan for s in sources])
        offsets = np.arange(len(sources)) + (place - (len(detectors) - 1) / 2) * wide
        bars = axes.bar(offsets, values, wide * 0.94, color=LINE_COLORS[place % len(LINE_COLORS)], label=name)
        axes.bar_label(bars, ["" if np.isnan(v) else f"{v:.2f}" for v in values], padding=2, fontsize=8)
    axes.set_xticks(range(len(sources)), [str(source) for source in sources])
    axes.set_ylim(0, 1.1)
    axes.set_ylabel(_METRIC_NAMES.get(metric, metric))
    axes.spines[["top", "right"]].set_visible(False)
    if nested:
        axes.legend(fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    return axes


def plot_errors(
    frames: LabelledFrames,
    predictions: FrameBoxes,
    *,
    kind: Literal["missed", "false"] = "missed",
    iou: float = 0.5,
    count: int = 12,
    columns: int = 6,
    ax: Axes | None = None,
) -> Axes:
    """Show crops of the worst mistakes: the largest vehicles that are missed, or the surest false alarms.

    Parameters
    ----------
    frames
        Frames with their true boxes.
    predictions
        Detected boxes, with scores; `FrameBoxes.from_detections` makes them.
    kind
        ``"missed"``: labelled vehicles without a detection, the largest first, each with the overlap of the
        nearest one. ``"false"``: detections that are no vehicle, the best score first.
    iou
        Overlap from which a detection matches a vehicle, as in `evaluate_detections`.
    count
        How many are shown at most.
    columns
        Crops in a row.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        One picture for each mistake, with the labelled box dashed and detections in full lines. The title
        tells how many there are in all; without any, nothing else is drawn.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or `evaluate_detections` refuses the two sides.

    Examples
    --------
    >>> labels = Labels([0], None, [[10, 10, 60, 50]])
    >>> frames = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    >>> plot_errors(frames, Labels([], None, [], scores=[])).get_title()
    '1 of 1 vehicles missed'
    """
    check_type(
        frames, "frames", LabelledFrames, "pair frames and labels with LabelledFrames(name, frames, labels)"
    )
    check_choice(kind, "kind", ("missed", "false"))
    limit = check_number(iou, "iou", above=0, high=1)
    most = check_integer(count, "count", low=1, high=1000)
    predictions, labels, keys = prepare_sides(predictions, frames.labels, frames.keys)
    found = match_detections(predictions, labels, keys, limit)
    if kind == "missed":
        side, rows = labels, np.setdiff1d(found.usable, found.partner)
        title = f"{len(rows):,} of {len(found.usable):,} vehicles missed"
        sizes = side.boxes[rows, 2:] - side.boxes[rows, :2]
        order = np.argsort(-sizes.prod(axis=1), kind="stable")
    else:
        side, rows = predictions, np.flatnonzero((found.partner < 0) & ~found.ignored)
        title = f"{len(rows):,} of {len(predictions):,} detections are no vehicle"
        order = np.arange(len(rows)) if side.scores is None else np.argsort(-side.scores[rows], kind="stable")
    shown = rows[order[:most]]
    across = min(check_integer(columns, "columns", low=1, high=100), max(len(shown), 1))
    axes = tile_axes(ax, max(len(shown), 1), across, inches=1.9, lines=2)
    axes.set_title(title, fontsize=10)
    crops, captions, corners = [], [], []
    for row in shown.tolist():
        key = side.frames[row]
        crop, corner = _crop(_image_of(frames, key), side.boxes[row])
        crops.append(crop)
        corners.append(corner)
        captions.append(_caption(side, row, key, predictions, labels, kind))
    places = put_tiles(axes, crops, captions, [None] * len(crops), across, inches=1.9, lines=2)
    for row, corner, crop, place in zip(shown.tolist(), corners, crops, places):
        key = side.frames[row]
        here = labels.frame(key)
        _put_cut(axes, here.boxes[~here.ignore], crop, corner, place, TRUTH, "--")
        _put_cut(axes, predictions.frame(key).boxes, crop, corner, place, SKY, "-")
        if kind == "false":
            _put_cut(axes, side.boxes[[row]], crop, corner, place, VERMILION, "-")
    if len(shown):
        _errors_legend(axes, kind)
    return axes


def _errors_legend(axes: Axes, kind: str) -> None:
    from matplotlib.lines import Line2D

    looks: list[Any] = [("labelled", "0.6", "--"), ("detected", SKY, "-")]
    looks += [("false alarm", VERMILION, "-")] if kind == "false" else []
    handles = [Line2D([], [], color=color, linestyle=dash, label=name) for name, color, dash in looks]
    axes.legend(handles=handles, loc="upper right", bbox_to_anchor=(1, 0), ncols=3, fontsize=8, frameon=False)


def _image_of(frames: LabelledFrames, key: FrameKey) -> NDArray[np.uint8]:
    held = frames.frames
    return held[held.names.index(str(key))] if isinstance(held, FrameSet) else held[key]


def _crop(image: NDArray[np.uint8], box: NDArray[Any]) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """Cut out a square around a box, with half of its size to spare, and where it begins."""
    height, width = image.shape[:2]
    x, y = (box[:2] + box[2:]) / 2
    half = max(24.0, 0.9 * float((box[2:] - box[:2]).max()))
    x1, y1 = max(0, int(x - half)), max(0, int(y - half))
    x2, y2 = min(width, int(x + half)), min(height, int(y + half))
    return image[y1 : max(y2, y1 + 1), x1 : max(x2, x1 + 1)], (x1, y1)


def _caption(
    side: FrameBoxes, row: int, key: FrameKey, predictions: FrameBoxes, labels: FrameBoxes, kind: str
) -> str:
    name = str(key).rpartition(".")[0] or str(key) if isinstance(key, str) else f"frame {key}"
    width, height = (side.boxes[row, 2:] - side.boxes[row, :2]).round().astype(int)
    if kind == "missed":
        overlaps = iou_matrix(side.boxes[[row]], predictions.frame(key).boxes)
        text = f"{width}x{height} px, IoU {overlaps.max(initial=0):.2f}"
    else:
        score = "" if side.scores is None else f"score {side.scores[row]:.2f}, "
        text = f"{score}{width}x{height} px"
    return f"{name if len(name) <= 24 else '...' + name[-21:]}\n{text}"


def _put_cut(
    axes: Axes,
    boxes: NDArray[Any],
    crop: NDArray[np.uint8],
    corner: tuple[int, int],
    place: tuple[float, float, float],
    color: Any,
    dash: str,
) -> None:
    """Draw the boxes that a tile shows, as far as they lie in it."""
    left, top, pixel = place
    height, width = crop.shape[:2]
    limits = np.array([width, height, width, height])
    inside = (boxes - np.tile(corner, 2)).clip(0, limits)
    inside = inside[(inside[:, 2:] - inside[:, :2] >= 2).all(axis=1)]
    if len(inside):
        placed = inside * pixel + np.array([left, top, left, top])
        put_boxes(axes, placed, color, linewidths=1.3, linestyles=dash)


# Greatest over least value from which a scale is logarithmic.
_WIDE = 20
# Letters that fit side by side under the x axis.
_ROOM = 60


def plot_tradeoff(
    table: DataFrame,
    *,
    quality: str = "accuracy",
    cost: str = "search_ms",
    label: str | None = "configuration",
    ax: Axes | None = None,
) -> Axes:
    """Plot what each configuration reaches against what it costs, and mark the best front.

    Parameters
    ----------
    table
        Rows of `compare_configurations` or `search_parameters`; those without either value are left out.
    quality
        Column of the y axis; more is better.
    cost
        Column of the x axis; less is better.
    label
        Column written beside the points of the front; None writes nothing.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        Its first collection holds all points; its first line is the front, cheapest first: no other point
        is better in one of the two without being worse in the other.

    Raises
    ------
    InvalidInputError
        If no row has both values, or a column does not exist.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"accuracy": [0.98, 0.99], "search_ms": [4.0, 9.0]})
    >>> plot_tradeoff(table, label=None).get_xlabel()
    'search ms'
    """
    front = pareto_front(table, quality, cost)
    if not len(front):
        raise InvalidInputError(f"table has no row with both {quality} and {cost}; measure them first")
    axes = new_axes(ax)
    x, y = numeric_column(table, cost), numeric_column(table, quality)
    shown = ~np.isnan(x) & ~np.isnan(y)
    axes.scatter(x[shown], y[shown], s=24, color="0.6", label="measured", zorder=2)
    axes.plot(front[cost], front[quality], "o-", color="C0", label="best front", zorder=3)
    if label is not None:
        for place in zip(front[cost], front[quality], front[label]):
            axes.annotate(str(place[2]), place[:2], (4, 6), textcoords="offset points", fontsize=8)
    axes.set_xlabel(cost.replace("_", " "))
    axes.set_ylabel(quality.replace("_", " "))
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return axes


def plot_parameter(
    table: DataFrame,
    parameter: str,
    *,
    quality: str = "accuracy",
    by: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot what a parameter does: the mean of a measurement for each of its values.

    Parameters
    ----------
    table
        Rows of `compare_configurations` or `search_parameters`; those without a measurement are left out.
    parameter
        Column of the x axis, such as ``"C"`` or ``"orient"``.
    quality
        Column of the y axis, a measurement.
    by
        A column that parts the rows into lines, such as ``"split"``; None draws one.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        One line for each value of `by`. The bars at its points are the standard deviation over the rows
        that agree in `parameter` and `by`. Numbers that span more than a factor of 20 are on a
        logarithmic scale; what holds more than numbers, at even distances.

    Raises
    ------
    InvalidInputError
        If a column does not exist, or no row was measured.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"C": [1e-4, 1.0], "accuracy": [0.99, 0.98]})
    >>> plot_parameter(table, "C").get_xscale()
    'log'
    """
    measured = table[~np.isnan(numeric_column(table, quality))]
    for name in [parameter] if by is None else [parameter, by]:
        if name not in table.columns:
            raise InvalidInputError(
                f"table has no column {name!r}; its columns are {', '.join(table.columns)}"
            )
        measured = measured[measured[name].notna()]
    if measured.empty:
        raise InvalidInputError(f"table has no row with both {parameter} and {quality}; measure them first")
    axes = new_axes(ax)
    values = measured[parameter].unique().tolist()
    numeric = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    listed = sorted(values) if numeric else values
    place = {value: value if numeric else index for index, value in enumerate(listed)}
    groups = [(None, measured)] if by is None else measured.groupby(by, sort=False)
    for (name, rows), (color, dash) in zip(groups, line_looks()):
        runs = rows.groupby(parameter, sort=False)[quality].agg(["mean", "std"])
        runs.index = runs.index.map(place)
        runs = runs.sort_index()
        axes.errorbar(
            runs.index,
            runs["mean"],
            yerr=runs["std"],
            fmt="o",
            linestyle=dash,
            color=color,
            capsize=3,
            markersize=4,
            label=None if by is None else str(name),
        )
    if not numeric:
        texts = [str(value) for value in listed]
        axes.set_xticks(range(len(listed)), texts)
        if max(map(len, texts)) * len(texts) > _ROOM:
            axes.tick_params(axis="x", rotation=30)
            for label in axes.get_xticklabels():
                label.set_horizontalalignment("right")
    elif listed[0] > 0 and listed[-1] > _WIDE * listed[0]:
        axes.set_xscale("log")
    axes.set_xlabel(parameter.replace("_", " "))
    axes.set_ylabel(quality.replace("_", " "))
    axes.grid(alpha=0.3)
    if by is not None:
        axes.legend(title=by.replace("_", " "), fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return axes
