import dataclasses
import pickle

import numpy as np
import pytest
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from tests.feature_cases import PATCHES
from tests.helpers import rendered_patches
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.training import PatchFeatures


def test_the_transformer_equals_extract_features():
    transformer = PatchFeatures(color_space="LUV", orient=6, jobs=1)
    params = FeatureParams(color_space="LUV", orient=6)
    assert transformer.to_params() == params
    expected = extract_features(PATCHES, params)
    np.testing.assert_array_equal(transformer.transform(PATCHES), expected)
    np.testing.assert_array_equal(transformer.fit_transform(list(PATCHES)), expected)
    assert transformer.fit(PATCHES) is transformer


def test_the_transformer_has_the_fields_and_defaults_of_feature_params():
    arguments = PatchFeatures().get_params()
    assert arguments.pop("jobs") is None
    assert arguments == dataclasses.asdict(FeatureParams())


def test_the_transformer_names_its_features():
    transformer = PatchFeatures(spatial_size=2, hist_bins=2, orient=4, pix_per_cell=32, hog_channel=0)
    names = transformer.get_feature_names_out()
    assert len(names) == transformer.to_params().length
    assert names[0] == "spatial0"
    assert names[12] == "hist0"
    assert names[-1] == "hog15"


class OfTables(PatchFeatures):
    """`PatchFeatures` that claims to accept tables of numbers, so that scikit-learn runs all its checks."""

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array, tags.no_validation = True, False
        return tags


# Checks of scikit-learn that do not apply: they pass tables of numbers to `transform`, which needs images
# (the tests below check the same with images), or expect `fit` to check its input, which it does not use.
DO_NOT_APPLY = """
fit_score_takes_y estimators_dtypes dtype_object pipeline_consistency estimators_pickle
f_contiguous_array_estimator transformer_data_not_an_array transformer_general
transformers_unfitted_stateless methods_sample_order_invariance methods_subset_invariance dict_unchanged
fit_idempotent fit2d_predict1d n_features_in_after_fitting n_features_in complex_data
estimators_empty_data_messages estimators_nan_inf estimator_sparse_tag fit1d array_api_input
"""


def test_the_transformer_passes_the_estimator_checks_that_apply():
    passed = set()
    pytest.importorskip("sklearn", minversion="1.6")
    from sklearn.utils.estimator_checks import estimator_checks_generator

    for estimator, check in estimator_checks_generator(OfTables(), legacy=True):
        name = check.func.__name__
        if name.removeprefix("check_") not in DO_NOT_APPLY.split():
            check(estimator)
            passed.add(name)
    assert {"check_parameters_default_constructible", "check_set_params", "check_fit2d_1sample"} <= passed
    assert len(passed) >= 20


def test_the_transformer_leaves_its_input_alone_and_can_be_pickled():
    before = PATCHES.copy()
    frozen = np.asfortranarray(PATCHES)
    frozen.setflags(write=False)
    transformer = PatchFeatures(jobs=1)
    expected = transformer.transform(PATCHES)
    np.testing.assert_array_equal(transformer.transform(frozen), expected)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(transformer)).transform(frozen), expected)
    np.testing.assert_array_equal(PATCHES, before)
    assert vars(transformer) == vars(PatchFeatures(jobs=1))


def test_the_transformer_in_cross_validation():
    patches, labels = rendered_patches(40)
    features = PatchFeatures(spatial_size=8, orient=6, hog_channel=0, jobs=1)
    pipeline = make_pipeline(features, StandardScaler(), LinearSVC(C=1e-3, random_state=0))
    assert cross_val_score(pipeline, patches, labels, cv=4, error_score="raise").mean() >= 0.9
    named = make_pipeline(features).set_output(transform="pandas").fit_transform(patches[:2])
    assert list(named.columns[:2]) == ["spatial0", "spatial1"]
