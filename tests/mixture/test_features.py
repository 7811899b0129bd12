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
    PLANES,
    image_pyramid,
    level_maps,
    mirror_planes,
    pyramid_levels,
)
from vehicle_detection.mixture.features import (
    _COTANGENTS,
    _EPS,
    BORDER,
    MIRRORED,
    WIDE_BORDER,
    Level,
    edge_sums,
    feature_planes,
    planes_of_sums,
)
from vehicle_detection.synthetic import render_scene

# Float32 against float64: the cumulative sums of a square are differenced.
CLOSE = {"rtol": 1e-4, "atol": 2e-3}


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def road(shape=(180, 320), seed=3):
    return render_scene(shape=shape, vehicles=3, random_state=seed).image


# The reference: the same features by plain numpy, in float64.


def bin_of(gx, gy):
    """Signed orientation, 0 to 15, of a gradient: the bin around each multiple of 22.5 degrees."""
    return np.floor(np.degrees(np.arctan2(gy, gx)) / 22.5 + 0.5).astype(int) % 16


def sums_reference(image, part=FINE):
    # In float32, as channels with all but equal gradients would otherwise change places.
    values = np.sqrt(np.float32(255) * image.astype(np.float32))
    gx, gy = np.zeros_like(values), np.zeros_like(values)
    gx[:, 1:-1] = values[:, 2:] - values[:, :-2]
    gy[1:-1] = values[2:] - values[:-2]
    longest = (gx * gx + gy * gy).argmax(axis=2)[..., None]
    gx, gy = (np.take_along_axis(each, longest, axis=2)[..., 0].astype(np.float64) for each in (gx, gy))
    rows, columns = image.shape[0] // part, image.shape[1] // part
    sums = np.zeros((16, rows, columns))
    bins, lengths = bin_of(gx, gy), np.hypot(gx, gy)
    for k in range(16):
        votes = np.where(bins == k, lengths, 0)[: rows * part, : columns * part]
        sums[k] = votes.reshape(rows, part, columns, part).sum(axis=(1, 3))
    return sums


def weighted(sums, weights, step):
    """Sum squares around every `step` of them; beyond the border the outermost ones go on."""
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
    """Mean of the gradient over a cell, of which every square shares by its middle's distance."""
    sums = sums_reference(image)
    if cell == COARSE:
        return weighted(sums, [1, 3, 3, 1], 2) / 16 / cell**2
    return weighted(sums, [1, 6, 1], 1) / 64 / cell**2


def planes_reference(cells):
    unsigned = cells[:8] + cells[8:]
    energy = np.pad((unsigned**2).sum(axis=0), 1, mode="edge")
    blocks = energy[:-1, :-1] + energy[:-1, 1:] + energy[1:, :-1] + energy[1:, 1:]
    factors = 1 / np.sqrt(blocks + _EPS)
    four = factors[:-1, :-1], factors[:-1, 1:], factors[1:, :-1], factors[1:, 1:]
    signed = np.array([np.minimum(cells * factor, 0.2) for factor in four])
    both = np.array([np.minimum(unsigned * factor, 0.2) for factor in four])
    return np.concatenate([signed.sum(axis=0) / 2, both.sum(axis=0) / 2, 0.2357 * signed.sum(axis=1)])


def test_every_gradient_of_whole_numbers_falls_into_its_bin():
    # A square of 4x4 pixels for each: the four neighbors of its second pixel are all that is not black.
    gy, gx = np.mgrid[-255:256, -255:256]
    image = np.zeros((511, 4, 511, 4), np.uint8)
    image[:, 1, :, 0], image[:, 1, :, 2] = np.maximum(-gx, 0), np.maximum(gx, 0)
    image[:, 0, :, 1], image[:, 2, :, 1] = np.maximum(-gy, 0), np.maximum(gy, 0)
    plane = image.reshape(4 * 511, 4 * 511)
    found = np.empty((16, 511, 511), np.float32)
    _fhog_kernels.orientation_sums(np.stack([plane] * 3), _COTANGENTS, found)
    # The least gradient counts 1: one in the wrong bin would show.
    np.testing.assert_allclose(found, sums_reference(plane[..., None]), **CLOSE)


@pytest.mark.parametrize("shape", [(8, 8), (16, 24), (33, 35), (40, 1044), (13, 522)])
def test_sums_of_orientations_equal_the_reference(shape):
    image = noise(shape)
    found = edge_sums(image)
    assert found.shape == (16, shape[0] // 4, shape[1] // 4)
    np.testing.assert_allclose(found, sums_reference(image), **CLOSE)


def test_of_the_channels_the_longest_gradient_counts():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, 4:, 0], image[4:, :, 1] = 40, 90
    sums = edge_sums(image)
    # Down by 90 in the middle rows, across by 40 in the others.
    down, across = math.sqrt(255 * 90) * 2 * 8, math.sqrt(255 * 40) * 2 * 6
    np.testing.assert_allclose([sums[4].sum(), sums[0].sum(), sums.sum()], [down, across, down + across])


def test_an_edge_in_the_dark_counts_for_more():
    image = np.full((8, 16, 3), 10, np.uint8)
    image[:, 4:8], image[:, 8:12] = 30, 200
    image[:, 12:] = 220
    sums = edge_sums(image)
    assert sums[0, 0, 0] > 2 * sums[0, 0, 3]


@pytest.mark.parametrize("degrees", range(0, 360, 45))
def test_a_slope_has_its_direction(degrees):
    y, x = np.mgrid[:16, :16]
    slope = 128 + 6 * ((x - 8) * math.cos(math.radians(degrees)) + (y - 8) * math.sin(math.radians(degrees)))
    sums = edge_sums(np.repeat(slope.round().astype(np.uint8)[..., None], 3, axis=2))
    assert sums[:, 1:-1, 1:-1].sum(axis=(1, 2)).argmax() == degrees / 22.5


@pytest.mark.parametrize("cell", [FINE, COARSE])
@pytest.mark.parametrize("shape", [(8, 8), (16, 24), (37, 43), (64, 1044)])
def test_planes_equal_the_reference(shape, cell):
    image = noise(shape)
    found = feature_planes(image, cell)
    assert found.shape == (PLANES, shape[0] // cell, shape[1] // cell)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, planes_reference(cells_reference(image, cell)), atol=1e-5)


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_planes_of_a_road_equal_the_reference(cell):
    image = road()
    expected = planes_reference(cells_reference(image, cell))
    # Where there is next to no contrast, rounding of the sums shows a little more.
    np.testing.assert_allclose(feature_planes(image, cell), expected, atol=1e-3)


def test_a_pixel_shares_in_the_cells_around_it():
    # One square's edges: the shares of all cells are its whole magnitude.
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
def test_features_of_the_mirrored_image_are_the_mirrored_features(cell, seed, rows, columns):
    image = noise((rows * cell, columns * cell), seed)
    mirrored = np.ascontiguousarray(image[:, ::-1])
    planes = feature_planes(image, cell)
    np.testing.assert_allclose(feature_planes(mirrored, cell), mirror_planes(planes), atol=1e-5)
    np.testing.assert_array_equal(mirror_planes(mirror_planes(planes)), planes)


def test_mirroring_swaps_planes():
    assert sorted(MIRRORED) == list(range(PLANES))
    np.testing.assert_array_equal(MIRRORED[MIRRORED], np.arange(PLANES))


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_an_even_image_has_no_features(cell):
    assert not feature_planes(np.full((32, 40, 3), 77, np.uint8), cell).any()


@pytest.mark.parametrize("cell", [FINE, COARSE])
def test_contrast_is_divided_out(cell):
    faint = noise((64, 64)) // 3
    np.testing.assert_allclose(feature_planes(faint * 3, cell), feature_planes(faint, cell), atol=2e-3)


def test_planes_lie_between_nothing_and_their_clip():
    planes = feature_planes(noise((64, 96)), COARSE)
    assert planes.min() >= 0
    assert planes[:24].max() <= 0.4 + 1e-6
    assert planes[24:].max() <= 0.2357 * 16 * 0.2


def test_one_map_of_sums_serves_fine_and_coarse_cells():
    image = road()
    sums = edge_sums(image)
    for cell in (FINE, COARSE):
        np.testing.assert_array_equal(planes_of_sums(sums, cell), feature_planes(image, cell))


# Levels of a pyramid.


@pytest.mark.parametrize("pixels", [3.1, 4.0, 5.0, 7.9])
def test_a_shared_level_equals_the_two_levels(pixels):
    images = image_pyramid(road())
    rows = 0, 180
    both = dict(level_maps(images, Level(pixels, 2 * pixels), rows))
    assert list(both) == [pixels, 2 * pixels]
    for alone in (Level(pixels, None), Level(None, 2 * pixels)):
        ((size, level),) = level_maps(images, alone, rows)
        shared = both[size]
        assert (shared.step_x, shared.step_y) == (level.step_x, level.step_y)
        # With coarse cells alone, more is made up around the frame, by whole cells.
        left = (shared.left - level.left) / level.step_x
        top = (shared.top - level.top) / level.step_y
        assert (left, top) == (pytest.approx(round(left)), pytest.approx(round(top)))
        high, wide = shared.planes.shape[1:]
        part = level.planes[:, round(top) : round(top) + high, round(left) : round(left) + wide]
        np.testing.assert_allclose(shared.planes[:, 2:-2, 2:-2], part[:, 2:-2, 2:-2], atol=1e-5)


@pytest.mark.parametrize(
    ("pixels", "rows"), [(8.0, (64, 192)), (16.0, (96, 208)), (12.0, (60, 180)), (32.0, (64, 256))]
)
def test_a_map_of_some_rows_is_a_part_of_the_whole_map(pixels, rows):
    images = image_pyramid(road((240, 384)) if pixels == 12 else road((256, 384)))
    ((_, whole),) = level_maps(images, Level(None, pixels), (0, images[0].shape[0]))
    ((_, part),) = level_maps(images, Level(None, pixels), rows)
    assert (part.left, part.step_x, part.step_y) == (whole.left, whole.step_x, whole.step_y)
    first = round((part.top - whole.top) / whole.step_y)
    assert part.top == whole.top + first * whole.step_y
    count = part.planes.shape[1]
    expected = whole.planes[:, first : first + count]
    # The outermost cells do not see what is beyond them, and those beside them are normalized by these.
    np.testing.assert_allclose(part.planes[:, 2 : count - 2], expected[:, 2 : count - 2], atol=1e-5)


@given(
    height=st.integers(40, 300),
    width=st.integers(40, 300),
    pixels=st.floats(2, 40),
    top=st.floats(0, 0.5),
    share=st.floats(0.4, 0.5),
)
def test_maps_cover_their_rows(height, width, pixels, top, share):
    rows = int(top * height), int((top + share) * height)
    level = Level(pixels, None) if pixels < COARSE else Level(None, pixels)
    for _, found in level_maps(image_pyramid(np.zeros((height, width, 3), np.uint8)), level, rows):
        _, high, wide = found.planes.shape
        assert found.left < 0
        assert found.left + wide * found.step_x > width
        slack = 1 / level.shrink + 2
        assert found.top <= rows[0] + slack
        assert found.top + high * found.step_y >= rows[1] - slack


@pytest.mark.parametrize("rows", [(0, 240), (50, 201), (71, 240), (0, 181)])
@pytest.mark.parametrize("pixels", [3.3, 5.7, 8.0, 11.1, 19.3])
def test_what_is_seen_is_where_it_is(pixels, rows):
    image = np.full((240, 321, 3), 90, np.uint8)
    image[104:136, 161:193] = 220
    level = Level(pixels, None) if pixels < COARSE else Level(None, pixels)
    ((_, found),) = level_maps(image_pyramid(image), level, rows)
    # Normalized, faint edges count nearly as much: the center tells the place to half a cell or so.
    edges = found.planes[24:].sum(axis=0).astype(np.float64)
    x = found.left + (np.arange(edges.shape[1]) + 0.5) * found.step_x
    y = found.top + (np.arange(edges.shape[0]) + 0.5) * found.step_y
    assert edges.sum(axis=0) @ x / edges.sum() == pytest.approx(177, abs=0.6 * pixels)
    assert edges.sum(axis=1) @ y / edges.sum() == pytest.approx(120, abs=0.6 * pixels)


def test_the_border_goes_on():
    image = np.full((64, 96, 3), (30, 90, 160), np.uint8)
    for level in (Level(None, 8.0), Level(4.0, None), Level(4.0, 8.0)):
        border = BORDER if level.fine else WIDE_BORDER
        for cell, found in level_maps([image], level, (0, 64)):
            assert (found.left, found.top) == (-border, -border)
            assert found.planes.shape == (PLANES, (64 + 2 * border) // cell, (96 + 2 * border) // cell)
            assert not found.planes.any()


def test_memory_that_is_used_again_changes_nothing():
    workspace = Workspace()
    for seed, shape in enumerate([(90, 160), (50, 70), (120, 100)]):
        images = image_pyramid(noise(shape, seed))
        for level in (Level(3.0, 6.0), Level(None, 9.0)):
            fresh = {size: found.planes for size, found in level_maps(images, level, (0, shape[0]))}
            for size, found in level_maps(images, level, (0, shape[0]), workspace):
                np.testing.assert_array_equal(found.planes, fresh[size])


def test_a_strided_frame_gives_the_same():
    image = noise((80, 120))
    wide = np.zeros((80, 240, 3), np.uint8)
    wide[:, ::2] = image
    for level in (Level(3.0, None), Level(None, 8.0)):
        ((_, one),) = level_maps(image_pyramid(image), level, (10, 70))
        ((_, two),) = level_maps(image_pyramid(wide[:, ::2]), level, (10, 70))
        np.testing.assert_array_equal(one.planes, two.planes)


def test_halves():
    shapes = [image.shape[:2] for image in image_pyramid(np.zeros((523, 300, 3), np.uint8))]
    assert shapes == [(523, 300), (261, 150), (130, 75)]
    assert len(image_pyramid(np.zeros((3, 5, 3), np.uint8))) == 1


@given(least=st.floats(2, 20), per_octave=st.integers(1, 8), octaves=st.floats(0, 6), share=st.booleans())
def test_every_size_is_served_once(least, per_octave, octaves, share):
    sizes = [least * 2 ** (step / per_octave) for step in range(int(octaves * per_octave) + 1)]
    levels = pyramid_levels(sizes, share=share)
    assert sorted(size for level in levels for size, _ in level.sizes) == sizes
    for level in levels:
        for size, cell in level.sizes:
            assert cell == (FINE if size < COARSE else COARSE)
            assert level.shrink * size == pytest.approx(cell)
            assert level.shrink <= 2 or size < 4
        assert share or len(level.sizes) == 1


def test_resizing_keeps_opencv_to_its_memory():
    # The pyramid hands cv2 the memory to write to: a copy of its own would cost what the buffers save.
    memory = np.empty((20, 30, 3), np.uint8)
    assert cv2.resize(noise((40, 60)), (30, 20), dst=memory) is memory
