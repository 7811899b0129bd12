"""Parameters of the step from windows to boxes: the course's heat map, or groups of windows."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from vehicle_detection._common import check_choice, store_integer, store_number


class HeatRange(NamedTuple):
    """Heat thresholds that suit a search: the default, and the limits beyond which most vehicles are lost."""

    default: float
    low: float
    high: float


class HeatSearch(Protocol):
    """Search parameters that know the heat of their windows."""

    def heat_range(self, heat: HeatParams, /) -> HeatRange:
        """Thresholds for heat maps of this search."""


@dataclass(frozen=True, kw_only=True)
class HeatParams:
    """How windows become boxes by a heat map, as in the course.

    Attributes
    ----------
    weighting
        ``"score"``: each window adds its score to the heat; ``"count"``: it adds 1, as in the course.
    frames
        Number of frames over which the heat is averaged.
    threshold
        Highest heat that is removed. None: chosen for the model and the density of its search. More
        windows cover a vehicle in a denser search, so a threshold fits one density only.
    peak_fraction
        A region is reduced to the part around its peak that has at least this fraction of the peak's heat,
        in [0, 1); 0 keeps whole regions, as in the course.
    """

    weighting: Literal["score", "count"] = "score"
    frames: int = 5
    threshold: float | None = None
    peak_fraction: float = 0.35

    def __post_init__(self) -> None:
        check_choice(self.weighting, "weighting", ("score", "count"))
        store_integer(self, "frames", low=1, high=1000)
        if self.threshold is not None:
            store_number(self, "threshold", low=0, high=1e9)
        store_number(self, "peak_fraction", low=0, high=0.99)

    def for_search(self, search: HeatSearch) -> HeatParams:
        """Return the same parameters with a threshold for `search`; warn if the given one cannot fit it."""
        expected = search.heat_range(self)
        if self.threshold is None:
            return dataclasses.replace(self, threshold=expected.default)
        if not expected.low <= self.threshold <= expected.high:
            many = "few" if self.threshold > expected.high else "many"
            warnings.warn(
                f"the heat threshold {self.threshold:g} does not fit the density of this search: too {many} "
                f"windows are hot. With weighting={self.weighting!r} and peak_fraction="
                f"{self.peak_fraction:g} expect {expected.low:.2g} to {expected.high:.2g}; omit the "
                f"threshold for the default of {expected.default:.2g}",
                stacklevel=3,
            )
        return self


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
            store_number(self, name, low=0, high=1e9)
        for name in ("min_iou", "max_coverage", "flank_peak_ratio"):
            store_number(self, name, low=0, high=1)
        store_number(self, "score_power", low=0, high=20)
        for name in ("suppression_radius", "face_width", "face_height", "flank_shift"):
            store_number(self, name, above=0, high=2)
        store_number(self, "face_offset_y", low=-1, high=1)
        store_number(self, "flank_length_m", low=0, high=100)
