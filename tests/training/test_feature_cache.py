import numpy as np

from tests.training.trial_cases import SMALL
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.training import FeatureCache, feature_cache

PARAMS = FeatureParams(**SMALL)


def test_cached_features_equal_extracted_features(patch_set, tmp_path, monkeypatch):
    plain = extract_features(patch_set.patches, PARAMS)
    mirrored = extract_features(np.ascontiguousarray(patch_set.patches[:, :, ::-1]), PARAMS)
    both = np.concatenate([plain, mirrored])
    cache = FeatureCache(patch_set.patches, folder=tmp_path)
    np.testing.assert_array_equal(cache.features(PARAMS), plain)
    np.testing.assert_array_equal(cache.features(PARAMS, mirror=True), both)
    monkeypatch.setattr(feature_cache, "patch_features", None)
    assert cache.features(PARAMS, mirror=True) is cache.features(PARAMS, mirror=True)
    other = FeatureCache(patch_set.patches, folder=tmp_path)
    np.testing.assert_array_equal(other.features(PARAMS), plain)
    np.testing.assert_array_equal(other.features(PARAMS, mirror=True), both)
