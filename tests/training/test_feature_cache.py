import numpy as np
import pytest

from tests.training.trial_cases import SMALL
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.training import FeatureCache, feature_cache

PARAMS = FeatureParams(**SMALL)


def test_cached_features_equal_extracted_features(patch_set, monkeypatch):
    features = FeatureCache(patch_set.patches)
    rows = np.array([5, 3, 117])
    expected = extract_features(patch_set.patches, PARAMS)
    np.testing.assert_array_equal(features.rows(PARAMS, rows), expected[rows])
    np.testing.assert_array_equal(features.all(PARAMS), expected)
    mirrored = extract_features(np.ascontiguousarray(patch_set.patches[:, :, ::-1]), PARAMS)
    np.testing.assert_array_equal(features.all(PARAMS, mirrored=True), mirrored)
    monkeypatch.setattr(feature_cache, "extract_features", None)
    features.rows(PARAMS, rows)[:] = -1  # A copy.
    np.testing.assert_array_equal(features.all(PARAMS), expected)
    with pytest.raises(ValueError, match="read-only"):
        features.all(PARAMS)[0] = 0


def test_the_least_recently_used_features_are_dropped(patch_set):
    one, two = PARAMS, FeatureParams(**{**SMALL, "orient": 5})
    size = 120 * one.length * 4 / 1e6
    features = FeatureCache(patch_set.patches, memory_mb=size * 2.5)
    for params, mirrored in ((one, False), (two, False), (one, False), (one, True)):
        features.all(params, mirrored=mirrored)
    assert list(features._in_memory) == [(one, False), (one, True)]
    assert len(FeatureCache(patch_set.patches, memory_mb=0).all(one)) == 120
