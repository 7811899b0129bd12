"""Classifiers and scalers of other libraries: checks, predictions, and their conversion to the library's."""

from __future__ import annotations

import copy
import sys
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import describe
from vehicle_detection.course.checks import Image
from vehicle_detection.course.vectors import FeatureOptions
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE, FeatureParams
from vehicle_detection.svm import (
    UNIT_CHANNELS,
    VehicleClassifier,
    fold_estimators,
    has_unit_range,
    n_features,
)

# Greatest value of a channel of a 0-1 image, with a margin: V of YUV reaches 1.12.
_MAX_UNIT = 1.2
# Least share of the values outside of the first bins that shows histograms of another range than 0-1.
_MIN_SPREAD = 0.1
# The attributes that a linear classifier and a scaler compute with.
_MODEL_STATE = (
    "classes_", "coef_", "intercept_", "mean_", "center_", "min_", "scale_", "with_mean", "with_std", "clip",
)  # fmt: skip
# The last model: a system calls `find_cars` for each scale and frame with the same one.
_last_model: tuple[list[Any], FeatureParams, VehicleClassifier] | None = None


def library_classifier(clf: Any, scaler: Any, params: FeatureParams) -> VehicleClassifier | None:
    """Return a linear classifier and its scaler as the library's classifier; None for other estimators."""
    global _last_model
    clf = getattr(clf, "best_estimator_", clf)  # of a GridSearchCV
    steps = [clf] if scaler is None else [scaler, clf]
    # Only classes of scikit-learn: others may predict in another way, as does a replaced method.
    if not all(type(step).__module__.startswith("sklearn.") for step in steps) or "predict" in vars(clf):
        return None
    state: list[Any] = [type(clf), type(scaler)]
    state += [getattr(each, name, None) for each in (clf, scaler) for name in _MODEL_STATE]
    last = _last_model
    if last is not None and last[1] == params and all(map(_equal, last[0], state)):
        return last[2]
    try:
        classifier = VehicleClassifier(params, (fold_estimators(steps, params.length),))
    except InvalidInputError:
        return None
    _last_model = (copy.deepcopy(state), params, classifier)
    return classifier


def _equal(first: Any, second: Any) -> bool:
    return np.array_equal(first, second) if isinstance(first, np.ndarray) else bool(first == second)


def predicts_car(features: NDArray[np.float64], clf: Any, scaler: Any) -> NDArray[np.bool_]:
    """Whether the classifier predicts 1 for each of ``(N, length)`` feature vectors."""
    scaled = features if scaler is None else scaler.transform(features)
    labels = np.asarray(clf.predict(scaled)).reshape(-1)
    if len(labels) != len(features):
        raise InvalidInputError(
            f"the classifier must predict a label for each of {len(features)} windows; got {len(labels)} "
            f"from {type(clf).__name__}.predict"
        )
    return np.asarray(labels == 1)


def check_estimators(clf: Any, scaler: Any, options: FeatureOptions, image: Image) -> None:
    """Check that a classifier and its scaler fit the features, and the range of an image's values."""
    from sklearn.exceptions import NotFittedError
    from sklearn.utils.validation import check_is_fitted

    for estimator, name, method in ((clf, "classifier", "predict"), (scaler, "scaler", "transform")):
        if scaler is None and name == "scaler":
            continue
        if not hasattr(estimator, method):
            raise InvalidInputError(f"the {name} must have a method {method}; got {describe(estimator)}")
        if type(estimator).__module__.startswith("sklearn."):
            try:
                check_is_fitted(estimator)
            except NotFittedError:
                raise InvalidInputError(
                    f"the {name} must be fitted; got an unfitted {type(estimator).__name__}: call fit first"
                ) from None
    if options.hog_feat and options.blocks < 1:
        raise InvalidInputError(
            f"a block of {options.cell_per_block} cells of {options.pix_per_cell} pixels must fit into a "
            f"window of {PATCH_SIZE} pixels"
        )
    first, name = (clf, "classifier") if scaler is None else (scaler, "scaler")
    fitted = n_features(first)
    if fitted not in (None, options.length):
        raise InvalidInputError(
            f"the {name} was fitted on {fitted} features, but these options give {options.length}; pass the "
            "options that the classifier was trained with"
        )
    trained_on_unit = _was_fitted_on_unit_range(scaler, options)
    largest = 255.0 if image.dtype == np.uint8 else float(image.max())
    if largest <= 0.1:
        return  # an almost black image may have either range
    if trained_on_unit is not None and (largest <= 2) != trained_on_unit:
        trained, given = ("0-1", "0-255") if trained_on_unit else ("0-255", "0-1")
        problem = f"the scaler was fitted on values {trained}, but the image has values {given}"
    elif largest <= 2 and _has_spread_histograms(scaler, options):
        problem = (
            "the scaler was fitted on histograms with values in many bins, but all values of a 0-1 image are "
            f"in the first bin of hist_range={options.hist_range}"
        )
    else:
        return
    warnings.warn(
        f"{problem}, which makes predictions useless. extract_features and mpimg.imread read a PNG as 0-1 "
        "and other files as 0-255; find_cars divides by 255 unless divide_by=1 is passed. A model trained "
        'with the functions of the HOG sub-sampling quiz needs hist_range=None and spatial_order="channels".',
        stacklevel=_caller_level(),
    )


def _caller_level() -> int:
    """Return the ``stacklevel`` for a warning of the calling function that names the user's code."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("vehicle_detection."):
        frame, level = frame.f_back, level + 1
    return level


def _has_spread_histograms(scaler: Any, options: FeatureOptions) -> bool:
    """Whether a scaler was fitted on histograms with values that channels of a 0-1 image cannot have."""
    means = getattr(scaler, "mean_", None)
    channels = list(UNIT_CHANNELS.get(options.color_space, ()))
    if means is None or not (options.hist_feat and options.hist_range and channels):
        return False
    width, height = options.spatial_size
    start = 3 * width * height if options.spatial_feat else 0
    counts = means[start : start + 3 * options.hist_bins].reshape(3, -1)[channels]
    lows = np.linspace(*options.hist_range, options.hist_bins, endpoint=False)
    return bool(counts[:, lows > _MAX_UNIT].sum() > _MIN_SPREAD * counts.sum())


def _was_fitted_on_unit_range(scaler: Any, options: FeatureOptions) -> bool | None:
    """Whether a scaler was fitted on features of images with values 0-1; None if it does not show it."""
    means, scales = (getattr(scaler, name, None) for name in ("mean_", "scale_"))
    if means is None:
        return None
    params = options.library_params(options.color_space)
    if params is not None:
        found = has_unit_range(means, np.ones_like(means) if scales is None else scales, params)
        return found or (False if options.spatial_feat else None)
    if not options.spatial_feat or len(UNIT_CHANNELS.get(options.color_space, ())) < 3:
        return None
    width, height = options.spatial_size
    return bool(np.max(means[: 3 * width * height]) <= 2)
