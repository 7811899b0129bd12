"""Extended Kalman filter of the distances of many tracks at once.

The state of a distance is what a box's edges depend on (`DISTANCE` to `HEIGHT`): distance in m, speed in m/s,
log(width / camera.vehicle_width_m), error in m of camera.vehicle_length_m, error of the horizon in px,
log(height of the camera above the road there / camera.height_m) and log(height / camera.vehicle_height_m).
A truck seems near by its width until its bottom edge has corrected it, and from then on its growth in the
image gives the speed. The length matters where the side of a vehicle is visible. Errors that successive
frames share (pitch, hills, sizes) are states, because as noise they would average out (Bar-Shalom, Li and
Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 8.2).

In names, "range" is the distance with this state. The distance is that of the vehicle's nearest part; its
box ends at its tires, ``camera.overhang_m`` behind that.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import Floats
from vehicle_detection.camera import Camera
from vehicle_detection.tracking.kalman import Bools, KalmanSmoother, KalmanStates, Measurements
from vehicle_detection.tracking.track import TrackParams

DISTANCE, SPEED, WIDTH, LENGTH, HORIZON, CAMERA_HEIGHT, HEIGHT = range(7)
"""Columns of a state."""

_INITIAL_DISTANCE, _INITIAL_DISTANCE_STD, _INITIAL_RANGE_SPEED_STD = 30.0, 1e3, 40.0
_MIN_DISTANCE, _MAX_DISTANCE = 1.0, 500.0
# Least and greatest values of a state.
_LIMITS = np.array(
    [
        [_MIN_DISTANCE, -np.inf, -0.7, -3.0, -np.inf, -0.5, -1.5],
        [_MAX_DISTANCE, np.inf, 0.9, 8.0, np.inf, 0.5, 1.5],
    ]
)
# Process noise of the speed (m/s per square root of a second).
_ACCELERATION = 1.5
# Prior error of the height's logarithm, so large that only its growth counts, and its process noise.
_HEIGHT_STD, _HEIGHT_CHANGE = 1.0, 0.1
# Times (s) in which the width's prior variance is added to its process noise, and over which the error of the
# horizon (pitch and hills), and other errors that successive frames share, are correlated.
_WIDTH_TIME, _PITCH_TIME, _SHARED_TIME = 20.0, 1.0, 2.0
# Error of the rate of a growth (1/s) that successive frames share.
_GROWTH_BIAS = 0.01
# Mean innovation of an edge (standard errors) above which a distance is uncertain, and the relative error
# that it then gains (per square root of a second).
_UNSETTLED, _UNSETTLED_STD = 2.0, 0.5
# Standard errors by which a box grows faster or slower than its speed says, above which the speed is another
# vehicle's, and time (s) in which it is forgotten.
_OTHER_SPEED, _FORGET_TIME = 2.5, 0.2
# Maximum relative error of a reported distance, without that of the focal length; maximum age of its last
# measurement (s); and error of a reported speed: in m/s, or as a fraction of it, whichever is larger.
_MAX_RANGE_STD, _MAX_RANGE_AGE, _MAX_RANGE_SPEED_STD, _MAX_SPEED_ERROR = 0.4, 0.5, 6.0, 0.25
# Relative error of the width of a box over the fraction of it that a nearer vehicle covers.
_COVERED_STD = 0.5
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
    count = len(mean)
    std = np.empty(7)
    std[[DISTANCE, SPEED]] = _INITIAL_DISTANCE_STD, _INITIAL_RANGE_SPEED_STD
    std[WIDTH] = math.hypot(camera.vehicle_width_std_m, camera.mean_width_std_m) / camera.vehicle_width_m
    std[LENGTH], std[HEIGHT] = camera.vehicle_length_std_m, _HEIGHT_STD
    std[HORIZON], std[CAMERA_HEIGHT] = camera.total_horizon_std_px, camera.height_std_m / camera.height_m
    range_mean = np.zeros((count, 7))
    range_mean[:, DISTANCE] = _INITIAL_DISTANCE
    range_cov = np.tile(np.diag(np.square(std)), (count, 1, 1))
    return KalmanStates(mean, cov, np.zeros((count, 4)), range_mean, range_cov)


def predict_distances(states: KalmanStates, dt: float, camera: Camera) -> KalmanStates:
    """Predict distances by `dt` seconds."""
    transition, noise = np.eye(7), np.zeros((7, 7))
    transition[DISTANCE, SPEED] = dt
    # The error of the horizon returns to 0 (Gauss-Markov process).
    transition[HORIZON, HORIZON] = math.exp(-dt / _PITCH_TIME)
    mean = states.range_mean @ transition.T
    mean[:, DISTANCE] = np.clip(mean[:, DISTANCE], _MIN_DISTANCE, _MAX_DISTANCE)
    noise[:2, :2] = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * _ACCELERATION**2
    noise[WIDTH, WIDTH] = (camera.vehicle_width_std_m / camera.vehicle_width_m) ** 2 * dt / _WIDTH_TIME
    noise[HEIGHT, HEIGHT] = _HEIGHT_CHANGE**2 * dt / _WIDTH_TIME
    noise[HORIZON, HORIZON] = camera.total_horizon_std_px**2 * (1 - math.exp(-2 * dt / _PITCH_TIME))
    return states._replace(range_mean=mean, range_cov=transition @ states.range_cov @ transition.T + noise)


class _View(NamedTuple):
    """What the boxes of a frame show, as columns with one row per track."""

    below_horizon: Floats  # pixels from the horizon to the bottom edge
    sides: Floats  # (N, 2) width and height in pixels
    edge_std: Floats  # (N, 2) error of the left and right edges, and of the top and bottom edges
    lateral_px: Floats
    width_scale: Floats  # width in pixels times the distance
    tallness: Floats  # height over the width of the near face, relative to a car's
    oncoming: Bools
    sees_bottom: Bools  # which of them are measurements
    sees_width: Bools
    sees_height: Bools
    is_bound: Bools  # whether the width is only a lower bound
    box_frames: float  # frames that share the error of a box, and other errors
    shared_frames: Floats


def update_distances(
    states: KalmanStates, measured: Measurements, camera: Camera, dt: float, correlation_time: float
) -> KalmanStates:
    """Correct distances by the growth, bottom edge, width and height of boxes (extended Kalman filter).

    The errors of a vehicle's boxes are correlated over `correlation_time` seconds.
    """
    mean, cov = states.range_mean.copy(), states.range_cov.copy()
    _loosen(mean, cov, states, measured, dt)
    view = _view(mean, measured, camera, dt, correlation_time)
    if measured.growth is not None:
        mean, cov = _correct_by_growth(mean, cov, measured.growth, camera, dt)
    view = _start(mean, cov, view, camera)
    mean, cov = _correct_by_bottom(mean, cov, view, camera)
    np.clip(mean[:, DISTANCE], _MIN_DISTANCE, _MAX_DISTANCE, out=mean[:, DISTANCE])
    mean, cov = _correct_by_width(mean, cov, view, measured, camera)
    np.clip(mean[:, DISTANCE], _MIN_DISTANCE, _MAX_DISTANCE, out=mean[:, DISTANCE])
    mean, cov = _correct_by_height(mean, cov, view, camera)
    return states._replace(range_mean=np.clip(mean, *_LIMITS), range_cov=cov)


def _loosen(mean: Floats, cov: Floats, states: KalmanStates, measured: Measurements, dt: float) -> None:
    """Increase the errors of distances and speeds that the boxes contradict, in place."""
    # While the edges of a box have not settled, or a nearer vehicle hides the bottom edge.
    unsettled = (np.abs(states.innovation_mean) > _UNSETTLED).any(axis=1) | measured.hidden[:, 3]
    cov[:, DISTANCE, DISTANCE] += unsettled * np.square(_UNSETTLED_STD * mean[:, DISTANCE]) * dt
    # The height of a box grows at the rate -speed / distance, unless the track has gone over to a vehicle
    # with another speed.
    height, distance = states.mean[:, 3], mean[:, DISTANCE]
    misfit = states.mean[:, 7] / height + mean[:, SPEED] / distance
    misfit_std = np.hypot(np.sqrt(states.cov[:, 7, 7]) / height, np.sqrt(cov[:, SPEED, SPEED]) / distance)
    other = (np.abs(misfit) > _OTHER_SPEED * misfit_std) & ~measured.truncated.any(axis=1)
    cov[:, SPEED, SPEED] += other * np.square(misfit * distance) * min(dt / _FORGET_TIME, 1.0)


def _view(mean: Floats, measured: Measurements, camera: Camera, dt: float, correlation_time: float) -> _View:
    boxes, lateral_px = measured.road_boxes, measured.lateral_px
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    oncoming = (mean[:, SPEED] < -_ONCOMING_SPEED) & (lateral_px > 0)
    width_scale = camera.width_times_distance(lateral_px) - oncoming * _ONCOMING_CUT * lateral_px
    tallness = sides[:, 1] / sides[:, 0] * width_scale / (camera.focal_px * camera.vehicle_height_m)
    # A merged box shows neither the bottom nor the width of its vehicles.
    visible = ~(measured.truncated | measured.merged[:, None])  # left, top, right, bottom
    visible[:, 3] &= ~measured.hidden[:, 3]
    return _View(
        below_horizon=boxes[:, 3] - camera.horizon_px - mean[:, HORIZON],
        sides=sides,
        edge_std=np.hypot(camera.bottom_std_px * camera.pixel_scale, camera.box_std * sides),
        lateral_px=lateral_px,
        width_scale=width_scale,
        tallness=tallness,
        oncoming=oncoming,
        sees_bottom=visible[:, 3],
        # The width of a vehicle that crosses the road, or stands across it, is its length.
        sees_width=visible[:, 0] & visible[:, 2] & (tallness > _MIN_TALLNESS),
        # A vehicle that the frame's side cuts shows the height of its far end.
        sees_height=np.asarray(visible.all(axis=1)),
        # Behind a nearer vehicle a box ends where its visible part does, and grows as its vehicle emerges:
        # its width is only a lower bound, as in a Kalman filter of censored measurements (Allik et al., *IEEE
        # Transactions on Control Systems Technology*, 2016).
        is_bound=np.asarray(measured.hidden[:, [0, 2]].any(axis=1)),
        # An error that n frames share must not average out among them: its variance is multiplied by n.
        box_frames=max(1.0, correlation_time / dt),
        shared_frames=np.full(len(mean), max(1.0, _SHARED_TIME / dt)),
    )


def _start(mean: Floats, cov: Floats, view: _View, camera: Camera) -> _View:
    """Set unknown distances, in place, to those of the first measurement, so that it is linearized there.

    Returns the view without the heights, and without bottom edges where the width was the better measurement.
    """
    unknown = cov[:, DISTANCE, DISTANCE] > _INITIAL_DISTANCE_STD**2 / 2
    if not unknown.any():
        return view
    whole = view.sees_width & ~view.is_bound
    bottom_std = np.hypot(view.edge_std[:, 1], camera.total_horizon_std_px)
    below = view.sees_bottom & (view.below_horizon > 2 * bottom_std)
    below_px = np.where(below, view.below_horizon, 1.0)
    # The measurement with the smaller relative error.
    side = view.lateral_px / view.width_scale
    width_error = np.sqrt(cov[:, WIDTH, WIDTH] + np.square(side) * cov[:, LENGTH, LENGTH])
    is_better = below & ((bottom_std / below_px < width_error) | ~whole)
    known = unknown & (below | whole)
    # Tall vehicles are wide: vans, buses and trucks.
    tall = np.clip(_WIDTH_OF_HEIGHT * (view.tallness - _TALL), 0.0, _MAX_TALL_WIDTH)
    mean[:, WIDTH] = np.where(known & whole, tall, mean[:, WIDTH])
    by_bottom = camera.focal_px * camera.height_m / below_px - camera.overhang_m
    by_width = view.width_scale * np.exp(mean[:, WIDTH]) / view.sides[:, 0]
    first = np.clip(np.where(is_better, by_bottom, by_width), _MIN_DISTANCE, _MAX_DISTANCE)
    mean[known, DISTANCE] = first[known]
    # No frame before shares the errors of a first width. With a multiple of its variance, a distance would be
    # so uncertain that linearized corrections diverge: to half of it, with small stated errors.
    return view._replace(
        sees_bottom=view.sees_bottom & (is_better | ~unknown),
        sees_height=view.sees_height & ~unknown,
        shared_frames=np.where(known & ~is_better, 1.0, view.shared_frames),
    )


def _correct_by_growth(
    mean: Floats, cov: Floats, growth: Floats, camera: Camera, dt: float
) -> tuple[Floats, Floats]:
    """Correct by ``(N, 2)`` logarithms of the growth since the last frame, and their standard errors.

    The growth is the distance before over that of now. The pixels that are followed lie between the nearest
    part and the tires.
    """
    logarithm, std = growth.T
    far = mean[:, DISTANCE] + camera.overhang_m / 2
    before = np.maximum(far - dt * mean[:, SPEED], 0.1 * far)
    slopes = {DISTANCE: 1 / before - 1 / far, SPEED: -dt / before}
    variance = np.square(std) + np.square(_GROWTH_BIAS * dt) * max(1.0, _SHARED_TIME / dt)
    known = np.isfinite(std) & (cov[:, DISTANCE, DISTANCE] < _INITIAL_DISTANCE_STD**2 / 2)
    return _scalar_update(mean, cov, slopes, logarithm - np.log(before / far), variance, known)


def _correct_by_bottom(mean: Floats, cov: Floats, view: _View, camera: Camera) -> tuple[Floats, Floats]:
    """Correct by the logarithm of the pixels below the horizon.

    The measurement is z = log(below_horizon), the model h(x) = log(focal * height / (x + overhang)). With h
    linearized at `at` instead of the mean, the innovation is z - (h(at) + h'(at) * (mean - at)): one step of
    an iterated extended Kalman filter.
    """

    def correct(at: Floats) -> tuple[Floats, Floats]:
        tires = at + camera.overhang_m
        log_ratio, tangent_px = _log_by_tangent(view.below_horizon, camera.focal_px * camera.height_m / tires)
        slopes = {DISTANCE: -1 / tires, HORIZON: 1 / tangent_px, CAMERA_HEIGHT: 1}
        innovation = log_ratio - (at - mean[:, DISTANCE]) / tires - mean[:, CAMERA_HEIGHT]
        shared = np.square(view.oncoming * _ONCOMING_BOTTOM_STD) + np.square(camera.overhang_std_m / tires)
        variance = np.square(view.edge_std[:, 1] / tangent_px) * view.box_frames + shared * view.shared_frames
        return _scalar_update(mean, cov, slopes, innovation, variance, view.sees_bottom)

    # Far away, noise dominates the correction, so that the predicted distance is more exact.
    predicted = mean[:, DISTANCE]
    corrected = np.maximum(correct(predicted)[0][:, DISTANCE], _MIN_DISTANCE)
    return correct(np.where(corrected < _RELINEARIZED, corrected, predicted))


def _correct_by_width(
    mean: Floats, cov: Floats, view: _View, measured: Measurements, camera: Camera
) -> tuple[Floats, Floats]:
    """Correct by the logarithm of the width: log(width_scale) + log(relative width) - log(distance).

    The error of the length is included to first order.
    """
    width, side = view.sides[:, 0], view.lateral_px / view.width_scale
    slopes = {DISTANCE: -1 / mean[:, DISTANCE], WIDTH: 1, LENGTH: side}
    expected = mean[:, WIDTH] + side * mean[:, LENGTH] - np.log(mean[:, DISTANCE])
    innovation = np.log(width / view.width_scale) - expected
    # Detectors cut the long sides of vehicles short, where the whole box would be wider than usual.
    aspect = view.width_scale / (camera.focal_px * camera.vehicle_height_m)
    cut_short = np.log(np.maximum(aspect / _MAX_ASPECT, 1.0))
    shared = (
        np.square(cut_short)
        + np.square(_COVERED_STD * measured.covered)
        + np.square(side * camera.vehicle_length_std_m)
    )
    # Both edges are measured with the same error.
    variance = 2 * np.square(view.edge_std[:, 0] / width) * view.box_frames + shared * view.shared_frames
    informs = view.sees_width & ~(view.is_bound & (innovation < 0))
    return _scalar_update(mean, cov, slopes, innovation, variance, informs)


def _correct_by_height(mean: Floats, cov: Floats, view: _View, camera: Camera) -> tuple[Floats, Floats]:
    """Correct by the logarithm of the height, which neither visible sides nor pitch change.

    How it grows gives the speed: the size of a vehicle over its change is the time to collision (Lee, "A
    theory of visual control of braking based on information about time-to-collision", *Perception*, 1976).
    """
    tires = mean[:, DISTANCE] + camera.overhang_m
    scale = camera.focal_px * camera.vehicle_height_m
    innovation = np.log(view.sides[:, 1] * tires / scale) - mean[:, HEIGHT]
    shared = np.square(camera.overhang_std_m / tires)
    height_std = view.edge_std[:, 1] / view.sides[:, 1]
    variance = 2 * np.square(height_std) * view.box_frames + shared * view.shared_frames
    return _scalar_update(
        mean, cov, {DISTANCE: -1 / tires, HEIGHT: 1}, innovation, variance, view.sees_height
    )


def _log_by_tangent(pixels: Floats, expected: Floats) -> tuple[Floats, Floats]:
    """Logarithm of ``pixels / expected``, and the pixels at which it is linearized.

    Outside of `_LOG_LIMIT` to 1 times the expected pixels it is continued by its tangents: near 0 a small
    error in pixels would be a large one of the logarithm, and below 0 there is none.
    """
    tangent_px = np.clip(pixels, _LOG_LIMIT * expected, expected)
    return np.log(tangent_px / expected) + (pixels - tangent_px) / tangent_px, tangent_px


def _scalar_update(
    mean: Floats, cov: Floats, slopes: dict[int, Any], innovation: Floats, variance: Floats, seen: Bools
) -> tuple[Floats, Floats]:
    """Correct the states for which a scalar measurement is `seen`, given its slopes by column of the state.

    `mean` is ``(N, 7)``, `cov` ``(N, 7, 7)``, `innovation` and `variance` ``(N,)``. With one measurement the
    innovation's covariance ``h P h' + r`` is a number, so that no matrix is inverted. The variance `r` of an
    outlier is increased by the square of its innovation in units of `_OUTLIER` standard errors (Huber's
    weights); an infinite one changes nothing.
    """
    jacobian, variance = np.zeros_like(mean), np.where(seen, variance, np.inf)
    for column, slope in slopes.items():
        jacobian[:, column] = slope
    cross = (cov @ jacobian[:, :, None])[:, :, 0]  # P h'
    expected = (jacobian * cross).sum(axis=1)  # h P h'
    penalty = np.maximum(np.square(innovation) / (expected + variance) / _OUTLIER**2, 1.0)
    gain = cross / (expected + variance * penalty)[:, None]
    corrected = mean + gain * innovation[:, None]
    return corrected, _rescale(cov - gain[:, :, None] * cross[:, None, :], mean, corrected)


def _rescale(cov: Floats, before: Floats, mean: Floats) -> Floats:
    """Change the covariance, in place, as a correction of the mean changes scales: relative errors stay.

    It is then that of ``log(distance)`` and ``speed / distance``. Boxes show only the latter while sizes are
    unknown; with the old scales, each acceleration would make all sizes, and so the distance, smaller (Aidala
    and Hammel, "Utilization of modified polar coordinates for bearings-only tracking", *IEEE Transactions on
    Automatic Control*, 1983).
    """
    distance, new_distance = (np.maximum(each[:, DISTANCE], _MIN_DISTANCE) for each in (before, mean))
    ratio = new_distance / distance
    shear = (mean[:, SPEED] - ratio * before[:, SPEED]) / distance
    for rows in (cov, cov.transpose(0, 2, 1)):
        rows[:, SPEED] = ratio[:, None] * rows[:, SPEED] + shear[:, None] * rows[:, DISTANCE]
        rows[:, DISTANCE] *= ratio[:, None]
    return cov


def estimate_distances(
    states: KalmanStates, time_since_update: Floats, camera: Camera
) -> list[dict[str, Any]]:
    """Distance and speed of each track with standard errors, as fields of `Track`; None where unknown."""
    distance, speed = states.range_mean[:, 0], states.range_mean[:, 1]
    distance_std, speed_std = np.sqrt(np.maximum(states.range_cov[:, [0, 1], [0, 1]], 0)).T
    known = (distance_std <= _MAX_RANGE_STD * distance) & (time_since_update <= _MAX_RANGE_AGE)
    speed_known = known & (speed_std <= np.maximum(_MAX_RANGE_SPEED_STD, _MAX_SPEED_ERROR * np.abs(speed)))
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


def measure_distances(boxes: Floats, shape: tuple[int, ...], camera: Camera) -> Floats:
    """Distances and standard errors of the vehicles of one image, ``(2, N)``; NaN where unknown."""
    seen, params = camera.for_shape(shape), TrackParams()
    pinhole, (height, width) = seen.to_pinhole(shape), shape[:2]
    boxes = np.clip(boxes.astype(np.float64), 0.0, [width, height, width, height])
    inside = (boxes[:, 2:] - boxes[:, :2] >= 1).all(axis=1)
    measured = Measurements.from_boxes(boxes[inside], (height, width), camera=seen if seen.fisheye else None)
    states = initiate_states(*KalmanSmoother(params).initiate(measured), pinhole)
    # With a frame a second, no error of a box is taken to be shared with frames before.
    states = update_distances(states, measured, pinhole, 1.0, params.measurement_correlation_time)
    values = np.full((2, len(boxes)), np.nan)
    estimates = estimate_distances(states, np.zeros(len(states.mean)), pinhole)
    values[:, inside] = [[each[name] for each in estimates] for name in ("distance_m", "distance_std_m")]
    return values
