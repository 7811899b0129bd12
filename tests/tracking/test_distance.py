import math

import numpy as np
import pytest

from vehicle_detection import Camera, Detections, Tracker
from vehicle_detection.tracking.distance import (
    estimate_distances,
    initiate_states,
    predict_distances,
    update_distances,
)
from vehicle_detection.tracking.kalman import Measurements, initiate

SHAPE = (720, 1280)
CAMERA = Camera.for_frame(SHAPE, horizon_std_px=0.0)
BOXES = np.array([[600.0, 400, 700, 490], [100, 300, 180, 420]])


def first_range(box, *, camera=CAMERA, hidden=False):
    """Distance, and its standard error, after the first measurement of a vehicle."""
    boxes = np.array([box])
    states = initiate_states(*initiate(boxes, np.ones((1, 4))), camera)
    measured = Measurements.from_boxes(boxes, SHAPE, hidden=hidden)
    states = update_distances(states, measured, camera, 0.04, 0.04)
    return states.range_mean[0, 0], np.sqrt(states.range_cov[0, 0, 0])


def box_at(distance, *, width=CAMERA.vehicle_width_m, camera=CAMERA):
    """Box of a vehicle straight ahead, which ends at its tires."""
    pixel = camera.focal_px / distance
    bottom = camera.horizon_px + camera.focal_px * camera.height_m / (distance + camera.overhang_m)
    return [640 - pixel * width / 2, bottom - pixel * 1.5, 640 + pixel * width / 2, bottom]


@pytest.mark.parametrize("distance", [8.0, 20.0, 40.0])
def test_first_distance_of_a_vehicle_is_that_of_the_pinhole_camera(distance):
    estimate, std = first_range(box_at(distance))
    assert estimate == pytest.approx(distance)
    assert 0 < std < 0.4 * distance


def test_truncated_edges_do_not_contribute_to_the_distance():
    by_bottom = CAMERA.focal_px * CAMERA.height_m / (520 - CAMERA.horizon_px) - CAMERA.overhang_m
    by_width = CAMERA.focal_px * CAMERA.vehicle_width_m / 160
    assert first_range([1100.0, 420, 1280, 520])[0] == pytest.approx(by_bottom)
    assert first_range([560.0, 580, 720, 720])[0] == pytest.approx(by_width)
    assert first_range([1100.0, 420, 1280, 720])[1] > 500


def test_the_first_distance_is_that_of_the_better_measurement():
    # 8 m away by its bottom edge, 10 m by its width.
    near, far = box_at(8.0), box_at(10.0)
    box = [far[0], near[3] - (far[3] - far[1]), far[2], near[3]]
    camera = Camera.for_frame(SHAPE, horizon_std_px=40.0)
    assert first_range(box, camera=camera)[0] == pytest.approx(10.0)
    assert first_range(box)[0] < 9.8  # the horizon is known, and the width corrects the distance
    # Without a visible width, the bottom edge must do.
    box = [0.0, box[1], near[2] - near[0], near[3]]
    assert first_range(box, camera=camera)[0] == pytest.approx(8.0)


def ranges(mean, cov):
    """States of a track with these first values; the others keep their priors."""
    states = initiate_states(*initiate(BOXES[:1], np.ones((1, 4))), CAMERA)
    count = len(mean)
    states.range_mean[0, :count] = mean
    states.range_cov[0, :count, :count] = cov
    return states


def test_distances_are_predicted_at_constant_speed():
    cov = np.array([[4.0, 0.5, 0.1, 0], [0.5, 9.0, 0.2, 0], [0.1, 0.2, 0.04, 0], [0, 0, 0, 0.5]])
    before = ranges([30.0, -5.0, 0.1, 0.3, 2.0], np.zeros((5, 5)))
    before.range_cov[0, :4, :4] = cov
    found = predict_distances(before, 0.2, CAMERA)
    # The error of the horizon returns to 0 within a second.
    np.testing.assert_allclose(found.range_mean, [[29.0, -5.0, 0.1, 0.3, 2 * math.exp(-0.2), 0, 0]])
    horizon = CAMERA.total_horizon_std_px**2 * (1 - math.exp(-0.4))
    np.testing.assert_allclose(np.diag(found.range_cov[0])[4:6], [horizon, before.range_cov[0, 5, 5]])
    transition = np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    expected = transition @ cov @ transition.T
    expected[:2, :2] += 1.5**2 * np.array([[0.2**3 / 3, 0.2**2 / 2], [0.2**2 / 2, 0.2]])
    expected[2, 2] += (CAMERA.vehicle_width_std_m / CAMERA.vehicle_width_m) ** 2 * 0.2 / 20
    np.testing.assert_allclose(found.range_cov[0, :4, :4], expected)
    for start, speed, end in ((2.0, -50.0, 1.0), (499.0, 50.0, 500.0)):
        assert predict_distances(ranges([start, speed, 0, 0], cov), 0.2, CAMERA).range_mean[0, 0] == end


def test_the_bottom_edge_of_an_oncoming_vehicle_has_less_weight():
    """A barrier may hide its wheels."""
    box = np.array([[100.0, CAMERA.horizon_px, 200, CAMERA.horizon_px + 40]])
    changes = []
    for speed, middle in ((-2.0, False), (-20.0, False), (-20.0, True)):
        # The left edge is truncated, so that the width is no measurement.
        boxes = np.where([True, False, middle, False], [0, 0, 700, 0], box)
        states = ranges([20.0, speed, 0.0, 0.0], np.diag([9.0, 4.0, 0.02, 0.6]))
        found = update_distances(states, Measurements.from_boxes(boxes, SHAPE), CAMERA, 0.04, 0.04)
        changes.append(found.range_mean[0, 0] - 20.0)
    near, oncoming, in_this_lane = changes
    assert near == in_this_lane > 0
    assert 0 < oncoming < near / 2


@pytest.mark.parametrize(
    ("mean", "limited"),
    [([0.5, 1, -2, -9], [1, 1, -0.7, -3]), ([900, 1, 2, 20], [500, 1, 0.9, 8]), ([9, 1, 0, 0], [9, 1, 0, 0])],
)
def test_distance_width_and_length_are_limited(mean, limited):
    measured = Measurements.from_boxes(BOXES[:1], SHAPE, merged=True)  # it shows neither edge
    found = update_distances(ranges(mean, np.eye(4)), measured, CAMERA, 0.04, 0.04)
    np.testing.assert_allclose(found.range_mean[0, :4], limited)


@pytest.mark.parametrize(
    ("distance_std", "speed_std", "age", "known"),
    [
        (8.0, 6.0, 0.5, (True, True)),
        (8.1, 6.0, 0.5, (False, False)),
        (8.0, 6.1, 0.5, (True, False)),
        (8.0, 6.0, 0.51, (False, False)),
    ],
)
def test_distances_and_speeds_are_stated_where_they_are_known(distance_std, speed_std, age, known):
    camera = Camera.for_frame(SHAPE, focal_std=0.1)
    states = ranges([20.0, -3.0, 0.0], np.diag([distance_std**2, speed_std**2, 0.1]))
    (found,) = estimate_distances(states, np.array([age]), camera)
    distance = (20.0, math.hypot(distance_std, 2.0)) if known[0] else (None, None)
    speed = (-3.0, math.hypot(speed_std, 0.3)) if known[1] else (None, None)
    for value, expected in zip(found.values(), (*distance, *speed), strict=True):
        assert value == (expected if expected is None else pytest.approx(expected))


def test_a_box_that_a_nearer_vehicle_covers_is_a_weaker_measurement():
    width = np.array([[600.0, 380.0, 660.0, 430.0]])  # narrower than before: part of it is hidden

    def distance(covered):
        boxes = np.array([[600.0, 380.0, 680.0, 446.0]])
        states = initiate_states(*initiate(boxes, np.ones((1, 4))), CAMERA)
        for box, fraction in ((boxes, 0.0), (boxes, 0.0), (width, covered)):
            measured = Measurements.from_boxes(box, SHAPE, covered=fraction)
            states = update_distances(states, measured, CAMERA, 0.08, 0.04)
        return states.range_mean[0, 0], states.range_cov[0, 0, 0] / states.range_mean[0, 0] ** 2

    visible, partial, hidden = distance(0.0), distance(0.1), distance(0.5)
    # The narrower a box, the farther the vehicle seems.
    assert hidden[0] < partial[0] < visible[0]
    assert visible[1] < partial[1] < hidden[1]


@pytest.mark.parametrize("edge", [0, 2])
def test_the_width_of_a_vehicle_behind_another_one_is_a_lower_bound(edge):
    hidden = np.arange(4) == edge
    states = ranges([20.0, 0.0, 0.0, 0.0], np.diag([9.0, 4.0, 0.02, 0.6]))

    def distance(width, **options):
        box = np.array([box_at(20.0, width=width)])
        box[:, 3] = 720  # its bottom edge is truncated
        measured = Measurements.from_boxes(box, SHAPE, **options)
        return update_distances(states, measured, CAMERA, 0.04, 0.04).range_mean[0, 0]

    assert distance(1.2) > 20.5
    assert distance(1.2, hidden=hidden) == 20
    # A part that is wider than expected shows that the vehicle is nearer, or wider.
    assert distance(2.2, hidden=hidden) == distance(2.2) < 19.5
    # Above a vehicle, nothing is hidden.
    assert distance(1.2, hidden=np.array([False, True, False, False])) == distance(1.2)


def test_the_first_distance_of_a_vehicle_behind_another_one_is_not_that_of_its_width():
    half, camera = box_at(30.0, width=0.9), Camera.for_frame(SHAPE, horizon_std_px=20.0)
    hidden = [False, False, True, False]
    assert first_range(half, camera=camera)[0] > 50
    assert first_range(half, camera=camera, hidden=hidden)[0] == pytest.approx(30)
    # Without a visible bottom edge, its distance is unknown.
    assert first_range([*half[:3], 720.0], hidden=hidden)[1] > 500


def follow(distances, *, height_m=1.5, speed=0.0, shift=0.0, **options):
    """State after boxes at these distances, one each tenth of a second, whose width is not visible."""
    states = None
    for distance in distances:
        box = np.array([box_at(distance)])
        box += [[0, shift, 0, shift]]
        box[:, 1] = box[:, 3] - CAMERA.focal_px * height_m / (distance + CAMERA.overhang_m)
        if states is None:
            states = initiate_states(*initiate(box, np.ones((1, 4))), CAMERA)
            states.range_mean[0, 1] = speed
        else:
            states = predict_distances(states, 0.1, CAMERA)
        # A nearer vehicle hides a part of its side.
        measured = Measurements.from_boxes(box, SHAPE, hidden=[True, False, False, False], **options)
        states = update_distances(states, measured, CAMERA, 0.1, 0.04)
    return states.range_mean[0], np.sqrt(np.diag(states.range_cov[0]))


@pytest.mark.parametrize("height_m", [1.4, 3.5])
def test_growth_gives_the_speed_of_cars_and_trucks(height_m):
    distances = 40 - 10 * 0.1 * np.arange(20)
    mean, std = follow(distances, height_m=height_m)
    assert mean[1] == pytest.approx(-10, abs=1.0)
    assert std[1] < 2


def test_a_shifted_horizon_changes_neither_the_speed_nor_the_stated_error_for_long():
    distances = 30 - 5 * 0.1 * np.arange(20)
    level, pitched = (follow(distances, shift=shift) for shift in (0.0, 4.0))
    assert pitched[0][1] == pytest.approx(level[0][1], abs=0.7)
    assert pitched[0][0] == pytest.approx(distances[-1], abs=2 * pitched[1][0])


def test_a_nearer_vehicle_that_hides_the_bottom_edge_leaves_the_distance_unknown():
    distances = np.full(5, 30.0)
    assert follow(distances)[1][0] < 5
    boxes = np.array([box_at(45.0)])
    states = initiate_states(*initiate(boxes, np.ones((1, 4))), CAMERA)
    hidden = [True, False, False, True]
    measured = Measurements.from_boxes(boxes, SHAPE, hidden=hidden)
    assert update_distances(states, measured, CAMERA, 0.1, 0.04).range_cov[0, 0, 0] > 500**2


def test_the_distance_does_not_depend_on_the_frame_rate():
    """The side of the car is visible, and the horizon is unknown and not in the middle."""
    found, distances = Detections([[890.5, 410, 1000, 472.8]], [5.0]), {}
    for fps, every in ((10, 1), (25, 2), (30, 2), (50, 4), (60, 5), (120, 10)):
        tracker = Tracker(fps=fps, camera=Camera.dashcam(fov=58))
        for frame in range(0, 2 * fps, every):
            (track,) = tracker.update(found, SHAPE, time=frame / fps)
        distances[fps] = track.distance_m
    assert max(distances.values()) < 1.05 * min(distances.values())


@pytest.mark.parametrize("fps", [10, 25, 60])
def test_the_distance_of_a_vehicle_whose_side_is_visible_is_that_of_its_rear_at_once(fps):
    """A box of the course's video, 19 m away by its bottom edge: the horizon lies at 0.575 of the height."""
    tracker, found = (
        Tracker(fps=fps, camera=Camera.dashcam(fov=58)),
        Detections([[957, 411, 1113, 491]], [5.0]),
    )
    for frame in range(fps):
        (track,) = tracker.update(found, SHAPE, time=frame / fps)
        if track.distance_m is not None:
            assert abs(track.distance_m - 19) < min(track.distance_std_m, 5)
    assert track.distance_m is not None


def test_a_distance_does_not_drift_while_a_vehicle_brakes_and_accelerates():
    tracker, ratios = Tracker(fps=10, camera=Camera.dashcam(fov=58)), []
    for distance in 15 + 2 * np.sin(2 * math.pi * np.arange(400) / 50):
        (track,) = tracker.update(Detections([box_at(distance)], [5.0]), SHAPE)
        ratios.append((track.distance_m or math.nan) / distance)
    assert np.mean(ratios[-50:]) == pytest.approx(1, abs=0.07)
