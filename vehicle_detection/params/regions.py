"""Parameters of the step from windows to boxes: the course's heat map, or groups of windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vehicle_detection._common import check_choice, check_integer, check_number


@dataclass(frozen=True, kw_only=True)
class HeatParams:
    """How windows become boxes by a heat map, as in the course.

    Attributes
    ----------
    weighting
        ``"score"``: each window adds its score to the heat; ``"count"``: it adds 1, as in the course.
    frames, threshold
        Number of frames over which the heat is averaged, and the highest heat that is removed.
    peak_fraction
        A region is reduced to the part around its peak that has at least this fraction of the peak's heat,
        in [0, 1); 0 keeps whole regions, as in the course.
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
    """How groups of overlapping windows become boxes; lengths are fractions of a window's side.

    Attributes
    ----------
    min_peak, min_evidence
        Minimum of the best score, and of the sum of positive scores in a group.
    min_iou
        Windows whose IoU with the best window exceeds this join its group.
    score_power
        The weight of a window in the group's mean is proportional to this power of its score.
    suppression_radius
        Windows whose center is this near to the center of a group start no group of their own.
    face_width, face_height, face_offset_y
        Size of the vehicle's face (front or rear) in a window, as on the training patches, and distance of
        its center below the window's center.
    flank_length_m, flank_shift
        Length of the visible side of a vehicle in meters, and fraction of the visible side by which the box's
        center moves towards the vanishing point.
    max_coverage
        A group is dropped if more than this fraction of its face lies inside the box of a better group.
    flank_peak_ratio
        A group whose face lies on the visible side of another vehicle is dropped even if it is the better
        one, unless the other peak is at most this fraction of its own.
    """

    min_peak: float = 0.7
    min_evidence: float = 1.75
    min_iou: float = 0.5
    score_power: float = 2.0
    suppression_radius: float = 0.6
    face_width: float = 0.84
    face_height: float = 0.79
    face_offset_y: float = -0.04
    flank_length_m: float = 6.0
    flank_shift: float = 0.27
    max_coverage: float = 0.5
    flank_peak_ratio: float = 0.5

    def __post_init__(self) -> None:
        for name in ("min_peak", "min_evidence"):
            check_number(getattr(self, name), name, low=0, high=1e9)
        for name in ("min_iou", "max_coverage", "flank_peak_ratio"):
            check_number(getattr(self, name), name, low=0, high=1)
        check_number(self.score_power, "score_power", low=0, high=20)
        for name in ("suppression_radius", "face_width", "face_height", "flank_shift"):
            check_number(getattr(self, name), name, above=0, high=2)
        check_number(self.face_offset_y, "face_offset_y", low=-1, high=1)
        check_number(self.flank_length_m, "flank_length_m", low=0, high=100)
