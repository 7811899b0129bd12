"""Data sets of images: COCO JSON, with its lists of results, and folders of YOLO."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import unicodedata
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import (
    Limit,
    check,
    describe,
    invalid,
    parse_number,
    parse_yaml,
    read_regular_file,
)
from vehicle_detection.boxes import VEHICLE_CLASSES, clip_boxes, confidence_score
from vehicle_detection.datasets.frames import FrameSet
from vehicle_detection.datasets.rows import (
    FRAME_NUMBER,
    ClassNumbers,
    FileRows,
    Record,
    class_name,
    label_files,
    no_text_files,
    read_lines,
    read_text,
    rows_of_records,
    warn_of_numbers,
    without_suffix,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import image_size, read_image
from vehicle_detection.tables import (
    CORNERS,
    LOOKALIKE_CLASSES,
    NO_TRACK,
    TRACK_COLUMNS,
    FrameKey,
    TrackTable,
    check_classes,
    frame_order,
)

_LOGGER = logging.getLogger(__name__)

Write = Callable[[FrameKey, Sequence[Record]], None]
"""Writes rows of a frame, of which there may be none."""

_VALUES = tuple(
    name for name in TRACK_COLUMNS if name not in (*CORNERS, "frame", "track_id", "score", "label")
)
# Keys of other tools' JSON, in the whole or its first entry.
_OTHER_TOOLS = (
    ({"shapes", "imagePath"}, "Labelme or X-AnyLabeling"),
    ({"labels", "name"}, "BDD100K (Scalabel)"),
    ({"data", "annotations"}, "Label Studio"),
    ({"annotator", "image"}, "Label Studio"),
    ({"regions", "filename"}, "the VGG Image Annotator"),
    ({"_via_img_metadata"}, "the VGG Image Annotator"),
    ({"items", "categories", "info"}, "Datumaro"),
    ({"objects", "size"}, "Supervisely"),
)


def json_reason(error: ValueError | RecursionError) -> str:
    """Say why a text cannot be parsed; Python refuses integers of thousands of digits."""
    if isinstance(error, RecursionError):
        return "nested too deeply"
    return error.msg if isinstance(error, json.JSONDecodeError) else "a number has too many digits"


class CocoFile(NamedTuple):
    """A COCO data set, or a list of results, whose images and categories are those of another file."""

    images: dict[Any, FrameKey]  # frame of each image id, in the order of the file
    entries: list[dict[str, Any]]  # of the images
    categories: dict[Any, str]  # lower-case name of each category id
    annotations: list[Any]


def _read_file(source: Path, truth: Path | None = None) -> CocoFile:
    """Read a COCO file; `truth` names the data set that a list of results belongs to."""
    try:
        data = json.loads(read_text(source))
    except (ValueError, RecursionError) as error:
        line = f" line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise DatasetError(f"{source}{line}: not JSON text ({json_reason(error)})") from None
    if isinstance(data, list) and all(isinstance(entry, dict) and "image_id" in entry for entry in data):
        if truth is None:
            raise DatasetError(
                f"{source} is a list of COCO results, predictions of images that the ground truth lists; "
                "read it with truth=, and use the ground truth, a COCO data set, as labels"
            )
        return _read_file(truth)._replace(annotations=data)
    parts = data if isinstance(data, dict) else {}
    first = data[0] if isinstance(data, list) and data else next(iter(parts.values()), None)
    keys = {*parts, *(first if isinstance(first, dict) else ())}
    other = next((tool for needed, tool in _OTHER_TOOLS if needed <= keys), None)
    if other is not None:
        raise DatasetError(f"{source} is the JSON of {other}, which is not read; export COCO there")
    needed = ("images", "annotations", "categories")
    missing = [name for name in needed if not isinstance(parts.get(name), list)]
    if missing:
        raise DatasetError(f"{source} is not a COCO file: it lacks the lists {', '.join(missing)}")
    try:
        images = {image["id"]: _frame_of(image) for image in data["images"]}
        names = {entry["id"]: " ".join(str(entry["name"]).lower().split()) for entry in data["categories"]}
    except (KeyError, TypeError, AttributeError):
        raise DatasetError(f"{source}: every image and category needs an id, and categories a name") from None
    if {*map(type, images.values())} not in (set(), {int}, {str}):
        raise DatasetError(f"{source}: give every image a file_name, or none of them and integer ids")
    if len(set(images.values())) < len(data["images"]):
        raise DatasetError(f"{source}: two images share an id or a file_name; make them unique")
    return CocoFile(images, data["images"], names, data["annotations"])


def _frame_of(image: dict[str, Any]) -> FrameKey:
    """Frame of an image: its file name; the frame's number where `_image_entry` put it into the name."""
    name, frame = image.get("file_name", image["id"]), image.get("frame")
    return frame if isinstance(frame, int) and name == f"{frame:06d}" else name


def _vehicle_categories(file: CocoFile, source: Path, classes: Collection[str] | None) -> set[Any]:
    """Ids of the categories that are vehicles; raise if there are annotations but no such category."""
    wanted = VEHICLE_CLASSES if classes is None else classes
    if file.annotations:
        check_classes(source, file.categories.values(), wanted, "category")
    return {number for number, name in file.categories.items() if name in wanted}


def read_coco(
    source: Path, classes: Collection[str] | None, truth: Path | None, images: FrameSet | None
) -> tuple[list[tuple[str, Record]], list[FrameKey]]:
    """Read the records of a data set or of results, each after its place, and the frames."""
    file = _read_file(source, truth)
    if images is not None:
        _warn_of_sizes(source, file, images)
    vehicles = _vehicle_categories(file, source, classes)
    rows: list[tuple[str, Record]] = []
    by_name: dict[str, FrameKey | None] = {}  # None: of several images
    for key in file.images.values():
        by_name[_base_name(key)] = None if _base_name(key) in by_name else key
    tracks = (_with_attributes(each).get("track_id") for each in file.annotations if isinstance(each, dict))
    free = max((track for track in tracks if isinstance(track, int)), default=NO_TRACK) + 1
    for number, entry in enumerate(file.annotations):
        where = f"{source} annotation {number}"
        try:
            x, y, width, height = (parse_number(side, "bbox", where) for side in entry["bbox"])
            category = entry["category_id"]
            # Ultralytics writes the file's name, or its number, which may be another id.
            image = entry["image_id"]
            named = by_name.get(_base_name(entry.get("file_name", "" if image in file.images else image)))
            frame = file.images[image] if named is None else named
            name = file.categories[category]
        except (KeyError, TypeError, ValueError) as error:
            expected = "bbox [x, y, width, height], and image_id and category_id of an image and a category"
            raise DatasetError(f"{where}: expected {expected} in the file ({error})") from None
        if category not in vehicles and name not in LOOKALIKE_CLASSES:
            continue
        entry = _with_attributes(entry)
        ignore = bool(entry.get("iscrowd") or entry.get("ignore") or category not in vehicles)
        # An ignored box without a track would be a region.
        track = entry.get("track_id", free + number if ignore and entry.get("score") is None else NO_TRACK)
        # A crowd is a region, except for the ignored vehicles that are written here, which are marked twice.
        if entry.get("iscrowd") and not (entry.get("ignore") and "track_id" in entry):
            track = NO_TRACK
        record = {key: entry.get(key) for key in ("score", *_VALUES, "occluded", "truncated")}
        record |= {"frame": frame, "track_id": track, "ignore": ignore, "label": name}
        rows.append((where, record | dict(zip(CORNERS, (x, y, x + width, y + height)))))
    return rows, list(file.images.values())


def _base_name(key: FrameKey, *, suffix: bool = False) -> str:
    """File name of an image without its folder, and without suffix."""
    name = str(key).replace("\\", "/").rpartition("/")[2]
    return name if suffix else without_suffix(name)


def _warn_of_sizes(source: Path, file: CocoFile, images: FrameSet) -> None:
    """Warn if images have another size than the one on which their boxes were drawn."""
    stated = {
        _base_name(key, suffix=True): (entry.get("width"), entry.get("height"))
        for key, entry in zip(file.images.values(), file.entries)
    }
    known = [name for name in images.names if {*map(type, stated.get(name, ()))} == {int}]
    sizes = {name: _image_shape(images.folder / name)[1::-1] for name in known}
    other = [name for name in known if sizes[name] != stated[name]]
    if other:
        _LOGGER.warning(
            "%s: %d of %d images have another size than it states, such as %s: %dx%d instead of %dx%d; boxes "
            "are not scaled",
            *(source, len(other), len(known), other[0], *sizes[other[0]], *stated[other[0]]),
        )


def _with_attributes(entry: dict[str, Any]) -> dict[str, Any]:
    """Add what CVAT and Datumaro write into ``attributes``, where true and false stand for 1 and 0."""
    attributes = entry.get("attributes")
    inner = attributes if isinstance(attributes, dict) else {}
    known = {name: inner[name] for name in ("track_id", "occluded", "truncated") if name in inner}
    known |= {"track_id": entry["instance_id"]} if "instance_id" in entry else {}  # of MMTracking
    flags = {name: int(value) for name, value in (known | entry).items() if isinstance(value, bool)}
    return known | entry | flags


def without_noise(value: float) -> float:
    """Drop the rounding error of a sum or difference of coordinates: 50.25 - 10.1 becomes 40.15."""
    return round(value, 9)


def _image_entry(key: FrameKey, shape: tuple[int, ...] | None) -> dict[str, Any]:
    """Describe a frame as a COCO image, whose id depends on nothing else, so that files agree about it.

    The id is the frame's number plus 1; for a file name 52 bits of its hash, which every JSON reader holds.
    """
    if isinstance(key, str):
        image: dict[str, Any] = {
            "id": int(hashlib.sha256(key.encode()).hexdigest()[:13], 16),
            "file_name": key,
        }
    else:
        image = {"id": key + 1, "file_name": f"{key:06d}", "frame": key}
    return image if shape is None else image | {"height": int(shape[0]), "width": int(shape[1])}


class Truth(NamedTuple):
    """A ground truth whose ids are written."""

    images: Mapping[FrameKey, Mapping[str, Any]]
    categories: Mapping[str, Any]  # id of each class of vehicles


def read_truth(labels: TrackTable, truth: Path, *, results: bool) -> Truth:
    """Images of the frames of a ground truth and, for `results`, its categories of vehicles."""
    file = _read_file(truth)
    images = dict(zip(file.images.values(), file.entries))
    keys = labels["frame"].tolist() if results else labels.frame_keys
    unknown = next((key for key in keys if key not in images), None)
    if unknown is not None:
        such = f", which has images such as {next(iter(images))!r}" if images else ""
        raise InvalidInputError(
            f"labels hold frame {unknown!r}, which is not an image of {truth.name}{such}; "
            "use the same names (labels.renamed), or drop these boxes"
        )
    if not results:
        return Truth(images, {})
    vehicles, names = _vehicle_categories(file, truth, None), {*map(class_name, labels["label"])}
    categories = {name: number for number, name in file.categories.items()}
    if len(vehicles) == 1:  # of every class that the truth does not name
        categories = dict.fromkeys(names, *vehicles) | categories
    missing = min(names - categories.keys(), default=None)
    if missing is not None:
        listed = ", ".join(map(repr, categories)) or "none"
        raise InvalidInputError(
            f"truth must have one category of vehicles, or those of the boxes, which include {missing!r}, "
            f"got {listed}; without its classes: write_labels(TrackTable.from_pandas(read_labels(truth)"
            ".to_pandas().drop(columns='label')), 'vehicles.json', truth=truth), and pass that file"
        )
    return Truth(images, categories)


def _result(record: Record, category: Any, truth: Truth | None) -> Record:
    """COCO result: box, score and, if known, track, distance, speed and confidence of one detection."""
    image = _image_entry(record["frame"], None) if truth is None else truth.images[record["frame"]]
    x1, y1, x2, y2 = (record[name] for name in CORNERS)
    result: Record = {"image_id": image["id"], "category_id": category}
    result["bbox"] = [x1, y1, without_noise(x2 - x1), without_noise(y2 - y1)]
    known = {name: record.get(name) for name in ("score", "track_id", *_VALUES)}
    known |= {"track_id": None} if known["track_id"] == NO_TRACK else {}
    return result | {name: value for name, value in known.items() if value is not None}


@contextlib.contextmanager
def open_coco(part: Path, shape: tuple[int, ...] | None, truth: Truth | None) -> Iterator[Write]:
    """Write a data set: every frame is an image, every row an annotation. Images come last.

    Ignored rows are crowds, because pycocotools overwrites ``ignore`` with ``iscrowd``.
    """
    frames: set[FrameKey] = set()
    count, numbers = 0, ClassNumbers()

    def write(frame: FrameKey, records: Sequence[Record]) -> None:
        nonlocal count
        frames.add(frame)
        for record in records:
            count += 1
            result = _result(record, numbers(record)[0] + 1, truth)
            ignore = record.get("ignore", False)
            width, height = result["bbox"][2:]
            flags = {"area": round(width * height, 2), "iscrowd": int(ignore)}
            flags |= {"ignore": 1} if ignore else {}
            # An explicit null: readers number labels that name no track.
            text = json.dumps({"id": count, "track_id": None} | result | flags, ensure_ascii=False)
            file.write((", " if count > 1 else "") + text)

    with part.open("w", encoding="utf-8", newline="") as file:
        file.write('{"annotations": [')
        yield write
        ordered = sorted(frames, key=lambda key: (isinstance(key, str), key))
        images = [_image_entry(key, shape) for key in ordered] if truth is None else [*truth.images.values()]
        categories = [
            {"id": number, "name": name, "supercategory": "vehicle"}
            for number, name in enumerate(numbers.names, 1)
            if name in (numbers.used or numbers.names)
        ]
        rest = json.dumps({"images": images, "categories": categories}, ensure_ascii=False)
        file.write(f"], {rest[1:]}")


@contextlib.contextmanager
def open_coco_results(part: Path, truth: Truth) -> Iterator[Write]:
    """Write the list of results that ``COCO.loadRes`` of pycocotools takes."""
    results: list[Record] = []
    yield lambda _, records: results.extend(
        _result(record, truth.categories[class_name(record.get("label"))], truth) for record in records
    )
    part.write_text(json.dumps(results, ensure_ascii=False), encoding="utf-8", newline="\n")


_TRACKS_ALONE = "tracks without confidences; write those too (save_conf=True of Ultralytics)"


def read_yolo(source: Path, classes: Collection[str] | None, shape: Any, images: FrameSet | None) -> FileRows:
    """Read a text file for each frame; the names of the classes are beside their folder, or unknown."""
    if shape is None and images is None:
        remedy = "pass it, or the folder of the images as images= or --images"
        raise invalid("shape", "be (height, width) of the frames for YOLO", None, remedy)
    inner = [each for each in (source / "labels", *source.glob("obj_*_data")) if each.is_dir()]  # or of CVAT
    if len(inner) > 1:
        raise DatasetError(f"{source} holds {inner[0].name} and {inner[1].name}; name one of them")
    folder = inner[0] if inner else source
    files = label_files(folder)
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
    """Name and shape of the image of each file."""
    # macOS decomposes the letters of names, such as that of "ä" into "a" and an accent.
    names = {unicodedata.normalize("NFC", without_suffix(name)): name for name in images.names}
    frames: list[tuple[FrameKey, tuple[int, ...]]] = []
    for file in files:
        image = names.get(unicodedata.normalize("NFC", file.stem))
        if image is None:
            raise DatasetError(f"{file} has no image in {images.folder}; pass the folder of its image")
        frames.append((image, _image_shape(images.folder / image)))
    return frames


def _image_shape(image: Path) -> tuple[int, ...]:
    """Height and width of an image file; the header has them, unless EXIF data may rotate it."""
    data = read_regular_file(image, f"image file {image}", Limit.IMAGE_BYTES, error=DatasetError)
    size = None if b"exif" in data.lower() else image_size(data)
    return read_image(image).shape[:2] if size is None else size[::-1]


def _yolo_record(where: str, words: list[str], shape: tuple[int, ...]) -> tuple[str, Record]:
    """Class and record of a line: class, center, size and, for predictions, confidence and track."""
    if not 5 <= len(words) <= 7:
        outline = "; export boxes, not outlines or rotated boxes" if len(words) > 8 else ""
        expected = "class, center and size, and perhaps confidence and track"
        raise DatasetError(f"{where}: expected {expected}, found {len(words)} values{outline}")
    x, y, width, height = (parse_number(word, "side of the box", where) for word in words[1:5])
    if min(width, height) < 0 or not all(-0.1 <= side <= 1.1 for side in (x, y, width, height)):
        reason = "lies outside the image; center and size are fractions of the image in YOLO"
        raise DatasetError(f"{where}: the box {' '.join(words[1:5])} {reason}")
    x, width, y, height = x * shape[1], width * shape[1], y * shape[0], height * shape[0]
    corners = np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])
    record: Record = dict(zip(CORNERS, clip_boxes(corners, shape)[0].tolist()))
    if len(words) > 5:
        confidence = parse_number(words[5], "confidence", where)
        if not 0 <= confidence <= 1:
            got = f"got {describe(words[5])}; it may be one of {_TRACKS_ALONE}"
            raise DatasetError(f"{where}: confidence must be from 0 to 1, {got}")
        record["score"] = confidence_score(confidence)
        record["track_id"] = parse_number(words[6], "track", where) if len(words) > 6 else None
    if not FRAME_NUMBER.fullmatch(words[0]):
        raise DatasetError(f"{where}: class must be a whole number, got {describe(words[0])}")
    return words[0].partition(".")[0], record


def _yolo_names(source: Path) -> dict[str, str]:
    """Lower-case name of each class number, from a YAML file or a list of names; empty if unknown."""
    place = source.resolve()
    for folder in (place, *place.parents[:2]):
        for described in ("data.yaml", "dataset.yaml"):  # the latter of FiftyOne
            if (folder / described).is_file():
                return _yaml_names(folder / described)
        for listed in ("classes.txt", "obj.names"):
            if (folder / listed).is_file():
                lines = read_text(folder / listed).splitlines()
                return {str(number): name.strip().lower() for number, name in enumerate(lines)}
    return {}


def _yaml_names(file: Path) -> dict[str, str]:
    """Value of ``names``: a list, or a mapping from numbers."""
    try:
        data = parse_yaml(read_text(file))
    except ValueError as error:
        raise DatasetError(f"{file} is not YAML text: {error}") from None
    names = data.get("names") if isinstance(data, dict) else None
    if not names or not isinstance(names, (list, dict)):
        raise DatasetError(f"{file} names no class; write them as names: [car, bus]")
    listed = enumerate(names) if isinstance(names, list) else names.items()
    return {str(number): " ".join(str(name).lower().split()) for number, name in listed}
