"""Batches: speed of two workers and of one, overhead over `process_video`, memory of a worker, and status."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from benchmarks._material import Context, clip, repeated_clip
from benchmarks._probe import run_probe
from benchmarks._report import Row, at_least, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import batch_status, run_batch

FRAMES, TRIPS = 2000, 8
MEMORY_TRIPS, MEMORY_FRAMES = 20, 50
RECORDS = 10_000
ROUNDS = 3
MEGABYTE = 1e6


def run(context: Context) -> list[Row]:
    """Process eight trips with one and two workers, in turns; then measure the rest."""
    source, material = clip(context.work)
    trips = _copies(repeated_clip(source, FRAMES // TRIPS, context.work), TRIPS, context.work / "trips")
    single: list[float] = []
    seconds: dict[int, list[float]] = {1: [], 2: []}
    for number in range(ROUNDS):
        single.append(_process_all(trips, context.work / f"single{number}"))
        for jobs, times in seconds.items():
            times.append(_batch(trips, context.work / f"out{number}_{jobs}", jobs))
    one, two, direct = median_of(seconds[1]), median_of(seconds[2]), median_of(single)
    return [
        Row(
            f"{TRIPS} trips, one worker with one thread",
            one,
            unit="s",
            material=f"{material}, {FRAMES:,} frames as {TRIPS} trips, with videos",
        ),
        Row("two workers with one thread each", two, unit="s"),
        Row("two workers to one", one / two, unit="x", target=at_least(1.8)),
        Row("process_video for each trip in one process, one thread", direct, unit="s"),
        Row("one worker to process_video", one / direct, unit="x", target=at_most(1.1)),
        *_memory(context, source),
        Row(f"status of {RECORDS:,} trips", _status_seconds(context.work), unit="s", target=at_most(2)),
    ]


def _copies(video: Path, count: int, folder: Path) -> Path:
    """Folder with copies of a video, which are different trips."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        shutil.copy(video, folder / f"drive {chr(97 + number)}{video.suffix}")
    return folder


def _batch(trips: Path, out: Path, jobs: int) -> float:
    """Seconds of a whole batch, with the start of its workers."""
    reports = []
    seconds = seconds_of(lambda: reports.append(run_batch(trips, out, jobs=jobs, progress=False)))
    done = reports[-1].done
    shutil.rmtree(out)
    if done != len(list(trips.iterdir())):
        raise AssertionError(f"the batch has processed {done} trips: {dict(reports[-1].messages)}")
    return seconds


def _process_all(trips: Path, out: Path) -> float:
    """Seconds of `process_video` for each trip in a new process with one thread, with the start of Python."""
    out.mkdir()
    seconds = seconds_of(lambda: run_probe("videos", str(trips), str(out), VEHICLE_DETECTION_JOBS="1"))
    shutil.rmtree(out)
    return seconds


def _memory(context: Context, source: Path) -> list[Row]:
    """Compare the memory of a process after the second trip and after the last one."""
    video = repeated_clip(source, MEMORY_FRAMES, context.work)
    trips = _copies(video, MEMORY_TRIPS, context.work / "memory")
    found = run_probe("trips", str(trips), str(context.work / "memory_out"), VEHICLE_DETECTION_JOBS="1")
    sizes = [size / MEGABYTE for size in found["memory"]]
    return [
        Row("memory of a worker after 2 trips", sizes[1], unit="MB"),
        Row(
            f"more after {MEMORY_TRIPS} trips", sizes[-1] - sizes[1], unit="MB", target=at_most(20),
            details={"after each trip": [round(size, 1) for size in sizes]},
        ),
    ]  # fmt: skip


def _status_seconds(work: Path) -> float:
    folder = work / "status" / "records"
    folder.mkdir(parents=True)
    source = {"uri": "/cards/1/20260131_081500_F.mp4", "size": 60_000_000, "tag": "1769847300000000000"}
    facts = {"status": "done", "frames": 1500, "tracks": 7, "video_seconds": 60.0, "seconds": 30.0}
    text = json.dumps({**facts, "sources": [source] * 10, "settings": {"model": "default"}}, indent=1)
    for number in range(RECORDS):
        (folder / f"{number:012x}-0123456789ab.json").write_text(text, encoding="utf-8")
    return median_of(seconds_of(lambda: batch_status(folder.parent)) for _ in range(ROUNDS))
