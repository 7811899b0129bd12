"""Simulation of a day of 1,000 cameras on a cluster: scheduler, shared storage, records and lost workers.

Each worker takes the next trip when it is free. A trip is read while it is processed, so that it takes the
longer of both; all workers share the storage. The figures of a trip are measured by the other benchmarks.
"""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass

from benchmarks._material import Context
from benchmarks._report import Row

WORKERS = (50, 200, 400, 800, 1600, 3200)


@dataclass(frozen=True)
class Fleet:
    """Cameras, and what a worker, the scheduler and the storage do."""

    cameras: int = 1000
    hours: float = 10.0  # of video from a camera on a day
    trip_s: float = 1200.0
    fps: float = 25.0
    frames_per_s: float = 50.0  # of a worker with one core, for tracks and video
    megabytes_per_s: float = 0.5  # of the cameras, for a second of video
    storage_mb_per_s: float = 1000.0
    dispatch_s: float = 0.001  # of the scheduler, for a trip
    request_s: float = 0.02  # for a part of the storage's list, or a record
    listed: int = 1000  # files in an answer to a request for the list
    parallel: int = 50  # requests for records at the same time
    hours_between_losses: float = 100.0  # mean time until a worker is lost, as on a preemptible machine
    restart_s: float = 60.0

    @property
    def trips(self) -> int:
        """Number of trips of a day."""
        return round(self.cameras * self.hours * 3600 / self.trip_s)


@dataclass(frozen=True)
class Day:
    """Result of a simulation."""

    hours: float
    repeated: int
    core_hours: float


def simulate(fleet: Fleet, workers: int, seed: int = 0) -> Day:
    """Process a day's trips, from the listing of the storage to the last record."""
    rng = random.Random(seed)
    compute = fleet.trip_s * fleet.fps / fleet.frames_per_s
    reading = fleet.trip_s * fleet.megabytes_per_s * workers / fleet.storage_mb_per_s
    service = max(compute, reading) + 5 * fleet.request_s
    listing = fleet.trips * (fleet.request_s / fleet.listed + fleet.request_s / fleet.parallel)
    free = [listing] * workers
    scheduler, repeated, left = listing, 0, fleet.trips
    while left:
        start = max(heapq.heappop(free), scheduler)
        scheduler = start + fleet.dispatch_s
        lost_after = rng.expovariate(1 / (fleet.hours_between_losses * 3600))
        if lost_after < service:
            heapq.heappush(free, start + lost_after + fleet.restart_s)
            repeated += 1
        else:
            heapq.heappush(free, start + service)
            left -= 1
    hours = max(free) / 3600
    return Day(hours, repeated, hours * workers)


def run(context: Context) -> list[Row]:
    """Simulate growing numbers of workers; the cost is that of all cores until the last trip is done."""
    fleet = Fleet()
    material = (
        f"simulated: {fleet.cameras:,} cameras, {fleet.trips:,} trips of {fleet.trip_s / 60:.0f} minutes"
    )
    rows = []
    for workers in WORKERS:
        day = simulate(fleet, workers)
        cost = day.core_hours / (fleet.cameras * fleet.hours)
        details = {"core_hours_per_hour_of_video": cost, "repeated_trips": day.repeated}
        rows.append(
            Row(
                f"day of the fleet, {workers:,} workers",
                day.hours,
                unit="h",
                material=material,
                details=details,
            )
        )
        rows.append(Row(f"core hours for an hour of video, {workers:,} workers", cost, unit="h"))
    return rows
