import csv
import dataclasses
import json
import math
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn, write_frame_set
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames
from vehicle_detection.images import write_image
from vehicle_detection.mixture import load_model
from vehicle_detection.mixture_training import (
    FrameDataset,
    as_metadata,
    cross_validate_mixture,
    drawn_source,
    find_patches,
    find_sources,
    train_mixture,
    write_card,
    write_curves,
)
from vehicle_detection.mixture_training.cross_validation import (
    FoldDetections,
    _log_odds,
    _score,
    _threshold,
    detect_in_source,
)
from vehicle_detection.mixture_training.drawn_frames import _where_cut


@pytest.fixture(scope="module")
def sources():
    return FrameDataset("one", (drawn(range(7), "first"),)), FrameDataset(
        "two", (drawn(range(7, 12), "second"),)
    )


@pytest.fixture(scope="module")
def judged(sources):
    return cross_validate_mixture(sources, SMALL_MIXTURE, n_jobs=1)


def held_out(scores, hits, *, frames=4, empty=0, source="road"):
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


# Judging.


def test_each_source_is_judged_by_a_model_that_does_not_know_it(sources, judged):
    _, scores, held = judged
    assert [(score.name, score.source) for score in scores] == [("first", "one"), ("second", "two")]
    for part, source, other in zip(held, sources, reversed(sources)):
        assert part.frames is source.sets[0]
        model = train_mixture([other], SMALL_MIXTURE, n_jobs=1)
        key, image = next(iter(part.frames))
        (again,) = detect_in_source(
            model, FrameDataset("x", (LabelledFrames("x", {key: image}, part.frames.labels),))
        )
        np.testing.assert_array_equal(again.found.boxes, part.found.frame(key).boxes)
    for score in scores:
        assert 0 <= score.f1 <= score.best_f1 <= 1
        assert score.average_precision > 0.5
        assert score.vehicles > 5


def test_the_model_is_the_one_trained_on_everything_and_calibrated(sources, judged, tmp_path):
    model, scores, held = judged
    plain = train_mixture(sources, SMALL_MIXTURE, n_jobs=1)
    np.testing.assert_array_equal(model.templates[0].weights, plain.templates[0].weights)
    assert (plain.slope, plain.offset, plain.threshold) == (1.0, 0.0, 0.0)
    assert model.slope > 0
    assert (model.threshold - model.offset) / model.slope == pytest.approx(_threshold(held))
    metadata = as_metadata(scores, sources, 0)
    model.with_metadata(metadata).save(tmp_path / "m.safetensors")
    assert load_model(tmp_path / "m.safetensors").metadata == json.loads(json.dumps(metadata))
    assert metadata["data"] == {"one": 7, "two": 5}


def test_a_source_for_every_model_is_never_judged(sources):
    always = drawn_source(drives=1, frames=1)
    params = dataclasses.replace(SMALL_MIXTURE, rounds=(0.2,))
    model, scores, held = cross_validate_mixture(sources, params, always=[always], n_jobs=1)
    assert [score.source for score in scores] == [part.source for part in held] == ["one", "two"]
    plain = train_mixture([*sources, always], params, n_jobs=1)
    np.testing.assert_array_equal(model.templates[0].weights, plain.templates[0].weights)


def test_the_nearest_frame_in_which_the_border_cuts_a_vehicle():
    def moment(truncated, ignore):
        return SimpleNamespace(truth=[SimpleNamespace(truncated=truncated, ignore=ignore)])

    drive = [moment(0.0, False)] * 40
    assert _where_cut(drive, 17) == 17
    drive[2], drive[32], drive[22], drive[16] = (
        moment(0.5, False),
        moment(0.3, False),
        moment(0.9, True),
        moment(0.5, False),
    )
    # Too small a part is ignored, and one that is between the frames that are looked at is not seen.
    assert _where_cut(drive, 17) == 2
    drive[12] = moment(0.21, False)
    assert _where_cut(drive, 17) == 12


def test_drawn_frames_follow_from_the_seed():
    one, same, other = (drawn_source(drives=2, frames=2, random_state=seed) for seed in (0, 0, 1))
    assert (one.name, [len(part) for part in one.sets]) == ("drawn", [2, 2])
    for part, again, different in zip(one.sets, same.sets, other.sets):
        for (key, image), (_, twin), (_, stranger) in zip(part, again, different):
            assert image.shape == (720, 1280, 3)
            np.testing.assert_array_equal(image, twin)
            assert (image != stranger).any()
            assert len(part.labels.rows(key)) > 0
    with pytest.raises(InvalidInputError, match="drives must be an integer at least 1; got 0"):
        drawn_source(drives=0)
    with pytest.raises(InvalidInputError, match="frames must be"):
        drawn_source(frames=500)


def test_too_few_sources_are_refused(sources):
    with pytest.raises(
        InvalidInputError, match="sources must be two or more, so that one can be left out; got 1"
    ):
        cross_validate_mixture(sources[:1], SMALL_MIXTURE)
    twin = dataclasses.replace(sources[1], name="one")
    with pytest.raises(InvalidInputError, match="sources must have different names, got 'one' twice"):
        cross_validate_mixture([sources[0], twin], SMALL_MIXTURE)


def test_scores_by_hand():
    part = held_out([1.0, 0.5, 0.2, -0.5], [True, False, True, True], frames=5, empty=1)
    score = _score(part, 0.0)
    assert (score.frames, score.vehicles) == (5, 4)
    assert (score.precision, score.recall) == (pytest.approx(2 / 3), 0.5)
    assert score.f1 == pytest.approx(4 / 7)
    assert score.best_f1 == pytest.approx(6 / 8)
    assert score.average_precision == pytest.approx(0.25 + 0.25 * 0.75 + 0.25 * 0.75)
    assert (score.mean_iou, score.false_per_frame, score.false_per_empty_frame) == (1.0, 0.2, 0.0)
    assert "false_per_empty_frame" not in _score(held_out([1.0], [True]), 0.0).to_dict()


def test_a_vehicle_in_an_ignored_group_is_false_in_the_plain_reading_only():
    part = held_out([1.0, 0.5, 0.2], [True, True, False])
    single = part.frames.labels
    labels = FrameBoxes(
        [*single.frames, 2],
        range(5),
        [*single.boxes, [80.0, 0.0, 160.0, 60.0]],
        ignore=np.arange(5) == 4,
        frame_keys=single.frame_keys,
    )
    part = FoldDetections("road", LabelledFrames("road", part.frames.frames, labels), part.found)
    score = _score(part, 0.0)
    assert (score.precision, score.f1) == (pytest.approx(2 / 3), pytest.approx(4 / 7))
    assert score.region_f1 == pytest.approx(4 / 6)
    assert score.average_precision == score.region_average_precision == 0.5


def test_scores_of_nothing():
    nothing = _score(held_out([], []), 0.0)
    assert (nothing.f1, nothing.best_f1, nothing.average_precision, nothing.recall) == (0, 0, 0, 0)
    assert math.isnan(nothing.precision)
    assert "precision" not in nothing.to_dict()
    empty = held_out([0.3, 0.6], [False, False], frames=2, empty=2)
    assert _score(empty, 0.5).false_per_empty_frame == 0.5


def test_the_threshold_is_the_best_of_all():
    part = held_out([1.0, 0.5, 0.0, -0.5], [True, True, True, False])
    assert -0.5 < _threshold([part]) <= 0.0
    other = held_out([0.9, 0.3], [True, False], frames=1)
    assert 0.3 < _threshold([other]) <= 0.9


def test_every_vehicle_counts_alike_whatever_its_set():
    # One set is best at 0.9, another one at 0.1, where the first loses: the one with more vehicles decides.
    strict = held_out([0.9, 0.2, 0.15, 0.15, 0.15, 0.15], [True, False, False, False, False, False], frames=1)
    few, many = held_out([0.1], [True], frames=1), held_out([0.1] * 4, [True] * 4)
    assert 0.2 < _threshold([strict]) <= 0.9
    assert 0.2 < _threshold([strict, few]) <= 0.9
    assert _threshold([strict, many]) <= 0.1


def test_the_threshold_bears_sets_without_vehicles_or_boxes():
    sets = [held_out([], []), held_out([], [], frames=2, empty=2), held_out([0.5], [True])]
    assert -1.0 <= _threshold(sets) <= 0.5
    assert _threshold(sets[:2]) == -1.0


def test_log_odds_rise_with_the_value():
    rng = np.random.default_rng(0)
    values = rng.uniform(-1, 1, 40)
    hits = rng.random(40) < 1 / (1 + np.exp(-4 * values - 1))
    hits[np.argsort(values)[-2:]] = True
    part = held_out(values, hits, frames=40)
    slope, offset = _log_odds([part])
    assert 2 < slope < 8
    assert -0.5 < offset < 2.5


@pytest.mark.parametrize("hits", [[True, True], [False, False], [False, True], []])
def test_log_odds_of_too_little(hits):
    # All right, all wrong, or the better box wrong: nothing to fit.
    assert _log_odds([held_out([0.9, 0.1][: len(hits)], hits)]) == (1.0, 0.0)


# The card and the curves.


def test_the_card_tells_what_was_measured(sources, judged, tmp_path):
    model, scores, _ = judged
    write_card(tmp_path / "small.md", model, scores, sources, 3)
    card = (tmp_path / "small.md").read_text()
    assert card.startswith("# Model card: small\n\nA mixture of 1 linear templates")
    assert "--seed 3 -o small.safetensors --card small.md" in card
    assert "6x5" in card
    assert f"| first | 7 | {scores[0].vehicles} | {scores[0].f1:.3f} |" in card
    assert "- one: 7 frames, " in card
    assert "nan" not in card
    assert "India" not in card
    shipped = [
        dataclasses.replace(sources[0], name=name) for name in ("india", "camvid", "indonesia", "course")
    ]
    write_card(tmp_path / "small.md", model, scores, shipped, 3)
    assert "frames of India" in (tmp_path / "small.md").read_text()


def test_the_card_of_scores_that_are_not_known(sources, judged, tmp_path):
    score = _score(held_out([], []), 0.0)
    write_card(tmp_path / "m.md", judged[0], [score], sources, 0)
    assert (
        "| road | 4 | 4 | 0.000 | 0.000 | 0.000 | - | 0.000 | - | 0.00 | - | 0.000 | 0.000 |"
        in (tmp_path / "m.md").read_text()
    )


def test_the_curves(tmp_path):
    write_curves(tmp_path / "c.csv", [held_out([1.0, 0.5], [True, False]), held_out([], [])])
    with (tmp_path / "c.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["frames", "value", "precision", "recall"],
        ["road", "1.0000", "1.0000", "0.2500"],
        ["road", "0.5000", "0.5000", "0.2500"],
    ]


def test_a_card_needs_a_folder(sources, judged, tmp_path):
    with pytest.raises(InvalidInputError, match="path needs an existing folder"):
        write_card(tmp_path / "none" / "m.md", *judged[:2], sources, 0)


# Folders of labelled frames.


def test_sources_of_a_folder(tmp_path):
    write_frame_set(tmp_path, "town", drawn(range(3)))
    write_frame_set(tmp_path, "indonesia", drawn(range(2)))
    write_frame_set(tmp_path, "stills", drawn(range(4)), place=".")
    found = find_sources(tmp_path)
    assert [source.name for source in found] == ["indonesia", "town", "course"]
    assert [[len(part) for part in source.sets] for source in found] == [[2], [3], [4]]
    assert [source.min_labelled_width for source in found] == [60.0, 0.0, 0.0]
    assert len(found[1].sets[0].labels) == len(drawn(range(3)).labels)


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "folder"])
def test_every_sixth_patch_of_a_folder(tmp_path, zipped):
    assert find_patches(tmp_path) == []
    for number in range(25):
        (tmp_path / "vehicles" / "GTI_Far").mkdir(parents=True, exist_ok=True)
        write_image(
            tmp_path / "vehicles" / "GTI_Far" / f"{number}.png", np.full((64, 64, 3), number, np.uint8)
        )
    if zipped:
        shutil.make_archive(str(tmp_path / "vehicles"), "zip", tmp_path, "vehicles")
        shutil.rmtree(tmp_path / "vehicles")
    found = find_patches(tmp_path)
    assert [image.shape for image in found] == [(64, 64, 3)] * 5
    assert [image[0, 0, 0] for image in found] == [0, 6, 12, 18, 24]


def test_folders_that_are_refused(tmp_path):
    with pytest.raises(DatasetError, match="does not exist; name the folder of the labelled frames"):
        find_sources(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"has no labels/NAME\.csv; name the folder"):
        find_sources(tmp_path)
    write_frame_set(tmp_path, "town", drawn(range(2)))
    labels = tmp_path / "labels" / "town.csv"
    rows = labels.read_text()
    labels.write_text(rows.replace("00", "99"))
    with pytest.raises(InvalidInputError, match=r"town.csv: labels know none of the frames"):
        find_sources(tmp_path)
    labels.write_text(rows)
    (tmp_path / "labels" / "other.csv").write_text(rows)
    with pytest.raises(
        DatasetError, match=r"other.csv has no frames: neither .* nor .*other.mp4 exists; add"
    ):
        find_sources(tmp_path)
    (tmp_path / "frames" / "other").mkdir()
    with pytest.raises((DatasetError, InvalidInputError), match="other"):
        find_sources(tmp_path)
