import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames
from vehicle_detection.mixture import load_model
from vehicle_detection.mixture_training import (
    FrameDataset,
    cross_validate_mixture,
    drawn_source,
    train_mixture,
    training_metadata,
    write_curves,
)
from vehicle_detection.mixture_training.cross_validation import (
    FoldDetections,
    best_threshold,
    detect_in_source,
    fit_log_odds,
    score_fold,
)


@pytest.fixture(scope="module")
def sources():
    return FrameDataset("one", (drawn(range(7), "first"),)), FrameDataset(
        "two", (drawn(range(7, 12), "second"),)
    )


@pytest.fixture(scope="module")
def cross_validated(sources):
    lines = []
    result = cross_validate_mixture(sources, SMALL_MIXTURE, n_jobs=1, on_step=lines.append)
    assert [line for line in lines if line.startswith("step")] == [
        "step 1 of 3: train without one",
        "step 1 of 3: evaluate on one",
        "step 2 of 3: train without two",
        "step 2 of 3: evaluate on two",
        "step 3 of 3: train on all sources",
    ]
    assert sum(line.startswith("round 1: ") for line in lines) == 3
    return result


def fold_of(scores, hits, *, frames=4, empty=0, source="road"):
    """One vehicle in each frame but the last `empty`; boxes with these scores, on it or beside it."""
    vehicle, beside = [10.0, 10.0, 60.0, 50.0], [100.0, 10.0, 150.0, 50.0]
    images = [np.zeros((60, 160, 3), np.uint8)] * frames
    full = range(frames - empty)
    labels = FrameBoxes(list(full), None, [vehicle for _ in full], frame_keys=list(range(frames)))
    found = {key: [] for key in range(frames)}
    for key, (score, hit) in enumerate(zip(scores, hits)):
        found[key % frames].append((vehicle if hit else beside, score))
    detections = {
        key: Detections([box for box, _ in rows], [score for _, score in rows])
        if rows
        else Detections.empty()
        for key, rows in found.items()
    }
    return FoldDetections(
        source, LabelledFrames(source, images, labels), FrameBoxes.from_detections(detections)
    )


def test_each_source_is_evaluated_with_a_model_trained_without_it(sources, cross_validated):
    _, scores, folds = cross_validated
    assert [(score.name, score.source) for score in scores] == [("first", "one"), ("second", "two")]
    for fold, source, other in zip(folds, sources, reversed(sources)):
        assert fold.frames is source.sets[0]
        model = train_mixture([other], SMALL_MIXTURE, n_jobs=1)
        key, image = next(iter(fold.frames))
        (again,) = detect_in_source(
            model, FrameDataset("x", (LabelledFrames("x", {key: image}, fold.frames.labels),))
        )
        np.testing.assert_array_equal(again.predictions.boxes, fold.predictions.frame(key).boxes)
    for score in scores:
        assert 0 <= score.f1 <= score.best_f1 <= 1
        assert score.average_precision > 0.5
        assert score.vehicles > 5


def test_the_final_model_is_trained_on_all_sources_and_calibrated(sources, cross_validated, tmp_path):
    model, scores, folds = cross_validated
    plain = train_mixture(sources, SMALL_MIXTURE, n_jobs=1)
    np.testing.assert_array_equal(model.templates[0].weights, plain.templates[0].weights)
    assert (plain.slope, plain.offset, plain.threshold) == (1.0, 0.0, 0.0)
    assert model.slope > 0
    assert (model.threshold - model.offset) / model.slope == pytest.approx(best_threshold(folds))
    metadata = training_metadata(scores, sources, 0)
    model.with_metadata(metadata).save(tmp_path / "m.safetensors")
    assert load_model(tmp_path / "m.safetensors").metadata == json.loads(json.dumps(metadata))
    assert metadata["data"] == {"one": 7, "two": 5}


def test_extra_sources_are_never_evaluated(sources):
    always = drawn_source(drives=1, frames=1)
    params = dataclasses.replace(SMALL_MIXTURE, mining_schedule=(0.2,))
    model, scores, folds = cross_validate_mixture(sources, params, extra_sources=[always], n_jobs=1)
    assert [score.source for score in scores] == [fold.source for fold in folds] == ["one", "two"]
    plain = train_mixture([*sources, always], params, n_jobs=1)
    np.testing.assert_array_equal(model.templates[0].weights, plain.templates[0].weights)


def test_too_few_sources(sources):
    with pytest.raises(
        InvalidInputError,
        match="sources must hold at least 2 data sets, got 1; one at a time is left out",
    ):
        cross_validate_mixture(sources[:1], SMALL_MIXTURE)
    twin = dataclasses.replace(sources[1], name="one")
    with pytest.raises(InvalidInputError, match="sources must have different names, got 'one' twice"):
        cross_validate_mixture([sources[0], twin], SMALL_MIXTURE)


def test_fold_scores_by_hand():
    fold = fold_of([1.0, 0.5, 0.2, -0.5], [True, False, True, True], frames=5, empty=1)
    score = score_fold(fold, 0.0)
    assert (score.frames, score.vehicles) == (5, 4)
    assert (score.precision, score.recall) == (pytest.approx(2 / 3), 0.5)
    assert score.f1 == pytest.approx(4 / 7)
    assert score.best_f1 == pytest.approx(6 / 8)
    assert score.average_precision == pytest.approx(0.25 + 0.25 * 0.75 + 0.25 * 0.75)
    assert (score.mean_iou, score.false_per_frame, score.false_per_empty_frame) == (1.0, 0.2, 0.0)
    assert "false_per_empty_frame" not in score_fold(fold_of([1.0], [True]), 0.0).to_dict()
    # At IoU 0.7 the same boxes are right; log-odds of 0 state a probability of one half for each box.
    assert score.strict_average_precision == score.average_precision
    assert score_fold(fold, 0.0, (0.0, 0.0)).calibration_error == pytest.approx(0.25)


def test_a_vehicle_in_an_ignored_group_is_not_false_in_the_region_scores():
    fold = fold_of([1.0, 0.5, 0.2], [True, True, False])
    single = fold.frames.labels
    labels = FrameBoxes(
        [*single.frames, 2],
        range(5),
        [*single.boxes, [80.0, 0.0, 160.0, 60.0]],
        ignore=np.arange(5) == 4,
        frame_keys=single.frame_keys,
    )
    fold = FoldDetections("road", LabelledFrames("road", fold.frames.frames, labels), fold.predictions)
    score = score_fold(fold, 0.0)
    assert (score.precision, score.f1) == (pytest.approx(2 / 3), pytest.approx(4 / 7))
    assert score.region_f1 == pytest.approx(4 / 6)
    assert score.average_precision == score.region_average_precision == 0.5


def test_fold_scores_without_detections_or_vehicles():
    nothing = score_fold(fold_of([], []), 0.0)
    assert (nothing.f1, nothing.best_f1, nothing.average_precision, nothing.recall) == (0, 0, 0, 0)
    assert math.isnan(nothing.precision)
    assert "precision" not in nothing.to_dict()
    assert "calibration_error" not in nothing.to_dict()
    empty = fold_of([0.3, 0.6], [False, False], frames=2, empty=2)
    assert score_fold(empty, 0.5).false_per_empty_frame == 0.5


def test_the_best_threshold_of_one_fold():
    fold = fold_of([1.0, 0.5, 0.0, -0.5], [True, True, True, False])
    assert -0.5 < best_threshold([fold]) <= 0.0
    other = fold_of([0.9, 0.3], [True, False], frames=1)
    assert 0.3 < best_threshold([other]) <= 0.9


def test_every_vehicle_has_the_same_weight_in_the_best_threshold():
    # One set is best at 0.9, another one at 0.1, where the first loses: the one with more vehicles decides.
    strict = fold_of([0.9, 0.2, 0.15, 0.15, 0.15, 0.15], [True, False, False, False, False, False], frames=1)
    few, many = fold_of([0.1], [True], frames=1), fold_of([0.1] * 4, [True] * 4)
    assert 0.2 < best_threshold([strict]) <= 0.9
    assert 0.2 < best_threshold([strict, few]) <= 0.9
    assert best_threshold([strict, many]) <= 0.1


def test_the_best_threshold_of_folds_without_vehicles_or_boxes():
    sets = [fold_of([], []), fold_of([], [], frames=2, empty=2), fold_of([0.5], [True])]
    assert -2.0 <= best_threshold(sets) <= 0.5
    assert best_threshold(sets[:2]) == -2.0


def test_log_odds_increase_with_the_margin():
    rng = np.random.default_rng(0)
    margins = rng.uniform(-1, 1, 40)
    hits = rng.random(40) < 1 / (1 + np.exp(-4 * margins - 1))
    hits[np.argsort(margins)[-2:]] = True
    fold = fold_of(margins, hits, frames=40)
    slope, offset = fit_log_odds([fold])
    assert 2 < slope < 8
    assert -0.5 < offset < 2.5


def test_log_odds_give_sources_with_more_vehicles_no_more_influence():
    margins = np.tile(np.linspace(-1, 1, 20), 5)
    strict = fold_of(margins[:20], margins[:20] > 0.6, frames=20, source="strict")
    easy = fold_of(margins, margins > -0.4, frames=100, source="easy")
    slope, offset = fit_log_odds([strict, easy])
    # Half-way between the two, and not near the larger one.
    assert -offset / slope == pytest.approx(0.1, abs=0.12)
    empty = fold_of([0.9], [False], frames=1, empty=1, source="empty")
    assert fit_log_odds([strict, easy, empty]) == pytest.approx((slope, offset), rel=0.1)


@pytest.mark.parametrize("hits", [[True, True], [False, False], [False, True], []])
def test_log_odds_of_too_few_boxes(hits):
    # All right, all wrong, or the better box wrong: nothing to fit.
    assert fit_log_odds([fold_of([0.9, 0.1][: len(hits)], hits)]) == (1.0, 0.0)


def test_write_curves(tmp_path):
    write_curves(tmp_path / "c.csv", [fold_of([1.0, 0.5], [True, False]), fold_of([], [])])
    with (tmp_path / "c.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["frames", "margin", "precision", "recall"],
        ["road", "1.0000", "1.0000", "0.2500"],
        ["road", "0.5000", "0.5000", "0.2500"],
    ]
