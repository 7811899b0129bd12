"""Score stated distances and speeds, and their standard errors, against measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection.evaluation.detections import Scores, format_number, format_summary, ratio
from vehicle_detection.evaluation.matching import match_detections, prepare_evaluation
from vehicle_detection.tables import FrameKey, TrackTable

# Ranges of the true distance (m), and times to collision (s) that are scored.
_RANGES, _COLLISION_TIMES = (0.0, 5.0, 10.0, 20.0, 40.0, 80.0), (1.0, 15.0)


@dataclass(frozen=True)
class ErrorScores(Scores):
    """Errors of one quantity: relative ones of distances and times, those in m/s of speeds.

    Attributes
    ----------
    known, stated
        Number of matched boxes whose true value is known, and for how many of them a value is stated.
    error, bias
        Median absolute error, and median error: above 0 where the stated values are too large.
    within_1_std, within_2_std
        Fractions of the errors that are at most one and two stated standard errors; 0.68 and 0.95 if these
        are right.
    """

    known: int
    stated: int
    error: float
    bias: float
    within_1_std: float
    within_2_std: float

    def summary(self) -> str:
        """Return the scores as one line."""
        within = " / ".join(map(format_number, (self.within_1_std, self.within_2_std)))
        bias = "n/a" if np.isnan(self.bias) else f"{self.bias:+.3f}"
        return (
            f"error {format_number(self.error)}, bias {bias}, within 1 / 2 std {within}, "
            f"stated {self.stated} of {self.known}"
        )


@dataclass(frozen=True)
class DistanceScores(Scores):
    """Result of `evaluate_distances`.

    Attributes
    ----------
    distances
        By range of the true distance (``"10-20 m"``), for vehicles that the frame's edge does not cut; those
        that it cuts are ``"cut, 0-5 m"`` and so on.
    speeds, collision_times
        Relative speeds, and times to collision (distance over closing speed) that truly are 1 to 15 s.

    Examples
    --------
    >>> boxes = TrackTable([0], [1], [[10, 10, 60, 50]], distance_m=[15.0], distance_std_m=[1.0])
    >>> evaluate_distances(boxes, boxes).distances["10-20 m"].within_2_std
    1.0
    """

    distances: dict[str, ErrorScores]
    speeds: ErrorScores
    collision_times: ErrorScores

    def summary(self) -> str:
        """Return the scores as a few aligned lines."""
        rows = {"speed, m/s": self.speeds, "time to collision": self.collision_times}
        lines = {f"distance, {name}": row for name, row in self.distances.items()} | rows
        texts = {name: row.summary() for name, row in lines.items() if row.known}
        return format_summary("distances and speeds", texts or {"none": "no matched box has a true distance"})


def evaluate_distances(
    predictions: TrackTable,
    labels: TrackTable,
    *,
    iou: float = 0.5,
    frames: Sequence[FrameKey] | None = None,
) -> DistanceScores:
    """Score the distances and speeds of tracks against measured ones.

    Boxes are matched as in `evaluate_detections`. A vehicle counts once in each frame in which it is matched,
    whether its box is scored there or not.

    Parameters
    ----------
    predictions
        Tracks with the columns ``distance_m``, ``distance_std_m``, ``speed_mps`` and ``speed_std_mps``.
    labels
        True boxes with ``distance_m`` and, where known, ``speed_mps``.
    iou, frames
        As in `evaluate_detections`.

    Examples
    --------
    >>> boxes = [[10, 10, 60, 50], [100, 20, 140, 60]]
    >>> labels = TrackTable([0, 0], [1, 2], boxes, distance_m=[20.0, 30.0])
    >>> found = TrackTable([0, 0], [1, 2], boxes, distance_m=[21.0, 28.5], distance_std_m=[2.0, 1.0])
    >>> print(evaluate_distances(found, labels))
    distances and speeds
      distance, 20-40 m  error 0.050, bias +0.000, within 1 / 2 std 0.500 / 1.000, stated 2 of 2
    """
    min_iou = check.number(iou, "iou", above=0, high=1)
    predictions, labels, keys = prepare_evaluation(predictions, labels, frames)
    scored = TrackTable(
        labels["frame"].tolist(), labels["track_id"], labels.boxes, ignore=np.zeros(len(labels), bool)
    )
    match = match_detections(predictions, scored, keys, min_iou).match
    rows = match[match >= 0]
    found = predictions[match >= 0]
    true, true_speed = labels["distance_m"][rows], labels["speed_mps"][rows]
    true[true <= 0] = np.nan  # beside or behind the camera: no relative error, no collision
    cut = labels["truncated"][rows] > 0
    relative = found["distance_m"] / true - 1
    std = found["distance_std_m"] / true
    distances = {}
    for start, end in pairwise(_RANGES):
        here = (true >= start) & (true < end)
        for name, chosen in (("", ~cut), ("cut, ", cut)):
            distances[f"{name}{start:.0f}-{end:.0f} m"] = _score(relative, std, here & chosen)
    speed = found["speed_mps"]
    with np.errstate(divide="ignore", invalid="ignore"):
        true_time = true / -true_speed
        times = found["distance_m"] / -speed / true_time - 1
    times[~(speed < 0)] = np.nan
    scored_times = (true_time > _COLLISION_TIMES[0]) & (true_time < _COLLISION_TIMES[1])
    return DistanceScores(
        distances,
        _score(speed - true_speed, found["speed_std_mps"], np.isfinite(true_speed)),
        _score(times, np.full(len(times), np.nan), scored_times),
    )


def _score(errors: NDArray[np.float64], std: NDArray[np.float64], chosen: NDArray[np.bool_]) -> ErrorScores:
    """Summarize the `chosen` errors, ``(N,)`` each; NaN where nothing is stated."""
    stated = chosen & np.isfinite(errors)
    known_std = stated & np.isfinite(std)
    size = np.abs(errors)
    return ErrorScores(
        known=int(chosen.sum()),
        stated=int(stated.sum()),
        error=float(np.median(size[stated])) if stated.any() else float("nan"),
        bias=float(np.median(errors[stated])) if stated.any() else float("nan"),
        within_1_std=ratio(float((size <= std)[known_std].sum()), int(known_std.sum())),
        within_2_std=ratio(float((size <= 2 * std)[known_std].sum()), int(known_std.sum())),
    )
