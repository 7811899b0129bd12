"""Where windows are searched: bands below the horizon, placed on frames of any size."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from vehicle_detection._common import check_choice, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

REFERENCE_WIDTH = 1280
"""Search windows are given in pixels of a frame whose longer side is this long."""

# A window of fewer pixels, blown up to a patch, is a blur.
_LEAST_WINDOW = 16

Pair = tuple[float, float]


@dataclass(frozen=True)
class PixelBand:
    """A search band placed on one frame: all integer pixels of that frame.

    Attributes
    ----------
    x1, y1, x2, y2
        The band's half-open rectangle. It lies inside the frame, but for an overhang at the sides.
    window
        Width and height of its windows.
    step
        Horizontal and vertical step between windows.
    """

    x1: int
    y1: int
    x2: int
    y2: int
    window: tuple[int, int]
    step: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class SearchBand:
    """Windows of one size over a strip of the road, in pixels of a 1280-wide reference frame.

    Attributes
    ----------
    window
        Width and height of the windows.
    y
        Top and bottom of the strip, counted from the horizon downwards (negative: above it).
    x
        Left and right end as shares of the frame's width, 0-1.
    overlap
        Horizontal and vertical share that neighboring windows have in common, in [0, 1).
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
        """Place the band on a frame of `shape` (height, width); None where no window fits."""
        height, width = shape[:2]
        scale = max(height, width) / REFERENCE_WIDTH
        window_w, window_h = (round(side * scale) for side in self.window)
        y1, y2 = (min(max(round(horizon * height + side * scale), 0), height) for side in self.y)
        x1, x2 = round(self.x[0] * width), round(self.x[1] * width)
        if min(window_w, window_h) < _LEAST_WINDOW or x2 - x1 < window_w or y2 - y1 < window_h:
            return None
        beyond = round(horizontal_padding * window_w)
        x1 -= beyond if x1 == 0 else 0
        x2 += beyond if x2 == width else 0
        step = (
            max(1, int(window_w * (1 - self.overlap[0]) + 1e-9)),
            max(1, int(window_h * (1 - self.overlap[1]) + 1e-9)),
        )
        return PixelBand(x1, y1, x2, y2, (window_w, window_h), step)


@dataclass(frozen=True, kw_only=True)
class SearchParams:
    """Where and at which sizes windows are searched.

    Attributes
    ----------
    bands
        The strips, each with its window size.
    horizon
        Height of the horizon as a share of the frame's height, 0 at the top.
    min_score
        Windows with a score above this count as hits.
    horizontal_padding
        Share of a window that may lie beyond the frame's left and right edge, where the outermost column
        is repeated: vehicles that are half in the picture are found.

    Examples
    --------
    >>> search = SearchParams.preset("three-scales")
    >>> search.place((720, 1280))[1]
    PixelBand(x1=0, y1=400, x2=1280, y2=656, window=(64, 64), step=(8, 8))
    """

    horizon_tolerance: ClassVar[float] = 0.1
    """Fraction of the frame's height by which the horizon of bands may be wrong."""

    bands: tuple[SearchBand, ...]
    horizon: float = 0.58
    min_score: float = 0.0
    horizontal_padding: float = 0.0

    def __post_init__(self) -> None:
        bands: object = self.bands
        if not isinstance(bands, (tuple, list)) or not all(isinstance(band, SearchBand) for band in bands):
            raise InvalidInputError(f"bands must be a tuple of SearchBand; got {describe(bands)}")
        if not bands:
            raise InvalidInputError("bands must be a tuple of SearchBand, at least one; got none")
        object.__setattr__(self, "bands", tuple(bands))
        check_number(self.horizon, "horizon", low=0, high=1)
        check_number(self.min_score, "min_score", low=-1e6, high=1e6)
        check_number(self.horizontal_padding, "horizontal_padding", low=0, high=0.9)

    @classmethod
    def default(cls) -> SearchParams:
        """Parameters for searching when none are given: the preset ``"default"``."""
        return cls.preset()

    @classmethod
    def preset(cls, name: str = "default") -> SearchParams:
        """Bands of the project (``"default"``) or of the course's first or third system.

        ``"130-windows"`` is the window list of the first system, ``"three-scales"`` the dense search
        of the third, both for 1280x720 frames.
        """
        presets = {"three-scales": _third_system, "130-windows": _first_system, "default": _default_search}
        check_choice(name, "preset", presets)
        return cls(**presets[name]())

    def with_horizon(self, horizon: float | None) -> SearchParams:
        """Return the same search with another horizon; None keeps it."""
        return self if horizon is None else dataclasses.replace(self, horizon=horizon)

    def place(self, shape: tuple[int, ...]) -> tuple[PixelBand, ...]:
        """Bands in pixels of a frame of `shape` (height, width, ...).

        Raises
        ------
        InvalidInputError
            If not one window fits into the frame.
        """
        placed = tuple(band for band in self._place_each(shape) if band)
        if not placed:
            raise InvalidInputError(
                f"image of {shape[1]}x{shape[0]} pixels holds no search window below the horizon at "
                f"{self.horizon:g} of its height; pass a larger image, another horizon or other bands"
            )
        return placed

    def _place_each(self, shape: tuple[int, ...]) -> Iterator[PixelBand | None]:
        return (band.place(shape, self.horizon, self.horizontal_padding) for band in self.bands)


def _check_pair(value: object, name: str, *, low: float, high: float) -> None:
    if not isinstance(value, tuple) or len(value) != 2:
        raise InvalidInputError(f"{name} must be a pair of numbers, got {describe(value)}")
    for index, number in enumerate(value):
        check_number(number, f"{name}[{index}]", low=low, high=high)


def _first_system() -> dict[str, Any]:
    rows = (
        ((96.0, 96.0), (395, 530), (0.9, 0.5)),
        ((110.0, 145.0), (380, 590), (0.7, 0.6)),
        ((155.0, 165.0), (370, 590), (0.6, 0.5)),
        ((170.0, 200.0), (400, 700), (0.6, 0.5)),
    )
    bands = tuple(
        SearchBand(window=window, y=(top - 400.0, bottom - 400.0), x=(650 / 1280, 1.0), overlap=overlap)
        for window, (top, bottom), overlap in rows
    )
    return {"bands": bands, "horizon": 400 / 720, "min_score": 0.0}


def _third_system() -> dict[str, Any]:
    bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in (1.5, 1.0, 0.8))
    return {"bands": bands, "horizon": 400 / 720, "min_score": 0.0}


def _default_search() -> dict[str, Any]:
    """Windows from 64 px up in even steps of scale, wherever a vehicle on a flat road may stand.

    With the camera `c` meters above the road, the foot of a vehicle whose face fills 0.84 of a window of
    side `s` is ``0.84 * s * c / 1.8`` below the horizon. For cameras from 0.9 to 2 m high that puts the
    window between -0.35 and 0.95 `s`; the margin allows for hills and for a horizon that is not exact.
    """
    margin = 16.0
    sides = [64.0 * 1.25**step for step in range(8)]
    bands = tuple(
        SearchBand(window=(side, side), y=(-0.35 * side - margin, 0.95 * side + margin)) for side in sides
    )
    return {"bands": bands, "horizon": 0.58, "min_score": 0.0, "horizontal_padding": 0.5}


# By how much of the frame's height a horizon that somebody states may be wrong.
_KNOWN = 0.06


@dataclass(frozen=True, kw_only=True)
class PyramidParams:
    """How the search with several templates walks through a frame, of whatever size.

    Attributes
    ----------
    min_width
        Width in pixels of the narrowest vehicle looked for.
    max_height
        Height of the highest one, as a share of the frame's height.
    per_octave
        Sizes from one to twice of it.
    horizon
        Height of the horizon as a share of the frame's height: a vehicle of each size is looked for where a
        flat road would carry it. None: everywhere.
    camera_height_m
        Heights in meters, least and most, at which the camera may be where the horizon is known.
    horizon_tolerance
        By how much of the frame's height the horizon may be wrong; the default holds for any dash-cam.
    min_score
        Least score of a window that is told, in log-odds above the model's threshold.

    Examples
    --------
    >>> [round(size, 2) for size in PyramidParams(min_width=70).sizes(7, 8, (720, 1280))[:6]]
    [10.0, 11.49, 13.2, 15.16, 17.41, 20.0]
    """

    min_width: float = 32.0
    max_height: float = 0.8
    per_octave: int = 5
    horizon: float | None = 0.5
    camera_height_m: tuple[float, float] = (0.9, 2.6)
    horizon_tolerance: float = 0.15
    min_score: float = 0.0

    def __post_init__(self) -> None:
        check_number(self.min_width, "min_width", low=16, high=10_000)
        check_number(self.max_height, "max_height", above=0, high=2)
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
        check_number(self.horizon_tolerance, "horizon_tolerance", low=0, high=1)
        check_number(self.min_score, "min_score")

    @classmethod
    def default(cls) -> PyramidParams:
        """Parameters for searching when none are given."""
        return cls()

    def with_horizon(self, horizon: float | None) -> PyramidParams:
        """Return the same for a horizon that is known to 6% of the height; None changes nothing."""
        if horizon is None:
            return self
        return dataclasses.replace(self, horizon=horizon, horizon_tolerance=_KNOWN)

    def sizes(self, columns: float, rows: float, shape: tuple[int, ...]) -> list[float]:
        """Pixels a cell of each level, for boxes of `columns` by `rows` cells in a frame of `shape`."""
        least = self.min_width / columns
        most = max(self.max_height * shape[0] / rows, least)
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
        slack = self.horizon_tolerance * shape[0]
        top = (self.horizon * shape[0]) + near - slack - height
        bottom = (self.horizon * shape[0]) + far + slack
        return max(0, math.floor(top)), min(shape[0], math.ceil(bottom))
