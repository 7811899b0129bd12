"""Counts of vehicles met and passed, by minute, and the density of the traffic."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from vehicle_detection._common import check, pluralize
from vehicle_detection.drive.events import Event, Kind, check_events
from vehicle_detection.tables import TrackTable

COUNTED: tuple[Kind, ...] = ("met", "we_overtook", "overtook_us", "passed")
"""Kinds of events that are counted."""


@dataclass(frozen=True, kw_only=True)
class MinuteCounts:
    """Counts of one minute, or of a whole drive."""

    start_s: float
    seconds: float  # duration; the last minute may be shorter
    met: int = 0  # number of these events; see `Event`
    we_overtook: int = 0
    overtook_us: int = 0
    passed: int = 0
    mean_in_view: float = 0.0  # vehicles in view: the density of the traffic as the camera sees it
    max_in_view: int = 0


@dataclass(frozen=True, kw_only=True)
class VehicleCounts:
    """Counts of a drive.

    >>> counts = count_vehicles([], TrackTable(), fps=25)
    >>> counts.vehicles, counts.total.met
    (0, 0)
    """

    vehicles: int  # number of different tracks
    total: MinuteCounts  # of the whole drive
    minutes: tuple[MinuteCounts, ...]  # of each of its minutes

    def summary(self) -> str:
        """Describe the counts in one line, whose subject is the own vehicle."""
        total = self.total
        counts = f"overtook {pluralize(total.we_overtook, 'vehicle')}, was overtaken by {total.overtook_us}"
        counts += f", met {total.met} oncoming"
        counts += f", passed {pluralize(total.passed, 'other')}" if total.passed else ""
        return f"{counts}; {total.mean_in_view:.1f} vehicles in view on average, {total.max_in_view} at most"


def count_vehicles(events: Iterable[Event], table: TrackTable, *, fps: float) -> VehicleCounts:
    """Count the vehicles of a drive, and of each of its minutes.

    Parameters
    ----------
    events, table, fps
        What `find_events` found, and the tracks and the frame rate that it was given.

    Examples
    --------
    >>> from vehicle_detection import TrackTable
    >>> from vehicle_detection.drive import Event
    >>> table = TrackTable()
    >>> for frame in range(3000):
    ...     table.append(frame)
    >>> event = Event(kind="met", track_id=1, frame=1600, start_frame=1580, end_frame=1600, time_s=64.0)
    >>> counts = count_vehicles([event], table, fps=25)
    >>> [minute.met for minute in counts.minutes]
    [0, 1]
    >>> print(counts.summary())
    overtook 0 vehicles, was overtaken by 0, met 1 oncoming; 0.0 vehicles in view on average, 0 at most
    """
    rate = check.number(fps, "fps", above=0, high=1e6)
    check.instance(table, "table", TrackTable, "pass the tracks of the video")
    listed = check_events(events)
    frames = table.counts()
    minutes = math.ceil(len(frames) / rate / 60 - 1e-9)
    edges = [min(round(number * 60 * rate), len(frames)) for number in range(minutes + 1)]
    return VehicleCounts(
        vehicles=len(table.by_track()),
        total=_count(listed, frames, 0, len(frames), rate),
        minutes=tuple(_count(listed, frames, *pair, rate) for pair in pairwise(edges)),
    )


def _count(events: list[Event], frames: Any, start: int, stop: int, fps: float) -> MinuteCounts:
    """Count the events and vehicles of a half-open range of frames."""
    kinds = Counter(event.kind for event in events if start <= event.frame < stop)
    inside = frames[start:stop]
    return MinuteCounts(
        start_s=start / fps,
        seconds=(stop - start) / fps,
        **{kind: kinds[kind] for kind in COUNTED},
        mean_in_view=round(float(inside.mean()), 2) if len(inside) else 0.0,
        max_in_view=int(inside.max(initial=0)),
    )
