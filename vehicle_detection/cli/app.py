"""The command line, ``vehicle-detection``: errors and exit codes, and the commands on images and video.

Commands import heavy libraries when they run, so that ``--help`` is fast.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperArgument, TyperGroup

from vehicle_detection import __version__
from vehicle_detection.cli.batch import batch
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
    Confidence,
    Every,
    FieldOfView,
    Horizon,
    LineWidth,
    Model,
    NoAudio,
    Preset,
    flag,
)
from vehicle_detection.cli.output import (
    announce_replaced,
    capture_stderr,
    check_distinct_paths,
    name_kept_files,
    option_names,
    output_folder,
    print_error,
    print_facts,
    print_warnings,
    rename_argument,
    replace_unprintable,
)
from vehicle_detection.cli.signals import raise_on_signals
from vehicle_detection.cli.train import fetch, info, train, train_frames
from vehicle_detection.cli.tune import tune
from vehicle_detection.errors import DatasetError, InvalidInputError, VehicleDetectionError

if TYPE_CHECKING:
    from vehicle_detection.boxes import Detections
    from vehicle_detection.camera import HorizonEstimate
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.params import DrawParams

BAD_INPUT, DAMAGED, INTERRUPTED = 2, 3, 130  # exit codes
_CHECKED_IMAGES = 20  # images that are searched again if no vehicle was found
_UNKNOWN_LENS = (
    "warning: distances assume a lens of 58 degrees, and may be wrong by a factor of 2 or more; "
    "pass --fov or --camera"
)


class _Commands(TyperGroup):
    """Commands whose expected errors become one line on standard error."""

    def invoke(self, ctx: Any) -> Any:
        replace_unprintable()
        try:
            with raise_on_signals(), print_warnings():
                return super().invoke(ctx)
        except (InvalidInputError, DatasetError) as error:
            print_error(f"error: {rename_argument(str(error), self._option_names(ctx))}")
            raise typer.Exit(BAD_INPUT) from None
        except VehicleDetectionError as error:
            print_error(f"error: {error}")
            raise typer.Exit(BAD_INPUT) from None
        except OSError as error:  # such as a full disk
            if error.errno == errno.EPIPE:
                raise
            reason = error.strerror or str(error)
            print_error(f"error: {error.filename}: {reason}" if error.filename else f"error: {reason}")
            raise typer.Exit(BAD_INPUT) from None
        except MemoryError:
            print_error("error: memory ran out; close other programs, or use fewer --jobs and smaller files")
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt as error:
            print_error("interrupted")
            raise typer.Exit(getattr(error, "code", INTERRUPTED)) from None

    def _option_names(self, ctx: Any) -> dict[str, str]:
        """Map the arguments of the command's function to the names that its user knows."""
        command = self.get_command(ctx, ctx.invoked_subcommand)
        return {
            param.name: str(param.metavar) if isinstance(param, TyperArgument) else param.opts[-1]
            for param in (command.params if command else ())
            if param.name
        }


app = typer.Typer(
    cls=_Commands,
    help="Detect and track vehicles in dash-cam images and video.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@app.command()
@option_names(random_state="--seed")
def demo(
    output: Annotated[Path, Option("-o", "--output", metavar="DIR", help="Folder to write.")] = Path("demo"),
    frames: Annotated[int, Option(metavar="N", help="Number of frames.")] = 120,
    seed: Annotated[int, Option(metavar="N", help="Random seed of the scene.")] = 0,
    report: Annotated[bool, flag("--report", help="Write a page with the video and its tracks.")] = False,
) -> None:
    """Draw a drive, annotate it with the default model and score it against the ground truth.

    Oncoming vehicles are scored too; boxes on vehicles that are under 40 pixels wide or largely hidden are
    neither right nor wrong.
    """
    from vehicle_detection.cli.demo import FILES, REPORT, run_demo
    from vehicle_detection.detector import VehicleDetector

    # The field of view of the drawn camera.
    with output_folder(output, "--output"), VehicleDetector(field_of_view=58) as detector:
        done, scores = run_demo(output, detector, frames=frames, random_state=seed, report=report)
    print_facts(
        f"{scores.frames} drawn frames of 1280x720, {scores.vehicles} vehicles, {scores.tracks} tracks",
        {
            "F1": f"{scores.f1:.3f}",
            "mean IoU": f"{scores.mean_iou:.3f}",
            "MOTA": f"{scores.mota:.3f}",
            "boxes": f"{scores.tp} on a vehicle, {scores.fn} missed, {scores.fp} false",
            "identity switches": scores.id_switches,
            "speed": f"{done.frames_per_second:.1f} frames/s",
        },
    )
    typer.echo(f"wrote {', '.join((*FILES, REPORT) if report else FILES)} in {output}")


@app.command()
def detect(
    images: Annotated[list[Path], Argument(metavar="IMAGE...", help="Image files, such as frames/*.jpg.")],
    output: Annotated[
        Path | None,
        Option("-o", "--output", metavar="DIR", help="Annotated images.", rich_help_panel=OUTPUT),
    ] = None,
    boxes: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Boxes by file name: .csv, .jsonl, .parquet or .json (COCO).",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    why: Annotated[
        Path | None,
        Option(
            metavar="DIR",
            help="Pictures that explain each box: the share of each cell in its score.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    model: Model = "default",
    conf: Confidence = None,
    horizon: Horizon = None,
    labels: Annotated[
        str,
        Option(
            metavar="score|none", help="Labels of the boxes in annotated images.", rich_help_panel=DRAWING
        ),
    ] = "score",
    line_width: LineWidth = None,
    blur: Blur = None,
) -> None:
    """Detect the vehicles of images."""
    from vehicle_detection._common import check_choice, check_integer
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.export import write_boxes

    check_choice(labels, "labels", ("score", "none"))
    if line_width is not None:
        check_integer(line_width, "line_width", low=1, high=1000)
    _check_images(images, output, boxes)
    announce_replaced([boxes])
    with (
        VehicleDetector(model, conf=conf, horizon=horizon, blur=_parse_blur(blur)) as detector,
        output_folder(output, "--output"),
        output_folder(why, "--why"),
    ):
        found = _detect_each(images, detector, output, why, scores=labels == "score", line_width=line_width)
        found = _warn_if_empty(found, images, detector, horizon)
        if boxes is None:
            for _ in found:
                pass
        else:
            with option_names(path="--boxes"):
                rows = write_boxes(found, boxes)
            typer.echo(f"wrote {rows} boxes to {boxes}")


def _check_images(images: list[Path], output: Path | None, boxes: Path | None) -> None:
    """Refuse images that would fail, or be overwritten, after a part of the work is done."""
    for image in images:
        if image.is_dir():
            raise InvalidInputError(
                f"IMAGE {image} is a folder; choose files in it, such as {image / '*.jpg'}"
            )
        if not image.exists():
            raise InvalidInputError(f"IMAGE {image} does not exist; check the path")
        if boxes is not None and boxes.exists() and boxes.samefile(image):
            raise InvalidInputError(f"--boxes {boxes} is one of the images; choose another name")
        if output is not None and output.exists() and output.samefile(image.parent):
            raise InvalidInputError(
                f"--output {output} is the folder of {image.name}, which would be overwritten; choose another"
            )
    by_name: dict[str, Path] = {}
    for image in images:
        other = by_name.setdefault(image.name, image)
        if other != image and (output is not None or boxes is not None):
            raise InvalidInputError(
                f"IMAGE {other} and {image} have the same file name, which identifies the results; "
                "process one folder at a time"
            )


def _warn_if_empty(
    found: Iterator[tuple[str, Detections]],
    images: list[Path],
    detector: VehicleDetector,
    horizon: float | None,
) -> Iterator[tuple[str, Detections]]:
    """Pass on what is found; if that is nothing, search some images without the given horizon."""
    import numpy as np

    from vehicle_detection.camera import estimate_horizon
    from vehicle_detection.images import read_image

    total = 0
    for name, vehicles in found:
        total += len(vehicles)
        yield name, vehicles
    if total or horizon is None:
        return
    boxes, shape = [np.empty((0, 4))], (1, 1)
    with _everywhere(detector.model, None) as everywhere:
        for image in map(read_image, images[:_CHECKED_IMAGES]):
            if image.shape[:2] == shape or shape == (1, 1):
                shape = image.shape[:2]
                boxes.append(everywhere.detect(image).boxes)
    estimate = None
    with contextlib.suppress(InvalidInputError):  # too few boxes
        estimate = estimate_horizon(np.concatenate(boxes), shape)
    _warn_of_horizon(horizon, estimate)


def _detect_each(
    images: list[Path],
    detector: VehicleDetector,
    output: Path | None,
    why: Path | None,
    *,
    scores: bool = True,
    line_width: int | None = None,
) -> Iterator[tuple[str, Detections]]:
    """Detect the vehicles of each image, print them, and write the annotated image."""
    import cv2

    from vehicle_detection.drawing import blur_boxes, draw_detections, score_texts
    from vehicle_detection.images import read_image, write_image

    for path in images:
        with capture_stderr() as messages:
            image = read_image(path)
        for message in messages:
            print_error(f"warning: {path}: {message}")
        found = detector.detect(image)
        listed = "".join(
            f"  [{' '.join(f'{side:.0f}' for side in box)}] {text}"
            for box, text in zip(found.boxes.tolist(), score_texts(found))
        )
        typer.echo(f"{path}: {len(found)} vehicle{'s' * (len(found) != 1)}{listed}")
        shown = image
        if detector.blur is not None:
            shown = blur_boxes(image, found.boxes, region=detector.blur)
        if why is not None:
            _write_explanations(why, path.name, detector, image, shown, found)
        if output is not None:
            suffix = path.suffix if cv2.haveImageWriter(f"image{path.suffix}") else f"{path.suffix}.png"
            drawn = draw_detections(shown, found, line_width=line_width, scores=scores)
            write_image(output / (path.stem + suffix), drawn)
        yield path.name, found


def _write_explanations(
    folder: Path, name: str, detector: VehicleDetector, image: Any, shown: Any, found: Detections
) -> None:
    """Write a picture for each box of an image that says why it was found; it shows the image `shown`."""
    from vehicle_detection._common import atomic_write
    from vehicle_detection.explanation import explain
    from vehicle_detection.plotting import plot_explanation

    for number, box in enumerate(found.boxes, start=1):
        explanation = explain(detector, image, box)
        typer.echo(f"  {number}: {explanation}")
        with atomic_write(folder / f"{name}_{number}.png", "--why") as part:
            picture: Any = plot_explanation(shown, explanation)
            picture.savefig(part)


@app.command()
@option_names(target="--output", workers="--jobs", field_of_view="--fov", camera_height_m="--camera-height")
def video(
    source: Annotated[
        str,
        Argument(
            metavar="SOURCE",
            help="Video file; folder or quoted pattern of a trip's segments, or images; URL; camera; or -.",
        ),
    ],
    output: Annotated[
        Path | None,
        Option(
            "-o",
            "--output",
            metavar="TARGET",
            help="Video to write: .mp4, .m4v, .mov or .mkv.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    show: Annotated[
        bool,
        flag("--show", panel=OUTPUT, help="Show the annotated frames in a window; Escape ends the run."),
    ] = False,
    tracks: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Tracks: .csv, .jsonl, .parquet, .txt (MOT), .zip (CVAT) or .json (COCO).",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        Option(metavar="FILE.html", help="Page with the video and its tracks.", rich_help_panel=OUTPUT),
    ] = None,
    why: Annotated[
        bool,
        flag(
            "--why", panel=OUTPUT, help="Explain a box of each vehicle in --report: the share of each cell."
        ),
    ] = False,
    events: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Events, such as cut-ins and overtaking: .csv or .json.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    clips: Annotated[
        Path | None,
        Option(
            metavar="DIR", help="Folder for a short annotated clip of each event.", rich_help_panel=OUTPUT
        ),
    ] = None,
    srt: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Subtitles with vehicles, nearest distance and events, second by second: .srt or .ass.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    preset: Preset = "veryfast",
    no_audio: NoAudio = False,
    quiet: Annotated[
        bool, flag("-q", "--quiet", panel=OUTPUT, help="Print errors and warnings of damage only.")
    ] = False,
    profile: Annotated[bool, flag("--profile", panel=OUTPUT, help="Print the time of each stage.")] = False,
    start: Annotated[
        float | None,
        Option(metavar="S", help="Start time in seconds, such as 12.5.", rich_help_panel=INPUT),
    ] = None,
    end: Annotated[
        float | None, Option(metavar="S", help="End time in seconds, such as 30.", rich_help_panel=INPUT)
    ] = None,
    own_speed: Annotated[
        float | None,
        Option(
            metavar="KM/H",
            help="Speed of the own vehicle, such as 100, for headways and speeds over ground.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    gpx: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Own speed over time: a GPX track, or a .csv table with the columns time_s and speed_kmh.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    gpx_offset: Annotated[
        float,
        Option(
            metavar="S",
            help="Seconds from the first point of --gpx to the start of the video, such as 12.5 or -3.",
            rich_help_panel=INPUT,
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
        Option(
            metavar="F|auto",
            help=f'{HORIZON_HELP} "auto": estimated from vehicles in a sample of frames.',
            rich_help_panel=CAMERA,
        ),
    ] = None,
    model: Model = "default",
    conf: Confidence = None,
    every: Every = None,
    jobs: Annotated[
        int | None,
        Option(
            metavar="N",
            help="Frames searched in parallel; default: one per core, at most 4.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    labels: Annotated[
        str,
        Option(
            metavar="LIST",
            help="Fields of the labels: some of id,distance,speed,score,std, such as id,distance; or none.",
            rich_help_panel=DRAWING,
        ),
    ] = "id,distance,speed",
    line_width: LineWidth = None,
    color_by: Annotated[
        str,
        Option(
            metavar="id|distance", help="What the colors of the boxes stand for.", rich_help_panel=DRAWING
        ),
    ] = "id",
    panel: Annotated[
        str,
        Option(
            metavar="corner|side|none",
            help="Bird's-eye view in the frame's corner, or beside it.",
            rich_help_panel=DRAWING,
        ),
    ] = "none",
    units: Annotated[
        str,
        Option(
            metavar="metric|imperial",
            help="Labels, subtitles and report in m and km/h, or ft and mph.",
            rich_help_panel=DRAWING,
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
    from vehicle_detection.cli.events import SideOutputs, explain_vehicles, print_summary, read_speed
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.events import TrackLog
    from vehicle_detection.export import FORMATS, TrackWriter, check_format
    from vehicle_detection.mixture import load_model
    from vehicle_detection.video import estimate_video_horizon, open_source, process_video

    outputs = {
        "--output": output, "--tracks": tracks, "--report": report, "--events": events, "--srt": srt,
    }  # fmt: skip
    sources = {"SOURCE": Path(source)} | ({} if gpx is None else {"--gpx": gpx})
    check_distinct_paths(outputs, sources)
    _check_outputs(outputs, clips, show=show, why=why)
    region = _parse_blur(blur)
    draw_params = _draw_params(labels, line_width=line_width, color_by=color_by, panel=panel, units=units)
    speed = read_speed(own_speed, gpx, gpx_offset)
    side_outputs = SideOutputs(events, clips, srt)
    if not quiet:
        announce_replaced(outputs.values())
    with name_kept_files(outputs.values()), contextlib.ExitStack() as stack:
        stack.enter_context(output_folder(clips, "--clips"))
        writers: list[Callable[[Any], object]] = []
        if tracks is not None:
            with option_names(path="--tracks"):
                check_format(tracks, None, FORMATS.values())
        loaded = load_model(model)
        if horizon == "auto":
            with _everywhere(loaded, conf) as everywhere:
                fraction = _estimate_horizon(source, everywhere, start, end, quiet)
        else:
            fraction = None if horizon is None else _parse_horizon(horizon)
        detector = stack.enter_context(
            VehicleDetector(
                loaded,
                conf=conf,
                camera=camera,
                field_of_view=fov,
                camera_height_m=camera_height,
                horizon=fraction,
                every=every,
                own_speed=speed,
                diagnostics=diagnostics,
                draw_params=draw_params,
                blur=region,
            )
        )
        page = None
        if report is not None and output is not None:
            from vehicle_detection.report import ReportWriter

            with option_names(path="--report"):
                page = ReportWriter(
                    report, video=output, source=source, detector=detector, units=draw_params.units
                )
        log = page.log if page else TrackLog()
        writers.append(page or log)
        opened = stack.enter_context(open_source(source, live=live or None, reconnect=not no_reconnect))
        if why and not opened.rereadable:
            raise InvalidInputError(
                f"--why needs a source that can be read again, got {source}; use a file, or omit --why"
            )
        if tracks is not None:
            with option_names(path="--tracks"):
                writers.append(stack.enter_context(TrackWriter(tracks, shape=opened.info.shape)))
        done = process_video(
            opened,
            output,
            detector,
            start=start,
            end=end,
            audio=not no_audio,
            preset=preset,
            workers=jobs,
            progress=not quiet,
            strict=strict,
            show=show,
            on_result=lambda result: [write(result) for write in writers],
        )
        found = side_outputs.find_events(log, done, detector)
        side_outputs.write(log, found, output, done, detector)
        if page is not None:
            # After the tracks, whose file is complete when its writer closes.
            stack.close()
            page.finish(done, events=found, pictures=explain_vehicles(detector, source, log) if why else ())
    if not done.tracks and horizon not in (None, "auto") and not quiet and opened.rereadable:
        with _everywhere(loaded, conf) as everywhere:
            _warn_of_horizon(horizon, estimate_video_horizon(source, everywhere, start=start, end=end))
    if done.tracks and not detector.lens_is_known and not quiet:
        print_error(_UNKNOWN_LENS)
    if not quiet or profile:
        lines = str(done).splitlines()
        typer.echo("\n".join(lines if profile else lines[:1]))
    if not quiet:
        print_summary(log, found, done)
        written = [path for path in (*outputs.values(), clips) if path is not None]
        if written:
            typer.echo(f"wrote {', '.join(map(str, written))}")
    if done.damage:
        raise typer.Exit(DAMAGED)


def _check_outputs(outputs: Mapping[str, Path | None], clips: Path | None, *, show: bool, why: bool) -> None:
    """Refuse outputs of ``video`` that need another one, and a run without any output."""
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
    from vehicle_detection.params import DrawParams

    fields = [field.strip() for field in labels.split(",")]
    return DrawParams(labels=() if fields == ["none"] else fields, **options)


def _everywhere(model: Any, conf: float | None) -> VehicleDetector:
    """Open a detector that searches all rows, whatever the horizon."""
    from vehicle_detection.detector import VehicleDetector

    return VehicleDetector(model, conf=conf, search_params=model.search_params_type.default().everywhere())


def _warn_of_horizon(horizon: str | float, found: HorizonEstimate | None) -> None:
    """Print what a search of all rows found where none was found below a given horizon."""
    message = f"warning: no vehicle was found with --horizon {horizon}, and too few with a search of all rows"
    if found is not None:
        message = (
            f"warning: no vehicle was found with --horizon {horizon}, but a search of all rows found "
            f"{found.n_boxes} boxes, whose horizon is {found.horizon:.2f}; use --horizon {found.horizon:.2f}"
        )
    print_error(message)


def _parse_blur(text: str | None) -> Any:
    """Check the region to blur before a model is loaded."""
    from vehicle_detection._common import check_choice
    from vehicle_detection.drawing import BLUR_REGIONS

    if text is not None:
        check_choice(text, "--blur", BLUR_REGIONS)
    return text


def _parse_horizon(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInputError(
            f"--horizon must be a fraction of the frame's height, such as 0.55, or auto; got {text!r}"
        ) from None


def _estimate_horizon(
    source: str, detector: VehicleDetector, start: float | None, end: float | None, quiet: bool
) -> float | None:
    """Estimate the horizon of a video from its vehicles, and print the result."""
    from vehicle_detection.video import estimate_video_horizon

    found = estimate_video_horizon(source, detector, start=start, end=end)
    if found is None:
        if not quiet:
            print_error(
                "warning: --horizon auto: too few vehicles to estimate the horizon; searching near the middle"
            )
        return None
    if not quiet:
        typer.echo(
            f"horizon {found.horizon:.3f} (standard error {found.horizon_std:.3f}, {found.n_boxes} boxes)"
        )
    return found.horizon


@app.command()
def evaluate(
    predictions: Annotated[
        Path,
        Argument(
            metavar="PREDICTIONS.csv",
            help="Boxes or tracks: .csv, .jsonl, .parquet, .txt (MOT) or .json (COCO data set or results).",
        ),
    ],
    labels: Annotated[
        Path, Argument(metavar="LABELS.csv", help="True boxes, in one of these formats or KITTI's folder.")
    ],
    iou: Annotated[float, Option(metavar="F", help="Minimum IoU of a correct box.")] = 0.5,
    ignored_as_regions: Annotated[
        bool, flag("--ignored-as-regions", help="Ignore boxes of which half lies in an ignored box.")
    ] = False,
    json: Annotated[Path | None, Option(metavar="FILE", help="File for all scores.")] = None,
) -> None:
    """Score boxes, and tracks if there are any, against labels."""
    from json import dumps

    from vehicle_detection._common import atomic_write, check_target
    from vehicle_detection.evaluation import evaluate_detections, evaluate_tracks, read_labels

    if json is not None:
        check_target(json, "--json")
        check_distinct_paths({"--json": json}, {"PREDICTIONS": predictions, "LABELS": labels})
    found, true = read_labels(predictions, truth=labels), read_labels(labels)
    scores: dict[str, Any] = {
        "detections": evaluate_detections(found, true, iou=iou, ignored_as_regions=ignored_as_regions)
    }
    if (found.tracks >= 0).any() and (true.tracks >= 0).any():
        scores["tracks"] = evaluate_tracks(found, true, iou=iou)
    typer.echo("\n\n".join(each.summary() for each in scores.values()))
    if json is not None:
        with atomic_write(json) as part:
            plain = {name: each.to_dict() for name, each in scores.items()}
            part.write_text(dumps(plain, indent=2) + "\n", encoding="utf-8")


for _command in (batch, train, train_frames, tune, fetch, info):
    app.command()(_command)
