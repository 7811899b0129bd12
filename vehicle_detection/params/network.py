"""Search parameters of a network: the size of its input, and the horizon for distances."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from vehicle_detection._common import describe, store_integer, store_number
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params.regions import HeatParams, HeatRange


@dataclass(frozen=True, kw_only=True)
class NetworkParams:
    """Search parameters of a network, which always searches the whole frame.

    Attributes
    ----------
    input_size
        Longer side of the network's input in pixels, a multiple of 32. Larger inputs show smaller vehicles
        and take more time. None: the size in the model file, 640 for the shipped network.
    horizon
        Row of the horizon as a fraction of the frame's height, for distances; None: estimated.
    horizon_tolerance
        Error of the horizon as a fraction of the frame's height; the default suits any dash-cam.
    min_score
        Minimum score of the boxes before suppression that count as positive windows, in log-odds above the
        model's threshold.

    Examples
    --------
    >>> NetworkParams(input_size=960).with_horizon(0.55).horizon
    0.55
    """

    input_size: int | None = None
    horizon: float | None = 0.5
    horizon_tolerance: float = 0.15
    min_score: float = 0.0

    def __post_init__(self) -> None:
        if self.input_size is not None:
            store_integer(self, "input_size", low=32, high=8192)
            if self.input_size % 32:
                raise InvalidInputError(
                    f"input_size must be a multiple of 32, got {describe(self.input_size)}; "
                    f"pass {-(-self.input_size // 32) * 32}"
                )
        if self.horizon is not None:
            store_number(self, "horizon", low=0, high=1)
        store_number(self, "horizon_tolerance", low=0, high=1)
        store_number(self, "min_score")

    @classmethod
    def default(cls) -> NetworkParams:
        """Return the default parameters."""
        return cls()

    def with_horizon(self, horizon: float | None) -> NetworkParams:
        """Return the same parameters with a known horizon and a lower tolerance; None changes nothing."""
        if horizon is None:
            return self
        return dataclasses.replace(self, horizon=horizon, horizon_tolerance=0.06)

    def everywhere(self) -> NetworkParams:
        """Return the same parameters: a network searches all rows."""
        return self

    def heat_range(self, heat: HeatParams) -> HeatRange:
        """Heat thresholds for boxes of unknown density: any."""
        return HeatRange(0.0, 0.0, math.inf)
