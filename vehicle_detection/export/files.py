"""Files of rows in each format, written row by row."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from vehicle_detection._common import (
    ParquetRows,
    atomic_write,
    check_choice,
    check_target,
    describe,
    temporary_folder,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.export.coco import COCO_CATEGORIES, coco_annotation, coco_images
from vehicle_detection.export.rows import DIGITS, STILL_COLUMNS, Row, without_noise

FORMATS = {
    ".csv": "csv",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".txt": "mot",
    ".json": "coco",
    ".zip": "mot_zip",
}
"""Format of each file name suffix."""

FOLDER_FORMATS = ("kitti", "yolo")
"""Formats that are folders, which are named instead of chosen by a suffix."""


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
    if kind not in FOLDER_FORMATS:
        check_target(path, "path")
    return str(kind)


class RowFile:
    """An open file of rows."""

    def add_frame(self, frame: int | str) -> None:
        """Note a frame, which may have no row; a table does not list frames."""

    def write(self, row: Row) -> None:
        """Write a row."""
        raise NotImplementedError


@contextlib.contextmanager
def open_row_file(
    path: str | os.PathLike[str], kind: str, columns: Sequence[str], shape: tuple[int, ...] | None = None
) -> Iterator[RowFile]:
    """Open a file of rows, which appears when the block ends without an error, and is removed otherwise."""
    with contextlib.ExitStack() as stack:
        if kind == "yolo":
            yield stack.enter_context(_open_yolo(Path(path), shape))
            return
        part = stack.enter_context(atomic_write(path, "path"))
        if kind == "parquet":
            frame = "string" if columns == STILL_COLUMNS else "int64"
            types = {"frame": frame, "track_id": "int64"} | dict.fromkeys(columns[2:], "double")
            yield _ParquetFile(stack.enter_context(ParquetRows(part, types)), columns)
        elif kind == "mot_zip":
            yield stack.enter_context(_open_mot_zip(part))
        else:
            file = stack.enter_context(part.open("w", encoding="utf-8", newline=""))
            if kind == "coco":
                yield stack.enter_context(_open_coco(file, shape))
            else:
                yield _TextFile(file, kind, columns)


class _TextFile(RowFile):
    """CSV, JSON Lines or MOTChallenge text."""

    def __init__(self, file: IO[str], kind: str, columns: Sequence[str]) -> None:
        self._file, self._kind, self._columns = file, kind, columns
        self._table = csv.writer(file, lineterminator="\n")
        if kind == "csv":
            self._table.writerow(columns)

    def write(self, row: Row) -> None:
        """Write a row."""
        if self._kind == "csv":
            self._table.writerow(_csv_cells(row, self._columns))
        elif self._kind == "jsonl":
            values = {name: getattr(row, name) for name in self._columns}
            self._file.write(json.dumps(values, ensure_ascii=False) + "\n")
        else:
            self._file.write(mot_line(row) + "\n")


def _csv_cells(row: Row, columns: Sequence[str]) -> list[Any]:
    numbers = ((getattr(row, name), DIGITS[name]) for name in columns[2:])
    return [*row[:2], *("" if value is None else f"{value:.{digits}f}" for value, digits in numbers)]


def mot_line(row: Row) -> str:
    """MOTChallenge text of a row, whose frames and pixels count from 1: a result, or without score a label.

    Both start with frame, id, left, top, width and height. A result goes on with its score and no world
    position, a label with its flag (0 if ignored), the class 3 (car) and its visible fraction.
    """
    numbers = row.x1 + 1, row.y1 + 1, row.x2 - row.x1, row.y2 - row.y1
    box = ",".join(str(without_noise(number)) for number in numbers)
    end = f"{int(not row.ignore)},3,{row.visible}" if row.score is None else f"{row.score},-1,-1,-1"
    return f"{int(row.frame) + 1},{-1 if row.track_id is None else row.track_id},{box},{end}"


class _ParquetFile(RowFile):
    def __init__(self, table: ParquetRows, columns: Sequence[str]) -> None:
        self._table, self._columns = table, columns

    def write(self, row: Row) -> None:
        """Write a row."""
        self._table.write([getattr(row, name) for name in self._columns])


class _CocoFile(RowFile):
    """A COCO data set. Its images come last, when all are known."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self.frames: set[int | str] = set()
        self._rows = 0

    def add_frame(self, frame: int | str) -> None:
        """Note an image, which may have no annotation."""
        self.frames.add(frame)

    def write(self, row: Row) -> None:
        """Write an annotation."""
        self.frames.add(row.frame)
        self._rows += 1
        # Its image depends on the frame alone.
        annotation = coco_annotation(self._rows, row, coco_images([row.frame], None)[row.frame])
        self._file.write((", " if self._rows > 1 else "") + json.dumps(annotation, ensure_ascii=False))


@contextlib.contextmanager
def _open_coco(file: IO[str], shape: tuple[int, ...] | None) -> Iterator[_CocoFile]:
    file.write('{"annotations": [')
    rows = _CocoFile(file)
    yield rows
    images = list(coco_images(rows.frames, shape).values())
    rest = json.dumps({"images": images, "categories": COCO_CATEGORIES}, ensure_ascii=False)
    file.write(f"], {rest[1:]}")


class _CvatFile(RowFile):
    """MOT ground truth as CVAT writes it: frames count from 1, pixels from 0; class 1 is the first label."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def write(self, row: Row) -> None:
        """Write a row; without a track, it becomes a shape of its frame."""
        sides = row.x1, row.y1, without_noise(row.x2 - row.x1), without_noise(row.y2 - row.y1)
        values = int(row.frame) + 1, -1 if row.track_id is None else row.track_id, *sides
        self._file.write(",".join(map(str, (*values, int(not row.ignore), 1, row.visible))) + "\n")


@contextlib.contextmanager
def _open_mot_zip(part: Path) -> Iterator[_CvatFile]:
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        with (
            archive.open("gt/gt.txt", "w") as binary,
            io.TextIOWrapper(binary, "utf-8", newline="\n") as text,
        ):
            yield _CvatFile(text)
        # Without the time of day, as the other member: the same tracks give the same archive.
        archive.writestr(zipfile.ZipInfo("gt/labels.txt"), "vehicle\n")


class _YoloFolder(RowFile):
    """A text file for each frame: class, center and size as fractions of the frame, confidence, track."""

    def __init__(self, folder: Path, shape: tuple[int, ...]) -> None:
        self._folder, self._shape = folder, shape
        self._frames: dict[str, str] = {}  # named frames, by the name of their file

    def add_frame(self, frame: int | str) -> None:
        """Create the file of a frame, which stays empty without boxes."""
        self._file_of(frame).touch()

    def write(self, row: Row) -> None:
        """Append a box to the file of its frame."""
        height, width = self._shape[:2]
        x, y = (row.x1 + row.x2) / 2 / width, (row.y1 + row.y2) / 2 / height
        words = ["0", *(f"{v:.6f}" for v in (x, y, (row.x2 - row.x1) / width, (row.y2 - row.y1) / height))]
        if row.score is not None:  # a label has five columns only
            # math.exp overflows beyond 709.
            known = 1 / (1 + math.exp(min(-row.score, 700))) if row.confidence is None else row.confidence
            words += [f"{known:.6f}"] + ([] if row.track_id is None else [str(row.track_id)])
        with self._file_of(row.frame).open("a", encoding="utf-8", newline="") as file:
            file.write(" ".join(words) + "\n")

    def _file_of(self, frame: int | str) -> Path:
        if isinstance(frame, str):
            name = Path(frame).stem
            other = self._frames.setdefault(name, frame)
            if other != frame:
                raise InvalidInputError(
                    f"path cannot hold the frames {other!r} and {frame!r}, which are one file in YOLO; "
                    "rename them"
                )
        else:
            name = f"{frame:06d}"
        return self._folder / f"{name}.txt"


@contextlib.contextmanager
def _open_yolo(path: Path, shape: tuple[int, ...] | None) -> Iterator[_YoloFolder]:
    if shape is None:
        raise InvalidInputError("shape must be (height, width) of the frames for YOLO, got None; pass it")
    with new_folder(path, "YOLO") as part:
        (part / "labels").mkdir()
        (part / "data.yaml").write_text("names:\n  0: vehicle\n", encoding="utf-8", newline="\n")
        yield _YoloFolder(part / "labels", shape)


@contextlib.contextmanager
def new_folder(path: Path, kind: str) -> Iterator[Path]:
    """Yield a temporary folder, which becomes `path`, a new or empty folder, if the block succeeds."""
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise InvalidInputError(f"path must be a new or empty folder for {kind}, got {path}; choose another")
    if not path.parent.is_dir():
        raise InvalidInputError(
            f"path needs an existing folder, {describe(str(path.parent))} is not one; create it first"
        )
    with temporary_folder(path.parent, path.name[:32]) as temporary:
        part = temporary / "new"
        part.mkdir()
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)
