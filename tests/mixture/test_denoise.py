import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.mixture import MixtureSearch, load_model, without_noise
from vehicle_detection.mixture.denoise import noise_level
from vehicle_detection.params import PyramidParams
from vehicle_detection.synthetic import render_drive, render_scene


def noisy(value, deviation, shape=(240, 320), seed=0):
    values = value + np.random.default_rng(seed).normal(0, deviation, (*shape, 3))
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("value", "deviation"), [(128, 3), (128, 8), (40, 3), (200, 5)])
def test_the_level_is_that_of_the_square_roots(value, deviation):
    # The derivative of sqrt(255 * v) is sqrt(255 / v) / 2.
    expected = deviation * np.sqrt(255 / value) / 2
    assert noise_level(noisy(value, deviation)) == pytest.approx(expected, rel=0.1)


def test_what_the_image_shows_is_no_noise():
    rows, columns = np.mgrid[:240, :320]
    ramp = np.repeat((rows / 2 + columns / 4)[..., None], 3, axis=2).astype(np.uint8)
    assert noise_level(ramp) < 1
    boxes = np.full((240, 320, 3), 90, np.uint8)
    boxes[50:90, 60:200], boxes[120:180, 40:90] = 20, 240
    assert noise_level(boxes) == 0


@given(height=st.integers(1, 9), width=st.integers(1, 9), seed=st.integers(0, 99))
def test_images_of_any_size(height, width, seed):
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    before = image.copy()
    assert noise_level(image) >= 0
    smooth = without_noise(image)
    assert smooth.shape == image.shape
    assert smooth.dtype == np.uint8
    np.testing.assert_array_equal(image, before)


def test_only_noisy_frames_are_smoothed():
    scene = render_scene(shape=(360, 640), vehicles=2, random_state=1).image
    assert without_noise(scene) is scene
    dark = noisy(12, 3)
    level = noise_level(dark)
    assert level > 6
    assert noise_level(without_noise(dark)) < level / 2


def test_more_noise_is_smoothed_more():
    removed = []
    for deviation in (2.2, 2.6, 3.0):
        image = noisy(20, deviation, seed=3)
        assert 3 < noise_level(image) < 6
        smooth = without_noise(image)
        removed.append(float(np.abs(smooth.astype(float) - image).mean()) / deviation)
    assert removed[0] < removed[1] < removed[2]


def test_the_search_looks_at_the_smoothed_frame():
    image = render_drive(frames=1, light="night", shape=(360, 640), random_state=7)[0].image
    assert noise_level(image) > 6
    model = load_model()
    search = MixtureSearch(model, n_jobs=1)
    found = search.find(image).vehicles
    smooth = without_noise(image)
    boxes, values = model.detect_vehicles(
        smooth, search.score_windows(smooth, PyramidParams()), min_margin=model.margin_of(0.0)
    )
    np.testing.assert_array_equal(found.boxes, boxes)
    np.testing.assert_array_equal(found.scores, model.scores(values))
    boxes, _ = model.detect_vehicles(
        image, search.score_windows(image, PyramidParams()), min_margin=model.margin_of(0.0)
    )
    assert not np.array_equal(found.boxes, boxes)
