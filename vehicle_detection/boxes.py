"""Box maths: overlap, clipping, suppression, and boxes with their scores as columns.

Boxes are ``(N, 4)`` arrays ``[x1, y1, x2, y2]`` in half-open pixels: the width is ``x2 - x1``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_number, describe
from vehicle_detection.errors import InvalidInputError


def box_areas(boxes: NDArray[Any]) -> NDArray[np.float64]:
    """Area of each ``[x1, y1, x2, y2]`` box, in pixels; ``(N,)`` float64."""
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]), np.float64)


def intersection_matrix(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Area that each box of `first` shares with each of `second`; ``(N, M)`` float64."""
    left = np.maximum(first[:, None, :2], second[None, :, :2])
    right = np.minimum(first[:, None, 2:], second[None, :, 2:])
    return np.asarray(np.clip(right - left, 0, None).prod(axis=2), np.float64)


def iou_matrix(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Intersection over union of each box of `first` with each box of `second`.

    Parameters
    ----------
    first, second
        ``(N, 4)`` and ``(M, 4)`` boxes ``[x1, y1, x2, y2]``.

    Returns
    -------
    numpy.ndarray
        ``(N, M)`` float64 in [0, 1]. A box without area overlaps nothing, not even itself.

    Raises
    ------
    InvalidInputError
        If an argument is not an array of finite boxes with ``x1 <= x2`` and ``y1 <= y2``.

    Examples
    --------
    >>> iou_matrix([[0, 0, 10, 10]], [[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]]).round(2)
    array([[1.  , 0.33, 0.  ]])
    """
    a, b = (
        check_boxes(boxes, name).astype(np.float64) for boxes, name in ((first, "first"), (second, "second"))
    )
    shared = intersection_matrix(a, b)
    union = box_areas(a)[:, None] + box_areas(b)[None, :] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def clip_boxes(boxes: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Clip boxes to an image of `shape`; a box outside becomes one without area at the border.

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes.
    shape
        ``(height, width, ...)``, as ``image.shape``.

    Returns
    -------
    numpy.ndarray
        A new ``(N, 4)`` array of the same dtype.

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


def non_max_suppression(boxes: ArrayLike, scores: ArrayLike, *, threshold: float = 0.5) -> NDArray[np.intp]:
    """Keep the best box of each group that overlaps, greedily by score.

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes.
    scores
        ``(N,)`` numbers, higher is better.
    threshold
        Overlap (IoU) in [0, 1] above which the lower-scored box is dropped.

    Returns
    -------
    numpy.ndarray
        Indices of the kept boxes, best score first; equal scores keep the order they came in.

    Raises
    ------
    InvalidInputError
        If boxes and scores differ in number, or hold NaN.

    Examples
    --------
    >>> non_max_suppression([[0, 0, 10, 10], [1, 0, 11, 10], [50, 0, 60, 10]], [0.5, 0.9, 0.1])
    array([1, 2])
    """
    detections = Detections(check_boxes(boxes), np.asarray(scores))
    limit = check_number(threshold, "threshold", low=0, high=1)
    order = np.argsort(-detections.scores, kind="stable")
    kept: list[int] = []
    while order.size:
        best, rest = order[0], order[1:]
        kept.append(int(best))
        overlap = iou_matrix(detections.boxes[[best]], detections.boxes[rest])[0]
        order = rest[overlap <= limit]
    return np.array(kept, np.intp)


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes and their scores as two columns, checked on construction.

    Attributes
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``.
    scores
        ``(N,)`` float64 scores, finite.

    Examples
    --------
    >>> found = Detections([[0, 0, 10, 10], [5, 5, 9, 9]], [0.5, 2.0])
    >>> len(found), found[found.scores > 1].boxes
    (2, array([[5, 5, 9, 9]]))

    Raises
    ------
    InvalidInputError
        If the columns differ in length or hold NaN.
    """

    boxes: NDArray[Any]
    scores: NDArray[np.float64]

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
        """No boxes at all."""
        return cls(np.empty((0, 4)), np.empty(0))

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: slice | NDArray[Any] | list[int]) -> Detections:
        """Take rows by a slice, a mask or a list of indices."""
        return Detections(self.boxes[rows], self.scores[rows])

    def __iter__(self) -> Iterator[tuple[NDArray[Any], float]]:
        """Yield ``(box, score)`` pairs."""
        return zip(self.boxes, self.scores.tolist())
