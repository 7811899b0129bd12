"""Training patches cut from rendered scenes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection.camera import Camera
from vehicle_detection.scenes.bodywork import VehicleBody
from vehicle_detection.scenes.camera_light import SceneConfig, Sensor, make_light
from vehicle_detection.scenes.raster import Doubles, Image, Rng
from vehicle_detection.scenes.render import VehiclePose, draw_vehicle
from vehicle_detection.scenes.scene import RandomState, make_generator
from vehicle_detection.scenes.scenery import LANE, Canvas, Road, Scenery
from vehicle_detection.scenes.shapes import random_appearance

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
    for number in range(n_scenes):
        scene = PatchScene(rng)
        for index in range(number, n_vehicles, n_scenes):
            patches[index] = scene.vehicle(size, rng)
        for index in range(n_vehicles + number, n, n_scenes):
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
