"""Ignore rules, frames and invariants that hold for detection scores and track scores."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.evaluation.cases import CAR, boxes_of, drives, moved, trials
from vehicle_detection import InvalidInputError, TrackTable, evaluate_detections, evaluate_tracks

IGNORED = np.array([True])


@pytest.mark.parametrize(
    ("track", "ignored_box", "detection", "ignored"),
    [
        pytest.param(-1, (0, 0, 400, 200), CAR, True, id="center in a region"),
        pytest.param(-1, (10, 0, 50, 60), CAR, False, id="center on the open edge of a region"),
        pytest.param(-1, (50, 30, 90, 60), CAR, True, id="center on the closed edge of a region"),
        pytest.param(4, CAR, moved(20), True, id="covers an ignored box"),
        pytest.param(4, (0, 0, 400, 200), CAR, False, id="center in an ignored box, too little overlap"),
        pytest.param(4, CAR, moved(40), False, id="covers too little of an ignored box"),
    ],
)
def test_ignore_rules(track, ignored_box, detection, ignored):
    labels = boxes_of((0, track, ignored_box), ignore=IGNORED)
    found = boxes_of((0, 7, detection, 1.0))
    scores, tracked = evaluate_detections(found, labels), evaluate_tracks(found, labels)
    assert (scores.ignored, scores.fp) == (int(ignored), int(not ignored))
    assert (tracked.ignored, tracked.fp, tracked.fn) == (int(ignored), int(not ignored), 0)
    assert tracked.longest_false_positive_run == int(not ignored)


def test_scored_labels_are_matched_before_the_ignore_rules():
    labels = boxes_of((0, 1, CAR), (0, -1, (0, 0, 500, 500)), ignore=np.array([False, True]))
    found = boxes_of((0, 1, CAR, 1.0), (0, 2, moved(20), 0.5))
    scores = evaluate_detections(found, labels)
    assert (scores.tp, scores.fp, scores.fn, scores.ignored) == (1, 0, 0, 1)
    assert scores == evaluate_detections(found, labels, ignored_as_regions=True)
    assert evaluate_tracks(found, labels).ignored == 1
    assert evaluate_detections(boxes_of((0, 1, moved(300), 1.0)), labels).fn == 1


def test_a_ratio_without_a_count_is_nan_and_none_in_json():
    labels = boxes_of((0, 1, CAR))
    empty = evaluate_detections(TrackTable([], [], []), labels)
    assert (empty.tp, empty.fn, empty.recall, empty.f1, empty.average_precision) == (0, 1, 0, 0, 0)
    assert math.isnan(empty.precision)
    nothing = evaluate_detections(TrackTable([], [], []), TrackTable([], [], []))
    assert nothing.frames == 0
    assert math.isnan(nothing.f1)
    tracked = evaluate_tracks(TrackTable([], [], []), TrackTable([], [], []))
    assert math.isnan(tracked.mota)
    for scores in (empty, nothing, tracked):
        assert "n/a" in str(scores)
        data = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
        assert data["mean_iou"] is None
    assert empty.to_dict()["by_size"]["small"]["f1"] is None
    assert math.isnan(evaluate_detections(labels, TrackTable([], [], [])).recall)


def test_predictions_marked_ignore_are_left_out():
    labels = boxes_of((0, 1, CAR), (0, -1, moved(500)), ignore=np.array([False, True]))
    assert evaluate_detections(labels, labels).ignored == 0
    assert evaluate_tracks(labels, labels).mota == 1


@pytest.mark.parametrize("evaluate", [evaluate_detections, evaluate_tracks])
def test_frames_are_checked(evaluate):
    labels, found = boxes_of((0, 1, CAR), (1, 1, CAR)), boxes_of((0, 1, CAR))
    assert evaluate(found, labels, frames=[0]).fn == 0
    assert evaluate(found, labels, frames=[0, 1, 2]).frames == 3
    for sides, options, message in (
        ((found, labels), {"frames": [1, 2]}, "predictions hold frame 0, which is not among the 2 frames"),
        ((found, labels), {"frames": [0, 1, 1]}, "frames must differ, got 1 more than once"),
        ((found, labels), {"frames": ["a"]}, r"frame keys must be all numbers .* 'a' in frames"),
        ((boxes_of(("x", 1, CAR)), labels), {}, "frame keys must be .* 'x' in predictions, 0 in labels"),
        ((found.boxes, labels), {}, r"predictions must be a TrackTable, .*TrackTable\.from_detections"),
        ((found, {}), {}, "labels must be a TrackTable"),
        ((found, labels), {"iou": 0}, "iou must be a number, greater than 0"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            evaluate(*sides, **options)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        pytest.param(["07.jpg", "08.jpg"], ["07", "09"], id="suffix"),
        pytest.param(["07"], ["in/07.png"], id="folder and suffix of the labels"),
        pytest.param(["../in/07.jpg"], ["in/07.jpg"], id="longer path"),
        pytest.param(["07.5.jpg", "07.6.jpg"], ["07.5"], id="names with dots"),
        pytest.param(["07.jpg"], ["in\\07.jpg", "in\\08.jpg"], id="backslashes"),
        pytest.param(["a\u0308.jpg"], ["in/\u00e4.png"], id="letters of macOS"),
    ],
)
def test_frame_names_may_differ_by_folder_and_suffix(ours, theirs):
    found, labels = (boxes_of(*((name, 1, CAR) for name in names)) for names in (ours, theirs))
    scores = evaluate_detections(found, labels)
    assert (scores.tp, scores.fn, scores.fp) == (1, len(theirs) - 1, len(ours) - 1)
    assert evaluate_tracks(found, labels).tp == 1
    chosen = evaluate_detections(found[:1], labels, frames=theirs)
    assert (chosen.tp, chosen.frames) == (1, len(theirs))


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        pytest.param(["a/07.jpg"], ["b/07.jpg"], id="other folders"),
        pytest.param(["a/07.jpg", "b/07.jpg"], ["07"], id="two predicted frames"),
        pytest.param(["07"], ["07.jpg", "07.png"], id="two labelled frames"),
    ],
)
def test_frame_names_that_may_be_of_other_images_are_refused(ours, theirs):
    found, labels = (boxes_of(*((name, 1, CAR) for name in names)) for names in (ours, theirs))
    message = r"frame names of predictions and labels differ: .*07.* and .*07.*with TrackTable\.renamed"
    with pytest.raises(InvalidInputError, match=message):
        evaluate_detections(found, labels)


def test_no_common_frame_is_a_warning(caplog):
    evaluate_detections(boxes_of(("a.jpg", 1, CAR)), boxes_of(("a_jpg.rf.1b.jpg", 1, CAR)))
    assert "predictions and labels share no frame; they hold 'a.jpg' and 'a_jpg" in caplog.text


def same(first, second):
    """Equal scores; NaN equals NaN, and sums may run in another order."""
    one, two = first.to_dict(), second.to_dict()
    sizes = one.pop("by_size", {}), two.pop("by_size", {})
    assert one == pytest.approx(two)
    for name in sizes[0]:
        assert sizes[0][name] == pytest.approx(sizes[1][name])


@given(labels=drives())
def test_perfect_predictions_score_one(labels):
    scores, tracked = evaluate_detections(labels, labels), evaluate_tracks(labels, labels)
    assert scores.precision == scores.recall == scores.f1 == scores.average_precision == scores.mean_iou == 1
    assert tracked.mota == tracked.idf1 == tracked.f1 == 1
    assert tracked.id_switches == tracked.longest_false_positive_run == 0
    assert math.isnan(tracked.jitter) or tracked.jitter == 0


@given(trial=trials())
def test_scores_are_consistent(trial):
    scores, tracked = evaluate_detections(*trial), evaluate_tracks(*trial)
    for each in (scores, tracked):
        assert each.tp + each.fn == len(trial[1])
        assert each.tp + each.fp + each.ignored == len(trial[0])
        assert 0.5 <= each.mean_iou <= 1 or each.tp == 0
    for name in ("tp", "fp", "fn"):
        assert sum(getattr(size, name) for size in scores.by_size.values()) == getattr(scores, name)
    assert 0 <= scores.average_precision <= 1
    assert scores.average_precision <= scores.recall + 1e-12
    assert tracked.mota <= tracked.recall + 1e-12
    assert 0 <= tracked.idf1 <= 1


@given(trial=trials(), order=st.randoms(use_true_random=False))
def test_scores_are_invariant_to_track_ids_and_row_order(trial, order):
    found, labels = trial
    names = list(range(60))
    order.shuffle(names)
    rows = [list(range(len(side))) for side in (found, labels)]
    for side in rows:
        order.shuffle(side)
    renamed = []
    for side, chosen in zip((found, labels), rows):
        part = side[chosen]
        tracks = np.array(names)[part["track_id"]]
        renamed.append(
            TrackTable(part["frame"], tracks, part.boxes, score=part["score"], frame_keys=side.frame_keys)
        )
    same(evaluate_tracks(found, labels), evaluate_tracks(*renamed))


@given(trial=trials(), box=st.tuples(st.integers(2000, 2200), st.integers(0, 80)))
def test_a_prediction_in_an_ignored_region_changes_no_score(trial, box):
    found, labels = trial
    region = TrackTable(
        [*labels["frame"].tolist(), 0],
        [*labels["track_id"], -1],
        [*labels.boxes, (2000, 0, 2500, 300)],
        ignore=np.arange(len(labels) + 1) == len(labels),
        frame_keys=labels.frame_keys,
    )
    more = TrackTable(
        [*found["frame"].tolist(), 0],
        [*found["track_id"], 55],
        [*found.boxes, (*box, box[0] + 90, box[1] + 60)],
        score=[*found["score"], 9.0],
        frame_keys=found.frame_keys,
    )
    for evaluate in (evaluate_detections, evaluate_tracks):
        before, after = evaluate(found, region).to_dict(), evaluate(more, region).to_dict()
        assert after.pop("ignored") == before.pop("ignored") + 1
        assert after == before
