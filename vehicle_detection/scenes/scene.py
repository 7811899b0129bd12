"""Single road scenes with ground truth, training patches cut from them, and what scenes and drives share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, fields
from vehicle_detection.camera import Camera
from vehicle_detection.scenes.camera_light import (
    Doubles,
    Image,
    Rng,
    SceneConfig,
    SceneView,
    Sensor,
    make_light,
)
from vehicle_detection.scenes.render import VehiclePose, VehicleTruth, composite, draw_vehicle
from vehicle_detection.scenes.scenery import LANE, Canvas, Road, Scenery
from vehicle_detection.scenes.vehicles import COLORS, VEHICLE_SHAPES, VehicleBody, random_appearance

RandomState = int | np.random.Generator | None


@dataclass(frozen=True, kw_only=True)
class SceneVehicle(fields.Checked):
    """A vehicle to place in a scene; `kind` and `color` are random if they are None."""

    distance_m: float = fields.number(low=2, high=1000)  # along the road to the nearer tires
    # Of its middle, to the right; a lane is 3.6 m wide.
    lateral_m: float = fields.number(0.0, low=-100, high=100)
    kind: str | None = fields.choice(None, VEHICLE_SHAPES)  # hatchback, estate, sedan, mpv, suv, van or truck
    color: str | None = fields.choice(None, COLORS)
    view: str = fields.choice("rear", ("rear", "front"))  # the end that the camera sees
    # Away from the camera; only for the ground truth.
    speed_mps: float = fields.number(0.0, low=-150, high=150)


@dataclass(frozen=True, eq=False)
class Scene:
    """A rendered image and its ground truth."""

    image: Image  # (H, W, 3) RGB
    truth: tuple[VehicleTruth, ...]  # by track; vehicles with a pixel in the image, occluded or not
    camera: Camera  # exact
    instance_map: NDArray[np.int32]  # (H, W) track of the vehicle that each pixel shows, 0 where none

    @property
    def boxes(self) -> NDArray[np.int64]:
        """``(N, 4)`` boxes of the vehicles in `truth`, in the same order."""
        return np.array([row.box for row in self.truth], np.int64).reshape(-1, 4)


def make_generator(random_state: RandomState) -> np.random.Generator:
    """Check `random_state` and turn it into a generator."""
    if random_state is None or isinstance(random_state, np.random.Generator):
        return np.random.default_rng(random_state)
    return np.random.default_rng(check.integer(random_state, "random_state", low=0))


class SceneRenderer:
    """Renders vehicles in the scenery of one configuration."""

    def __init__(self, config: SceneConfig, road: Road) -> None:
        self.config, self.road = config, road

    @cached_property
    def scenery(self) -> Scenery:
        """The scenery, with additional rows for a camera that pitches."""
        height, width = self.config.shape
        margin = self.config.margin
        return Scenery(replace(self.config.pitched(margin), shape=(height + 2 * margin, width)), self.road)

    @cached_property
    def sensor(self) -> Sensor:
        """The sensor of the camera."""
        return Sensor(self.config)

    def scene(
        self, poses: Sequence[VehiclePose], travel: float, pitch_offset: int, roll: float, frame: int
    ) -> Scene:
        """Render a scene `travel` meters into the drive, with the horizon `pitch_offset` rows lower."""
        config = self.config.pitched(pitch_offset, roll)
        first = config.margin - pitch_offset
        image = np.ascontiguousarray(self.scenery.render(travel)[first : first + config.shape[0]])
        truth, instance_map = composite(poses, self.scenery, config, travel, image)
        if roll:
            # For small angles, a rotation moves each column down or up.
            shear = np.array([[1, 0, 0], [roll, 1, -roll * config.center_px]])
            size, border = (config.shape[1], config.shape[0]), cv2.BORDER_REFLECT
            image = np.asarray(cv2.warpAffine(image, shear, size, borderMode=border), np.uint8)
            tracks = instance_map.astype(np.float32)
            instance_map = cv2.warpAffine(tracks, shear, size, flags=cv2.INTER_NEAREST).astype(np.int32)
        image = self.sensor.expose(image, frame)
        if config.jpeg_quality is not None:
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
        return Scene(image, truth, config.camera, instance_map)

    def truth(
        self, poses: Sequence[VehiclePose], travel: float, pitch_offset: int, roll: float
    ) -> tuple[VehicleTruth, ...]:
        """Ground truth of the same scene without the image."""
        return composite(poses, self.scenery, self.config.pitched(pitch_offset, roll), travel, None)[0]


def render_scene(
    *,
    vehicles: Sequence[SceneVehicle] | int | None = None,
    lane: int | None = None,
    random_state: RandomState = 0,
    **view: Any,
) -> Scene:
    """Render one road scene.

    Parameters
    ----------
    vehicles
        The vehicles to draw, or how many to place at random in the lanes ahead; None places one to five.
    lane
        The lane that the camera drives in: 0 left, 1 middle, 2 right; None chooses one at random.
    random_state
        Seed or generator: the same seed and options give the same bytes.
    **view
        Fields of `SceneView`: ``shape`` ``(height, width)``; ``horizon`` as a fraction of the height;
        ``camera_height_m`` and ``focal_px``, by default 0.9 times the longer side; ``light``: day, overcast,
        dusk or night; ``rain`` from 0 (dry) to 1 (heavy); and ``jpeg_quality``, None for no compression.

    Returns
    -------
    Scene
        Image and ground truth. The `track` of a vehicle is its position in `vehicles`, from 1 on.

    Examples
    --------
    >>> car = SceneVehicle(distance_m=20.0, kind="sedan", color="white")
    >>> scene = render_scene(shape=(360, 640), vehicles=[car], random_state=1)
    >>> scene.image.shape, scene.truth[0].track, round(scene.truth[0].distance_m, 1)
    ((360, 640, 3), 1, 19.0)
    """
    rng = make_generator(random_state)
    config = SceneView(**view).configure(rng)
    own = int(rng.integers(3))
    road = Road(own=own if lane is None else check.integer(lane, "lane", low=0, high=2))
    if vehicles is None:
        vehicles = int(rng.integers(1, 6))
    if isinstance(vehicles, (int, np.integer)):
        vehicles = _random_vehicles(road, check.integer(vehicles, "vehicles", low=0, high=60), rng)
    poses = []
    for track, vehicle in enumerate(check.sequence(vehicles, "vehicles", "SceneVehicle"), start=1):
        remedy = "make one with SceneVehicle(distance_m=20)"
        check.instance(vehicle, f"vehicles[{track - 1}]", SceneVehicle, remedy)
        # A generator for each vehicle: adding or removing a vehicle does not change the appearance of others.
        look = random_appearance(np.random.default_rng([config.seed, 5, track]))
        look |= {"kind": vehicle.kind or look["kind"], "color": vehicle.color or look["color"]}
        body = VehicleBody(**look, view=vehicle.view, light=config.light)
        lateral, distance = float(vehicle.lateral_m), float(vehicle.distance_m)
        poses.append(VehiclePose(body, track, lateral, distance, float(vehicle.speed_mps)))
    travel = np.random.default_rng([config.seed, 6]).uniform(0, 200)
    return SceneRenderer(config, road).scene(poses, travel, pitch_offset=0, roll=0.0, frame=0)


def _random_vehicles(road: Road, count: int, rng: Rng) -> list[SceneVehicle]:
    """Place vehicles without overlap in the lanes ahead."""
    free_from = [
        rng.uniform(18, 32) if lane == road.own else rng.uniform(12, 24) for lane in range(road.lanes)
    ]
    vehicles = []
    for _ in range(count):
        lane = int(rng.integers(road.lanes)) if rng.random() < 0.5 else int(np.argmin(free_from))
        lateral = road.lane(lane) + rng.uniform(-0.3, 0.3)
        vehicles.append(SceneVehicle(distance_m=free_from[lane], lateral_m=lateral))
        free_from[lane] += rng.uniform(22, 40)
    return vehicles


_HEIGHT, _WIDTH = 720, 1280


def render_patches(
    n: int, *, size: int = 64, random_state: RandomState = 0
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Render training patches: half of them vehicles, half background.

    A vehicle fills 85-98% of its patch's width or almost all of its height; it is seen from behind, straight
    or slightly from the side, near and sharp or distant and blurred. A background patch shows road, lane
    markings, barriers, trees, sky, or less than a fifth of a vehicle.

    Parameters
    ----------
    n, size
        Number of patches, and their side in pixels, 16 to 512.
    random_state
        Seed or generator; the same seed and options give the same bytes.

    Returns
    -------
    patches, labels : numpy.ndarray
        ``(n, size, size, 3)`` uint8 RGB, and ``(n,)`` bool: True for the vehicles, which come first.

    Examples
    --------
    >>> patches, labels = render_patches(6)
    >>> patches.shape, labels.tolist()
    ((6, 64, 64, 3), [True, True, True, False, False, False])
    """
    n = check.integer(n, "n", low=1)
    size = check.integer(size, "size", low=16, high=512)
    rng = make_generator(random_state)
    patches = np.empty((n, size, size, 3), np.uint8)
    n_vehicles = (n + 1) // 2
    n_scenes = min(-(-n // 80), 14)
    for first in range(n_scenes):
        scene = PatchScene(rng)
        for index in range(first, n_vehicles, n_scenes):
            patches[index] = scene.vehicle(size, rng)
        for index in range(n_vehicles + first, n, n_scenes):
            patches[index] = scene.background(size, rng)
    return patches, np.arange(n) < n_vehicles


class PatchScene:
    """An empty road and several vehicles to draw on it."""

    def __init__(self, rng: Rng) -> None:
        name = str(rng.choice(["day", "overcast", "dusk"], p=[0.6, 0.33, 0.07]))
        light = make_light(name, 0.0, rng)
        height = rng.uniform(1.15, 1.6)
        horizon = 403.0 + float(rng.integers(-60, 60))
        camera = Camera(focal_px=0.9 * _WIDTH, horizon_px=horizon, height_m=height)
        self.road = Road(own=int(rng.integers(3)))
        self.config = SceneConfig((_HEIGHT, _WIDTH), camera, light, seed=int(rng.integers(2**31)))
        scenery = Scenery(self.config, self.road)
        travel = rng.uniform(0, 240)
        self.empty = scenery.render(travel)
        scenery.draw_barrier(Canvas(self.config, self.empty), travel)
        self.sensor = Sensor(replace(self.config, seed=int(rng.integers(2**31))))
        self.bodies = [VehicleBody(**random_appearance(rng), view="rear", light=light) for _ in range(10)]

    def _with_vehicle(self, rng: Rng, distance: float) -> tuple[Image, NDArray[np.int64]] | None:
        """Draw a vehicle into a copy of the image; return it and the box, None if the border cuts it."""
        body = self.bodies[int(rng.integers(len(self.bodies)))]
        lane = int(rng.integers(self.road.lanes))
        lateral = self.road.lane(lane) + rng.uniform(-0.5, 0.5)
        if rng.random() < 0.3:
            lateral = rng.uniform(-0.3, 0.3) * LANE
        image = self.empty.copy()
        sprite = draw_vehicle(image, self.config, VehiclePose(body, 1, lateral, distance))
        if sprite is None or sprite.box[0] <= 0 or sprite.box[2] >= _WIDTH or sprite.box[3] >= _HEIGHT:
            return None
        return image, np.array(sprite.box, np.int64)

    def vehicle(self, size: int, rng: Rng) -> Image:
        """Cut out a square around a vehicle, as a ``(size, size, 3)`` patch."""
        while True:
            drawn = self._with_vehicle(rng, float(np.exp(rng.uniform(np.log(7.5), np.log(60)))))
            if drawn is None:
                continue
            image, box = drawn
            width, height = box[2:] - box[:2]
            if width <= 1.55 * height:
                side = max(width / rng.uniform(0.85, 0.98), height / 0.97)
                center = (box[:2] + box[2:]) / 2 + rng.uniform(-0.02, 0.02, 2) * side
                return self._cut(image, center, side, size, rng)

    def background(self, size: int, rng: Rng) -> Image:
        """Cut out a square without a vehicle, or with a small part of one."""
        image, horizon = self.empty, self.config.camera.horizon_px
        side = float(np.exp(rng.uniform(np.log(40), np.log(220))))
        x = rng.uniform(side / 2, _WIDTH - side / 2)
        choice = rng.random()
        if choice < 0.12:
            y = rng.uniform(side / 2, max(horizon - 30, side / 2 + 1))
        else:
            # Mostly where a search looks: from above the horizon down to the near road.
            y = float(np.clip(horizon + rng.normal(60, 85), side / 2, _HEIGHT - side / 2))
        drawn = self._with_vehicle(rng, rng.uniform(8, 25)) if choice > 0.85 else None
        if drawn and (square := _partial_square(drawn[1], rng)):
            image, (x, y, side) = drawn[0], square
        return self._cut(image, np.array([x, y]), side, size, rng)

    def _cut(self, image: Image, center: Doubles, side: float, size: int, rng: Rng) -> Image:
        """Cut out a square, apply lens and sensor, resize it, and vary blur, exposure and color."""
        margin = 4
        x1, y1 = (int(np.floor(v)) for v in center - side / 2)
        span = int(np.ceil(side))
        columns = np.clip(np.arange(x1 - margin, x1 + span + margin), 0, image.shape[1] - 1)
        rows = np.clip(np.arange(y1 - margin, y1 + span + margin), 0, image.shape[0] - 1)
        crop = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        crop = self.sensor.expose(crop, int(rng.integers(2**31)), crop_blur=rng.uniform(0.3, 0.7))
        # Repeat the border where the square reaches beyond the image.
        crop = crop[rows - rows[0]][:, columns - columns[0]]
        crop = np.ascontiguousarray(crop[margin:-margin, margin:-margin])
        method = cv2.INTER_AREA if span > size else cv2.INTER_CUBIC
        patch = np.asarray(cv2.resize(crop, (size, size), interpolation=method), np.float32)
        if rng.random() < 0.25:
            sigma = rng.uniform(0.4, 1.3) * size / 64
            patch = np.asarray(cv2.GaussianBlur(patch, (0, 0), sigma), np.float32)
        gain, fading = rng.uniform(0.6, 1.3), rng.uniform(-0.2, 0.25)
        patch = patch * (gain * rng.uniform(0.94, 1.06, 3)).astype(np.float32)
        patch += (patch.mean() - patch) * np.float32(fading)
        return np.asarray(np.clip(np.rint(patch), 0, 255), np.uint8)


def _partial_square(box: NDArray[np.int64], rng: Rng) -> tuple[float, float, float] | None:
    """Center and side of a square with up to a fifth of a vehicle; None if it leaves the image."""
    width = float(box[2] - box[0])
    side = width * rng.uniform(0.7, 1.2)
    overlap = width * rng.uniform(0.02, 0.19)
    x = float(box[0]) + overlap - side / 2 if rng.random() < 0.5 else float(box[2]) - overlap + side / 2
    y = float(box[1] + box[3]) / 2 + width * rng.uniform(-0.2, 0.2)
    inside = side / 2 <= x <= _WIDTH - side / 2 and side / 2 <= y <= _HEIGHT - side / 2
    return (x, y, side) if inside else None
