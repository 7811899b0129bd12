"""The command that tracks the vehicles of a video."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import vehicle_detection as vd
from vehicle_detection.cli.horizon import is_limited, search_everywhere, warn_of_horizon, with_found_horizon
from vehicle_detection.cli.options import check_blur, open_model, takes
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
)
from vehicle_detection.cli.video_options import VideoOptions
from vehicle_detection.cli.video_outputs import SideOutputs, read_speed
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.video import FrameSource, VideoReport


@option_names(target="--output", height_m="--camera-height")
@takes(VideoOptions)
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
    from vehicle_detection._common import check_suffix
    from vehicle_detection.camera import LENSES
    from vehicle_detection.formats import FORMATS

    files = options.files()
    sources = {"SOURCE": Path(options.source)} | ({} if options.gpx is None else {"--gpx": options.gpx})
    check_distinct_paths(files, sources)
    suffixes = {"--tracks": tuple(FORMATS), "--report": (".html", ".htm")}
    suffixes |= {"--events": vd.drive.EVENT_SUFFIXES, "--srt": vd.drive.SUBTITLE_SUFFIXES}
    for name, allowed in suffixes.items():
        if (path := files[name]) is not None:
            check_suffix(path, name, allowed)
    if options.output is None:
        for name, path, purpose in (
            ("--report", options.report, "contains it"),
            ("--clips", options.clips, "are cut out of it"),
        ):
            if path is not None:
                raise InvalidInputError(f"--output must name a video for {name}, which {purpose}; add it")
        if not options.show and all(path is None for path in files.values()):
            raise InvalidInputError(
                "--output must name the video to write; or use --show, --tracks, --events or --srt"
            )
    if options.why and options.report is None:
        raise InvalidInputError("--why needs --report, which shows the explanations; add it")
    camera = options.camera
    if camera is not None and camera not in LENSES and not Path(camera).is_file():
        raise InvalidInputError(
            f"--camera must be one of {', '.join(LENSES)} or an existing JSON file; got {camera!r}; "
            "or state the lens with --fov"
        )
    if options.diagnostics and options.panel != "none":
        raise InvalidInputError("--panel has no place with --diagnostics; omit one of them")
    check_blur(options.blur)
    options.encoding()
    if options.blur is not None and options.output is None and not options.show:
        raise InvalidInputError("--output must name a video for --blur, which blurs its vehicles; add it")


@contextlib.contextmanager
def _open(options: VideoOptions) -> Iterator[tuple[FrameSource, vd.VehicleDetector]]:
    """Open the source and the detector; its horizon is estimated first if the option says so."""
    drawing: dict[str, Any] = {"diagnostics": options.diagnostics, "blur": options.blur}
    speed = read_speed(options.own_speed, options.gpx, options.gpx_offset)
    style = options.draw_params()
    camera = vd.open_camera(
        options.camera, fov=options.fov, height_m=options.camera_height, horizon=options.stated_horizon()
    )
    model = open_model(options.model, options.classes, options.device)
    with options.open_source() as source:
        if speed is not None:
            speed = replace(speed, clock=vd.drive.segment_clock(source))
        annotator = vd.Annotator(style, own_speed=speed, **drawing)
        if options.why and not source.rereadable:
            raise InvalidInputError(
                f"--why needs a source that can be read again, got {options.source}; use a file, or omit it"
            )
        if options.horizon == "auto":
            # The estimate takes seconds: refuse invalid options before it.
            with vd.VehicleDetector(model, conf=options.conf, camera=camera, annotator=annotator) as unsure:
                camera.for_shape(source.info.shape)
                _check_run(options, source, unsure)
            known = {"height_m": options.camera_height, **options.span()}
            camera = with_found_horizon(
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
    if not source.rereadable or not is_limited(detector.detector):
        return
    if options.stated_horizon() is not None:
        given = f"--horizon {options.horizon}"
    elif options.horizon is None and detector.camera.horizon_is_known:
        given = f"the horizon of --camera {options.camera}"
    else:
        return
    with options.open_source() as again, search_everywhere(detector.model, options.conf) as everywhere:
        warn_of_horizon(given, estimate_video_horizon(again, everywhere, **options.span()))
