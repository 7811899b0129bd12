import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.feature_cases import BLANK, PATCHES
from tests.helpers import rendered_patches
from vehicle_detection import (
    FeatureParams,
    InvalidInputError,
    convert_color,
    extract_features,
    single_img_features,
    write_image,
)
from vehicle_detection._kernels import features as kernels
from vehicle_detection._kernels.features import degree_bounds
from vehicle_detection.features import COLOR_SPACES, HOG_CHANNELS, SPATIAL_ORDERS, hog_blocks

PRESETS = sorted(FeatureParams.PRESETS)
# The kernels work in float32, the reference in float64; HOG values lie in 0-1.
TOLERANCE = 1e-5


def assert_equals_the_reference(patches, params):
    fast = extract_features(patches, params)
    reference = np.stack([single_img_features(patch, params) for patch in patches])
    assert fast.dtype == np.float32
    assert fast.shape == reference.shape == (len(patches), params.length)
    counted = params.spatial_length + params.hist_length
    np.testing.assert_array_equal(fast[:, :counted], reference[:, :counted].astype(np.float32))
    np.testing.assert_allclose(fast[:, counted:], reference[:, counted:], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_presets_equal_the_reference(preset):
    assert_equals_the_reference(np.vstack([PATCHES, rendered_patches(12)[0]]), FeatureParams.preset(preset))


@pytest.mark.parametrize(
    "changes",
    [
        *({"color_space": space} for space in COLOR_SPACES),
        *({"orient": orient} for orient in (1, 2, 4, 12)),
        {"orient": 180, "cell_per_block": 1, "hog_channel": 0}, {"pix_per_cell": 16},
        {"pix_per_cell": 7, "cell_per_block": 3}, {"pix_per_cell": 64, "cell_per_block": 1},
        {"pix_per_cell": 2, "cell_per_block": 1, "hog_channel": 1},
        *({"cell_per_block": block} for block in (1, 8)), {"hog_channel": "GRAY", "color_space": "HSV"},
        {"hog_channel": "GRAY", "transform_sqrt": True}, {"hog_channel": 2, "color_space": "HLS"},
        {"transform_sqrt": True, "orient": 4},
        {"transform_sqrt": True, "orient": 180, "cell_per_block": 1, "hog_channel": 0},
        *({"spatial_size": size} for size in (1, 64)), {"spatial_size": 24, "hist_bins": 7},
        *({"hist_bins": bins} for bins in (1, 256)), {"hog_feat": False},
        {"hog_feat": False, "spatial_feat": False}, {"hist_sqrt": True, "hist_bins": 256, "hog_feat": False},
        {"coarse_hog": True, "hog_channel": "GRAY", "transform_sqrt": True},
        {"coarse_hog": True, "pix_per_cell": 7, "cell_per_block": 3},
        {"coarse_hog": True, "pix_per_cell": 2, "cell_per_block": 1, "hog_channel": 1},
        {"spatial_order": "interleaved", "spatial_size": 24, "spatial_color_space": "HLS"},
        {"spatial_color_space": "RGB", "hist_color_space": "HSV"},
        {"color_space": "LUV", "hist_color_space": "HLS", "hist_sqrt": True, "hog_channel": 0},
    ],
    ids=str,
)  # fmt: skip
def test_other_parameters_equal_the_reference(changes):
    assert_equals_the_reference(PATCHES[::2], dataclasses.replace(FeatureParams(), **changes))


@st.composite
def feature_params(draw):
    parts = draw(st.sampled_from([(True, True), (True, False), (False, True), (False, False)]))
    cell = draw(st.integers(4, 64))
    block = draw(st.integers(1, min(4, 64 // cell)))
    return FeatureParams(
        color_space=draw(st.sampled_from(COLOR_SPACES)),
        spatial_color_space=draw(st.sampled_from((None, *COLOR_SPACES))),
        hist_color_space=draw(st.sampled_from((None, *COLOR_SPACES))),
        spatial_order=draw(st.sampled_from(SPATIAL_ORDERS)), spatial_feat=parts[0], hist_feat=parts[1],
        hog_feat=True, spatial_size=draw(st.integers(1, 64)), hist_bins=draw(st.integers(1, 256)),
        orient=draw(st.integers(1, 20)), pix_per_cell=cell, cell_per_block=block,
        hog_channel=draw(st.sampled_from(HOG_CHANNELS)), transform_sqrt=draw(st.booleans()),
        hist_sqrt=draw(st.booleans()), coarse_hog=64 // cell // 2 >= block and draw(st.booleans()),
    )  # fmt: skip


@given(feature_params(), st.integers(0, len(PATCHES) - 1), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_any_parameters_equal_the_reference(params, row, seed):
    noise = np.random.default_rng(seed).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    assert_equals_the_reference(np.stack([PATCHES[row], noise]), params)


@pytest.mark.realdata
def test_real_patches_equal_the_reference(some_real_patches):
    patches = some_real_patches[0][::10]
    for preset in PRESETS:
        some = patches if preset in ("luv-2384", "ycrcb-6156") else patches[::8]
        assert_equals_the_reference(some, FeatureParams.preset(preset))


def all_gradients():
    """Image ``(3 * 511, 3 * 511)`` in 3x3 tiles whose middles have every pair of uint8 gradients once."""
    differences = np.arange(-255, 256)
    low, high = np.maximum(-differences, 0), np.maximum(differences, 0)
    image = np.zeros((511, 3, 511, 3), np.uint8)
    image[:, 1, :, 0], image[:, 1, :, 2] = low[None, :], high[None, :]
    image[:, 0, :, 1], image[:, 2, :, 1] = low[:, None], high[:, None]
    gy, gx = np.meshgrid(differences, differences, indexing="ij")
    return image, gx, gy


def reference_bins(gx, gy, orient):
    """Orientation bin of gradients, as scikit-image's histogram loop decides it."""
    degrees = np.rad2deg(np.arctan2(gy.astype(float), gx.astype(float))) % 180
    bounds = degree_bounds(orient)
    bins = np.full(gx.shape, -1)
    for k in range(orient):
        bins[(degrees >= bounds[k]) & (degrees < bounds[k + 1])] = k
    return bins


@pytest.mark.parametrize("orient", [1, 2, 3, 4, 5, 6, 8, 9, 12, 18])
def test_the_kernel_bins_all_uint8_gradients_like_the_reference(orient):
    image, gx, gy = all_gradients()
    expected = reference_bins(gx, gy, orient)
    length = np.hypot(gx, gy)
    for start in range(0, 511, 73):
        tiles = image[start : start + 73].reshape(73 * 3, 511 * 3, 1)
        middles = kernels.hog_cells(tiles, orient, 1, False)[0, :, 1::3, 1::3]
        rows = slice(start, start + 73)
        np.testing.assert_allclose(middles.sum(axis=0), length[rows], rtol=1e-6)
        filled = length[rows] > 0
        np.testing.assert_array_equal(middles.argmax(axis=0)[filled], expected[rows][filled])
        assert ((middles != 0).sum(axis=0) == filled).all()


@pytest.mark.parametrize("preset", ["luv-2384", "ycrcb-6156"])
def test_threads_do_not_change_the_features(preset):
    params = FeatureParams.preset(preset)
    # More than two batches.
    patches = np.random.default_rng(3).integers(0, 256, (600, 64, 64, 3), dtype=np.uint8)
    one = extract_features(patches, params, jobs=1)
    for jobs in (2, 3):
        np.testing.assert_array_equal(extract_features(patches, params, jobs=jobs), one)
    for rows in (slice(590, None), slice(250, 260)):
        np.testing.assert_array_equal(extract_features(patches[rows], params), one[rows])


def test_all_kinds_of_sources_give_the_same_features(tmp_path):
    patches = PATCHES[:5]
    expected = extract_features(patches)
    paths = [tmp_path / f"{index}.png" for index in range(5)]
    for path, patch in zip(paths, patches):
        write_image(path, patch)
    sources = {
        "list": list(patches), "tuple": tuple(patches), "views": [patch[::-1][::-1] for patch in patches],
        "generator": (patch for patch in patches), "paths": paths, "strings": map(str, paths),
        "array of paths": np.array(paths), "array of strings": np.array([str(path) for path in paths]),
        "mixed": [paths[0], *patches[1:]], "strided": np.repeat(patches, 2, axis=0)[::2],
        "reversed": np.ascontiguousarray(patches[:, :, ::-1])[:, :, ::-1],
    }  # fmt: skip
    for name, source in sources.items():
        np.testing.assert_array_equal(extract_features(source), expected, err_msg=name)


def test_extraction_does_not_change_its_input_and_shows_its_progress_if_asked(capsys):
    before = PATCHES.copy()
    features = extract_features(PATCHES)
    single_img_features(PATCHES[0])
    np.testing.assert_array_equal(PATCHES, before)
    assert capsys.readouterr() == ("", "")
    np.testing.assert_array_equal(extract_features(PATCHES, progress=True), features)
    out, err = capsys.readouterr()
    assert out == ""
    assert f"{len(PATCHES)}/{len(PATCHES)}" in err
    for empty in ([], np.empty((0, 64, 64, 3), np.uint8), iter(())):
        assert extract_features(empty).shape == (0, 6156)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (PATCHES[:, :32, :32], r"source must be an \(N, 64, 64, 3\)"),
        ([BLANK[:32]], r"source\[0\] must be 64x64 pixels, got .*32, 64"),
        ([BLANK, BLANK[..., 0]], r"source\[1\] must be .*COLOR_GRAY2RGB"),
        (["missing.png"], "image file missing.png does not exist"),
    ],
)
def test_invalid_sources(source, message):
    with pytest.raises(InvalidInputError, match=message):
        extract_features(source)


@pytest.mark.parametrize("params", ["luv-2384", {"orient": 9}, FeatureParams, 5, False])
def test_invalid_params(params):
    for extract in (lambda: extract_features(PATCHES, params), lambda: single_img_features(BLANK, params)):
        with pytest.raises(InvalidInputError, match=r"params must be a FeatureParams, got .*; pass Feature"):
            extract()


def test_one_edge_fills_one_orientation():
    vertical = np.zeros((64, 64), np.uint8)
    vertical[:, 32:] = 200
    by_orientation = hog_blocks(vertical, 9, 8, 2).sum(axis=(0, 1, 2, 3))
    assert by_orientation.argmax() == 0
    assert np.count_nonzero(by_orientation) == 1
    horizontal = hog_blocks(vertical.T, 9, 8, 2).sum(axis=(0, 1, 2, 3))
    assert horizontal.argmax() == 4


@pytest.mark.parametrize("color_space", COLOR_SPACES)
def test_convert_color(color_space):
    patch = PATCHES[0]
    before = patch.copy()
    converted = convert_color(patch, color_space)
    assert converted.shape == patch.shape
    assert converted.dtype == np.uint8
    assert not np.shares_memory(converted, patch)
    np.testing.assert_array_equal(convert_color(patch, f"RGB2{color_space}"), converted)
    np.testing.assert_array_equal(patch, before)
    # Converting a view gives the view of the converted image.
    np.testing.assert_array_equal(convert_color(patch[8:40, ::-2], color_space), converted[8:40, ::-2])
    red = np.full((1, 1, 3), (255, 0, 0), np.uint8)
    expected = {"HSV": [0, 255, 255], "HLS": [0, 128, 255], "YCrCb": [76, 255, 85], "RGB": [255, 0, 0]}
    found = convert_color(red, color_space)[0, 0].tolist()
    assert expected.get(color_space, found) == found
    for arguments, message in (((patch, "BGR"), "color_space must be"), ((patch / 255,), "image must")):
        with pytest.raises(InvalidInputError, match=message):
            convert_color(*arguments)
