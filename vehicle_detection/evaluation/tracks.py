"""Score tracks against labelled vehicles: HOTA, CLEAR MOT metrics, IDF1 and jitter."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_flags, check_number
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.detections import Scores, format_number, format_summary, mean, rates, ratio
from vehicle_detection.evaluation.hota import Overlaps, hota_scores
from vehicle_detection.evaluation.matching import find_ignored, prepare_evaluation
from vehicle_detection.tables import NO_TRACK, FrameKey, TrackTable


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
    check_flags(ignored_as_regions=ignored_as_regions)
    predictions, labels, keys = prepare_evaluation(predictions, labels, frames)
    min_iou = check_number(iou, "iou", above=0, high=1)
    _check_tracks(predictions, "predictions", keys)
    _check_tracks(labels, "labels", keys)
    matched = _match_tracks(predictions, labels, keys, min_iou, ignored_as_regions)

    overlaps = [overlap for frame in matched for *_, overlap in frame.pairs]
    found_rows = [row for frame in matched for _, row, _ in frame.pairs]
    false_rows = [row for frame in matched for row in frame.false]
    tp, fp, fn = len(found_rows), len(false_rows), sum(len(frame.missed) for frame in matched)
    # The tracks that matched each vehicle, frame by frame; None where it was missed.
    histories: dict[int, list[int | None]] = defaultdict(list)
    for frame in matched:
        for target, row, _ in frame.pairs:
            histories[int(labels["track_id"][target])].append(int(predictions["track_id"][row]))
        for target in frame.missed:
            histories[int(labels["track_id"][target])].append(None)
    switches = fragmentations = 0
    for history in histories.values():
        tracks = [track for track in history if track is not None]
        switches += sum(before != after for before, after in pairwise(tracks))
        found_runs = sum(found for found, _ in groupby(track is not None for track in history))
        fragmentations += max(found_runs - 1, 0)
    return TrackScores(
        frames=len(keys),
        iou=min_iou,
        vehicles=len(histories),
        tracks=len(np.unique(predictions["track_id"][found_rows + false_rows])),
        ignored=sum(frame.ignored for frame in matched),
        mean_iou=mean(overlaps),
        jitter=_jitter(predictions, labels, matched),
        mota=1 - ratio(fn + fp + switches, tp + fn),
        **hota_scores([_overlaps(predictions, labels, frame) for frame in matched]),
        idf1=ratio(2 * _identity_true_positives(matched), 2 * tp + fp + fn),
        id_switches=switches,
        fragmentations=fragmentations,
        longest_false_positive_run=_longest_false_run(predictions, matched),
        **rates(tp, fp, fn),
    )


@dataclass(frozen=True)
class _MatchedFrame:
    """The matches of one frame, as row numbers of `labels` and `predictions`."""

    position: int  # consecutive frames differ by 1, others by more
    pairs: list[tuple[int, int, float]]  # label row, prediction row, IoU
    missed: list[int]  # label rows
    false: list[int]  # prediction rows
    ignored: int
    overlapping: list[tuple[int, int]]  # vehicle and track of every pair that overlaps enough, matched or not


def _overlaps(predictions: TrackTable, labels: TrackTable, frame: _MatchedFrame) -> Overlaps:
    """Collect the boxes of a frame that count."""
    targets = np.array(sorted([*(target for target, *_ in frame.pairs), *frame.missed]), np.intp)
    rows = np.array(sorted([*(row for _, row, _ in frame.pairs), *frame.false]), np.intp)
    iou = iou_matrix(labels.boxes[targets], predictions.boxes[rows])
    return Overlaps(labels["track_id"][targets], predictions["track_id"][rows], iou)


def _check_tracks(side: TrackTable, name: str, keys: list[FrameKey]) -> None:
    wanted = set(keys)
    for row in np.flatnonzero((side["track_id"] == NO_TRACK) & ~side["ignore"]).tolist():
        frame = side["frame"].tolist()[row]
        if frame in wanted:
            raise InvalidInputError(
                f"{name} must have a track for every box, row {row} in frame {frame!r} has none; "
                "score boxes without tracks with evaluate_detections"
            )


def _match_tracks(
    predictions: TrackTable,
    labels: TrackTable,
    keys: list[FrameKey],
    min_iou: float,
    ignored_as_regions: bool,
) -> list[_MatchedFrame]:
    """Match the frames in order, each vehicle with its last track where possible."""
    track_of: dict[int, int] = {}
    matched: list[_MatchedFrame] = []
    for key, position in zip(keys, _positions(keys)):
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~labels["ignore"][rows]]
        overlap = iou_matrix(labels.boxes[targets], predictions.boxes[here])
        vehicles, tracks = labels["track_id"][targets].tolist(), predictions["track_id"][here].tolist()

        kept: list[tuple[int, int]] = []
        for i, vehicle in enumerate(vehicles):
            j = tracks.index(track_of[vehicle]) if track_of.get(vehicle) in tracks else -1
            # If two vehicles had the same track last, the first row takes it, as in motmetrics.
            if j >= 0 and overlap[i, j] >= min_iou and all(j != taken for _, taken in kept):
                kept.append((i, j))
        pairs = kept + _assign_rest(overlap, kept, min_iou)
        track_of.update((vehicles[i], tracks[j]) for i, j in pairs)

        rest = np.delete(here, [j for _, j in pairs])
        ignored = find_ignored(predictions.boxes[rest], labels, rows, min_iou, as_regions=ignored_as_regions)
        dropped = set(rest[ignored].tolist())
        close = np.argwhere(overlap >= min_iou)
        matched.append(
            _MatchedFrame(
                position,
                [(int(targets[i]), int(here[j]), float(overlap[i, j])) for i, j in pairs],
                np.delete(targets, [i for i, _ in pairs]).tolist(),
                rest[~ignored].tolist(),
                len(dropped),
                [(vehicles[i], tracks[j]) for i, j in close if here[j] not in dropped],
            )
        )
    return matched


def _positions(keys: list[FrameKey]) -> list[int]:
    """Assign positions to frames: consecutive ones differ by 1, others by more."""
    numbers = [key if isinstance(key, int) else index for index, key in enumerate(keys)]
    steps = [after - before for before, after in pairwise(numbers)]
    min_step = min(steps, default=1)
    return list(accumulate((1 if step == min_step else 2 for step in steps), initial=0))


def _assign_rest(
    overlap: NDArray[np.float64], kept: list[tuple[int, int]], min_iou: float
) -> list[tuple[int, int]]:
    """Assign the remaining rows: as many pairs as possible, then the largest total IoU."""
    from scipy.optimize import linear_sum_assignment

    allowed = overlap >= min_iou
    for i, j in kept:
        allowed[i], allowed[:, j] = False, False
    # A forbidden pair costs more than all allowed pairs together.
    chosen = linear_sum_assignment(np.where(allowed, 1 - overlap, 1.0 + min(overlap.shape)))
    return [(int(i), int(j)) for i, j in zip(*chosen) if allowed[i, j]]


def _identity_true_positives(matched: list[_MatchedFrame]) -> int:
    """Count the right boxes under the best one-to-one assignment of tracks to vehicles (IDTP).

    Vehicles and tracks that overlap in no frame, directly or through others, are assigned separately: a table
    of all of them grows with the square of the clip's length.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    counts = Counter(pair for frame in matched for pair in frame.overlapping)
    if not counts:
        return 0
    pairs, boxes = np.array([*counts], np.int64), np.array([*counts.values()], np.int64)
    vehicles, rows = np.unique(pairs[:, 0], return_inverse=True)
    tracks, columns = np.unique(pairs[:, 1], return_inverse=True)
    size = len(vehicles) + len(tracks)
    graph = coo_array((boxes, (rows, columns + len(vehicles))), shape=(size, size))
    _, groups = connected_components(graph, directed=False)
    order = np.argsort(groups[rows], kind="stable")
    total = 0
    for group in np.split(order, np.flatnonzero(np.diff(groups[rows][order])) + 1):
        (_, i), (_, j) = (np.unique(each[group], return_inverse=True) for each in (rows, columns))
        table = np.zeros((i.max() + 1, j.max() + 1), np.int64)
        table[i, j] = boxes[group]
        total += int(table[linear_sum_assignment(table, maximize=True)].sum())
    return total


def _jitter(predictions: TrackTable, labels: TrackTable, matched: list[_MatchedFrame]) -> float:
    """Mean absolute change of the edge errors, over vehicles that are matched in two consecutive frames.

    Errors are followed by vehicle, so the jump to another track's box counts as jitter.
    """
    changes: list[NDArray[np.float64]] = []
    before: dict[int, tuple[int, NDArray[np.float64]]] = {}
    for frame in matched:
        for target, row, _ in frame.pairs:
            vehicle, error = int(labels["track_id"][target]), predictions.boxes[row] - labels.boxes[target]
            position, last = before.get(vehicle, (-2, error))
            if position == frame.position - 1:
                changes.append(np.abs(error - last))
            before[vehicle] = frame.position, error
    return mean(changes)


def _longest_false_run(predictions: TrackTable, matched: list[_MatchedFrame]) -> int:
    longest = 0
    runs: dict[int, tuple[int, int]] = {}
    for frame in matched:
        for track in predictions["track_id"][frame.false].tolist():
            position, length = runs.get(track, (-2, 0))
            runs[track] = frame.position, length + 1 if position == frame.position - 1 else 1
            longest = max(longest, runs[track][1])
    return longest
