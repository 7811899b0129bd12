"""The linear SVM classifier of 64x64 patches: prediction, training and model file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check, invalid, pluralize, read_model, write_model
from vehicle_detection.boxes import Platt
from vehicle_detection.datasets import check_labels
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.features import PATCH_SIZE, FeatureParams, extract_features
from vehicle_detection.search import BandFilters, BandSearch, SearchParams

KIND = "patches"
"""Value of ``kind`` in the model files of patch classifiers."""

_SCALERS = ("StandardScaler", "RobustScaler", "MinMaxScaler", "MaxAbsScaler")
# Channels whose values are 0-1 in float images. Those of LUV and LAB have other ranges.
UNIT_CHANNELS = dict.fromkeys(("RGB", "YUV", "YCrCb"), (0, 1, 2)) | {"HSV": (1, 2), "HLS": (1, 2)}
# Greatest sum of mean and scale of a spatial bin with values 0-1.
# LUV and LAB, last channel: gray is 0 in float images and over 127 in uint8. Float: every mean is below 64,
# and some mean + scale is below 128.
_MAX_UNIT_SUM, _MAX_FLOAT_MEAN, _GRAY = 2.5, 64.0, 128.0

# Fitted to the boxes of the model "highway" in labelled frames of the course's road, not to patches: most
# windows of a frame show no vehicle.
_BOX_CALIBRATION = Platt(-6.29, 5.74)

_OR_ELSE = "search with vehicle_detection.course, which accepts any scikit-learn estimator"
CLASSIFIER_REMEDY = "load_classifier, train_classifier or VehicleClassifier.from_pipeline make one"


@dataclass(frozen=True, eq=False)
class Template:
    """One linear SVM, called a template because its weights act as a filter.

    The features are scaled: ``score = coef @ ((x - mean) / scale) + intercept``.
    """

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    coef: NDArray[np.float64]
    intercept: float

    def __post_init__(self) -> None:
        for name in ("mean", "scale", "coef"):
            column = np.array(getattr(self, name), np.float64)
            if column.ndim != 1 or column.shape != np.shape(self.mean):
                raise invalid(name, f"be a vector of the features' length {np.shape(self.mean)}", column)
            if not np.isfinite(column).all():
                raise InvalidInputError(f"{name} must be finite, got NaN or infinity; train again")
            column.setflags(write=False)
            object.__setattr__(self, name, column)
        if not (self.scale > 0).all():
            raise InvalidInputError("scale must be positive; a constant feature has scale 1")
        object.__setattr__(self, "intercept", check.number(self.intercept, "intercept"))
        with np.errstate(over="ignore", invalid="ignore"):
            weights, bias = self.fold()
        if not (np.isfinite(weights).all() and math.isfinite(bias)):
            raise InvalidInputError("coef must be of the order of scale; their quotient is too large")

    def fold(self) -> tuple[NDArray[np.float64], float]:
        """Weights and bias of the equivalent affine function ``score = weights @ x + bias``."""
        weights = self.coef / self.scale
        return weights, float(self.intercept - weights @ self.mean)


@dataclass(frozen=True, eq=False, repr=False)
class VehicleClassifier:
    """A linear classifier of 64x64 patches, or of feature vectors.

    Attributes
    ----------
    params
        Parameters of the features.
    templates
        One or more linear SVMs; the score of a patch is their maximum.
    metadata
        JSON values kept in the model file: training options, metrics, data, versions.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> classifier = load_classifier()
    >>> classifier.predict(np.zeros((2, 64, 64, 3), np.uint8)).tolist()
    [0, 0]
    """

    search_params_type: ClassVar[type[SearchParams]] = SearchParams
    searches_every_frame: ClassVar[bool] = False

    params: FeatureParams
    templates: tuple[Template, ...]
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check.instance(self.params, "params", FeatureParams, CLASSIFIER_REMEDY)
        object.__setattr__(self, "templates", check.sequence(self.templates, "templates", "Template"))
        if not self.templates:
            raise InvalidInputError("templates must hold at least one template; got none")
        for template in self.templates:
            check.instance(template, "templates", Template, CLASSIFIER_REMEDY)
            if template.coef.shape != (self.params.length,):
                must = f"have {self.params.length} weights, the length of the features"
                raise invalid("templates", must, len(template.coef))

    @property
    def calibration(self) -> Platt:
        """Probability that a box contains a vehicle, by its best window's score, on the course's road.

        It is too high on other roads, which have more lookalikes, and for models with other features.
        """
        return _BOX_CALIBRATION

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Score of each patch, positive for a vehicle: ``(N,)`` float64, the maximum of several templates.

        `X` is ``(N, length)`` feature vectors, or ``(N, 64, 64, 3)`` uint8 RGB patches.
        """
        features = self._features_of(X)
        folded = [template.fold() for template in self.templates]
        scores = np.empty(len(features))
        # Convert in chunks: a float64 copy of all features may not fit into memory.
        for chunk in (slice(start, start + 1024) for start in range(0, len(features), 1024)):
            rows = features[chunk].astype(np.float64)
            scores[chunk] = np.max([rows @ weights + bias for weights, bias in folded], axis=0)
        return scores

    def predict(self, X: ArrayLike) -> NDArray[np.int64]:
        """Predict 1 for a vehicle and 0 otherwise, ``(N,)`` int64; `X` as in `decision_function`."""
        return (self.decision_function(X) > 0).astype(np.int64)

    def score(self, X: ArrayLike, y: ArrayLike) -> float:
        """Accuracy, 0 to 1, for ``(N,)`` labels `y`, 1 for a vehicle; `X` as in `decision_function`."""
        predicted = self.predict(X)
        if not len(predicted):
            raise invalid("X", "hold at least one row", X)
        labels = check_labels(y, "y", count=len(predicted), of="rows")
        return float(np.mean(predicted == labels))

    def _features_of(self, X: ArrayLike) -> NDArray[Any]:
        """Check feature vectors, or extract those of patches: ``(N, length)``."""
        array = check.array(X, "X")
        if array.ndim == 4:
            return extract_features(check.patches(array, PATCH_SIZE, "X"), self.params)
        if array.ndim != 2 or array.shape[1] != self.params.length or array.dtype.kind not in "iuf":
            raise invalid("X", f"be (N, {self.params.length}) features or (N, 64, 64, 3) patches", array)
        if not np.isfinite(array).all():
            raise InvalidInputError("X must be finite, got NaN or infinity")
        return array

    @classmethod
    def from_pipeline(
        cls, pipeline: Any, params: FeatureParams | None = None, *, metadata: Mapping[str, Any] | None = None
    ) -> VehicleClassifier:
        """Convert fitted scikit-learn estimators, scalers and a linear classifier: the scores are equal.

        Parameters
        ----------
        pipeline
            A fitted ``Pipeline``, a search over one such as ``GridSearchCV``, or a pair of a classifier and
            its scaler. Scalers: ``StandardScaler``, ``RobustScaler``, ``MinMaxScaler``, ``MaxAbsScaler``.
            Classifiers: any that computes a weighted sum, such as ``LinearSVC``, ``SGDClassifier``,
            ``LogisticRegression`` or ``SVC(kernel="linear")``, fitted on the labels 0 (or -1) and 1.
        params
            Parameters of the features that it was fitted on; not needed if the first step is `PatchFeatures`.
            For spatial bins computed with ``cv2.resize(image, size).ravel()`` pass
            ``spatial_order="interleaved"``: a wrong order cannot be detected, but the scores are wrong.
        metadata
            JSON values to keep in the model file.

        Raises
        ------
        InvalidInputError
            Also if the scaler was fitted on features of images with values 0-1, as which the course reads PNG
            files. HOG alone, and histograms of LUV and LAB, do not show this.

        Examples
        --------
        >>> from sklearn.pipeline import make_pipeline
        >>> from sklearn.preprocessing import MinMaxScaler
        >>> from sklearn.linear_model import RidgeClassifier
        >>> from vehicle_detection import render_patches
        >>> from vehicle_detection.training import PatchFeatures
        >>> patches, labels = render_patches(20)
        >>> pipeline = make_pipeline(PatchFeatures(orient=6), MinMaxScaler(), RidgeClassifier())
        >>> VehicleClassifier.from_pipeline(pipeline.fit(patches, labels)).score(patches, labels)
        1.0
        """
        known, steps = split_pipeline(pipeline)
        params = known if params is None else params
        if metadata is not None:
            check.instance(metadata, "metadata", Mapping, "pass a dictionary")
        if not isinstance(params, FeatureParams):
            raise invalid("params", "be the FeatureParams of the pipeline's features", params)
        # The gains change the weights only, not the features.
        if known and replace(params, hist_gain=known.hist_gain, coarse_gain=known.coarse_gain) != known:
            raise invalid("params", f"equal those of the pipeline, {known}, or be omitted", params)
        template = fold_estimators(steps, params.length)
        check_equal_scores(template, steps)
        if len(steps) > 1 and has_unit_range(template.mean, template.scale, params):
            # Their spatial bins can be converted, but not the HOG of a color channel, whose small differences
            # the rounding to uint8 removes.
            raise InvalidInputError(
                "pipeline must be fitted on features of uint8 images; it was fitted on values 0-1, as which "
                "the course reads PNG files. Pass imread=vehicle_detection.read_image to extract_features, "
                "and fit the scaler and the classifier again"
            )
        return cls(params, (template,), metadata or {})

    @cached_property
    def filters(self) -> BandFilters:
        """The model as filters over the bands of a frame; an error if windows cannot share the features."""
        return BandFilters(self.params, [template.fold() for template in self.templates])

    def open_search(self, jobs: int | None = None) -> BandSearch:
        """Open a search of frames in `jobs` threads: a thread-safe context manager, with `SearchParams`."""
        return BandSearch(self.filters, jobs)

    def __repr__(self) -> str:
        return f"VehicleClassifier({self.summary()[0]})"

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        title = f"{self.params.length} features, {pluralize(len(self.templates), 'template')}"
        return title, {name: str(value) for name, value in asdict(self.params).items()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as a safetensors file (tensors and JSON, no pickle)."""
        tensors = {
            f"{index}.{name}": np.array(value, np.float64, ndmin=1)
            for index, template in enumerate(self.templates)
            for name, value in vars(template).items()
        }
        write_model(path, KIND, asdict(self.params), tensors, self.metadata)


def load_classifier(path: str | os.PathLike[str] | None = None) -> VehicleClassifier:
    """Load a patch classifier from a file by `VehicleClassifier.save`, or the shipped model ``"highway"``.

    Raises
    ------
    ModelFileError
        If the file is missing, damaged, edited, of another kind or version, or inconsistent.

    Examples
    --------
    >>> load_classifier().params.color_space
    'LAB'
    """
    model = read_model("highway" if path is None else path, KIND)
    try:
        templates = []
        for index in range(len({key.split(".")[0] for key in model.tensors})):
            mean, scale, coef, intercept = (
                model.tensors[f"{index}.{name}"] for name in ("mean", "scale", "coef", "intercept")
            )
            templates.append(Template(mean, scale, coef, float(intercept.reshape(()))))
        return VehicleClassifier(FeatureParams(**model.params), tuple(templates), model.metadata)
    except (InvalidInputError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ModelFileError(f"{model.name} does not fit its own parameters: {error}") from error


def split_pipeline(model: Any) -> tuple[FeatureParams | None, list[Any]]:
    """Split a pipeline, search or ``(classifier, scaler)`` pair: parameters of its `PatchFeatures`, steps."""
    steps = flatten_steps(model)
    if isinstance(model, (tuple, list)) and len(steps) == 2 and hasattr(steps[0], "predict"):
        steps.reverse()
    if steps and hasattr(steps[0], "to_params"):
        return steps[0].to_params(), steps[1:]
    return None, steps


def flatten_steps(model: Any) -> list[Any]:
    """List the fitted estimators of nested pipelines and searches, in order."""
    if isinstance(model, (tuple, list)):
        return [step for part in model for step in flatten_steps(part)]
    if hasattr(model, "steps"):
        return [step for _, part in model.steps for step in flatten_steps(part)]
    if model is None or isinstance(model, str):  # "passthrough"
        return []
    if hasattr(model, "estimator") and hasattr(model, "refit"):  # GridSearchCV and its relatives
        if not hasattr(model, "best_estimator_"):
            name = type(model).__name__
            raise InvalidInputError(f"pipeline must be fitted, with refit=True; its {name} is not")
        return flatten_steps(model.best_estimator_)
    return [model]


def fold_estimators(steps: Sequence[Any], length: int) -> Template:
    """Fold fitted scalers and, last, a linear classifier of vectors of `length` into a template."""
    if not steps:
        raise InvalidInputError("pipeline must end in a linear classifier; got no step")
    *scalers, classifier = steps
    mean, scale = np.zeros(length), np.ones(length)
    for scaler in scalers:
        offset, factor = _scaling(scaler, length)
        # ((x - mean) / scale - offset) / factor = (x - (mean + scale * offset)) / (scale * factor)
        mean, scale = mean + scale * offset, scale * factor
    return Template(mean, scale, *_weights(classifier, length))


def n_features(estimator: Any) -> int | None:
    """Return the number of features that a scaler or linear classifier was fitted on; None if unknown."""
    found = getattr(estimator, "n_features_in_", None)
    if found is not None or not type(estimator).__module__.startswith("sklearn."):
        return found
    # Estimators that scikit-learn before 0.24 has pickled lack n_features_in_.
    arrays: list[Any] = [getattr(estimator, name, None) for name in ("scale_", "mean_", "center_", "coef_")]
    return next((int(array.shape[-1]) for array in arrays if np.ndim(array)), None)


def _scaling(scaler: Any, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offset and factor of a fitted scaler, which computes ``(x - offset) / factor``."""
    name = type(scaler).__name__
    if name not in _SCALERS:
        must = f"hold only {', '.join(_SCALERS)} before the classifier"
        reason = "which does not scale each feature by itself"
        raise InvalidInputError(f"pipeline must {must}; got {name}, {reason}; train again, or {_OR_ELSE}")
    fitted = n_features(scaler)
    if fitted is None:
        raise InvalidInputError(f"pipeline must be fitted; its {name} is not: call fit first")
    _check_length(fitted, length, name)
    offset, factor = np.zeros(length), np.ones(length)
    if getattr(scaler, "clip", False):
        raise InvalidInputError(f"pipeline must not clip; train with {name}(clip=False)")
    if name == "MinMaxScaler":
        # It computes x * scale_ + min_.
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
        raise InvalidInputError(f"pipeline must end in a linear classifier; got {check.describe(classifier)}")
    if not hasattr(classifier, "classes_"):
        raise InvalidInputError(f"pipeline must be fitted; its {name} is not: call fit first")
    if not hasattr(classifier, "coef_") or not hasattr(classifier, "decision_function"):
        must = "end in a linear classifier, such as LinearSVC"
        raise InvalidInputError(f"pipeline must {must}; got {name}; {_OR_ELSE}")
    labels = np.asarray(classifier.classes_).tolist()
    if labels not in ([0, 1], [-1, 1]):
        must = "be fitted on the labels 0 or -1 for others and 1 for vehicles"
        raise invalid("pipeline", must, labels)
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
        return bool((np.abs(means) + scales)[list(channels)].max() < _MAX_UNIT_SUM)
    is_centered = bool(means.any())
    return is_centered and bool(means[2].max() < _MAX_FLOAT_MEAN and (means + scales)[2].min() < _GRAY)


def _has_first_bins_only(mean: Floats, scale: Floats, params: FeatureParams) -> bool:
    """Whether all values of the channels with the range 0-1 are in the first bin of a histogram of 0-256."""
    bins = slice(params.spatial_length, params.spatial_length + params.hist_length)
    channels = list(UNIT_CHANNELS.get(params.hist_space, ()))
    if not params.hist_feat or params.hist_bins == 1 or not channels:
        return False
    means, scales = (values[bins].reshape(3, -1)[channels, 1:] for values in (mean, scale))
    # StandardScaler gives constant features scale 1.
    return bool((means == 0).all() and (scales == 1).all())
