"""`PatchFeatures`: the features as a scikit-learn transformer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin

from vehicle_detection.features import FeatureParams, extract_features


@dataclass(eq=False, repr=False, kw_only=True)
class PatchFeatures(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Turn 64x64 patches into feature vectors, for ``Pipeline`` and ``GridSearchCV``.

    The parameters are the fields of `FeatureParams`, checked by `fit`, and `n_jobs` of `extract_features`.
    The transformer has no state and works without `fit`. It ignores the gains, which only `train_classifier`
    uses. It passes scikit-learn's estimator checks that do not need tables of numbers as input; images have
    four dimensions, and ``n_features_in_`` is not set.

    Examples
    --------
    >>> from sklearn.pipeline import make_pipeline
    >>> from sklearn.preprocessing import StandardScaler
    >>> pipeline = make_pipeline(PatchFeatures(color_space="LUV", spatial_feat=False), StandardScaler())
    >>> pipeline.fit_transform(np.zeros((2, 64, 64, 3), np.uint8)).shape
    (2, 5388)
    """

    color_space: str = "YCrCb"
    spatial_color_space: str | None = None
    hist_color_space: str | None = None
    spatial_feat: bool = True
    hist_feat: bool = True
    hog_feat: bool = True
    spatial_size: int = 16
    spatial_order: Literal["channels", "interleaved"] = "channels"
    hist_bins: int = 32
    orient: int = 9
    pix_per_cell: int = 8
    cell_per_block: int = 2
    hog_channel: int | Literal["ALL", "GRAY"] = "ALL"
    transform_sqrt: bool = False
    hist_sqrt: bool = False
    coarse_hog: bool = False
    hist_gain: float = 1.0
    coarse_gain: float = 1.0
    n_jobs: int | None = None

    def to_params(self) -> FeatureParams:
        """Return the parameters as checked `FeatureParams`."""
        arguments = self.get_params(deep=False)
        del arguments["n_jobs"]
        return FeatureParams(**arguments)

    def fit(self, X: Any, y: Any = None) -> PatchFeatures:
        """Check the parameters.

        Parameters
        ----------
        X, y
            Patches and labels, which are ignored.

        Returns
        -------
        PatchFeatures
            This transformer.

        Raises
        ------
        InvalidInputError
            If a parameter is invalid.
        """
        self.to_params()
        return self

    def transform(self, X: Any) -> NDArray[np.float32]:
        """Extract feature vectors, ``(N, length)`` float32; `X` as in `extract_features`."""
        return extract_features(X, self.to_params(), n_jobs=self.n_jobs)

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
