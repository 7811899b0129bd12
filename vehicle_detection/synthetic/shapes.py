"""Shapes, colors and details of the vehicles that can be drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection.synthetic.raster import Color, Doubles, Rng

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

    def scaled(self, factor: float) -> VehicleShape:
        """Return the same vehicle, `factor` times as large."""
        lengths = set(self.__dataclass_fields__) - {"roof", "is_box"}
        return replace(self, **{name: np.multiply(getattr(self, name), factor).tolist() for name in lengths})


VEHICLE_SHAPES: dict[str, VehicleShape] = {
    "hatchback": VehicleShape(
        4.1, 1.74, 1.48, 0.94, 0.24, 0.31, (0.68, 0.82),
        ((0.24, 0.14), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.64, 0.06), (0.86, 0.07), (0.94, 0.11),
         (1.36, 0.36), (1.44, 0.5), (1.48, 0.9)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.76, 0.2), (0.88, 0.6), (0.96, 1.0),
         (1.38, 1.75), (1.44, 1.95), (1.48, 2.3)),
        (0.42, 3.0),
    ),
    "estate": VehicleShape(
        4.65, 1.78, 1.48, 0.94, 0.25, 0.32, (0.92, 0.88),
        ((0.25, 0.14), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.64, 0.06), (0.88, 0.07), (0.94, 0.1),
         (1.36, 0.46), (1.43, 0.58), (1.48, 1.0)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.76, 0.2), (0.88, 0.6), (0.97, 1.1),
         (1.38, 1.9), (1.44, 2.1), (1.48, 2.5)),
        (0.5, 3.4),
    ),
    "sedan": VehicleShape(
        4.7, 1.8, 1.43, 0.96, 0.24, 0.32, (1.0, 0.88),
        ((0.24, 0.16), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.66, 0.06), (0.9, 0.05), (0.98, 0.09),
         (1.03, 0.28), (1.06, 0.62), (1.34, 1.22), (1.39, 1.45), (1.43, 1.9)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.74, 0.2), (0.88, 0.7), (0.97, 1.25),
         (1.33, 1.95), (1.39, 2.15), (1.43, 2.5)),
        (1.0, 3.35), roof=0.68,
    ),
    "mpv": VehicleShape(
        4.4, 1.8, 1.62, 1.02, 0.24, 0.32, (0.72, 0.85),
        ((0.24, 0.12), (0.34, 0.03), (0.52, 0.0), (0.62, 0.03), (0.68, 0.05), (0.96, 0.06), (1.02, 0.09),
         (1.5, 0.28), (1.57, 0.4), (1.62, 0.8)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.7, 0.05), (0.82, 0.2), (0.95, 0.5), (1.04, 0.8),
         (1.5, 1.6), (1.57, 1.8), (1.62, 2.2)),
        (0.34, 3.4), roof=0.74,
    ),
    "suv": VehicleShape(
        4.6, 1.87, 1.7, 1.08, 0.32, 0.37, (0.8, 0.85),
        ((0.32, 0.12), (0.42, 0.03), (0.6, 0.0), (0.7, 0.03), (0.74, 0.06), (1.0, 0.06), (1.08, 0.09),
         (1.55, 0.32), (1.64, 0.44), (1.7, 0.8)),
        ((0.3, 0.15), (0.42, 0.03), (0.6, 0.0), (0.84, 0.04), (0.94, 0.14), (1.04, 0.6), (1.1, 1.25),
         (1.56, 1.9), (1.64, 2.1), (1.7, 2.5)),
        (0.4, 3.1), roof=0.76,
    ),
    "van": VehicleShape(
        4.9, 1.92, 1.96, 1.1, 0.3, 0.34, (0.95, 0.9),
        ((0.3, 0.1), (0.4, 0.02), (0.55, 0.0), (0.64, 0.03), (1.1, 0.04), (1.8, 0.13), (1.9, 0.2),
         (1.96, 0.5)),
        ((0.28, 0.15), (0.4, 0.03), (0.6, 0.0), (0.86, 0.05), (0.98, 0.2), (1.1, 0.65), (1.8, 1.35),
         (1.9, 1.55), (1.96, 1.9)),
        (2.6, 4.0), roof=0.84, corner=0.16,
    ),
    "truck": VehicleShape(
        8.4, 2.46, 3.5, 1.5, 0.42, 0.48, (1.6, 1.35),
        ((0.42, 0.1), (0.9, 0.08), (1.0, 0.0), (3.46, 0.0), (3.5, 0.05)),
        ((0.3, 0.1), (0.45, 0.02), (0.8, 0.0), (1.4, 0.03), (1.5, 0.06), (2.4, 0.22),
         (2.7, 0.4), (3.46, 1.3), (3.5, 1.4)),
        (6.9, 7.9), roof=0.99, corner=0.05, is_box=True,
    ),
}  # fmt: skip

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
