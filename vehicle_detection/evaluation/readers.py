"""Label and prediction files of any layout; all are checked in one place and refused for the same faults."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from vehicle_detection._common import check_choice
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import DatasetError
from vehicle_detection.evaluation.formats import READERS, Row, read_text, split_words
from vehicle_detection.evaluation.labels import NO_TRACK, FrameKey, Labels


def read_labels(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    classes: Collection[str] | None = None,
    shape: tuple[int, ...] | None = None,
) -> Labels:
    """Read labelled or predicted boxes from a file or folder.

    Parameters
    ----------
    path
        A CSV file (``frame,track,x1,y1,x2,y2,occluded,truncated,ignore`` or, for predictions,
        ``frame,track_id,x1,y1,x2,y2,score[,distance_m,speed_mps]``; more columns may follow, the
        separator is a comma, semicolon or tab), a KITTI ``label_2`` folder, a MOTChallenge text file or
        a COCO JSON file.
    format
        ``"csv"``, ``"kitti"``, ``"mot"`` or ``"coco"``; None tells by suffix and content.
    classes
        KITTI types, COCO category names or MOT class numbers that are vehicles, in any case. None takes
        car, van, truck, bus and vehicle, and every row of a MOT file.
    shape
        ``(height, width, ...)`` of the frames: boxes are clipped to it. None leaves them as they are.

    Returns
    -------
    Labels
        Boxes in half-open pixels. CSV frames are int where all of them are whole numbers, else str.
        KITTI frames are the files' names without ``.txt``, COCO frames the images' ``file_name``, and
        MOT frames, 1-based in the file, are counted from 0.

    Raises
    ------
    DatasetError
        If the file is missing, is of none of these layouts, or holds a faulty row; the message names the
        line: no finite number, a box without area, a track twice in a frame, a box outside `shape`.
    InvalidInputError
        If `format` or `shape` is none of the values above.

    Notes
    -----
    KITTI's ``DontCare`` and COCO's crowds become regions to ignore; trams, trailers and the like become
    boxes to ignore, as do KITTI's vehicles that are largely hidden, cut off by more than 0.7 or under
    40 px wide: the rule of the project's own labels. Persons and all else are left out. A MOT file with
    nine columns is ground truth, whose rows with flag 0 are ignored; in others column seven is the score.

    Examples
    --------
    >>> read_labels("labels/missing.csv")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: labels/missing.csv does not exist; check the path
    """
    source = Path(path)
    if format is not None:
        check_choice(format, "format", tuple(READERS))
    if not source.exists():
        raise DatasetError(f"{source} does not exist; check the path")
    kind = format or _guess_format(source)
    if source.is_dir() and kind != "kitti":
        raise DatasetError(f"{source} is a folder, and {kind} labels are one file; name the file in it")
    chosen = None if classes is None else frozenset(str(name).lower() for name in classes)
    rows, keys = READERS[kind](source, chosen)
    return _assemble(rows, keys, shape)


def _assemble(rows: list[Row], keys: list[FrameKey], shape: tuple[int, ...] | None) -> Labels:
    """Check the rows of any format and make them columns."""
    boxes = np.array([row.box for row in rows], np.float64).reshape(-1, 4)
    scored = [row.score is not None for row in rows]
    first: dict[tuple[FrameKey, int], str] = {}
    for row, has_score in zip(rows, scored):
        x1, y1, x2, y2 = row.box
        if not all(map(math.isfinite, row.box)):
            raise DatasetError(f"{row.where}: a box needs finite corners, got {list(row.box)}")
        # A prediction cut at the border may have no area left; a label without area is a slip of the hand.
        if x2 < x1 or y2 < y1 or (not has_score and (x2 == x1 or y2 == y1)):
            raise DatasetError(f"{row.where}: a box needs x1 < x2 and y1 < y2, got {list(row.box)}")
        if row.track != NO_TRACK:
            before = first.setdefault((row.frame, row.track), row.where)
            if before != row.where:
                raise DatasetError(
                    f"{row.where}: track {row.track} comes twice in frame {row.frame!r}, first at {before}"
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
    distance, speed = (np.array([getattr(row, name) for row in rows]) for name in ("distance_m", "speed_mps"))
    return Labels(
        [row.frame for row in rows],
        np.array([row.track for row in rows], np.int64),
        boxes,
        occluded=np.array([row.occluded for row in rows], np.int64),
        truncated=np.array([row.truncated for row in rows], np.float64),
        ignore=np.array([row.ignore for row in rows], np.bool_),
        scores=np.array([row.score for row in rows], np.float64) if rows and scored[0] else None,
        distance_m=None if np.isnan(distance).all() else distance,
        speed_mps=None if np.isnan(speed).all() else speed,
        frame_keys=keys,
    )


def _guess_format(source: Path) -> str:
    """Tell a layout by its suffix, and where that says nothing by its first line."""
    if source.is_dir():
        return "kitti"
    by_suffix = {".json": "coco", ".csv": "csv", ".tsv": "csv"}.get(source.suffix.lower())
    if by_suffix:
        return by_suffix
    start = read_text(source).lstrip()[:4096]
    words = split_words(start.splitlines()[0]) if start else [""]
    if start.startswith(("{", "[")):
        return "coco"
    if re.fullmatch(r"[0-9]+(\.0*)?", words[0]):
        return "mot"
    return "kitti" if not start or (len(words) >= 15 and "frame" not in words) else "csv"
