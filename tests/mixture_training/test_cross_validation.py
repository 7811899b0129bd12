import dataclasses
import json

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames
from vehicle_detection.mixture import load_model
from vehicle_detection.mixture_training import (
    FrameDataset,
    cross_validate_mixture,
    drawn_source,
    train_mixture,
    training_metadata,
)
from vehicle_detection.training import best_threshold, detect_in_source


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
