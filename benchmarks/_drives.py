"""Tracking on rendered drives with exact ground truth: tracks, distances and speeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._material import Context
from benchmarks._report import Row, at_least, at_most
from vehicle_detection import (
    FrameResult,
    VehicleDetector,
    evaluate_tracks,
    iou_matrix,
    read_labels,
    render_drive,
)
from vehicle_detection.evaluation import FrameBoxes
from vehicle_detection.synthetic import Drive

FRAMES = 200

CASES: dict[str, dict[str, Any]] = {
    "highway": {},
    "overtaking": {"scenario": "overtaking"},
    "crossing": {"scenario": "crossing"},
    "occlusion": {"scenario": "occlusion"},
    "rain": {"rain": 0.6},
    "night": {"light": "night"},
    "960x540": {"shape": (540, 960)},
    "1920x1080": {"shape": (1080, 1920)},
}
"""Options of `render_drive` for each drive."""

SEED = 7
NEAR_M, FAR_M = 10.0, 60.0
"""Range of distances in meters in which distance and speed are evaluated."""


def run(context: Context) -> list[Row]:
    """Track the vehicles of every drive with the default settings."""
    rows: list[Row] = []
    with VehicleDetector() as detector:
        for name, options in CASES.items():
            rows += drive_rows(
                name, render_drive(frames=FRAMES, random_state=SEED, **options), detector, context
            )
    return rows


def drive_rows(name: str, drive: Drive, detector: VehicleDetector, context: Context) -> list[Row]:
    """Score one drive."""
    detector.reset(fps=drive.fps)
    results = [detector.process(scene.image, index / drive.fps) for index, scene in enumerate(drive)]
    labels = context.work / f"{name}.csv"
    drive.write_labels(labels)
    scores = evaluate_tracks(
        FrameBoxes.from_results(results), read_labels(labels), frames=range(len(results))
    )
    errors = range_errors(drive, results)
    material, details = f"{FRAMES} rendered frames each", scores.to_dict()
    return [
        Row(f"{name}: MOTA", scores.mota, target=at_least(0.95), material=material, details=details),
        Row(f"{name}: IDF1", scores.idf1, target=at_least(0.95)),
        Row(f"{name}: median error of the distance", errors.distance, unit="%", target=at_most(15)),
        Row(f"{name}: median error of the speed", errors.speed, unit="m/s", target=at_most(1.5)),
    ]


@dataclass(frozen=True)
class RangeErrors:
    """Median errors for vehicles 10 to 60 m away: distance in percent, speed in m/s."""

    distance: float
    speed: float


def range_errors(drive: Drive, results: list[FrameResult]) -> RangeErrors:
    """Compare estimated and true distances and speeds."""
    pairs = np.array(list(_ranges(drive, results))).reshape(-1, 4)
    distance = np.abs(pairs[:, 0] - pairs[:, 1]) / pairs[:, 1] * 100
    speed = np.abs(pairs[:, 2] - pairs[:, 3])
    return RangeErrors(_median(distance), _median(speed))


def _median(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _ranges(drive: Drive, results: list[FrameResult]) -> Iterator[tuple[float, float, float, float]]:
    """Estimated and true distance, estimated and true speed of each match of a track and a vehicle."""
    for truth, result in zip(drive.truth, results):
        near = [row for row in truth if not row.ignore and NEAR_M <= row.distance_m <= FAR_M]
        if not near or not result.shown:
            continue
        overlap = iou_matrix([track.box for track in result.shown], [row.box for row in near])
        for track, shared in zip(result.shown, overlap):
            row = near[int(shared.argmax())]
            if shared.max() >= 0.5:
                estimates = (track.distance_m, track.speed_mps)
                distance, speed = (np.nan if value is None else value for value in estimates)
                yield distance, row.distance_m, speed, row.speed_mps
