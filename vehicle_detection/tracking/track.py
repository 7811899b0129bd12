"""A track: what users see of it after a frame, and the state of its life cycle inside the tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from vehicle_detection._common import Floats
from vehicle_detection.params import TrackParams

TIME_TOLERANCE = 1e-6
"""Float tolerance in seconds when comparing summed frame times with a limit."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """A vehicle with a constant identity, as estimated after one frame.

    Attributes
    ----------
    id
        Number of the vehicle, from 1 in order of confirmation; 0 while the track is tentative.
    box, velocity
        ``(4,)`` box inside the frame, read-only, and velocity of its center in pixels per second.
    score
        Exponential moving average of the detections' scores; a frame without a detection counts as 0.
    confidence
        Calibrated probability that the track shows a vehicle, in [0, 1]: that of the mean of its detections'
        scores, in which older ones weigh less. It stays while there are no detections.
    state, shown
        ``"tentative"`` (not confirmed yet), ``"confirmed"`` (detected in this frame) or ``"coasting"``
        (confirmed, but not detected in this frame: the box is a prediction); whether to draw the track.
    age, misses, time_since_update
        Seconds since the first detection, and frames and seconds since the last.
    key
        Number of the track from its first detection on, from 1; unlike `id` it is set while the track is
        tentative, and tracks that are never confirmed have one.
    distance_m, distance_std_m, speed_mps, speed_std_mps
        Distance along the road in meters, and speed relative to the camera in meters per second, positive
        when moving away, with their standard errors; None where they are unknown.
    """

    id: int
    box: Floats
    score: float
    state: Literal["tentative", "confirmed", "coasting"]
    shown: bool
    age: float
    misses: int
    time_since_update: float
    velocity: tuple[float, float]
    key: int = 0
    confidence: float | None = None
    distance_m: float | None = None
    distance_std_m: float | None = None
    speed_mps: float | None = None
    speed_std_mps: float | None = None


def weight_of(dt: float, params: TrackParams) -> float:
    """Weight of a frame in the exponential moving average of scores, `dt` seconds after the frame before."""
    return -math.expm1(-dt / params.score_time_constant)


@dataclass(eq=False, slots=True)
class TrackState:
    """Life cycle of a track; its Kalman states are a row of `KalmanStates`. Times are in seconds."""

    score: float
    weight: float = 1.0  # sum of the weights that the detections have in the score
    mean_score: float = field(init=False)  # mean of the detections' scores with these weights
    confirm_at_birth: bool = False  # whether its first detection suffices to confirm it
    key: int = 0
    id: int = 0
    hits: int = 1
    misses: int = 0  # since the last detection
    all_misses: int = 0
    age: float = 0.0
    time_since_update: float = 0.0
    last_gap: float = 0.0  # time without a detection before the last one
    unexplained_gap: float = 0.0  # time without a detection while no other vehicle hides it
    hidden_gap: float = 0.0  # time without a detection while another vehicle hides it
    coast_budget: float = 0.0  # time for which it is still shown without a detection
    covered_budget: float = 0.0  # time for which it is still shown while nothing of it is visible
    hidden: bool = False  # whether another vehicle explains the missing detection
    covered: float = 0.0  # fraction of its box that nearer vehicles cover
    lost: bool = False  # whether its predicted position is only a guess
    past_boxes: list[tuple[float, Floats]] = field(default_factory=list)  # for the smoother "history"

    def __post_init__(self) -> None:
        self.mean_score = self.score / self.weight

    @property
    def state(self) -> Literal["tentative", "confirmed", "coasting"]:
        """Stage of the life cycle."""
        if not self.id:
            return "tentative"
        return "coasting" if self.misses else "confirmed"

    @property
    def shown(self) -> bool:
        """Whether to draw it."""
        if not self.id or self.lost:
            return False
        if not self.misses:
            return True
        if self.hidden:  # shown for as long as it was detected before
            long_enough = 2 * self.time_since_update < self.age + TIME_TOLERANCE
            return long_enough and self.covered_budget > -TIME_TOLERANCE
        return self.coast_budget > -TIME_TOLERANCE

    def update_score(self, score: float | None, dt: float, params: TrackParams) -> None:
        """Advance by a frame, with the score of the assigned detection, or None without one."""
        new = weight_of(dt, params)
        self.score = (1 - new) * self.score + new * (score or 0.0)
        self.weight = (1 - new) * self.weight + new * (score is not None)
        self.age += dt
        self.hidden = self.lost = False
        if score is None:
            self.misses += 1
            self.all_misses += 1
            self.time_since_update += dt
        else:
            self.mean_score = self.score / self.weight
            self.hits += 1
            self.last_gap = self.time_since_update
            self.misses, self.time_since_update = 0, 0.0
            self.unexplained_gap, self.hidden_gap, self.covered_budget = 0.0, 0.0, params.show_covered
            self.coast_budget = min(self.coast_budget + dt, params.show_coast) if self.id else 0.0

    def mark_missed(self, dt: float, *, hidden: bool, covered: bool, lost: bool) -> None:
        """Account for a frame without a detection, behind another vehicle or for an unknown reason."""
        self.hidden, self.lost = hidden, lost
        if hidden:
            self.hidden_gap += dt
            self.covered_budget -= dt if covered else 0.0
        else:
            self.unexplained_gap += dt
            self.coast_budget -= dt

    def can_confirm(self, params: TrackParams) -> bool:
        """Whether a tentative track meets the conditions of confirmation in this frame."""
        if self.id or self.misses:
            return False
        return self.confirm_at_birth or (
            self.hits - self.all_misses >= params.confirm_hits
            and self.age > params.confirm_seconds - TIME_TOLERANCE
            and self.score >= params.confirm_score
        )

    def is_expired(self, params: TrackParams) -> bool:
        """Whether it has had no detection for too long."""
        if self.id:
            unexplained = self.unexplained_gap > params.max_coast + TIME_TOLERANCE
            return unexplained or self.hidden_gap > params.max_hidden + TIME_TOLERANCE
        return self.time_since_update > params.tentative_coast + TIME_TOLERANCE
