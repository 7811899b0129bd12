"""Whole-video processing compared with rewriting the video by moviepy with an identity function."""

from __future__ import annotations

import contextlib
from pathlib import Path

from benchmarks._material import Context, clip
from benchmarks._report import Row, at_least, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import VehicleDetector, process_video
from vehicle_detection.video import VideoReport

ROUNDS = 3


def run(context: Context) -> list[Row]:
    """Alternately process the clip with each model and rewrite it by moviepy."""
    source, material = clip(context.work)
    target = context.work / "out.mp4"
    reports: dict[str, list[VideoReport]] = {"highway": [], "default": []}
    moviepy_seconds = []
    with contextlib.ExitStack() as stack:
        detectors = {name: stack.enter_context(VehicleDetector(name)) for name in reports}
        for detector in detectors.values():
            process_video(source, target, detector, end=0.4, progress=False)
        rewrite(source, target, end=0.4)
        for _ in range(ROUNDS):
            moviepy_seconds.append(seconds_of(lambda: rewrite(source, target)))
            for name, detector in detectors.items():
                report = process_video(source, target, detector, progress=False)
                reports[name].append(report)
    moviepy_median = median_of(moviepy_seconds)
    frames = reports["highway"][0].frames
    rows = [
        Row(
            "moviepy with an identity function",
            moviepy_median,
            unit="s",
            material=f"{material}, {frames} frames, veryfast",
        )
    ]
    for name, max_ratio, min_speed in (("highway", 1.2, 45), ("default", 1.35, 45)):
        ours = median_of(report.seconds for report in reports[name])
        middle = sorted(reports[name], key=lambda report: report.seconds)[ROUNDS // 2]
        rows += [
            Row(f"{name}: process_video", ours, unit="s"),
            Row(
                f"{name}: time relative to moviepy's rewrite",
                ours / moviepy_median,
                unit="x",
                target=at_most(max_ratio),
            ),
            Row(f"{name}: speed", frames / ours, unit="frames/s", target=at_least(min_speed)),
            *(
                Row(f"{name}: stage {stage}", seconds / frames * 1e3, unit="ms/frame")
                for stage, seconds in middle.stages.items()
            ),
        ]
    return rows


def rewrite(source: Path, target: Path, *, end: float | None = None) -> None:
    """Decode and encode every frame unchanged, as users of moviepy do."""
    from moviepy import VideoFileClip

    with VideoFileClip(str(source)) as movie:
        part = movie if end is None else movie.subclipped(0, end)
        changed = part.image_transform(lambda frame: frame)
        changed.write_videofile(str(target), preset="veryfast", logger=None)
