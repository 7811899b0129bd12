"""The command that tracks the vehicles of a video, with its options and what it writes."""

from __future__ import annotations

import contextlib
import glob
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli import horizon as rows
from vehicle_detection.cli import options as shared
from vehicle_detection.cli.output import (
    DAMAGED,
    UNKNOWN_LENS,
    announce_replaced,
    check_distinct_paths,
    name_kept_files,
    option_names,
    output_folder,
    print_error,
    print_line,
    refuse_if,
)

if TYPE_CHECKING:
    from vehicle_detection.video import FrameSource, VideoReport

# Fraction of the frames without a known own speed from which on a warning is printed.
_MAX_UNKNOWN = 0.05
_MAX_OWN_SPEED = 500.0


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of ``video``."""

    source: str = Argument(
        ...,
        metavar="SOURCE",
        help="Video file, such as drive.mp4; folder or quoted pattern of a trip's segments, or images; "
        "URL; camera, such as 0; or -.",
    )
    output: Path | None = shared.output(
        "TARGET",
        "Video to write: .mp4, .m4v, .mov or .mkv; default: beside the source, such as drive_tracked.mp4.",
        "-o",
        "--output",
    )
    show: bool = shared.output_flag("--show", "Show the annotated frames in a window; Escape ends the run.")
    tracks: Path | None = shared.output(
        "FILE", "Tracks: .csv, .jsonl, .parquet, .txt (MOT), .zip (CVAT) or .json (COCO)."
    )
    report: Path | None = shared.output("FILE.html", "Page with the video and its tracks.")
    why: bool = shared.output_flag(
        "--why", "Explain a box of each vehicle in --report: the share of each cell."
    )
    events: Path | None = shared.output("FILE", "Events, such as cut-ins and overtaking: .csv or .json.")
    clips: Path | None = shared.output(
        "DIR", "Folder for a short annotated clip of each event, such as clips."
    )
    clips_of: str | None = shared.output(
        "KINDS", "Kinds of events for --clips, such as cut_in,closing; default: all."
    )
    srt: Path | None = shared.output(
        "FILE", "Subtitles with vehicles, nearest distance and events, second by second: .srt or .ass."
    )
    preset: str = shared.PRESET
    crf: int | None = shared.output("N", "Quality of the video, 0 (best) to 51; default: 23.")
    encoder: str = shared.output(
        "NAME",
        "x264, nvenc, vaapi, videotoolbox, or auto: a graphics processor's if one works.",
        default="x264",
    )
    no_audio: bool = shared.NO_AUDIO
    quiet: bool = shared.output_flag("-q", "Print errors and warnings of damage only.", "--quiet")
    profile: bool = shared.output_flag("--profile", "Print the processor time and the waiting of each stage.")
    start: str | None = shared.source("TIME", "Start time, such as 12.5 (seconds) or 12:30.")
    end: str | None = shared.source("TIME", "End time, such as 30 (seconds) or 1:02:06.")
    fps: float | None = shared.source(
        "N", "Frame rate of images, a raw stream such as .h264, a pipe or a camera, such as 10."
    )
    stream: int | None = shared.source(
        "N", "Video stream of a file with several, by ffmpeg's number, such as 1."
    )
    own_speed: str | None = shared.source(
        "SPEED", "Own speed in km/h, such as 100, or 62mph, for headways and speeds over ground."
    )
    gpx: Path | None = shared.source(
        "FILE", "Own speed over time: a GPX track, NMEA sentences, or a .csv table with time_s and speed_kmh."
    )
    gpx_offset: float = shared.source(
        "S",
        "Time of the video's start in --gpx: seconds after the first point of a track, or the "
        "time_s of a table, such as 12.5 or -3.",
        default=0.0,
    )
    live: bool = shared.source_flag(
        "--live", "Drop frames of a pipe rather than lag; default for cameras and streams."
    )
    no_reconnect: bool = shared.source_flag("--no-reconnect", "End with a network stream that breaks off.")
    strict: bool = shared.source_flag("--strict", "Fail, and write nothing, if the source is damaged.")
    camera: str | None = shared.CAMERA
    fov: float | None = shared.FIELD_OF_VIEW
    camera_height: float | None = shared.CAMERA_HEIGHT
    horizon: str | None = shared.camera(
        "F|auto", f'{shared.HORIZON_HELP} "auto": estimated from vehicles in a sample of frames.'
    )
    model: str = shared.MODEL
    classes: str | None = shared.CLASSES
    device: str = shared.DEVICE
    conf: float | None = shared.CONFIDENCE
    every: int | None = shared.EVERY
    jobs: int | None = shared.search(
        "N", "Frames searched in parallel, such as 2; default: one per core, at most 4."
    )
    labels: str = shared.drawing(
        "LIST",
        "Fields of the labels: some of id,distance,speed,score,std, such as id,distance; or none.",
        default="id,distance,speed",
    )
    line_width: int | None = shared.LINE_WIDTH
    color_by: str = shared.drawing("id|distance", "What the colors of the boxes stand for.", default="id")
    panel: str = shared.drawing(
        "corner|side|none", "Bird's-eye view in the frame's corner, or beside it.", default="none"
    )
    units: str = shared.drawing(
        "metric|imperial", "Labels, subtitles and report in m and km/h, or ft and mph.", default="metric"
    )
    blur: str | None = shared.BLUR
    diagnostics: bool = shared.drawing_flag(
        "--diagnostics", "Show frame, positive windows, heat map and tracks side by side."
    )

    def files(self) -> dict[str, Path | None]:
        """Files to write, by their options."""
        return {f"--{name}": getattr(self, name) for name in ("output", "tracks", "report", "events", "srt")}

    def with_target(self) -> VideoOptions:
        """Name the video to write if one is needed and none or a folder is named; it replaces no file."""
        source, folder = Path(self.source), self.output
        if self.source.isdecimal() or self.source == "-" or common.is_url(self.source):
            return self
        if glob.has_magic(self.source) and not source.exists():
            return self
        if source.name in ("", ".."):  # the current folder, or one above: the copy is written beside it
            source = source.resolve()
        if folder is None:
            alone = not self.show and all(path is None for path in self.files().values())
            if not alone and self.report is None and self.clips is None:
                return self
            folder = source.parent
        elif not folder.is_dir():
            return self
        numbers = itertools.chain([""], (f"_{number}" for number in itertools.count(2)))
        targets = (folder / f"{source.stem}_tracked{number}.mp4" for number in numbers)
        return replace(self, output=next(target for target in targets if not target.exists()))

    def span(self) -> dict[str, Any]:
        """First and last second of the part to process."""
        return {
            "start": shared.parse_time(self.start, "--start"),
            "end": shared.parse_time(self.end, "--end"),
        }

    def encoding(self) -> Any:
        """How the copy is encoded."""
        from vehicle_detection.video import Encoding

        return Encoding(preset=self.preset, crf=self.crf, encoder=self.encoder)  # type: ignore[arg-type]

    def stated_horizon(self) -> float | None:
        """Return the horizon that the option states; None if it states none, or is to be estimated."""
        if self.horizon is None or self.horizon == "auto":
            return None
        try:
            return float(self.horizon)
        except ValueError:
            expected = "be a fraction of the frame's height, such as 0.55, or auto"
            raise common.invalid("--horizon", expected, self.horizon) from None

    def draw_params(self) -> vd.DrawParams:
        """Parameters of the annotations."""
        fields = [field.strip() for field in self.labels.split(",")]
        style: dict[str, Any] = {"color_by": self.color_by, "panel": self.panel, "units": self.units}
        return vd.DrawParams(labels=() if fields == ["none"] else fields, line_width=self.line_width, **style)

    def open_source(self) -> FrameSource:
        """Open the source."""
        options: dict[str, Any] = {"live": self.live or None, "reconnect": not self.no_reconnect}
        options |= {"fps": self.fps, "stream": self.stream, "strict": self.strict}
        return vd.open_trip(self.source, **options)


@option_names(target="--output", height_m="--camera-height")
@shared.takes(VideoOptions)
def video(options: VideoOptions) -> None:
    """Track the vehicles of a video, and write or show an annotated copy.

    Speeds are relative to the camera, and over ground where its own speed is known (--gpx, --own-speed).

    Exit code 3: the source is damaged, and the copy lacks what cannot be decoded.
    """
    options = options.with_target()
    _check(options)
    outputs = SideOutputs(options)
    files = options.files().values()
    tracking: dict[str, Any] = {"jobs": options.jobs, "every": options.every, **options.span()}
    with (
        name_kept_files(files),
        output_folder(options.clips, "--clips"),
        _open(options) as (source, detector),
    ):
        with outputs.collect(source, detector) as writers:
            if not options.quiet:
                # After the other checks: what is refused replaces nothing.
                _check_run(options, source, detector)
                announce_replaced(files)
            done = vd.process_video(
                source,
                options.output,
                detector,
                progress=not options.quiet,
                show=options.show,
                audio=not options.no_audio,
                encoding=options.encoding(),
                on_result=lambda result: [write(result) for write in writers],
                **tracking,
            )
        outputs.write(done, detector)
    if not options.quiet:
        outputs.check_horizon(done, detector)
        _warn_of_camera(options, done, source, detector)
    if not options.quiet or options.profile:
        lines = str(done).splitlines()
        print_line("\n".join(lines if options.profile else lines[:1]))
    if not options.quiet:
        outputs.print_summary(done)
        written = [path for path in (*files, options.clips) if path is not None]
        if written:
            print_line(f"wrote {', '.join(map(str, written))}")
    if done.damage:
        raise typer.Exit(DAMAGED)


def _check_run(options: VideoOptions, source: FrameSource, detector: vd.VehicleDetector) -> None:
    """Refuse what `process_video` would refuse, before anything is computed or replaced."""
    from vehicle_detection.video import check_video_target

    vd.track(source, detector, jobs=options.jobs, every=options.every, **options.span()).close()
    if options.output is not None:
        check_video_target(options.output, source.files)


def _check(options: VideoOptions) -> None:
    """Refuse options that do not fit each other, and a run without any output."""
    from vehicle_detection.camera import LENSES
    from vehicle_detection.datasets import FORMATS

    files = options.files()
    sources = {"SOURCE": Path(options.source)} | ({} if options.gpx is None else {"--gpx": options.gpx})
    check_distinct_paths(files, sources)
    suffixes = {"--tracks": tuple(FORMATS), "--report": (".html", ".htm")}
    suffixes |= {"--events": vd.drive.EVENT_SUFFIXES, "--srt": vd.drive.SUBTITLE_SUFFIXES}
    for name, allowed in suffixes.items():
        if (path := files[name]) is not None:
            common.check_suffix(path, name, allowed)
    camera, target, screen = options.camera, options.output, options.show
    needs_video = "--output must name a video for"
    refuse_if(options.report and not target, f"{needs_video} --report, which contains it; add it")
    refuse_if(options.clips and not target, f"{needs_video} --clips, which are cut out of it; add it")
    refuse_if(
        not screen and not any(files.values()),
        "--output must name the video to write; or use --show, --tracks, --events or --srt",
    )
    unread = options.why and not options.report
    refuse_if(unread, "--why needs --report, which shows the explanations; add it")
    refuse_if(
        camera is not None and camera not in LENSES and not Path(camera).is_file(),
        f"--camera must be one of {', '.join(LENSES)} or an existing JSON file; got {camera!r}; "
        "or state the lens with --fov",
    )
    both = options.diagnostics and options.panel != "none"
    refuse_if(both, "--panel has no place with --diagnostics; omit one of them")
    shared.check_blur(options.blur)
    options.encoding()
    unseen = options.blur and not target and not screen
    refuse_if(unseen, f"{needs_video} --blur, which blurs its vehicles; add it")


@contextlib.contextmanager
def _open(options: VideoOptions) -> Iterator[tuple[FrameSource, vd.VehicleDetector]]:
    """Open the source and the detector; its horizon is estimated first if the option says so."""
    drawing: dict[str, Any] = {"diagnostics": options.diagnostics, "blur": options.blur}
    speed = read_speed(options.own_speed, options.gpx, options.gpx_offset)
    style = options.draw_params()
    camera = vd.open_camera(
        options.camera, fov=options.fov, height_m=options.camera_height, horizon=options.stated_horizon()
    )
    model = shared.open_model(options.model, options.classes, options.device)
    with options.open_source() as source:
        if speed is not None:
            speed = replace(speed, clock=vd.drive.segment_clock(source))
        annotator = vd.Annotator(style, own_speed=speed, **drawing)
        once = f"--why needs a source that can be read again, got {options.source}; use a file, or omit it"
        refuse_if(options.why and not source.rereadable, once)
        if options.horizon == "auto":
            # The estimate takes seconds: refuse invalid options before it.
            with vd.VehicleDetector(model, conf=options.conf, camera=camera, annotator=annotator) as unsure:
                camera.for_shape(source.info.shape)
                _check_run(options, source, unsure)
            known = {"height_m": options.camera_height, **options.span()}
            camera = rows.with_found_horizon(
                camera, source, model, conf=options.conf, quiet=options.quiet, **known
            )
        with vd.VehicleDetector(model, conf=options.conf, camera=camera, annotator=annotator) as detector:
            yield source, detector


def _warn_of_camera(
    options: VideoOptions, done: VideoReport, source: FrameSource, detector: vd.VehicleDetector
) -> None:
    """Warn of distances through an unknown lens, and of a horizon with which no vehicle was found."""
    from vehicle_detection.video import estimate_video_horizon

    if done.tracks:
        if not detector.camera.lens_is_known:
            print_error(UNKNOWN_LENS)
        return
    if not source.rereadable or not rows.is_limited(detector.detector):
        return
    if options.stated_horizon() is not None:
        given = f"--horizon {options.horizon}"
    elif options.horizon is None and detector.camera.horizon_is_known:
        given = f"the horizon of --camera {options.camera}"
    else:
        return
    with options.open_source() as again, rows.search_everywhere(detector.model, options.conf) as everywhere:
        rows.warn_of_horizon(given, estimate_video_horizon(again, everywhere, **options.span()))


def read_speed(own_speed: str | None, gpx: Path | None, offset: float) -> vd.drive.OwnSpeed | None:
    """Speed of the own vehicle: constant (km/h, or with its unit), from a file, or unknown."""
    if gpx is not None:
        refuse_if(own_speed, "--own-speed and --gpx both state the own speed; give one of them")
        with option_names(path="--gpx", offset="--gpx-offset"):
            return vd.read_own_speed(gpx, offset=offset)
    refuse_if(offset, "--gpx-offset needs --gpx; give the file, or omit the offset")
    if own_speed is None:
        return None
    found = re.fullmatch(r"(\d{1,3}(?:\.\d*)?) ?(km/h|kmh|mph)?", own_speed.strip().lower())
    if found is None or float(found[1]) > _MAX_OWN_SPEED:
        must = f"be a speed of at most {_MAX_OWN_SPEED:g}, such as 100 (km/h) or 62mph"
        raise common.invalid("--own-speed", must, own_speed)
    unit = common.UNITS["imperial" if found[2] == "mph" else "metric"].speed
    return vd.drive.OwnSpeed.constant(float(found[1]) / unit)


class SideOutputs:
    """Files of ``video`` beside the video; their options are checked before the work starts."""

    def __init__(self, options: VideoOptions) -> None:
        self._options = options
        self._page: vd.ReportWriter | None = None
        self._table: vd.TrackTable
        self._events: tuple[vd.drive.Event, ...] = ()
        self._clip_kinds: list[str] = [*vd.drive.KINDS]
        if options.clips_of is not None:
            refuse_if(options.clips is None, "--clips-of needs --clips, the folder of the clips; add it")
            self._clip_kinds = [kind.strip() for kind in options.clips_of.split(",")]
        for kind in self._clip_kinds:
            common.check.choice(kind, "--clips-of", vd.drive.KINDS)

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
        # With --quiet, a camera that never ends needs no memory for tracks that nobody asked for.
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
                    pictures = vd.drive.explain_tracks(detector, again, table)
            self._page.finish(done, events=events, pictures=pictures)
        if options.clips is not None and options.output is not None:
            # Last, because there may be thousands of clips.
            chosen = [event for event in events if event.kind in self._clip_kinds]
            progress = not options.quiet
            vd.drive.cut_clips(chosen, options.output, options.clips, fps=fps, progress=progress)

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

    def check_horizon(self, done: VideoReport, detector: vd.VehicleDetector) -> None:
        """Warn of a horizon, stated by the option or a camera's file, that the tracks contradict."""
        camera, options = detector.camera, self._options
        if camera.horizon_is_known and not camera.fisheye and options.horizon != "auto":
            fps, height_m = float(done.fps), options.camera_height
            rows.warn_of_contradiction(camera.horizon, self._table, done.shape, fps=fps, height_m=height_m)

    def print_summary(self, done: VideoReport) -> None:
        """Print the counts of a drive in one line, and the number of events of each other kind in another."""
        if not len(self._table.frame_keys):
            return
        print_line(vd.count_vehicles(self._events, self._table, fps=float(done.fps)).summary())
        kinds = Counter(event.kind for event in self._events if event.kind not in vd.drive.COUNTED)
        if kinds:
            listed = (f"{kinds[kind]} {name}" for kind, name in vd.drive.KINDS.items() if kinds[kind])
            print_line(f"events: {', '.join(listed)}")
