"""Write results to files: CSV, JSON Lines, Parquet, MOTChallenge text and COCO JSON.

Every table has the columns ``frame,track_id,x1,y1,x2,y2,score``. Tables of tracks go on with
``distance_m,speed_mps,confidence,distance_std_m,speed_std_mps``, tables of boxes with ``confidence``.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from vehicle_detection._common import (
    atomic_write,
    check_choice,
    check_number,
    check_target,
    describe,
    write_parquet,
)
from vehicle_detection.errors import InvalidInputError

BOX_COLUMNS = ("frame", "track_id", "x1", "y1", "x2", "y2", "score")
"""Columns that every row has."""
STILL_COLUMNS = (*BOX_COLUMNS, "confidence")
TRACK_COLUMNS = (*BOX_COLUMNS, "distance_m", "speed_mps", "confidence", "distance_std_m", "speed_std_mps")

DIGITS = dict(zip(TRACK_COLUMNS[2:], (2, 2, 2, 2, 4, 2, 2, 4, 2, 2)))
"""Decimals of each column."""


class Row(NamedTuple):
    """One box of one frame. Without a score it is a label, which may be marked `ignore`."""

    frame: int | str
    track_id: int | None
    x1: float
    y1: float
    x2: float
    y2: float
    score: float | None
    distance_m: float | None = None
    speed_mps: float | None = None
    confidence: float | None = None
    distance_std_m: float | None = None
    speed_std_mps: float | None = None
    ignore: bool = False
    visible: float = 1.0


def check_items(items: object) -> Iterator[Any]:
    """Iterate over results or rows; a pandas table gives its rows as mappings."""
    if hasattr(items, "to_dict") and hasattr(items, "columns"):
        return iter(items.to_dict("records"))
    scalar = isinstance(items, (str, bytes, Mapping)) or getattr(items, "ndim", 1) == 0
    if scalar or not isinstance(items, Iterable):
        raise InvalidInputError(
            f"results must be a list of results or rows, got {describe(items)}; wrap it in a list"
        )
    return iter(items)


def is_result(item: Any) -> bool:
    """Whether `item` is a frame's result rather than a row (a tuple has an ``index`` method, too)."""
    return hasattr(item, "tracks") and hasattr(item, "index") and not isinstance(item, (Mapping, Sequence))


def shown_tracks(result: Any) -> list[Any]:
    """Tracks of a frame's result that are drawn and written."""
    return [track for track in result.tracks if getattr(track, "shown", True)]


def track_rows(result: Any, number: int = 0) -> list[Row]:
    """Rows of a frame's result, one per shown track; `number` is that of the first one in error messages."""
    optional = TRACK_COLUMNS[len(BOX_COLUMNS) :]
    rows = (
        (result.index, track.id, *track.box, track.score, *(getattr(track, name, None) for name in optional))
        for track in shown_tracks(result)
    )
    return [_check_row(row, number + place) for place, row in enumerate(rows)]


def _rows_of(item: Any, number: int) -> list[Row]:
    """Rows of a frame's result; a row stays one row."""
    return track_rows(item, number) if is_result(item) else [_check_row(item, number)]


def _check_row(item: Any, number: int, *, stills: bool = False) -> Row:
    """Check and round one row; `number` counts rows from 0 for the error message."""
    columns = STILL_COLUMNS if stills else TRACK_COLUMNS
    values: list[Any] = []
    if isinstance(item, Mapping):
        missing = [name for name in BOX_COLUMNS if name not in item and not (stills and name == "track_id")]
        if missing:
            raise InvalidInputError(
                f"row {number} lacks {', '.join(missing)}; its names must be {', '.join(columns)}"
            )
        values = [item.get(name) for name in columns]
    elif isinstance(item, (Sequence, np.ndarray)) and not isinstance(item, (str, bytes)):
        values = list(item)
    if not len(BOX_COLUMNS) <= len(values) <= len(columns):
        raise InvalidInputError(
            f"row {number} must be a FrameResult or the values {', '.join(columns)}, got {describe(item)}"
        )
    optional = ("track_id",) * stills + columns[len(BOX_COLUMNS) :]
    checked: dict[str, Any] = {
        name: None if name in optional and _is_missing(value) else _check_value(value, number, name, stills)
        for name, value in zip(columns, values)
    }
    row = Row(**checked)
    if row.x2 < row.x1 or row.y2 < row.y1:
        raise InvalidInputError(
            f"row {number} must have x1 <= x2 and y1 <= y2, got {list(row[2:6])}; "
            "boxes given as x, y, width, height need x + width and y + height"
        )
    return row


def _is_missing(value: Any) -> bool:
    """Whether a value is None, NaN or pandas.NA."""
    if isinstance(value, (float, np.floating)):
        return math.isnan(value)
    return value is None or str(value) == "<NA>"


def _check_value(value: Any, number: int, name: str, stills: bool) -> Any:
    """Check and round one value of a row."""
    where = f"row {number}: {name}"
    if name == "frame" and stills:
        if not isinstance(value, (str, os.PathLike)):
            raise InvalidInputError(
                f"{where} must be the image's file name, got {describe(value)}; "
                "write the frames of a video with write_tracks"
            )
        return os.fspath(value)
    positive = name in ("frame", "confidence", "distance_std_m", "speed_std_mps")
    high = 1.0 if name == "confidence" else math.inf
    checked = check_number(value, where, low=0 if positive else -math.inf, high=high)
    if name in DIGITS:
        return round(checked, DIGITS[name]) + 0.0  # + 0.0 turns -0.0 into 0.0
    # A pandas column with missing values holds whole numbers as floats.
    if not checked.is_integer():
        raise InvalidInputError(f"{where} must be a whole number, got {describe(value)}; drop the row")
    return int(value)


FORMATS = {
    ".csv": "csv",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".txt": "mot",
    ".json": "coco",
}
"""Format of each file name suffix."""


def write_tracks(
    results: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002 - the name that pandas and Pillow use
    shape: tuple[int, ...] | None = None,
) -> int:
    """Write the tracks of a video to a file; the file appears only when it is complete.

    Parameters
    ----------
    results
        One :class:`FrameResult` for each frame, of which the shown tracks are written; or rows, each a
        mapping or a sequence of ``frame, track_id, x1, y1, x2, y2, score[, distance_m, speed_mps,
        confidence, distance_std_m, speed_std_mps]``; or a pandas table of such rows.
    path, format
        File to write, and its format: ``"csv"``, ``"jsonl"`` (one JSON object per line), ``"parquet"`` (needs
        pyarrow), ``"mot"`` (MOTChallenge text) or ``"coco"`` (JSON). None chooses by the suffix: .csv,
        .jsonl, .ndjson, .parquet, .txt or .json.
    shape
        ``(height, width, ...)`` of a frame, which COCO viewers need.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    InvalidInputError
        If a row is malformed, the format unknown, or the folder missing or read-only.

    Notes
    -----
    ``frame`` counts from 0, the first processed frame; boxes are half-open pixels with two decimals.
    Unknown values are empty in CSV and null elsewhere. The score is the log-odds above the threshold, the
    confidence a calibrated probability; speeds are relative to the camera.

    MOT files count frames and pixels from 1, as the MOTChallenge tools do, and hold width and height. A COCO
    file is a data set whose image ids are the frame numbers plus 1, whichever frames have tracks; for
    ``COCO.loadRes`` of pycocotools, write ``FrameBoxes.from_results(results)`` with `write_labels`.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "tracks.csv"
    >>> write_tracks([(0, 1, 10, 20, 50.128, 60, 1.5), (1, 1, 12, 20, 52, 60, 1.25, 31.4, -0.5)], file)
    2
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps
    0,1,10.00,20.00,50.13,60.00,1.5000,,,,,
    1,1,12.00,20.00,52.00,60.00,1.2500,31.40,-0.50,,,
    """
    kind = check_format(path, format, FORMATS.values())
    if kind in ("csv", "jsonl", "mot"):
        with TrackWriter(path, format=kind) as write:
            for item in check_items(results):
                write(item)
        return write.rows
    rows: list[Row] = []
    frames: list[int | str] = []  # a COCO file also lists the frames without a vehicle
    for item in check_items(results):
        frames += [int(item.index)] if is_result(item) else []
        rows += _rows_of(item, len(rows))
    return _write_rows(rows, frames, path, kind, TRACK_COLUMNS, shape)


def write_boxes(
    boxes: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
) -> int:
    """Write the boxes found in images to a file; the file appears only when it is complete.

    Parameters
    ----------
    boxes
        Pairs of an image's file name and its :class:`Detections`; or rows, each a mapping or a sequence of
        ``frame, track_id, x1, y1, x2, y2, score[, confidence]`` with the file name as ``frame``, and None as
        ``track_id`` unless the boxes are numbered.
    path, format
        As in `write_tracks`, without ``"mot"``. The image ids of a COCO file depend on the file names alone;
        `write_labels` writes boxes with the ids of a ground truth.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    InvalidInputError
        If a row is malformed, the format unknown, or the folder missing or read-only.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection.boxes import Detections
    >>> file = Path(tempfile.mkdtemp()) / "boxes.csv"
    >>> write_boxes([("road.jpg", Detections([[10, 20, 50, 60]], [1.5], [0.82]))], file)
    1
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,confidence
    road.jpg,,10.00,20.00,50.00,60.00,1.5000,0.8200
    """
    kind = check_format(path, format, ("csv", "jsonl", "parquet", "coco"))
    names: list[int | str] = []
    rows: list[Row] = []
    for item in check_items(boxes):
        if isinstance(item, Sequence) and len(item) == 2 and hasattr(item[1], "scores"):
            name, found = item
            names.append(str(name))
            rows += [
                _check_row((str(name), None, *box, score, confidence), len(rows), stills=True)
                for box, score, confidence in zip(found.boxes, found.scores, _confidences(found))
            ]
        else:
            rows.append(_check_row(item, len(rows), stills=True))
    return _write_rows(rows, names, path, kind, STILL_COLUMNS)


def _confidences(found: Any) -> Sequence[float | None]:
    """Confidence of each detection, None where unknown."""
    known = getattr(found, "confidences", None)
    return [None] * len(found.scores) if known is None else known


class TrackWriter:
    """Write the tracks of a video while it is processed, in constant memory.

    The file appears when the ``with`` block ends without an error; otherwise an existing file is kept.

    Parameters
    ----------
    path, format
        As in `write_tracks`; only ``"csv"``, ``"jsonl"`` and ``"mot"``.

    Attributes
    ----------
    rows
        Number of rows written so far.

    Raises
    ------
    InvalidInputError
        If the format is another one, or the folder is missing or read-only.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "tracks.jsonl"
    >>> with TrackWriter(file) as write:  # then: process_video(..., on_result=write)
    ...     write((0, 1, 10, 20, 50, 60, 1.5))
    >>> print(file.read_text().rstrip())
    {"frame": 0, "track_id": 1, "x1": 10.0, "y1": 20.0, "x2": 50.0, "y2": 60.0, "score": 1.5, \
"distance_m": null, "speed_mps": null, "confidence": null, "distance_std_m": null, "speed_std_mps": null}
    """

    def __init__(self, path: str | os.PathLike[str], *, format: str | None = None) -> None:  # noqa: A002
        self._kind = check_format(path, format, ("csv", "jsonl", "mot"))
        self._path = path
        self._stack = contextlib.ExitStack()
        self._write_row: Callable[[Row], object] | None = None
        self.rows = 0

    def __enter__(self) -> TrackWriter:
        with contextlib.ExitStack() as stack:
            part = stack.enter_context(atomic_write(self._path, "path"))
            file = stack.enter_context(part.open("w", encoding="utf-8", newline=""))
            self._write_row = _row_writer(file, self._kind, TRACK_COLUMNS)
            self._stack = stack.pop_all()
        self.rows = 0
        return self

    def __call__(self, result: Any) -> None:
        """Write the shown tracks of one frame's result, or one row."""
        if self._write_row is None:
            raise InvalidInputError(
                "TrackWriter must be called inside its with block; use with TrackWriter(path) as write: ..."
            )
        for row in _rows_of(result, self.rows):
            self._write_row(row)
            self.rows += 1

    def __exit__(self, *error: Any) -> None:
        self._write_row = None
        self._stack.__exit__(*error)


def check_format(path: object, name: str | None, allowed: Iterable[str]) -> str:
    """Choose the format by its name or the suffix, and check the target before any work is done."""
    if not isinstance(path, (str, os.PathLike)):
        raise InvalidInputError(
            f"path must be a file name, got {describe(path)}; pass a name such as 'tracks.csv'"
        )
    choices = tuple(dict.fromkeys(allowed))
    kind = FORMATS.get(Path(path).suffix.lower()) if name is None else name
    if name is None and kind not in choices:
        suffixes = [suffix for suffix, meant in FORMATS.items() if meant in choices]
        raise InvalidInputError(
            f"path must end in {', '.join(suffixes)}, got {Path(path).name!r}; "
            f"or set the format to {', '.join(map(repr, choices))}"
        )
    check_choice(kind, "format", choices)
    check_target(path, "path")
    return str(kind)


def _row_writer(file: IO[str], kind: str, columns: Sequence[str]) -> Callable[[Row], object]:
    """Write the header, and return the function that writes one row as text."""
    if kind == "csv":
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        return lambda row: table.writerow(_csv_cells(row, columns))
    if kind == "jsonl":
        return lambda row: file.write(json.dumps(_values(row, columns), ensure_ascii=False) + "\n")
    return lambda row: file.write(mot_line(row) + "\n")


def _values(row: Row, columns: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(row, name) for name in columns}


def _csv_cells(row: Row, columns: Sequence[str]) -> list[Any]:
    numbers = ((getattr(row, name), DIGITS[name]) for name in columns[2:])
    return [*row[:2], *("" if value is None else f"{value:.{digits}f}" for value, digits in numbers)]


def mot_line(row: Row) -> str:
    """MOTChallenge text of a row, whose frames and pixels count from 1: a result, or without score a label.

    Both start with frame, id, left, top, width and height. A result goes on with its score and no world
    position, a label with its flag (0 if ignored), the class 3 (car) and its visible fraction.
    """
    numbers = row.x1 + 1, row.y1 + 1, row.x2 - row.x1, row.y2 - row.y1
    box = ",".join(str(_without_noise(number)) for number in numbers)
    end = f"{int(not row.ignore)},3,{row.visible}" if row.score is None else f"{row.score},-1,-1,-1"
    return f"{int(row.frame) + 1},{-1 if row.track_id is None else row.track_id},{box},{end}"


def _without_noise(value: float) -> float:
    """Drop the rounding error of a sum or difference of coordinates: 50.25 - 10.1 becomes 40.15."""
    return round(value, 9)


def _write_rows(
    rows: Sequence[Row],
    frames: Sequence[int | str],
    path: str | os.PathLike[str],
    kind: str,
    columns: Sequence[str],
    shape: tuple[int, ...] | None = None,
) -> int:
    """Write all rows at once, in any format; return their number."""
    if kind == "parquet":
        frame = "string" if columns == STILL_COLUMNS else "int64"
        types = {"frame": frame, "track_id": "int64"} | dict.fromkeys(columns[2:], "double")
        write_parquet(path, {name: [getattr(row, name) for row in rows] for name in columns}, types=types)
        return len(rows)
    with atomic_write(path, "path") as part, part.open("w", encoding="utf-8", newline="") as file:
        if kind == "coco":
            images = coco_images([*frames, *(row.frame for row in rows)], shape)
            json.dump(coco_document(rows, images), file, ensure_ascii=False)
        else:
            write_row = _row_writer(file, kind, columns)
            for row in rows:
                write_row(row)
    return len(rows)


CocoImages = Mapping[int | str, Mapping[str, Any]]
"""Entry of each frame in the list of images of a COCO file."""


def coco_images(frames: Iterable[int | str], shape: tuple[int, ...] | None) -> CocoImages:
    """Describe frames as COCO images. Their ids depend on nothing else, so that files agree about them."""
    keys = sorted(set(frames), key=lambda key: (isinstance(key, str), key))
    size = {} if shape is None else {"height": int(shape[0]), "width": int(shape[1])}
    return {key: {"id": _image_id(key), **_image_name(key), **size} for key in keys}


def _image_id(key: int | str) -> int:
    """Frame number plus 1; for a file name 52 bits of its hash, which every JSON reader holds exactly."""
    if isinstance(key, str):
        return int(hashlib.sha256(key.encode()).hexdigest()[:13], 16)
    return key + 1


def _image_name(key: int | str) -> dict[str, Any]:
    """Name of an image; a video frame has no file, so that its number serves as the file name."""
    return {"file_name": key} if isinstance(key, str) else {"file_name": f"{key:06d}", "frame": key}


def coco_result(row: Row, image_id: int, category_id: int) -> dict[str, Any]:
    """COCO result: box, score and, if known, track, distance, speed and confidence of one detection."""
    optional = {"track_id": row.track_id} | {name: getattr(row, name) for name in TRACK_COLUMNS[7:]}
    return {
        "image_id": image_id,
        "category_id": category_id,
        "bbox": [row.x1, row.y1, _without_noise(row.x2 - row.x1), _without_noise(row.y2 - row.y1)],
        **({} if row.score is None else {"score": row.score}),
        **{name: value for name, value in optional.items() if value is not None},
    }


def coco_document(rows: Iterable[Row], images: CocoImages) -> dict[str, Any]:
    """COCO data set: every frame is an image, every row an annotation, with its score if it has one.

    Ignored rows are crowds, because pycocotools overwrites ``ignore`` with ``iscrowd``.
    """
    annotations = []
    for number, row in enumerate(rows, start=1):
        result = coco_result(row, images[row.frame]["id"], 1)
        width, height = result["bbox"][2:]
        flags = {"area": round(width * height, 2), "iscrowd": int(row.ignore)}
        flags |= {"ignore": 1} if row.ignore else {}
        # An explicit null: readers number labels that name no track.
        annotations.append({"id": number, "track_id": None} | result | flags)
    return {
        "images": list(images.values()),
        "annotations": annotations,
        "categories": [{"id": 1, "name": "vehicle", "supercategory": "vehicle"}],
    }
