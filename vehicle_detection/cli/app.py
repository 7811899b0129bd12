"""The command line: ``vehicle-detection ...``.

Heavy imports stand in the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import contextlib
import errno
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from vehicle_detection import __version__
from vehicle_detection.cli.output import (
    capture_stderr,
    check_distinct_paths,
    output_folder,
    print_error,
    print_facts,
)
from vehicle_detection.cli.train import fetch, info, train, train_frames
from vehicle_detection.cli.tune import tune
from vehicle_detection.errors import InvalidInputError, VehicleDetectionError

if TYPE_CHECKING:
    from vehicle_detection.boxes import Detections
    from vehicle_detection.classifier import VehicleClassifier
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.mixture import TemplateMixture

BAD_INPUT, INTERRUPTED = 2, 130


class _Commands(TyperGroup):
    """Commands whose expected errors end in one line on standard error."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except VehicleDetectionError as error:
            print_error(f"error: {error}")
            raise typer.Exit(BAD_INPUT) from None
        except OSError as error:  # the disk is full, a name is too long
            if error.errno == errno.EPIPE:
                raise
            print_error(f"error: {error}")
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            print_error("interrupted")
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(
    cls=_Commands,
    help="Find and follow vehicles in dash-cam images and video.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line."""
    try:
        app(prog_name="vehicle-detection")
    except KeyboardInterrupt:  # before or after a command
        print_error("interrupted")
        sys.exit(INTERRUPTED)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _start(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


Model = Annotated[
    str,
    typer.Option("--model", metavar="NAME|FILE", help='"default": any road; "highway": fastest; or a file.'),
]
Horizon = Annotated[
    float | None,
    typer.Option(metavar="F", help="Height of the horizon as a share of the frame's height, 0 at the top."),
]


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write to.")] = Path(
        "demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", help="Length of the drive.")] = 120,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the drive.")] = 0,
) -> None:
    """Draw a drive, annotate it with the shipped model and score it against the truth."""
    from vehicle_detection.cli.demo import FILES, run_demo
    from vehicle_detection.detector import VehicleDetector

    with output_folder(output, "-o"), VehicleDetector() as detector:
        result = run_demo(output, detector, frames=frames, random_state=seed, progress=True)
    scores = result.scores
    print_facts(
        f"{scores.frames} drawn frames of 1280x720, {scores.vehicles} vehicles, {scores.tracks} tracks",
        {
            "F1": f"{scores.f1:.3f}",
            "mean IoU": f"{scores.mean_iou:.3f}",
            "MOTA": f"{scores.mota:.3f}",
            "identity switches": scores.id_switches,
            "speed": f"{result.report.frames_per_second:.1f} frames/s",
        },
    )
    typer.echo(f"wrote {', '.join(FILES)} in {output}")


@app.command()
def detect(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Image files.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder for annotated images.")
    ] = None,
    boxes: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table of all boxes, by file name.")
    ] = None,
    model: Model = "default",
    horizon: Horizon = None,
) -> None:
    """Find the vehicles of images."""
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.export import write_boxes
    from vehicle_detection.mixture import load_model

    _check_images(images, output, boxes)
    with VehicleDetector(load_model(model), horizon=horizon) as detector, output_folder(output, "-o"):
        found = _detect_each(images, detector, output)
        if boxes is None:
            for _ in found:
                pass
        else:
            rows = write_boxes(found, boxes)
            typer.echo(f"wrote {rows} boxes to {boxes}")


def _check_images(images: list[Path], output: Path | None, boxes: Path | None) -> None:
    """Refuse what would fail, or overwrite something, after a part of the work is done."""
    for image in images:
        if image.is_dir():
            raise InvalidInputError(
                f"IMAGE {image} is a folder; name the files in it, such as {image / '*.jpg'}"
            )
        if not image.exists():
            raise InvalidInputError(f"IMAGE {image} does not exist; check the path")
        if boxes is not None and boxes.exists() and boxes.samefile(image):
            raise InvalidInputError(f"--boxes {boxes} is one of the images; choose another name")
        if output is not None and output.exists() and output.samefile(image.parent):
            raise InvalidInputError(
                f"-o {output} is the folder of {image.name}, which would be overwritten; choose another"
            )
    by_name: dict[str, Path] = {}
    for image in images:
        other = by_name.setdefault(image.name, image)
        if other != image and (output is not None or boxes is not None):
            raise InvalidInputError(
                f"IMAGE {other} and {image} have the same name, by which results go; take a folder at a time"
            )


def _detect_each(
    images: list[Path], detector: VehicleDetector, output: Path | None
) -> Iterator[tuple[str, Detections]]:
    """Search one image after the other, print what is found, and write the annotated image."""
    import cv2

    from vehicle_detection.drawing import draw_boxes
    from vehicle_detection.images import read_image, write_image

    for path in images:
        with capture_stderr() as messages:
            image = read_image(path)
        for message in messages:
            print_error(f"warning: {path}: {message}")
        found = detector.detect(image)
        listed = "".join(
            f"  [{' '.join(f'{side:.0f}' for side in box)}] {score:.2f}"
            for box, score in zip(found.boxes.tolist(), found.scores.tolist())
        )
        typer.echo(f"{path}: {len(found)} vehicle{'s' * (len(found) != 1)}{listed}")
        if output is not None:
            thickness = max(2, round(max(image.shape) / 320))
            suffix = path.suffix if cv2.haveImageWriter(f"image{path.suffix}") else f"{path.suffix}.png"
            drawn = draw_boxes(image, found.boxes, color=(230, 159, 0), thickness=thickness)
            write_image(output / (path.stem + suffix), drawn)
        yield path.name, found


@app.command()
def video(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Video to read.")],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="Video to write: .mp4, .m4v, .mov or .mkv.")
    ],
    tracks: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table of all tracks: .csv, .jsonl or .txt (MOT).")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Page with the video and its tracks over time, in one file."),
    ] = None,
    diagnostics: Annotated[
        bool,
        typer.Option("--diagnostics", help="Show frame, positive windows, heat map and tracks side by side."),
    ] = False,
    model: Model = "default",
    start: Annotated[float | None, typer.Option(metavar="S", help="Second to start at.")] = None,
    end: Annotated[float | None, typer.Option(metavar="S", help="Second to end at.")] = None,
    preset: Annotated[
        str, typer.Option(metavar="P", help="Speed of the H.264 encoder, ultrafast to placebo.")
    ] = "veryfast",
    horizon: Annotated[
        str | None,
        typer.Option(
            metavar="F|auto",
            help='Height of the horizon as a share of the frame\'s height, 0 at the top; "auto": look at the '
            "vehicles first.",
        ),
    ] = None,
    no_audio: Annotated[bool, typer.Option("--no-audio", help="Leave out the sound.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")] = False,
    profile: Annotated[bool, typer.Option("--profile", help="Show the time of each stage.")] = False,
) -> None:
    """Follow the vehicles of a video and write it again with their boxes."""
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.export import TrackWriter
    from vehicle_detection.mixture import load_model
    from vehicle_detection.report import ReportWriter
    from vehicle_detection.video import process_video

    named = {"--tracks": tracks, "--report": report}
    outputs = {name: path for name, path in named.items() if path is not None}
    check_distinct_paths(outputs, {"SOURCE": source, "TARGET": target})
    with contextlib.ExitStack() as stack:
        writers: list[Callable[[Any], object]] = []
        if tracks is not None:
            writers.append(stack.enter_context(TrackWriter(tracks)))
        loaded = load_model(model)
        if horizon == "auto":
            share = _look_for_horizon(source, loaded, start, end, quiet)
        else:
            share = None if horizon is None else _as_share(horizon)
        detector = stack.enter_context(VehicleDetector(loaded, horizon=share, diagnostics=diagnostics))
        page = None
        if report is not None:
            page = ReportWriter(report, video=target, source=source, detector=detector)
            writers.append(page)
        done = process_video(
            source,
            target,
            detector,
            start=start,
            end=end,
            audio=not no_audio,
            preset=preset,
            progress=not quiet,
            on_result=lambda result: [write(result) for write in writers],
        )
    if page is not None:
        page.finish(done)
    if not quiet or profile:
        lines = str(done).splitlines()
        typer.echo("\n".join(lines if profile else lines[:1]))
    if not quiet:
        typer.echo(f"wrote {' and '.join(map(str, (target, *outputs.values())))}")


def _as_share(horizon: str) -> float:
    try:
        return float(horizon)
    except ValueError:
        raise InvalidInputError(
            f"--horizon must be a share of the frame's height, such as 0.55, or auto; got {horizon!r}"
        ) from None


def _look_for_horizon(
    source: Path,
    model: VehicleClassifier | TemplateMixture,
    start: float | None,
    end: float | None,
    quiet: bool,
) -> float | None:
    """Estimate the horizon of a video from its vehicles, and say what came of it."""
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.video import estimate_video_horizon

    with VehicleDetector(model) as detector:
        found = estimate_video_horizon(source, detector, start=start, end=end)
    if not quiet and found is None:
        print_error("warning: --horizon auto: the vehicles do not tell the horizon; it is left open")
    elif not quiet and found is not None:
        std, count = found.horizon_std, found.n_boxes
        typer.echo(f"horizon {found.horizon:.3f}, give or take {std:.3f}, from {count} boxes")
    return None if found is None else found.horizon


@app.command()
def evaluate(
    predictions: Annotated[Path, typer.Argument(metavar="PREDICTIONS.csv", help="Boxes or tracks.")],
    labels: Annotated[Path, typer.Argument(metavar="LABELS.csv", help="True boxes.")],
    iou: Annotated[float, typer.Option(metavar="F", help="Overlap from which a box is right.")] = 0.5,
    regions: Annotated[
        bool,
        typer.Option(
            "--regions/--no-regions", help="Do not judge boxes of which half lies in an ignored box."
        ),
    ] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="File for all scores.")] = None,
) -> None:
    """Score boxes, and tracks where there are any, against labels."""
    from json import dumps

    from vehicle_detection._common import atomic_write, check_target
    from vehicle_detection.evaluation import evaluate_detections, evaluate_tracks, read_labels

    if json is not None:
        check_distinct_paths(
            {"--json": check_target(json, "--json")}, {"PREDICTIONS": predictions, "LABELS": labels}
        )
    found, true = read_labels(predictions), read_labels(labels)
    scores: dict[str, Any] = {
        "detections": evaluate_detections(found, true, iou=iou, ignored_as_regions=regions)
    }
    if (found.tracks >= 0).any() and (true.tracks >= 0).any():
        scores["tracks"] = evaluate_tracks(found, true, iou=iou)
    typer.echo("\n\n".join(each.summary() for each in scores.values()))
    if json is not None:
        with atomic_write(json) as part:
            plain = {name: each.to_dict() for name, each in scores.items()}
            part.write_text(dumps(plain, indent=2) + "\n", encoding="utf-8")


for _command in (train, train_frames, tune, fetch, info):
    app.command()(_command)
