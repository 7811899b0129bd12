"""Kalman filters over many tracks at once, as pure functions: boxes in the image, distances on the road.

The box's state is ``[cx, cy, w, h]`` and their speeds a second, moved on at constant velocity and corrected
by the measured edges (Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, chapter 6; on boxes: Bewley et al., *Simple Online and Realtime Tracking*, ICIP 2016). Edges, not
centers, are measured, since one edge may be hidden by the frame's border while the others are seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.camera import Camera, width_times_distance

Floats = NDArray[np.float64]

UNKNOWN = 1e9
"""Variance of a measurement that says nothing; large, yet small enough to keep the sums exact."""

_EDGES = np.array([[1, 0, -0.5, 0], [0, 1, 0, -0.5], [1, 0, 0.5, 0], [0, 1, 0, 0.5]], np.float64)
_STATES = np.linalg.inv(_EDGES)
# The blocks of a state's transition and process noise: places among themselves, places by speeds, speeds.
_STAY, _GO, _PLACES, _SPEEDS = (
    np.eye(8),
    np.eye(8, k=4),
    np.diag([1.0] * 4 + [0.0] * 4),
    np.diag([0.0] * 4 + [1.0] * 4),
)
_LEAST_SIZE = 4.0
_FOUR = np.arange(4)
# Standard errors beyond which an edge is far off, and that count at most; the share of a lasting error that
# the place of an edge is then uncertain by.
_FAR_OFF, _MOST, _DOUBT = 2.5, 6.0, 0.25
# Speeds of a new box, in box sizes a second: of its center, of its size.
_START_SPEEDS = np.array([1.0, 0.6, 0.35, 0.35])


def boxes_of(mean: Floats) -> Floats:
    """``(N, 4)`` boxes of ``(N, 8)`` states."""
    return np.asarray(mean[:, :4] @ _EDGES.T)


def state_of(box: Floats) -> Floats:
    """Center and size ``[cx, cy, w, h]`` of one box."""
    return np.asarray(_STATES @ box)


def start(boxes: Floats, edge_error: Floats) -> tuple[Floats, Floats]:
    """States ``(N, 8)`` and covariances ``(N, 8, 8)`` of boxes at their first sight, standing still.

    Parameters
    ----------
    boxes, edge_error
        ``(N, 4)`` measured edges and their standard errors in pixels.
    """
    mean = np.zeros((len(boxes), 8))
    mean[:, :4] = boxes @ _STATES.T
    cov = np.zeros((len(boxes), 8, 8))
    cov[:, :4, :4] = (_STATES * np.square(edge_error)[:, None, :]) @ _STATES.T
    speeds = np.tile(mean[:, 2:4], 2) * _START_SPEEDS
    cov[:, 4:, 4:] = np.square(speeds)[:, :, None] * np.eye(4)
    return mean, cov


def predict(mean: Floats, cov: Floats, dt: float, density: Floats) -> tuple[Floats, Floats]:
    """Move ``(N, 8)`` states `dt` seconds on, at constant velocity.

    Parameters
    ----------
    mean, cov
        States and their covariances ``(N, 8, 8)``.
    dt
        Elapsed time in seconds, 0 or more.
    density
        ``(N, 4)`` variance that each of the four speeds gains in a second (white acceleration).
    """
    step = _STAY + dt * _GO
    moved = mean @ step.T
    moved[:, 2:4] = np.maximum(moved[:, 2:4], _LEAST_SIZE)
    noise = (dt**3 / 3) * _PLACES + (dt**2 / 2) * (_GO + _GO.T) + dt * _SPEEDS
    spread = step @ cov @ step.T + noise * density[:, [0, 1, 2, 3, 0, 1, 2, 3], None]
    return moved, spread


def update(
    mean: Floats,
    cov: Floats,
    drift: Floats,
    edges: Floats,
    variance: Floats,
    reject: NDArray[np.bool_],
    keep: float,
) -> tuple[Floats, Floats, Floats]:
    """Correct ``(N, 8)`` states by measured edges.

    An edge that lies far off is given less weight (Huber, *Robust Statistics*, chapter 7), so that one wrong
    box does not throw the track. If it stays off to the same side, it is the track that is wrong: the edge's
    place is then taken to be uncertain again.

    Parameters
    ----------
    mean, cov
        States and their covariances.
    drift
        ``(N, 4)`` running mean of how far off each edge was, in standard errors; 0 at the start.
    edges
        ``(N, 4)`` measured boxes ``[x1, y1, x2, y2]``.
    variance
        ``(N, 4)`` variance of each edge; `UNKNOWN` where the edge is not seen.
    reject
        ``(N,)``: whether edges that lie off are left out altogether.
    keep
        Weight of the past in `drift`, 0-1.

    Returns
    -------
    tuple
        States, covariances and drifts.
    """
    crossed = cov[:, :, :4] @ _EDGES.T  # cov @ H.T, as H is zero for the speeds
    expected = _EDGES @ crossed[:, :4]
    off = edges - boxes_of(mean)
    standard = off / np.sqrt(expected[:, _FOUR, _FOUR] + variance)
    drift = keep * drift + (1 - keep) * np.where(reject[:, None], 0.0, np.clip(standard, -_MOST, _MOST))
    moved = (np.abs(drift) > _FAR_OFF) & (drift * standard > 0)
    if moved.any():
        doubt = np.where(moved, np.square(_DOUBT * off), 0.0)
        cov = cov.copy()
        cov[:, :4, :4] += (_STATES * doubt[:, None, :]) @ _STATES.T
        crossed = cov[:, :, :4] @ _EDGES.T
        expected = _EDGES @ crossed[:, :4]
    penalty = np.where(moved, 1.0, np.maximum(np.square(standard / _FAR_OFF), 1.0))
    noise = np.where(reject[:, None] & (penalty > 1), UNKNOWN, np.minimum(variance * penalty, UNKNOWN))
    expected[:, _FOUR, _FOUR] += noise
    gain = np.linalg.solve(expected, crossed.transpose(0, 2, 1)).transpose(0, 2, 1)
    corrected = mean + (gain @ off[:, :, None])[:, :, 0]
    corrected[:, 2:4] = np.maximum(corrected[:, 2:4], _LEAST_SIZE)
    spread = cov - gain @ crossed.transpose(0, 2, 1)
    return corrected, (spread + spread.transpose(0, 2, 1)) / 2, drift


def bound(mean: Floats, cov: Floats, place: float = 0.5, speed: float = 2.0) -> Floats:
    """Covariances whose standard errors stay below shares of the box's size, for tracks that are not seen."""
    limit = mean[:, [2, 3] * 4] * np.array([place] * 4 + [speed] * 4)
    spread = np.sqrt(np.maximum(cov[:, np.arange(8), np.arange(8)], 1e-12))
    shrink = np.minimum(limit / spread, 1.0)
    return np.asarray(cov * shrink[:, :, None] * shrink[:, None, :])


# The road: [distance in m, its speed in m/s, logarithm of the width over the camera's vehicle_width_m].
# The width is part of the state: a truck looks near by its width until its foot has told otherwise, and
# from then on its growth in the image gives the speed.

_SPEED_SPREAD, _ACCELERATION, _WIDTH_SECONDS, _PITCH_SECONDS = 20.0, 1.5, 20.0, 2.0
_NEAREST, _FARTHEST, _FAR_SPREAD = 1.0, 500.0, 1e3


def range_start(camera: Camera) -> tuple[Floats, Floats]:
    """State ``(3,)`` and covariance ``(3, 3)`` of a vehicle about which nothing is known."""
    spread = np.array([_FAR_SPREAD, _SPEED_SPREAD, camera.vehicle_width_std_m / camera.vehicle_width_m])
    return np.array([30.0, 0.0, 0.0]), np.diag(np.square(spread))


def range_predict(mean: Floats, cov: Floats, dt: float, camera: Camera) -> tuple[Floats, Floats]:
    """Move ``(N, 3)`` distances `dt` seconds on."""
    step = np.eye(3)
    step[0, 1] = dt
    moved = mean @ step.T
    moved[:, 0] = np.clip(moved[:, 0], _NEAREST, _FARTHEST)
    noise = np.array([[dt**3 / 3, dt**2 / 2, 0], [dt**2 / 2, dt, 0], [0, 0, 0]]) * _ACCELERATION**2
    noise[2, 2] = (camera.vehicle_width_std_m / camera.vehicle_width_m) ** 2 * dt / _WIDTH_SECONDS
    return moved, step @ cov @ step.T + noise


def range_update(
    mean: Floats,
    cov: Floats,
    boxes: Floats,
    cut: NDArray[np.bool_],
    aside: Floats,
    camera: Camera,
    dt: float,
    alike: float,
) -> tuple[Floats, Floats]:
    """Correct ``(N, 3)`` distances by the foot and the width of measured boxes (an extended Kalman filter).

    Parameters
    ----------
    mean, cov
        States and covariances ``(N, 3, 3)``.
    boxes, cut
        ``(N, 4)`` measured boxes, and which of their edges the frame's border cuts off.
    aside
        ``(N,)`` how far their inner edges lie from the frame's middle.
    camera
        The camera.
    dt
        Time in seconds that this measurement stands for, above 0.
    alike
        Time in seconds over which a box's errors stay alike.
    """
    mean = mean.copy()
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    edge = np.hypot(camera.bottom_std_px * camera.pixel_scale, camera.box_error * sides)
    tilt = camera.tilt_error_px
    fast, slow = max(1.0, alike / dt), max(1.0, _PITCH_SECONDS / dt)
    below = boxes[:, 3] - camera.horizon_px
    foot_seen, width_seen = ~cut[:, 3], ~(cut[:, 0] | cut[:, 2])

    drop, unit = camera.focal_px * camera.height_m, width_times_distance(camera, aside)
    fresh = cov[:, 0, 0] > _FAR_SPREAD**2 / 2
    if fresh.any():
        # Nothing is known yet: the first measurement itself is the point at which to linearise.
        plain = foot_seen & (below > 2 * np.hypot(edge[:, 1], tilt))
        first = np.where(plain, drop / np.where(plain, below, 1.0), unit / sides[:, 0])
        known = fresh & (plain | width_seen)
        mean[known, 0] = np.clip(first[known], _NEAREST, _FARTHEST)
        foot_seen &= plain | ~fresh

    # Pixels below the horizon: drop / distance.
    expected = drop / mean[:, 0]
    lasting = tilt**2 + np.square(expected * camera.height_std_m / camera.height_m)
    variance = np.square(edge[:, 1]) * fast + lasting * slow
    slope = np.zeros_like(mean)
    slope[:, 0] = -expected / mean[:, 0]
    mean, cov = _scalar_update(mean, cov, slope, below - expected, np.where(foot_seen, variance, np.inf))
    np.clip(mean[:, 0], _NEAREST, _FARTHEST, out=mean[:, 0])

    # Logarithm of the width in pixels: log(unit) + log(width) - log(distance).
    off = np.log(sides[:, 0] / unit) - mean[:, 2] + np.log(mean[:, 0])
    flank = np.square(aside * camera.vehicle_length_std_m / unit)
    variance = np.square(edge[:, 0] / sides[:, 0]) * 2 * fast + flank * slow
    slope[:, 0], slope[:, 2] = -1 / mean[:, 0], 1.0
    mean, cov = _scalar_update(mean, cov, slope, off, np.where(width_seen, variance, np.inf))
    np.clip(mean[:, 0], _NEAREST, _FARTHEST, out=mean[:, 0])
    mean[:, 2] = np.clip(mean[:, 2], -0.7, 0.9)
    return mean, cov


def _scalar_update(
    mean: Floats, cov: Floats, slope: Floats, off: Floats, variance: Floats, limit: float = 2.5
) -> tuple[Floats, Floats]:
    """Correct states by one number each, `off` its expected value; infinite variance changes nothing."""
    crossed = (cov @ slope[:, :, None])[:, :, 0]
    expected = (slope * crossed).sum(axis=1)
    penalty = np.maximum(np.square(off) / (expected + variance) / limit**2, 1.0)
    gain = crossed / (expected + variance * penalty)[:, None]
    return mean + gain * off[:, None], cov - gain[:, :, None] * crossed[:, None, :]
