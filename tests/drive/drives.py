"""Simulated drives: tracks of the boxes that a detector with noise would find, and the true events."""

import numpy as np

from vehicle_detection import Camera, Detections, Tracker, TrackTable
from vehicle_detection.scenes.drive import make_traffic

FPS, SHAPE = 12.5, (720, 1280)
CAMERA = Camera.for_frame(SHAPE)
LENGTH_M, HEIGHT_M = 4.4, 1.5


def box_of(vehicle, time):
    """Box in pixels, including parts outside the frame: near face and far end of the side; None if behind."""
    distance, lateral = vehicle.distance(time), vehicle.lateral(time)
    if distance < 2.0:
        return None
    x = [(lateral + side * 0.9) / d for side in (-1, 1) for d in (distance, distance + LENGTH_M)]
    y = (CAMERA.height_m - HEIGHT_M) / distance, CAMERA.height_m / distance
    columns, rows = np.array([min(x), max(x)]) * CAMERA.focal_px, np.array(y) * CAMERA.focal_px
    return np.array(
        [columns[0] + 640, rows[0] + CAMERA.horizon_px, columns[1] + 640, rows[1] + CAMERA.horizon_px]
    )


def simulate(scenario, seed, **options):
    """Vehicles of a scenario, and the table of their tracks."""
    table = TrackTable()
    traffic = make_traffic(scenario, 10.0, np.random.default_rng(seed))[1]
    for frame in log_frames(scenario, seed, **options):
        table.append(*frame)
    return traffic, table


def log_frames(scenario, seed, *, seconds=10.0, noise=0.03):
    """Yield the number, the time and the tracks of each frame of a scenario."""
    rng = np.random.default_rng(seed)
    _, traffic = make_traffic(scenario, seconds, rng)
    tracker, errors = Tracker(fps=FPS), {}
    for frame in range(round(seconds * FPS)):
        found = []
        nearest_first = sorted(traffic, key=lambda vehicle: vehicle.distance(frame / FPS))
        for vehicle in nearest_first:
            box = box_of(vehicle, frame / FPS)
            if box is None or vehicle.distance(frame / FPS) > 100:
                continue
            sides = np.tile(box[2:] - box[:2], 2)
            inside = np.clip(box, 0, [1280, 720, 1280, 720])
            visible = np.prod(inside[2:] - inside[:2]) / np.prod(sides[:2])
            hidden = any(
                np.prod(
                    np.clip(np.minimum(inside[2:], other[2:]) - np.maximum(inside[:2], other[:2]), 0, None)
                )
                > 0.5 * np.prod(inside[2:] - inside[:2])
                for other in found
            )
            error = 0.8 * errors.get(vehicle.track, np.zeros(4)) + 0.6 * rng.normal(size=4)
            errors[vehicle.track] = error
            if visible > 0.4 and not hidden and rng.random() > 0.05:
                found.append(np.clip(box + noise * error * sides, 0, [1280, 720, 1280, 720]))
        detections = Detections(np.array(found).reshape(-1, 4), np.full(len(found), 2.0))
        yield frame, frame / FPS, tracker.update(detections, (*SHAPE, 3), time=frame / FPS)


def passing_times(traffic, seconds, *, first=2.0, oncoming=False):
    """Time at which each vehicle is beside the camera, whether it comes from behind, and its lane (m)."""
    listed = []
    for vehicle in traffic:
        if vehicle.speed and vehicle.oncoming == oncoming:
            time = -vehicle.start / vehicle.speed
            if first < time < seconds - 1.0:
                listed.append((time, vehicle.speed > 0, vehicle.lane_from))
    return listed


def cut_in_times(traffic):
    """Time at which the middle of each vehicle enters the lane of the camera, and the lane it comes from."""
    times = np.arange(0, 10, 0.02)
    found = []
    for vehicle in traffic:
        inside = np.array([abs(vehicle.lateral(time)) < 1.8 for time in times])
        if inside.any() and not inside[0]:
            found.append((float(times[np.argmax(inside)]), vehicle.lane_from))
    return found
