"""Read YOLO folders: a text file of boxes, in fractions of the image, for each frame."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vehicle_detection._common import Limit, check, describe, read_regular_file
from vehicle_detection.boxes import clip_boxes, logit
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.formats.rows import (
    FRAME_NUMBER,
    FileRows,
    Record,
    no_text_files,
    read_lines,
    read_text,
    rows_of_records,
    warn_of_numbers,
    without_suffix,
)
from vehicle_detection.images import image_size, read_image
from vehicle_detection.tables import (
    CORNERS,
    VEHICLE_CLASSES,
    FrameKey,
    check_classes,
    frame_order,
    parse_number,
)

# Confidences of 0 and 1 have infinite log-odds.
_MIN_CONFIDENCE = 1e-6
_TRACKS_ALONE = "tracks without confidences; write those too (save_conf=True of Ultralytics)"


def read_yolo(source: Path, classes: Collection[str] | None, shape: Any, images: FrameSet | None) -> FileRows:
    """Read a text file for each frame; the names of the classes are beside their folder, or unknown."""
    if shape is None and images is None:
        raise InvalidInputError(
            "shape must be (height, width) of the frames for YOLO, got None; pass it, or the folder of "
            "the images as images= or --images"
        )
    inner = [each for each in (source / "labels", *source.glob("obj_*_data")) if each.is_dir()]  # or of CVAT
    if len(inner) > 1:
        raise DatasetError(f"{source} holds {inner[0].name} and {inner[1].name}; name one of them")
    folder = inner[0] if inner else source
    files = [file for file in folder.glob("*.txt") if file.name not in ("classes.txt", "train.txt")]
    without_frames = folder != source and not any(folder.iterdir())
    if not files and not without_frames:
        raise no_text_files(folder, "a folder of YOLO labels")
    names = _yolo_names(source)
    wanted = VEHICLE_CLASSES if classes is None else classes
    if names:
        check_classes(source, names.values(), wanted)
    files.sort(key=lambda file: frame_order(file.name))
    frames = _yolo_frames(files, shape) if images is None else _yolo_images(files, images)
    rows: list[tuple[str, Record]] = []
    numbers, sixth = set[str](), set[str]()
    for file, (key, size) in zip(files, frames, strict=True):
        lines = [(where, line.split()) for where, line in read_lines(file)]
        for where, words in lines:
            if len(words) != len(lines[0][1]):
                raise DatasetError(
                    f"{where}: expected {len(lines[0][1])} values, as before, found {len(words)}"
                )
            name, record = _yolo_record(where, words, size)
            if names and name not in names:
                raise DatasetError(f"{where}: class {words[0]} has no name; add it to the list of names")
            # Without names, classes are numbers, and by default all of them are vehicles.
            numbers.add(name)
            sixth.update(words[5:6] if len(words) == 6 else ("",))
            if (not names and classes is None) or names.get(name, name) in wanted:
                rows.append((where, {"frame": key, "label": names.get(name), **record}))
    if sixth and sixth <= {"0", "1"}:
        raise DatasetError(f"{source} has {_TRACKS_ALONE}")
    if not names and classes is not None and numbers:
        check_classes(source, numbers, wanted)
    elif not names:
        warn_of_numbers(source, numbers, "add classes.txt with their names, or pass classes=")
    return rows_of_records(rows, [key for key, _ in frames])


def _yolo_frames(files: Sequence[Path], shape: Any) -> list[tuple[FrameKey, tuple[int, ...]]]:
    """Frame and shape of each file, all of one shape: numbers if all names have six digits."""
    shape = check.shape(shape)
    numbered = all(file.stem.isdecimal() and file.stem == f"{int(file.stem):06d}" for file in files)
    return [(int(file.stem) if numbered else file.stem, shape) for file in files]


def _yolo_images(files: Sequence[Path], images: FrameSet) -> list[tuple[FrameKey, tuple[int, ...]]]:
    """Name and shape of the image of each file; the header has the shape, unless EXIF data may rotate it."""
    names = {without_suffix(name): name for name in images.names}
    frames: list[tuple[FrameKey, tuple[int, ...]]] = []
    for file in files:
        if file.stem not in names:
            raise DatasetError(f"{file} has no image in {images.folder}; pass the folder of its image")
        image = images.folder / names[file.stem]
        data = read_regular_file(image, f"image file {image}", Limit.IMAGE_BYTES, error=DatasetError)
        size = None if b"exif" in data.lower() else image_size(data)
        frames.append((image.name, read_image(image).shape[:2] if size is None else size[::-1]))
    return frames


def _yolo_record(where: str, words: list[str], shape: tuple[int, ...]) -> tuple[str, Record]:
    """Class and record of a line: class, center, size and, for predictions, confidence and track."""
    if not 5 <= len(words) <= 7:
        outline = "; export boxes, not outlines or rotated boxes" if len(words) > 8 else ""
        raise DatasetError(
            f"{where}: expected class, center and size, and perhaps confidence and track, found {len(words)} "
            f"values{outline}"
        )
    x, y, width, height = (parse_number(word, "side of the box", where) for word in words[1:5])
    if len(words) == 5 and not (abs(x - 0.5) < (1 + width) / 2 and abs(y - 0.5) < (1 + height) / 2):
        raise DatasetError(
            f"{where}: the box {' '.join(words[1:5])} lies outside the image; center and size are fractions "
            "of the image in YOLO"
        )
    x, width, y, height = x * shape[1], width * shape[1], y * shape[0], height * shape[0]
    corners = np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])
    record: Record = dict(zip(CORNERS, clip_boxes(corners, shape)[0].tolist()))
    if len(words) > 5:
        confidence = parse_number(words[5], "confidence", where)
        if not 0 <= confidence <= 1:
            raise DatasetError(
                f"{where}: confidence must be from 0 to 1, got {describe(words[5])}; it may be one of "
                f"{_TRACKS_ALONE}"
            )
        record["score"] = logit(min(max(confidence, _MIN_CONFIDENCE), 1 - _MIN_CONFIDENCE))
        record["track_id"] = parse_number(words[6], "track", where) if len(words) > 6 else None
    if not FRAME_NUMBER.fullmatch(words[0]):
        raise DatasetError(f"{where}: class must be a whole number, got {describe(words[0])}")
    return words[0].partition(".")[0], record


def _yolo_names(source: Path) -> dict[str, str]:
    """Lower-case name of each class number, from ``data.yaml`` or a list of names; empty if unknown."""
    place = source.resolve()
    for folder in (place, *place.parents[:2]):
        if (folder / "data.yaml").is_file():
            return _yaml_names(folder / "data.yaml")
        for listed in ("classes.txt", "obj.names"):
            if (folder / listed).is_file():
                lines = read_text(folder / listed).splitlines()
                return {str(number): name.strip().lower() for number, name in enumerate(lines)}
    return {}


def _yaml_names(file: Path) -> dict[str, str]:
    """Value of ``names``: a list, or a mapping from numbers."""
    import yaml

    try:
        data = next(yaml.safe_load_all(read_text(file)), None)  # of several documents, the first
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DatasetError(f"{file} is not YAML text: {' '.join(str(error).split())}") from None
    names = data.get("names") if isinstance(data, dict) else None
    if not names or not isinstance(names, (list, dict)):
        raise DatasetError(f"{file} names no class; write them as names: [car, bus]")
    listed = enumerate(names) if isinstance(names, list) else names.items()
    return {str(number): str(name).lower() for number, name in listed}
