"""Explanations of scores: shares of cells and other terms."""

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.helpers import mixture_template, random_classifier
from vehicle_detection import (
    Explanation,
    FeatureParams,
    TemplateMixture,
    VehicleDetector,
    explain,
    render_scene,
    write_image,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.events import TrackLog
from vehicle_detection.explanation import explain_tracks, patch_cell_shares
from vehicle_detection.features import part_slices
from vehicle_detection.function_model import FunctionModel
from vehicle_detection.mixture import MixtureSearch, denoise, prepare
from vehicle_detection.synthetic import SceneVehicle

CARS = [SceneVehicle(distance_m=14.0, kind="sedan"), SceneVehicle(distance_m=9.0, lateral_m=4.2, kind="suv")]
SCENE = render_scene(shape=(360, 640), vehicles=CARS, lane=1, random_state=1)


@pytest.fixture(scope="module")
def detector():
    with VehicleDetector() as found:
        yield found


def test_each_found_vehicle_is_explained(detector):
    found = detector.detect(SCENE.image)
    assert len(found) == 2
    for box, score in zip(found.boxes, found.scores):
        explanation = explain(detector, SCENE.image, box)
        assert explanation.found
        assert (explanation.box == box).all()
        assert explanation.score == pytest.approx(score)
        assert explanation.terms["cells"] == pytest.approx(explanation.cells.sum())
        rows, columns = detector.model.templates[explanation.template].weights.shape[:2]
        assert explanation.cells.shape == (rows, columns)
        assert f"score {score:.2f}" in str(explanation)
        # The terms are those of the search: their sum gives the score.
        assert detector.model.scores(explanation.margin) == pytest.approx(score, abs=1e-5)


def test_a_hazy_frame_is_explained_as_it_is_searched(detector):
    hazy = cv2.addWeighted(SCENE.image, 0.15, np.full_like(SCENE.image, 190), 0.85, 0)
    assert (prepare(hazy) != denoise(hazy)).any()
    found = detector.detect(hazy)
    assert len(found)
    for box, score in zip(found.boxes, found.scores):
        explanation = explain(detector, hazy, box)
        assert detector.model.scores(explanation.margin) == pytest.approx(score, abs=1e-5)


def test_cells_and_bias_are_the_margin_of_a_window_of_the_search(detector):
    model, image = detector.model, SCENE.image
    explanation = explain(detector, image, detector.detect(image).boxes[0])
    _, windows = MixtureSearch(model).score_windows(denoise(image), detector.search_params)
    margins = windows.margins[windows.templates == explanation.template]
    linear = explanation.terms["cells"] + explanation.terms["bias"]
    assert np.abs(margins - linear).min() < 0.01


def test_a_window_at_either_border_is_explained():
    # A template that responds to any cells, at the borders only.
    weights = np.random.default_rng(0).normal(0, 0.3, (8, 6, 20)).astype(np.float32)
    template = dataclasses.replace(mixture_template(6, 8, bias=0.0, border=True), weights=weights)
    with VehicleDetector(TemplateMixture((template,), slope=1.0)) as detector:
        found = detector.detect(SCENE.image)
        sides = set()
        for box in found.boxes:
            explanation = explain(detector, SCENE.image, box)
            _, windows = MixtureSearch(detector.model).score_windows(
                denoise(SCENE.image), detector.search_params
            )
            linear = explanation.terms["cells"] + explanation.terms["bias"]
            # The search rounds these weights, which are five times as large as usual.
            assert np.abs(windows.margins - linear).min() < 0.05
            sides.add("left" if box[0] < 1 else "right" if box[2] > 639 else "inside")
    assert sides == {"left", "right"}


def test_a_box_without_a_vehicle_is_explained_too(detector):
    explanation = explain(detector, SCENE.image, [60, 230, 130, 290])
    assert not explanation.found
    assert explanation.score is None
    assert explanation.margin < 0
    assert explanation.box.tolist() == [60, 230, 130, 290]
    assert str(explanation).startswith("not found, template ")


@pytest.mark.parametrize(
    "params",
    [
        FeatureParams(),
        FeatureParams.preset("lab-9432"),
        FeatureParams.preset("luv-2384"),
        FeatureParams(pix_per_cell=16, spatial_size=8, spatial_order="interleaved", cell_per_block=1),
        FeatureParams(hog_feat=False, spatial_size=12),
        FeatureParams(spatial_feat=False, hist_feat=False, pix_per_cell=7),
    ],
)
def test_shares_of_a_patch_are_exact(params):
    shares = np.random.default_rng(0).normal(size=params.length)
    cells = patch_cell_shares(shares, params)
    histogram = part_slices(params).get("color histogram", slice(0))
    assert cells.shape == (params.cells, params.cells)
    assert cells.sum() == pytest.approx(shares.sum() - shares[histogram].sum())


def test_a_share_lies_where_its_feature_does():
    params = FeatureParams(hist_feat=False, spatial_size=16)
    shares = np.zeros(params.length)
    params.spatial_planes(shares[: params.spatial_length])[1, 2, 15] = 3.0
    hog = shares[params.spatial_length :].reshape(3, 7, 7, 2, 2, 9)
    hog[2, 4, 5, 1, 0, 6] = 5.0
    cells = patch_cell_shares(shares, params)
    assert {tuple(cell): cells[tuple(cell)] for cell in np.argwhere(cells)} == {(1, 7): 3.0, (5, 5): 5.0}


def test_terms_of_a_classifier_are_its_score():
    with VehicleDetector("highway") as detector:
        explanation = explain(detector, SCENE.image, SCENE.boxes[0])
        assert explanation.found
        x1, y1, x2, y2 = np.rint(explanation.window).astype(int)
        patch = cv2.resize(SCENE.image[y1:y2, x1:x2], (64, 64))
        score = detector.model.decision_function(patch[None])[0]
        assert explanation.margin == pytest.approx(score) == explanation.score
        assert list(explanation.terms) == ["cells", "bias", "color histogram"]
        nothing = explain(detector, SCENE.image, [0, 0, 60, 60])
        assert (nothing.found, nothing.score) == (False, None)


def test_the_best_template_of_a_classifier_is_explained():
    classifier = random_classifier(FeatureParams(), templates=3)
    with VehicleDetector(classifier) as detector:
        explanation = explain(detector, SCENE.image, [200, 100, 264, 164])
    assert explanation.template in range(3)
    assert isinstance(explanation, Explanation)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([1, 2, 3], "box must be an"),
        ([10, 10, 10, 20], r"box must be \[x1, y1, x2, y2\], 1 pixel or larger"),
        ([[1, 2, 3, 4]] * 2, "box must be"),
        ([30, 20, 10, 40], "box must be .* with x1 <= x2"),
    ],
)
def test_bad_boxes_are_refused(detector, box, message):
    with pytest.raises(InvalidInputError, match=message):
        explain(detector, SCENE.image, box)


@pytest.mark.parametrize(("seconds", "frame"), [((0.0, 0.04), 0), ((0.04, 0.08), 1)])
def test_a_detected_box_of_a_track_is_explained(detector, tmp_path, seconds, frame):
    # Without any detected box, the largest predicted one.
    log, box = TrackLog(), detector.detect(SCENE.image).boxes[0]
    for index, time_since_update in enumerate(seconds):
        write_image(tmp_path / f"{index}.png", SCENE.image)
        larger = box + index * np.array([-1, -1, 1, 1])
        log.add(index, index / 25, [SimpleNamespace(id=1, box=larger, time_since_update=time_since_update)])
    explained = explain_tracks(detector, tmp_path, log)
    assert explained[1].frame == frame
    assert explained[1].explanation.found


def test_bad_arguments_are_refused(detector):
    with pytest.raises(InvalidInputError, match="detector must be a VehicleDetector"):
        explain(detector.model, SCENE.image, [0, 0, 9, 9])
    with pytest.raises(InvalidInputError, match="image must be"):
        explain(detector, SCENE.image[..., 0], [0, 0, 9, 9])
    function = FunctionModel(function=lambda image: ([], []), score="probability")
    with pytest.raises(InvalidInputError, match="detector must have a linear model, got a function"):
        explain(VehicleDetector(function), SCENE.image, [0, 0, 9, 9])
    with (
        VehicleDetector("highway") as highway,
        pytest.raises(InvalidInputError, match="box must lie in the image of 640x360 pixels"),
    ):
        explain(highway, SCENE.image, [700, 0, 760, 60])
