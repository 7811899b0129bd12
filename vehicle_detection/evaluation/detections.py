"""Detections and tracks against labelled frames: how many are found, how well they fit, who stays who.

The boxes of `FrameBoxes` marked ``ignore`` are not scored, and a prediction on them is neither right nor wrong:
one whose center lies in a region (``ignore`` with track -1), or that covers an ignored box at the IoU in
use. Usable boxes are matched first, so an ignore region over a vehicle does not take its detection away.

Where a box to ignore holds several vehicles, such as cars that touch in a mask of a class, none of them
covers it. With ``ignored_as_regions`` a prediction is neutral, too, where half of it or more lies in one.

A ratio with nothing to count is NaN: ``n/a`` in a summary, None in ``to_dict``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.labels import FrameBoxes, FrameKey
from vehicle_detection.evaluation.matching import (
    Scores,
    as_lines,
    as_text,
    find_ignored,
    mean,
    prepare_sides,
    rates,
    ratio,
)

SIZES = {"small": (0.0, 64.0), "medium": (64.0, 128.0), "large": (128.0, math.inf)}
"""Half-open ranges of box width in pixels."""


@dataclass(frozen=True)
class SizeScores:
    """Detection scores of one range of widths; the label's width counts, for a false box its own.

    Attributes
    ----------
    tp, fp, fn
        Vehicles found, false boxes, vehicles missed.
    precision, recall, f1, mean_iou
        As in `DetectionScores`.
    """

    tp: int
    fp: int
    fn: int
    precision: float
    recall: float
    f1: float
    mean_iou: float


@dataclass(frozen=True)
class DetectionScores(Scores):
    """What `evaluate_detections` found.

    Attributes
    ----------
    frames
        Number of evaluated frames.
    iou
        Overlap from which a detection matches a vehicle.
    tp, fp, fn
        Vehicles found, false detections, vehicles missed.
    ignored
        Detections that are neither right nor wrong.
    precision, recall, f1
        ``tp / (tp + fp)``, ``tp / (tp + fn)`` and ``2 tp / (2 tp + fp + fn)``.
    average_precision
        Area under the precision-recall curve, precision made monotonic (PASCAL VOC from 2010 on).
    false_positives_per_frame
        ``fp / frames``.
    mean_iou
        Mean overlap of the matched pairs.
    by_size
        The same for ``"small"`` (under 64 px wide), ``"medium"`` (under 128 px) and ``"large"`` vehicles.
    """

    frames: int
    iou: float
    tp: int
    fp: int
    fn: int
    ignored: int
    precision: float
    recall: float
    f1: float
    average_precision: float
    false_positives_per_frame: float
    mean_iou: float
    by_size: dict[str, SizeScores]

    def summary(self) -> str:
        """Say the scores in a few aligned lines."""
        rows = {
            "F1": as_text(self.f1),
            "precision": as_text(self.precision),
            "recall": as_text(self.recall),
            "average precision": as_text(self.average_precision),
            "mean IoU": as_text(self.mean_iou),
            "false a frame": as_text(self.false_positives_per_frame),
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        for name, (low, high) in SIZES.items():
            size = self.by_size[name]
            reach = f"from {low:g} px" if high == math.inf else f"under {high:g} px"
            rows[f"{name}, {reach}"] = (
                f"F1 {as_text(size.f1)}, {size.tp} of {size.tp + size.fn}, {size.fp} false"
            )
        return as_lines(f"Detections in {self.frames} frames at IoU {self.iou:g}", rows)


def evaluate_detections(
    predictions: FrameBoxes,
    labels: FrameBoxes,
    *,
    iou: float = 0.5,
    frames: Sequence[FrameKey] | None = None,
    ignored_as_regions: bool = False,
) -> DetectionScores:
    """Score detections against labels, each frame by itself.

    In every frame the detections choose in order of their score, each the vehicle it overlaps most among
    those still free, as in PASCAL VOC and COCO; equal scores choose in order of their best overlap.

    Parameters
    ----------
    predictions
        Detected boxes; their tracks do not matter. Without scores all count as equally sure. Rows marked
        ``ignore`` are left out.
    labels
        True boxes.
    iou
        Overlap in (0, 1] from which a detection matches a vehicle, or covers an ignored box.
    frames
        All evaluated frames, so that those without label and prediction count too. Labels in other frames
        are left out. None takes all frames that `predictions` or `labels` know of.
    ignored_as_regions
        Whether a detection of which half or more lies in an ignored box is neutral as well: for labels whose
        ignored boxes hold several vehicles each.

    Returns
    -------
    DetectionScores
        Counts and ratios, in all and by size.

    Raises
    ------
    InvalidInputError
        If an argument is no `FrameBoxes`, `iou` is out of range, a prediction is in none of the `frames`, or
        predictions and labels name their frames differently.

    Examples
    --------
    >>> labels = Labels([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = Labels([0, 0], None, [[1, 0, 51, 40], [400, 0, 450, 40]], scores=[2.0, 0.5])
    >>> scores = evaluate_detections(found, labels)
    >>> scores.precision, scores.recall, scores.average_precision
    (0.5, 0.5, 0.5)
    """
    predictions, labels, keys = prepare_sides(predictions, labels, frames)
    limit = check_number(iou, "iou", above=0, high=1)
    found = match_detections(predictions, labels, keys, limit, ignored_as_regions=ignored_as_regions)
    hit, false = found.partner >= 0, (found.partner < 0) & ~found.ignored
    missed = np.setdiff1d(found.usable, found.partner)

    true_widths = _widths(labels)
    by_size = {}
    for name, (low, high) in SIZES.items():
        widths = true_widths[found.partner[hit]], _widths(predictions)[false], true_widths[missed]
        tp, fp, fn = ((low <= width) & (width < high) for width in widths)
        by_size[name] = SizeScores(
            *rates(int(tp.sum()), int(fp.sum()), int(fn.sum())), mean(found.overlap[hit][tp])
        )
    tp_all, fp_all, fn_all, precision, recall, f1 = rates(int(hit.sum()), int(false.sum()), len(missed))
    return DetectionScores(
        frames=len(keys),
        iou=limit,
        tp=tp_all,
        fp=fp_all,
        fn=fn_all,
        ignored=int(found.ignored.sum()),
        precision=precision,
        recall=recall,
        f1=f1,
        average_precision=_average_precision(*_curve(predictions, found)[:2]),
        false_positives_per_frame=ratio(fp_all, len(keys)),
        mean_iou=mean(found.overlap[hit]),
        by_size=by_size,
    )


def precision_recall_curve(
    predictions: FrameBoxes, labels: FrameBoxes, *, iou: float = 0.5, ignored_as_regions: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision and recall for every threshold on the detections' scores.

    Parameters
    ----------
    predictions
        Detected boxes with scores.
    labels
        True boxes.
    iou
        Overlap in (0, 1] from which a detection matches a vehicle.
    ignored_as_regions
        As in `evaluate_detections`.

    Returns
    -------
    precision, recall, thresholds : numpy.ndarray
        Three ``(K,)`` float64 arrays, one entry for each score that occurs, highest first: what the
        detections with a score of at least ``thresholds[k]`` reach. Recall never falls along them; it is
        NaN where no vehicle is labelled.

    Raises
    ------
    InvalidInputError
        If predictions have no scores, and where `evaluate_detections` does.

    Examples
    --------
    >>> labels = Labels([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = Labels([0, 0], None, [[0, 0, 50, 40], [400, 0, 450, 40]], scores=[2.0, 0.5])
    >>> precision_recall_curve(found, labels)
    (array([1. , 0.5]), array([0.5, 0.5]), array([2. , 0.5]))
    """
    predictions, labels, keys = prepare_sides(predictions, labels, None)
    if len(predictions) and predictions.scores is None:
        raise InvalidInputError("predictions need scores for a curve; pass Labels with scores=")
    limit = check_number(iou, "iou", above=0, high=1)
    found = match_detections(predictions, labels, keys, limit, ignored_as_regions=ignored_as_regions)
    return _curve(predictions, found)


def _widths(labels: FrameBoxes) -> NDArray[np.float64]:
    return labels.boxes[:, 2] - labels.boxes[:, 0]


@dataclass(frozen=True)
class Matching:
    """The fate of every prediction.

    Attributes
    ----------
    partner
        ``(N,)`` row of the label that each prediction found, -1 for none.
    overlap
        ``(N,)`` IoU of the two.
    ignored
        ``(N,)`` whether the prediction is neither right nor wrong.
    usable
        Rows of the labels that are scored.
    """

    partner: NDArray[np.intp]
    overlap: NDArray[np.float64]
    ignored: NDArray[np.bool_]
    usable: NDArray[np.intp]


def match_detections(
    predictions: FrameBoxes,
    labels: FrameBoxes,
    keys: list[FrameKey],
    limit: float,
    *,
    ignored_as_regions: bool = False,
) -> Matching:
    """Match each frame greedily by score, then find what is neutral among the rest.

    Parameters
    ----------
    predictions, labels
        Found and true boxes.
    keys
        The frames to match in.
    limit
        Least IoU of a match.
    ignored_as_regions
        As in `evaluate_detections`.
    """
    count = len(predictions)
    scores = np.zeros(count) if predictions.scores is None else predictions.scores
    partner, overlap, ignored = np.full(count, -1, np.intp), np.zeros(count), np.zeros(count, np.bool_)
    usable: list[int] = []
    for key in keys:
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~labels.ignore[rows]]
        usable += targets.tolist()
        overlaps = iou_matrix(predictions.boxes[here], labels.boxes[targets])
        best = overlaps.max(axis=1, initial=0)
        for index in np.lexsort((-best, -scores[here])) if len(targets) else ():
            target = int(np.argmax(overlaps[index]))
            if overlaps[index, target] >= limit:
                partner[here[index]], overlap[here[index]] = targets[target], overlaps[index, target]
                overlaps[:, target] = -1
        rest = here[partner[here] < 0]
        ignored[rest] = find_ignored(
            predictions.boxes[rest], labels, rows, limit, as_regions=ignored_as_regions
        )
    return Matching(partner, overlap, ignored, np.array(usable, np.intp))


def _curve(
    predictions: FrameBoxes, found: Matching
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision, recall and threshold for every distinct score, highest first.

    A greedy match depends on higher scores alone, so the match at a threshold is a prefix of the whole.
    """
    counted = np.flatnonzero(~found.ignored)
    scores = np.zeros(len(counted)) if predictions.scores is None else predictions.scores[counted]
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(found.partner[counted][order] >= 0)
    last = np.flatnonzero(np.diff(scores[order], append=-np.inf))
    recall = hits[last] / len(found.usable) if len(found.usable) else np.full(len(last), np.nan)
    return hits[last] / (last + 1), recall, scores[order][last]


def _average_precision(precision: NDArray[np.float64], recall: NDArray[np.float64]) -> float:
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall, prepend=0) * envelope).sum())
