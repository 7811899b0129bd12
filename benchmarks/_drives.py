"""Tracking on rendered drives with exact ground truth: tracks, distances, speeds and delays."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._material import Context
from benchmarks._report import Row, Target, at_least, at_most
from vehicle_detection import FrameResult, VehicleDetector, evaluate_tracks, iou_matrix, render_drive
from vehicle_detection.evaluation import TrackScores
from vehicle_detection.scenes import Drive, VehicleTruth
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import backfill_results, interpolate_results, search_delay, search_interval

FRAMES = 200

CASES: dict[str, dict[str, Any]] = {
    "highway": {},
    "overtaking": {"scenario": "overtaking"},
    "crossing": {"scenario": "crossing"},
    "occlusion": {"scenario": "occlusion"},
    "passing": {"scenario": "passing"},
    "rain": {"rain": 0.6},
    "night": {"light": "night"},
    "960x540": {"shape": (540, 960)},
    "1920x1080": {"shape": (1080, 1920)},
}
"""Options of `render_drive` for each drive with vehicles."""

EMPTY_CASES: dict[str, dict[str, Any]] = {
    "empty": {"scenario": "empty"},
    "empty, rain": {"scenario": "empty", "rain": 0.6},
    "empty, night": {"scenario": "empty", "light": "night"},
}
"""Options of the drives without vehicles."""

FIRST_SEED = 7
NEAR_M, FAR_M = 10.0, 60.0
"""Range of distances in meters in which distance and speed are evaluated."""

_IOU = 0.5
_COLUMNS = ("distance", "true distance", "speed", "true speed", "oncoming")


@dataclass(frozen=True)
class DriveScores:
    """What is measured in one drive.

    `scores`, and `region_mota`, the MOTA with ignored boxes as regions, are None for drives without vehicles.
    Oncoming vehicles behind a barrier are ignored; boxes of their visible parts lie in such regions. `ranges`
    has a row for each match of a track and a vehicle: estimated and true distance, estimated and true speed,
    and 1 for oncoming vehicles. `delays` are the frames from the first detection of each vehicle to the first
    one in which a track shows it, infinite if none does.
    """

    scores: TrackScores | None
    ranges: NDArray[np.float64]
    delays: tuple[float, ...]
    shown: int  # boxes of tracks in all frames
    region_mota: float | None = None


def run(context: Context) -> list[Row]:
    """Track the vehicles of every drive with the default settings, for each seed."""
    seeds = range(FIRST_SEED, FIRST_SEED + context.seeds)
    cases = [*CASES, *EMPTY_CASES]
    tasks = [(case, seed) for case in cases for seed in seeds]
    if context.jobs == 1:
        found = [track_case(*task) for task in tasks]
    else:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(context.jobs, mp_context=spawn) as pool:
            found = list(pool.map(track_case, *zip(*tasks)))
    by_case = {case: [drive for (name, _), drive in zip(tasks, found) if name == case] for case in cases}
    rows: list[Row] = []
    for case in CASES:
        rows += case_rows(case, by_case[case], seeds)
    rows += total_rows([drive for case in CASES for drive in by_case[case]])
    shown = sum(drive.shown for case in EMPTY_CASES for drive in by_case[case])
    rows.append(Row("drives without vehicles: boxes shown", shown, target=Target("=", 0)))
    return [row for row in rows if not math.isnan(row.value)]


def track_case(case: str, seed: int) -> DriveScores:
    """Render and score one drive, in this process."""
    drive = render_drive(frames=FRAMES, random_state=seed, **{**CASES, **EMPTY_CASES}[case])
    return score_drive(drive, _detector())


@lru_cache(maxsize=1)
def _detector() -> VehicleDetector:
    """Return the detector of this process."""
    return VehicleDetector()


def score_drive(drive: Drive, detector: VehicleDetector) -> DriveScores:
    """Track the vehicles of a drive as in a video file, and compare them with the truth."""
    results, detected = track_drive(drive, detector)
    truth = drive.truth
    labels = _label_boxes(truth)
    shown = TrackTable.from_results(results)
    scores, region_mota = None, None
    if len(labels):
        options: dict[str, Any] = {"iou": _IOU, "frames": range(len(results))}
        scores = evaluate_tracks(shown, labels, **options)
        region_mota = evaluate_tracks(shown, labels, ignored_as_regions=True, **options).mota
    ranges, delays = match_ranges(truth, results), tuple(_delays(truth, results, detected))
    return DriveScores(scores, ranges, delays, len(shown), region_mota)


def track_drive(drive: Drive, detector: VehicleDetector) -> tuple[list[FrameResult], list[int]]:
    """Results of all frames, and the frames that were searched; only these are rendered."""
    step, fps = search_interval(drive.fps), drive.fps
    detector.reset(fps=fps)
    tracked: list[FrameResult] = []
    searched = list(range(0, len(drive), step))
    held = search_delay(detector.track_params, fps, step) + 1
    for index in searched:
        found = detector.search(drive[index].image)
        tracked.append(detector.track(found, time=index / fps, frames=step if tracked else 1))
        tracked[-held:] = backfill_results(tracked[-held:])
    results: list[FrameResult] = []
    for result in tracked:
        if results:
            between = range(results[-1].index + 1, result.index)
            times = [frame / fps for frame in between]
            results += interpolate_results(results[-1], result, times, drive.shape)
        results.append(result)
    rest = range(results[-1].index + 1, len(drive))
    times = [frame / fps for frame in rest]
    return results + interpolate_results(results[-1], None, times, drive.shape), searched


def _label_boxes(truth: Sequence[Sequence[VehicleTruth]]) -> TrackTable:
    """Boxes of all frames."""
    rows = [(frame, row) for frame, vehicles in enumerate(truth) for row in vehicles]
    boxes = np.array([row.box for _, row in rows], np.float64).reshape(-1, 4)
    ignored = np.array([bool(row.ignore) for _, row in rows], np.bool_)
    tracks = np.array([row.track for _, row in rows], np.int64)
    return TrackTable([frame for frame, _ in rows], tracks, boxes, ignore=ignored)


def match_ranges(
    truth: Sequence[Sequence[VehicleTruth]], results: Sequence[FrameResult]
) -> NDArray[np.float64]:
    """Return the rows of `DriveScores.ranges`."""
    return np.array(list(_ranges(truth, results))).reshape(-1, len(_COLUMNS))


def _ranges(
    truth: Sequence[Sequence[VehicleTruth]], results: Sequence[FrameResult]
) -> Iterator[tuple[float, ...]]:
    """Rows of `DriveScores.ranges`."""
    for vehicles, result in zip(truth, results):
        near = [row for row in vehicles if not row.hard_to_see and NEAR_M <= row.distance_m <= FAR_M]
        if not near or not result.shown:
            continue
        overlap = iou_matrix([track.box for track in result.shown], [row.box for row in near])
        for track, shared in zip(result.shown, overlap):
            row = near[int(shared.argmax())]
            if shared.max() >= _IOU:
                estimates = (track.distance_m, track.speed_mps)
                distance, speed = (math.nan if value is None else value for value in estimates)
                yield distance, row.distance_m, speed, row.speed_mps, row.ignore


def _delays(
    truth: Sequence[Sequence[VehicleTruth]], results: Sequence[FrameResult], searched: Sequence[int]
) -> Iterator[float]:
    """Frames from the first detection of each vehicle that is not ignored to its first display."""
    frames = set(searched)
    for vehicle in sorted({row.track for vehicles in truth for row in vehicles if not row.ignore}):
        detected: int | None = None
        shown = math.inf
        for index, result in enumerate(results):
            boxes = [row.box for row in truth[index] if row.track == vehicle and not row.ignore]
            if not boxes:
                continue
            if detected is None and index in frames and _covers(result.detections.boxes, boxes):
                detected = index
            if _covers([track.box for track in result.shown], boxes):
                shown = index
                break
        if detected is not None or math.isfinite(shown):
            yield max(shown - (shown if detected is None else detected), 0)


def _covers(found: Any, boxes: Sequence[Any]) -> bool:
    return len(found) > 0 and float(iou_matrix(found, boxes).max()) >= _IOU


def case_rows(case: str, drives: Sequence[DriveScores], seeds: range) -> list[Row]:
    """Rows of one kind of drive over all seeds."""
    found = [drive.scores for drive in drives if drive.scores is not None]
    mota = [scores.mota for scores in found]
    errors = range_errors([drive.ranges for drive in drives])
    details = {f"seed {seed}": scores.to_dict() for seed, scores in zip(seeds, found)}
    material = f"{FRAMES} rendered frames each, {len(seeds)} seeds"
    worst = [Row(f"{case}: minimum MOTA", min(mota), target=at_least(0.90))] if len(mota) > 1 else []
    return [
        Row(f"{case}: MOTA", mean(mota), target=at_least(0.97), material=material, details=details),
        *worst,
        Row(f"{case}: IDF1", mean([scores.idf1 for scores in found]), target=at_least(0.95)),
        Row(f"{case}: median error of the distance", errors.distance, unit="%", target=at_most(6)),
        Row(f"{case}: 90th percentile of it", errors.distance_90, unit="%", target=at_most(12)),
        Row(f"{case}: median error of the speed", errors.speed, unit="m/s", target=at_most(1.5)),
    ]


def total_rows(drives: Sequence[DriveScores]) -> list[Row]:
    """Rows of all drives with vehicles together."""
    found = [drive.scores for drive in drives if drive.scores is not None]
    ranges = [drive.ranges for drive in drives]
    errors = range_errors(ranges)
    oncoming = range_errors([rows[rows[:, -1] > 0] for rows in ranges])
    delays = [delay for drive in drives for delay in drive.delays]
    late = sum(delay > 4 for delay in delays) / len(delays) * 100 if delays else math.nan
    return [
        Row("all drives: MOTA", mean([scores.mota for scores in found]), target=at_least(0.97)),
        Row(
            "all drives: MOTA, ignored boxes as regions",
            mean([drive.region_mota for drive in drives if drive.region_mota is not None]),
            target=at_least(0.995),
        ),
        Row("all drives: identity switches", sum(scores.id_switches for scores in found)),
        Row("all drives: false boxes", sum(scores.fp for scores in found)),
        Row("all drives: median error of the distance", errors.distance, unit="%", target=at_most(6)),
        Row("all drives: 90th percentile of it", errors.distance_90, unit="%", target=at_most(12)),
        Row("all drives: the same, oncoming vehicles", oncoming.distance, unit="%"),
        Row("all drives: vehicles shown over 4 frames after their detection", late, unit="%"),
    ]


@dataclass(frozen=True)
class RangeErrors:
    """Errors for vehicles 10 to 60 m away: median and 90th percentile in percent, and in m/s."""

    distance: float
    distance_90: float
    speed: float


def range_errors(ranges: Sequence[NDArray[np.float64]]) -> RangeErrors:
    """Compare estimated and true distances and speeds of all matches."""
    pairs = np.concatenate([np.empty((0, len(_COLUMNS))), *ranges])
    distance = np.abs(pairs[:, 0] - pairs[:, 1]) / pairs[:, 1] * 100
    speed = np.abs(pairs[:, 2] - pairs[:, 3])
    return RangeErrors(_percentile(distance, 50), _percentile(distance, 90), _percentile(speed, 50))


def _percentile(values: NDArray[np.float64], percent: float) -> float:
    known = values[~np.isnan(values)]
    return float(np.percentile(known, percent)) if len(known) else math.nan


def mean(values: Sequence[float]) -> float:
    """Mean of values; NaN without any."""
    return float(np.mean(values)) if len(values) else math.nan
