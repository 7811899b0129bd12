"""Score detections against labelled frames: precision, recall, F1, average precision.

Labels marked ``ignore`` are not scored. An unmatched prediction counts neither as right nor as wrong if its
center lies in a region (``ignore`` with track -1), or if it overlaps an ignored box by at least the IoU in
use; with ``ignored_as_regions`` also if half of it lies in an ignored box. A ratio whose denominator is 0 is
NaN: ``n/a`` in a summary, None in ``to_dict``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.matching import DetectionMatches, match_detections, prepare_evaluation
from vehicle_detection.tables import FrameKey, TrackTable

SIZES = {"small": (0.0, 64.0), "medium": (64.0, 128.0), "large": (128.0, math.inf)}
"""Half-open ranges of box width in pixels."""


@dataclass(frozen=True)
class Scores:
    """Base class of detection scores and track scores."""

    def summary(self) -> str:
        """Return the scores as a few aligned lines."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON; NaN becomes None."""
        return dataclasses.asdict(self, dict_factory=_nan_to_none)

    def __str__(self) -> str:
        return self.summary()


def _nan_to_none(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in fields}


def rates(tp: int, fp: int, fn: int) -> dict[str, Any]:
    """Return the counts, precision, recall and F1, by the names of the fields."""
    precision, recall, f1 = ratio(tp, tp + fp), ratio(tp, tp + fn), ratio(2 * tp, 2 * tp + fp + fn)
    return {"tp": tp, "fp": fp, "fn": fn, "precision": precision, "recall": recall, "f1": f1}


def ratio(part: float, whole: float) -> float:
    """Divide; NaN where `whole` is 0."""
    return part / whole if whole else math.nan


def mean(values: ArrayLike) -> float:
    """Mean; NaN for no values."""
    array = np.asarray(values, np.float64)
    return float(array.mean()) if array.size else math.nan


def format_number(value: float) -> str:
    """Format a ratio or length for a summary."""
    return "n/a" if math.isnan(value) else f"{value:.3f}"


def format_summary(title: str, rows: dict[str, str]) -> str:
    """Lay out a title and, below it, one aligned line for each name and its text."""
    width = max(map(len, rows))
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in rows.items())])


@dataclass(frozen=True)
class SizeScores:
    """Detection scores of one range of box widths: of the label, or of the prediction if it is false."""

    tp: int
    fp: int
    fn: int
    precision: float
    recall: float
    f1: float
    mean_iou: float


@dataclass(frozen=True)
class DetectionScores(Scores):
    """Result of `evaluate_detections`.

    >>> boxes = TrackTable([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> evaluate_detections(boxes, boxes).f1
    1.0
    """

    frames: int  #: number of evaluated frames
    iou: float  #: smallest IoU of a match
    tp: int  #: vehicles found
    fp: int  #: false detections
    fn: int  #: vehicles missed
    ignored: int  #: ignored detections
    precision: float  #: ``tp / (tp + fp)``
    recall: float  #: ``tp / (tp + fn)``
    f1: float  #: ``2 tp / (2 tp + fp + fn)``
    average_precision: float  #: area under the monotonic precision-recall curve (PASCAL VOC since 2010)
    false_positives_per_frame: float  #: ``fp / frames``
    mean_iou: float  #: of the matched pairs
    by_size: dict[str, SizeScores]  #: of ``"small"`` (below 64 px), ``"medium"`` (below 128), ``"large"``

    def summary(self) -> str:
        """Return the scores as a few aligned lines."""
        rows = {
            "F1": format_number(self.f1),
            "precision": format_number(self.precision),
            "recall": format_number(self.recall),
            "average precision": format_number(self.average_precision),
            "mean IoU": format_number(self.mean_iou),
            "false a frame": format_number(self.false_positives_per_frame),
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        for (name, size), (low, high) in zip(self.by_size.items(), SIZES.values()):
            limit = f"from {low:g} px" if high == math.inf else f"under {high:g} px"
            found = f"F1 {format_number(size.f1)}, {size.tp} of {size.tp + size.fn}, {size.fp} false"
            rows[f"{name}, {limit}"] = found
        return format_summary(f"Detections in {self.frames} frames at IoU {self.iou:g}", rows)


def evaluate_detections(
    predictions: TrackTable,
    labels: TrackTable,
    *,
    iou: float = 0.5,
    frames: Sequence[FrameKey] | None = None,
    ignored_as_regions: bool = False,
) -> DetectionScores:
    """Score detections against labels, each frame by itself.

    In every frame the detections are matched in order of their score, each to the free label that it overlaps
    most, as in PASCAL VOC and COCO; equal scores are ordered by their best overlap.

    Parameters
    ----------
    predictions, labels
        Detected and true boxes; predictions marked ``ignore`` are left out. Without scores, all scores count
        as equal. Names of frames may differ by folder and suffix.
    iou
        Smallest IoU, in (0, 1], at which a detection matches a label or is ignored with an ignored box.
    frames
        All evaluated frames, which must hold those of the predictions; None takes those of both sides.
    ignored_as_regions
        Also ignore a detection of which at least half lies in an ignored box: for labels whose ignored boxes
        cover several vehicles each.

    Examples
    --------
    >>> labels = TrackTable([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = TrackTable([0, 0], None, [[1, 0, 51, 40], [400, 0, 450, 40]], score=[2.0, 0.5])
    >>> scores = evaluate_detections(found, labels)
    >>> scores.precision, scores.recall, scores.average_precision
    (0.5, 0.5, 0.5)
    """
    check.flags(ignored_as_regions=ignored_as_regions)
    predictions, labels, keys = prepare_evaluation(predictions, labels, frames)
    min_iou = check.number(iou, "iou", above=0, high=1)
    found = match_detections(predictions, labels, keys, min_iou, ignored_as_regions=ignored_as_regions)
    hit, false, missed = found.match >= 0, (found.match < 0) & ~found.ignored, found.missed

    label_widths, widths = (side.boxes[:, 2] - side.boxes[:, 0] for side in (labels, predictions))
    by_size = {}
    for name, (low, high) in SIZES.items():
        sides = label_widths[found.match[hit]], widths[false], label_widths[missed]
        tp, fp, fn = ((low <= width) & (width < high) for width in sides)
        counts = rates(int(tp.sum()), int(fp.sum()), int(fn.sum()))
        by_size[name] = SizeScores(**counts, mean_iou=mean(found.iou[hit][tp]))
    precision, recall, _ = _curve(predictions, found)
    monotonic = np.maximum.accumulate(precision[::-1])[::-1]
    area = float((np.diff(recall, prepend=0) * monotonic).sum())
    return DetectionScores(
        frames=len(keys),
        iou=min_iou,
        ignored=int(found.ignored.sum()),
        average_precision=area if hit.any() or len(missed) else math.nan,  # unknown without labels
        false_positives_per_frame=ratio(int(false.sum()), len(keys)),
        mean_iou=mean(found.iou[hit]),
        by_size=by_size,
        **rates(int(hit.sum()), int(false.sum()), len(missed)),
    )


def precision_recall_curve(
    predictions: TrackTable, labels: TrackTable, *, iou: float = 0.5, ignored_as_regions: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision and recall for every threshold on the scores; options as in `evaluate_detections`.

    Returns
    -------
    precision, recall, thresholds : numpy.ndarray
        Three ``(K,)`` float64 arrays with one entry for each distinct score, highest first: the values for
        the detections with a score of at least ``thresholds[k]``. Recall is NaN if no vehicle is labelled.

    Examples
    --------
    >>> labels = TrackTable([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = TrackTable([0, 0], None, [[0, 0, 50, 40], [400, 0, 450, 40]], score=[2.0, 0.5])
    >>> precision_recall_curve(found, labels)
    (array([1. , 0.5]), array([0.5, 0.5]), array([2. , 0.5]))
    """
    check.flags(ignored_as_regions=ignored_as_regions)
    predictions, labels, keys = prepare_evaluation(predictions, labels, None)
    if len(predictions) and "score" not in predictions.columns:
        raise InvalidInputError("predictions need scores for a curve; pass a TrackTable with score=")
    min_iou = check.number(iou, "iou", above=0, high=1)
    found = match_detections(predictions, labels, keys, min_iou, ignored_as_regions=ignored_as_regions)
    return _curve(predictions, found)


def best_f1(
    precision: NDArray[np.float64], recall: NDArray[np.float64], thresholds: NDArray[np.float64]
) -> tuple[float, float]:
    """Best F1 of a precision-recall curve, and the first threshold that reaches it; ``(0, NaN)`` if empty."""
    if not len(thresholds):
        return 0.0, math.nan
    recall = np.nan_to_num(recall)  # NaN: no vehicle is labelled
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    # The tolerance makes equal F1 from different counts tie in spite of rounding errors.
    best = int(np.argmax(f1 >= f1.max() - 1e-12))
    return float(f1.max()), float(thresholds[best])


def _curve(
    predictions: TrackTable, found: DetectionMatches
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision, recall and threshold for every distinct score, highest first.

    A greedy match depends on higher scores only, so one matching serves all thresholds.
    """
    scored = np.flatnonzero(~found.ignored)
    scores = np.nan_to_num(predictions["score"][scored])  # without scores, all are equal
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(found.match[scored][order] >= 0)
    last = np.flatnonzero(np.diff(scores[order], append=-np.inf))
    recall = hits[last] / len(found.usable) if len(found.usable) else np.full(len(last), np.nan)
    return hits[last] / (last + 1), recall, scores[order][last]
