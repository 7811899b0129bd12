import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection import Camera, Detections, RegionParams, find_vehicles, iou_matrix
from vehicle_detection.regions import fit_boxes, group_windows

SHAPE = (720, 1280)
CAMERA = Camera.for_frame(SHAPE)
DEFAULT = RegionParams()
# Fixed parameters for tests of behavior, because the defaults may be tuned.
PLAIN = RegionParams(
    min_peak=0.5, min_evidence=0.5, min_iou=0.4, suppression_radius=0.6, face_width=0.8, face_height=0.75,
    face_offset_y=0.05, flank_length_m=4.0, flank_shift=0.25, max_coverage=0.5, flank_peak_ratio=0.5,
)  # fmt: skip


def around(center, side, *, step=8, spread=2, peak=2.0):
    """Windows around a vehicle, as a search finds them: the score decreases with the distance."""
    offsets = np.arange(-spread, spread + 1) * step
    shifts = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    corners = np.array(center) + shifts - side / 2
    boxes = np.concatenate([corners, corners + side], axis=1)
    scores = peak - 0.03 * np.abs(shifts).sum(axis=1)
    return Detections(boxes, scores)


def groups_of(boxes, peaks=None):
    boxes = np.array(boxes, float).reshape(-1, 4)
    peaks = np.full(len(boxes), 2.0) if peaks is None else np.array(peaks, float)
    return Detections(boxes, peaks)


def window(x, side=100, y=450):
    return [x - side / 2, y - side / 2, x + side / 2, y + side / 2]


@st.composite
def any_windows(draw):
    count = draw(st.integers(0, 25))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    side = rng.uniform(0, 300, (count, 1)) * rng.integers(0, 8, (count, 1)).clip(0, 1)
    corner = rng.uniform(-200, 1300, (count, 2)) * (1, 0.6)
    boxes = np.concatenate([corner, corner + side * rng.uniform(0.7, 1.4, (count, 2))], axis=1)
    return Detections(boxes, rng.uniform(-1, 4, count))


def test_windows_around_a_vehicle_are_one_group_at_its_place():
    groups = group_windows(around((640.0, 420.0), 96), PLAIN)
    assert len(groups) == 1
    np.testing.assert_allclose(groups.boxes[0], [592, 372, 688, 468], atol=1e-6)
    assert groups.scores.tolist() == [2.0]


def test_the_mean_is_more_precise_than_the_step():
    # The vehicle lies between two positions of the search.
    windows = around((640.0, 420.0), 96)
    middle = np.array([642.5, 420.0])
    centers = (windows.boxes[:, :2] + windows.boxes[:, 2:]) / 2
    scores = 2 - 0.03 * np.abs(centers - middle).sum(axis=1)
    box = group_windows(Detections(windows.boxes, scores), PLAIN).boxes[0]
    assert 640.2 < (box[0] + box[2]) / 2 < 644
    assert (box[1] + box[3]) / 2 == pytest.approx(420)


def test_the_size_of_a_group_is_the_mean_of_logarithmic_sizes():
    small, large = window(640, 80), window(640, 100)
    groups = group_windows(Detections([small, large], [1.0, 1.0]), dataclasses.replace(PLAIN, score_power=0))
    side = groups.boxes[0, 2] - groups.boxes[0, 0]
    assert 80 < side < 100
    # Windows of one size give that size.
    same = group_windows(Detections([small, small], [1.0, 0.5]), PLAIN)
    np.testing.assert_allclose(same.boxes[0], small)


def test_windows_that_overlap_too_little_do_not_join():
    # Shifted by half a window, the IoU is a third. They are within the radius, so they start no group either.
    found = Detections([window(640), window(690), window(690)], [2.0, 1.9, 1.9])
    groups = group_windows(found, PLAIN)
    np.testing.assert_allclose(groups.boxes, [window(640)])
    assert groups.scores.tolist() == [2.0]
    narrow = dataclasses.replace(PLAIN, suppression_radius=0.3)
    assert len(group_windows(found, narrow)) == 2


def test_two_vehicles_are_two_groups_best_first():
    found = around((400.0, 430.0), 90, peak=1.5) + around((700.0, 430.0), 120, peak=2.5)
    groups = group_windows(found, PLAIN)
    assert len(groups) == 2
    assert (groups.boxes[:, 0] < 500).tolist() == [False, True]
    assert groups.scores.tolist() == [2.5, 1.5]


def test_low_scores_and_single_windows_form_no_group():
    strict = dataclasses.replace(PLAIN, min_peak=1.0, min_evidence=2.0)
    assert len(group_windows(Detections([window(300), window(302)], [0.9, 0.9]), strict)) == 0
    assert len(group_windows(Detections([window(300)], [1.5]), strict)) == 0
    assert len(group_windows(Detections([window(300), window(302)], [1.5, 0.9]), strict)) == 1
    assert len(group_windows(Detections([window(300), window(302)], [1.0, 1.0]), strict)) == 1


def test_windows_at_or_below_zero_are_ignored():
    good = around((640.0, 420.0), 96)
    bad = Detections(good.boxes + 20, -np.abs(good.scores))
    with_bad = group_windows(bad + good, PLAIN)
    alone = group_windows(good, PLAIN)
    np.testing.assert_array_equal(with_bad.boxes, alone.boxes)
    np.testing.assert_array_equal(with_bad.scores, alone.scores)


def test_windows_without_area_are_ignored():
    flat = Detections([[10, 10, 10, 50], [10, 10, 50, 10], [5, 5, 5, 5]], [3.0, 3.0, 3.0])
    assert len(group_windows(flat, PLAIN)) == 0
    assert len(group_windows(flat + around((640.0, 420.0), 96), PLAIN)) == 1


@given(any_windows())
def test_groups_satisfy_the_thresholds(found):
    before = found.boxes.copy(), found.scores.copy()
    groups = group_windows(found, PLAIN)
    assert (groups.scores >= PLAIN.min_peak).all()
    assert (np.diff(groups.scores) <= 0).all()
    assert np.isfinite(groups.boxes).all()
    assert (groups.boxes[:, 2:] > groups.boxes[:, :2]).all()
    assert np.isin(groups.scores, found.scores).all()
    np.testing.assert_array_equal(found.boxes, before[0])
    np.testing.assert_array_equal(found.scores, before[1])


@given(any_windows(), st.floats(0.5, 4), st.floats(-500, 500))
def test_groups_translate_and_scale_with_their_windows(found, factor, shift):
    groups = group_windows(found, PLAIN)
    moved = group_windows(Detections(found.boxes * factor + shift, found.scores), PLAIN)
    # Rounding may change the result for an IoU at the threshold.
    if len(moved) == len(groups):
        np.testing.assert_allclose(moved.boxes, groups.boxes * factor + shift, rtol=1e-6, atol=1e-3)
    else:
        assert abs(len(moved) - len(groups)) <= 1


def test_the_box_of_a_vehicle_straight_ahead_is_its_face():
    square, low = window(640), [590, 420, 690, 480]
    for box, face in ((square, [600, 417.5, 680, 492.5]), (low, [600, 430.5, 680, 475.5])):
        found = fit_boxes(groups_of([box]), CAMERA, SHAPE, PLAIN)
        np.testing.assert_allclose(found.boxes, [face])
        assert found.scores.tolist() == [2.0]


def test_the_box_of_a_vehicle_in_another_lane_includes_its_side():
    sides = [640, 760, 900, 1050]
    found = [fit_boxes(groups_of([window(x)]), CAMERA, SHAPE, PLAIN).boxes[0] for x in sides]
    widths = [box[2] - box[0] for box in found]
    assert widths == sorted(widths)
    assert widths[0] == pytest.approx(80)
    assert widths[-1] > 90
    for x, box in zip(sides[1:], found[1:]):
        # The center of the whole vehicle is nearer to the vanishing point than that of its face.
        assert (box[0] + box[2]) / 2 < x
        assert box[0] < x - 40
    heights = {round(box[3] - box[1], 6) for box in found}
    assert heights == {75}


def test_a_nearer_vehicle_shows_more_of_its_side():
    widths = []
    for side in (60, 120, 240):
        # The same lateral position: the nearer, the farther from the middle of the image.
        x = 640 + 1.5 * side
        box = fit_boxes(groups_of([window(x, side)]), CAMERA, SHAPE, PLAIN).boxes[0]
        widths.append((box[2] - box[0]) / side)
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]


@given(any_windows())
def test_results_are_symmetric_to_left_and_right(found):
    groups = group_windows(found, PLAIN)
    mirrored = groups.boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (1280, 0, 1280, 0)
    boxes = fit_boxes(groups, CAMERA, SHAPE, PLAIN)
    other = fit_boxes(Detections(mirrored, groups.scores), CAMERA, SHAPE, PLAIN)
    expected = other.boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (1280, 0, 1280, 0)
    np.testing.assert_allclose(boxes.boxes, expected, atol=1e-6)


@given(
    any_windows(), st.sampled_from([PLAIN, RegionParams(), dataclasses.replace(PLAIN, face_offset_y=-0.5)])
)
def test_boxes_lie_inside_the_frame(found, params):
    boxes = find_vehicles(found, CAMERA, SHAPE, params)
    height, width = SHAPE
    assert ((boxes.boxes >= 0) & (boxes.boxes <= (width, height, width, height))).all()
    assert (boxes.boxes[:, 2:] > boxes.boxes[:, :2]).all()
    assert (boxes.scores >= params.min_peak).all()


def test_boxes_are_clipped_at_the_border():
    for x, border, edge in ((0, 0, 0), (1280, 1280, 2)):
        (box,) = fit_boxes(groups_of([window(x, 120)]), CAMERA, SHAPE, PLAIN).boxes
        assert box[edge] == border
        assert box[2] - box[0] >= 40


def test_faces_outside_the_frame_are_dropped():
    outside = groups_of([window(-80), window(1400), window(640, 100, -70), window(640, 100, 800)])
    assert len(fit_boxes(outside, CAMERA, SHAPE, PLAIN)) == 0


def test_of_two_overlapping_faces_the_better_one_is_kept():
    near = groups_of([window(640), window(650)], [2.0, 1.5])
    assert fit_boxes(near, CAMERA, SHAPE, PLAIN).scores.tolist() == [2.0]
    reversed_order = groups_of([window(650), window(640)], [1.5, 2.0])
    assert fit_boxes(reversed_order, CAMERA, SHAPE, PLAIN).scores.tolist() == [2.0]


def test_vehicles_side_by_side_are_kept():
    apart = groups_of([window(540), window(640), window(740)], [2.0, 1.0, 1.5])
    assert len(fit_boxes(apart, CAMERA, SHAPE, PLAIN)) == 3


def test_a_face_on_the_side_of_another_vehicle_is_dropped():
    # A near vehicle far to the right: its side extends a third of a window towards the middle.
    vehicle = window(1000, 240)
    (box,) = fit_boxes(groups_of([vehicle]), CAMERA, SHAPE, PLAIN).boxes
    flank = window(box[0] + 18, 40)
    face = [1000 - 96, 0, 1000 + 96, 0]
    assert iou_matrix([flank], [[face[0], 354, face[2], 546]])[0, 0] < 0.2
    # Even a better one is dropped, unless the vehicle's score is much lower.
    for peaks, left in (([2.0, 1.0], [2.0]), ([1.5, 2.0], [1.5]), ([0.9, 2.0], [2.0, 0.9])):
        found = fit_boxes(groups_of([vehicle, flank], peaks), CAMERA, SHAPE, PLAIN)
        assert sorted(found.scores, reverse=True) == left


def test_find_vehicles_groups_and_fits():
    found = around((400.0, 430.0), 90, peak=1.5) + around((900.0, 430.0), 120, peak=2.5)
    both = find_vehicles(found, CAMERA, SHAPE, PLAIN)
    steps = fit_boxes(group_windows(found, PLAIN), CAMERA, SHAPE, PLAIN)
    np.testing.assert_array_equal(both.boxes, steps.boxes)
    np.testing.assert_array_equal(both.scores, steps.scores)
    default = find_vehicles(found, CAMERA, SHAPE)
    np.testing.assert_array_equal(default.boxes, find_vehicles(found, CAMERA, SHAPE, RegionParams()).boxes)


class TestDefaults:
    """Effects of the default parameters: each test fails if its parameter is disabled."""

    def test_windows_of_other_sizes_on_a_vehicle_form_no_second_group(self):
        small = around((420.0, 440.0), 64, step=6, peak=1.4)
        large = around((400.0, 430.0), 128, peak=2.5)
        assert len(group_windows(large + small, DEFAULT)) == 1

    def test_neighbors_with_overlapping_windows_form_two_groups(self):
        found = around((400.0, 430.0), 100, spread=1) + around((480.0, 430.0), 100, spread=1)
        assert len(group_windows(found, DEFAULT)) == 2
