"""Run the detector for very many frames: memory, speed and identities must stay as they are.

``python -m tools.soak --frames 100000`` renders a short drive once and repeats it. The last tenth of the
frames is compared with the first. ``--hours 20`` searches each frame of the drive once and tracks the results
for so many hours of video, which takes a tenth of that time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import vehicle_detection as vd


@dataclass(frozen=True)
class Sample:
    """State after a tenth of the frames."""

    frames: int
    memory_mb: float
    frames_per_second: float  # of the processor's time, so that other processes do not matter
    tracks: int
    mean_distance_m: float


FPS = 25.0


def soak(
    model: str,
    *,
    frames: int,
    length: int = 100,
    shape: tuple[int, int] = (270, 480),
    seed: int = 0,
    replay: bool = False,
) -> Iterator[Sample]:
    """Track the vehicles of `frames` frames, and measure after each tenth of them.

    With `replay`, each frame of the drive is searched once only.
    """
    scenes = [scene.image for scene in vd.render_drive(frames=length, shape=shape, random_state=seed)]
    total, count = 0.0, 0  # of the distances
    with vd.VehicleDetector(model) as detector:
        detector.reset(fps=FPS)
        found = [detector.search(scene) for scene in scenes] if replay else []
        start, before = time.process_time(), 0
        for number in range(frames):
            place = number % length
            search = found[place] if replay else detector.search(scenes[place])
            result = detector.track(search, time=number / FPS)
            distances = [track.distance_m for track in result.tracks if track.distance_m is not None]
            total, count = total + sum(distances), count + len(distances)
            if (number + 1) % max(frames // 10, 1) == 0:
                elapsed = time.process_time() - start
                yield Sample(
                    frames=number + 1,
                    memory_mb=_memory_mb(),
                    frames_per_second=(number + 1 - before) / elapsed,
                    tracks=len(result.tracks),
                    mean_distance_m=total / count if count else 0.0,
                )
                total, count = 0.0, 0
                start, before = time.process_time(), number + 1


def _memory_mb() -> float:
    """Memory of this process now, in MB; 0 where the system does not tell it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 1e6


def judge(samples: list[Sample]) -> list[str]:
    """Name what has grown or slowed down since the first sample."""
    first, last, problems = samples[0], samples[-1], []
    if last.memory_mb > first.memory_mb + 20:
        problems.append(f"memory grew from {first.memory_mb:.0f} to {last.memory_mb:.0f} MB")
    speeds = [sample.frames_per_second for sample in samples[1:]]
    if speeds and np.median(speeds[len(speeds) // 2 :]) < 0.8 * first.frames_per_second:
        problems.append(f"speed fell from {first.frames_per_second:.0f} to {speeds[-1]:.0f} frames/s")
    if max(sample.tracks for sample in samples) > 30:
        problems.append("the number of tracks is not bounded")
    if abs(last.mean_distance_m - first.mean_distance_m) > 0.1 * first.mean_distance_m + 1:
        problems.append(f"distances drifted from {first.mean_distance_m:.1f} to {last.mean_distance_m:.1f} m")
    return problems


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--hours", type=float, help="hours of video whose searched frames are tracked")
    parser.add_argument("--models", nargs="+", default=["default", "highway"])
    options = parser.parse_args()
    failed = False
    frames = round(options.hours * 3600 * FPS) if options.hours else options.frames
    for model in options.models:
        samples = []
        for sample in soak(model, frames=frames, replay=options.hours is not None):
            samples.append(sample)
            print(
                f"{model}: {sample.frames} frames, {sample.memory_mb:.0f} MB, "
                f"{sample.frames_per_second:.1f} frames/s of one core, {sample.tracks} tracks, "
                f"mean distance {sample.mean_distance_m:.1f} m",
                flush=True,
            )
        problems = judge(samples)
        failed |= bool(problems)
        print(f"{model}: {'; '.join(problems) or 'steady'}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
