"""Cross-validation of a mixture by leaving out one source at a time, and its calibration from the folds."""

from __future__ import annotations

import csv
import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import Floats, atomic_write, check_integer, resolve_jobs
from vehicle_detection.boxes import Platt
from vehicle_detection.evaluation import (
    DetectionMatches,
    FrameBoxes,
    LabelledFrames,
    best_f1,
    calibrate_scores,
    calibration_error,
    evaluate_detections,
    match_detections,
    precision_recall_curve,
)
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.mixture_training.sources import FrameDataset, check_sources
from vehicle_detection.mixture_training.train import train_mixture
from vehicle_detection.params import MixtureParams

log = logging.getLogger(__name__)

_MIN_MARGIN = -2.0  # of an evaluated box
_THRESHOLDS = np.arange(-2.0, 1.5, 0.02)  # to choose from
_MIN_PROBABILITY = 0.1  # of a box that counts in the calibration error
# In F-beta, a false box counts 1 / 0.7 = 1.4 times as much as a missed vehicle.
_BETA_SQUARED = 0.7

FOLD_COLUMNS = {
    "f1": ("F1", 3), "best_f1": ("best F1", 3), "average_precision": ("AP", 3), "precision": ("precision", 3),
    "recall": ("recall", 3), "mean_iou": ("mean IoU", 3), "false_per_frame": ("false", 2),
    "false_per_empty_frame": ("on empty", 2), "region_f1": ("region F1", 3),
    "region_average_precision": ("region AP", 3), "strict_average_precision": ("AP 0.7", 3),
    "calibration_error": ("ECE", 3),
}  # fmt: skip
"""Columns of a table of `FoldScore`: titles and decimals."""


@dataclass(frozen=True, kw_only=True)
class FoldScore:
    """Scores on a set of frames whose source was left out of training.

    The region scores are those with ``ignored_as_regions=True``, see `evaluate_detections`: for labels with
    one ignored box around a group of vehicles, in which the other scores count detections as false.
    """

    name: str
    source: str
    frames: int
    vehicles: int  # scored labels
    f1: float  # this and the next three at the threshold that is best for the other sources
    precision: float
    recall: float
    mean_iou: float
    false_per_frame: float
    false_per_empty_frame: float  # per frame without any label; NaN if there is none
    threshold: float  # an SVM margin
    average_precision: float
    best_f1: float  # at the best threshold of this set
    region_f1: float
    region_average_precision: float
    strict_average_precision: float  # region average precision at IoU 0.7
    calibration_error: float  # of probabilities from 0.1 on, fitted to the other sources

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
    predictions: FrameBoxes  # scores are SVM margins

    @property
    def labels(self) -> FrameBoxes:
        """Labels that list all frames, also those without a box."""
        return replace(self.frames.labels, frame_keys=tuple(self.frames.keys))

    @property
    def margins(self) -> Floats:
        """SVM margin of each prediction."""
        assert self.predictions.scores is not None
        return self.predictions.scores

    @cached_property
    def matches(self) -> DetectionMatches:
        """Predictions matched to labels at IoU 0.5; ignored boxes are regions."""
        return match_detections(self.predictions, self.labels, self.frames.keys, 0.5, ignored_as_regions=True)

    @property
    def hits(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Margins of the predictions that are not ignored, and which of them match a vehicle."""
        scored = ~self.matches.ignored
        return self.margins[scored], self.matches.match[scored] >= 0

    def above(self, threshold: float) -> FrameBoxes:
        """Predictions with a margin of at least `threshold`."""
        return self.predictions[self.margins >= threshold]


def cross_validate_mixture(
    sources: Sequence[FrameDataset],
    params: MixtureParams | None = None,
    *,
    extra_sources: Sequence[FrameDataset] = (),
    patches: Sequence[NDArray[np.uint8]] = (),
    random_state: int = 0,
    n_jobs: int | None = None,
    on_step: Callable[[str], object] | None = None,
) -> tuple[TemplateMixture, list[FoldScore], list[FoldDetections]]:
    """Train a mixture on all sources, calibrated and evaluated by leaving out one source at a time.

    The threshold of the model has the best F-beta over all left-out sources together, so every vehicle has
    the same weight; a false box counts 1.4 times as much as a missed one, and ignored boxes are regions. The
    log-odds are fitted to the same detections (Platt, "Probabilistic outputs for support vector machines",
    1999).

    Parameters
    ----------
    sources, extra_sources
        Labelled frames of at least two sources; and sources that every model is trained on and none is
        evaluated on.
    params, patches, random_state, n_jobs, on_step
        As in `train_mixture`.

    Returns
    -------
    tuple
        The model trained on everything; a `FoldScore` for each set of frames, at the threshold that is best
        for the other sources; and the detections in each set.

    Raises
    ------
    InvalidInputError
        If there are fewer than two sources, or `train_mixture` finds too few vehicles without one of them.
    """
    sources = check_sources(sources, min_count=2)
    extra = check_sources((*sources, *check_sources(extra_sources, min_count=0)))[len(sources) :]
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    options: dict[str, Any] = {"patches": patches, "random_state": random_state, "n_jobs": n_jobs}
    folds: list[FoldDetections] = []
    report, total = on_step or log.info, len(sources) + 1
    for step, left_out in enumerate(sources, 1):
        report(f"step {step} of {total}: train without {left_out.name}")
        rest = [source for source in sources if source is not left_out]
        mixture = train_mixture([*rest, *extra], params, on_step=report, **options)
        report(f"step {step} of {total}: evaluate on {left_out.name}")
        folds += detect_in_source(mixture, left_out, n_jobs=n_jobs)
    scores = []
    for fold in folds:
        others = [other for other in folds if other.source != fold.source]
        scores.append(score_fold(fold, best_threshold(others), fit_log_odds(others)))
    report(f"step {total} of {total}: train on all sources")
    mixture = train_mixture([*sources, *extra], params, on_step=report, **options)
    slope, offset = fit_log_odds(folds)
    threshold = slope * best_threshold(folds) + offset
    return replace(mixture, slope=slope, offset=offset, threshold=threshold), scores, folds


def detect_in_source(
    mixture: TemplateMixture, source: FrameDataset, *, n_jobs: int | None = None
) -> list[FoldDetections]:
    """Detect vehicles in all frames of a source, including weak ones; scores are margins."""
    with mixture.open_search(n_jobs=1) as search, ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool:

        def detect(pair: tuple[Any, NDArray[np.uint8]]) -> tuple[Any, Any]:
            # An uncalibrated mixture has slope 1 and offset 0, so its scores are margins.
            return pair[0], search.find(pair[1], min_vehicle_score=_MIN_MARGIN).vehicles

        found = [FrameBoxes.from_detections(dict(pool.map(detect, part))) for part in source.sets]
    return [FoldDetections(source.name, part, boxes) for part, boxes in zip(source.sets, found)]


def score_fold(
    fold: FoldDetections, threshold: float, log_odds: tuple[float, float] = (1.0, 0.0)
) -> FoldScore:
    """Score a fold's detections at a threshold and over all, with slope and offset of their log-odds."""
    slope, offset = log_odds
    labels, kept = fold.labels, fold.above(threshold)
    scores = evaluate_detections(kept, labels)
    region_scores = evaluate_detections(kept, labels, ignored_as_regions=True)
    every = evaluate_detections(fold.predictions, labels)
    every_region = evaluate_detections(fold.predictions, labels, ignored_as_regions=True)
    strict = evaluate_detections(fold.predictions, labels, iou=0.7, ignored_as_regions=True)
    margins, hits = fold.hits
    probabilities = Platt(-slope, -offset).probability(margins)
    # Boxes that are hardly ever vehicles are many, and would hide the errors of the others.
    likely = probabilities >= _MIN_PROBABILITY
    hits, probabilities = hits[likely], probabilities[likely]
    empty = [key for key in fold.frames.keys if not len(labels.rows(key))]
    false_on_empty = sum(len(kept.rows(key)) for key in empty)
    at_threshold = {name: getattr(scores, name) for name in ("f1", "precision", "recall", "mean_iou")}
    return FoldScore(
        name=fold.frames.name,
        source=fold.source,
        frames=len(fold.frames),
        vehicles=int((~labels.ignore).sum()),
        **at_threshold,
        false_per_frame=scores.false_positives_per_frame,
        false_per_empty_frame=false_on_empty / len(empty) if empty else math.nan,
        threshold=threshold,
        average_precision=every.average_precision,
        best_f1=best_f1(*precision_recall_curve(fold.predictions, labels))[0],
        region_f1=region_scores.f1,
        region_average_precision=every_region.average_precision,
        strict_average_precision=strict.average_precision,
        calibration_error=calibration_error(probabilities, hits) if len(hits) else math.nan,
    )


def best_threshold(folds: Sequence[FoldDetections]) -> float:
    """Threshold with the best F-beta over the vehicles of all folds together, each with the same weight."""
    margins, hits = _joined_hits(folds)
    above = margins[:, None] >= _THRESHOLDS
    right, shown = above[hits].sum(axis=0), above.sum(axis=0)
    vehicles = sum(_vehicle_counts(folds).values())
    scores = right / np.maximum(shown + _BETA_SQUARED * vehicles, 1e-9)
    return float(_THRESHOLDS[int(np.argmax(scores))])


def fit_log_odds(folds: Sequence[FoldDetections]) -> tuple[float, float]:
    """Slope and offset that turn margins into log-odds, fitted to the detections of all folds.

    The detections in a source are weighted by the inverse of its number of vehicles, so that all sources
    have a similar influence; one without vehicles counts like the largest.
    """
    margins, hits = _joined_hits(folds)
    if len(set(hits.tolist())) < 2:
        return 1.0, 0.0
    counts = _vehicle_counts(folds)
    weights = [
        np.full(len(fold.hits[0]), 1 / (counts[fold.source] or max(counts.values()))) for fold in folds
    ]
    platt = calibrate_scores(margins, hits, prior=False, weights=np.concatenate(weights))
    # Among few boxes the better ones may be false; a negative slope would reverse their order.
    return (-platt.a, -platt.b) if platt.a < 0 else (1.0, 0.0)


def _joined_hits(folds: Sequence[FoldDetections]) -> tuple[Floats, NDArray[np.bool_]]:
    """`FoldDetections.hits` of all folds."""
    margins, hits = zip(*(fold.hits for fold in folds))
    return np.concatenate(margins), np.concatenate(hits)


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


def training_metadata(
    scores: Sequence[FoldScore], sources: Sequence[FrameDataset], seed: int, patches: int = 0
) -> dict[str, Any]:
    """Metadata of a cross-validated model for its file."""
    data = {source.name: sum(len(part) for part in source.sets) for source in sources}
    return {
        "metrics": {"left_out": {score.name: score.to_dict() for score in scores}},
        "data": data | ({"patches": patches} if patches else {}),
        "training": {"random_state": seed},
        "versions": {"vehicle_detection": vehicle_detection.__version__},
    }


def write_curves(path: str | os.PathLike[str], folds: Sequence[FoldDetections]) -> None:
    """Write the precision-recall curve of every fold as CSV, one row for each threshold."""
    with atomic_write(path, "path") as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frames", "margin", "precision", "recall"])
        for fold in folds:
            for precision, recall, margin in zip(*precision_recall_curve(fold.predictions, fold.labels)):
                writer.writerow([fold.frames.name, f"{margin:.4f}", f"{precision:.4f}", f"{recall:.4f}"])
