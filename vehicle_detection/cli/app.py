"""The command line, ``vehicle-detection``: errors and exit codes, and the short commands.

Commands import heavy libraries when they run, so that ``--help`` is fast.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import itertools
import os
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperArgument, TyperGroup

from vehicle_detection import __version__
from vehicle_detection.cli.batch import batch
from vehicle_detection.cli.horizon import is_limited, search_everywhere, warn_of_horizon
from vehicle_detection.cli.options import (
    DRAWING,
    OUTPUT,
    Blur,
    Classes,
    Confidence,
    Device,
    Horizon,
    LineWidth,
    Model,
    flag,
    open_model,
    option,
    parse_blur,
)
from vehicle_detection.cli.output import (
    announce_replaced,
    capture_stderr,
    check_distinct_paths,
    exit_if_abandoned,
    option_names,
    output_folder,
    print_error,
    print_facts,
    print_line,
    print_warnings,
    rename_argument,
    replace_unprintable,
)
from vehicle_detection.cli.signals import raise_on_signals
from vehicle_detection.cli.train import fetch, info, train, train_frames
from vehicle_detection.cli.tune import tune
from vehicle_detection.cli.video import DAMAGED, video
from vehicle_detection.errors import DatasetError, InvalidInputError, VehicleDetectionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehicle_detection.boxes import Detections
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.evaluation import FrameBoxes, FrameKey

BAD_INPUT, INTERRUPTED = 2, 130  # exit codes
_MAX_LISTED = 120  # characters of a message that lists surplus arguments
_CHECKED_IMAGES = 20  # images that are searched again if no vehicle was found


# Raised for an unknown command or option, or a value of another type; typer has no public name for it.
_UsageError: type[Any] = typer.BadParameter.__bases__[0]


@contextlib.contextmanager
def _print_usage_error() -> Iterator[None]:
    """Print an error in how a command is called as one line, instead of a box, and exit."""
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            raise
        message = " ".join(error.format_message().split()).rstrip(".")
        command = "vehicle-detection" if error.ctx is None else error.ctx.command_path
        if "unexpected extra argument" in message and command.endswith(" video"):
            # Such as the files of a pattern that the shell has expanded, of which there may be thousands.
            message = textwrap.shorten(message, _MAX_LISTED, placeholder=" ...)")
            message += (
                "; SOURCE is one argument: for several files, pass their folder or a quoted pattern, such as "
                "'CARD/*.MP4'"
            )
        print_error(f"error: {message.partition(', unable to parse')[0]}; see {command} --help")
        raise typer.Exit(BAD_INPUT) from None


def _is_folder_gone() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


@contextlib.contextmanager
def _print_system_errors() -> Iterator[None]:
    """Print an error of the system as one line, and exit."""
    try:
        yield
    except OSError as error:  # such as a full disk
        if error.errno == errno.EPIPE:
            raise
        reason = error.strerror or str(error)
        if error.errno == errno.ENOENT and error.filename is None and _is_folder_gone():
            reason = "the current folder has been removed; change to another one"
        print_error(f"error: {error.filename}: {reason}" if error.filename else f"error: {reason}")
    except MemoryError:
        print_error("error: memory ran out; close other programs, or use fewer --jobs and smaller files")
    except RuntimeError as error:
        if "can't start new thread" not in str(error):
            raise
        print_error(
            "error: the system refuses to start another thread; close other programs, or raise the limit of "
            "processes (ulimit -u)"
        )
    else:
        return
    raise typer.Exit(BAD_INPUT)


class _Commands(TyperGroup):
    """Commands whose expected errors become one line on standard error."""

    def make_context(self, *args: Any, **options: Any) -> Any:
        with _print_system_errors(), _print_usage_error():
            return super().make_context(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        replace_unprintable()
        with _print_system_errors():
            return self._invoke(ctx)

    def _invoke(self, ctx: Any) -> Any:
        try:
            with raise_on_signals(), print_warnings(), _print_usage_error():
                return super().invoke(ctx)
        except (InvalidInputError, DatasetError) as error:
            print_error(f"error: {rename_argument(str(error), self._option_names(ctx))}")
            raise typer.Exit(BAD_INPUT) from None
        except VehicleDetectionError as error:
            print_error(f"error: {error}")
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt as error:
            print_error(f"interrupted{error}")
            code = getattr(error, "code", INTERRUPTED)
            exit_if_abandoned(code)
            raise typer.Exit(code) from None

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
    output: Annotated[Path, option("DIR", "Folder to write.", "-o", "--output")] = Path("demo"),
    frames: Annotated[int, option("N", "Number of frames.")] = 120,
    seed: Annotated[int, option("N", "Random seed of the scene.")] = 0,
    report: Annotated[bool, flag("--report", help="Write a page with the video and its tracks.")] = False,
) -> None:
    """Draw a drive, annotate it with the default model and score it against the ground truth.

    Oncoming vehicles are scored too; boxes on vehicles that are under 40 pixels wide or largely hidden are
    neither right nor wrong.
    """
    from vehicle_detection.cli.demo import FILES, REPORT, run_demo
    from vehicle_detection.detector import VehicleDetector

    # The field of view of the rendering camera.
    with output_folder(output, "--output"), VehicleDetector(field_of_view=58) as detector:
        done, scores = run_demo(output, detector, frames=frames, random_state=seed, report=report)
    print_facts(
        f"{scores.frames} rendered frames of 1280x720, {scores.vehicles} vehicles, {scores.tracks} tracks",
        {
            "F1": f"{scores.f1:.3f}",
            "mean IoU": f"{scores.mean_iou:.3f}",
            "MOTA": f"{scores.mota:.3f}",
            "boxes": f"{scores.tp} on a vehicle, {scores.fn} missed, {scores.fp} false",
            "identity switches": scores.id_switches,
            "speed": f"{done.frames_per_second:.1f} frames/s",
        },
    )
    print_line(f"wrote {', '.join((*FILES, REPORT) if report else FILES)} in {output}")


@app.command()
def detect(
    images: Annotated[list[Path], Argument(metavar="IMAGE...", help="Image files, such as frames/*.jpg.")],
    output: Annotated[
        Path | None,
        option("DIR", "Folder for annotated images, such as found.", "-o", "--output", panel=OUTPUT),
    ] = None,
    boxes: Annotated[
        Path | None,
        option("FILE", "Boxes by file name: .csv, .jsonl, .parquet or .json (COCO).", panel=OUTPUT),
    ] = None,
    why: Annotated[
        Path | None,
        option(
            "DIR",
            "Folder, such as why, for pictures that explain each box: the share of each cell.",
            panel=OUTPUT,
        ),
    ] = None,
    model: Model = "default",
    classes: Classes = None,
    device: Device = "cpu",
    conf: Confidence = None,
    horizon: Horizon = None,
    labels: Annotated[
        str, option("score|none", "Labels of the boxes in annotated images.", panel=DRAWING)
    ] = "score",
    line_width: LineWidth = None,
    blur: Blur = None,
) -> None:
    """Detect the vehicles of images.

    Exit code 3: some images cannot be decoded, and are left out.
    """
    from vehicle_detection._common import check_choice, check_integer, check_suffix
    from vehicle_detection.detector import VehicleDetector
    from vehicle_detection.export import write_boxes

    check_choice(labels, "labels", ("score", "none"))
    if line_width is not None:
        check_integer(line_width, "line_width", low=1, high=1000)
    images = list(dict.fromkeys(itertools.chain.from_iterable(map(_expand, images))))
    _check_images(images, output, boxes)
    if boxes is not None:
        check_suffix(boxes, "--boxes", (".csv", ".jsonl", ".ndjson", ".parquet", ".json"))
    region = parse_blur(blur)
    if region is not None and output is None and why is None:
        raise InvalidInputError(
            "--output must name a folder for --blur, which blurs annotated images; add it"
        )
    undecodable: list[Path] = []
    loaded = open_model(model, classes, device)
    with (
        VehicleDetector(loaded, conf=conf, horizon=horizon, blur=region) as detector,
        output_folder(output, "--output"),
        output_folder(why, "--why"),
    ):
        announce_replaced([boxes])
        readable = _read_each(images, undecodable)
        found = _detect_each(
            readable,
            detector,
            output,
            why,
            scores=labels == "score",
            line_width=line_width,
            left_out=undecodable,
        )
        found = _warn_if_empty(found, images, undecodable, detector, horizon)
        if boxes is None:
            for _ in found:
                pass
        else:
            with option_names(path="--boxes"):
                rows = write_boxes(found, boxes)
            print_line(f"wrote {rows} boxes to {boxes}")
    folders = [str(folder) for folder in (output, why) if folder is not None]
    if folders:
        print_line(f"wrote {', '.join(folders)}")
    if undecodable:
        raise typer.Exit(DAMAGED)


def _expand(image: Path) -> list[Path]:
    """List the files of a pattern with ``*`` or ``?``, which the shell of Windows passes on as it is."""
    if image.exists():
        return [image]
    found = map(Path, sorted(glob.glob(str(image).replace("[", "[[]"))))
    return [path for path in found if not path.is_dir()] or [image]


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
    undecodable: list[Path],
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
    if total or horizon is None or not is_limited(detector):
        return
    boxes, shape = [np.empty((0, 4))], tuple[int, ...]()
    with search_everywhere(detector.model, None) as everywhere:
        decodable = (path for path in images if path not in undecodable)
        for image in map(read_image, itertools.islice(decodable, _CHECKED_IMAGES)):
            shape = shape or image.shape[:2]
            if image.shape[:2] == shape:
                boxes.append(everywhere.detect(image).boxes)
    estimate = None
    with contextlib.suppress(InvalidInputError):  # too few boxes
        estimate = estimate_horizon(np.concatenate(boxes), shape)
    warn_of_horizon(f"--horizon {horizon}", estimate)


def _read_each(images: list[Path], undecodable: list[Path]) -> Iterator[tuple[Path, NDArray[np.uint8]]]:
    """Yield the images that can be decoded, warn of others and list them; it is an error if all are such."""
    from vehicle_detection.images import read_image
    from vehicle_detection.video import is_video_file

    for path in images:
        try:
            if is_video_file(path.name):
                raise InvalidInputError(f"image file {path} is a video; use vehicle-detection video {path}")
            with capture_stderr() as messages:
                image = read_image(path)
        except InvalidInputError as error:
            undecodable.append(path)
            if len(undecodable) == len(images):
                raise
            print_error(f"warning: {error}; left out")
            continue
        for message in messages:
            print_error(f"warning: {path}: {message}")
        yield path, image


def _detect_each(
    images: Iterable[tuple[Path, NDArray[np.uint8]]],
    detector: VehicleDetector,
    output: Path | None,
    why: Path | None,
    *,
    left_out: list[Path],
    scores: bool = True,
    line_width: int | None = None,
) -> Iterator[tuple[str, Detections]]:
    """Detect the vehicles of each image, print them, and write the annotated image.

    Images that are too small are left out, with a warning; it is an error if all of them are.
    """
    import cv2

    from vehicle_detection._common import pluralize
    from vehicle_detection.drawing import (
        blur_boxes,
        draw_detections,
        score_texts,
    )
    from vehicle_detection.images import write_image

    searched, reasons = False, list[str]()
    for path, image in images:
        try:
            found = detector.detect(image)
        except InvalidInputError as error:
            left_out.append(path)
            reasons.append(f"{path}: {error}")
            continue
        searched = True
        listed = "".join(
            f"  [{' '.join(f'{side:.0f}' for side in box)}] {text}"
            for box, text in zip(found.boxes.tolist(), score_texts(found))
        )
        print_line(f"{path}: {pluralize(len(found), 'vehicle')}{listed}")
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
    if reasons and not searched:
        raise InvalidInputError(reasons[0])
    for reason in reasons:
        print_error(f"warning: {reason}; left out")


def _write_explanations(
    folder: Path, name: str, detector: VehicleDetector, image: Any, shown: Any, found: Detections
) -> None:
    """Write a picture for each box of an image that says why it was found; it shows the image `shown`."""
    from vehicle_detection._common import atomic_write
    from vehicle_detection.explanation import explain
    from vehicle_detection.notebook import plot_explanation

    for number, box in enumerate(found.boxes, start=1):
        explanation = explain(detector, image, box)
        print_line(f"  {number}: {explanation}")
        with atomic_write(folder / f"{name}_{number}.png", "--why") as part:
            picture: Any = plot_explanation(shown, explanation)
            picture.savefig(part)


app.command()(video)


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
        Path,
        Argument(
            metavar="LABELS.csv", help="True boxes, in one of these formats, or a folder of KITTI or YOLO."
        ),
    ],
    iou: Annotated[float, option("F", "Minimum IoU of a correct box.")] = 0.5,
    ignored_as_regions: Annotated[
        bool, flag("--ignored-as-regions", help="Ignore boxes of which half lies in an ignored box.")
    ] = False,
    frames: Annotated[
        str | None,
        option(
            "LIST|FILE",
            "Score only these frames: numbers, such as 0,6,12, 0-299 or 0-299:6 (every 6th), or a text file "
            "with the number or name of a frame in each line.",
        ),
    ] = None,
    images: Annotated[
        Path | None, option("DIR", "Folder of the images, whose sizes YOLO folders need, such as images/val.")
    ] = None,
    json: Annotated[Path | None, option("FILE", "File for all scores, such as scores.json.")] = None,
) -> None:
    """Score boxes, and tracks if there are any, against labels."""
    from json import dumps

    from vehicle_detection._common import check_target, write_text
    from vehicle_detection.evaluation import (
        NO_TRACK,
        evaluate_detections,
        evaluate_tracks,
        match_names,
        read_labels,
    )

    if json is not None:
        check_target(json, "--json")
        check_distinct_paths({"--json": json}, {"PREDICTIONS": predictions, "LABELS": labels})
    found, true = read_labels(predictions, truth=labels, images=images), read_labels(labels, images=images)
    # Equal scores may be flags of labels, as in MOTChallenge's ground truth.
    if len(found) and found.scores is None and true.scores is not None and len(set(true.scores)) > 1:
        raise InvalidInputError(
            f"{labels} has scores and {predictions} has none, so they seem to be swapped; pass the "
            "predictions first, then the labels; if these are labels with scores, remove the scores"
        )
    found = match_names(found, true.frame_keys, (str(predictions), str(labels)))
    chosen = None
    if frames is not None:
        chosen = _parse_frames(frames, true.frame_keys)
        found, true = (_boxes_in(each, chosen) for each in (found, true))
    scores: dict[str, Any] = {
        "detections": evaluate_detections(
            found, true, iou=iou, ignored_as_regions=ignored_as_regions, frames=chosen
        )
    }
    unknown = [int(((boxes.tracks == NO_TRACK) & ~boxes.ignore).sum()) for boxes in (found, true)]
    if not any(unknown):
        scores["tracks"] = evaluate_tracks(
            found, true, iou=iou, ignored_as_regions=ignored_as_regions, frames=chosen
        )
    print_line("\n\n".join(each.summary() for each in scores.values()))
    labelled = set(true.frames if chosen is None else chosen)
    unseen = len(labelled - set(found.frames))
    if labelled and unseen > 0.5 * len(labelled):
        print_error(
            f"note: {unseen} of {len(labelled)} labelled frames have no box in {predictions}, so their "
            "vehicles count as missed; pass --frames if not all of them were searched"
        )
    searched = set(found[~found.ignore].frames)
    unlabelled = len(searched - set(true.frame_keys if chosen is None else chosen))
    if unlabelled > 0.1 * len(searched):
        print_error(
            f"note: {unlabelled} of {len(searched)} frames with boxes have no row in {labels}, so their "
            "boxes count as false; pass --frames if not all of them are labelled"
        )
    for boxes, count, file in zip((found, true), unknown, (predictions, labels)):
        if 0 < count < (~boxes.ignore).sum():
            noun = "box has" if count == 1 else "boxes have"
            print_error(f"note: the tracks are not scored: {count} {noun} no track in {file}")
    if json is not None:
        write_text(json, dumps({name: each.to_dict() for name, each in scores.items()}, indent=2) + "\n")


def _boxes_in(boxes: FrameBoxes, frames: Sequence[FrameKey]) -> FrameBoxes:
    """Boxes in some frames."""
    wanted = set(frames)
    return boxes[[row for row, key in enumerate(boxes.frames) if key in wanted]]


def _parse_frames(text: str, keys: Sequence[FrameKey]) -> list[FrameKey]:
    """Frames of numbers and ranges, or of a file with a frame in each line; some must be among the keys."""
    span = r"\s*(\d{1,9})(?:-(\d{1,9})(?::([1-9]\d{0,8}))?)?\s*"
    spans = [re.fullmatch(span, part) for part in text.split(",")]
    chosen: list[FrameKey] = []
    if all(spans):
        for first, last, step in (found.groups() for found in spans if found):
            chosen += range(int(first), int(last or first) + 1, int(step or 1))
    else:
        from vehicle_detection._common import Limit, check_path, read_regular_file

        kind = "numbers such as 0,6,12 or 0-299 (0-299:6 for every 6th), or a file with a frame in each line"
        file = check_path(text, "--frames", kind=kind)
        if not file.exists():
            raise InvalidInputError(f"--frames must be {kind}, got {text!r}")
        data = read_regular_file(file, f"--frames {text}", Limit.TEXT_BYTES).decode("utf-8-sig", "replace")
        names = [line.strip() for line in data.splitlines() if line.strip()]
        numbered = bool(keys) and isinstance(keys[0], int)
        chosen = [int(name) for name in names if name.isdecimal()] if numbered else [*names]
    if not set(chosen) & set(keys):
        example = f", such as {keys[0]}" if keys else ", which hold none"
        raise InvalidInputError(f"--frames {text} names no frame of the labels{example}")
    return list(dict.fromkeys(chosen))


for _command in (batch, train, train_frames, tune, fetch, info):
    app.command()(_command)
