"""Write tables of tracks, detections and labels in each format, also while a video is processed."""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import (
    atomic_write,
    check,
    check_target,
    describe,
    invalid,
    open_parquet,
    spreadsheet_text,
    temporary_folder,
)
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.datasets.coco_yolo import (
    Truth,
    Write,
    open_coco,
    open_coco_results,
    read_truth,
    without_noise,
)
from vehicle_detection.datasets.reading import FOLDER_FORMATS, FORMATS
from vehicle_detection.datasets.rows import FRAME_NUMBER, ClassNumbers, Record, without_suffix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import BOX_COLUMNS, CORNERS, NO_TRACK, TRACK_COLUMNS, FrameKey, TrackTable
from vehicle_detection.tracking import UNKNOWN_LABEL

TIME_COLUMN = "time_s"
DIGITS = dict(zip((*TRACK_COLUMNS[2:-1], TIME_COLUMN), (2, 2, 2, 2, 4, 2, 2, 4, 2, 2, 3)))
"""Decimals of each column of a table of tracks."""
_STILL_COLUMNS = (*BOX_COLUMNS, "distance_m", "confidence", "distance_std_m", "label")

_TRACK_FORMATS = (*dict.fromkeys(FORMATS.values()), "yolo")
_STILL_FORMATS = ("csv", "jsonl", "parquet", "coco", "yolo")

# Pixels by which a box may extend beyond its image, from rounding.
_ROUNDING = 1.0


def _round(record: Record) -> Record:
    """Round to the decimals of a table of tracks; + 0.0 turns -0.0 into 0.0."""
    return {
        name: value if name not in DIGITS or value is None else round(value, DIGITS[name]) + 0.0
        for name, value in record.items()
    }


def track_records(result: Any) -> list[Record]:
    """Return the rounded rows of the shown tracks of a frame's result."""
    return list(map(_round, _table_records(TrackTable.from_results([result]), TRACK_COLUMNS)))


def _table_records(table: TrackTable, columns: Sequence[str]) -> list[Record]:
    values = [
        [None if isinstance(value, float) and math.isnan(value) else value for value in table[name].tolist()]
        for name in columns
    ]
    return [dict(zip(columns, row)) for row in zip(*values)]


def _write_table(table: TrackTable, records: Iterable[Record], write: Write) -> None:
    """Write all frames, some of which may be empty, then the rows in their order."""
    for key in table.frame_keys:
        write(key, ())
    for key, rows in groupby(records, lambda record: record["frame"]):
        write(key, list(rows))


class _Target(NamedTuple):
    """What a format needs to know of the rows."""

    path: Path
    columns: Sequence[str]
    shape: tuple[int, ...] | None = None
    named: bool = False  # whether frames have names
    rounded: bool = False  # to `DIGITS`
    truth: Truth | None = None  # of COCO files


@contextlib.contextmanager
def _open_csv(part: Path, target: _Target) -> Iterator[Write]:
    digits = DIGITS if target.rounded else {}

    def cell(name: str, value: Any) -> Any:
        if value is None or isinstance(value, bool):
            return "" if value is None else int(value)
        if isinstance(value, str):
            return spreadsheet_text(value)
        return f"{value:.{digits[name]}f}" if name in digits else value

    with part.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(target.columns)
        yield lambda _, records: table.writerows(
            [cell(name, record[name]) for name in target.columns] for record in records
        )


@contextlib.contextmanager
def _open_lines(part: Path, line: Callable[[Record], str]) -> Iterator[Write]:
    with part.open("w", encoding="utf-8", newline="") as file:
        yield lambda _, records: file.writelines(map(line, records))


@contextlib.contextmanager
def _open_parquet(part: Path, target: _Target) -> Iterator[Write]:
    types = {"frame": "string" if target.named else "int64", "track_id": "int64", "occluded": "int64"}
    types |= {"ignore": "bool", "label": "string"}
    with open_parquet(part, {name: types.get(name, "double") for name in target.columns}) as write:
        yield lambda _, records: write(records)


def _json_line(columns: Sequence[str], record: Record) -> str:
    return json.dumps({name: record[name] for name in columns}, ensure_ascii=False) + "\n"


def _mot_line(record: Record, *, first_pixel: int = 1, vehicle_class: int = 3, scores: bool = True) -> str:
    """MOTChallenge text of a row, whose frames count from 1: a result, or without score a label.

    Both start with frame, id, left, top, width and height. A result goes on with its score and no world
    position, a label with its flag (0 if ignored), its class (3 is a car) and its visible fraction.
    """
    x1, y1, x2, y2 = (record[name] for name in CORNERS)
    box = (without_noise(side) for side in (x1 + first_pixel, y1 + first_pixel, x2 - x1, y2 - y1))
    if scores and record.get("score") is not None:
        end: tuple[Any, ...] = (record["score"], -1, -1, -1)
    else:
        hidden = min(record.get("occluded", 0), 2) / 2
        visible = round((1 - record.get("truncated", 0.0)) * (1 - hidden), 2)
        end = (int(not record.get("ignore", False)), vehicle_class, visible)
    return ",".join(map(str, (record["frame"] + 1, record["track_id"], *box, *end))) + "\n"


@contextlib.contextmanager
def _open_mot_zip(part: Path, target: _Target) -> Iterator[Write]:
    """Archive of ground truth as CVAT writes it: pixels count from 0, and class 1 is the first label."""
    numbers = ClassNumbers()
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        with (
            archive.open("gt/gt.txt", "w") as binary,
            io.TextIOWrapper(binary, "utf-8", newline="\n") as text,
        ):
            yield lambda _, records: text.writelines(
                _mot_line(record, first_pixel=0, vehicle_class=numbers(record)[0] + 1, scores=False)
                for record in records
            )
        # Without the time of day, as the other member: the same tracks give the same archive.
        archive.writestr(zipfile.ZipInfo("gt/labels.txt"), "".join(f"{name}\n" for name in numbers.names))


def _folder_writer(
    folder: Path, name: Callable[[FrameKey], str], line: Callable[[Record], str], kind: str
) -> Write:
    """Write a text file for each frame, which stays empty without rows."""
    frames: dict[str, FrameKey] = {}

    def write(frame: FrameKey, records: Sequence[Record]) -> None:
        other = frames.setdefault(name(frame), frame)
        if other != frame:
            pair = f"{other!r} and {frame!r}, which are one file in {kind}"
            raise InvalidInputError(f"path cannot hold the frames {pair}; rename them")
        with (folder / f"{name(frame)}.txt").open("a", encoding="utf-8", newline="") as file:
            file.writelines(map(line, records))

    return write


@contextlib.contextmanager
def _open_yolo(part: Path, target: _Target) -> Iterator[Write]:
    """Lines of class, center and size as fractions of the frame, confidence and track; labels have five."""
    if target.shape is None:
        raise InvalidInputError("shape must be (height, width) of the frames for YOLO, got None; pass it")
    import yaml

    height, width = target.shape[:2]
    numbers = ClassNumbers()

    def line(record: Record) -> str:
        x1, y1, x2, y2 = (record[name] for name in CORNERS)
        values = [(x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height]
        track: list[str] = []
        if record.get("score") is not None:
            # math.exp overflows beyond 709.
            known = record.get("confidence")
            values.append(1 / (1 + math.exp(min(-record["score"], 700))) if known is None else known)
            track = [] if record["track_id"] in (None, NO_TRACK) else [str(record["track_id"])]
        return " ".join([str(numbers(record)[0]), *(f"{value:.6f}" for value in values), *track]) + "\n"

    (part / "labels").mkdir()
    yield _folder_writer(
        part / "labels", lambda key: Path(key).stem if isinstance(key, str) else f"{key:06d}", line, "YOLO"
    )
    names = yaml.safe_dump({"names": dict(enumerate(numbers.names))}, allow_unicode=True, sort_keys=False)
    (part / "data.yaml").write_text(names, encoding="utf-8", newline="\n")


@contextlib.contextmanager
def _open_kitti(part: Path, target: _Target) -> Iterator[Write]:
    """``label_2`` files, in which angle, size and place in 3D are unknown."""
    classes = ClassNumbers()

    def line(record: Record) -> str:
        # KITTI has no type for all vehicles, and no spaces in types.
        _, label = classes(record)
        name = "Car" if label == UNKNOWN_LABEL else label.capitalize().replace(" ", "_")
        name = "DontCare" if record.get("ignore", False) else name
        words = [name, record.get("truncated", 0.0), record.get("occluded", 0), -10]
        words += [*(record[side] for side in CORNERS), "-1 -1 -1 -1000 -1000 -1000 -10"]
        words += [] if record.get("score") is None else [record["score"]]
        return " ".join(map(str, words)) + "\n"

    yield _folder_writer(part, lambda key: without_suffix(str(key)), line, "KITTI")


_WRITERS: dict[str, Callable[[Path, _Target], contextlib.AbstractContextManager[Write]]] = {
    "csv": _open_csv,
    "jsonl": lambda part, target: _open_lines(part, functools.partial(_json_line, target.columns)),
    "parquet": _open_parquet,
    "mot": lambda part, target: _open_lines(part, _mot_line),
    "mot_zip": _open_mot_zip,
    "coco": lambda part, target: open_coco(part, target.shape, target.truth),
    "coco_results": lambda part, target: open_coco_results(part, target.truth or Truth({}, {})),
    "kitti": _open_kitti,
    "yolo": _open_yolo,
}


@contextlib.contextmanager
def _open_target(kind: str, target: _Target) -> Iterator[Write]:
    """Open a file or folder, which appears when the block ends without an error, and is removed otherwise."""
    folder = kind in FOLDER_FORMATS
    place = _new_folder(target.path, kind.upper()) if folder else atomic_write(target.path, "path")
    with place as part, _WRITERS[kind](part, target) as write:
        yield write


@contextlib.contextmanager
def _new_folder(path: Path, kind: str) -> Iterator[Path]:
    """Yield a temporary folder, which becomes `path`, a new or empty folder, if the block succeeds."""
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise InvalidInputError(f"path must be a new or empty folder for {kind}, got {path}; choose another")
    if not path.parent.is_dir():
        missing = describe(str(path.parent))
        raise InvalidInputError(f"path needs an existing folder, {missing} is not one; create it first")
    with temporary_folder(path.parent, path.name[:32]) as temporary:
        part = temporary / "new"
        part.mkdir()
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)


def _check_format(path: object, name: str | None, allowed: Iterable[str]) -> str:
    """Choose the format by its name or the suffix, and check the target before any work is done."""
    if not isinstance(path, (str, os.PathLike)):
        raise invalid("path", "be a file name", path, "pass a name such as 'tracks.csv'")
    choices = tuple(dict.fromkeys(allowed))
    kind = FORMATS.get(Path(path).suffix.lower()) if name is None else name
    if name is None and kind not in choices:
        suffixes = [suffix for suffix, meant in FORMATS.items() if meant in choices]
        remedy = f"or set the format to {', '.join(map(repr, choices))}"
        raise invalid("path", f"end in {', '.join(suffixes)}", Path(path).name, remedy)
    check.choice(kind, "format", choices)
    if kind not in FOLDER_FORMATS:
        check_target(path, "path")
    return str(kind)


class TrackStream:
    """Rows of a video that are written while it is processed; see `open_tracks`."""

    def __init__(self, write: Write, fps: float | None) -> None:
        self._write, self._fps = write, fps
        self._last = -1
        self.rows = 0

    def __call__(self, result: Any) -> None:
        """Write the shown tracks of the next frame's result."""
        records = track_records(result)
        frame = int(result.index)
        if frame <= self._last:
            remedy = "write each frame once, and each video to a file of its own"
            raise invalid("frame", f"be greater than {self._last}, the last one", frame, remedy)
        self._last = frame
        time = None if self._fps is None else round(frame / self._fps, DIGITS[TIME_COLUMN])
        self._write(frame, [{**record, TIME_COLUMN: time} for record in records])
        self.rows += len(records)


@contextlib.contextmanager
def open_tracks(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002 - the name that pandas and Pillow use
    shape: tuple[int, ...] | None = None,
    fps: float | None = None,
) -> Iterator[TrackStream]:
    """Open a file for the tracks of a video that is being processed, in constant memory.

    Yields a function that takes the :class:`FrameResult` of each frame; its ``rows`` counts those written so
    far. The file appears when the ``with`` block ends without an error; otherwise an existing file is kept.
    Options: see `write_tracks`.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from vehicle_detection import Detections, FrameResult, Tracker
    >>> found, tracker = Detections([[10, 20, 50, 60]], [1.5]), Tracker(fps=25)
    >>> file = Path(tempfile.mkdtemp()) / "tracks.csv"
    >>> with open_tracks(file) as write:  # or: process_video(..., on_result=write)
    ...     for frame in range(20):
    ...         tracks = tracker.update(found, (720, 1280, 3))
    ...         write(FrameResult(frame, frame / 25, found, found, tracks))
    >>> print(file.read_text().splitlines()[0])
    frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps,label
    """
    kind = _check_format(path, format, _TRACK_FORMATS)
    rate = None if fps is None else check.number(fps, "fps", above=0, high=1e6)
    columns = TRACK_COLUMNS if rate is None else (*TRACK_COLUMNS, TIME_COLUMN)
    with _open_target(kind, _Target(Path(path), columns, shape, rounded=True)) as write:
        yield TrackStream(write, rate)


def write_tracks(
    results: Iterable[Any] | TrackTable,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    shape: tuple[int, ...] | None = None,
    fps: float | None = None,
) -> int:
    """Write the tracks of a video, or detections, to a file, which appears only when it is complete.

    Returns the number of rows written.

    Parameters
    ----------
    results
        One :class:`FrameResult` for each frame, of which the shown tracks are written; or a `TrackTable` of
        tracks, or of the detections of images.
    path, format
        File to write, and its format: ``"csv"``, ``"jsonl"`` (one JSON object per line), ``"parquet"`` (needs
        pyarrow), ``"mot"`` (MOTChallenge text), ``"mot_zip"`` (the archive that CVAT imports as tracks),
        ``"coco"`` (JSON) or ``"yolo"`` (a new folder). None chooses by the suffix: .csv, .jsonl, .ndjson,
        .parquet, .txt, .zip or .json. Images have no MOT formats.
    shape
        ``(height, width, ...)`` of a frame, which YOLO and viewers of COCO data sets need.
    fps
        Frame rate, with which tables (CSV, JSON Lines, Parquet) get a last column ``time_s``: the frame's
        number divided by it, as in `write_events`.

    Notes
    -----
    ``frame`` counts from 0, the first processed frame; boxes are half-open pixels with two decimals. Unknown
    values are empty in CSV and null elsewhere. The score is the log-odds above the threshold, the confidence
    a calibrated probability, the label the class, ``vehicle`` if the model does not tell kinds apart; speeds
    are relative to the camera. The archive for CVAT has no scores.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> file = Path(tempfile.mkdtemp()) / "tracks.csv"
    >>> write_tracks(TrackTable([0], [1], [[10, 20, 50.128, 60]], score=[1.5], distance_m=[31.4]), file)
    1
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps,label
    0,1,10.00,20.00,50.13,60.00,1.5000,31.40,,,,,vehicle
    """
    if not isinstance(results, TrackTable):
        results = TrackTable.from_results(results)
    named = any(isinstance(key, str) for key in results.frame_keys)
    kind = _check_format(path, format, _STILL_FORMATS if named else _TRACK_FORMATS)
    unknown = {"distance_m", "distance_std_m"}.difference(results.columns)
    columns = tuple(name for name in _STILL_COLUMNS if name not in unknown) if named else TRACK_COLUMNS
    records = [_round(record) for record in _table_records(results, columns)]
    for record in records if named else ():
        record["track_id"] = None if record["track_id"] == NO_TRACK else record["track_id"]
    if fps is not None:
        if named:
            raise invalid("fps", "be omitted for frames with names, which have no times", fps)
        rate = check.number(fps, "fps", above=0, high=1e6)
        columns = (*columns, TIME_COLUMN)
        records = [_round({**record, TIME_COLUMN: record["frame"] / rate}) for record in records]
    with _open_target(kind, _Target(Path(path), columns, shape, named, rounded=True)) as write:
        _write_table(results, records, write)
    return len(results)


def write_labels(
    labels: TrackTable,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    shape: tuple[int, ...] | None = None,
    truth: str | os.PathLike[str] | None = None,
) -> int:
    """Write labelled or predicted boxes to a file without rounding; `read_labels` reads them back.

    Returns the number of boxes written.

    Parameters
    ----------
    labels
        The boxes: predictions if they have scores, else labels.
    path, format
        File to write, and its format: ``"csv"``, ``"jsonl"`` or ``"parquet"`` (the columns of
        `TrackTable.to_pandas`), ``"mot"`` (MOTChallenge text: ground truth or results), ``"mot_zip"`` (the
        archive that CVAT imports as tracks), ``"coco"`` (a data set with all frames as images),
        ``"coco_results"`` (the list of predictions that ``COCO.loadRes`` of pycocotools takes), ``"kitti"``
        (a new folder with one ``label_2`` file for each frame) or ``"yolo"`` (a new folder with ``data.yaml``
        and ``labels``). None chooses by the suffix as in `write_tracks`.
    shape
        ``(height, width, ...)`` of all images, which YOLO and some viewers of COCO data sets need.
    truth
        A COCO data set whose image ids are used; required for results. Frames are found by file name, or by
        number in data sets written here. A data set has its images, too.

    Notes
    -----
    The page on files lists what each format holds. No format but KITTI, YOLO (tracks of labels) and the
    archive for CVAT (scores) loses a box's score, track or ``ignore`` without an error. Tables and MOT files
    do not list frames without boxes. Ignored boxes become crowds in COCO and regions in KITTI.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection import read_labels
    >>> file = Path(tempfile.mkdtemp()) / "labels.txt"
    >>> write_labels(TrackTable([0, 2], [1, 1], [[0, 0, 50, 40], [4, 0, 54, 40]]), file)
    2
    >>> print(file.read_text().rstrip())
    1,1,1.0,1.0,50.0,40.0,1,3,1.0
    3,1,5.0,1.0,50.0,40.0,1,3,1.0
    >>> read_labels(file)["frame"]
    array([0, 2])
    """
    check.instance(labels, "labels", TrackTable, "pass TrackTable.from_detections([found]) or from_results")
    kind = _check_format(path, format, _WRITERS)
    if truth is not None and not kind.startswith("coco"):
        raise InvalidInputError(f"truth must be None for the format {kind!r}; only COCO files have image ids")
    _check_holds(labels, kind, shape)
    if truth is None and kind == "coco_results":
        must = "name the COCO ground truth, whose image ids the results refer to"
        raise invalid("truth", must, None, "write it with write_labels, too")
    named = any(isinstance(key, str) for key in labels.frame_keys)
    found = None
    if truth is not None:
        found = read_truth(labels, Path(truth), results=kind == "coco_results")
    with _open_target(kind, _Target(Path(path), labels.columns, shape, named, truth=found)) as write:
        _write_table(labels, _table_records(labels, labels.columns), write)
    return len(labels)


def _check_holds(labels: TrackTable, kind: str, shape: tuple[int, ...] | None) -> None:
    """Raise if a format would change or lose what decides about the scores."""
    names = [key for key in labels["frame"].tolist() if isinstance(key, str)]
    padded = next((name for name in names if name != name.strip() or not name), None)
    unnamed = [key for key in labels.frame_keys if not isinstance(key, str) or Path(key).name != key]
    scored, ignored = "score" in labels.columns, bool(labels["ignore"].any())
    drop = "drop them with labels[~labels['ignore']]"
    if kind == "csv" and names and all(FRAME_NUMBER.fullmatch(name.strip()) for name in names):
        problem = (
            f"labels have frame names that CSV does not tell from numbers, such as {names[0]!r}; "
            "convert them with labels.renamed(int), or write .jsonl"
        )
    elif kind == "csv" and padded is not None:
        problem = f"labels name a frame {padded!r}; CSV drops the spaces around a name, so write .jsonl"
    elif kind in ("mot", "mot_zip") and names:
        problem = (
            f"labels must have numbered frames for MOT, got {names[0]!r}; number them with labels.renamed"
        )
    elif kind in ("mot", "coco_results") and scored and ignored:
        problem = f"labels hold predictions marked ignore, which the format {kind!r} cannot mark; {drop}"
    elif kind == "coco_results" and not scored and len(labels):
        problem = "labels need scores for COCO results; write labels as a data set ('coco')"
    elif kind in FOLDER_FORMATS and any("\0" in str(key) for key in labels.frame_keys):
        problem = "labels name a frame with a null byte, as no file can be called; use labels.renamed"
    elif kind == "kitti" and unnamed:
        problem = (
            f"labels must have frames that are file names for KITTI, got {unnamed[0]!r}; "
            "name them with labels.renamed(lambda frame: f'{frame:06d}')"
        )
    elif kind == "yolo" and ignored:
        problem = f"labels hold boxes marked ignore, which YOLO cannot mark; {drop}"
    elif kind == "yolo" and shape is not None and len(labels):
        beyond = np.abs(labels.boxes - clip_boxes(labels.boxes, shape)).max(axis=1)
        row = int(beyond.argmax())
        if beyond[row] <= _ROUNDING:
            return
        frame = labels["frame"].tolist()[row]
        problem = (
            f"labels hold the box {labels.boxes[row].tolist()} in frame {frame!r}, beyond the "
            f"{shape[1]}x{shape[0]} pixels of shape; write images of each size into a folder of their own, "
            "and clip boxes that leave their image with clip_boxes"
        )
    else:
        return
    raise InvalidInputError(problem)
