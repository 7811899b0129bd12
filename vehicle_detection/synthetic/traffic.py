"""How vehicles move: smooth paths along a straight road, and the scenarios made of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection.synthetic.road import LANE, Road
from vehicle_detection.synthetic.shapes import KIND_SHARES, PAINT_SHARES, draw_share

SCENARIOS = ("highway", "overtaking", "crossing", "occlusion", "empty")

_SEEN_UP_TO = 220.0


@dataclass(frozen=True, kw_only=True)
class Mover:
    """A vehicle's looks and its path relative to the camera; every value is a function of time.

    Attributes
    ----------
    track
        Its number, from 1 on.
    kind, paint, facing, seed
        What it looks like; `facing` is the end that the camera sees, ``"rear"`` or ``"front"``.
    start, speed
        Distance in metres at time 0 and speed away from the camera in m/s.
    sway, period, phase
        Amplitude in metres, period in seconds and phase of a slow closing and falling back.
    lane_from, lane_to
        Lateral positions in metres before and after a lane change.
    change_at, change_for
        Middle and duration of the lane change in seconds.
    oncoming
        True on the other side of the barrier.
    """

    track: int
    kind: str
    paint: str
    facing: str = "rear"
    seed: int = 0
    start: float
    speed: float = 0.0
    sway: float = 0.0
    period: float = 10.0
    phase: float = 0.0
    lane_from: float = 0.0
    lane_to: float | None = None
    change_at: float = 0.0
    change_for: float = 5.0
    oncoming: bool = False

    def distance(self, time: float) -> float:
        """Metres from the camera to where its nearer tyres stand."""
        swing = math.sin(2 * math.pi * time / self.period + self.phase) - math.sin(self.phase)
        return self.start + self.speed * time + self.sway * swing

    def relative_speed(self, time: float) -> float:
        """Return the derivative of `distance` in m/s: positive when it pulls away."""
        turn = 2 * math.pi / self.period
        return self.speed + self.sway * turn * math.cos(turn * time + self.phase)

    def lateral(self, time: float) -> float:
        """Metres from the camera's axis to the vehicle's middle, to the right."""
        wander = 0.12 * math.sin(2 * math.pi * time / (0.8 * self.period) + 2 * self.phase)
        if self.lane_to is None:
            return self.lane_from + wander
        share = min(max((time - self.change_at) / self.change_for + 0.5, 0.0), 1.0)
        return self.lane_from + (self.lane_to - self.lane_from) * share * share * (3 - 2 * share) + wander


def make_traffic(scenario: str, duration: float, rng: np.random.Generator) -> tuple[Road, list[Mover]]:
    """Road and vehicles of a scenario that lasts `duration` seconds; what happens does so in its middle."""
    road = Road(own=int(rng.integers(3)) if scenario in ("highway", "empty") else 1)
    if scenario == "empty":
        return road, []
    if scenario == "highway":
        ahead = _cars_ahead(road, duration, rng)
        return road, ahead + _oncoming(road, duration, rng, first=len(ahead) + 1)
    middle = duration / 2
    if scenario == "overtaking":
        side = 1 if rng.random() < 0.5 else -1
        passing = Mover(
            track=1, start=float(rng.uniform(-3.0, -1.5)), speed=min(max(45 / max(duration, 1.0), 5.0), 9.0),
            lane_from=side * LANE, **_looks(rng, avoid=("truck", "van")),
        )  # fmt: skip
        far = Mover(track=2, start=70.0, sway=1.0, lane_from=-side * LANE, **_looks(rng))
        return road, [passing, far]
    side = 1 if rng.random() < 0.5 else -1
    crossing = scenario == "crossing"
    near = Mover(
        track=1, start=20.0 if crossing else 15.0, sway=0.6, period=9.0, phase=float(rng.uniform(0, 6)),
        lane_from=side * LANE, lane_to=-side * LANE, change_at=middle, change_for=5.0 if crossing else 6.5,
        **_looks(rng, only=("hatchback", "estate", "sedan") if crossing else ("suv", "mpv", "van")),
    )  # fmt: skip
    far = Mover(
        track=2, start=33.0 if crossing else 36.0, sway=0.8, period=11.0, phase=float(rng.uniform(0, 6)),
        **_looks(rng, only=("hatchback", "sedan", "estate")),
    )  # fmt: skip
    return road, [near, far]


def _looks(
    rng: np.random.Generator, only: tuple[str, ...] = (), avoid: tuple[str, ...] = ()
) -> dict[str, Any]:
    shares = {
        key: share for key, share in KIND_SHARES.items() if key not in avoid and (not only or key in only)
    }
    return {
        "kind": draw_share(shares, rng),
        "paint": draw_share(PAINT_SHARES, rng),
        "seed": int(rng.integers(2**31)),
    }


def _cars_ahead(road: Road, duration: float, rng: np.random.Generator) -> list[Mover]:
    """Cars in every lane with gaps that their swaying and drifting cannot close."""
    movers: list[Mover] = []
    for lane in range(road.lanes):
        distance = float(rng.uniform(20, 30) if lane == road.own else rng.uniform(14, 28))
        for _ in range(int(rng.integers(1, 3))):
            movers.append(
                Mover(
                    track=len(movers) + 1, start=distance,
                    speed=float(rng.uniform(-2, 2)) / max(duration, 10.0),
                    sway=float(rng.uniform(0.3, 1.0)), period=float(rng.uniform(7, 14)),
                    phase=float(rng.uniform(0, 6)), lane_from=road.lane(lane), **_looks(rng),
                )
            )  # fmt: skip
            distance += float(rng.uniform(20, 36))
    return movers


def _oncoming(road: Road, duration: float, rng: np.random.Generator, first: int) -> list[Mover]:
    """Cars that come along behind the barrier, one after the other in two lanes."""
    movers: list[Mover] = []
    speed = -float(rng.uniform(48, 58))
    for lane in (-1, -2):
        time = -_SEEN_UP_TO / -speed + float(rng.uniform(0, 1.5))
        while time < duration:
            movers.append(
                Mover(
                    track=first + len(movers), start=_SEEN_UP_TO - speed * time, speed=speed,
                    lane_from=road.lane(lane), facing="front", oncoming=True, **_looks(rng),
                )
            )  # fmt: skip
            time += float(rng.uniform(1.0, 3.5))
    return movers
