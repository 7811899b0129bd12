"""Distances through lenses of several angles, on rendered drives with exact ground truth."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import _drives
from benchmarks._material import Context
from benchmarks._report import Row, at_most
from vehicle_detection import Camera, VehicleDetector, render_drive
from vehicle_detection._common import ROUGH_DISTANCE

ANGLES, HEIGHTS = (58, 90, 120), (1.0, 1.4, 1.8)
"""Fields of view in degrees, and heights of the camera in meters."""

SHAPE, HORIZON = (720, 1280), 0.56

CAMERAS: dict[str, Mapping[str, Any] | None] = {
    "the right camera": {"horizon": HORIZON},
    "the right lens and height": {"horizon_std_px": 0.05 * SHAPE[0]},
    "no camera": None,
}
"""What is known, as options of `Camera.for_frame` besides the lens and the height."""

_LIMITS = {"the right camera": at_most(10), "the right lens and height": at_most(20)}


def run(context: Context) -> list[Row]:
    """Measure the errors of the distances for each field of view, with all heights and seeds together."""
    seeds = range(_drives.FIRST_SEED, _drives.FIRST_SEED + context.seeds)
    tasks = [(angle, height, seed) for angle in ANGLES for height in HEIGHTS for seed in seeds]
    if context.jobs == 1:
        found = [measure(*task) for task in tasks]
    else:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(context.jobs, mp_context=spawn) as pool:
            found = list(pool.map(measure, *zip(*tasks)))
    rows: list[Row] = []
    for known in CAMERAS:
        for angle in ANGLES:
            drives = [drive[known] for task, drive in zip(tasks, found) if task[0] == angle]
            errors = [_drives.range_errors([ranges]).distance for ranges, _ in drives]
            rough = np.mean([share for _, share in drives])
            name, material = f"{angle} degrees, {known}", f"{_drives.FRAMES} rendered frames each, cameras "
            material += f"{HEIGHTS[0]} to {HEIGHTS[-1]} m high, {len(seeds)} seeds"
            rows += [
                Row(
                    f"{name}: median error of the distance",
                    _drives.range_errors([ranges for ranges, _ in drives]).distance,
                    unit="%",
                    target=_LIMITS.get(known),
                    material="" if rows else material,
                ),
                Row(f"{name}: the same in the worst drive", max(errors), unit="%"),
                Row(f"{name}: distances marked with ~", 100 * float(rough), unit="%"),
            ]
    return rows


def measure(angle: float, height: float, seed: int) -> dict[str, tuple[NDArray[np.float64], float]]:
    """Rows of `DriveScores.ranges` of one drive, and the share of rough distances, for each of `CAMERAS`."""
    focal = SHAPE[1] / 2 / math.tan(math.radians(angle) / 2)
    drive = render_drive(
        frames=_drives.FRAMES,
        shape=SHAPE,
        horizon=HORIZON,
        camera_height_m=height,
        focal_px=focal,
        random_state=seed,
    )
    found = {}
    for name, known in CAMERAS.items():
        camera = None
        if known is not None:
            camera = Camera.for_frame(SHAPE, fov=angle, height_m=height, focal_std=0.01, **known)
        results, _ = _drives.track_drive(drive, _detector(camera))
        stated = [
            (track.distance_std_m or 0.0) > ROUGH_DISTANCE * track.distance_m
            for result in results
            for track in result.shown
            if track.distance_m is not None
        ]
        found[name] = _drives.match_ranges(drive.truth, results), float(np.mean(stated)) if stated else 0.0
    return found


@lru_cache(maxsize=len(CAMERAS))
def _detector(camera: Camera | None) -> VehicleDetector:
    return VehicleDetector(camera=camera)
