"""Vehicles as painted surfaces: what the two ends, the flanks and the underside look like, in meters.

A vehicle is a rounded body: its half width depends on the height, the depth of its near end on height
and side. That gives each surface its normals, and so its shading, and lets `_sprites` draw it in perspective.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic import bodywork as _bodywork
from vehicle_detection.synthetic.bodywork import PIXELS_PER_METRE, Easel, Surface
from vehicle_detection.synthetic.camera_light import Color, Floats, Light, wrapped_noise
from vehicle_detection.synthetic.shapes import DESIGNS, Looks, profile_at

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
        """Half of the body's width at heights `y`, in meters."""
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
        """Body color in the light: diffuse, plus the surroundings mirrored in the paint."""
        light = self.light
        sun = np.clip(normal @ np.asarray(light.to_sun, np.float32), 0, None)
        gain = light.ambient * (0.72 + 0.36 * normal[..., 1]) + light.sun * sun
        slant = 1 - np.abs(normal[..., 2:])
        gloss = 0.1 + 0.35 * slant**2
        return np.asarray(self.paint * gain[..., None] * (1 - 0.5 * gloss) + mirrored * gloss, np.float32)

    def _mirror(self, normal: Floats) -> Floats:
        """Color of the surroundings mirrored to a camera that looks along the road."""
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
