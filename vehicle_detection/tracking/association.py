"""Assignment of detections to tracks, and tests of whether boxes show the same vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.boxes import box_areas, clip_boxes, intersection_matrix, iter_nms, overlap_matrices
from vehicle_detection.camera import FrameShape
from vehicle_detection.tracking.track import TrackParams

# A detection shows two vehicles if it covers more than this fraction of both, and has a lower IoU with both.
_MIN_MERGED_COVERAGE, _MAX_MERGED_IOU = 0.7, 0.7
# Fraction of its size by which the box of a nearer vehicle is enlarged.
_COVER_MARGIN = 0.03
# Fraction of a vehicle's height by which the bottom edge of a nearer one is lower.
_MIN_NEARER = 0.1
# A nearer vehicle hides a left or right edge if it shares this fraction of the height, and covers the point
# at this distance beyond the edge, as a fraction of the height; or the bottom edge with this fraction of the
# width.
_MIN_SHARED_HEIGHT, _HIDING_DISTANCE, _MIN_SHARED_WIDTH = 0.5, 0.06, 0.6
# Largest growth of an approaching vehicle between two searched frames.
_MAX_GROWTH = 1.6
# Smallest IoU of its grown box with the new one.
_MIN_GROWN_IOU = 0.6
# Cost of a pair that is not allowed: more than all allowed ones, so that as many as possible are chosen.
_FORBIDDEN = 1e6

Bools = NDArray[np.bool_]


def match_boxes(
    predicted: Floats, measured: Floats, max_distance: Floats, min_iou: float | Floats = 0.0
) -> list[tuple[int, int]]:
    """Pairs ``(predicted, measured)`` of indices by the Hungarian method, with minimum total cost.

    The cost is the sum of ``1 - IoU``, of the distance between centers in units of `max_distance` ``(N,)``,
    and of the weighted logarithm of the ratio of areas (Kuhn, *Naval Research Logistics Quarterly*, 1955).
    Pairs with an IoU below `min_iou` are not allowed.
    """
    if not len(predicted) or not len(measured):
        return []
    iou, _ = overlap_matrices(predicted, measured)
    distance = center_distances(predicted, measured) / max_distance[:, None]
    areas, others = (np.log(np.maximum(box_areas(boxes), 1.0)) for boxes in (predicted, measured))
    area_ratio = np.abs(areas[:, None] - others[None])
    cost = (1 - iou) + distance + 0.3 * area_ratio
    return cheapest_pairs(cost, (distance <= 1) & (area_ratio <= math.log(4)) & (iou >= min_iou))


def match_approaching(
    boxes: Floats, measured: Floats, focus: tuple[float, float], frame: FrameShape
) -> list[tuple[int, int]]:
    """Pairs ``(box, measured)`` of indices of vehicles that may have come nearer between two frames.

    On a straight course, the box of a vehicle grows around the focus of expansion, where the course meets the
    horizon (Gibson, *The Perception of the Visual World*, 1950). The growth is that which takes the edges of
    the box closest to the measured ones; the grown box, clipped to the frame, must then fit the measured one.
    """
    if not len(boxes) or not len(measured):
        return []
    center = np.tile(focus, 2)
    offsets, others = boxes - center, measured - center
    growth = offsets @ others.T / np.maximum(np.square(offsets).sum(axis=1), 1.0)[:, None]
    grown = center + offsets[:, None] * growth.clip(1, _MAX_GROWTH)[:, :, None]
    clipped = (clip_boxes(grown[:, column], frame) for column in range(len(measured)))
    columns = [overlap_matrices(each, box[None])[0] for each, box in zip(clipped, measured)]
    iou = np.concatenate(columns, axis=1)
    return cheapest_pairs(1 - iou, (growth >= 1) & (growth <= _MAX_GROWTH) & (iou >= _MIN_GROWN_IOU))


def center_distances(first: Floats, second: Floats) -> Floats:
    """``(N, M)`` distances between the centers, in mean widths and heights of the two boxes."""
    sides, others = (np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0) for boxes in (first, second))
    apart = (first[:, :2] + first[:, 2:])[:, None] - (second[:, :2] + second[:, 2:])[None]
    # Sums of both edges over sums of both sides: the factors of one half cancel.
    apart = apart / (sides[:, None] + others[None])
    return np.asarray(np.hypot(apart[:, :, 0], apart[:, :, 1]))


def covered_fractions(boxes: Floats, others: Floats) -> Floats:
    """``(N, M)`` fraction of each of `boxes` that each of `others` covers."""
    return intersection_matrix(boxes, others) / np.maximum(box_areas(boxes), 1e-9)[:, None]


def nearer_cover(boxes: Floats, is_opaque: Bools) -> Floats:
    """For each box, the largest fraction of it that a single nearer, opaque box covers; ``(N,)``.

    That box is enlarged by a few percent, because a vehicle that only touches another one hides its edge.
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    margin = _COVER_MARGIN * np.tile(sides, 2) * np.array([-1.0, -1.0, 1.0, 1.0])
    fractions = covered_fractions(boxes, boxes + margin)
    nearer = _are_nearer(boxes, boxes) & is_opaque
    return np.asarray(np.where(nearer, fractions, 0.0).max(axis=1, initial=0.0))


def _are_nearer(boxes: Floats, others: Floats) -> Bools:
    """``(N, M)``: whether each of `others` is nearer than each of `boxes`: its bottom edge is lower."""
    heights = boxes[:, 3] - boxes[:, 1]
    return np.asarray(others[:, 3] > (boxes[:, 3] + _MIN_NEARER * heights)[:, None])


def hidden_edges(boxes: Floats, tracked: Floats, rows: Sequence[int], is_opaque: Bools) -> Bools:
    """``(N, 4)``: whether a nearer, opaque one of the `tracked` boxes hides what lies beyond an edge.

    `boxes` are of the tracks `rows`. The top edge is never marked, and the bottom edge only where a vehicle
    hides most of it, as vehicles pass each other sideways.
    """
    heights = (boxes[:, 3] - boxes[:, 1])[:, None]
    shared = np.minimum(boxes[:, None, 3], tracked[:, 3]) - np.maximum(boxes[:, None, 1], tracked[:, 1])
    others = np.arange(len(tracked)) != np.array(rows)[:, None]
    nearer = others & is_opaque & _are_nearer(boxes, tracked)
    hiding = nearer & (shared > _MIN_SHARED_HEIGHT * heights)
    hidden = np.zeros(boxes.shape, np.bool_)
    for edge, outward in (0, -1), (2, 1):
        x = boxes[:, edge, None] + outward * _HIDING_DISTANCE * heights
        hidden[:, edge] = (hiding & (tracked[:, 0] < x) & (x < tracked[:, 2])).any(axis=1)
    y, widths = boxes[:, 3, None] + _HIDING_DISTANCE * heights, (boxes[:, 2] - boxes[:, 0])[:, None]
    across = np.minimum(boxes[:, None, 2], tracked[:, 2]) - np.maximum(boxes[:, None, 0], tracked[:, 0])
    hidden[:, 3] = (nearer & (tracked[:, 1] < y) & (across > _MIN_SHARED_WIDTH * widths)).any(axis=1)
    return hidden


def distinct_vehicles(boxes: Floats, order: Sequence[int], known: Floats, params: TrackParams) -> list[int]:
    """Rows of `order` (best first) whose box shows neither a vehicle of `known` nor one of an earlier row."""
    iou, coverage = overlap_matrices(boxes, known)
    is_known = np.any((iou > params.max_iou) | (coverage > params.max_coverage), axis=1).tolist()
    rows = np.array([row for row in order if not is_known[row]], np.intp)
    kept = iter_nms(boxes, rows, max_iou=params.max_iou, max_coverage=params.max_coverage)
    return [row for row, _ in kept]


def merged_detections(
    predicted: Floats, measured: Floats, assigned: dict[int, int]
) -> tuple[set[int], dict[int, int]]:
    """Find detections that show two vehicles in one box: they cover both predictions, and fit neither.

    `assigned` maps tracks to their detections. Returns the tracks whose own detection is merged, and the
    merged detection of each track that has none of its own.
    """
    merged: set[int] = set()
    shared: dict[int, int] = {}
    unassigned = np.ones(len(predicted), np.bool_)
    unassigned[list(assigned)] = False
    if assigned and unassigned.any():
        iou, _ = overlap_matrices(predicted, measured)
        covered = covered_fractions(predicted, measured)
        is_part = (covered > _MIN_MERGED_COVERAGE) & (iou < _MAX_MERGED_IOU)
        for row, column in assigned.items():
            others = np.flatnonzero(is_part[:, column] & unassigned).tolist()
            if is_part[row, column] and others:
                merged.add(row)
                shared |= dict.fromkeys(others, column)
    return merged, shared


def cheapest_pairs(cost: NDArray[np.float64], allowed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Choose allowed pairs of rows and columns: as many as possible, with minimum total cost, rows in order.

    The same as ``scipy.optimize.linear_sum_assignment``, whose package takes 0.3 s and 20 MB to load.

    >>> cheapest_pairs(np.array([[0.1, 0.3], [0.2, 0.9]]), np.ones((2, 2), bool))
    [(0, 1), (1, 0)]
    """
    if (allowed.sum(axis=0) <= 1).all() and (allowed.sum(axis=1) <= 1).all():
        rows, columns = np.nonzero(allowed)
        return list(zip(rows.tolist(), columns.tolist()))
    rows, columns = np.flatnonzero(allowed.any(axis=1)), np.flatnonzero(allowed.any(axis=0))
    table = np.where(allowed, cost, _FORBIDDEN)[rows[:, None], columns]
    if len(rows) <= len(columns):
        columns = columns[_shortest_paths(table.tolist())]
    else:
        rows = rows[_shortest_paths(table.T.tolist())]
    chosen = sorted(zip(rows.tolist(), columns.tolist()))
    return [pair for pair in chosen if allowed[pair]]


def _shortest_paths(cost: list[list[float]]) -> list[int]:
    """Column of each row with minimum total cost; there are at least as many columns as rows.

    Shortest augmenting paths (Jonker and Volgenant, "A shortest augmenting path algorithm for dense and
    sparse linear assignment problems", Computing 38, 1987). Lists, because the tables are small.
    """
    count = len(cost[0])
    row_prices, column_prices = [0.0] * len(cost), [0.0] * count
    row_of: list[int | None] = [None] * count
    for start in range(len(cost)):
        # Dijkstra's algorithm from the row `start` to the nearest free column.
        distance, previous, reached = [math.inf] * count, [-1] * count, [False] * count
        row, column, length = start, -1, 0.0
        while True:
            nearest, best = -1, math.inf
            for other in range(count):
                if reached[other]:
                    continue
                via = length + cost[row][other] - row_prices[row] - column_prices[other]
                if via < distance[other]:
                    distance[other], previous[other] = via, column
                if distance[other] < best:
                    nearest, best = other, distance[other]
            column, length = nearest, best
            reached[column] = True
            taken_by = row_of[column]
            if taken_by is None:
                break
            row = taken_by
        row_prices[start] += length
        for other in range(count):
            taken_by = row_of[other]
            if reached[other] and taken_by is not None:
                row_prices[taken_by] += length - distance[other]
                column_prices[other] -= length - distance[other]
        while column >= 0:  # assign along the path, from its end to its start
            before = previous[column]
            row_of[column] = start if before < 0 else row_of[before]
            column = before
    column_of = [-1] * len(cost)
    for column, taken_by in enumerate(row_of):
        if taken_by is not None:
            column_of[taken_by] = column
    return column_of
