"""Batches: speed of two workers and of one, overhead over `process_video`, memory of a worker, and status."""

from __future__ import annotations

import json
import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from benchmarks._material import Context, clip, repeated_clip
from benchmarks._probe import run_probe
from benchmarks._report import Row, at_least, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import run_batch
from vehicle_detection.drive import batch_status

FRAMES, TRIPS = 2000, 8
MEMORY_TRIPS, MEMORY_FRAMES = 20, 50
RECORDS = 10_000
ROUNDS = 3
MEGABYTE = 1e6
_TOPOLOGY = "/sys/devices/system/cpu/cpu{}/topology/thread_siblings_list"


def run(context: Context) -> list[Row]:
    """Process eight trips with one and two workers, in turns; then measure the rest."""
    source, material = clip(context.work)
    first = _copies(repeated_clip(source, 1, context.work), 1, context.work / "first")
    _batch(first, context.work / "out", 1)  # compiles the kernels
    trips = _copies(repeated_clip(source, FRAMES // TRIPS, context.work), TRIPS, context.work / "trips")
    rounds = ROUNDS if context.long else 1
    return [
        Row(
            "rounds of the comparisons of workers",
            rounds,
            material=f"{material}, {FRAMES:,} frames as {TRIPS} trips; workers of one thread",
        ),
        *_compare_workers(trips, context.work, rounds, tracks_only=False),
        *_compare_workers(trips, context.work, rounds, tracks_only=True),
        *_memory(context, source),
        Row(f"status of {RECORDS:,} trips", _status_seconds(context.work), unit="s", target=at_most(2)),
    ]


def _compare_workers(trips: Path, work: Path, rounds: int, *, tracks_only: bool) -> list[Row]:
    """Compare two workers with one, free to use all CPUs and each bound to one, and with `process_video`."""
    out, cpus = work / "out", two_cpus()
    runs: dict[str, Callable[[], float]] = {
        "process_video": partial(_process_all, trips, out, tracks_only=tracks_only),
        "one worker": partial(_batch, trips, out, 1, tracks_only=tracks_only),
        "two workers": partial(_batch, trips, out, 2, tracks_only=tracks_only),
    }
    if cpus:
        for name, used in (("one worker on one CPU", cpus[:1]), ("two workers on a CPU each", cpus)):
            runs[name] = partial(_bound_batch, trips, out, used, tracks_only=tracks_only)
    times: defaultdict[str, list[float]] = defaultdict(list)
    for _ in range(rounds):
        for name, measure in runs.items():
            times[name].append(measure())
    seconds = {name: median_of(each) for name, each in times.items()}
    kind = "tracks only" if tracks_only else "with videos"
    rows = [Row(f"{kind}: {name}", each, unit="s") for name, each in seconds.items()]
    overhead = seconds["one worker"] / seconds["process_video"]
    rows.append(Row(f"{kind}: one worker to process_video", overhead, unit="x", target=at_most(1.1)))
    gain = seconds["one worker"] / seconds["two workers"]
    rows.append(Row(f"{kind}: two workers to one", gain, unit="x", target=None if cpus else at_least(1.8)))
    if cpus:
        bound = seconds["one worker on one CPU"] / seconds["two workers on a CPU each"]
        rows.append(
            Row(
                f"{kind}: two workers to one, bound to a CPU each",
                bound,
                unit="x",
                target=at_least(1.8),
                details={"CPUs": cpus, "of one core": _siblings(cpus[0]) == _siblings(cpus[1])},
            )
        )
    return rows


def two_cpus() -> list[int]:
    """Two CPUs that this process may use, of different cores if possible; none where CPUs cannot be bound."""
    if not hasattr(os, "sched_getaffinity"):  # only Linux
        return []
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2:
        return []
    first = allowed[0]
    other = next((cpu for cpu in allowed[1:] if _siblings(cpu) != _siblings(first)), allowed[1])
    return [first, other]


def _siblings(cpu: int) -> str:
    """Logical CPUs of the core to which a CPU belongs."""
    path = Path(_TOPOLOGY.format(cpu))
    return path.read_text(encoding="ascii").strip() if path.exists() else str(cpu)


def _copies(video: Path, count: int, folder: Path) -> Path:
    """Folder with copies of a video, which are different trips."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        shutil.copy(video, folder / f"drive {chr(97 + number)}{video.suffix}")
    return folder


def _batch(trips: Path, out: Path, jobs: int, *, tracks_only: bool = False) -> float:
    """Seconds of a whole batch, with the start of its workers."""
    reports = []
    options = {"jobs": jobs, "tracks_only": tracks_only, "progress": False}
    seconds = seconds_of(lambda: reports.append(run_batch(trips, out, **options)))
    _check_done(reports[0].done, trips, out)
    return seconds


def _bound_batch(trips: Path, out: Path, cpus: Sequence[int], *, tracks_only: bool) -> float:
    """Seconds of batches at the same time, one for each CPU, as the tasks of a job array.

    Each has an equal part of the trips. Its worker and ffmpeg run on its CPU only.
    """
    files = [str(path) for path in sorted(trips.iterdir())]
    kind = "tracks" if tracks_only else "videos"

    def process(place: int) -> int:
        part = files[place :: len(cpus)]
        done: int = run_probe("bound", str(cpus[place]), kind, str(out), *part)["done"]
        return done

    with ThreadPoolExecutor(len(cpus)) as pool:
        counts: list[int] = []
        seconds = seconds_of(lambda: counts.extend(pool.map(process, range(len(cpus)))))
    _check_done(sum(counts), trips, out)
    return seconds


def _check_done(done: int, trips: Path, out: Path) -> None:
    """Check that a batch has processed all trips, and remove its results."""
    if done != len(list(trips.iterdir())):
        raise AssertionError(f"the batch has processed {done} trips: {batch_status(out)}")
    shutil.rmtree(out)


def _process_all(trips: Path, out: Path, *, tracks_only: bool) -> float:
    """Seconds of `process_video` for each trip in a new process with one thread, with the start of Python."""
    out.mkdir()
    kind = "tracks" if tracks_only else "videos"
    seconds = seconds_of(lambda: run_probe("each", kind, str(trips), str(out), VEHICLE_DETECTION_JOBS="1"))
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
