"""Read labels and predictions: CSV, JSON Lines, Parquet, KITTI, MOTChallenge, CVAT, COCO and YOLO.

A reader turns a file into columns of cells, with the place of each row for messages.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import os
import re
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vehicle_detection._common import (
    Limit,
    check,
    check_regular_file,
    describe,
    import_pyarrow,
    parse_number,
    shorten,
)
from vehicle_detection.boxes import VEHICLE_CLASSES, clip_boxes
from vehicle_detection.datasets.coco_yolo import json_reason, read_coco, read_yolo
from vehicle_detection.datasets.frames import load_frames
from vehicle_detection.datasets.rows import (
    FRAME_NUMBER,
    FileRows,
    Record,
    label_files,
    no_text_files,
    read_lines,
    read_text,
    rows_of_records,
    warn_of_numbers,
)
from vehicle_detection.errors import DatasetError
from vehicle_detection.tables import (
    BOX_COLUMNS,
    CORNERS,
    LABEL_COLUMNS,
    NO_TRACK,
    FrameKey,
    TrackTable,
    check_classes,
    frame_order,
    parse_cells,
)
from vehicle_detection.tracking import UNKNOWN_LABEL

FORMATS = {
    ".csv": "csv", ".jsonl": "jsonl", ".ndjson": "jsonl", ".parquet": "parquet", ".txt": "mot",
    ".json": "coco", ".zip": "mot_zip",
}  # fmt: skip
"""Format of each file name suffix."""
FOLDER_FORMATS = ("kitti", "yolo")
"""Formats that are folders, which are named instead of chosen by a suffix."""

PERSON_CLASSES = ("pedestrian", "person_sitting", "cyclist")

_LOGGER = logging.getLogger(__name__)

_LABELS = ("frame", "track", *CORNERS)
# The project's labels do not score vehicles that are largely hidden, truncated by more, or narrower (px).
_HIDDEN, _MAX_TRUNCATED, _MIN_WIDTH = 2, 0.7, 40.0


def _split_words(line: str) -> list[str]:
    """Split a line at commas and white space."""
    return re.split(r"\s*,\s*|\s+", line.strip())


def _read_csv(source: Path, classes: Collection[str] | None) -> FileRows:
    text = read_text(source)
    separator = max(",;\t", key=text.split("\n", 1)[0].count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    try:
        lines = [(reader.line_num, line) for line in reader]
    except csv.Error as error:
        raise DatasetError(f"{source} line {reader.line_num}: not CSV text ({error})") from None
    names = [" ".join(name.split()).lower() for name in lines[0][1]] if lines else []
    twice = sorted({name for name in (*BOX_COLUMNS, *_LABELS, *LABEL_COLUMNS) if names.count(name) > 1})
    if twice:
        raise DatasetError(f"{source} has the column {', '.join(twice)} more than once; keep one of each")
    # Before the lines: those of a table without a header may differ in length.
    _check_columns(source, FileRows([], {name: [] for name in names}))
    lines = [(number, line) for number, line in lines[1:] if any(cell.strip() for cell in line)]
    for number, line in lines:
        if len(line) != len(names):
            raise DatasetError(f"{source} line {number}: expected {len(names)} columns, found {len(line)}")
    cells: dict[str, list[Any]] = {
        name: [line[column].strip() for _, line in lines] for column, name in enumerate(names)
    }
    if "frame" in cells:  # without the mark that keeps a spreadsheet from calculating
        cells["frame"] = [re.sub(r"^'(?=[=+@-])", "", frame) for frame in cells["frame"]]
    if all(map(FRAME_NUMBER.fullmatch, cells.get("frame", ["no number"]))):
        cells["frame"] = [int(frame.partition(".")[0]) for frame in cells["frame"]]
    return _check_columns(source, FileRows([f"{source} line {number}" for number, _ in lines], cells))


def _check_columns(source: Path, found: FileRows) -> FileRows:
    """Check that a table has the columns of labels, or those of predictions."""
    scores = found.cells.get("score")
    scored = scores is not None and not all(str(cell).lower() in ("", "nan", "none") for cell in scores)
    tracked = not found.cells.keys().isdisjoint(("track", "track_id"))
    expected = BOX_COLUMNS if scored or (scores is not None and not tracked) else _LABELS
    missing = [name for name in expected if name not in found.cells and not (tracked and "track" in name)]
    if missing:
        listed = shorten(", ".join(found.cells), 300) or "an empty file"
        raise DatasetError(
            f"{source} lacks the columns {', '.join(missing)}; found {listed}; labels have "
            f"{','.join(_LABELS)} and, optionally, {','.join(LABEL_COLUMNS)}; predictions "
            f"{','.join(BOX_COLUMNS)}"
        )
    return found


def _read_json_lines(source: Path, classes: Collection[str] | None) -> FileRows:
    rows: list[tuple[str, Record]] = []
    # Not splitlines, which also splits at other characters that a name may hold.
    for number, line in enumerate(read_text(source).split("\n"), 1):
        where = f"{source} line {number}"
        if line.strip():
            try:
                rows.append((where, json.loads(line)))
            except (ValueError, RecursionError) as error:
                raise DatasetError(f"{where}: not a JSON object ({json_reason(error)})") from None
            if not isinstance(rows[-1][1], dict):
                raise DatasetError(f"{where}: expected a JSON object, found {line.strip()[:40]!r}")
    return _check_columns(source, rows_of_records(rows)) if rows else rows_of_records(rows)


def _read_parquet(source: Path, classes: Collection[str] | None) -> FileRows:
    pyarrow = import_pyarrow()
    check_regular_file(source, str(source), Limit.TEXT_BYTES, error=DatasetError)
    try:
        table = pyarrow.parquet.read_table(source)
    except (pyarrow.ArrowException, OSError) as error:
        raise DatasetError(f"{source} is not a Parquet file: {' '.join(str(error).split())}") from None
    places = [f"{source} row {number}" for number in range(table.num_rows)]
    return _check_columns(source, FileRows(places, table.to_pydict()))


def _read_kitti(source: Path, classes: Collection[str] | None) -> FileRows:
    files = label_files(source) if source.is_dir() else [source]
    if not files:
        raise no_text_files(source, "a KITTI label_2 folder or a label file")
    rows: list[tuple[str, Record]] = []
    for file in sorted(files, key=lambda file: frame_order(file.name)):
        for where, line in read_lines(file):
            words = line.split()
            place: Record = {"frame": file.stem}
            tracked = len(words) in (17, 18) and words[0].isdecimal()  # labels of KITTI's tracking
            if tracked and len(files) > 1:
                raise DatasetError(f"{source} holds tracks of several drives; name one of its files")
            if tracked:
                place = {"frame": int(words[0]), "track_id": parse_number(words[1], "track", where)}
            record = _kitti_record(where, words[2:] if tracked else words, classes)
            if record is not None:
                # `ignore` with NO_TRACK means a region, so an ignored vehicle gets a track number of its own.
                track = len(rows) if record["ignore"] and "occluded" in record else NO_TRACK
                rows.append((where, {"track_id": track, **place, **record}))
    tracks = any(isinstance(record["frame"], int) for _, record in rows)
    return rows_of_records(rows, () if tracks else [file.stem for file in files])


def _kitti_record(where: str, words: list[str], classes: Collection[str] | None) -> Record | None:
    """One KITTI object; None for a person. One without `occluded` is a region."""
    if len(words) not in (15, 16):
        expected = "15 values (16 with a score; 2 more before them with tracks)"
        raise DatasetError(f"{where}: a KITTI object has {expected}, found {len(words)}")
    name = words[0].lower()
    corners = [parse_number(word, "corner of the box", where) for word in words[4:8]]
    score = words[15] if len(words) == 16 else None
    record = {**dict(zip(CORNERS, corners)), "score": score, "ignore": True}
    if name == "dontcare":
        return record
    wanted = name in (VEHICLE_CLASSES if classes is None else classes)
    if not wanted and name in PERSON_CLASSES:
        return None
    # Results hold -1 for unknown values; an occlusion of 3 is KITTI's "unknown".
    truncated = min(max(parse_number(words[1], "truncated", where), 0.0), 1.0)
    occluded = min(max(int(parse_number(words[2], "occluded", where)), 0), _HIDDEN)
    unscored = occluded >= _HIDDEN or truncated > _MAX_TRUNCATED or corners[2] - corners[0] < _MIN_WIDTH
    ignore = not wanted or (unscored and score is None)
    return record | {"occluded": occluded, "truncated": truncated, "ignore": ignore, "label": name}


def _read_mot(source: Path, classes: Collection[str] | None) -> FileRows:
    names = source.parent / "labels.txt"
    if source.name == "gt.txt" and names.is_file():  # an unpacked archive of CVAT
        return _read_cvat(source, read_text(source), read_text(names), classes)
    rows = list(_mot_rows(read_lines(source)))
    found = {number for *_, number in rows if number is not None}
    if classes is None:
        warn_of_numbers(source, found, "pass the numbers of vehicles as classes=")
    elif rows:
        if not found:
            raise DatasetError(f"{source} holds predictions, which have no classes; leave out classes=")
        check_classes(source, found, classes)
    return rows_of_records(
        (where, record) for where, record, number in rows if classes is None or number in classes
    )


def _mot_rows(
    lines: Iterable[tuple[str, str]], *, first_pixel: int = 1
) -> Iterator[tuple[str, Record, str | None]]:
    """Yield each row of MOTChallenge text with its class number, None if it has none."""
    rows = [(where, _split_words(line.rstrip(","))) for where, line in lines]
    labelled = all(_is_mot_label(words) for _, words in rows)
    for where, words in rows:
        if len(words) != len(rows[0][1]):  # it may be cut off, and then labels would look like results
            raise DatasetError(f"{where}: expected {len(rows[0][1])} values, as before, found {len(words)}")
        if len(words) < 6:
            raise DatasetError(f"{where}: expected frame, id, x, y, width, height, found {len(words)} values")
        frame = parse_number(words[0], "frame (counted from 1)", where)
        if frame < 1 or frame != int(frame):
            raise DatasetError(f"{where}: frame (counted from 1) must be at least 1, got {frame:g}")
        x, y, width, height = (parse_number(word, "side of the box", where) for word in words[2:6])
        track, *values = (parse_number(word, "value", where) for word in (words[1], *words[6:]))
        x, y = x - first_pixel, y - first_pixel
        record: Record = {"frame": int(frame) - 1, "track_id": track}
        record |= zip(CORNERS, (x, y, x + width, y + height))
        if labelled:
            record |= {"ignore": values[0] == 0, "occluded": values[3] if len(values) == 4 else 0}
        else:
            record["score"] = values[0] if values else None
        has_class = (labelled or len(words) in (8, 9)) and values[1] != -1
        yield where, record, f"{values[1]:g}" if has_class else None


def _is_mot_label(words: list[str]) -> bool:
    """Whether the last of nine or ten columns are those of ground truth: flag, class and visibility.

    VisDrone has truncation (0, 1) and occlusion (0 to 2) instead of the latter. Trackers such as BoxMOT also
    write nine: confidence, class and -1.
    """
    try:
        flag, number, *rest = map(float, words[6:])
    except ValueError:  # fewer columns, or text
        return False
    if len(rest) == 2:
        return flag in (0, 1) and number >= 0 and rest[0] in (0, 1) and rest[1] in (0, 1, 2)
    return flag in (0, 1) and number >= 0 and len(rest) == 1 and 0 <= rest[0] <= 1


def _read_mot_zip(source: Path, classes: Collection[str] | None) -> FileRows:
    """Read an archive of CVAT."""
    text, names = _read_members(source, "gt/gt.txt", "gt/labels.txt")
    if text is None:
        remedy = "export MOT 1.1 there, or unpack an archive of another format"
        raise DatasetError(f"{source} is not an archive of CVAT: it lacks gt/gt.txt; {remedy}")
    return _read_cvat(source, text, names, classes)


def _read_cvat(source: Path, text: str, names: str | None, classes: Collection[str] | None) -> FileRows:
    """Read CVAT's MOTChallenge text, whose pixels count from 0, with the names of the classes."""
    wanted = VEHICLE_CLASSES if classes is None else classes
    labels = [name.strip().lower() for name in (names or "").splitlines() if name.strip()]
    if labels:
        check_classes(source, labels, wanted)
    rows = []
    for where, record, number in _mot_rows(read_lines(source, text), first_pixel=0):
        if labels and number is not None:
            index = parse_number(number, "class", where)
            if index not in range(1, len(labels) + 1):
                expected = f"a whole number from 1 to {len(labels)}, as in gt/labels.txt"
                raise DatasetError(f"{where}: class must be {expected}, got {number}")
            record["label"] = labels[int(index) - 1]
            if record["label"] not in wanted:
                continue
        rows.append((where, record))
    return rows_of_records(rows)


def _read_members(source: Path, *names: str) -> list[str | None]:
    """Read text files of an archive; None for each that it lacks."""
    check_regular_file(source, str(source), Limit.TEXT_BYTES, error=DatasetError)
    try:
        with zipfile.ZipFile(source) as archive:
            known = {info.filename: info for info in archive.infolist()}
            for name in names:
                if name in known and known[name].file_size > Limit.TEXT_BYTES.current():
                    raise DatasetError(Limit.TEXT_BYTES.exceeded(f"{source}: {name}"))
            return [archive.read(name).decode("utf-8-sig") if name in known else None for name in names]
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError, OSError) as error:
        raise DatasetError(f"{source} is not a zip archive that can be read ({error})") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{source} does not hold UTF-8 text; save it as UTF-8") from None


# All have the same arguments; tables are filtered by class in `parse_cells`. The readers of COCO and YOLO
# take more, and `read_labels` calls them.
_READERS = {
    "csv": _read_csv,
    "jsonl": _read_json_lines,
    "parquet": _read_parquet,
    "kitti": _read_kitti,
    "mot": _read_mot,
    "mot_zip": _read_mot_zip,
}
_READ_FORMATS = (*dict.fromkeys(FORMATS.values()), "coco_results", *FOLDER_FORMATS)


def read_labels(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    classes: Collection[str] | None = None,
    shape: tuple[int, ...] | None = None,
    truth: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
) -> TrackTable:
    """Read labelled or predicted boxes from a file or folder; `write_labels` writes them.

    Parameters
    ----------
    path
        One of these:

        - a CSV file, separated by commas, semicolons or tabs: for labels
          ``frame,track,x1,y1,x2,y2[,occluded,truncated,ignore]``, where ``track_id`` may stand for ``track``,
          for predictions the columns of `write_tracks`; with a column ``class``, ``label`` or ``category`` of
          names, rows of other classes than vehicles are left out; a column ``confidence`` or ``conf`` stands
          for a missing ``score``, as its log-odds;
        - a JSON Lines or Parquet (needs pyarrow) file with these columns;
        - a KITTI ``label_2`` folder or one of its files, or a file of KITTI's tracking;
        - a MOTChallenge text file, or the MOT archive of CVAT;
        - a COCO JSON file, or a list of COCO results;
        - a YOLO folder: ``labels/*.txt``, with names in ``data.yaml``, ``dataset.yaml`` or ``classes.txt``,
          or an unpacked YOLO archive of CVAT.
    format
        ``"csv"``, ``"jsonl"``, ``"parquet"``, ``"kitti"``, ``"mot"``, ``"mot_zip"``, ``"coco"``,
        ``"coco_results"`` or ``"yolo"``; None chooses by suffix and content.
    classes
        KITTI types, COCO category names, class names of tables, CVAT and YOLO, or class numbers of MOT files
        and of YOLO folders without names, that are vehicles, in upper or lower case. None takes car, van,
        truck, bus and vehicle, and every row of files with numbers.
    shape
        ``(height, width, ...)`` of the frames, to which boxes are clipped. YOLO needs it, or `images`.
    truth
        The COCO data set whose image and category ids a list of COCO results has.
    images
        The folder of the images: of a YOLO folder, which may differ in size, instead of `shape`; of a COCO
        file, whose sizes are compared.

    Returns
    -------
    TrackTable
        CSV frames are int if all of them are whole numbers, else str. KITTI frames are the files' names
        without ``.txt``, COCO frames the images' ``file_name``. Frames of MOT files and of CVAT's archives
        count from 1, as do the pixels of MOT files, but not those of the archives; all are returned from 0.
        YOLO frames are the files' names without ``.txt``, or numbers if all have six digits, or with `images`
        the images' file names; a confidence becomes its log-odds. ``label`` is the class that a file names.

    Raises
    ------
    DatasetError
        If the file is missing, has none of these formats, names no class of vehicles, or holds an invalid
        row; the message names the line.

    Notes
    -----
    KITTI's ``DontCare`` and COCO's crowds become regions; trams, trailers and the like become ignored boxes,
    as do KITTI's other classes but persons, and its vehicles that are largely hidden, truncated by more than
    0.7 or narrower than 40 px, as in the project's labels. A MOT file is ground truth if all rows end with a
    flag (0: ignored), a class and a visible fraction, or truncation and occlusion as in VisDrone; in others
    column seven is the score.

    Examples
    --------
    >>> read_labels("labels/missing.csv")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: labels/missing.csv does not exist; check the path
    """
    source = check.path(path, "path", kind="a file or folder")
    pictures = None
    if images is not None:
        pictures = load_frames(check.path(images, "images", kind="the folder of the images"))
    if format is not None:
        check.choice(format, "format", _READ_FORMATS)
    if not source.is_dir():
        check_regular_file(source, str(source), Limit.TEXT_BYTES, error=DatasetError)
    kind = format or _guess_format(source)
    if source.is_dir() and kind not in FOLDER_FORMATS:
        raise DatasetError(f"{source} is a folder, and {kind} labels are one file; pass its path")
    chosen = None
    if classes is not None:
        chosen = frozenset(str(name).lower() for name in check.sequence(classes, "classes", "names"))
    if kind in ("coco", "coco_results"):  # told apart by their content
        named = None if truth is None else check.path(truth, "truth")
        found = rows_of_records(*read_coco(source, chosen, named, pictures))
    elif kind == "yolo":
        found, shape = read_yolo(source, chosen, shape, pictures), None  # its boxes are clipped
    else:
        found = _READERS[kind](source, chosen)
    return _table_of(source, kind, found, chosen, shape)


def _table_of(
    source: Path, kind: str, found: FileRows, classes: Collection[str] | None, shape: tuple[int, ...] | None
) -> TrackTable:
    """Check the rows of any format, clip their boxes to `shape`, and return them as a table."""
    # Tables are filtered by class here; other formats have been, and may have ignored boxes of other classes.
    is_table = kind in ("csv", "jsonl", "parquet")
    labels = None if is_table else found.cells.pop("label", None)
    columns, places = parse_cells(found.cells, source, found.places, classes if is_table else None)
    if labels is not None and {*labels} - {None, UNKNOWN_LABEL}:
        columns["label"] = [label or UNKNOWN_LABEL for label in labels]
    boxes, labelled = columns["boxes"], "score" not in columns
    # A prediction clipped at the border may have no area; a label without area is a mistake.
    sides = boxes[:, 2:] - boxes[:, :2]
    wrong = np.flatnonzero(((sides < 0) | (labelled & (sides == 0))).any(axis=1))
    if wrong.size:
        place, box = places[wrong[0]], boxes[wrong[0]].tolist()
        raise DatasetError(f"{place}: a box needs x1 < x2 and y1 < y2, got {box}")
    first: dict[tuple[FrameKey, int], str] = {}
    if "track_id" in columns:
        for frame, track, place in zip(columns["frame"], columns["track_id"].tolist(), places, strict=True):
            before = place if track == NO_TRACK else first.setdefault((frame, track), place)
            if before != place:
                twice = f"track {track} comes twice in frame {describe(frame)}"
                raise DatasetError(f"{place}: {twice}, first at {before}")
    if labelled:
        _warn_of_copies(source, columns, places)
    if len(boxes) and boxes.min() >= 0 and boxes.max() <= 1:
        _LOGGER.warning("%s: all boxes are within 1 pixel, as fractions of the frame are; use pixels", source)
    if shape is not None:
        columns["boxes"] = clip_boxes(boxes, shape)
        gone = np.flatnonzero((columns["boxes"][:, :2] == columns["boxes"][:, 2:]).any(axis=1))
        if gone.size and labelled:
            box, size = boxes[gone[0]].tolist(), f"{shape[1]}x{shape[0]}"
            remedy = "check that shape is (height, width) of these frames"
            raise DatasetError(f"{places[gone[0]]}: box {box} lies outside the {size} image; {remedy}")
    return TrackTable(**columns | {"frame_keys": (*columns["frame_keys"], *found.frames)})


def _warn_of_copies(source: Path, columns: dict[str, Any], places: list[str]) -> None:
    """Warn of vehicles that are labelled twice, as in merged exports: the copies would count as missed."""
    ignored = columns.get("ignore", np.zeros(len(places), np.bool_))
    seen, copies = set[tuple[Any, ...]](), list[str]()
    for frame, box, is_ignored, place in zip(columns["frame"], columns["boxes"].tolist(), ignored, places):
        if (frame, *box) in seen and not is_ignored:
            copies.append(place)
        seen.add((frame, *box))
    if copies:
        text = "%s holds copies of other boxes of their frames: %d, the first at %s; remove them"
        _LOGGER.warning(text, source, len(copies), copies[0])


def _guess_format(source: Path) -> str:
    """Choose the format by the suffix or else by the first line."""
    if source.is_dir():
        named = ("labels", "data.yaml", "classes.txt", "obj.names")
        if any((source / name).exists() for name in named):
            return "yolo"
        for suffix, tool in ((".xml", "Pascal VOC"), (".json", "a tool with a file for each image")):
            if any(source.glob(f"*{suffix}")) and not any(source.glob("*.txt")):
                reason = f"holds {suffix} files, as of {tool}, which are not read"
                raise DatasetError(f"{source} {reason}; export one COCO file")
        lines = (line for file in label_files(source) for _, line in read_lines(file))
        words = next(lines, "").split()
        outlines = len(words) > 8 and not any(word.isalpha() for word in words)  # of YOLO
        return "yolo" if 5 <= len(words) <= 7 or outlines else "kitti"
    suffix = source.suffix.lower()
    if suffix in (".yaml", ".yml"):
        raise DatasetError(f"{source} names a YOLO data set; pass its folder of labels, such as labels/train")
    if suffix == ".tsv" or (suffix in FORMATS and suffix != ".txt"):
        return FORMATS.get(suffix, "csv")
    start = read_text(source).lstrip()[:4096]
    words = _split_words(start.splitlines()[0]) if start else []
    if start.startswith(("{", "[")):
        return "coco"
    if start.startswith("<"):
        remedy = "export COCO, or from CVAT also YOLO 1.1 or MOT 1.1"
        raise DatasetError(f"{source} is XML, as of CVAT or Pascal VOC, which is not read; {remedy}")
    if len(words) in (17, 18) and words[2].isalpha():
        return "kitti"
    if not words or re.fullmatch(r"[0-9]+(\.0*|\.[0-9]+e\+[0-9]+)?", words[0]):  # also of numpy.savetxt
        return "mot"
    return "kitti" if len(words) >= 15 and "frame" not in words else "csv"
