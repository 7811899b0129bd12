"""Higher order tracking accuracy (HOTA): detection, association and localization in one score.

Luiten et al., "HOTA: a higher order metric for evaluating multi-object tracking", IJCV 2021. All values equal
those of the authors' package TrackEval.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats

# Minimum IoU of a match; each score is the mean over these thresholds.
_ALPHAS = np.arange(0.05, 0.99, 0.05)
_EPS = np.finfo(np.float64).eps


class Overlaps(NamedTuple):
    """The vehicles and tracks of one frame."""

    vehicles: NDArray[np.int64]  # (N,) number of each labelled vehicle
    tracks: NDArray[np.int64]  # (M,) number of each predicted track
    iou: Floats  # (N, M)


def hota_scores(frames: Sequence[Overlaps]) -> dict[str, Any]:
    """HOTA, DetA, AssA and LocA of a clip, by the names of the fields of `TrackScores`."""
    n_vehicles, vehicle_rows = _number([frame.vehicles for frame in frames])
    n_tracks, track_rows = _number([frame.tracks for frame in frames])
    n_boxes = sum(n_vehicles) + sum(n_tracks)
    if not n_boxes:
        return dict.fromkeys(("hota", "deta", "assa", "loca"), math.nan)
    alignment = _alignment(frames, vehicle_rows, track_rows, n_vehicles, n_tracks)
    vehicles, tracks, iou = _match(frames, vehicle_rows, track_rows, alignment)

    matched = iou >= _ALPHAS[:, None] - _EPS  # (A, matches)
    tp = matched.sum(axis=1)
    detection = tp / (n_boxes - tp)
    localization = np.maximum((matched * iou).sum(axis=1), 1e-10) / np.maximum(tp, 1e-10)
    pairs = vehicles * len(n_tracks) + tracks
    order = np.argsort(pairs, kind="stable")
    same, starts = np.unique(pairs[order], return_index=True)
    # Matches of each vehicle with each of its tracks, (A, pairs).
    matches = np.add.reduceat(matched[:, order], starts, axis=1) if len(pairs) else np.zeros((len(tp), 0))
    # Boxes of the vehicle and the track together.
    counts = n_vehicles[same // max(len(n_tracks), 1)] + n_tracks[same % max(len(n_tracks), 1)]
    jaccard = matches / np.maximum(counts - matches, 1)
    association = (matches * jaccard).sum(axis=1) / np.maximum(tp, 1)
    hota = np.sqrt(detection * association)
    means = (float(values.mean()) for values in (hota, detection, association, localization))
    return dict(zip(("hota", "deta", "assa", "loca"), means))


def _number(ids: list[NDArray[np.int64]]) -> tuple[NDArray[np.intp], list[NDArray[np.intp]]]:
    """Assign numbers from 0 to ids; return the boxes of each, and the numbers frame by frame."""
    joined = np.concatenate([np.empty(0, np.int64), *ids])
    _, numbers, counts = np.unique(joined, return_inverse=True, return_counts=True)
    return counts, np.split(numbers, np.cumsum([len(each) for each in ids]))[:-1]


def _alignment(
    frames: Sequence[Overlaps],
    vehicles: list[NDArray[np.intp]],
    tracks: list[NDArray[np.intp]],
    n_vehicles: NDArray[np.intp],
    n_tracks: NDArray[np.intp],
) -> list[Floats]:
    """Jaccard index of the vehicles and tracks of each frame over the clip, before boxes are matched.

    Only pairs that overlap are in memory: a table of all vehicles and tracks grows with the square of the
    clip's length.
    """
    shared: defaultdict[tuple[int, int], float] = defaultdict(float)
    for rows, columns, (_, _, iou) in zip(vehicles, tracks, frames):
        union = iou.sum(axis=0) + iou.sum(axis=1)[:, None] - iou
        part = np.divide(iou, union, out=np.zeros_like(iou), where=union > _EPS)
        for i, j in np.argwhere(part).tolist():
            shared[rows[i], columns[j]] += part[i, j]
    alignment = []
    for rows, columns, (_, _, iou) in zip(vehicles, tracks, frames):
        common = np.zeros_like(iou)
        for i, j in np.argwhere(iou).tolist():
            common[i, j] = shared[rows[i], columns[j]]
        alignment.append(common / (n_vehicles[rows][:, None] + n_tracks[columns] - common))
    return alignment


def _match(
    frames: Sequence[Overlaps],
    vehicles: list[NDArray[np.intp]],
    tracks: list[NDArray[np.intp]],
    alignment: list[Floats],
) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Match each frame for the largest total IoU, weighted by the alignment, whatever the threshold.

    Returns the vehicle, the track and the IoU of each match.
    """
    from scipy.optimize import linear_sum_assignment

    matches: list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]] = []
    for rows, columns, weights, (_, _, iou) in zip(vehicles, tracks, alignment, frames):
        chosen = linear_sum_assignment(weights * iou, maximize=True)
        matches.append((rows[chosen[0]], columns[chosen[1]], iou[chosen]))
    matched_rows, matched_columns, overlaps = (np.concatenate(each) for each in zip(*matches))
    return matched_rows, matched_columns, overlaps
