import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.boxes import greedy_nms, iou_matrix, overlap_matrices
from vehicle_detection.mixture import vote_boxes
from vehicle_detection.mixture.boxes import ScoredWindows, mostly_inside, nms, whole_vehicles


def random_windows(count, seed):
    rng = np.random.default_rng(seed)
    corners, sides = rng.uniform(0, 100, (count, 2)), rng.uniform(5, 60, (count, 2))
    margins = -np.sort(-rng.normal(0, 1, count).round(1))
    return ScoredWindows(np.hstack([corners, corners + sides]), margins, rng.integers(0, 3, count))


@given(
    count=st.integers(0, 40),
    seed=st.integers(0, 1000),
    min_margin=st.floats(-1.5, 1.5),
    max_boxes=st.integers(1, 9),
)
def test_voting_keeps_the_best_window_of_each_group(count, seed, min_margin, max_boxes):
    windows = random_windows(count, seed)
    kept, vote_mass = vote_boxes(windows, min_margin=min_margin, max_boxes=max_boxes)
    assert len(kept) <= max_boxes
    assert kept.boxes.shape == (len(kept), 4)
    assert (kept.margins >= min_margin).all()
    assert (np.diff(kept.margins) <= 0).all()
    assert len(kept) > 0 or not (windows.margins >= min_margin).any()
    if len(kept):
        assert kept.margins[0] == windows.margins[0]
        assert (kept.boxes >= windows.boxes.min(axis=0) - 1e-9).all()
        assert (kept.boxes <= windows.boxes.max(axis=0) + 1e-9).all()
        # Windows below the minimum change boxes only, not which windows are kept.
        strong = windows[windows.margins >= min_margin]
        again, lower_mass = vote_boxes(strong, min_margin=min_margin, max_boxes=max_boxes)
        assert again.margins.tolist() == kept.margins.tolist()
        # A window votes for itself, and more windows only add votes.
        assert (vote_mass >= np.maximum(kept.margins + 1.1, 0) - 1e-9).all()
        assert (lower_mass <= vote_mass + 1e-9).all()


def test_a_box_is_the_mean_of_its_voters():
    boxes = np.array([[0.0, 0, 40, 40], [4, 0, 44, 40], [200, 0, 240, 40]])
    windows = ScoredWindows(boxes, np.array([1.0, 1.0, 0.5]), np.array([0, 1, 2]))
    kept, vote_mass = vote_boxes(windows, min_margin=0.0)
    np.testing.assert_allclose(kept.boxes, [[2, 0, 42, 40], [200, 0, 240, 40]])
    np.testing.assert_allclose(vote_mass, [4.2, 1.6])
    assert kept.templates.tolist() == [0, 2]


@given(count=st.integers(0, 30), seed=st.integers(0, 1000))
def test_nms_removes_the_weaker_of_two_overlapping_boxes(count, seed):
    windows = random_windows(count, seed)
    order = np.random.default_rng(seed).permutation(count)
    boxes, scores = windows.boxes[order], windows.margins[order]
    rows = nms(boxes, scores)
    assert len(set(rows.tolist())) == len(rows)
    assert (np.diff(scores[rows]) <= 0).all()
    kept = boxes[rows]
    assert (np.triu(iou_matrix(kept, kept), 1) <= 0.35).all()
    for row in set(range(count)) - set(rows.tolist()):
        (iou,), (cover,) = overlap_matrices(boxes[row, None], kept)
        better = scores[rows] >= scores[row]
        assert (((iou > 0.35) | (cover > 0.75)) & better).any()
    assert nms(kept, scores[rows]).tolist() == list(range(len(rows)))
    expected = greedy_nms(boxes, scores, max_iou=0.35, max_coverage=0.75)
    np.testing.assert_array_equal(rows, expected)


def test_the_minimum_margin_is_inclusive():
    windows = ScoredWindows(np.array([[0.0, 0, 9, 9], [20, 0, 29, 9]]), np.array([0.5, 0.25]), np.arange(2))
    for min_margin, templates in ((0.25, [0, 1]), (0.26, [0]), (0.6, [])):
        assert vote_boxes(windows, min_margin=min_margin)[0].templates.tolist() == templates


@pytest.mark.parametrize(
    ("other", "kept"),
    [
        ([40, 0, 140, 100], [0]),  # IoU 0.43
        ([50, 0, 150, 100], [0, 1]),  # IoU 0.33
        ([60, 10, 110, 30], [0]),  # 80% of it is covered
        ([65, 10, 115, 30], [0, 1]),  # 70%
    ],
)
def test_of_two_boxes_on_one_vehicle_the_better_one_is_kept(other, kept):
    boxes = np.array([[0, 0, 100, 100], other], float)
    assert nms(boxes, np.array([2.0, 1.0])).tolist() == kept


@pytest.mark.parametrize(
    ("other", "margin", "kept"),
    [
        ([150, 105, 250, 200], 0.9, [0]),  # half of it is on the vehicle, at the same distance
        ([150, 105, 250, 200], 1.1, [0, 1]),  # hardly worse
        ([150, 105, 250, 200], 3.1, [1]),
        ([165, 105, 265, 200], 0.9, [0, 1]),  # a third is
        ([150, 125, 250, 200], 0.9, [0, 1]),  # too low
        ([150, 84, 250, 184], 0.9, [0, 1]),  # its lower edge is farther away
    ],
)
def test_boxes_on_a_part_of_a_vehicle_are_removed(other, margin, kept):
    boxes = np.array([[0, 100, 200, 200], other], float)
    assert whole_vehicles(boxes, np.array([2.0, margin])).tolist() == kept
    rows = whole_vehicles(boxes[::-1], np.array([margin, 2.0]))
    assert sorted((1 - rows).tolist()) == kept


def test_more_than_a_third_of_a_box_must_be_visible():
    boxes = np.array(
        [[-65.0, 0, 35, 40], [-64, 0, 36, 40], [0, 280, 40, 380], [0, 264, 40, 364], [9, 9, 9, 9]]
    )
    assert mostly_inside(boxes, (300, 300)).tolist() == [False, True, False, True, False]


def test_the_best_windows_keep_their_order():
    windows = ScoredWindows(np.arange(16.0).reshape(4, 4), np.array([1.0, 3.0, 2.0, 3.0]), np.arange(4))
    assert windows.best(3).templates.tolist() == [1, 3, 2]
    assert windows.best(9).templates.tolist() == [1, 3, 2, 0]
