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
