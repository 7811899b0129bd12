"""Windows and their classification: one by one, and the search that shares one HOG between all windows."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_array,
    check_choice,
    check_integer,
    check_number,
    describe,
)
from vehicle_detection.course.checks import Image, box_rows, check_lesson_image, corner_array
from vehicle_detection.course.defaults import FORMULAS, Formula, or_default
from vehicle_detection.course.estimators import check_estimators, library_classifier, predicts_car
from vehicle_detection.course.features import (
    Size,
    SpatialOrder,
    bin_indices,
    bin_spatial,
    color_hist,
    convert_color,
    count_bins,
)
from vehicle_detection.course.heat import draw_boxes
from vehicle_detection.course.vectors import FeatureOptions, accept_cspace, are_uint8_patches
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.search import BandSearch
from vehicle_detection.svm import VehicleClassifier

Box = tuple[tuple[int, int], tuple[int, int]]
ResizeOrder = Literal["after conversion", "before conversion"]

# Number of windows whose features are in memory at a time.
_CHUNK = 512


def slide_window(
    img: Any,
    x_start_stop: Sequence[float | None] = (None, None),
    y_start_stop: Sequence[float | None] = (None, None),
    xy_window: Sequence[float] = (64, 64),
    xy_overlap: Sequence[float] = (0.5, 0.5),
    *,
    formula: Formula | None = None,
) -> list[Box]:
    """List the windows of one size over a region of an image, row by row.

    Parameters
    ----------
    img
        Only its height and width are used.
    x_start_stop, y_start_stop
        Pixel range of the region, whole numbers; None means the image's border. Lists are not changed.
    xy_window
        Width and height of a window, whole numbers.
    xy_overlap
        Horizontal and vertical overlap of neighboring windows as a fraction of their size.
    formula
        Number of windows along an axis; the course has published both. ``"old"``: ``int(span / step) - 1``;
        with overlaps above 0.5 the last windows extend beyond the region, and below 0.5 some that fit are
        left out. ``"new"``: ``int((span - int(window * overlap)) / step)``, the windows that fit. None is the
        default of `set_lesson_defaults`, initially ``"old"``.

    Returns
    -------
    list
        Corner pairs ``((x1, y1), (x2, y2))``.

    Raises
    ------
    InvalidInputError
        If an argument is malformed or the step between windows is less than a pixel.

    Examples
    --------
    >>> slide_window(np.zeros((64, 128, 3)), xy_overlap=(0.5, 0))
    []
    >>> slide_window(np.zeros((64, 128, 3)), xy_overlap=(0.5, 0), formula="new")
    [((0, 0), (64, 64)), ((32, 0), (96, 64)), ((64, 0), (128, 64))]
    """
    if not isinstance(img, np.ndarray) or img.ndim < 2:
        raise InvalidInputError(f"img must be an image array; got {describe(img)}")
    formula = or_default(formula, "formula")
    check_choice(formula, "formula", FORMULAS)
    for name, pair in (("xy_window", xy_window), ("xy_overlap", xy_overlap)):
        if check_array(pair, name).shape != (2,):
            raise InvalidInputError(f"{name} must be a pair of numbers; got {describe(pair)}")
    width, height = (check_integer(_as_whole(side), "xy_window", low=1) for side in xy_window)
    x1, x2 = _check_span(x_start_stop, img.shape[1], "x_start_stop")
    y1, y2 = _check_span(y_start_stop, img.shape[0], "y_start_stop")
    lefts = _window_starts(x1, x2, width, xy_overlap[0], formula)
    tops = _window_starts(y1, y2, height, xy_overlap[1], formula)
    return [((x, y), (x + width, y + height)) for y in tops for x in lefts]


def _as_whole(value: Any) -> Any:
    """Return a whole-number float as an int, other values as they are."""
    return int(value) if isinstance(value, (float, np.floating)) and value.is_integer() else value


def _check_span(limits: Any, size: int, name: str) -> tuple[int, int]:
    """Return the pixel range ``[start, stop]`` with None replaced by the image's border."""
    pair = [_as_whole(limit) for limit in limits] if check_array(limits, name).shape == (2,) else []
    if not pair or not all(isinstance(limit, (int, np.integer, type(None))) for limit in pair):
        raise InvalidInputError(f"{name} must be [start, stop], whole pixels or None; got {describe(limits)}")
    start = 0 if pair[0] is None else int(pair[0])
    stop = size if pair[1] is None else int(pair[1])
    if not 0 <= start <= stop:
        raise InvalidInputError(f"{name} must satisfy 0 <= start <= stop; got {[start, stop]}")
    return start, stop


def _window_starts(start: int, stop: int, side: int, overlap: float, formula: Formula) -> range:
    """First pixels of the windows along one axis."""
    step = int(side * (1 - check_number(overlap, "xy_overlap", low=0)))
    if step < 1:
        raise InvalidInputError(
            f"xy_overlap must leave a step of 1 pixel or more between windows of {side} pixels; got {overlap}"
        )
    if formula == "old":
        count = int((stop - start) / step) - 1
    else:
        count = int((stop - start - int(side * overlap)) / step)
    return range(start, start + max(count, 0) * step, step)


@accept_cspace
def search_windows(
    img: Image,
    windows: Any,
    clf: Any,
    scaler: Any,
    color_space: str = "RGB",
    spatial_size: Size = (32, 32),
    hist_bins: int = 32,
    hist_range: tuple[float, float] | None = (0, 256),
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    hog_channel: int | str = 0,
    spatial_feat: bool = True,
    hist_feat: bool = True,
    hog_feat: bool = True,
    *,
    transform_sqrt: bool | None = None,
    spatial_order: SpatialOrder = "interleaved",
) -> list[Any]:
    """Classify each window of an image, resized to 64x64 pixels.

    Parameters
    ----------
    img
        ``(H, W, 3)`` RGB with the range of values that the classifier was trained on: float 0-1 after
        training on PNG files (``image.astype(np.float32) / 255``), uint8 otherwise.
    windows
        Corner pairs from `slide_window`, an ``(N, 4)`` array, or `Detections`. Parts beyond the right and
        lower border of the image are cut off before resizing.
    clf, scaler
        A fitted classifier with ``predict`` and a fitted scaler with ``transform``, of any kind; None for a
        classifier of features that are not scaled.
    hist_range
        As in `extract_features`; the lesson's code ignores it here.
    color_space, spatial_size, hist_bins, orient, pix_per_cell, cell_per_block, hog_channel
        As in `extract_features`, of the features that the classifier was trained on.
    spatial_feat, hist_feat, hog_feat, transform_sqrt, spatial_order
        As in `extract_features`.

    Returns
    -------
    list
        The windows, in their order, for which the classifier predicts 1.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, a window lies outside the image, or the scaler was fitted on another
        number of features.

    Warns
    -----
    UserWarning
        If the scaler was fitted on values 0-255 and the image has values 0-1, or the other way round.

    Examples
    --------
    >>> from sklearn.naive_bayes import GaussianNB
    >>> from sklearn.preprocessing import StandardScaler
    >>> from vehicle_detection import render_patches
    >>> from vehicle_detection.course import extract_features
    >>> patches, labels = render_patches(20)
    >>> X = extract_features(patches, "YCrCb", hog_channel="ALL")
    >>> scaler = StandardScaler().fit(X)
    >>> clf = GaussianNB().fit(scaler.transform(X), labels)
    >>> row = np.concatenate([patches[0], patches[-1]], axis=1)
    >>> windows = [((0, 0), (64, 64)), ((64, 0), (128, 64))]
    >>> search_windows(row, windows, clf, scaler, "YCrCb", hog_channel="ALL")
    [((0, 0), (64, 64))]
    """
    options = FeatureOptions.of(locals())
    image = check_lesson_image(img)
    check_estimators(clf, scaler, options, image)
    corners = corner_array(windows, "windows")
    height, width = image.shape[:2]
    valid = (corners >= 0).all(axis=1) & (corners[:, 0] < width) & (corners[:, 1] < height)
    valid &= (corners[:, 2:] > corners[:, :2]).all(axis=1)
    if not valid.all():
        row = int(np.argmin(valid))
        raise InvalidInputError(
            f"windows must be non-empty and start inside the {width}x{height} image; got "
            f"{corners[row].tolist()} in row {row}"
        )
    rows = box_rows(windows)
    found: list[Any] = []
    for start in range(0, len(corners), _CHUNK):
        patches = [
            np.asarray(cv2.resize(image[y1:y2, x1:x2], (PATCH_SIZE, PATCH_SIZE)))
            for x1, y1, x2, y2 in corners[start : start + _CHUNK]
        ]
        hits = _classify_patches(patches, options, clf, scaler)
        found += [rows[start + index] for index in np.flatnonzero(hits)]
    return found


def find_cars(
    img: Image,
    ystart: int | None,
    ystop: int | None,
    scale: float,
    svc: Any,
    X_scaler: Any,
    orient: int,
    pix_per_cell: int,
    cell_per_block: int,
    spatial_size: Size,
    hist_bins: int,
    *,
    color_space: str = "YCrCb",
    hog_channel: int | str = "ALL",
    spatial_feat: bool = True,
    hist_feat: bool = True,
    hog_feat: bool = True,
    hist_range: tuple[float, float] | None = (0, 256),
    transform_sqrt: bool | None = None,
    spatial_order: SpatialOrder = "interleaved",
    cells_per_step: int = 2,
    divide_by: float = 255,
    resize: ResizeOrder = "after conversion",
    formula: Formula = "old",
) -> Image:
    """Draw the windows of `find_car_windows` on a copy of the image; the arguments are the same.

    Returns
    -------
    numpy.ndarray
        A new image with blue rectangles, 6 pixels thick.

    Examples
    --------
    >>> from sklearn.dummy import DummyClassifier
    >>> from sklearn.preprocessing import StandardScaler
    >>> svc = DummyClassifier(strategy="constant", constant=1).fit([[0], [0]], [0, 1])
    >>> scaler = StandardScaler().fit(np.zeros((2, 8460)))
    >>> drawn = find_cars(np.zeros((96, 96, 3), np.uint8), 0, 96, 1, svc, scaler, 9, 8, 2, (32, 32), 32)
    >>> drawn[0, 0].tolist(), drawn[40, 40].tolist()
    ([0, 0, 255], [0, 0, 0])
    """
    return draw_boxes(img, find_car_windows(**locals()))  # all arguments


def find_car_windows(
    img: Image,
    ystart: int | None,
    ystop: int | None,
    scale: float,
    svc: Any,
    X_scaler: Any,
    orient: int,
    pix_per_cell: int,
    cell_per_block: int,
    spatial_size: Size,
    hist_bins: int,
    *,
    color_space: str = "YCrCb",
    hog_channel: int | str = "ALL",
    spatial_feat: bool = True,
    hist_feat: bool = True,
    hog_feat: bool = True,
    hist_range: tuple[float, float] | None = (0, 256),
    transform_sqrt: bool | None = None,
    spatial_order: SpatialOrder = "interleaved",
    cells_per_step: int = 2,
    divide_by: float = 255,
    resize: ResizeOrder = "after conversion",
    formula: Formula = "old",
) -> list[Box]:
    """Search a band of an image at one scale, with one HOG for all windows: the boxes that `find_cars` draws.

    Parameters
    ----------
    img
        ``(H, W, 3)`` RGB.
    ystart, ystop
        Rows to search.
    scale
        Side of a window divided by 64 pixels: the band is shrunk by this factor.
    svc, X_scaler
        A fitted classifier with ``predict`` and a fitted scaler with ``transform``, of any kind; None for a
        classifier of features that are not scaled.
    orient, pix_per_cell, cell_per_block, spatial_size, hist_bins
        As in `extract_features`, of the features that the classifier was trained on.
    color_space, hog_channel, spatial_feat, hist_feat, hog_feat, hist_range, transform_sqrt, spatial_order
        As in `extract_features`. The quiz comes with functions that order the bins by channel and take the
        range of each channel: pass ``spatial_order="channels", hist_range=None`` for a model trained with
        them.
    cells_per_step
        Step between windows, in cells.
    divide_by
        Number by which the values are divided first. The quiz divides by 255, for a model trained on PNG
        files, which ``mpimg.imread`` reads as float 0-1. Pass 1 for a model trained on uint8 images; most
        published systems remove the division then. A uint8 image is searched by the library's fast search. A
        float image with values 0-1 is never divided.
    resize
        ``"after conversion"``: the quiz converts the colors first and then shrinks the band.
        ``"before conversion"``: shrink first, as a window-by-window search (`search_windows`) and the main
        API do. Scores of the two differ by up to 1.7 at scales other than 1.
    formula
        Number of steps along an axis; the course has published both. ``"old"``:
        ``(blocks - blocks per window) // cells_per_step``, which leaves out the last position; ``"new"`` adds
        one. `set_lesson_defaults` does not change this default: the two versions of `slide_window` are
        independent of these.

    Returns
    -------
    list
        Corner pairs ``((x1, y1), (x2, y2))`` of the windows for which the classifier predicts 1, column by
        column, as in the quiz.

    Raises
    ------
    InvalidInputError
        If an argument is malformed or the scaler was fitted on another number of features.

    Warns
    -----
    UserWarning
        If the scaler was fitted on values 0-255 and the searched values are 0-1, or the other way round.

    Examples
    --------
    >>> from sklearn.preprocessing import StandardScaler
    >>> from sklearn.svm import LinearSVC
    >>> from vehicle_detection import render_patches
    >>> from vehicle_detection.course import extract_features
    >>> patches, labels = render_patches(40)
    >>> X = extract_features(patches, "YCrCb", (16, 16), hog_channel="ALL")
    >>> scaler = StandardScaler().fit(X)
    >>> svc = LinearSVC(random_state=0).fit(scaler.transform(X), labels)
    >>> frame = np.full((144, 240, 3), 90, np.uint8)
    >>> frame[32:96, 64:128] = patches[0]
    >>> boxes = find_car_windows(frame, 0, 144, 1, svc, scaler, 9, 8, 2, (16, 16), 32, divide_by=1)
    >>> ((64, 32), (128, 96)) in boxes
    True
    """
    options = FeatureOptions.of(locals())
    check_number(scale, "scale", above=0, high=1e6)
    check_integer(cells_per_step, "cells_per_step", low=1)
    check_choice(resize, "resize", ("after conversion", "before conversion"))
    check_choice(formula, "formula", FORMULAS)
    image = check_lesson_image(img)
    top, bottom = _check_rows(ystart, ystop, image.shape[0])
    image = _scale_values(image[top:bottom], check_number(divide_by, "divide_by", above=0))
    check_estimators(svc, X_scaler, options, image)
    if resize == "after conversion":
        converted = _shrink(convert_color(image, color_space), scale)
    else:
        converted = convert_color(_shrink(image, scale), color_space)
    hits = _search_band(converted, options, svc, X_scaler, cells_per_step, formula)
    stride, side = cells_per_step * options.pix_per_cell, int(PATCH_SIZE * scale)
    boxes = []
    for column, row in np.argwhere(hits.T).tolist():
        x, y = int(column * stride * scale), int(row * stride * scale) + top
        boxes.append(((x, y), (x + side, y + side)))
    return boxes


def _check_rows(start: int | None, stop: int | None, height: int) -> tuple[int, int]:
    """Return the rows of a band, clipped to the image's height."""
    top = 0 if start is None else check_integer(start, "ystart", low=0)
    bottom = height if stop is None else min(height, check_integer(stop, "ystop", low=0))
    if top >= bottom:
        raise InvalidInputError(
            f"ystart and ystop must be a range of the image's {height} rows; got {start} and {stop}"
        )
    return top, bottom


def _scale_values(image: Image, divide_by: float) -> Image:
    """Divide an image like the quiz, but not a float image with values 0-1."""
    if divide_by == 1 or (image.dtype != np.uint8 and image.max() <= 1):
        return image
    return image.astype(np.float32) / np.float32(divide_by)


def _shrink(image: Image, scale: float) -> Image:
    if scale == 1:
        return image
    height, width = (max(1, int(side / scale)) for side in image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height)))


def _search_band(
    converted: Image, options: FeatureOptions, clf: Any, scaler: Any, cells_per_step: int, formula: Formula
) -> NDArray[np.bool_]:
    """Whether the classifier predicts 1 for each window of a converted band, ``(rows, columns)``."""
    cell, block = options.pix_per_cell, options.cell_per_block
    rows, columns = (
        (side // cell - block + 1 - options.blocks) // cells_per_step + (formula == "new")
        for side in converted.shape[:2]
    )
    if rows < 1 or columns < 1:
        return np.zeros((0, 0), np.bool_)
    scores = _fast_scores(converted, options, clf, scaler)
    if scores is not None:
        return np.asarray(scores[::cells_per_step, ::cells_per_step][:rows, :columns] > 0)
    hog = None
    if options.hog_feat:
        # A view: (channels, rows, columns, block, block, orient, blocks, blocks), windows at every cell.
        window = (options.blocks, options.blocks)
        view = np.lib.stride_tricks.sliding_window_view(options.hog_blocks(converted), window, axis=(1, 2))
        hog = view.transpose(1, 2, 0, 6, 7, 3, 4, 5)[::cells_per_step, ::cells_per_step]
    indices = None
    if options.hist_feat and options.hist_range is not None:
        indices = bin_indices(converted, options.hist_bins, options.hist_range)
    positions = np.indices((rows, columns)).reshape(2, -1).T
    hits = []
    for start in range(0, len(positions), _CHUNK):
        features = np.empty((len(positions[start : start + _CHUNK]), options.length))
        for vector, (row, column) in zip(features, positions[start:].tolist()):
            y, x = row * cells_per_step * cell, column * cells_per_step * cell
            parts = _window_color(converted, indices, y, x, options)
            if hog is not None:
                parts.append(hog[row, column].ravel())
            np.concatenate(parts, out=vector)
        hits.append(predicts_car(features, clf, scaler))
    return np.concatenate(hits).reshape(rows, columns)


def _window_color(
    converted: Image, indices: NDArray[np.intp] | None, y: int, x: int, options: FeatureOptions
) -> list[NDArray[Any]]:
    """Spatial bins and histogram of the window at ``(x, y)``; `indices` are the band's histogram bins."""
    part = np.s_[y : y + PATCH_SIZE, x : x + PATCH_SIZE]
    window = converted[part]
    if window.shape[:2] != (PATCH_SIZE, PATCH_SIZE):
        # The border may cut the last window if a cell does not divide 64.
        return options.color_parts(np.asarray(cv2.resize(window, (PATCH_SIZE, PATCH_SIZE))))
    parts: list[NDArray[Any]] = []
    if options.spatial_feat:
        parts.append(bin_spatial(window, options.spatial_size, order=options.spatial_order))
    if indices is not None:
        parts.append(count_bins(indices[part], options.hist_bins))
    elif options.hist_feat:
        parts.append(color_hist(window, options.hist_bins, None))
    return parts


def _fast_scores(
    converted: Image, options: FeatureOptions, clf: Any, scaler: Any
) -> NDArray[np.float32] | None:
    """Scores of the windows at every cell by the library's filters, or None where they do not apply."""
    params = options.library_params(options.color_space)
    if params is None or PATCH_SIZE % params.pix_per_cell or (options.hist_feat and not options.hist_range):
        return None
    if params.spatial_feat and (params.spatial_size % params.cells or PATCH_SIZE % params.spatial_size):
        return None
    classifier = library_classifier(clf, scaler, params)
    if classifier is None:
        return None
    search = _open_search(classifier)
    filters = search.filters
    if converted.dtype == np.uint8 and options.has_library_range:
        return filters.score_converted(converted, {params.color_space: converted}, search.workspace)
    hist, tables = converted, None
    if options.hist_feat:
        assert options.hist_range is not None
        hist = bin_indices(converted, options.hist_bins, options.hist_range)
        # The last bin, of values out of range, has no weight.
        tables = np.pad(filters.weights_by_bin, ((0, 0), (0, 0), (0, 1)))
    maps = []
    if options.hog_feat:
        hog = options.hog_maps(converted)
        maps = [hog.reshape(-1, *hog.shape[4:])]
    return filters.score_maps(maps, converted, hist, tables, search.workspace)


@functools.lru_cache(maxsize=1)
def _open_search(classifier: VehicleClassifier) -> BandSearch:
    return classifier.open_search(1)


def _classify_patches(
    patches: list[Image], options: FeatureOptions, clf: Any, scaler: Any
) -> NDArray[np.bool_]:
    """Whether the classifier predicts 1 for each of some 64x64 patches."""
    params = options.library_params(options.color_space) if options.has_library_range else None
    if params is not None and are_uint8_patches(patches):
        classifier = library_classifier(clf, scaler, params)
        if classifier is not None:
            return np.asarray(classifier.decision_function(np.stack(patches)) > 0)
    return predicts_car(np.array(options.compute(patches)), clf, scaler)
