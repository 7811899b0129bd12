"""One track over a video, and the runs and means of its frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.drawing import color_index
from vehicle_detection.tables import TrackTable

COLUMNS = ("distance_m", "distance_std_m", "speed_mps", "speed_std_mps", "confidence", "time_since_update")
"""Values of a track in each frame; NaN if unknown."""


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
    boxes: Floats  # (N, 4) [x1, y1, x2, y2]; NaN if unknown
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


def track_histories(table: TrackTable) -> list[TrackHistory]:
    """Return the tracks of a table in the order of their first frames."""
    times = table.times()
    histories = []
    for track_id, rows in table.by_track().items():
        frames, columns = rows["frame"].astype(np.int64), {name: rows[name] for name in COLUMNS}
        of_frames = None if times is None else times[frames]
        histories.append(TrackHistory(track_id, frames, rows.boxes, columns, of_frames))
    return histories


def bin_means(frames: NDArray[np.int64], values: Floats, width: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the bins of `width` frames that have known values, and the means of these values."""
    known = np.isfinite(values)
    bins, inverse, counts = np.unique(frames[known] // width, return_inverse=True, return_counts=True)
    return bins, np.bincount(inverse, values[known], len(bins)) / counts


def split_runs(numbers: NDArray[np.int64], max_step: int = 1) -> list[slice]:
    """Slices of an ascending array in which each number is at most `max_step` above the one before."""
    edges = [0, *(np.flatnonzero(np.diff(numbers) > max_step) + 1).tolist(), len(numbers)]
    return [slice(start, stop) for start, stop in pairwise(edges) if stop > start]
