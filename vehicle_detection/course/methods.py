"""The two methods of the course to find hot windows: each by itself, and HOG sub-sampling."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.course.search import find_car_windows, scale_values, search_windows
from vehicle_detection.course.versions import lesson_defaults
from vehicle_detection.course.windows import Corners, slide_window
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.search import REFERENCE_WIDTH, SearchBand, SearchParams
from vehicle_detection.svm import VehicleClassifier, load_classifier
from vehicle_detection.windows import find_cars as find_library_windows
from vehicle_detection.windows import search_windows as search_library_windows

# Scale, rows and columns.
_Band = tuple[float, Sequence[int], Sequence[int]]
FindWindows = Callable[[NDArray[np.uint8]], Any]

_FEATURES = {
    "orient": 9, "pix_per_cell": 8, "cell_per_block": 2, "spatial_size": (32, 32), "hist_bins": 32,
    "color_space": "YCrCb", "hog_channel": "ALL",
}  # fmt: skip
_FROZEN = ("divide_by", "cells_per_step", "transform_sqrt", "hist_range", "spatial_order")


def read_bands(scales: Sequence[Any], rows: Sequence[int]) -> list[_Band]:
    """Scales with their rows and columns, checked."""
    bands, usual = [], (rows, (0, REFERENCE_WIDTH))
    for each in check.sequence(scales, "scales", "numbers"):
        scale, *own = each if isinstance(each, tuple) else (each,)
        pairs = [*own, *usual[len(own) :]]
        if len(pairs) > 2 or not all(_is_range(pair) for pair in pairs):
            must = "hold numbers, or (scale, (ystart, ystop), (xstart, xstop)) with start < stop"
            raise invalid("scales and y_start_stop", must, (each, rows))
        bands.append((check.number(scale, "scales", low=0.25, high=20), pairs[0], pairs[1]))
    if not bands:
        raise InvalidInputError("scales must hold a number at least, such as (1.0, 1.5); got none")
    return bands


def _is_range(pair: Any) -> bool:
    numbers = isinstance(pair, (tuple, list)) and all(isinstance(each, Real) for each in pair)
    return numbers and len(pair) == 2 and 0 <= pair[0] < pair[1] <= 1e5


def window_search(
    clf: Any, scaler: Any, method: int, bands: list[_Band], options: dict[str, Any]
) -> FindWindows:
    """Return the function of an image that finds the hot windows."""
    check.choice(method, "method", (1, 2))
    if isinstance(clf, (str, os.PathLike)):
        clf = load_classifier(clf)
    if isinstance(clf, VehicleClassifier):
        step = options.pop("cells_per_step", 2)
        if scaler is not None or options:
            must = "be omitted with a model of the library, which contains them"
            raise invalid("scaler and options of the features", must, (scaler, sorted(options)))
        if method == 1:
            return lambda image: search_library_windows(image, _list_windows(image), clf).boxes
        params = _search_params(bands, check.integer(step, "cells_per_step", low=1, high=8))
        return lambda image: find_library_windows(image, clf, params).boxes
    if callable(clf) and not hasattr(clf, "predict"):
        return clf  # type: ignore[no-any-return]
    scaled = hasattr(scaler, "transform") or (scaler is None and hasattr(clf, "steps"))
    if not hasattr(clf, "predict") or not scaled:
        must = "be a model of the library, a function of an image, or a fitted classifier with a scaler"
        raise invalid("clf", must, (clf, scaler), "pass the scaler, or a pipeline of both")
    # Later changes of the defaults must not change a detector.
    options = {**_FEATURES, **{name: lesson_defaults[name] for name in _FROZEN}, **options}
    # An image of one window checks the options, the estimators and the range before the first frame.
    white = np.full((PATCH_SIZE, PATCH_SIZE, 3), 255, np.uint8)
    find_car_windows(white, None, None, 1, clf, scaler, **options)
    if method == 2:
        return functools.partial(_search_bands, model=(clf, scaler), bands=bands, options=options)
    divide_by, _ = (options.pop(name) for name in _FROZEN[:2])

    def search_list(image: NDArray[np.uint8]) -> Any:
        return search_windows(scale_values(image, divide_by), _list_windows(image), clf, scaler, **options)

    return search_list


def _scale(pair: Sequence[float], image: NDArray[np.uint8]) -> tuple[int, int]:
    """Positions in an image of those in a 1280x720 frame."""
    factor = max(image.shape) / REFERENCE_WIDTH
    return round(pair[0] * factor), round(pair[1] * factor)


def _list_windows(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """``(N, 4)`` windows of the four lists, in the right half; the border of the image cuts some off."""
    params = SearchParams.preset("130-windows")
    windows = []
    for band in params.bands:
        ends = [REFERENCE_WIDTH * side for side in band.x], [720 * params.horizon + side for side in band.y]
        x, y, size = (_scale(pair, image) for pair in (*ends, band.window))
        windows.append(slide_window(image, x, y, size, band.overlap, formula="old"))
    height, width = image.shape[:2]
    return np.minimum(np.concatenate(windows).reshape(-1, 4), (width, height, width, height))


def _search_bands(
    image: NDArray[np.uint8], model: tuple[Any, Any], bands: list[_Band], options: dict[str, Any]
) -> list[Corners]:
    """Hits of `find_car_windows` for a classifier with a scaler at all scales."""
    hits = []
    for scale, rows, columns in bands:
        (left, right), factor = _scale(columns, image), max(image.shape) / REFERENCE_WIDTH
        found = find_car_windows(
            image[:, left:right], *_scale(rows, image), scale * factor, *model, **options
        )
        hits += [((x1 + left, y1), (x2 + left, y2)) for (x1, y1), (x2, y2) in found]
    return hits


def _search_params(bands: list[_Band], cells_per_step: int) -> SearchParams:
    """Bands of the library with the windows of the lesson's ``find_cars`` at each scale."""
    overlap, horizon = 1 - cells_per_step / 8, 400
    placed = [
        SearchBand(
            window=(PATCH_SIZE * scale,) * 2,
            y=(top - horizon, bottom - horizon),
            x=(left / REFERENCE_WIDTH, right / REFERENCE_WIDTH),
            overlap=(overlap, overlap),
        )
        for scale, (top, bottom), (left, right) in bands
    ]
    return SearchParams(bands=tuple(placed), horizon=horizon / 720)
