"""Fold fitted scikit-learn estimators, scalers and a linear classifier, into one `Template`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, describe
from vehicle_detection.classifier import Template
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import FeatureParams

_SCALERS = ("StandardScaler", "RobustScaler", "MinMaxScaler", "MaxAbsScaler")
# Channels whose values are 0-1 in float images. Those of LUV and LAB have other ranges.
UNIT_CHANNELS = dict.fromkeys(("RGB", "YUV", "YCrCb"), (0, 1, 2)) | {"HSV": (1, 2), "HLS": (1, 2)}
# Greatest sum of mean and scale of a spatial bin with values 0-1. For the last channel of LUV and LAB: the
# greatest mean in float images, where gray is 0, and the least sum in uint8 images, where gray is over 127.
_MAX_UNIT, _MAX_FLOAT_MEAN, _GRAY = 2.5, 64.0, 128.0


def split_pipeline(model: Any) -> tuple[FeatureParams | None, list[Any]]:
    """Split a fitted pipeline, search or ``(classifier, scaler)`` pair: parameters of its features, steps.

    The parameters are those of a first step `PatchFeatures`, None without it. The classifier is the last
    step.
    """
    from vehicle_detection.features import PatchFeatures

    steps = _flatten(model)
    if isinstance(model, (tuple, list)) and len(steps) == 2 and hasattr(steps[0], "predict"):
        steps.reverse()
    if steps and isinstance(steps[0], PatchFeatures):
        return steps[0].to_params(), steps[1:]
    return None, steps


def _flatten(model: Any) -> list[Any]:
    """List the fitted estimators of nested pipelines and searches, in order."""
    if isinstance(model, (tuple, list)):
        return [step for part in model for step in _flatten(part)]
    if hasattr(model, "steps"):
        return [step for _, part in model.steps for step in _flatten(part)]
    if model is None or isinstance(model, str):  # "passthrough"
        return []
    if hasattr(model, "estimator") and hasattr(model, "refit"):  # GridSearchCV and its relatives
        if not hasattr(model, "best_estimator_"):
            name = type(model).__name__
            raise InvalidInputError(f"pipeline must be fitted, with refit=True; its {name} is not")
        return _flatten(model.best_estimator_)
    return [model]


def linear_svc(C: float, random_state: int) -> Any:
    """Return the unfitted ``LinearSVC`` of `train_classifier`.

    With its usual tolerance, scores on all of the course's patches are off by up to 0.01, in the same time.
    """
    from sklearn.svm import LinearSVC

    return LinearSVC(C=C, tol=1e-6, random_state=random_state, max_iter=10_000)


def fit_estimator(
    estimator: Any,
    features: NDArray[np.float32],
    labels: NDArray[np.int64],
    weights: NDArray[np.float64],
    gains: NDArray[np.float64],
) -> Template:
    """Fit a scaler and a copy of a linear classifier; `weights` are those of the rows of `features`."""
    from sklearn.base import clone
    from sklearn.preprocessing import StandardScaler
    from sklearn.utils.validation import has_fit_parameter

    is_estimator = hasattr(estimator, "fit") and hasattr(estimator, "get_params")
    if not is_estimator or isinstance(estimator, type) or hasattr(estimator, "steps"):
        raise InvalidInputError(
            f"estimator must be a scikit-learn classifier without its scaler; got {describe(estimator)}"
        )
    weighted = bool((weights != 1).any())
    if weighted and not has_fit_parameter(estimator, "sample_weight"):
        raise InvalidInputError(
            f"estimator must accept sample_weight for degraded copies; {type(estimator).__name__} does not"
        )
    scaler = StandardScaler(copy=False).fit(features)
    scaled = scaler.transform(features)
    scaled *= gains.astype(np.float32)
    fitted = clone(estimator).fit(scaled, labels, **({"sample_weight": weights} if weighted else {}))
    try:
        template = fold_estimators([scaler, *_flatten(fitted)], len(gains))
    except InvalidInputError as error:
        raise InvalidInputError(
            f"estimator must be a linear classifier, such as LinearSVC; got {describe(estimator)}. "
            "compare_classifiers trains any classifier, and vehicle_detection.course searches with it"
        ) from error
    return Template(template.mean, template.scale / gains, template.coef, template.intercept)


def fold_estimators(steps: Sequence[Any], length: int) -> Template:
    """Fold fitted scalers and, last, a linear classifier of vectors of `length` into a template.

    Raises
    ------
    InvalidInputError
        If a step is of another kind, not fitted, or fitted on vectors of another length or other labels.
    """
    if not steps:
        raise InvalidInputError("pipeline must end in a linear classifier; got no step")
    *scalers, classifier = steps
    mean, scale = np.zeros(length), np.ones(length)
    for scaler in scalers:
        offset, factor = _scaling(scaler, length)
        mean, scale = mean + scale * offset, scale * factor
    return Template(mean, scale, *_weights(classifier, length))


def n_features(estimator: Any) -> int | None:
    """Return the number of features that a scaler or linear classifier was fitted on; None if unknown.

    Estimators that scikit-learn before 0.24 has pickled lack ``n_features_in_``.
    """
    found = getattr(estimator, "n_features_in_", None)
    if found is not None:
        return int(found)
    if not type(estimator).__module__.startswith("sklearn."):
        return None
    arrays: list[Any] = [getattr(estimator, name, None) for name in ("scale_", "mean_", "center_", "coef_")]
    return next((int(array.shape[-1]) for array in arrays if np.ndim(array)), None)


def _scaling(scaler: Any, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offset and factor of a fitted scaler, which computes ``(x - offset) / factor``."""
    name = type(scaler).__name__
    if name not in _SCALERS:
        raise InvalidInputError(
            f"pipeline must hold only {', '.join(_SCALERS)} before the classifier; got {name}, which does "
            "not scale each feature by itself. Train with one of these, or search with "
            "vehicle_detection.course, which accepts any scikit-learn estimator"
        )
    fitted = n_features(scaler)
    if fitted is None:
        raise InvalidInputError(f"pipeline must be fitted; its {name} is not: call fit first")
    _check_length(fitted, length, name)
    offset, factor = np.zeros(length), np.ones(length)
    if getattr(scaler, "clip", False):
        raise InvalidInputError(f"pipeline must not clip; train with {name}(clip=False)")
    if name == "MinMaxScaler":
        return -scaler.min_ / scaler.scale_, 1 / scaler.scale_
    center = getattr(scaler, "mean_" if name == "StandardScaler" else "center_", None)
    if center is not None and getattr(scaler, "with_mean", True):
        offset = np.asarray(center, np.float64)
    if getattr(scaler, "scale_", None) is not None:
        factor = np.asarray(scaler.scale_, np.float64)
    return offset, factor


def _weights(classifier: Any, length: int) -> tuple[NDArray[np.float64], float]:
    """Weights and intercept of a fitted linear classifier of two classes."""
    name = type(classifier).__name__
    if not hasattr(classifier, "predict"):
        raise InvalidInputError(f"pipeline must end in a linear classifier; got {describe(classifier)}")
    if not hasattr(classifier, "classes_"):
        raise InvalidInputError(f"pipeline must be fitted; its {name} is not: call fit first")
    if not hasattr(classifier, "coef_") or not hasattr(classifier, "decision_function"):
        raise InvalidInputError(
            f"pipeline must end in a linear classifier, such as LinearSVC; got {name}. Search with "
            "vehicle_detection.course, which accepts any scikit-learn estimator"
        )
    labels = list(classifier.classes_)
    if labels not in ([0, 1], [-1, 1]):
        raise InvalidInputError(
            f"pipeline must be fitted on the labels 0 or -1 for others and 1 for vehicles; got {labels}"
        )
    coef = classifier.coef_
    coef = np.asarray(coef.toarray() if hasattr(coef, "toarray") else coef, np.float64).ravel()
    _check_length(len(coef), length, name)
    return coef, float(np.ravel(classifier.intercept_)[0])


def _check_length(fitted: int, length: int, name: str) -> None:
    if fitted != length:
        raise InvalidInputError(
            f"pipeline must be fitted on the {length} features of its parameters; its {name} was fitted on "
            f"{fitted}. Pass the parameters that the features were computed with"
        )


def check_equal_scores(template: Template, steps: Sequence[Any]) -> None:
    """Compare the template with the estimators on random vectors: those of other libraries may differ."""
    *scalers, classifier = steps
    rng = np.random.default_rng(0)
    vectors = template.mean + template.scale * rng.normal(scale=3, size=(16, len(template.mean)))
    weights, bias = template.fold()
    expected = vectors @ weights + bias
    scaled = vectors
    for scaler in scalers:
        scaled = scaler.transform(scaled)
    scores = np.ravel(classifier.decision_function(scaled))
    if not np.allclose(scores, expected, rtol=1e-3, atol=1e-3 * float(np.abs(expected).max())):
        names = " and ".join(type(step).__name__ for step in steps)
        raise InvalidInputError(f"pipeline must score by a weighted sum of the features; {names} does not")


def check_uint8(template: Template, params: FeatureParams) -> None:
    """Check that scaled features are not those of images with values 0-1, as the course reads PNG files.

    Such a template is useless for uint8 images. Its spatial bins can be converted, but not the HOG of a color
    channel, whose small differences the rounding to uint8 removes.

    Raises
    ------
    InvalidInputError
        If the spatial bins, or the histogram where all values are in the first bins, show it.
    """
    if has_unit_range(template.mean, template.scale, params):
        raise InvalidInputError(
            "pipeline must be fitted on features of uint8 images; it was fitted on values 0-1, as which the "
            "course reads PNG files. Pass imread=vehicle_detection.read_image to extract_features, and fit "
            "the scaler and the classifier again"
        )


def has_unit_range(mean: Floats, scale: Floats, params: FeatureParams) -> bool:
    """Whether features with this mean and scale show that the images had values 0-1; HOG does not show it."""
    return _has_float_bins(mean, scale, params) or _has_first_bins_only(mean, scale, params)


def _has_float_bins(mean: Floats, scale: Floats, params: FeatureParams) -> bool:
    """Whether the spatial bins are those of float images; False for LUV and LAB if nothing is subtracted."""
    if not params.spatial_feat:
        return False
    means, scales = (params.spatial_planes(values[: params.spatial_length]) for values in (mean, scale))
    if params.spatial_space in UNIT_CHANNELS:
        channels = UNIT_CHANNELS[params.spatial_space]
        return bool((np.abs(means) + scales)[list(channels)].max() < _MAX_UNIT)
    is_centered = bool(means.any())
    return is_centered and bool(means[2].max() < _MAX_FLOAT_MEAN and (means + scales)[2].min() < _GRAY)


def _has_first_bins_only(mean: Floats, scale: Floats, params: FeatureParams) -> bool:
    """Whether all values of the channels with the range 0-1 are in the first bin of a histogram of 0-256."""
    bins = slice(params.spatial_length, params.spatial_length + params.hist_length)
    channels = list(UNIT_CHANNELS.get(params.hist_space, ()))
    if not params.hist_feat or params.hist_bins == 1 or not channels:
        return False
    means, scales = (values[bins].reshape(3, -1)[channels, 1:] for values in (mean, scale))
    return bool((means == 0).all() and (scales == 1).all())
