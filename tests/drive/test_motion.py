"""Motion of tracks whose boxes are exactly known."""

import numpy as np
import pytest

from vehicle_detection.camera import Camera
from vehicle_detection.drive.motion import COLUMNS, TrackHistory, estimate_motion

SHAPE, FPS = (720, 1280), 25
CAMERA = Camera.for_frame(SHAPE)
SPEED, IMPACT = 10.0, 6.0  # m/s, and time of the collision in seconds


def motion_of(seconds, errors):
    """Motion of a vehicle that closes in, given the relative errors of its size in each frame."""
    times = np.arange(round(seconds * FPS)) / FPS
    distance = SPEED * (IMPACT - times)
    height = CAMERA.focal_px * CAMERA.vehicle_height_m / distance * (1 + errors)
    half, bottom = 0.6 * height, CAMERA.horizon_px + CAMERA.focal_px * CAMERA.height_m / distance
    columns = {name: np.full(len(times), np.nan) for name in COLUMNS}
    boxes = np.stack([640 - half, bottom - height, 640 + half, bottom], axis=1)
    columns |= {"distance_m": distance, "distance_std_m": 0.1 * distance}
    track = TrackHistory(1, np.arange(len(times)), boxes, columns)
    return times, estimate_motion(track, fps=FPS, shape=SHAPE, camera=CAMERA)


@pytest.mark.parametrize("row", [0, 5, 50, 95, 99])
def test_the_error_of_the_time_to_collision_is_that_of_the_zero_of_a_fitted_line(row):
    times, motion = motion_of(4.0, np.zeros(100))
    near = times[np.abs(times - times[row]) < 0.75 + 1e-6] - times[row]
    assert motion.time_to_collision[row] == pytest.approx(IMPACT - times[row])
    # Ordinary least squares with errors of 4% of the mean, correlated over half a second.
    values = IMPACT - times[row] - near
    count = max(np.sqrt(12 * near.var()) / 0.5, 2)
    design = np.stack([np.ones_like(near), near], axis=1)
    cov = (0.04 * values.mean()) ** 2 * len(near) / count * np.linalg.inv(design.T @ design)
    # The zero at -value / slope, whose slope is -1 here.
    gradient = np.array([1.0, values.mean() + near.mean()])
    assert motion.time_to_collision_std[row] == pytest.approx(np.sqrt(gradient @ cov @ gradient))
    assert motion.slope_error[row] == pytest.approx(np.sqrt(cov[1, 1]))


@pytest.mark.parametrize("seconds", [4.0, 5.6])
def test_errors_of_the_time_to_collision_fit_at_the_end_of_a_track_too(seconds):
    rng, window = np.random.default_rng(0), round(0.5 * FPS)
    normalized = []
    for _ in range(300):
        noise = rng.standard_normal(round(seconds * FPS) + window - 1)
        errors = 0.04 * np.convolve(noise, np.full(window, window**-0.5), "valid")
        times, motion = motion_of(seconds, errors)
        normalized.append((motion.time_to_collision - (IMPACT - times)) / motion.time_to_collision_std)
    middle, *ends = np.std(np.array(normalized)[:, [round(seconds * FPS) // 2, -5, -1]], axis=0)
    assert 0.6 < middle < 1
    assert all(0.6 < end < 1 for end in ends)


def test_a_vehicle_of_constant_size_has_no_time_to_collision():
    columns = {name: np.full(100, np.nan) for name in COLUMNS}
    boxes = np.tile([600.0, 400, 680, 464], (100, 1))
    columns |= {"distance_m": np.full(100, 20.0), "distance_std_m": np.full(100, 2.0)}
    track = TrackHistory(1, np.arange(100), boxes, columns)
    motion = estimate_motion(track, fps=FPS, shape=SHAPE, camera=CAMERA)
    # Slopes of 0, or of the rounding error.
    assert (np.abs(motion.time_to_collision) > 1e9).all()
    assert (motion.slope_error > 1e9).all()
