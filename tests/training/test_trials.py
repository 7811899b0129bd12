import numpy as np
import pytest

from tests.training.trial_cases import SEARCH, SMALL, UNTIMED
from vehicle_detection import FeatureParams, InvalidInputError, TrackTable, VehicleDetector
from vehicle_detection.datasets import make_split, split_sequences
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.training import (
    FeatureCache,
    TrainingOptions,
    TrialOptions,
    compare_configurations,
    train_classifier,
)

PARAMS = FeatureParams(**SMALL)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("split", ["sequences", "gti_to_kitti", "kitti_to_gti", "random"])
def test_a_trial_equals_training_on_that_part(patch_set, mirror, split):
    parts = make_split(patch_set, split, random_state=3)
    table = compare_configurations(
        patch_set, [{**SMALL, "mirror": mirror}], splits=split, C=0.01, seeds=[3], options=UNTIMED
    )
    (row,) = table.to_dict("records")
    train, test = patch_set[parts.train], patch_set[parts.test]
    classifier = train_classifier(
        train.patches,
        train.labels,
        params=PARAMS,
        options=TrainingOptions(C=0.01, mirror=mirror, random_state=3),
    )
    assert row["accuracy"] == classifier.score(test.patches, test.labels)
    assert row["train_accuracy"] == classifier.score(train.patches, train.labels)
    assert (row["train_size"], row["test_size"]) == (len(train), len(test))
    assert row["mirror"] is mirror


def test_frames_are_scored_like_the_detector(patch_set, frames, labels):
    other = LabelledFrames("again", {1: frames.frames[1]}, labels, horizon=0.5)
    options = TrialOptions(frames=iter([frames, other]), search_params=SEARCH)
    (row,) = compare_configurations(patch_set, [SMALL], C=0.1, options=options).to_dict("records")
    train = patch_set[split_sequences(patch_set).train]
    classifier = train_classifier(train.patches, train.labels, params=PARAMS, options=TrainingOptions(C=0.1))
    scores = []
    for each in (frames, other):
        with VehicleDetector(classifier, search_params=SEARCH.with_horizon(each.horizon)) as detector:
            found = TrackTable.from_detections({key: detector.detect(image) for key, image in each})
        scores.append(evaluate_detections(found, each.labels, frames=each.keys))
    assert row["frame_f1"] == pytest.approx(np.nanmean([score.f1 for score in scores]))
    assert row["frame_average_precision"] == pytest.approx(np.mean([s.average_precision for s in scores]))
    assert row["frame_f1"] <= row["frame_best_f1"] + 1e-12
    assert row["frame_f1_by_set"].split()[::2] == ["drawn", "again"]
    assert row["search_ms"] > 0


def test_invalid_options(patch_set, frames):
    with pytest.raises(InvalidInputError, match="frames must be a LabelledFrames, got 3"):
        TrialOptions(frames=[3])
    with pytest.raises(InvalidInputError, match="frames must have different names"):
        TrialOptions(frames=[frames, frames])
    with pytest.raises(InvalidInputError, match="patch_set must be a PatchSet, got an array"):
        compare_configurations(patch_set.patches, [SMALL])
    other = FeatureCache(np.zeros((1, 64, 64, 3), np.uint8))
    with pytest.raises(InvalidInputError, match="cache must be a FeatureCache of the patches"):
        compare_configurations(patch_set, [SMALL], options=TrialOptions(cache=other))
