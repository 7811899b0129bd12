"""The parameters of every stage: frozen, validated, with the presets of the three course systems."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from vehicle_detection._checks import check_choice, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

PATCH_SIZE = 64
"""Width and height in pixels of a training patch and of a window once it is resized."""

REFERENCE_WIDTH = 1280
"""Search windows are given in pixels of a frame whose longer side is this long."""

COLOR_SPACES = ("RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")
HOG_CHANNELS: tuple[int | str, ...] = (0, 1, 2, "ALL", "GRAY")

Pair = tuple[float, float]


def _check_pair(value: object, name: str, *, low: float, high: float) -> None:
    if not isinstance(value, tuple) or len(value) != 2:
        raise InvalidInputError(f"{name} must be a pair of numbers, got {describe(value)}")
    for index, number in enumerate(value):
        check_number(number, f"{name}[{index}]", low=low, high=high)


@dataclass(frozen=True, kw_only=True)
class FeatureParams:
    """What a 64x64 patch is turned into: ``[spatial | histogram | HOG]``, each channel by channel.

    Attributes
    ----------
    color_space
        Space of the spatial bins, the histograms and HOG: one of ``COLOR_SPACES``.
    spatial_feat, hist_feat, hog_feat
        Switches for the three parts.
    spatial_size
        Side of the grid of spatial bins; ``spatial_size**2 * 3`` values.
    hist_bins
        Bins of each channel's histogram over 0-255.
    orient
        HOG orientations over 0-180 degrees.
    pix_per_cell
        Side of a HOG cell in pixels.
    cell_per_block
        Side of a HOG block in cells.
    hog_channel
        0, 1, 2, ``"ALL"``, or ``"GRAY"`` (HOG of the gray image, whatever `color_space`).
    transform_sqrt
        HOG of the square root of the pixel values.

    Examples
    --------
    >>> FeatureParams.preset("ycrcb-6156").length
    6156
    >>> FeatureParams(orient=12, hog_channel=0).hog_length
    2352
    """

    color_space: str = "YCrCb"
    spatial_feat: bool = True
    hist_feat: bool = True
    hog_feat: bool = True
    spatial_size: int = 16
    hist_bins: int = 32
    orient: int = 9
    pix_per_cell: int = 8
    cell_per_block: int = 2
    hog_channel: int | Literal["ALL", "GRAY"] = "ALL"
    transform_sqrt: bool = False

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "luv-2384": {
            "color_space": "LUV",
            "hist_bins": 16,
            "orient": 8,
            "hog_channel": 0,
            "transform_sqrt": True,
        },
        "ycrcb-6156": {},
        "ycrcb-8460": {"spatial_size": 32},
    }

    def __post_init__(self) -> None:
        check_choice(self.color_space, "color_space", COLOR_SPACES)
        for name in ("spatial_feat", "hist_feat", "hog_feat", "transform_sqrt"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidInputError(f"{name} must be True or False; got {describe(getattr(self, name))}")
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; switch one on")
        check_integer(self.spatial_size, "spatial_size", low=1, high=PATCH_SIZE)
        check_integer(self.hist_bins, "hist_bins", low=1, high=256)
        check_integer(self.orient, "orient", low=1, high=180)
        check_integer(self.pix_per_cell, "pix_per_cell", low=2, high=PATCH_SIZE)
        most = PATCH_SIZE // self.pix_per_cell
        check_integer(self.cell_per_block, "cell_per_block", low=1, high=most)
        check_choice(self.hog_channel, "hog_channel", HOG_CHANNELS)

    @classmethod
    def preset(cls, name: str) -> FeatureParams:
        """Parameters of a course system: ``"luv-2384"``, ``"ycrcb-6156"`` or ``"ycrcb-8460"``."""
        check_choice(name, "preset", cls.PRESETS)
        return cls(**cls.PRESETS[name])

    @property
    def hog_channels(self) -> int:
        """Number of channels that HOG sees."""
        return 3 if self.hog_channel == "ALL" else 1

    @property
    def cells(self) -> int:
        """HOG cells along a side of the patch."""
        return PATCH_SIZE // self.pix_per_cell

    @property
    def blocks(self) -> int:
        """HOG block positions along a side of the patch."""
        return self.cells - self.cell_per_block + 1

    @property
    def spatial_length(self) -> int:
        """Values from spatial bins."""
        return self.spatial_size**2 * 3 if self.spatial_feat else 0

    @property
    def hist_length(self) -> int:
        """Values from colour histograms."""
        return self.hist_bins * 3 if self.hist_feat else 0

    @property
    def hog_length(self) -> int:
        """Values from HOG."""
        values = self.blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values if self.hog_feat else 0

    @property
    def length(self) -> int:
        """Length of the feature vector."""
        return self.spatial_length + self.hist_length + self.hog_length


@dataclass(frozen=True)
class PixelBand:
    """A search band placed on one frame: all integer pixels of that frame.

    Attributes
    ----------
    x1, y1, x2, y2
        The band's half-open rectangle, inside the frame.
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
        Horizontal and vertical share that neighbouring windows have in common, in [0, 1).
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

    def place(self, shape: tuple[int, ...], horizon: float) -> PixelBand | None:
        """Place the band on a frame of `shape` (height, width); None where no window fits."""
        height, width = shape[:2]
        scale = max(height, width) / REFERENCE_WIDTH
        window_w, window_h = (max(8, round(side * scale)) for side in self.window)
        y1, y2 = (min(max(round(horizon * height + side * scale), 0), height) for side in self.y)
        x1, x2 = round(self.x[0] * width), round(self.x[1] * width)
        if x2 - x1 < window_w or y2 - y1 < window_h:
            return None
        step = (
            max(1, int(window_w * (1 - self.overlap[0]) + 1e-9)),
            max(1, int(window_h * (1 - self.overlap[1]) + 1e-9)),
        )
        return PixelBand(x1, y1, x2, y2, (window_w, window_h), step)


def _third_system() -> dict[str, Any]:
    bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in (1.5, 1.0, 0.8))
    return {"bands": bands, "horizon": 400 / 720, "min_score": 0.0}


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

    Examples
    --------
    >>> search = SearchParams.preset("three-scales")
    >>> search.place((720, 1280))[1]
    PixelBand(x1=0, y1=400, x2=1280, y2=656, window=(64, 64), step=(8, 8))
    """

    bands: tuple[SearchBand, ...]
    horizon: float = 0.56
    min_score: float = 0.0

    def __post_init__(self) -> None:
        if not self.bands or not all(isinstance(band, SearchBand) for band in self.bands):
            raise InvalidInputError(f"bands must be a tuple of SearchBand; got {describe(self.bands)}")
        check_number(self.horizon, "horizon", low=0, high=1)
        check_number(self.min_score, "min_score", low=-1e6, high=1e6)

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
        placed = tuple(band for band in (b.place(shape, self.horizon) for b in self.bands) if band)
        if not placed:
            raise InvalidInputError(
                f"image of {shape[1]}x{shape[0]} pixels holds no search window below the horizon at "
                f"{self.horizon:g} of its height; pass a larger image, another horizon or smaller bands"
            )
        return placed


def _default_search() -> dict[str, Any]:
    sizes = (64.0, 80.0, 100.0, 125.0, 156.0, 195.0, 244.0)
    bands = tuple(SearchBand(window=(side, side), y=(-0.35 * side, 1.05 * side)) for side in sizes)
    return {"bands": bands, "horizon": 0.56}


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
    share
        A region reaches out to this share of its own peak, in [0, 1); 0 is the plain course way.
    """

    weighting: Literal["score", "count"] = "score"
    frames: int = 5
    threshold: float = 2.0
    share: float = 0.35

    def __post_init__(self) -> None:
        check_choice(self.weighting, "weighting", ("score", "count"))
        check_integer(self.frames, "frames", low=1, high=1000)
        check_number(self.threshold, "threshold", low=0, high=1e9)
        check_number(self.share, "share", low=0, high=0.99)


@dataclass(frozen=True, kw_only=True)
class TrackParams:
    """How regions become vehicles; times are in seconds of the video."""

    field_placeholder: float = field(default=0.0, repr=False)
