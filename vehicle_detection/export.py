"""Results to files: CSV, JSON Lines, Parquet, MOT challenge and COCO.

Every table has the columns ``frame,track_id,x1,y1,x2,y2,score``, that of tracks has ``distance_m,speed_mps``
as well.
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from vehicle_detection._common import atomic_write, check_choice, check_target, describe
from vehicle_detection.errors import InvalidInputError

BOX_COLUMNS = ("frame", "track_id", "x1", "y1", "x2", "y2", "score")
TRACK_COLUMNS = (*BOX_COLUMNS, "distance_m", "speed_mps")

DIGITS = dict(zip(TRACK_COLUMNS[2:], (2, 2, 2, 2, 4, 2, 2)))
"""Decimals of each column."""


class Row(NamedTuple):
    """A box of one frame, as it is written."""

    frame: int | str
    track_id: int | None
    x1: float
    y1: float
    x2: float
    y2: float
    score: float
    distance_m: float | None = None
    speed_mps: float | None = None


def check_items(items: object) -> Iterator[Any]:
    """Return an iterator over results or rows; a pandas table gives its rows."""
    if hasattr(items, "to_dict") and hasattr(items, "columns"):  # a pandas table
        return iter(items.to_dict("records"))
    if isinstance(items, (str, bytes, Mapping)) or not isinstance(items, Iterable):
        raise InvalidInputError(
            f"results must be a list of results or rows, got {describe(items)}; wrap it in a list"
        )
    return iter(items)


def is_result(item: Any) -> bool:
    """Whether this is a frame's result rather than a row (a tuple has an ``index``, too)."""
    return hasattr(item, "tracks") and hasattr(item, "index") and not isinstance(item, (Mapping, Sequence))


def rows_of(item: Any, number: int) -> list[Row]:
    """Turn a frame's result into rows, one for each track that is shown; a row stays one."""
    if not is_result(item):
        return [as_row(item, number)]
    return [
        as_row(
            (item.index, track.id, *track.box, track.score, track.distance_m, track.speed_mps), number + place
        )
        for place, track in enumerate(track for track in item.tracks if getattr(track, "shown", True))
    ]


def as_row(item: Any, number: int, *, stills: bool = False) -> Row:
    """Check one row; a message counts rows from 0."""
    columns = BOX_COLUMNS if stills else TRACK_COLUMNS
    if isinstance(item, Mapping):
        missing = [name for name in BOX_COLUMNS if name not in item and not (stills and name == "track_id")]
        if missing:
            raise InvalidInputError(
                f"row {number} lacks {', '.join(missing)}; its names must be {', '.join(columns)}"
            )
        values = [item.get(name) for name in columns]
    elif isinstance(item, (Sequence, np.ndarray)) and not isinstance(item, (str, bytes)):
        values = list(item)
    else:
        values = []
    if not len(BOX_COLUMNS) <= len(values) <= len(columns):
        raise InvalidInputError(
            f"row {number} must be a FrameResult or the values {', '.join(columns)}, got {describe(item)}"
        )
    frame = _file_name(values[0], number) if stills else _whole_number(values[0], number, "frame", low=0)
    free = stills and _is_missing(values[1])
    track = None if free else _whole_number(values[1], number, "track_id")
    x1, y1, x2, y2, score = (_number(value, number, name) for name, value in zip(columns[2:], values[2:7]))
    if x2 < x1 or y2 < y1:
        raise InvalidInputError(
            f"row {number} must have x1 <= x2 and y1 <= y2, got {[x1, y1, x2, y2]}; "
            "boxes given as x, y, width, height need x + width and y + height"
        )
    extra = [
        None if _is_missing(value) else _number(value, number, name)
        for name, value in zip(columns[7:], values[7:])
    ]
    return Row(frame, track, x1, y1, x2, y2, score, *extra)


def _file_name(value: Any, number: int) -> str:
    if not isinstance(value, (str, os.PathLike)):
        raise InvalidInputError(
            f"row {number}: frame must be the image's file name, got {describe(value)}; "
            "write the frames of a video with write_tracks"
        )
    return os.fspath(value)


def _is_missing(value: Any) -> bool:
    """Whether a value is unknown: None, or what pandas makes of it."""
    if isinstance(value, (float, np.floating)):
        return math.isnan(value)
    return value is None or str(value) == "<NA>"


def _whole_number(value: Any, number: int, name: str, *, low: float = -math.inf) -> int:
    # A column of pandas that misses a value holds floats.
    whole = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not whole or not math.isfinite(value) or value != int(value) or value < low:
        expected = "a whole number" if low < 0 else f"a whole number of at least {low:g}"
        raise InvalidInputError(
            f"row {number}: {name} must be {expected}, got {describe(value)}; drop the row"
        )
    return int(value)


def _number(value: Any, number: int, name: str) -> float:
    is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value):
        raise InvalidInputError(
            f"row {number}: {name} must be a finite number, got {describe(value)}; drop the row"
        )
    return round(float(value), DIGITS[name]) + 0.0  # + 0.0: no minus zero


Format: TypeAlias = Literal["csv", "jsonl", "parquet", "mot", "coco"]
FORMATS: dict[str, Format] = {
    ".csv": "csv",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".txt": "mot",
    ".json": "coco",
}
"""The format that each suffix stands for."""


def write_tracks(
    results: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: Format | None = None,  # noqa: A002 - the word that pandas and Pillow use
    shape: tuple[int, ...] | None = None,
) -> int:
    """Write the tracks of a video to a file, which appears whole or not at all.

    Parameters
    ----------
    results
        One :class:`FrameResult` for each frame, of which the tracks that are shown are written; or rows, each
        a mapping or a sequence of ``frame, track_id, x1, y1, x2, y2, score[, distance_m, speed_mps]``; or a
        pandas table of them.
    path
        File to write.
    format
        ``"csv"``, ``"jsonl"`` (a JSON object in each line), ``"parquet"`` (needs pyarrow), ``"mot"`` (the
        text of the MOT challenge) or ``"coco"`` (JSON). None: by the suffix .csv, .jsonl, .ndjson, .parquet,
        .txt or .json.
    shape
        ``(height, width, ...)`` of a frame, which COCO viewers ask for.

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
    ``frame`` counts from 0, the first frame that was processed; boxes are half-open pixels with two decimals.
    Unknown distances and speeds are empty in CSV, null elsewhere. MOT counts frames and pixels from 1, as its
    own tools do, and has width and height.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "tracks.csv"
    >>> write_tracks([(0, 1, 10, 20, 50.128, 60, 1.5), (1, 1, 12, 20, 52, 60, 1.25, 31.4, -0.5)], file)
    2
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps
    0,1,10.00,20.00,50.13,60.00,1.5000,,
    1,1,12.00,20.00,52.00,60.00,1.2500,31.40,-0.50
    """
    kind = _check_format(path, format, FORMATS.values())
    if kind in ("csv", "jsonl", "mot"):
        with TrackWriter(path, format=kind) as write:
            for item in check_items(results):
                write(item)
        return write.rows
    rows: list[Row] = []
    frames: list[int | str] = []  # a frame without a vehicle is a picture of a COCO file as well
    for item in check_items(results):
        frames += [int(item.index)] if is_result(item) else []
        rows += rows_of(item, len(rows))
    _write_whole(rows, frames, path, kind, TRACK_COLUMNS, shape)
    return len(rows)


def write_boxes(
    boxes: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: Format | None = None,  # noqa: A002
) -> int:
    """Write the boxes found in stills to a file, which appears whole or not at all.

    Parameters
    ----------
    boxes
        Pairs of an image's file name and its :class:`Detections`; or rows, each a mapping or a sequence of
        ``frame, track_id, x1, y1, x2, y2, score`` with the file name as ``frame``, and None as ``track_id``
        unless the boxes are numbered.
    path
        File to write.
    format
        ``"csv"``, ``"jsonl"``, ``"parquet"`` or ``"coco"``; None: by the suffix, as in `write_tracks`.

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
    >>> write_boxes([("road.jpg", Detections([[10, 20, 50, 60]], [1.5]))], file)
    1
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score
    road.jpg,,10.00,20.00,50.00,60.00,1.5000
    """
    kind = _check_format(path, format, ("csv", "jsonl", "parquet", "coco"))
    names: list[int | str] = []
    rows: list[Row] = []
    for item in check_items(boxes):
        if isinstance(item, Sequence) and len(item) == 2 and hasattr(item[1], "scores"):
            name, found = item
            names.append(str(name))
            rows += [
                as_row((str(name), None, *box, score), len(rows), stills=True)
                for box, score in zip(found.boxes, found.scores)
            ]
        else:
            rows.append(as_row(item, len(rows), stills=True))
    if kind in ("parquet", "coco"):
        _write_whole(rows, names, path, kind, BOX_COLUMNS, None)
    else:
        with atomic_write(path, "path") as part, _open_text(part) as file:
            put = _text_writer(file, kind, BOX_COLUMNS)
            for row in rows:
                put(row)
    return len(rows)


class TrackWriter:
    """Write the tracks of a video while it is processed, in constant memory.

    The file appears when the ``with`` block ends well, else an earlier one stays.

    Parameters
    ----------
    path
        File to write.
    format
        ``"csv"``, ``"jsonl"`` or ``"mot"``; None: by the suffix .csv, .jsonl, .ndjson or .txt.

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
"distance_m": null, "speed_mps": null}
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        format: Format | None = None,  # noqa: A002
    ) -> None:
        self._kind = _check_format(path, format, ("csv", "jsonl", "mot"))
        self._path = path
        self._stack = contextlib.ExitStack()
        self._put: Callable[[Row], None] | None = None
        self.rows = 0

    def __enter__(self) -> TrackWriter:
        with contextlib.ExitStack() as stack:
            part = stack.enter_context(atomic_write(self._path, "path"))
            file = stack.enter_context(_open_text(part))
            self._put = _text_writer(file, self._kind, TRACK_COLUMNS)
            self._stack = stack.pop_all()
        self.rows = 0
        return self

    def __call__(self, result: Any) -> None:
        """Write the shown tracks of one frame's result, or one row.

        Raises
        ------
        InvalidInputError
            If the result is malformed, or the writer is not inside its ``with`` block.
        """
        if self._put is None:
            raise InvalidInputError(
                "TrackWriter must be inside its with block to write, got a call outside; use "
                "with TrackWriter(path) as write: ..."
            )
        for row in rows_of(result, self.rows):
            self._put(row)
            self.rows += 1

    def __exit__(self, *error: Any) -> None:
        self._put = None
        self._stack.__exit__(*error)


def _check_format(path: object, name: str | None, allowed: Iterable[Format]) -> Format:
    """Choose the format by its name or the suffix, and check the target before any work is done."""
    if not isinstance(path, (str, os.PathLike)):
        raise InvalidInputError(
            f"path must be a file name, got {describe(path)}; pass a name such as 'tracks.csv'"
        )
    choices = tuple(dict.fromkeys(allowed))
    kind = name
    if name is None:
        kind = FORMATS.get(Path(path).suffix.lower())
        if kind not in choices:
            suffixes = [suffix for suffix, meant in FORMATS.items() if meant in choices]
            raise InvalidInputError(
                f"path must end in {', '.join(suffixes)}, got {Path(path).name!r}; "
                f"or pass format= one of {', '.join(map(repr, choices))}"
            )
    check_choice(kind, "format", choices)
    check_target(path, "path")
    return next(choice for choice in choices if choice == kind)


def _open_text(path: Path) -> IO[str]:
    return path.open("w", encoding="utf-8", newline="")


def _text_writer(file: IO[str], kind: Format, columns: Sequence[str]) -> Callable[[Row], None]:
    """Return the function that writes one row as text."""
    if kind == "jsonl":
        return lambda row: _put_line(file, json.dumps(dict(zip(columns, row)), ensure_ascii=False))
    if kind == "mot":
        return lambda row: _put_line(file, _mot_line(row))
    table = csv.writer(file, lineterminator="\n")
    table.writerow(columns)

    def put(row: Row) -> None:
        numbers = (
            "" if value is None else f"{value:.{DIGITS[name]}f}" for name, value in zip(columns[2:], row[2:])
        )
        table.writerow([*row[:2], *numbers])

    return put


def _put_line(file: IO[str], line: str) -> None:
    file.write(line + "\n")


def _mot_line(row: Row) -> str:
    """Write a row as the MOT challenge has it: all counts from 1, no place in the world."""
    frame = int(row.frame) + 1
    size = f"{row.x2 - row.x1:.2f},{row.y2 - row.y1:.2f}"
    return f"{frame},{row.track_id},{row.x1 + 1:.2f},{row.y1 + 1:.2f},{size},{row.score:.4f},-1,-1,-1"


def _write_whole(
    rows: Sequence[Row],
    frames: Sequence[int | str],
    path: str | os.PathLike[str],
    kind: Format,
    columns: Sequence[str],
    shape: tuple[int, ...] | None,
) -> None:
    """Write a format that needs all rows at once."""
    if kind == "parquet":
        _write_parquet(rows, path, columns)
        return
    document = _coco_document(rows, frames, shape)
    with atomic_write(path, "path") as part, _open_text(part) as file:
        json.dump(document, file, ensure_ascii=False)


def _write_parquet(rows: Sequence[Row], path: str | os.PathLike[str], columns: Sequence[str]) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InvalidInputError(
            "format 'parquet' needs pyarrow; pip install 'vehicle-detection[parquet]', or write .csv"
        ) from None
    frame = pyarrow.string() if columns == BOX_COLUMNS else pyarrow.int64()
    types = [frame, pyarrow.int64(), *[pyarrow.float64()] * (len(columns) - 2)]
    table = pyarrow.table(
        [pyarrow.array([row[place] for row in rows], kind) for place, kind in enumerate(types)],
        names=list(columns),
    )
    with atomic_write(path, "path") as part:
        pyarrow.parquet.write_table(table, part)


def _coco_document(
    rows: Sequence[Row], frames: Sequence[int | str], shape: tuple[int, ...] | None
) -> dict[str, Any]:
    """Build a COCO data set: every frame an image, every row an annotation with its score."""
    keys = list(dict.fromkeys([*frames, *(row.frame for row in rows)]))
    keys.sort(key=lambda key: (isinstance(key, str), key))
    size = {} if shape is None else {"height": int(shape[0]), "width": int(shape[1])}
    # Images of a video have no file of their own: the frame's number stands for it.
    numbers = {key: place for place, key in enumerate(keys, start=1)}
    images = [
        {"id": numbers[key], "file_name": key if isinstance(key, str) else f"{key:06d}", **size}
        | ({} if isinstance(key, str) else {"frame": key})
        for key in keys
    ]
    annotations = []
    for number, row in enumerate(rows, start=1):
        width, height = round(row.x2 - row.x1, 2), round(row.y2 - row.y1, 2)
        annotation = {
            "id": number,
            "image_id": numbers[row.frame],
            "category_id": 1,
            "bbox": [row.x1, row.y1, width, height],
            "area": round(width * height, 2),
            "iscrowd": 0,
            "score": row.score,
        }
        named = {"track_id": row.track_id, "distance_m": row.distance_m, "speed_mps": row.speed_mps}
        annotations.append(annotation | {name: value for name, value in named.items() if value is not None})
    return {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": 1, "name": "vehicle", "supercategory": "vehicle"}],
    }
