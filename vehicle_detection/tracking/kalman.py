"""Kalman filter of the boxes of many tracks at once.

The state of a box is ``[cx, cy, w, h]`` and its velocity in pixels per second. It is predicted at constant
velocity and corrected by the measured edges (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications
to Tracking and Navigation*, chapter 6), because the frame's border may truncate one edge alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats
from vehicle_detection.camera import Camera, FrameShape, lateral_offsets, truncated_edges
from vehicle_detection.tracking.track import TrackParams

Bools = NDArray[np.bool_]

OUTWARD = np.array([-1.0, -1.0, 1.0, 1.0])
"""Direction in which each edge of a box faces."""

UNKNOWN = 1e9
"""Variance of an edge that is not measured: large, but small enough to keep the sums exact."""

# Box edges from ``[cx, cy, w, h]``, and the inverse.
_TO_EDGES = np.array([[1, 0, -0.5, 0], [0, 1, 0, -0.5], [1, 0, 0.5, 0], [0, 1, 0, 0.5]], np.float64)
_FROM_EDGES = np.linalg.inv(_TO_EDGES)
_DIAGONAL = np.arange(4)
# Blocks of 8x8 matrices: the box itself, the velocity in the rows of the box, and the velocity itself.
_BOX, _MOTION, _VELOCITY = (
    np.kron(block, np.eye(4)) for block in ([[1, 0], [0, 0]], [[0, 1], [0, 0]], [[0, 0], [0, 1]])
)
_TWICE = np.arange(8) % 4
_MIN_SIZE = 4.0
# Standard deviation of a new box's velocity ``[cx, cy, w, h]``, in box sizes per second.
_INITIAL_SPEED_STD = np.array([2.0, 1.0, 0.7, 0.7])
# Innovations in standard errors: above the first an edge is an outlier; the second is the clipping limit.
_OUTLIER, _MAX_INNOVATION = 2.5, 6.0
# Mean innovation (standard errors) of an edge above which it is persistent, and the standard errors that it
# adds to the edge's position, as a fraction of the innovation, and to its velocity, per second.
_PERSISTENT, _PERSISTENT_STD, _PERSISTENT_SPEED_STD = 2.0, 0.25, 5.0
# Time constant (s) of the innovation's mean, and minimum weight of its past from frame to frame.
_INNOVATION_TIME, _MIN_INNOVATION_DECAY = 0.15, 0.75
# Time constants (s) with which the velocity ``[cx, cy, w, h]`` of a coasting track decays.
_VELOCITY_DECAY = np.array([1.5, 1.5, 0.5, 0.5])
# Maximum relative change of size per second that is interpreted as an approach.
_MAX_GROWTH = 3.0
# Seconds without a detection after which the velocity of a vehicle that is detected again is unknown.
_MAX_VELOCITY_AGE = 0.5
# Prior aspect ratio (width to height) of a box that the frame's border truncates, and its relative error.
_TRUNCATED_ASPECT, _TRUNCATED_STD = 1.5, 0.3
# Factor of the standard error of an edge where a nearer vehicle begins.
_HIDDEN_NOISE = 5.0
# Limits of standard errors: positions and velocities in box sizes.
_MAX_STD = np.array([0.5] * 4 + [2.0] * 4)


class KalmanStates(NamedTuple):
    """States of both filters as columns with one row per track."""

    mean: Floats  # (N, 8) box and its velocity
    cov: Floats  # (N, 8, 8)
    innovation_mean: Floats  # (N, 4) moving average of each edge's innovation in standard errors
    range_mean: Floats  # (N, 7) distance, speed and what the errors of their measurements share
    range_cov: Floats  # (N, 7, 7)

    @classmethod
    def empty(cls) -> KalmanStates:
        """States of no tracks."""
        return cls(*(np.empty((0, *shape)) for shape in ((8,), (8, 8), (4,), (7,), (7, 7))))

    def boxes(self) -> Floats:
        """``(N, 4)`` boxes, including parts outside the frame."""
        return boxes_from_states(self.mean)

    def take(self, rows: Sequence[int]) -> KalmanStates:
        """Return these rows, in this order."""
        if list(rows) == list(range(len(self.mean))):
            return self
        index = np.array(rows, np.intp)
        return KalmanStates(*(column[index] for column in self))

    def put(self, rows: Sequence[int], other: KalmanStates) -> KalmanStates:
        """Return a copy with these rows replaced by those of `other`."""
        columns = [column.copy() for column in self]
        for column, new in zip(columns, other):
            column[list(rows)] = new
        return KalmanStates(*columns)

    def join(self, other: KalmanStates) -> KalmanStates:
        """Return the rows of both."""
        return KalmanStates(*(np.concatenate(pair) for pair in zip(self, other)))


class Measurements(NamedTuple):
    """Detections assigned to tracks in one frame, as columns with one row per track."""

    boxes: Floats  # (N, 4)
    road_boxes: Floats  # (N, 4) the same as seen by a pinhole camera
    truncated: Bools  # (N, 4) edges at the frame's border
    lateral_px: Floats  # (N,) distance of the inner edge from the frame's middle column
    merged: Bools  # (N,) whether the box shows another vehicle too
    unsure: Bools  # (N,) whether the box has a low score, so that it may show something else too
    covered: Floats  # (N,) fraction of the box that nearer vehicles cover
    hidden: Bools  # (N, 4) edges beyond which a nearer vehicle hides what follows
    growth: Floats | None = None  # (N, 2) logarithm of the growth since the last frame, and its error

    @classmethod
    def from_boxes(
        cls,
        boxes: Floats,
        frame: FrameShape,
        merged: ArrayLike = False,
        camera: Camera | None = None,
        covered: ArrayLike = 0.0,
        hidden: ArrayLike = False,
        unsure: ArrayLike = False,
    ) -> Measurements:
        """Measure boxes in a frame of this shape, seen by `camera` or, by default, a pinhole camera."""
        merged, unsure = (np.full(len(boxes), each, np.bool_) for each in (merged, unsure))
        covered, hidden = np.full(len(boxes), covered, np.float64), np.full(boxes.shape, hidden, np.bool_)
        road = boxes if camera is None else camera.rectify_boxes(boxes, frame)
        truncated, lateral_px = truncated_edges(boxes, frame), lateral_offsets(road, frame)
        return cls(boxes, road, truncated, lateral_px, merged, unsure, covered, hidden)


class KalmanSmoother:
    """Initiates, predicts and corrects boxes by a constant-velocity Kalman filter."""

    def __init__(self, params: TrackParams) -> None:
        self._params = params

    def initiate(self, measured: Measurements) -> tuple[Floats, Floats]:
        """Means ``(N, 8)`` and covariances ``(N, 8, 8)`` of new tracks."""
        boxes, sides = measured.boxes.copy(), measured.boxes[:, 2:] - measured.boxes[:, :2]
        std = np.tile(sides, 2) * self._params.measurement_noise
        # Extend a truncated box beyond the frame: then the motion of its inner edge is not taken for growth.
        width = np.maximum(sides[:, 0], _TRUNCATED_ASPECT * sides[:, 1])
        for outer, inner in ((0, 2), (2, 0)):
            rows = measured.truncated[:, outer] & ~measured.truncated[:, inner]
            boxes[rows, outer] = boxes[rows, inner] + width[rows] * OUTWARD[outer]
            std[rows, outer] = _TRUNCATED_STD * width[rows]
        return initiate(boxes, std)

    def predict(self, states: KalmanStates, coasting: Bools, dt: float) -> KalmanStates:
        """Predict boxes: detected vehicles keep their speed on the road, ``coasting`` ones slow down."""
        mean = states.mean
        # A constant speed on the road accelerates in the image as the box grows: v' = 2 v w'/w.
        growth = np.clip((mean[:, 6:] / mean[:, 2:4]).mean(axis=1), -_MAX_GROWTH, _MAX_GROWTH)
        rates = np.where(coasting[:, None], -1 / _VELOCITY_DECAY, 2 * growth[:, None])
        factors = np.concatenate((np.ones_like(rates), np.exp(dt * rates)), axis=1)
        # The error of a velocity grows like the velocity; that of the growth also through the rate itself.
        std_factors = factors.copy()
        std_factors[:, 6:] *= 1 + dt * np.maximum(2 * growth[:, None], 0) * ~coasting[:, None]
        mean = mean * factors
        cov = states.cov * std_factors[:, :, None] * std_factors[:, None, :]
        position, size = self._params.process_noise_position, self._params.process_noise_size
        noise = mean[:, [2, 3, 2, 3]] * np.array([position, position, size, size])
        mean, cov = predict(mean, cov, dt, np.square(noise))
        # Limit the standard errors of coasting tracks.
        std = np.sqrt(np.maximum(cov[:, np.arange(8), np.arange(8)], 1e-12))
        scale = np.minimum(mean[:, [2, 3] * 4] * _MAX_STD / std, 1.0)
        return states._replace(mean=mean, cov=cov * scale[:, :, None] * scale[:, None, :])

    def correct(self, states: KalmanStates, gaps: Floats, measured: Measurements, dt: float) -> KalmanStates:
        """Correct the boxes of tracks by a measurement each, after `gaps` seconds without one."""
        params, mean, boxes = self._params, states.mean, measured.boxes
        # A truncated edge says only that the vehicle reaches the border: no correction if it is predicted to.
        is_outside = (boxes_from_states(mean) - boxes) * OUTWARD >= 0
        beyond = measured.truncated & is_outside
        correlated_frames = max(1.0, params.measurement_correlation_time / dt)
        noise = np.square(mean[:, [2, 3, 2, 3]] * params.measurement_noise) * correlated_frames
        # A vehicle may reach behind a nearer one, so a hidden edge moves its box inwards only a little.
        noise = np.where(measured.hidden & is_outside, _HIDDEN_NOISE**2 * noise, noise)
        variance = np.where(beyond, UNKNOWN, noise)
        doubtful = measured.merged | measured.unsure
        corrected = KalmanStates(*update(*states[:3], boxes, variance, doubtful, dt), *states[3:])
        again = (gaps > _MAX_VELOCITY_AGE) & ~measured.merged
        if again.any():
            new = (*self.initiate(measured), np.zeros((len(boxes), 4)))
            for column, values in zip(corrected, new):
                column[again] = values[again]
        return corrected


def boxes_from_states(mean: Floats) -> Floats:
    """``(N, 4)`` boxes of ``(N, 8)`` states."""
    return np.asarray(mean[:, :4] @ _TO_EDGES.T)


def centers_and_sizes(boxes: Floats) -> Floats:
    """``(N, 4)`` rows ``[cx, cy, w, h]`` of boxes."""
    return np.asarray(boxes @ _FROM_EDGES.T)


def initiate(boxes: Floats, edge_std: Floats) -> tuple[Floats, Floats]:
    """Means ``(N, 8)`` and covariances ``(N, 8, 8)`` of boxes at rest whose edges have these errors."""
    mean = np.zeros((len(boxes), 8))
    mean[:, :4] = centers_and_sizes(boxes)
    cov = np.zeros((len(boxes), 8, 8))
    cov[:, :4, :4] = (_FROM_EDGES * np.square(edge_std)[:, None, :]) @ _FROM_EDGES.T
    speed_std = np.tile(mean[:, 2:4], 2) * _INITIAL_SPEED_STD
    cov[:, 4:, 4:] = np.square(speed_std)[:, :, None] * np.eye(4)
    return mean, cov


def predict(mean: Floats, cov: Floats, dt: float, noise_density: Floats) -> tuple[Floats, Floats]:
    """Predict states by `dt` seconds; a velocity gains the variance `noise_density` ``(N, 4)`` per second."""
    # State [box | velocity]: box += dt * velocity. The noise is white acceleration, integrated over dt.
    transition = _BOX + _MOTION * dt + _VELOCITY
    noise = _BOX * (dt**3 / 3) + (_MOTION + _MOTION.T) * (dt**2 / 2) + _VELOCITY * dt
    predicted = mean @ transition.T
    predicted[:, 2:4] = np.maximum(predicted[:, 2:4], _MIN_SIZE)
    cov = transition @ cov @ transition.T + noise * noise_density[:, _TWICE, None]
    return predicted, cov


def update(
    mean: Floats,
    cov: Floats,
    innovation_mean: Floats,
    edges: Floats,
    variance: Floats,
    reject_outliers: Bools,
    dt: float,
) -> tuple[Floats, Floats, Floats]:
    """Correct states by measured edges; returns means, covariances and innovation means.

    The weight of an outlier is reduced (Huber, *Robust Statistics*, chapter 7), or set to 0 with
    `reject_outliers`, so that one wrong box does not distort the track. If an edge deviates persistently to
    one side, the track is wrong: the variances of that edge's position and of its velocity during the last
    `dt` seconds are increased instead.
    """
    # The measurement matrix H, (4, 8), is [_TO_EDGES | 0]: edges do not depend on the velocities. So P H' is
    # (N, 8, 4) and H P H' is (N, 4, 4).
    cross = cov[:, :, :4] @ _TO_EDGES.T
    innovation_cov = _TO_EDGES @ cross[:, :4]
    innovation = edges - boxes_from_states(mean)
    normalized = innovation / np.sqrt(innovation_cov[:, _DIAGONAL, _DIAGONAL] + variance)
    clipped = np.where(reject_outliers[:, None], 0.0, np.clip(normalized, -_MAX_INNOVATION, _MAX_INNOVATION))
    decay = max(math.exp(-dt / _INNOVATION_TIME), _MIN_INNOVATION_DECAY)
    innovation_mean = decay * innovation_mean + (1 - decay) * clipped
    persistent = (np.abs(innovation_mean) > _PERSISTENT) & (innovation_mean * normalized > 0)
    if persistent.any():
        squared = np.where(persistent, np.square(innovation), 0.0)
        added = (_FROM_EDGES * squared[:, None, :]) @ _FROM_EDGES.T
        speed = _PERSISTENT_SPEED_STD**2
        factors = [[_PERSISTENT_STD**2 + speed * dt**2, speed * dt], [speed * dt, speed]]
        cov = cov + np.kron(factors, added)
        cross = cov[:, :, :4] @ _TO_EDGES.T
        innovation_cov = _TO_EDGES @ cross[:, :4]
    penalty = np.where(persistent, 1.0, np.maximum(np.square(normalized / _OUTLIER), 1.0))
    rejected = reject_outliers[:, None] & (penalty > 1)
    noise = np.where(rejected, UNKNOWN, np.minimum(variance * penalty, UNKNOWN))
    innovation_cov[:, _DIAGONAL, _DIAGONAL] += noise  # the edges' errors R are independent
    gain = np.linalg.solve(innovation_cov, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    corrected = mean + (gain @ innovation[:, :, None])[:, :, 0]
    corrected[:, 2:4] = np.maximum(corrected[:, 2:4], _MIN_SIZE)
    cov = cov - gain @ cross.transpose(0, 2, 1)
    # Rounding errors must not make the covariances asymmetric.
    return corrected, (cov + cov.transpose(0, 2, 1)) / 2, innovation_mean


def coasted_distance(mean: Floats, seconds: Floats) -> Floats:
    """Distance in box sizes that tracks have moved in these seconds ``(N,)`` without a detection."""
    speed = np.abs(mean[:, 4:6] / mean[:, 2:4]).max(axis=1)
    return np.asarray(speed * _VELOCITY_DECAY[0] * np.expm1(seconds / _VELOCITY_DECAY[0]))


def exit_times(mean: Floats, frame: FrameShape) -> Floats:
    """``(N,)`` seconds until boxes at the left or right border have moved out; infinite for others."""
    boxes, speeds = boxes_from_states(mean), mean[:, 4:] @ _TO_EDGES.T
    at_border = truncated_edges(boxes, frame)
    inside = np.stack([boxes[:, 2], frame[1] - boxes[:, 0]], axis=1)
    outward = np.stack([-speeds[:, 2], speeds[:, 0]], axis=1)
    moves_out = at_border[:, [0, 2]] & (outward > 0)
    seconds = np.where(moves_out, inside / np.where(moves_out, outward, 1.0), np.inf)
    return np.asarray(seconds.min(axis=1))
