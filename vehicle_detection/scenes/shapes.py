"""Shapes, colors and details of the vehicles that can be drawn."""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection.scenes.camera_light import Light
from vehicle_detection.scenes.raster import Color, Doubles, Rng

Profile = Sequence[tuple[float, float]]  # contour of one end of a vehicle: height and depth (m)


@dataclass(frozen=True)
class VehicleShape:
    """Dimensions of a kind of vehicle in meters."""

    length: float
    width: float
    height: float
    belt: float  # height of the lower edge of the windows
    clearance: float
    wheel_radius: float
    overhangs: Sequence[float]  # axle to bumper, rear and front
    rear: Profile
    front: Profile
    windows: Sequence[float]  # where the side windows begin and end, from the rear
    roof: float = 0.72  # width of the roof over that of the body
    corner: float = 0.32  # depth of the rounded corners
    is_box: bool = False  # a box truck

    def scaled(self, factor: float, widening: float = 1.0) -> VehicleShape:
        """Return the same vehicle, `factor` times as large, and `widening` times as wide as that."""
        lengths = set(self.__dataclass_fields__) - {"roof", "is_box"}
        sizes = {name: np.multiply(getattr(self, name), factor).tolist() for name in lengths}
        return replace(self, **sizes | {"width": sizes["width"] * widening})


_FILE = importlib.resources.files("vehicle_detection.scenes") / "vehicle_shapes.json"
VEHICLE_SHAPES = {kind: VehicleShape(**shape) for kind, shape in json.loads(_FILE.read_bytes()).items()}

COLORS: dict[str, Color] = {
    "white": (226, 227, 225), "silver": (172, 176, 179), "gray": (112, 117, 121), "anthracite": (64, 68, 73),
    "black": (27, 28, 31), "navy": (30, 42, 78), "blue": (42, 86, 148), "ice": (134, 158, 180),
    "red": (164, 28, 30), "wine": (96, 24, 30), "green": (40, 70, 54), "beige": (170, 156, 126),
    "brown": (84, 66, 54), "yellow": (212, 176, 52),
}  # fmt: skip

# Frequencies where none is requested; a truck is only drawn on request.
KIND_WEIGHTS = {"hatchback": 29, "estate": 15, "sedan": 25, "mpv": 12, "suv": 13, "van": 6}
COLOR_WEIGHTS = {
    "white": 15, "silver": 19, "gray": 13, "anthracite": 11, "black": 12, "navy": 7, "blue": 6, "ice": 3,
    "red": 6, "wine": 3, "green": 2, "beige": 2, "brown": 1, "yellow": 1,
}  # fmt: skip


def random_appearance(rng: Rng, kinds: Sequence[str] = tuple(KIND_WEIGHTS)) -> dict[str, Any]:
    """Draw the kind, color and seed of a `VehicleBody`."""

    def draw(weights: dict[str, int]) -> str:
        p = np.array(list(weights.values()), float)
        return str(rng.choice(list(weights), p=p / p.sum()))

    weights = {kind: weight for kind, weight in KIND_WEIGHTS.items() if kind in kinds}
    return {"kind": draw(weights), "color": draw(COLOR_WEIGHTS), "seed": int(rng.integers(2**31))}


def profile_at(profile: Profile, y: ArrayLike) -> Doubles:
    """Depth of an end at heights `y`."""
    heights, depths = zip(*profile)
    return np.asarray(np.interp(np.asarray(y), heights, depths), np.float64)


class VehicleAppearance:
    """Random details that differ between vehicles of one kind."""

    def __init__(self, kind: str, rng: Rng) -> None:
        tall = kind in ("hatchback", "estate", "mpv", "suv", "van")
        self.tall_lamps = tall and rng.random() < 0.75
        self.lamp_width = rng.uniform(0.14, 0.19) if self.tall_lamps else rng.uniform(0.26, 0.42)
        self.lamp_height = rng.uniform(0.26, 0.42) if self.tall_lamps else rng.uniform(0.13, 0.19)
        self.plate_high = rng.random() < (0.75 if tall else 0.6)
        self.plate_color = (238, 238, 232) if rng.random() < 0.8 else (222, 200, 96)
        self.plastic_bumper = rng.random() < (0.6 if kind in ("suv", "van", "truck") else 0.25)
        self.chrome = rng.random() < 0.5
        self.glass_tint = rng.uniform(0.55, 1.15)
        self.glass_reflection = rng.uniform(0.2, 1.3)
        self.rear_doors = kind == "van" and rng.random() < 0.7
        self.windowless = kind == "van" and rng.random() < 0.4
        self.rim_tone = rng.uniform(90, 190)
        self.grille_height = rng.uniform(0.1, 0.2)
        self.exhaust = rng.random() < 0.6
        tone = rng.uniform(165, 225)
        self.cargo_color = tuple(np.clip(tone + rng.normal(0, 8, 3), 0, 235).tolist())
        self.seed = int(rng.integers(2**31))


class BodyShape:
    """Shape, color and details of one vehicle; `view` is the end that the camera sees, rear or front."""

    def __init__(
        self, kind: str, color: str, seed: int, view: str, light: Light, widening: float = 1.0
    ) -> None:
        rng = np.random.default_rng([seed, 7])
        dims = VEHICLE_SHAPES[kind].scaled(rng.uniform(0.96, 1.05), widening)
        self.dimensions, self.view, self.light = dims, view, light
        rear = view == "rear"
        self.end, self.far_end = (dims.rear, dims.front) if rear else (dims.front, dims.rear)
        self.overhang, self.far_overhang = dims.overhangs if rear else dims.overhangs[::-1]
        self.color = np.clip(np.asarray(COLORS[color], np.float32) * rng.uniform(0.9, 1.1), 8, 240)
        self.seed = seed
        self.appearance = VehicleAppearance(kind, rng)

    def half_width(self, y: ArrayLike) -> Doubles:
        """Half of the body's width at heights `y`, in meters."""
        dims = self.dimensions
        if dims.is_box:
            heights = [dims.clearance, dims.clearance + 0.1, dims.height - 0.03, dims.height]
            ratios = [0.94, 1.0, 1.0, 0.98] if self.view == "rear" else [0.9, 0.97, 0.97, 0.9]
        else:
            cabin, roof = dims.height - dims.belt, dims.roof
            heights = [
                dims.clearance, dims.clearance + 0.12, 0.5 * dims.belt + 0.1, dims.belt - 0.12, dims.belt,
                dims.belt + 0.8 * cabin, dims.height - 0.06, dims.height - 0.02, dims.height,
            ]  # fmt: skip
            ratios = [0.93, 0.985, 1.0, 0.99, 0.96, roof + 0.05, roof - 0.02, roof - 0.1, roof - 0.26]
        return np.asarray(np.interp(np.asarray(y), heights, np.array(ratios) * dims.width / 2), np.float64)
