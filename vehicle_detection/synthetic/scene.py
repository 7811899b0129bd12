"""A view of the road, checked, and what turns placed vehicles into scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.synthetic.camera_light import LIGHTS, Light, Pinhole, Sensor, make_light
from vehicle_detection.synthetic.render import Image, Placed, VehicleTruth, stage
from vehicle_detection.synthetic.scenery import Road, Scenery
from vehicle_detection.synthetic.shapes import PAINTS
from vehicle_detection.synthetic.vehicles import Car

RandomState = int | np.random.Generator | None

_LEAST_SIDE = 64
_MOST_SIDE = 4320


@dataclass(frozen=True, eq=False)
class Scene:
    """A drawn picture and what is true of it.

    Attributes
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    truth
        One `VehicleTruth` for each vehicle with a pixel in the picture, hidden or not, by track.
    camera
        The camera that took it: rows to distances and back.
    seen
        ``(H, W)`` int32: the track that each pixel shows, 0 where it shows none.
    """

    image: Image
    truth: tuple[VehicleTruth, ...]
    camera: Pinhole
    seen: NDArray[np.int32]

    @property
    def boxes(self) -> NDArray[np.int64]:
        """``(N, 4)`` boxes of the vehicles in `truth`, in its order."""
        return np.array([row.box for row in self.truth], np.int64).reshape(-1, 4)


@dataclass(frozen=True)
class View:
    """What every frame of a scene or drive shares."""

    shape: tuple[int, int]
    camera: Pinhole
    light: Light
    rain: float
    jpeg_quality: int | None
    margin: int
    seed: int


def make_view(
    shape: Any, horizon: float, camera_height: float, focal: float | None, light: str, rain: float,
    jpeg_quality: int | None, rng: np.random.Generator, margin: int = 0,
) -> View:  # fmt: skip
    """Check the options that scenes and drives share."""
    if not isinstance(shape, tuple) or len(shape) != 2:
        raise InvalidInputError(f"shape must be (height, width) in pixels, got {describe(shape)}")
    height, width = (
        check_integer(side, f"shape[{axis}]", low=_LEAST_SIDE, high=_MOST_SIDE)
        for axis, side in enumerate(shape)
    )
    level = check_number(horizon, "horizon", low=0.1, high=0.9)
    above = check_number(camera_height, "camera_height", low=0.5, high=5.0)
    length = (
        0.9 * max(height, width)
        if focal is None
        else check_number(focal, "focal", low=0.2 * width, high=10.0 * width)
    )
    check_choice(light, "light", LIGHTS)
    wet = check_number(rain, "rain", low=0.0, high=1.0)
    if jpeg_quality is not None:
        jpeg_quality = check_integer(jpeg_quality, "jpeg_quality", low=1, high=100)
    camera = Pinhole(focal_px=length, center_px=width / 2, horizon_px=level * height, height_m=above)
    seed = int(rng.integers(2**62))
    lit = make_light(light, wet, np.random.default_rng([seed, 4]))
    return View((height, width), camera, lit, wet, jpeg_quality, margin, seed)


def make_generator(random_state: RandomState) -> np.random.Generator:
    if random_state is None or isinstance(random_state, np.random.Generator):
        return np.random.default_rng(random_state)
    return np.random.default_rng(check_integer(random_state, "random_state", low=0))


class Studio:
    """A view with its scenery and sensor: turns placed vehicles into scenes."""

    def __init__(self, view: View, road: Road) -> None:
        self.view, self.road = view, road

    @cached_property
    def scenery(self) -> Scenery:
        view = self.view
        # Rows above and below the picture, for a camera that nods.
        tall = (view.shape[0] + 2 * view.margin, view.shape[1])
        camera = replace(view.camera, horizon_px=view.camera.horizon_px + view.margin)
        return Scenery(tall, camera, view.light, self.road, view.seed)

    @cached_property
    def sensor(self) -> Sensor:
        return Sensor(self.view.shape, self.view.light, self.view.rain, self.view.seed)

    def car(self, kind: str, paint: str, facing: str, seed: int) -> Car:
        return Car(kind, PAINTS[paint], facing, self.view.light, seed)

    def camera(self, nod: int) -> Pinhole:
        return replace(self.view.camera, horizon_px=self.view.camera.horizon_px + nod)

    def scene(self, placed: Sequence[Placed], travel: float, frame: int, nod: int = 0) -> Scene:
        view = self.view
        first = view.margin - nod
        image = np.ascontiguousarray(self.scenery.render(travel)[first : first + view.shape[0]])
        camera = self.camera(nod)
        truth, seen = stage(placed, self.scenery, camera, travel, view.shape, image)
        image = self.sensor.expose(image, frame)
        if view.jpeg_quality is not None:
            image = _recompress(image, view.jpeg_quality)
        return Scene(image, truth, camera, seen)

    def truth(self, placed: Sequence[Placed], travel: float, nod: int = 0) -> tuple[VehicleTruth, ...]:
        return stage(placed, self.scenery, self.camera(nod), travel, self.view.shape, None)[0]


def _recompress(image: Image, quality: int) -> Image:
    """Return the picture as it comes back from a JPEG file."""
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[
        1
    ]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB), np.uint8)
