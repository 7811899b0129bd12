"""The linear classifier of patches: a scaler and one or more weight templates, and how it scores."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_patches, describe, write_model
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import extract_features
from vehicle_detection.params import PATCH_SIZE, FeatureParams

if TYPE_CHECKING:
    from sklearn.pipeline import Pipeline

KIND = "patches"
"""Kind of the model files that hold a classifier of patches."""

_CHUNK = 1024

_TENSORS = ("mean", "scale", "coef", "intercept")


@dataclass(frozen=True, eq=False)
class Template:
    """One linear SVM over a window of 8x8 cells and the scaler it was trained behind.

    Attributes
    ----------
    mean, scale
        ``(length,)`` float64: the scaler subtracts and divides by them.
    coef
        ``(length,)`` float64 weights of the scaled features.
    intercept
        Added to the weighted sum.
    """

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    coef: NDArray[np.float64]
    intercept: float

    def __post_init__(self) -> None:
        for name in ("mean", "scale", "coef"):
            column = np.array(getattr(self, name), np.float64)
            if column.ndim != 1 or column.shape != np.shape(self.mean):
                raise InvalidInputError(
                    f"{name} must be a vector as long as the features ({np.shape(self.mean)}); "
                    f"got {describe(column)}"
                )
            if not np.isfinite(column).all():
                raise InvalidInputError(f"{name} must be finite, got NaN or infinity; train again")
            column.setflags(write=False)
            object.__setattr__(self, name, column)
        if not (self.scale > 0).all():
            raise InvalidInputError("scale must be positive; a constant feature has scale 1")
        if not np.isfinite(self.intercept):
            raise InvalidInputError(f"intercept must be finite; got {self.intercept}")

    def fold(self) -> tuple[NDArray[np.float64], float]:
        """Scaler and SVM as one affine function ``score = weights . features + bias``."""
        weights = self.coef / self.scale
        return weights, float(self.intercept - weights @ self.mean)


@dataclass(frozen=True, eq=False)
class VehicleClassifier:
    """A linear classifier of 64x64 patches, or of feature vectors.

    Attributes
    ----------
    params
        The features it is trained on.
    templates
        One or more `Template`; a patch's score is the best of them.
    metadata
        What the model file tells about itself: training, accuracy, data, versions. JSON values only.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> classifier = load_classifier()
    >>> classifier.predict(np.zeros((2, 64, 64, 3), np.uint8)).tolist()
    [0, 0]
    """

    params: FeatureParams
    templates: tuple[Template, ...]
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.templates:
            raise InvalidInputError("templates must hold at least one template; got none")
        for template in self.templates:
            if template.coef.shape != (self.params.length,):
                raise InvalidInputError(
                    f"templates must have {self.params.length} weights, as the parameters say; "
                    f"got {len(template.coef)}"
                )

    def decision_function(self, X: ArrayLike) -> NDArray[np.float64]:
        """Signed distance from the separating plane; positive is a vehicle.

        Parameters
        ----------
        X
            ``(N, length)`` feature vectors, or ``(N, 64, 64, 3)`` uint8 RGB patches.

        Returns
        -------
        numpy.ndarray
            ``(N,)`` float64.

        Raises
        ------
        InvalidInputError
            If the vectors are of another length or hold NaN.
        """
        features = self._features_of(X)
        folded = [template.fold() for template in self.templates]
        scores = np.empty((len(folded), len(features)))
        for start in range(0, len(features), _CHUNK):
            # Float64 copies of a chunk, not of features that may fill half the memory.
            rows = features[start : start + _CHUNK].astype(np.float64)
            for row, (weights, bias) in zip(scores, folded):
                row[start : start + _CHUNK] = rows @ weights + bias
        return np.asarray(scores.max(axis=0), np.float64)

    def predict(self, X: ArrayLike) -> NDArray[np.int64]:
        """1 for a vehicle and 0 for anything else, ``(N,)`` int64; arguments as `decision_function`."""
        return (self.decision_function(X) > 0).astype(np.int64)

    def score(self, X: ArrayLike, y: ArrayLike) -> float:
        """Share of right predictions for the labels `y`, 0-1."""
        labels = np.asarray(y)
        predicted = self.predict(X)
        if labels.shape != predicted.shape or not labels.size:
            raise InvalidInputError(
                f"y must be one label for each of {len(predicted)} rows, at least one; got {describe(labels)}"
            )
        return float(np.mean(predicted == labels))

    def _features_of(self, X: ArrayLike) -> NDArray[Any]:
        array = np.asarray(X)
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
        cls, pipeline: Pipeline, params: FeatureParams, *, metadata: Mapping[str, Any] | None = None
    ) -> VehicleClassifier:
        """Take over a fitted scikit-learn pipeline that ends in ``StandardScaler`` and ``LinearSVC``.

        Parameters
        ----------
        pipeline
            Fitted; a `PatchFeatures` step before the scaler is allowed.
        params
            The features that the scaler was fitted on.
        metadata
            Facts to keep in the model file.

        Raises
        ------
        InvalidInputError
            If the last two steps are others, not fitted, or of another length.
        """
        steps = [step for _, step in pipeline.steps]
        names = [type(step).__name__ for step in steps]
        if names[-2:] != ["StandardScaler", "LinearSVC"]:
            raise InvalidInputError(f"pipeline must end in StandardScaler and LinearSVC; got {names}")
        scaler, svm = steps[-2:]
        if not hasattr(scaler, "scale_") or not hasattr(svm, "coef_"):
            raise InvalidInputError("pipeline must be fitted; call its fit first")
        if list(svm.classes_) not in ([0, 1], [False, True]):
            raise InvalidInputError(
                f"pipeline must be fitted on the labels 0 and 1; got {list(svm.classes_)}"
            )
        length = svm.coef_.shape[1]
        mean = scaler.mean_ if scaler.with_mean else np.zeros(length)
        scale = scaler.scale_ if scaler.with_std else np.ones(length)
        template = Template(mean, scale, svm.coef_[0], float(np.ravel(svm.intercept_)[0]))
        return cls(params, (template,), metadata or {})

    def to_pipeline(self) -> Pipeline:
        """Return a fitted scikit-learn pipeline: `PatchFeatures`, ``StandardScaler``, ``LinearSVC``.

        Raises
        ------
        InvalidInputError
            If the model has several templates: a pipeline holds one.
        """
        from sklearn.pipeline import Pipeline
        from sklearn.preprocessing import StandardScaler
        from sklearn.svm import LinearSVC

        from vehicle_detection.features import PatchFeatures

        if len(self.templates) > 1:
            raise InvalidInputError(f"a pipeline holds one template; this model has {len(self.templates)}")
        template = self.templates[0]
        scaler = StandardScaler()
        scaler.mean_, scaler.scale_ = template.mean.copy(), template.scale.copy()
        scaler.var_ = template.scale**2
        scaler.n_features_in_ = self.params.length
        scaler.n_samples_seen_ = 1
        svm = LinearSVC()
        svm.coef_, svm.intercept_ = template.coef[None].copy(), np.array([template.intercept])
        svm.classes_ = np.array([0, 1])
        svm.n_features_in_ = self.params.length
        features = PatchFeatures(**asdict(self.params))
        return Pipeline([("features", features), ("scaler", scaler), ("svm", svm)])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as a safetensors file: tensors and JSON, nothing that runs when loaded.

        Raises
        ------
        InvalidInputError
            If the folder is missing or read-only, or the metadata holds more than JSON values.
        """
        tensors = {
            f"{index}.{name}": np.atleast_1d(np.asarray(getattr(template, name), np.float64))
            for index, template in enumerate(self.templates)
            for name in _TENSORS
        }
        write_model(path, KIND, asdict(self.params), tensors, self.metadata)
