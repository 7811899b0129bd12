"""``python -m benchmarks --compare REF``: the speed of this tree and of another commit, measured alternately.

Each version runs in a process of its own, which loads its models once. The processes take turns, so that both
see the same load and clock rate of the machine.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks._material import Context, clip, searched_frame
from benchmarks._probe import ROOT
from benchmarks._report import Row
from benchmarks._timing import median_of

ROUNDS = 5
TASKS = {
    "default: detect, one core": "detect default 1",
    "default: detect, two cores": "detect default 2",
    "highway: detect, one core": "detect highway 1",
    "highway: detect, two cores": "detect highway 2",
    "default: whole video": "video default",
    "highway: whole video": "video highway",
}

# Runs in the process of a version. It uses only functions that all versions have.
_WORKER = """
import inspect, sys, time
import numpy as np
import vehicle_detection as vd
frame, source, target = np.load(sys.argv[1]), sys.argv[2], sys.argv[3]
# Earlier versions called it so.
name = "jobs" if "jobs" in inspect.signature(vd.VehicleDetector.__init__).parameters else "n_jobs"
detectors = {}
def detector(model, jobs):
    if (model, jobs) not in detectors:
        detectors[model, jobs] = vd.VehicleDetector(vd.load_model(model), **{name: jobs})
    return detectors[model, jobs]
def seconds(function, *arguments, **options):
    start = time.perf_counter()
    function(*arguments, **options)
    return time.perf_counter() - start
for line in sys.stdin:
    kind, model, *jobs = line.split()
    if kind == "detect":
        detect = detector(model, int(jobs[0])).detect
        result = sorted(seconds(detect, frame) for _ in range(15))[7]
    else:
        result = seconds(vd.process_video, source, target, detector(model, None), end=6.0, progress=False)
    print(result, flush=True)
"""


def compare(context: Context, reference: str) -> list[Row]:
    """Measure both versions; a ratio below 1 means that this tree is faster."""
    frame, source = searched_frame()
    video, _ = clip(context.work)
    np.save(context.work / "frame.npy", frame)
    with contextlib.ExitStack() as stack:
        other = stack.enter_context(_checkout(reference, context.work / "reference"))
        folders = {"reference": other, "here": ROOT}
        workers = {
            name: stack.enter_context(_worker(folder, name, context.work, video))
            for name, folder in folders.items()
        }
        rows = []
        for what, task in TASKS.items():
            for worker in workers.values():
                _measure(worker, task)  # warm up
            rounds = [
                {name: _measure(worker, task) for name, worker in workers.items()} for _ in range(ROUNDS)
            ]
            medians = {name: median_of(found[name] for found in rounds) for name in workers}
            ratio = median_of(found["here"] / found["reference"] for found in rounds)
            material = f"{source}, {reference}" if not rows else ""
            rows += [
                Row(f"{what}, {reference}", medians["reference"] * 1e3, unit="ms", material=material),
                Row(f"{what}, here", medians["here"] * 1e3, unit="ms"),
                Row(f"{what}, here relative to {reference}", ratio, unit="x"),
            ]
    return rows


@contextlib.contextmanager
def _checkout(reference: str, folder: Path) -> Iterator[Path]:
    """Check out a commit into a folder, without changing this tree."""
    git = ["git", "-C", str(ROOT), "worktree"]
    done = subprocess.run([*git, "add", "--detach", str(folder), reference], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"--compare must name a commit of this repository, got {reference!r}: {done.stderr}")
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True, capture_output=True)


@contextlib.contextmanager
def _worker(folder: Path, name: str, work: Path, video: Path) -> Iterator[subprocess.Popen[str]]:
    """Start the process of a version, with a cache of compiled kernels of its own."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(work / f"kernels {name}")}
    command = [sys.executable, "-c", _WORKER, str(work / "frame.npy"), str(video), str(work / f"{name}.mp4")]
    with subprocess.Popen(
        command, cwd=work, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _measure(worker: subprocess.Popen[str], task: str) -> float:
    """Seconds of a task in the process of a version."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    print(task, file=worker.stdin, flush=True)
    answer = worker.stdout.readline()
    if not answer:
        raise RuntimeError(f"the measurement of {task!r} failed; see the error above")
    return float(json.loads(answer))
