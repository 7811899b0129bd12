"""Commands beside ffmpeg alone, start, memory, latency of a live source, and overhead of short clips."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks._material import Context, clip, ffmpeg, searched_frame
from benchmarks._probe import ROOT, run_probe
from benchmarks._report import Row, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import run_batch, write_image

ROUNDS, STARTS = 3, 5
CLIPS, CLIP_FRAMES = 500, 5
RATES = (30, 60)  # frames per second of the live sources
MEGABYTE = 1e6

Times = tuple[float, float]
"""Elapsed and processor time in seconds of a command with its children."""


def run(context: Context) -> list[Row]:
    """Run each command in turns with ffmpeg; then measure the rest."""
    source, material = clip(context.work)
    return [
        *_compare_with_ffmpeg(source, material, context.work),
        *_starts(context.work, source),
        *_memory(source, context.work),
        *(row for rate in RATES for row in _latency(source, rate)),
        _overhead(source, context.work),
    ]


def _compare_with_ffmpeg(source: Path, material: str, work: Path) -> list[Row]:
    video, tracks, out = ("video", str(source), "--quiet"), str(work / "out.csv"), str(work / "out.mp4")
    decode = [ffmpeg(), "-v", "error", "-y", "-i", str(source)]
    commands = {
        "rewrite": [*decode, "-c:v", "libx264", "-preset", "veryfast", str(work / "rewritten.mp4")],
        "default": _program(*video, "-o", out),
        "highway": _program(*video, "-o", out, "--model", "highway"),
        "decode": [*decode, "-an", "-f", "null", "-"],
        "tracks": _program(*video, "--tracks", tracks),
    }
    times: defaultdict[str, list[Times]] = defaultdict(list)
    _run(commands["highway"])  # compiles the kernels
    for _ in range(ROUNDS):
        for name, command in commands.items():
            times[name].append(_run(command))
    elapsed, cpu = (
        {name: median_of(each[i] for each in runs) for name, runs in times.items()} for i in (0, 1)
    )
    rows = [Row("ffmpeg's rewrite, veryfast", elapsed["rewrite"], unit="s", material=material)]
    for model in ("default", "highway"):
        name = f"{model}: annotated video to ffmpeg's rewrite"
        ratio, effort = elapsed[model] / elapsed["rewrite"], cpu[model] / cpu["rewrite"]
        rows.append(Row(f"{name}, time", ratio, unit="x", target=at_most(1.15)))
        rows.append(Row(f"{name}, processor time", effort, unit="x", target=at_most(1.25)))
    ratio = elapsed["tracks"] / elapsed["decode"]
    rows.append(Row("default: tracks only to ffmpeg's decoding, time", ratio, unit="x", target=at_most(2.2)))
    return rows


def _starts(work: Path, source: Path) -> list[Row]:
    image, short = work / "frame.png", [str(source), "--end", "0.2", "--quiet"]
    frame, _ = searched_frame()
    write_image(image, frame)
    np.save(work / "start.npy", frame)
    with_tracks = _program("video", *short, "--tracks", str(work / "short.csv"))
    cold = [_run(with_tracks, work / f"no kernels {number}")[0] for number in range(ROUNDS)]
    warm = [_run(with_tracks)[0] for _ in range(ROUNDS)]
    highway = []
    for number in range(ROUNDS):
        cache = str(work / f"no kernels of highway {number}")
        probe = run_probe("startup", str(work / "start.npy"), "--highway", NUMBA_CACHE_DIR=cache)
        highway.append(probe["first_frame"])
    named = (("--help", 0.2, ["--help"]), ("detect of one image", 0.7, ["detect", str(image)]))
    return [
        *(
            Row(
                f"{name} from the shell, warm",
                median_of(_run(_program(*words))[0] for _ in range(STARTS)),
                unit="s",
                target=at_most(limit),
            )
            for name, limit, words in named
        ),
        Row("more for the first video, without kernels", median_of(cold) - median_of(warm), unit="s",
            target=at_most(1)),
        Row("highway: first frame, without kernels", median_of(highway), unit="s", target=at_most(5)),
    ]  # fmt: skip


def _memory(source: Path, work: Path) -> list[Row]:
    """Peak memory of this process, without ffmpeg, with a video and with tracks only."""
    found = {
        kind: run_probe("memory", str(source), target)["peak"] / MEGABYTE
        for kind, target in (("annotated video", str(work / "out.mp4")), ("tracks only", ""))
    }
    return [Row(f"memory, {kind}", size, unit="MB", target=at_most(250)) for kind, size in found.items()]


def _latency(source: Path, rate: int) -> list[Row]:
    """Time from a frame's arrival to its result, of a live source that sends at this rate."""
    speed = rate / 25  # the clip has 25 frames/s
    sender = [ffmpeg(), "-v", "error", "-readrate", str(speed), "-i", str(source), "-an", "-c:v", "copy"]
    with subprocess.Popen([*sender, "-f", "mpegts", "-"], stdout=subprocess.PIPE) as process:
        found = run_probe("latency", stdin=process.stdout)
    p50, p99 = (float(value) * 1e3 for value in np.percentile(found["latencies"], [50, 99]))
    limit = at_most(100) if rate == RATES[0] else None
    return [
        Row(f"live, {rate} frames/s: latency, p50", p50, unit="ms"),
        Row(f"live, {rate} frames/s: latency, p99", p99, unit="ms", target=limit,
            details={"dropped": found["dropped"]}),
    ]  # fmt: skip


def _overhead(source: Path, work: Path) -> Row:
    """Compare a batch of short clips with the same work in one process."""
    folder = work / "short clips"
    folder.mkdir()
    first = work / "short.mp4"
    options = ["-i", str(source), "-an", "-frames:v", str(CLIP_FRAMES), "-c:v", "libx264", str(first)]
    subprocess.run([ffmpeg(), "-v", "error", "-y", *options], check=True)
    for number in range(CLIPS):
        shutil.copy(first, folder / f"drive {chr(97 + number // 26)}{chr(97 + number % 26)}.mp4")
    for name in ("each", "batch"):
        (work / name).mkdir()
    alone = seconds_of(
        lambda: run_probe("each", "tracks", str(folder), str(work / "each"), VEHICLE_DETECTION_JOBS="1")
    )
    began = time.perf_counter()
    report = run_batch(folder, work / "batch", jobs=1, group="file", tracks_only=True, progress=False)
    batch = time.perf_counter() - began
    if report.done != CLIPS:
        raise AssertionError(f"the batch has processed {report.done} of {CLIPS} clips")
    name = f"overhead of a batch of {CLIPS} clips of {CLIP_FRAMES} frames"
    return Row(name, batch - alone, unit="s", target=at_most(10), details={"batch": batch, "alone": alone})


def _program(*words: str) -> list[str]:
    return [sys.executable, "-m", "vehicle_detection", *words]


def _run(command: Sequence[str], cache: Path | None = None) -> Times:
    """Times of a command, which finds compiled Python modules, as after an installation."""
    import resource

    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "PYTHONPATH": str(ROOT)}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, env=environment, check=True, capture_output=True)
    elapsed, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return elapsed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
