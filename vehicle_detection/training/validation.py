"""Validation of a model on labelled frames that it was not trained on: detections, scores and calibration."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, atomic_write, check, resolve_jobs, spreadsheet_text
from vehicle_detection.boxes import Platt
from vehicle_detection.detector import Model
from vehicle_detection.evaluation import (
    DetectionMatches,
    LabelledFrames,
    best_f1,
    calibrate_scores,
    calibration_error,
    evaluate_detections,
    match_detections,
    mean,
    precision_recall_curve,
)
from vehicle_detection.tables import FrameKey, TrackTable
from vehicle_detection.training.frames import FrameDataset, select_frames

# Log-odds that `best_threshold` chooses from.
_THRESHOLDS = np.arange(-4.0, 4.0, 0.02)
_MIN_PROBABILITY = 0.1  # of a box that counts in the calibration error
# In F-beta, a false box counts 1 / 0.7 = 1.4 times as much as a missed vehicle.
_BETA_SQUARED = 0.7
# Distance (px) to the left, right or lower edge of the frame from which on it may cut a vehicle.
_EDGE = 2.0
_NARROW = 32.0  # width (px) below which a vehicle is narrow

FOLD_COLUMNS = {
    "f1": ("F1", 3), "best_f1": ("best F1", 3), "average_precision": ("AP", 3), "precision": ("precision", 3),
    "recall": ("recall", 3), "mean_iou": ("mean IoU", 3), "false_per_frame": ("false", 2),
    "false_per_empty_frame": ("on empty", 2),
    "false_per_vehicle_free_frame": ("without vehicle", 2), "region_f1": ("region F1", 3),
    "region_average_precision": ("region AP", 3), "strict_average_precision": ("AP 0.7", 3),
    "recall_occluded": ("occluded", 3), "recall_truncated": ("truncated", 3),
    "recall_narrow": ("under 32 px", 3), "calibration_error": ("ECE", 3),
}  # fmt: skip
"""Columns of a table of `FoldScore`: titles and decimals."""


@dataclass(frozen=True, kw_only=True)
class FoldScore:
    """Scores on a set of frames whose source was left out of training.

    The region scores are those with ``ignored_as_regions=True``, see `evaluate_detections`: for labels with
    one ignored box around a group of vehicles, in which the other scores count detections as false. A rate
    without anything to count is NaN.
    """

    name: str
    source: str
    frames: int
    vehicles: int  # scored labels
    f1: float  # this and the next three at `threshold`
    precision: float
    recall: float
    mean_iou: float
    false_per_frame: float
    false_per_empty_frame: float  # per frame without any label
    false_per_vehicle_free_frame: float  # per frame without a scored label; not those in ignored boxes
    threshold: float  # log-odds
    average_precision: float
    best_f1: float  # at the best threshold of this set
    region_f1: float
    region_average_precision: float
    strict_average_precision: float  # region average precision at IoU 0.7
    recall_occluded: float  # of the vehicles that are partly occluded, by their labels
    recall_truncated: float  # of those that the left, right or lower edge of the frame cuts
    recall_narrow: float  # of those under 32 px wide
    occluded: int  # numbers of these vehicles
    truncated: int
    narrow: int
    calibration_error: float  # of probabilities from 0.1 on

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, rounded to four digits, without those that are NaN."""
        return {
            name: round(value, 4) if isinstance(value, float) else value
            for name, value in asdict(self).items()
            if not (isinstance(value, float) and math.isnan(value))
        }


@dataclass(frozen=True, eq=False)
class FoldDetections:
    """Detections in a set of frames whose source was left out of training."""

    source: str
    frames: LabelledFrames
    predictions: TrackTable  # scores are log-odds

    @property
    def labels(self) -> TrackTable:
        """Labels that list all frames, also those without a box."""
        return self.frames.labels

    @property
    def logits(self) -> Floats:
        """Log-odds of each prediction."""
        return self.predictions["score"]

    @cached_property
    def matches(self) -> DetectionMatches:
        """Predictions matched to labels at IoU 0.5; ignored boxes are regions."""
        return match_detections(self.predictions, self.labels, self.frames.keys, 0.5, ignored_as_regions=True)

    @property
    def hits(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Log-odds of the predictions that are not ignored, and which of them match a vehicle."""
        scored = ~self.matches.ignored
        return self.logits[scored], self.matches.match[scored] >= 0

    @property
    def matched_iou(self) -> Floats:
        """IoU of each matched prediction with its label."""
        return self.matches.iou[self.matches.match >= 0]

    def above(self, threshold: float) -> TrackTable:
        """Predictions with log-odds of at least `threshold`."""
        return self.predictions[self.logits >= threshold]

    @cached_property
    def shapes(self) -> dict[FrameKey, tuple[int, int]]:
        """Height and width of each frame (px)."""
        return {key: (image.shape[0], image.shape[1]) for key, image in self.frames}

    @property
    def groups(self) -> dict[str, NDArray[np.intp]]:
        """Rows of the scored labels that are occluded, truncated and narrow, see `FoldScore`."""
        labels, rows = self.labels, self.matches.usable
        boxes = labels.boxes[rows]
        sizes = np.array([self.shapes[labels["frame"][row]] for row in rows.tolist()]).reshape(-1, 2)
        at_edge = (boxes[:, 0] <= _EDGE) | (boxes[:, 2:] >= sizes[:, ::-1] - _EDGE).any(axis=1)
        return {
            "occluded": rows[labels["occluded"][rows] == 1],
            "truncated": rows[at_edge | (labels["truncated"][rows] > 0)],
            "narrow": rows[boxes[:, 2] - boxes[:, 0] < _NARROW],
        }

    def select(self, keys: Collection[FrameKey], name: str | None = None) -> FoldDetections:
        """Return the same detections in some of the frames."""
        frames = replace(select_frames(self.frames, keys), name=name or self.frames.name)
        return replace(self, frames=frames, predictions=self.predictions.select(frames.keys))


def detect_in_source(
    model: Model, source: FrameDataset, *, min_score: float = -6.0, jobs: int | None = None
) -> list[FoldDetections]:
    """Detect vehicles in all frames of a source, one `FoldDetections` for each of its sets.

    Scores are log-odds above the model's own threshold; a low `min_score` covers all thresholds in use. The
    result does not depend on `jobs`, the number of frames searched at the same time.
    """
    lowest = check.number(min_score, "min_score")
    with model.open_search(1) as search, ThreadPoolExecutor(resolve_jobs(jobs)) as pool:

        def detect(part: LabelledFrames, key: FrameKey) -> Any:
            # Each image is read when it is searched: `map` would read all of an iterator in advance.
            return search.find(part[key], None, min_vehicle_score=lowest).vehicles

        found = [dict(zip(part.keys, pool.map(partial(detect, part), part.keys))) for part in source.sets]
    tables = map(TrackTable.from_detections, found)
    return [FoldDetections(source.name, part, table) for part, table in zip(source.sets, tables)]


def score_fold(
    fold: FoldDetections, threshold: float, log_odds: tuple[float, float] = (1.0, 0.0)
) -> FoldScore:
    """Score a fold's detections at a threshold and over all, with slope and offset of their calibration."""
    slope, offset = log_odds
    labels, kept = fold.labels, fold.above(threshold)
    scores = evaluate_detections(kept, labels)
    region_scores = evaluate_detections(kept, labels, ignored_as_regions=True)
    every = evaluate_detections(fold.predictions, labels)
    every_region = evaluate_detections(fold.predictions, labels, ignored_as_regions=True)
    strict = evaluate_detections(fold.predictions, labels, iou=0.7, ignored_as_regions=True)
    logits, hits = fold.hits
    probabilities = Platt(-slope, -offset).probability(logits)
    # Boxes that are hardly ever vehicles are many, and would hide the errors of the others.
    likely = probabilities >= _MIN_PROBABILITY
    hits, probabilities = hits[likely], probabilities[likely]
    above = fold.logits >= threshold
    found = fold.matches.match[above]
    groups = fold.groups
    recalls: dict[str, Any] = {f"recall_{name}": mean(np.isin(rows, found)) for name, rows in groups.items()}
    at_threshold = {name: getattr(scores, name) for name in ("f1", "precision", "recall", "mean_iou")}
    return FoldScore(
        name=fold.frames.name,
        source=fold.source,
        frames=len(fold.frames),
        vehicles=int((~labels["ignore"]).sum()),
        **at_threshold,
        false_per_frame=scores.false_positives_per_frame,
        **_false_without_vehicles(fold, above),
        **recalls,
        **{name: len(rows) for name, rows in groups.items()},
        threshold=threshold,
        average_precision=every.average_precision,
        best_f1=best_f1(*precision_recall_curve(fold.predictions, labels))[0],
        region_f1=region_scores.f1,
        region_average_precision=every_region.average_precision,
        strict_average_precision=strict.average_precision,
        calibration_error=calibration_error(probabilities, hits) if len(hits) else math.nan,
    )


def _false_without_vehicles(fold: FoldDetections, above: NDArray[np.bool_]) -> dict[str, Any]:
    """Count the false boxes `above` the threshold, per frame without a label and without a scored one."""
    labels, false = fold.labels, above & (fold.matches.match < 0) & ~fold.matches.ignored
    counts = Counter(fold.predictions["frame"][row] for row in np.flatnonzero(false).tolist())
    scored = {labels["frame"][row] for row in fold.matches.usable.tolist()}
    empty = [counts[key] for key in fold.frames.keys if not len(labels.rows(key))]
    vehicle_free = [counts[key] for key in fold.frames.keys if key not in scored]
    return {"false_per_empty_frame": mean(empty), "false_per_vehicle_free_frame": mean(vehicle_free)}


def best_threshold(folds: Sequence[FoldDetections]) -> float:
    """Threshold with the best F-beta over the vehicles of all folds together, each with the same weight."""
    logits, hits = _joined_hits(folds)
    above = logits[:, None] >= _THRESHOLDS
    right, shown = above[hits].sum(axis=0), above.sum(axis=0)
    vehicles = sum(_vehicle_counts(folds).values())
    scores = right / np.maximum(shown + _BETA_SQUARED * vehicles, 1e-9)
    return float(_THRESHOLDS[int(np.argmax(scores))])


def fit_log_odds(folds: Sequence[FoldDetections]) -> tuple[float, float]:
    """Slope and offset that calibrate logits, fitted to the detections of all folds.

    The detections in a source are weighted by the inverse of its number of vehicles, so that all sources
    have a similar influence; one without vehicles counts like the largest.
    """
    logits, hits = _joined_hits(folds)
    if len(set(hits.tolist())) < 2:
        return 1.0, 0.0
    counts = _vehicle_counts(folds)
    weights = [
        np.full(len(fold.hits[0]), 1 / (counts[fold.source] or max(counts.values()))) for fold in folds
    ]
    platt = calibrate_scores(logits, hits, prior=False, weights=np.concatenate(weights))
    # Among few boxes the better ones may be false; a negative slope would reverse their order.
    return (-platt.a, -platt.b) if platt.a < 0 else (1.0, 0.0)


def _joined_hits(folds: Sequence[FoldDetections]) -> tuple[Floats, NDArray[np.bool_]]:
    """`FoldDetections.hits` of all folds."""
    logits, hits = zip(*(fold.hits for fold in folds))
    return np.concatenate(logits), np.concatenate(hits)


def _vehicle_counts(folds: Sequence[FoldDetections]) -> Counter[str]:
    """Scored vehicles of each source."""
    counts: Counter[str] = Counter()
    for fold in folds:
        counts[fold.source] += len(fold.matches.usable)
    return counts


def format_fold(values: Mapping[str, Any], *, missing: str = "") -> list[str]:
    """Format the values of ``FoldScore.to_dict()`` as the cells of `FOLD_COLUMNS`."""
    return [
        f"{values[name]:.{decimals}f}" if name in values else missing
        for name, (_, decimals) in FOLD_COLUMNS.items()
    ]


def write_curves(path: str | os.PathLike[str], folds: Sequence[FoldDetections]) -> None:
    """Write the precision-recall curve of every fold as CSV, one row for each threshold."""
    import pandas as pd

    rows = [
        (spreadsheet_text(fold.frames.name), logit, precision, recall)
        for fold in folds
        for precision, recall, logit in zip(*precision_recall_curve(fold.predictions, fold.labels))
    ]
    table = pd.DataFrame(rows, columns=["frames", "logit", "precision", "recall"])
    with atomic_write(path, "path") as part:
        table.to_csv(part, index=False, float_format="%.4f", na_rep="nan", lineterminator="\n")
