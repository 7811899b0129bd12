"""Score tracks against labelled vehicles: HOTA, CLEAR MOT metrics, IDF1 and jitter."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.detections import Scores, format_number, format_summary, mean, rates, ratio
from vehicle_detection.evaluation.matching import find_ignored, prepare_evaluation
from vehicle_detection.tables import NO_TRACK, FrameKey, TrackTable

# Minimum IoU of a match in HOTA; each of its scores is the mean over these thresholds.
_ALPHAS = np.arange(0.05, 0.99, 0.05)
_EPS = np.finfo(np.float64).eps

Ids = NDArray[np.int64]


@dataclass(frozen=True)
class TrackScores(Scores):
    """Result of `evaluate_tracks`: counts of boxes are summed over the frames, as in `DetectionScores`.

    >>> boxes = TrackTable([0, 1], [1, 1], [[0, 0, 50, 40], [4, 0, 54, 40]])
    >>> evaluate_tracks(boxes, boxes).hota
    1.0
    """

    frames: int  #: number of evaluated frames
    iou: float  #: smallest IoU of a match
    vehicles: int  #: labelled vehicles
    tracks: int  #: predicted tracks with a box that is not ignored
    tp: int  #: boxes on a vehicle
    fp: int  #: boxes on none
    fn: int  #: vehicles without a box
    ignored: int  #: ignored boxes
    precision: float  #: of the boxes
    recall: float  #: of the boxes
    f1: float  #: of the boxes
    mean_iou: float  #: of the matched pairs
    jitter: float  #: mean change of the four edge errors of a matched box between two frames (px)
    hota: float  #: higher order tracking accuracy, mean over the IoU thresholds 0.05, 0.1, ..., 0.95
    deta: float  #: its part for detection
    assa: float  #: its part for association
    loca: float  #: its part for localization
    mota: float  #: ``1 - (fn + fp + id_switches) / (tp + fn)``; at most 1, and may be below 0
    idf1: float  #: F1 of the boxes under the best one-to-one assignment of tracks to vehicles
    id_switches: int  #: times that a vehicle is matched by another track than last
    fragmentations: int  #: times that a vehicle is lost and found again
    longest_false_positive_run: int  #: most consecutive frames in which one track is a false positive

    def summary(self) -> str:
        """Return the scores as a few aligned lines."""
        precision, recall = format_number(self.precision), format_number(self.recall)
        parts = (format_number(part) for part in (self.deta, self.assa, self.loca))
        rows = {
            "HOTA": "{} (DetA {}, AssA {}, LocA {})".format(format_number(self.hota), *parts),
            "MOTA": format_number(self.mota),
            "IDF1": format_number(self.idf1),
            "F1": f"{format_number(self.f1)} (precision {precision}, recall {recall})",
            "mean IoU": format_number(self.mean_iou),
            "jitter": f"{format_number(self.jitter)} px a frame",
            "identity switches": str(self.id_switches),
            "fragmentations": str(self.fragmentations),
            "longest false run": f"{self.longest_false_positive_run} frames",
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        counts = f"{self.tracks} tracks of {self.vehicles} vehicles in {self.frames} frames"
        return format_summary(f"{counts} at IoU {self.iou:g}", rows)


def evaluate_tracks(
    predictions: TrackTable,
    labels: TrackTable,
    *,
    iou: float = 0.5,
    frames: Sequence[FrameKey] | None = None,
    ignored_as_regions: bool = False,
) -> TrackScores:
    """Score tracks against labels: HOTA, CLEAR MOT metrics, IDF1 and jitter.

    A vehicle keeps the track that matched it last as long as their IoU is large enough; the rest are assigned
    for the largest number of matches and, among those, the largest total IoU. The counts equal those of the
    package motmetrics, and HOTA equals that of TrackEval. Every box needs a track unless it is marked
    ``ignore``. Options: see `evaluate_detections`.

    Frames are consecutive if their numbers differ by the smallest difference that occurs, which is 1 unless
    only every n-th frame is labelled; named frames in their order.

    Notes
    -----
    MOTA, switches and fragmentations: Bernardin and Stiefelhagen, "Evaluating multiple object tracking
    performance: the CLEAR MOT metrics", 2008. IDF1: Ristani et al., "Performance measures and a data set
    for multi-target, multi-camera tracking", 2016. HOTA: Luiten et al., "HOTA: a higher order metric for
    evaluating multi-object tracking", 2021. Ignored boxes are removed before anything is counted.

    Examples
    --------
    >>> labels = TrackTable([0, 1, 2], [1, 1, 1], [[0, 0, 50, 40], [4, 0, 54, 40], [8, 0, 58, 40]])
    >>> found = TrackTable([0, 1, 2], [7, 7, 8], [[0, 0, 50, 40], [5, 0, 55, 40], [9, 0, 59, 40]])
    >>> scores = evaluate_tracks(found, labels)
    >>> scores.id_switches, round(scores.mota, 3), round(scores.hota, 3), scores.jitter
    (1, 0.667, 0.745, 0.25)
    """
    check.flags(ignored_as_regions=ignored_as_regions)
    predictions, labels, keys = prepare_evaluation(predictions, labels, frames)
    min_iou = check.number(iou, "iou", above=0, high=1)
    _check_tracks(predictions, "predictions", keys)
    _check_tracks(labels, "labels", keys)
    clip = _match_tracks(predictions, labels, keys, min_iou, ignored_as_regions)
    positions = dict(zip(keys, _positions(keys)))
    # The labels that count, vehicle by vehicle, and the prediction that matches each of them.
    targets, matched = (_join([getattr(each, name) for each in clip]) for name in ("targets", "matched"))
    vehicles, times = _places(labels, targets, positions)
    order = np.lexsort((times, vehicles))
    targets, matched, vehicles, times = targets[order], matched[order], vehicles[order], times[order]
    found = matched >= 0
    # Whether a label and the next one are of the same vehicle and both matched.
    goes_on = (vehicles[1:] == vehicles[:-1]) & found[1:] & found[:-1]
    n_runs = int(found.sum()) - int(goes_on.sum())  # in which a vehicle is matched label by label
    tracks = predictions["track_id"][matched[found]]
    switches = int(((np.diff(vehicles[found]) == 0) & (np.diff(tracks) != 0)).sum())
    errors = predictions.boxes[matched] - labels.boxes[targets] if len(predictions) else np.empty((0, 4))
    steady = np.flatnonzero(goes_on & (np.diff(times) == 1))
    false = _join([each.false for each in clip])
    tp, fp, fn = int(found.sum()), len(false), int((~found).sum())
    pairs = _join_pairs(predictions, labels, clip)
    return TrackScores(
        frames=len(keys),
        iou=min_iou,
        vehicles=len(np.unique(vehicles)),
        tracks=len(np.unique(predictions["track_id"][_join([matched[found], false])])),
        ignored=sum(each.ignored for each in clip),
        mean_iou=mean([overlap for each in clip for overlap in each.overlaps.tolist()]),
        jitter=mean(np.abs(errors[steady + 1] - errors[steady])),
        mota=1 - ratio(fn + fp + switches, tp + fn),
        **_hota_scores(pairs, clip),
        idf1=ratio(2 * _identity_true_positives(pairs, min_iou), 2 * tp + fp + fn),
        id_switches=switches,
        fragmentations=n_runs - len(np.unique(vehicles[found])),
        longest_false_positive_run=_longest_run(*_places(predictions, false, positions)),
        **rates(tp, fp, fn),
    )


def _check_tracks(side: TrackTable, name: str, keys: list[FrameKey]) -> None:
    wanted = set(keys)
    for row in np.flatnonzero((side["track_id"] == NO_TRACK) & ~side["ignore"]).tolist():
        frame = side["frame"].tolist()[row]
        if frame in wanted:
            raise InvalidInputError(
                f"{name} must have a track for every box, row {row} in frame {frame!r} has none; "
                "score boxes without tracks with evaluate_detections"
            )


class _Frame(NamedTuple):
    """The matches of one frame."""

    targets: Ids  # (N,) rows of the labels that count
    rows: Ids  # (M,) rows of the predictions that are not ignored
    iou: Floats  # (N, M)
    matched: Ids  # (N,) row of the prediction that matches each label, or -1
    false: Ids  # rows of the predictions without a label
    overlaps: Floats  # IoU of each match
    ignored: int


def _match_tracks(
    predictions: TrackTable, labels: TrackTable, keys: list[FrameKey], min_iou: float, as_regions: bool
) -> list[_Frame]:
    """Match the frames in order, each vehicle with its last track where possible."""
    track_of: dict[int, int] = {}
    clip = []
    for key in keys:
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~labels["ignore"][rows]]
        overlap = iou_matrix(labels.boxes[targets], predictions.boxes[here])
        vehicles, tracks = labels["track_id"][targets].tolist(), predictions["track_id"][here].tolist()
        pairs: dict[int, int] = {}
        for i, vehicle in enumerate(vehicles):
            j = tracks.index(track_of[vehicle]) if track_of.get(vehicle) in tracks else -1
            # If two vehicles had the same track last, the first row takes it, as in motmetrics.
            if j >= 0 and overlap[i, j] >= min_iou and j not in pairs.values():
                pairs[i] = j
        pairs |= _assign_rest(overlap, pairs, min_iou)
        track_of.update((vehicles[i], tracks[j]) for i, j in pairs.items())
        matched, found, by = np.full(len(targets), -1), list(pairs), list(pairs.values())
        matched[found] = here[by]
        rest = np.setdiff1d(here, matched)
        ignored = find_ignored(predictions.boxes[rest], labels, rows, min_iou, as_regions=as_regions)
        kept = ~np.isin(here, rest[ignored])
        parts = overlap[:, kept], matched, rest[~ignored], overlap[found, by]
        clip.append(_Frame(targets, here[kept], *parts, int(ignored.sum())))
    return clip


def _positions(keys: list[FrameKey]) -> list[int]:
    """Assign positions to frames: consecutive ones differ by 1, others by more."""
    numbers = [key if isinstance(key, int) else index for index, key in enumerate(keys)]
    steps = [after - before for before, after in pairwise(numbers)]
    min_step = min(steps, default=1)
    return list(accumulate((1 if step == min_step else 2 for step in steps), initial=0))


def _places(side: TrackTable, rows: Ids, positions: dict[FrameKey, int]) -> tuple[Ids, Ids]:
    """Track and position of each row."""
    return side["track_id"][rows], np.array([positions[key] for key in side["frame"][rows]], np.int64)


def _assign_rest(overlap: Floats, kept: dict[int, int], min_iou: float) -> dict[int, int]:
    """Assign the remaining rows: as many pairs as possible, then the largest total IoU."""
    from scipy.optimize import linear_sum_assignment

    allowed = overlap >= min_iou
    allowed[list(kept)] = allowed[:, list(kept.values())] = False
    # A forbidden pair costs more than all allowed pairs together.
    chosen = linear_sum_assignment(np.where(allowed, 1 - overlap, 1.0 + min(overlap.shape)))
    return {int(i): int(j) for i, j in zip(*chosen) if allowed[i, j]}


def _join(arrays: Sequence[Ids]) -> Ids:
    return np.concatenate([np.empty(0, np.int64), *arrays])


def _longest_run(tracks: Ids, positions: Ids) -> int:
    """Most consecutive positions of one track."""
    order = np.lexsort([positions, tracks])
    is_gap = (np.diff(tracks[order]) != 0) | (np.diff(positions[order]) != 1)
    ends = np.array([0, *(np.flatnonzero(is_gap) + 1), len(tracks)])
    return int(np.diff(ends).max())


class _Pairs(NamedTuple):
    """Each vehicle and track that occur in the same frame, and their IoU there."""

    numbers: Ids  # (K,) number of each pair of a frame, the same in all its frames
    iou: Floats  # (K,)
    vehicles: Ids  # (P,) vehicle of each number
    tracks: Ids  # (P,)
    boxes: Ids  # (P,) boxes of the vehicle and the track together


def _join_pairs(predictions: TrackTable, labels: TrackTable, clip: list[_Frame]) -> _Pairs:
    vehicles = [labels["track_id"][each.targets] for each in clip]
    tracks = [predictions["track_id"][each.rows] for each in clip]
    n_vehicles, n_tracks = (Counter(_join(each).tolist()) for each in (vehicles, tracks))
    vehicle = _join([np.repeat(ids, len(others)) for ids, others in zip(vehicles, tracks)])
    track = _join([np.tile(ids, len(others)) for ids, others in zip(tracks, vehicles)])
    pairs, numbers = np.unique(np.stack([vehicle, track]), axis=1, return_inverse=True)
    boxes = np.array([n_vehicles[i] + n_tracks[j] for i, j in pairs.T.tolist()], np.int64)
    iou = np.concatenate([np.empty(0), *(each.iou.ravel() for each in clip)])
    return _Pairs(numbers.ravel(), iou, pairs[0], pairs[1], boxes)


def _hota_scores(pairs: _Pairs, clip: list[_Frame]) -> dict[str, Any]:
    """HOTA, DetA, AssA and LocA of a clip, by the names of the fields of `TrackScores`.

    All values equal those of the authors' package TrackEval.
    """
    from scipy.optimize import linear_sum_assignment

    n_boxes = sum(len(each.targets) + len(each.rows) for each in clip)
    if not n_boxes:
        return dict.fromkeys(("hota", "deta", "assa", "loca"), math.nan)
    # Jaccard index of each vehicle and track over the clip, before boxes are matched.
    parts = [np.empty(0)]
    for iou in (each.iou for each in clip):
        union = iou.sum(axis=0) + iou.sum(axis=1)[:, None] - iou
        parts.append(np.divide(iou, union, out=np.zeros_like(iou), where=union > _EPS).ravel())
    shared = np.bincount(pairs.numbers, np.concatenate(parts), len(pairs.boxes))
    weights = (shared / (pairs.boxes - shared))[pairs.numbers] * pairs.iou
    # Match each frame for the largest total IoU, weighted by this index, whatever the threshold.
    chosen, start = [np.empty(0, np.intp)], 0
    for n, m in (each.iou.shape for each in clip):
        i, j = linear_sum_assignment(weights[start : start + n * m].reshape(n, m), maximize=True)
        chosen.append(start + i * m + j)
        start += n * m
    rows = np.concatenate(chosen)
    iou, numbers = pairs.iou[rows], pairs.numbers[rows]
    matched = iou >= _ALPHAS[:, None] - _EPS  # (A, matches)
    tp = matched.sum(axis=1)
    detection = tp / (n_boxes - tp)
    localization = np.maximum((matched * iou).sum(axis=1), 1e-10) / np.maximum(tp, 1e-10)
    matches = np.array([np.bincount(numbers[each], minlength=len(pairs.boxes)) for each in matched])
    association = (matches * (matches / (pairs.boxes - matches))).sum(axis=1) / np.maximum(tp, 1)
    values = np.sqrt(detection * association), detection, association, localization
    return {name: float(each.mean()) for name, each in zip(("hota", "deta", "assa", "loca"), values)}


def _identity_true_positives(pairs: _Pairs, min_iou: float) -> int:
    """Count the right boxes under the best one-to-one assignment of tracks to vehicles (IDTP)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    counts = np.bincount(pairs.numbers[pairs.iou >= min_iou], minlength=len(pairs.boxes))
    rows, columns = (np.unique(each[counts > 0], return_inverse=True)[1] for each in pairs[2:4])
    if not len(rows):
        return 0
    # Each vehicle also has a column of its own, for no track. All weigh 1 more, as 0 is no pair.
    size = int(rows.max()) + 1
    own = np.arange(size)
    weights = np.concatenate([counts[counts > 0] + 1, np.ones(size, np.int64)])
    places = np.concatenate([rows, own]), np.concatenate([columns, columns.max() + 1 + own])
    table = coo_array((weights, places)).tocsr()
    return int(table[min_weight_full_bipartite_matching(table, maximize=True)].sum()) - size
