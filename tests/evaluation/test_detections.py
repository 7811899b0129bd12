import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.evaluation.cases import CAR, boxes_of, moved, trials
from vehicle_detection import InvalidInputError, TrackTable, evaluate_detections
from vehicle_detection.evaluation import best_f1, precision_recall_curve


def test_counts_ratios_and_sizes_by_hand():
    small, large = (0, 100, 50, 140), (300, 0, 500, 100)
    labels = boxes_of((0, 1, CAR), (0, 2, small), (1, 1, large))
    found = boxes_of(
        (0, -1, CAR, 2.0), (0, -1, moved(20), 1.0), (1, -1, (300, 0, 500, 80), 0.5), (1, -1, small, 0.1)
    )
    scores = evaluate_detections(found, labels, frames=range(4))
    assert (scores.tp, scores.fp, scores.fn, scores.frames) == (2, 2, 1, 4)
    assert (scores.precision, scores.recall) == (0.5, 2 / 3)
    assert scores.f1 == 4 / 7
    assert scores.false_positives_per_frame == 0.5
    assert scores.mean_iou == pytest.approx(0.9)
    sizes = {name: (size.tp, size.fp, size.fn) for name, size in scores.by_size.items()}
    assert sizes == {"small": (0, 1, 1), "medium": (1, 1, 0), "large": (1, 0, 0)}
    assert scores.by_size["large"].mean_iou == pytest.approx(0.8)


def test_average_precision_by_hand():
    labels = boxes_of(*((0, index, moved(200 * index)) for index in range(3)))
    found = boxes_of(
        (0, -1, CAR, 0.9), (0, -1, moved(900), 0.8), (0, -1, moved(200), 0.7), (0, -1, moved(1200), 0.6)
    )
    precision, recall, thresholds = precision_recall_curve(found, labels)
    np.testing.assert_allclose(precision, [1, 1 / 2, 2 / 3, 1 / 2])
    np.testing.assert_allclose(recall, [1 / 3, 1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_allclose(thresholds, [0.9, 0.8, 0.7, 0.6])
    # A third of the recall at precision 1, the next third at 2/3.
    assert evaluate_detections(found, labels).average_precision == pytest.approx(1 / 3 + 2 / 9)


def test_equal_scores_are_one_point_of_the_curve():
    labels = boxes_of((0, 1, CAR))
    found = boxes_of((0, -1, moved(500), 1.0), (0, -1, CAR, 1.0))
    assert [part.tolist() for part in precision_recall_curve(found, labels)] == [[0.5], [1.0], [1.0]]
    assert evaluate_detections(found, labels).average_precision == 0.5


def test_the_higher_score_matches_and_the_other_is_false():
    labels = boxes_of((0, 1, CAR))
    found = boxes_of((0, -1, CAR, 1.0), (0, -1, moved(10), 2.0))
    scores = evaluate_detections(found, labels)
    assert (scores.tp, scores.fp) == (1, 1)
    assert scores.mean_iou == pytest.approx(90 / 110)
    # Without scores the better fit comes first.
    assert evaluate_detections(TrackTable(found["frame"], None, found.boxes), labels).mean_iou == 1


@pytest.mark.parametrize(
    ("ignored_box", "ignored"),
    [
        pytest.param((-100, -100, 400, 200), True, id="inside"),
        pytest.param((50, 0, 400, 60), True, id="half inside"),
        pytest.param((51, 0, 400, 60), False, id="less than half inside"),
        pytest.param((40, 20, 60, 40), False, id="around the ignored box"),
        pytest.param((100, 0, 400, 60), False, id="beside it"),
    ],
)
def test_ignored_boxes_as_regions(ignored_box, ignored):
    labels = boxes_of((0, 4, ignored_box), ignore=[True])
    found = boxes_of((0, 7, CAR, 1.0))
    assert evaluate_detections(found, labels).fp == 1
    scores = evaluate_detections(found, labels, ignored_as_regions=True)
    assert (scores.ignored, scores.fp) == (int(ignored), int(not ignored))


def test_the_curve_with_ignored_boxes_as_regions():
    labels = boxes_of((0, 1, moved(500)), (0, 2, (0, 0, 300, 90)), ignore=np.array([False, True]))
    found = boxes_of((0, -1, CAR, 2.0), (0, -1, moved(500), 1.0))
    assert precision_recall_curve(found, labels)[0].tolist() == [0.0, 0.5]
    precision, recall, thresholds = precision_recall_curve(found, labels, ignored_as_regions=True)
    assert [each.tolist() for each in (precision, recall, thresholds)] == [[1.0], [1.0], [1.0]]


def test_a_curve_needs_scores():
    labels = boxes_of((0, 1, CAR))
    with pytest.raises(InvalidInputError, match="predictions need scores for a curve"):
        precision_recall_curve(labels, labels)
    assert [part.size for part in precision_recall_curve(TrackTable([], [], []), labels)] == [0, 0, 0]


@given(trial=trials(), data=st.data())
def test_ignored_boxes_as_regions_only_remove_false_positives(trial, data):
    found, labels = trial
    ignore = np.array(data.draw(st.lists(st.booleans(), min_size=len(labels), max_size=len(labels))), bool)
    labels = TrackTable(labels["frame"], labels["track_id"], labels.boxes, ignore=ignore)
    plain, lenient = (evaluate_detections(found, labels, ignored_as_regions=each) for each in (False, True))
    assert (lenient.tp, lenient.fn) == (plain.tp, plain.fn)
    assert lenient.fp + lenient.ignored == plain.fp + plain.ignored
    assert lenient.fp <= plain.fp
    # NaN where nothing is left to find.
    assert not lenient.average_precision < plain.average_precision - 1e-12


@given(trial=trials())
def test_the_curve_equals_the_scores_at_every_threshold(trial):
    found, labels = trial
    precision, recall, thresholds = precision_recall_curve(found, labels)
    assert (np.diff(thresholds) < 0).all()
    assert (np.diff(recall) >= 0).all()
    for index, threshold in enumerate(thresholds):
        scores = evaluate_detections(found[found["score"] >= threshold], labels)
        assert (scores.precision, scores.recall) == (precision[index], recall[index])


@given(trial=trials())
def test_best_f1_is_the_maximum_over_all_thresholds(trial):
    found, labels = trial
    if not len(found):
        return
    f1, threshold = best_f1(*precision_recall_curve(found, labels))
    assert evaluate_detections(found[found["score"] >= threshold], labels).f1 == pytest.approx(f1)
    assert all(
        evaluate_detections(found[found["score"] >= each], labels).f1 <= f1 + 1e-12 for each in found["score"]
    )
