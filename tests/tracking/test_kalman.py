import numpy as np
import pytest

from vehicle_detection import Camera, TrackParams
from vehicle_detection.tracking.distance import initiate_states
from vehicle_detection.tracking.kalman import (
    UNKNOWN,
    KalmanSmoother,
    Measurements,
    boxes_from_states,
    centers_and_sizes,
    coasted_distance,
    exit_times,
    initiate,
    predict,
    update,
)

SHAPE = (720, 1280)
BOXES = np.array([[600.0, 400, 700, 490], [100, 300, 180, 420]])


def moving_states():
    """Means, covariances and noise densities of two moving boxes."""
    mean, cov = initiate(BOXES, np.full((2, 4), 5.0))
    mean[:, 4:] = [[30.0, -4.0, 6.0, 3.0], [-80.0, 2.0, 9.0, 8.0]]
    return mean, cov, np.full((2, 4), 7.0)


def corrected(mean, cov, edges, variance, *, innovation_mean=0.0, reject_outliers=False):
    innovation_mean = np.broadcast_to(innovation_mean, (2, 4))
    return update(mean, cov, innovation_mean, edges, variance, np.full(2, reject_outliers), 0.1)


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


# --- against the equations of a Kalman filter, one track at a time ---

# Edges from [cx, cy, w, h] and velocities.
EDGES = np.hstack([[[1, 0, -0.5, 0], [0, 1, 0, -0.5], [1, 0, 0.5, 0], [0, 1, 0, 0.5]], np.zeros((4, 4))])


def textbook(mean, cov, edges, variance):
    """Corrected state of one track."""
    gain = cov @ EDGES.T @ np.linalg.inv(EDGES @ cov @ EDGES.T + np.diag(variance))
    return mean + gain @ (edges - EDGES @ mean), (np.eye(8) - gain @ EDGES) @ cov


def predicted_states():
    mean, cov, density = moving_states()
    return predict(mean, cov, 0.2, density)


def normalized(mean, cov, edges, variance):
    return (edges - EDGES @ mean) / np.sqrt(np.diag(EDGES @ cov @ EDGES.T) + variance)


def test_a_new_state_has_the_errors_of_its_edges():
    edge_std = np.array([[1.0, 2.0, 3.0, 4.0]])
    mean, cov = initiate(BOXES[:1], edge_std)
    np.testing.assert_allclose(EDGES @ cov[0] @ EDGES.T, np.diag([1, 4, 9, 16.0]), atol=1e-9)
    # Speeds in widths and heights per second.
    np.testing.assert_allclose(np.sqrt(np.diag(cov[0])[4:]), np.array([100, 90, 100, 90]) * [2, 1, 0.7, 0.7])
    assert not cov[0, :4, 4:].any()
    assert not mean[0, 4:].any()


def test_velocities_move_boxes_and_their_noise_is_that_of_constant_velocity():
    mean, cov, density = moving_states()
    moved, grown = predict(mean, cov, 0.2, density)
    np.testing.assert_allclose(moved[:, :4], mean[:, :4] + 0.2 * mean[:, 4:])
    np.testing.assert_allclose(moved[:, 4:], mean[:, 4:])
    variance, speed = cov[0, 0, 0], cov[0, 4, 4]
    assert grown[0, 0, 0] == pytest.approx(variance + 0.2**2 * speed + 7 * 0.2**3 / 3)
    assert grown[0, 0, 4] == pytest.approx(0.2 * speed + 7 * 0.2**2 / 2)
    assert grown[0, 4, 4] == pytest.approx(speed + 7 * 0.2)
    tiny = predict(mean - 99 * np.eye(8)[2], cov, 0.2, density)[0]
    assert tiny[0, 2] == 4.0


def test_a_correction_is_that_of_the_textbook():
    mean, cov = predicted_states()
    edges = boxes_from_states(mean) + np.array([[3.0, -2, 5, 1], [-4, 2, 0, 6]])
    variance = np.array([[25.0, 16, 25, 9], [30, 20, 10, 40]])
    before = np.array([[0.5, 0, 0, 0], [0, -1, 0, 0.2]])
    after, after_cov, innovation = corrected(mean, cov, edges, variance, innovation_mean=before)
    for row in range(2):
        expected = textbook(mean[row], cov[row], edges[row], variance[row])
        np.testing.assert_allclose(after[row], expected[0])
        np.testing.assert_allclose(after_cov[row], expected[1], atol=1e-9)
        errors = normalized(mean[row], cov[row], edges[row], variance[row])
        assert np.abs(errors).max() < 2.5
        np.testing.assert_allclose(innovation[row], 0.75 * before[row] + 0.25 * errors)


def test_the_variance_of_an_outlier_grows_with_its_square():
    mean, cov = predicted_states()
    edges = boxes_from_states(mean) + np.array([[0, 0, 250.0, 0], [0, 0, 0, -150.0]])
    variance = np.full((2, 4), 25.0)
    after, _, innovation = corrected(mean, cov, edges, variance)
    for row in range(2):
        errors = normalized(mean[row], cov[row], edges[row], variance[row])
        assert np.abs(errors).max() > 2.5
        expected, _ = textbook(mean[row], cov[row], edges[row], 25 * np.maximum((errors / 2.5) ** 2, 1))
        np.testing.assert_allclose(after[row], expected)
        np.testing.assert_allclose(innovation[row], 0.25 * np.clip(errors, -6, 6))


def test_only_the_outliers_of_merged_boxes_are_rejected():
    mean, cov = predicted_states()
    shift = np.array([[0, 0, 250.0, 0], [0, 0, 0, 2.0]])
    edges, variance = boxes_from_states(mean) + shift, np.full((2, 4), 25.0)
    after, _, innovation = corrected(mean, cov, edges, variance, reject_outliers=True)
    expected, _ = textbook(mean[0], cov[0], edges[0], np.array([25, 25, UNKNOWN, 25]))
    np.testing.assert_allclose(after[0], expected)
    np.testing.assert_allclose(after[1], textbook(mean[1], cov[1], edges[1], variance[1])[0])
    assert not innovation.any()


def states_of(mean, cov):
    return initiate_states(mean, cov, Camera.for_frame(SHAPE))


def test_the_growth_that_counts_as_approach_is_limited():
    mean, cov, _ = moving_states()
    mean[:, 6:] = mean[:, 2:4] * [[5.0], [-5.0]]
    moved = KalmanSmoother(TrackParams()).predict(states_of(mean, cov), np.zeros(2, np.bool_), 0.1).mean
    np.testing.assert_allclose(moved[:, 4:], mean[:, 4:] * np.exp([[0.6], [-0.6]]))


def test_errors_of_coasting_tracks_are_limited():
    mean, cov, _ = moving_states()
    states = states_of(mean, 1e6 * cov)
    found = KalmanSmoother(TrackParams()).predict(states, np.ones(2, np.bool_), 0.04)
    std = np.sqrt(found.cov[:, np.arange(8), np.arange(8)])
    sizes = found.mean[:, [2, 3, 2, 3]]
    np.testing.assert_allclose(std, np.hstack([0.5 * sizes, 2 * sizes]))
    np.testing.assert_allclose(found.cov, found.cov.transpose(0, 2, 1))


def test_a_truncated_box_is_extended_beyond_the_border():
    boxes = np.array([[0.0, 300, 60, 400], [1220, 300, 1280, 400], [0, 300, 1280, 400], [600, 300, 650, 400]])
    mean, cov = KalmanSmoother(TrackParams()).initiate(Measurements.from_boxes(boxes, SHAPE))
    expected = boxes.copy()
    expected[0, 0], expected[1, 2] = 60 - 150, 1220 + 150
    np.testing.assert_allclose(boxes_from_states(mean), expected)
    std = np.sqrt(np.einsum("ij,njk,ik->ni", EDGES, cov, EDGES))
    noise = TrackParams().measurement_noise
    np.testing.assert_allclose(std[0], [0.3 * 150, 100 * noise, 60 * noise, 100 * noise])
    np.testing.assert_allclose(std[1], [60 * noise, 100 * noise, 0.3 * 150, 100 * noise])
    np.testing.assert_allclose(std[3], np.array([50, 100, 50, 100]) * noise)


def test_a_box_that_reaches_the_border_as_predicted_is_not_corrected_there():
    smoother, boxes = KalmanSmoother(TrackParams()), np.array([[1200.0, 300, 1300, 400]])
    states = states_of(*initiate(boxes, np.full((1, 4), 5.0)))
    inside = Measurements.from_boxes(np.array([[1200.0, 300, 1280, 400]]), SHAPE)
    after = smoother.correct(states, np.zeros(1), inside, 0.04)
    np.testing.assert_allclose(after.boxes(), boxes, atol=1e-3)
    # A prediction that ends before the border is corrected.
    states = states_of(*initiate(np.array([[1200.0, 300, 1260, 400]]), np.full((1, 4), 5.0)))
    assert smoother.correct(states, np.zeros(1), inside, 0.04).boxes()[0, 2] > 1262


def test_an_edge_where_a_nearer_vehicle_begins_corrects_little():
    smoother, boxes = KalmanSmoother(TrackParams()), np.array([[600.0, 300, 700, 400]])
    states = states_of(*initiate(boxes, np.full((1, 4), 5.0)))
    step = np.array([[0.0, 0, 10, 0]])
    hidden = np.array([[False, False, True, False]])

    def right_edge(measured, hidden):
        measurements = Measurements.from_boxes(measured, SHAPE, hidden=hidden)
        return smoother.correct(states, np.zeros(1), measurements, 0.04).boxes()[0, 2]

    assert 700 - right_edge(boxes - step, hidden) < 0.1 * (700 - right_edge(boxes - step, False))
    # A vehicle that is visible beyond its predicted edge reaches at least as far.
    assert right_edge(boxes + step, hidden) == right_edge(boxes + step, False) > 702


def test_the_motion_of_a_vehicle_that_was_not_detected_for_long_is_unknown():
    smoother = KalmanSmoother(TrackParams())
    mean, cov, _ = moving_states()
    states = states_of(mean, cov)._replace(innovation_mean=np.ones((2, 4)))
    gaps = np.array([0.4, 0.6])
    measured = Measurements.from_boxes(BOXES + 9.0, SHAPE)
    after = smoother.correct(states, gaps, measured, 0.08)
    for column, new in zip(after, smoother.initiate(measured)):
        np.testing.assert_allclose(column[1], new[1])
    assert not after.innovation_mean[1].any()
    # After a shorter time, and where it is merged with another vehicle, the state is only corrected.
    np.testing.assert_allclose(after.mean[0, 4], 30, atol=5)
    merged = Measurements.from_boxes(BOXES + 9.0, SHAPE, merged=True)
    np.testing.assert_allclose(smoother.correct(states, gaps, merged, 0.08).mean[1, 4], -80, atol=5)


def test_the_way_of_a_coasting_track_is_the_integral_of_its_speed():
    mean = np.array([[0.0, 0, 100, 50, -30, 20, 0, 0]])
    # Its speed of 0.4 heights per second was greater before, by a factor e in 1.5 s.
    times = np.linspace(0, 0.6, 10_001)
    expected = np.trapezoid(0.4 * np.exp(times / 1.5), times)
    np.testing.assert_allclose(coasted_distance(mean, np.array([0.6])), [expected], rtol=1e-6)
    assert coasted_distance(mean, np.zeros(1)) == 0


def test_exit_times():
    boxes = np.array([[0, 400, 100, 480], [0, 400, 100, 480], [1180, 400, 1280, 480], [600, 400, 700, 480.0]])
    mean, _ = initiate(boxes, np.ones((4, 4)))
    mean[:, 4] = [-200.0, 200.0, 400.0, -400.0]
    np.testing.assert_allclose(exit_times(mean, SHAPE[:2]), [0.5, np.inf, 0.25, np.inf])
