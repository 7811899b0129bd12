"""How windows become vehicles: by heat, as in the course, or by groups of windows that agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehicle_detection._common import check_choice, check_integer, check_number


@dataclass(frozen=True, kw_only=True)
class HeatParams:
    """How windows become regions.

    Attributes
    ----------
    weighting
        ``"score"``: a window adds its score to the heat; ``"count"``: it adds 1, as in the course.
    frames
        Number of last frames whose heat is averaged in a video.
    threshold
        Heat at or below this is no vehicle.
    peak_fraction
        A region reaches out to this share of its own peak, in [0, 1); 0 is the plain course way.
    """

    weighting: Literal["score", "count"] = "score"
    frames: int = 5
    threshold: float = 2.0
    peak_fraction: float = 0.35

    def __post_init__(self) -> None:
        check_choice(self.weighting, "weighting", ("score", "count"))
        check_integer(self.frames, "frames", low=1, high=1000)
        check_number(self.threshold, "threshold", low=0, high=1e9)
        check_number(self.peak_fraction, "peak_fraction", low=0, high=0.99)


@dataclass(frozen=True, kw_only=True)
class RegionParams:
    """How agreeing windows become the boxes of vehicles; lengths are shares of a window's side.

    Attributes
    ----------
    min_peak
        Best score that a group of windows needs.
    min_evidence
        Sum of positive scores that it needs.
    overlap
        Windows that overlap the best one by more than this (IoU) join its group.
    power
        A window counts in the mean with this power of its score.
    reach
        Windows with a center this near to a group's are used up by it.
    face_width, face_height
        Part of the window that a vehicle's face fills, on the training patches and their like.
    face_offset_y
        How far the face's middle lies below the window's.
    flank_length_m
        Length of a vehicle's flank in meters, as far as it shows.
    covered
        A group whose face lies inside the box of a better one by more than this share is no vehicle.
    flank_peak
        Such a group goes even before a weaker one, if it only lies on its flank and the other has more than
        this share of its peak.
    flank_shift
        Share of the visible flank by which the box's middle moves towards the vanishing point.
    """

    min_peak: float = 0.7
    min_evidence: float = 1.75
    overlap: float = 0.5
    power: float = 2.0
    reach: float = 0.6
    face_width: float = 0.84
    face_height: float = 0.79
    face_offset_y: float = -0.04
    flank_length_m: float = 6.0
    flank_shift: float = 0.27
    covered: float = 0.5
    flank_peak: float = 0.5

    def __post_init__(self) -> None:
        for name in ("min_peak", "min_evidence"):
            check_number(getattr(self, name), name, low=0, high=1e9)
        check_number(self.overlap, "overlap", low=0, high=1)
        check_number(self.covered, "covered", low=0, high=1)
        check_number(self.flank_peak, "flank_peak", low=0, high=1)
        check_number(self.power, "power", low=0, high=20)
        for name in ("reach", "face_width", "face_height", "flank_shift"):
            check_number(getattr(self, name), name, above=0, high=2)
        check_number(self.face_offset_y, "face_offset_y", low=-1, high=1)
        check_number(self.flank_length_m, "flank_length_m", low=0, high=100)
