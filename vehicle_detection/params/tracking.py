"""Parameters of the tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehicle_detection._common import check_choice, store_integer, store_number
from vehicle_detection.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class TrackParams:
    """How detections become tracks; times are in seconds of the video, sizes in fractions of a box's size.

    Attributes
    ----------
    smoother
        ``"kalman"``: a constant-velocity Kalman filter; ``"history"``: weighted mean of the last boxes (the
        course's second system); ``"nearest"``: the box moves a fraction of the way to the nearest detection
        (the course's first system).
    score_time_constant
        Time constant of the exponential moving average of a track's scores.
    high_threshold, low_threshold
        Detections from `high_threshold` on can start tracks. Detections between the two thresholds only
        continue tracks that have no better detection, and confirmed tracks only within half of
        `max_distance` and at an IoU of at least 0.5 (as in ByteTrack). Lower ones are dropped.
    confirm_score
        Average score at which a track is confirmed. A vehicle with constant score `s` reaches it after
        ``score_time_constant * log(s / (s - confirm_score))`` seconds, and never if `s` is lower. Both
        shipped models detect vehicles in single images from score 0 on.
    confirm_hits, confirm_seconds
        Minimum number of detections beyond the number of frames without one, and minimum time since the first
        one, before a track is confirmed.
    instant_confirm_score
        In the first frame, and in the first one after a scene cut, a detection with this score is confirmed
        at once, because no earlier frame could have shown it.
    tentative_coast, max_coast, max_hidden
        A tentative and a confirmed track end after these times without a detection. The time in which another
        vehicle hides a confirmed one has a limit of its own, `max_hidden`.
    show_coast, show_covered
        A confirmed track is shown for `show_coast` without a detection, and no longer than it was detected
        since its confirmation. While another vehicle hides it, it is shown up to `max_coast`, no longer than
        it was detected, and for `show_covered` if nothing of it is visible. It is not shown once it must have
        moved by half of its size.
    backfill
        A track is also shown for this time before its confirmation, where frames can wait: in
        `process_video` and `track`, unless the source is live.
    max_gap
        A longer gap between two frames ends all tracks.
    max_distance
        Maximum distance between the centers of a detection and of a prediction, in box widths and heights.
    max_iou, max_coverage
        A detection starts no track if its IoU with a track exceeds `max_iou`, or if the two share more than
        the fraction `max_coverage` of the smaller box.
    measurement_noise, measurement_correlation_time
        Standard error of a detection's edges, and time over which it is correlated, so that twice the frame
        rate is not twice the evidence.
    process_noise_position, process_noise_size
        Process noise of the center and of the size: standard deviation by which their speeds change in a
        second, in sizes per second.
    history_seconds, nearest_weight
        Length of the mean of the smoother ``"history"``, and fraction of the way that the smoother
        ``"nearest"`` moves in 0.04 seconds, in (0, 1].

    Examples
    --------
    >>> TrackParams(max_coast=0.5).show_coast
    0.3
    """

    smoother: Literal["kalman", "history", "nearest"] = "kalman"
    score_time_constant: float = 0.3
    high_threshold: float = -0.3
    low_threshold: float = -1.5
    confirm_score: float = 0.2
    confirm_hits: int = 3
    confirm_seconds: float = 0.12
    instant_confirm_score: float = 1.3
    tentative_coast: float = 0.1
    show_coast: float = 0.3
    show_covered: float = 0.4
    max_coast: float = 1.0
    max_hidden: float = 4.0
    backfill: float = 0.32
    max_gap: float = 1.0
    max_distance: float = 0.7
    max_iou: float = 0.3
    max_coverage: float = 0.7
    measurement_noise: float = 0.07
    measurement_correlation_time: float = 0.04
    process_noise_position: float = 0.18
    process_noise_size: float = 0.1
    history_seconds: float = 0.4
    nearest_weight: float = 0.3

    def __post_init__(self) -> None:
        check_choice(self.smoother, "smoother", ("kalman", "history", "nearest"))
        for name in ("score_time_constant", "max_gap", "history_seconds"):
            store_number(self, name, above=0, high=3600)
        times = (
            "confirm_seconds",
            "tentative_coast",
            "show_coast",
            "show_covered",
            "max_coast",
            "max_hidden",
            "backfill",
        )
        for name in (*times, "measurement_correlation_time"):
            store_number(self, name, low=0, high=3600)
        for name in ("high_threshold", "low_threshold", "confirm_score", "instant_confirm_score"):
            store_number(self, name, low=-1e6, high=1e6)
        for name in ("max_distance", "process_noise_position", "process_noise_size"):
            store_number(self, name, above=0, high=100)
        for name in ("max_iou", "max_coverage"):
            store_number(self, name, low=0, high=1)
        store_integer(self, "confirm_hits", low=1, high=10_000)
        for name in ("measurement_noise", "nearest_weight"):
            store_number(self, name, above=0, high=1)
        if self.show_coast > self.max_coast:
            raise InvalidInputError(
                f"show_coast must be at most max_coast, because a track that ended is not shown; "
                f"got {self.show_coast:g} and {self.max_coast:g}; change both"
            )
