"""The command that detects the vehicles of images."""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import typer
from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli import options as shared
from vehicle_detection.cli.horizon import is_limited, search_everywhere, warn_of_horizon
from vehicle_detection.cli.output import (
    DAMAGED,
    announce_replaced,
    capture_stderr,
    option_names,
    output_folder,
    print_error,
    print_line,
    refuse_if,
)
from vehicle_detection.errors import InvalidInputError

_CHECKED_IMAGES = 20  # images that are searched again if no vehicle was found


class _Image(NamedTuple):
    """An image to search: its file or URL, and the name by which results know it."""

    source: Any
    name: str

    def __str__(self) -> str:
        return common.hide_credentials(str(self.source))


@dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """Options of ``detect``."""

    images: list[str] = Argument(
        ..., metavar="IMAGE...", help="Image files, such as frames/*.jpg; folders; URLs."
    )
    output: Path | None = shared.output(
        "DIR", "Folder for annotated images, such as found.", "-o", "--output"
    )
    boxes: Path | None = shared.output("FILE", "Boxes by file name: .csv, .jsonl, .parquet or .json (COCO).")
    why: Path | None = shared.output(
        "DIR", "Folder, such as why, for pictures that explain each box: the share of each cell."
    )
    model: str = shared.MODEL
    classes: str | None = shared.CLASSES
    device: str = shared.DEVICE
    jobs: int | None = shared.search("N", "Images searched in parallel, such as 2; default: one per core.")
    conf: float | None = shared.CONFIDENCE
    camera: str | None = shared.CAMERA
    fov: float | None = shared.camera(
        "DEG", "Field of view along the longer side in degrees, such as 90, to state distances."
    )
    camera_height: float | None = shared.CAMERA_HEIGHT
    horizon: float | None = shared.HORIZON
    labels: str = shared.drawing("score|none", "Labels of the boxes in annotated images.", default="score")
    line_width: int | None = shared.LINE_WIDTH
    blur: str | None = shared.BLUR


@shared.takes(DetectOptions)
def detect(options: DetectOptions) -> None:
    """Detect the vehicles of images.

    Exit code 3: some images cannot be decoded, and are left out.
    """
    with option_names(image="IMAGE", path="IMAGE"):
        images = list(dict.fromkeys(itertools.chain.from_iterable(map(_expand, options.images))))
    _check(options, images)
    left_out: list[_Image] = []
    loaded = shared.open_model(options.model, options.classes, options.device)
    camera = vd.open_camera(
        options.camera, fov=options.fov, height_m=options.camera_height, horizon=options.horizon
    )
    jobs = common.resolve_jobs(options.jobs)
    with (
        # Several images are searched in parallel by one thread each, which takes the least time.
        vd.Detector(
            loaded, conf=options.conf, camera=camera, jobs=1 if len(images) > 1 else jobs
        ) as detector,
        output_folder(options.output, "--output"),
        output_folder(options.why, "--why"),
    ):
        announce_replaced([options.boxes])
        found = _detect_each(images, detector, options, min(jobs, len(images)), left_out)
        if options.horizon is not None:
            readable = (image for image in images if image not in left_out)
            found = _warn_if_empty(found, readable, detector, options.horizon)
        if options.boxes is None:
            deque(found, maxlen=0)
        else:
            with option_names(path="--boxes"):
                table = vd.TrackTable.from_detections({common.encodable(name): each for name, each in found})
                rows = vd.write_tracks(table, options.boxes)
            print_line(f"wrote {rows} boxes to {options.boxes}")
    folders = [str(folder) for folder in (options.output, options.why) if folder is not None]
    if folders:
        print_line(f"wrote {', '.join(folders)}")
    if left_out:
        raise typer.Exit(DAMAGED)


def _expand(text: str) -> list[_Image]:
    """List the images of a folder, or of a pattern, which the shell of Windows passes on as it is."""
    from vehicle_detection.images import list_images

    refuse_if(not text.strip(), "IMAGE must be a file, a folder or a URL, got an empty name")
    path = common.check.path(text, "IMAGE", kind="an image file")
    if common.is_url(text):
        return [_Image(text, Path(common.without_query(text)).name or "image")]
    has_pattern = ("*" in text or "?" in text) and not path.exists()
    if not path.is_dir() and not has_pattern:
        return [_Image(path, path.name)]
    found = list_images(path if path.is_dir() else text.replace("[", "[[]")) or ()
    return [_Image(each, str(each.relative_to(path) if path.is_dir() else each.name)) for each in found]


def _check(options: DetectOptions, images: list[_Image]) -> None:
    """Refuse options and images that would fail, or be overwritten, after a part of the work is done."""
    output, boxes = options.output, options.boxes
    common.check.choice(options.labels, "labels", ("score", "none"))
    if options.line_width is not None:
        common.check.integer(options.line_width, "line_width", low=1, high=1000)
    by_name: dict[str, _Image] = {}
    for image in images:
        other = by_name.setdefault(image.name, image)
        refuse_if(
            other != image and (output or boxes),
            f"IMAGE {other} and {image} have the same file name, which identifies the results; process one "
            "folder at a time",
        )
        if isinstance(image.source, str):  # a URL
            continue
        refuse_if(not image.source.exists(), f"IMAGE {image} does not exist; check the path")
        is_image = boxes is not None and boxes.exists() and boxes.samefile(image.source)
        refuse_if(is_image, f"--boxes {boxes} is one of the images; choose another name")
        refuse_if(
            output is not None and output.exists() and output.samefile(image.source.parent),
            f"--output {output} is the folder of {image.name}, which would be overwritten; choose another",
        )
    if boxes is not None:
        common.check_suffix(boxes, "--boxes", (".csv", ".jsonl", ".ndjson", ".parquet", ".json"))
    shared.check_blur(options.blur)
    unseen = options.blur and not output and not options.why
    refuse_if(unseen, "--output must name a folder for --blur, which blurs annotated images; add it")


def _detect_each(
    images: list[_Image], detector: vd.Detector, options: DetectOptions, jobs: int, left_out: list[_Image]
) -> Iterator[tuple[str, vd.Detections]]:
    """Detect the vehicles of each image, print them, and write what the options name.

    Images that cannot be decoded or are too small are listed in `left_out`, with a warning; it is an error
    if all of them are.
    """
    import cv2
    import numpy as np

    from vehicle_detection.drawing import draw_texts, line_width_for

    searched, too_small, without_distance = 0, list[str](), 0
    for image, pixels, result in _search_each(_read_each(images, left_out), detector, jobs):
        try:
            found = result()
        except InvalidInputError as error:
            left_out.append(image)
            too_small.append(f"{image}: {error}")
            continue
        searched += 1
        texts = _texts(found)
        if found.distances_m is not None:
            without_distance += int(np.isnan(found.distances_m).sum())
        listed = "".join(
            f"  [{' '.join(f'{side:.0f}' for side in box)}] {text}"
            for box, text in zip(found.boxes.tolist(), texts)
        )
        print_line(f"{image}: {common.pluralize(len(found), 'vehicle')}{listed}")
        shown = pixels if options.blur is None else vd.blur_boxes(pixels, found.boxes, region=options.blur)
        name = Path(image.name)
        if options.why is not None:
            for number, box in enumerate(found.boxes, start=1):
                explanation = vd.explain(detector, pixels, box)
                print_line(f"  {number}: {explanation}")
                figure: Any = vd.notebook.plot_explanation(shown, explanation)
                file = options.why / f"{image.name.replace('/', '_')}_{number}.png"
                with common.atomic_write(file, "--why") as part:
                    figure.savefig(part)
        if options.output is not None:
            # As PNG if its own format cannot be written.
            suffix = name.suffix if cv2.haveImageWriter(f"image{name.suffix}") else f"{name.suffix}.png"
            drawn = vd.draw_detections(shown, found, line_width=options.line_width, scores=False)
            if options.labels == "score":
                width = options.line_width or line_width_for(drawn.shape)
                draw_texts(drawn, found.boxes, texts, (230, 159, 0), width)
            target = options.output / name.with_name(name.stem + suffix)
            target.parent.mkdir(parents=True, exist_ok=True)
            vd.write_image(target, drawn)
        yield image.name, found.with_columns(source=None)  # without the pixels
    if too_small and not searched:
        raise InvalidInputError(too_small[0])
    if without_distance:
        remedy = "" if options.horizon is not None else " without a stated --horizon"
        count = common.pluralize(without_distance, "vehicle")
        print_error(f"note: no distance for {count}: cut off by the frame, or seen from the side{remedy}")
    for reason in too_small:
        print_error(f"warning: {reason}; left out")


def _texts(found: Any) -> list[str]:
    """Return the confidence of each box and, if the lens is known, its distance."""
    from vehicle_detection.drawing import score_texts

    texts = score_texts(found)
    if found.distances_m is None:
        return texts
    distances = zip(found.distances_m.tolist(), found.distance_stds_m.tolist())
    metric = common.UNITS["metric"]
    return [
        text if distance != distance else f"{text} {metric.distance_text(distance, std, with_std=True)}"
        for text, (distance, std) in zip(texts, distances)
    ]


def _search_each(
    images: Iterator[tuple[_Image, Any]], detector: vd.Detector, jobs: int
) -> Iterator[tuple[_Image, Any, Callable[[], Any]]]:
    """Search images in `jobs` threads; yield each with its pixels and a function that returns the result."""
    pending = deque[tuple[_Image, Any, Callable[[], Any]]]()
    with ThreadPoolExecutor(jobs, thread_name_prefix="vehicle-detect") as pool:
        for image, pixels in images:
            pending.append((image, pixels, pool.submit(detector.detect, pixels).result))
            if len(pending) > jobs:
                yield pending.popleft()
        yield from pending


def _read_each(images: list[_Image], left_out: list[_Image]) -> Iterator[tuple[_Image, Any]]:
    """Yield the images that can be decoded, warn of others and list them; it is an error if all are such."""
    from vehicle_detection.video import is_video_file

    for image in images:
        try:
            if is_video_file(str(image.source)):
                raise InvalidInputError(f"image file {image} is a video; use vehicle-detection video {image}")
            with capture_stderr() as messages:
                pixels = vd.read_image(image.source)
        except InvalidInputError as error:
            left_out.append(image)
            if len(left_out) == len(images):
                raise
            print_error(f"warning: {error}; left out")
            continue
        for message in messages:  # of the library, or of a decoder, which does not name the image
            print_error(message if message.startswith("warning: ") else f"warning: {image}: {message}")
        yield image, pixels


def _warn_if_empty(
    found: Iterator[tuple[str, vd.Detections]],
    images: Iterator[_Image],
    detector: vd.Detector,
    horizon: float,
) -> Iterator[tuple[str, vd.Detections]]:
    """Pass on what is found; if that is nothing, search some images without the given horizon."""
    import numpy as np

    total = 0
    for name, vehicles in found:
        total += len(vehicles)
        yield name, vehicles
    if total or not is_limited(detector):
        return
    boxes, shape = [np.empty((0, 4))], tuple[int, ...]()
    with search_everywhere(detector.model, None) as everywhere:
        for image in (vd.read_image(each.source) for each in itertools.islice(images, _CHECKED_IMAGES)):
            shape = shape or image.shape[:2]
            if image.shape[:2] == shape:
                boxes.append(everywhere.detect(image).boxes)
    estimate = None
    with contextlib.suppress(InvalidInputError):  # too few boxes
        estimate = vd.estimate_horizon(np.concatenate(boxes), shape)
    warn_of_horizon(f"--horizon {horizon}", estimate)
