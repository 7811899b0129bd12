import cv2
import numpy as np

from vehicle_detection.mixture import (
    N_CHANNELS,
    N_COLOR_FEATURES,
    N_EDGE_FEATURES,
    N_REGRESSION_FEATURES,
    regression_features,
    rescoring_features,
)

BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])


def test_features_of_a_box_do_not_depend_on_its_position():
    image = np.random.default_rng(4).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    inner, same = np.array([[96.0, 64.0, 160.0, 128.0]]), np.array([[0.0, 0.0, 64.0, 64.0]])
    whole, part = regression_features(image, inner), regression_features(image[64:128, 96:160], same)
    assert whole.shape == (1, N_REGRESSION_FEATURES)
    one, two = (each[0, :-4].reshape(N_CHANNELS, 12, 12)[:, 4:8, 4:8] for each in (whole, part))
    np.testing.assert_allclose(one, two, atol=1e-5)
    outside = regression_features(image, np.array([[-20.0, -10.0, 20.0, 90.0], [280.0, 150.0, 360.0, 250.0]]))
    np.testing.assert_allclose(outside[:, -4:], [[0.5, 0.1, 0, 0], [0, 0, 0.75, 0.5]])


def test_regression_and_rescoring_have_the_same_edge_features():
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    edges, colors = rescoring_features(image, BOXES)
    np.testing.assert_array_equal(edges, regression_features(image, BOXES)[:, :-4])
    assert colors.shape == (3, N_COLOR_FEATURES)
    assert edges.dtype == colors.dtype == np.float32


def test_no_boxes():
    image = np.zeros((120, 160, 3), np.uint8)
    assert regression_features(image, BOXES[:0]).shape == (0, N_REGRESSION_FEATURES)
    for part, length in zip(rescoring_features(image, BOXES[:0]), (N_EDGE_FEATURES, N_COLOR_FEATURES)):
        assert part.shape == (0, length)


def test_colors_are_standardized_lightness_and_scaled_a_and_b():
    image = np.zeros((120, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (200, 40, 40), (40, 40, 200)
    _, (colors,) = rescoring_features(image, np.array([[20.0, 20.0, 100.0, 100.0]]))
    lightness, a, b = colors.reshape(3, 12, 12)
    assert abs(float(lightness.mean())) < 1e-5
    expected = cv2.cvtColor(np.float32([[[200, 40, 40], [40, 40, 200]]]) / 255, cv2.COLOR_RGB2LAB)[0]
    for column, lab in ((2, expected[0]), (9, expected[1])):
        np.testing.assert_allclose(a[:, column] * 20, lab[1], atol=0.1)
        np.testing.assert_allclose(b[:, column] * 20, lab[2], atol=0.1)
    assert (lightness[:, 2] > lightness[:, 9]).all()


def test_lightness_features_hardly_depend_on_exposure():
    ramp = np.tile(np.linspace(40, 200, 120)[None, :, None], (120, 1, 3))
    box = np.array([[20.0, 20.0, 100.0, 100.0]])
    bright, dark = (
        rescoring_features((ramp * exposure).astype(np.uint8), box)[1][0, :144] for exposure in (1.0, 0.6)
    )
    assert np.abs(bright - dark).max() < 0.2
    assert bright.std() > 0.7
