"""Arithmetic of boxes: areas, overlap, clipping and non-maximum suppression."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check_array, check_boxes, check_number, check_shape
from vehicle_detection.boxes.detections import Detections

# Lower bound of a divisor. An empty box shares no area with any other, so its ratios become 0.
_TINY = np.finfo(np.float64).tiny
# Boxes at one distance: least ratio of their heights, largest difference of their lower edges in heights. And
# the fraction of the narrower one's width that boxes on one vehicle share.
_ALIKE_HEIGHT, _ALIKE_BOTTOM, _PART_OVERLAP = 0.8, 0.15, 0.4


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


def on_one_vehicle(boxes: Floats) -> NDArray[np.bool_]:
    """``(N, N)``: whether two boxes are at one distance and share much of the narrower one's width.

    Two vehicles at one distance from the camera do not overlap in the image. The side of a near vehicle in
    the next lane, however, looks like a vehicle of the same height.
    """
    left, _, right, bottom = boxes.T
    widths, heights = right - left, bottom - boxes[:, 1]
    higher, lower = np.maximum(heights[:, None], heights), np.minimum(heights[:, None], heights)
    apart = np.abs(bottom[:, None] - bottom)
    at_one_distance = (lower > _ALIKE_HEIGHT * higher) & (apart < _ALIKE_BOTTOM * higher)
    shared = np.minimum(right[:, None], right) - np.maximum(left[:, None], left)
    overlapping = shared > _PART_OVERLAP * np.minimum(widths[:, None], widths)
    return np.asarray(at_one_distance & overlapping)


def iou_matrix(first: Detections | ArrayLike, second: Detections | ArrayLike) -> Floats:
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


def clip_boxes(boxes: Detections | ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
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
    height, width = check_shape(shape)
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


def non_max_suppression(
    boxes: Detections | ArrayLike, scores: ArrayLike, *, threshold: float = 0.5
) -> NDArray[np.intp]:
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
    detections = Detections(check_boxes(boxes), check_array(scores, "scores"))
    max_iou = check_number(threshold, "threshold", low=0, high=1)
    return greedy_nms(detections.boxes.astype(np.float64), detections.scores, max_iou=max_iou)
