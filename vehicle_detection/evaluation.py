"""Detections and tracks against labelled frames: how many are found, how well they fit, who stays who.

The boxes of `Labels` marked ``ignore`` are not scored, and a prediction on them is neither right nor wrong:
one whose centre lies in a region (``ignore`` with track -1), or that covers an ignored box at the IoU in
use. Usable boxes are matched first, so an ignore region over a vehicle does not take its detection away.

A ratio with nothing to count is NaN: ``n/a`` in a summary, None in ``to_dict``.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._checks import check_integer, check_number, describe
from vehicle_detection._labels import NO_TRACK, FrameKey, Labels, check_keys, frame_order, read_labels
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError

__all__ = [
    "DetectionScores",
    "Labels",
    "SizeScores",
    "TrackScores",
    "calibration_error",
    "evaluate_detections",
    "evaluate_tracks",
    "precision_recall_curve",
    "read_labels",
]

SIZES = {"small": (0.0, 64.0), "medium": (64.0, 128.0), "large": (128.0, math.inf)}
"""Half-open ranges of box width in pixels."""


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _mean(values: ArrayLike) -> float:
    array = np.asarray(values, np.float64)
    return float(array.mean()) if array.size else math.nan


def _plain(value: Any) -> Any:
    """Turn NaN into None, at any depth: JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def _text(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return "n/a" if math.isnan(value) else f"{value:.3f}"


def _lines(title: str, rows: dict[str, str]) -> str:
    width = max(map(len, rows))
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in rows.items())])


@dataclass(frozen=True)
class _Scores:
    """What both kinds of scores can do."""

    def summary(self) -> str:
        """Say the scores in a few aligned lines."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, ready for JSON; a ratio with nothing to count is None."""
        return {key: _plain(value) for key, value in dataclasses.asdict(self).items()}

    def __str__(self) -> str:
        return self.summary()


@dataclass(frozen=True)
class SizeScores:
    """Detection scores of one range of widths; the label's width counts, for a false box its own.

    Attributes
    ----------
    tp, fp, fn
        Vehicles found, false boxes, vehicles missed.
    precision, recall, f1, mean_iou
        As in `DetectionScores`.
    """

    tp: int
    fp: int
    fn: int
    precision: float
    recall: float
    f1: float
    mean_iou: float


@dataclass(frozen=True)
class DetectionScores(_Scores):
    """What `evaluate_detections` found.

    Attributes
    ----------
    frames
        Number of evaluated frames.
    iou
        Overlap from which a detection matches a vehicle.
    tp, fp, fn
        Vehicles found, false detections, vehicles missed.
    ignored
        Detections that are neither right nor wrong.
    precision, recall, f1
        ``tp / (tp + fp)``, ``tp / (tp + fn)`` and ``2 tp / (2 tp + fp + fn)``.
    average_precision
        Area under the precision-recall curve, precision made monotonic (PASCAL VOC from 2010 on).
    false_positives_per_frame
        ``fp / frames``.
    mean_iou
        Mean overlap of the matched pairs.
    by_size
        The same for ``"small"`` (under 64 px wide), ``"medium"`` (under 128 px) and ``"large"`` vehicles.
    """

    frames: int
    iou: float
    tp: int
    fp: int
    fn: int
    ignored: int
    precision: float
    recall: float
    f1: float
    average_precision: float
    false_positives_per_frame: float
    mean_iou: float
    by_size: dict[str, SizeScores]

    def summary(self) -> str:
        """Say the scores in a few aligned lines."""
        rows = {
            "F1": _text(self.f1),
            "precision": _text(self.precision),
            "recall": _text(self.recall),
            "average precision": _text(self.average_precision),
            "mean IoU": _text(self.mean_iou),
            "false a frame": _text(self.false_positives_per_frame),
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        for name, (low, high) in SIZES.items():
            size = self.by_size[name]
            reach = f"from {low:g} px" if high == math.inf else f"under {high:g} px"
            rows[f"{name}, {reach}"] = (
                f"F1 {_text(size.f1)}, {size.tp} of {size.tp + size.fn}, {size.fp} false"
            )
        return _lines(f"Detections in {self.frames} frames at IoU {self.iou:g}", rows)


@dataclass(frozen=True)
class TrackScores(_Scores):
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
            "MOTA": _text(self.mota),
            "IDF1": _text(self.idf1),
            "F1": f"{_text(self.f1)} (precision {_text(self.precision)}, recall {_text(self.recall)})",
            "mean IoU": _text(self.mean_iou),
            "jitter": f"{_text(self.jitter)} px a frame",
            "identity switches": str(self.id_switches),
            "fragmentations": str(self.fragmentations),
            "longest false run": f"{self.longest_false_positive_run} frames",
            "boxes": f"{self.tp} found, {self.fn} missed, {self.fp} false, {self.ignored} ignored",
        }
        title = (
            f"{self.tracks} tracks of {self.vehicles} vehicles in {self.frames} frames at IoU {self.iou:g}"
        )
        return _lines(title, rows)


def evaluate_detections(
    predictions: Labels, labels: Labels, *, iou: float = 0.5, frames: Sequence[FrameKey] | None = None
) -> DetectionScores:
    """Score detections against labels, each frame by itself.

    In every frame the detections choose in order of their score, each the vehicle it overlaps most among
    those still free, as in PASCAL VOC and COCO; equal scores choose in order of their best overlap.

    Parameters
    ----------
    predictions
        Detected boxes; their tracks do not matter. Without scores all count as equally sure. Rows marked
        ``ignore`` are left out.
    labels
        True boxes.
    iou
        Overlap in (0, 1] from which a detection matches a vehicle, or covers an ignored box.
    frames
        All evaluated frames, so that those without label and prediction count too. Labels in other frames
        are left out. None takes all frames that `predictions` or `labels` know of.

    Returns
    -------
    DetectionScores
        Counts and ratios, in all and by size.

    Raises
    ------
    InvalidInputError
        If an argument is no `Labels`, `iou` is out of range, a prediction is in none of the `frames`, or
        predictions and labels name their frames differently.

    Examples
    --------
    >>> labels = Labels([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = Labels([0, 0], None, [[1, 0, 51, 40], [400, 0, 450, 40]], scores=[2.0, 0.5])
    >>> scores = evaluate_detections(found, labels)
    >>> scores.precision, scores.recall, scores.average_precision
    (0.5, 0.5, 0.5)
    """
    predictions, labels, keys = _prepare(predictions, labels, frames)
    limit = check_number(iou, "iou", above=0, high=1)
    found = _match(predictions, labels, keys, limit)
    hit, false = found.partner >= 0, (found.partner < 0) & ~found.neutral
    missed = np.setdiff1d(found.usable, found.partner)

    true_widths = _widths(labels)
    by_size = {}
    for name, (low, high) in SIZES.items():
        widths = true_widths[found.partner[hit]], _widths(predictions)[false], true_widths[missed]
        tp, fp, fn = ((low <= width) & (width < high) for width in widths)
        by_size[name] = SizeScores(
            *_rates(int(tp.sum()), int(fp.sum()), int(fn.sum())), _mean(found.overlap[hit][tp])
        )
    tp_all, fp_all, fn_all, precision, recall, f1 = _rates(int(hit.sum()), int(false.sum()), len(missed))
    return DetectionScores(
        frames=len(keys),
        iou=limit,
        tp=tp_all,
        fp=fp_all,
        fn=fn_all,
        ignored=int(found.neutral.sum()),
        precision=precision,
        recall=recall,
        f1=f1,
        average_precision=_average_precision(*_curve(predictions, found)[:2]),
        false_positives_per_frame=_ratio(fp_all, len(keys)),
        mean_iou=_mean(found.overlap[hit]),
        by_size=by_size,
    )


def precision_recall_curve(
    predictions: Labels, labels: Labels, *, iou: float = 0.5
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision and recall for every threshold on the detections' scores.

    Parameters
    ----------
    predictions
        Detected boxes with scores.
    labels
        True boxes.
    iou
        Overlap in (0, 1] from which a detection matches a vehicle.

    Returns
    -------
    precision, recall, thresholds : numpy.ndarray
        Three ``(K,)`` float64 arrays, one entry for each score that occurs, highest first: what the
        detections with a score of at least ``thresholds[k]`` reach. Recall never falls along them; it is
        NaN where no vehicle is labelled.

    Raises
    ------
    InvalidInputError
        If predictions have no scores, and where `evaluate_detections` does.

    Examples
    --------
    >>> labels = Labels([0, 0], [1, 2], [[0, 0, 50, 40], [200, 0, 290, 60]])
    >>> found = Labels([0, 0], None, [[0, 0, 50, 40], [400, 0, 450, 40]], scores=[2.0, 0.5])
    >>> precision_recall_curve(found, labels)
    (array([1. , 0.5]), array([0.5, 0.5]), array([2. , 0.5]))
    """
    predictions, labels, keys = _prepare(predictions, labels, None)
    if len(predictions) and predictions.scores is None:
        raise InvalidInputError("predictions need scores for a curve; pass Labels with scores=")
    limit = check_number(iou, "iou", above=0, high=1)
    return _curve(predictions, _match(predictions, labels, keys, limit))


def evaluate_tracks(
    predictions: Labels, labels: Labels, *, iou: float = 0.5, frames: Sequence[FrameKey] | None = None
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
    predictions, labels, keys = _prepare(predictions, labels, frames)
    limit = check_number(iou, "iou", above=0, high=1)
    _check_tracks(predictions, "predictions", keys)
    _check_tracks(labels, "labels", keys)
    followed = _follow(predictions, labels, keys, limit)

    overlaps = [overlap for frame in followed for *_, overlap in frame.pairs]
    histories = _histories(labels, followed)
    false_rows = [row for frame in followed for row in frame.false]
    fn = sum(partner is None for history in histories.values() for partner in history)
    tp, fp, fn, precision, recall, f1 = _rates(len(overlaps), len(false_rows), fn)
    switches = sum(_count_switches(predictions, history) for history in histories.values())
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
        mean_iou=_mean(overlaps),
        jitter=_jitter(predictions, labels, followed),
        mota=1 - _ratio(fn + fp + switches, tp + fn),
        idf1=_ratio(2 * _identity_hits(followed), 2 * tp + fp + fn),
        id_switches=switches,
        fragmentations=sum(_count_fragmentations(history) for history in histories.values()),
        longest_false_positive_run=_longest_false_run(predictions, followed),
    )


def calibration_error(probabilities: ArrayLike, labels: ArrayLike, *, bins: int = 15) -> float:
    """Measure how far probabilities are from the share of vehicles among them: the ECE.

    The expected calibration error is the sum over `bins` equal bins of ``|mean label - mean probability|``,
    weighted by the bin's share of the samples (Naeini et al., "Obtaining well calibrated probabilities
    using Bayesian binning", 2015).

    Parameters
    ----------
    probabilities
        ``(N,)`` probabilities of a vehicle, in [0, 1].
    labels
        ``(N,)`` truth, 0 or 1 or bool.
    bins
        Number of bins over [0, 1].

    Returns
    -------
    float
        In [0, 1]; 0 is perfect.

    Raises
    ------
    InvalidInputError
        If the arrays are empty, differ in length, or hold other values.

    Examples
    --------
    >>> round(calibration_error([0.9, 0.9, 0.1, 0.1], [1, 1, 0, 1]), 3)
    0.25
    """
    shares, truth = np.asarray(probabilities), np.asarray(labels)
    inside = shares.dtype.kind in "iuf" and bool(((shares >= 0) & (shares <= 1)).all())
    if shares.ndim != 1 or not shares.size or not inside:
        raise InvalidInputError(
            f"probabilities must be a one-dimensional array of numbers from 0 to 1, got {describe(shares)}; "
            "a decision value becomes one by the classifier's calibration"
        )
    if truth.shape != shares.shape or not np.isin(truth, (0, 1)).all():
        raise InvalidInputError(
            f"labels must be 0 or 1 for each of the {len(shares)} probabilities, got {describe(truth)}; "
            "labels of -1 and 1 convert with labels > 0"
        )
    count = check_integer(bins, "bins", low=1)
    chosen = np.minimum((shares * count).astype(np.intp), count - 1)
    gaps = np.bincount(chosen, weights=truth.astype(np.float64) - shares, minlength=count)
    return float(np.abs(gaps).sum() / len(shares))


def _prepare(
    predictions: object, labels: object, frames: Sequence[FrameKey] | None
) -> tuple[Labels, Labels, list[FrameKey]]:
    """Check both sides, drop predictions that are to be ignored, and list the frames in order."""
    for name, side in (("predictions", predictions), ("labels", labels)):
        if not isinstance(side, Labels):
            raise InvalidInputError(
                f"{name} must be Labels, got {describe(side)}; read a file with read_labels or convert the "
                "Detections of each frame with Labels.from_detections"
            )
    assert isinstance(predictions, Labels)
    assert isinstance(labels, Labels)
    predictions = predictions[~predictions.ignore]
    given = None if frames is None else check_keys(frames, "frames")
    sides = {"predictions": predictions.frame_keys, "labels": labels.frame_keys, "frames": given or ()}
    first = {name: keys[0] for name, keys in sides.items() if keys}
    if len({type(key) for key in first.values()}) > 1:
        listed = ", ".join(f"{key!r} in {name}" for name, key in first.items())
        raise InvalidInputError(
            f"frames must go by numbers or by names throughout, got {listed}; convert with Labels.renamed"
        )
    if given is not None:
        return predictions, labels, _given_frames(predictions, given)
    # Without a frame in common, names that differ by folder or suffix alone are a slip, not a result of 0.
    ours, theirs = set(predictions.frames), set(labels.frames)
    if not ours & theirs:
        stems = [{PurePosixPath(key).stem for key in side if isinstance(key, str)} for side in (ours, theirs)]
        if stems[0] & stems[1]:
            raise InvalidInputError(
                f"predictions and labels name their frames differently: {predictions.frames[0]!r} and "
                f"{labels.frames[0]!r}; convert with Labels.renamed"
            )
    return predictions, labels, sorted({*predictions.frame_keys, *labels.frame_keys}, key=frame_order)


def _given_frames(predictions: Labels, frames: tuple[FrameKey, ...]) -> list[FrameKey]:
    known = set(frames)
    if len(known) < len(frames):
        twice = next(key for key, count in Counter(frames).items() if count > 1)
        raise InvalidInputError(f"frames must differ, got {twice!r} more than once; list each frame once")
    unknown = next((key for key in predictions.frames if key not in known), None)
    if unknown is not None:
        raise InvalidInputError(
            f"predictions hold frame {unknown!r}, which is not among the {len(frames)} frames; add it to "
            "frames or drop these predictions"
        )
    return sorted(frames, key=frame_order) if frames and isinstance(frames[0], int) else list(frames)


def _rates(tp: int, fp: int, fn: int) -> tuple[int, int, int, float, float, float]:
    """Put precision, recall and F1 beside the counts."""
    return tp, fp, fn, _ratio(tp, tp + fp), _ratio(tp, tp + fn), _ratio(2 * tp, 2 * tp + fp + fn)


def _widths(labels: Labels) -> NDArray[np.float64]:
    return labels.boxes[:, 2] - labels.boxes[:, 0]


def _is_neutral(
    boxes: NDArray[np.float64], labels: Labels, rows: NDArray[np.intp], limit: float
) -> NDArray[np.bool_]:
    """Whether each box lies with its centre in a region, or covers an ignored box, of the label `rows`."""
    ignored = rows[labels.ignore[rows]]
    regions = labels.boxes[ignored[labels.tracks[ignored] == NO_TRACK]]
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    inside = (regions[:, :2] <= centre[:, None]) & (centre[:, None] < regions[:, 2:])
    covers = iou_matrix(boxes, labels.boxes[ignored]) >= limit
    return np.asarray(inside.all(axis=2).any(axis=1) | covers.any(axis=1))


@dataclass(frozen=True)
class _Matching:
    """Every prediction's fate: the label row it found (else -1) and their overlap, or whether it is neutral.

    `usable` lists the label rows that are scored.
    """

    partner: NDArray[np.intp]
    overlap: NDArray[np.float64]
    neutral: NDArray[np.bool_]
    usable: NDArray[np.intp]


def _match(predictions: Labels, labels: Labels, keys: list[FrameKey], limit: float) -> _Matching:
    """Match each frame greedily by score, then find what is neutral among the rest."""
    count = len(predictions)
    scores = np.zeros(count) if predictions.scores is None else predictions.scores
    partner, overlap, neutral = np.full(count, -1, np.intp), np.zeros(count), np.zeros(count, np.bool_)
    usable: list[int] = []
    for key in keys:
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~labels.ignore[rows]]
        usable += targets.tolist()
        overlaps = iou_matrix(predictions.boxes[here], labels.boxes[targets])
        best = overlaps.max(axis=1, initial=0)
        for index in np.lexsort((-best, -scores[here])) if len(targets) else ():
            target = int(np.argmax(overlaps[index]))
            if overlaps[index, target] >= limit:
                partner[here[index]], overlap[here[index]] = targets[target], overlaps[index, target]
                overlaps[:, target] = -1
        rest = here[partner[here] < 0]
        neutral[rest] = _is_neutral(predictions.boxes[rest], labels, rows, limit)
    return _Matching(partner, overlap, neutral, np.array(usable, np.intp))


def _curve(
    predictions: Labels, found: _Matching
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Precision, recall and threshold for every distinct score, highest first.

    A greedy match depends on higher scores alone, so the match at a threshold is a prefix of the whole.
    """
    counted = np.flatnonzero(~found.neutral)
    scores = np.zeros(len(counted)) if predictions.scores is None else predictions.scores[counted]
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(found.partner[counted][order] >= 0)
    last = np.flatnonzero(np.diff(scores[order], append=-np.inf))
    recall = hits[last] / len(found.usable) if len(found.usable) else np.full(len(last), np.nan)
    return hits[last] / (last + 1), recall, scores[order][last]


def _average_precision(precision: NDArray[np.float64], recall: NDArray[np.float64]) -> float:
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(recall, prepend=0) * envelope).sum())


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


# The rows of the boxes that matched a vehicle, frame by frame; None where it was missed.
_History = list[int | None]


def _check_tracks(side: Labels, name: str, keys: list[FrameKey]) -> None:
    wanted = set(keys)
    for row in np.flatnonzero((side.tracks == NO_TRACK) & ~side.ignore).tolist():
        if side.frames[row] in wanted:
            raise InvalidInputError(
                f"{name} must have a track for every box, row {row} in frame {side.frames[row]!r} has none; "
                "boxes without tracks are for evaluate_detections"
            )


def _follow(predictions: Labels, labels: Labels, keys: list[FrameKey], limit: float) -> list[_Frame]:
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
        neutral = _is_neutral(predictions.boxes[rest], labels, rows, limit)
        out = set(rest[neutral].tolist())
        followed.append(
            _Frame(
                tick,
                [(int(targets[i]), int(here[j]), float(overlap[i, j])) for i, j in pairs],
                np.delete(targets, [i for i, _ in pairs]).tolist(),
                rest[~neutral].tolist(),
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


def _histories(labels: Labels, followed: list[_Frame]) -> dict[int, _History]:
    """Each labelled vehicle's frames in order."""
    histories: dict[int, _History] = defaultdict(list)
    for frame in followed:
        for target, row, _ in frame.pairs:
            histories[int(labels.tracks[target])].append(row)
        for target in frame.missed:
            histories[int(labels.tracks[target])].append(None)
    return histories


def _count_switches(predictions: Labels, history: _History) -> int:
    tracks = [int(predictions.tracks[row]) for row in history if row is not None]
    return sum(before != after for before, after in pairwise(tracks))


def _count_fragmentations(history: _History) -> int:
    found = [row is not None for row in history]
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


def _jitter(predictions: Labels, labels: Labels, followed: list[_Frame]) -> float:
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
    return _mean(changes)


def _longest_false_run(predictions: Labels, followed: list[_Frame]) -> int:
    longest = 0
    runs: dict[int, tuple[int, int]] = {}
    for frame in followed:
        for track in predictions.tracks[frame.false].tolist():
            tick, length = runs.get(track, (-2, 0))
            runs[track] = frame.tick, length + 1 if tick == frame.tick - 1 else 1
            longest = max(longest, runs[track][1])
    return longest
