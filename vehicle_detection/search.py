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

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    NEW_ARRAYS,
    Closing,
    ThreadTeam,
    Workspace,
    check_image,
    check_number,
    check_type,
    single_threaded_opencv,
)
from vehicle_detection._kernels import (
    Filter,
    bin_of_value,
    degree_bounds,
    orientation_cotangents,
    sqrt_gradients,
)
from vehicle_detection._kernels import histogram as _histogram_kernels
from vehicle_detection._kernels import hog as _hog_kernels
from vehicle_detection.boxes import Detections
from vehicle_detection.classifier import CLASSIFIER_REMEDY, VehicleClassifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import convert_color, hog_source, pick_hog_channels
from vehicle_detection.images import make_thumbnail
from vehicle_detection.params import (
    PATCH_SIZE,
    FeatureParams,
    PixelBand,
    SearchParams,
)
from vehicle_detection.windows import band_windows, search_windows


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
    shape
        ``(height, width)`` of the frame.
    thumbnail
        ``(18, 32)`` float32 gray copy of the frame, for detecting scene cuts.
    seconds
        Duration of the search.
    """

    windows: Detections
    vehicles: Detections | None
    shape: tuple[int, int]
    thumbnail: NDArray[np.float32]
    seconds: float

    def __repr__(self) -> str:
        return f"SearchResult(windows={self.windows}, vehicles={self.vehicles}, shape={self.shape})"


class FrameSearch(Closing, ABC):
    """What ``model.open_search()`` returns for every kind of model: threads and memory kept between frames.

    Searches are thread-safe context managers.
    """

    params_type: ClassVar[type[Any]]

    def __init__(self, n_jobs: int | None) -> None:
        self._team = ThreadTeam(n_jobs, name="search")
        self.workspace = Workspace()

    def find(
        self, frame: NDArray[np.uint8], params: Any = None, *, min_vehicle_score: float = 0.0
    ) -> SearchResult:
        """Search a frame for windows and vehicles.

        Parameters
        ----------
        frame
            ``(H, W, 3)`` uint8 RGB.
        params
            `SearchParams`, `NetworkParams` or `FunctionParams`, depending on the model; the default suits any
            dash-cam.
        min_vehicle_score
            Minimum score of a vehicle. It has no effect if vehicles are derived from the windows.

        Raises
        ------
        InvalidInputError
            If an argument is malformed, or a search with `SearchParams` has no window in the frame.
        """
        start = time.perf_counter()
        check_image(frame, "frame")
        params = self.params_type.default() if params is None else params
        check_type(params, "params", self.params_type, "omit it for the default")
        min_score = check_number(min_vehicle_score, "min_vehicle_score")
        windows, vehicles = self._search(frame, params, min_score)
        thumbnail, shape = make_thumbnail(frame), (frame.shape[0], frame.shape[1])
        return SearchResult(windows, vehicles, shape, thumbnail, time.perf_counter() - start)

    @abstractmethod
    def _search(
        self, frame: NDArray[np.uint8], params: Any, min_vehicle_score: float
    ) -> tuple[Detections, Detections | None]:
        """Windows and vehicles of a valid frame."""

    def close(self) -> None:
        """Stop the threads; they start again on the next search."""
        self._team.close()


def find_cars(
    image: NDArray[np.uint8],
    classifier: VehicleClassifier,
    params: SearchParams | None = None,
    *,
    n_jobs: int | None = None,
) -> Detections:
    """Find the windows of a frame that look like vehicles.

    Scores equal those of `search_windows` with ``border="image"`` on each resized band within 1e-4.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    classifier
        The trained model.
    params
        Bands and minimum score; the default is ``SearchParams.preset("default")``. Steps between windows
        are rounded to whole cells, at least one.
    n_jobs
        Threads, each of which searches a band; the result does not depend on them.

    Returns
    -------
    Detections
        Float boxes in pixels of the image and scores, ordered by band and row.

    Raises
    ------
    InvalidInputError
        If the image is malformed or smaller than a window, or windows cannot share the features exactly.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> len(find_cars(np.zeros((720, 1280, 3), np.uint8), load_classifier()))
    0
    """
    with BandSearch(classifier, n_jobs=n_jobs) as search:
        return search.find_windows(image, SearchParams.preset() if params is None else params)


class BandSearch(FrameSearch):
    """The fast search with one template or a few that share the features of a band."""

    params_type = SearchParams

    def __init__(self, classifier: VehicleClassifier, *, n_jobs: int | None = None) -> None:
        check_type(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
        super().__init__(n_jobs)
        self.filters = _Filters(classifier)

    def _search(
        self, frame: NDArray[np.uint8], params: SearchParams, min_vehicle_score: float
    ) -> tuple[Detections, None]:
        return self.find_windows(frame, params), None

    def find_windows(self, image: NDArray[np.uint8], params: SearchParams) -> Detections:
        """Windows of all bands that score above ``params.min_score``."""
        check_image(image)
        check_type(params, "params", SearchParams, 'pass SearchParams.preset("default")')
        bands = params.place(image.shape)
        cell, min_score = self.filters.params.pix_per_cell, float(params.min_score)
        with single_threaded_opencv():
            parts = self._team.map(
                lambda band: _hits(self.score_map(image, band), band, cell, min_score), bands, cost=_cost
            )
        boxes, scores = zip(*parts)
        return Detections(np.concatenate(boxes), np.concatenate(scores))

    def score_map(self, image: NDArray[np.uint8], band: PixelBand) -> NDArray[np.float32]:
        """Score of every window of a band at a step of one cell, ``(rows, columns)`` float32.

        Entry ``[i, j]`` is the window that starts at row `i` and column `j` of the resized band's cells. With
        several templates, it is the maximum of their scores.
        """
        workspace = self.workspace
        return self.filters.score_map(resize_band(image, band, workspace), workspace)


class ReferenceSearch(FrameSearch):
    """The reference search: the windows of the same bands by `search_windows`, one patch per window."""

    params_type = SearchParams

    def __init__(self, classifier: VehicleClassifier, *, n_jobs: int | None = None) -> None:
        check_type(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
        super().__init__(n_jobs)
        self._classifier, self._n_jobs = classifier, n_jobs

    def _search(
        self, frame: NDArray[np.uint8], params: SearchParams, min_vehicle_score: float
    ) -> tuple[Detections, None]:
        windows = np.concatenate([band_windows(band) for band in params.place(frame.shape)])
        # `search_windows` needs windows inside the frame.
        windows = windows[(windows[:, 0] >= 0) & (windows[:, 2] <= frame.shape[1])]
        min_score, n_jobs = params.min_score, self._n_jobs
        return search_windows(frame, windows, self._classifier, min_score=min_score, n_jobs=n_jobs), None


def resized_shape(band: PixelBand) -> tuple[int, int]:
    """Height and width of a band after resizing its windows to 64x64."""
    width = round((band.x2 - band.x1) * PATCH_SIZE / band.window[0])
    height = round((band.y2 - band.y1) * PATCH_SIZE / band.window[1])
    return max(height, PATCH_SIZE), max(width, PATCH_SIZE)


def resize_band(
    image: NDArray[np.uint8], band: PixelBand, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.uint8]:
    """Crop a band and resize it so that its windows are 64x64; columns beyond the frame are replicated."""
    height, width = resized_shape(band)
    scale = PATCH_SIZE / band.window[0]
    left = round(max(0, -band.x1) * scale)
    right = round(max(0, band.x2 - image.shape[1]) * scale)
    strip = image[band.y1 : band.y2, max(0, band.x1) : band.x2]
    size = (width - left - right, height)
    if size != (strip.shape[1], strip.shape[0]):
        memory = workspace.take((size[1], size[0], 3), np.uint8, "strip")
        strip = np.asarray(cv2.resize(strip, size, dst=memory), np.uint8)
    if not left and not right:
        return strip
    # Replication adds no gradient at the frame's border.
    memory = workspace.take((height, width, 3), np.uint8, "band")
    padded = cv2.copyMakeBorder(strip, 0, 0, left, right, cv2.BORDER_REPLICATE, dst=memory)
    return np.asarray(padded, np.uint8)


def _cost(band: PixelBand) -> float:
    height, width = resized_shape(band)
    return float(height * width)


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


class _Filters:
    """The folded weights of a classifier as filters over the channels of cells."""

    def __init__(self, classifier: VehicleClassifier) -> None:
        self.params = params = classifier.params
        _check_shareable(params)
        self.cells = params.cells
        self.block = params.cell_per_block
        self.per_cell = params.spatial_size // params.cells
        self.hist_roots = params.hist_feat and params.hist_sqrt
        self.hist_lookup = params.hist_feat and not params.hist_sqrt
        self.coarse = params.coarse_blocks if params.hog_feat else 0
        self.cotangents = orientation_cotangents(params.orient)
        self.bounds = degree_bounds(params.orient)
        self.bins = bin_of_value(params.hist_bins)
        folded = [template.fold() for template in classifier.templates]
        self.biases = [bias for _, bias in folded]
        self.filters = [self._build_filters(weights) for weights, _ in folded]
        hist = slice(params.spatial_length, params.spatial_length + params.hist_length)
        # Every template has its own table of weights by pixel value, and so its own histogram channel.
        by_bin = np.array([weights[hist] for weights, _ in folded], np.float32).reshape(len(folded), 3, -1)
        self.weights_by_bin = by_bin
        self.tables = by_bin[:, :, self.bins] if self.hist_lookup else None

    def _build_filters(self, weights: NDArray[np.float64]) -> list[Filter]:
        """Build the filters of one template: over HOG, over coarse HOG, over spatial bins and histogram."""
        params, cells = self.params, self.cells
        filters = []
        if params.hog_feat:
            start, stop = params.length - params.hog_length, params.length - params.coarse_length
            for positions, part, dilation in (
                (params.blocks, weights[start:stop], 1),
                (self.coarse, weights[stop:], 2),
            ):
                if positions:
                    blocks = part.reshape(params.hog_channels, positions, positions, -1).transpose(1, 2, 0, 3)
                    filters.append(Filter(blocks.reshape(positions, positions, -1), dilation=dilation))
        values = []
        if params.spatial_feat:
            planes = params.spatial_planes(weights[: params.spatial_length])
            part = planes.reshape(3, cells, self.per_cell, cells, self.per_cell)
            values.append(part.transpose(1, 3, 0, 2, 4).reshape(cells, cells, -1))
        if self.hist_lookup:
            values.append(np.ones((cells, cells, 1)))
        return [*filters, Filter(np.concatenate(values, axis=2))] if values else filters

    def score_map(self, band: NDArray[np.uint8], workspace: Workspace) -> NDArray[np.float32]:
        """Scores of all windows of a resized band as a new ``(rows, columns)`` float32 array."""
        params = self.params
        converted = {
            space: convert_color(band, space, out=workspace.take(band.shape, np.uint8, space))
            for space in params.used_color_spaces
        }
        return self.score_converted(band, converted, workspace)

    def score_converted(
        self, band: NDArray[np.uint8], converted: dict[str, NDArray[np.uint8]], workspace: Workspace
    ) -> NDArray[np.float32]:
        """Scores of all windows of a resized band, given its conversion to each color space."""
        params = self.params
        hog = self._hog_maps(band, converted, workspace) if params.hog_feat else []
        spatial, hist = (converted.get(space, band) for space in (params.spatial_space, params.hist_space))
        return self.score_maps(hog, spatial, hist, self.tables, workspace)

    def score_maps(
        self,
        hog: list[NDArray[np.float32]],
        spatial: NDArray[Any],
        hist: NDArray[Any],
        tables: NDArray[np.float32] | None,
        workspace: Workspace,
    ) -> NDArray[np.float32]:
        """Scores of all windows from the HOG of a band and the images of spatial bins and histogram.

        `hog` are ``(channels, rows, columns)`` for each filter over HOG. `tables` is
        ``(templates, 3, values)``, the histogram's weight of each value of the integer image `hist`.
        """
        cell, maps = self.params.pix_per_cell, list(hog)
        rows, columns = spatial.shape[0] // cell, spatial.shape[1] // cell
        if self.params.spatial_feat or self.hist_lookup:
            maps.append(self._value_map(spatial, workspace))
        shape = (len(self.filters), rows - self.cells + 1, columns - self.cells + 1)
        scores = np.empty(shape, np.float32)
        for template, (filters, bias) in enumerate(zip(self.filters, self.biases)):
            scores[template] = bias
            if tables is not None:
                _histogram_kernels.histogram_cells(hist, tables[template], cell, maps[-1][-1])
            for template_filter, channels in zip(filters, maps):
                template_filter.add_to(channels, scores[template], workspace)
        if self.hist_roots:
            weights = self.weights_by_bin
            _histogram_kernels.add_root_histograms(hist, self.bins, weights, cell, self.cells, scores)
        return scores[0] if len(scores) == 1 else np.asarray(scores.max(axis=0))

    def _hog_maps(
        self, band: NDArray[np.uint8], converted: dict[str, NDArray[np.uint8]], workspace: Workspace
    ) -> list[NDArray[np.float32]]:
        """Compute the blocks of HOG and, if used, of coarse HOG; each ``(channels, rows, columns)``."""
        params, channels = self.params, self.params.hog_channels
        cell = params.pix_per_cell
        rows, columns = band.shape[0] // cell, band.shape[1] // cell
        gray = params.hog_channel == "GRAY"
        source = (
            hog_source(band, params) if gray else pick_hog_channels(converted[params.color_space], params)
        )
        cells = workspace.take((channels, params.orient, rows, columns), np.float32, "cells")
        if params.transform_sqrt:
            _hog_kernels.sum_orientations(*sqrt_gradients(source), self.bounds, channels, cell, cells)
        else:
            flat = np.ascontiguousarray(source).reshape(source.shape[0], -1)
            _hog_kernels.hog_cells(flat, channels, cell, self.cotangents, cells)
        shape = (channels, self.block, self.block, params.orient, rows, columns)
        blocks = workspace.take(shape, np.float32, "blocks")
        _hog_kernels.normalize_blocks(cells, self.block, 1, blocks)
        maps = [blocks.reshape(-1, rows, columns)]
        if self.coarse:
            pooled = workspace.take(cells.shape, np.float32, "pooled")
            _hog_kernels.pool_cells(cells, pooled)
            blocks = workspace.take(shape, np.float32, "coarse blocks")
            _hog_kernels.normalize_blocks(pooled, self.block, 2, blocks)
            maps.append(blocks.reshape(-1, rows, columns))
        return maps

    def _value_map(self, image: NDArray[Any], workspace: Workspace) -> NDArray[np.float32]:
        """Spatial bins of each cell ``(channels, rows, columns)`` and, last, a channel for the histogram."""
        cell, per_cell = self.params.pix_per_cell, self.per_cell
        rows, columns = image.shape[0] // cell, image.shape[1] // cell
        count = 3 * per_cell**2 if self.params.spatial_feat else 0
        channels = workspace.take((count + int(self.hist_lookup), rows, columns), np.float32, "values")
        if count:
            size = (columns * per_cell, rows * per_cell)
            memory = workspace.take((size[1], size[0], 3), image.dtype, "bins")
            bins = cv2.resize(image[: rows * cell, : columns * cell], size, dst=memory)
            cells = channels[:count].reshape(3, per_cell, per_cell, rows, columns)
            _histogram_kernels.spatial_cells(bins, per_cell, cells)
        return channels


def _check_shareable(params: FeatureParams) -> None:
    """Reject features that windows cannot share exactly."""
    remedy = "use search_windows, the reference search, or other parameters"
    if params.cells * params.pix_per_cell != PATCH_SIZE:
        raise InvalidInputError(
            f"find_cars needs whole HOG cells in a window of {PATCH_SIZE} pixels, got "
            f"pix_per_cell={params.pix_per_cell}; {remedy}"
        )
    size = params.spatial_size
    if params.spatial_feat and (size % params.cells or PATCH_SIZE % size):
        raise InvalidInputError(
            f"find_cars needs whole spatial bins in a cell of {params.pix_per_cell} pixels, got "
            f"spatial_size={size}; {remedy}"
        )
