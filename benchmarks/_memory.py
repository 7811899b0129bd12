"""Memory of whole-video runs of different lengths, and on request a long run that must not slow down."""

from __future__ import annotations

from benchmarks._material import Context, clip, looped
from benchmarks._probe import run_probe
from benchmarks._report import Row, at_least, at_most

SHORT, FULL, LONG, END = 100, 1000, 3000, 500
MEGABYTE = 1e6


def run(context: Context) -> list[Row]:
    """Process 100 and 1,000 frames (``--long``: 3,000 too), each in a fresh process."""
    source, material = clip(context.work)
    peaks = {}
    for frames in (SHORT, FULL):
        found = run_probe("memory", str(looped(source, frames, context.work)), str(context.work / "out.mp4"))
        if found["frames"] != frames:
            raise AssertionError(f"the looped clip has {found['frames']} frames instead of {frames}")
        peaks[frames] = found["peak"] / MEGABYTE
    rows = [
        Row(
            what=f"peak memory, {SHORT} frames", value=peaks[SHORT], unit="MB", material=f"{material}, looped"
        ),
        Row(what=f"peak memory, {FULL:,} frames", value=peaks[FULL], unit="MB"),
        Row(
            what=f"cost of {FULL - SHORT} more frames",
            value=peaks[FULL] - peaks[SHORT],
            unit="MB",
            target=at_most(20),
        ),
    ]
    return rows + (_long_run(context) if context.long else [])


def _long_run(context: Context) -> list[Row]:
    """Compare the beginning and the end of a long run."""
    source, _ = clip(context.work)
    video = looped(source, LONG, context.work)
    found = run_probe("memory", str(video), str(context.work / "out.mp4"))
    moments = found["moments"]
    first = (END - 1) / (moments[END - 1] - moments[0])
    last = (END - 1) / (moments[-1] - moments[-END])
    # One sample of the held memory stands for every hundred frames.
    growth = (found["held"][-1] - found["held"][END // 100 - 1]) / MEGABYTE
    return [
        Row(what=f"{LONG:,} frames: first {END}", value=first, unit="frames/s"),
        Row(what=f"{LONG:,} frames: last {END}", value=last, unit="frames/s"),
        Row(what=f"{LONG:,} frames: last to first", value=last / first, target=at_least(0.95)),
        Row(
            what=f"{LONG:,} frames: memory after frame {END}",
            value=growth,
            unit="MB more",
            target=at_most(20),
        ),
    ]
