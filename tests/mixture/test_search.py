import dataclasses

import numpy as np
import pytest

from tests.helpers import mixture_template, random_mixture
from vehicle_detection import VehicleDetector
from vehicle_detection.boxes import box_areas, clip_boxes
from vehicle_detection.classifier import load_classifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import (
    CellGrid,
    EdgePyramid,
    MixtureSearch,
    TemplateMixture,
    frame_grid,
    load_model,
)
from vehicle_detection.mixture.search import _MAX_WINDOWS, _cell_rows, _row_range
from vehicle_detection.params import HeatParams, PyramidParams, SearchParams
from vehicle_detection.search import find_cars
from vehicle_detection.synthetic import render_scene

ROAD = render_scene(shape=(360, 640), vehicles=3, random_state=5).image


def search_once(model, image, params=None, n_jobs=1):
    with MixtureSearch(model, n_jobs=n_jobs) as search:
        return search.find(image, params)


@pytest.mark.parametrize("params", [None, PyramidParams(horizon=0.56), PyramidParams(per_octave=3)])
def test_the_result_does_not_depend_on_threads(params):
    model = random_mixture()
    one, *others = (search_once(model, ROAD, params, n_jobs) for n_jobs in (1, 2, 3))
    assert len(one.windows) > 100
    assert len(one.vehicles) > 5
    for other in others:
        for name in ("windows", "vehicles"):
            np.testing.assert_array_equal(getattr(one, name).boxes, getattr(other, name).boxes)
            np.testing.assert_array_equal(getattr(one, name).scores, getattr(other, name).scores)


@pytest.mark.parametrize(
    "shape",
    [
        *[(1, 1), (1, 700), (700, 1), (5, 9), (20, 30), (40, 40), (64, 48), (97, 31), (31, 300), (30, 1500)],
        *[(375, 1242), (360, 480), (540, 960), (640, 360)],
    ],
)
def test_frames_of_any_size(shape):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    for params in (None, PyramidParams(horizon=0.5), PyramidParams(horizon=0.0), PyramidParams(horizon=1.0)):
        found = search_once(random_mixture(), image, params)
        boxes = found.vehicles.boxes
        assert (boxes[:, :2] >= 0).all()
        assert (boxes[:, 2:] <= (shape[1], shape[0])).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all()
        windows = found.windows.boxes
        inside = clip_boxes(windows, shape)
        assert (box_areas(inside) > 0.3 * box_areas(windows)).all()
        assert (np.diff(found.windows.scores) <= 0).all()
        assert (np.diff(found.vehicles.scores) <= 0).all()
        if min(shape) < 32:
            assert not len(found.windows) or min(shape) > 20


def test_windows_have_the_requested_sizes():
    params = PyramidParams(min_width=50, max_height=0.5, min_score=-3.0)
    boxes = search_once(random_mixture(), ROAD, params).windows.boxes
    width, height = (boxes[:, 2:] - boxes[:, :2]).T
    # Frames are resized to whole pixels, which changes the size of windows by up to two percent.
    assert width.min() > 49
    assert height.max() < 0.51 * 360


def test_minimum_score_and_threshold():
    model = random_mixture(slope=2.0, offset=-0.5, threshold=0.3)
    found = search_once(model, ROAD, PyramidParams(min_score=-1.8))
    assert found.windows.scores.min() >= -1.8
    assert found.vehicles.scores.min() >= 0
    plain = search_once(random_mixture(), ROAD, PyramidParams(min_score=-0.9))
    # The scores of windows depend on the slope only, those of boxes are log-odds above the threshold.
    np.testing.assert_array_equal(plain.windows.boxes, found.windows.boxes)
    np.testing.assert_allclose(2 * plain.windows.scores, found.windows.scores)
    above = 2 * plain.vehicles.scores - 0.5 - 0.3
    np.testing.assert_allclose(above[above >= 0], found.vehicles.scores)


@pytest.mark.parametrize("horizon", [0.3, 0.5, 0.62])
def test_a_known_horizon_limits_the_positions_of_vehicles(horizon):
    model = TemplateMixture((mixture_template(bias=0.5),))
    params = PyramidParams(horizon=horizon, min_width=40, min_score=-3.0)
    boxes = search_once(model, ROAD, params).windows.boxes
    # Truncated windows may be anywhere at the frame's border.
    boxes = boxes[(boxes[:, 1] >= 0) & (boxes[:, 3] <= 360)]
    assert len(boxes) > 100
    width, bottom = boxes[:, 2] - boxes[:, 0], boxes[:, 3]
    slack, cell = 360 * params.horizon_tolerance, width / 7
    low, high = (camera_height * width / 1.8 + horizon * 360 for camera_height in params.camera_height_m)
    assert (bottom >= low - slack - 2 * cell).all()
    assert (bottom <= high + slack + 2 * cell).all()


def test_windows_of_a_border_template_end_at_the_border():
    model = dataclasses.replace(
        random_mixture(),
        templates=(mixture_template(bias=-0.5), mixture_template(5, 6, seed=4, bias=1.0, border=True)),
    )
    search = MixtureSearch(model, n_jobs=1)
    _, found = search.score_windows(ROAD, PyramidParams())
    at_border = found.boxes[found.templates == 1]
    assert (at_border[:, 0] == 0).any()
    assert (at_border[:, 2] == 640).any()
    assert ((at_border[:, 0] == 0) | (at_border[:, 2] == 640)).all()
    # It does not change the sizes at which the other template is searched.
    alone = dataclasses.replace(model, templates=model.templates[:1])
    _, expected = MixtureSearch(alone, n_jobs=1).score_windows(ROAD, PyramidParams())
    others = found.boxes[found.templates == 0]
    np.testing.assert_array_equal(others, expected.boxes[: len(others)])


def test_margins_of_windows_at_a_border_are_those_of_the_strip():
    template = mixture_template(5, 6, seed=4, bias=1.0, border=True)
    model = dataclasses.replace(random_mixture(), templates=(mixture_template(bias=-0.5), template))
    _, found = MixtureSearch(model, n_jobs=1).score_windows(ROAD, PyramidParams())
    pyramid = EdgePyramid(ROAD)
    at_border = found[found.templates == 1]
    for border_x, column in ((0, 0), (640, 2)):
        windows = at_border[at_border.boxes[:, column] == border_x]
        assert len(windows) > 5
        for box, margin in zip(windows.boxes[:5], windows.margins):
            size = (box[3] - box[1]) / 4  # the box has 4 rows, and one more on each side
            grid = frame_grid(size, ROAD.shape)
            grid = CellGrid(grid.left, box[1] - size, grid.step_x, size, 6, grid.columns)
            strip = template.border_strip(pyramid.feature_map(grid), border_x, left=column == 0)
            assert template.margins(strip) == pytest.approx(margin, abs=0.01)


def test_weak_windows_are_found_because_they_vote():
    model = TemplateMixture((mixture_template(bias=-1.3),))
    _, found = MixtureSearch(model, n_jobs=1).score_windows(ROAD, PyramidParams(min_score=0.5))
    assert len(found) < _MAX_WINDOWS
    assert -1.01 < found.margins.min() < -0.9


def test_rows_of_cells_cover_rows_of_the_frame():
    shape = (80, 160)
    whole, part = frame_grid(8.0, shape), frame_grid(8.0, shape, (16, 64))
    # Four rows of cells lie beyond each border of the frame.
    assert (whole.top, whole.rows, part.top, part.rows) == (-32, 18, 16, 6)
    assert _cell_rows(whole, (0, 80), shape) == (0, 18)
    assert _cell_rows(whole, (20, 44), shape) == (6, 10)
    assert _cell_rows(part, (20, 44), shape) == (0, 4)


def test_a_template_needs_the_rows_of_its_padding():
    params, shape = PyramidParams(horizon=0.5), (360, 640)
    plain, padded = mixture_template(4, 4, padding=(0.0, 0.0)), mixture_template(6, 8, padding=(1.0, 2.0))
    top, bottom = _row_range(plain, 10.0, params, shape)
    assert 0 < top < bottom < 360
    assert _row_range(padded, 10.0, params, shape) == (top - 20, bottom + 20)
    assert _row_range(padded, 10.0, PyramidParams(horizon=None), shape) == (0, 360)


@pytest.mark.parametrize("shape", [(200, 320), (320, 200)])
def test_a_search_of_all_rows_has_the_gradients_of_all_rows(shape):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    pyramid, _ = MixtureSearch(random_mixture(), n_jobs=1).score_windows(image, PyramidParams(horizon=None))
    for found, expected in zip(pyramid.octaves, EdgePyramid(image).octaves, strict=True):
        np.testing.assert_array_equal(found.sums, expected.sums)


def test_only_the_best_windows_are_returned():
    every = search_once(random_mixture(), ROAD, PyramidParams(min_score=-30.0))
    assert len(every.windows) == _MAX_WINDOWS
    few = search_once(random_mixture(), ROAD)
    np.testing.assert_array_equal(few.windows.boxes, every.windows.boxes[: len(few.windows)])


def test_a_uniform_frame_has_no_vehicles():
    found = search_once(load_model(), np.full((360, 640, 3), 120, np.uint8))
    assert len(found.vehicles) == 0


def test_invalid_frames_and_parameters_are_rejected():
    search = MixtureSearch(random_mixture(), n_jobs=1)
    with pytest.raises(InvalidInputError, match=r"convert a grayscale image with cv2\.cvtColor"):
        search.find(ROAD[..., 0])
    with pytest.raises(InvalidInputError, match="scale its values 0-1"):
        search.find(ROAD / 255)
    with pytest.raises(InvalidInputError, match="params must be a PyramidParams, got SearchParams"):
        search.find(ROAD, SearchParams.preset())
    with pytest.raises(InvalidInputError, match=r"model must be a TemplateMixture, .*; load_model\(\"defau"):
        MixtureSearch(load_classifier())
    with pytest.raises(InvalidInputError, match="n_jobs must be an integer from 1"):
        MixtureSearch(random_mixture(), n_jobs=0)
    with pytest.raises(InvalidInputError, match="classifier must be a VehicleClassifier, got Template"):
        find_cars(ROAD, random_mixture())
    with pytest.raises(InvalidInputError, match="method must be 'shared' for a mixture"):
        VehicleDetector(random_mixture(), method="windows")
    with pytest.raises(InvalidInputError, match="search_params must be a PyramidParams, got SearchParams"):
        VehicleDetector(random_mixture(), search_params=SearchParams.preset())
    with pytest.raises(InvalidInputError, match="search_params must be a SearchParams, got PyramidParams"):
        VehicleDetector(load_classifier(), search_params=PyramidParams())


def test_the_detector_returns_the_vehicles_of_the_search():
    model = random_mixture()
    params = PyramidParams(min_width=60)
    expected = search_once(model, ROAD, params)
    with VehicleDetector(model, search_params=params, n_jobs=1) as detector:
        found = detector.search(ROAD)
        assert found.windows.scores.tolist() == expected.windows.scores.tolist()
        assert detector.detect(ROAD).boxes.tolist() == expected.vehicles.boxes.tolist()
        assert detector.process(ROAD).detections.boxes.tolist() == expected.vehicles.boxes.tolist()
    with VehicleDetector(model, region_params=HeatParams(), horizon=0.6, n_jobs=1) as detector:
        assert detector.search_params.horizon == 0.6
        assert detector.detect(ROAD).boxes.shape[1] == 4
