"""Numba kernel of greedy non-maximum suppression and of the voting of boxes."""

from __future__ import annotations

import numpy as np

from vehicle_detection._kernels.jit import jit

_TINY = float(np.finfo(np.float64).tiny)


@jit
def group(sides, order, max_iou, max_coverage, max_groups, strengths, voted, mass):
    """Group boxes by greedy non-maximum suppression, and let all boxes vote for the groups.

    `sides` is ``(4, N)``: left, top, right and bottom of the boxes. A box of `order` starts a group, unless
    its IoU with the first box of another one exceeds `max_iou`, or they share more than the fraction
    `max_coverage` of the smaller one. Returns the first boxes, at most `max_groups`.

    The boxes that overlap a first box by more than `max_iou` vote with their `strengths` for its group. The
    outputs are the mean boxes `voted` ``(K, 4)``, weighted by the squares of the strengths, and the sums of
    the strengths `mass` ``(K,)``. Without rows of `voted` there is no vote.
    """
    left, top, right, bottom = sides[0], sides[1], sides[2], sides[3]
    areas, iou, sums = np.empty(len(left)), np.empty(len(left)), np.empty(6)
    dropped = np.empty(len(areas), np.bool_)
    # Not np.zeros, which takes the compiler a fifth of a second.
    for row in range(len(areas)):
        areas[row] = (right[row] - left[row]) * (bottom[row] - top[row])
        dropped[row] = False
    for place in range(len(sums)):
        sums[place] = 0.0
    first = np.empty(len(order), np.int64)
    count = 0
    for best in order:
        if dropped[best]:
            continue
        if count == max_groups:
            break
        x1, y1, x2, y2, area = left[best], top[best], right[best], bottom[best], areas[best]
        # The compiler computes several at a time because there is one output only.
        for row in range(len(areas)):
            width = max(min(right[row], x2) - max(left[row], x1), 0.0)
            height = max(min(bottom[row], y2) - max(top[row], y1), 0.0)
            shared = width * height
            iou[row] = shared / max(areas[row] + area - shared, _TINY)
        for row in range(len(areas)):
            # A box without an area does not overlap itself.
            if iou[row] > max_iou or row == best:
                dropped[row] = True
                if len(voted):
                    weight = strengths[row] * strengths[row] if iou[row] > max_iou else 0.0
                    weight = max(weight, 1e-9) if row == best else weight
                    # Sums in memory: the compiler would add zeros for all other rows.
                    sums[0] += weight
                    sums[1] += strengths[row] if iou[row] > max_iou else 0.0
                    for side in range(len(sides)):
                        sums[2 + side] += weight * sides[side, row]
            elif max_coverage < 1:
                width = max(min(right[row], x2) - max(left[row], x1), 0.0)
                height = max(min(bottom[row], y2) - max(top[row], y1), 0.0)
                if width * height / max(min(areas[row], area), _TINY) > max_coverage:
                    dropped[row] = True
        if len(voted):
            for side in range(len(sides)):
                voted[count, side] = sums[2 + side] / sums[0]
            mass[count] = sums[1]
            for place in range(len(sums)):
                sums[place] = 0.0
        first[count] = best
        count += 1
    return first[:count]
