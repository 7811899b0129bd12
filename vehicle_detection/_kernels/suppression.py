"""Numba kernels of greedy non-maximum suppression and of the voting of windows."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import inlined, jit

_TINY = float(np.finfo(np.float64).tiny)


@inlined
def _overlaps(boxes, best, iou, coverage):
    """IoU of one box with all boxes, and the shared fraction of the smaller box of each pair."""
    x1, y1, x2, y2 = boxes[best]
    area = (x2 - x1) * (y2 - y1)
    for row in range(len(boxes)):
        width = max(min(boxes[row, 2], x2) - max(boxes[row, 0], x1), 0.0)
        height = max(min(boxes[row, 3], y2) - max(boxes[row, 1], y1), 0.0)
        shared = width * height
        other = (boxes[row, 2] - boxes[row, 0]) * (boxes[row, 3] - boxes[row, 1])
        iou[row] = shared / max(other + area - shared, _TINY)
        coverage[row] = shared / max(min(other, area), _TINY)


@jit
def suppress(boxes, order, max_iou, max_coverage, max_boxes):
    """Rows that greedy non-maximum suppression keeps, at most `max_boxes`, in the order of `order`.

    A row is dropped if its IoU with a kept box exceeds `max_iou`, or if they share more than the fraction
    `max_coverage` of the smaller one.
    """
    iou, coverage = np.empty(len(boxes)), np.empty(len(boxes))
    dropped = np.empty(len(boxes), np.bool_)
    dropped[:] = False
    kept = np.empty(len(order), np.int64)
    count = 0
    for row in order:
        if dropped[row]:
            continue
        if count == max_boxes:
            break
        kept[count] = row
        count += 1
        _overlaps(boxes, row, iou, coverage)
        for other in range(len(boxes)):
            if iou[other] > max_iou or coverage[other] > max_coverage:
                dropped[other] = True
    return kept[:count]


@jit
def vote(boxes, strengths, kept, min_iou, voted, mass):
    """Let all windows vote for the boxes of the `kept` ones that they overlap by more than `min_iou`.

    The outputs are the mean boxes ``(K, 4)``, weighted by the squares of the `strengths`, and the sums of the
    strengths, ``(K,)``.
    """
    iou, coverage = np.empty(len(boxes)), np.empty(len(boxes))
    for number in range(len(kept)):
        best = kept[number]
        _overlaps(boxes, best, iou, coverage)
        total = mass[number] = 0.0
        voted[number] = 0.0
        for row in range(len(boxes)):
            if iou[row] > min_iou or row == best:
                weight = strengths[row] * strengths[row]
                if row == best:
                    weight = max(weight if iou[row] > min_iou else 0.0, 1e-9)
                if iou[row] > min_iou:
                    mass[number] += strengths[row]
                total += weight
                for side in range(4):
                    voted[number, side] += weight * boxes[row, side]
        for side in range(4):
            voted[number, side] /= total
