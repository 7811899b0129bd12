"""The classification of windows: one by one, and the search that shares one HOG between all windows.

A linear classifier of scikit-learn, behind a scaler or not, becomes the library's: the filters of its fast
search give the scores of all windows. Others predict a feature vector for each window.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import MISSING, dataclass
from typing import Any, ClassVar, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import describe, fields, invalid, warn
from vehicle_detection.course.features import (
    UNUSED,
    FeatureOptions,
    Image,
    Size,
    are_uint8_patches,
    bin_indices,
    check_lesson_image,
    convert_color,
    is_unit,
    warn_of_first_bin,
)
from vehicle_detection.course.versions import FORMULAS, RETURNS, lesson_function
from vehicle_detection.course.windows import BLUE, THICKNESS, Corners, box_rows, corner_array
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.search import BandFilters
from vehicle_detection.svm import (
    UNIT_CHANNELS,
    VehicleClassifier,
    flatten_steps,
    fold_estimators,
    has_unit_range,
    n_features,
)

Result = TypeVar("Result")

# Number of windows whose features are in memory at a time.
_CHUNK = 512
# The attributes that a linear classifier and a scaler compute with.
_MODEL_STATE = (
    "classes_", "n_features_in_",
    "coef_", "intercept_", "mean_", "center_", "min_", "scale_", "with_mean", "with_std", "clip",
)  # fmt: skip


@lesson_function()
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
    transform_sqrt: bool = False,
    spatial_order: str = "interleaved",
) -> list[Any]:
    """Classify each window of an image, resized to 64x64 pixels.

    Returns the windows, in their order, for which the classifier predicts 1. The options are those of
    `extract_features` with which it was trained; the lesson's code ignores `hist_range` here. A warning says
    if the scaler was fitted on values 0-255 and the image has values 0-1, or the other way round.

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
    options, image = FeatureOptions.of(locals()), check_lesson_image(img)
    estimators = _check_estimators(clf, scaler, options, image)
    corners = corner_array(windows, "windows")
    height, width = image.shape[:2]
    valid = (corners >= 0).all(axis=1) & (corners[:, 0] < width) & (corners[:, 1] < height)
    valid &= (corners[:, 2:] > corners[:, :2]).all(axis=1)
    if not valid.all():
        row = int(np.argmin(valid))
        must = f"be non-empty and start inside the {width}x{height} image"
        raise invalid(f"windows[{row}]", must, corners[row].tolist())
    rows = box_rows(windows)
    found: list[Any] = []
    for start in range(0, len(corners), _CHUNK):
        patches = [
            np.asarray(cv2.resize(image[y1:y2, x1:x2], (PATCH_SIZE, PATCH_SIZE)))
            for x1, y1, x2, y2 in corners[start : start + _CHUNK]
        ]
        if estimators.classifier is not None and options.has_library_range and are_uint8_patches(patches):
            hits = estimators.classifier.decision_function(np.stack(patches)) > 0
        else:
            hits = estimators.predict(np.array(options.compute(patches)))
        found += [rows[start + index] for index in np.flatnonzero(hits)]
    return found


# Names of the positional arguments, and of those that published versions insert after the scale or append.
_POSITIONAL = (
    "img", "ystart", "ystop", "scale", "svc", "X_scaler", "orient", "pix_per_cell", "cell_per_block",
    "spatial_size", "hist_bins",
)  # fmt: skip
_SPACE, _SWITCHES = ("color_space", "hog_channel"), ("spatial_feat", "hist_feat", "hog_feat")


def _accept_published_orders(function: Callable[..., Result]) -> Callable[..., Result]:
    """Name the positional arguments of versions with more of them than the lesson."""

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Result:
        names = [*_POSITIONAL, *(_SWITCHES if args[11:12] in ((True,), (False,)) else (*_SPACE, *_SWITCHES))]
        if len(args) > 4 and isinstance(args[4], str):
            names = [*_POSITIONAL[:4], *_SPACE, *_POSITIONAL[4:]]
            args = args[:13]  # another one says whether to draw
            options = {"spatial_feat": args[11] is not None, "hist_feat": args[12] is not None, **options}
        if len(args) > len(names):
            raise TypeError(f"find_cars() takes up to {len(names)} positional arguments; got {len(args)}")
        return function(**dict(zip(names, args)), **options)

    return call


@_accept_published_orders
@lesson_function(formula="find_cars_formula", returns="find_cars_returns")
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
    transform_sqrt: bool = False,
    spatial_order: str = "interleaved",
    cells_per_step: int = 2,
    divide_by: float = 255,
    resize: str = "after conversion",
    formula: str = "old",
    returns: str = "picture",
) -> Any:
    """Search a band of an image at one scale, with one HOG for all windows, and draw the hits on a copy.

    The hits are those of `reference.find_car_windows`, column by column, as in the quiz.

    Parameters
    ----------
    img, ystart, ystop
        ``(H, W, 3)`` RGB, and the rows to search.
    scale
        Side of a window divided by 64 pixels: the band is shrunk by this factor.
    svc, X_scaler
        As `clf` and `scaler` of `search_windows`.
    orient, pix_per_cell, cell_per_block, spatial_size, hist_bins
        As in `extract_features`, of the features that the classifier was trained on. Published versions with
        ``color_space, hog_channel`` after `scale`, or with further arguments at the end, are understood.
    color_space, hog_channel, spatial_feat, hist_feat, hog_feat, hist_range, transform_sqrt, spatial_order
        As in `extract_features`. Pass ``spatial_order="channels", hist_range=None`` for a model trained with
        the functions of the quiz, which order the bins by channel and take the range of each channel.
    cells_per_step
        Step between windows, in cells.
    divide_by
        Number by which the values are divided first. The quiz divides by 255, for a model trained on PNG
        files, which ``mpimg.imread`` reads as float 0-1. Pass 1 for a model trained on uint8 images. A float
        image with values 0-1 is never divided.
    resize
        ``"after conversion"``: the quiz converts the colors first and then shrinks the band.
        ``"before conversion"``: shrink first, as `search_windows` and the main API do. Scores of the two
        differ by up to 1.7 at scales other than 1.
    formula
        Number of steps along an axis; the course has published both. ``"old"``:
        ``(blocks - blocks per window) // cells_per_step``, which leaves out the last position; ``"new"`` adds
        one.
    returns
        ``"picture"``: a new image with blue rectangles, 6 pixels thick; ``"boxes"``: corner pairs
        ``((x1, y1), (x2, y2))`` of the hits, as `find_car_windows`; ``"both"``: a pair of them.

    Examples
    --------
    >>> from sklearn.dummy import DummyClassifier
    >>> from sklearn.preprocessing import StandardScaler
    >>> svc = DummyClassifier(strategy="constant", constant=1).fit([[0], [0]], [0, 1])
    >>> scaler = StandardScaler().fit(np.zeros((2, 8460)))
    >>> image = np.zeros((96, 96, 3), np.uint8)
    >>> drawn = find_cars(image, 0, 96, 1, svc, scaler, 9, 8, 2, (32, 32), 32)
    >>> drawn[0, 0].tolist(), drawn[40, 40].tolist()
    ([0, 0, 255], [0, 0, 0])
    >>> find_car_windows(image, 0, 96, 1, svc, scaler, 9, 8, 2, (32, 32), 32)
    [((0, 0), (64, 64)), ((0, 16), (64, 80)), ((16, 0), (80, 64)), ((16, 16), (80, 80))]
    """
    options, image = _SearchOptions.of(locals()), check_lesson_image(img)
    top, bottom = options.rows(image.shape[0])
    image = scale_values(image[top:bottom], options.divide_by)
    estimators = _check_estimators(svc, X_scaler, options, image)
    if resize == "after conversion":
        converted = _shrink(convert_color(image, color_space), scale)
    else:
        converted = convert_color(_shrink(image, scale), color_space)
    hits = _search_band(converted, estimators, options)
    stride, side = cells_per_step * options.pix_per_cell, int(PATCH_SIZE * scale)
    boxes: list[Corners] = []
    for column, row in np.argwhere(hits.T).tolist():
        x, y = int(column * stride * scale), int(row * stride * scale) + top
        boxes.append(((x, y), (x + side, y + side)))
    if returns == "boxes":
        return boxes
    drawn = np.array(img, order="C")
    for corner, opposite in boxes:
        cv2.rectangle(drawn, corner, opposite, BLUE, THICKNESS)
    return drawn if returns == "picture" else (drawn, boxes)


@functools.wraps(find_cars, assigned=())
def find_car_windows(*args: Any, **options: Any) -> list[Corners]:
    """Return the boxes that `find_cars` draws; the arguments are the same."""
    boxes: list[Corners] = find_cars(*args, **{**options, "returns": "boxes"})
    return boxes


@dataclass(frozen=True, kw_only=True)
class _SearchOptions(FeatureOptions):
    """The options of `find_cars`, checked."""

    # The step between windows depends on the cells of HOG, whether it is used or not.
    unused: ClassVar = UNUSED | {"hog_feat": {"orient": 9, "hog_channel": 0}}

    ystart: int | None = fields.integer(None, low=0)
    ystop: int | None = fields.integer(None, low=0)
    scale: float = fields.number(above=0, high=1e6)
    cells_per_step: int = fields.integer(low=1)
    divide_by: float = fields.number(above=0)
    resize: str = fields.choice(MISSING, ("after conversion", "before conversion"))
    formula: str = fields.choice(MISSING, FORMULAS)
    returns: str = fields.choice(MISSING, RETURNS)

    def rows(self, height: int) -> tuple[int, int]:
        """Rows of the band, clipped to the image's height."""
        top, bottom = self.ystart or 0, height if self.ystop is None else min(height, self.ystop)
        if top >= bottom:
            rows = self.ystart, self.ystop
            raise invalid("ystart and ystop", f"be a range of the image's {height} rows", rows)
        return top, bottom


def scale_values(image: Image, divide_by: float) -> Image:
    """Divide an image like the quiz, but not a float image with values 0-1."""
    if divide_by == 1 or (image.dtype != np.uint8 and image.max() <= 1):
        return image
    return image.astype(np.float32) / np.float32(divide_by)


def _shrink(image: Image, scale: float) -> Image:
    if scale == 1:
        return image
    height, width = (max(1, int(side / scale)) for side in image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height)))


def _search_band(converted: Image, estimators: _Estimators, options: _SearchOptions) -> NDArray[np.bool_]:
    """Whether the classifier predicts 1 for each window of a converted band, ``(rows, columns)``."""
    cell, block, cells_per_step = options.pix_per_cell, options.cell_per_block, options.cells_per_step
    rows, columns = (
        (side // cell - block + 1 - options.blocks) // cells_per_step + (options.formula == "new")
        for side in converted.shape[:2]
    )
    if rows < 1 or columns < 1:
        return np.zeros((0, 0), np.bool_)
    if estimators.filters is not None:
        scores = _fast_scores(converted, options, estimators.filters)
        return np.asarray(scores[::cells_per_step, ::cells_per_step][:rows, :columns] > 0)
    hog = None
    if options.hog_feat:
        # A view: (channels, rows, columns, block, block, orient, blocks, blocks), windows at every cell.
        window = (options.blocks, options.blocks)
        view = np.lib.stride_tricks.sliding_window_view(options.hog(converted), window, axis=(1, 2))
        hog = view.transpose(1, 2, 0, 6, 7, 3, 4, 5)[::cells_per_step, ::cells_per_step]
    positions = np.indices((rows, columns)).reshape(2, -1).T
    hits = []
    for start in range(0, len(positions), _CHUNK):
        features = np.empty((len(positions[start : start + _CHUNK]), options.length))
        for vector, (row, column) in zip(features, positions[start:].tolist()):
            y, x = row * cells_per_step * cell, column * cells_per_step * cell
            patch = converted[y : y + PATCH_SIZE, x : x + PATCH_SIZE]
            if patch.shape[:2] != (PATCH_SIZE, PATCH_SIZE):  # cut by the border: a cell does not divide 64
                patch = np.asarray(cv2.resize(patch, (PATCH_SIZE, PATCH_SIZE)))
            parts = options.color_parts(patch)
            if hog is not None:
                parts.append(hog[row, column].ravel())
            np.concatenate(parts, out=vector)
        hits.append(estimators.predict(features))
    return np.concatenate(hits).reshape(rows, columns)


def _fast_scores(converted: Image, options: FeatureOptions, filters: BandFilters) -> NDArray[np.float32]:
    """Scores of the windows at every cell by the library's filters."""
    hist, tables, limits = converted, filters.tables, options.hist_range
    if options.hist_feat and limits and not (converted.dtype == np.uint8 and options.has_library_range):
        hist = bin_indices(converted, options.hist_bins, limits)
        # The last bin, of values out of range, has no weight.
        tables = np.pad(filters.weights_by_bin, ((0, 0), (0, 0), (0, 1)))
    source = options.hog_source(converted) if options.hog_feat else None
    return filters.score_images(source, converted, hist, tables)


@dataclass(frozen=True)
class _Estimators:
    """A classifier and its scaler, checked for some features."""

    clf: Any
    scaler: Any  # None for features that are not scaled
    options: FeatureOptions
    state: list[Any] | None  # what scikit-learn's classes compute with; None for other classes
    classifier: VehicleClassifier | None  # the same as the library's, if it is linear
    filters: BandFilters | None  # for the fast search, if windows can share the features
    unit_range: bool | None  # whether the scaler was fitted on images with values 0-1; None if unknown

    def predict(self, features: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the classifier predicts 1 for each of ``(N, length)`` feature vectors."""
        scaled = features if self.scaler is None else self.scaler.transform(features)
        labels = np.asarray(self.clf.predict(scaled)).reshape(-1)
        if len(labels) != len(features):
            raise InvalidInputError(
                f"the classifier must predict a label for each of {len(features)} windows; got {len(labels)} "
                f"from {type(self.clf).__name__}.predict"
            )
        return np.asarray(labels == 1)


# Those of the last call: a system calls `find_cars` for each scale and frame with the same ones.
_last: _Estimators | None = None


def _check_estimators(clf: Any, scaler: Any, options: FeatureOptions, image: Image) -> _Estimators:
    """Check that a classifier and its scaler fit the features, and the range of an image's values."""
    global _last
    clf = getattr(clf, "best_estimator_", clf)  # of a GridSearchCV
    # Only classes of scikit-learn: others may predict in another way, as does a replaced method.
    known = all(each is None or type(each).__module__.startswith("sklearn.") for each in (clf, scaler))
    state: list[Any] | None = None
    if known and clf is not None and "predict" not in vars(clf):
        state = [type(clf), type(scaler)]
        state += [getattr(each, name, None) for each in (clf, scaler) for name in _MODEL_STATE]
    found = _last
    if found is None or found.options != options or not _are_equal(found.state, state):
        found = _last = _read_estimators(clf, scaler, options, copy.deepcopy(state))
    elif found.clf is not clf or found.scaler is not scaler:
        found = dataclasses.replace(found, clf=clf, scaler=scaler)
    _warn_of_range(found, image)
    return found


def _are_equal(before: list[Any] | None, state: list[Any] | None) -> bool:
    return before is not None and state is not None and all(map(np.array_equal, before, state))


def _read_estimators(clf: Any, scaler: Any, options: FeatureOptions, state: list[Any] | None) -> _Estimators:
    from sklearn.exceptions import NotFittedError
    from sklearn.utils.validation import check_is_fitted

    given = [(clf, "classifier", "predict"), (scaler, "scaler", "transform")]
    for estimator, name, method in given[: 1 if scaler is None else 2]:
        if not hasattr(estimator, method):
            raise InvalidInputError(f"the {name} must have a method {method}; got {describe(estimator)}")
        if type(estimator).__module__.startswith("sklearn."):
            try:
                check_is_fitted(estimator)
            except NotFittedError:
                raise InvalidInputError(
                    f"the {name} must be fitted; got an unfitted {type(estimator).__name__}: call fit first"
                ) from None
    if isinstance(clf, VehicleClassifier):
        # The gains change the weights only, not the features.
        params = dataclasses.replace(clf.params, hist_gain=1.0, coarse_gain=1.0)
        if scaler is not None or params != options.params or not options.has_library_range:
            raise InvalidInputError(
                "a model of the library needs no scaler, and the options of its own features; "
                "HeatmapDetector(model) and vehicle_detection.find_cars(image, model) know them"
            )
    if 1 not in getattr(clf, "classes_", (1,)):
        must = "be trained with the label 1 for vehicles and 0 for others"
        raise invalid("the classifier", must, clf.classes_.tolist())
    if options.hog_feat and options.blocks < 1:
        block = f"a block of {options.cell_per_block} cells of {options.pix_per_cell} pixels"
        raise InvalidInputError(f"{block} must fit into a window of {PATCH_SIZE} pixels")
    first, name = (clf, "classifier") if scaler is None else (scaler, "scaler")
    fitted = n_features(first)
    if fitted not in (None, options.length):
        raise InvalidInputError(
            f"the {name} was fitted on {fitted} features, but these options give {options.length}; pass the "
            "options that the classifier was trained with"
        )
    classifier, filters = None, None
    if state is not None and options.params is not None:
        steps = [clf] if scaler is None else [scaler, clf]
        with contextlib.suppress(InvalidInputError):  # not linear, or windows cannot share the features
            classifier = VehicleClassifier(options.params, (fold_estimators(steps, options.length),))
            filters = classifier.filters
    if options.hist_feat and not options.hist_range:
        filters = None
    own = isinstance(clf, VehicleClassifier)  # trained on uint8 patches
    unit_range = False if own else _was_fitted_on_unit_range(flatten_steps([scaler, clf])[0], options)
    return _Estimators(clf, scaler, options, state, classifier, filters, unit_range)


def _warn_of_range(estimators: _Estimators, image: Image) -> None:
    """Warn if the values of an image have another range than those that the scaler was fitted on."""
    options, trained_on_unit = estimators.options, estimators.unit_range
    if options.hist_feat:
        warn_of_first_bin(image, options.hist_range, options.color_space)
    if trained_on_unit is None or is_unit(image) == trained_on_unit or not image.max() > 0.1:
        return
    trained, given = ("0-1", "0-255") if trained_on_unit else ("0-255", "0-1")
    warn(
        f"the scaler was fitted on values {trained}, but the image has values {given}, which makes "
        "predictions useless. extract_features and mpimg.imread read a PNG as 0-1 and other files as 0-255, "
        'imread="cv2" reads all as 0-255; find_cars divides by 255 unless divide_by=1 is passed'
    )


def _was_fitted_on_unit_range(scaler: Any, options: FeatureOptions) -> bool | None:
    """Whether a scaler was fitted on features of images with values 0-1; None if it does not show it."""
    means, scales = (getattr(scaler, name, None) for name in ("mean_", "scale_"))
    if means is None:
        return None
    if options.params is not None:
        scales = np.ones_like(means) if scales is None else scales
        return has_unit_range(means, scales, options.params) or (False if options.spatial_feat else None)
    if not options.spatial_feat or len(UNIT_CHANNELS.get(options.color_space, ())) < 3:
        return None
    return bool(np.max(means[: options.spatial_length]) <= 2)
