"""Drives: traffic scenarios, rendered as sequences of road scenes with ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from vehicle_detection._common import check
from vehicle_detection.scenes.camera_light import Rng, SceneConfig, SceneView
from vehicle_detection.scenes.render import VehiclePose, VehicleTruth
from vehicle_detection.scenes.scene import RandomState, Scene, SceneRenderer, make_generator
from vehicle_detection.scenes.scenery import LANE, Road
from vehicle_detection.scenes.vehicles import KIND_WEIGHTS, VehicleBody, random_appearance
from vehicle_detection.tables import FrameKey, TrackTable

SCENARIOS = (
    "highway", "overtaking", "crossing", "occlusion", "traffic", "passing", "closing", "cut_in", "empty",
)  # fmt: skip

# Of rough drives: largest pitch and roll of the camera (radians), curvature of the road (1/m) and the time
# (s) between two crests, and fraction of trucks.
_PITCH, _ROLL, _CURVATURE, _CREST_TIME, _TRUCKS = 0.005, 0.013, 1 / 4000, 7.0, 0.1


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
    widening: float = 1.0  # width over that of its kind

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


_CARS = ("hatchback", "estate", "sedan")
# Vehicles of the scenarios with an event in the middle: values of a `TrafficVehicle`, or ranges of them.
# `lanes` are those before and after a change, 1 beside the own one on the side of the event.
_STAGED: dict[str, list[dict[str, Any]]] = {
    "closing": [  # nearest after 4 s, at 9 to 18 m
        {"start": (30.0, 36.0), "sway": (9.0, 10.5), "period": 8.0, "phase": math.pi / 2, "lanes": [0]},
    ],
    "cut_in": [
        {"start": (14.0, 22.0), "speed": (0.0, 0.6), "sway": 0.3, "lanes": [1, 0], "change_for": (2.5, 4.0)},
        {"start": 55.0, "sway": 0.8, "lanes": [-1]},
    ],
    "overtaking": [
        {"start": (-3.0, -1.5), "lanes": [1], "kinds": (*_CARS, "mpv", "suv"),
         "speed": lambda duration: min(max(45 / max(duration, 1.0), 5.0), 9.0)},
        {"start": 70.0, "sway": 1.0, "lanes": [-1]},
    ],
    "crossing": [
        {"start": 20.0, "sway": 0.6, "period": 9.0, "phase": (0, 6), "lanes": [1, -1], "kinds": _CARS},
        {"start": 33.0, "sway": 0.8, "period": 11.0, "phase": (0, 6), "lanes": [0], "kinds": _CARS},
    ],
    "occlusion": [
        {"start": 15.0, "sway": 0.6, "period": 9.0, "phase": (0, 6), "lanes": [1, -1], "change_for": 6.5,
         "kinds": ("suv", "mpv", "van")},
        {"start": 36.0, "sway": 0.8, "period": 11.0, "phase": (0, 6), "lanes": [0], "kinds": _CARS},
    ],
}  # fmt: skip


def make_traffic(scenario: str, duration: float, rng: Rng) -> tuple[Road, list[TrafficVehicle]]:
    """Return road and vehicles of a scenario that lasts `duration` seconds; its event is in the middle."""
    road = Road(own=int(rng.integers(3)) if scenario in ("highway", "traffic", "empty") else 1)
    if scenario == "empty":
        return road, []
    if scenario in ("highway", "traffic"):
        vehicles = _vehicles_ahead(road, rng, duration)
        if scenario == "highway":
            speed = -rng.uniform(48, 58)
            for lane in (-1, -2):  # behind the barrier, visible from 220 m on
                times = _times(rng, 220.0 / speed + rng.uniform(0, 1.5), duration, (1.0, 3.5))
                look = {"lane_from": road.lane(lane), "view": "front", "oncoming": True}
                vehicles += _one_by_one(times, 220.0, speed, rng, len(vehicles) + 1, **look)
        return road, vehicles
    side = 1 if rng.random() < 0.5 else -1
    if scenario == "passing":
        vehicles = []
        for sign in (-1, 1):  # one after the other, beside the camera during the drive
            speed = sign * rng.uniform(6.0, 10.0)
            times = _times(rng, rng.uniform(2.0, 3.0), duration - 2.0, (2.5, 4.0))
            vehicles += _one_by_one(times, 0.0, speed, rng, len(vehicles) + 1, lane_from=-sign * side * LANE)
        return road, vehicles
    return road, [_stage(number, row, side, duration, rng) for number, row in enumerate(_STAGED[scenario], 1)]


def _stage(track: int, row: dict[str, Any], side: int, duration: float, rng: Rng) -> TrafficVehicle:
    """Return a vehicle of `_STAGED`; a lane change is in the middle of the drive."""
    values: dict[str, Any] = {}
    for name, value in row.items():
        if name not in ("lanes", "kinds"):
            drawn = rng.uniform(*value) if isinstance(value, tuple) else value
            values[name] = value(duration) if callable(value) else drawn
    values |= zip(("lane_from", "lane_to"), (side * lane * LANE for lane in row["lanes"]))
    look = random_appearance(rng, row.get("kinds", tuple(KIND_WEIGHTS)))
    return TrafficVehicle(track=track, change_at=duration / 2, **values, **look)


def _vehicles_ahead(road: Road, rng: Rng, duration: float) -> list[TrafficVehicle]:
    """Vehicles in every lane with gaps that their relative motion cannot close."""
    vehicles: list[TrafficVehicle] = []
    for lane in range(road.lanes):
        distance = rng.uniform(20, 30) if lane == road.own else rng.uniform(14, 28)
        for _ in range(int(rng.integers(1, 3))):
            vehicle = TrafficVehicle(
                track=len(vehicles) + 1, start=distance, speed=rng.uniform(-2, 2) / max(duration, 10.0),
                sway=rng.uniform(0.3, 1.0), period=rng.uniform(7, 14), phase=rng.uniform(0, 6),
                lane_from=road.lane(lane), **random_appearance(rng),
            )  # fmt: skip
            vehicles.append(vehicle)
            distance += rng.uniform(20, 36)
    return vehicles


def _times(rng: Rng, first: float, end: float, step: tuple[float, float]) -> Iterator[float]:
    """Yield times with random steps between them."""
    while first < end:
        yield first
        first += rng.uniform(*step)


def _one_by_one(
    times: Iterable[float], place: float, speed: float, rng: Rng, first_track: int, **look: Any
) -> list[TrafficVehicle]:
    """Vehicles at the same speed, each at the distance `place` at its time."""
    return [
        TrafficVehicle(track=track, start=place - speed * time, speed=speed, **look, **random_appearance(rng))
        for track, time in enumerate(times, first_track)
    ]


class Drive:
    """A drive made by `render_drive`; ``drive[i]`` and iteration render `Scene` objects, and none is kept."""

    def __init__(
        self,
        config: SceneConfig,
        road: Road,
        traffic: Sequence[TrafficVehicle],
        *,
        frames: int,
        fps: float,
        rough: bool = False,
    ) -> None:
        self.fps, self.shape = fps, config.shape
        self._frames, self._renderer = frames, SceneRenderer(config, road)
        self._traffic = [
            (v, VehicleBody(v.kind, v.color, v.seed, v.view, config.light, v.widening)) for v in traffic
        ]
        rng = np.random.default_rng([config.seed, 8])
        self._pitch_phases = rng.uniform(0, 2 * np.pi, 3)
        self._roll = _ROLL * rng.uniform(-1, 1) if rough else 0.0
        self._curvature = _CURVATURE if rough else 0.0

    def __repr__(self) -> str:
        height, width = self.shape[:2]
        return f"Drive({self._frames} frames of {width}x{height} at {self.fps:g} Hz)"

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> Scene:
        """Render frame `index`; a negative index counts from the end, a slice is an error."""
        frame = self._check_index(index)
        return self._renderer.scene(*self._state(frame), frame)

    def _check_index(self, index: int) -> int:
        return check.integer(index, "frame number", low=-self._frames, high=self._frames - 1) % self._frames

    def __iter__(self) -> Iterator[Scene]:
        """Render one frame after the other."""
        return (self[index] for index in range(self._frames))

    @cached_property
    def truth(self) -> tuple[tuple[VehicleTruth, ...], ...]:
        """Ground truth of every frame, computed without rendering the images."""
        return tuple(self.truth_of(frame) for frame in range(self._frames))

    @cached_property
    def labels(self) -> TrackTable:
        """Ground truth of every frame as a table; see `truth_table`."""
        return truth_table(dict(enumerate(self.truth)))

    def truth_of(self, index: int) -> tuple[VehicleTruth, ...]:
        """Ground truth of frame `index`, computed without rendering the image."""
        return self._renderer.truth(*self._state(self._check_index(index)))

    def _state(self, frame: int) -> tuple[list[VehiclePose], float, int, float]:
        """Poses of the vehicles that may be visible, distance traveled (m), pitch offset (rows) and roll."""
        time = frame / self.fps
        waves = np.sin(2 * np.pi * frame / self.fps * np.array([1.3, 2.1, 3.7]) + self._pitch_phases)
        # The road rises or falls from below the camera on as a parabola.
        bend = self._curvature * math.sin(2 * math.pi * time / _CREST_TIME + self._pitch_phases[0])
        poses = [
            VehiclePose(
                body, v.track, v.lateral(time), v.distance(time), v.relative_speed(time), v.oncoming,
                bend / 2 * v.distance(time),
            )
            for v, body in self._traffic
            if -12.0 < v.distance(time) < 230.0
        ]  # fmt: skip
        pitch_offset = int(np.rint(self._renderer.config.margin * float(waves @ (0.5, 0.3, 0.2))))
        # The speed of the camera is 27 m/s.
        return poses, 27.0 * time, pitch_offset, self._roll * (1 + 0.4 * float(waves[1]))


def render_drive(
    *,
    frames: int = 250,
    fps: float = 25.0,
    scenario: str = "highway",
    rough: bool = False,
    random_state: RandomState = 0,
    **view: Any,
) -> Drive:
    """Render a drive along a highway at 97 km/h, frame by frame.

    Parameters
    ----------
    frames, fps
        Number of frames, and frames per second.
    scenario
        ``"highway"``: vehicles ahead in three lanes, oncoming ones behind a barrier. ``"overtaking"``: a car
        enters at the left or right edge of the image and pulls away. ``"crossing"``: in the middle of the
        drive a car crosses two lanes in front of another. ``"occlusion"``: the same, closer and slower, so
        that the other car is hidden for about a second. ``"traffic"``: vehicles ahead in three lanes, none
        oncoming. ``"passing"``: vehicles that the camera overtakes in one lane, and that overtake it in
        another. ``"closing"``: the distance to the vehicle ahead shrinks fast, and grows again.
        ``"cut_in"``: a car moves into the lane of the camera. ``"empty"``: no vehicles.
    rough
        Whether vehicles are 1.5 to 2.6 m wide, with trucks among them, the camera rolls by up to a degree,
        and pitches by up to 0.3 degrees, and the vehicles follow crests and dips of a radius of 4 km; the
        surface of the road is drawn level.
    random_state, **view
        As for `render_scene`.

    Examples
    --------
    >>> drive = render_drive(frames=50, shape=(180, 320), scenario="overtaking")
    >>> len(drive), drive[0].image.shape
    (50, (180, 320, 3))
    """
    rng = make_generator(random_state)
    frames = check.integer(frames, "frames", low=1)
    fps = check.number(fps, "fps", low=1.0, high=1000.0)
    check.choice(scenario, "scenario", SCENARIOS)
    rough = check.boolean(rough, "rough")
    config = SceneView(**view).configure(rng)
    road, traffic = make_traffic(scenario, frames / fps, rng)
    if rough:
        config = replace(config, margin=math.ceil(_PITCH * config.camera.focal_px))
        traffic = [_vary(vehicle, rng) for vehicle in traffic]
    return Drive(config, road, traffic, frames=frames, fps=fps, rough=rough)


def _vary(vehicle: TrafficVehicle, rng: Rng) -> TrafficVehicle:
    """Return the vehicle with another width, some of them as trucks."""
    kind = "truck" if rng.random() < _TRUCKS else vehicle.kind
    return replace(vehicle, kind=kind, widening=rng.uniform(0.88, 1.05))


def truth_table(frames: Mapping[FrameKey, Sequence[VehicleTruth]]) -> TrackTable:
    """Return the ground truth of frames, by number or file name, as labels with distances and speeds."""
    keys = [key for key, found in frames.items() for _ in found]
    rows = [row for found in frames.values() for row in found]
    names = ("occluded", "truncated", "distance_m", "speed_mps")
    columns = {name: [getattr(row, name) for row in rows] for name in names}
    columns["ignore"] = [bool(row.ignore) for row in rows]
    boxes = np.array([row.box for row in rows], np.float64).reshape(-1, 4)
    tracks = [row.track for row in rows]
    return TrackTable(keys, tracks, boxes, frame_keys=tuple(frames), **columns)
