"""Search parameters: bands of windows below the horizon, and those of functions."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar

from vehicle_detection._common import (
    check_choice,
    check_number,
    describe,
    store_number,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params.regions import HeatParams, HeatRange

REFERENCE_WIDTH = 1280
"""Search windows are given in pixels of a frame whose longer side has this length."""

# Heat thresholds by weighting, and whether regions are reduced to their peak, chosen on single frames of the
# labelled clips: the default has the best F1, or close to it, and beyond the limits F1 is about 0.5 or lower.
_BAND_HEAT = {
    ("score", True): HeatRange(2.0, 0.0, 40.0),
    ("count", True): HeatRange(8.0, 0.0, 56.0),
    ("score", False): HeatRange(12.0, 4.0, 40.0),
    ("count", False): HeatRange(16.0, 10.0, 56.0),
}
# Factor of the default thresholds of whole regions if all windows are of similar size.
_SIMILAR_SIZES_FACTOR = 0.6
# Windows of sides that differ by at most this factor fire on the same vehicle.
_SIMILAR_SIDES = 1.5
# The fast search steps by one cell, an eighth of a window, or more.
_MIN_STEP = 1 / 8

Pair = tuple[float, float]


@dataclass(frozen=True)
class PixelBand:
    """A search band in integer pixels of one frame; it may extend beyond the left and right border."""

    x1: int
    y1: int
    x2: int
    y2: int
    window: tuple[int, int]  # width and height
    step: tuple[int, int]  # horizontal and vertical


@dataclass(frozen=True, kw_only=True)
class SearchBand:
    """Windows of one size in a horizontal band, in pixels of a 1280-wide reference frame.

    Attributes
    ----------
    window
        Width and height of the windows.
    y, x
        Top and bottom of the band relative to the horizon, positive downwards; left and right end as
        fractions of the frame's width, 0-1.
    overlap
        Horizontal and vertical overlap of neighboring windows as fractions of their size, in [0, 1).
    """

    window: Pair
    y: Pair
    x: Pair = (0.0, 1.0)
    overlap: Pair = (0.875, 0.875)

    def __post_init__(self) -> None:
        _check_pair(self.window, "window", low=8, high=4096)
        _check_pair(self.y, "y", low=-4096, high=4096)
        _check_pair(self.x, "x", low=0, high=1)
        _check_pair(self.overlap, "overlap", low=0, high=0.99)
        for name, (start, stop) in (("x", self.x), ("y", self.y)):
            if start >= stop:
                raise InvalidInputError(
                    f"{name} must be (start, stop) with start < stop; got {(start, stop)}"
                )

    def place(
        self, shape: tuple[int, ...], horizon: float, horizontal_padding: float = 0.0
    ) -> PixelBand | None:
        """Place the band on a frame.

        Parameters
        ----------
        shape
            ``(height, width, ...)`` of the frame.
        horizon
            Row of the horizon as a fraction of the frame's height, 0 at the top.
        horizontal_padding
            Fraction of a window's width by which a band that ends at the frame's left or right border extends
            beyond it.

        Returns
        -------
        PixelBand or None
            The band in pixels; None if no window fits, or windows are smaller than 16 pixels.
        """
        height, width = shape[:2]
        scale = max(height, width) / REFERENCE_WIDTH
        window_w, window_h = (round(side * scale) for side in self.window)
        y1, y2 = (min(max(round(horizon * height + side * scale), 0), height) for side in self.y)
        x1, x2 = round(self.x[0] * width), round(self.x[1] * width)
        # Smaller windows than 16 pixels are too blurred when enlarged to a patch.
        if min(window_w, window_h) < 16 or x2 - x1 < window_w or y2 - y1 < window_h:
            return None
        padding = round(horizontal_padding * window_w)
        x1 -= padding if x1 == 0 else 0
        x2 += padding if x2 == width else 0
        step_x, step_y = (
            max(1, int(side * (1 - overlap) + 1e-9))
            for side, overlap in zip((window_w, window_h), self.overlap)
        )
        return PixelBand(x1, y1, x2, y2, (window_w, window_h), (step_x, step_y))


@dataclass(frozen=True, kw_only=True)
class SearchParams:
    """Positions and sizes of the windows that are searched.

    Attributes
    ----------
    bands, horizon
        Bands of windows, and row of the horizon as a fraction of the frame's height, 0 at the top.
    min_score
        Minimum score of a hit (exclusive).
    horizontal_padding
        Fraction of a window that may extend beyond the frame's left and right border, where the outermost
        column is replicated, so that truncated vehicles are found.

    Examples
    --------
    >>> params = SearchParams.preset("three-scales")
    >>> params.place((720, 1280))[1]
    PixelBand(x1=0, y1=400, x2=1280, y2=656, window=(64, 64), step=(8, 8))
    """

    horizon_tolerance: ClassVar[float] = 0.1
    """Maximum error of the horizon that the bands allow, as a fraction of the frame's height."""

    bands: tuple[SearchBand, ...]
    horizon: float = 0.58
    min_score: float = 0.0
    horizontal_padding: float = 0.0

    def __post_init__(self) -> None:
        bands: object = self.bands
        if not (isinstance(bands, (tuple, list)) and bands and all(isinstance(b, SearchBand) for b in bands)):
            raise InvalidInputError(
                f"bands must be a tuple of SearchBand, at least one; got {describe(bands)}"
            )
        object.__setattr__(self, "bands", tuple(bands))
        store_number(self, "horizon", low=0, high=1)
        store_number(self, "min_score", low=-1e6, high=1e6)
        store_number(self, "horizontal_padding", low=0, high=0.9)

    @classmethod
    def default(cls) -> SearchParams:
        """Return the preset ``"default"``."""
        return cls.preset()

    @classmethod
    def preset(cls, name: str = "default") -> SearchParams:
        """Return "default", or "130-windows" or "three-scales" of the course's first or third system."""
        presets = {"three-scales": _three_scales, "130-windows": _window_list, "default": _default_bands}
        check_choice(name, "preset", presets)
        return presets[name]()

    def with_horizon(self, horizon: float | None) -> SearchParams:
        """Return the same parameters with another horizon; None keeps it."""
        return self if horizon is None else dataclasses.replace(self, horizon=horizon)

    def everywhere(self) -> SearchParams:
        """Return the same parameters for a search of all rows, whatever the horizon."""
        bands = (dataclasses.replace(band, y=(-4096.0, 4096.0)) for band in self.bands)
        return dataclasses.replace(self, bands=tuple(bands))

    @property
    def window_density(self) -> float:
        """Number of windows of similar size that cover a point, as the mean over the bands."""
        sides = [math.sqrt(band.window[0] * band.window[1]) for band in self.bands]
        covers = [
            math.prod(1 / max(1 - overlap, _MIN_STEP) for overlap in band.overlap) for band in self.bands
        ]
        similar = [
            cover
            for side in sides
            for other, cover in zip(sides, covers)
            if max(side, other) <= _SIMILAR_SIDES * min(side, other)
        ]
        return sum(similar) / len(self.bands)

    def heat_range(self, heat: HeatParams) -> HeatRange:
        """Heat thresholds for the windows of this search: those of the default search, scaled by density.

        Examples
        --------
        >>> SearchParams.preset().heat_range(HeatParams(weighting="count", peak_fraction=0))
        HeatRange(default=16.0, low=10.0, high=56.0)
        """
        factor = self.window_density / SearchParams.default().window_density
        default, low, high = (factor * value for value in _BAND_HEAT[heat.weighting, heat.peak_fraction > 0])
        # Only windows much larger than a vehicle join it to others, which takes a higher threshold.
        sides = [side for band in self.bands for side in band.window]
        if heat.peak_fraction == 0 and max(sides) <= 4 * min(sides):
            default, low = _SIMILAR_SIZES_FACTOR * default, 0.0
        return HeatRange(default, low, high)

    def place(self, shape: tuple[int, ...]) -> tuple[PixelBand, ...]:
        """Bands in pixels of a frame of `shape` (height, width, ...), in which some window must fit."""
        placed = [band.place(shape, self.horizon, self.horizontal_padding) for band in self.bands]
        fitting = tuple(band for band in placed if band is not None)
        if not fitting:
            raise InvalidInputError(
                f"image of {shape[1]}x{shape[0]} pixels holds no search window below the horizon at "
                f"{self.horizon:g} of its height; pass a larger image, or change horizon or bands"
            )
        return fitting


def _check_pair(value: object, name: str, *, low: float, high: float) -> None:
    if not isinstance(value, tuple) or len(value) != 2:
        raise InvalidInputError(f"{name} must be a pair of numbers, got {describe(value)}")
    for index, number in enumerate(value):
        check_number(number, f"{name}[{index}]", low=low, high=high)


def _window_list() -> SearchParams:
    bands = tuple(
        SearchBand(window=window, y=y, x=(650 / 1280, 1.0), overlap=overlap)
        for window, y, overlap in (
            ((96.0, 96.0), (-5.0, 130.0), (0.9, 0.5)),
            ((110.0, 145.0), (-20.0, 190.0), (0.7, 0.6)),
            ((155.0, 165.0), (-30.0, 190.0), (0.6, 0.5)),
            ((170.0, 200.0), (0.0, 300.0), (0.6, 0.5)),
        )
    )
    return SearchParams(bands=bands, horizon=400 / 720)


def _three_scales() -> SearchParams:
    bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in (1.5, 1.0, 0.8))
    return SearchParams(bands=bands, horizon=400 / 720)


def _default_bands() -> SearchParams:
    """Windows from 64 pixels up, in steps of 1.25, wherever a vehicle on a flat road may be.

    With the camera `c` meters above the road, the bottom of a vehicle whose face fills 0.84 of a window of
    side `s` is ``0.84 * s * c / 1.8`` below the horizon. For cameras at 0.9 to 2 m the window is between
    -0.35 `s` and 0.95 `s`; the margin allows for hills and an inexact horizon.
    """
    sides = [64.0 * 1.25**step for step in range(8)]
    bands = tuple(SearchBand(window=(side, side), y=(-0.35 * side - 16, 0.95 * side + 16)) for side in sides)
    return SearchParams(bands=bands, horizontal_padding=0.5)


@dataclass(frozen=True, kw_only=True)
class FunctionParams:
    """Parameters of a detector that is a function: it searches the whole frame by itself.

    Attributes
    ----------
    horizon
        Row of the horizon as a fraction of the frame's height, for distances; None: estimated.
    horizon_tolerance
        Error of the horizon as a fraction of the frame's height.
    min_score
        Minimum score, in log-odds, of the boxes that count as positive windows.

    Examples
    --------
    >>> FunctionParams().with_horizon(0.55).horizon
    0.55
    """

    horizon: float | None = None
    horizon_tolerance: float = 0.15
    min_score: float = 0.0

    def __post_init__(self) -> None:
        if self.horizon is not None:
            store_number(self, "horizon", low=0, high=1)
        store_number(self, "horizon_tolerance", low=0, high=1)
        store_number(self, "min_score")

    @classmethod
    def default(cls) -> FunctionParams:
        """Return the default parameters."""
        return cls()

    def with_horizon(self, horizon: float | None) -> FunctionParams:
        """Return the same parameters with a known horizon and a lower tolerance; None changes nothing."""
        if horizon is None:
            return self
        return dataclasses.replace(self, horizon=horizon, horizon_tolerance=0.06)

    def everywhere(self) -> FunctionParams:
        """Return the same parameters: a function searches all rows."""
        return self

    def heat_range(self, heat: HeatParams) -> HeatRange:
        """Heat thresholds for boxes of unknown density: any."""
        return HeatRange(0.0, 0.0, math.inf)


def entries(values: object, name: str) -> tuple[Any, ...]:
    """Return the values of a tuple or list with at least one entry."""
    if not isinstance(values, (tuple, list)) or not values:
        raise InvalidInputError(f"{name} must be a tuple of at least one entry; got {describe(values)}")
    return tuple(values)
