"""Write the results of videos and images to files, also while they are computed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from typing import Any

from vehicle_detection._common import check_number, encodable
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.export.files import FORMATS, RowFile, check_format, open_row_file
from vehicle_detection.export.rows import (
    DIGITS,
    STILL_COLUMNS,
    TIME_COLUMN,
    TRACK_COLUMNS,
    Row,
    check_items,
    check_row,
    is_result,
    rows_of,
)

_TRACK_FORMATS = (*dict.fromkeys(FORMATS.values()), "yolo")
_BOX_FORMATS = ("csv", "jsonl", "parquet", "coco", "yolo")


def write_tracks(
    results: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002 - the name that pandas and Pillow use
    shape: tuple[int, ...] | None = None,
    fps: float | None = None,
) -> int:
    """Write the tracks of a video to a file; the file appears only when it is complete.

    Parameters
    ----------
    results
        One :class:`FrameResult` for each frame, of which the shown tracks are written; or rows, each a
        mapping or a sequence of ``frame, track_id, x1, y1, x2, y2, score[, distance_m, speed_mps,
        confidence, distance_std_m, speed_std_mps]``; or a pandas table of such rows. The frames of each track
        ascend.
    path, format
        File to write, and its format: ``"csv"``, ``"jsonl"`` (one JSON object per line), ``"parquet"`` (needs
        pyarrow), ``"mot"`` (MOTChallenge text), ``"mot_zip"`` (the archive that CVAT imports as tracks),
        ``"coco"`` (JSON) or ``"yolo"`` (a new folder). None chooses by the suffix: .csv, .jsonl, .ndjson,
        .parquet, .txt, .zip or .json.
    shape
        ``(height, width, ...)`` of a frame, which YOLO and viewers of COCO data sets need.
    fps
        Frame rate, with which tables (CSV, JSON Lines, Parquet) get a last column ``time_s``: the frame's
        number divided by it, as in `write_events`.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    InvalidInputError
        If a row is malformed, a track comes twice in a frame or its frames do not ascend, the format is
        unknown, the frame rate is not a positive number, or the folder is missing or read-only.

    Notes
    -----
    ``frame`` counts from 0, the first processed frame; boxes are half-open pixels with two decimals.
    Unknown values are empty in CSV and null elsewhere. The score is the log-odds above the threshold, the
    confidence a calibrated probability; speeds are relative to the camera.

    MOT files count frames and pixels from 1, as the MOTChallenge tools do, and hold width and height. A COCO
    file is a data set whose image ids are the frame numbers plus 1, whichever frames have tracks; for
    ``COCO.loadRes`` of pycocotools, write ``FrameBoxes.from_results(results)`` with `write_labels`.

    The archive for CVAT holds labels to correct, without scores: ``gt/gt.txt`` with frames from 1 and pixels
    from 0, and ``gt/labels.txt``. A YOLO folder has ``labels/000000.txt`` for each frame, with class, center
    and size as fractions of the frame, confidence and track.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> file = Path(tempfile.mkdtemp()) / "tracks.csv"
    >>> write_tracks([(0, 1, 10, 20, 50.128, 60, 1.5), (1, 1, 12, 20, 52, 60, 1.25, 31.4, -0.5)], file)
    2
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps
    0,1,10.00,20.00,50.13,60.00,1.5000,,,,,
    1,1,12.00,20.00,52.00,60.00,1.2500,31.40,-0.50,,,
    """
    with TrackWriter(path, format=format, shape=shape, fps=fps) as write:
        for item in check_items(results):
            write(item)
    return write.rows


def write_boxes(
    boxes: Iterable[Any],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    shape: tuple[int, ...] | None = None,
) -> int:
    """Write the boxes found in images to a file; the file appears only when it is complete.

    Parameters
    ----------
    boxes
        Pairs of an image's file name and its :class:`Detections`; or rows, each a mapping or a sequence of
        ``frame, track_id, x1, y1, x2, y2, score[, confidence]`` with the file name as ``frame``, and None as
        ``track_id`` unless the boxes are numbered.
    path, format
        As in `write_tracks`, without ``"mot"`` and ``"mot_zip"``. The image ids of a COCO file depend on the
        file names alone; `write_labels` writes boxes with the ids of a ground truth.
    shape
        ``(height, width, ...)`` of the images, which YOLO needs; all of one size.

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
    >>> from pathlib import Path
    >>> file = Path(tempfile.mkdtemp()) / "boxes.csv"
    >>> write_boxes([("road.jpg", Detections([[10, 20, 50, 60]], [1.5], [0.82]))], file)
    1
    >>> print(file.read_text().rstrip())
    frame,track_id,x1,y1,x2,y2,score,confidence
    road.jpg,,10.00,20.00,50.00,60.00,1.5000,0.8200
    """
    kind = check_format(path, format, _BOX_FORMATS)
    count = 0
    with open_row_file(path, kind, STILL_COLUMNS, shape) as file:
        for item in check_items(boxes):
            given: list[Any] = [item]
            if isinstance(item, Sequence) and len(item) == 2 and hasattr(item[1], "scores"):
                name, found = encodable(str(item[0])), item[1]
                file.add_frame(name)
                columns = zip(found.boxes, found.scores, _confidences(found))
                given = [(name, None, *box, score, confidence) for box, score, confidence in columns]
            for row in given:
                file.write(check_row(row, count, stills=True))
                count += 1
    return count


def _confidences(found: Any) -> Sequence[float | None]:
    """Confidence of each detection, None where unknown."""
    known = getattr(found, "confidences", None)
    return [None] * len(found.scores) if known is None else known


class TrackWriter:
    """Write the tracks of a video while it is processed, in constant memory.

    The file appears when the ``with`` block ends without an error; otherwise an existing file is kept.

    Parameters
    ----------
    path, format, shape, fps
        As in `write_tracks`.

    Attributes
    ----------
    rows
        Number of rows written so far.

    Raises
    ------
    InvalidInputError
        If the format is another one, the frame rate is not a positive number, or the folder is missing or
        read-only.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> file = Path(tempfile.mkdtemp()) / "tracks.jsonl"
    >>> with TrackWriter(file) as write:  # then: process_video(..., on_result=write)
    ...     write((0, 1, 10, 20, 50, 60, 1.5))
    >>> print(file.read_text().rstrip())
    {"frame": 0, "track_id": 1, "x1": 10.0, "y1": 20.0, "x2": 50.0, "y2": 60.0, "score": 1.5, \
"distance_m": null, "speed_mps": null, "confidence": null, "distance_std_m": null, "speed_std_mps": null}
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        format: str | None = None,  # noqa: A002
        shape: tuple[int, ...] | None = None,
        fps: float | None = None,
    ) -> None:
        self._kind = check_format(path, format, _TRACK_FORMATS)
        self._fps = None if fps is None else check_number(fps, "fps", above=0, high=1e6)
        self._path, self._shape = path, shape
        self._stack = contextlib.ExitStack()
        self._file: RowFile | None = None
        self._last_frames: dict[int, int] = {}  # by track
        self.rows = 0

    def __enter__(self) -> TrackWriter:
        columns = TRACK_COLUMNS if self._fps is None else (*TRACK_COLUMNS, TIME_COLUMN)
        self._file = self._stack.enter_context(open_row_file(self._path, self._kind, columns, self._shape))
        self._last_frames, self.rows = {}, 0
        return self

    def __call__(self, result: Any) -> None:
        """Write the shown tracks of one frame's result, or one row."""
        if self._file is None:
            raise InvalidInputError(
                "TrackWriter must be called inside its with block; use with TrackWriter(path) as write: ..."
            )
        if is_result(result):
            self._file.add_frame(int(result.index))
        rows = list(rows_of(result, self.rows))
        for row in rows:
            self._check_order(row)
        for row in rows:
            time = None if self._fps is None else round(int(row.frame) / self._fps, DIGITS[TIME_COLUMN])
            self._file.write(row._replace(time_s=time))
        self.rows += len(rows)

    def _check_order(self, row: Row) -> None:
        """Refuse a box of a track, if it has one (not -1), in a frame that is not after its last one."""
        frame, track = row.frame, row.track_id
        assert isinstance(frame, int)
        assert track is not None
        last = self._last_frames.get(track, -1)
        if track >= 0 and frame <= last:
            raise InvalidInputError(
                f"row {self.rows}: frame must be greater than {last}, the last one of track {track}, got "
                f"{frame}; sort rows by frame, write each box once, and each video to a file of its own; "
                "boxes without a track have -1"
            )
        self._last_frames[track] = frame

    def __exit__(self, *error: Any) -> None:
        self._file = None
        self._stack.__exit__(*error)
