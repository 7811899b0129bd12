import numpy as np
import pytest

from vehicle_detection.features import FeatureParams, part_slices, sum_blocks


def test_parts_lie_one_after_another():
    params = FeatureParams(spatial_size=(32, 32), hist_bins=32, orient=9, hog_channel="ALL")
    assert part_slices(params) == {
        "spatial bins": slice(0, 3072),
        "color histogram": slice(3072, 3168),
        "HOG": slice(3168, 8460),
    }


def test_coarse_hog_is_a_part_of_its_own():
    params = FeatureParams(spatial_feat=False, hist_feat=False, hog_channel=0, coarse_hog=True)
    assert part_slices(params) == {
        "HOG": slice(0, params.length - params.coarse_length),
        "coarse HOG": slice(params.length - params.coarse_length, params.length),
    }
    assert params.coarse_length > 0


@pytest.mark.parametrize("side", [1, 2, 3])
def test_blocks_are_summed_over_the_cells_that_they_share(side):
    blocks = np.random.default_rng(0).normal(size=(4, 5, side, side, 9))
    sums = sum_blocks(blocks)
    expected = np.zeros((4 + side - 1, 5 + side - 1, 9))
    for (down, across, row, column), values in np.ndenumerate(blocks[..., 0]):
        expected[down + row, across + column, 0] += values
    assert sums.shape == expected.shape
    np.testing.assert_allclose(sums[..., 0], expected[..., 0])
    counts = sum_blocks(np.ones_like(blocks))
    assert (counts[0, 0, 0], counts.max()) == (1, side**2)
