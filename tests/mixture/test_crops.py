import cv2
import numpy as np
import pytest

from vehicle_detection.mixture import (
    N_CHANNELS,
    N_EDGE_FEATURES,
    EdgePyramid,
    edge_features,
    rescoring_inputs,
)
from vehicle_detection.mixture.crops import window_grid
from vehicle_detection.synthetic import render_scene

BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])


def test_features_of_a_box_do_not_depend_on_its_position():
    image = np.random.default_rng(4).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    inner, same = np.array([[96.0, 64.0, 160.0, 128.0]]), np.array([[0.0, 0.0, 64.0, 64.0]])
    pyramid, part_pyramid = EdgePyramid(image), EdgePyramid(image[64:128, 96:160])
    whole, part = edge_features(pyramid, inner), edge_features(part_pyramid, same)
    assert whole.shape == (1, N_EDGE_FEATURES)
    one, two = (each.reshape(N_CHANNELS, 12, 12)[:, 4:8, 4:8] for each in (whole, part))
    np.testing.assert_allclose(one, two, atol=1e-5)


@pytest.mark.parametrize("side", [30.0, 47.0, 49.0, 90.0])
def test_small_and_large_boxes_have_similar_features(side):
    # The same scene at two sizes, one of which may be computed from small squares.
    image = render_scene(shape=(360, 640), vehicles=3, random_state=5).image
    large = cv2.resize(image, (1280, 720), interpolation=cv2.INTER_CUBIC)
    box = np.array([[300.0, 180.0, 300.0 + side, 180.0 + side]])
    one, two = edge_features(EdgePyramid(image), box)[0], edge_features(EdgePyramid(large), 2 * box)[0]
    assert np.corrcoef(one, two)[0, 1] > 0.85


def test_small_boxes_at_the_border_of_a_frame():
    image = render_scene(shape=(360, 640), vehicles=3, random_state=5).image[180:240, 300:380]
    boxes = np.array([[-9.0, -9, 20, 15], [70, 50, 95, 75], [-90, -90, -60, -70], [200, 200, 230, 230]])
    assert np.isfinite(edge_features(EdgePyramid(image), boxes)).all()
    padded = np.pad(image, ((40, 40), (40, 40), (0, 0)), mode="edge")
    expected, found = (
        edge_features(EdgePyramid(padded), boxes[:2] + 40),
        edge_features(EdgePyramid(image), boxes[:2]),
    )
    assert np.corrcoef(expected.ravel(), found.ravel())[0, 1] > 0.98


def test_rescoring_has_edge_features():
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    pyramid = EdgePyramid(image)
    inputs = rescoring_inputs(pyramid, BOXES)
    assert inputs.shape == (12, 23, 12, 3)
    assert inputs.dtype == np.float32
    edges = inputs[:, :20].transpose(3, 1, 0, 2).reshape(3, -1)
    np.testing.assert_allclose(edges, edge_features(pyramid, BOXES) * 5 - 0.5, atol=1e-6)


def test_no_boxes():
    pyramid = EdgePyramid(np.zeros((120, 160, 3), np.uint8))
    assert edge_features(pyramid, BOXES[:0]).shape == (0, N_EDGE_FEATURES)
    assert rescoring_inputs(pyramid, BOXES[:0]).shape == (12, 23, 12, 0)


def colors_of(image, box):
    """Lightness, a and b of the cells of a box."""
    return rescoring_inputs(EdgePyramid(image), np.array([box]))[:, 20:, :, 0].swapaxes(0, 1)


def test_colors_are_standardized_lightness_and_scaled_a_and_b():
    image = np.zeros((120, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (200, 40, 40), (40, 40, 200)
    lightness, a, b = colors_of(image, [20.0, 20.0, 100.0, 100.0])
    assert abs(float(lightness.mean())) < 1e-5
    expected = cv2.cvtColor(np.float32([[[200, 40, 40], [40, 40, 200]]]) / 255, cv2.COLOR_RGB2LAB)[0]
    for column, lab in ((2, expected[0]), (9, expected[1])):
        np.testing.assert_allclose(a[:, column] * 40, lab[1], atol=0.1)
        np.testing.assert_allclose(b[:, column] * 40, lab[2], atol=0.1)
    # Half of the cells are darker by `step`; the divisor is twice the standard deviation and 10 more.
    step = expected[0, 0] - expected[1, 0]
    np.testing.assert_allclose(lightness[:, 2] - lightness[:, 9], step / (step + 10), rtol=0.01)


def test_a_box_fills_the_cells_in_the_middle_of_its_crop():
    image = np.zeros((160, 160, 3), np.uint8)
    image[40:120, 32:128] = (200, 0, 0)
    _, a, _ = colors_of(image, [32.0, 40.0, 128.0, 120.0])
    expected = np.zeros((12, 12), bool)
    expected[2:10, 2:10] = True
    np.testing.assert_array_equal(a > 0.5, expected)


def test_the_grid_of_a_window_has_the_box_in_its_middle():
    # 4 by 2 cells of the box, of 10 by 15 pixels, in a window of 8 by 6 cells.
    grid = window_grid((100.0, 200.0, 140.0, 230.0), (4, 2), (8, 6))
    assert (grid.left, grid.top, grid.step_x, grid.step_y) == (80, 170, 10, 15)
    assert (grid.rows, grid.columns) == (6, 8)


def test_lightness_features_hardly_depend_on_exposure():
    ramp = np.tile(np.linspace(40, 200, 120)[None, :, None], (120, 1, 3))
    bright, dark = (
        colors_of((ramp * exposure).astype(np.uint8), [20.0, 20.0, 100.0, 100.0])[0] for exposure in (1, 0.6)
    )
    assert np.abs(bright - dark).max() < 0.1
    assert bright.std() > 0.35
