"""Road scenes, drives and patches with exact truth, drawn by the project itself.

A pinhole camera looks along a flat, straight road; vehicles are painted bodies in true perspective. So every
box, distance and speed is known, and nobody's photographs are needed to try, test and show the pipeline.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check_choice, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.synthetic.patches import draw_patches
from vehicle_detection.synthetic.render import Placed, VehicleTruth
from vehicle_detection.synthetic.scene import RandomState, Scene, Studio, View, make_generator, make_view
from vehicle_detection.synthetic.scenery import LANE, Road
from vehicle_detection.synthetic.shapes import DESIGNS, KIND_SHARES, PAINT_SHARES, PAINTS, draw_share
from vehicle_detection.synthetic.vehicles import Car

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
        Distance in meters at time 0 and speed away from the camera in m/s.
    sway, period, phase
        Amplitude in meters, period in seconds and phase of a slow closing and falling back.
    lane_from, lane_to
        Lateral positions in meters before and after a lane change.
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


_CAMERA_SPEED = 27.0

LABEL_COLUMNS = (
    "frame", "track", "x1", "y1", "x2", "y2", "occluded", "truncated", "ignore", "distance_m", "speed_mps",
)  # fmt: skip
"""Columns of a labels file; the first nine are those of hand-drawn labels."""


@dataclass(frozen=True, kw_only=True)
class SceneVehicle:
    """A vehicle to place in a scene; what is None is drawn at random.

    Attributes
    ----------
    distance_m
        Metres along the road to where its nearer tyres stand.
    lateral_m
        Metres from the camera's axis to its middle, to the right. A lane is 3.6 m wide.
    kind
        One of ``"hatchback"``, ``"estate"``, ``"sedan"``, ``"mpv"``, ``"suv"``, ``"van"``, ``"truck"``.
    paint
        One of ``"white"``, ``"silver"``, ``"gray"``, ``"anthracite"``, ``"black"``, ``"navy"``, ``"blue"``,
        ``"ice"``, ``"red"``, ``"wine"``, ``"green"``, ``"beige"``, ``"brown"``, ``"yellow"``.
    facing
        The end that the camera sees: ``"rear"`` or ``"front"``.
    speed_mps
        Speed away from the camera; only the truth tells it.
    """

    distance_m: float
    lateral_m: float = 0.0
    kind: str | None = None
    paint: str | None = None
    facing: str = "rear"
    speed_mps: float = 0.0

    def __post_init__(self) -> None:
        check_number(self.distance_m, "distance_m", low=2.0, high=1000.0)
        check_number(self.lateral_m, "lateral_m", low=-100.0, high=100.0)
        if self.kind is not None:
            check_choice(self.kind, "kind", DESIGNS)
        if self.paint is not None:
            check_choice(self.paint, "paint", PAINTS)
        check_choice(self.facing, "facing", ("rear", "front"))
        check_number(self.speed_mps, "speed_mps", low=-150.0, high=150.0)


def render_scene(
    *,
    shape: tuple[int, int] = (720, 1280),
    vehicles: Sequence[SceneVehicle] | int | None = None,
    lane: int | None = None,
    horizon: float = 0.56,
    camera_height: float = 1.3,
    focal: float | None = None,
    light: str = "day",
    rain: float = 0.0,
    jpeg_quality: int | None = None,
    random_state: RandomState = 0,
) -> Scene:
    """Draw one road scene.

    Parameters
    ----------
    shape
        ``(height, width)`` in pixels.
    vehicles
        The vehicles to draw, or how many to place at random in the lanes ahead; None takes one to five.
    lane
        The lane of the three that the camera drives in: 0 left, 1 middle, 2 right; None draws one.
    horizon
        Row of the horizon as a share of the height.
    camera_height
        Metres from the road to the camera.
    focal
        Focal length in pixels; None takes 0.9 times the longer side.
    light
        ``"day"``, ``"overcast"``, ``"dusk"`` or ``"night"``.
    rain
        0 dry to 1 heavy: streaks, haze, less contrast, more noise.
    jpeg_quality
        Quality of a JPEG file that the picture goes through, or None for none.
    random_state
        Seed or generator; the same seed and options give the same bytes.

    Returns
    -------
    Scene
        Picture and truth. The `track` of a vehicle is its place in `vehicles`, from 1 on.

    Raises
    ------
    InvalidInputError
        If an option is out of range; the message names it.

    Examples
    --------
    >>> car = SceneVehicle(distance_m=20.0, kind="sedan", paint="white")
    >>> scene = render_scene(shape=(360, 640), vehicles=[car], random_state=1)
    >>> scene.image.shape, scene.truth[0].track, scene.truth[0].distance_m
    ((360, 640, 3), 1, 20.0)
    >>> x1, y1, x2, y2 = scene.truth[0].box
    >>> abs(scene.camera.foot_row(20.0) - y2) <= 1
    True
    """
    rng = make_generator(random_state)
    view = make_view(shape, horizon, camera_height, focal, light, rain, jpeg_quality, rng)
    own = int(rng.integers(3))
    road = Road(own=own if lane is None else check_integer(lane, "lane", low=0, high=2))
    if vehicles is None:
        vehicles = int(rng.integers(1, 6))
    if isinstance(vehicles, (int, np.integer)):
        vehicles = _scatter(road, check_integer(vehicles, "vehicles", low=0, high=60), rng)
    studio = Studio(view, road)
    placed = []
    for track, wanted in enumerate(vehicles, start=1):
        if not isinstance(wanted, SceneVehicle):
            raise InvalidInputError(
                f"vehicles[{track - 1}] must be a SceneVehicle, got {describe(wanted)}; "
                "make one with SceneVehicle(distance_m=20)"
            )
        # Looks depend on the seed and the place in the list alone: a vehicle less changes no other.
        dice = np.random.default_rng([view.seed, 5, track])
        kind, paint = draw_share(KIND_SHARES, dice), draw_share(PAINT_SHARES, dice)
        car = studio.car(wanted.kind or kind, wanted.paint or paint, wanted.facing, int(dice.integers(2**31)))
        placed.append(
            Placed(car, track, float(wanted.lateral_m), float(wanted.distance_m), float(wanted.speed_mps))
        )
    travel = float(np.random.default_rng([view.seed, 6]).uniform(0, 200))
    return studio.scene(placed, travel, frame=0)


def _scatter(road: Road, count: int, rng: np.random.Generator) -> list[SceneVehicle]:
    """Vehicles in the lanes ahead that do not stand in each other."""
    ends = [
        float(rng.uniform(12, 24)) if lane != road.own else float(rng.uniform(18, 32))
        for lane in range(road.lanes)
    ]
    found = []
    for _ in range(count):
        lane = int(rng.integers(road.lanes)) if rng.random() < 0.5 else int(np.argmin(ends))
        lateral = road.lane(lane) + float(rng.uniform(-0.3, 0.3))
        found.append(SceneVehicle(distance_m=ends[lane], lateral_m=lateral))
        ends[lane] += float(rng.uniform(22, 40))
    return found


class Drive:
    """A drive, drawn frame by frame as it is asked for; `render_drive` makes one.

    ``drive[i]`` and iteration give `Scene` objects; no frame depends on another, and none is kept.

    Attributes
    ----------
    fps
        Frames per second.
    shape
        ``(height, width)`` in pixels.
    scenario
        What happens.
    """

    def __init__(
        self, view: View, road: Road, movers: Sequence[Mover], *, frames: int, fps: float, scenario: str
    ) -> None:
        self.fps, self.shape, self.scenario = fps, view.shape, scenario
        self._frames, self._movers = frames, tuple(movers)
        self._studio = Studio(view, road)
        self._cars: dict[int, Car] = {}
        rng = np.random.default_rng([view.seed, 8])
        self._nods = rng.uniform(0, 2 * np.pi, 3)

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> Scene:
        """Draw frame `index`; a negative number counts from the end.

        Raises
        ------
        InvalidInputError
            If `index` is no integer (a slice, say) or there is no such frame.
        """
        frame = check_integer(index, "frame number", low=-self._frames, high=self._frames - 1) % self._frames
        return self._studio.scene(*self._moment(frame), frame, self._nod(frame))

    def __iter__(self) -> Iterator[Scene]:
        """Draw one frame after the other."""
        return (self[index] for index in range(self._frames))

    @cached_property
    def truth(self) -> tuple[tuple[VehicleTruth, ...], ...]:
        """The truth of every frame, found without drawing the pictures."""
        return tuple(
            self._studio.truth(*self._moment(frame), self._nod(frame)) for frame in range(self._frames)
        )

    def _moment(self, frame: int) -> tuple[list[Placed], float]:
        """Where every vehicle is, and how far the camera has come."""
        time = frame / self.fps
        placed = [
            Placed(self._car(mover), mover.track, mover.lateral(time), mover.distance(time),
                   mover.relative_speed(time), mover.oncoming)
            for mover in self._movers
            if -12.0 < mover.distance(time) < 230.0
        ]  # fmt: skip
        return placed, _CAMERA_SPEED * time

    def _car(self, mover: Mover) -> Car:
        if mover.track not in self._cars:
            self._cars[mover.track] = self._studio.car(mover.kind, mover.paint, mover.facing, mover.seed)
        return self._cars[mover.track]

    def _nod(self, frame: int) -> int:
        """Rows by which the horizon is off in a frame, within the margin."""
        waves = np.sin(2 * np.pi * frame / self.fps * np.array([1.3, 2.1, 3.7]) + self._nods)
        return int(np.rint(self._studio.view.margin * float(waves @ (0.5, 0.3, 0.2))))

    def write_labels(self, path: str | os.PathLike[str]) -> None:
        """Write the truth of every frame as CSV, see `write_labels`."""
        write_labels(path, enumerate(self.truth))


def render_drive(
    *,
    frames: int = 250,
    fps: float = 25.0,
    shape: tuple[int, int] = (720, 1280),
    scenario: str = "highway",
    horizon: float = 0.56,
    camera_height: float = 1.3,
    focal: float | None = None,
    light: str = "day",
    rain: float = 0.0,
    pitch_jitter: int = 0,
    jpeg_quality: int | None = None,
    random_state: RandomState = 0,
) -> Drive:
    """Draw a drive along a motorway at 97 km/h, frame by frame.

    Parameters
    ----------
    frames, fps
        Number of frames and frames per second.
    shape
        ``(height, width)`` in pixels.
    scenario
        ``"highway"``: cars ahead in three lanes, oncoming ones behind a barrier. ``"overtaking"``: a car
        comes into the picture at its left or right edge and pulls away. ``"crossing"``: in the middle of the
        drive a car crosses two lanes in front of another. ``"occlusion"``: the same nearer and slower, so
        that the other car is hidden for about a second. ``"empty"``: no vehicle at all.
    horizon, camera_height, focal, light, rain, jpeg_quality
        As for `render_scene`.
    pitch_jitter
        Rows by which the nodding camera moves the horizon at most, up or down.
    random_state
        Seed or generator; the same seed and options give the same bytes.

    Returns
    -------
    Drive
        ``len(drive)``, ``drive[i]`` and iteration; frames are drawn when asked for and not kept.

    Raises
    ------
    InvalidInputError
        If an option is out of range; the message names it.

    Examples
    --------
    >>> drive = render_drive(frames=50, shape=(180, 320), scenario="overtaking")
    >>> len(drive), drive[0].image.shape
    (50, (180, 320, 3))
    >>> distances = [row.distance_m for rows in drive.truth for row in rows if row.track == 1]
    >>> distances == sorted(distances)
    True
    """
    rng = make_generator(random_state)
    number = check_integer(frames, "frames", low=1)
    rate = check_number(fps, "fps", low=1.0, high=1000.0)
    check_choice(scenario, "scenario", SCENARIOS)
    margin = check_integer(pitch_jitter, "pitch_jitter", low=0, high=50)
    view = make_view(shape, horizon, camera_height, focal, light, rain, jpeg_quality, rng, margin)
    road, movers = make_traffic(scenario, number / rate, rng)
    return Drive(view, road, movers, frames=number, fps=rate, scenario=scenario)


def write_labels(
    path: str | os.PathLike[str],
    frames: Iterable[tuple[int | str, Sequence[VehicleTruth]]],
) -> None:
    """Write truth as CSV, one row a vehicle: the columns of `LABEL_COLUMNS`.

    Parameters
    ----------
    path
        The file to write; it appears whole or not at all.
    frames
        Pairs of a frame number or file name and the truth of that picture.

    Raises
    ------
    InvalidInputError
        If the folder does not exist or is read-only.
    """
    with atomic_write(path, "path") as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(LABEL_COLUMNS)
        for frame, rows in frames:
            for row in rows:
                writer.writerow(
                    [frame, row.track, *row.box, row.occluded, f"{row.truncated:.3f}", row.ignore,
                     f"{row.distance_m:.2f}", f"{row.speed_mps:.2f}"]
                )  # fmt: skip


def render_patches(
    n: int, *, size: int = 64, random_state: RandomState = 0
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Draw training patches: half vehicles, half background.

    A vehicle fills 85-98% of its patch's width or almost all of its height, seen from behind, straight or a
    little from a side, near and sharp or far and blurred. A background patch shows road, lines, barriers,
    trees, sky, or less than a fifth of a vehicle.

    Parameters
    ----------
    n
        Number of patches; the first half, rounded up, shows vehicles.
    size
        Side in pixels.
    random_state
        Seed or generator; the same seed and options give the same bytes.

    Returns
    -------
    patches : numpy.ndarray
        ``(n, size, size, 3)`` uint8 RGB.
    labels : numpy.ndarray
        ``(n,)`` bool: True for a vehicle.

    Raises
    ------
    InvalidInputError
        If `n` or `size` is no positive integer.

    Examples
    --------
    >>> patches, labels = render_patches(6)
    >>> patches.shape, labels.tolist()
    ((6, 64, 64, 3), [True, True, True, False, False, False])
    """
    count = check_integer(n, "n", low=1)
    side = check_integer(size, "size", low=16, high=512)
    return draw_patches(count, side, make_generator(random_state))
