import numpy as np
import pytest

from tests.features.cases import BLANK, PATCHES
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import (
    convert_color,
)
from vehicle_detection.params import COLOR_SPACES


@pytest.mark.parametrize("color_space", COLOR_SPACES)
def test_convert_color(color_space):
    patch = PATCHES[0]
    before = patch.copy()
    converted = convert_color(patch, color_space)
    assert converted.shape == patch.shape
    assert converted.dtype == np.uint8
    assert not np.shares_memory(converted, patch)
    np.testing.assert_array_equal(convert_color(patch, f"RGB2{color_space}"), converted)
    out = np.empty_like(patch)
    assert np.shares_memory(convert_color(patch, color_space, out=out), out)
    np.testing.assert_array_equal(out, converted)
    np.testing.assert_array_equal(patch, before)
    # Converting a view gives the view of the converted image.
    np.testing.assert_array_equal(convert_color(patch[8:40, ::-2], color_space), converted[8:40, ::-2])


def test_red_in_each_color_space():
    red = np.full((1, 1, 3), (255, 0, 0), np.uint8)
    assert convert_color(red, "HSV")[0, 0].tolist() == [0, 255, 255]
    assert convert_color(red, "HLS")[0, 0].tolist() == [0, 128, 255]
    assert convert_color(red, "YCrCb")[0, 0].tolist() == [76, 255, 85]
    assert convert_color(red, "RGB")[0, 0].tolist() == [255, 0, 0]


def test_invalid_arguments_of_convert_color():
    with pytest.raises(InvalidInputError, match=r"color_space must be one of 'RGB', .*; got 'BGR'"):
        convert_color(BLANK, "BGR")
    with pytest.raises(InvalidInputError, match="image must be an"):
        convert_color(BLANK / 255)
