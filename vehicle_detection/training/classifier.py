"""Training of the linear SVM of patches, with mirrored, blurred and degraded copies of them."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

import vehicle_detection
from vehicle_detection import _kernels as kernels
from vehicle_detection._common import check, describe, fields, invalid
from vehicle_detection.datasets import PatchSet, check_labels
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import FeatureParams, extract_features, read_patches
from vehicle_detection.svm import Template, VehicleClassifier, flatten_steps, fold_estimators

DEFAULT_C = 1e-4

# Ranges of degraded patches: log of the downscaling factor, log of the saturation factor, JPEG quality.
_LOG_SHRINK, _LOG_SATURATION, _JPEG_QUALITY = (0.0, 1.6), (-1.5, 0.2), (20.0, 90.0)


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(fields.Checked):
    """Options of the training of a patch classifier.

    >>> TrainingOptions(C=0.01, degraded=0.05).copy_weights
    (1.0, 1.0, 0.05, 0.05)
    """

    #: Inverse regularization strength. Small values generalize better to other sequences.
    C: float = fields.number(DEFAULT_C, above=0, high=1e12)
    #: Add the mirror image of each patch, with brightness exponents from ``exp(-gamma)`` to ``exp(gamma)``.
    mirror: bool = fields.flag(True)
    gamma: float = fields.number(0.0, low=0, high=2)
    #: Weight, in [0, 1], of two more copies of each patch, one blurred, the other also desaturated and
    #: compressed, which help on images of other cameras. 0 omits them.
    degraded: float = fields.number(0.0, low=0, high=1)
    #: Cost of a misclassified vehicle, in those of a misclassified non-vehicle.
    positive_weight: float = fields.number(1.0, above=0, high=1e6)
    random_state: int = fields.integer(0, low=0, high=2**32 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("C", "gamma", "degraded", "positive_weight"):  # the same file for 1 and 1.0
            object.__setattr__(self, name, float(getattr(self, name)))
        if self.gamma and not self.mirror:
            raise InvalidInputError(
                f"gamma must be 0 without mirrored patches, whose brightness it changes; got {self.gamma:g}"
            )

    @property
    def copy_weights(self) -> tuple[float, ...]:
        """Training weight of each copy of the patches, in the order of `patch_features`."""
        return (1.0, *(1.0,) * self.mirror, *(self.degraded, self.degraded) * (self.degraded > 0))

    def to_dict(self) -> dict[str, Any]:
        """Return the options as JSON values, as a model file keeps them."""
        values = asdict(self)
        if self.positive_weight == 1:
            del values["positive_weight"]
        return {"C": values.pop("C"), "solver": "dual", **values}


def train_classifier(
    patches: Any,
    labels: ArrayLike | None = None,
    *,
    params: FeatureParams | None = None,
    options: TrainingOptions | None = None,
    estimator: Any = None,
    jobs: int | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> VehicleClassifier:
    """Train a linear SVM behind a feature scaler on patches, or another linear classifier of scikit-learn.

    The SVM is that of ``LinearSVC(C, dual=True)``, with scores within 1e-4 unless a warning says that it has
    not converged, by a solver that needs no copy of the features: on 17,760 patches with 8,460 features a
    fifth of the time (5 of 24 s) and 4 GB less memory.
    The model has one template; the same input and seed give the same model.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB training patches, or a list of patches or of image files. Without
        `labels`: a `PatchSet`, or a pair ``(cars, notcars)`` of such arrays or lists.
    labels
        ``(N,)``, 1 (or True) for a vehicle, 0 otherwise.
    params, options
        Features and training, by default ``FeatureParams()`` and ``TrainingOptions()``.
    estimator
        An unfitted scikit-learn classifier with linear scores, such as ``LogisticRegression(C=0.01)``, that
        replaces the SVM and its `C`.
    jobs, metadata
        Threads of the feature extraction; and JSON values to keep in the model file, besides the options.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> train_classifier(patches, labels, params=FeatureParams(hog_channel=0)).score(patches, labels)
    1.0
    """
    params, options = check_training(params, options)
    if metadata is not None:
        check.instance(metadata, "metadata", Mapping, "pass a dictionary")
    images, targets = _read_training_set(patches, labels)
    features = patch_features(images, params, options, jobs=jobs)
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
    return images, check_labels(labels, count=len(images), both=True).astype(np.int64)


def patch_features(
    images: NDArray[np.uint8], params: FeatureParams, options: TrainingOptions, *, jobs: int | None = None
) -> NDArray[np.float32]:
    """Features of all patches, followed by those of their mirrored, blurred and degraded copies."""
    features = np.empty((len(options.copy_weights), len(images), params.length), np.float32)
    for rows, variant in zip(features, _augmented_copies(images, options)):
        rows[:] = extract_features(variant, params, jobs=jobs)
    return features.reshape(-1, params.length)


def _augmented_copies(images: NDArray[np.uint8], options: TrainingOptions) -> Iterator[NDArray[np.uint8]]:
    """Yield the patches and their copies one after the other, to save memory."""
    yield images
    if options.mirror:
        yield mirror_patches(images, gamma=options.gamma)
    if options.degraded:
        yield blur_patches(images, mirror=options.mirror)
        yield degrade_patches(images, mirror=options.mirror)


def mirror_patches(images: NDArray[np.uint8], *, gamma: float = 0.0) -> NDArray[np.uint8]:
    """Mirror ``(N, H, W, 3)`` patches left to right and change their brightness, in a new array.

    A value `v` becomes ``255 * (v / 255)**e``, with ``log(e)`` uniform in ``[-gamma, gamma]``. The CRC-32 of
    a patch's pixels determines its `e`, which therefore does not depend on the other patches or their order.
    """
    mirrored = np.ascontiguousarray(images[:, :, ::-1])
    if gamma:
        values = np.arange(256) / 255
        for image in mirrored:
            uniform = zlib.crc32(image) / (2**32 - 1)
            exponent = np.exp(gamma * (2 * uniform - 1))
            image[:] = np.round(255 * values**exponent).astype(np.uint8)[image]
    return mirrored


def blur_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Downscale ``(N, H, W, 3)`` patches by up to 5 and enlarge them again, in a new array.

    A patch's own pixels seed its random numbers. `mirror` flips half of the patches left to right.
    """
    blurred = np.empty_like(images)
    for image, out in zip(images, blurred):
        out[:] = _rescale(image, _seeded_generator(image, 1), mirror)
    return blurred


def degrade_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Blur ``(N, H, W, 3)`` RGB patches, reduce their saturation and compress them as JPEG, in a new array.

    A patch's own pixels seed its random numbers. `mirror` flips half of the patches left to right.
    """
    degraded = np.empty_like(images)
    for image, out in zip(images, degraded):
        rng = _seeded_generator(image, 2)
        blurred = _rescale(image, rng, mirror)
        saturation = float(np.exp(rng.uniform(*_LOG_SATURATION)))
        gray = cv2.cvtColor(cv2.cvtColor(blurred, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        pale = cv2.addWeighted(blurred, saturation, gray, 1 - saturation, 0)
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(*_JPEG_QUALITY))]
        _, encoded = cv2.imencode(".jpg", cv2.cvtColor(pale, cv2.COLOR_RGB2BGR), quality)
        decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)
        out[:] = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
    return degraded


def _seeded_generator(image: NDArray[np.uint8], kind: int) -> np.random.Generator:
    return np.random.default_rng((kind, zlib.crc32(image.tobytes())))


def _rescale(image: NDArray[np.uint8], rng: np.random.Generator, mirror: bool) -> NDArray[np.uint8]:
    """Downscale by a random factor and enlarge to the same size; mirror with probability 1/2 if asked to."""
    factor, uniform = float(np.exp(rng.uniform(*_LOG_SHRINK))), rng.random()
    if mirror and uniform < 0.5:
        image = image[:, ::-1]
    height, width = image.shape[:2]
    small = max(round(width / factor), 1), max(round(height / factor), 1)
    downscaled = cv2.resize(np.ascontiguousarray(image), small, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(downscaled, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


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
    if estimator is None:
        costs = options.C * all_weights
        fitted = kernels.fit_svm(
            features, all_labels, costs, rows=all_rows, gains=params.gains, random_state=seed
        )
        template, learner = Template(*fitted), "numba"
    else:
        training |= {"estimator": " ".join(repr(estimator).split()), "C": None, "solver": None}
        rows_labels, rows_weights = all_labels[all_rows], all_weights[all_rows]
        template = _fit_estimator(estimator, features[all_rows], rows_labels, rows_weights, params.gains)
        learner = "scikit-learn"
    vehicles = int(labels[chosen].sum())
    training |= {"vehicles": vehicles, "non_vehicles": len(chosen) - vehicles}
    libraries = {name: version(name) for name in (learner, "numpy", "opencv-python-headless")}
    versions = {"vehicle_detection": vehicle_detection.__version__, **libraries}
    all_metadata = {"training": training, "versions": versions, **(metadata or {})}
    return VehicleClassifier(params, (template,), all_metadata)


def check_training(
    params: FeatureParams | None, options: TrainingOptions | None
) -> tuple[FeatureParams, TrainingOptions]:
    """Return both, with the defaults for None."""
    params = FeatureParams() if params is None else params
    options = TrainingOptions() if options is None else options
    check.instance(params, "params", FeatureParams, "omit it for the default")
    check.instance(options, "options", TrainingOptions, "omit it for the default")
    return params, options


def _fit_estimator(
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
        raise invalid("estimator", "be a scikit-learn classifier without its scaler", estimator)
    weighted = bool((weights != 1).any())
    if weighted and not has_fit_parameter(estimator, "sample_weight"):
        raise InvalidInputError(
            "estimator must accept sample_weight for degraded copies and positive_weight; "
            f"{type(estimator).__name__} does not"
        )
    scaler = StandardScaler(copy=False).fit(features)
    scaled = scaler.transform(features)
    scaled *= gains.astype(np.float32)
    fitted = clone(estimator).fit(scaled, labels, **({"sample_weight": weights} if weighted else {}))
    try:
        template = fold_estimators([scaler, *flatten_steps(fitted)], len(gains))
    except InvalidInputError as error:
        raise InvalidInputError(
            f"estimator must be a linear classifier, such as LinearSVC; got {describe(estimator)}. "
            "PatchFeatures in a pipeline of scikit-learn trains any classifier, and vehicle_detection.course "
            "searches with it"
        ) from error
    return Template(template.mean, template.scale / gains, template.coef, template.intercept)
