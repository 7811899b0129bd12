"""Which vehicles a model finds on roads that it was not trained on, and how true its probabilities are."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import box_areas, intersection_matrix
from vehicle_detection.evaluation import FrameBoxes, match_detections
from vehicle_detection.training import FoldDetections, FoldScore, fit_log_odds

WIDTHS = (0.0, 32.0, 48.0, 80.0, 160.0, np.inf)
"""Limits of the widths of labelled boxes, in pixels."""

PROBABILITIES = (0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Limits of the stated probabilities of boxes."""

VISIBILITY = ("whole", "behind another vehicle", "cut by the frame")

# Fraction of a box that a nearer box covers, and fraction of a vehicle outside the frame.
_MIN_HIDDEN, _MIN_TRUNCATED = 0.15, 0.01


def recall_by_width(fold: FoldDetections, threshold: float) -> list[tuple[int, int]]:
    """Count the vehicles found, and all, for each range of `WIDTHS`."""
    rows, found = _usable(fold, threshold)
    boxes = fold.labels.boxes[rows]
    return _count(
        np.searchsorted(WIDTHS, boxes[:, 2] - boxes[:, 0], side="right") - 1, found, len(WIDTHS) - 1
    )


def recall_by_visibility(fold: FoldDetections, threshold: float) -> list[tuple[int, int]]:
    """Count the vehicles found, and all, for each kind of `VISIBILITY`."""
    rows, found = _usable(fold, threshold)
    labels = fold.labels
    hidden = _hidden_fractions(labels)[rows] >= _MIN_HIDDEN
    kinds = np.where(labels.truncated[rows] >= _MIN_TRUNCATED, 2, hidden)
    return _count(kinds, found, len(VISIBILITY))


def calibration_rows(folds: Sequence[FoldDetections]) -> list[tuple[int, float, float]]:
    """List the number of boxes, their mean probability and the fraction of right ones by `PROBABILITIES`.

    The log-odds of a fold are fitted to the other sources.
    """
    stated, right = [np.empty(0)], [np.empty(0, np.bool_)]
    for fold in folds:
        slope, offset = fit_log_odds([other for other in folds if other.source != fold.source])
        logits, hits = fold.hits
        stated.append(1 / (1 + np.exp(-(slope * logits + offset).clip(-500, 500))))
        right.append(hits)
    values, hits = np.concatenate(stated), np.concatenate(right)
    rows = []
    for low, high in itertools.pairwise(PROBABILITIES):
        here = (values >= low) & (values <= high if high == 1 else values < high)
        if here.any():
            rows.append((int(here.sum()), float(values[here].mean()), float(hits[here].mean())))
    return rows


def _usable(fold: FoldDetections, threshold: float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Rows of the scored labels, and which of them a prediction above the threshold matches."""
    matches = match_detections(
        fold.above(threshold), fold.labels, fold.frames.keys, 0.5, ignored_as_regions=True
    )
    return matches.usable, np.isin(matches.usable, matches.match)


def _hidden_fractions(labels: FrameBoxes) -> NDArray[np.float64]:
    """Largest fraction of each labelled box that one other vehicle with a lower bottom edge covers."""
    hidden = np.zeros(len(labels))
    # The others are regions.
    vehicles = np.flatnonzero(~labels.ignore | (labels.tracks != -1))
    for key in labels.frame_keys:
        rows = np.intersect1d(labels.rows(key), vehicles)
        boxes = labels.boxes[rows]
        shares = intersection_matrix(boxes, boxes) / box_areas(boxes)[:, None]
        nearer = boxes[None, :, 3] > boxes[:, None, 3]
        hidden[rows] = np.where(nearer, shares, 0).max(axis=1, initial=0)
    return hidden


def _count(groups: NDArray[np.int64], found: NDArray[np.bool_], count: int) -> list[tuple[int, int]]:
    """Count the found ones, and all, of each group."""
    return [(int(found[groups == group].sum()), int((groups == group).sum())) for group in range(count)]


def recall_cells(pairs: Sequence[tuple[int, int]]) -> list[str]:
    """Format ``(found, all)`` as cells of a table: the recall, and the number of vehicles."""
    return [f"{found / count:.2f} of {count}" if count else "-" for found, count in pairs]


def recall_tables(
    folds: Sequence[FoldDetections], scores: Sequence[FoldScore]
) -> tuple[list[list[str]], list[list[str]], list[list[str]]]:
    """Rows of the tables by width, by visibility, and of the stated probabilities."""
    widths, kinds = [], []
    for fold, score in zip(folds, scores, strict=True):
        widths.append([score.name, *recall_cells(recall_by_width(fold, score.threshold))])
        kinds.append([score.name, *recall_cells(recall_by_visibility(fold, score.threshold))])
    stated = [
        [f"{probability:.2f}", f"{right:.2f}", str(count)]
        for count, probability, right in calibration_rows(folds)
    ]
    return widths, kinds, stated
