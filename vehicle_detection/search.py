"""The fast search: features shared by all windows of a band, with the SVM as a filter over them.

Scaler and SVM fold into one affine function of the feature vector (`Template.fold`). A band of the frame is
resized once so that a window is 64x64; then each part of the vector becomes channels over the band's cells,
and each part of the weights a filter over 8x8 cells:

- HOG: a channel for each color channel, position in the block and orientation, normalized once for all
windows.
- Spatial bins: a channel for each color channel and position of a bin in its cell.
- Color histogram: one channel, the sum of the looked-up weights of a cell's pixel values; no histogram is
  computed. With `hist_sqrt`, which is not linear in the counts, histograms slide over the band instead.
- Coarse HOG: channels of cells averaged over 2x2 at every cell; the filter has a dilation of two cells.

The correlation of channels and filters gives the scores of all windows. Dalal and Triggs (CVPR 2005) for HOG;
Felzenszwalb et al. (PAMI 2010), section 3, for linear templates as filters over a feature map.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection import _kernels as kernels
from vehicle_detection._common import Closing, ThreadTeam, Workspace, check, fields, single_threaded_opencv
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE, FeatureParams, convert_color, hog_source

REFERENCE_WIDTH = 1280
"""Search windows are given in pixels of a frame whose longer side has this length."""

_SIMILAR_SIDES = 1.5  # windows of sides that differ by at most this factor fire on the same vehicle
_MIN_STEP = 1 / 8  # the fast search steps by one cell, an eighth of a window, or more

Pair = tuple[float, float]


def _pair(*, low: float, high: float) -> Callable[[Any, str], Pair]:
    def pair(value: Any, name: str) -> Pair:
        if not isinstance(value, tuple) or len(value) != 2:
            raise InvalidInputError(f"{name} must be a pair of numbers, got {check.describe(value)}")
        for index, each in enumerate(value):
            check.number(each, f"{name}[{index}]", low=low, high=high)
        return value

    return pair


def _check_bands(bands: Any, name: str) -> tuple[SearchBand, ...]:
    if not (isinstance(bands, (tuple, list)) and bands and all(isinstance(b, SearchBand) for b in bands)):
        raise check.invalid(name, "be a tuple of SearchBand, at least one", bands)
    return tuple(bands)


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
class SearchBand(fields.Checked):
    """Windows of one size in a horizontal band, in pixels of a frame whose longer side is 1280.

    Attributes
    ----------
    window, overlap
        Width and height of the windows, and the overlap of neighbors as fractions of these, 0 to 0.99.
    y, x
        Top and bottom of the band relative to the horizon, positive downwards; left and right end as
        fractions of the frame's width, 0-1.

    Examples
    --------
    >>> SearchBand(window=(96, 96), y=(-16, 128), overlap=(0.75, 0.75)).x
    (0.0, 1.0)
    """

    window: tuple[float, float] = fields.checked_field(MISSING, _pair(low=8, high=4096))
    y: tuple[float, float] = fields.checked_field(MISSING, _pair(low=-4096, high=4096))
    x: tuple[float, float] = fields.checked_field((0.0, 1.0), _pair(low=0, high=1))
    overlap: tuple[float, float] = fields.checked_field((0.875, 0.875), _pair(low=0, high=0.99))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (start, stop) in (("x", self.x), ("y", self.y)):
            if start >= stop:
                raise check.invalid(name, "be (start, stop) with start < stop", (start, stop))

    def place(
        self, shape: tuple[int, ...], horizon: float, horizontal_padding: float = 0.0
    ) -> PixelBand | None:
        """Place the band on a frame of `shape` (height, width, ...); None if no window fits.

        A band that ends at the frame's left or right border extends beyond it by `horizontal_padding` of a
        window's width.
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
class SearchParams(fields.Checked):
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

    bands: tuple[SearchBand, ...] = fields.checked_field(MISSING, _check_bands)
    horizon: float = fields.number(0.58, low=0, high=1)
    min_score: float = fields.number(0.0, low=-1e6, high=1e6)
    horizontal_padding: float = fields.number(0.0, low=0, high=0.9)

    @classmethod
    def default(cls) -> SearchParams:
        """Return the preset ``"default"``."""
        return cls.preset()

    @classmethod
    def preset(cls, name: str = "default") -> SearchParams:
        """Return the preset of this name; "default" suits any dash-cam.

        `"130-windows"` are the windows of the course's first system, `"three-scales"` those of the third
        (docs/results.md).
        """
        presets = {"three-scales": _three_scales, "130-windows": _window_list, "default": _default_bands}
        check.choice(name, "preset", presets)
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
        covers = [math.prod(1 / max(1 - part, _MIN_STEP) for part in band.overlap) for band in self.bands]
        similar = [
            cover
            for side in sides
            for other, cover in zip(sides, covers)
            if max(side, other) <= _SIMILAR_SIDES * min(side, other)
        ]
        return sum(similar) / len(self.bands)

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


def _window_list() -> SearchParams:
    """Four sizes of windows, each with its band and overlap, in the right half of the frame."""
    table = (
        ((96.0, 96.0), (-5.0, 130.0), (0.9, 0.5)),
        ((110.0, 145.0), (-20.0, 190.0), (0.7, 0.6)),
        ((155.0, 165.0), (-30.0, 190.0), (0.6, 0.5)),
        ((170.0, 200.0), (0.0, 300.0), (0.6, 0.5)),
    )
    bands = tuple(SearchBand(window=w, y=y, x=(650 / 1280, 1.0), overlap=overlap) for w, y, overlap in table)
    return SearchParams(bands=bands, horizon=400 / 720)


def _three_scales() -> SearchParams:
    """Windows of 96, 64 and 51 pixels in steps of an eighth, in the 256 rows below the horizon."""
    bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in (1.5, 1.0, 0.8))
    return SearchParams(bands=bands, horizon=400 / 720)


def _default_bands() -> SearchParams:
    """Windows from 64 pixels up, in steps of 1.25, wherever a vehicle on a flat road may be.

    With the camera `c` meters above the road, the bottom of a vehicle whose face fills 0.84 of a window of
    side `s` is ``0.84 * s * c / 1.8`` below the horizon, and 0.855 `s` below the window's top
    (`RegionParams`). For cameras at 1.1 to 1.7 m the window is between -0.35 `s` and 0.95 `s`; the margin
    allows for other heights, hills and an inexact horizon.
    """
    sides = [64.0 * 1.25**step for step in range(8)]
    bands = tuple(SearchBand(window=(side, side), y=(-0.35 * side - 16, 0.95 * side + 16)) for side in sides)
    return SearchParams(bands=bands, horizontal_padding=0.5)


@dataclass(frozen=True, eq=False, repr=False)
class SearchResult:
    """The result of searching one frame; it depends on no other frame.

    Attributes
    ----------
    windows
        Windows with a score above the search's minimum.
    vehicles
        Vehicle boxes, if the model predicts them; None if they are derived from the windows. Scores below 0
        are kept for tracking only.
    shape, seconds
        ``(height, width)`` of the frame, and the duration of the search.
    gray
        The frame in gray, at most 640 pixels long, from which a tracker measures speeds; None without one.

    Examples
    --------
    >>> from vehicle_detection import Detector, read_image
    >>> found = Detector("highway").search(read_image("test_images/road1.jpg"))
    >>> found.shape, found.vehicles  # the boxes are derived from the windows
    ((720, 1280), None)
    """

    windows: Detections
    vehicles: Detections | None
    shape: tuple[int, int]
    seconds: float
    gray: NDArray[np.uint8] | None = None

    def enlarged(self, factor: int) -> Self:
        """Return the result for a frame that was reduced by a whole factor before the search."""
        windows, vehicles = self.windows, self.vehicles
        if vehicles is not None:
            vehicles = vehicles.with_columns(boxes=vehicles.boxes * factor)
        return dataclasses.replace(
            self,
            windows=windows.with_columns(boxes=windows.boxes * factor),
            vehicles=vehicles,
            shape=(self.shape[0] * factor, self.shape[1] * factor),
        )

    def __repr__(self) -> str:
        return f"SearchResult(windows={self.windows}, vehicles={self.vehicles}, shape={self.shape})"


class FrameSearch(Closing, ABC):
    """What ``model.open_search()`` returns: a thread-safe context manager that keeps threads and memory."""

    params_type: ClassVar[type[Any]]

    def __init__(self, jobs: int | None) -> None:
        self._team = ThreadTeam(jobs, name="search")
        self.workspace = Workspace()

    def find(
        self, frame: NDArray[np.uint8], params: Any = None, *, min_vehicle_score: float = 0.0
    ) -> SearchResult:
        """Search a frame for windows and vehicles.

        Parameters
        ----------
        frame, params
            ``(H, W, 3)`` uint8 RGB, and `SearchParams`, `NetworkParams` or `FunctionParams`, depending on the
            model; the default suits any dash-cam.
        min_vehicle_score
            Minimum score of a vehicle, without effect if vehicles are derived from the windows.
        """
        start = time.perf_counter()
        height, width, _ = check.image(frame, "frame").shape
        params = self.params_type.default() if params is None else params
        check.instance(params, "params", self.params_type, "omit it for the default")
        min_score = check.number(min_vehicle_score, "min_vehicle_score")
        windows, vehicles = self._search(frame, params, min_score)
        return SearchResult(windows, vehicles, (height, width), time.perf_counter() - start)

    def reduction(self, shape: tuple[int, ...], params: Any) -> int:
        """Whole factor by which the search reduces frames of this shape first."""
        return 1

    @abstractmethod
    def _search(
        self, frame: NDArray[np.uint8], params: Any, min_vehicle_score: float
    ) -> tuple[Detections, Detections | None]:
        """Windows and vehicles of a valid frame."""

    def close(self) -> None:
        """Stop the threads; they start again on the next search."""
        self._team.close()


class BandSearch(FrameSearch):
    """The fast search with one template or a few that share the features of a band."""

    params_type = SearchParams

    def __init__(self, filters: BandFilters, jobs: int | None = None) -> None:
        super().__init__(jobs)
        self.filters = filters

    def _search(
        self, frame: NDArray[np.uint8], params: SearchParams, min_vehicle_score: float
    ) -> tuple[Detections, None]:
        return self.find_windows(frame, params), None

    def find_windows(self, image: NDArray[np.uint8], params: SearchParams) -> Detections:
        """Windows of all bands that score above ``params.min_score``."""
        check.image(image)
        check.instance(params, "params", SearchParams, 'pass SearchParams.preset("default")')
        bands = params.place(image.shape)
        cell, min_score = self.filters.params.pix_per_cell, float(params.min_score)
        with single_threaded_opencv():
            parts = self._team.map(
                lambda band: _hits(self.score_map(image, band), band, cell, min_score),
                bands,
                cost=lambda band: math.prod(resized_shape(band)),
            )
        boxes, scores = zip(*parts)
        return Detections(np.concatenate(boxes), np.concatenate(scores))

    def score_map(self, image: NDArray[np.uint8], band: PixelBand) -> NDArray[np.float32]:
        """Score of every window of a band, ``(rows, columns)`` float32; the maximum of several templates.

        Entry ``[i, j]`` is the window that starts at row `i` and column `j` of the resized band's cells.
        """
        return self.filters.score_map(resize_band(image, band))


def resized_shape(band: PixelBand) -> tuple[int, int]:
    """Height and width of a band after resizing its windows to 64x64."""
    width = round((band.x2 - band.x1) * PATCH_SIZE / band.window[0])
    height = round((band.y2 - band.y1) * PATCH_SIZE / band.window[1])
    return max(height, PATCH_SIZE), max(width, PATCH_SIZE)


def resize_band(image: NDArray[np.uint8], band: PixelBand) -> NDArray[np.uint8]:
    """Crop a band and resize it so that its windows are 64x64; columns beyond the frame are replicated."""
    height, width = resized_shape(band)
    scale = PATCH_SIZE / band.window[0]
    left = round(max(0, -band.x1) * scale)
    right = round(max(0, band.x2 - image.shape[1]) * scale)
    strip = image[band.y1 : band.y2, max(0, band.x1) : band.x2]
    size = (width - left - right, height)
    if size != (strip.shape[1], strip.shape[0]):
        strip = np.asarray(cv2.resize(strip, size), np.uint8)
    if not left and not right:
        return strip
    # Replication adds no gradient at the frame's border.
    return np.asarray(cv2.copyMakeBorder(strip, 0, 0, left, right, cv2.BORDER_REPLICATE), np.uint8)


def _hits(
    scores: NDArray[np.float32], band: PixelBand, cell: int, min_score: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Boxes in pixels of the frame and scores of the windows of a score map above `min_score`."""
    height, width = resized_shape(band)
    scale_x, scale_y = (band.x2 - band.x1) / width, (band.y2 - band.y1) / height
    # Steps in pixels of the frame become whole cells of the resized band.
    step_x, step_y = (
        max(1, round(step / (cell * scale))) for step, scale in zip(band.step, (scale_x, scale_y))
    )
    grid = scores[::step_y, ::step_x]
    rows, columns = (grid > min_score).nonzero()
    boxes = np.empty((len(rows), 4))
    boxes[:, 0] = columns * (step_x * cell) * scale_x + band.x1
    boxes[:, 1] = rows * (step_y * cell) * scale_y + band.y1
    boxes[:, 2] = boxes[:, 0] + scale_x * PATCH_SIZE
    boxes[:, 3] = boxes[:, 1] + scale_y * PATCH_SIZE
    return boxes, grid[rows, columns].astype(np.float64)


Filter = tuple[NDArray[np.float32], int]
_to_float32 = functools.partial(np.ascontiguousarray, dtype=np.float32)


class BandFilters:
    """Affine functions of a feature vector, each ``(weights, bias)``, as filters over cells.

    It equals a feature vector of `course.reference.find_car_windows` times the weights, for each window.
    """

    def __init__(self, params: FeatureParams, functions: Sequence[tuple[NDArray[np.float64], float]]) -> None:
        self.params = params
        self._workspace = Workspace()
        _check_shareable(params)
        self.cells_per_window = params.cells  # along a side
        self.bins_per_cell = params.spatial_size // params.cells
        # Look up weights by pixel value, or, as roots of counts are not linear in these, count each window.
        self.hist_roots = params.hist_feat and params.hist_sqrt
        self.hist_lookup = params.hist_feat and not params.hist_sqrt
        self.coarse = params.coarse_blocks if params.hog_feat else 0
        self.bins = kernels.bin_of_value(params.hist_bins)
        self.biases = [bias for _, bias in functions]
        self.filters = [self._build_filters(weights) for weights, _ in functions]
        hist = slice(params.spatial_length, params.spatial_length + params.hist_length)
        # Every template has its own table of weights by pixel value, and so its own histogram channel.
        by_bin = np.array([weights[hist] for weights, _ in functions], np.float32)
        self.weights_by_bin = by_bin = by_bin.reshape(len(functions), 3, -1)
        self.tables = by_bin[:, :, self.bins] if self.hist_lookup else None

    def _build_filters(self, weights: NDArray[np.float64]) -> list[Filter]:
        """Weights ``(rows, columns, channels)`` and dilation over HOG, coarse HOG, and bins and histogram."""
        params, cells, bins = self.params, self.cells_per_window, self.bins_per_cell
        filters = []
        # The vector is spatial bins, histogram, HOG, coarse HOG.
        if params.hog_feat:
            start, stop = params.length - params.hog_length, params.length - params.coarse_length
            for positions, part, dilation in (
                (params.blocks, weights[start:stop], 1),
                (self.coarse, weights[stop:], 2),
            ):
                if positions:
                    # (channel, block row, block column, values in the block) to
                    # (block row, block column, channel and values), the order of `_hog_maps`.
                    blocks = part.reshape(params.hog_channels, positions, positions, -1).transpose(1, 2, 0, 3)
                    filters.append((_to_float32(blocks.reshape(positions, positions, -1)), dilation))
        values = []
        if params.spatial_feat:
            planes = params.spatial_planes(weights[: params.spatial_length])
            # (color, cell row, bin row, cell column, bin column) to
            # (cell row, cell column, color, bin row, bin column).
            part = planes.reshape(3, cells, bins, cells, bins)
            values.append(part.transpose(1, 3, 0, 2, 4).reshape(cells, cells, -1))
        if self.hist_lookup:
            values.append(np.ones((cells, cells, 1)))
        return [*filters, (_to_float32(np.concatenate(values, axis=2)), 1)] if values else filters

    def score_map(self, band: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Scores of all windows of a resized band as a new ``(rows, columns)`` float32 array."""
        params = self.params
        converted = {space: convert_color(band, space) for space in params.used_color_spaces}
        source = hog_source(band, params, converted.get(params.color_space)) if params.hog_feat else None
        spatial, hist = (converted.get(space, band) for space in (params.spatial_space, params.hist_space))
        return self.score_images(source, spatial, hist, self.tables)

    def score_images(
        self,
        source: NDArray[Any] | None,
        spatial: NDArray[Any],
        hist: NDArray[Any],
        tables: NDArray[np.float32] | None,
    ) -> NDArray[np.float32]:
        """Scores of all windows from the images of HOG, spatial bins and histogram, ``(H, W, channels)``.

        `tables` is ``(templates, 3, values)``, the histogram's weight of each value of the integers `hist`.
        """
        cell, side = self.params.pix_per_cell, self.cells_per_window
        maps = [] if source is None else self._hog_maps(source)
        if self.params.spatial_feat or self.hist_lookup:
            maps.append(self._value_map(spatial))
        rows, columns = (length // cell - side + 1 for length in spatial.shape[:2])
        scores = np.empty((len(self.filters), rows, columns), np.float32)
        for template, (filters, bias) in enumerate(zip(self.filters, self.biases)):
            scores[template] = bias
            if tables is not None:
                # The last channel of the last map is the histogram's; each template fills it again.
                kernels.histogram_cells(hist, tables[template], cell, maps[-1][-1])
            for (weights, dilation), channels in zip(filters, maps):
                kernels.add_correlation(channels, weights, dilation, scores[template])
        if self.hist_roots:
            kernels.add_root_histograms(hist, self.weights_by_bin, cell, side, scores)
        return scores[0] if len(scores) == 1 else np.asarray(scores.max(axis=0))

    def _hog_maps(self, source: NDArray[Any]) -> list[NDArray[np.float32]]:
        """Compute the blocks of HOG and, if used, of coarse HOG; each ``(channels, rows, columns)``."""
        params, workspace = self.params, self._workspace
        options = params.orient, params.pix_per_cell, params.transform_sqrt
        cells = kernels.hog_cells(source, *options, workspace)
        maps = [kernels.hog_blocks(cells, params.cell_per_block, 1, workspace)]
        if self.coarse:
            pooled = kernels.pool_cells(cells, workspace)
            maps.append(kernels.hog_blocks(pooled, params.cell_per_block, 2, workspace))
        return [blocks.reshape(-1, *cells.shape[2:]) for blocks in maps]

    def _value_map(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """Spatial bins of each cell ``(channels, rows, columns)`` and, last, a channel for the histogram."""
        cell, bins = self.params.pix_per_cell, self.bins_per_cell
        rows, columns = image.shape[0] // cell, image.shape[1] // cell
        count = 3 * bins**2 if self.params.spatial_feat else 0
        shape = count + self.hist_lookup, rows, columns
        channels: NDArray[np.float32] = self._workspace.take(shape, np.float32, "values")
        if count:
            small = cv2.resize(image[: rows * cell, : columns * cell], (columns * bins, rows * bins))
            # (cell row, bin row, cell column, bin column, color) to (color, bin row, bin column, cells)
            split = small.reshape(rows, bins, columns, bins, 3).transpose(4, 1, 3, 0, 2)
            channels[:count] = split.reshape(count, rows, columns)
        return channels


def _check_shareable(params: FeatureParams) -> None:
    """Reject features that windows cannot share exactly."""
    cell, size = params.pix_per_cell, params.spatial_size
    if PATCH_SIZE % cell:
        problem = f"HOG cells in a window of {PATCH_SIZE} pixels, got pix_per_cell={cell}"
    elif params.spatial_feat and (size % params.cells or PATCH_SIZE % size):
        problem = f"spatial bins in a cell of {cell} pixels, got spatial_size={size}"
    else:
        return
    raise InvalidInputError(f"find_cars needs whole {problem}; use search_windows, or other parameters")
