"""The track table of a video: a few numbers per track and frame, and no images."""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check_integer, check_number, check_type, describe, pluralize
from vehicle_detection.drawing import color_index
from vehicle_detection.drive.own_speed import OwnSpeed
from vehicle_detection.errors import InvalidInputError

BOX_COLUMNS = ("x1", "y1", "x2", "y2")
COLUMNS = (
    "distance_m",
    "distance_std_m",
    "speed_mps",
    "speed_std_mps",
    "confidence",
    "time_since_update",
    *BOX_COLUMNS,
)
"""Values of a track that are kept for each frame; NaN if unknown."""


class ClosestApproach(NamedTuple):
    """Smallest distance of a track."""

    frame: int
    distance_m: float
    std_m: float | None


@dataclass(frozen=True, eq=False)
class TrackHistory:
    """One track over the whole video."""

    id: int
    frames: NDArray[np.int64]  # (N,) indices of the frames that show the track, ascending
    columns: dict[str, Floats]  # (N,) for each name of COLUMNS
    times: Floats | None = None  # (N,) seconds; None: frames are evenly spaced

    @property
    def first(self) -> int:
        """First frame that shows the track."""
        return int(self.frames[0])

    @property
    def last(self) -> int:
        """Last frame that shows the track."""
        return int(self.frames[-1])

    @property
    def color(self) -> int:
        """Index of the track's color in `TRACK_COLORS`, as in the video."""
        return color_index(self.id)

    @property
    def boxes(self) -> Floats:
        """``(N, 4)`` boxes ``[x1, y1, x2, y2]``; NaN if unknown."""
        return np.stack([self.columns[name] for name in BOX_COLUMNS], axis=1)

    @property
    def mean_confidence(self) -> float | None:
        """Mean of the known confidences; None if none is known."""
        confidences = self.columns["confidence"]
        known = confidences[np.isfinite(confidences)]
        return float(known.mean()) if known.size else None

    def spans(self, max_step: int = 1) -> list[tuple[int, int]]:
        """Half-open ranges of frames that show the track; frames up to `max_step` apart share a range."""
        runs = [self.frames[run] for run in split_runs(self.frames, max_step)]
        return [(int(run[0]), int(run[-1]) + 1) for run in runs]

    def closest_approach(self, fps: float) -> ClosestApproach | None:
        """Minimum of the running median of the distance; None if no distance is known."""
        distances, stds = self.columns["distance_m"], self.columns["distance_std_m"]
        known = np.flatnonzero(np.isfinite(distances))
        if not known.size:
            return None
        # A median over a third of a second, so that a single outlier does not count.
        width = min(max(round(1 / 3 * fps), 1), known.size)
        width -= 1 - width % 2  # so that the median is the distance of one frame
        medians = np.median(np.lib.stride_tricks.sliding_window_view(distances[known], width), axis=1)
        start = int(np.argmin(medians))
        window = known[start : start + width]
        # The frame to seek to: the one whose distance is closest to the median.
        best = window[int(np.argmin(np.abs(distances[window] - medians[start])))]
        std = float(np.median(stds[window]))
        frame, distance = int(self.frames[best]), float(medians[start])
        return ClosestApproach(frame, distance, std if math.isfinite(std) else None)


class TrackLog:
    """Collect the shown tracks of a video while it is processed, 88 bytes for each track and frame.

    Examples
    --------
    >>> from vehicle_detection import Detections, Tracker
    >>> tracker, log = Tracker(fps=25), TrackLog()
    >>> for frame in range(50):  # or: process_video(..., on_result=log)
    ...     found = Detections([[600, 400, 700 + frame, 490 + frame]], [1.0])
    ...     log.add(frame, frame / 25, tracker.update(found, (720, 1280, 3)))
    >>> len(log.counts), [track.id for track in log.histories()]
    (50, [1])
    """

    def __init__(self) -> None:
        self.first_time: float | None = None  # of the first frame in the source, in seconds
        self.counts = array("q")  # shown tracks in each frame
        self._times = array("d")  # of each frame; NaN if unknown
        # Frames and columns of each track.
        self._tracks: defaultdict[int, list[array[Any]]] = defaultdict(_empty_columns)

    def __repr__(self) -> str:
        return f"TrackLog({pluralize(len(self._tracks), 'track')} in {pluralize(len(self.counts), 'frame')})"

    def __call__(self, result: Any) -> None:
        """Add one frame's result: for ``process_video(..., on_result=log)``."""
        self.add(result.index, result.time, result.tracks)

    def add(self, index: int, time: float | None, tracks: Iterable[Any]) -> None:
        """Add the shown tracks of the next frame.

        Parameters
        ----------
        index
            Number of the frame, counted from 0; those that a live source dropped are left out.
        time
            Time of the frame in the source in seconds; None if unknown.
        tracks
            `Track` objects; those that are not shown are skipped.

        Raises
        ------
        InvalidInputError
            If a frame is repeated, two tracks have the same id, or an argument is malformed.
        """
        expected = len(self.counts)
        if check_integer(index, "index", low=0) < expected:
            raise InvalidInputError(
                f"index must be at least {expected}, as frames are added in order; got {index}; "
                "use a new TrackLog for another video"
            )
        if time is not None:
            check_number(time, "time", low=-1e12, high=1e12)
        rows = list(_rows(tracks))
        if not expected:
            self.first_time = time
        # Of frames that a live source dropped, a written video shows the last one before again.
        self.counts.extend([self.counts[-1] if expected else 0] * (index - expected))
        self.counts.append(len(rows))
        self._times.extend([math.nan] * (index - expected))
        self._times.append(math.nan if time is None else float(time))
        for track_id, values in rows:
            for column, value in zip(self._tracks[track_id], (index, *values)):
                column.append(value)

    def own_speeds(self, speed: OwnSpeed, fps: float) -> Floats:
        """Speed of the own vehicle in each frame.

        Parameters
        ----------
        speed
            Speed over the time of the source, as `read_own_speed` returns it.
        fps
            Frame rate, for frames that were added without a time.

        Returns
        -------
        numpy.ndarray
            ``(len(counts),)`` float64 in m/s; NaN where the speed is unknown.

        Raises
        ------
        InvalidInputError
            If `speed` is something else, or the frame rate is not a positive number.
        """
        check_type(speed, "speed", OwnSpeed, "pass what read_own_speed returns")
        rate = check_number(fps, "fps", above=0, high=1e6)
        times = self._frame_times()
        if times is None:
            times = (self.first_time or 0.0) + np.arange(len(self.counts)) / rate
        return speed.at(times)

    def histories(self) -> list[TrackHistory]:
        """Return the tracks in the order of their first frames."""
        times = self._frame_times()
        histories = []
        for track_id, (numbers, *columns) in self._tracks.items():
            frames, values = np.array(numbers), dict(zip(COLUMNS, map(np.array, columns)))
            histories.append(TrackHistory(track_id, frames, values, None if times is None else times[frames]))
        return sorted(histories, key=lambda track: (track.first, track.id))

    def _frame_times(self) -> Floats | None:
        """Return the time of each frame, interpolated where it is unknown or does not ascend.

        None if that is so for most frames, for the first one or for the last one.
        """
        times = np.array(self._times)
        known = np.isfinite(times)
        latest = np.maximum.accumulate(np.where(known, times, -np.inf))
        known[1:] &= times[1:] > latest[:-1]
        rows = np.flatnonzero(known)
        if 2 * rows.size <= times.size or not known[0] or not known[-1]:
            return None
        return np.asarray(np.interp(np.arange(times.size), rows, times[rows]))


def _empty_columns() -> list[array[Any]]:
    """Frames and columns of a new track."""
    return [array("q"), *(array("d") for _ in COLUMNS)]


def _rows(tracks: object) -> Iterator[tuple[int, list[float]]]:
    """Id and values of `COLUMNS` of each shown track."""
    seen = set()
    for track in [tracks] if isinstance(tracks, str) or not isinstance(tracks, Iterable) else tracks:
        if not hasattr(track, "id"):
            raise InvalidInputError(
                f"tracks must be Track objects, got {describe(track)}; pass result.tracks"
            )
        if not getattr(track, "shown", True):
            continue
        track_id = check_integer(track.id, "track.id", low=0)
        if track_id in seen:
            raise InvalidInputError(
                f"tracks must have unique ids, got {track_id} twice in one frame; pass result.tracks"
            )
        seen.add(track_id)
        box = dict(zip(BOX_COLUMNS, getattr(track, "box", ())))
        yield track_id, [_number(box.get(name, getattr(track, name, None)), name) for name in COLUMNS]


def _number(value: Any, name: str) -> float:
    """Return a value of a track as a float; NaN if it is unknown, infinite or absurdly large."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise InvalidInputError(f"track.{name} must be a number or None, got {describe(value)}; omit it")
    return float(value) if -1e9 < value < 1e9 else math.nan


def bin_means(frames: NDArray[np.int64], values: Floats, width: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the bins of `width` frames that have known values, and the means of these values."""
    known = np.isfinite(values)
    bins, inverse, counts = np.unique(frames[known] // width, return_inverse=True, return_counts=True)
    return bins, np.bincount(inverse, values[known], len(bins)) / counts


def split_runs(numbers: NDArray[np.int64], max_step: int = 1) -> list[slice]:
    """Slices of an ascending array in which each number is at most `max_step` above the one before."""
    edges = [0, *(np.flatnonzero(np.diff(numbers) > max_step) + 1).tolist(), len(numbers)]
    return [slice(start, stop) for start, stop in pairwise(edges) if stop > start]
