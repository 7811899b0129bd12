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
