"""Figures of quality: scores of patches, curves and errors on labelled frames, parameter studies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.boxes import box_areas, clip_boxes, iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, best_f1, match_detections, prepare_evaluation
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import SKY, TRUTH, VERMILION, Image
from vehicle_detection.tables import FrameKey, TrackTable
from vehicle_detection.training import check_column, numeric_column, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

Curve = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


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
    limit = math.inf if threshold is None else check.number(threshold, "threshold")
    axes = style.new_axes(ax, 6.5, 6)
    for level in (0.2, 0.4, 0.6, 0.8, 0.9):
        x = np.linspace(level / (2 - level), 1, 100)
        axes.plot(x, level * x / (2 * x - level), color="0.85", linewidth=0.8, zorder=1)
        axes.annotate(f"F1 {level:g}", (1, x[0]), fontsize=7, color="0.5", ha="right", va="bottom")
    for name, (precision, recall, thresholds) in checked.items():
        f1, best_threshold = best_f1(precision, recall, thresholds)
        best = int(np.argmax(thresholds == best_threshold))
        text = f"best F1 {f1:.2f} at {best_threshold:.2f}"
        label = f"{name}: {text}" if name else text
        (line,) = axes.plot(recall, precision, linewidth=1.8, label=label, zorder=3)
        color = line.get_color()
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
        remedy = "pass what precision_recall_curve returns"
        raise invalid(text, "be (precision, recall, thresholds)", curve, remedy)
    precision, recall, thresholds = (np.asarray(part, np.float64) for part in curve)
    if precision.ndim != 1 or not precision.size or np.isnan(recall).any():
        raise InvalidInputError(f"{text} must be computed from detections and labelled vehicles; got none")
    return precision, recall, thresholds


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
    check.instance(frames, "frames", LabelledFrames, "pass LabelledFrames(name, frames, labels)")
    check.choice(kind, "kind", ("missed", "false"))
    min_iou = check.number(iou, "iou", above=0, high=1)
    max_count = check.integer(count, "count", low=1, high=1000)
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
    image = frames[key]
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


def _quantity(column: str) -> str:
    """Name of a column's quantity with its unit."""
    return _QUANTITIES.get(column, column.replace("_", " "))
