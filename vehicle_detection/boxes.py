"""Box arithmetic: overlap, clipping, non-maximum suppression, and boxes with their scores as columns.

Boxes are ``(N, 4)`` arrays ``[x1, y1, x2, y2]`` in half-open pixels: the width is ``x2 - x1``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_number, describe
from vehicle_detection.errors import InvalidInputError

Floats = NDArray[np.float64]

# Lower bound of a divisor. An empty box shares no area with any other, so its ratios become 0.
_TINY = np.finfo(np.float64).tiny


def box_areas(boxes: NDArray[Any]) -> Floats:
    """Area of each ``[x1, y1, x2, y2]`` box in pixels; ``(N,)`` float64."""
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]), np.float64)


def intersection_matrix(first: NDArray[Any], second: NDArray[Any]) -> Floats:
    """Area that each box of `first` shares with each box of `second`; ``(N, M)`` float64."""
    left = np.maximum(first[:, None, :2], second[None, :, :2])
    right = np.minimum(first[:, None, 2:], second[None, :, 2:])
    return np.asarray(np.clip(right - left, 0, None).prod(axis=2), np.float64)


def _iou(shared: Floats, areas: Floats, others: Floats) -> Floats:
    return np.asarray(shared / np.maximum(areas + others - shared, _TINY))


def _coverage(shared: Floats, areas: Floats, others: Floats) -> Floats:
    return np.asarray(shared / np.maximum(np.minimum(areas, others), _TINY))


def overlap_matrices(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """IoU of ``(N, 4)`` with ``(M, 4)`` boxes, and shared fraction of the smaller box; each ``(N, M)``."""
    shared = intersection_matrix(first, second)
    areas, others = box_areas(first)[:, None], box_areas(second)[None]
    return _iou(shared, areas, others), _coverage(shared, areas, others)


def iou_matrix(first: ArrayLike, second: ArrayLike) -> Floats:
    """Intersection over union of each box of `first` with each box of `second`.

    Parameters
    ----------
    first, second
        ``(N, 4)`` and ``(M, 4)`` boxes ``[x1, y1, x2, y2]``.

    Returns
    -------
    numpy.ndarray
        ``(N, M)`` float64 in [0, 1]. The IoU of a box without area is 0, even with itself.

    Raises
    ------
    InvalidInputError
        If an argument is not an array of finite boxes with ``x1 <= x2`` and ``y1 <= y2``.

    Examples
    --------
    >>> iou_matrix([[0, 0, 10, 10]], [[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]]).round(2)
    array([[1.  , 0.33, 0.  ]])
    """
    a = check_boxes(first, "first").astype(np.float64)
    b = check_boxes(second, "second").astype(np.float64)
    return overlap_matrices(a, b)[0]


def clip_boxes(boxes: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Clip boxes to an image of `shape`; a box outside the image collapses onto its border.

    Parameters
    ----------
    boxes, shape
        ``(N, 4)`` boxes, and ``(height, width, ...)`` of the image.

    Returns
    -------
    numpy.ndarray
        A new ``(N, 4)`` array of the same dtype.

    Raises
    ------
    InvalidInputError
        If the boxes are malformed or `shape` is not the shape of an image.

    Examples
    --------
    >>> clip_boxes([[-5, 10, 30, 60]], (50, 20, 3))
    array([[ 0, 10, 20, 50]])
    """
    array = check_boxes(boxes)
    if len(shape) < 2 or shape[0] < 1 or shape[1] < 1:
        raise InvalidInputError(f"shape must be (height, width, ...) of an image, got {describe(shape)}")
    height, width = shape[:2]
    limits = np.array([width, height, width, height])
    return np.asarray(np.clip(array, 0, limits), array.dtype)


def iter_nms(
    boxes: Floats, order: NDArray[np.intp], *, max_iou: float, max_coverage: float = np.inf
) -> Iterator[tuple[int, Floats]]:
    """Yield the rows that greedy non-maximum suppression keeps, each with its IoU with all ``(N, 4)`` boxes.

    `order` lists the candidate rows from the best one down. A candidate is dropped if its IoU with a kept
    box exceeds `max_iou`, or if they share more than the fraction `max_coverage` of the smaller one.
    """
    # The areas and one row per coordinate are computed once, because this runs in every frame.
    columns, areas = np.ascontiguousarray(boxes.T), box_areas(boxes)
    while len(order):
        best, order = order[0], order[1:]
        low = np.maximum(columns[:2], columns[:2, best, None])
        width, height = np.maximum(np.minimum(columns[2:], columns[2:, best, None]) - low, 0)
        shared = width * height
        iou = _iou(shared, areas, areas[best])
        kept = iou[order] <= max_iou
        if max_coverage < 1:
            kept &= _coverage(shared[order], areas[order], areas[best]) <= max_coverage
        order = order[kept]
        yield int(best), iou


def greedy_nms(
    boxes: Floats,
    scores: Floats,
    *,
    max_iou: float,
    max_coverage: float = np.inf,
    max_boxes: int | None = None,
) -> NDArray[np.intp]:
    """Rows that `iter_nms` keeps, best score first, at most `max_boxes`; equal scores keep their order."""
    order = np.argsort(-scores, kind="stable")
    kept = iter_nms(boxes, order, max_iou=max_iou, max_coverage=max_coverage)
    return np.array([row for row, _ in islice(kept, max_boxes)], np.intp)


def non_max_suppression(boxes: ArrayLike, scores: ArrayLike, *, threshold: float = 0.5) -> NDArray[np.intp]:
    """Keep the best box of each group of overlapping boxes, greedily by score.

    Parameters
    ----------
    boxes, scores
        ``(N, 4)`` boxes, and ``(N,)`` numbers, higher is better.
    threshold
        IoU in [0, 1] above which the box with the lower score is dropped.

    Returns
    -------
    numpy.ndarray
        Indices of the kept boxes, best score first; equal scores keep their order.

    Raises
    ------
    InvalidInputError
        If boxes and scores differ in number or contain NaN.

    Examples
    --------
    >>> non_max_suppression([[0, 0, 10, 10], [1, 0, 11, 10], [50, 0, 60, 10]], [0.5, 0.9, 0.1])
    array([1, 2])
    """
    detections = Detections(check_boxes(boxes), np.asarray(scores))
    max_iou = check_number(threshold, "threshold", low=0, high=1)
    return greedy_nms(detections.boxes.astype(np.float64), detections.scores, max_iou=max_iou)


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes and their scores as two columns, checked on construction.

    Attributes
    ----------
    boxes, scores
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, and ``(N,)`` finite float64 scores.

    Raises
    ------
    InvalidInputError
        If the columns differ in length or contain NaN.

    Examples
    --------
    >>> found = Detections([[0, 0, 10, 10], [5, 5, 9, 9]], [0.5, 2.0])
    >>> found
    Detections(2 boxes, scores 0.50 to 2.00)
    >>> found[found.scores > 1].boxes
    array([[5, 5, 9, 9]])
    """

    boxes: NDArray[Any]
    scores: Floats

    def __post_init__(self) -> None:
        boxes = check_boxes(self.boxes)
        scores = np.asarray(self.scores)
        if scores.size == 0:
            scores = scores.reshape(-1).astype(np.float64)
        if scores.shape != (len(boxes),) or scores.dtype.kind not in "iuf":
            raise InvalidInputError(
                f"scores must be one number for each of the {len(boxes)} boxes, got {describe(scores)}"
            )
        if not np.isfinite(scores).all():
            raise InvalidInputError("scores must be finite, got NaN or infinity; drop those rows")
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "scores", scores.astype(np.float64, copy=False))

    @classmethod
    def empty(cls) -> Detections:
        """Return detections without any box."""
        return cls(np.empty((0, 4)), np.empty(0))

    def __repr__(self) -> str:
        if not len(self):
            return "Detections(0 boxes)"
        noun = "box" if len(self) == 1 else "boxes"
        return f"Detections({len(self)} {noun}, scores {self.scores.min():.2f} to {self.scores.max():.2f})"

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: int | slice | NDArray[Any] | list[int]) -> Detections:
        """Take one row by its index, or several by a slice, a mask or a list of indices."""
        taken = [rows] if isinstance(rows, (int, np.integer)) else rows
        return Detections(self.boxes[taken], self.scores[taken])

    def __iter__(self) -> Iterator[tuple[NDArray[Any], float]]:
        """Yield ``(box, score)`` pairs."""
        return zip(self.boxes, self.scores.tolist())
