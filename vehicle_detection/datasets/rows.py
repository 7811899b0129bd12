"""What readers and writers of formats share: the rows of a file, its lines, and numbers of classes."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, NamedTuple

from vehicle_detection._common import Limit, is_hidden, read_regular_file, shorten
from vehicle_detection.boxes import VEHICLE_CLASSES
from vehicle_detection.datasets.archives import is_image
from vehicle_detection.errors import DatasetError
from vehicle_detection.tables import BOX_COLUMNS, FrameKey, frame_order
from vehicle_detection.tracking import UNKNOWN_LABEL

_LOGGER = logging.getLogger(__name__)

Record = dict[str, Any]
"""Values of a row by the names of their columns, None where a value is unknown."""

# Names of lists of images beside the labels, as of CVAT, FiftyOne and Darknet; a frame may have one of them.
_LISTS = ("train", "val", "valid", "test", "images")

FRAME_NUMBER = re.compile(r"-?(0|[1-9][0-9]{0,17})(\.0*)?")
"""Text of a frame that is a number. One with leading zeros is a file name."""


class FileRows(NamedTuple):
    """Rows of a file."""

    places: list[str]  # file and line of each, for messages
    cells: dict[str, list[Any]]  # of each column
    frames: Sequence[FrameKey] = ()  # that the file lists; they may have no row


def rows_of_records(rows: Iterable[tuple[str, Record]], frames: Sequence[FrameKey] = ()) -> FileRows:
    """Collect records; a cell that a record lacks is missing."""
    places, records = zip(*listed) if (listed := list(rows)) else ((), ())
    names = dict.fromkeys(name for record in records for name in record) or BOX_COLUMNS[:-1]
    return FileRows(list(places), {name: [record.get(name) for record in records] for name in names}, frames)


class ClassNumbers:
    """Numbers from 0 of the classes in a file: the usual ones, which agree between files, then others."""

    def __init__(self) -> None:
        self._numbers = {name: number for number, name in enumerate((UNKNOWN_LABEL, *VEHICLE_CLASSES[:-1]))}
        self.used = set[str]()
        self._unusual = set[str]()  # of which a warning was logged

    def __call__(self, record: Record) -> tuple[int, str]:
        """Return number and name of the class of a row, with a warning if it is not read by default."""
        name = class_name(record.get("label"))
        if name not in (*VEHICLE_CLASSES, *self._unusual) and not record.get("ignore"):
            self._unusual.add(name)
            _LOGGER.warning("boxes of class %r are read back only if classes= names it", name)
        self.used.add(name)
        return self._numbers.setdefault(name, len(self._numbers)), name

    @property
    def names(self) -> list[str]:
        """Name of each number; one if no row has a known class."""
        return list(self._numbers) if self.used - {UNKNOWN_LABEL} else [UNKNOWN_LABEL]


def class_name(label: str | None) -> str:
    """Return a class as it is read back: in lower case, on one line."""
    return " ".join((label or UNKNOWN_LABEL).lower().split())


def read_lines(file: Path, text: str | None = None) -> Iterator[tuple[str, str]]:
    """Yield the lines of a file, or of a text in it, that are not blank, after their places for messages."""
    for number, line in enumerate((read_text(file) if text is None else text).splitlines(), 1):
        if line.strip(", \t"):
            yield f"{file} line {number}", line.strip()


def read_text(file: Path) -> str:
    """Read a file of UTF-8 text of limited size."""
    try:
        return read_regular_file(file, str(file), Limit.TEXT_BYTES, error=DatasetError).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{file} is not UTF-8 text; save it as UTF-8") from None


def without_suffix(name: str) -> str:
    """Return the name of a frame without the suffix of an image."""
    path = PurePosixPath(name)
    return name[: -len(path.suffix)] if is_image(path.name) else name


def warn_of_numbers(source: Path, numbers: Collection[str], remedy: str) -> None:
    """Warn that the boxes of several classes without names are read, of which some may not be vehicles."""
    if len(numbers) > 1:
        listed = ", ".join(sorted(numbers, key=frame_order))
        _LOGGER.warning("%s: all classes (%s) are read as vehicles; %s", source, shorten(listed), remedy)


def label_files(folder: Path) -> list[Path]:
    """Text files of a folder that hold labels, not names of classes, lists of images or a README."""
    return [
        file
        for file in folder.glob("*.txt")
        if file.name != "classes.txt"
        and not is_hidden(file.name)
        and not file.name.startswith("README")
        and not (file.stem in _LISTS and all(is_image(PurePath(line).name) for _, line in read_lines(file)))
    ]


def no_text_files(folder: Path, expected: str) -> DatasetError:
    """Error of a folder without text files, which names a subfolder that has some, such as labels/train."""
    texts = (*folder.glob("*/*.txt"), *folder.glob("*/labels/*.txt"))
    inside = min((file.parent for file in texts), default=None)
    remedy = f"name {expected}" if inside is None else f"its subfolders are read one at a time: name {inside}"
    return DatasetError(f"{folder} holds no .txt file; {remedy}")
