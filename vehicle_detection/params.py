"""The parameters of every stage: frozen, validated, with the presets of the three course systems."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._checks import check_choice, check_integer, check_number, describe
from vehicle_detection._pyramid_params import PyramidParams as PyramidParams
from vehicle_detection.errors import InvalidInputError

PATCH_SIZE = 64
"""Width and height in pixels of a training patch and of a window once it is resized."""

REFERENCE_WIDTH = 1280
"""Search windows are given in pixels of a frame whose longer side is this long."""

COLOR_SPACES = ("RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")
HOG_CHANNELS: tuple[int | str, ...] = (0, 1, 2, "ALL", "GRAY")

# A window of fewer pixels, blown up to a patch, is a blur.
_LEAST_WINDOW = 16

Pair = tuple[float, float]


def _check_pair(value: object, name: str, *, low: float, high: float) -> None:
    if not isinstance(value, tuple) or len(value) != 2:
        raise InvalidInputError(f"{name} must be a pair of numbers, got {describe(value)}")
    for index, number in enumerate(value):
        check_number(number, f"{name}[{index}]", low=low, high=high)


@dataclass(frozen=True, kw_only=True)
class FeatureParams:
    """What a 64x64 patch is turned into: ``[spatial | histogram | HOG]``, each channel by channel.

    With `coarse_hog` a second, coarser HOG stands at the end: ``[spatial | histogram | HOG | coarse HOG]``.

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
    hist_sqrt
        Square roots of the histogram's counts: a full bin drowns the others less.
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
    coarse_hog
        HOG of cells twice as large, too, as ``2 * pix_per_cell`` would give it: each is four of the cells.
    hist_gain, coarse_gain
        What the scaled histogram and the scaled coarse HOG are multiplied by in training, so that the SVM's
        regularisation holds the few of them back less than the many other values. They change the weights
        alone, not the features and not the time of a search.

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
    hist_sqrt: bool = False
    coarse_hog: bool = False
    hist_gain: float = 1.0
    coarse_gain: float = 1.0

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
        "lab-8460": {"color_space": "LAB", "spatial_size": 32},
        "lab-9432": {
            "color_space": "LAB",
            "spatial_size": 32,
            "hist_sqrt": True,
            "coarse_hog": True,
            "hist_gain": 4.0,
            "coarse_gain": 3.0,
        },
    }

    def __post_init__(self) -> None:
        check_choice(self.color_space, "color_space", COLOR_SPACES)
        switches = ("spatial_feat", "hist_feat", "hog_feat", "transform_sqrt", "hist_sqrt", "coarse_hog")
        for name in switches:
            if not isinstance(getattr(self, name), bool):
                raise InvalidInputError(f"{name} must be True or False; got {describe(getattr(self, name))}")
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; switch one on")
        self._check_integer("spatial_size", 1, PATCH_SIZE)
        self._check_integer("hist_bins", 1, 256)
        self._check_integer("orient", 1, 180)
        self._check_integer("pix_per_cell", 2, PATCH_SIZE)
        self._check_integer("cell_per_block", 1, PATCH_SIZE // self.pix_per_cell)
        check_choice(self.hog_channel, "hog_channel", HOG_CHANNELS)
        if not isinstance(self.hog_channel, str):
            self._check_integer("hog_channel", 0, 2)
        if self.coarse_hog and self.cells // 2 < self.cell_per_block:
            raise InvalidInputError(
                f"coarse_hog must be False where no block of {self.cell_per_block} cells of "
                f"{2 * self.pix_per_cell} pixels fits into a patch; got True"
            )

        for name in ("hist_gain", "coarse_gain"):
            gain = check_number(getattr(self, name), name, low=0.01, high=100)
            object.__setattr__(self, name, float(gain))

    def _check_integer(self, name: str, low: int, high: int) -> None:
        # A plain int replaces one of numpy, which the JSON of a model file does not take.
        object.__setattr__(self, name, check_integer(getattr(self, name), name, low=low, high=high))

    @classmethod
    def preset(cls, name: str) -> FeatureParams:
        """Parameters of a course system or of the shipped model.

        ``"luv-2384"``, ``"ycrcb-6156"`` and ``"ycrcb-8460"`` are the three systems' of the course;
        ``"lab-9432"`` is the shipped highway model's: roots of the histogram and a coarse HOG beside what
        ``"lab-8460"`` has.
        """
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
    def coarse_blocks(self) -> int:
        """Block positions of the coarse HOG along a side of the patch, 0 without it."""
        return self.cells // 2 - self.cell_per_block + 1 if self.coarse_hog else 0

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
        """Values from HOG, the coarse ones included."""
        values = self.blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values + self.coarse_length if self.hog_feat else 0

    @property
    def coarse_length(self) -> int:
        """Values from the coarse HOG, at the end of the vector."""
        values = self.coarse_blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values if self.hog_feat else 0

    @property
    def length(self) -> int:
        """Length of the feature vector."""
        return self.spatial_length + self.hist_length + self.hog_length

    @property
    def gains(self) -> NDArray[np.float64]:
        """What each scaled value is multiplied by in training, ``(length,)`` float64."""
        gains = np.ones(self.length)
        gains[self.spatial_length :][: self.hist_length] = self.hist_gain
        gains[self.length - self.coarse_length :] = self.coarse_gain
        return gains


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

    def place(self, shape: tuple[int, ...], horizon: float, overhang: float = 0.0) -> PixelBand | None:
        """Place the band on a frame of `shape` (height, width); None where no window fits."""
        height, width = shape[:2]
        scale = max(height, width) / REFERENCE_WIDTH
        window_w, window_h = (round(side * scale) for side in self.window)
        y1, y2 = (min(max(round(horizon * height + side * scale), 0), height) for side in self.y)
        x1, x2 = round(self.x[0] * width), round(self.x[1] * width)
        if min(window_w, window_h) < _LEAST_WINDOW or x2 - x1 < window_w or y2 - y1 < window_h:
            return None
        beyond = round(overhang * window_w)
        x1 -= beyond if x1 == 0 else 0
        x2 += beyond if x2 == width else 0
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
    overhang
        Share of a window that may lie beyond the frame's left and right edge, where the outermost column
        is repeated: vehicles that are half in the picture are found.

    Examples
    --------
    >>> search = SearchParams.preset("three-scales")
    >>> search.place((720, 1280))[1]
    PixelBand(x1=0, y1=400, x2=1280, y2=656, window=(64, 64), step=(8, 8))
    """

    bands: tuple[SearchBand, ...]
    horizon: float = 0.58
    min_score: float = 0.0
    overhang: float = 0.0

    def __post_init__(self) -> None:
        bands: object = self.bands
        if not isinstance(bands, (tuple, list)) or not all(isinstance(band, SearchBand) for band in bands):
            raise InvalidInputError(f"bands must be a tuple of SearchBand; got {describe(bands)}")
        if not bands:
            raise InvalidInputError("bands must be a tuple of SearchBand, at least one; got none")
        object.__setattr__(self, "bands", tuple(bands))
        check_number(self.horizon, "horizon", low=0, high=1)
        check_number(self.min_score, "min_score", low=-1e6, high=1e6)
        check_number(self.overhang, "overhang", low=0, high=0.9)

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
        return (band.place(shape, self.horizon, self.overhang) for band in self.bands)


def _default_search() -> dict[str, Any]:
    """Windows from 64 px up in even steps of scale, wherever a vehicle on a flat road may stand.

    With the camera `c` metres above the road, the foot of a vehicle whose face fills 0.84 of a window of
    side `s` is ``0.84 * s * c / 1.8`` below the horizon. For cameras from 0.9 to 2 m high that puts the
    window between -0.35 and 0.95 `s`; the margin allows for hills and for a horizon that is not exact.
    """
    margin = 16.0
    sides = [64.0 * 1.25**step for step in range(8)]
    bands = tuple(
        SearchBand(window=(side, side), y=(-0.35 * side - margin, 0.95 * side + margin)) for side in sides
    )
    return {"bands": bands, "horizon": 0.58, "min_score": 0.0, "overhang": 0.5}


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
        Windows with a centre this near to a group's are used up by it.
    face_width, face_height
        Part of the window that a vehicle's face fills, on the training patches and their like.
    drop
        How far the face's middle lies below the window's.
    flank_length_m
        Length of a vehicle's flank in metres, as far as it shows.
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
    drop: float = -0.04
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
        check_number(self.drop, "drop", low=-1, high=1)
        check_number(self.flank_length_m, "flank_length_m", low=0, high=100)


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
    birth_score
        Detections below this score keep a track alive but start none.
    confirm_score
        Running mean of the scores at which a track is believed. A vehicle of score `s` reaches it after
        ``memory * log(s / (s - confirm_score))`` seconds, one that scores less never does. Both shipped
        models put the least score of a vehicle at 0. With the mixture, whose scores are log-odds, vehicles
        of drives that it was not tuned on score 1 to 8, half of them above 5, and false boxes seldom 0.7; at
        0 instead of 0.35, with boxes down to -1.5 taken too, a quarter of the missed vehicles were found but
        ten times as many false ones. With the model for highways, a true but far vehicle of a real road may
        score as little as a false box of another: 0.7 would miss it.
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
        Farthest that a detection's centre may lie from the predicted one, in box widths and heights.
    max_overlap, max_cover
        A second box on one vehicle: IoU with a track, and share of the smaller of the two boxes that both
        cover, above which a detection starts no track of its own.
    box_noise
        Standard error of a detection's edges.
    box_noise_seconds
        Time over which that error stays alike, so that twice the frames are not twice the evidence.
    agility, growth
        Process noise of the centre and of the size: their speeds wander by this share of the size a second,
        in a second.
    history
        Length of the mean of the smoother ``"history"``.
    nearest_share
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
    birth_score: float = 0.0
    confirm_score: float = 0.35
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
    agility: float = 0.18
    growth: float = 0.1
    history: float = 0.4
    nearest_share: float = 0.3

    def __post_init__(self) -> None:
        check_choice(self.smoother, "smoother", ("kalman", "history", "nearest"))
        for name in ("memory", "max_gap", "history"):
            check_number(getattr(self, name), name, above=0, high=3600)
        for name in ("confirm_seconds", "tentative_coast", "show_coast", "max_coast", "box_noise_seconds"):
            check_number(getattr(self, name), name, low=0, high=3600)
        for name in ("birth_score", "confirm_score", "start_score"):
            check_number(getattr(self, name), name, low=-1e6, high=1e6)
        for name in ("gate", "agility", "growth"):
            check_number(getattr(self, name), name, above=0, high=100)
        for name in ("max_overlap", "max_cover"):
            check_number(getattr(self, name), name, low=0, high=1)
        check_integer(self.confirm_hits, "confirm_hits", low=1, high=10_000)
        check_number(self.box_noise, "box_noise", above=0, high=1)
        check_number(self.nearest_share, "nearest_share", above=0, high=1)
        if self.show_coast > self.max_coast:
            raise InvalidInputError(
                f"show_coast must be at most max_coast, as a track that ended is not drawn; "
                f"got {self.show_coast:g} and {self.max_coast:g}; change both"
            )
