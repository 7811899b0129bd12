"""The painting of a vehicle's surfaces: windows, lamps, plates, bumpers, wheels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic.camera_light import Floats
from vehicle_detection.synthetic.shapes import profile_at

if TYPE_CHECKING:
    from vehicle_detection.synthetic.camera_light import Floats
    from vehicle_detection.synthetic.vehicles import Car

PIXELS_PER_METRE = 112

Outline = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """A painted surface: ``(H, W, 4)`` premultiplied RGBA, 0-255, and the meters of its upper left corner."""

    rgba: Floats
    left: float
    top: float
    depth: Floats | None = None


@dataclass(frozen=True, eq=False)
class Cover:
    """How much a shape covers of each pixel, 0-1, in the part of the sheet where it lies."""

    values: Floats
    top: int
    left: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Rows and columns of the part."""
        height, width = self.values.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def _aligned(self, other: Cover) -> Floats:
        """Give the other's values where this one lies, 0 outside it."""
        sheet = np.zeros_like(self.values)
        y1, x1 = max(self.top, other.top), max(self.left, other.left)
        y2 = min(self.top + self.values.shape[0], other.top + other.values.shape[0])
        x2 = min(self.left + self.values.shape[1], other.left + other.values.shape[1])
        if y1 < y2 and x1 < x2:
            inside = other.values[y1 - other.top : y2 - other.top, x1 - other.left : x2 - other.left]
            sheet[y1 - self.top : y2 - self.top, x1 - self.left : x2 - self.left] = inside
        return sheet

    def within(self, other: Cover) -> Cover:
        """Return the part that lies in another cover."""
        return Cover(self.values * self._aligned(other), self.top, self.left)

    def without(self, other: Cover) -> Cover:
        """Return what another cover leaves of it."""
        return Cover(np.maximum(self.values - self._aligned(other), 0), self.top, self.left)

    def __mul__(self, gain: Floats) -> Cover:
        """Thin it out by a gain for the whole sheet."""
        return Cover(self.values * gain[self.place], self.top, self.left)


class Easel:
    """A sheet in meters, `left`..`right` by `low`..`top`, to paint polygons on."""

    def __init__(self, left: float, right: float, low: float, top: float) -> None:
        ppm = PIXELS_PER_METRE
        self.left, self.top = left, top
        self.size = (round((top - low) * ppm), round((right - left) * ppm))
        self.x: Floats = (left + (np.arange(self.size[1], dtype=np.float32) + 0.5) / ppm)[None, :].astype(
            np.float32
        )
        self.y: Floats = (top - (np.arange(self.size[0], dtype=np.float32) + 0.5) / ppm)[:, None].astype(
            np.float32
        )
        self.color: Floats = np.zeros((*self.size, 3), np.float32)
        self.alpha: Floats = np.zeros(self.size, np.float32)

    def mask(self, points: ArrayLike, *, soften: float = 0.0) -> Cover:
        """Cover of a polygon of ``(x, y)`` points, its edge softened by some meters."""
        corners = (np.asarray(points, np.float64) - (self.left, self.top)) * (1, -1) * PIXELS_PER_METRE - 0.5
        margin = 2 + int(3 * soften * PIXELS_PER_METRE)
        x1, y1 = np.maximum(np.floor(corners.min(0)).astype(int) - margin, 0).tolist()
        x2, y2 = np.minimum(np.ceil(corners.max(0)).astype(int) + margin + 1, self.size[::-1]).tolist()
        if x1 >= x2 or y1 >= y2:
            return Cover(np.zeros((0, 0), np.float32), 0, 0)
        sheet = np.zeros((y2 - y1, x2 - x1), np.uint8)
        cv2.fillPoly(sheet, [np.rint((corners - (x1, y1)) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        cover = sheet.astype(np.float32) / 255
        if soften:
            cover = cv2.GaussianBlur(cover, (0, 0), soften * PIXELS_PER_METRE)  # type: ignore[assignment]
        return Cover(np.asarray(cover, np.float32), y1, x1)

    def box(self, x: float, y: float, width: float, height: float, *, round_by: float = 0.0) -> Cover:
        """Cover of a box around ``(x, y)`` with rounded corners."""
        w, h = width / 2, height / 2
        corners = [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]
        return self.mask(rounded(corners, round_by))

    def paint(self, cover: Cover, color: ArrayLike, strength: float = 1.0) -> None:
        """Lay a color, or a sheet of colors, over what is there."""
        paint = np.asarray(color, np.float32)
        if paint.ndim == 3:
            paint = np.broadcast_to(paint, self.color.shape)[cover.place]
        part = self.color[cover.place]
        part += (cover.values * strength)[..., None] * (paint - part)

    def dim(self, cover: Cover, gain: float) -> None:
        """Multiply what is there by `gain` under a cover."""
        self.color[cover.place] *= (1 + cover.values * (gain - 1))[..., None]

    def show(self, cover: Cover) -> None:
        """Make the sheet opaque under a cover."""
        part = self.alpha[cover.place]
        np.maximum(part, cover.values, out=part)

    def surface(self, depth: Floats | None = None) -> Surface:
        """Return what has been painted."""
        color = np.clip(self.color, 0, 255) * self.alpha[..., None]
        return Surface(np.dstack([color, self.alpha * 255]), self.left, self.top, depth)


def rounded(corners: ArrayLike, radius: float) -> Outline:
    """Replace each corner of a polygon by a curve that starts `radius` before it."""
    points = np.asarray(corners, np.float64)
    if radius <= 0:
        return points
    t = np.linspace(0, 1, 7)[:, None]
    out = []
    for before, corner, after in zip(np.roll(points, 1, 0), points, np.roll(points, -1, 0)):
        start, end = (
            corner + (other - corner) * min(0.5, radius / max(float(np.linalg.norm(other - corner)), 1e-9))
            for other in (before, after)
        )
        out.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(out)


_PLATE = (0.52, 0.115)


def _band(car: Car, low: float, high: float, share: float, inset: float) -> Outline:
    """Outline of a band across the body from one height to another, `share` of its width less `inset`."""
    y = np.linspace(low, high, 12)
    x = car.half_width(y) * share - inset
    return np.concatenate([np.column_stack([x, y]), np.column_stack([-x, y])[::-1]])


def _window(car: Car, low: float, high: float, share: float, inset: float) -> list[tuple[float, float]]:
    bottom, top = (float(car.half_width(y)) * share - inset for y in (low, high))
    return [(-bottom, low), (bottom, low), (top, high), (-top, high)]


def _paint_glass(car: Car, easel: Easel, outline: Outline, mirrored: Floats, *, seats: bool = True) -> Cover:
    """Paint a pane: a dark cabin behind it, the sky mirrored in it, a dark seal around it."""
    looks = car.looks
    day = 0.3 if car.light.dark else 1.0
    low, high = float(outline[:, 1].min()), float(outline[:, 1].max())
    rise = np.clip((easel.y - low) / (high - low), 0, 1)
    easel.paint(easel.mask(outline, soften=0.012), (18, 18, 20), 0.75)
    pane = easel.mask(outline)
    cabin = np.array([34, 38, 42], np.float32) * (day * looks.tint * car.light.ambient / 0.6)
    easel.paint(pane, cabin * (0.8 + 0.5 * rise)[..., None])
    for side in (-1, 1) if seats else ():
        seat = easel.box(side * 0.36, low + 0.1, 0.26, 0.34, round_by=0.1)
        easel.paint(seat.within(pane), np.array([22, 24, 26]) * day, 0.55)
    ripple = 0.75 + 0.25 * np.sin(easel.x * 5.0 + looks.seed % 7) * np.cos(easel.y * 9.0 + looks.seed % 5)
    strength = (pane * ((0.16 + 0.42 * looks.glare) * (0.45 + 0.55 * rise) * ripple)).values[..., None]
    part = easel.color[pane.place]
    part += strength * (mirrored[pane.place] - 0.4 * part)
    return pane


def _paint_plate(car: Car, easel: Easel, y: float) -> None:
    day = (
        max(0.5, car.light.lamps * 0.7)
        if car.light.dark
        else min(1.1, car.light.ambient + 0.6 * car.light.sun)
    )
    width, height = _PLATE
    easel.paint(easel.box(0, y, width + 0.08, height + 0.07, round_by=0.03), car.paint * 0.35, 0.55)
    easel.paint(easel.box(0, y, width, height), np.array(car.looks.plate) * day)
    rng = np.random.default_rng(car.looks.seed)
    for x in np.linspace(-0.2, 0.2, 8):
        if rng.random() < 0.85:
            easel.paint(easel.box(x, y, rng.uniform(0.02, 0.045), 0.066), (40, 42, 48), 0.8)


def _lamp(car: Car, easel: Easel, outline: Outline, color: tuple[int, int, int], shine: float) -> None:
    """Paint a lamp glass: its color, darker at the rim, lit from within by `shine`."""
    cover = easel.mask(outline)
    day = 0.45 if car.light.dark else car.light.ambient + 0.4 * car.light.sun
    easel.paint(easel.mask(outline, soften=0.012), (26, 16, 16), 0.55)
    easel.paint(cover, np.array(color) * day)
    core = easel.mask(outline.mean(0) + (outline - outline.mean(0)) * 0.55, soften=0.02)
    bright = np.minimum(np.array(color) * 1.25 + 38, 255)
    easel.paint(core, bright * max(day, shine), 0.55)
    if shine:
        easel.paint(cover, np.minimum(np.array(color) * 1.3 + 60, 255), 0.75 * shine)


def paint_rear(car: Car, easel: Easel, mirrored: Floats) -> None:
    """Paint the rear of a car: tailgate or boot, window, tail lamps, plate, bumper."""
    d, looks = car.design, car.looks
    sedan = d.rear[-1][1] > 1.5
    bumper_top = d.clearance + 0.42
    # Bumper: a crease above, a dark lower edge, plastic on some.
    if looks.plastic:
        easel.paint(easel.mask(_band(car, d.clearance, bumper_top - 0.04, 1.2, 0.0)), _plastic(car), 0.9)
    easel.dim(easel.mask(_band(car, bumper_top - 0.012, bumper_top + 0.012, 0.99, 0.0)), 0.35)
    easel.dim(easel.mask(_band(car, bumper_top - 0.1, bumper_top - 0.075, 0.96, 0.0)), 1.22)
    easel.paint(
        easel.mask(_band(car, d.clearance - 0.02, d.clearance + 0.09, 0.82, 0.0), soften=0.02),
        (24, 24, 26),
        0.9,
    )
    for side in (-1, 1):
        easel.paint(
            easel.box(side * 0.62, d.clearance + 0.16, 0.16, 0.035, round_by=0.01), (120, 20, 20), 0.8
        )
    if looks.exhaust:
        easel.paint(easel.box(-0.5, d.clearance + 0.02, 0.11, 0.05, round_by=0.02), (150, 150, 150), 0.7)
    # Tailgate: shut lines, a crease under the window.
    low = d.belt + (0.11 if sedan else 0.03)
    high = d.height - (0.075 if sedan else 0.11)
    gate = _band(car, bumper_top, d.belt - (0.0 if not sedan else -0.02), 0.8, 0.03)
    inner = _band(car, bumper_top + 0.012, d.belt - 0.012, 0.8, 0.042)
    easel.dim(easel.mask(gate).without(easel.mask(inner)), 0.5)
    easel.dim(easel.mask(_band(car, d.belt - 0.2, d.belt - 0.18, 0.8, 0.05)), 0.78)
    if sedan:
        # Sky on the boot lid, shadow where the window meets it.
        easel.paint(
            easel.mask(_band(car, d.belt + 0.025, d.belt + 0.085, 0.93, 0.02), soften=0.01), mirrored, 0.3
        )
        easel.dim(easel.mask(_band(car, d.belt - 0.06, d.belt - 0.005, 0.9, 0.02), soften=0.01), 1.12)
    if not looks.windowless:
        share, inset = (0.86, 0.0) if sedan else (0.93, 0.035)
        corners = _window(car, low, high, share, inset)
        _paint_glass(car, easel, rounded(corners, 0.1), mirrored)
        if not sedan:
            easel.paint(easel.box(-0.12, low + 0.03, 0.42, 0.018), (14, 14, 14), 0.8)
    if looks.doors:
        easel.paint(
            easel.box(0, (d.clearance + d.height) / 2 + 0.1, 0.05, d.height - d.clearance - 0.4),
            car.paint * 0.6,
            0.9,
        )
        easel.dim(easel.box(0, (d.clearance + d.height) / 2 + 0.1, 0.014, d.height - d.clearance - 0.4), 0.3)
    roof = easel.mask(_band(car, high + 0.035, d.height - 0.015, 0.86, 0.04), soften=0.008)
    easel.paint(roof, mirrored * 0.5 + car.paint * 0.55 * (0.3 if car.light.dark else 1), 0.35)
    easel.paint(easel.box(0, high + 0.02, 0.34, 0.022), (110, 20, 20), 0.8)
    _paint_tail_lamps(car, easel, bumper_top, low)
    plate_y = d.belt - 0.24 if looks.plate_high else d.clearance + 0.24
    if looks.chrome:
        easel.paint(
            easel.box(0, d.belt - 0.15, 0.56, 0.028),
            np.array((196, 198, 200)) * (0.3 if car.light.dark else 0.9),
            0.8,
        )
    _paint_plate(car, easel, plate_y)
    easel.paint(
        easel.box(0, d.belt - 0.09, 0.07, 0.07, round_by=0.035),
        np.array((190, 192, 196)) * (0.3 if car.light.dark else 0.9),
        0.8,
    )


def _plastic(car: Car) -> NDArray[np.float64]:
    return np.array([46, 47, 49]) * (0.35 if car.light.dark else car.light.ambient / 0.6)


def _paint_tail_lamps(car: Car, easel: Easel, bumper_top: float, window_low: float) -> None:
    d, looks = car.design, car.looks
    rng = np.random.default_rng(looks.seed + 1)
    if looks.tall_lamps:
        top = (
            window_low + rng.uniform(-0.05, 0.3)
            if d.height > 1.5 or rng.random() < 0.4
            else window_low - 0.02
        )
        low = top - looks.lamp_height
    else:
        top = d.belt - 0.05
        low = top - looks.lamp_height
    low = max(low, bumper_top - 0.03)
    lean = rng.uniform(0.0, 0.05)
    shine = car.light.lamps
    for side in (-1, 1):
        outer_low, outer_top = (float(car.half_width(y)) * 0.985 for y in (low, top))
        inner_low, inner_top = outer_low - looks.lamp_width - lean, outer_top - looks.lamp_width + lean
        corners = [(outer_low, low), (outer_top, top), (inner_top, top), (inner_low, low)]
        outline = rounded(np.array(corners) * (side, 1), 0.05)
        _lamp(car, easel, outline, (136, 20, 24), shine)
        middle = outline.mean(0)
        if looks.tall_lamps:
            lens = easel.box(
                middle[0], low + 0.3 * looks.lamp_height, looks.lamp_width * 0.6, 0.055, round_by=0.02
            )
        else:
            lens = easel.box(
                middle[0] - side * 0.3 * looks.lamp_width,
                middle[1],
                0.07,
                looks.lamp_height * 0.5,
                round_by=0.02,
            )
        easel.paint(lens, np.array((226, 206, 200)) * (0.4 if car.light.dark else 0.9), 0.65)


def paint_front(car: Car, easel: Easel, mirrored: Floats) -> None:
    """Paint the front of a car: windscreen, bonnet, headlamps, grille, bumper, plate."""
    d, looks = car.design, car.looks
    nose = float(
        np.interp(0.22, profile_at(d.front, np.linspace(0.6, d.belt, 40)), np.linspace(0.6, d.belt, 40))
    )
    low = float(np.interp(1.05 if not d.box else 0.1, [z for _, z in d.front], [y for y, _ in d.front]))
    low = min(max(low, d.belt), d.height - 0.5)
    high = d.height - 0.1 if not d.box else 2.4
    corners = _window(car, low, high, 0.92, 0.02)
    pane = _paint_glass(car, easel, rounded(corners, 0.09), mirrored)
    easel.paint(easel.box(0, high - 0.07, 0.2, 0.06, round_by=0.03).within(pane), (20, 22, 24), 0.9)
    # The bonnet's shut line and the shadow along its front edge.
    easel.dim(easel.mask(_band(car, nose - 0.01, nose + 0.008, 0.86, 0.05)), 0.5)
    dark = np.array([22, 22, 24]) * (0.5 if car.light.dark else 1.0)
    grille = easel.box(0, nose - 0.06 - looks.grille_tall / 2, 0.72, looks.grille_tall, round_by=0.04)
    easel.paint(grille, dark, 0.92)
    if looks.chrome:
        easel.paint(easel.box(0, nose - 0.06 - looks.grille_tall / 2, 0.7, 0.02), (190, 192, 196), 0.7)
    intake = easel.box(0, d.clearance + 0.13, 1.05, 0.13, round_by=0.05)
    easel.paint(intake, dark, 0.9)
    for side in (-1, 1):
        easel.paint(easel.box(side * 0.66, d.clearance + 0.14, 0.17, 0.1, round_by=0.04), dark, 0.7)
        top = nose - 0.02
        outer = float(car.half_width(top)) * 0.97
        corners = [(outer, top + 0.03), (outer - 0.4, top - 0.03), (outer - 0.36, top - 0.17)]
        outline = rounded(np.array([*corners, (outer - 0.02, top - 0.13)]) * (side, 1), 0.05)
        _lamp(car, easel, outline, (186, 190, 196), car.light.lamps)
        if car.light.lamps > 0.3:
            middle = outline.mean(0)
            easel.paint(
                easel.box(middle[0], middle[1], 0.2, 0.15, round_by=0.07), (255, 252, 236), car.light.lamps
            )
    easel.dim(easel.mask(_band(car, d.clearance + 0.4, d.clearance + 0.415, 0.98, 0.0)), 0.6)
    _paint_plate(car, easel, d.clearance + 0.27)
    easel.paint(
        easel.mask(_band(car, d.clearance - 0.02, d.clearance + 0.05, 0.86, 0.0), soften=0.02), dark, 0.9
    )


def paint_box(car: Car, easel: Easel) -> None:
    """Paint the rear of a box lorry: cargo doors, lamps and the bar low down."""
    d, looks = car.design, car.looks
    half = d.width / 2
    gain = car.light.ambient + 0.4 * car.light.sun
    day = 0.4 if car.light.dark else gain
    doors = easel.mask(_band(car, 1.0, d.height, 1.0, 0.0))
    shade = 1.03 - 0.1 * (easel.y - 1.0) / (d.height - 1.0)
    easel.paint(doors, np.array(looks.cargo) * day * shade[..., None])
    frame = doors.without(easel.mask(_band(car, 1.06, d.height - 0.07, 1.0, 0.07)))
    easel.paint(frame, np.array([150, 150, 152]) * day, 0.8)
    easel.dim(easel.box(0, (1 + d.height) / 2, 0.025, d.height - 1.1), 0.35)
    for x in (-0.75, -0.3, 0.3, 0.75):
        easel.dim(easel.box(x, (1 + d.height) / 2, 0.03, d.height - 1.15), 0.72)
        easel.paint(easel.box(x, 1.6, 0.09, 0.06), np.array([90, 90, 92]) * day, 0.8)
    low = easel.mask(_band(car, d.clearance, 1.0, 1.0, 0.0))
    easel.paint(low, np.array([30, 30, 32]) * (0.5 if car.light.dark else 1))
    easel.paint(easel.box(0, 0.55, d.width * 0.92, 0.12), np.array([120, 120, 120]) * day, 0.8)
    for side in (-1, 1):
        outline = rounded([(side * (half - 0.1), 0.78), (side * (half - 0.1), 0.94),
                           (side * (half - 0.5), 0.94), (side * (half - 0.5), 0.78)], 0.03)  # fmt: skip
        _lamp(car, easel, outline, (176, 24, 26), car.light.lamps)
    _paint_plate(car, easel, 0.8)


def paint_flank(car: Car, easel: Easel, mirrored: Floats) -> None:
    """Paint the flank: outline, windows with pillars, wheels in their arches, doors, sill."""
    d, looks = car.design, car.looks
    y = np.linspace(d.clearance, d.height, 50)
    near = profile_at(car.end, y) - 0.06
    far = d.length - profile_at(car.far_end, y)
    outline = np.concatenate([np.column_stack([near, y]), np.column_stack([far, y])[::-1]])
    easel.show(easel.mask(outline))
    dark = np.array([20, 20, 21]) * (0.5 if car.light.dark else 1.0)
    hubs = (car.overhang, d.length - d.overhangs[1 if car.facing == "rear" else 0])
    if d.box:
        start, stop = (1.6, d.length) if car.facing == "front" else (0.0, d.length - 1.7)
        cargo = easel.mask([(start, 1.0), (stop, 1.0), (stop, d.height), (start, d.height)])
        gain = 0.4 if car.light.dark else car.light.ambient + 0.3 * car.light.sun
        easel.paint(cargo, np.array(looks.cargo) * gain)
        under = easel.mask([(0, 0), (d.length, 0), (d.length, 1.0), (0, 1.0)])
        easel.paint(under, dark * 1.6, 0.85)
    front, back = d.windows
    if car.facing == "front":
        front, back = d.length - back, d.length - front
    low, high = d.belt + 0.02, d.height - 0.09
    band_y = np.array([low, high])
    edge = np.maximum(profile_at(car.end, band_y) + 0.1, front)
    limit = np.minimum(d.length - profile_at(car.far_end, band_y) - 0.1, back)
    pane = np.array([(edge[0], low), (limit[0], low), (limit[1], high), (edge[1], high)])
    easel.dim(_paint_glass(car, easel, rounded(pane, 0.06), mirrored, seats=False), 0.85)
    span = pane[1, 0] - pane[0, 0]
    for share in (0.3, 0.62) if not d.box else ():
        x = pane[0, 0] + span * share
        easel.paint(
            easel.box(x, (low + high) / 2, 0.07, high - low),
            car.paint * (0.12 if car.light.dark else 0.4),
            0.9,
        )
        easel.dim(easel.box(x, (d.clearance + low) / 2 + 0.06, 0.014, low - d.clearance - 0.12), 0.55)
        easel.paint(easel.box(x + 0.2, d.belt - 0.11, 0.17, 0.03), car.paint * 0.7, 0.6)
    easel.dim(
        easel.mask(
            [
                (0.1, d.belt - 0.18),
                (d.length - 0.2, d.belt - 0.2),
                (d.length - 0.2, d.belt - 0.215),
                (0.1, d.belt - 0.195),
            ]
        ),
        0.75,
    )
    sill = easel.mask(
        [
            (0, d.clearance - 0.05),
            (d.length, d.clearance - 0.05),
            (d.length, d.clearance + 0.1),
            (0, d.clearance + 0.1),
        ]
    )
    easel.paint(sill, dark * 1.3, 0.75)
    turn = np.linspace(0, 2 * np.pi, 40)
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    day = 0.35 if car.light.dark else car.light.ambient / 0.65
    lamp = [(-0.02, d.belt - 0.28), (0.2, d.belt - 0.26), (0.16, d.belt - 0.1), (-0.02, d.belt - 0.08)]
    if not d.box:
        color = (160, 24, 26) if car.facing == "rear" else (190, 194, 198)
        easel.paint(easel.mask(rounded(lamp, 0.03)), np.array(color) * max(day, car.light.lamps), 0.9)
    for hub in hubs:
        center = np.array([hub, d.wheel])
        arch = easel.mask(center + ring * (d.wheel + 0.06))
        easel.paint(arch, dark * 0.7)
        tyre = easel.mask(center + ring * d.wheel)
        easel.show(tyre)
        easel.paint(tyre, dark * 1.4)
        rim = easel.mask(center + ring * d.wheel * 0.64)
        easel.paint(rim, np.full(3, looks.rims * 0.85 * day))
        for angle in np.arange(5) * 2 * np.pi / 5 + looks.seed % 3:
            spoke = center + np.array([np.cos(angle), np.sin(angle)]) * d.wheel * 0.42
            easel.paint(easel.mask(spoke + ring * d.wheel * 0.13), dark, 0.85)
