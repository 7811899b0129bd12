"""Single road scenes with ground truth, and the rendering that scenes and drives share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Checked, check, choice, number
from vehicle_detection.camera import Camera
from vehicle_detection.scenes.bodywork import VehicleBody
from vehicle_detection.scenes.camera_light import SceneConfig, SceneView, Sensor
from vehicle_detection.scenes.raster import Image, Rng
from vehicle_detection.scenes.render import VehiclePose, VehicleTruth, composite
from vehicle_detection.scenes.scenery import Road, Scenery
from vehicle_detection.scenes.shapes import COLORS, VEHICLE_SHAPES, random_appearance

RandomState = int | np.random.Generator | None


@dataclass(frozen=True, kw_only=True)
class SceneVehicle(Checked):
    """A vehicle to place in a scene; `kind` and `color` are random if they are None."""

    distance_m: float = number(low=2, high=1000)  # along the road to the nearer tires
    lateral_m: float = number(0.0, low=-100, high=100)  # of its middle, to the right; a lane is 3.6 m wide
    kind: str | None = choice(None, VEHICLE_SHAPES)  # hatchback, estate, sedan, mpv, suv, van or truck
    color: str | None = choice(None, COLORS)
    view: str = choice("rear", ("rear", "front"))  # the end that the camera sees
    speed_mps: float = number(0.0, low=-150, high=150)  # away from the camera; only for the ground truth


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
