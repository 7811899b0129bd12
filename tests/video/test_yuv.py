"""Conversion of frames to planes and back."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.video.yuv import (
    ColorEncoding,
    DecodedFrame,
    PlanarFrame,
    planes_from_rgb,
    rgb_from_planes,
)

VALUES = st.integers(0, 255)
SIZES = st.integers(1, 9)


def planes_of(frame):
    height, width = (side + side % 2 for side in frame.shape[:2])
    planes = np.empty((height * 3 // 2, width), np.uint8)
    planes_from_rgb(frame, planes)
    return planes


@given(SIZES, SIZES, VALUES, VALUES, VALUES)
def test_planes_have_the_values_of_bt601(half_height, half_width, red, green, blue):
    planes = planes_of(np.full((half_height * 2, half_width * 2, 3), (red, green, blue), np.uint8))
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    expected = (
        16 + 219 / 255 * luma,
        128 + 224 / 255 * (blue - luma) / 1.772,
        128 + 224 / 255 * (red - luma) / 1.402,
    )
    count = half_height * half_width
    values = planes.reshape(-1)
    for plane, level in zip(np.split(values, [4 * count, 5 * count]), expected, strict=True):
        assert np.abs(plane - level).max() <= 0.6


@given(VALUES, VALUES, VALUES, st.sampled_from(["unknown", "bt470bg", "bt709", "bt2020nc"]), st.booleans())
def test_frames_follow_the_formula_of_their_encoding(luma, blue, red, space, full):
    planes = np.array([[luma] * 2] * 2 + [[blue, red]], np.uint8)
    frame = rgb_from_planes(planes, ColorEncoding(space, full))
    kr, kb = {"bt709": (0.2126, 0.0722), "bt2020nc": (0.2627, 0.0593)}.get(space, (0.299, 0.114))
    if space in ("unknown", "bt470bg") and not full:
        luma = max(luma, 16)
    y = luma / 255 if full else (luma - 16) / 219
    u, v = ((value - 128) / (255 if full else 224) for value in (blue, red))
    r, b = y + 2 * (1 - kr) * v, y + 2 * (1 - kb) * u
    g = (y - kr * r - kb * b) / (1 - kr - kb)
    expected = 255 * np.clip([r, g, b], 0, 1)
    assert np.abs(frame.reshape(4, 3) - expected).max() <= 0.6


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_gray_is_unchanged_after_both_conversions(height, width, seed):
    gray = np.random.default_rng(seed).integers(0, 256, (height, width, 1), np.uint8).repeat(3, axis=2)
    back = rgb_from_planes(planes_of(gray), ColorEncoding())
    assert np.abs(back[:height, :width].astype(int) - gray).max() <= 2
    # Odd sides are extended by their last column or row.
    assert (back[height:] == back[height - 1 : height]).all()
    assert (back[:, width:] == back[:, width - 1 : width]).all()


def test_thin_lines_keep_their_color():
    # The color of only one pixel of four would be pure red or black.
    lines = np.zeros((16, 16, 3), np.uint8)
    lines[:, 1::2] = (255, 0, 0)
    assert planes_of(lines)[16:].reshape(2, 8, 8)[1].mean() == pytest.approx(128 + 112 / 2, abs=1.5)


def test_an_encoding_knows_whether_it_is_supported():
    assert ColorEncoding("bt709").supported
    assert not ColorEncoding("ycgco").supported


def frames_of(seed, space, factor=2, cells=(12, 20)):
    """A frame of smooth colors as planes and as RGB."""
    height, width = (2 * factor * side for side in cells)
    coarse = np.random.default_rng(seed).integers(40, 210, (4, 6, 3), np.uint8)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return PlanarFrame(planes_of(smooth), ColorEncoding(space))


@pytest.mark.parametrize("space", ["unknown", "bt709"])
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_reduced_planes_equal_the_reduced_frame(space, factor):
    frame = frames_of(1, space, factor)
    error = np.abs(frame.reduced(factor).astype(int) - DecodedFrame(frame.rgb()).reduced(factor))
    assert error.max() <= 4
    assert error.mean() <= 1


@pytest.mark.parametrize("space", ["unknown", "bt709"])
def test_samples_of_planes_are_pixels_of_the_frame(space):
    frame = frames_of(2, space)
    expected = DecodedFrame(frame.rgb()).sampled((9, 16))
    assert np.abs(frame.sampled((9, 16)).astype(int) - expected).max() <= 1
