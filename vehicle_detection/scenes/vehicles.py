"""Vehicles: their shapes, colors and details, and their painted surfaces in meters."""

from __future__ import annotations

import importlib.resources
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection.scenes.camera_light import (
    Color,
    Doubles,
    Floats,
    Light,
    Rng,
    blend,
    tile_to,
    wrapped_noise,
)

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


_DATA = json.loads((importlib.resources.files("vehicle_detection.scenes") / "vehicles.json").read_bytes())
VEHICLE_SHAPES = {kind: VehicleShape(**shape) for kind, shape in _DATA["shapes"].items()}
# Frequencies where none is requested; a truck is only drawn on request.
KIND_WEIGHTS: dict[str, int] = _DATA["kind_weights"]
COLORS: dict[str, Color] = {name: tuple(color) for name, (color, _) in _DATA["colors_and_weights"].items()}
COLOR_WEIGHTS: dict[str, int] = {name: weight for name, (_, weight) in _DATA["colors_and_weights"].items()}


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


PIXELS_PER_METER = 112
_LAYERS: dict[str, list[dict[str, Any]]] = _DATA["paint"]
# A term of a length such as "0.5*belt-0.2".
_TERM = re.compile(r"([+-]?)(?:([\d.]+)\*?)?([a-z_]*)")


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


class Mask(NamedTuple):
    """Coverage of pixels by a shape, 0-1, in the part of a canvas where the shape lies."""

    values: Floats
    region: tuple[slice, slice]  # rows and columns of the part


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

    def polygon(self, points: ArrayLike, *holes: ArrayLike, soften: float = 0.0) -> Mask:
        """Mask of a polygon of ``(x, y)`` points with holes, blurred by `soften` meters."""
        corners, *inner = (
            (np.asarray(each, np.float64) - (self.left, self.top)) * (1, -1) * PIXELS_PER_METER - 0.5
            for each in (points, *holes)
        )
        margin = 2 + int(3 * soften * PIXELS_PER_METER)
        x1, y1 = np.maximum(np.floor(corners.min(0)).astype(int) - margin, 0).tolist()
        x2, y2 = np.minimum(np.ceil(corners.max(0)).astype(int) + margin + 1, self.size[::-1]).tolist()
        filled = np.zeros((y2 - y1, x2 - x1), np.uint8)
        outlines = [np.rint((each - (x1, y1)) * 16).astype(np.int32) for each in (corners, *inner)]
        cv2.fillPoly(filled, outlines, 255, cv2.LINE_AA, 4)
        values = filled.astype(np.float32) / 255
        if soften:
            values = cv2.GaussianBlur(values, (0, 0), soften * PIXELS_PER_METER)  # type: ignore[assignment]
        return Mask(np.asarray(values, np.float32), (slice(y1, y2), slice(x1, x2)))

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
    """Paints the layers of one end or flank of a vehicle (``vehicles.json``) on a canvas in its color.

    What the shape of a layer covers is multiplied by a ``gain``, becomes a ``lamp`` or ``glass``, or is
    painted in a ``color``, ``lit`` by a factor. Lengths (m) may be sums of named ones, and a layer may depend
    on details of the vehicle (``if``).
    """

    def __init__(self, body: VehicleBody, canvas: SurfaceCanvas, reflection: Floats) -> None:
        self.body, self.canvas = body, canvas
        self.reflection = reflection  # (H, W, 3) color of the surroundings in a mirror
        dims, look, light = body.dimensions, body.appearance, body.light
        self.dims, self.look, self.lamps = dims, look, light.lamps
        lengths = ("clearance", "belt", "height", "width", "length")
        self.names = {"": 1.0, "lamps": light.lamps} | {name: getattr(dims, name) for name in lengths}
        self.flags = vars(look) | {"is_box": dims.is_box, "shining": light.lamps > 0.3}
        bright = light.ambient + 0.4 * light.sun
        gains = {  # at night and by day
            "dark": (0.5, 1.0), "metal": (0.3, 0.9), "plastic": (0.35, light.ambient / 0.6),
            "reverse": (0.4, 0.9), "lamp": (0.45, bright), "cargo": (0.4, bright), "pillar": (0.12, 0.4),
            "plate": (max(0.5, light.lamps * 0.7), min(1.1, bright + 0.2 * light.sun)),
            "flank": (0.35, light.ambient / 0.65), "cabin": (0.3, 1.0),
        }  # fmt: skip
        self.gains = {name: night if light.dark else day for name, (night, day) in gains.items()}
        self.gains["side_lamp"] = max(self.gains["flank"], light.lamps)
        rise = (canvas.y - 1.0) / (dims.height - 1.0)
        self.colors: dict[str, ArrayLike] = {
            "body": body.color,
            "reflection": reflection,
            "roof": reflection * 0.5 + body.color * 0.55 * self.gains["cabin"],
            "cargo": look.cargo_color,
            "doors": np.array(look.cargo_color) * (1.03 - 0.1 * rise)[..., None],
            "side_lamp": (160, 24, 26) if body.view == "rear" else (190, 194, 198),
            "plate": look.plate_color,
        }

    def paint(self, part: str) -> None:
        """Paint the layers of a part."""
        for layer in _LAYERS[part]:
            if all(bool(self.flags[name.lstrip("!")]) == (name[0] != "!") for name in layer.get("if", ())):
                self._paint_layer(layer)

    def _paint_layer(self, layer: dict[str, Any]) -> None:
        canvas, color, lit = self.canvas, layer.get("color"), layer.get("lit", 1.0)
        opacity = self._measure(layer.get("opacity", 1.0))
        for outline in self._outlines(layer):
            holes = [self._band(layer["minus"])] if "minus" in layer else []
            mask = canvas.polygon(outline, *holes, soften=layer.get("soften", 0.0))
            if "glass" in layer:
                self.paint_glass(outline, seats=(-0.36, 0.36))
            elif "lamp" in layer:
                self._paint_lamp(outline, np.array(color))
            elif "gain" in layer:
                canvas.multiply(mask, layer["gain"])
            else:
                paint = np.asarray(self.colors[color] if isinstance(color, str) else color, np.float32)
                canvas.paint(mask, paint * self.gains.get(lit, lit), opacity)

    def _measure(self, value: Any) -> Any:
        """Numbers for lengths such as 0.2 or ``"0.5*belt-0.2"``, or for lists of them."""
        if isinstance(value, list):
            return [self._measure(each) for each in value]
        terms = _TERM.findall(value) if isinstance(value, str) else [("", value, "")]
        return sum(
            float(f"{sign}{factor or 1}") * self.names[name] for sign, factor, name in terms if factor or name
        )

    def _outlines(self, layer: dict[str, Any]) -> list[Doubles]:
        """Outlines of a layer's shape: boxes at each `x`, a band, or a polygon and its mirror image."""
        if "box" in layer:
            x, y, width, height = self._measure(layer["box"])
            corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)
            outlines = [np.add(corners, (middle, y)) for middle in np.atleast_1d(x)]
        elif "band" in layer:
            outlines = [self._band(layer["band"], layer.get("steps", 12))]
        else:
            points = np.array(self._measure(layer["polygon"]))
            outlines = [points * (side, 1) for side in ((-1, 1) if "mirrored" in layer else (1,))]
        return [round_corners(outline, layer.get("radius", 0.0)) for outline in outlines]

    def _band(self, band: list[Any], steps: int = 12) -> Doubles:
        """Outline of a band across the body, a ratio of its width less some meters at each side."""
        low, high, ratio, inset = self._measure(band)
        y = np.linspace(low, high, steps)
        x = self.body.half_width(y) * ratio - inset
        return np.column_stack([np.append(-x, x[::-1]), np.append(y, y[::-1])])

    def paint_glass(self, outline: Doubles, *, seats: Sequence[float] = ()) -> Mask:
        """Paint a pane: a dark cabin behind it, the reflected sky on it, a dark seal around it."""
        canvas, look = self.canvas, self.look
        gain = self.gains["cabin"]
        low, high = float(outline[:, 1].min()), float(outline[:, 1].max())
        rise = np.clip((canvas.y - low) / (high - low), 0, 1)
        canvas.paint(canvas.polygon(outline, soften=0.012), (18, 18, 20), 0.75)
        pane = canvas.polygon(outline)
        cabin = np.array([34, 38, 42], np.float32) * (gain * look.glass_tint * self.body.light.ambient / 0.6)
        canvas.paint(pane, cabin * (0.8 + 0.5 * rise)[..., None])
        for x in seats:
            seat = canvas.box(x, low + 0.14, 0.26, 0.26, radius=0.08)
            canvas.paint(seat, np.array([22, 24, 26]) * gain, 0.55)
        ripple = 0.75 + 0.25 * np.sin(canvas.x * 5.0 + look.seed % 7) * np.cos(canvas.y * 9.0 + look.seed % 5)
        strength = (0.16 + 0.42 * look.glass_reflection) * (0.45 + 0.55 * rise) * ripple
        color, strength = canvas.color[pane.region], pane.values * strength[pane.region]
        color += strength[..., None] * (self.reflection[pane.region] - 0.4 * color)
        return pane

    def _paint_lamp(self, outline: Doubles, color: Doubles) -> None:
        """Paint a lamp: its glass, darker at the rim, and its light."""
        canvas, gain = self.canvas, self.gains["lamp"]
        mask, middle = canvas.polygon(outline), outline.mean(0)
        canvas.paint(canvas.polygon(outline, soften=0.012), (26, 16, 16), 0.55)
        canvas.paint(mask, color * gain)
        core = canvas.polygon(middle + (outline - middle) * 0.55, soften=0.02)
        canvas.paint(core, np.minimum(color * 1.25 + 38, 255) * max(gain, self.lamps), 0.55)
        if self.lamps:
            canvas.paint(mask, np.minimum(color * 1.3 + 60, 255), 0.75 * self.lamps)

    def paint_end(self) -> None:
        """Paint the near end."""
        dims, look = self.dims, self.look
        self.canvas.make_opaque(self.canvas.polygon(self._band(["clearance", "height", 0.975, 0.0], 60)))
        if self.body.view == "front":
            heights = np.linspace(0.6, dims.belt, 40)
            nose = float(np.interp(0.22, profile_at(dims.front, heights), heights))
            front_heights, front_depths = zip(*dims.front)
            low = float(np.interp(0.1 if dims.is_box else 1.05, front_depths, front_heights))
            self.names |= {"nose": nose, "low": min(max(low, dims.belt), dims.height - 0.5)}
            self.names |= {"high": 2.4 if dims.is_box else dims.height - 0.1}
            self.names |= {"outer": float(self.body.half_width(nose - 0.02)) * 0.97}
            grille = nose - 0.06 - look.grille_height / 2
            self.names |= {"grille": grille, "grille_height": look.grille_height}
            part, plate = "front", dims.clearance + 0.27
        elif dims.is_box:
            part, plate = "box rear", 0.8
        else:
            self._place_rear()
            part, plate = "rear", dims.belt - 0.24 if look.plate_high else dims.clearance + 0.24
        self.names["plate"] = plate
        self.paint(part)
        self.paint("plate")

    def _place_rear(self) -> None:
        """Name the lengths of the rear of a car: bumper, gap of the tailgate, window and tail lamps."""
        dims, look, half_width = self.dims, self.look, self.body.half_width
        sedan = dims.rear[-1][1] > 1.5
        self.flags["sedan"] = sedan
        bumper, low, top = dims.clearance + 0.42, dims.belt + (0.11 if sedan else 0.03), dims.belt - 0.05
        self.names |= {"bumper": bumper, "gate": dims.belt + (0.02 if sedan else 0.0)}
        self.names |= {"low": low, "high": dims.height - (0.075 if sedan else 0.11)}
        rng = np.random.default_rng(look.seed + 1)
        if look.tall_lamps:
            high = dims.height > 1.5 or rng.random() < 0.4
            top = low + (rng.uniform(-0.05, 0.3) if high else -0.02)
        bottom, lean = max(top - look.lamp_height, bumper - 0.03), rng.uniform(0.0, 0.05)
        outer_low, outer_top = (float(half_width(y)) * 0.985 for y in (bottom, top))
        inner_low, inner_top = outer_low - look.lamp_width - lean, outer_top - look.lamp_width + lean
        self.names |= {"lamp_low": bottom, "lamp_top": top, "outer_low": outer_low, "outer_top": outer_top}
        self.names |= {"inner_low": inner_low, "inner_top": inner_top}
        middle = (outer_low + outer_top + inner_low + inner_top) / 4
        if look.tall_lamps:
            lens = (middle, bottom + 0.3 * look.lamp_height, look.lamp_width * 0.6, 0.055)
        else:
            lens = (middle - 0.3 * look.lamp_width, (bottom + top) / 2, 0.07, look.lamp_height * 0.5)
        self.names |= zip(("lens", "lens_y", "lens_width", "lens_height"), lens)

    def paint_flank(self) -> None:
        """Paint a flank: outline, windows with pillars, wheels in their arches, doors, sill."""
        canvas, dims, body = self.canvas, self.dims, self.body
        y = np.linspace(dims.clearance, dims.height, 50)
        near, far = profile_at(body.end, y) - 0.06, dims.length - profile_at(body.far_end, y)
        outline = np.column_stack([np.append(near, far[::-1]), np.append(y, y[::-1])])
        canvas.make_opaque(canvas.polygon(outline))
        (first, last), y = dims.windows, np.array([dims.belt + 0.02, dims.height - 0.09])
        cargo = 0.0, dims.length - 1.7
        if body.view == "front":
            first, last, cargo = dims.length - last, dims.length - first, (1.6, dims.length)
        near = np.maximum(profile_at(body.end, y) + 0.1, first)
        far = np.minimum(dims.length - profile_at(body.far_end, y) - 0.1, last)
        pane = np.array([(near[0], y[0]), (far[0], y[0]), (far[1], y[1]), (near[1], y[1])])
        canvas.multiply(self.paint_glass(round_corners(pane, 0.06)), 0.85)
        pillars = near[0] + (far[0] - near[0]) * np.array([0.3, 0.62])
        self.names |= zip(("cargo", "cargo_end", "pillar", "second_pillar"), (*cargo, *pillars))
        self.paint("flank")
        self._paint_wheels()

    def _paint_wheels(self) -> None:
        canvas, dims, body = self.canvas, self.dims, self.body
        dark = np.array([20, 20, 21]) * self.gains["dark"]
        angles = np.linspace(0, 2 * np.pi, 40)
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        for hub in (body.overhang, dims.length - body.far_overhang):
            center = np.array([hub, dims.wheel_radius])
            canvas.paint(canvas.polygon(center + circle * (dims.wheel_radius + 0.06)), dark * 0.7)
            tire = canvas.polygon(center + circle * dims.wheel_radius)
            canvas.make_opaque(tire)
            canvas.paint(tire, dark * 1.4)
            rim = canvas.polygon(center + circle * dims.wheel_radius * 0.64)
            canvas.paint(rim, np.full(3, self.look.rim_tone * 0.85 * self.gains["flank"]))
            for angle in np.arange(5) * 2 * np.pi / 5 + self.look.seed % 3:
                spoke = center + np.array([np.cos(angle), np.sin(angle)]) * dims.wheel_radius * 0.42
                canvas.paint(canvas.polygon(spoke + circle * dims.wheel_radius * 0.13), dark, 0.85)


class VehicleBody:
    """Shape and painted surfaces of one vehicle; `view` is the end that the camera sees, rear or front."""

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
        reflection = self._reflect(normal)
        canvas.color[:] = self._shade(normal, reflection)
        BodyPainter(self, canvas, reflection).paint_end()
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
