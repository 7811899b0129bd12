import contextlib
import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._common import ThreadTeam, Workspace
from vehicle_detection._kernels import fhog as _fhog_kernels
from vehicle_detection._kernels.vector import unpack_bytes
from vehicle_detection.mixture import N_CHANNELS, CellGrid, EdgePyramid, mirror_channels
from vehicle_detection.mixture.features import (
    _EPS,
    CHANNEL_SCALES,
    MIRROR_ORDER,
    octave_count,
    octave_of,
)
from vehicle_detection.synthetic import render_scene

# The kernel sums in float32, the reference in float64.
CLOSE = {"rtol": 1e-4, "atol": 2e-3}
SIZES = [4.0, 5.3, 7.9, 11.9, 12.0, 20.0, 37.0]


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def road(shape=(180, 320), seed=3):
    return render_scene(shape=shape, vehicles=3, random_state=seed).image


def inner_grid(size, shape=(180, 320), offset=(0.3, 0.7)):
    """Cells inside a frame, at a position that is no multiple of their size."""
    left, top = (size * (1 + each) for each in offset)
    rows, columns = (int((side - 2 * size) / size) - 2 for side in shape)
    return CellGrid(left, top, size, size, max(rows, 1), max(columns, 1))


# The reference computes the same channels with numpy in float64.


def orientation_bins(gx, gy):
    """Signed orientation, 0 to 15, of a gradient: the bin around each multiple of 22.5 degrees."""
    return np.floor(np.degrees(np.arctan2(gy, gx)) / 22.5 + 0.5).astype(int) % 16


def votes_reference(image, margin):
    """Gradient magnitudes by orientation of each pixel and of `margin` replicated ones; ``(16, H, W)``."""
    padded = np.pad(image, ((margin + 1, margin + 1), (margin + 1, margin + 1), (0, 0)), mode="edge")
    # In float32 as in the kernel, so that both choose the same of several nearly equal gradients.
    values = np.sqrt(np.float32(255) * padded.astype(np.float32))
    gx = values[1:-1, 2:] - values[1:-1, :-2]
    gy = values[2:, 1:-1] - values[:-2, 1:-1]
    longest = (gx * gx + gy * gy).argmax(axis=2)[..., None]
    gx, gy = (np.take_along_axis(each, longest, axis=2)[..., 0].astype(np.float64) for each in (gx, gy))
    bins, lengths = orientation_bins(gx, gy), np.hypot(gx, gy)
    return np.where(bins == np.arange(16)[:, None, None], lengths, 0)


def sums_reference(image):
    """Sums over squares, with one square more around those of the image; ``(rows, columns, 16)``."""
    height, width = image.shape[:2]
    image = np.pad(image, ((0, -height % 4), (0, -width % 4), (0, 0)), mode="edge")
    votes = votes_reference(image, 4)
    return votes.reshape(16, votes.shape[1] // 4, 4, -1, 4).sum(axis=(2, 4)).transpose(1, 2, 0)


def tent_area(end):
    """Integral of ``1 - |t|`` from -1 to `end`."""
    end = np.clip(end, -1, 1)
    return np.where(end < 0, 0.5 * (1 + end) ** 2, 1 - 0.5 * (1 - end) ** 2)


def tent_weights(start, step, count, squares):
    """Weight of each square, from -1 to `squares`, in each cell; replicated squares add to the outer ones."""
    weights = np.zeros((count, squares + 2))
    for cell in range(count):
        center = start + (cell + 0.5) * step
        for square in range(math.floor(center - step), math.ceil(center + step)):
            share = tent_area((square + 1 - center) / step) - tent_area((square - center) / step)
            weights[cell, min(max(square, -1), squares) + 1] += share
    return weights


def cells_reference(sums, grid, square):
    """Interpolate the cells of a grid, with one cell more on each side; ``(16, rows + 2, columns + 2)``."""
    step_x, step_y = grid.step_x / square, grid.step_y / square
    down = tent_weights(grid.top / square - step_y, step_y, grid.rows + 2, sums.shape[0] - 2)
    across = tent_weights(grid.left / square - step_x, step_x, grid.columns + 2, sums.shape[1] - 2)
    return np.einsum("ri,ijk,cj->krc", down, sums, across) / 16


def channels_reference(cells):
    """Normalize all but the outermost cells."""
    unsigned = cells[:8] + cells[8:]
    energy = (unsigned**2).sum(axis=0)
    blocks = energy[:-1, :-1] + energy[:-1, 1:] + energy[1:, :-1] + energy[1:, 1:]
    factors = 1 / np.sqrt(blocks + _EPS)
    four = factors[:-1, :-1], factors[:-1, 1:], factors[1:, :-1], factors[1:, 1:]
    inner = cells[:, 1:-1, 1:-1]
    signed = np.array([np.minimum(inner * factor, 0.2) for factor in four])
    return np.concatenate([signed.sum(axis=0) / 2, 0.2357 * signed.sum(axis=1)])


def halved(image):
    image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
    return cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)


def map_reference(image, grid):
    octave = octave_of(math.sqrt(grid.step_x * grid.step_y), octave_count(image.shape))
    for _ in range(octave):
        image = halved(image)
    return channels_reference(cells_reference(sums_reference(image), grid, 4 * 2**octave))


def orientation_sums(image):
    return EdgePyramid(image).octaves[0].sums


def test_every_integer_gradient_is_in_the_right_bin():
    # A square of 4x4 pixels for each gradient, black except for the four neighbors of one pixel.
    gy, gx = np.mgrid[-255:256, -255:256]
    image = np.zeros((511, 4, 511, 4), np.uint8)
    image[:, 1, :, 0], image[:, 1, :, 2] = np.maximum(-gx, 0), np.maximum(gx, 0)
    image[:, 0, :, 1], image[:, 2, :, 1] = np.maximum(-gy, 0), np.maximum(gy, 0)
    image = np.repeat(image.reshape(4 * 511, 4 * 511, 1), 3, axis=2)
    # The tolerance is below the smallest gradient, so a wrong bin fails.
    np.testing.assert_allclose(orientation_sums(image), sums_reference(image), **CLOSE)


@pytest.mark.parametrize("shape", [(8, 8), (16, 24), (33, 35), (40, 1044), (13, 522), (3, 2)])
def test_orientation_sums_equal_the_reference(shape):
    image = noise(shape)
    found = orientation_sums(image)
    assert found.shape == (-(-shape[0] // 4) + 2, -(-shape[1] // 4) + 2, 16)
    np.testing.assert_allclose(found, sums_reference(image), **CLOSE)


def test_the_channel_with_the_longest_gradient_is_used():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, 4:, 0], image[4:, :, 1] = 40, 90
    sums = orientation_sums(image)[1:-1, 1:-1].sum(axis=(0, 1))
    # A vertical step of 90 in the middle rows, a horizontal one of 40 in the others.
    down, across = math.sqrt(255 * 90) * 2 * 8, math.sqrt(255 * 40) * 2 * 6
    np.testing.assert_allclose([sums[4], sums[0], sums.sum()], [down, across, down + across])


def test_edges_of_dark_regions_have_more_weight():
    image = np.full((8, 16, 3), 10, np.uint8)
    image[:, 4:8], image[:, 8:12] = 30, 200
    image[:, 12:] = 220
    sums = orientation_sums(image)[1, 1:-1, 0]
    assert sums[0] > 2 * sums[3]


@pytest.mark.parametrize("degrees", range(0, 360, 45))
def test_a_ramp_has_the_orientation_of_its_gradient(degrees):
    y, x = np.mgrid[:16, :16]
    ramp = 128 + 6 * ((x - 8) * math.cos(math.radians(degrees)) + (y - 8) * math.sin(math.radians(degrees)))
    sums = orientation_sums(np.repeat(ramp.round().astype(np.uint8)[..., None], 3, axis=2))
    assert sums[2:-2, 2:-2].sum(axis=(0, 1)).argmax() == degrees / 22.5


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "image", [noise((180, 320)), road(), noise((175, 317), 1)], ids=["noise", "road", "odd"]
)
def test_channels_equal_the_reference(image, size):
    for grid in (inner_grid(size), CellGrid(-2.5 * size, -3 * size, 1.1 * size, size, 9, 12)):
        found = EdgePyramid(image).feature_map(grid)
        assert found.channels.shape == (N_CHANNELS, grid.rows, grid.columns)
        assert found.channels.dtype == np.float32
        # Rounding of the sums has more effect where contrast is low.
        np.testing.assert_allclose(found.channels, map_reference(image, grid), atol=1e-3)


@given(st.floats(0.5, 6), st.floats(-20, 20), st.integers(1, 9))
def test_the_weights_of_a_cell_sum_to_one(step, start, count):
    taps = math.ceil(2 * step) + 1
    index, weights = np.empty((count, taps), np.int64), np.empty((count, taps), np.float32)
    _fhog_kernels._tent_taps(start, step, 30, taps, index, weights)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    assert weights.min() >= 0
    assert 0 <= index.min() <= index.max() <= 31
    expected = tent_weights(start, step, count, 30)
    for cell in range(count):
        found = np.bincount(index[cell], weights[cell], 32)
        np.testing.assert_allclose(found, expected[cell], atol=1e-5)


@given(st.integers(0, 100), st.floats(4, 40), st.integers(1, 6), st.integers(1, 6))
@settings(max_examples=30)
def test_channels_of_the_mirrored_image_are_the_mirrored_channels(seed, size, rows, columns):
    image = noise((96, 128), seed)
    grid = CellGrid(20.0, 10.0, size, size, rows, columns)
    mirrored_grid = CellGrid(128 - 20 - columns * size, 10.0, size, size, rows, columns)
    mirrored = EdgePyramid(np.ascontiguousarray(image[:, ::-1])).feature_map(mirrored_grid).channels
    channels = EdgePyramid(image).feature_map(grid).channels
    np.testing.assert_allclose(mirrored, mirror_channels(channels), atol=2e-5)
    np.testing.assert_array_equal(mirror_channels(mirror_channels(channels)), channels)


def test_mirroring_permutes_channels():
    assert sorted(MIRROR_ORDER) == list(range(N_CHANNELS))
    np.testing.assert_array_equal(MIRROR_ORDER[MIRROR_ORDER], np.arange(N_CHANNELS))


def test_a_uniform_image_has_no_features_and_its_border_is_replicated():
    image = np.full((64, 96, 3), (30, 90, 160), np.uint8)
    for size in SIZES:
        assert not EdgePyramid(image).feature_map(CellGrid(-40, -40, size, size, 12, 14)).channels.any()


def test_channels_do_not_depend_on_contrast():
    faint = noise((64, 64)) // 3
    grid = inner_grid(8.0, (64, 64))
    one, two = (EdgePyramid(image).feature_map(grid).channels for image in (faint, faint * 3))
    np.testing.assert_allclose(one, two, atol=2e-3)


def test_channels_are_between_zero_and_their_clipping_limit():
    channels = EdgePyramid(noise((64, 96))).feature_map(inner_grid(8.0, (64, 96))).channels
    scaled = channels * CHANNEL_SCALES[:, None, None]
    assert scaled.min() >= 0
    assert 100 < scaled.max() <= 127.001


def test_the_scales_map_the_largest_channels_to_127():
    # Orientations are half of four terms of at most 0.2, texture sums are 0.2357 times sixteen terms.
    largest = np.repeat([0.4, 0.2357 * 16 * 0.2], [16, 4])
    np.testing.assert_allclose(CHANNEL_SCALES * largest, 127, rtol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(7.0, 7.0), (20.0, 12.0), (5.0, 30.0)])
def test_crops_of_large_cells_are_interpolated_like_a_map(width, height):
    pyramid = EdgePyramid(road())
    grids = np.array([[30.5, 20.0, width, height], [3.0, -9.5, width, height]])
    crops = pyramid.crops(grids, 4, 5)
    assert crops.shape == (2, N_CHANNELS, 4, 5)
    for grid, crop in zip(grids.tolist(), crops):
        expected = pyramid.feature_map(CellGrid(*grid, 4, 5)).channels
        np.testing.assert_array_equal(crop, expected)


@pytest.mark.parametrize("size", SIZES)
def test_packed_channels_are_rounded_channels(size):
    pyramid, grid = EdgePyramid(road()), inner_grid(size)
    packed = pyramid.packed_channels(grid)
    assert packed.shape == (N_CHANNELS // 4, grid.rows, grid.columns)
    found = unpack_bytes(packed.transpose(1, 2, 0)).transpose(2, 0, 1)
    scaled = pyramid.feature_map(grid).channels * CHANNEL_SCALES[:, None, None]
    np.testing.assert_array_equal(found, np.floor(np.minimum(scaled + np.float32(0.5), 127)))


@pytest.mark.parametrize("rows", [(40, 100), (0, 90), (100, 180), (170, 180)])
def test_a_pyramid_of_some_rows_has_the_same_channels_there(rows):
    image = road()
    whole, part = EdgePyramid(image), EdgePyramid(image, [rows] * 9)
    for size in (4.0, 9.0, 13.0):
        count = int((rows[1] - rows[0]) / size) - 4
        if count > 0:
            grid = CellGrid(7.0, rows[0] + 2 * size, size, size, count, 12)
            np.testing.assert_array_equal(part.feature_map(grid).channels, whole.feature_map(grid).channels)
        assert len(part.octaves[0].sums) <= (rows[1] - rows[0]) / 4 + 4
    # Cells elsewhere take the nearest known rows.
    assert np.isfinite(part.feature_map(CellGrid(0.0, 0.0, 9.0, 9.0, 20, 20)).channels).all()


@pytest.mark.parametrize("size", [4.3, 5.7, 8.0, 11.1, 19.3])
def test_positions_of_cells_are_those_in_the_frame(size):
    image = np.full((240, 321, 3), 90, np.uint8)
    image[104:136, 161:193] = 220
    grid = CellGrid(-20.0, -10.0, size, size, int(260 / size), int(360 / size))
    channels = EdgePyramid(image).feature_map(grid).channels
    # Normalization raises faint edges, so the centroid is accurate to about half a cell.
    edges = channels[-4:].sum(axis=0).astype(np.float64)
    x = grid.left + (np.arange(edges.shape[1]) + 0.5) * size
    y = grid.top + (np.arange(edges.shape[0]) + 0.5) * size
    assert edges.sum(axis=0) @ x / edges.sum() == pytest.approx(177, abs=0.6 * size)
    assert edges.sum(axis=1) @ y / edges.sum() == pytest.approx(120, abs=0.6 * size)


def test_neither_memory_nor_threads_change_the_result():
    workspace, team = Workspace(), ThreadTeam(3, name="test")
    for seed, shape in enumerate([(190, 160), (50, 70), (120, 101)]):
        image = noise(shape, seed)
        fresh, reused = EdgePyramid(image), EdgePyramid(image, (), workspace, team)
        assert len(fresh.octaves) == len(reused.octaves) == octave_count(shape)
        for one, two in zip(fresh.octaves, reused.octaves):
            np.testing.assert_array_equal(one.sums, two.sums)
        grid = inner_grid(5.0, shape)
        packed = fresh.packed_channels(grid)
        np.testing.assert_array_equal(reused.packed_channels(grid), packed)
    team.close()


def test_a_strided_frame_gives_the_same_channels():
    image = noise((80, 120))
    wide = np.zeros((80, 240, 3), np.uint8)
    wide[:, ::2] = image
    grid = inner_grid(9.0, (80, 120))
    one, two = (EdgePyramid(each).feature_map(grid).channels for each in (image, wide[:, ::2]))
    np.testing.assert_array_equal(one, two)


def test_octaves_halve_the_image():
    pyramid = EdgePyramid(np.zeros((523, 300, 3), np.uint8))
    shapes = [octave.planes.shape for octave in pyramid.octaves]
    assert shapes == [(3, 523, 300), (3, 262, 150), (3, 131, 75), (3, 66, 38), (3, 33, 19)]
    assert len(EdgePyramid(np.zeros((3, 5, 3), np.uint8)).octaves) == 1


@pytest.mark.parametrize("shape", [(523, 301), (361, 40), (34, 33)])
def test_an_octave_is_the_mean_of_2x2_pixels(shape):
    # The first octave is computed in parts of the image.
    image = noise(shape)
    with contextlib.closing(ThreadTeam(2, name="test")) as team:
        planes = [octave.planes for octave in EdgePyramid(image, team=team).octaves]
    np.testing.assert_array_equal(planes[0], image.transpose(2, 0, 1))
    for whole, half in pairwise(planes):
        height, width = (2 * side for side in half.shape[1:])
        padded = np.pad(whole, ((0, 0), (0, height), (0, width)), mode="edge")[:, :height, :width]
        means = padded.reshape(3, height // 2, 2, width // 2, 2).mean(axis=(2, 4))
        np.testing.assert_array_equal(half, np.floor(means + 0.5))


def test_the_octaves_of_cells_of_several_sizes():
    pyramid = EdgePyramid(noise((90, 160)))
    sizes = np.random.default_rng(0).uniform(1, 60, 50)
    found = pyramid.by_octave(sizes)
    assert sorted(np.concatenate([rows for _, rows in found]).tolist()) == list(range(50))
    for number, rows in found:
        assert {octave_of(size, len(pyramid.octaves)) for size in sizes[rows].tolist()} == {number}


def test_cells_have_at_most_three_squares_a_side():
    assert [octave_of(size, 9) for size in (2, 4, 11.9, 12, 23.9, 24, 48)] == [0, 0, 0, 1, 1, 2, 3]
    assert octave_of(500, 3) == 2


def test_opencv_resizes_into_the_given_array():
    # The workspace saves nothing if OpenCV allocates an array of its own.
    memory = np.empty((20, 30), np.uint8)
    assert cv2.resize(noise((40, 60))[..., 0].copy(), (30, 20), dst=memory) is memory
