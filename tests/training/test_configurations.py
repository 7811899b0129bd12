import numpy as np
import pytest

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training import expand_grid, parse_grid


def test_parse_grid():
    text = "orient=8,9 color_space=YCrCb,LAB  hog_channel=ALL,0 C=1e-4,1 mirror=true,no"
    grid = parse_grid(text)
    assert grid == {
        "orient": [8, 9],
        "color_space": ["YCrCb", "LAB"],
        "hog_channel": ["ALL", 0],
        "C": [1e-4, 1],
        "mirror": [True, False],
    }
    assert len(expand_grid(grid)) == 32


def test_expand_grid_accepts_arrays_and_tuples():
    assert list(expand_grid({"orient": np.arange(8, 10), "C": (1,)})) == [
        {"orient": 8, "C": 1},
        {"orient": 9, "C": 1},
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "grid is empty; name at least one option"),
        ("orient", "grid must look like 'orient=8,9 .* got 'orient'"),
        ("orient=8, 9", "got 'orient=8,'"),
        ("=8", "got '=8'"),
        ("orient=8 orient=9", "grid names orient twice"),
        ("color=LAB", "grid has the unknown option 'color'"),
    ],
)
def test_invalid_text_of_a_grid(text, message):
    with pytest.raises(InvalidInputError, match=message):
        parse_grid(text)
