import dataclasses
import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection import VehicleDetector
from vehicle_detection._common import FORMAT_VERSION
from vehicle_detection._common.model_file import FORMAT, checksum
from vehicle_detection.boxes import box_areas, clip_boxes, iou_matrix
from vehicle_detection.classifier import VehicleClassifier, load_classifier
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import (
    CROP_LENGTH,
    PLANES,
    BoxRegressor,
    FeatureMap,
    MixtureSearch,
    MixtureTemplate,
    TemplateMixture,
    crop_features,
    image_pyramid,
    level_maps,
    load_model,
    mirror_planes,
    overlaps,
    vote_boxes,
)
from vehicle_detection.mixture import model as mixture
from vehicle_detection.mixture.boxes import ScoredWindows, nms
from vehicle_detection.mixture.features import Level
from vehicle_detection.params import PyramidParams, SearchParams
from vehicle_detection.search import find_cars
from vehicle_detection.synthetic import render_scene

ROAD = render_scene(shape=(360, 640), vehicles=3, random_state=5).image


def random_template(columns=9, rows=8, seed=0, bias=0.0, margin=(1.0, 1.0)):
    weights = np.random.default_rng(seed).normal(0, 0.05, (rows, columns, PLANES))
    return MixtureTemplate(weights, bias, margin)


def random_mixture(**options):
    """A mixture that was never trained; some of all windows score above 0."""
    templates = (random_template(bias=-0.2), random_template(12, 8, 1, -0.2), random_template(8, 10, 2, -0.2))
    rng = np.random.default_rng(3)
    box_regressor = BoxRegressor(rng.normal(0, 1e-3, (CROP_LENGTH, 4)), rng.normal(0, 0.01, 4))
    return TemplateMixture(templates, box_regressor, **options)


def search_once(model, image, params=None, n_jobs=1):
    search = MixtureSearch(model, n_jobs=n_jobs)
    try:
        return search.find(image, params)
    finally:
        search.close()


# Templates.


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 5), (3, 4), (8, 9)])
@pytest.mark.parametrize("shape", [(8, 9), (9, 12), (12, 30)])
def test_scores_are_sums_of_products(rows, columns, shape):
    rng = np.random.default_rng(7)
    planes = rng.uniform(0, 0.4, (PLANES, *shape)).astype(np.float32)
    template = random_template(columns, rows, bias=0.25, margin=(0.0, 0.0))
    expected = np.empty((shape[0] - rows + 1, shape[1] - columns + 1))
    for y in range(expected.shape[0]):
        for x in range(expected.shape[1]):
            window = planes[:, y : y + rows, x : x + columns].transpose(1, 2, 0).astype(np.float64)
            expected[y, x] = (window * template.weights).sum() + 0.25
    found = template.scores(planes)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_map_smaller_than_a_template_has_no_window():
    template = random_template(9, 8)
    for shape in ((7, 20), (20, 8), (1, 1)):
        assert template.scores(np.zeros((PLANES, *shape), np.float32)).size == 0


def test_the_mirrored_template_scores_the_mirrored_map_alike():
    planes = np.random.default_rng(1).uniform(0, 0.4, (PLANES, 12, 20)).astype(np.float32)
    template = random_template()
    weights = mirror_planes(template.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
    mirrored = MixtureTemplate(weights, template.bias, template.padding)
    np.testing.assert_allclose(
        mirrored.scores(mirror_planes(planes)), template.scores(planes)[:, ::-1], atol=1e-5
    )


def test_boxes_leave_out_the_margin():
    template = random_template(9, 8, margin=(1.0, 0.5))
    assert template.box_cells == (7, 7)
    ((_, level),) = level_maps(image_pyramid(np.zeros((160, 160, 3), np.uint8)), Level(None, 8.0), (0, 160))
    first = np.array([0])
    (box,) = template.boxes(level, first, first)
    assert box.tolist() == [level.left + 8, level.top + 4, level.left + 64, level.top + 60]
    (box,) = template.boxes(level, first + 3, first + 5)
    assert box.tolist() == [level.left + 48, level.top + 28, level.left + 104, level.top + 84]


def border_template(seed=4):
    return dataclasses.replace(random_template(5, 6, seed), border=True)


def test_a_template_at_the_border_has_its_margin_on_one_side():
    template = border_template()
    assert template.box_cells == (4, 4)


@given(seed=st.integers(0, 1000), columns=st.integers(3, 12), rows=st.integers(4, 9))
def test_both_borders_are_searched_alike(seed, columns, rows):
    rng = np.random.default_rng(seed)
    planes = rng.uniform(0, 0.3, (PLANES, rows, columns)).astype(np.float32)
    level = FeatureMap(planes, 0.0, 4.0, 8.0, 8.0)
    align_mirrored = dataclasses.replace(level, planes=mirror_planes(planes))
    template, width = border_template(), columns * 8.0
    boxes, values = template.border_windows(level, width, left=False, min_margin=-9.0)
    assert len(boxes) == (rows - 5 if columns >= 5 and rows >= 6 else 0)
    assert (boxes[:, 2] == width).all()
    assert (boxes[:, 2:] - boxes[:, :2] == 32).all()
    others, same = template.border_windows(align_mirrored, 0.0, left=True, min_margin=-9.0)
    np.testing.assert_array_equal(same, values)
    np.testing.assert_array_equal(others[:, [1, 3]], boxes[:, [1, 3]])
    np.testing.assert_array_equal(others[:, [0, 2]], width - boxes[:, [2, 0]])
    if len(boxes):
        inside = level.planes[:, :, columns - 5 :]
        np.testing.assert_allclose(template.scores(np.ascontiguousarray(inside))[:, 0], values)


def test_windows_of_a_template_at_the_border_end_there():
    model = dataclasses.replace(
        random_mixture(),
        templates=(random_template(bias=-0.5), dataclasses.replace(border_template(), bias=1.0)),
    )
    search = MixtureSearch(model, n_jobs=1)
    found = search.score_windows(ROAD, PyramidParams())
    at_border = found.boxes[found.templates == 1]
    assert (at_border[:, 0] == 0).any()
    assert (at_border[:, 2] == 640).any()
    assert ((at_border[:, 0] == 0) | (at_border[:, 2] == 640)).all()
    # The other templates' sizes stay what they are without it.
    alone = dataclasses.replace(model, templates=model.templates[:1])
    expected = MixtureSearch(alone, n_jobs=1).score_windows(ROAD, PyramidParams())
    others = found.boxes[found.templates == 0]
    np.testing.assert_array_equal(others, expected.boxes[: len(others)])


def test_nearer_vehicles_gain():
    model = random_mixture()
    found = MixtureSearch(model, n_jobs=1).score_windows(ROAD, PyramidParams())
    least = float(np.quantile(found.scores, 0.2))
    boxes, values = model.vehicles(ROAD, found, min_margin=least)
    gained = dataclasses.replace(model, size_prior_weight=0.1)
    others, more = gained.vehicles(ROAD, found, min_margin=least)
    before = {tuple(box): value for box, value in zip(boxes, values)}
    both = [row for row, box in enumerate(others) if tuple(box) in before]
    assert len(both) > 3
    heights = others[both, 3] - others[both, 1]
    expected = [before[tuple(others[row])] for row in both] + 0.1 * np.log2(4 * heights / 360)
    np.testing.assert_allclose(more[both], expected)
    assert (more >= least).all()
    assert (np.diff(more) <= 0).all()


def test_what_many_windows_agree_on_gains():
    model = dataclasses.replace(random_mixture(), box_regressor=BoxRegressor.none())
    vehicle, twins = [100.0, 100.0, 200.0, 180.0], 30
    boxes = np.array([[400.0, 100.0, 500.0, 180.0], *[vehicle] * twins])
    windows = ScoredWindows(boxes, np.array([0.5, *[0.4] * twins]), np.zeros(twins + 1, np.intp))
    assert model.vehicles(ROAD, windows, min_margin=0.0)[1].tolist() == [0.5, 0.4]
    gained = dataclasses.replace(model, vote_weight=0.1)
    found, values = gained.vehicles(ROAD, windows, min_margin=0.0)
    assert found.tolist() == [vehicle, boxes[0].tolist()]
    # Of 30 windows that exceed -1.1 by 1.5 each, e^4 count.
    np.testing.assert_allclose(values, [0.4 + 0.1 * (np.log(46) - 2), 0.5 + 0.1 * (np.log(2.6) - 2)])
    assert len(gained.vehicles(ROAD, windows, min_margin=0.5)[0]) == 1
    more = ScoredWindows(np.array([vehicle] * 90), np.full(90, 0.4), np.zeros(90, np.intp))
    np.testing.assert_allclose(gained.vehicles(ROAD, more, min_margin=0.0)[1], [0.6])


def test_a_template_keeps_a_copy_that_cannot_be_changed():
    weights = np.zeros((3, 4, PLANES), np.float32)
    template = MixtureTemplate(weights, 0.0, (0.0, 0.0))
    weights[0] = 1
    assert not template.weights.any()
    with pytest.raises(ValueError, match="read-only"):
        template.weights[0] = 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"weights": np.zeros((3, 4, 27))},
            r"weights must be finite numbers of shape \(any, any, 28\), got an",
        ),
        ({"weights": np.zeros((4, PLANES))}, r"weights must be .*; train again"),
        ({"weights": np.zeros((0, 4, PLANES))}, "weights must be finite numbers"),
        ({"weights": np.full((3, 4, PLANES), np.nan)}, "weights must be finite numbers"),
        ({"weights": "none"}, "weights must be finite numbers"),
        ({"bias": np.inf}, "bias must be a number"),
        ({"margin": (2.0, 0.0)}, r"margin must leave cells for the box of 4x3 cells, got \(2.0, 0.0\)"),
        ({"margin": (0.0, 1.5)}, "margin must leave cells"),
        ({"margin": 1.0}, "margin must be two numbers of cells, got 1.0"),
        ({"margin": (np.nan, 0.0)}, "margin must be a number"),
        ({"border": 1}, "border must be True or False, got 1"),
    ],
)
def test_templates_that_make_no_sense(changes, message):
    options = {"weights": np.zeros((3, 4, PLANES)), "bias": 0.0, "margin": (0.0, 0.0)}
    with pytest.raises(InvalidInputError, match=message):
        MixtureTemplate(**(options | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"templates": ()}, "templates must hold at least one template; got none"),
        ({"templates": (5,)}, "templates must be a MixtureTemplate, got 5"),
        ({"refinement": None}, "box_regressor must be a BoxRegressor, got None"),
        ({"slope": 0.0}, "slope must be a number, greater than 0"),
        ({"slope": -1.0}, "slope must be a number, greater than 0"),
        ({"offset": np.nan}, "offset must be a number"),
        ({"threshold": np.inf}, "threshold must be a number"),
        ({"vote_weight": np.nan}, "vote_weight must be a number"),
    ],
)
def test_mixtures_that_make_no_sense(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(random_mixture(), **changes)


@pytest.mark.parametrize("side", [CROP_LENGTH - 1, 0])
def test_refinements_that_make_no_sense(side):
    with pytest.raises(InvalidInputError, match=rf"box_regressor.weights must be .* \({CROP_LENGTH}, 4\)"):
        BoxRegressor(np.zeros((side, 4)), np.zeros(4))
    with pytest.raises(InvalidInputError, match=r"box_regressor.bias must be finite numbers of shape \(4\)"):
        BoxRegressor(np.zeros((CROP_LENGTH, 4)), np.zeros(3))


# The search.


@pytest.mark.parametrize("params", [None, PyramidParams(horizon=0.56), PyramidParams(per_octave=3)])
def test_threads_change_nothing(params):
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


def test_windows_have_the_sizes_that_are_looked_for():
    params = PyramidParams(min_width=50, max_height=0.5, min_score=-3.0)
    boxes = search_once(random_mixture(), ROAD, params).windows.boxes
    width, height = (boxes[:, 2:] - boxes[:, :2]).T
    # A frame is resized to whole pixels: a window is as wide as wanted to a percent or two.
    assert width.min() > 49
    assert height.max() < 0.51 * 360


def test_least_score_and_threshold():
    model = random_mixture(slope=2.0, offset=-0.5, threshold=0.3)
    found = search_once(model, ROAD, PyramidParams(min_score=-1.8))
    assert found.windows.scores.min() >= -1.8
    assert found.vehicles.scores.min() >= 0
    plain = search_once(random_mixture(), ROAD, PyramidParams(min_score=-0.5))
    np.testing.assert_array_equal(plain.windows.boxes, found.windows.boxes)
    # Log-odds above the threshold: 2 * value - 0.5 - 0.3.
    np.testing.assert_allclose(2 * plain.windows.scores - 0.8, found.windows.scores)


@pytest.mark.parametrize("horizon", [0.3, 0.5, 0.62])
def test_a_known_horizon_limits_where_vehicles_stand(horizon):
    model = TemplateMixture((random_template(bias=0.5),), BoxRegressor.none())
    params = PyramidParams(horizon=horizon, min_width=40, min_score=-3.0)
    boxes = search_once(model, ROAD, params).windows.boxes
    # Windows that the frame cuts off are found wherever its border is in reach.
    boxes = boxes[(boxes[:, 1] >= 0) & (boxes[:, 3] <= 360)]
    assert len(boxes) > 100
    width, foot = boxes[:, 2] - boxes[:, 0], boxes[:, 3]
    slack, cell = 360 * params.horizon_tolerance, width / 7
    low, high = (share * width / 1.8 + horizon * 360 for share in params.camera_height_m)
    assert (foot >= low - slack - 2 * cell).all()
    assert (foot <= high + slack + 2 * cell).all()


def test_the_best_windows_are_kept():
    everything = search_once(random_mixture(), ROAD, PyramidParams(min_score=-30.0))
    assert len(everything.windows) == mixture._MOST_WINDOWS
    few = search_once(random_mixture(), ROAD)
    np.testing.assert_array_equal(few.windows.boxes, everything.windows.boxes[: len(few.windows)])


def test_an_even_frame_is_empty():
    found = search_once(load_model(), np.full((360, 640, 3), 120, np.uint8))
    assert len(found.vehicles) == 0


def test_frames_and_parameters_that_are_refused():
    search = MixtureSearch(random_mixture(), n_jobs=1)
    with pytest.raises(InvalidInputError, match=r"convert a grayscale image with cv2\.cvtColor"):
        search.find(ROAD[..., 0])
    with pytest.raises(InvalidInputError, match="scale a 0-1 float image"):
        search.find(ROAD / 255)
    with pytest.raises(InvalidInputError, match="params must be a PyramidParams, got SearchParams"):
        search.find(ROAD, SearchParams.preset())
    with pytest.raises(
        InvalidInputError, match=r"mixture must be a TemplateMixture, .*; load_model\(\"defau"
    ):
        MixtureSearch(load_classifier())
    with pytest.raises(InvalidInputError, match="n_jobs must be an integer from 1"):
        MixtureSearch(random_mixture(), n_jobs=0)
    with pytest.raises(InvalidInputError, match="classifier must be a VehicleClassifier, got Template"):
        find_cars(ROAD, random_mixture())
    with pytest.raises(InvalidInputError, match="method must be 'shared' for a mixture"):
        VehicleDetector(random_mixture(), method="windows")
    with pytest.raises(InvalidInputError, match="search must be a PyramidParams, got SearchParams"):
        VehicleDetector(random_mixture(), search_params=SearchParams.preset())
    with pytest.raises(InvalidInputError, match="search must be a SearchParams, got PyramidParams"):
        VehicleDetector(load_classifier(), search_params=PyramidParams())


def test_the_detector_hands_out_what_the_search_finds():
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


def test_a_cropped_box_is_itself_wherever_it_is():
    image = np.random.default_rng(4).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    inner, same = np.array([[96.0, 64.0, 160.0, 128.0]]), np.array([[0.0, 0.0, 64.0, 64.0]])
    whole, part = crop_features(image, inner), crop_features(image[64:128, 96:160], same)
    assert whole.shape == (1, CROP_LENGTH)
    one, two = (each[0, :-4].reshape(PLANES, 12, 12)[:, 4:8, 4:8] for each in (whole, part))
    np.testing.assert_allclose(one, two, atol=1e-5)
    outside = crop_features(image, np.array([[-20.0, -10.0, 20.0, 90.0], [280.0, 150.0, 360.0, 250.0]]))
    np.testing.assert_allclose(outside[:, -4:], [[0.5, 0.1, 0, 0], [0, 0, 0.75, 0.5]])


# From windows to vehicles.


def windows_of(count, seed):
    rng = np.random.default_rng(seed)
    corners, sides = rng.uniform(0, 100, (count, 2)), rng.uniform(5, 60, (count, 2))
    scores = -np.sort(-rng.normal(0, 1, count).round(1))
    return ScoredWindows(np.hstack([corners, corners + sides]), scores, rng.integers(0, 3, count))


@given(
    count=st.integers(0, 40),
    seed=st.integers(0, 1000),
    min_margin=st.floats(-1.5, 1.5),
    max_boxes=st.integers(1, 9),
)
def test_suppression(count, seed, least, most):
    windows = windows_of(count, seed)
    kept, vote_mass = vote_boxes(windows, min_margin=least, max_boxes=most)
    assert len(kept) <= most
    assert kept.boxes.shape == (len(kept), 4)
    assert (kept.scores >= least).all()
    assert (np.diff(kept.scores) <= 0).all()
    assert len(kept) > 0 or not (windows.scores >= least).any()
    if len(kept):
        assert kept.scores[0] == windows.scores[0]
        assert (kept.boxes >= windows.boxes.min(axis=0) - 1e-9).all()
        assert (kept.boxes <= windows.boxes.max(axis=0) + 1e-9).all()
        # The weaker windows change no score and take none away: they vote for places only.
        strong = windows[windows.scores >= least]
        again, less = vote_boxes(strong, min_margin=least, max_boxes=most)
        assert again.scores.tolist() == kept.scores.tolist()
        # A window supports itself, and the more there are the better.
        assert (vote_mass >= np.maximum(kept.scores + 1.1, 0) - 1e-9).all()
        assert (less <= vote_mass + 1e-9).all()


def test_neighbors_vote():
    boxes = np.array([[0.0, 0, 40, 40], [4, 0, 44, 40], [200, 0, 240, 40]])
    windows = ScoredWindows(boxes, np.array([1.0, 1.0, 0.5]), np.array([0, 1, 2]))
    kept, vote_mass = vote_boxes(windows, min_margin=0.0)
    np.testing.assert_allclose(kept.boxes, [[2, 0, 42, 40], [200, 0, 240, 40]])
    np.testing.assert_allclose(vote_mass, [4.2, 1.6])
    assert kept.templates.tolist() == [0, 2]


@given(count=st.integers(0, 30), seed=st.integers(0, 1000))
def test_of_two_boxes_on_one_vehicle_the_weaker_goes(count, seed):
    windows = windows_of(count, seed)
    order = np.random.default_rng(seed).permutation(count)
    boxes, scores = windows.boxes[order], windows.scores[order]
    rows = nms(boxes, scores)
    assert len(set(rows.tolist())) == len(rows)
    assert (np.diff(scores[rows]) <= 0).all()
    kept = boxes[rows]
    assert (np.triu(iou_matrix(kept, kept), 1) <= 0.35).all()
    for row in set(range(count)) - set(rows.tolist()):
        iou, cover = overlaps(boxes[row], kept)
        better = scores[rows] >= scores[row]
        assert (((iou > 0.35) | (cover > 0.75)) & better).any()
    assert nms(kept, scores[rows]).tolist() == list(range(len(rows)))


@given(seed=st.integers(0, 100), count=st.integers(0, 6))
@settings(max_examples=15)
def test_corrected_boxes_lie_inside(seed, count):
    windows = windows_of(count, seed)
    image = np.random.default_rng(seed).integers(0, 256, (90, 110, 3), dtype=np.uint8)
    strong = BoxRegressor(np.random.default_rng(seed).normal(0, 0.1, (CROP_LENGTH, 4)), np.zeros(4))
    for box_regressor in (strong, dataclasses.replace(strong, n_iterations=3), BoxRegressor.none()):
        boxes, scores = box_regressor.apply(image, windows)
        assert len(boxes) == len(scores) <= count
        assert (boxes[:, :2] >= 0).all()
        assert (boxes[:, 2:] <= (110, 90)).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all()
    assert not BoxRegressor.none().shifts(image, windows.boxes).any()


def test_a_box_is_looked_at_again_while_it_moves():
    image = np.random.default_rng(1).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    windows = ScoredWindows(np.array([[50.0, 50.0, 100.0, 100.0]]), np.array([1.0]), np.array([0]))
    still = np.zeros((CROP_LENGTH, 4))
    for shift, n_iterations, expected in [
        (0.2, 1, [50, 50, 110, 100]),
        (0.2, 3, [50, 50, 136.4, 100]),
        (0.1, 3, [50, 50, 105, 100]),
        (0.9, 2, [50, 50, 134.5, 100]),
    ]:
        box_regressor = BoxRegressor(still, np.array([0, 0, shift, 0]), n_iterations)
        boxes, _ = box_regressor.apply(image, windows)
        np.testing.assert_allclose(boxes, [expected], rtol=1e-6)
    assert windows.boxes.tolist() == [[50, 50, 100, 100]]


# Files.


def test_saving_and_loading_keeps_every_bit(tmp_path):
    path = tmp_path / "model.safetensors"
    options = {"slope": 1.7, "offset": 0.1, "threshold": -0.3, "size_prior_weight": 0.02, "vote_weight": 0.04}
    model = random_mixture(**options, metadata={"a": [1, {"b": None}]})
    box_regressor = dataclasses.replace(model.box_regressor, n_iterations=2)
    templates = *model.templates, border_template()
    model = dataclasses.replace(model, templates=templates, box_regressor=box_regressor)
    model.save(path)
    loaded = load_model(path)
    assert isinstance(loaded, TemplateMixture)
    for one, other in zip(model.templates, loaded.templates, strict=True):
        assert one.weights.tobytes() == other.weights.tobytes()
        assert (one.bias, one.margin, one.border) == (other.bias, other.margin, other.border)
    assert loaded.box_regressor.weights.tobytes() == model.box_regressor.weights.tobytes()
    assert loaded.box_regressor.bias.tobytes() == model.box_regressor.bias.tobytes()
    assert loaded.box_regressor.n_iterations == 2
    assert {name: getattr(loaded, name) for name in options} == options
    assert loaded.metadata == {"a": [1, {"b": None}]}
    first = path.read_bytes()
    loaded.save(path)
    assert path.read_bytes() == first
    np.testing.assert_array_equal(
        search_once(model, ROAD).vehicles.boxes, search_once(loaded, ROAD).vehicles.boxes
    )


def test_other_metadata():
    model = random_mixture()
    other = model.with_metadata({"x": 1})
    assert (model.metadata, other.metadata) == ({}, {"x": 1})
    assert other.templates == model.templates


def test_metadata_that_is_no_json_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="metadata must contain JSON values only"):
        random_mixture(metadata={"when": object()}).save(tmp_path / "m.safetensors")
    assert not list(tmp_path.iterdir())


def write_file(path, tensors=None, params=None, *, params_text=None, **changes):
    """Write a model file as `save` does, but with whatever it holds; the checksum fits."""
    from safetensors.numpy import save

    model = random_mixture()
    whole = {
        "box_regressor.weights": model.box_regressor.weights,
        "box_regressor.bias": model.box_regressor.bias,
        **{f"{index}.weights": template.weights for index, template in enumerate(model.templates)},
        **(tensors or {}),
    }
    whole = {name: np.array(tensor) for name, tensor in whole.items() if tensor is not None}
    values = {
        "biases": [0.0] * 3,
        "margins": [[1.0, 1.0]] * 3,
        "slope": 1.0,
        "offset": 0.0,
        "threshold": 0.0,
        **(params or {}),
    }
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": "mixture",
        "params": params_text
        or json.dumps({name: value for name, value in values.items() if value is not None}),
        "metadata": "{}",
        **changes,
    }
    header.setdefault("sha256", checksum(header, whole))
    path.write_bytes(save(whole, metadata=header))
    return path


def test_the_file_of_these_tests_is_sound(tmp_path):
    model = load_model(write_file(tmp_path / "m.safetensors"))
    assert len(model.templates) == 3
    # Files of before know neither of these.
    assert (model.size_prior_weight, model.vote_weight, model.box_regressor.n_iterations) == (0.0, 0.0, 1)


@pytest.mark.parametrize(
    ("tensors", "params", "message"),
    [
        ({"1.weights": np.full((3, 4, PLANES), np.nan, np.float32)}, {}, "weights must be finite numbers"),
        ({"1.weights": np.zeros((3, 4, 5), np.float32)}, {}, "weights must be finite numbers of shape"),
        ({"2.weights": None}, {}, "'2.weights'"),
        ({"box_regressor.bias": None}, {}, "'box_regressor.bias'"),
        ({"box_regressor.weights": np.zeros((5, 4), np.float32)}, {}, "box_regressor.weights must be"),
        ({}, {"biases": None}, "'biases'"),
        ({}, {"biases": [0.0]}, "argument"),
        ({}, {"biases": [], "margins": []}, "at least one template"),
        ({}, {"biases": ["x", 0.0, 0.0]}, "could not convert"),
        ({}, {"margins": [[1.0], [1.0], [1.0]]}, "index out of range"),
        ({}, {"margins": [[4.0, 50.0]] * 3}, "margin must leave cells"),
        ({}, {"borders": [True]}, "argument"),
        ({}, {"borders": [1, 0, 0]}, "border must be True or False"),
        ({}, {"slope": 0.0}, "slope must be a number"),
        ({}, {"n_iterations": 0}, "looks must be an integer from 1"),
        ({}, {"vote_weight": "much"}, "could not convert"),
        ({}, {"threshold": None}, "'threshold'"),
    ],
)
def test_files_that_do_not_fit(tmp_path, tensors, params, message):
    path = write_file(tmp_path / "m.safetensors", tensors, params)
    with pytest.raises(ModelFileError, match=rf"model file .* does not fit its own parameters: .*{message}"):
        load_model(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "forest"}, "holds a model of the unknown kind 'forest'; train one"),
        ({"kind": "patches"}, "does not fit its own parameters"),
        ({"format": "other"}, "not a model of this library"),
        ({"format_version": "1"}, f"has format version 1, this release reads {FORMAT_VERSION}; train again"),
        ({"sha256": "0"}, r"was changed after it was written \(checksum differs\)"),
        ({"params_text": "{"}, "has no readable parameters"),
        ({"metadata": "3"}, "has no readable parameters"),
    ],
)
def test_headers_that_do_not_fit(tmp_path, changes, message):
    path = write_file(tmp_path / "m.safetensors", **changes)
    with pytest.raises(ModelFileError, match=message):
        load_model(path)


def test_damaged_files(tmp_path):
    path = write_file(tmp_path / "m.safetensors")
    data = path.read_bytes()
    for damaged in (b"", data[:7], data[: len(data) // 2], data[:-1], b"x" * 500):
        path.write_bytes(damaged)
        with pytest.raises(ModelFileError, match="is not a complete safetensors file"):
            load_model(path)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ModelFileError, match="was changed after it was written"):
        load_model(path)


def test_paths_that_name_no_model(tmp_path):
    with pytest.raises(
        ModelFileError, match="does not exist; check the path, or name a shipped model: default"
    ):
        load_model("defualt")
    with pytest.raises(ModelFileError, match="is a folder; choose a file in it"):
        load_model(tmp_path)
    for path in (None, 5):
        with pytest.raises(
            InvalidInputError, match="path must be a model file or one of 'default', 'highway'"
        ):
            load_model(path)


def test_the_shipped_models():
    default, highway = load_model(), load_model("highway")
    assert isinstance(default, TemplateMixture)
    assert isinstance(highway, VehicleClassifier)
    assert default.metadata["metrics"]["left_out"].keys() >= {"india", "camvid", "indonesia", "project_clip"}
    assert set(default.metadata["data"]) == {"india", "camvid", "indonesia", "course", "drawn", "patches"}
    assert highway.metadata == load_classifier().metadata
    with pytest.raises(
        ModelFileError,
        match=re.escape("shipped model 'default' contains a model of kind 'mixture', not 'patches'"),
    ):
        load_classifier("default")


def test_a_shipped_model_that_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr("vehicle_detection._common.model_file.resources.files", lambda package: tmp_path)
    with pytest.raises(ModelFileError, match="shipped model 'highway' is missing; install the package again"):
        load_model("highway")
