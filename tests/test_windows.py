import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_classifier
from vehicle_detection import FeatureParams, InvalidInputError, SearchParams, course
from vehicle_detection.windows import band_windows, search_windows, slide_window

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=4, pix_per_cell=16, hog_channel=0)
CLASSIFIER = random_classifier(SMALL)


def image_of(height, width, seed=0):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


IMAGE = image_of(120, 200)


def expected_windows(region, window, overlap):
    """All windows of a grid that fit into a region."""
    x1, y1, x2, y2 = region
    steps = [max(1, int(side * (1 - part) + 1e-9)) for side, part in zip(window, overlap)]
    return [
        [x, y, x + window[0], y + window[1]]
        for y in range(y1, y2 + 1, steps[1])
        for x in range(x1, x2 + 1, steps[0])
        if x + window[0] <= x2 and y + window[1] <= y2
    ]


@st.composite
def ranges(draw, size):
    start = draw(st.one_of(st.none(), st.integers(0, size - 1)))
    stop = draw(st.one_of(st.none(), st.integers((start or 0) + 1, size)))
    return start, stop


@given(ranges(90), ranges(60), st.tuples(*[st.integers(1, 70)] * 2), st.tuples(*[st.floats(0, 0.99)] * 2))
def test_every_window_that_fits_is_listed(x_range, y_range, window, overlap):
    image = np.zeros((60, 90, 3), np.uint8)
    found = slide_window(
        image, x_start_stop=x_range, y_start_stop=y_range, xy_window=window, xy_overlap=overlap
    )
    region = [x_range[0] or 0, y_range[0] or 0, x_range[1] or 90, y_range[1] or 60]
    assert found.dtype == np.int64
    assert found.shape == (len(found), 4)
    assert found.tolist() == expected_windows(region, window, overlap)
    assert (found[:, :2] >= region[:2]).all()
    assert (found[:, 2:] <= region[2:]).all()
    assert ((found[:, 2:] - found[:, :2]) == window).all()


def test_the_arguments_are_not_modified():
    x, y, window, overlap = [None, 100], [20, None], [32, 16], [0.5, 0.75]
    before = IMAGE.copy()
    slide_window(IMAGE, x_start_stop=x, y_start_stop=y, xy_window=window, xy_overlap=overlap)
    # The course's version replaces None in the caller's list.
    assert (x, y, window, overlap) == ([None, 100], [20, None], [32, 16], [0.5, 0.75])
    np.testing.assert_array_equal(IMAGE, before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x_start_stop": (-5, 100)}, r"x_start_stop must satisfy 0 <= start < stop <= 200; got \(-5, 100\)"),
        ({"y_start_stop": (60, 60)}, r"y_start_stop must satisfy 0 <= start < stop <= 120"),
        ({"y_start_stop": (400, None)}, r"y_start_stop must satisfy .*got \(400, 120\)"),
        ({"xy_overlap": (0.5, 1.0)}, r"xy_overlap\[1\] must be a number, at least 0 and at most 0.999"),
    ],
)
def test_slide_window_rejects_invalid_arguments(arguments, message):
    arguments = {"image": IMAGE, **arguments}
    with pytest.raises(InvalidInputError, match=message):
        slide_window(arguments.pop("image"), **arguments)


def test_the_window_list_of_the_first_system():
    image = np.zeros((720, 1280, 3), np.uint8)
    lists = [
        [
            function(image, x_start_stop=(650, None), y_start_stop=rows, xy_window=window, xy_overlap=overlap)
            for function in (slide_window, course.slide_window)
        ]
        for rows, window, overlap in [
            ((395, 530), (96, 96), (0.9, 0.5)),
            ((380, 590), (110, 145), (0.7, 0.6)),
            ((370, 590), (155, 165), (0.6, 0.5)),
            ((400, 700), (170, 200), (0.6, 0.5)),
        ]
    ]
    bands = SearchParams.preset("130-windows").place(image.shape)
    for (found, published), band in zip(lists, bands, strict=True):
        np.testing.assert_array_equal(found, band_windows(band))
        fits = [(x1, y1, x2, y2) for (x1, y1), (x2, y2) in published if x2 <= band.x2 and y2 <= band.y2]
        assert fits == [tuple(window) for window in found.tolist()]
    assert [len(published) for _, published in lists] == [69, 36, 9, 16]
    assert sum(len(found) for found, _ in lists) == 114


def test_scores_are_those_of_the_cropped_patches():
    windows = slide_window(IMAGE, xy_window=(50, 40), xy_overlap=(0.5, 0.5))
    found = search_windows(IMAGE, windows, CLASSIFIER, min_score=None)
    patches = [cv2.resize(IMAGE[y1:y2, x1:x2], (64, 64)) for x1, y1, x2, y2 in windows]
    np.testing.assert_array_equal(found.boxes, windows)
    np.testing.assert_array_equal(found.scores, CLASSIFIER.decision_function(np.stack(patches)))


def test_windows_above_the_minimum_score_are_returned():
    windows = slide_window(IMAGE, xy_window=(40, 40))
    every = search_windows(IMAGE, windows, CLASSIFIER, min_score=None)
    min_score = float(np.median(every.scores))
    some = search_windows(IMAGE, windows, CLASSIFIER, min_score=min_score)
    np.testing.assert_array_equal(some.boxes, windows[every.scores > min_score])
    default = search_windows(IMAGE, windows, CLASSIFIER)
    np.testing.assert_array_equal(default.boxes, windows[every.scores > 0])
    none = search_windows(IMAGE, slide_window(image_of(64, 63)), CLASSIFIER, min_score=None)
    assert none.boxes.shape == (0, 4)


@pytest.mark.parametrize(
    ("windows", "message"),
    [
        (
            [[0, 0, 64, 64], [150, 0, 214, 64]],
            r"windows\[1\] must .* inside the 200x120 image, got \[150, 0, 214, 64\]",
        ),
        ([[-1, 0, 63, 64]], r"windows\[0\] must .*; use slide_window, or clip_boxes"),
        ([[0, 80, 64, 144]], "inside the 200x120 image"),
        ([[10, 10, 10, 20]], "must be non-empty boxes"),
        ([[0, 0, 64, 64], [0, 0, 64.5, 64]], r"windows\[1\] must be whole pixels, .*; round them first"),
    ],
)
def test_search_windows_rejects_invalid_windows(windows, message):
    with pytest.raises(InvalidInputError, match=message):
        search_windows(IMAGE, windows, CLASSIFIER)
