"""What ``video`` derives from the tracks: events, clips, subtitles, explanations and the summary."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vehicle_detection.cli.output import option_names, print_error, print_line
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.events import Event, TrackLog
    from vehicle_detection.report import TrackPicture
    from vehicle_detection.video import FrameSource, OwnSpeed, VideoReport

# Fraction of the frames without a known own speed from which on a warning is printed.
_MAX_UNKNOWN = 0.05
_MAX_OWN_SPEED = 500.0


def read_speed(own_speed: str | None, gpx: Path | None, offset: float) -> OwnSpeed | None:
    """Speed of the own vehicle: constant (km/h, or with its unit), from a file, or unknown."""
    from vehicle_detection._common import UNITS, describe
    from vehicle_detection.video import OwnSpeed, read_own_speed

    if gpx is not None:
        if own_speed is not None:
            raise InvalidInputError("--own-speed and --gpx both state the own speed; give one of them")
        with option_names(path="--gpx", offset="--gpx-offset"):
            return read_own_speed(gpx, offset=offset)
    if offset:
        raise InvalidInputError("--gpx-offset needs --gpx; give the file, or omit the offset")
    if own_speed is None:
        return None
    found = re.fullmatch(r"(\d{1,3}(?:\.\d*)?) ?(km/h|kmh|mph)?", own_speed.strip().lower())
    if found is None or float(found[1]) > _MAX_OWN_SPEED:
        raise InvalidInputError(
            f"--own-speed must be a speed of at most {_MAX_OWN_SPEED:g}, such as 100 (km/h) or 62mph; got "
            f"{describe(own_speed)}"
        )
    return OwnSpeed.constant(float(found[1]) / UNITS["imperial" if found[2] == "mph" else "metric"].speed)


@dataclass(frozen=True)
class SideOutputs:
    """Files of ``video`` beside the video and its tracks, checked before the work starts."""

    events: Path | None
    clips: Path | None  # existing folder for clips of the events
    clips_of: str | None  # kinds of events that get a clip, separated by commas; None: all
    subtitles: Path | None

    def __post_init__(self) -> None:
        from vehicle_detection._common import check_choice, check_suffix
        from vehicle_detection.events import EVENT_SUFFIXES, KINDS, SUBTITLE_SUFFIXES

        if self.events is not None:
            check_suffix(self.events, "--events", EVENT_SUFFIXES)
        if self.subtitles is not None:
            check_suffix(self.subtitles, "--srt", SUBTITLE_SUFFIXES)
        if self.clips_of is not None and self.clips is None:
            raise InvalidInputError("--clips-of needs --clips, the folder of the clips; add it")
        for kind in self._kinds():
            check_choice(kind, "--clips-of", KINDS)

    def _kinds(self) -> list[str]:
        """Kinds of events that `clips_of` lists."""
        return [] if self.clips_of is None else [kind.strip() for kind in self.clips_of.split(",")]

    def find_events(
        self, log: TrackLog, report: VideoReport, detector: VehicleDetector, *, quiet: bool = False
    ) -> tuple[Event, ...]:
        """Find the events of a processed video, and warn if the own speed is unknown for a part of it."""
        import numpy as np

        from vehicle_detection.events import find_events

        speeds = None if detector.own_speed is None else log.own_speeds(detector.own_speed, float(report.fps))
        unknown = 0.0 if speeds is None or not len(speeds) else float(np.isnan(speeds).mean())
        if unknown > _MAX_UNKNOWN and not quiet:
            print_error(
                f"warning: the own speed is known for {1 - unknown:.0%} of the video; check --gpx-offset, "
                "and that the file has no gaps of over 5 s"
            )
        camera = detector.camera_of(report.shape)
        return find_events(
            log, fps=float(report.fps), shape=report.shape, camera=camera, own_speed_mps=speeds
        )

    def write(
        self,
        log: TrackLog,
        events: tuple[Event, ...],
        report: VideoReport,
        detector: VehicleDetector,
    ) -> None:
        """Write the file of events and the subtitles."""
        from vehicle_detection.events import write_events, write_subtitles

        fps = float(report.fps)
        if self.events is not None:
            with option_names(path="--events"):
                write_events(events, self.events)
        if self.subtitles is not None:
            units = detector.draw_params.units
            with option_names(path="--srt"):
                write_subtitles(
                    log, self.subtitles, fps=fps, events=events, own_speed=detector.own_speed, units=units
                )

    def cut_clips(self, events: tuple[Event, ...], video: Path, *, fps: float, progress: bool) -> None:
        """Cut the clips of the events out of the annotated video."""
        from vehicle_detection.events import cut_clips

        if self.clips is not None:
            chosen = [event for event in events if self.clips_of is None or event.kind in self._kinds()]
            cut_clips(chosen, video, self.clips, fps=fps, progress=progress)


def explain_vehicles(detector: VehicleDetector, source: FrameSource, log: TrackLog) -> list[TrackPicture]:
    """Explain a box of each vehicle of a video, for its report."""
    from vehicle_detection.explanation import explain_tracks
    from vehicle_detection.report import TrackPicture

    return [
        TrackPicture(track_id, found.frame, found.picture, str(found.explanation))
        for track_id, found in explain_tracks(detector, source, log).items()
    ]


def print_summary(log: TrackLog, events: tuple[Event, ...], report: VideoReport) -> None:
    """Print the counts of a drive in one line, and the number of events of each other kind in another."""
    from vehicle_detection.events import COUNTED, KINDS, count_vehicles

    if not len(log.counts):
        return
    print_line(count_vehicles(events, log, fps=float(report.fps)).summary())
    kinds = Counter(event.kind for event in events if event.kind not in COUNTED)
    if kinds:
        print_line("events: " + ", ".join(f"{kinds[kind]} {KINDS[kind]}" for kind in KINDS if kinds[kind]))
