"""The linear SVM classifier of 64x64 patches: prediction, training and model file."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

import vehicle_detection
from vehicle_detection._common import (
    blur_patches,
    check_array,
    check_bool,
    check_choice,
    check_integer,
    check_number,
    check_patches,
    check_sequence,
    check_type,
    degrade_patches,
    describe,
    mirror_patches,
    pluralize,
    read_model,
    store_number,
    write_model,
)
from vehicle_detection._kernels import fit_svm
from vehicle_detection.boxes import Platt
from vehicle_detection.datasets import PatchSet
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.features import extract_features, read_patches
from vehicle_detection.params import PATCH_SIZE, FeatureParams, SearchParams

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

    from vehicle_detection.search import FrameSearch

KIND = "patches"
"""Value of ``kind`` in the model files of patch classifiers."""

DEFAULT_C = 1e-4

# Fitted to the boxes of the model "highway" in labelled frames of the course's road, not to patches: most
# windows of a frame show no vehicle.
_BOX_CALIBRATION = Platt(-6.29, 5.74)

CLASSIFIER_REMEDY = "load_classifier, train_classifier or VehicleClassifier.from_pipeline make one"


@dataclass(frozen=True, eq=False)
class Template:
    """A linear SVM on scaled features: ``score = coef @ ((x - mean) / scale) + intercept``."""

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    coef: NDArray[np.float64]
    intercept: float

    def __post_init__(self) -> None:
        for name in ("mean", "scale", "coef"):
            column = np.array(getattr(self, name), np.float64)
            if column.ndim != 1 or column.shape != np.shape(self.mean):
                raise InvalidInputError(
                    f"{name} must be a vector of the features' length {np.shape(self.mean)}; "
                    f"got {describe(column)}"
                )
            if not np.isfinite(column).all():
                raise InvalidInputError(f"{name} must be finite, got NaN or infinity; train again")
            column.setflags(write=False)
            object.__setattr__(self, name, column)
        if not (self.scale > 0).all():
            raise InvalidInputError("scale must be positive; a constant feature has scale 1")
        store_number(self, "intercept")
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
        check_type(self.params, "params", FeatureParams, CLASSIFIER_REMEDY)
        object.__setattr__(self, "templates", check_sequence(self.templates, "templates", "Template"))
        if not self.templates:
            raise InvalidInputError("templates must hold at least one template; got none")
        for template in self.templates:
            check_type(template, "templates", Template, CLASSIFIER_REMEDY)
            if template.coef.shape != (self.params.length,):
                raise InvalidInputError(
                    f"templates must have {self.params.length} weights, the length of the features; "
                    f"got {len(template.coef)}"
                )

    @property
    def calibration(self) -> Platt:
        """Probability that a box contains a vehicle, by its best window's score, on the course's road.

        Other roads have more lookalikes, and the probabilities there are too high; so may be those of models
        with other features.
        """
        return _BOX_CALIBRATION

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Score of each patch: its signed distance from the separating hyperplane, positive for a vehicle.

        Parameters
        ----------
        X
            ``(N, length)`` feature vectors, or ``(N, 64, 64, 3)`` uint8 RGB patches.

        Returns
        -------
        numpy.ndarray
            ``(N,)`` float64; with several templates, the maximum of their scores.

        Raises
        ------
        InvalidInputError
            If the vectors are of another length or hold NaN.
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
        """Accuracy: fraction of correct predictions.

        Parameters
        ----------
        X
            As in `decision_function`.
        y
            ``(N,)`` labels, 1 for a vehicle, 0 otherwise.

        Returns
        -------
        float
            In [0, 1].

        Raises
        ------
        InvalidInputError
            If `X` is malformed or empty, or `y` is of another length.
        """
        labels, predicted = check_array(y, "y"), self.predict(X)
        if labels.shape != predicted.shape or not labels.size:
            raise InvalidInputError(
                f"y must hold one label for each of {len(predicted)} rows (at least one); "
                f"got {describe(labels)}"
            )
        return float(np.mean(predicted == labels))

    def _features_of(self, X: ArrayLike) -> NDArray[Any]:
        """Check feature vectors, or extract those of patches: ``(N, length)``."""
        array = check_array(X, "X")
        if array.ndim == 4:
            return extract_features(check_patches(array, PATCH_SIZE, "X"), self.params)
        if array.ndim != 2 or array.shape[1] != self.params.length or array.dtype.kind not in "iuf":
            raise InvalidInputError(
                f"X must be (N, {self.params.length}) features or (N, 64, 64, 3) patches; "
                f"got {describe(array)}"
            )
        if not np.isfinite(array).all():
            raise InvalidInputError("X must be finite, got NaN or infinity")
        return array

    @classmethod
    def from_pipeline(
        cls,
        pipeline: Any,
        params: FeatureParams | None = None,
        *,
        metadata: Mapping[str, Any] | None = None,
    ) -> VehicleClassifier:
        """Convert fitted scikit-learn estimators: scalers and a linear classifier.

        Scores equal the classifier's ``decision_function``.

        Parameters
        ----------
        pipeline
            A fitted ``Pipeline``, a search over one such as ``GridSearchCV``, or a pair of a classifier and
            its scaler. Scalers: ``StandardScaler``, ``RobustScaler``, ``MinMaxScaler``, ``MaxAbsScaler``.
            Classifiers: any that computes a weighted sum, such as ``LinearSVC``, ``SGDClassifier``,
            ``LogisticRegression`` or ``SVC(kernel="linear")``, fitted on the labels 0 (or -1) and 1.
        params
            Parameters of the features that it was fitted on; not needed if the first step is `PatchFeatures`.
            The order of the spatial bins matters: for features computed with
            ``cv2.resize(image, size).ravel()`` pass ``spatial_order="interleaved"``. The length of a vector
            does not depend on the order, so that a wrong one cannot be detected, but the scores are wrong.
        metadata
            JSON values to keep in the model file.

        Returns
        -------
        VehicleClassifier
            A model with one template.

        Raises
        ------
        InvalidInputError
            If a step is of another kind or not fitted, the features have another length, `params` differ
            from those of the pipeline's `PatchFeatures`, or the scaler was fitted on features of images with
            values 0-1, as which the course reads PNG files. HOG alone, and histograms of LUV and LAB, do not
            show this.

        Examples
        --------
        >>> from sklearn.pipeline import make_pipeline
        >>> from sklearn.preprocessing import MinMaxScaler
        >>> from sklearn.linear_model import RidgeClassifier
        >>> from vehicle_detection import PatchFeatures, render_patches
        >>> patches, labels = render_patches(20)
        >>> pipeline = make_pipeline(PatchFeatures(orient=6), MinMaxScaler(), RidgeClassifier())
        >>> VehicleClassifier.from_pipeline(pipeline.fit(patches, labels)).score(patches, labels)
        1.0
        """
        from vehicle_detection.sklearn_models import (
            check_equal_scores,
            check_uint8,
            fold_estimators,
            split_pipeline,
        )

        known, steps = split_pipeline(pipeline)
        params = known if params is None else params
        if metadata is not None:
            check_type(metadata, "metadata", Mapping, "pass a dictionary")
        if not isinstance(params, FeatureParams):
            raise InvalidInputError(
                f"params must be the FeatureParams of the pipeline's features; got {describe(params)}"
            )
        # The gains change the weights only, not the features.
        if known and replace(params, hist_gain=known.hist_gain, coarse_gain=known.coarse_gain) != known:
            raise InvalidInputError(
                f"params must equal those of the pipeline, {known}, or be omitted; got {params}"
            )
        template = fold_estimators(steps, params.length)
        check_equal_scores(template, steps)
        if len(steps) > 1:
            check_uint8(template, params)
        return cls(params, (template,), metadata or {})

    def to_pipeline(self) -> Pipeline:
        """Convert to a fitted scikit-learn pipeline: `PatchFeatures`, ``StandardScaler``, ``LinearSVC``.

        Raises
        ------
        InvalidInputError
            If the model has several templates.
        """
        from sklearn.pipeline import Pipeline
        from sklearn.preprocessing import StandardScaler
        from sklearn.svm import LinearSVC

        from vehicle_detection.features import PatchFeatures

        if len(self.templates) > 1:
            raise InvalidInputError(
                f"only a model with one template converts; this has {len(self.templates)}"
            )
        template = self.templates[0]
        scaler, svm = StandardScaler(), LinearSVC()
        scaler.mean_, scaler.scale_ = template.mean.copy(), template.scale.copy()
        scaler.var_, scaler.n_samples_seen_ = template.scale**2, 1
        svm.coef_, svm.intercept_ = template.coef[None].copy(), np.array([template.intercept])
        svm.classes_ = np.array([0, 1])
        scaler.n_features_in_ = svm.n_features_in_ = self.params.length
        features = PatchFeatures(**asdict(self.params))
        return Pipeline([("features", features), ("scaler", scaler), ("svm", svm)])

    def open_search(
        self, n_jobs: int | None = None, method: Literal["shared", "windows"] = "shared"
    ) -> FrameSearch:
        """Open a search of frames with this model.

        Parameters
        ----------
        n_jobs
            Threads; the result does not depend on them.
        method
            ``"shared"``: the fast search; ``"windows"``: the reference, one patch per window.

        Returns
        -------
        FrameSearch
            A thread-safe context manager; its parameters are `SearchParams`.

        Raises
        ------
        InvalidInputError
            If `method` is unknown, or windows cannot share the features.
        """
        from vehicle_detection.search import BandSearch, ReferenceSearch

        check_choice(method, "method", ("shared", "windows"))
        search = BandSearch if method == "shared" else ReferenceSearch
        return search(self, n_jobs=n_jobs)

    def __repr__(self) -> str:
        return f"VehicleClassifier({self.summary()[0]})"

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        title = f"{self.params.length} features, {pluralize(len(self.templates), 'template')}"
        return title, {name: str(value) for name, value in asdict(self.params).items()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as a safetensors file (tensors and JSON, no pickle).

        Raises
        ------
        InvalidInputError
            If the folder is missing or read-only, or `metadata` holds other values than JSON.
        """
        tensors = {
            f"{index}.{name}": np.array(value, np.float64, ndmin=1)
            for index, template in enumerate(self.templates)
            for name, value in vars(template).items()
        }
        write_model(path, KIND, asdict(self.params), tensors, self.metadata)


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of the training, checked; `train_classifier` documents them.

    A misclassified vehicle costs `positive_weight` times a misclassified non-vehicle.
    """

    C: float = DEFAULT_C
    solver: Literal["liblinear", "dual"] = "dual"
    mirror: bool = True
    gamma: float = 0.0
    degraded: float = 0.0
    positive_weight: float = 1.0
    random_state: int = 0

    def __post_init__(self) -> None:
        checked = {
            "C": check_number(self.C, "C", above=0, high=1e12),
            "gamma": check_number(self.gamma, "gamma", low=0, high=2),
            "degraded": check_number(self.degraded, "degraded", low=0, high=1),
            "positive_weight": check_number(self.positive_weight, "positive_weight", above=0, high=1e6),
            "random_state": check_integer(self.random_state, "random_state", low=0, high=2**32 - 1),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        check_choice(self.solver, "solver", ("liblinear", "dual"))
        object.__setattr__(self, "mirror", check_bool(self.mirror, "mirror"))
        if self.gamma and not self.mirror:
            raise InvalidInputError(
                f"gamma must be 0 without mirrored patches, whose brightness it changes; got {self.gamma:g}"
            )

    @property
    def copy_weights(self) -> tuple[float, ...]:
        """Training weight of each copy of the patches, in the order of `patch_features`."""
        return (1.0, *(1.0,) * self.mirror, *(self.degraded, self.degraded) * (self.degraded > 0))

    def to_dict(self) -> dict[str, Any]:
        """Return the options of `train_classifier` as JSON values."""
        return {name: value for name, value in asdict(self).items() if name != "positive_weight"}


def train_classifier(
    patches: Any,
    labels: ArrayLike | None = None,
    *,
    params: FeatureParams | None = None,
    C: float = DEFAULT_C,
    solver: Literal["liblinear", "dual"] = "liblinear",
    estimator: Any = None,
    mirror: bool = True,
    gamma: float = 0.0,
    degraded: float = 0.0,
    random_state: int = 0,
    n_jobs: int | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> VehicleClassifier:
    """Train a linear SVM behind a feature scaler on patches: scikit-learn's ``LinearSVC``, or another model.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB training patches, or a list of patches or of image files. Without
        `labels`: a `PatchSet`, or a pair ``(cars, notcars)`` of such arrays or lists.
    labels
        ``(N,)``, 1 (or True) for a vehicle, 0 otherwise.
    params
        Features; the default is ``FeatureParams()``.
    C
        Inverse regularization strength. Small values generalize better to other sequences.
    solver
        ``"liblinear"``: ``LinearSVC`` of scikit-learn. ``"dual"``: the library's solver of the same problem,
        for large sets: on 17,760 patches with 8,460 features it needs a fifth of the time (5 of 24 s) and 4
        GB less memory, and its scores differ by less than 1e-4.
    estimator
        An unfitted scikit-learn classifier with linear scores, such as ``LogisticRegression(C=0.01)``, that
        replaces ``LinearSVC``, `C` and `solver`.
    mirror
        Add the mirror image of each patch.
    gamma
        Brightness jitter of the mirrored patches, as exponents from ``exp(-gamma)`` to ``exp(gamma)``.
    degraded
        Weight, in [0, 1], of two more copies of each patch, one blurred, the other also desaturated and
        compressed, which help on images of other cameras. 0 omits them.
    random_state
        Seed of the solver; the same input and seed give the same model.
    n_jobs
        Threads of the feature extraction.
    metadata
        JSON values to keep in the model file.

    Returns
    -------
    VehicleClassifier
        A model with one template. Its metadata also hold the training options and the versions of libraries.

    Raises
    ------
    InvalidInputError
        If a patch is malformed, the labels do not match the patches, a class is missing, or the estimator is
        not linear.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> train_classifier(patches, labels, params=FeatureParams(hog_channel=0)).score(patches, labels)
    1.0
    """
    params = FeatureParams() if params is None else params
    check_type(params, "params", FeatureParams, "omit it for the default")
    options = TrainingOptions(
        C=C, solver=solver, mirror=mirror, gamma=gamma, degraded=degraded, random_state=random_state
    )
    if metadata is not None:
        check_type(metadata, "metadata", Mapping, "pass a dictionary")
    images, targets = _read_training_set(patches, labels)
    features = patch_features(images, params, options, n_jobs=n_jobs)
    return fit_features(features, targets, params, options, estimator=estimator, metadata=metadata)


def _read_training_set(patches: Any, labels: ArrayLike | None) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Patches and labels of the forms that `train_classifier` accepts."""
    if labels is None and isinstance(patches, PatchSet):
        labels = patches.labels
    if labels is None:
        if not isinstance(patches, (tuple, list)) or len(patches) != 2:
            raise InvalidInputError(
                "labels must be given, unless patches is a PatchSet or a pair (cars, notcars); "
                f"patches is {describe(patches)}"
            )
        cars, others = (read_patches(part, name) for part, name in zip(patches, ("cars", "notcars")))
        patches, labels = np.concatenate([cars, others]), np.repeat([1, 0], [len(cars), len(others)])
    images = read_patches(patches, "patches")
    return images, check_labels(labels, len(images))


def patch_features(
    images: NDArray[np.uint8], params: FeatureParams, options: TrainingOptions, *, n_jobs: int | None = None
) -> NDArray[np.float32]:
    """Features of all patches, followed by those of their mirrored, blurred and degraded copies."""
    features = np.empty((len(options.copy_weights), len(images), params.length), np.float32)
    for rows, variant in zip(features, _augmented_copies(images, options)):
        rows[:] = extract_features(variant, params, n_jobs=n_jobs)
    return features.reshape(-1, params.length)


def _augmented_copies(images: NDArray[np.uint8], options: TrainingOptions) -> Iterator[NDArray[np.uint8]]:
    """Yield the patches and their copies one after the other, to save memory."""
    yield images
    if options.mirror:
        yield mirror_patches(images, gamma=options.gamma)
    if options.degraded:
        yield blur_patches(images, mirror=options.mirror)
        yield degrade_patches(images, mirror=options.mirror)


def fit_features(
    features: NDArray[np.float32],
    labels: NDArray[np.int64],
    params: FeatureParams,
    options: TrainingOptions,
    *,
    rows: NDArray[np.intp] | None = None,
    estimator: Any = None,
    metadata: Mapping[str, Any] | None = None,
) -> VehicleClassifier:
    """Train on the `patch_features` of the same options, which are not copied.

    `labels` is ``(N,)`` 0 or 1 with both classes. `rows` are the patches to train on, with all their copies.
    """
    from importlib.metadata import version

    weights, count = options.copy_weights, len(labels)
    chosen = np.arange(count) if rows is None else rows
    all_labels = np.tile(labels, len(weights))
    all_weights = np.repeat(weights, count) * np.where(all_labels == 1, options.positive_weight, 1.0)
    all_rows = np.concatenate([chosen + copy * count for copy in range(len(weights))])
    training, seed = options.to_dict(), options.random_state
    if estimator is None and options.solver == "dual":
        costs = options.C * all_weights
        fitted = fit_svm(features, all_labels, costs, rows=all_rows, gains=params.gains, random_state=seed)
        template, learner = Template(*fitted), "numba"
    else:
        from vehicle_detection.sklearn_models import fit_estimator, linear_svc

        if estimator is not None:
            training |= {"estimator": " ".join(repr(estimator).split()), "C": None, "solver": None}
        model = linear_svc(options.C, seed) if estimator is None else estimator
        rows_labels, rows_weights = all_labels[all_rows], all_weights[all_rows]
        template = fit_estimator(model, features[all_rows], rows_labels, rows_weights, params.gains)
        learner = "scikit-learn"
    vehicles = int(labels[chosen].sum())
    training |= {"vehicles": vehicles, "non_vehicles": len(chosen) - vehicles}
    libraries = {name: version(name) for name in (learner, "numpy", "opencv-python-headless")}
    versions = {"vehicle_detection": vehicle_detection.__version__, **libraries}
    all_metadata = {"training": training, "versions": versions, **(metadata or {})}
    return VehicleClassifier(params, (template,), all_metadata)


def check_labels(labels: ArrayLike, count: int) -> NDArray[np.int64]:
    """Return `labels` as `count` integers 0 or 1, both of which must occur."""
    array = check_array(labels, "labels")
    if array.shape != (count,) or array.dtype.kind not in "biuf":
        raise InvalidInputError(
            f"labels must hold one number for each of {count} patches; got {describe(array)}"
        )
    if not np.isin(array, (0, 1)).all():
        raise InvalidInputError(f"labels must be 0 or 1; got {np.unique(array)[:5].tolist()}")
    if count == 0 or array.min() == array.max():
        raise InvalidInputError("labels must hold both classes: vehicles (1) and non-vehicles (0)")
    return array.astype(np.int64)


def load_classifier(path: str | os.PathLike[str] | None = None) -> VehicleClassifier:
    """Load a patch classifier from a model file, or the shipped model ``"highway"``.

    Parameters
    ----------
    path
        A ``.safetensors`` file written by `VehicleClassifier.save`; None loads ``"highway"``.

    Returns
    -------
    VehicleClassifier
        The model with its feature parameters and metadata.

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
