import dataclasses
import json

import numpy as np
import pytest

from tests.helpers import rendered_patches
from vehicle_detection import (
    FeatureParams,
    InvalidInputError,
    PatchSet,
    TrainingOptions,
    load_classifier,
    load_training_patches,
    train_and_evaluate,
    train_classifier,
)
from vehicle_detection.datasets import split_leakage, split_random, split_sequences, split_sources
from vehicle_detection.training import SPLITS, model_card

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=6, pix_per_cell=16, hog_channel=0)
SOURCES = {True: ("GTI_Far", "KITTI_extracted"), False: ("GTI", "Extras")}


def named(patches, labels, sources):
    """Name the patches like those of the course, alternating between the sources of each class."""
    names = [
        f"{'vehicles' if label else 'non-vehicles'}/{sources[bool(label)][number % 2]}/{number}.png"
        for number, label in enumerate(labels)
    ]
    return PatchSet(patches, labels, names)


@pytest.fixture(scope="module")
def patch_set():
    return named(*rendered_patches(160), SOURCES)


@pytest.fixture(scope="module")
def trained(patch_set):
    return train_and_evaluate(patch_set, params=SMALL, options=TrainingOptions(random_state=3), seeds=2)


def test_every_split_is_evaluated(trained, patch_set):
    _, report = trained
    assert list(report.splits) == list(SPLITS)
    assert report.skipped == {}
    assert (report.vehicles, report.non_vehicles, report.balance) == (80, 80, 0.5)
    assert report.sources == {"Extras": 40, "GTI": 40, "GTI_Far": 40, "KITTI_extracted": 40}
    assert report.fingerprint == patch_set.fingerprint
    assert [len(score.accuracies) for score in report.splits.values()] == [2, 1, 1, 1]
    for score in report.splits.values():
        assert score.train + score.test == 160
        assert 0.5 < score.accuracy <= 1
        wrong = (score.false_negative_rate + score.false_positive_rate) / 2
        assert 1 - score.accuracy == pytest.approx(wrong, abs=0.1)
    assert set(report.seconds) == {"features", *SPLITS, "calibration", "leakage", "final"}
    assert 0 <= report.calibration_error < 0.5
    assert report.accuracy == report.splits["random"].accuracy
    assert (report.split, report.features) == ("random", f"{SMALL.length} features")


@pytest.mark.parametrize(("mirror", "gamma"), [(True, 0.0), (False, 0.0), (True, 0.4)])
def test_the_scores_equal_training_on_the_training_part_only(patch_set, mirror, gamma):
    _, report = train_and_evaluate(
        patch_set, params=SMALL, options=TrainingOptions(random_state=3, mirror=mirror, gamma=gamma), seeds=2
    )
    splits = {
        "random": [split_random(patch_set, random_state=seed) for seed in (3, 4)],
        "sequences": [split_sequences(patch_set)],
        "gti_to_kitti": [split_sources(patch_set)],
        "kitti_to_gti": [split_sources(patch_set, train=("KITTI", "Extras"), test=("GTI",))],
    }
    for name, each in splits.items():
        score = report.splits[name]
        for (train, test), accuracy in zip(each, score.accuracies):
            alone = train_classifier(
                patch_set.patches[train],
                patch_set.labels[train],
                params=SMALL,
                options=TrainingOptions(mirror=mirror, gamma=gamma, random_state=3),
            )
            assert alone.score(patch_set.patches[test], patch_set.labels[test]) == accuracy
        assert score.leakage == split_leakage(patch_set, each[0])
        assert (score.train, score.test) == (len(each[0].train), len(each[0].test))


def test_the_model_is_trained_on_all_patches(trained, patch_set):
    classifier, report = trained
    plain = train_classifier(
        patch_set.patches, patch_set.labels, params=SMALL, options=TrainingOptions(random_state=3)
    )
    for name in ("mean", "scale", "coef", "intercept"):
        np.testing.assert_array_equal(
            getattr(classifier.templates[0], name), getattr(plain.templates[0], name)
        )
    metadata = dict(classifier.metadata)
    assert metadata["training"] == plain.metadata["training"]
    assert metadata["versions"] == plain.metadata["versions"]
    assert metadata["data"] == {
        "fingerprint": patch_set.fingerprint,
        "sources": report.sources,
        "balance": 0.5,
    }
    assert metadata["metrics"]["accuracy"] == round(report.accuracy, 5)
    assert set(metadata["metrics"]["splits"]) == set(SPLITS)


@pytest.mark.parametrize("split", ["random", "sequences"])
def test_training_again_writes_the_same_file(patch_set, tmp_path, split):
    before = patch_set.patches.copy()
    for name, jobs in (("a", 1), ("b", 3)):
        classifier, report = train_and_evaluate(
            patch_set, params=SMALL, split=split, seeds=1, jobs=jobs, options=TrainingOptions(random_state=5)
        )
        classifier.save(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    np.testing.assert_array_equal(patch_set.patches, before)
    assert load_classifier(tmp_path / "a").metadata["metrics"]["split"] == split
    assert report.accuracy == report.splits[split].accuracy


def test_impossible_splits_are_skipped():
    patches, labels = rendered_patches(24)
    own = named(patches, labels, {True: ("mine", "mine"), False: ("other", "other")})
    _, report = train_and_evaluate(own, params=SMALL, seeds=1)
    assert set(report.splits) == {"random", "sequences"}
    assert report.skipped == {}  # the other splits are those of the course's patches
    # Each patch in a folder of its own: there is no sequence.
    single = PatchSet(patches, labels, [f"{number}/1.png" for number in range(24)])
    _, report = train_and_evaluate(single, params=SMALL, seeds=1)
    assert set(report.splits) == {"random"}
    assert "folder of two or more patches" in report.skipped["sequences"]
    with pytest.raises(InvalidInputError, match="folder of two or more patches; add patches"):
        train_and_evaluate(single, params=SMALL, split="sequences")


def test_reports_are_json(trained):
    _, report = trained
    plain = json.loads(json.dumps(report.to_dict()))
    assert plain["accuracy"] == report.accuracy
    assert plain["params"] == dataclasses.asdict(SMALL)
    assert plain["splits"]["random"]["accuracies"] == list(report.splits["random"].accuracies)
    assert plain["splits"]["sequences"]["accuracy"] == report.splits["sequences"].accuracy
    assert (plain["features"], plain["balance"]) == (report.features, 0.5)
    assert dataclasses.replace(report, params=FeatureParams.preset("lab-8460")).features == "lab-8460"


# --- the card ---


def test_the_card_holds_data_license_accuracy_and_limitations(trained):
    classifier, report = trained
    other = dataclasses.replace(report, params=FeatureParams.preset("luv-2384"))
    text = model_card(classifier, report, others=(other,), command="vehicle-detection train ...")
    assert "```bash\nvehicle-detection train ...\n```" in text
    assert "80 patches of vehicles and 80 of non-vehicles (50.0% vehicles)" in text
    assert "| KITTI_extracted | 40 |" in text
    assert report.fingerprint in text
    assert "CC BY-NC-SA 3.0" in text
    assert "non-commercial" in text
    for name, title in SPLITS.items():
        score = report.splits[name]
        assert f"| {title} | {score.train} | {score.test} | {score.accuracy:.4f} |" in text
    assert "mean of 2 seeds" in text
    assert "| luv-2384 | 2384 |" in text
    assert "`Extras` holds crops of the road in the course's project video" in text
    assert "`KITTI_extracted` are shuffled" in text
    assert max(len(line) for line in text.splitlines() if not line.startswith("|")) <= 110
    for version in classifier.metadata["versions"].values():
        assert version in text


def test_the_card_of_own_patches_does_not_mention_the_course():
    own = named(*rendered_patches(24), {True: ("mine", "mine"), False: ("other", "other")})
    options = TrainingOptions(mirror=False, positive_weight=3)
    classifier, report = train_and_evaluate(own, params=SMALL, seeds=1, options=options)
    assert classifier.metadata["training"]["positive_weight"] == 3
    text = model_card(classifier, report)
    for word in ("GTI", "KITTI", "Extras", "CC BY", "```", "Other features"):
        assert word not in text
    assert "inherits the terms of the patches" in text
    assert "without mirrored patches, vehicles weighted by 3, seed 0" in " ".join(text.split())
    assert "mean of 1 seed." in text


# --- bad input ---


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "half"}, "split must be one of 'random', 'sequences'; got 'half'"),
        ({"options": TrainingOptions(random_state=2**32 - 1)}, "random_state must .* from 0 to 4294967291"),
    ],
)
def test_invalid_options(patch_set, options, message):
    with pytest.raises(InvalidInputError, match=message):
        train_and_evaluate(patch_set, params=SMALL, **options)


def test_invalid_patches(patch_set):
    with pytest.raises(InvalidInputError, match=r"patch_set .*be a PatchSet, got an array .* read one with"):
        train_and_evaluate(patch_set.patches)
    with pytest.raises(InvalidInputError, match="labels must hold both classes"):
        train_and_evaluate(patch_set[patch_set.labels])
    with pytest.raises(InvalidInputError, match="1 vehicles and 80 non-vehicles are too few"):
        train_and_evaluate(patch_set[79:])


# --- the real patches ---


@pytest.mark.realdata
def test_a_part_of_the_course_patches(real_data):
    everything = load_training_patches(real_data / "vehicles.zip", real_data / "non-vehicles.zip")
    classifier, report = train_and_evaluate(
        everything[::20], params=FeatureParams.preset("luv-2384"), seeds=2, split="sequences"
    )
    assert list(report.splits) == list(SPLITS)
    assert report.vehicles + report.non_vehicles == 888
    assert 0.90 < report.splits["random"].accuracy < 1
    assert 0.90 < report.accuracy < 1
    assert report.splits["gti_to_kitti"].accuracy > 0.7
    # The patches that were left out, near duplicates of those that were not.
    assert classifier.score(everything.patches[7::40], everything.labels[7::40]) > 0.9
