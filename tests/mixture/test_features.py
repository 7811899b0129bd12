import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._common import Workspace
from vehicle_detection._kernels import fhog as _fhog_kernels
from vehicle_detection.mixture import (
    COARSE,
    FINE,
    N_CHANNELS,
    feature_maps,
    image_pyramid,
    mirror_channels,
    pyramid_levels,
)
from vehicle_detection.mixture.features import (
    _COTANGENTS,
    _EPS,
    BORDER,
    MIRROR_ORDER,
    WIDE_BORDER,
    PyramidLevel,
    channels_from_sums,
    fhog_channels,
    orientation_sums,
)
from vehicle_detection.synthetic import render_scene

# The kernel computes differences of cumulative sums in float32, the reference sums in float64.
CLOSE = {"rtol": 1e-4, "atol": 2e-3}


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def road(shape=(180, 320), seed=3):
    return render_scene(shape=shape, vehicles=3, random_state=seed).image


# The reference computes the same channels with numpy in float64.


def orientation_bins(gx, gy):
    """Signed orientation, 0 to 15, of a gradient: the bin around each multiple of 22.5 degrees."""
    return np.floor(np.degrees(np.arctan2(gy, gx)) / 22.5 + 0.5).astype(int) % 16


def sums_reference(image, part=FINE):
    # In float32 as in the kernel, so that both choose the same of several nearly equal gradients.
    values = np.sqrt(np.float32(255) * image.astype(np.float32))
    gx, gy = np.zeros_like(values), np.zeros_like(values)
    gx[:, 1:-1] = values[:, 2:] - values[:, :-2]
    gy[1:-1] = values[2:] - values[:-2]
    longest = (gx * gx + gy * gy).argmax(axis=2)[..., None]
    gx, gy = (np.take_along_axis(each, longest, axis=2)[..., 0].astype(np.float64) for each in (gx, gy))
    rows, columns = image.shape[0] // part, image.shape[1] // part
    sums = np.zeros((16, rows, columns))
    bins, lengths = orientation_bins(gx, gy), np.hypot(gx, gy)
    for k in range(16):
        votes = np.where(bins == k, lengths, 0)[: rows * part, : columns * part]
        sums[k] = votes.reshape(rows, part, columns, part).sum(axis=(1, 3))
    return sums


def pooled(sums, weights, step):
    """Weighted sums of squares around each cell of `step` squares, with replicated borders."""
    count = sums.shape[1] // step, sums.shape[2] // step
    reach = (len(weights) - step) // 2
    inner = sums[:, : count[0] * step, : count[1] * step]
    padded = np.pad(inner, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    cells = np.zeros((16, *count))
    for i, above in enumerate(weights):
        for j, beside in enumerate(weights):
            part = padded[:, i : i + count[0] * step : step, j : j + count[1] * step : step]
            cells += above * beside * part
    return cells


def cells_reference(image, cell):
    """Orientation histograms of cells by bilinear interpolation."""
    sums = sums_reference(image)
    if cell == COARSE:
        return pooled(sums, [1, 3, 3, 1], 2) / 16 / cell**2
    return pooled(sums, [1, 6, 1], 1) / 64 / cell**2


def channels_reference(cells):
    unsigned = cells[:8] + cells[8:]
    energy = np.pad((unsigned**2).sum(axis=0), 1, mode="edge")
    blocks = energy[:-1, :-1] + energy[:-1, 1:] + energy[1:, :-1] + energy[1:, 1:]
    factors = 1 / np.sqrt(blocks + _EPS)
    four = factors[:-1, :-1], factors[:-1, 1:], factors[1:, :-1], factors[1:, 1:]
    signed = np.array([np.minimum(cells * factor, 0.2) for factor in four])
    both = np.array([np.minimum(unsigned * factor, 0.2) for factor in four])
    return np.concatenate([signed.sum(axis=0) / 2, both.sum(axis=0) / 2, 0.2357 * signed.sum(axis=1)])


def test_every_integer_gradient_is_in_the_right_bin():
    # A square of 4x4 pixels for each gradient, black except for the four neighbors of one pixel.
    gy, gx = np.mgrid[-255:256, -255:256]
    image = np.zeros((511, 4, 511, 4), np.uint8)
    image[:, 1, :, 0], image[:, 1, :, 2] = np.maximum(-gx, 0), np.maximum(gx, 0)
    image[:, 0, :, 1], image[:, 2, :, 1] = np.maximum(-gy, 0), np.maximum(gy, 0)
    plane = image.reshape(4 * 511, 4 * 511)
    found = np.empty((16, 511, 511), np.float32)
    _fhog_kernels.orientation_sums(np.stack([plane] * 3), _COTANGENTS, found)
    # The tolerance is below the smallest gradient, so a wrong bin fails.
    np.testing.assert_allclose(found, sums_reference(plane[..., None]), **CLOSE)


@pytest.mark.parametrize("shape", [(8, 8), (16, 24), (33, 35), (40, 1044), (13, 522)])
def test_orientation_sums_equal_the_reference(shape):
    image = noise(shape)
    found = orientation_sums(image)
    assert found.shape == (16, shape[0] // 4, shape[1] // 4)
    np.testing.assert_allclose(found, sums_reference(image), **CLOSE)


def test_the_channel_with_the_longest_gradient_is_used():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, 4:, 0], image[4:, :, 1] = 40, 90
    sums = orientation_sums(image)
    # A vertical step of 90 in the middle rows, a horizontal one of 40 in the others.
    down, across = math.sqrt(255 * 90) * 2 * 8, math.sqrt(255 * 40) * 2 * 6
    np.testing.assert_allclose([sums[4].sum(), sums[0].sum(), sums.sum()], [down, across, down + across])


def test_edges_of_dark_regions_have_more_weight():
    image = np.full((8, 16, 3), 10, np.uint8)
    image[:, 4:8], image[:, 8:12] = 30, 200
    image[:, 12:] = 220
    sums = orientation_sums(image)
    assert sums[0, 0, 0] > 2 * sums[0, 0, 3]


@pytest.mark.parametrize("degrees", range(0, 360, 45))
def test_a_ramp_has_the_orientation_of_its_gradient(degrees):
    y, x = np.mgrid[:16, :16]
    ramp = 128 + 6 * ((x - 8) * math.cos(math.radians(degrees)) + (y - 8) * math.sin(math.radians(degrees)))
    sums = orientation_sums(np.repeat(ramp.round().astype(np.uint8)[..., None], 3, axis=2))
    assert sums[:, 1:-1, 1:-1].sum(axis=(1, 2)).argmax() == degrees / 22.5


@pytest.mark.parametrize("cell", [FINE, COARSE])
@pytest.mark.parametrize("shape", [(8, 8), (16, 24), (37, 43), (64, 1044)])
def test_channels_equal_the_reference(shape, cell):
    image = noise(shape)
    found = fhog_channels(image, cell)
    assert found.shape == (N_CHANNELS, shape[0] // cell, shape[1] // cell)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, channels_reference(cells_reference(image, cell)), atol=1e-5)


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_channels_of_a_road_equal_the_reference(cell):
    image = road()
    expected = channels_reference(cells_reference(image, cell))
    # Rounding of the sums has more effect where contrast is low.
    np.testing.assert_allclose(fhog_channels(image, cell), expected, atol=1e-3)


def test_a_pixel_is_distributed_to_the_cells_around_it():
    # The weights of one square in all cells sum to 1.
    for step, cell, kernel in (
        (2, COARSE, _fhog_kernels.pool_bilinear),
        (1, FINE, _fhog_kernels.smooth_cells),
    ):
        sums = np.zeros((16, 12, 12), np.float32)
        sums[3, 6, 5] = 64.0
        cells = np.empty((16, 12 // step, 12 // step), np.float32)
        scale = 1 / (16 * cell**2) if step == 2 else 1 / (64 * cell**2)
        kernel(sums, np.float32(scale), cells)
        assert cells.sum() == pytest.approx(64 / cell**2)
        assert np.count_nonzero(cells) == (9 if step == 1 else 4)


@pytest.mark.parametrize("cell", [FINE, COARSE])
@given(seed=st.integers(0, 1000), rows=st.integers(1, 6), columns=st.integers(1, 6))
@settings(max_examples=20)
def test_channels_of_the_mirrored_image_are_the_mirrored_channels(cell, seed, rows, columns):
    image = noise((rows * cell, columns * cell), seed)
    mirrored = np.ascontiguousarray(image[:, ::-1])
    channels = fhog_channels(image, cell)
    np.testing.assert_allclose(fhog_channels(mirrored, cell), mirror_channels(channels), atol=1e-5)
    np.testing.assert_array_equal(mirror_channels(mirror_channels(channels)), channels)


def test_mirroring_permutes_channels():
    assert sorted(MIRROR_ORDER) == list(range(N_CHANNELS))
    np.testing.assert_array_equal(MIRROR_ORDER[MIRROR_ORDER], np.arange(N_CHANNELS))


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_a_uniform_image_has_no_features(cell):
    assert not fhog_channels(np.full((32, 40, 3), 77, np.uint8), cell).any()


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_channels_do_not_depend_on_contrast(cell):
    faint = noise((64, 64)) // 3
    np.testing.assert_allclose(fhog_channels(faint * 3, cell), fhog_channels(faint, cell), atol=2e-3)


def test_channels_are_between_zero_and_their_clipping_limit():
    channels = fhog_channels(noise((64, 96)), COARSE)
    assert channels.min() >= 0
    assert channels[:24].max() <= 0.4 + 1e-6
    assert channels[24:].max() <= 0.2357 * 16 * 0.2


def test_fine_and_coarse_cells_share_the_sums():
    image = road()
    sums = orientation_sums(image)
    for cell in (FINE, COARSE):
        np.testing.assert_array_equal(channels_from_sums(sums, cell), fhog_channels(image, cell))


@pytest.mark.parametrize("pixels", [3.1, 4.0, 5.0, 7.9])
def test_a_shared_level_equals_two_levels(pixels):
    images = image_pyramid(road())
    rows = 0, 180
    both = dict(feature_maps(images, PyramidLevel(pixels, 2 * pixels), rows))
    assert list(both) == [pixels, 2 * pixels]
    for alone in (PyramidLevel(pixels, None), PyramidLevel(None, 2 * pixels)):
        ((size, level),) = feature_maps(images, alone, rows)
        shared = both[size]
        assert (shared.step_x, shared.step_y) == (level.step_x, level.step_y)
        # The border of a level of coarse cells only is wider by whole cells.
        left = (shared.left - level.left) / level.step_x
        top = (shared.top - level.top) / level.step_y
        assert (left, top) == (pytest.approx(round(left)), pytest.approx(round(top)))
        high, wide = shared.channels.shape[1:]
        part = level.channels[:, round(top) : round(top) + high, round(left) : round(left) + wide]
        np.testing.assert_allclose(shared.channels[:, 2:-2, 2:-2], part[:, 2:-2, 2:-2], atol=1e-5)


@pytest.mark.parametrize(
    ("pixels", "rows"), [(8.0, (64, 192)), (16.0, (96, 208)), (12.0, (60, 180)), (32.0, (64, 256))]
)
def test_a_map_of_some_rows_is_part_of_the_whole_map(pixels, rows):
    images = image_pyramid(road((240, 384)) if pixels == 12 else road((256, 384)))
    ((_, whole),) = feature_maps(images, PyramidLevel(None, pixels), (0, images[0].shape[0]))
    ((_, part),) = feature_maps(images, PyramidLevel(None, pixels), rows)
    assert (part.left, part.step_x, part.step_y) == (whole.left, whole.step_x, whole.step_y)
    first = round((part.top - whole.top) / whole.step_y)
    assert part.top == whole.top + first * whole.step_y
    count = part.channels.shape[1]
    expected = whole.channels[:, first : first + count]
    # The outermost cells have no context, and the next ones are normalized with them.
    np.testing.assert_allclose(part.channels[:, 2 : count - 2], expected[:, 2 : count - 2], atol=1e-5)


@given(
    height=st.integers(40, 300),
    width=st.integers(40, 300),
    pixels=st.floats(2, 40),
    top=st.floats(0, 0.5),
    fraction=st.floats(0.4, 0.5),
)
def test_maps_cover_their_rows(height, width, pixels, top, fraction):
    rows = int(top * height), int((top + fraction) * height)
    level = PyramidLevel(pixels, None) if pixels < COARSE else PyramidLevel(None, pixels)
    for _, found in feature_maps(image_pyramid(np.zeros((height, width, 3), np.uint8)), level, rows):
        _, high, wide = found.channels.shape
        assert found.left < 0
        assert found.left + wide * found.step_x > width
        slack = 1 / level.scale + 2
        assert found.top <= rows[0] + slack
        assert found.top + high * found.step_y >= rows[1] - slack


@pytest.mark.parametrize("rows", [(0, 240), (50, 201), (71, 240), (0, 181)])
@pytest.mark.parametrize("pixels", [3.3, 5.7, 8.0, 11.1, 19.3])
def test_positions_of_cells_are_those_in_the_frame(pixels, rows):
    image = np.full((240, 321, 3), 90, np.uint8)
    image[104:136, 161:193] = 220
    level = PyramidLevel(pixels, None) if pixels < COARSE else PyramidLevel(None, pixels)
    ((_, found),) = feature_maps(image_pyramid(image), level, rows)
    # Normalization raises faint edges, so the centroid is accurate to about half a cell.
    edges = found.channels[24:].sum(axis=0).astype(np.float64)
    x = found.left + (np.arange(edges.shape[1]) + 0.5) * found.step_x
    y = found.top + (np.arange(edges.shape[0]) + 0.5) * found.step_y
    assert edges.sum(axis=0) @ x / edges.sum() == pytest.approx(177, abs=0.6 * pixels)
    assert edges.sum(axis=1) @ y / edges.sum() == pytest.approx(120, abs=0.6 * pixels)


def test_the_border_is_replicated():
    image = np.full((64, 96, 3), (30, 90, 160), np.uint8)
    for level in (PyramidLevel(None, 8.0), PyramidLevel(4.0, None), PyramidLevel(4.0, 8.0)):
        border = BORDER if level.fine else WIDE_BORDER
        for cell, found in feature_maps([image], level, (0, 64)):
            assert (found.left, found.top) == (-border, -border)
            assert found.channels.shape == (N_CHANNELS, (64 + 2 * border) // cell, (96 + 2 * border) // cell)
            assert not found.channels.any()


def test_a_workspace_does_not_change_the_result():
    workspace = Workspace()
    for seed, shape in enumerate([(90, 160), (50, 70), (120, 100)]):
        images = image_pyramid(noise(shape, seed))
        for level in (PyramidLevel(3.0, 6.0), PyramidLevel(None, 9.0)):
            fresh = {size: found.channels for size, found in feature_maps(images, level, (0, shape[0]))}
            for size, found in feature_maps(images, level, (0, shape[0]), workspace):
                np.testing.assert_array_equal(found.channels, fresh[size])


def test_a_strided_frame_gives_the_same_map():
    image = noise((80, 120))
    wide = np.zeros((80, 240, 3), np.uint8)
    wide[:, ::2] = image
    for level in (PyramidLevel(3.0, None), PyramidLevel(None, 8.0)):
        ((_, one),) = feature_maps(image_pyramid(image), level, (10, 70))
        ((_, two),) = feature_maps(image_pyramid(wide[:, ::2]), level, (10, 70))
        np.testing.assert_array_equal(one.channels, two.channels)


def test_pyramids_halve_the_image():
    shapes = [image.shape[:2] for image in image_pyramid(np.zeros((523, 300, 3), np.uint8))]
    assert shapes == [(523, 300), (261, 150), (130, 75)]
    assert len(image_pyramid(np.zeros((3, 5, 3), np.uint8))) == 1


@given(smallest=st.floats(2, 20), per_octave=st.integers(1, 8), octaves=st.floats(0, 6), share=st.booleans())
def test_every_size_has_one_level(smallest, per_octave, octaves, share):
    sizes = [smallest * 2 ** (step / per_octave) for step in range(int(octaves * per_octave) + 1)]
    levels = pyramid_levels(sizes, share=share)
    assert sorted(size for level in levels for size, _ in level.sizes) == sizes
    for level in levels:
        for size, cell in level.sizes:
            assert cell == (FINE if size < COARSE else COARSE)
            assert level.scale * size == pytest.approx(cell)
            assert level.scale <= 2 or size < 4
        assert share or len(level.sizes) == 1


def test_opencv_resizes_into_the_given_array():
    # The workspace saves nothing if OpenCV allocates an array of its own.
    memory = np.empty((20, 30, 3), np.uint8)
    assert cv2.resize(noise((40, 60)), (30, 20), dst=memory) is memory
