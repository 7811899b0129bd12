"""Read label and prediction files: CSV, JSON Lines, Parquet, KITTI, MOTChallenge, COCO and YOLO."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import (
    Limit,
    check_choice,
    check_path,
    check_regular_file,
    check_sequence,
    check_shape,
    describe,
    read_regular_file,
    shorten,
)
from vehicle_detection.boxes import clip_boxes, logit
from vehicle_detection.datasets import FrameSet, load_frames
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation.frame_boxes import (
    LOOKALIKE_CLASSES,
    NO_TRACK,
    VEHICLE_CLASSES,
    FrameBoxes,
    FrameKey,
    class_name,
    frame_order,
    known_classes,
    none_if_unknown,
    without_suffix,
)
from vehicle_detection.export import BOX_COLUMNS, FOLDER_FORMATS, FORMATS
from vehicle_detection.images import image_size, read_image

REQUIRED_LABEL_COLUMNS = ("frame", "track", "x1", "y1", "x2", "y2")
LABEL_COLUMNS = (*REQUIRED_LABEL_COLUMNS, "occluded", "truncated", "ignore")

FRAME_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.0*)?")
"""Frame of a CSV file that is a number. One with leading zeros is a file name."""

PERSON_CLASSES = ("pedestrian", "person_sitting", "cyclist")

# The project's labels do not score vehicles that are largely hidden, truncated by more, or narrower (px).
_HIDDEN, _MAX_TRUNCATED, _MIN_WIDTH = 2, 0.7, 40.0

# Confidences of 0 and 1 have infinite log-odds.
_MIN_CONFIDENCE = 1e-6


# YAML. Quotes open at the start of a value only, as in names: ['car [big]', driver's car]
_YAML_QUOTED = r"""(?:(?<![^\s,\[{:-])(?:"[^"]*"|'[^']*'))"""
_YAML_COMMENT = re.compile(rf"({_YAML_QUOTED})|(?:^|(?<=\s))#.*", re.MULTILINE)
_YAML_FLOW = re.compile(rf"\s*[\[{{]((?:{_YAML_QUOTED}|[^\]}}])*)[\]}}]")
_YAML_PART = re.compile(rf"(?:{_YAML_QUOTED}|[^,])+")
_YAML_ITEM = re.compile(
    r"""\s*(?:-\s+|["']?(?P<number>\d+)["']?\s*:\s*)?"""
    r"""(?:"(?P<double>[^"]*)"|'(?P<single>[^']*)'|(?P<plain>\S.*?)?)\s*"""
)

_READ_FORMATS = (*dict.fromkeys(FORMATS.values()), "coco_results", *FOLDER_FORMATS)


class Row(NamedTuple):
    """One box as read from a file."""

    where: str  # file and line, for error messages
    frame: FrameKey
    track: int
    box: tuple[float, float, float, float]
    occluded: int = 0
    truncated: float = 0.0
    ignore: bool = False
    score: float = math.nan  # of predictions; NaN for labels
    distance_m: float = math.nan
    speed_mps: float = math.nan


Rows = tuple[list[Row], list[FrameKey]]
"""The rows of a file, and the frames that it lists, which may have no row."""


def _read_text(file: Path) -> str:
    try:
        return read_regular_file(file, str(file), Limit.TEXT_BYTES, error=DatasetError).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{file} is not UTF-8 text; save it as UTF-8") from None


def _read_lines(file: Path, text: str | None = None) -> Iterator[tuple[str, str]]:
    """Yield the lines of a file, or of a text in it, that are not blank, after their places for messages."""
    for number, line in enumerate((_read_text(file) if text is None else text).splitlines(), 1):
        if line.strip(", \t"):
            yield f"{file} line {number}", line.strip()


def _split_words(line: str) -> list[str]:
    """Split a line at commas and white space."""
    return re.split(r"\s*,\s*|\s+", line.strip())


def _number(text: str, name: str, where: str, *, low: float = -math.inf, high: float = math.inf) -> float:
    """Parse a finite number in ``[low, high]``."""
    try:
        value = math.nan if "_" in text else float(text)  # Python reads 1_0 as 10
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        hint = "; use a decimal point" if re.fullmatch(r"\s*-?\d+,\d+\s*", text) else ""
        raise DatasetError(f"{where}: {name} must be a finite number, got {describe(text)}{hint}")
    if not low <= value <= high:
        bound = f"at least {low:g}" if value < low else f"at most {high:g}"
        raise DatasetError(f"{where}: {name} must be {bound}, got {describe(text)}")
    return value


def _integer(text: str, name: str, where: str, *, low: int) -> int:
    value = _number(text, name, where, low=low, high=2.0**53)
    if value != int(value):
        raise DatasetError(f"{where}: {name} must be a whole number, got {describe(text)}")
    return int(value)


def _read_csv(source: Path, classes: Collection[str] | None) -> Rows:
    text = _read_text(source)
    separator = max(",;\t", key=text.split("\n", 1)[0].count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [(reader.line_num, line) for line in reader]
    except csv.Error as error:
        raise DatasetError(f"{source} line {reader.line_num}: not CSV text ({error})") from None
    names = [" ".join(name.split()).lower() for name in lines[0][1]] if lines else []
    known = (*BOX_COLUMNS, *LABEL_COLUMNS)
    twice = sorted({name for name in known if names.count(name) > 1})
    if twice:
        raise DatasetError(f"{source} has the column {', '.join(twice)} more than once; keep one of each")
    records: list[tuple[str, dict[str, str]]] = []
    for number, line in lines[1:]:
        where = f"{source} line {number}"
        if not any(cell.strip() for cell in line):
            continue
        if len(line) != len(names):
            raise DatasetError(f"{where}: expected {len(names)} columns, found {len(line)}")
        records.append((where, dict(zip(names, (cell.strip() for cell in line)))))
    predicted = _check_columns(source, names, [record for _, record in records])
    counted = all(FRAME_NUMBER.fullmatch(record["frame"]) for _, record in records)
    return _table_rows(source, records, classes, predicted=predicted, counted=counted)


def _read_json_lines(source: Path, classes: Collection[str] | None) -> Rows:
    records: list[tuple[str, Any]] = []
    # Not splitlines, which also splits at other characters that a name may hold.
    for number, line in enumerate(_read_text(source).split("\n"), 1):
        where = f"{source} line {number}"
        if line.strip():
            try:
                records.append((where, json.loads(line)))
            except (ValueError, RecursionError) as error:
                raise DatasetError(f"{where}: not a JSON object ({_json_reason(error)})") from None
            if not isinstance(records[-1][1], dict):
                raise DatasetError(f"{where}: expected a JSON object, found {line.strip()[:40]!r}")
    return _typed_rows(source, records, classes)


def _json_reason(error: ValueError | RecursionError) -> str:
    """Say why a text cannot be parsed; Python refuses integers of thousands of digits."""
    if isinstance(error, RecursionError):
        return "nested too deeply"
    return error.msg if isinstance(error, json.JSONDecodeError) else "a number has too many digits"


def _read_parquet(source: Path, classes: Collection[str] | None) -> Rows:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InvalidInputError(
            "a .parquet file needs pyarrow; pip install pyarrow, or convert it to .csv"
        ) from None
    check_regular_file(source, str(source), Limit.TEXT_BYTES, error=DatasetError)
    try:
        table = pyarrow.parquet.read_table(source)
    except (pyarrow.ArrowException, OSError) as error:
        raise DatasetError(f"{source} is not a Parquet file: {' '.join(str(error).split())}") from None
    rows = [(f"{source} row {number}", record) for number, record in enumerate(table.to_pylist())]
    if not rows:
        _check_columns(source, table.column_names, [])
    return _typed_rows(source, rows, classes)


def _typed_rows(
    source: Path, records: Sequence[tuple[str, Mapping[str, Any]]], classes: Collection[str] | None
) -> Rows:
    """Rows of a table with types: frames are numbers or names as they are stored there."""
    texts = [
        (where, {name: "" if value is None else str(value) for name, value in record.items()})
        for where, record in records
    ]
    predicted = bool(texts) and _check_columns(source, list(texts[0][1]), [record for _, record in texts])
    frames = [record.get("frame") for _, record in records]
    named = {isinstance(frame, str) for frame in frames}
    if len(named) > 1:
        raise DatasetError(f"{source}: frame must be a number in every row, or a name in every row")
    return _table_rows(source, texts, classes, predicted=predicted, counted=named == {False})


def _table_rows(
    source: Path,
    records: Sequence[tuple[str, dict[str, str]]],
    classes: Collection[str] | None,
    *,
    predicted: bool,
    counted: bool,
) -> Rows:
    """Rows of vehicles of a table, and all its frames; without a column of classes all rows are vehicles."""
    names = [class_name(record) for _, record in records]
    wanted = VEHICLE_CLASSES if classes is None else classes
    found = known_classes(names)
    if found:
        _check_classes(source, found, wanted)
    rows, keys = [], []
    for (where, record), name in zip(records, names, strict=True):
        row = _table_row(where, record, predicted, counted)
        keys.append(row.frame)
        if not found or name in wanted:
            rows.append(row)
        elif name in LOOKALIKE_CLASSES and not predicted:
            rows.append(row._replace(ignore=True))
    return rows, keys


def _check_columns(source: Path, names: Sequence[str], records: Sequence[Mapping[str, str]]) -> bool:
    """Check that all columns are there; return whether the rows are predictions, which have scores."""
    scored = any(record.get("score", "").lower() not in ("", "nan") for record in records)
    tracked = not {"track", "track_id"}.isdisjoint(names)
    predicted = "score" in names and (scored or not tracked)
    expected = BOX_COLUMNS if predicted else REQUIRED_LABEL_COLUMNS
    given = {*names, "track", "track_id"} if tracked else {*names}
    missing = [name for name in expected if name not in given]
    if missing:
        found = shorten(", ".join(names), 300) or "an empty file"
        raise DatasetError(
            f"{source} lacks the columns {', '.join(missing)}; found {found}; labels have "
            f"{','.join(REQUIRED_LABEL_COLUMNS)} and, optionally, "
            f"{','.join(LABEL_COLUMNS[len(REQUIRED_LABEL_COLUMNS) :])}; predictions {','.join(BOX_COLUMNS)}"
        )
    return predicted


def _table_row(where: str, record: dict[str, str], predicted: bool, counted: bool) -> Row:
    """Row of a table; `record` holds the text of each cell by the name of its column."""

    def text(name: str, default: str = "") -> str:
        return record.get(name, default) or (default if predicted else "")

    if not text("frame"):
        raise DatasetError(f"{where}: frame is empty; enter its number from 0 or its file name")
    frame: FrameKey = _integer(text("frame"), "frame", where, low=0) if counted else text("frame")
    x1, y1, x2, y2 = (_number(text(name), name, where) for name in ("x1", "y1", "x2", "y2"))
    name = "track_id" if "track_id" in record else "track"
    track = _integer(text(name, str(NO_TRACK) if predicted else ""), name, where, low=NO_TRACK)
    # These columns may be missing, but cells of labels may not be empty.
    occluded = _integer(text("occluded", "0"), "occluded", where, low=0)
    truncated = _number(text("truncated", "0"), "truncated", where, low=0, high=1)
    ignored = text("ignore", "0")
    flag = {"0": False, "1": True, "false": False, "true": True}.get(ignored.lower())
    if flag is None:
        raise DatasetError(f"{where}: ignore must be 0 or 1, got {describe(ignored)}")
    optional: dict[str, Any] = {
        name: _number(text(name), name, where)
        for name in ("distance_m", "speed_mps")
        if text(name).lower() not in ("", "nan")
    }
    if predicted:
        optional["score"] = _number(text("score"), "score", where)
    return Row(where, frame, track, (x1, y1, x2, y2), occluded, truncated, flag, **optional)


def _read_kitti(source: Path, classes: Collection[str] | None) -> Rows:
    files = list(source.glob("*.txt")) if source.is_dir() else [source]
    if not files:
        raise _no_text_files(source, "a KITTI label_2 folder or a label file")
    rows: list[Row] = []
    for file in sorted(files, key=lambda file: frame_order(file.name)):
        for where, line in _read_lines(file):
            row = _kitti_row(where, file.stem, len(rows), line.split(), classes)
            rows += [row] if row else []
    return rows, [file.stem for file in files]


def _no_text_files(folder: Path, expected: str) -> DatasetError:
    """Error of a folder without text files, which names a subfolder that has some, such as labels/train."""
    inside = min((file.parent for file in folder.glob("*/*.txt")), default=None)
    remedy = f"name {expected}" if inside is None else f"its subfolders are read one at a time: name {inside}"
    return DatasetError(f"{folder} holds no .txt file; {remedy}")


def _kitti_row(
    where: str, frame: str, number: int, words: list[str], classes: Collection[str] | None
) -> Row | None:
    """One KITTI object; None for a person. `number` marks an ignored vehicle, which has no track either."""
    if len(words) not in (15, 16):
        raise DatasetError(f"{where}: a KITTI object has 15 values (16 with a score), found {len(words)}")
    name = words[0].lower()
    x1, y1, x2, y2 = (_number(word, "corner of the box", where) for word in words[4:8])
    score = _number(words[15], "score", where) if len(words) == 16 else math.nan
    if name == "dontcare":
        return Row(where, frame, NO_TRACK, (x1, y1, x2, y2), ignore=True, score=score)
    wanted = name in (VEHICLE_CLASSES if classes is None else classes)
    if not wanted and name in PERSON_CLASSES:
        return None
    # Results hold -1 for unknown values; an occlusion of 3 is KITTI's "unknown".
    truncated = min(max(_number(words[1], "truncated", where), 0.0), 1.0)
    occluded = min(max(int(_number(words[2], "occluded", where)), 0), _HIDDEN)
    unscored = occluded >= _HIDDEN or truncated > _MAX_TRUNCATED or x2 - x1 < _MIN_WIDTH
    ignore = not wanted or (unscored and math.isnan(score))
    track = number if ignore else NO_TRACK  # an ignored box without a track would be a region
    return Row(where, frame, track, (x1, y1, x2, y2), occluded, truncated, ignore, score)


def _read_mot(source: Path, classes: Collection[str] | None) -> Rows:
    rows = list(_mot_rows(_read_lines(source)))
    if classes is not None and rows:
        found = {number for _, number in rows if number is not None}
        if not found:
            raise DatasetError(f"{source} holds predictions, which have no classes; leave out classes=")
        _check_classes(source, found, classes)
    return [row for row, number in rows if classes is None or number in classes], []


def _check_classes(
    source: Path, found: Collection[str], wanted: Collection[str], kind: str = "class"
) -> None:
    """Refuse a file in which no class is that of vehicles: it would have no box."""
    if not any(name in wanted for name in found):
        listed = shorten(", ".join(map(repr, sorted(found))), 300) or "none"
        raise DatasetError(
            f"{source} has no {kind} among {', '.join(sorted(wanted))}; found {listed}; "
            "name those of vehicles with classes="
        )


def _mot_rows(lines: Iterable[tuple[str, str]], *, first_pixel: int = 1) -> Iterator[tuple[Row, str | None]]:
    """Yield each row of MOTChallenge text with its class number; predictions have none."""
    for where, line in lines:
        words = _split_words(line.rstrip(","))
        if len(words) < 6:
            raise DatasetError(f"{where}: expected frame, id, x, y, width, height, found {len(words)} values")
        frame = _integer(words[0], "frame (counted from 1)", where, low=1) - 1
        track = _integer(words[1], "id", where, low=NO_TRACK)
        x, y, width, height = (_number(word, "side of the box", where) for word in words[2:6])
        x, y = x - first_pixel, y - first_pixel
        box = (x, y, x + width, y + height)
        # Ground truth has nine columns, the last ones flag, class, visibility. Results have class -1 or ten.
        if len(words) == 9 and words[7] != "-1":
            yield Row(where, frame, track, box, ignore=_number(words[6], "flag", where) == 0), words[7]
        else:
            score = _number(words[6], "score", where) if len(words) > 6 else math.nan
            yield Row(where, frame, track, box, score=score), None


def _read_mot_zip(source: Path, classes: Collection[str] | None) -> Rows:
    """Read an archive of CVAT: MOTChallenge text whose pixels count from 0, and the names of the classes."""
    text, names = _read_members(source, "gt/gt.txt", "gt/labels.txt")
    if text is None:
        raise DatasetError(f"{source} is not an archive of CVAT: it lacks gt/gt.txt; export MOT 1.1 there")
    wanted = VEHICLE_CLASSES if classes is None else classes
    labels = None if names is None else [name.strip().lower() for name in names.splitlines() if name.strip()]
    if labels:
        _check_classes(source, labels, wanted)
    rows = []
    for row, number in _mot_rows(_read_lines(source, text), first_pixel=0):
        if labels is not None and number is not None:
            index = _integer(number, "class", row.where, low=1)
            if index > len(labels):
                raise DatasetError(
                    f"{row.where}: class must be at most {len(labels)}, as in gt/labels.txt, got {index}"
                )
            if labels[index - 1] not in wanted:
                continue
        rows.append(row)
    return rows, []


def _read_members(source: Path, *names: str) -> list[str | None]:
    """Read text files of an archive; None for each that it lacks."""
    check_regular_file(source, str(source), Limit.TEXT_BYTES, error=DatasetError)
    try:
        with zipfile.ZipFile(source) as archive:
            known = {info.filename: info for info in archive.infolist()}
            texts: list[str | None] = []
            for name in names:
                if name in known and known[name].file_size > Limit.TEXT_BYTES.current():
                    raise DatasetError(
                        f"{source}: {name} is larger than {Limit.TEXT_BYTES.current():,} bytes; if it is "
                        f"meant to be so large, set {Limit.TEXT_BYTES.variable}"
                    )
                texts.append(archive.read(name).decode("utf-8-sig") if name in known else None)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError, OSError) as error:
        raise DatasetError(f"{source} is not a zip archive that can be read ({error})") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{source} does not hold UTF-8 text; save it as UTF-8") from None
    return texts


def _read_yolo(
    source: Path,
    classes: Collection[str] | None,
    shape: tuple[int, ...] | None,
    images: FrameSet | None,
) -> Rows:
    """Read a text file for each frame; the names of the classes are beside their folder, or unknown."""
    if shape is None and images is None:
        raise InvalidInputError(
            "shape must be (height, width) of the frames for YOLO, got None; pass it, or the folder of "
            "the images as images= or --images"
        )
    folder = source / "labels" if (source / "labels").is_dir() else source
    files = [file for file in folder.glob("*.txt") if file.name != "classes.txt"]
    without_frames = folder != source and not any(folder.iterdir())
    if not files and not without_frames:
        raise _no_text_files(folder, "a folder of YOLO labels")
    names = _yolo_names(source)
    wanted = VEHICLE_CLASSES if classes is None else classes
    if names:
        _check_classes(source, names.values(), wanted)
    files.sort(key=lambda file: frame_order(file.name))
    frames = _yolo_frames(files, shape) if images is None else _yolo_images(files, images)
    rows: list[Row] = []
    numbers: set[str] = set()
    for file, (key, size) in zip(files, frames, strict=True):
        for where, line in _read_lines(file):
            name, row = _yolo_row(where, key, line.split(), size)
            # Without names, classes are numbers, and by default all of them are vehicles.
            numbers.add(name)
            if (not names and classes is None) or names.get(name, name) in wanted:
                rows.append(row)
    if not names and classes is not None and numbers:
        _check_classes(source, numbers, wanted)
    return rows, [key for key, _ in frames]


def _yolo_frames(files: Sequence[Path], shape: Any) -> list[tuple[FrameKey, tuple[int, ...]]]:
    """Frame and shape of each file, all of one shape: numbers if all names have six digits."""
    shape = check_shape(shape)
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


def _yolo_row(where: str, frame: FrameKey, words: list[str], shape: tuple[int, ...]) -> tuple[str, Row]:
    """Class and row of a line: class, center, size and, for predictions, confidence and track."""
    if not 5 <= len(words) <= 7:
        raise DatasetError(
            f"{where}: expected class, center and size, and perhaps confidence and track, found {len(words)} "
            "values"
        )
    x, y, width, height = (_number(word, "side of the box", where) for word in words[1:5])
    if len(words) == 5 and not (abs(x - 0.5) < (1 + width) / 2 and abs(y - 0.5) < (1 + height) / 2):
        raise DatasetError(
            f"{where}: the box {' '.join(words[1:5])} lies outside the image; center and size are fractions "
            "of the image in YOLO"
        )
    x, width, y, height = x * shape[1], width * shape[1], y * shape[0], height * shape[0]
    score = math.nan
    if len(words) > 5:
        confidence = _number(words[5], "confidence", where, low=0, high=1)
        confidence = min(max(confidence, _MIN_CONFIDENCE), 1 - _MIN_CONFIDENCE)
        score = logit(confidence)
    track = _integer(words[6], "track", where, low=NO_TRACK) if len(words) > 6 else NO_TRACK
    corners = np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])
    x1, y1, x2, y2 = clip_boxes(corners, shape)[0].tolist()
    name = words[0].partition(".")[0] if FRAME_NUMBER.fullmatch(words[0]) else words[0]
    return name, Row(where, frame, track, (x1, y1, x2, y2), score=score)


def _yolo_names(source: Path) -> dict[str, str]:
    """Lower-case name of each class number, from ``data.yaml`` or ``classes.txt``; empty if unknown."""
    place = source.resolve()
    for folder in (place, *place.parents[:2]):
        if (folder / "data.yaml").is_file():
            names = _yaml_names(_read_text(folder / "data.yaml"))
            if not names:
                raise DatasetError(f"{folder / 'data.yaml'} names no class; write them as names: [car, bus]")
            return names
        if (folder / "classes.txt").is_file():
            lines = _read_text(folder / "classes.txt").splitlines()
            return {str(number): name.strip().lower() for number, name in enumerate(lines)}
    return {}


def _yaml_names(text: str) -> dict[str, str]:
    """Value of ``names``, a list or a mapping from numbers, as a block or in brackets."""
    text = _YAML_COMMENT.sub(lambda found: found[1] or "", text)
    before = r"[{,]" if text.lstrip().startswith("{") else "^"
    key = re.search(rf"""{before}\s*["']?names["']?[ \t]*:""", text, re.MULTILINE)
    value = text[key.end() :] if key else ""
    flow = _YAML_FLOW.match(value)
    if flow:
        items = [item for item in _YAML_PART.findall(flow[1]) if item.strip()]
    else:
        items = list(takewhile(_is_block_line, value.splitlines()[1:]))
    names: dict[str, str] = {}
    for item in items:
        entry = _YAML_ITEM.fullmatch(item)
        if entry and any(entry.groups()):
            number = entry["number"] or str(len(names))
            names[number] = (entry["double"] or entry["single"] or entry["plain"] or "").lower()
    return names


def _is_block_line(line: str) -> bool:
    """Whether a line may be that of an indented block, or of a list."""
    return not line.strip() or (line[0] in " \t-" and not line.startswith("---"))


class CocoFile(NamedTuple):
    """A COCO data set, or a list of results, whose images and categories are those of another file."""

    images: dict[Any, FrameKey]  # frame of each image id, in the order of the file
    entries: list[dict[str, Any]]  # of the images
    categories: dict[Any, str]  # lower-case name of each category id
    annotations: list[Any]


def read_coco_file(source: Path, truth: Path | None = None) -> CocoFile:
    """Read a COCO file; `truth` names the data set that a list of results belongs to."""
    try:
        data = json.loads(_read_text(source))
    except (ValueError, RecursionError) as error:
        line = f" line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise DatasetError(f"{source}{line}: not JSON text ({_json_reason(error)})") from None
    if isinstance(data, list) and all(isinstance(entry, dict) and "image_id" in entry for entry in data):
        if truth is None:
            raise DatasetError(
                f"{source} is a list of COCO results, predictions of images that the ground truth lists; "
                "read it with truth=, and use the ground truth, a COCO data set, as labels"
            )
        return read_coco_file(truth)._replace(annotations=data)
    parts = data if isinstance(data, dict) else {}
    needed = ("images", "annotations", "categories")
    missing = [name for name in needed if not isinstance(parts.get(name), list)]
    if missing:
        raise DatasetError(f"{source} is not a COCO file: it lacks the lists {', '.join(missing)}")
    try:
        images = {image["id"]: _coco_frame(image) for image in data["images"]}
        names = {entry["id"]: str(entry["name"]).lower() for entry in data["categories"]}
    except (KeyError, TypeError, AttributeError):
        raise DatasetError(
            f"{source}: every image and category needs an id, and every category a name"
        ) from None
    if {*map(type, images.values())} not in (set(), {int}, {str}):
        raise DatasetError(f"{source}: give every image a file_name, or none of them and integer ids")
    if len(set(images.values())) < len(data["images"]):
        raise DatasetError(f"{source}: two images share an id or a file_name; make them unique")
    return CocoFile(images, data["images"], names, data["annotations"])


def _coco_frame(image: dict[str, Any]) -> FrameKey:
    """Frame of an image: its file name; the frame's number where `write_labels` put it into the name."""
    name, frame = image.get("file_name", image["id"]), image.get("frame")
    return frame if isinstance(frame, int) and name == f"{frame:06d}" else name


def vehicle_categories(file: CocoFile, source: Path, classes: Collection[str] | None) -> set[Any]:
    """Ids of the categories that are vehicles; raise if there are annotations but no such category."""
    wanted = VEHICLE_CLASSES if classes is None else classes
    found = {number for number, name in file.categories.items() if name in wanted}
    if file.annotations:
        _check_classes(source, file.categories.values(), wanted, "category")
    return found


def _read_coco(source: Path, classes: Collection[str] | None, truth: Path | None) -> Rows:
    file = read_coco_file(source, truth)
    vehicles = vehicle_categories(file, source, classes)
    rows: list[Row] = []
    for number, entry in enumerate(file.annotations):
        where = f"{source} annotation {number}"
        try:
            x, y, width, height = (_number(str(side), "bbox", where) for side in entry["bbox"])
            category = entry["category_id"]
            frame, name = file.images[entry["image_id"]], file.categories[category]
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{where}: expected bbox [x, y, width, height] and the image_id and category_id of an image "
                f"and a category in the file ({error})"
            ) from None
        if category not in vehicles and name not in LOOKALIKE_CLASSES:
            continue
        score = math.nan if entry.get("score") is None else _number(str(entry["score"]), "score", where)
        ignore = bool(entry.get("iscrowd") or entry.get("ignore") or category not in vehicles)
        # An ignored box without a track would be a region.
        track = entry.get("track_id", number if ignore and math.isnan(score) else NO_TRACK)
        # A crowd is a region, except for the ignored vehicles of write_labels, which marks them twice.
        if track is None or (entry.get("iscrowd") and not (entry.get("ignore") and "track_id" in entry)):
            track = NO_TRACK
        track = _integer(str(track), "track_id", where, low=NO_TRACK)
        box = (x, y, x + width, y + height)
        optional: dict[str, Any] = {
            name: _number(str(entry[name]), name, where)
            for name in ("distance_m", "speed_mps")
            if entry.get(name) is not None
        }
        rows.append(Row(where, frame, track, box, ignore=ignore, score=score, **optional))
    return rows, list(file.images.values())


def read_labels(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    classes: Collection[str] | None = None,
    shape: tuple[int, ...] | None = None,
    truth: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
) -> FrameBoxes:
    """Read labelled or predicted boxes from a file or folder; `write_labels` writes them.

    Parameters
    ----------
    path
        A CSV file (``frame,track,x1,y1,x2,y2[,occluded,truncated,ignore]``, where ``track_id`` may stand for
        ``track``, or, for predictions, ``frame,track_id,x1,y1,x2,y2,score[,distance_m,speed_mps]``; separated
        by commas, semicolons or tabs; with a column ``class``, ``label`` or ``category`` of names, rows of
        other classes than vehicles are left out),
        a JSON Lines or Parquet (needs pyarrow) file with these columns, a KITTI ``label_2`` folder, a
        MOTChallenge text file, the MOT archive of CVAT, a COCO JSON file, a list of COCO results, or a YOLO
        folder: ``labels/*.txt``, with class names in ``data.yaml`` or ``classes.txt``.
    format
        ``"csv"``, ``"jsonl"``, ``"parquet"``, ``"kitti"``, ``"mot"``, ``"mot_zip"``, ``"coco"``,
        ``"coco_results"`` or ``"yolo"``; None chooses by suffix and content.
    classes
        KITTI types, COCO category names, class names of CVAT and YOLO, or class numbers of MOT files and of
        YOLO folders without names, that are vehicles, in upper or lower case. None takes car, van, truck, bus
        and vehicle, and every row of files with numbers.
    shape
        ``(height, width, ...)`` of the frames, to which boxes are clipped. None does not clip them. YOLO
        needs it, or `images`.
    truth
        The COCO data set whose image and category ids a list of COCO results has; not read otherwise.
    images
        The folder of the images of a YOLO folder, which may differ in size, instead of `shape`; not used
        otherwise.

    Returns
    -------
    FrameBoxes
        CSV frames are int if all of them are whole numbers, else str. KITTI frames are the files' names
        without ``.txt``, COCO frames the images' ``file_name``. Frames and pixels of MOT files count from 1
        and are returned from 0. YOLO frames are the files' names without ``.txt``, or numbers if all have six
        digits, or with `images` the images' file names; a confidence becomes its log-odds.

    Raises
    ------
    DatasetError
        If the file is missing, has none of these formats, names no class of vehicles, or holds an invalid
        row; the message names the line.
    InvalidInputError
        If `path`, `format` or `shape` is none of the values above, or pyarrow is missing.

    Notes
    -----
    KITTI's ``DontCare`` and COCO's crowds become regions; trams, trailers and the like become ignored boxes,
    as do KITTI's vehicles that are largely hidden, truncated by more than 0.7 or narrower than 40 px, the
    same rule as in the project's labels. Persons and all other classes are left out. A MOT file with nine
    columns is ground truth, whose rows with flag 0 are ignored; in others column seven is the score.

    Examples
    --------
    >>> read_labels("labels/missing.csv")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: labels/missing.csv does not exist; check the path
    """
    source = check_path(path, "path", kind="a file or folder")
    pictures = None
    if images is not None:
        pictures = load_frames(check_path(images, "images", kind="the folder of the images"))
    if format is not None:
        check_choice(format, "format", _READ_FORMATS)
    if not source.exists():
        raise DatasetError(f"{source} does not exist; check the path")
    kind = format or _guess_format(source)
    if source.is_dir() and kind not in FOLDER_FORMATS:
        raise DatasetError(
            f"{source} is a folder, and {kind} labels are one file; pass the path of that file"
        )
    chosen = None
    if classes is not None:
        chosen = frozenset(str(name).lower() for name in check_sequence(classes, "classes", "names"))
    if kind in ("csv", "jsonl", "parquet"):
        tables = {"csv": _read_csv, "jsonl": _read_json_lines, "parquet": _read_parquet}
        found = tables[kind](source, chosen)
    elif kind in ("coco", "coco_results"):  # told apart by their content
        found = _read_coco(source, chosen, None if truth is None else check_path(truth, "truth"))
    elif kind == "yolo":
        found, shape = _read_yolo(source, chosen, shape, pictures), None  # its boxes are clipped
    else:
        found = {"kitti": _read_kitti, "mot": _read_mot, "mot_zip": _read_mot_zip}[kind](source, chosen)
    return _assemble(*found, shape)


def _assemble(rows: list[Row], keys: list[FrameKey], shape: tuple[int, ...] | None) -> FrameBoxes:
    """Check the rows of any format, and return them as columns."""
    boxes = np.array([row.box for row in rows], np.float64)
    scored = [not math.isnan(row.score) for row in rows]
    first: dict[tuple[FrameKey, int], str] = {}
    for row, has_score in zip(rows, scored):
        x1, y1, x2, y2 = row.box
        if not all(map(math.isfinite, row.box)):
            raise DatasetError(f"{row.where}: a box needs finite corners, got {list(row.box)}")
        # A prediction clipped at the border may have no area; a label without area is a mistake.
        if x2 < x1 or y2 < y1 or (not has_score and (x2 == x1 or y2 == y1)):
            raise DatasetError(f"{row.where}: a box needs x1 < x2 and y1 < y2, got {list(row.box)}")
        if row.track != NO_TRACK:
            before = first.setdefault((row.frame, row.track), row.where)
            if before != row.where:
                raise DatasetError(
                    f"{row.where}: track {row.track} comes twice in frame {describe(row.frame)}, "
                    f"first at {before}"
                )
        if has_score != scored[0]:
            raise DatasetError(f"{row.where}: some boxes have a score and some have none; give all or none")
    if shape is not None:
        boxes = clip_boxes(boxes, shape)
        for row, box, has_score in zip(rows, boxes.tolist(), scored):
            if not has_score and (box[0] == box[2] or box[1] == box[3]):
                raise DatasetError(
                    f"{row.where}: box {list(row.box)} lies outside the {shape[1]}x{shape[0]} image; "
                    "check that shape is (height, width) of these frames"
                )
    columns = {name: np.array([getattr(row, name) for row in rows]) for name in Row._fields[4:]}
    return FrameBoxes(
        [row.frame for row in rows],
        np.array([row.track for row in rows], np.int64),
        boxes,
        occluded=columns["occluded"],
        truncated=columns["truncated"],
        ignore=columns["ignore"],
        scores=none_if_unknown(columns["score"]),
        distance_m=none_if_unknown(columns["distance_m"]),
        speed_mps=none_if_unknown(columns["speed_mps"]),
        frame_keys=keys,
    )


def _guess_format(source: Path) -> str:
    """Choose the format by the suffix or else by the first line."""
    if source.is_dir():
        named = ("labels", "data.yaml", "classes.txt")
        if any((source / name).exists() for name in named):
            return "yolo"
        lines = (line for file in source.glob("*.txt") for _, line in _read_lines(file))
        return "yolo" if 5 <= len(next(lines, "").split()) <= 7 else "kitti"
    suffix = source.suffix.lower()
    if suffix == ".tsv" or (suffix in FORMATS and suffix != ".txt"):
        return FORMATS.get(suffix, "csv")
    start = _read_text(source).lstrip()[:4096]
    words = _split_words(start.splitlines()[0]) if start else []
    if start.startswith(("{", "[")):
        return "coco"
    if not words or re.fullmatch(r"[0-9]+(\.0*)?", words[0]):
        return "mot"
    return "kitti" if len(words) >= 15 and "frame" not in words else "csv"
