import dataclasses

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import check_estimator

from tests.features.cases import PATCHES
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PatchFeatures, extract_features
from vehicle_detection.params import FeatureParams


def test_the_transformer_equals_extract_features():
    transformer = PatchFeatures(color_space="LUV", orient=6, n_jobs=1)
    params = FeatureParams(color_space="LUV", orient=6)
    assert transformer.to_params() == params
    expected = extract_features(PATCHES, params)
    np.testing.assert_array_equal(transformer.transform(PATCHES), expected)
    np.testing.assert_array_equal(transformer.fit_transform(list(PATCHES)), expected)
    assert transformer.fit(PATCHES) is transformer


def test_the_transformer_has_the_fields_and_defaults_of_feature_params():
    arguments = PatchFeatures().get_params()
    assert arguments.pop("n_jobs") is None
    assert arguments == dataclasses.asdict(FeatureParams())


def test_the_transformer_can_be_cloned_and_set():
    transformer = PatchFeatures(orient=6)
    copy = clone(transformer)
    assert copy is not transformer
    assert copy.get_params() == transformer.get_params()
    assert copy.set_params(orient=7).to_params().orient == 7


def test_fit_checks_the_parameters():
    transformer = PatchFeatures(color_space="BGR")
    with pytest.raises(InvalidInputError, match="color_space must be one of"):
        transformer.fit(PATCHES)
    with pytest.raises(InvalidInputError, match="source must be an"):
        PatchFeatures().fit_transform(PATCHES / 255)


def test_the_transformer_names_its_features():
    transformer = PatchFeatures(spatial_size=2, hist_bins=2, orient=4, pix_per_cell=32, hog_channel=0)
    names = transformer.get_feature_names_out()
    assert len(names) == transformer.to_params().length
    assert names[0] == "spatial0"
    assert names[12] == "hist0"
    assert names[-1] == "hog15"


@pytest.mark.filterwarnings("ignore:Can't test estimator:sklearn.exceptions.SkipTestWarning")
def test_the_transformer_is_an_estimator():
    # Most checks of scikit-learn need 2-D input; run those that do not.
    check_estimator(PatchFeatures())
    for check in (
        estimator_checks.check_parameters_default_constructible,
        estimator_checks.check_no_attributes_set_in_init,
        estimator_checks.check_get_params_invariance,
        estimator_checks.check_set_params,
    ):
        check("PatchFeatures", PatchFeatures())


def test_the_transformer_in_a_grid_search():
    patches = np.concatenate([PATCHES[:4]] * 2 + [PATCHES[5:9]] * 2)
    labels = np.repeat([1, 0], 8)
    pipeline = make_pipeline(
        PatchFeatures(spatial_size=8, hist_bins=8, n_jobs=1),
        StandardScaler(),
        LinearSVC(C=1e-3, random_state=0),
    )
    grid = {"patchfeatures__orient": [4, 6], "patchfeatures__hog_channel": [0, "GRAY"]}
    search = GridSearchCV(pipeline, grid, cv=2, error_score="raise").fit(patches, labels)
    assert len(search.cv_results_["params"]) == 4
    assert search.predict(patches).shape == (16,)
    assert search.best_estimator_.score(patches, labels) > 0.9
