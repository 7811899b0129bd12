import math

import numpy as np
import pytest

from vehicle_detection.tracking import TrackParams
from vehicle_detection.tracking.kalman import (
    HistorySmoother,
    KalmanStates,
    Measurements,
    NearestSmoother,
    centers_and_sizes,
)
from vehicle_detection.tracking.track import TrackState

SHAPE = (720, 1280)
PARAMS = TrackParams(history_seconds=0.4, nearest_weight=0.3)
FIRST = np.array([[100.0, 100, 140, 140]])


def states_of(smoother, boxes):
    mean, cov = smoother.initiate(Measurements.from_boxes(boxes, SHAPE))
    count = len(boxes)
    return KalmanStates(mean, cov, np.zeros((count, 4)), np.zeros((count, 3)), np.zeros((count, 3, 3)))


def follow(smoother, boxes, dt):
    """States of one track after each box."""
    states, track = states_of(smoother, boxes[:1]), TrackState(score=1.0)
    found = [states]
    for box in boxes[1:]:
        track.age += dt
        states = smoother.predict(states, np.zeros(1, np.bool_), dt)
        states = smoother.correct(states, [track], Measurements.from_boxes(box[None], SHAPE), dt)
        found.append(states)
    return found


@pytest.mark.parametrize("kind", [HistorySmoother, NearestSmoother])
def test_a_new_track_stays_at_its_detection(kind):
    boxes = np.array([[100.0, 100, 140, 120], [300, 200, 360, 260]])
    states = states_of(kind(PARAMS), boxes)
    np.testing.assert_allclose(states.boxes(), boxes)
    np.testing.assert_allclose(states.mean[:, 4:], 0)
    assert states.cov[1, 0, 0] > states.cov[0, 0, 0] > 0
    assert kind(PARAMS).predict(states, np.ones(2, np.bool_), 0.5) is states


def test_the_history_is_a_mean_of_the_last_boxes_with_falling_weights():
    dt = 0.1
    boxes = FIRST + 10.0 * np.arange(8)[:, None]
    for count, states in enumerate(follow(HistorySmoother(PARAMS), boxes, dt)):
        ages = np.arange(max(count - 4, 0), count + 1)  # those of the last 0.4 s
        weights = 1 - (count - ages) * dt / (0.4 + dt)
        expected = np.average(centers_and_sizes(boxes[ages]), axis=0, weights=weights)
        np.testing.assert_allclose(states.mean[0, :4], expected)


def test_the_nearest_box_draws_the_track_by_a_fraction_that_does_not_depend_on_the_frame_rate():
    target = FIRST[0] + 40.0
    (_, once) = follow(NearestSmoother(PARAMS), np.array([FIRST[0], target]), 0.04)
    np.testing.assert_allclose(once.boxes()[0], FIRST[0] + 0.3 * 40)
    (*_, twice) = follow(NearestSmoother(PARAMS), np.array([FIRST[0], target, target]), 0.04)
    (_, slow) = follow(NearestSmoother(PARAMS), np.array([FIRST[0], target]), 0.08)
    np.testing.assert_allclose(slow.boxes(), twice.boxes())


@pytest.mark.parametrize("kind", [HistorySmoother, NearestSmoother])
def test_the_velocity_is_a_moving_average_of_the_displacements(kind):
    dt = 0.1
    before, after = follow(kind(PARAMS), np.array([FIRST[0], FIRST[0] + 20.0]), dt)
    moved = (after.mean - before.mean)[0, :4]
    decay = math.exp(-dt / PARAMS.score_time_constant)
    assert moved[0] > 0
    np.testing.assert_allclose(after.mean[0, 4:], (1 - decay) * moved / dt)
    (_, _, later) = follow(kind(PARAMS), np.array([FIRST[0], FIRST[0] + 20.0, FIRST[0] + 20.0]), dt)
    moved_again = (later.mean - after.mean)[0, :4]
    expected = decay * after.mean[0, 4:] + (1 - decay) * moved_again / dt
    np.testing.assert_allclose(later.mean[0, 4:], expected)


@pytest.mark.parametrize("kind", [HistorySmoother, NearestSmoother])
def test_the_velocity_of_a_track_that_is_detected_now_and_then(kind):
    smoother, dt = kind(PARAMS), 0.04
    states, track = states_of(smoother, FIRST), TrackState(score=1.0)
    track.last_gap = 2 * dt
    for frame in range(3, 300, 3):
        track.age += 3 * dt
        box = Measurements.from_boxes(FIRST + 4.0 * frame, SHAPE)
        states = smoother.correct(states, [track], box, dt)
    np.testing.assert_allclose(states.mean[0, 4:6], 100, rtol=0.02)


def test_the_nearest_pairs_are_matched_first():
    predicted = np.array([[0.0, 0, 40, 40], [30, 0, 70, 40]])
    measured = np.array([[25.0, 0, 65, 40], [55, 0, 95, 40]])
    # The nearest pair is (1, 0), although it leaves the first track without a detection.
    assert NearestSmoother.match(predicted, measured, np.ones(2)) == [(1, 0)]
    assert NearestSmoother.match(predicted, measured, np.full(2, 2.0)) == [(1, 0), (0, 1)]
    assert NearestSmoother.match(predicted[:1], measured[:1], np.array([0.625])) == [(0, 0)]
    assert NearestSmoother.match(predicted[:1], measured[:1], np.array([0.62])) == []
