"""Distances and speeds against measured ones, on real sequences and on rendered drives of another kind.

A sequence is a folder with ``frames/``, ``camera.json`` (of `read_camera`), and one or both of ``truth.csv``
(labels with ``distance_m`` and ``speed_mps``) and ``own_speed.csv`` (``time_s,speed_mps``, one row a frame).
Lens and height of the camera are stated, its horizon is not. Rendered drives are rough: vehicles of other
widths than the tracker assumes, trucks, a camera that pitches and rolls, crests and dips, 10 frames/s.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks._material import Context, data_folder
from benchmarks._report import Row, Target, at_least, at_most
from vehicle_detection import (
    Camera,
    FrameResult,
    TrackTable,
    VehicleDetector,
    evaluate_tracks,
    open_source,
    read_camera,
    read_labels,
    render_drive,
    track,
)
from vehicle_detection.evaluation import evaluate_distances
from vehicle_detection.evaluation.distances import ErrorScores
from vehicle_detection.search import SearchResult
from vehicle_detection.tables import CORNERS
from vehicle_detection.tracking import backfill_results, search_delay

SEQUENCES: Mapping[str, tuple[float, Camera]] = {
    "tusimple_a": (20, Camera.dashcam(fov=83.77, height_m=1.8)),
    "tusimple_b": (20, Camera.dashcam(fov=83.77, height_m=1.8)),
    "kitti_odo03": (10, Camera.dashcam(fov=81.43, height_m=1.65)),
}
"""Frame rates and cameras of the sequences of the real data."""

PARKED = {"kitti_odo03": (85, (732, 931))}
"""A frame of these sequences, and the columns of a parked vehicle in it."""

WRONG: Mapping[str, Mapping[str, float]] = {
    "field of view 10% too large": {"fov": 1.1},
    "height of the camera 10% too large": {"height_m": 1.1},
    "horizon stated 0.01 too low": {"horizon": 0.01},
    "horizon stated": {"horizon": 0.0},
}
"""Other statements about the camera of the rough drives: factors, and the error of the horizon."""

DRIVES, FRAMES, FPS, SHAPE = 20, 100, 10, (720, 1280)
_SCENARIOS = ("traffic", "highway", "closing", "passing", "cut_in")


def run(context: Context) -> list[Row]:
    """Compare tracks with the truth of the given sequences, by default those of the data, and of drives."""
    rows: list[Row] = []
    folder = data_folder()
    sequences = context.sequences or ([folder / "sequences" / name for name in SEQUENCES] if folder else [])
    for sequence in sequences:
        rows += _sequence_rows(sequence, context.fps)
    if context.sequences:
        return rows
    seeds = range(DRIVES)
    if context.jobs == 1:
        drives = [track_rough_drive(seed) for seed in seeds]
    else:
        with ProcessPoolExecutor(context.jobs, mp_context=get_context("spawn")) as pool:
            drives = list(pool.map(track_rough_drive, seeds))
    truth = _join([labels for labels, _ in drives])
    found = {name: _join([tables[name] for _, tables in drives]) for name in drives[0][1]}
    mota = [evaluate_tracks(tables[""], labels).mota for labels, tables in drives]
    material = f"{len(drives)} rendered drives of {FRAMES} frames"
    rows.append(Row("rough drives: MOTA", float(np.mean(mota)), target=at_least(0.98), material=material))
    rows += _error_rows("rough drives", found[""], truth, limit=4, speed_limit=0.6)
    for name in WRONG:
        for where, errors in evaluate_distances(found[name], truth).distances.items():
            if where in ("10-20 m", "20-40 m"):
                row = f"rough drives, {name}: distance, {where}: bias"
                rows.append(Row(row, 100 * errors.bias, unit="%"))
    return rows


def _sequence_rows(folder: Path, fps: float | None) -> list[Row]:
    """Rows of one sequence."""
    rate, camera = SEQUENCES.get(folder.name, (10.0, None))
    detector = VehicleDetector(camera=camera or read_camera(folder / "camera.json"))
    with open_source(folder / "frames", fps=fps or rate) as source:
        found = TrackTable.from_results(list(track(source, detector)))
    rows: list[Row] = []
    if (truth := folder / "truth.csv").exists():
        rows += _error_rows(folder.name, found, read_labels(truth), limit=7, speed_limit=1.5)
    if folder.name in PARKED:
        own = pd.read_csv(folder / "own_speed.csv")["speed_mps"].to_numpy()
        frame, (left, right) = PARKED[folder.name]
        boxes = found.frame(frame).boxes
        nearest = np.abs(boxes[:, [0, 2]] - (left, right)).sum(axis=1).argmin()
        parked = found[found["track_id"] == found.frame(frame)["track_id"][nearest]]
        speed = parked["speed_mps"] + own[parked["frame"].astype(int)]
        name = f"{folder.name}: parked vehicle, median speed over ground"
        rows.append(Row(name, abs(float(np.nanmedian(speed))), unit="m/s", target=at_most(0.5)))
    return rows


def track_rough_drive(seed: int) -> tuple[TrackTable, dict[str, TrackTable]]:
    """Truth of a rough drive, and its tracks by what is stated: the right lens and height, or `WRONG`."""
    random = np.random.default_rng([seed, 3])
    fov, height, horizon = random.uniform(55, 95), random.uniform(1.2, 1.8), random.uniform(0.48, 0.58)
    drive = render_drive(
        frames=FRAMES,
        fps=FPS,
        shape=SHAPE,
        scenario=_SCENARIOS[seed % len(_SCENARIOS)],
        rough=True,
        random_state=seed,
        focal_px=SHAPE[1] / 2 / math.tan(math.radians(fov) / 2),
        camera_height_m=height,
        horizon=horizon,
    )
    detector = VehicleDetector()
    found = [detector.search(scene.image) for scene in drive]
    tables = {}
    for name, wrong in {"": {}, **WRONG}.items():
        camera = Camera.dashcam(
            fov=fov * wrong.get("fov", 1.0),
            height_m=height * wrong.get("height_m", 1.0),
            horizon=horizon + wrong["horizon"] if "horizon" in wrong else None,
        )
        tables[name] = TrackTable.from_results(_track(found, VehicleDetector(camera=camera)))
    return drive.labels, tables


def _track(found: Sequence[SearchResult], detector: VehicleDetector) -> list[FrameResult]:
    """Results of all frames as in a video file."""
    detector.reset(fps=FPS)
    held = search_delay(detector.track_params, FPS, 1) + 1
    results: list[FrameResult] = []
    for index, frame in enumerate(found):
        results.append(detector.track(frame, time=index / FPS))
        results[-held:] = backfill_results(results[-held:])
    return results


def _join(tables: Sequence[TrackTable]) -> TrackTable:
    """Return the rows of several videos as one table, with frames and tracks of their own."""
    offsets = np.repeat(np.arange(len(tables)) * 10_000, [len(table) for table in tables])
    names = [name for name in tables[0].columns if name not in ("frame", "track_id", *CORNERS)]
    columns = {name: np.concatenate([table[name] for table in tables]) for name in names}
    frame, tracks = (np.concatenate([table[name] for table in tables]) for name in ("frame", "track_id"))
    boxes = np.concatenate([table.boxes for table in tables])
    return TrackTable((frame.astype(int) + offsets).tolist(), tracks + offsets, boxes, **columns)


def _error_rows(
    name: str, found: TrackTable, truth: TrackTable, *, limit: float, speed_limit: float
) -> Iterator[Row]:
    """Rows of the errors of distances, speeds and times to collision; `limit` in percent."""
    scores = evaluate_distances(found, truth)
    targets = {"10-20 m": limit, "20-40 m": limit, "cut, 0-5 m": 25}
    for where, errors in scores.distances.items():
        most = targets.get(where)
        yield from _rows(f"{name}: distance, {where}", errors, 100, "%", most and at_most(most))
    yield from _rows(f"{name}: speed", scores.speeds, 1, "m/s", at_most(speed_limit))
    yield from _rows(f"{name}: time to collision", scores.collision_times, 100, "%", at_most(12))


def _rows(name: str, errors: ErrorScores, scale: float, unit: str, target: Target | None) -> Iterator[Row]:
    """Error, bias and coverage of one quantity, if its truth is known."""
    if errors.stated:
        material = f"{errors.stated} of {errors.known} stated"
        yield Row(f"{name}: median error", scale * errors.error, unit=unit, target=target, material=material)
        yield Row(f"{name}: bias", scale * errors.bias, unit=unit)
        for what, value in (("1 std", errors.within_1_std), ("2 std", errors.within_2_std)):
            if not math.isnan(value):
                yield Row(f"{name}: within {what}", 100 * value, unit="%")
