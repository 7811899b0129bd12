"""Training patches cut from drawn scenes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.camera_light import Pinhole, Sensor, make_light
from vehicle_detection.synthetic.render import Image, Placed, draw_one
from vehicle_detection.synthetic.scenery import LANE, Canvas, Road, Scenery
from vehicle_detection.synthetic.shapes import KIND_SHARES, PAINT_SHARES, PAINTS, draw_share
from vehicle_detection.synthetic.vehicles import Car

_SHAPE = (720, 1280)
_PER_SCENE = 80
_MOST_SCENES = 14
_LOOKS_PER_SCENE = 10
_STEEPEST = 1.55


def draw_patches(n: int, size: int, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """See `synthetic.render_patches`."""
    vehicles = (n + 1) // 2
    patches = np.empty((n, size, size, 3), np.uint8)
    labels = np.arange(n) < vehicles
    seen = {True: np.flatnonzero(labels), False: np.flatnonzero(~labels)}
    scenes = min(-(-n // _PER_SCENE), _MOST_SCENES)
    for scene in range(scenes):
        stand = _Stand(rng)
        for index in seen[True][scene::scenes]:
            patches[index] = stand.vehicle(size, rng)
        for index in seen[False][scene::scenes]:
            patches[index] = stand.background(size, rng)
    return patches, labels


class _Stand:
    """An empty road and a few vehicles to put on it."""

    def __init__(self, rng: np.random.Generator) -> None:
        name = str(rng.choice(["day", "overcast", "dusk"], p=[0.6, 0.33, 0.07]))
        self.light = make_light(name, 0.0, rng)
        height = float(rng.uniform(1.15, 1.6))
        self.camera = Pinhole(
            focal_px=1152.0, center_px=640.0, horizon_px=403.0 + float(rng.integers(-60, 60)), height_m=height
        )
        self.road = Road(own=int(rng.integers(3)))
        scenery = Scenery(_SHAPE, self.camera, self.light, self.road, int(rng.integers(2**31)))
        travel = float(rng.uniform(0, 240))
        self.empty = scenery.render(travel)
        scenery.draw_barrier(Canvas(self.camera, self.empty), travel)
        self.sensor = Sensor(_SHAPE, self.light, 0.0, int(rng.integers(2**31)))
        self.cars = [self._make_car(rng) for _ in range(_LOOKS_PER_SCENE)]

    def _make_car(self, rng: np.random.Generator) -> Car:
        kind, paint = draw_share(KIND_SHARES, rng), draw_share(PAINT_SHARES, rng)
        return Car(kind, PAINTS[paint], "rear", self.light, int(rng.integers(2**31)))

    def _put(self, rng: np.random.Generator, distance: float) -> tuple[Image, NDArray[np.int64]] | None:
        """Put one vehicle into a copy of the picture; return it and the box, None if it does not fit."""
        car = self.cars[int(rng.integers(len(self.cars)))]
        lane = int(rng.integers(self.road.lanes))
        lateral = self.road.lane(lane) + float(rng.uniform(-0.5, 0.5))
        if rng.random() < 0.3:
            lateral = float(rng.uniform(-0.3, 0.3)) * LANE
        placed = Placed(car, 1, lateral, distance, 0.0)
        image = self.empty.copy()
        box = draw_one(image, self.camera, self.light, placed)
        if box is None or box[0] <= 0 or box[2] >= _SHAPE[1] or box[3] >= _SHAPE[0]:
            return None
        return image, box

    def vehicle(self, size: int, rng: np.random.Generator) -> Image:
        """Cut a square around a vehicle."""
        while True:
            distance = float(np.exp(rng.uniform(np.log(7.5), np.log(60))))
            put = self._put(rng, distance)
            if put is None:
                continue
            image, box = put
            wide, high = box[2] - box[0], box[3] - box[1]
            if wide > _STEEPEST * high:
                continue
            side = max(wide / rng.uniform(0.85, 0.98), high / 0.97)
            middle = (box[:2] + box[2:]) / 2 + rng.uniform(-0.02, 0.02, 2) * side
            return self._develop(image, middle, side, size, rng)

    def background(self, size: int, rng: np.random.Generator) -> Image:
        """Cut a square without a vehicle, or with a small part of one."""
        image = self.empty
        side = float(np.exp(rng.uniform(np.log(40), np.log(220))))
        x = float(rng.uniform(side / 2, _SHAPE[1] - side / 2))
        draw = rng.random()
        if draw < 0.12:
            y = float(rng.uniform(side / 2, max(self.camera.horizon_px - 30, side / 2 + 1)))
        else:
            # Mostly where a search looks: from above the horizon down to the near road.
            y = float(np.clip(self.camera.horizon_px + rng.normal(60, 85), side / 2, _SHAPE[0] - side / 2))
        if draw > 0.85:
            put = self._put(rng, float(rng.uniform(8, 25)))
            part = None if put is None else _graze(put[1], rng)
            if put is not None and part is not None:
                image, (x, y, side) = put[0], part
        return self._develop(image, np.array([x, y]), side, size, rng)

    def _develop(
        self, image: Image, middle: NDArray[np.float64], side: float, size: int, rng: np.random.Generator
    ) -> Image:
        """Cut a square, through lens and sensor, and bring it to the size of a patch."""
        half = side / 2
        margin = 4
        x1, y1 = (int(np.floor(v)) for v in middle - half)
        span = int(np.ceil(side))
        columns = np.clip(np.arange(x1 - margin, x1 + span + margin), 0, image.shape[1] - 1)
        rows = np.clip(np.arange(y1 - margin, y1 + span + margin), 0, image.shape[0] - 1)
        crop = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        crop = self.sensor.expose_part(crop, int(rng.integers(2**31)), blur=float(rng.uniform(0.3, 0.7)))
        ix, iy = columns - columns[0], rows - rows[0]
        crop = np.ascontiguousarray(crop[iy][:, ix][margin:-margin, margin:-margin])
        method = cv2.INTER_AREA if span > size else cv2.INTER_CUBIC
        patch = np.asarray(cv2.resize(crop, (size, size), interpolation=method), np.float32)
        if rng.random() < 0.25:
            sigma = float(rng.uniform(0.4, 1.3)) * size / 64
            patch = np.asarray(cv2.GaussianBlur(patch, (0, 0), sigma), np.float32)
        # Cameras differ in exposure, contrast and color.
        gain, flat = rng.uniform(0.6, 1.3), rng.uniform(-0.2, 0.25)
        patch = patch * (gain * rng.uniform(0.94, 1.06, 3)).astype(np.float32)
        patch += (patch.mean() - patch) * np.float32(flat)
        return np.asarray(np.clip(np.rint(patch), 0, 255), np.uint8)


def _graze(box: NDArray[np.int64], rng: np.random.Generator) -> tuple[float, float, float] | None:
    """Find middle and side of a square with up to a fifth of a vehicle; None if it leaves the picture."""
    wide = float(box[2] - box[0])
    side = wide * float(rng.uniform(0.7, 1.2))
    into = wide * float(rng.uniform(0.02, 0.19))
    x = float(box[0]) + into - side / 2 if rng.random() < 0.5 else float(box[2]) - into + side / 2
    y = float(box[1] + box[3]) / 2 + wide * float(rng.uniform(-0.2, 0.2))
    inside = side / 2 <= x <= _SHAPE[1] - side / 2 and side / 2 <= y <= _SHAPE[0] - side / 2
    return (x, y, side) if inside else None
