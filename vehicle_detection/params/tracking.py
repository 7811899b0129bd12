"""How the vehicles of single frames become tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehicle_detection._common import check_choice, check_integer, check_number
from vehicle_detection.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class TrackParams:
    """How regions become vehicles; times are in seconds of the video, sizes in shares of a box's own size.

    Attributes
    ----------
    smoother
        ``"kalman"``: constant velocity; ``"history"``: weighted mean of the last boxes (the course's second
        system); ``"nearest"``: the box moves a share of the way to the new one (its first system).
    memory
        Time constant in which the running mean of a track's scores forgets.
    high_threshold
        Detections below this score start no track.
    low_threshold
        Detections from this score on, where they are below `high_threshold`, keep a track alive that found no
        better one; a believed track only where they are half as far off as `gate` allows. Of less the tracker
        knows nothing.
    confirm_score
        Running mean of the scores at which a track is believed. A vehicle of score `s` reaches it after
        ``memory * log(s / (s - confirm_score))`` seconds, one that scores less never does. Both shipped
        models put the least score of a vehicle on a still at 0. A vehicle that scores now above it and now
        below is believed as soon as the mean says so, and then kept: about half of what was missed on
        drawn drives at 0.35, with boxes from 0 on alone, is followed.
    confirm_hits, confirm_seconds
        A track is believed after this many detections at the earliest, and this long after the first.
    start_score
        In the first frame, and the first after a cut, a detection of this score is believed at once: there
        is no earlier frame that could have told.
    tentative_coast
        A track that is not yet believed ends once it is unseen for longer than this.
    show_coast
        A believed track is drawn this long without a detection, and less if it was seen for less than twice
        as long; while other vehicles hide it, up to `max_coast`, if it was seen for as long as it is unseen.
        It is drawn no more once it must have moved by half of its own size.
    max_coast
        A believed track ends once it is unseen for longer than this.
    max_gap
        A longer gap between two frames ends all tracks.
    gate
        Farthest that a detection's center may lie from the predicted one, in box widths and heights.
    max_overlap, max_cover
        A second box on one vehicle: IoU with a track, and share of the smaller of the two boxes that both
        cover, above which a detection starts no track of its own.
    box_noise
        Standard error of a detection's edges.
    box_noise_seconds
        Time over which that error stays alike, so that twice the frames are not twice the evidence.
    process_noise_position, growth
        Process noise of the center and of the size: their speeds wander by this share of the size a second,
        in a second.
    history
        Length of the mean of the smoother ``"history"``.
    nearest_weight
        Share of the way that the smoother ``"nearest"`` moves in 0.04 seconds, in (0, 1].

    Examples
    --------
    >>> TrackParams(max_coast=0.5).show_coast
    0.3
    >>> TrackParams(confirm_hits=0)
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: confirm_hits must be an integer from 1 to 10000; got 0 (int)
    """

    smoother: Literal["kalman", "history", "nearest"] = "kalman"
    memory: float = 0.3
    high_threshold: float = -0.3
    low_threshold: float = -1.5
    confirm_score: float = 0.2
    confirm_hits: int = 4
    confirm_seconds: float = 0.12
    start_score: float = 1.3
    tentative_coast: float = 0.1
    show_coast: float = 0.3
    max_coast: float = 1.0
    max_gap: float = 1.0
    gate: float = 0.7
    max_overlap: float = 0.3
    max_cover: float = 0.7
    box_noise: float = 0.07
    box_noise_seconds: float = 0.04
    process_noise_position: float = 0.18
    growth: float = 0.1
    history: float = 0.4
    nearest_weight: float = 0.3

    def __post_init__(self) -> None:
        check_choice(self.smoother, "smoother", ("kalman", "history", "nearest"))
        for name in ("memory", "max_gap", "history"):
            check_number(getattr(self, name), name, above=0, high=3600)
        for name in ("confirm_seconds", "tentative_coast", "show_coast", "max_coast", "box_noise_seconds"):
            check_number(getattr(self, name), name, low=0, high=3600)
        for name in ("high_threshold", "low_threshold", "confirm_score", "start_score"):
            check_number(getattr(self, name), name, low=-1e6, high=1e6)
        for name in ("gate", "process_noise_position", "growth"):
            check_number(getattr(self, name), name, above=0, high=100)
        for name in ("max_overlap", "max_cover"):
            check_number(getattr(self, name), name, low=0, high=1)
        check_integer(self.confirm_hits, "confirm_hits", low=1, high=10_000)
        check_number(self.box_noise, "box_noise", above=0, high=1)
        check_number(self.nearest_weight, "nearest_weight", above=0, high=1)
        if self.show_coast > self.max_coast:
            raise InvalidInputError(
                f"show_coast must be at most max_coast, as a track that ended is not drawn; "
                f"got {self.show_coast:g} and {self.max_coast:g}; change both"
            )
