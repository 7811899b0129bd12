import numpy as np
import pytest

from vehicle_detection.camera import Camera
from vehicle_detection.tracking.kalman_filter import (
    UNKNOWN,
    Measurements,
    boxes_from_states,
    centers_and_sizes,
    initiate,
    initiate_states,
    predict,
    update,
    update_distances,
)

SHAPE = (720, 1280)
CAMERA = Camera.for_frame(SHAPE, horizon_std_px=0.0)
BOXES = np.array([[600.0, 400, 700, 490], [100, 300, 180, 420]])


def moving_states():
    """Means, covariances and noise densities of two moving boxes."""
    mean, cov = initiate(BOXES, np.full((2, 4), 5.0))
    mean[:, 4:] = [[30.0, -4.0, 6.0, 3.0], [-80.0, 2.0, 9.0, 8.0]]
    return mean, cov, np.full((2, 4), 7.0)


def corrected(mean, cov, edges, variance, *, innovation_mean=None, reject_outliers=False):
    if innovation_mean is None:
        innovation_mean = np.zeros((2, 4))
    return update(mean, cov, innovation_mean, edges, variance, np.full(2, reject_outliers), 0.75)


def test_boxes_and_states_are_inverse():
    mean, _, _ = moving_states()
    np.testing.assert_allclose(boxes_from_states(mean), BOXES)
    np.testing.assert_allclose(centers_and_sizes(BOXES), mean[:, :4])


def test_two_predictions_equal_one_over_the_whole_time():
    mean, cov, density = moving_states()
    once = predict(mean, cov, 0.3, density)
    twice = predict(*predict(mean, cov, 0.1, density), 0.2, density)
    for one, two in zip(once, twice, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-9)


def test_prediction_over_no_time_changes_nothing():
    mean, cov, density = moving_states()
    for before, after in zip((mean, cov), predict(mean, cov, 0.0, density), strict=True):
        np.testing.assert_array_equal(before, after)


def test_correction_moves_the_state_towards_the_box_and_reduces_its_covariance():
    mean, cov, density = moving_states()
    mean, cov = predict(mean, cov, 0.04, density)
    after, after_cov, _ = corrected(mean, cov, boxes_from_states(mean) + 4.0, np.full((2, 4), 25.0))
    moved = boxes_from_states(after) - boxes_from_states(mean)
    assert ((moved > 0) & (moved < 4)).all()
    assert (np.linalg.eigvalsh(cov - after_cov) > -1e-9).all()


def test_edges_of_unknown_position_are_ignored():
    mean, cov, _ = moving_states()
    variance = np.array([[25.0, 25.0, UNKNOWN, 25.0]] * 2)
    results = [
        corrected(mean, cov, boxes_from_states(mean) + np.array([3.0, 1.0, right, 1.0]), variance)[0]
        for right in (0.0, 500.0)
    ]
    np.testing.assert_allclose(*results, atol=0.02)


def test_outliers_move_the_state_less_and_can_be_rejected():
    mean, cov, _ = moving_states()
    edges, variance = boxes_from_states(mean) + 200.0, np.full((2, 4), 25.0)
    moved = [
        np.abs(corrected(mean, cov, edges, variance, reject_outliers=reject)[0] - mean)[:, :2].max()
        for reject in (False, True)
    ]
    assert moved[0] < 100
    assert moved[1] < 0.1


def first_range(box, *, camera=CAMERA):
    """Distance, and its standard error, after the first measurement of a vehicle."""
    boxes = np.array([box])
    states = initiate_states(*initiate(boxes, np.ones((1, 4))), camera)
    states = update_distances(states, Measurements.from_boxes(boxes, SHAPE), camera, 0.04, 0.04)
    return states.range_mean[0, 0], np.sqrt(states.range_cov[0, 0, 0])


def box_at(distance, *, width=1.8, camera=CAMERA):
    """Box of a vehicle straight ahead."""
    pixel = camera.focal_px / distance
    bottom = camera.horizon_px + pixel * camera.height_m
    return [640 - pixel * width / 2, bottom - pixel * 1.5, 640 + pixel * width / 2, bottom]


@pytest.mark.parametrize("distance", [8.0, 20.0, 40.0])
def test_first_distance_of_a_vehicle_is_that_of_the_pinhole_camera(distance):
    estimate, std = first_range(box_at(distance))
    assert estimate == pytest.approx(distance)
    assert 0 < std < 0.4 * distance


def test_truncated_edges_do_not_contribute_to_the_distance():
    by_bottom, by_width = (
        CAMERA.focal_px * CAMERA.height_m / (520 - CAMERA.horizon_px),
        CAMERA.focal_px * CAMERA.vehicle_width_m / 160,
    )
    assert first_range([1100.0, 420, 1280, 520])[0] == pytest.approx(by_bottom)
    assert first_range([560.0, 420, 720, 720])[0] == pytest.approx(by_width)
    assert first_range([1100.0, 420, 1280, 720])[1] > 500


def test_an_uncertain_horizon_gives_more_weight_to_the_width():
    box = box_at(30.0)
    fixed, uncertain = (
        Camera.for_frame(SHAPE, horizon=0.5, horizon_std_px=std, height_std_m=0.0) for std in (0.0, 40.0)
    )
    assert first_range(box, camera=fixed)[0] < 26
    assert first_range(box, camera=uncertain)[0] == pytest.approx(30.0, rel=0.15)


def test_inputs_are_not_modified():
    mean, cov, density = moving_states()
    copies = mean.copy(), cov.copy()
    predict(mean, cov, 0.1, density)
    corrected(mean, cov, boxes_from_states(mean) + 90.0, density, innovation_mean=np.full((2, 4), 5.0))
    states = initiate_states(mean, cov, CAMERA)
    before = [column.copy() for column in states]
    update_distances(states, Measurements.from_boxes(BOXES, SHAPE), CAMERA, 0.04, 0.04)
    np.testing.assert_array_equal(mean, copies[0])
    np.testing.assert_array_equal(cov, copies[1])
    for column, copy in zip(states, before, strict=True):
        np.testing.assert_array_equal(column, copy)
