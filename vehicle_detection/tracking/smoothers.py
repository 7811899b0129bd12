"""The smoothers of the course's systems, with the same methods as `KalmanSmoother`.

They have no motion model: a box stays where it is until the next detection, and the velocity is a moving
average of its displacements.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehicle_detection._common import Floats
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.tracking.association import center_distances, match_boxes
from vehicle_detection.tracking.kalman import (
    Bools,
    KalmanSmoother,
    KalmanStates,
    Measurements,
    centers_and_sizes,
    initiate,
)
from vehicle_detection.tracking.track import TrackParams, TrackState


class HistorySmoother:
    """Weighted mean of the boxes of the last `history_seconds` (the course's second system)."""

    match = staticmethod(match_boxes)

    def __init__(self, params: TrackParams) -> None:
        self._params = params

    def initiate(self, measured: Measurements) -> tuple[Floats, Floats]:
        """Means ``(N, 8)`` and covariances ``(N, 8, 8)`` of new tracks."""
        sides = measured.boxes[:, 2:] - measured.boxes[:, :2]
        return initiate(measured.boxes, np.tile(sides, 2) * self._params.measurement_noise)

    def predict(self, states: KalmanStates, coasting: Bools, dt: float) -> KalmanStates:
        """Leave the boxes where they are."""
        return states

    def correct(
        self, states: KalmanStates, tracks: Sequence[TrackState], measured: Measurements, dt: float
    ) -> KalmanStates:
        """Correct the boxes of tracks by a measurement each; truncated and merged boxes count like others."""
        before, velocity = states.mean[:, :4], states.mean[:, 4:]
        rows = zip(tracks, before, centers_and_sizes(measured.boxes))
        after = np.stack([self._smooth(track, old, new, dt) for track, old, new in rows])
        seconds = np.array([[dt + track.last_gap] for track in tracks])  # since the boxes `before`
        decay = np.exp(-seconds / self._params.score_time_constant)
        velocity = decay * velocity + (1 - decay) * (after - before) / seconds
        return states._replace(mean=np.concatenate((after, velocity), axis=1))

    def _smooth(self, track: TrackState, before: Floats, measured: Floats, dt: float) -> Floats:
        """Center and size of one track after a detection, ``(4,)``."""
        length, past = self._params.history_seconds, track.past_boxes
        past = past or [(0.0, before)]  # the first detection
        past = [(age, state) for age, state in (*past, (track.age, measured)) if age >= track.age - length]
        track.past_boxes = past
        weights = [1.0 - (track.age - age) / (length + dt) for age, _ in past]
        return np.average([state for _, state in past], axis=0, weights=weights)


class NearestSmoother(HistorySmoother):
    """Moves each box a fraction of the way to the nearest detection (the course's first system)."""

    @staticmethod
    def match(
        predicted: Floats, measured: Floats, max_distance: Floats, min_iou: float = 0.0
    ) -> list[tuple[int, int]]:
        """Pairs of indices with at least this IoU, by the distance of the centers alone, nearest first."""
        pairs: list[tuple[int, int]] = []
        distance = center_distances(predicted, measured) / max_distance[:, None]
        distance[iou_matrix(predicted, measured) < min_iou] = np.inf
        for flat in np.argsort(distance, axis=None, kind="stable"):
            row, column = divmod(int(flat), len(measured))
            if distance[row, column] <= 1 and all(row != r and column != c for r, c in pairs):
                pairs.append((row, column))
        return pairs

    def _smooth(self, track: TrackState, before: Floats, measured: Floats, dt: float) -> Floats:
        fraction = 1 - (1 - self._params.nearest_weight) ** (dt / 0.04)
        return np.asarray(before + fraction * (measured - before))


Smoother = KalmanSmoother | HistorySmoother


def make_smoother(params: TrackParams) -> Smoother:
    """Return the smoother that `params` name."""
    if params.smoother == "kalman":
        return KalmanSmoother(params)
    return HistorySmoother(params) if params.smoother == "history" else NearestSmoother(params)
