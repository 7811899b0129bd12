import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.mixture import prepare, reduce_haze
from vehicle_detection.mixture.haze import relative_contrast
from vehicle_detection.synthetic import render_drive, render_scene

SCENE = render_scene(shape=(360, 640), vehicles=3, random_state=1).image


@pytest.mark.parametrize("options", [{}, {"light": "dusk"}, {"light": "night"}, {"rain": 0.6}])
def test_clear_frames_stay_as_they_are(options):
    frame = render_drive(frames=2, random_state=3, **options)[0].image
    assert relative_contrast(frame) > 0.03
    assert reduce_haze(frame) is frame


def test_hazy_frames_gain_contrast():
    hazy = np.round(0.15 * SCENE + 0.85 * 180).astype(np.uint8)
    clearer = reduce_haze(hazy)
    assert relative_contrast(hazy) < 0.02
    assert relative_contrast(clearer) > 1.4 * relative_contrast(hazy)
    np.testing.assert_array_equal(prepare(hazy), clearer)


def test_the_effect_begins_gradually():
    gains = []
    for passed in 1.0, 0.78, 0.7, 0.6, 0.5:
        hazy = np.round(passed * SCENE + (1 - passed) * 180).astype(np.uint8)
        gains.append(relative_contrast(reduce_haze(hazy)) / relative_contrast(hazy))
    assert gains[0] == 1
    assert gains == sorted(gains)
    assert max(np.diff(gains)) < 0.8


def test_a_brighter_exposure_is_not_haze():
    dark = (SCENE // 2).astype(np.uint8)
    assert relative_contrast(dark) == pytest.approx(relative_contrast(SCENE), rel=0.1)


@given(height=st.integers(1, 40), width=st.integers(1, 200), seed=st.integers(0, 99))
def test_images_of_any_size(height, width, seed):
    image = np.random.default_rng(seed).integers(150, 154, (height, width, 3), dtype=np.uint8)
    before = image.copy()
    result = reduce_haze(image)
    assert (result.shape, result.dtype) == (image.shape, np.uint8)
    np.testing.assert_array_equal(image, before)
    np.testing.assert_array_equal(result, reduce_haze(image))


@pytest.mark.parametrize("width", [160, 480, 500])
def test_the_contrast_is_that_of_blocks_in_every_sixteenth_row(width):
    image = np.random.default_rng(2).integers(0, 256, (50, width, 3), dtype=np.uint8)
    size = width // 160
    means = [
        [float(image[row, start : start + size, 1].mean()) for start in range(0, width - size + 1, size)]
        for row in (8, 24, 40)
    ]
    expected = np.abs(np.diff(means, axis=1)).mean() / (np.mean(means) + 1)
    assert relative_contrast(image) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("shape", [(8, 200, 3), (40, 1, 3)])
def test_an_image_too_small_to_tell_is_clear(shape):
    image = np.full(shape, 200, np.uint8)
    assert relative_contrast(image) == 1
    assert reduce_haze(image) is image


def test_two_columns_suffice_to_tell():
    image = np.zeros((40, 2, 3), np.uint8)
    image[:, 0], image[:, 1] = 100, 200
    assert relative_contrast(image) == pytest.approx(100 / 151)


@pytest.mark.parametrize(("contrast", "weight"), [(0.03, 0.0), (0.025, 0.5), (0.02, 1.0), (0.01, 1.0)])
def test_the_weight_of_the_equalization_depends_on_the_contrast(monkeypatch, contrast, weight):
    hazy = np.round(0.15 * SCENE + 0.85 * 180).astype(np.uint8)
    monkeypatch.setattr("vehicle_detection.mixture.haze.relative_contrast", lambda image: contrast)
    lab = cv2.cvtColor(hazy, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(2.0, (8, 8)).apply(lab[..., 0])
    equalized = cv2.cvtColor(lab, cv2.COLOR_LAB2RGB).astype(float)
    expected = weight * equalized + (1 - weight) * hazy
    np.testing.assert_allclose(reduce_haze(hazy), expected, atol=0.51)
    assert (reduce_haze(hazy) is hazy) == (weight == 0)
