import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection import TrackParams, iou_matrix
from vehicle_detection.tracking.association import (
    center_distances,
    distinct_vehicles,
    hidden_edges,
    match_approaching,
    match_boxes,
    merged_detections,
    nearer_cover,
)

NONE = np.empty((0, 4))


def boxes_at(*centers, side=40.0):
    """Squares around centers."""
    middle = np.array(centers, float)
    return np.hstack([middle - side / 2, middle + side / 2])


def random_boxes(rng, count):
    corners, sides = rng.uniform(0, 150, (count, 2)), rng.uniform(20, 60, (count, 2))
    return np.hstack([corners, corners + sides])


def test_distances_are_in_mean_widths_and_heights():
    first, second = np.array([[0.0, 0, 40, 20]]), np.array([[30.0, 20, 50, 60], [0.0, 0, 40, 20]])
    # Centers (20, 10) and (40, 40); mean width 30, mean height 30.
    np.testing.assert_allclose(center_distances(first, second), [[math.hypot(20 / 30, 30 / 30), 0]])
    empty = np.array([[5.0, 5, 5, 5]])  # boxes without an area: in pixels
    np.testing.assert_allclose(center_distances(empty, empty + np.array([3, 4, 3, 4])), [[5]])


@pytest.mark.parametrize(("shift", "pairs"), [(40.0, [(0, 0)]), (40.1, [])])
def test_the_largest_distance_is_inclusive(shift, pairs):
    assert match_boxes(boxes_at((50, 50)), boxes_at((50 + shift, 50)), np.array([1.0])) == pairs


@pytest.mark.parametrize(("side", "pairs"), [(80.0, [(0, 0)]), (80.5, []), (20.1, [(0, 0)]), (19.8, [])])
def test_areas_differ_by_a_factor_of_four_at_most(side, pairs):
    assert match_boxes(boxes_at((50, 50)), boxes_at((50, 50), side=side), np.array([1.0])) == pairs


def test_pairs_that_overlap_too_little_leave_their_boxes_to_others():
    # Without the limit, both tracks have a detection, the first one with an IoU of 1/3.
    predicted, measured = boxes_at((50, 50), (80, 50)), boxes_at((70, 50), (100, 50))
    largest = np.array([1.0, 1.0])
    assert match_boxes(predicted, measured, largest) == [(0, 0), (1, 1)]
    assert match_boxes(predicted, measured, largest, min_iou=0.5) == [(1, 0)]


def cost(predicted, measured, limit):
    """Cost of a pair, and whether it is allowed."""
    distance = center_distances(predicted[None], measured[None])[0, 0] / limit
    areas = [np.prod(box[2:] - box[:2]) for box in (predicted, measured)]
    ratio = abs(math.log(areas[0] / areas[1]))
    iou = iou_matrix(predicted[None], measured[None])[0, 0]
    return 1 - iou + distance + 0.3 * ratio, bool(distance <= 1 and ratio <= math.log(4))


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 4))
def test_pairs_have_the_least_cost_of_all_assignments(seed, rows, columns):
    rng = np.random.default_rng(seed)
    predicted, measured = random_boxes(rng, rows), random_boxes(rng, columns)
    limit = rng.uniform(0.3, 1.5, rows)
    pairs = match_boxes(predicted, measured, limit)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)

    def total(assignment):
        costs = [cost(predicted[row], measured[column], limit[row]) for row, column in assignment]
        return sum(value if allowed else 1e3 for value, allowed in costs)

    count = min(rows, columns)
    best = min(
        total(zip(chosen, order))
        for chosen in itertools.combinations(range(rows), count)
        for order in itertools.permutations(range(columns), count)
    )
    assert total(pairs) + 1e3 * (count - len(pairs)) == pytest.approx(best)


def test_a_better_or_known_box_hides_a_weaker_one():
    params = TrackParams()
    boxes = np.array([[0.0, 0, 40, 40], [2, 0, 42, 40], [100, 0, 140, 40], [200, 0, 240, 40]])
    assert distinct_vehicles(boxes, [1, 0, 2, 3], NONE, params) == [1, 2, 3]
    assert distinct_vehicles(boxes, [1, 0, 2, 3], boxes[2:3] + 1, params) == [1, 3]
    assert distinct_vehicles(boxes, [], boxes, params) == []
    assert distinct_vehicles(NONE, [], NONE, params) == []


def test_a_box_inside_a_known_one_is_no_vehicle():
    known, inside = np.array([[0.0, 0, 100, 100]]), np.array([[10.0, 10, 40, 40]])
    assert iou_matrix(known, inside)[0, 0] < 0.1
    assert distinct_vehicles(inside, [0], known, TrackParams()) == []


def test_a_box_over_two_predictions_is_merged():
    predicted = np.array([[0.0, 0, 40, 40], [35, 0, 75, 40], [200, 0, 240, 40]])
    both = np.array([[0.0, 0, 75, 40], [200, 0, 240, 40]])
    assert merged_detections(predicted, both, {0: 0, 2: 1}) == ({0}, {1: 0})
    assert merged_detections(predicted, both, {0: 0, 1: 1, 2: 1}) == (set(), {})
    assert merged_detections(predicted, both, {}) == (set(), {})


def test_a_box_that_fits_a_prediction_is_not_merged():
    predicted = np.array([[0.0, 0, 40, 40], [20, 0, 40, 40]])
    assert merged_detections(predicted, np.array([[0.0, 0, 44, 40]]), {0: 0}) == (set(), {})
    # Nor is one that covers the other prediction in part only.
    predicted = np.array([[0.0, 0, 40, 40], [50, 0, 90, 40]])
    assert merged_detections(predicted, np.array([[0.0, 0, 70, 40]]), {0: 0}) == (set(), {})


@pytest.mark.parametrize(
    ("lower", "expected"), [(0.05, [0, 0]), (0.15, [0, 0.5]), (-0.05, [0, 0]), (-0.15, [0.5, 0])]
)
def test_a_vehicle_is_covered_by_one_whose_bottom_edge_is_clearly_lower(lower, expected):
    # Two boxes of 100 by 80 pixels, the first of which is farther right by half of its width.
    boxes = np.array([[550.0, 400, 650, 480], [500.0, 400, 600, 480]])
    boxes[0, [1, 3]] += 80 * lower
    both = np.array([True, True])
    # The box of the nearer one is enlarged by 3 percent of its size on each side.
    margin = 0.03 * (expected != [0, 0])
    height = 1 - max(abs(lower) - 0.03, 0)
    found = nearer_cover(boxes, both)
    np.testing.assert_allclose(found, np.array(expected) * (1 + 2 * margin) * height, atol=1e-9)
    assert nearer_cover(boxes, ~both).tolist() == [0, 0]


def test_the_nearer_vehicle_that_covers_most_counts():
    far, left, right = [500.0, 400, 600, 480], [450.0, 400, 530, 500], [540.0, 400, 640, 520]
    found = nearer_cover(np.array([far, left, right]), np.ones(3, np.bool_))
    np.testing.assert_allclose(found, [0.63, 0, 0], atol=1e-9)
    assert nearer_cover(NONE, np.empty(0, np.bool_)).shape == (0,)


FOCUS, FRAME = (640.0, 400.0), (720, 1280)


def approaching(box, growth):
    """A box after a vehicle has come nearer, around `FOCUS`."""
    center = np.tile(FOCUS, 2)
    return np.asarray(center + (np.asarray(box) - center) * growth)


def test_a_nearer_vehicle_hides_the_edge_that_it_stands_beside():
    car = [100.0, 100, 160, 150]
    beside = {
        "left": [40.0, 90, 98, 180],
        "right": [158.0, 90, 240, 180],
        "apart": [40.0, 90, 90, 180],
        "farther": [40.0, 90, 98, 140],
        "below": [40.0, 140, 98, 200],
    }
    expected = {"left": [0], "right": [2]}
    for name, other in beside.items():
        tracked = np.array([car, other])
        found = hidden_edges(tracked[:1], tracked, [0], np.ones(2, np.bool_))
        assert np.flatnonzero(found[0]).tolist() == expected.get(name, []), name
        assert not hidden_edges(tracked[:1], tracked, [0], np.array([True, False])).any()
    # A vehicle does not hide itself, and boxes are of the tracks in `rows`.
    tracked = np.array([car, beside["left"]])
    assert not hidden_edges(tracked[1:], tracked, [1], np.ones(2, np.bool_)).any()
    assert hidden_edges(NONE, NONE, [], np.empty(0, np.bool_)).shape == (0, 4)


def test_a_vehicle_that_comes_nearer_is_found_far_from_its_last_box():
    boxes = np.array([[235.0, 398, 317, 442], [700, 410, 760, 450]])
    measured = np.array([approaching(boxes[0], 1.2), boxes[1]])
    assert iou_matrix(boxes[:1], measured[:1])[0, 0] < 0.1
    assert match_approaching(boxes, measured, FOCUS, FRAME) == [(0, 0), (1, 1)]
    assert match_approaching(boxes, measured[::-1], FOCUS, FRAME) == [(0, 1), (1, 0)]


@pytest.mark.parametrize(
    "measured",
    [
        [100.0, 398, 182, 442],  # moves sideways and does not grow
        [270, 398, 348, 439],  # moves away
        [90, 340, 190, 390],  # leaves the road
        [-560, 397, -396, 485],  # is twice as near
    ],
)
def test_other_boxes_are_no_approaching_vehicle(measured):
    box = np.array([[235.0, 398, 317, 442]])
    assert match_approaching(box, np.array([measured]), FOCUS, FRAME) == []
    assert match_approaching(box[:0], np.array([measured]), FOCUS, FRAME) == []
    assert match_approaching(box, np.empty((0, 4)), FOCUS, FRAME) == []


def test_an_approaching_vehicle_may_leave_the_frame():
    box = np.array([[30.0, 395, 170, 462]])
    measured = approaching(box[0], 1.2).clip(0)
    assert measured[0] == 0
    assert match_approaching(box, measured[None], FOCUS, FRAME) == [(0, 0)]
