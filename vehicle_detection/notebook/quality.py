"""Figures of quality: scores of patches, curves and errors on labelled frames, parameter studies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    check_array,
    check_choice,
    check_integer,
    check_number,
    check_type,
    describe,
)
from vehicle_detection.boxes import box_areas, clip_boxes, iou_matrix
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import (
    DetectionScores,
    LabelledFrames,
    best_f1,
    match_detections,
    prepare_evaluation,
)
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import LINE_COLORS, OTHER, SKY, TRUTH, VEHICLE, VERMILION, Image
from vehicle_detection.tables import FrameKey, TrackTable
from vehicle_detection.training import check_column, numeric_column, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

Curve = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_METRICS = ("f1", "precision", "recall", "average_precision", "mean_iou")
_METRIC_NAMES = {"f1": "F1", "average_precision": "average precision", "mean_iou": "mean IoU"}


def plot_scores(
    scores: ArrayLike, labels: ArrayLike, *, threshold: float = 0.0, bins: int = 60, ax: Axes | None = None
) -> Axes:
    """Plot histograms of the scores of both classes, on a logarithmic scale that makes errors visible.

    `labels` are 1 for a vehicle, 0 for anything else. Patches with scores above `threshold`, the vertical
    line, are classified as vehicles; the legend counts the errors.

    >>> axes = plot_scores([1.0, 2.0, -0.5, -2.0], [1, 1, 1, 0])
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['vehicles: 1 of 3 missed', 'other: 0 of 1 classified as vehicles', 'threshold 0']
    """
    from matplotlib.ticker import LogFormatter

    values, known = style.check_scores(scores, "scores"), check_array(labels, "labels")
    if known.shape != values.shape or not np.isin(known, (0, 1)).all():
        raise InvalidInputError(
            f"labels must be 0 or 1 for each of the {len(values)} scores; got {describe(known)}"
        )
    limit = check_number(threshold, "threshold")
    edges = _bin_edges(values, limit, check_integer(bins, "bins", low=1, high=10_000))
    axes = style.new_axes(ax)
    classes = ((1, VEHICLE, "vehicles", "missed"), (0, OTHER, "other", "classified as vehicles"))
    for vehicle, color, name, error in classes:
        own = values[known == vehicle]
        errors = int(((own > limit) != vehicle).sum())
        counts = np.histogram(own, edges)[0]
        axes.stairs(counts, edges, fill=True, color=color, alpha=0.35)
        label = f"{name}: {errors:,} of {len(own):,} {error}"
        axes.stairs(counts, edges, color=color, linewidth=1.4, label=label)
    axes.axvline(limit, color="black", linestyle="--", linewidth=1, label=f"threshold {limit:g}")
    axes.set(yscale="log", xlabel="score (decision value)", ylabel="patches")
    axes.set_ylim(bottom=0.7)
    # The default formatter writes 4x10^0 on an axis of less than a decade.
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_minor_formatter(LogFormatter())
    style.legend_above(axes, 3)
    return axes


def _bin_edges(values: NDArray[np.float64], threshold: float, count: int) -> NDArray[np.float64]:
    """Edges of about `count` bins, one of them at the threshold, so that no bin mixes both decisions."""
    low, high = min(float(values.min()), threshold), max(float(values.max()), threshold)
    width = (high - low) / count or 1.0
    before = np.ceil((threshold - low) / width)
    after = np.floor((high - threshold) / width) + 1
    return np.asarray(threshold + width * np.arange(-before, after + 1), np.float64)


def plot_precision_recall(
    curves: Mapping[str, Curve] | Curve, *, threshold: float | None = None, ax: Axes | None = None
) -> Axes:
    """Plot precision against recall for all score thresholds, with lines of equal F1.

    `curves` is a result of `precision_recall_curve`, or a mapping from names to several; a square marks the
    `threshold`, a dot the best F1.

    >>> curve = np.array([1.0, 0.5]), np.array([0.5, 0.5]), np.array([2.0, 0.5])
    >>> axes = plot_precision_recall({"road": curve})
    >>> axes.get_legend().get_texts()[0].get_text()
    'road: best F1 0.67 at 2.00'
    """
    named = curves if isinstance(curves, Mapping) else {"": curves}
    if not named:
        raise InvalidInputError("curves must hold at least one curve; got none")
    checked = {str(name): _check_curve(curve, str(name)) for name, curve in named.items()}
    limit = math.inf if threshold is None else check_number(threshold, "threshold")
    axes = style.new_axes(ax, 6.5, 6)
    for level in (0.2, 0.4, 0.6, 0.8, 0.9):
        x = np.linspace(level / (2 - level), 1, 100)
        axes.plot(x, level * x / (2 * x - level), color="0.85", linewidth=0.8, zorder=1)
        axes.annotate(f"F1 {level:g}", (1, x[0]), fontsize=7, color="0.5", ha="right", va="bottom")
    for (name, (precision, recall, thresholds)), (color, dash) in zip(checked.items(), style.line_styles()):
        f1, best_threshold = best_f1(precision, recall, thresholds)
        best = int(np.argmax(thresholds == best_threshold))
        text = f"best F1 {f1:.2f} at {best_threshold:.2f}"
        label = f"{name}: {text}" if name else text
        axes.plot(recall, precision, color=color, linestyle=dash, linewidth=1.8, label=label, zorder=3)
        axes.plot(recall[best], precision[best], "o", color=color, zorder=4)
        used = np.flatnonzero(thresholds > limit)
        if len(used):
            axes.plot(recall[used[-1]], precision[used[-1]], "s", color=color, mfc="white", zorder=4)
    axes.set(xlim=(0, 1.01), ylim=(0, 1.01), aspect="equal", xlabel="recall (fraction of vehicles found)")
    axes.set_ylabel("precision (fraction of boxes that are correct)")
    style.legend_above(axes, fontsize=8)
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
        raise InvalidInputError(f"{text} must be computed from detections and labelled vehicles; got none")
    return precision, recall, thresholds


def plot_f1(
    scores: Mapping[str, DetectionScores] | Mapping[str, Mapping[str, DetectionScores]],
    *,
    metric: str = "f1",
    ax: Axes | None = None,
) -> Axes:
    """Plot a metric on each source of frames as bars, for one detector or several.

    `scores` are results of `evaluate_detections` by source; or by detector, then by source. Unknown values
    have no bar. `metric` is ``"f1"``, ``"precision"``, ``"recall"``, ``"average_precision"`` or
    ``"mean_iou"``.

    >>> from vehicle_detection import evaluate_detections
    >>> labels = TrackTable([0], None, [[0, 0, 50, 40]])
    >>> axes = plot_f1({"road": evaluate_detections(labels, labels)})
    >>> [text.get_text() for text in axes.texts]
    ['1.00']
    """
    check_choice(metric, "metric", _METRICS)
    remedy = "pass what evaluate_detections returns"
    style.check_mapping(scores, "scores", "sources to DetectionScores", remedy)
    nested = all(isinstance(value, Mapping) for value in scores.values())
    detectors: dict[str, Any] = dict(scores) if nested else {"": scores}
    for by_source in detectors.values():
        for source, value in by_source.items():
            check_type(value, f"scores[{source!r}]", DetectionScores, remedy)
    sources = list(dict.fromkeys(source for by_source in detectors.values() for source in by_source))
    if not sources:
        raise InvalidInputError("scores must hold at least one source; got none")
    axes = style.new_axes(ax, 2.5 + 1.3 * len(sources), 4)
    width = 0.8 / len(detectors)
    for number, (name, by_source) in enumerate(detectors.items()):
        values = [getattr(by_source.get(source), metric, np.nan) for source in sources]
        positions = np.arange(len(sources)) + (number - (len(detectors) - 1) / 2) * width
        color = LINE_COLORS[number % len(LINE_COLORS)]
        bars = axes.bar(positions, values, width * 0.94, color=color, label=name)
        axes.bar_label(bars, ["" if np.isnan(v) else f"{v:.2f}" for v in values], padding=2, fontsize=8)
    _name_ticks(axes, [str(source) for source in sources])
    axes.set(ylim=(0, 1.1), ylabel=_METRIC_NAMES.get(metric, metric))
    axes.spines[["top", "right"]].set_visible(False)
    if nested:
        style.legend_above(axes, 3)
    return axes


def plot_errors(
    frames: LabelledFrames,
    predictions: TrackTable,
    *,
    kind: Literal["missed", "false"] = "missed",
    iou: float = 0.5,
    count: int = 12,
    columns: int = 6,
    ax: Axes | None = None,
) -> Axes:
    """Show crops of the worst errors: the largest missed vehicles, or the false positives of highest score.

    ``"missed"`` are labelled vehicles without a detection of at least `iou`, with the largest IoU of any;
    ``"false"`` are detections without a labelled vehicle. `predictions` are boxes with scores, as
    `TrackTable.from_detections` makes. Labelled boxes are dashed, detections solid. The title counts all
    errors, of which `count` are shown.

    >>> labels = TrackTable([0], None, [[10, 10, 60, 50]])
    >>> frames = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    >>> plot_errors(frames, TrackTable(score=[])).get_title()
    '1 of 1 vehicles missed'
    """
    check_type(frames, "frames", LabelledFrames, "pass LabelledFrames(name, frames, labels)")
    check_choice(kind, "kind", ("missed", "false"))
    min_iou = check_number(iou, "iou", above=0, high=1)
    max_count = check_integer(count, "count", low=1, high=1000)
    predictions, labels, keys = prepare_evaluation(predictions, frames.labels, frames.keys)
    matches = match_detections(predictions, labels, keys, min_iou)
    if kind == "missed":
        side, rows, importance = labels, matches.missed, box_areas(labels.boxes)
        title = f"{len(rows):,} of {len(matches.usable):,} vehicles missed"
    else:
        side, rows = predictions, np.flatnonzero((matches.match < 0) & ~matches.ignored)
        importance = np.nan_to_num(side["score"])
        title = f"{len(rows):,} of {len(predictions):,} detections are false positives"
    shown = rows[np.argsort(-importance[rows], kind="stable")[:max_count]].tolist()
    crops = [_crop(frames, side["frame"][row], side.boxes[row]) for row in shown]
    captions = [_caption(side, row, predictions, kind) for row in shown]
    tiles = [(image, caption) for (image, _), caption in zip(crops, captions)]
    axes, places = style.add_tiles(ax, tiles, columns=columns, inches=1.9, caption_lines=2)
    axes.set_title(title, fontsize=10)
    entries = [("labelled", "0.6", "--"), ("detected", SKY, "-"), ("false positive", VERMILION, "-")]
    entries = entries[: 2 if kind == "missed" else 3]
    for row, (image, corner), (left, top, pixel) in zip(shown, crops, places):
        true, found = labels.frame(side["frame"][row]), predictions.frame(side["frame"][row])
        layers = (true.boxes[~true["ignore"]], found.boxes, side.boxes[[row]])
        for boxes, color, (_, _, linestyle) in zip(layers, (TRUTH, SKY, VERMILION), entries):
            clipped = clip_boxes(boxes - np.tile(corner, 2), image.shape)
            clipped = clipped[(clipped[:, 2:] - clipped[:, :2] >= 2).all(axis=1)]
            if len(clipped):
                placed = clipped * pixel + np.array([left, top, left, top])
                style.add_boxes(axes, placed, color, linewidths=1.3, linestyles=linestyle)
    if shown:
        options: dict[str, Any] = {"bbox_to_anchor": (1, 0), "ncols": 3, "fontsize": 8, "frameon": False}
        axes.legend(handles=style.legend_lines(*entries), loc="upper right", **options)
    return axes


def _crop(frames: LabelledFrames, key: FrameKey, box: NDArray[Any]) -> tuple[Image, tuple[int, int]]:
    """Cut out a square around the center of a box, 1.8 times its longer side; and its upper left corner."""
    images = frames.frames
    image = images[images.names.index(str(key))] if isinstance(images, FrameSet) else images[key]
    height, width = image.shape[:2]
    x, y = (box[:2] + box[2:]) / 2
    half = max(24.0, 0.9 * float((box[2:] - box[:2]).max()))
    x1, y1 = max(0, int(x - half)), max(0, int(y - half))
    x2, y2 = min(width, int(x + half)), min(height, int(y + half))
    return image[y1 : max(y2, y1 + 1), x1 : max(x2, x1 + 1)], (x1, y1)


def _caption(side: TrackTable, row: int, predictions: TrackTable, kind: str) -> str:
    """Frame, size of the box, and its best IoU or its score."""
    key = side["frame"][row]
    name = str(key).rpartition(".")[0] or str(key) if isinstance(key, str) else f"frame {key}"
    width, height = (side.boxes[row, 2:] - side.boxes[row, :2]).round().astype(int)
    text = f"{width}x{height} px"
    if kind == "missed":
        overlaps = iou_matrix(side.boxes[[row]], predictions.frame(key).boxes)
        text += f", IoU {overlaps.max(initial=0):.2f}"
    elif "score" in side.columns:
        text = f"score {side['score'][row]:.2f}, {text}"
    return f"{name if len(name) <= 24 else '...' + name[-21:]}\n{text}"


# Ratio of the largest to the smallest value above which the x axis is logarithmic.
_LOG_RATIO = 20
# Width of a character of a tick label as a fraction of the font's size; axes grow when they are laid out.
_CHARACTER_WIDTH = 0.5
# Quantities of columns of results whose names do not say them.
_QUANTITIES = {
    "accuracy": "accuracy on patches",
    "train_accuracy": "accuracy on training patches",
    "search_ms": "search time (ms per frame)",
    "fit_seconds": "training time (s)",
    "frame_f1": "F1 on frames",
    "frame_best_f1": "best F1 on frames",
    "frame_average_precision": "average precision on frames",
    "frame_iou": "mean IoU on frames",
    "n_features": "number of features",
}


def plot_tradeoff(
    table: DataFrame,
    *,
    quality: str = "accuracy",
    cost: str = "search_ms",
    label: str | None = "configuration",
    ax: Axes | None = None,
) -> Axes:
    """Plot the quality of each configuration against its cost, with the Pareto front.

    `table` holds results of `compare_configurations` or `compare_searches`. `quality` and `cost` are its
    columns of the y axis, where higher is better, and of the x axis, where lower is better; `label` is that
    of the text beside the points of the front. Rows without either value are left out. The first collection
    of the Axes holds all points, the first line the front (see `pareto_front`).

    >>> import pandas as pd
    >>> table = pd.DataFrame({"accuracy": [0.98, 0.99], "search_ms": [4.0, 9.0]})
    >>> plot_tradeoff(table, label=None).get_xlabel()
    'search time (ms per frame)'
    """
    front = pareto_front(table, quality, cost)
    if not len(front):
        raise InvalidInputError(f"table has no row with both {quality} and {cost}; measure them first")
    if label is not None:
        check_column(table, label)
    axes = style.new_axes(ax)
    x, y = numeric_column(table, cost), numeric_column(table, quality)
    shown = ~np.isnan(x) & ~np.isnan(y)
    axes.scatter(x[shown], y[shown], s=24, color="0.6", label="measured", zorder=2)
    axes.plot(front[cost], front[quality], "o-", color="C0", label="Pareto front", zorder=3)
    axes.set(xlabel=_quantity(cost), ylabel=_quantity(quality))
    axes.grid(alpha=0.3)
    axes.margins(0.12)
    low, high = axes.get_ylim()
    if y[shown].max() <= 1 < high:  # a fraction: above 1 is room for text only
        axes.set_ylim(low, min(high, 1 + 0.06 * (1 - low)))
        axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= 1])
    if label is not None:
        middle = sum(axes.get_xlim()) / 2
        for x, y, text in zip(front[cost], front[quality], front[label]):
            # Away from the nearer side of the axes, and off the rising front.
            options: dict[str, Any] = {"ha": "left", "va": "top"} if x < middle else {"ha": "right"}
            offset = (5, -3) if x < middle else (-5, 3)
            axes.annotate(str(text), (x, y), offset, textcoords="offset points", fontsize=7, **options)
    style.legend_above(axes, 2)
    return axes


def plot_parameter(
    table: DataFrame,
    parameter: str,
    *,
    quality: str = "accuracy",
    by: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot the mean of a measurement against a parameter.

    `parameter` and `quality` are the columns of both axes in a `table` as in `plot_tradeoff`. There is a line
    for each value of the column `by`, such as ``"split"``, with the standard deviation over rows with the
    same `parameter` and `by` as error bars. The x axis is logarithmic if its numbers span more than a factor
    of 20, and evenly spaced if it holds text.

    >>> import pandas as pd
    >>> table = pd.DataFrame({"C": [1e-4, 1.0], "accuracy": [0.99, 0.98]})
    >>> plot_parameter(table, "C").get_xscale()
    'log'
    """
    columns = [parameter] if by is None else [parameter, by]
    for name in columns:
        check_column(table, name)
    measured = table[~np.isnan(numeric_column(table, quality))].dropna(subset=columns).reset_index(drop=True)
    if measured.empty:
        raise InvalidInputError(f"table has no row with both {parameter} and {quality}; measure them first")
    axes = style.new_axes(ax)
    values = measured[parameter].tolist()
    numeric = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    x, names = (np.array(values), ()) if numeric else measured[parameter].factorize()
    groups = [(None, measured)] if by is None else measured.groupby(by, sort=False)
    for (name, rows), (color, dash) in zip(groups, style.line_styles()):
        runs = rows[quality].groupby(x[rows.index]).agg(["mean", "std"])
        look: dict[str, Any] = {"fmt": "o", "linestyle": dash, "color": color, "capsize": 3, "markersize": 4}
        lines = axes.errorbar(runs.index, runs["mean"], runs["std"], **look)
        lines.set_label(None if by is None else str(name))
    if not numeric:
        _name_ticks(axes, [str(name) for name in names])
    elif x.min() > 0 and x.max() > _LOG_RATIO * x.min():
        axes.set_xscale("log")
    axes.set(xlabel=_quantity(parameter), ylabel=_quantity(quality))
    axes.grid(alpha=0.3)
    if by is not None:
        axes.legend(title=_quantity(by), fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return axes


def _quantity(column: str) -> str:
    """Name of a column's quantity with its unit."""
    return _QUANTITIES.get(column, column.replace("_", " "))


def _name_ticks(axes: Axes, texts: list[str]) -> None:
    """Write a text at each position 0, 1, ... of the x axis, turned if they are long."""
    axes.set_xticks(range(len(texts)), texts)
    points = axes.get_window_extent().width * 72 / axes.figure.dpi
    character = _CHARACTER_WIDTH * float(axes.get_xticklabels()[0].get_fontsize())
    if max(map(len, texts)) * len(texts) * character > points:
        axes.set_xticks(range(len(texts)), texts, rotation=30, ha="right", rotation_mode="anchor")
