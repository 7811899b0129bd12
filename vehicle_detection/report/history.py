"""What a report keeps of a run: a few numbers for each vehicle of each frame, and no frame."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

Floats = NDArray[np.float64]

COLUMNS = ("distance_m", "distance_std_m", "speed_mps", "speed_std_mps", "score")
"""What is kept of a track in each frame; NaN where it is unknown."""

NEAREST_SECONDS = 1 / 3
"""A nearest approach is a median over this time: a single frame does not make one."""

_BOUND = 1e9


class Nearest(NamedTuple):
    """How near a vehicle came: in which frame, meters, and their standard error (NaN if unknown)."""

    frame: int
    meters: float
    error: float


@dataclass(frozen=True, eq=False)
class TrackHistory:
    """A vehicle over the whole video.

    Attributes
    ----------
    id
        Its number.
    frames
        ``(N,)`` int64, the frames in which it was shown, counted from 0, ascending.
    columns
        For each name of ``COLUMNS``, ``(N,)`` float64.
    """

    id: int
    frames: NDArray[np.int64]
    columns: dict[str, Floats]

    @property
    def first(self) -> int:
        """First frame that shows it."""
        return int(self.frames[0])

    @property
    def last(self) -> int:
        """Last frame that shows it."""
        return int(self.frames[-1])

    def spans(self, gap: int = 1) -> list[tuple[int, int]]:
        """Return the runs of frames that show it, half-open; up to `gap` frames apart they are one."""
        ends = np.flatnonzero(np.diff(self.frames) > gap)
        starts = [0, *(ends + 1)]
        return [
            (int(self.frames[start]), int(self.frames[stop]) + 1)
            for start, stop in zip(starts, [*ends, len(self.frames) - 1])
        ]

    def nearest(self, fps: float) -> Nearest | None:
        """Return the least distance, as a median over ``NEAREST_SECONDS``; None where none is known."""
        meters, errors = self.columns["distance_m"], self.columns["distance_std_m"]
        known = np.flatnonzero(np.isfinite(meters))
        if not known.size:
            return None
        width = min(max(round(NEAREST_SECONDS * fps), 1), known.size)
        medians = np.median(np.lib.stride_tricks.sliding_window_view(meters[known], width), axis=1)
        start = int(np.argmin(medians))
        window = known[start : start + width]
        # The frame of the window that is most like its median, where the video is to stop.
        place = window[int(np.argmin(np.abs(meters[window] - medians[start])))]
        return Nearest(int(self.frames[place]), float(medians[start]), float(np.median(errors[window])))


class TrackLog:
    """Collects the vehicles of each frame; 48 bytes for each that is shown.

    Attributes
    ----------
    first_time
        Time of the first frame in the source in seconds, None where it is not known.
    counts
        Number of vehicles shown in each frame so far.
    """

    def __init__(self) -> None:
        self.first_time: float | None = None
        self.counts = array("q")
        self._columns: dict[int, tuple[array[int], dict[str, array[float]]]] = {}

    def add(self, index: int, time: float | None, tracks: Iterable[Any]) -> None:
        """Take the tracks of the next frame."""
        expected = len(self.counts)
        if check_integer(index, "frame_index", low=0) != expected:
            raise InvalidInputError(
                f"frame_index must be {expected}, as frames come one by one from 0; got {index}; "
                "use a new writer for another video"
            )
        if time is not None:
            check_number(time, "time", low=-1e12, high=1e12)
        rows = list(_rows(tracks))
        if not expected:
            self.first_time = time
        self.counts.append(len(rows))
        for number, values in rows:
            if number not in self._columns:
                self._columns[number] = (array("q"), {name: array("d") for name in COLUMNS})
            frames, columns = self._columns[number]
            frames.append(expected)
            for name, value in zip(COLUMNS, values):
                columns[name].append(value)

    def histories(self) -> list[TrackHistory]:
        """Return the vehicles, in the order in which they appeared."""
        found = (
            TrackHistory(
                number,
                np.array(frames, np.int64),
                {name: np.array(column, np.float64) for name, column in columns.items()},
            )
            for number, (frames, columns) in self._columns.items()
        )
        return sorted(found, key=lambda track: (track.first, track.id))


def _rows(tracks: object) -> Iterator[tuple[int, list[float]]]:
    if isinstance(tracks, (str, bytes)) or not isinstance(tracks, Iterable):
        raise InvalidInputError(f"tracks must be Track objects, got {describe(tracks)}; pass result.tracks")
    seen = set()
    for track in tracks:
        if not hasattr(track, "id"):
            raise InvalidInputError(
                f"tracks must be Track objects, got {describe(track)}; pass result.tracks"
            )
        if not getattr(track, "shown", True):
            continue
        number = check_integer(track.id, "track.id", low=0)
        if number in seen:
            raise InvalidInputError(
                f"tracks must have an id each, got {number} twice in one frame; pass result.tracks"
            )
        seen.add(number)
        yield number, [_number(getattr(track, name, None), name) for name in COLUMNS]


def _number(value: Any, name: str) -> float:
    """Return a value of a track as a float; NaN where it is unknown or beyond all use."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise InvalidInputError(f"track.{name} must be a number or None, got {describe(value)}; drop it")
    try:
        number = float(value)
    except OverflowError:
        return math.nan
    return number if abs(number) < _BOUND else math.nan


def binned(frames: NDArray[np.int64], values: Floats, step: int) -> tuple[NDArray[np.int64], Floats]:
    """Take the mean of the known values in each run of `step` frames.

    Returns
    -------
    tuple of numpy.ndarray
        Numbers of the runs that hold a known value, ascending, and the mean in each.

    Examples
    --------
    >>> bins, means = binned(np.arange(5), np.array([1.0, 3.0, np.nan, np.nan, 7.0]), 2)
    >>> bins.tolist(), means.tolist()
    ([0, 2], [2.0, 7.0])
    """
    known = np.isfinite(values)
    bins, place, counts = np.unique(frames[known] // step, return_inverse=True, return_counts=True)
    return bins, np.bincount(place, values[known], len(bins)) / counts


def runs(bins: NDArray[np.int64]) -> list[slice]:
    """Slices of the stretches in which numbers follow each other without a gap.

    Examples
    --------
    >>> [(part.start, part.stop) for part in runs(np.array([3, 4, 5, 9]))]
    [(0, 3), (3, 4)]
    """
    edges = [0, *(np.flatnonzero(np.diff(bins) > 1) + 1).tolist(), len(bins)]
    return [slice(start, stop) for start, stop in pairwise(edges) if stop > start]
