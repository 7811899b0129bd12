import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.datasets.cases import make_set, patch_image
from vehicle_detection.datasets import PatchSet, Split, find_near_duplicates, split_leakage
from vehicle_detection.errors import InvalidInputError


def test_brightness_contrast_and_noise_are_ignored():
    patches = np.stack([patch_image(seed) for seed in range(6)])
    rng = np.random.default_rng(0)
    patches[4] = patches[0] // 2 + 60
    patches[5] = np.clip(patches[1] + rng.normal(0, 5, patches[1].shape), 0, 255).astype(np.uint8)
    before = patches.copy()
    assert find_near_duplicates(patches).tolist() == [[0, 4], [1, 5], [4, 0], [5, 1]]
    np.testing.assert_array_equal(patches, before)


def test_the_nearest_duplicate_is_found_across_chunks():
    patches = np.random.default_rng(0).integers(0, 256, (1100, 16, 16, 3), np.uint8)
    patches[1099] = patches[3]
    patch_set = PatchSet(patches, [1] * 1100, [f"{row}.png" for row in range(1100)])
    assert find_near_duplicates(patch_set).tolist() == [[3, 1099], [1099, 3]]


@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.floats(0.05, 1))
def test_pairs_agree_with_the_correlation_of_thumbnails(seed, count, threshold):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (count, 2, 2, 1), np.uint8)
    patches = np.repeat(np.kron(coarse, np.ones((1, 8, 8, 1), np.uint8)), 3, axis=3)
    labels, names = [1] * count, [f"{row}.png" for row in range(count)]
    # Each pixel of a 16x16 gray patch is its own thumbnail.
    expected = np.corrcoef(patches[..., 0].reshape(count, -1)) - 2 * np.eye(count)
    pairs = find_near_duplicates(PatchSet(patches, labels, names), threshold=threshold)
    for row in range(count):
        best = expected[row].max()
        if abs(best - threshold) > 1e-4:
            assert (row in pairs[:, 0]) == (best > threshold)
    np.testing.assert_allclose(
        expected[pairs[:, 0], pairs[:, 1]], expected[pairs[:, 0]].max(axis=1), atol=1e-4
    )


def test_uniform_patches_have_no_duplicates():
    plain = np.full((3, 64, 64, 3), 90, np.uint8)
    assert find_near_duplicates(plain).shape == (0, 2)
    assert find_near_duplicates(plain[:1]).shape == (0, 2)
    assert find_near_duplicates(plain[:0]).shape == (0, 2)


def test_invalid_arguments():
    patches = make_set(["a", "b"])
    with pytest.raises(
        InvalidInputError, match=r"threshold must be a number, greater than 0 .*at most 1; got 2"
    ):
        find_near_duplicates(patches, threshold=2)
    with pytest.raises(InvalidInputError, match=r"split holds row 5, but patch_set has 2 patches"):
        split_leakage(patches, Split([0], [5]))
    with pytest.raises(InvalidInputError, match=r"patches must be an \(N, 64, 64, 3\) uint8"):
        find_near_duplicates(np.zeros((2, 3)))
