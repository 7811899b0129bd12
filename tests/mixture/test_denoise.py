import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.mixture import MixtureSearch, denoise, load_model
from vehicle_detection.mixture.denoise import estimate_noise
from vehicle_detection.params import PyramidParams
from vehicle_detection.synthetic import render_drive, render_scene


def noisy(value, deviation, shape=(240, 320), seed=0):
    values = value + np.random.default_rng(seed).normal(0, deviation, (*shape, 3))
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("value", "deviation"), [(128, 3), (128, 8), (40, 3), (200, 5)])
def test_the_estimate_is_the_noise_of_the_square_roots(value, deviation):
    # The derivative of sqrt(255 * v) is sqrt(255 / v) / 2.
    expected = deviation * np.sqrt(255 / value) / 2
    assert estimate_noise(noisy(value, deviation)) == pytest.approx(expected, rel=0.1)


def test_image_content_is_not_noise():
    rows, columns = np.mgrid[:240, :320]
    ramp = np.repeat((rows / 2 + columns / 4)[..., None], 3, axis=2).astype(np.uint8)
    assert estimate_noise(ramp) < 1
    boxes = np.full((240, 320, 3), 90, np.uint8)
    boxes[50:90, 60:200], boxes[120:180, 40:90] = 20, 240
    assert estimate_noise(boxes) == 0


@given(height=st.integers(1, 9), width=st.integers(1, 9), seed=st.integers(0, 99))
def test_images_of_any_size(height, width, seed):
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    before = image.copy()
    assert estimate_noise(image) >= 0
    smooth = denoise(image)
    assert smooth.shape == image.shape
    assert smooth.dtype == np.uint8
    np.testing.assert_array_equal(image, before)


def test_only_noisy_frames_are_smoothed():
    scene = render_scene(shape=(360, 640), vehicles=2, random_state=1).image
    assert denoise(scene) is scene
    dark = noisy(12, 3)
    noise = estimate_noise(dark)
    assert noise > 6
    assert estimate_noise(denoise(dark)) < noise / 2


def test_smoothing_increases_with_noise():
    removed = []
    for deviation in (2.2, 2.6, 3.0):
        image = noisy(20, deviation, seed=3)
        assert 3 < estimate_noise(image) < 6
        smooth = denoise(image)
        removed.append(float(np.abs(smooth.astype(float) - image).mean()) / deviation)
    assert removed[0] < removed[1] < removed[2]


def test_the_search_uses_the_smoothed_frame():
    image = render_drive(frames=1, light="night", shape=(360, 640), random_state=7)[0].image
    assert estimate_noise(image) > 6
    model = load_model()
    search = MixtureSearch(model, n_jobs=1)
    found = search.find(image).vehicles
    smooth = denoise(image)
    min_margin = model.margin_of(0.0)
    boxes, margins, *_ = model.detect_vehicles(
        *search.score_windows(smooth, PyramidParams()), min_margin=min_margin
    )
    np.testing.assert_array_equal(found.boxes, boxes)
    np.testing.assert_array_equal(found.scores, model.scores(margins))
    boxes, *_ = model.detect_vehicles(*search.score_windows(image, PyramidParams()), min_margin=min_margin)
    assert not np.array_equal(found.boxes, boxes)


def test_the_estimate_is_the_median_of_a_difference_of_laplacians():
    image = np.random.default_rng(5).integers(0, 256, (60, 40, 3), dtype=np.uint8)
    roots = np.sqrt(255.0 * image[..., 1])
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])
    differences = [
        (roots[row - 1 : row + 2, column - 1 : column + 2] * kernel).sum()
        for row in (1, 25, 49)
        for column in range(1, 39, 2)
    ]
    assert estimate_noise(image) == pytest.approx(np.median(np.abs(differences)) / (6 * 0.6745), rel=1e-5)


@pytest.mark.parametrize(("noise", "weight"), [(3.0, 0.0), (4.5, 0.5), (6.0, 1.0), (9.0, 1.0)])
def test_the_weight_of_the_smoothing_depends_on_the_noise(monkeypatch, noise, weight):
    image = noisy(90, 9)
    monkeypatch.setitem(denoise.__globals__, "_noise_of", lambda differences: noise)
    smooth = cv2.GaussianBlur(image, (5, 5), 0.9).astype(float)
    np.testing.assert_allclose(denoise(image), weight * smooth + (1 - weight) * image, atol=0.51)


@pytest.mark.parametrize(("rows", "columns"), [(2, 40), (40, 2), (3, 40), (40, 3)])
def test_an_estimate_needs_three_rows_and_columns(rows, columns):
    image = np.random.default_rng(0).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    assert (estimate_noise(image) > 0) == (min(rows, columns) > 2)
