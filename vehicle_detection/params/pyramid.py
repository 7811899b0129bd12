"""Which windows a pyramid search looks at."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from vehicle_detection._common import check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

# By how much of the frame's height a horizon that somebody states may be wrong.
_KNOWN = 0.06


@dataclass(frozen=True, kw_only=True)
class PyramidParams:
    """How the search with several templates walks through a frame, of whatever size.

    Attributes
    ----------
    least_width
        Width in pixels of the narrowest vehicle looked for.
    most_height
        Height of the highest one, as a share of the frame's height.
    per_octave
        Sizes from one to twice of it.
    horizon
        Height of the horizon as a share of the frame's height: a vehicle of each size is looked for where a
        flat road would carry it. None: everywhere.
    camera_height_m
        Heights in metres, least and most, at which the camera may be where the horizon is known.
    horizon_error
        By how much of the frame's height the horizon may be wrong; the default holds for any dash-cam.
    min_score
        Least score of a window that is told, in log-odds above the model's threshold.

    Examples
    --------
    >>> [round(size, 2) for size in PyramidParams(least_width=70).sizes(7, 8, (720, 1280))[:6]]
    [10.0, 11.49, 13.2, 15.16, 17.41, 20.0]
    """

    least_width: float = 32.0
    most_height: float = 0.8
    per_octave: int = 5
    horizon: float | None = 0.5
    camera_height_m: tuple[float, float] = (0.9, 2.6)
    horizon_error: float = 0.15
    min_score: float = 0.0

    def __post_init__(self) -> None:
        check_number(self.least_width, "least_width", low=16, high=10_000)
        check_number(self.most_height, "most_height", above=0, high=2)
        check_integer(self.per_octave, "per_octave", low=1, high=32)
        if self.horizon is not None:
            check_number(self.horizon, "horizon", low=0, high=1)
        heights: object = self.camera_height_m
        if not isinstance(heights, (tuple, list)) or len(heights) != 2:
            raise InvalidInputError(
                f"camera_height_m must be the least and the most, such as (0.9, 2.6); got {describe(heights)}"
            )
        low, high = (check_number(each, "camera_height_m", above=0, high=1000) for each in heights)
        if low > high:
            raise InvalidInputError(f"camera_height_m must be the least one first; got {describe(heights)}")
        object.__setattr__(self, "camera_height_m", (low, high))
        check_number(self.horizon_error, "horizon_error", low=0, high=1)
        check_number(self.min_score, "min_score")

    def with_horizon(self, horizon: float | None) -> PyramidParams:
        """Return the same for a horizon that is known to 6% of the height; None changes nothing."""
        if horizon is None:
            return self
        return dataclasses.replace(self, horizon=horizon, horizon_error=_KNOWN)

    def sizes(self, columns: float, rows: float, shape: tuple[int, ...]) -> list[float]:
        """Pixels a cell of each level, for boxes of `columns` by `rows` cells in a frame of `shape`."""
        least = self.least_width / columns
        most = max(self.most_height * shape[0] / rows, least)
        count = math.floor(self.per_octave * math.log2(most / least)) + 1
        return [least * 2 ** (step / self.per_octave) for step in range(count)]

    def rows(self, width: float, height: float, shape: tuple[int, ...]) -> tuple[int, int]:
        """First and last row of the frame that boxes of `width` by `height` pixels may reach.

        A vehicle about 1.8 m wide that stands on a flat road has its foot below the horizon by its width in
        pixels times the camera's height over its own width.
        """
        if self.horizon is None:
            return 0, shape[0]
        near, far = (share * width / 1.8 for share in self.camera_height_m)
        slack = self.horizon_error * shape[0]
        top = (self.horizon * shape[0]) + near - slack - height
        bottom = (self.horizon * shape[0]) + far + slack
        return max(0, math.floor(top)), min(shape[0], math.ceil(bottom))
