"""Measurements in a process of their own, which print one line of JSON.

``python -m benchmarks._probe startup FRAME.npy [--kernels] [--highway]``, ``... memory VIDEO TARGET``,
``... latency`` of standard input, ``... each videos|tracks FOLDER OUTPUT``,
``... bound CPU videos|tracks OUTPUT VIDEO...`` and ``... trips FOLDER OUTPUT``. Only the standard library is
imported before the measurement starts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def run_probe(*arguments: str, stdin: Any = None, **environment: str) -> dict[str, Any]:
    """Run this module in a new interpreter and return its result."""
    command = [sys.executable, "-m", "benchmarks._probe", *arguments]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, **environment},
        stdin=stdin,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the measurement failed:\n{done.stderr}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def startup(frame: str, *, kernels: bool = False, model: str = "default") -> dict[str, Any]:
    """Import the package and detect on a first frame."""
    began = time.perf_counter()
    import vehicle_detection

    imported = time.perf_counter()
    import numpy as np

    record = None
    if kernels:
        from numba.core import event

        recorder = event.install_recorder("numba:compile")
        record = recorder.__enter__()
    vehicle_detection.VehicleDetector(model).detect(np.load(frame))
    first = time.perf_counter()
    return {
        "import": imported - began,
        "first_frame": first - imported,
        "kernels": _compile_seconds(record) if record is not None else {},
    }


def _compile_seconds(record: Any) -> dict[str, float]:
    """Seconds to compile each kernel, including the functions that it calls."""
    seconds: dict[str, float] = {}
    starts: list[float] = []
    for moment, occurrence in record.buffer:
        if occurrence.is_start:
            starts.append(moment)
            continue
        began = starts.pop()
        if not starts:
            name = occurrence.data["dispatcher"].py_func.__name__
            seconds[name] = seconds.get(name, 0.0) + moment - began
    return seconds


def memory(source: str, target: str) -> dict[str, Any]:
    """Process a whole video; report this process's memory (without ffmpeg) and the time of each frame."""
    import vehicle_detection

    times: list[float] = []
    sampled: list[int] = []

    def note(result: Any) -> None:
        times.append(time.perf_counter())
        if len(times) % 100 == 0:
            sampled.append(current_memory())

    with vehicle_detection.VehicleDetector() as detector:
        vehicle_detection.process_video(source, target or None, detector, progress=False, on_result=note)
    return {"frames": len(times), "peak": peak_memory(), "memory": sampled, "times": times}


def latency() -> dict[str, Any]:
    """Track standard input as a live source; seconds from the arrival of each frame to its result."""
    import numpy as np

    import vehicle_detection
    from vehicle_detection.video.live import LiveStream

    arrivals: dict[int, float] = {}
    read = LiveStream.read

    def note(stream: LiveStream, planes: Any) -> int | None:
        number = read(stream, planes)
        if number is not None:
            arrivals[number] = time.perf_counter()
        return number

    LiveStream.read = note  # type: ignore[method-assign]
    found: list[float] = []
    with vehicle_detection.VehicleDetector() as detector:
        detector.detect(np.zeros((720, 1280, 3), np.uint8))  # opens the session
        with vehicle_detection.open_source("-", live=True) as source:
            results = vehicle_detection.track(source, detector)
            found.extend(time.perf_counter() - arrivals[result.index] for result in results)
    return {"latencies": found, "dropped": results.report().dropped}


def each(kind: str, folder: str, out: str) -> dict[str, Any]:
    """Process each video of a folder with one thread, as a worker of a batch does."""
    import vehicle_detection

    frames = 0
    with vehicle_detection.VehicleDetector(jobs=1) as detector:
        for path in sorted(Path(folder).iterdir()):
            target = Path(out) / path.name
            with vehicle_detection.open_tracks(target.with_suffix(".parquet")) as write:
                done = vehicle_detection.process_video(
                    path,
                    target if kind == "videos" else None,
                    detector,
                    jobs=1,
                    progress=False,
                    on_result=write,
                )
                frames += done.frames
    return {"frames": frames}


def bound(cpu: str, kind: str, out: str, *files: str) -> dict[str, Any]:
    """Process videos as a batch with one worker; all processes of it may use one CPU only."""
    os.sched_setaffinity(0, {int(cpu)})
    import vehicle_detection

    report = vehicle_detection.run_batch(files, out, jobs=1, tracks_only=kind == "tracks", progress=False)
    return {"done": report.done}


def trips(folder: str, out: str) -> dict[str, Any]:
    """Process the trips of a batch in this process, and sample its memory after each."""
    from concurrent.futures import ThreadPoolExecutor

    import vehicle_detection

    sampled: list[int] = []
    with ThreadPoolExecutor(1) as executor:
        vehicle_detection.run_batch(
            folder, out, executor, progress=False, on_record=lambda _: sampled.append(current_memory())
        )
    return {"memory": sampled}


def peak_memory() -> int:
    """Peak resident memory of this process in bytes.

    On Linux the maximum of ``getrusage`` survives ``exec`` and may be that of the parent process; ``VmHWM``
    is reset.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def current_memory() -> int:
    """Resident memory of this process in bytes; 0 if the system does not report it."""
    status = Path("/proc/self/statm")
    if not status.exists():
        return 0
    return int(status.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main(arguments: list[str]) -> None:
    """Run the named measurement."""
    kind, *rest = arguments
    if kind == "startup":
        model = "highway" if "--highway" in rest else "default"
        found = startup(rest[0], kernels="--kernels" in rest, model=model)
    else:
        found = {"memory": memory, "latency": latency, "each": each, "bound": bound, "trips": trips}[kind](
            *rest
        )
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
