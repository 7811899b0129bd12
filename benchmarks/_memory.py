"""Memory of whole-video runs of different lengths, and optionally the speed over a long run."""

from __future__ import annotations

from benchmarks._material import Context, clip, repeated_clip
from benchmarks._probe import run_probe
from benchmarks._report import Row, at_least, at_most

SHORT, FULL, LONG, END = 100, 1000, 3000, 500
MEGABYTE = 1e6


def run(context: Context) -> list[Row]:
    """Process 100 and 1,000 frames (``--long``: also 3,000), each in a new process."""
    source, material = clip(context.work)
    peaks = {}
    for frames in (SHORT, FULL):
        video = repeated_clip(source, frames, context.work)
        found = run_probe("memory", str(video), str(context.work / "out.mp4"))
        if found["frames"] != frames:
            raise AssertionError(f"the repeated clip has {found['frames']} frames instead of {frames}")
        peaks[frames] = found["peak"] / MEGABYTE
    rows = [
        Row(f"peak memory, {SHORT} frames", peaks[SHORT], unit="MB", material=f"{material}, repeated"),
        Row(f"peak memory, {FULL:,} frames", peaks[FULL], unit="MB"),
        Row(f"cost of {FULL - SHORT} more frames", peaks[FULL] - peaks[SHORT], unit="MB", target=at_most(20)),
    ]
    return rows + (_long_run(context) if context.long else [])


def _long_run(context: Context) -> list[Row]:
    """Compare the speed and memory at the beginning and the end of a long run."""
    source, _ = clip(context.work)
    video = repeated_clip(source, LONG, context.work)
    found = run_probe("memory", str(video), str(context.work / "out.mp4"))
    times = found["times"]
    first = (END - 1) / (times[END - 1] - times[0])
    last = (END - 1) / (times[-1] - times[-END])
    # The memory is sampled every hundred frames.
    growth = (found["memory"][-1] - found["memory"][END // 100 - 1]) / MEGABYTE
    return [
        Row(f"{LONG:,} frames: first {END}", first, unit="frames/s"),
        Row(f"{LONG:,} frames: last {END}", last, unit="frames/s"),
        Row(f"{LONG:,} frames: last to first", last / first, target=at_least(0.95)),
        Row(f"{LONG:,} frames: memory after frame {END}", growth, unit="MB more", target=at_most(20)),
    ]
