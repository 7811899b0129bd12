"""Windows of several templates to boxes: voting, non-maximum suppression and box regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_integer, finite_array
from vehicle_detection.boxes import box_areas, clip_boxes, greedy_nms, iter_nms
from vehicle_detection.mixture.crops import N_REGRESSION_FEATURES, regression_features

MIN_MARGIN = -1.0
"""Minimum margin of a window that takes part in the voting."""

# A window votes for a box at an IoU above the first; of two boxes on one vehicle, the weaker one is removed
# at an IoU above the second or if more than the third of the smaller one is covered.
_VOTE_IOU, _NMS_IOU, _NMS_COVER = 0.5, 0.35, 0.75
# IoU above which two regressed boxes are duplicates.
_DUPLICATE_IOU = 0.7
# A window's vote is its margin above this one.
_VOTE_MARGIN = -1.1
_MAX_VEHICLES = 60
_MIN_VISIBLE_FRACTION = 0.35
# Largest shift of an edge per regression step, as a fraction of the box's side; a box is regressed again if
# one of its edges moved by more than the second.
_MAX_SHIFT, _SETTLED_SHIFT = 0.3, 0.15

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ScoredWindows:
    """Windows as columns: boxes ``(N, 4)``, SVM margins ``(N,)`` and template indices ``(N,)``."""

    boxes: Floats
    margins: Floats
    templates: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: NDArray[Any] | slice) -> ScoredWindows:
        return ScoredWindows(self.boxes[rows], self.margins[rows], self.templates[rows])

    @classmethod
    def empty(cls) -> ScoredWindows:
        """No windows."""
        return cls(np.empty((0, 4)), np.empty(0), np.empty(0, np.intp))

    @classmethod
    def join(cls, parts: Sequence[ScoredWindows], shape: tuple[int, ...]) -> ScoredWindows:
        """Concatenate the windows of several searches, without those mostly outside the frame."""
        parts = [part for part in parts if len(part)] or [cls.empty()]
        joined = cls(
            np.concatenate([part.boxes for part in parts]),
            np.concatenate([part.margins for part in parts]),
            np.concatenate([part.templates for part in parts]),
        )
        return joined[np.flatnonzero(mostly_inside(joined.boxes, shape))]

    def best(self, count: int) -> ScoredWindows:
        """Keep the `count` best windows, best first; equal margins keep their order."""
        return self[np.argsort(-self.margins, kind="stable")[:count]]


def mostly_inside(boxes: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Select the boxes whose visible fraction inside a frame of ``(height, width, ...)`` is large enough."""
    inside = box_areas(clip_boxes(boxes, shape))
    return np.asarray(inside > _MIN_VISIBLE_FRACTION * box_areas(boxes), np.bool_)


def vote_boxes(
    windows: ScoredWindows, *, min_margin: float, max_boxes: int = _MAX_VEHICLES
) -> tuple[ScoredWindows, Floats]:
    """Keep the best window of each group, with the weighted mean box of the windows that overlap it.

    `windows` are sorted, best first; those below `min_margin` vote but are not kept. Also returns the vote
    mass of each kept window: the sum of the voters' margins above `_VOTE_MARGIN`.
    """
    order = np.flatnonzero(windows.margins >= min_margin)
    boxes: list[Floats] = []
    kept: list[int] = []
    vote_mass: list[float] = []
    strengths = np.maximum(windows.margins - _VOTE_MARGIN, 0)
    weights = strengths**2
    for best, iou in islice(iter_nms(windows.boxes, order, max_iou=_VOTE_IOU), max_boxes):
        voters = iou > _VOTE_IOU
        vote_mass.append(float(strengths @ voters))
        votes = weights * voters
        votes[best] = max(votes[best], 1e-9)
        boxes.append(votes @ windows.boxes / votes.sum())
        kept.append(best)
    rows = np.array(kept, np.intp)
    groups = ScoredWindows(np.array(boxes).reshape(-1, 4), windows.margins[rows], windows.templates[rows])
    return groups, np.array(vote_mass)


def nms(
    boxes: Floats,
    scores: Floats,
    *,
    iou: float = _NMS_IOU,
    cover: float = _NMS_COVER,
    max_boxes: int | None = None,
) -> NDArray[np.intp]:
    """Rows of the boxes that greedy suppression keeps, best first, at most `max_boxes`.

    A box is removed by a better one at an IoU above `iou`, or if more than `cover` of the smaller one is
    covered.
    """
    return greedy_nms(boxes, scores, max_iou=iou, max_coverage=cover, max_boxes=max_boxes)


@dataclass(frozen=True, eq=False)
class BoxRegressor:
    """A linear regression of the shifts of a box's edges from the features of its crop.

    `weights` ``(length, 4)`` and `bias` ``(4,)`` float32 give shifts as fractions of the box's sides, from
    `regression_features`. The regression runs `n_iterations` times; from the second time on only for boxes
    whose last shift was large, because the crop of a misplaced box shows too little of its vehicle.
    """

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    n_iterations: int = 1

    def __post_init__(self) -> None:
        check_integer(self.n_iterations, "n_iterations", low=1, high=10)
        weights = finite_array(self.weights, "box_regressor.weights", (N_REGRESSION_FEATURES, 4))
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "bias", finite_array(self.bias, "box_regressor.bias", (4,)))

    @classmethod
    def none(cls) -> BoxRegressor:
        """Return a regressor that shifts nothing."""
        return cls(np.zeros((N_REGRESSION_FEATURES, 4), np.float32), np.zeros(4, np.float32))

    def shifts(self, image: NDArray[np.uint8], boxes: Floats) -> Floats:
        """Shifts of the edges of each box, ``(N, 4)``, as fractions of the box's sides."""
        if not len(boxes):
            return np.empty((0, 4))
        shifts = regression_features(image, boxes) @ self.weights + self.bias
        return np.clip(shifts.astype(np.float64), -_MAX_SHIFT, _MAX_SHIFT)

    def apply(self, image: NDArray[np.uint8], windows: ScoredWindows) -> tuple[Floats, Floats]:
        """Correct boxes, clip them to the image, and remove near duplicates of better ones."""
        boxes, margins = windows.boxes.copy(), windows.margins
        moving = np.ones(len(boxes), np.bool_)
        for _ in range(self.n_iterations):
            # Shifts of at most 0.3 from both sides leave at least two fifths of a side.
            sides = np.tile(boxes[moving, 2:] - boxes[moving, :2], 2)
            shifts = self.shifts(image, boxes[moving])
            boxes[moving] += shifts * sides
            moving[moving] = np.abs(shifts).max(axis=1, initial=0) > _SETTLED_SHIFT
            inside = clip_boxes(boxes, image.shape)
            rows = nms(inside, margins, iou=_DUPLICATE_IOU, cover=np.inf)
            rows = rows[box_areas(inside[rows]) > 0]
            boxes, margins, moving = boxes[rows], margins[rows], moving[rows]
        return np.asarray(clip_boxes(boxes, image.shape), np.float64), margins
