"""A whole video against the same rewrite by moviepy with a function that does nothing."""

from __future__ import annotations

from pathlib import Path

from benchmarks._material import Context, clip
from benchmarks._report import Row, at_least, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import VehicleDetector, VideoReport, process_video

ROUNDS = 3


def run(context: Context) -> list[Row]:
    """Process the clip and rewrite it by moviepy, in turn."""
    source, material = clip(context.work)
    target = context.work / "out.mp4"
    reports: list[VideoReport] = []
    moviepy_seconds = []
    with VehicleDetector() as detector:
        process_video(source, target, detector, end=0.4, progress=False)
        rewrite(source, target, end=0.4)
        for _ in range(ROUNDS):
            moviepy_seconds.append(seconds_of(lambda: rewrite(source, target)))
            reports.append(process_video(source, target, detector, preset="veryfast", progress=False))
    ours, theirs = median_of(report.seconds for report in reports), median_of(moviepy_seconds)
    frames = reports[0].frames
    middle = sorted(reports, key=lambda report: report.seconds)[ROUNDS // 2]
    return [
        Row(what="process_video", value=ours, unit="s", material=f"{material}, {frames} frames, veryfast"),
        Row(what="moviepy with an identity function", value=theirs, unit="s"),
        Row(what="time of moviepy's rewrite", value=ours / theirs, unit="x", target=at_most(1.3)),
        Row(what="speed", value=frames / ours, unit="frames/s", target=at_least(30)),
        *(
            Row(what=f"work of the stage {stage}", value=seconds / frames * 1e3, unit="ms a frame")
            for stage, seconds in middle.stages.items()
        ),
    ]


def rewrite(source: Path, target: Path, *, end: float | None = None) -> None:
    """Decode, hand every frame through and encode, as users of moviepy do."""
    from moviepy import VideoFileClip

    with VideoFileClip(str(source)) as movie:
        part = movie if end is None else movie.subclipped(0, end)
        changed = part.image_transform(lambda frame: frame)
        changed.write_videofile(str(target), preset="veryfast", logger=None)
