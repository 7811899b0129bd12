"""Extended Kalman filter of the distances of many tracks at once.

The state of a distance is ``[distance in m, speed in m/s, log(width / camera.vehicle_width_m), length error
in m]``. Width and length are part of the state: a truck seems near by its width until its bottom edge has
corrected it, and from then on its growth in the image gives the speed. The length matters where the side of
a vehicle is visible, and its error is relative to ``camera.vehicle_length_m``. In names, "range" is the
distance with this state. The distance is that of the vehicle's nearest part; its box ends at its tires,
``camera.overhang_m`` behind that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vehicle_detection._common import Floats
from vehicle_detection.camera import Camera
from vehicle_detection.tracking.kalman import KalmanStates, Measurements

_INITIAL_DISTANCE, _INITIAL_DISTANCE_STD, _INITIAL_RANGE_SPEED_STD = 30.0, 1e3, 40.0
_MIN_DISTANCE, _MAX_DISTANCE = 1.0, 500.0
# Least and greatest values of a state.
_LIMITS = np.array([[_MIN_DISTANCE, -np.inf, -0.7, -3.0], [_MAX_DISTANCE, np.inf, 0.9, 8.0]])
# Process noise of the speed (m/s per square root of a second).
_ACCELERATION = 1.5
# Times (s) in which the width's prior variance is added to its process noise, and over which errors that
# successive frames share (pitch, hills, how much of a side is seen) are correlated.
_WIDTH_TIME, _SYSTEMATIC_TIME = 20.0, 2.0
# Mean innovation of an edge (standard errors) above which a distance is uncertain, and the relative error
# that it then gains (per square root of a second).
_UNSETTLED, _UNSETTLED_STD = 1.5, 0.5
# Maximum relative error of a reported distance, without that of the focal length; maximum age of its last
# measurement (s), and error of a speed (m/s). A distance that is too small makes the speed and its error too
# small alike, so such vehicles pass the last limit first: stated speeds near -40 m/s are biased towards 0 by
# about one standard error.
_MAX_RANGE_STD, _MAX_RANGE_AGE, _MAX_RANGE_SPEED_STD = 0.4, 0.5, 6.0
# Fraction of a box that nearer vehicles cover, from which on it is no measurement, and relative error of the
# width of a box that they cover less.
_MAX_COVERED, _COVERED_STD = 0.3, 0.15
# Vehicles in another lane that approach fast are mostly oncoming, and a barrier may hide their wheels:
# minimum speed (m/s), length (m) of the side that their boxes lack, and relative error of the bottom edge.
_ONCOMING_SPEED, _ONCOMING_CUT, _ONCOMING_BOTTOM_STD = 15.0, 1.0, 0.3
# Fraction of the expected pixels below the horizon, under which their logarithm is continued by its tangent.
_LOG_LIMIT = 0.5
# Distance (m) below which the bottom edge is linearized again at the corrected distance.
_RELINEARIZED = 10.0
# Innovation in standard errors above which a measurement is an outlier.
_OUTLIER = 2.5
# Height of a box relative to that of a car of its width: below the first, the box shows a side of a vehicle;
# above the second, the logarithm of the width rises by `_WIDTH_OF_HEIGHT` times the height, to a truck's.
_MIN_TALLNESS, _TALL, _WIDTH_OF_HEIGHT, _MAX_TALL_WIDTH = 0.65, 1.15, 0.8, 0.34
# Aspect ratio above which a detector's boxes are narrower than the vehicle with its side.
_MAX_ASPECT = 1.5


def initiate_states(mean: Floats, cov: Floats, camera: Camera) -> KalmanStates:
    """Return the states of new tracks, whose distance is unknown, from those of their boxes."""
    count, width_std = (
        len(mean),
        math.hypot(camera.vehicle_width_std_m, camera.mean_width_std_m) / camera.vehicle_width_m,
    )
    length_std = camera.vehicle_length_std_m
    range_std = np.array([_INITIAL_DISTANCE_STD, _INITIAL_RANGE_SPEED_STD, width_std, length_std])
    range_mean = np.tile([_INITIAL_DISTANCE, 0.0, 0.0, 0.0], (count, 1))
    range_cov = np.tile(np.diag(np.square(range_std)), (count, 1, 1))
    return KalmanStates(mean, cov, np.zeros((count, 4)), range_mean, range_cov)


def predict_distances(states: KalmanStates, dt: float, camera: Camera) -> KalmanStates:
    """Predict distances by `dt` seconds."""
    transition = np.eye(4)
    transition[0, 1] = dt
    mean = states.range_mean @ transition.T
    mean[:, 0] = np.clip(mean[:, 0], _MIN_DISTANCE, _MAX_DISTANCE)
    noise = np.zeros((4, 4))
    noise[:2, :2] = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * _ACCELERATION**2
    noise[2, 2] = (camera.vehicle_width_std_m / camera.vehicle_width_m) ** 2 * dt / _WIDTH_TIME
    return states._replace(range_mean=mean, range_cov=transition @ states.range_cov @ transition.T + noise)


def update_distances(
    states: KalmanStates, measured: Measurements, camera: Camera, dt: float, correlation_time: float
) -> KalmanStates:
    """Correct distances by the bottom edge and the width of boxes (extended Kalman filter).

    The errors of a vehicle's boxes are correlated over `correlation_time` seconds.
    """
    mean, cov = states.range_mean.copy(), states.range_cov.copy()
    # While the edges of a box have not settled, or are partly covered, its distance is uncertain.
    unsettled = (np.abs(states.innovation_mean) > _UNSETTLED).any(axis=1)
    unsettled |= measured.covered > 0
    cov[:, 0, 0] += unsettled * np.square(_UNSETTLED_STD * mean[:, 0]) * dt
    # A merged box shows neither the bottom nor the width of its vehicles.
    visible = ~(measured.truncated | measured.merged[:, None])  # left, top, right, bottom
    visible &= (measured.covered < _MAX_COVERED)[:, None]
    bottom_visible, width_visible = visible[:, 3], visible[:, 0] & visible[:, 2]
    # Behind a nearer vehicle a box ends where its visible part does, and grows as its vehicle emerges: its
    # width is only a lower bound, as in a Kalman filter of censored measurements (Allik et al., *IEEE
    # Transactions on Control Systems Technology*, 2016).
    is_bound = measured.hidden[:, [0, 2]].any(axis=1)
    boxes, lateral_px = measured.road_boxes, measured.lateral_px
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    # (N, 2): the left and right edges, and the top and bottom edges, in pixels.
    edge_std = np.hypot(camera.bottom_std_px * camera.pixel_scale, camera.box_std * sides)
    horizon_std = camera.total_horizon_std_px
    # An error that n frames share must not average out among them: its variance is multiplied by n.
    box_frames, shared_frames = max(1.0, correlation_time / dt), max(1.0, _SYSTEMATIC_TIME / dt)
    below_horizon = boxes[:, 3] - camera.horizon_px

    bottom_scale = camera.focal_px * camera.height_m
    oncoming = (mean[:, 1] < -_ONCOMING_SPEED) & (lateral_px > 0)
    width_scale = camera.width_times_distance(lateral_px) - oncoming * _ONCOMING_CUT * lateral_px
    # Height of a box over the part of its width that shows the near face, relative to that of a car.
    tallness = sides[:, 1] / sides[:, 0] * width_scale / (camera.focal_px * camera.vehicle_height_m)
    # The width of a vehicle that crosses the road, or stands across it, is its length.
    width_visible &= tallness > _MIN_TALLNESS
    unknown = cov[:, 0, 0] > _INITIAL_DISTANCE_STD**2 / 2
    if unknown.any():
        whole = width_visible & ~is_bound
        # Linearize at the first measurement itself.
        below = bottom_visible & (below_horizon > 2 * np.hypot(edge_std[:, 1], horizon_std))
        by_bottom = bottom_scale / np.where(below, below_horizon, 1.0) - camera.overhang_m
        # The measurement with the smaller relative error.
        bottom_error = np.hypot(edge_std[:, 1], horizon_std) / np.where(below, below_horizon, 1.0)
        width_error = np.sqrt(cov[:, 2, 2] + np.square(lateral_px / width_scale) * cov[:, 3, 3])
        is_better = below & ((bottom_error < width_error) | ~whole)
        known = unknown & (below | whole)
        # Tall vehicles are wide: vans, buses and trucks.
        tall = np.clip(_WIDTH_OF_HEIGHT * (tallness - _TALL), 0.0, _MAX_TALL_WIDTH)
        mean[:, 2] = np.where(known & whole, tall, mean[:, 2])
        first = np.where(is_better, by_bottom, width_scale * np.exp(mean[:, 2]) / sides[:, 0])
        mean[known, 0] = np.clip(first[known], _MIN_DISTANCE, _MAX_DISTANCE)
        bottom_visible &= is_better | ~unknown

    # The measurement is z = log(below_horizon), the model h(x) = log(bottom_scale / (x + overhang)).
    # With h linearized at `at` instead of the mean, the innovation is z - (h(at) + h'(at) * (mean - at)): one
    # step of an iterated extended Kalman filter.
    bottom_std = np.hypot(camera.height_std_m / camera.height_m, oncoming * _ONCOMING_BOTTOM_STD)
    jacobian = np.zeros_like(mean)

    def correct_by_bottom(at: Floats) -> tuple[Floats, Floats]:
        """Correct by the bottom edge, linearized at distances `at`."""
        tires = at + camera.overhang_m
        expected = bottom_scale / tires
        log_ratio, tangent_px = _log_by_tangent(below_horizon, expected)
        jacobian[:, 0] = -1 / tires
        innovation = log_ratio - (at - mean[:, 0]) / tires
        systematic = np.square(horizon_std / tangent_px) + np.square(bottom_std)
        systematic += np.square(camera.overhang_std_m / tires)
        variance = np.square(edge_std[:, 1] / tangent_px) * box_frames + systematic * shared_frames
        return _scalar_update(mean, cov, jacobian, innovation, np.where(bottom_visible, variance, np.inf))

    # Far away, noise dominates the correction, so that the predicted distance is more exact.
    corrected = np.maximum(correct_by_bottom(mean[:, 0])[0][:, 0], _MIN_DISTANCE)
    mean, cov = correct_by_bottom(np.where(corrected < _RELINEARIZED, corrected, mean[:, 0]))
    np.clip(mean[:, 0], _MIN_DISTANCE, _MAX_DISTANCE, out=mean[:, 0])

    # Logarithm of the width in pixels: log(width_scale) + log(relative width) - log(distance), with the error
    # of the length to first order.
    side = lateral_px / width_scale
    innovation = np.log(sides[:, 0] / width_scale) - mean[:, 2] - side * mean[:, 3] + np.log(mean[:, 0])
    systematic = _width_variance(measured, camera, width_scale, side)
    # Both edges are measured with the same error.
    variance = np.square(edge_std[:, 0] / sides[:, 0]) * 2 * box_frames + systematic * shared_frames
    jacobian[:, 0], jacobian[:, 2], jacobian[:, 3] = -1 / mean[:, 0], 1.0, side
    variance = np.where(width_visible & ~(is_bound & (innovation < 0)), variance, np.inf)
    mean, cov = _scalar_update(mean, cov, jacobian, innovation, variance)
    return states._replace(range_mean=np.clip(mean, *_LIMITS), range_cov=cov)


def _log_by_tangent(pixels: Floats, expected: Floats) -> tuple[Floats, Floats]:
    """Logarithm of ``pixels / expected``, and the pixels at which it is linearized.

    Outside of `_LOG_LIMIT` to 1 times the expected pixels it is continued by its tangents: near 0 a small
    error in pixels would be a large one of the logarithm, and below 0 there is none.
    """
    tangent_px = np.clip(pixels, _LOG_LIMIT * expected, expected)
    return np.log(tangent_px / expected) + (pixels - tangent_px) / tangent_px, tangent_px


def _width_variance(measured: Measurements, camera: Camera, width_scale: Floats, side: Floats) -> Floats:
    """Variance ``(N,)`` of the logarithm of boxes' widths that more frames do not average out.

    `width_scale` is the width in pixels times the distance, of which a meter of length adds the part `side`.
    """
    # Detectors cut the long sides of vehicles short, where the whole box would be wider than usual.
    aspect = width_scale / (camera.focal_px * camera.vehicle_height_m)
    cut_short = np.log(np.maximum(aspect / _MAX_ASPECT, 1.0))
    covered_std = np.where(measured.covered > 0, _COVERED_STD, 0.0)
    side_std = side * camera.vehicle_length_std_m
    return np.asarray(np.square(cut_short) + np.square(covered_std) + np.square(side_std))


def _scalar_update(
    mean: Floats, cov: Floats, jacobian: Floats, innovation: Floats, variance: Floats
) -> tuple[Floats, Floats]:
    """Correct each state by one scalar measurement; an infinite variance changes nothing.

    `mean` and `jacobian` are ``(N, 4)``, `cov` ``(N, 4, 4)``, `innovation` and `variance` ``(N,)``. With one
    measurement the innovation's covariance ``h P h' + r`` is a number, so that no matrix is inverted. The
    variance `r` of an outlier is increased by the square of its innovation in units of `_OUTLIER` standard
    errors (Huber's weights).
    """
    cross = (cov @ jacobian[:, :, None])[:, :, 0]  # P h'
    expected = (jacobian * cross).sum(axis=1)  # h P h'
    penalty = np.maximum(np.square(innovation) / (expected + variance) / _OUTLIER**2, 1.0)
    gain = cross / (expected + variance * penalty)[:, None]
    return mean + gain * innovation[:, None], cov - gain[:, :, None] * cross[:, None, :]


def estimate_distances(
    states: KalmanStates, time_since_update: Floats, camera: Camera
) -> list[dict[str, Any]]:
    """Distance and speed of each track with standard errors, as fields of `Track`; None where unknown."""
    distance, speed = states.range_mean[:, 0], states.range_mean[:, 1]
    distance_std, speed_std = np.sqrt(np.maximum(states.range_cov[:, [0, 1], [0, 1]], 0)).T
    known = (distance_std <= _MAX_RANGE_STD * distance) & (time_since_update <= _MAX_RANGE_AGE)
    speed_known = known & (speed_std <= _MAX_RANGE_SPEED_STD)
    # The focal length scales all measurements alike, so no filter averages its error out.
    distance_std = np.hypot(distance_std, distance * camera.focal_std)
    speed_std = np.hypot(speed_std, speed * camera.focal_std)
    columns = {
        "distance_m": (distance, known),
        "distance_std_m": (distance_std, known),
        "speed_mps": (speed, speed_known),
        "speed_std_mps": (speed_std, speed_known),
    }
    return [
        {name: float(values[row]) if mask[row] else None for name, (values, mask) in columns.items()}
        for row in range(len(distance))
    ]
