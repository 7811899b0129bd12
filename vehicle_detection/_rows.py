"""Rows of boxes, checked and rounded, as every file format takes them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vehicle_detection._common import describe
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
