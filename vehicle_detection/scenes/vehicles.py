"""Painted bodies of vehicles: the end towards the camera, with its depth, the flank and the underside."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from vehicle_detection.scenes.bodywork import BodyPainter
from vehicle_detection.scenes.raster import Floats, blend, tile_to, wrapped_noise
from vehicle_detection.scenes.shapes import BodyShape, profile_at
from vehicle_detection.scenes.surface import PIXELS_PER_METER, Surface, SurfaceCanvas


class VehicleBody(BodyShape):
    """The painted surfaces of one vehicle."""

    @cached_property
    def near_end(self) -> Surface:
        """The end towards the camera, with its depth; x is 0 in the middle, y is up."""
        dims, half = self.dimensions, self.dimensions.width / 2
        canvas = SurfaceCanvas(-half - 0.04, half + 0.04, dims.clearance - 0.04, dims.height + 0.04)
        edge = np.maximum(self.half_width(canvas.y), 1e-3).astype(np.float32)
        across = np.clip(np.abs(canvas.x) / edge, 0, 0.999)
        power = 4.5  # of the superellipse that rounds the corners
        bend = 1 - (1 - across**power) ** (1 / power)
        depth = (profile_at(self.end, canvas.y) + dims.corner * bend).astype(np.float32)
        smooth = cv2.GaussianBlur(depth, (0, 0), 1.5)
        slope_y, slope_x = np.gradient(smooth * PIXELS_PER_METER)
        # The normal of z = depth(x, y) that faces the camera is (dz/dx, dz/dy, -1); rows run downwards.
        normal = np.stack([slope_x, -slope_y, -np.ones_like(slope_x)], axis=-1).astype(np.float32)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        y = np.linspace(dims.clearance, dims.height, 60)
        x = self.half_width(y) * 0.975
        canvas.make_opaque(canvas.between(x, -x, y))
        reflection = self._reflect(normal)
        canvas.color[:] = self._shade(normal, reflection)
        painter = BodyPainter(self, canvas, reflection)
        if self.view == "front":
            painter.paint_front()
        elif dims.is_box:
            painter.paint_box_rear()
        else:
            painter.paint_rear()
        self._add_dirt(canvas)
        return canvas.surface(depth)

    def _shade(self, normal: Floats, reflection: Floats) -> Floats:
        """Body color in the light: diffuse shading and the reflection of the surroundings."""
        light = self.light
        sun = np.clip(normal @ np.asarray(light.to_sun, np.float32), 0, None)
        gain = light.ambient * (0.72 + 0.36 * normal[..., 1]) + light.sun * sun
        gloss = 0.1 + 0.35 * (1 - np.abs(normal[..., 2:])) ** 2
        return np.asarray(self.color * gain[..., None] * (1 - 0.5 * gloss) + reflection * gloss, np.float32)

    def _reflect(self, normal: Floats) -> Floats:
        """Color of the surroundings that a camera looking along the road sees in a mirror."""
        light = self.light
        # Elevation of the reflected ray: road, then a dark band of trees at the horizon, then sky.
        elevations = [-1.0, -0.25, -0.04, 0.02, 0.22, 0.4, 1.0]
        low, top = np.asarray(light.sky_low, np.float32), np.asarray(light.sky_top, np.float32)
        ground = [(58, 58, 60), (80, 80, 80), (92, 92, 90), (60, 66, 58), (72, 80, 74)]
        colors = np.array([*(np.array(ground) * (0.25 if light.dark else 1.0)), low, 0.5 * (low + top)])
        steps = np.linspace(-1, 1, 512)
        table = np.column_stack([np.interp(steps, elevations, channel) for channel in colors.T])
        index = np.clip((1 - 2 * normal[..., 2] * normal[..., 1]) * 255.5, 0, 511).astype(np.intp)
        return np.asarray(table.astype(np.float32)[index], np.float32)

    def _add_dirt(self, canvas: SurfaceCanvas) -> None:
        """Add dust near the ground and a slight unevenness."""
        dust = np.array([40, 38, 36] if self.light.dark else [96, 92, 86], np.float32)
        blend(canvas.color, dust, 0.22 * np.clip((0.75 - canvas.y) / 0.6, 0, 1)[..., None])
        # A generator of its own makes the surface independent of the order in which surfaces are painted.
        rng = np.random.default_rng([self.seed, canvas.size[1]])
        noise = tile_to(wrapped_noise(rng, (128, 128), falloff=0.8), *canvas.size)
        canvas.color *= (1 + 0.012 * noise)[..., None]

    @cached_property
    def flank(self) -> Surface:
        """The flank seen from outside: x is the distance behind the near end, y is up."""
        dims = self.dimensions
        canvas = SurfaceCanvas(-0.3, dims.length + 0.05, -0.02, dims.height + 0.04)
        # The doors are upright with a crease; above the belt the windows lean inwards.
        crease = 0.1 * np.sin((canvas.y - dims.clearance) / (dims.belt - dims.clearance) * 2 * np.pi)
        tilt = np.where(canvas.y > dims.belt, 0.4, crease).astype(np.float32)
        normal = np.dstack([np.zeros_like(tilt), tilt, np.full_like(tilt, -0.6)])
        reflection = np.broadcast_to(self._reflect(normal), (*canvas.size, 3))
        # The sun on the left and the right flank differs; `render` accounts for it.
        gain = self.light.ambient * (0.74 + 0.5 * tilt) + 0.3 * self.light.sun
        canvas.color[:] = self.color * (0.9 * gain)[..., None] + 0.16 * reflection
        BodyPainter(self, canvas, reflection).paint_flank()
        self._add_dirt(canvas)
        return canvas.surface()

    @cached_property
    def underside(self) -> Surface:
        """Tires and dark underside below the near end, in the plane of the tires' contact with the road."""
        dims, half = self.dimensions, self.dimensions.width / 2
        canvas = SurfaceCanvas(-half, half, -0.02, dims.clearance + dims.wheel_radius)
        gain = 0.5 if self.light.dark else 1.0
        canvas.color[:] = np.float32(20 * gain)
        radius, width = dims.wheel_radius, 0.5 if dims.is_box else 0.2
        for side in (-1, 1):
            middle = side * (half - 0.03 - width / 2)
            tire = canvas.box(middle, radius, width, 2 * radius, radius=0.05)
            canvas.make_opaque(tire)
            canvas.paint(tire, np.full(3, 34 * gain))
            canvas.paint(canvas.box(middle, radius, 0.04, radius), np.full(3, 46 * gain), 0.6)
        middle = dims.clearance + radius / 2 + 0.02
        canvas.make_opaque(canvas.box(0, middle, dims.width - 0.16, radius + 0.06))
        return canvas.surface()
