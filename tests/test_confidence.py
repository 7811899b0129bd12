"""Confidence: calibrated probabilities, and the threshold that a probability implies."""

import dataclasses

import numpy as np
import pytest

from vehicle_detection import (
    HeatParams,
    InvalidInputError,
    RegionParams,
    VehicleDetector,
    detector_from,
    load_classifier,
    load_model,
    render_scene,
)
from vehicle_detection.confidence import with_confidence
from vehicle_detection.scenes import SceneVehicle


@pytest.fixture(scope="module")
def scene():
    cars = [
        SceneVehicle(distance_m=distance, lateral_m=lateral) for distance, lateral in ((14, 0), (30, 3.6))
    ]
    return render_scene(shape=(360, 640), vehicles=cars, lane=1, random_state=3)


def test_the_threshold_of_the_default_model_has_its_probability():
    model = load_model()
    at_threshold = 1 / (1 + np.exp(-model.threshold))
    assert model.calibration.probability(0.0) == pytest.approx(at_threshold)
    assert with_confidence(model, None, 0.5)[0].threshold == 0.0


@pytest.mark.parametrize("name", ["default", "highway"])
def test_boxes_have_at_least_the_confidence(scene, name):
    with VehicleDetector(name) as detector:
        everything = detector.detect(scene.image)
    found = {}
    for conf in (0.1, 0.5, 0.9):
        with VehicleDetector(name, conf=conf) as detector:
            found[conf] = detector.detect(scene.image)
        assert (found[conf].confidences >= conf - 1e-6).all()
    assert len(found[0.1]) >= len(found[0.5]) >= len(found[0.9])
    assert len(found[0.5]) >= 1
    # The threshold does not change the probability of a box.
    best = max(everything.confidences)
    assert max(found[0.1].confidences) == pytest.approx(best, abs=1e-6)


def test_tracks_have_a_confidence(scene):
    with VehicleDetector(conf=0.6) as detector:
        detector.reset(fps=10)
        for _ in range(8):
            result = detector.process(scene.image)
    assert result.shown
    for track in result.shown:
        # The frames are alike, so the mean score is that of each detection.
        expected = detector_probability(detector, result.detections.scores)
        assert np.isclose(expected, track.confidence).any()
        assert track.confidence >= 0.6
    assert result.detections.confidences.min() >= 0.6


def detector_probability(detector, score):
    return 1 / (1 + np.exp(-(score + detector.model.threshold)))


def test_confidence_of_a_function():
    found = np.array([[10.0, 10, 50, 40], [100, 10, 150, 40]]), np.array([0.4, 0.8])
    image = np.zeros((90, 160, 3), np.uint8)
    for options, given in (({}, found), ({"score": "logit"}, (found[0], np.log([2 / 3, 4.0])))):
        for threshold in ({}, {"threshold": 0.3}):
            detector = detector_from(lambda _, given=given: given, **options, **threshold)
            np.testing.assert_allclose(detector.detect(image).confidences[-1], 0.8, atol=1e-9)
            assert len(detector_from(lambda _, given=given: given, conf=0.5, **options).detect(image)) == 1
            assert len(detector_from(lambda _, given=given: given, conf=0.2, **options).detect(image)) == 2


def test_weak_groups_of_windows_need_less_evidence():
    classifier = load_classifier()
    _, strict = with_confidence(classifier, None, 0.99)
    _, loose = with_confidence(classifier, RegionParams(min_iou=0.4), 0.05)
    assert strict.min_peak > RegionParams().min_peak > loose.min_peak
    assert strict.min_evidence == RegionParams().min_evidence > loose.min_evidence
    assert loose == dataclasses.replace(loose, min_iou=0.4)


def test_a_heat_map_has_no_confidence(scene):
    with VehicleDetector("highway", region_params=HeatParams()) as detector:
        assert detector.detect(scene.image).confidences is None
        assert all(track.confidence is None for track in detector.process(scene.image).tracks)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conf": 1.5}, "conf must be a number, at least 0 and at most 1; got 1.5"),
        ({"conf": "high"}, "conf must be a number"),
        ({"conf": 0.5, "region_params": HeatParams()}, "conf must be None with a heat map.*HeatParams"),
    ],
)
def test_invalid_confidence(options, message):
    with pytest.raises(InvalidInputError, match=message):
        VehicleDetector(**options)


def test_scores_of_their_own_scale_have_no_confidence():
    with pytest.raises(InvalidInputError, match="conf must be None for scores on a scale of their own"):
        detector_from(lambda image: ([], []), score=(0, 10), conf=0.5)
