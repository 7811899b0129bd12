"""Vehicles as painted surfaces: what the two ends, the flanks and the underside look like, in metres.

A vehicle is a rounded body: its half width depends on the height, the depth of its near end on height
and side. That gives each surface its normals, and so its shading, and lets `_sprites` draw it in perspective.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic import bodywork as _bodywork
from vehicle_detection.synthetic.bodywork import PIXELS_PER_METRE, Easel, Surface
from vehicle_detection.synthetic.camera_light import Color, Floats, Light, wrapped_noise

Profile = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Design:
    """Measures of a kind of vehicle in metres; a profile is depth of an end by height."""

    length: float
    width: float
    height: float
    belt: float
    clearance: float
    wheel: float
    overhangs: tuple[float, float]
    rear: Profile
    front: Profile
    windows: tuple[float, float]
    roof: float = 0.72
    corner: float = 0.32
    box: bool = False

    def scaled(self, factor: float) -> Design:
        """Return the same vehicle, `factor` times as large."""
        lengths = ("length", "width", "height", "belt", "clearance", "wheel", "corner")
        changed: dict[str, Any] = {name: getattr(self, name) * factor for name in lengths}
        for name in ("overhangs", "windows"):
            changed[name] = tuple(factor * value for value in getattr(self, name))
        for name in ("rear", "front"):
            changed[name] = tuple((y * factor, z * factor) for y, z in getattr(self, name))
        return replace(self, **changed)


DESIGNS: dict[str, Design] = {
    "hatchback": Design(
        4.1, 1.74, 1.48, 0.94, 0.24, 0.31, (0.68, 0.82),
        ((0.24, 0.14), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.64, 0.06), (0.86, 0.07), (0.94, 0.11),
         (1.36, 0.36), (1.44, 0.5), (1.48, 0.9)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.76, 0.2), (0.88, 0.6), (0.96, 1.0),
         (1.38, 1.75), (1.44, 1.95), (1.48, 2.3)),
        (0.42, 3.0),
    ),
    "estate": Design(
        4.65, 1.78, 1.48, 0.94, 0.25, 0.32, (0.92, 0.88),
        ((0.25, 0.14), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.64, 0.06), (0.88, 0.07), (0.94, 0.1),
         (1.36, 0.46), (1.43, 0.58), (1.48, 1.0)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.76, 0.2), (0.88, 0.6), (0.97, 1.1),
         (1.38, 1.9), (1.44, 2.1), (1.48, 2.5)),
        (0.5, 3.4),
    ),
    "sedan": Design(
        4.7, 1.8, 1.43, 0.96, 0.24, 0.32, (1.0, 0.88),
        ((0.24, 0.16), (0.34, 0.03), (0.5, 0.0), (0.6, 0.03), (0.66, 0.06), (0.9, 0.05), (0.98, 0.09),
         (1.03, 0.28), (1.06, 0.62), (1.34, 1.22), (1.39, 1.45), (1.43, 1.9)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.66, 0.05), (0.74, 0.2), (0.88, 0.7), (0.97, 1.25),
         (1.33, 1.95), (1.39, 2.15), (1.43, 2.5)),
        (1.0, 3.35), roof=0.68,
    ),
    "mpv": Design(
        4.4, 1.8, 1.62, 1.02, 0.24, 0.32, (0.72, 0.85),
        ((0.24, 0.12), (0.34, 0.03), (0.52, 0.0), (0.62, 0.03), (0.68, 0.05), (0.96, 0.06), (1.02, 0.09),
         (1.5, 0.28), (1.57, 0.4), (1.62, 0.8)),
        ((0.22, 0.18), (0.34, 0.03), (0.5, 0.0), (0.7, 0.05), (0.82, 0.2), (0.95, 0.5), (1.04, 0.8),
         (1.5, 1.6), (1.57, 1.8), (1.62, 2.2)),
        (0.34, 3.4), roof=0.74,
    ),
    "suv": Design(
        4.6, 1.87, 1.7, 1.08, 0.32, 0.37, (0.8, 0.85),
        ((0.32, 0.12), (0.42, 0.03), (0.6, 0.0), (0.7, 0.03), (0.74, 0.06), (1.0, 0.06), (1.08, 0.09),
         (1.55, 0.32), (1.64, 0.44), (1.7, 0.8)),
        ((0.3, 0.15), (0.42, 0.03), (0.6, 0.0), (0.84, 0.04), (0.94, 0.14), (1.04, 0.6), (1.1, 1.25),
         (1.56, 1.9), (1.64, 2.1), (1.7, 2.5)),
        (0.4, 3.1), roof=0.76,
    ),
    "van": Design(
        4.9, 1.92, 1.96, 1.1, 0.3, 0.34, (0.95, 0.9),
        ((0.3, 0.1), (0.4, 0.02), (0.55, 0.0), (0.64, 0.03), (1.1, 0.04), (1.8, 0.13), (1.9, 0.2),
         (1.96, 0.5)),
        ((0.28, 0.15), (0.4, 0.03), (0.6, 0.0), (0.86, 0.05), (0.98, 0.2), (1.1, 0.65), (1.8, 1.35),
         (1.9, 1.55), (1.96, 1.9)),
        (2.6, 4.0), roof=0.84, corner=0.16,
    ),
    "truck": Design(
        8.4, 2.46, 3.5, 1.5, 0.42, 0.48, (1.6, 1.35),
        ((0.42, 0.1), (0.9, 0.08), (1.0, 0.0), (3.46, 0.0), (3.5, 0.05)),
        ((0.3, 0.1), (0.45, 0.02), (0.8, 0.0), (1.4, 0.03), (1.5, 0.06), (2.4, 0.22),
         (2.7, 0.4), (3.46, 1.3), (3.5, 1.4)),
        (6.9, 7.9), roof=0.99, corner=0.05, box=True,
    ),
}  # fmt: skip
"""Kinds of vehicles that can be drawn."""

PAINTS: dict[str, Color] = {
    "white": (226, 227, 225),
    "silver": (172, 176, 179),
    "gray": (112, 117, 121),
    "anthracite": (64, 68, 73),
    "black": (27, 28, 31),
    "navy": (30, 42, 78),
    "blue": (42, 86, 148),
    "ice": (134, 158, 180),
    "red": (164, 28, 30),
    "wine": (96, 24, 30),
    "green": (40, 70, 54),
    "beige": (170, 156, 126),
    "brown": (84, 66, 54),
    "yellow": (212, 176, 52),
}
"""Paints and their colours in sunlight."""

KIND_SHARES = {"hatchback": 29, "estate": 15, "sedan": 25, "mpv": 12, "suv": 13, "van": 6}
"""How often each kind is drawn where none is asked for; a truck is drawn on request alone."""

PAINT_SHARES = {
    "white": 15, "silver": 19, "gray": 13, "anthracite": 11, "black": 12, "navy": 7, "blue": 6, "ice": 3,
    "red": 6, "wine": 3, "green": 2, "beige": 2, "brown": 1, "yellow": 1,
}  # fmt: skip


def draw_share(shares: dict[str, int], rng: np.random.Generator) -> str:
    """Draw a key by its share."""
    weights = np.array(list(shares.values()), float)
    return str(rng.choice(list(shares), p=weights / weights.sum()))


def profile_at(profile: Profile, y: ArrayLike) -> NDArray[np.float64]:
    """Depth of an end at heights `y`."""
    heights, depths = zip(*profile)
    return np.asarray(np.interp(np.asarray(y), heights, depths), np.float64)


class Looks:
    """Details that differ between vehicles of one kind."""

    def __init__(self, kind: str, rng: np.random.Generator) -> None:
        tall = kind in ("hatchback", "estate", "mpv", "suv", "van")
        self.tall_lamps = bool(tall and rng.random() < 0.75)
        self.lamp_width = float(rng.uniform(0.14, 0.19) if self.tall_lamps else rng.uniform(0.26, 0.42))
        self.lamp_height = float(rng.uniform(0.26, 0.42) if self.tall_lamps else rng.uniform(0.13, 0.19))
        self.plate_high = bool(rng.random() < (0.75 if tall else 0.6))
        self.plate = (238, 238, 232) if rng.random() < 0.8 else (222, 200, 96)
        self.plastic = bool(rng.random() < (0.6 if kind in ("suv", "van", "truck") else 0.25))
        self.chrome = bool(rng.random() < 0.5)
        self.tint = float(rng.uniform(0.55, 1.15))
        self.glare = float(rng.uniform(0.2, 1.3))
        self.doors = bool(kind == "van" and rng.random() < 0.7)
        self.windowless = bool(kind == "van" and rng.random() < 0.4)
        self.rims = float(rng.uniform(90, 190))
        self.grille_tall = float(rng.uniform(0.1, 0.2))
        self.exhaust = bool(rng.random() < 0.6)
        tone = rng.uniform(165, 225)
        self.cargo = tuple(float(v) for v in np.clip(tone + rng.normal(0, 8, 3), 0, 235))
        self.seed = int(rng.integers(2**31))


_CORNER_POWER = 4.5
_FLANK_SHARE = 0.975


class Car:
    """One vehicle's surfaces, painted for a light; `facing` says which end the camera sees."""

    def __init__(self, kind: str, paint: Color, facing: str, light: Light, seed: int) -> None:
        rng = np.random.default_rng([seed, 7])
        d = DESIGNS[kind].scaled(float(rng.uniform(0.96, 1.05)))
        self.design, self.facing, self.light = d, facing, light
        self.end, self.far_end = (d.rear, d.front) if facing == "rear" else (d.front, d.rear)
        self.overhang = d.overhangs[0 if facing == "rear" else 1]
        self.paint = np.clip(np.asarray(paint, np.float32) * rng.uniform(0.9, 1.1), 8, 240)
        self._seed = seed
        self.looks = Looks(kind, rng)
        self.levels: dict[tuple[str, int, int], Surface] = {}

    def half_width(self, y: ArrayLike) -> NDArray[np.float64]:
        """Half of the body's width at heights `y`, in metres."""
        d = self.design
        if d.box:
            heights = [d.clearance, d.clearance + 0.1, d.height - 0.03, d.height]
            shares = [0.94, 1.0, 1.0, 0.98] if self.facing == "rear" else [0.9, 0.97, 0.97, 0.9]
        else:
            cabin = d.height - d.belt
            heights = [d.clearance, d.clearance + 0.12, 0.5 * d.belt + 0.1, d.belt - 0.12, d.belt,
                       d.belt + 0.8 * cabin, d.height - 0.06, d.height - 0.02, d.height]  # fmt: skip
            shares = [0.93, 0.985, 1.0, 0.99, 0.96, d.roof + 0.05, d.roof - 0.02, d.roof - 0.1, d.roof - 0.26]
        return np.asarray(np.interp(np.asarray(y), heights, np.array(shares) * d.width / 2), np.float64)

    @cached_property
    def near(self) -> Surface:
        """The end towards the camera, with its depth: x from -width/2, y up."""
        d = self.design
        half = d.width / 2
        easel = Easel(-half - 0.04, half + 0.04, d.clearance - 0.04, d.height + 0.04)
        edge = np.maximum(self.half_width(easel.y), 1e-3).astype(np.float32)
        across = np.clip(np.abs(easel.x) / edge, 0, 0.999)
        bend = 1 - (1 - across**_CORNER_POWER) ** (1 / _CORNER_POWER)
        depth = (profile_at(self.end, easel.y) + d.corner * bend).astype(np.float32)
        smooth = cv2.GaussianBlur(depth, (0, 0), 1.5)
        slope_y, slope_x = np.gradient(smooth * PIXELS_PER_METRE)
        # The surface z = depth(x, y) faces the camera along (dz/dx, dz/dy, -1); rows run downwards.
        normal = np.stack([slope_x, -slope_y, -np.ones_like(slope_x)], axis=-1).astype(np.float32)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        outline_y = np.linspace(d.clearance, d.height, 60)
        outline_x = self.half_width(outline_y) * _FLANK_SHARE
        right, left = np.column_stack([outline_x, outline_y]), np.column_stack([-outline_x, outline_y])
        easel.show(easel.mask(np.concatenate([right, left[::-1]])))
        mirrored = self._mirror(normal)
        easel.color[:] = self._shade(normal, mirrored)
        if self.facing == "front":
            _bodywork.paint_front(self, easel, mirrored)
        elif d.box:
            _bodywork.paint_box(self, easel)
        else:
            _bodywork.paint_rear(self, easel, mirrored)
        self._weather(easel)
        return easel.surface(depth)

    def _shade(self, normal: Floats, mirrored: Floats) -> Floats:
        """Body colour in the light: diffuse, plus the surroundings mirrored in the paint."""
        light = self.light
        sun = np.clip(normal @ np.asarray(light.to_sun, np.float32), 0, None)
        gain = light.ambient * (0.72 + 0.36 * normal[..., 1]) + light.sun * sun
        slant = 1 - np.abs(normal[..., 2:])
        gloss = 0.1 + 0.35 * slant**2
        return np.asarray(self.paint * gain[..., None] * (1 - 0.5 * gloss) + mirrored * gloss, np.float32)

    def _mirror(self, normal: Floats) -> Floats:
        """Colour of the surroundings mirrored to a camera that looks along the road."""
        light = self.light
        # The mirrored ray's rise: the road below, a dark band of trees at the horizon, then the sky.
        steps = [-1.0, -0.25, -0.04, 0.02, 0.22, 0.4, 1.0]
        low, top = np.asarray(light.sky_low, np.float32), np.asarray(light.sky_top, np.float32)
        ground = [(58, 58, 60), (80, 80, 80), (92, 92, 90), (60, 66, 58), (72, 80, 74)]
        colors = np.array([*(np.array(ground) * (0.25 if light.dark else 1.0)), low, 0.5 * (low + top)])
        rise = np.linspace(-1, 1, 512)
        table = np.column_stack([np.interp(rise, steps, colors[:, c]) for c in range(3)]).astype(np.float32)
        index = np.clip((1 - 2 * normal[..., 2] * normal[..., 1]) * 255.5, 0, 511).astype(np.intp)
        return np.asarray(table[index], np.float32)

    def _weather(self, easel: Easel) -> None:
        """Dust towards the ground and the small unevenness of a real surface."""
        low = 0.22 * np.clip((0.75 - easel.y) / 0.6, 0, 1)[..., None]
        dust = np.array([40, 38, 36] if self.light.dark else [96, 92, 86], np.float32)
        easel.color += low * (dust - easel.color)
        # A generator of its own: the surfaces come out the same in whatever order they are painted.
        tile = wrapped_noise(np.random.default_rng([self._seed, easel.size[1]]), (128, 128), falloff=0.8)
        turns = (easel.size[0] // 128 + 1, easel.size[1] // 128 + 1)
        noise = np.tile(tile, turns)[: easel.size[0], : easel.size[1]]
        easel.color *= (1 + 0.012 * noise)[..., None]

    @cached_property
    def flank(self) -> Surface:
        """The flank, seen from outside: x is the depth from the near end, y up."""
        d = self.design
        easel = Easel(-0.3, d.length + 0.05, -0.02, d.height + 0.04)
        # Upright doors with a crease along them; above the belt the windows lean inwards.
        crease = 0.1 * np.sin((easel.y - d.clearance) / (d.belt - d.clearance) * 2 * np.pi)
        tilt = np.where(easel.y > d.belt, 0.4, crease).astype(np.float32)
        normal = np.dstack([np.zeros_like(tilt), tilt, np.full_like(tilt, -0.6)])
        mirrored = np.broadcast_to(self._mirror(normal), (*easel.size, 3))
        # The sun's share differs between left and right: it is settled when the flank is drawn.
        gain = self.light.ambient * (0.74 + 0.5 * tilt) + 0.3 * self.light.sun
        easel.color[:] = self.paint * (0.9 * gain)[..., None] + 0.16 * mirrored
        _bodywork.paint_flank(self, easel, mirrored)
        self._weather(easel)
        return easel.surface()

    @cached_property
    def under(self) -> Surface:
        """What shows beneath the near end: tyres and the dark underside, in the plane of the tyres."""
        d = self.design
        half = d.width / 2
        easel = Easel(-half, half, -0.02, d.clearance + d.wheel)
        dark = 0.5 if self.light.dark else 1.0
        easel.color[:] = np.float32(20 * dark)
        tread = 0.2 if not d.box else 0.5
        for side in (-1, 1):
            middle = side * (half - 0.03 - tread / 2)
            tyre = easel.box(middle, d.wheel, tread, 2 * d.wheel, round_by=0.05)
            easel.show(tyre)
            easel.paint(tyre, np.full(3, 34 * dark))
            easel.paint(easel.box(middle, d.wheel, 0.04, d.wheel), np.full(3, 46 * dark), 0.6)
        easel.show(easel.box(0, d.clearance + d.wheel / 2 + 0.02, d.width - 0.16, d.wheel + 0.06))
        return easel.surface()
