"""Events and counts of the command ``video``: files, clips and the summary."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vehicle_detection.cli.output import option_names

if TYPE_CHECKING:
    from vehicle_detection.events import Event, TrackLog
    from vehicle_detection.video import VideoReport


@dataclass(frozen=True)
class EventOptions:
    """Options of ``video`` about events: checked before the work starts."""

    path: Path | None  # file of the events
    clips: Path | None  # existing folder for their clips
    own_speed: float | None  # km/h

    def __post_init__(self) -> None:
        from vehicle_detection._common import check_number
        from vehicle_detection.events import check_event_file

        if self.path is not None:
            check_event_file(self.path, "--events")
        if self.own_speed is not None:
            check_number(self.own_speed, "--own-speed", low=0, high=500)

    def find(self, log: TrackLog, report: VideoReport, detector: Any) -> tuple[Event, ...]:
        """Find the events of a processed video."""
        from vehicle_detection.events import find_events

        speed = None if self.own_speed is None else self.own_speed / 3.6
        camera = detector.camera_of(report.shape)
        return find_events(log, fps=float(report.fps), shape=report.shape, camera=camera, own_speed_mps=speed)

    def write(self, events: tuple[Event, ...], video: Path | None, report: VideoReport) -> None:
        """Write the file of events, and their clips."""
        from vehicle_detection.events import cut_clips, write_events

        if self.path is not None:
            with option_names(path="--events"):
                write_events(events, self.path)
        if self.clips is not None and video is not None:
            cut_clips(events, video, self.clips, fps=float(report.fps))


def print_summary(log: TrackLog, events: tuple[Event, ...], report: VideoReport) -> None:
    """Print the counts of a drive in one line, and the number of events of each other kind in another."""
    from vehicle_detection.events import COUNTED, KINDS, count_vehicles

    if not len(log.counts):
        return
    typer.echo(count_vehicles(events, log, fps=float(report.fps)).summary())
    kinds = Counter(event.kind for event in events if event.kind not in COUNTED)
    if kinds:
        typer.echo("events: " + ", ".join(f"{kinds[kind]} {KINDS[kind]}" for kind in KINDS if kinds[kind]))
