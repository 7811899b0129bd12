import dataclasses
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import random_classifier
from tests.search_reference import score_windows
from vehicle_detection import InvalidInputError, VehicleClassifier, find_cars, search_windows, slide_window
from vehicle_detection.features import COLOR_SPACES, FeatureParams
from vehicle_detection.search import PixelBand, SearchBand, SearchParams, resize_band, resized_shape
from vehicle_detection.training import to_pipeline

PRESETS = sorted(FeatureParams.PRESETS)
TOLERANCE = 1e-4
SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=6, pix_per_cell=16, hog_channel=0)


def textured(height, width, seed=0):
    """An image of random boxes, smooth variation and noise."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 110, float)
    for _ in range(40):
        x, y = rng.integers(0, width), rng.integers(0, height)
        w, h = rng.integers(4, max(5, width // 3)), rng.integers(4, max(5, height // 3))
        image[y : y + h, x : x + w] = rng.integers(0, 256, 3)
    image += cv2.resize(rng.normal(0, 30, (height // 8 + 1, width // 8 + 1, 3)), (width, height))
    image += rng.normal(0, 8, image.shape)
    return image.clip(0, 255).astype(np.uint8)


IMAGE = textured(220, 330)


def reference_map(image, band, classifier):
    """Scores of all windows of a band at a step of one cell, by the reference."""
    resized = resize_band(image, band)
    cell = classifier.params.pix_per_cell
    windows = slide_window(resized, xy_overlap=(1 - cell / 64,) * 2)
    scores = score_windows(resized, windows, classifier)
    height, width = resized.shape[:2]
    return scores.reshape(height // cell - 64 // cell + 1, width // cell - 64 // cell + 1)


def assert_equals_the_reference(image, band, classifier):
    with classifier.open_search(1) as search:
        scores = search.score_map(image, band)
    expected = reference_map(image, band, classifier)
    assert scores.dtype == np.float32
    assert scores.shape == expected.shape
    assert scores.size == 1 or expected.std() > 0
    np.testing.assert_allclose(scores, expected, rtol=0, atol=TOLERANCE)


def band_of(window, *, x=(0, 330), y=(20, 220), step=(8, 8)):
    return PixelBand(x[0], y[0], x[1], y[1], window, step)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("window", [(96, 96), (64, 64), (51, 51)])
def test_presets_equal_the_reference(preset, window):
    # A band of two window heights keeps the reference fast.
    band = band_of(window, x=(10, 250), y=(30, 30 + 2 * window[1]))
    assert_equals_the_reference(IMAGE, band, random_classifier(FeatureParams.preset(preset)))


@pytest.mark.parametrize(
    "changes",
    [
        {"pix_per_cell": 16}, {"pix_per_cell": 16, "cell_per_block": 3, "spatial_size": 8},
        {"pix_per_cell": 64, "cell_per_block": 1, "spatial_size": 1},
        {"pix_per_cell": 4, "cell_per_block": 4, "orient": 4, "hog_channel": 1},
        *({"cell_per_block": block} for block in (1, 3)),
        {"cell_per_block": 8, "orient": 3, "hog_channel": 0},
        *({"hog_channel": channel} for channel in ("GRAY", 0, 1, 2)),
        {"hog_channel": "GRAY", "transform_sqrt": True, "color_space": "HSV"},
        *({"orient": orient} for orient in (1, 4, 12)),
        *({part: False} for part in ("spatial_feat", "hist_feat", "hog_feat")),
        {"spatial_feat": False, "hist_feat": False}, {"hist_feat": False, "hog_feat": False},
        *({"hist_bins": bins} for bins in (1, 20, 256)), *({"spatial_size": size} for size in (8, 32, 64)),
        *({"color_space": space} for space in COLOR_SPACES), {"coarse_hog": True},
        {"coarse_hog": True, "hog_channel": "GRAY", "transform_sqrt": True},
        {"coarse_hog": True, "cell_per_block": 1, "orient": 8},
        {"coarse_hog": True, "pix_per_cell": 4, "cell_per_block": 3, "hog_channel": 0},
        {"coarse_hog": True, "pix_per_cell": 32, "cell_per_block": 1, "spatial_size": 2},
        {"hist_sqrt": True, "hist_bins": 20, "pix_per_cell": 16},
        {"hist_sqrt": True, "pix_per_cell": 4, "hog_channel": 0},
        {"hist_sqrt": True, "pix_per_cell": 64, "cell_per_block": 1, "spatial_size": 1},
        {"hist_sqrt": True, "coarse_hog": True, "color_space": "HSV", "spatial_feat": False},
        {"spatial_order": "interleaved", "spatial_size": 32, "pix_per_cell": 16},
        {"spatial_color_space": "RGB", "hist_color_space": "HSV"},
        {"spatial_color_space": "HLS", "spatial_order": "interleaved", "hog_channel": "GRAY"},
        {"hist_color_space": "LUV", "hist_sqrt": True, "hog_channel": 0},
    ],
    ids=str,
)  # fmt: skip
def test_other_features_equal_the_reference(changes):
    classifier = random_classifier(dataclasses.replace(FeatureParams(), **changes))
    assert_equals_the_reference(IMAGE, band_of((80, 80), x=(5, 213), y=(40, 152)), classifier)


@pytest.mark.parametrize("height", range(64, 74))
def test_bands_of_any_height(height):
    # Rows below the last whole cell still affect the gradients of the cell above them.
    band = band_of((64, 64), x=(3, 3 + height + 17), y=(11, 11 + height))
    assert_equals_the_reference(IMAGE, band, random_classifier(FeatureParams(hog_channel=0)))


@pytest.mark.parametrize("preset", PRESETS)
def test_columns_beyond_the_frame_are_replicated(preset):
    classifier = random_classifier(FeatureParams.preset(preset))
    band = PixelBand(-32, 50, 330 + 32, 130, (64, 64), (8, 8))
    assert_equals_the_reference(IMAGE, band, classifier)
    padded = np.concatenate([IMAGE[:, :1].repeat(32, 1), IMAGE, IMAGE[:, -1:].repeat(32, 1)], axis=1)
    np.testing.assert_array_equal(resize_band(IMAGE, band), padded[50:130])


@given(
    st.tuples(st.integers(30, 120), st.integers(30, 120)),
    st.tuples(st.integers(-40, 150), st.integers(0, 80)),
    st.tuples(st.integers(0, 60), st.integers(0, 30)),
    st.integers(0, 5),
)
@settings(max_examples=20)
def test_any_band_equals_the_reference(window, corner, more, seed):
    x1, y1 = corner
    x2, y2 = x1 + window[0] + more[0], min(y1 + window[1] + more[1], 220)
    band = PixelBand(x1, y1, x2, y2, window, (8, 8))
    classifier = random_classifier(FeatureParams(hog_channel=0, spatial_size=8), seed)
    if y2 - y1 >= window[1]:
        assert_equals_the_reference(IMAGE, band, classifier)


@pytest.mark.parametrize("preset", ["ycrcb-6156", "luv-2384", "lab-9432"])
def test_two_templates_give_the_maximum_score(preset):
    params = FeatureParams.preset(preset)
    both = random_classifier(params, 3, templates=2, bias=0.3)
    band = band_of((80, 80), x=(0, 250), y=(30, 140))
    assert_equals_the_reference(IMAGE, band, both)
    alone = []
    for template in both.templates:
        with VehicleClassifier(params, (template,)).open_search(1) as search:
            alone.append(search.score_map(IMAGE, band))
    with both.open_search(1) as search:
        np.testing.assert_allclose(search.score_map(IMAGE, band), np.maximum(*alone), atol=1e-6)
    assert (alone[0] > alone[1]).any()
    assert (alone[0] < alone[1]).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pix_per_cell": 7}, "whole HOG cells in a window of 64 pixels, got pix_per_cell=7"),
        ({"spatial_size": 20}, "whole spatial bins in a cell of 8 pixels, got spatial_size=20"),
        ({"spatial_size": 4}, "spatial_size=4; use search_windows"),
        ({"spatial_size": 24}, "spatial_size=24"),
        ({"spatial_size": 8, "pix_per_cell": 4}, "spatial bins in a cell of 4 pixels, got spatial_size=8"),
    ],
)
def test_features_that_windows_cannot_share_are_rejected(changes, message):
    classifier = random_classifier(dataclasses.replace(FeatureParams(), **changes))
    params = SearchParams.preset("three-scales")
    with pytest.raises(InvalidInputError, match=message):
        find_cars(np.zeros((720, 1280, 3), np.uint8), classifier, params)
    # The reference search accepts them.
    assert len(search_windows(IMAGE, [[0, 0, 64, 64]], classifier, min_score=None)) == 1


def small_params(**changes):
    """Parameters with three bands for a frame of 330x220 and windows of 64, 42 and 96 pixels."""
    bands = tuple(
        SearchBand(window=(side * 1280 / 330,) * 2, y=(-400, 400), overlap=(0.8, 0.8))
        for side in (64, 42, 96)
    )
    return SearchParams(bands=bands, horizon=0.5, **changes)


@pytest.mark.parametrize("params", [SMALL, FeatureParams.preset("ycrcb-8460")], ids=["small", "8460"])
@pytest.mark.parametrize("templates", [1, 2])
def test_threads_and_strides_do_not_change_the_result(params, templates):
    classifier = random_classifier(params, 2, templates=templates)
    search, image = small_params(horizontal_padding=0.3), IMAGE.copy()
    one = find_cars(image, classifier, search, jobs=1)
    assert len(one) > 10
    turned = np.ascontiguousarray(IMAGE[:, ::-1])[:, ::-1]
    for jobs, same in ((2, image), (3, image), (2, turned)):
        found = find_cars(same, classifier, search, jobs=jobs)
        np.testing.assert_array_equal(found.boxes, one.boxes)
        np.testing.assert_array_equal(found.scores, one.scores)
    np.testing.assert_array_equal(image, IMAGE)


def test_many_threads_can_use_one_search(monkeypatch):
    before = set(threading.enumerate())
    opened = []

    class SlowExecutor(ThreadPoolExecutor):
        def __init__(self, *arguments, **options):
            opened.append(self)
            time.sleep(0.02)
            super().__init__(*arguments, **options)

    monkeypatch.setattr("vehicle_detection._common.threads.ThreadPoolExecutor", SlowExecutor)
    classifier = random_classifier(SMALL)
    search = small_params()
    images = [textured(220, 330, seed) for seed in range(8)]
    fresh = [find_cars(image, classifier, search, jobs=1) for image in images]
    with classifier.open_search(2) as bands, ThreadPoolExecutor(8) as callers:
        together = threading.Barrier(8)

        def find(image):
            together.wait(60)
            return bands.find_windows(image, search)

        for found, expected in zip(callers.map(find, images), fresh):
            np.testing.assert_array_equal(found.scores, expected.scores)
            np.testing.assert_array_equal(found.boxes, expected.boxes)
    assert len(opened) == 1
    started = set(threading.enumerate()) - before
    assert not [thread for thread in started if thread.name.startswith("search")]


@given(
    st.tuples(st.integers(120, 500), st.integers(120, 900)),
    st.tuples(st.floats(64, 300), st.floats(64, 300)),
    st.tuples(st.floats(0, 0.95), st.floats(0, 0.95)),
    st.floats(0, 0.5),
)
@settings(max_examples=30)
def test_windows_are_inside_the_band_and_have_its_window_size(shape, window, overlap, horizontal_padding):
    band = SearchBand(window=window, y=(-300, 300), overlap=overlap)
    search = SearchParams(bands=(band,), horizon=0.5, min_score=-1e6, horizontal_padding=horizontal_padding)
    try:
        (placed,) = search.place(shape)
    except InvalidInputError:
        return
    classifier = random_classifier(FeatureParams(hog_feat=False, hist_feat=False, spatial_size=8))
    found = find_cars(np.zeros((*shape, 3), np.uint8), classifier, search, jobs=1)
    assert len(found) >= 1
    slack = 1e-9 * max(shape)
    assert (found.boxes[:, :2] >= (placed.x1 - slack, placed.y1 - slack)).all()
    assert (found.boxes[:, 2:] <= (placed.x2 + slack, placed.y2 + slack)).all()
    assert found.boxes[0, :2].tolist() == [placed.x1, placed.y1]
    # The band is resized to whole pixels, which changes the window size by up to half a pixel of the band.
    height, width = resized_shape(placed)
    off = np.abs(found.boxes[:, 2:] - found.boxes[:, :2] - placed.window) / placed.window
    assert (off <= (0.51 / width, 0.51 / height)).all() or min(height, width) == 64
    # Steps are rounded to whole cells, at least one.
    for axis in (0, 1):
        starts = np.unique(found.boxes[:, axis])
        if len(starts) > 1:
            cell = 8 * ((placed.x2 - placed.x1) / width if axis == 0 else (placed.y2 - placed.y1) / height)
            cells = np.diff(starts) / cell
            expected = max(1, round(placed.step[axis] / cell))
            np.testing.assert_allclose(cells, expected, rtol=1e-6)


def test_the_three_scales_have_11580_windows():
    search = dataclasses.replace(SearchParams.preset("three-scales"), min_score=-1e6)
    classifier = random_classifier(FeatureParams(hog_feat=False, hist_feat=False, spatial_size=8))
    found = find_cars(np.zeros((720, 1280, 3), np.uint8), classifier, search)
    assert len(found) == 11_580
    # The order is by band and row.
    sizes = (found.boxes[:, 2] - found.boxes[:, 0]).round()
    assert [int((sizes == side).sum()) for side in (96, 64, 51)] == [1386, 3825, 6369]
    first = found.boxes[:1386]
    assert (np.lexsort((first[:, 0], first[:, 1])) == np.arange(1386)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": IMAGE[:40, :40]}, "image of 40x40 pixels holds no search window .*; pass a larger image"),
        ({"classifier": to_pipeline(random_classifier(SMALL))}, "classifier must be a VehicleClassifier"),
    ],
)
def test_find_cars_rejects_invalid_arguments(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        find_cars(**{"image": IMAGE, "classifier": random_classifier(SMALL), **arguments})
