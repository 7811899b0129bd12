"""Rows of tables: one box of one frame each, checked and rounded."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import check_number, describe, is_listing
from vehicle_detection.errors import InvalidInputError

BOX_COLUMNS = ("frame", "track_id", "x1", "y1", "x2", "y2", "score")
"""Columns that every row has."""
STILL_COLUMNS = (*BOX_COLUMNS, "confidence")
TRACK_COLUMNS = (*BOX_COLUMNS, "distance_m", "speed_mps", "confidence", "distance_std_m", "speed_std_mps")

TIME_COLUMN = "time_s"
"""Last column of a table of tracks whose frame rate is known."""

DIGITS = dict(zip((*TRACK_COLUMNS[2:], TIME_COLUMN), (2, 2, 2, 2, 4, 2, 2, 4, 2, 2, 3)))
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
    time_s: float | None = None
    ignore: bool = False
    visible: float = 1.0


def check_items(items: object) -> Iterator[Any]:
    """Iterate over results or rows; a pandas table gives its rows as mappings."""
    if hasattr(items, "to_dict") and hasattr(items, "columns"):
        return iter(items.to_dict("records"))
    if isinstance(items, Mapping) or not is_listing(items):
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
    return [check_row(row, number + place) for place, row in enumerate(rows)]


def rows_of(item: Any, number: int) -> list[Row]:
    """Rows of a frame's result; a row stays one row."""
    return track_rows(item, number) if is_result(item) else [check_row(item, number)]


def check_row(item: Any, number: int, *, stills: bool = False) -> Row:
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


def without_noise(value: float) -> float:
    """Drop the rounding error of a sum or difference of coordinates: 50.25 - 10.1 becomes 40.15."""
    return round(value, 9)
