"""Traffic scenarios: which vehicles take part in a drive, and how they move."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection.synthetic.scenery import LANE, Road
from vehicle_detection.synthetic.shapes import COLOR_WEIGHTS, KIND_WEIGHTS, weighted_choice

SCENARIOS = ("highway", "overtaking", "crossing", "occlusion", "empty")


@dataclass(frozen=True, kw_only=True)
class TrafficVehicle:
    """A vehicle's appearance, and its path relative to the camera as a function of time."""

    track: int  # from 1 on
    kind: str
    color: str
    view: str = "rear"  # the end that the camera sees
    seed: int = 0
    start: float  # distance at time 0 (m)
    speed: float = 0.0  # mean speed away from the camera (m/s)
    sway: float = 0.0  # amplitude (m), period (s) and phase of an oscillation of the distance
    period: float = 10.0
    phase: float = 0.0
    lane_from: float = 0.0  # lateral position before and after a lane change (m)
    lane_to: float | None = None
    change_at: float = 0.0  # middle and duration of the lane change (s)
    change_for: float = 5.0
    oncoming: bool = False

    def distance(self, time: float) -> float:
        """Distance from the camera to the nearer tires (m)."""
        swing = math.sin(2 * math.pi * time / self.period + self.phase) - math.sin(self.phase)
        return self.start + self.speed * time + self.sway * swing

    def relative_speed(self, time: float) -> float:
        """Return the derivative of `distance` (m/s): positive when the vehicle pulls away."""
        omega = 2 * math.pi / self.period
        return self.speed + self.sway * omega * math.cos(omega * time + self.phase)

    def lateral(self, time: float) -> float:
        """Lateral position of its middle (m), positive to the right of the camera."""
        drift = 0.12 * math.sin(2 * math.pi * time / (0.8 * self.period) + 2 * self.phase)
        if self.lane_to is None:
            return self.lane_from + drift
        t = min(max((time - self.change_at) / self.change_for + 0.5, 0.0), 1.0)
        return self.lane_from + (self.lane_to - self.lane_from) * t * t * (3 - 2 * t) + drift


def make_traffic(
    scenario: str, duration: float, rng: np.random.Generator
) -> tuple[Road, list[TrafficVehicle]]:
    """Return road and vehicles of a scenario that lasts `duration` seconds; its event is in the middle."""
    road = Road(own=int(rng.integers(3)) if scenario in ("highway", "empty") else 1)
    if scenario == "empty":
        return road, []
    if scenario == "highway":
        ahead = _vehicles_ahead(road, duration, rng)
        return road, ahead + _oncoming_vehicles(road, duration, rng, first_track=len(ahead) + 1)
    side = 1 if rng.random() < 0.5 else -1
    if scenario == "overtaking":
        return road, [
            TrafficVehicle(
                track=1, start=float(rng.uniform(-3.0, -1.5)), lane_from=side * LANE,
                speed=min(max(45 / max(duration, 1.0), 5.0), 9.0),
                **_random_appearance(rng, ("hatchback", "estate", "sedan", "mpv", "suv")),
            ),
            TrafficVehicle(track=2, start=70.0, sway=1.0, lane_from=-side * LANE, **_random_appearance(rng)),
        ]  # fmt: skip
    if scenario == "crossing":
        near_start, far_start, change_for, kinds = 20.0, 33.0, 5.0, ("hatchback", "estate", "sedan")
    else:
        near_start, far_start, change_for, kinds = 15.0, 36.0, 6.5, ("suv", "mpv", "van")
    return road, [
        TrafficVehicle(
            track=1, start=near_start, sway=0.6, period=9.0, phase=float(rng.uniform(0, 6)),
            lane_from=side * LANE, lane_to=-side * LANE, change_at=duration / 2, change_for=change_for,
            **_random_appearance(rng, kinds),
        ),
        TrafficVehicle(
            track=2, start=far_start, sway=0.8, period=11.0, phase=float(rng.uniform(0, 6)),
            **_random_appearance(rng, ("hatchback", "sedan", "estate")),
        ),
    ]  # fmt: skip


def _random_appearance(
    rng: np.random.Generator, kinds: tuple[str, ...] = tuple(KIND_WEIGHTS)
) -> dict[str, Any]:
    weights = {kind: weight for kind, weight in KIND_WEIGHTS.items() if kind in kinds}
    return {
        "kind": weighted_choice(weights, rng),
        "color": weighted_choice(COLOR_WEIGHTS, rng),
        "seed": int(rng.integers(2**31)),
    }


def _vehicles_ahead(road: Road, duration: float, rng: np.random.Generator) -> list[TrafficVehicle]:
    """Vehicles in every lane with gaps that their relative motion cannot close."""
    vehicles: list[TrafficVehicle] = []
    for lane in range(road.lanes):
        distance = float(rng.uniform(20, 30) if lane == road.own else rng.uniform(14, 28))
        for _ in range(int(rng.integers(1, 3))):
            vehicles.append(
                TrafficVehicle(
                    track=len(vehicles) + 1, start=distance,
                    speed=float(rng.uniform(-2, 2)) / max(duration, 10.0),
                    sway=float(rng.uniform(0.3, 1.0)), period=float(rng.uniform(7, 14)),
                    phase=float(rng.uniform(0, 6)), lane_from=road.lane(lane), **_random_appearance(rng),
                )
            )  # fmt: skip
            distance += float(rng.uniform(20, 36))
    return vehicles


def _oncoming_vehicles(
    road: Road, duration: float, rng: np.random.Generator, first_track: int
) -> list[TrafficVehicle]:
    """Vehicles behind the barrier, one after the other in two lanes, visible from 220 m on."""
    vehicles: list[TrafficVehicle] = []
    visible_from = 220.0
    speed = -float(rng.uniform(48, 58))
    for lane in (-1, -2):
        time = -visible_from / -speed + float(rng.uniform(0, 1.5))
        while time < duration:
            vehicles.append(
                TrafficVehicle(
                    track=first_track + len(vehicles), start=visible_from - speed * time, speed=speed,
                    lane_from=road.lane(lane), view="front", oncoming=True, **_random_appearance(rng),
                )
            )  # fmt: skip
            time += float(rng.uniform(1.0, 3.5))
    return vehicles
