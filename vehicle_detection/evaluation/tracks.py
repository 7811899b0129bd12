"""Tracks against labelled vehicles: CLEAR MOT, identity and steadiness."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.labels import NO_TRACK, FrameBoxes, FrameKey
from vehicle_detection.evaluation.matching import (
    Scores,
    as_lines,
    as_text,
    find_ignored,
    mean,
    prepare_sides,
    rates,
    ratio,
)


@dataclass(frozen=True)
class TrackScores(Scores):
    """What `evaluate_tracks` found.

    Attributes
    ----------
    frames
        Number of evaluated frames.
    iou
        Overlap from which a tracked box matches a vehicle.
    vehicles, tracks
        Number of labelled vehicles, and of predicted tracks with a box that counts.
    tp, fp, fn
        Boxes on a vehicle, boxes on none, vehicles without a box, each summed over the frames.
    ignored
        Boxes that are neither right nor wrong.
    precision, recall, f1
        Of the tracked boxes, as in `DetectionScores`.
    mean_iou
        Mean overlap of the matched pairs.
    jitter
        Mean change of a matched box's four edge errors from one frame to the next, in pixels.
    mota
        ``1 - (fn + fp + id_switches) / (tp + fn)``; at most 1, and below 0 if errors outnumber vehicles.
    idf1
        F1 of the boxes under the best one-to-one pairing of vehicles and tracks over the whole clip.
    id_switches
        Times a vehicle is matched by another track than the last one that matched it.
    fragmentations
        Times a vehicle is lost and found again.
    longest_false_positive_run
        Most evaluated frames in a row in which one track is on no vehicle and not on ignored ground.
    """

    frames: int
    iou: float
    vehicles: int
    tracks: int
    tp: int
    fp: int
    fn: int
    ignored: int
    precision: float
    recall: float
    f1: float
    mean_iou: float
    jitter: float
    mota: float
    idf1: float
    id_switches: int
    fragmentations: int
    longest_false_positive_run: int

    def summary(self) -> str:
        """Say the scores in a few aligned lines."""
        rows = {
            "MOTA": as_text(self.mota),
            "IDF1": as_text(self.idf1),
            "F1": f"{as_text(self.f1)} (precision {as_text(self.precision)}, recall {as_text(self.recall)})",
            "mean IoU": as_text(self.mean_iou),
            "jitter": f"{as_text(self.jitter)} px a frame",
            "identity switches": str(self.id_switches),
            "fragmentations": str(self.fragmentations),
            "longest false run": f"{self.longest_false_positive_run} frames",
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        title = (
            f"{self.tracks} tracks of {self.vehicles} vehicles in {self.frames} frames at IoU {self.iou:g}"
        )
        return as_lines(title, rows)


def evaluate_tracks(
    predictions: FrameBoxes, labels: FrameBoxes, *, iou: float = 0.5, frames: Sequence[FrameKey] | None = None
) -> TrackScores:
    """Score tracks against labels: CLEAR MOT, identity and steadiness.

    A vehicle keeps the track that it was matched with last, as long as they overlap enough; the others are
    paired for the greatest number of matches and, among those, the greatest overlap. The counts equal those
    of the package motmetrics.

    Parameters
    ----------
    predictions
        Tracked boxes, each with its track. Rows marked ``ignore`` are left out.
    labels
        True boxes, each with its track unless it is to be ignored.
    iou
        Overlap in (0, 1] from which a tracked box matches a vehicle, or covers an ignored box.
    frames
        All evaluated frames, as in `evaluate_detections`; names stay in the order they are given in.

    Returns
    -------
    TrackScores
        Counts and ratios. Frames follow each other where their numbers differ by the least difference
        that occurs, which is 1 unless only every n-th frame is labelled; named frames in their order.

    Raises
    ------
    InvalidInputError
        If a box has no track, and where `evaluate_detections` raises.

    Notes
    -----
    MOTA, switches and fragmentations: Bernardin and Stiefelhagen, "Evaluating multiple object tracking
    performance: the CLEAR MOT metrics", 2008. IDF1: Ristani et al., "Performance measures and a data set
    for multi-target, multi-camera tracking", 2016. Ignored boxes are taken out before anything is counted.

    Examples
    --------
    >>> labels = Labels([0, 1, 2], [1, 1, 1], [[0, 0, 50, 40], [4, 0, 54, 40], [8, 0, 58, 40]])
    >>> found = Labels([0, 1, 2], [7, 7, 8], [[0, 0, 50, 40], [5, 0, 55, 40], [9, 0, 59, 40]])
    >>> scores = evaluate_tracks(found, labels)
    >>> scores.id_switches, round(scores.mota, 3), scores.jitter
    (1, 0.667, 0.25)
    """
    predictions, labels, keys = prepare_sides(predictions, labels, frames)
    limit = check_number(iou, "iou", above=0, high=1)
    _check_tracks(predictions, "predictions", keys)
    _check_tracks(labels, "labels", keys)
    followed = _follow(predictions, labels, keys, limit)

    overlaps = [overlap for frame in followed for *_, overlap in frame.pairs]
    histories = _histories(predictions, labels, followed)
    false_rows = [row for frame in followed for row in frame.false]
    fn = sum(len(frame.missed) for frame in followed)
    tp, fp, fn, precision, recall, f1 = rates(len(overlaps), len(false_rows), fn)
    switches = sum(_count_switches(history) for history in histories.values())
    counted = [*false_rows, *(row for frame in followed for _, row, _ in frame.pairs)]
    return TrackScores(
        frames=len(keys),
        iou=limit,
        vehicles=len(histories),
        tracks=len(np.unique(predictions.tracks[counted])),
        tp=tp,
        fp=fp,
        fn=fn,
        ignored=sum(frame.ignored for frame in followed),
        precision=precision,
        recall=recall,
        f1=f1,
        mean_iou=mean(overlaps),
        jitter=_jitter(predictions, labels, followed),
        mota=1 - ratio(fn + fp + switches, tp + fn),
        idf1=ratio(2 * _identity_hits(followed), 2 * tp + fp + fn),
        id_switches=switches,
        fragmentations=sum(_count_fragmentations(history) for history in histories.values()),
        longest_false_positive_run=_longest_false_run(predictions, followed),
    )


@dataclass(frozen=True)
class _Frame:
    """What became of one frame's boxes: rows of `labels` and `predictions`.

    `tick` counts evaluated frames, one more where frames are missing; `together` lists every vehicle and
    track that overlap enough, matched or not.
    """

    tick: int
    pairs: list[tuple[int, int, float]]
    missed: list[int]
    false: list[int]
    ignored: int
    together: list[tuple[int, int]]


# The tracks that matched a vehicle, frame by frame; None where it was missed.
_History = list[int | None]


def _check_tracks(side: FrameBoxes, name: str, keys: list[FrameKey]) -> None:
    wanted = set(keys)
    for row in np.flatnonzero((side.tracks == NO_TRACK) & ~side.ignore).tolist():
        if side.frames[row] in wanted:
            raise InvalidInputError(
                f"{name} must have a track for every box, row {row} in frame {side.frames[row]!r} has none; "
                "boxes without tracks are for evaluate_detections"
            )


def _follow(predictions: FrameBoxes, labels: FrameBoxes, keys: list[FrameKey], limit: float) -> list[_Frame]:
    """Match the frames in order, each vehicle with its last track if it can."""
    track_of: dict[int, int] = {}
    followed: list[_Frame] = []
    for key, tick in zip(keys, _ticks(keys)):
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~labels.ignore[rows]]
        overlap = iou_matrix(labels.boxes[targets], predictions.boxes[here])
        vehicles, tracks = labels.tracks[targets].tolist(), predictions.tracks[here].tolist()

        kept: list[tuple[int, int]] = []
        for i, vehicle in enumerate(vehicles):
            j = tracks.index(track_of[vehicle]) if track_of.get(vehicle) in tracks else -1
            # Two vehicles may have had the same track last: the first row takes it, as in motmetrics.
            if j >= 0 and overlap[i, j] >= limit and all(j != taken for _, taken in kept):
                kept.append((i, j))
        pairs = kept + _pair_rest(overlap, kept, limit)
        track_of.update((vehicles[i], tracks[j]) for i, j in pairs)

        rest = np.delete(here, [j for _, j in pairs])
        ignored = find_ignored(predictions.boxes[rest], labels, rows, limit)
        out = set(rest[ignored].tolist())
        followed.append(
            _Frame(
                tick,
                [(int(targets[i]), int(here[j]), float(overlap[i, j])) for i, j in pairs],
                np.delete(targets, [i for i, _ in pairs]).tolist(),
                rest[~ignored].tolist(),
                len(out),
                [(vehicles[i], tracks[j]) for i, j in np.argwhere(overlap >= limit) if here[j] not in out],
            )
        )
    return followed


def _ticks(keys: list[FrameKey]) -> list[int]:
    """Count frames so that those which follow each other differ by 1, and others by more."""
    numbers = [key for key in keys if isinstance(key, int)]
    if not numbers:
        return list(range(len(keys)))
    steps = [after - before for before, after in pairwise(numbers)]
    least = min(steps, default=1)
    return list(accumulate((1 if step == least else 2 for step in steps), initial=0))


def _pair_rest(
    overlap: NDArray[np.float64], kept: list[tuple[int, int]], limit: float
) -> list[tuple[int, int]]:
    """Pair what is left: as many as possible, then with the greatest overlap."""
    from scipy.optimize import linear_sum_assignment

    allowed = overlap >= limit
    for i, j in kept:
        allowed[i], allowed[:, j] = False, False
    # One forbidden pair costs more than all allowed pairs together.
    chosen = linear_sum_assignment(np.where(allowed, 1 - overlap, 1.0 + min(overlap.shape)))
    return [(int(i), int(j)) for i, j in zip(*chosen) if allowed[i, j]]


def _histories(predictions: FrameBoxes, labels: FrameBoxes, followed: list[_Frame]) -> dict[int, _History]:
    """Each labelled vehicle's frames in order."""
    histories: dict[int, _History] = defaultdict(list)
    for frame in followed:
        for target, row, _ in frame.pairs:
            histories[int(labels.tracks[target])].append(int(predictions.tracks[row]))
        for target in frame.missed:
            histories[int(labels.tracks[target])].append(None)
    return histories


def _count_switches(history: _History) -> int:
    tracks = [track for track in history if track is not None]
    return sum(before != after for before, after in pairwise(tracks))


def _count_fragmentations(history: _History) -> int:
    found = [track is not None for track in history]
    again = sum(not before and after for before, after in pairwise(found))
    return again - (any(found) and not found[0])


def _identity_hits(followed: list[_Frame]) -> int:
    """Boxes right under the best one-to-one pairing of vehicles and tracks."""
    from scipy.optimize import linear_sum_assignment

    counts = Counter(pair for frame in followed for pair in frame.together)
    vehicles = {vehicle: index for index, vehicle in enumerate(sorted({v for v, _ in counts}))}
    tracks = {track: index for index, track in enumerate(sorted({t for _, t in counts}))}
    table = np.zeros((len(vehicles), len(tracks)))
    for (vehicle, track), count in counts.items():
        table[vehicles[vehicle], tracks[track]] = count
    return int(table[linear_sum_assignment(table, maximize=True)].sum())


def _jitter(predictions: FrameBoxes, labels: FrameBoxes, followed: list[_Frame]) -> float:
    """Mean absolute change of the edge errors, over vehicles that are matched in two frames in a row.

    It goes by vehicle: a jump that comes with another track's box is jitter as well.
    """
    changes: list[NDArray[np.float64]] = []
    before: dict[int, tuple[int, NDArray[np.float64]]] = {}
    for frame in followed:
        for target, row, _ in frame.pairs:
            vehicle, error = int(labels.tracks[target]), predictions.boxes[row] - labels.boxes[target]
            tick, last = before.get(vehicle, (-2, error))
            if tick == frame.tick - 1:
                changes.append(np.abs(error - last))
            before[vehicle] = frame.tick, error
    return mean(changes)


def _longest_false_run(predictions: FrameBoxes, followed: list[_Frame]) -> int:
    longest = 0
    runs: dict[int, tuple[int, int]] = {}
    for frame in followed:
        for track in predictions.tracks[frame.false].tolist():
            tick, length = runs.get(track, (-2, 0))
            runs[track] = frame.tick, length + 1 if tick == frame.tick - 1 else 1
            longest = max(longest, runs[track][1])
    return longest
