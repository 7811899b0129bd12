"""Single road scenes with ground truth, and the rendering that scenes and drives share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_choice,
    check_integer,
    check_number,
    check_sequence,
    describe,
    store_number,
)
from vehicle_detection.camera import Camera
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.scenes.camera_light import LIGHTS, SceneConfig, Sensor, make_light
from vehicle_detection.scenes.raster import Image, Rng
from vehicle_detection.scenes.render import VehiclePose, VehicleTruth, composite
from vehicle_detection.scenes.scenery import Road, Scenery
from vehicle_detection.scenes.shapes import COLORS, VEHICLE_SHAPES, random_appearance
from vehicle_detection.scenes.vehicles import VehicleBody

RandomState = int | np.random.Generator | None


@dataclass(frozen=True, kw_only=True)
class SceneVehicle:
    """A vehicle to place in a scene; `kind` and `color` are random if they are None."""

    distance_m: float  # along the road from the camera to the nearer tires
    lateral_m: float = 0.0  # from the camera to the right to the vehicle's middle; a lane is 3.6 m wide
    kind: str | None = None  # hatchback, estate, sedan, mpv, suv, van or truck
    color: str | None = None  # one of `COLORS`
    view: str = "rear"  # the end that the camera sees, rear or front
    speed_mps: float = 0.0  # away from the camera; only for the ground truth

    def __post_init__(self) -> None:
        store_number(self, "distance_m", low=2.0, high=1000.0)
        store_number(self, "lateral_m", low=-100.0, high=100.0)
        if self.kind is not None:
            check_choice(self.kind, "kind", VEHICLE_SHAPES)
        if self.color is not None:
            check_choice(self.color, "color", COLORS)
        check_choice(self.view, "view", ("rear", "front"))
        store_number(self, "speed_mps", low=-150.0, high=150.0)


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


def make_config(
    shape: Any, horizon: float, camera_height_m: float, focal_px: float | None, light: str, rain: float,
    jpeg_quality: int | None, rng: Rng, margin: int = 0,
) -> SceneConfig:  # fmt: skip
    """Check the options that scenes and drives have in common."""
    if not isinstance(shape, tuple) or len(shape) != 2:
        raise InvalidInputError(f"shape must be (height, width) in pixels, got {describe(shape)}")
    height, width = (check_integer(shape[axis], f"shape[{axis}]", low=64, high=4320) for axis in (0, 1))
    horizon_px = check_number(horizon, "horizon", low=0.1, high=0.9) * height
    height_m = check_number(camera_height_m, "camera_height_m", low=0.5, high=5.0)
    if focal_px is None:
        focal_px = 0.9 * max(height, width)
    else:
        focal_px = check_number(focal_px, "focal_px", low=0.2 * width, high=10.0 * width)
    check_choice(light, "light", LIGHTS)
    rain = check_number(rain, "rain", low=0.0, high=1.0)
    if jpeg_quality is not None:
        jpeg_quality = check_integer(jpeg_quality, "jpeg_quality", low=1, high=100)
    camera = Camera(
        focal_px=focal_px,
        horizon_px=horizon_px,
        height_m=height_m,
        focal_std=0.0,
        height_std_m=0.0,
        shape=(height, width),
    )
    seed = int(rng.integers(2**62))
    lighting = make_light(light, rain, np.random.default_rng([seed, 4]))
    return SceneConfig((height, width), camera, lighting, rain, jpeg_quality, margin, seed)


def make_generator(random_state: RandomState) -> np.random.Generator:
    """Check `random_state` and turn it into a generator."""
    if random_state is None or isinstance(random_state, np.random.Generator):
        return np.random.default_rng(random_state)
    return np.random.default_rng(check_integer(random_state, "random_state", low=0))


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

    def scene(self, poses: Sequence[VehiclePose], travel: float, pitch_offset: int, frame: int) -> Scene:
        """Render a scene `travel` meters into the drive, with the horizon `pitch_offset` rows lower."""
        config = self.config.pitched(pitch_offset)
        first = config.margin - pitch_offset
        image = np.ascontiguousarray(self.scenery.render(travel)[first : first + config.shape[0]])
        truth, instance_map = composite(poses, self.scenery, config, travel, image)
        image = self.sensor.expose(image, frame)
        if config.jpeg_quality is not None:
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
            image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
        return Scene(image, truth, config.camera, instance_map)

    def truth(
        self, poses: Sequence[VehiclePose], travel: float, pitch_offset: int
    ) -> tuple[VehicleTruth, ...]:
        """Ground truth of the same scene without the image."""
        return composite(poses, self.scenery, self.config.pitched(pitch_offset), travel, None)[0]


def render_scene(
    *,
    shape: tuple[int, int] = (720, 1280),
    vehicles: Sequence[SceneVehicle] | int | None = None,
    lane: int | None = None,
    horizon: float = 0.56,
    camera_height_m: float = 1.3,
    focal_px: float | None = None,
    light: str = "day",
    rain: float = 0.0,
    jpeg_quality: int | None = None,
    random_state: RandomState = 0,
) -> Scene:
    """Render one road scene.

    Parameters
    ----------
    shape, horizon
        ``(height, width)`` in pixels, and the row of the horizon as a fraction of the height.
    vehicles
        The vehicles to draw, or how many to place at random in the lanes ahead; None places one to five.
    lane
        The lane that the camera drives in: 0 left, 1 middle, 2 right; None chooses one at random.
    camera_height_m, focal_px
        Height of the camera above the road, and focal length; None means 0.9 times the longer side.
    light, rain
        ``"day"``, ``"overcast"``, ``"dusk"`` or ``"night"``; and 0 (dry) to 1 (heavy): streaks, haze, less
        contrast, more noise.
    jpeg_quality, random_state
        Quality of a JPEG compression, None for none; and seed or generator: the same seed and options give
        the same bytes.

    Returns
    -------
    Scene
        Image and ground truth. The `track` of a vehicle is its position in `vehicles`, from 1 on.

    Raises
    ------
    InvalidInputError
        If an option is out of range.

    Examples
    --------
    >>> car = SceneVehicle(distance_m=20.0, kind="sedan", color="white")
    >>> scene = render_scene(shape=(360, 640), vehicles=[car], random_state=1)
    >>> scene.image.shape, scene.truth[0].track, scene.truth[0].distance_m
    ((360, 640, 3), 1, 20.0)
    """
    rng = make_generator(random_state)
    config = make_config(shape, horizon, camera_height_m, focal_px, light, rain, jpeg_quality, rng)
    own = int(rng.integers(3))
    road = Road(own=own if lane is None else check_integer(lane, "lane", low=0, high=2))
    if vehicles is None:
        vehicles = int(rng.integers(1, 6))
    if isinstance(vehicles, (int, np.integer)):
        vehicles = _random_vehicles(road, check_integer(vehicles, "vehicles", low=0, high=60), rng)
    poses = []
    for track, vehicle in enumerate(check_sequence(vehicles, "vehicles", "SceneVehicle"), start=1):
        if not isinstance(vehicle, SceneVehicle):
            raise InvalidInputError(
                f"vehicles[{track - 1}] must be a SceneVehicle, got {describe(vehicle)}; "
                "make one with SceneVehicle(distance_m=20)"
            )
        # A generator for each vehicle: adding or removing a vehicle does not change the appearance of others.
        look = random_appearance(np.random.default_rng([config.seed, 5, track]))
        look |= {"kind": vehicle.kind or look["kind"], "color": vehicle.color or look["color"]}
        body = VehicleBody(**look, view=vehicle.view, light=config.light)
        lateral, distance = float(vehicle.lateral_m), float(vehicle.distance_m)
        poses.append(VehiclePose(body, track, lateral, distance, float(vehicle.speed_mps)))
    travel = np.random.default_rng([config.seed, 6]).uniform(0, 200)
    return SceneRenderer(config, road).scene(poses, travel, pitch_offset=0, frame=0)


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
