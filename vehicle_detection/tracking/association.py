"""Which detection belongs to which track, and which boxes show the same vehicle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from vehicle_detection.boxes import box_areas, intersection_matrix

Floats = NDArray[np.float64]

_FORBIDDEN = 1e3
_AREA_RATIO = 4.0
_COVERED, _FITTING = 0.7, 0.7


def overlap_matrices(first: Floats, second: Floats) -> tuple[Floats, Floats, Floats]:
    """Overlap of ``(N, 4)`` with ``(M, 4)`` boxes, each ``(N, M)`` in [0, 1].

    Returns
    -------
    tuple
        IoU; share of each first box that the second covers; share of the smaller of both that both cover.
    """
    shared = intersection_matrix(first, second)
    areas, others = np.maximum(box_areas(first), 1e-9)[:, None], np.maximum(box_areas(second), 1e-9)[None]
    return shared / (areas + others - shared), shared / areas, shared / np.minimum(areas, others)


def match_boxes(predicted: Floats, measured: Floats, gate: Floats) -> list[tuple[int, int]]:
    """Assign measured boxes to predicted ones so that the sum of the costs is least.

    The cost joins IoU, the distance of the centers in box sizes and the ratio of the areas. The assignment is
    the Hungarian one (Kuhn, *Naval Research Logistics Quarterly*, 1955).

    Parameters
    ----------
    predicted, measured
        ``(N, 4)`` and ``(M, 4)`` boxes.
    gate
        ``(N,)`` farthest distance of the centers, in mean widths and heights.

    Returns
    -------
    list
        Pairs of indices ``(predicted, measured)``, those within the gate only.
    """
    if not len(predicted) or not len(measured):
        return []
    iou = overlap_matrices(predicted, measured)[0]
    distance = _center_distances(predicted, measured) / gate[:, None]
    areas, others = (np.log(np.maximum(box_areas(boxes), 1.0)) for boxes in (predicted, measured))
    ratio = np.abs(areas[:, None] - others[None])
    cost = (1 - iou) + distance + 0.3 * ratio
    cost[(distance > 1) | (ratio > math.log(_AREA_RATIO))] = _FORBIDDEN
    rows, columns = linear_sum_assignment(cost)
    return [(int(r), int(c)) for r, c in zip(rows, columns) if cost[r, c] < _FORBIDDEN]


def match_nearest(predicted: Floats, measured: Floats, gate: Floats) -> list[tuple[int, int]]:
    """Pair boxes by the distance of their centers alone, nearest first (the course's first system)."""
    pairs: list[tuple[int, int]] = []
    distance = _center_distances(predicted, measured) / gate[:, None]
    for flat in np.argsort(distance, axis=None, kind="stable"):
        row, column = divmod(int(flat), len(measured))
        if distance[row, column] <= 1 and all(row != r and column != c for r, c in pairs):
            pairs.append((row, column))
    return pairs


def _center_distances(first: Floats, second: Floats) -> Floats:
    """``(N, M)`` distances of the centers, in mean widths and heights of the two boxes."""
    sides, others = (np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0) for boxes in (first, second))
    apart = (first[:, :2] + first[:, 2:])[:, None] - (second[:, :2] + second[:, 2:])[None]
    # Sums of both edges over sums of both sides: the halves cancel.
    apart = apart / (sides[:, None] + others[None])
    return np.asarray(np.hypot(apart[:, :, 0], apart[:, :, 1]))


def same_vehicle(box: Floats, others: Floats, max_overlap: float, max_cover: float) -> bool:
    """Whether a box overlaps one of `others` so much that both show one vehicle."""
    if not len(others):
        return False
    iou, _, cover = overlap_matrices(box[None], others)
    return bool(((iou > max_overlap) | (cover > max_cover)).any())


def merged_regions(
    predicted: Floats, measured: Floats, own: dict[int, int]
) -> tuple[set[int], dict[int, int]]:
    """Find detections that show two vehicles as one region: they cover both, and fit neither.

    Parameters
    ----------
    predicted, measured
        ``(N, 4)`` boxes of the tracks and ``(M, 4)`` boxes of the detections.
    own
        The detection of each track that has one.

    Returns
    -------
    tuple
        Tracks whose own detection is such a region, and the region of each other track that one shows.
    """
    merged: set[int] = set()
    region: dict[int, int] = {}
    alone = np.ones(len(predicted), np.bool_)
    alone[list(own)] = False
    if own and alone.any():
        iou, covered, _ = overlap_matrices(predicted, measured)
        fits = (covered > _COVERED) & (iou < _FITTING)
        for row, column in own.items():
            others = np.flatnonzero(fits[:, column] & alone).tolist()
            if fits[row, column] and others:
                merged.add(row)
                region |= dict.fromkeys(others, column)
    return merged, region
