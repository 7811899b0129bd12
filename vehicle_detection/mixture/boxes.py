"""Windows of several templates to boxes: voting and non-maximum suppression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection._kernels import group
from vehicle_detection.boxes import box_areas, clip_boxes, on_one_vehicle

MIN_MARGIN = -1.0
"""Minimum margin of a window that takes part in the voting."""

# A window votes for a box at an IoU above the first; of two boxes on one vehicle, the weaker one is removed
# at an IoU above the second or if more than the third of the smaller one is covered.
_VOTE_IOU, _NMS_IOU, _NMS_COVER = 0.5, 0.35, 0.75
# IoU above which two proposed boxes are duplicates.
DUPLICATE_IOU = 0.7
# A window's vote is its margin above this one.
_VOTE_MARGIN = -1.1
MAX_PROPOSALS = 120
"""Greatest number of boxes that are proposed in a frame."""

# Minimum difference of the margins of two boxes on one vehicle of which the lower one shows a part of it.
_PART_GAP = 1.0
_MIN_VISIBLE_FRACTION = 0.35


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

    def best(self, count: int) -> ScoredWindows:
        """Keep the `count` best windows, best first; equal margins keep their order."""
        return self[np.argsort(-self.margins, kind="stable")[:count]]


def mostly_inside(boxes: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Select the boxes whose visible fraction inside a frame of ``(height, width, ...)`` is large enough."""
    inside = box_areas(clip_boxes(boxes, shape))
    return np.asarray(inside > _MIN_VISIBLE_FRACTION * box_areas(boxes), np.bool_)


def vote_boxes(
    windows: ScoredWindows, *, min_margin: float, max_boxes: int = MAX_PROPOSALS
) -> tuple[ScoredWindows, Floats]:
    """Keep the best window of each group, with the weighted mean box of the windows that overlap it.

    `windows` are sorted, best first; those below `min_margin` vote but are not kept. Also returns the vote
    mass of each kept window: the sum of the voters' margins above `_VOTE_MARGIN`.
    """
    strengths = np.maximum(windows.margins - _VOTE_MARGIN, 0)
    order = np.flatnonzero(windows.margins >= min_margin)
    boxes, vote_mass = np.empty((max_boxes, 4)), np.empty(max_boxes)
    sides = np.ascontiguousarray(windows.boxes.T)
    kept = group(sides, order, _VOTE_IOU, np.inf, max_boxes, strengths, boxes, vote_mass)
    grouped = ScoredWindows(boxes[: len(kept)], windows.margins[kept], windows.templates[kept])
    return grouped, vote_mass[: len(kept)]


def nms(
    boxes: Floats,
    scores: Floats,
    *,
    iou: float = _NMS_IOU,
    cover: float = _NMS_COVER,
) -> NDArray[np.intp]:
    """Rows of the boxes that greedy suppression keeps, best first.

    A box is removed by a better one at an IoU above `iou`, or if more than `cover` of the smaller one is
    covered.
    """
    order = np.argsort(-scores, kind="stable")
    sides = np.ascontiguousarray(boxes.T)
    return np.asarray(group(sides, order, iou, cover, len(boxes), scores, np.empty((0, 4)), np.empty(0)))


def whole_vehicles(boxes: Floats, margins: Floats) -> NDArray[np.intp]:
    """Rows of the boxes that are not on a part of the vehicle of a much better box.

    Two vehicles at one distance from the camera do not overlap in the image. The side of a near vehicle in
    the next lane, however, looks like a vehicle of the same height.

    >>> whole_vehicles(np.array([[50.0, 395, 226, 494], [180, 399, 260, 487]]), np.array([1.2, -0.1]))
    array([0])
    """
    better = margins[:, None] > margins + _PART_GAP
    return np.flatnonzero(~(on_one_vehicle(boxes) & better).any(axis=0))
