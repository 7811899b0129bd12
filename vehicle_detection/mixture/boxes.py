"""Windows of several templates to boxes of vehicles: suppression, voting, and a linear correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_integer, finite_array
from vehicle_detection.boxes import box_areas, clip_boxes, greedy_nms, iter_nms, overlap_matrices
from vehicle_detection.mixture.crops import CROP_LENGTH, crop_features

WEAKEST = -1.0
"""Least value of a template that makes a window a candidate."""

# Overlaps: of windows that vote for one box; above which the weaker of two vehicles goes, by IoU and by the
# share of the smaller one that is covered.
_VOTE, _IOU, _COVER = 0.5, 0.35, 0.75
# IoU above which two boxes are the same.
_SAME = 0.7
# What a window's value exceeds this by counts in a vote.
_VOTE_FROM = -1.1
_MOST_VEHICLES = 60
# Least share of a box inside the frame.
_LEAST_INSIDE = 0.35
# A correction moves an edge by this share of the box's side at most; a box is looked at again where it moved
# one by more than the second.
_MOST_SHIFT, _SETTLED = 0.3, 0.15

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ScoredWindows:
    """Windows as columns: boxes, values of their templates, numbers of the templates."""

    boxes: Floats
    scores: Floats
    templates: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: NDArray[Any] | slice) -> ScoredWindows:
        return ScoredWindows(self.boxes[rows], self.scores[rows], self.templates[rows])

    @classmethod
    def empty(cls) -> ScoredWindows:
        """No window."""
        return cls(np.empty((0, 4)), np.empty(0), np.empty(0, np.intp))

    @classmethod
    def join(cls, parts: Sequence[ScoredWindows], shape: tuple[int, ...]) -> ScoredWindows:
        """Put the windows of several searches together; those that are mostly outside the frame go."""
        parts = [part for part in parts if len(part)] or [cls.empty()]
        both = cls(
            np.concatenate([part.boxes for part in parts]),
            np.concatenate([part.scores for part in parts]),
            np.concatenate([part.templates for part in parts]),
        )
        return both[np.flatnonzero(mostly_inside(both.boxes, shape))]

    def best(self, most: int) -> ScoredWindows:
        """Take the best windows, from the best one down; of equals the first."""
        return self[np.argsort(-self.scores, kind="stable")[:most]]


def mostly_inside(boxes: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Tell which boxes show enough of a vehicle inside a frame of ``(height, width, ...)``."""
    inside = box_areas(clip_boxes(boxes, shape))
    return np.asarray(inside > _LEAST_INSIDE * box_areas(boxes), np.bool_)


def overlaps(box: Floats, others: Floats) -> tuple[Floats, Floats]:
    """IoU of a box with others, and the share of the smaller of both that they share."""
    iou, coverage = overlap_matrices(box[None], others)
    return iou[0], coverage[0]


def vote_boxes(
    windows: ScoredWindows, *, least: float, most: int = _MOST_VEHICLES
) -> tuple[ScoredWindows, Floats]:
    """Keep the best window of each group, at the place for which the windows around it vote.

    Parameters
    ----------
    windows
        From the best one down.
    least
        Least value of a window that is kept; weaker ones vote only.

    Returns
    -------
    Candidates
        At most `most` of them; they still overlap as vehicles behind one another do.
    numpy.ndarray
        Support of each: the sum of what the windows that vote for it exceed -1.1 by.
    """
    order = np.flatnonzero(windows.scores >= least)
    boxes: list[Floats] = []
    kept: list[int] = []
    vote_mass: list[float] = []
    strengths = np.maximum(windows.scores - _VOTE_FROM, 0)
    weights = strengths**2
    for best, iou in islice(iter_nms(windows.boxes, order, max_iou=_VOTE), most):
        voters = iou > _VOTE
        vote_mass.append(float(strengths @ voters))
        votes = weights * voters
        votes[best] = max(votes[best], 1e-9)
        boxes.append(votes @ windows.boxes / votes.sum())
        kept.append(best)
    rows = np.array(kept, np.intp)
    groups = ScoredWindows(np.array(boxes).reshape(-1, 4), windows.scores[rows], windows.templates[rows])
    return groups, np.array(vote_mass)


def nms(boxes: Floats, scores: Floats, *, iou: float = _IOU, cover: float = _COVER) -> NDArray[np.intp]:
    """Rows of the boxes that stay when the weaker of two on one vehicle goes, from the best one down.

    Two boxes are on one vehicle whose IoU is above `iou`, or of which the smaller one is covered by more than
    `cover`.
    """
    return greedy_nms(boxes, scores, max_iou=iou, max_coverage=cover)


@dataclass(frozen=True, eq=False)
class BoxRegressor:
    """A linear correction of boxes from what they show.

    Attributes
    ----------
    weights
        ``(length, 4)`` float32: shifts of the four edges, in sides of the box, for each feature of
        `crop_features`.
    bias
        ``(4,)`` float32.
    n_iterations
        How often a box is corrected; from the second time on only those that the last correction moved much.
        A box that is far too small or beside its vehicle shows too little of it at first.
    """

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    n_iterations: int = 1

    def __post_init__(self) -> None:
        check_integer(self.n_iterations, "n_iterations", low=1, high=10)
        weights = finite_array(self.weights, "box_regressor.weights", (CROP_LENGTH, 4))
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "bias", finite_array(self.bias, "box_regressor.bias", (4,)))

    @classmethod
    def none(cls) -> BoxRegressor:
        """Correct nothing."""
        return cls(np.zeros((CROP_LENGTH, 4), np.float32), np.zeros(4, np.float32))

    def shifts(self, image: NDArray[np.uint8], boxes: Floats) -> Floats:
        """Shifts of the edges of each box, in sides of the box, ``(N, 4)``."""
        if not len(boxes):
            return np.empty((0, 4))
        shifts = crop_features(image, boxes) @ self.weights + self.bias
        return np.clip(shifts.astype(np.float64), -_MOST_SHIFT, _MOST_SHIFT)

    def apply(self, image: NDArray[np.uint8], windows: ScoredWindows) -> tuple[Floats, Floats]:
        """Correct boxes, clip them to the image and drop those that nearly coincide with a better one."""
        boxes, values = windows.boxes.copy(), windows.scores
        moving = np.ones(len(boxes), np.bool_)
        for _ in range(self.n_iterations):
            # No box turns inside out: of a side, at least two fifths are left.
            sides = np.tile(boxes[moving, 2:] - boxes[moving, :2], 2)
            shifts = self.shifts(image, boxes[moving])
            boxes[moving] += shifts * sides
            moving[moving] = np.abs(shifts).max(axis=1, initial=0) > _SETTLED
            inside = clip_boxes(boxes, image.shape)
            rows = nms(inside, values, iou=_SAME, cover=np.inf)
            rows = rows[box_areas(inside[rows]) > 0]
            boxes, values, moving = boxes[rows], values[rows], moving[rows]
        return np.asarray(clip_boxes(boxes, image.shape), np.float64), values
