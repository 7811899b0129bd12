import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage

from vehicle_detection import Detections, InvalidInputError
from vehicle_detection.heatmap import (
    HeatHistory,
    HeatParams,
    add_heat,
    apply_threshold,
    bounding_boxes,
    frame_heat,
    label_boxes,
)

SHAPE = (12, 17)
EIGHT = np.ones((3, 3))


@st.composite
def windows(draw, elements):
    corners = draw(hnp.arrays(np.float64, (draw(st.integers(0, 7)), 4), elements=elements))
    low, high = np.minimum(corners[:, :2], corners[:, 2:]), np.maximum(corners[:, :2], corners[:, 2:])
    boxes = np.concatenate([low, high], axis=1)
    scores = draw(hnp.arrays(np.float64, len(boxes), elements=st.floats(-5, 5, width=16)))
    return Detections(boxes, scores)


heats = hnp.arrays(np.float32, SHAPE, elements=st.integers(0, 6).map(float))


def added_one_by_one(heat, boxes, weights):
    total = heat.astype(float)
    height, width = heat.shape
    for (x1, y1, x2, y2), weight in zip(np.rint(boxes).astype(int), weights):
        total[max(y1, 0) : max(min(y2, height), 0), max(x1, 0) : max(min(x2, width), 0)] += weight
    return total


@given(heats, windows(st.one_of(st.integers(-6, 24), st.floats(-30, 60, width=32))))
def test_heat_is_added_inside_windows(heat, found):
    counted, weighted, boxes = heat.copy(), heat.copy(), found.boxes.copy()
    # In place, as the course's code expects, and returned.
    assert add_heat(counted, found.boxes) is counted
    assert add_heat(weighted, found.boxes, scores=found.scores) is weighted
    np.testing.assert_array_equal(counted, added_one_by_one(heat, found.boxes, np.ones(len(found))))
    np.testing.assert_allclose(weighted, added_one_by_one(heat, found.boxes, found.scores), atol=1e-4)
    np.testing.assert_array_equal(found.boxes, boxes)


def test_rounding_errors_outside_windows_are_removed():
    boxes = [[0, 0, 5, 5], [3, 3, 9, 9], [1, 1, 4, 8]]
    heat = add_heat(np.zeros(SHAPE), boxes, scores=[0.1, 0.2, 0.7])
    covered = added_one_by_one(np.zeros(SHAPE), np.array(boxes), np.ones(3)) > 0
    np.testing.assert_array_equal(heat != 0, covered)


@pytest.mark.parametrize(
    ("start", "scores", "message"),
    [
        (255, None, r"dtype uint8 holds whole numbers from 0 to 255 only; the new heat is .* to 256"),
        (0, [-1.0], "the new heat is -1 to -1; start with"),
        (0, [0.5], "holds whole numbers .*; the new heat is 0.5 to 0.5; start with numpy.zeros"),
    ],
)
def test_integers_that_cannot_hold_the_heat_are_rejected(start, scores, message):
    heat = np.full((4, 4), start, np.uint8)
    with pytest.raises(InvalidInputError, match=message):
        add_heat(heat, [[0, 0, 2, 2]], scores=scores)
    assert (heat == start).all()


@given(heats, st.floats(0, 6))
def test_threshold_is_exclusive_and_applied_in_place(heat, threshold):
    hot = heat.copy()
    assert apply_threshold(hot, threshold) is hot
    np.testing.assert_array_equal(hot, np.where(heat > np.float32(threshold), heat, 0))
    np.testing.assert_array_equal(apply_threshold(hot.copy(), threshold), hot)


@given(heats, st.integers(0, 4))
def test_regions_equal_those_of_scipy(heat, threshold):
    before = heat.copy()
    found = label_boxes(heat, threshold=threshold)
    labels, count = ndimage.label(heat > threshold, EIGHT)
    regions = ndimage.find_objects(labels)
    expected = sorted(
        (rows.start, columns.start, columns.stop, rows.stop, heat[labels == index + 1].max())
        for index, (rows, columns) in enumerate(regions)
    )
    assert len(found) == count
    assert found.boxes.dtype == np.int64
    rows = [(y1, x1, x2, y2, peak) for (x1, y1, x2, y2), peak in found]
    assert sorted(rows) == expected
    # From top to bottom.
    assert [row[:2] for row in rows] == sorted(row[:2] for row in rows)
    np.testing.assert_array_equal(heat, before)


def part_around_the_peak(heat, labels, index, peak_fraction):
    own = np.where(labels == index, heat, 0)
    parts, _ = ndimage.label(own >= peak_fraction * own.max(), EIGHT)
    rows, columns = np.nonzero(parts == parts[np.unravel_index(own.argmax(), own.shape)])
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


@given(heats, st.integers(0, 2), st.floats(0.05, 0.99))
def test_peak_fraction_shrinks_the_box_around_the_peak(heat, threshold, peak_fraction):
    whole = label_boxes(heat, threshold=threshold)
    core = label_boxes(heat, threshold=threshold, peak_fraction=peak_fraction)
    np.testing.assert_array_equal(core.scores, whole.scores)
    assert (core.boxes[:, :2] >= whole.boxes[:, :2]).all()
    assert (core.boxes[:, 2:] <= whole.boxes[:, 2:]).all()
    labels, count = ndimage.label(heat > threshold, EIGHT)
    expected = [part_around_the_peak(heat, labels, index, peak_fraction) for index in range(1, count + 1)]
    assert sorted(core.boxes.tolist()) == sorted(map(list, expected))
    smaller = label_boxes(heat, threshold=threshold, peak_fraction=min(0.99, peak_fraction * 1.5))
    assert (smaller.boxes[:, :2] >= core.boxes[:, :2]).all()
    assert (smaller.boxes[:, 2:] <= core.boxes[:, 2:]).all()


@given(windows(st.integers(-6, 24)))
def test_bounding_boxes_combines_the_three_steps(found):
    counted = HeatParams(weighting="count", threshold=1, peak_fraction=0)
    expected = label_boxes(apply_threshold(add_heat(np.zeros(SHAPE), found.boxes), 1))
    result = bounding_boxes((*SHAPE, 3), found, params=counted)
    np.testing.assert_array_equal(result.boxes, expected.boxes)
    np.testing.assert_array_equal(result.scores, expected.scores)


def test_windows_are_weighted_by_their_scores():
    found = Detections([[0, 0, 5, 5], [10, 0, 15, 5], [5, 8, 9, 12]], [3.0, 1.0, -2.0])
    heat = frame_heat((*SHAPE, 3), found, HeatParams())
    assert (heat[0, 0], heat[0, 10], heat[9, 6]) == (3, 1, 0)
    result = bounding_boxes(SHAPE, found, params=HeatParams(threshold=2, peak_fraction=0))
    assert result.boxes.tolist() == [[0, 0, 5, 5]]
    assert result.scores.tolist() == [3]
    counted = bounding_boxes(SHAPE, found, params=HeatParams(weighting="count", threshold=0, peak_fraction=0))
    assert len(counted) == 3
    assert len(bounding_boxes(SHAPE, Detections.empty())) == 0


@given(st.lists(heats, min_size=1, max_size=5), st.integers(1, 4))
@settings(max_examples=20)
def test_history_is_the_mean_of_the_last_frames(maps, frames):
    history = HeatHistory(frames)
    for index, heat in enumerate(maps):
        given_map = heat.copy()
        mean = history.add(given_map)
        given_map[:] = 99  # the history holds a copy
        last = maps[max(0, index + 1 - frames) : index + 1]
        np.testing.assert_allclose(mean, np.mean(last, axis=0), rtol=1e-6)
        assert mean.dtype == np.float32
        mean[:] = 99
    assert HeatHistory(2).add(np.full((3, 2), 1.0)).tolist() == np.ones((3, 2)).tolist()
    history.add(np.full((3, 2), 8.0))
    assert history.add(np.full((2, 2), 1.0)).tolist() == np.ones((2, 2)).tolist()
    history.clear()
    assert history.add(np.full((2, 2), 5.0)).max() == 5


READ_ONLY = np.zeros(SHAPE)
READ_ONLY.setflags(write=False)
ONES, WINDOW = np.ones((3, 3)), [[0, 0, 1, 1]]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: add_heat(np.zeros((3, 4, 3)), []), r"heatmap must be .*numpy.zeros\(image"),
        (lambda: add_heat(READ_ONLY, []), "heatmap must be writable, because it is changed in place"),
        (lambda: add_heat(np.zeros((3, 3)), WINDOW * 2, scores=[1.0]), "scores must be"),
        (lambda: apply_threshold(READ_ONLY, 1), "heatmap must be writable"),
        (lambda: bounding_boxes(ONES, Detections.empty()), r"shape must be .*; pass image.shape"),
        (lambda: bounding_boxes(SHAPE, WINDOW), r"windows must be a Detections, .*weighting=\"count\""),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(InvalidInputError, match=message):
        call()
