import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.network import InputFormat, fit_input

SIDES = st.integers(1, 20_000)


@given(SIDES, SIDES, st.integers(1, 40), st.sampled_from([32, 64]))
def test_the_input_holds_the_frame_with_its_aspect_ratio(height, width, steps, multiple):
    size = steps * multiple
    scaled, padded = fit_input((height, width), size, multiple)
    assert all(0 < inner <= outer < inner + multiple for inner, outer in zip(scaled, padded))
    assert all(side % multiple == 0 for side in padded)
    assert max(padded) <= max(size, multiple)
    factors = [inner / side for inner, side in zip(scaled, (height, width))]
    # Whole pixels, at least one, and 3% to avoid padding.
    short, long = np.argsort((height, width), kind="stable")
    exact = (height, width)[short] * factors[long]
    assert abs(scaled[short] - exact) <= max(0.5, 0.03 * exact, 1 - exact) + 1e-6
    assert factors[long] <= 2.06


@pytest.mark.parametrize("shape", [(720, 1280), (721, 1279), (480, 640), (60, 100), (3000, 4000), (1, 9000)])
def test_a_frame_is_resized_as_by_areas(shape):
    rng = np.random.default_rng(0)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (*shape, 3), dtype=np.uint8), (0, 0), 4)
    array, (height, width) = InputFormat(None, "uint8", False).prepare(frame, 640)
    method = cv2.INTER_AREA if shape[1] > width else cv2.INTER_LINEAR
    expected = cv2.resize(frame, (width, height), interpolation=method)
    assert np.abs(array[0, :height, :width].astype(int) - expected).max() <= 5
    assert (array[0, height:] == 114).all()
    assert (array[0, :, width:] == 114).all()


@pytest.mark.parametrize("dtype", ["uint8", "float32", "float16"])
@pytest.mark.parametrize("channels_first", [True, False])
@pytest.mark.parametrize("bgr", [True, False])
@pytest.mark.parametrize("scaled", [True, False])
def test_layouts(dtype, channels_first, bgr, scaled):
    frame = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    network = InputFormat((64, 96), dtype, channels_first, bgr=bgr, scaled=scaled)
    array, _ = network.prepare(frame, 96)
    assert array.dtype == dtype
    image = array[0].transpose(1, 2, 0) if channels_first else array[0]
    image = image[..., ::-1] if bgr else image
    expected = frame / 255 if scaled and dtype != "uint8" else frame
    np.testing.assert_allclose(image, expected, rtol=1e-3)


def test_a_fixed_size_pads_or_stretches():
    frame = np.zeros((50, 100, 3), np.uint8)
    array, scaled = InputFormat((64, 64), "uint8", False).prepare(frame, 64)
    assert scaled == (32, 64)
    assert (array[0, 32:] == 114).all()
    array, scaled = InputFormat((64, 64), "uint8", False, stretch=True).prepare(frame, 64)
    assert scaled == (64, 64)
    assert not array.any()


FACTORS = {(720, 1280): 2, (1080, 1920): 3, (2160, 3840): 6, (1920, 1080): 3, (540, 960): 1, (721, 1281): 1}


@pytest.mark.parametrize(("shape", "factor"), FACTORS.items())
def test_a_reduced_frame_gives_the_same_input(shape, factor):
    network = InputFormat(None, "uint8", False)
    assert network.reduction(shape, 640) == factor
    frame = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    reduced = cv2.resize(frame, (shape[1] // factor, shape[0] // factor), interpolation=cv2.INTER_AREA)
    expected, scaled = network.prepare(frame, 640)
    found, also_scaled = network.prepare(reduced, 640)
    assert scaled == also_scaled
    np.testing.assert_array_equal(found, expected)
