"""What ``video`` writes beside the annotated copy: tracks, report, events, clips and subtitles."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vehicle_detection as vd
from vehicle_detection.cli.output import option_names, print_error, print_line
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.cli.video_options import VideoOptions
    from vehicle_detection.video import FrameSource, VideoReport

# Fraction of the frames without a known own speed from which on a warning is printed.
_MAX_UNKNOWN = 0.05
_MAX_OWN_SPEED = 500.0


def read_speed(own_speed: str | None, gpx: Path | None, offset: float) -> vd.drive.OwnSpeed | None:
    """Speed of the own vehicle: constant (km/h, or with its unit), from a file, or unknown."""
    from vehicle_detection._common import UNITS, describe

    if gpx is not None:
        if own_speed is not None:
            raise InvalidInputError("--own-speed and --gpx both state the own speed; give one of them")
        with option_names(path="--gpx", offset="--gpx-offset"):
            return vd.read_own_speed(gpx, offset=offset)
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
    unit = UNITS["imperial" if found[2] == "mph" else "metric"].speed
    return vd.drive.OwnSpeed.constant(float(found[1]) / unit)


class SideOutputs:
    """Files of ``video`` beside the video; their options are checked before the work starts."""

    def __init__(self, options: VideoOptions) -> None:
        from vehicle_detection._common import check_choice

        self._options = options
        self._page: vd.ReportWriter | None = None
        self._table: vd.TrackTable
        self._events: tuple[vd.drive.Event, ...] = ()
        self._clip_kinds: list[str] = [*vd.drive.KINDS]
        if options.clips_of is not None:
            if options.clips is None:
                raise InvalidInputError("--clips-of needs --clips, the folder of the clips; add it")
            self._clip_kinds = [kind.strip() for kind in options.clips_of.split(",")]
        for kind in self._clip_kinds:
            check_choice(kind, "--clips-of", vd.drive.KINDS)

    @contextlib.contextmanager
    def collect(
        self, source: FrameSource, detector: vd.VehicleDetector
    ) -> Iterator[list[Callable[[Any], object]]]:
        """Yield functions that take each frame's result; the file of tracks is complete after the block."""
        options, units = self._options, detector.annotator.style.units
        writers: list[Callable[[Any], object]] = []
        if options.report is not None and options.output is not None:
            page: dict[str, Any] = {"video": options.output, "source": options.source, "units": units}
            with option_names(path="--report"):
                self._page = vd.ReportWriter(options.report, detector=detector, **page)
        self._table = self._page.table if self._page else vd.TrackTable()
        # A camera that never ends would fill the memory with tracks that nobody asked for.
        wanted = options.report, options.events, options.clips, options.srt
        if not options.quiet or any(path is not None for path in wanted):
            writers.append(self._table.append)
        with contextlib.ExitStack() as stack:
            if options.tracks is not None:
                with option_names(path="--tracks"):
                    table = vd.open_tracks(
                        options.tracks, shape=source.info.shape, fps=float(source.info.fps)
                    )
                    writers.append(stack.enter_context(table))
            yield writers

    def write(self, done: VideoReport, detector: vd.VehicleDetector) -> None:
        """Find the events, and write all files but that of the tracks."""
        options, fps, table = self._options, float(done.fps), self._table
        events = self._events = self._find_events(done, detector)
        if options.events is not None:
            with option_names(path="--events"):
                vd.write_events(events, options.events)
        if options.srt is not None:
            units = detector.annotator.style.units
            with option_names(path="--srt"):
                own: Any = detector.annotator.own_speed
                vd.write_subtitles(table, options.srt, fps=fps, events=events, own_speed=own, units=units)
        if self._page is not None:
            pictures: list[vd.drive.TrackPicture] = []
            if options.why:
                with options.open_source() as again:
                    pictures = vd.drive.explain_tracks(detector, again, table, every=options.every)
            self._page.finish(done, events=events, pictures=pictures)
        if options.clips is not None and options.output is not None:
            # Last, because there may be thousands of clips.
            chosen = [event for event in events if event.kind in self._clip_kinds]
            quiet = options.quiet
            vd.drive.cut_clips(chosen, options.output, options.clips, fps=fps, progress=not quiet)

    def _find_events(self, done: VideoReport, detector: vd.VehicleDetector) -> tuple[vd.drive.Event, ...]:
        """Find the events of a processed video, and warn if the own speed is unknown for a part of it."""
        import numpy as np

        table, fps, speeds = self._table, float(done.fps), None
        own: Any = detector.annotator.own_speed
        if own is not None:
            speeds = vd.drive.own_speeds(own, table, fps=fps)
            unknown = float(np.isnan(speeds).mean()) if len(speeds) else 0.0
            if unknown > _MAX_UNKNOWN and not self._options.quiet:
                print_error(
                    f"warning: the own speed is known for {1 - unknown:.0%} of the video; check "
                    "--gpx-offset, and that the file has no gaps of over 5 s"
                )
        camera = detector.camera.for_shape(done.shape)
        return vd.find_events(table, fps=fps, shape=done.shape, camera=camera, own_speed_mps=speeds)

    def print_summary(self, done: VideoReport) -> None:
        """Print the counts of a drive in one line, and the number of events of each other kind in another."""
        if not len(self._table.frame_keys):
            return
        print_line(vd.count_vehicles(self._events, self._table, fps=float(done.fps)).summary())
        kinds = Counter(event.kind for event in self._events if event.kind not in vd.drive.COUNTED)
        if kinds:
            listed = (f"{kinds[kind]} {name}" for kind, name in vd.drive.KINDS.items() if kinds[kind])
            print_line(f"events: {', '.join(listed)}")
