"""The command that tracks the vehicles of a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument

from vehicle_detection.cli.horizon import (
    find_horizon,
    is_limited,
    parse_horizon,
    search_everywhere,
    warn_of_horizon,
)
from vehicle_detection.cli.options import (
    CAMERA,
    DRAWING,
    HORIZON_HELP,
    INPUT,
    OUTPUT,
    SEARCH,
    Blur,
    CameraHeight,
    CameraName,
    Classes,
    Confidence,
    Device,
    Every,
    FieldOfView,
    LineWidth,
    Model,
    NoAudio,
    Preset,
    flag,
    open_model,
    option,
    parse_blur,
    parse_time,
)
from vehicle_detection.cli.output import (
    UNKNOWN_LENS,
    announce_replaced,
    check_distinct_paths,
    name_kept_files,
    option_names,
    output_folder,
    print_error,
    print_line,
)
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.annotator import DrawParams
    from vehicle_detection.report import TrackPicture

DAMAGED = 3  # exit code


@option_names(target="--output", workers="--jobs", field_of_view="--fov", camera_height_m="--camera-height")
def video(
    source: Annotated[
        str,
        Argument(
            metavar="SOURCE",
            help="Video file, such as drive.mp4; folder or quoted pattern of a trip's segments, or images; "
            "URL; camera, such as 0; or -.",
        ),
    ],
    output: Annotated[
        Path | None,
        option("TARGET", "Video to write: .mp4, .m4v, .mov or .mkv.", "-o", "--output", panel=OUTPUT),
    ] = None,
    show: Annotated[
        bool, flag("--show", panel=OUTPUT, help="Show the annotated frames in a window; Escape ends the run.")
    ] = False,
    tracks: Annotated[
        Path | None,
        option(
            "FILE", "Tracks: .csv, .jsonl, .parquet, .txt (MOT), .zip (CVAT) or .json (COCO).", panel=OUTPUT
        ),
    ] = None,
    report: Annotated[
        Path | None, option("FILE.html", "Page with the video and its tracks.", panel=OUTPUT)
    ] = None,
    why: Annotated[
        bool,
        flag(
            "--why", panel=OUTPUT, help="Explain a box of each vehicle in --report: the share of each cell."
        ),
    ] = False,
    events: Annotated[
        Path | None, option("FILE", "Events, such as cut-ins and overtaking: .csv or .json.", panel=OUTPUT)
    ] = None,
    clips: Annotated[
        Path | None,
        option("DIR", "Folder for a short annotated clip of each event, such as clips.", panel=OUTPUT),
    ] = None,
    clips_of: Annotated[
        str | None,
        option(
            "KINDS",
            "Kinds of events for --clips, such as cut_in,closing; default: all.",
            "--clips-of",
            panel=OUTPUT,
        ),
    ] = None,
    srt: Annotated[
        Path | None,
        option(
            "FILE",
            "Subtitles with vehicles, nearest distance and events, second by second: .srt or .ass.",
            panel=OUTPUT,
        ),
    ] = None,
    preset: Preset = "veryfast",
    no_audio: NoAudio = False,
    quiet: Annotated[
        bool, flag("-q", "--quiet", panel=OUTPUT, help="Print errors and warnings of damage only.")
    ] = False,
    profile: Annotated[bool, flag("--profile", panel=OUTPUT, help="Print the time of each stage.")] = False,
    start: Annotated[
        str | None, option("TIME", "Start time, such as 12.5 (seconds) or 12:30.", panel=INPUT)
    ] = None,
    end: Annotated[
        str | None, option("TIME", "End time, such as 30 (seconds) or 1:02:06.", panel=INPUT)
    ] = None,
    fps: Annotated[float, option("N", "Frame rate of a source of images, such as 10.", panel=INPUT)] = 25.0,
    own_speed: Annotated[
        str | None,
        option(
            "SPEED",
            "Own speed in km/h, such as 100, or 62mph, for headways and speeds over ground.",
            panel=INPUT,
        ),
    ] = None,
    gpx: Annotated[
        Path | None,
        option(
            "FILE",
            "Own speed over time: a GPX track, or a .csv table with the columns time_s and speed_kmh.",
            panel=INPUT,
        ),
    ] = None,
    gpx_offset: Annotated[
        float,
        option(
            "S",
            "Time of the video's start in --gpx: seconds after the first point of a track, or the "
            "time_s of a table, such as 12.5 or -3.",
            panel=INPUT,
        ),
    ] = 0.0,
    live: Annotated[
        bool,
        flag(
            "--live",
            panel=INPUT,
            help="Drop frames of a pipe rather than lag; default for cameras and streams.",
        ),
    ] = False,
    no_reconnect: Annotated[
        bool, flag("--no-reconnect", panel=INPUT, help="End with a network stream that breaks off.")
    ] = False,
    strict: Annotated[
        bool, flag("--strict", panel=INPUT, help="Fail, and write nothing, if the source is damaged.")
    ] = False,
    camera: CameraName = None,
    fov: FieldOfView = None,
    camera_height: CameraHeight = None,
    horizon: Annotated[
        str | None,
        option(
            "F|auto", f'{HORIZON_HELP} "auto": estimated from vehicles in a sample of frames.', panel=CAMERA
        ),
    ] = None,
    model: Model = "default",
    classes: Classes = None,
    device: Device = "cpu",
    conf: Confidence = None,
    every: Every = None,
    jobs: Annotated[
        int | None,
        option(
            "N", "Frames searched in parallel, such as 2; default: one per core, at most 4.", panel=SEARCH
        ),
    ] = None,
    labels: Annotated[
        str,
        option(
            "LIST",
            "Fields of the labels: some of id,distance,speed,score,std, such as id,distance; or none.",
            panel=DRAWING,
        ),
    ] = "id,distance,speed",
    line_width: LineWidth = None,
    color_by: Annotated[
        str, option("id|distance", "What the colors of the boxes stand for.", panel=DRAWING)
    ] = "id",
    panel: Annotated[
        str, option("corner|side|none", "Bird's-eye view in the frame's corner, or beside it.", panel=DRAWING)
    ] = "none",
    units: Annotated[
        str,
        option(
            "metric|imperial", "Labels, subtitles and report in m and km/h, or ft and mph.", panel=DRAWING
        ),
    ] = "metric",
    blur: Blur = None,
    diagnostics: Annotated[
        bool,
        flag(
            "--diagnostics",
            panel=DRAWING,
            help="Show frame, positive windows, heat map and tracks side by side.",
        ),
    ] = False,
) -> None:
    """Track the vehicles of a video, and write or show an annotated copy.

    Speeds are relative to the camera, and over ground where its own speed is known (--gpx, --own-speed).

    Exit code 3: the source is damaged, and the copy lacks what cannot be decoded.
    """
    from vehicle_detection.camera import LENSES
    from vehicle_detection.cli.events import SideOutputs, explain_vehicles, print_summary, read_speed
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.events import TrackLog
    from vehicle_detection.export import TrackWriter
    from vehicle_detection.video import VideoRun, estimate_video_horizon, open_source, process_video

    outputs = {
        "--output": output, "--tracks": tracks, "--report": report, "--events": events, "--srt": srt,
    }  # fmt: skip
    sources = {"SOURCE": Path(source)} | ({} if gpx is None else {"--gpx": gpx})
    check_distinct_paths(outputs, sources)
    _check_outputs(outputs, clips, show=show, why=why)
    if camera is not None and camera not in LENSES and not Path(camera).is_file():
        raise InvalidInputError(
            f"--camera must be one of {', '.join(LENSES)} or an existing JSON file; got {camera!r}; "
            "or state the lens with --fov"
        )
    if diagnostics and panel != "none":
        raise InvalidInputError("--panel has no place with --diagnostics; omit one of them")
    region = parse_blur(blur)
    if region is not None and output is None and not show:
        raise InvalidInputError("--output must name a video for --blur, which blurs its vehicles; add it")
    draw_params = _draw_params(labels, line_width=line_width, color_by=color_by, panel=panel, units=units)
    speed = read_speed(own_speed, gpx, gpx_offset)
    span = {"start": parse_time(start, "--start"), "end": parse_time(end, "--end")}
    side_outputs = SideOutputs(events, clips, clips_of, srt)
    with (
        name_kept_files(outputs.values()),
        output_folder(clips, "--clips"),
        contextlib.ExitStack() as stack,
    ):
        writers: list[Callable[[Any], object]] = []
        fraction = None if horizon in (None, "auto") else parse_horizon(str(horizon))
        loaded = open_model(model, classes, device)
        opened = stack.enter_context(
            open_source(source, fps=fps, live=live or None, reconnect=not no_reconnect)
        )
        if why and not opened.rereadable:
            raise InvalidInputError(
                f"--why needs a source that can be read again, got {source}; use a file, or omit --why"
            )
        options: dict[str, Any] = {
            "conf": conf,
            "camera": camera,
            "field_of_view": fov,
            "camera_height_m": camera_height,
            "every": every,
            "own_speed": speed,
            "diagnostics": diagnostics,
            "draw_params": draw_params,
            "blur": region,
        }
        settings: dict[str, Any] = span | {"preset": preset, "workers": jobs}
        if horizon == "auto":
            # The estimate takes seconds: refuse invalid options before it.
            with VehicleDetector(loaded, **options) as unsure:
                unsure.camera_of(opened.info.shape)
                VideoRun(opened, unsure, target=output, audio=False, **settings).close()
            fraction = find_horizon(opened, loaded, conf=conf, quiet=quiet, **span)
        detector = stack.enter_context(VehicleDetector(loaded, horizon=fraction, **options))
        page = None
        if report is not None and output is not None:
            from vehicle_detection.report import ReportWriter

            with option_names(path="--report"):
                page = ReportWriter(
                    report, video=output, source=source, detector=detector, units=draw_params.units
                )
        log = page.log if page else TrackLog()
        # A camera that never ends would fill the memory with tracks that nobody asked for.
        if not quiet or any(path is not None for path in (report, events, clips, srt)):
            writers.append(page or log)
        if tracks is not None:
            with option_names(path="--tracks"):
                table = TrackWriter(tracks, shape=opened.info.shape, fps=float(opened.info.fps))
                writers.append(stack.enter_context(table))
        if not quiet:
            # After the other checks: what is refused replaces nothing.
            VideoRun(opened, detector, target=output, audio=not no_audio, **settings).close()
            announce_replaced(outputs.values())
        done = process_video(
            opened,
            output,
            detector,
            audio=not no_audio,
            progress=not quiet,
            strict=strict,
            show=show,
            on_result=lambda result: [write(result) for write in writers],
            **settings,
        )
        stack.close()  # the file of tracks is complete when its writer closes
        found = side_outputs.find_events(log, done, detector, quiet=quiet)
        side_outputs.write(log, found, done, detector)
        if page is not None:
            pictures: list[TrackPicture] = []
            if why:
                with open_source(source, fps=fps) as again:
                    pictures = explain_vehicles(detector, again, log)
            page.finish(done, events=found, pictures=pictures)
        if output is not None:
            # Last, because there may be thousands of clips.
            side_outputs.cut_clips(found, output, fps=float(done.fps), progress=not quiet)
    if not quiet and done.tracks:
        if not detector.lens_is_known:
            print_error(UNKNOWN_LENS)
    elif not quiet and opened.rereadable and is_limited(detector):
        given = None if horizon in (None, "auto") else f"--horizon {horizon}"
        if horizon is None and detector.search_params_of(opened.info.shape) != detector.search_params:
            given = f"the horizon of --camera {camera}"
        if given is not None:
            with open_source(source, fps=fps) as again, search_everywhere(loaded, conf) as everywhere:
                warn_of_horizon(given, estimate_video_horizon(again, everywhere, **span))
    if not quiet or profile:
        lines = str(done).splitlines()
        print_line("\n".join(lines if profile else lines[:1]))
    if not quiet:
        print_summary(log, found, done)
        written = [path for path in (*outputs.values(), clips) if path is not None]
        if written:
            print_line(f"wrote {', '.join(map(str, written))}")
    if done.damage:
        raise typer.Exit(DAMAGED)


def _check_outputs(outputs: Mapping[str, Path | None], clips: Path | None, *, show: bool, why: bool) -> None:
    """Refuse outputs of ``video`` that need another one, and a run without any output."""
    from vehicle_detection._common import check_suffix
    from vehicle_detection.export import FORMATS

    if outputs["--tracks"] is not None:
        check_suffix(outputs["--tracks"], "--tracks", tuple(FORMATS))
    if outputs["--report"] is not None:
        check_suffix(outputs["--report"], "--report", (".html", ".htm"))
    if outputs["--output"] is None:
        if outputs["--report"] is not None:
            raise InvalidInputError("--output must name a video for --report, which contains it; add it")
        if clips is not None:
            raise InvalidInputError("--output must name a video for --clips, which are cut out of it; add it")
    if not show and all(path is None for path in outputs.values()):
        raise InvalidInputError(
            "--output must name the video to write; or use --show, --tracks, --events or --srt"
        )
    if why and outputs["--report"] is None:
        raise InvalidInputError("--why needs --report, which shows the explanations; add it")


def _draw_params(labels: str, **options: Any) -> DrawParams:
    """Parameters of the annotations, with labels given as a comma-separated list or "none"."""
    from vehicle_detection.annotator import DrawParams

    fields = [field.strip() for field in labels.split(",")]
    return DrawParams(labels=() if fields == ["none"] else fields, **options)
