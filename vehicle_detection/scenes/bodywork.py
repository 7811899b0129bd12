"""Painted bodies of vehicles: surfaces in meters, and what is painted on the ends and flanks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection.scenes.raster import Color, Doubles, Floats, blend, tile_to, wrapped_noise
from vehicle_detection.scenes.shapes import BodyShape, profile_at

PIXELS_PER_METER = 112


@dataclass(frozen=True, eq=False)
class Surface:
    """A painted surface: ``(H, W, 4)`` premultiplied RGBA, 0-255."""

    rgba: Floats
    left: float  # position of the upper left corner (m)
    top: float
    depth: Floats | None = None  # (H, W) distance behind the nearest point (m)
    _mipmaps: dict[tuple[int, ...], Floats] = field(default_factory=dict, init=False)

    def mipmap(self, x_ratio: float, y_ratio: float) -> tuple[Floats, float, float]:
        """Return the surface reduced by up to these ratios, and its pixels per meter along x and y."""
        steps = [int(np.clip(np.log2(max(ratio, 1.0)) + 0.25, 0, 6)) for ratio in (x_ratio, y_ratio)]
        height, width = self.rgba.shape[:2]
        size = (max(1, width >> steps[0]), max(1, height >> steps[1]))
        if size not in self._mipmaps:
            rgba = cv2.resize(self.rgba, size, interpolation=cv2.INTER_AREA) if any(steps) else self.rgba
            self._mipmaps[size] = np.asarray(rgba, np.float32)
        return self._mipmaps[size], PIXELS_PER_METER * size[0] / width, PIXELS_PER_METER * size[1] / height


@dataclass(frozen=True, eq=False)
class Mask:
    """Coverage of pixels by a shape, 0-1, in the part of a canvas where the shape lies."""

    values: Floats
    region: tuple[slice, slice]  # rows and columns of the part
    size: tuple[int, int]  # of the canvas

    def _aligned(self, other: Mask) -> Floats:
        """Values of another mask in this region, 0 where the other does not reach."""
        values = np.zeros(self.size, np.float32)
        values[other.region] = other.values
        return values[self.region]

    def __and__(self, other: Mask) -> Mask:
        return replace(self, values=self.values * self._aligned(other))

    def __sub__(self, other: Mask) -> Mask:
        return replace(self, values=np.maximum(self.values - self._aligned(other), 0))


class SurfaceCanvas:
    """A canvas from `left` to `right` and `low` to `top` in meters, to paint polygons on."""

    def __init__(self, left: float, right: float, low: float, top: float) -> None:
        ppm = PIXELS_PER_METER
        self.left, self.top = left, top
        height, width = self.size = round((top - low) * ppm), round((right - left) * ppm)
        columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
        self.x: Floats = np.asarray(left + (columns[None, :] + 0.5) / ppm, np.float32)
        self.y: Floats = np.asarray(top - (rows[:, None] + 0.5) / ppm, np.float32)
        self.color: Floats = np.zeros((*self.size, 3), np.float32)
        self.alpha: Floats = np.zeros(self.size, np.float32)

    def polygon(self, points: ArrayLike, *, soften: float = 0.0) -> Mask:
        """Mask of a polygon of ``(x, y)`` points, blurred by `soften` meters."""
        corners = (np.asarray(points, np.float64) - (self.left, self.top)) * (1, -1) * PIXELS_PER_METER - 0.5
        margin = 2 + int(3 * soften * PIXELS_PER_METER)
        x1, y1 = np.maximum(np.floor(corners.min(0)).astype(int) - margin, 0).tolist()
        x2, y2 = np.minimum(np.ceil(corners.max(0)).astype(int) + margin + 1, self.size[::-1]).tolist()
        filled = np.zeros((y2 - y1, x2 - x1), np.uint8)
        cv2.fillPoly(filled, [np.rint((corners - (x1, y1)) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        values = filled.astype(np.float32) / 255
        if soften:
            values = cv2.GaussianBlur(values, (0, 0), soften * PIXELS_PER_METER)  # type: ignore[assignment]
        return Mask(np.asarray(values, np.float32), (slice(y1, y2), slice(x1, x2)), self.size)

    def between(self, left: Doubles, right: Doubles, y: Doubles, *, soften: float = 0.0) -> Mask:
        """Mask of the area between two curves, given by their `x` at ascending heights `y`."""
        outline = np.column_stack([np.append(left, right[::-1]), np.append(y, y[::-1])])
        return self.polygon(outline, soften=soften)

    def box(self, x: float, y: float, width: float, height: float, *, radius: float = 0.0) -> Mask:
        """Mask of a box centered at ``(x, y)`` with rounded corners."""
        w, h = width / 2, height / 2
        corners = [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]
        return self.polygon(round_corners(corners, radius))

    def paint(self, mask: Mask, color: ArrayLike, opacity: float = 1.0) -> None:
        """Composite a color, or an ``(H, W, 3)`` image of colors, under a mask."""
        paint = np.asarray(color, np.float32)
        if paint.ndim == 3:
            paint = np.broadcast_to(paint, self.color.shape)[mask.region]
        blend(self.color[mask.region], paint, (mask.values * opacity)[..., None])

    def multiply(self, mask: Mask, gain: float) -> None:
        """Multiply the color under a mask by `gain`."""
        self.color[mask.region] *= (1 + mask.values * (gain - 1))[..., None]

    def make_opaque(self, mask: Mask) -> None:
        """Add a mask to the opaque part of the canvas."""
        alpha = self.alpha[mask.region]
        np.maximum(alpha, mask.values, out=alpha)

    def surface(self, depth: Floats | None = None) -> Surface:
        """Return what has been painted."""
        color = np.clip(self.color, 0, 255) * self.alpha[..., None]
        return Surface(np.dstack([color, self.alpha * 255]), self.left, self.top, depth)


def round_corners(corners: ArrayLike, radius: float) -> Doubles:
    """Replace each corner of a polygon by a curve that starts `radius` before it."""
    points = np.asarray(corners, np.float64)
    if radius <= 0:
        return points
    t = np.linspace(0, 1, 7)[:, None]
    curves = []
    for before, corner, after in zip(np.roll(points, 1, 0), points, np.roll(points, -1, 0)):
        start, end = (
            corner + (other - corner) * min(0.5, radius / max(float(np.linalg.norm(other - corner)), 1e-9))
            for other in (before, after)
        )
        curves.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(curves)


class BodyPainter:
    """Paints the details of one end or flank of a vehicle on a canvas in the body color."""

    def __init__(self, body: BodyShape, canvas: SurfaceCanvas, reflection: Floats) -> None:
        self.body, self.canvas = body, canvas
        self.reflection = reflection  # (H, W, 3) color of the surroundings in a mirror
        self.dims, self.look, self.light = body.dimensions, body.appearance, body.light

    def by_light(self, night: float, day: float) -> float:
        """Choose a value for night or day."""
        return night if self.light.dark else day

    def band(self, low: float, high: float, ratio: float, inset: float = 0.0, *, soften: float = 0.0) -> Mask:
        """Mask of a band across the body, `ratio` of its width less `inset` meters at each side."""
        y = np.linspace(low, high, 12)
        x = self.body.half_width(y) * ratio - inset
        return self.canvas.between(x, -x, y, soften=soften)

    def paint_box(
        self, x: float, y: float, width: float, height: float, color: ArrayLike, opacity: float,
        radius: float = 0.0,
    ) -> None:  # fmt: skip
        """Paint a box centered at ``(x, y)``."""
        self.canvas.paint(self.canvas.box(x, y, width, height, radius=radius), color, opacity)

    def paint_window(self, low: float, high: float, ratio: float, inset: float, radius: float) -> Mask:
        """Paint a window across the body."""
        bottom, top = (float(self.body.half_width(y)) * ratio - inset for y in (low, high))
        corners = [(-bottom, low), (bottom, low), (top, high), (-top, high)]
        return self.paint_glass(round_corners(corners, radius), seats=True)

    def paint_glass(self, outline: Doubles, *, seats: bool) -> Mask:
        """Paint a pane: a dark cabin behind it, the reflected sky on it, a dark seal around it."""
        canvas, look = self.canvas, self.look
        gain = self.by_light(0.3, 1.0)
        low, high = float(outline[:, 1].min()), float(outline[:, 1].max())
        rise = np.clip((canvas.y - low) / (high - low), 0, 1)
        canvas.paint(canvas.polygon(outline, soften=0.012), (18, 18, 20), 0.75)
        pane = canvas.polygon(outline)
        cabin = np.array([34, 38, 42], np.float32) * (gain * look.glass_tint * self.light.ambient / 0.6)
        canvas.paint(pane, cabin * (0.8 + 0.5 * rise)[..., None])
        for side in (-1, 1) if seats else ():
            seat = canvas.box(side * 0.36, low + 0.1, 0.26, 0.34, radius=0.1)
            canvas.paint(seat & pane, np.array([22, 24, 26]) * gain, 0.55)
        ripple = 0.75 + 0.25 * np.sin(canvas.x * 5.0 + look.seed % 7) * np.cos(canvas.y * 9.0 + look.seed % 5)
        strength = (0.16 + 0.42 * look.glass_reflection) * (0.45 + 0.55 * rise) * ripple
        color, strength = canvas.color[pane.region], pane.values * strength[pane.region]
        color += strength[..., None] * (self.reflection[pane.region] - 0.4 * color)
        return pane

    def paint_plate(self, y: float) -> None:
        """Paint a license plate with its recess."""
        light, look = self.light, self.look
        gain = self.by_light(max(0.5, light.lamps * 0.7), min(1.1, light.ambient + 0.6 * light.sun))
        self.paint_box(0, y, 0.6, 0.185, self.body.color * 0.35, 0.55, radius=0.03)
        self.paint_box(0, y, 0.52, 0.115, np.array(look.plate_color) * gain, 1.0)
        rng = np.random.default_rng(look.seed)
        for x in np.linspace(-0.2, 0.2, 8):
            if rng.random() < 0.85:
                self.paint_box(x, y, rng.uniform(0.02, 0.045), 0.066, (40, 42, 48), 0.8)

    def paint_lamp(self, outline: Doubles, color: Color) -> None:
        """Paint a lamp: its glass, darker at the rim, and its light."""
        canvas, lamps = self.canvas, self.light.lamps
        mask = canvas.polygon(outline)
        gain = self.by_light(0.45, self.light.ambient + 0.4 * self.light.sun)
        canvas.paint(canvas.polygon(outline, soften=0.012), (26, 16, 16), 0.55)
        canvas.paint(mask, np.array(color) * gain)
        core = canvas.polygon(outline.mean(0) + (outline - outline.mean(0)) * 0.55, soften=0.02)
        canvas.paint(core, np.minimum(np.array(color) * 1.25 + 38, 255) * max(gain, lamps), 0.55)
        if lamps:
            canvas.paint(mask, np.minimum(np.array(color) * 1.3 + 60, 255), 0.75 * lamps)

    def paint_rear(self) -> None:
        """Paint the rear of a car: bumper, tailgate or trunk lid, window, tail lamps, plate."""
        canvas, dims, look, light = self.canvas, self.dims, self.look, self.light
        sedan = dims.rear[-1][1] > 1.5
        bumper_top = dims.clearance + 0.42
        # The bumper has a crease at its top and a dark lower edge.
        if look.plastic_bumper:
            plastic = np.array([46, 47, 49]) * self.by_light(0.35, light.ambient / 0.6)
            canvas.paint(self.band(dims.clearance, bumper_top - 0.04, 1.2), plastic, 0.9)
        canvas.multiply(self.band(bumper_top - 0.012, bumper_top + 0.012, 0.99), 0.35)
        canvas.multiply(self.band(bumper_top - 0.1, bumper_top - 0.075, 0.96), 1.22)
        lower_edge = self.band(dims.clearance - 0.02, dims.clearance + 0.09, 0.82, soften=0.02)
        canvas.paint(lower_edge, (24, 24, 26), 0.9)
        for side in (-1, 1):
            self.paint_box(side * 0.62, dims.clearance + 0.16, 0.16, 0.035, (120, 20, 20), 0.8, radius=0.01)
        if look.exhaust:
            self.paint_box(-0.5, dims.clearance + 0.02, 0.11, 0.05, (150, 150, 150), 0.7, radius=0.02)
        # Gaps around the tailgate and a crease under the window.
        low = dims.belt + (0.11 if sedan else 0.03)
        high = dims.height - (0.075 if sedan else 0.11)
        gate = self.band(bumper_top, dims.belt + (0.02 if sedan else 0.0), 0.8, 0.03)
        canvas.multiply(gate - self.band(bumper_top + 0.012, dims.belt - 0.012, 0.8, 0.042), 0.5)
        canvas.multiply(self.band(dims.belt - 0.2, dims.belt - 0.18, 0.8, 0.05), 0.78)
        if sedan:
            # The trunk lid reflects the sky.
            lid = self.band(dims.belt + 0.025, dims.belt + 0.085, 0.93, 0.02, soften=0.01)
            canvas.paint(lid, self.reflection, 0.3)
            edge = self.band(dims.belt - 0.06, dims.belt - 0.005, 0.9, 0.02, soften=0.01)
            canvas.multiply(edge, 1.12)
        if not look.windowless:
            self.paint_window(low, high, 0.86 if sedan else 0.93, 0.0 if sedan else 0.035, 0.1)
            if not sedan:
                self.paint_box(-0.12, low + 0.03, 0.42, 0.018, (14, 14, 14), 0.8)
        if look.rear_doors:
            middle, length = (dims.clearance + dims.height) / 2 + 0.1, dims.height - dims.clearance - 0.4
            self.paint_box(0, middle, 0.05, length, self.body.color * 0.6, 0.9)
            canvas.multiply(canvas.box(0, middle, 0.014, length), 0.3)
        roof = self.band(high + 0.035, dims.height - 0.015, 0.86, 0.04, soften=0.008)
        canvas.paint(roof, self.reflection * 0.5 + self.body.color * 0.55 * self.by_light(0.3, 1), 0.35)
        self.paint_box(0, high + 0.02, 0.34, 0.022, (110, 20, 20), 0.8)
        self._paint_tail_lamps(bumper_top, low)
        metal = self.by_light(0.3, 0.9)
        if look.chrome:
            self.paint_box(0, dims.belt - 0.15, 0.56, 0.028, np.array((196, 198, 200)) * metal, 0.8)
        self.paint_plate(dims.belt - 0.24 if look.plate_high else dims.clearance + 0.24)
        self.paint_box(0, dims.belt - 0.09, 0.07, 0.07, np.array((190, 192, 196)) * metal, 0.8, radius=0.035)

    def _paint_tail_lamps(self, bumper_top: float, window_low: float) -> None:
        look, half_width = self.look, self.body.half_width
        rng = np.random.default_rng(look.seed + 1)
        if not look.tall_lamps:
            top = self.dims.belt - 0.05
        elif self.dims.height > 1.5 or rng.random() < 0.4:
            top = window_low + rng.uniform(-0.05, 0.3)
        else:
            top = window_low - 0.02
        low = max(top - look.lamp_height, bumper_top - 0.03)
        lean = rng.uniform(0.0, 0.05)
        outer_low, outer_top = (float(half_width(y)) * 0.985 for y in (low, top))
        inner_low, inner_top = outer_low - look.lamp_width - lean, outer_top - look.lamp_width + lean
        corners = np.array([(outer_low, low), (outer_top, top), (inner_top, top), (inner_low, low)])
        reverse_light = np.array((226, 206, 200)) * self.by_light(0.4, 0.9)
        for side in (-1, 1):
            outline = round_corners(corners * (side, 1), 0.05)
            self.paint_lamp(outline, (136, 20, 24))
            x, y = outline.mean(0)
            if look.tall_lamps:
                lens = (x, low + 0.3 * look.lamp_height, look.lamp_width * 0.6, 0.055)
            else:
                lens = (x - side * 0.3 * look.lamp_width, y, 0.07, look.lamp_height * 0.5)
            self.paint_box(*lens, reverse_light, 0.65, radius=0.02)

    def paint_front(self) -> None:
        """Paint the front of a vehicle: windshield, hood, headlamps, grille, bumper, plate."""
        canvas, dims, look, light = self.canvas, self.dims, self.look, self.light
        heights = np.linspace(0.6, dims.belt, 40)
        nose = float(np.interp(0.22, profile_at(dims.front, heights), heights))
        front_heights, front_depths = zip(*dims.front)
        low = float(np.interp(0.1 if dims.is_box else 1.05, front_depths, front_heights))
        low = min(max(low, dims.belt), dims.height - 0.5)
        high = 2.4 if dims.is_box else dims.height - 0.1
        pane = self.paint_window(low, high, 0.92, 0.02, 0.09)
        mirror = canvas.box(0, high - 0.07, 0.2, 0.06, radius=0.03)
        canvas.paint(mirror & pane, (20, 22, 24), 0.9)
        # The gap at the front edge of the hood.
        canvas.multiply(self.band(nose - 0.01, nose + 0.008, 0.86, 0.05), 0.5)
        dark = np.array([22, 22, 24]) * self.by_light(0.5, 1.0)
        grille_y = nose - 0.06 - look.grille_height / 2
        self.paint_box(0, grille_y, 0.72, look.grille_height, dark, 0.92, radius=0.04)
        if look.chrome:
            self.paint_box(0, grille_y, 0.7, 0.02, (190, 192, 196), 0.7)
        self.paint_box(0, dims.clearance + 0.13, 1.05, 0.13, dark, 0.9, radius=0.05)
        top = nose - 0.02
        outer = float(self.body.half_width(top)) * 0.97
        corners = np.array([(0, 0.03), (-0.4, -0.03), (-0.36, -0.17), (-0.02, -0.13)])
        corners += (outer, top)
        for side in (-1, 1):
            self.paint_box(side * 0.66, dims.clearance + 0.14, 0.17, 0.1, dark, 0.7, radius=0.04)
            outline = round_corners(corners * (side, 1), 0.05)
            self.paint_lamp(outline, (186, 190, 196))
            if light.lamps > 0.3:
                x, y = outline.mean(0)
                self.paint_box(x, y, 0.2, 0.15, (255, 252, 236), light.lamps, radius=0.07)
        canvas.multiply(self.band(dims.clearance + 0.4, dims.clearance + 0.415, 0.98), 0.6)
        self.paint_plate(dims.clearance + 0.27)
        canvas.paint(self.band(dims.clearance - 0.02, dims.clearance + 0.05, 0.86, soften=0.02), dark, 0.9)

    def paint_box_rear(self) -> None:
        """Paint the rear of a box truck: cargo doors, lamps, underrun bar, plate."""
        canvas, dims, light = self.canvas, self.dims, self.light
        half, middle = dims.width / 2, (1 + dims.height) / 2
        gain = self.by_light(0.4, light.ambient + 0.4 * light.sun)
        doors = self.band(1.0, dims.height, 1.0)
        shade = 1.03 - 0.1 * (canvas.y - 1.0) / (dims.height - 1.0)
        canvas.paint(doors, np.array(self.look.cargo_color) * gain * shade[..., None])
        frame = doors - self.band(1.06, dims.height - 0.07, 1.0, 0.07)
        canvas.paint(frame, np.array([150, 150, 152]) * gain, 0.8)
        canvas.multiply(canvas.box(0, middle, 0.025, dims.height - 1.1), 0.35)
        for x in (-0.75, -0.3, 0.3, 0.75):
            canvas.multiply(canvas.box(x, middle, 0.03, dims.height - 1.15), 0.72)
            self.paint_box(x, 1.6, 0.09, 0.06, np.array([90, 90, 92]) * gain, 0.8)
        canvas.paint(self.band(dims.clearance, 1.0, 1.0), np.array([30, 30, 32]) * self.by_light(0.5, 1))
        self.paint_box(0, 0.55, dims.width * 0.92, 0.12, np.array([120, 120, 120]) * gain, 0.8)
        for side in (-1, 1):
            outer, inner = side * (half - 0.1), side * (half - 0.5)
            outline = round_corners([(outer, 0.78), (outer, 0.94), (inner, 0.94), (inner, 0.78)], 0.03)
            self.paint_lamp(outline, (176, 24, 26))
        self.paint_plate(0.8)

    def paint_flank(self) -> None:
        """Paint a flank: outline, windows with pillars, wheels in their arches, doors, sill."""
        canvas, dims, look, light, body = self.canvas, self.dims, self.look, self.light, self.body
        y = np.linspace(dims.clearance, dims.height, 50)
        near, far = profile_at(body.end, y) - 0.06, dims.length - profile_at(body.far_end, y)
        canvas.make_opaque(canvas.between(near, far, y))
        dark = np.array([20, 20, 21]) * self.by_light(0.5, 1.0)
        if dims.is_box:
            start, stop = (1.6, dims.length) if body.view == "front" else (0.0, dims.length - 1.7)
            cargo = self._rectangle(start, stop, 1.0, dims.height)
            gain = self.by_light(0.4, light.ambient + 0.3 * light.sun)
            canvas.paint(cargo, np.array(look.cargo_color) * gain)
            canvas.paint(self._rectangle(0, dims.length, 0, 1.0), dark * 1.6, 0.85)
        low, high = dims.belt + 0.02, dims.height - 0.09
        self._paint_side_windows(low, high)
        crease = [(0.1, -0.18), (dims.length - 0.2, -0.2), (dims.length - 0.2, -0.215), (0.1, -0.195)]
        canvas.multiply(canvas.polygon([(x, dims.belt + y) for x, y in crease]), 0.75)
        sill = self._rectangle(0, dims.length, dims.clearance - 0.05, dims.clearance + 0.1)
        canvas.paint(sill, dark * 1.3, 0.75)
        gain = self.by_light(0.35, light.ambient / 0.65)
        if not dims.is_box:
            lamp = np.array([(-0.02, -0.28), (0.2, -0.26), (0.16, -0.1), (-0.02, -0.08)])
            lamp[:, 1] += dims.belt
            color = np.array((160, 24, 26) if body.view == "rear" else (190, 194, 198))
            canvas.paint(canvas.polygon(round_corners(lamp, 0.03)), color * max(gain, light.lamps), 0.9)
        self._paint_wheels(dark, gain)

    def _rectangle(self, x1: float, x2: float, y1: float, y2: float) -> Mask:
        return self.canvas.polygon([(x1, y1), (x2, y1), (x2, y2), (x1, y2)])

    def _paint_side_windows(self, low: float, high: float) -> None:
        """Paint windows, pillars, door gaps and door handles."""
        canvas, dims, body = self.canvas, self.dims, self.body
        first, last = dims.windows
        if body.view == "front":
            first, last = dims.length - last, dims.length - first
        y = np.array([low, high])
        near = np.maximum(profile_at(body.end, y) + 0.1, first)
        far = np.minimum(dims.length - profile_at(body.far_end, y) - 0.1, last)
        pane = np.array([(near[0], low), (far[0], low), (far[1], high), (near[1], high)])
        canvas.multiply(self.paint_glass(round_corners(pane, 0.06), seats=False), 0.85)
        if dims.is_box:
            return
        for position in (0.3, 0.62):
            x = near[0] + (far[0] - near[0]) * position
            self.paint_box(x, (low + high) / 2, 0.07, high - low, body.color * self.by_light(0.12, 0.4), 0.9)
            gap = canvas.box(x, (dims.clearance + low) / 2 + 0.06, 0.014, low - dims.clearance - 0.12)
            canvas.multiply(gap, 0.55)
            self.paint_box(x + 0.2, dims.belt - 0.11, 0.17, 0.03, body.color * 0.7, 0.6)

    def _paint_wheels(self, dark: Doubles, gain: float) -> None:
        canvas, dims, body = self.canvas, self.dims, self.body
        angles = np.linspace(0, 2 * np.pi, 40)
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        for hub in (body.overhang, dims.length - body.far_overhang):
            center = np.array([hub, dims.wheel_radius])
            canvas.paint(canvas.polygon(center + circle * (dims.wheel_radius + 0.06)), dark * 0.7)
            tire = canvas.polygon(center + circle * dims.wheel_radius)
            canvas.make_opaque(tire)
            canvas.paint(tire, dark * 1.4)
            rim = canvas.polygon(center + circle * dims.wheel_radius * 0.64)
            canvas.paint(rim, np.full(3, self.look.rim_tone * 0.85 * gain))
            for angle in np.arange(5) * 2 * np.pi / 5 + self.look.seed % 3:
                spoke = center + np.array([np.cos(angle), np.sin(angle)]) * dims.wheel_radius * 0.42
                canvas.paint(canvas.polygon(spoke + circle * dims.wheel_radius * 0.13), dark, 0.85)


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
