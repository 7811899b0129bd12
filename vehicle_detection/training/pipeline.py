"""Pipelines of scikit-learn: `PatchFeatures`, and a model as a pipeline."""

from __future__ import annotations

from dataclasses import asdict, fields, make_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.svm import VehicleClassifier

# The fields of `FeatureParams`, not frozen, because scikit-learn sets the parameters of estimators.
_FIELDS = [(each.name, each.type, each.default) for each in fields(FeatureParams)]
_Params: Any = make_dataclass("_Params", [*_FIELDS, ("jobs", "int | None", None)], eq=False, kw_only=True)


class PatchFeatures(TransformerMixin, BaseEstimator, _Params):  # type: ignore[misc]
    """Turn 64x64 patches into feature vectors, for ``Pipeline`` and ``GridSearchCV``.

    The parameters are the fields of `FeatureParams`, checked by `fit`, and `jobs` of `extract_features`.
    The transformer has no state and works without `fit`. It ignores the gains, which only `train_classifier`
    uses. It passes scikit-learn's estimator checks that do not need tables of numbers as input.

    >>> from sklearn.pipeline import make_pipeline
    >>> from sklearn.preprocessing import StandardScaler
    >>> pipeline = make_pipeline(PatchFeatures(color_space="LUV", spatial_feat=False), StandardScaler())
    >>> pipeline.fit_transform(np.zeros((2, 64, 64, 3), np.uint8)).shape
    (2, 5388)
    """

    def to_params(self) -> FeatureParams:
        """Return the parameters as checked `FeatureParams`."""
        arguments = self.get_params(deep=False)
        del arguments["jobs"]
        return FeatureParams(**arguments)

    def fit(self, X: Any, y: Any = None) -> PatchFeatures:
        """Check the parameters; `X` and `y`, patches and labels, are ignored."""
        self.to_params()
        return self

    def transform(self, X: Any) -> NDArray[np.float32]:
        """Extract feature vectors, ``(N, length)`` float32; `X` as in `extract_features`."""
        return extract_features(X, self.to_params(), jobs=self.jobs)

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[np.object_]:
        """Names of the features: ``spatial0 ... hist0 ... hog0 ...``."""
        params = self.to_params()
        lengths = {"spatial": params.spatial_length, "hist": params.hist_length, "hog": params.hog_length}
        return np.array([f"{part}{i}" for part, count in lengths.items() for i in range(count)], object)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.input_tags.three_d_array = False
        tags.no_validation = True
        tags.requires_fit = False
        tags.transformer_tags.preserves_dtype = []
        return tags


def to_pipeline(classifier: VehicleClassifier) -> Pipeline:
    """Convert a model with one template to a fitted pipeline: `PatchFeatures`, `StandardScaler`, `LinearSVC`.

    >>> from vehicle_detection import load_classifier
    >>> list(to_pipeline(load_classifier()).named_steps)
    ['features', 'scaler', 'svm']
    """
    if len(classifier.templates) > 1:
        raise InvalidInputError(
            f"only a model with one template converts; this has {len(classifier.templates)}"
        )
    template = classifier.templates[0]
    scaler, svm = StandardScaler(), LinearSVC()
    scaler.mean_, scaler.scale_ = template.mean.copy(), template.scale.copy()
    scaler.var_, scaler.n_samples_seen_ = template.scale**2, 1
    svm.coef_, svm.intercept_ = template.coef[None].copy(), np.array([template.intercept])
    svm.classes_ = np.array([0, 1])
    scaler.n_features_in_ = svm.n_features_in_ = classifier.params.length
    features = PatchFeatures(**asdict(classifier.params))
    return Pipeline([("features", features), ("scaler", scaler), ("svm", svm)])
