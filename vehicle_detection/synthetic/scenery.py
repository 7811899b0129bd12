"""The road and what is around it, for one camera, light and road.

What does not change along a drive is drawn once; what passes by is moved with the distance travelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic.background import draw_backdrop
from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole, wrapped_noise

LANE = 3.6
"""Width of a lane in meters."""


@dataclass(frozen=True)
class Road:
    """A straight road: `lanes` lanes of which the camera drives in number `own`, counted from the left."""

    lanes: int = 3
    own: int = 1
    shoulder: float = 2.2

    @property
    def left(self) -> float:
        """Where the leftmost lane ends, in meters right of the camera."""
        return -(self.own + 0.5) * LANE

    @property
    def right(self) -> float:
        """Where the rightmost lane ends."""
        return (self.lanes - self.own - 0.5) * LANE

    @property
    def barrier(self) -> float:
        """Where the barrier to the oncoming lanes stands."""
        return self.left - 1.1

    def lane(self, number: int) -> float:
        """Middle of a lane; -1 and below are the oncoming ones behind the barrier."""
        return self.barrier - 1.4 + (number + 0.5) * LANE if number < 0 else (number - self.own) * LANE


_GROUND_PERIOD = 96.0
_ACROSS = 0.1
_GROUND_ALONG = 0.12
_HALF = 28.0
_GROUND_LEVELS = 7


class _Band(NamedTuple):
    """Rows of the picture that take their grain from one level of detail."""

    rows: slice
    map_x: Floats
    map_y: Floats
    tile: NDArray[np.uint8]


class Ground:
    """Everything below the horizon that lies flat, without the lines."""

    def __init__(
        self,
        shape: tuple[int, int],
        camera: Pinhole,
        light: Light,
        road: Road,
        dry: float,
        rng: np.random.Generator,
    ) -> None:
        self.first = int(np.clip(np.ceil(camera.horizon_px + 0.5), 0, shape[0]))
        rows = np.arange(self.first, shape[0]) + 0.5
        ahead = camera.focal_px * camera.height_m / np.maximum(rows - camera.horizon_px, 0.3)
        columns = (np.arange(shape[1]) + 0.5 - camera.center_px) / camera.focal_px
        self._ahead: Floats = ahead.astype(np.float32)[:, None]
        self._across: Floats = (columns[None, :] * ahead[:, None]).astype(np.float32)
        self.color = self._paint(camera, light, road, dry, rng)
        step = ahead**2 / (camera.focal_px * camera.height_m)
        self._bands = self._cut_bands(step, _draw_tile(light, road, rng))

    def _paint(
        self, camera: Pinhole, light: Light, road: Road, dry: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Asphalt, shoulder and grass in this light, through the haze, or lit by the headlights."""
        across, ahead = self._across, self._ahead
        tone = rng.uniform(70, 118)
        asphalt = np.array([tone, tone, tone * rng.uniform(0.97, 1.05)], np.float32)
        grass = np.array([84, 90, 62] if dry < 0.5 else [138, 121, 88], np.float32)
        blur = ahead / camera.focal_px * 1.2
        paved = _ramp(across, road.barrier - 2.2 - 3 * LANE, blur) - _ramp(
            across, road.right + road.shoulder, blur
        )
        # Tyres polish two tracks in each lane, oil darkens the middle; the shoulder is paler.
        inside = _ramp(across, road.left, 0.3) - _ramp(across, road.right, 0.3)
        phase = (across - road.left) * np.float32(2 * np.pi / LANE)
        tracks = 0.03 * np.cos(phase) - 0.045 * np.cos(2 * phase)
        shade = paved * (1.12 + inside * (tracks - 0.12))
        color = shade[..., None] * asphalt + (1 - paved)[..., None] * grass
        # Seen at a low angle the road mirrors more of the sky.
        sheen = 1 + 0.12 * (1 - np.exp(-ahead / 60.0))
        clear = np.exp(-ahead / light.visibility)
        gain = (light.ambient + 0.75 * light.sun) * (0.8 if light.dark else 1.0)
        color *= (gain * sheen * clear)[..., None]
        color += light.haze * (1 - clear)[..., None]
        if light.dark:
            beam = np.exp(-((across / ahead / 0.33) ** 2)) * np.exp(-ahead / 30.0)
            color *= (0.13 + 0.95 * beam)[..., None]
        return np.asarray(np.clip(color, 0, 255), np.uint8)

    def _cut_bands(self, step: NDArray[np.float64], tile: Floats) -> list[_Band]:
        """For each row the level of detail whose pixels are as long as the row sees of the road."""
        levels = [np.clip(tile * 128, 0, 255).astype(np.uint8)]
        while len(levels) < _GROUND_LEVELS:
            size = (levels[-1].shape[1], levels[-1].shape[0] // 2)
            levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))  # type: ignore[arg-type]
        chosen = np.clip(np.rint(np.log2(np.maximum(step / _GROUND_ALONG, 1))), 0, _GROUND_LEVELS - 1).astype(
            int
        )
        bands = []
        for number, level in enumerate(levels):
            here = np.flatnonzero(chosen == number)
            if len(here):
                rows = slice(int(here[0]), int(here[-1]) + 1)
                map_x = (self._across[rows] + _HALF) / _ACROSS - 0.5
                map_y = np.broadcast_to(self._ahead[rows] / (_GROUND_ALONG * 2**number) - 0.5, map_x.shape)
                bands.append(_Band(rows, map_x.astype(np.float32), map_y.astype(np.float32), level))
        return bands

    def wear(self, ground: NDArray[np.uint8], travel: float) -> None:
        """Give the rows below the horizon, lines and all, their grain, in place."""
        grain = np.empty(ground.shape[:2], np.uint8)
        for rows, map_x, map_y, tile in self._bands:
            shift = np.float32(travel % _GROUND_PERIOD / _GROUND_PERIOD * tile.shape[0])
            cv2.remap(
                tile, map_x, map_y + shift, cv2.INTER_LINEAR, dst=grain[rows], borderMode=cv2.BORDER_WRAP
            )
        cv2.multiply(ground, cv2.merge([grain] * 3), dst=ground, scale=1 / 128)


def _ramp(values: Floats, edge: float, width: ArrayLike) -> Floats:
    """0 below an edge, 1 above it, linear over `width`."""
    return np.asarray(np.clip((values - np.float32(edge)) / np.maximum(width, 1e-3) + 0.5, 0, 1), np.float32)


def _draw_tile(light: Light, road: Road, rng: np.random.Generator) -> Floats:
    """Gain of the road's brightness over one period, seamless along the road."""
    size = (round(_GROUND_PERIOD / _GROUND_ALONG), round(2 * _HALF / _ACROSS))
    coarse, fine = wrapped_noise(rng, size, falloff=1.1, stretch=0.5), wrapped_noise(rng, size, falloff=0.2)
    # Grass grows in tufts, far less even than asphalt.
    rough = np.full(size[1], 0.16, np.float32)
    left, right = (
        int((x + _HALF) / _ACROSS) for x in (road.barrier - 2.2 - 3 * LANE, road.right + road.shoulder)
    )
    rough[max(left, 0) : right] = 0.035
    tile = 1 + rough * (coarse + fine)
    # Mended asphalt, seams and cracks, on the camera's side of the barrier.
    first, last = (int((x + _HALF) / _ACROSS) for x in (road.barrier, road.right + road.shoulder))
    paved = tile[:, first:last]
    for _ in range(int(rng.integers(0, 5))):
        x, y = int(rng.integers(paved.shape[1])), int(rng.integers(size[0]))
        width, length = int(rng.uniform(1, 3.6) / _ACROSS), int(rng.uniform(3, 25) / _GROUND_ALONG)
        paved[y : y + length, x : x + width] *= rng.uniform(0.82, 1.1)
    for _ in range(int(rng.integers(0, 6))):
        paved[int(rng.integers(size[0]))] *= rng.uniform(0.7, 0.9)
    for _ in range(int(rng.integers(0, 4))):
        wander = np.cumsum(rng.normal(0, 0.35, size[0]))
        wander -= np.linspace(0, wander[-1], size[0])
        x = np.clip(int(rng.integers(paved.shape[1])) + wander.astype(int), 0, paved.shape[1] - 1)
        paved[np.arange(size[0]), x] *= 0.75
    if light.sun > 0.2 and rng.random() < 0.5:
        tile *= _tree_shadows(light, size, rng)
    return np.asarray(tile, np.float32)


def _tree_shadows(light: Light, size: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Gain of the shadows that trees throw across the road."""
    leaf = wrapped_noise(rng, size, falloff=1.0)
    y = np.arange(size[0], dtype=np.float32)[:, None] * _GROUND_ALONG
    x = np.arange(size[1], dtype=np.float32)[None, :] * _ACROSS - _HALF
    cover = np.zeros(size, np.float32)
    side = -np.sign(light.to_sun[0])
    for _ in range(int(rng.integers(1, 4))):
        place, wide, far = rng.uniform(12, _GROUND_PERIOD - 12), rng.uniform(2, 7), rng.uniform(3, 16)
        inside = 1.6 - np.abs(y - place - 0.3 * x) / wide * 1.6
        inside -= np.clip((side * x - far) / 3, -0.5, 4)
        cover = np.maximum(cover, np.clip(inside + 0.7 * leaf, 0, 1))
    return np.asarray(1 - 0.5 * cover, np.float32)


_HEDGE_PERIOD = 96.0
_HEDGE_ALONG, _UP = 0.15, 0.1
_TALLEST = 6.4
_NEAREST, _FARTHEST = 6.0, 320.0
_HEDGE_LEVELS = 6


class _Strip(NamedTuple):
    """Columns of the picture that show the hedge in one level of detail."""

    columns: slice
    rows: slice
    map_x: Floats
    map_y: Floats
    sheet: Floats
    haze: Floats


class Hedge:
    """Shrubs at `lateral` meters beside the road, between `low` and `high` meters tall."""

    def __init__(
        self,
        shape: tuple[int, int],
        camera: Pinhole,
        light: Light,
        lateral: float,
        low: float,
        high: float,
        dry: float,
        rng: np.random.Generator,
    ) -> None:
        self._light = light
        columns = np.arange(shape[1]) + 0.5 - camera.center_px
        ahead = camera.focal_px * lateral / np.where(np.abs(columns) < 0.25, 0.25, columns)
        level = np.log2(np.maximum(ahead**2 / (camera.focal_px * abs(lateral)) / _HEDGE_ALONG, 1))
        sheets = [_draw_sheet(low, high, dry, light, rng)]
        while len(sheets) < _HEDGE_LEVELS:
            size = (sheets[-1].shape[1] // 2, max(sheets[-1].shape[0] // (2 if len(sheets) > 2 else 1), 4))
            sheets.append(np.asarray(cv2.resize(sheets[-1], size, interpolation=cv2.INTER_AREA), np.float32))
        chosen = np.clip(np.rint(level), 0, _HEDGE_LEVELS - 1).astype(int)
        shown = (ahead > _NEAREST) & (ahead < _FARTHEST)
        self._strips = []
        for number, sheet in enumerate(sheets):
            here = np.flatnonzero(shown & (chosen == number))
            if len(here):
                part = slice(int(here[0]), int(here[-1]) + 1)
                self._strips.append(self._cut(shape, camera, part, ahead[part], sheet))

    def _cut(
        self,
        shape: tuple[int, int],
        camera: Pinhole,
        columns: slice,
        ahead: NDArray[np.float64],
        sheet: Floats,
    ) -> _Strip:
        scale = camera.focal_px / ahead.min()
        first, last = (
            camera.horizon_px - scale * (_TALLEST - camera.height_m),
            camera.horizon_px + scale * camera.height_m,
        )
        rows = slice(*np.clip([int(first) - 1, int(last) + 2], 0, shape[0]).tolist())
        up = (camera.horizon_px - np.arange(rows.start, rows.stop) - 0.5)[:, None] / camera.focal_px
        height = camera.height_m + up * ahead[None, :]
        map_y = (_TALLEST - height) / _TALLEST * sheet.shape[0] - 0.5
        map_x = np.broadcast_to(ahead / _HEDGE_PERIOD * sheet.shape[1] - 0.5, map_y.shape)
        clear = np.exp(-ahead / self._light.visibility) * [self._light.reach(float(z)) for z in ahead]
        return _Strip(
            columns, rows, map_x.astype(np.float32), map_y.astype(np.float32), sheet, clear.astype(np.float32)
        )

    def draw(self, image: NDArray[np.uint8], travel: float) -> None:
        """Draw the hedge, `travel` meters into the drive, in place."""
        for columns, rows, map_x, map_y, sheet, clear in self._strips:
            shift = np.float32(travel % _HEDGE_PERIOD / _HEDGE_PERIOD * sheet.shape[1])
            # The sheet repeats along the road; above its top and below its foot it is empty.
            x = np.mod(map_x + shift, np.float32(sheet.shape[1] - 1))
            seen = cv2.remap(sheet, x, map_y, cv2.INTER_LINEAR)
            alpha = seen[..., 3:] * np.float32(1 / 255)
            color = seen[..., :3] * clear[:, None] + self._light.haze * (1 - clear[:, None]) * alpha
            part = image[rows, columns]
            part[:] = np.clip(part * (1 - alpha) + color, 0, 255)


def _draw_sheet(low: float, high: float, dry: float, light: Light, rng: np.random.Generator) -> Floats:
    """Paint foliage as premultiplied RGBA: a ragged top, lit clumps, gaps."""
    size = (round(_TALLEST / _UP), round(_HEDGE_PERIOD / _HEDGE_ALONG))
    y = _TALLEST - (np.arange(size[0]) + 0.5)[:, None] * _UP
    rough = wrapped_noise(rng, (1, size[1]), falloff=1.0)
    top = np.clip(low + (high - low) * (0.5 + 0.32 * rough), 0.0, _TALLEST - 0.4)
    clumps = wrapped_noise(rng, (128, size[1]), falloff=1.1)[: size[0]]
    leaves = wrapped_noise(rng, (128, size[1]), falloff=0.4)[: size[0]]
    alpha = np.clip((top - y) * 2.2 + 0.55 * clumps + 0.5 * leaves, 0, 1)
    # The foot is ragged too: grass of several heights before it.
    alpha *= np.clip(y * 3.0 + 0.4 * clumps + 0.3 * leaves + 0.2, 0, 1)
    green = np.array([78, 90, 52]) * (1 - 0.6 * dry) + np.array([112, 102, 68]) * 0.6 * dry
    rise = np.clip(y / np.maximum(top, 0.5), 0, 1)
    gain = light.ambient * (0.6 + 0.25 * rise) + light.sun * 0.4 * np.clip(0.45 * clumps + 0.6 * rise, 0, 1.2)
    tone = np.clip(gain * (1 + 0.3 * leaves + 0.15 * clumps), 0.05, 1.5) * (0.35 if light.dark else 1.0)
    color = np.clip(green * tone[..., None], 0, 255) * alpha[..., None]
    return np.dstack([color, alpha * 255]).astype(np.float32)


_SIDE = 192


def paint_tree(rng: np.random.Generator, dry: float, light: Light) -> tuple[Floats, float]:
    """Paint a tree as ``(H, W, 4)`` premultiplied RGBA, 0-255; also return its width over its height."""
    slender = float(rng.uniform(0.55, 1.0))
    height, width = _SIDE, round(_SIDE * slender)
    x: Floats = ((np.arange(width) + 0.5) / width * 2 - 1).astype(np.float32)[None, :]
    y: Floats = ((np.arange(height) + 0.5) / height).astype(np.float32)[:, None]
    crown, shade = _crown(rng, x, y, light)
    leaves = wrapped_noise(rng, (256, 256), falloff=0.75)[:height, :width]
    twigs = wrapped_noise(rng, (256, 256), falloff=1.2)[:height, :width]
    cover = np.clip((crown + 0.3 * leaves + 0.35 * twigs + 0.1) * 4, 0, 1)
    # Nothing of the crown reaches the sheet's edge: a cut would draw an upright line.
    cover *= np.clip((1 - np.abs(x)) * 10, 0, 1) * np.clip(y * 30, 0, 1) * np.clip((0.93 - y) * 14, 0, 1)
    trunk = np.clip((0.035 - np.abs(x + 0.05 * np.sin(6 * y))) * 60, 0, 1) * (y > 0.5) * (1 - cover)
    hue = rng.uniform(0, 1)
    green = np.array([74, 88, 50]) * (1 - hue) + np.array([102, 98, 62]) * hue
    green = (green * (1 - 0.3 * dry) + np.array([116, 104, 74]) * 0.3 * dry).astype(np.float32)
    gain = light.ambient * 0.78 + light.sun * 0.55 * np.clip(shade, 0, 1.2) - 0.14 * np.clip(-shade, 0, 1)
    tone = np.clip(gain * (1 + 0.42 * leaves + 0.12 * twigs), 0.08, 1.6) * (0.35 if light.dark else 1.0)
    bark = np.array([70, 60, 50], np.float32) * (light.ambient * (0.4 if light.dark else 0.8))
    color = green * (tone * cover)[..., None] + bark * trunk[..., None]
    return np.dstack([np.clip(color, 0, 255), (cover + trunk) * 255]).astype(np.float32), slender


def _crown(rng: np.random.Generator, x: Floats, y: Floats, light: Light) -> tuple[Floats, Floats]:
    """Lumps of foliage: above 0 inside them, and how far up on its lump a point lies."""
    crown = np.full((y.size, x.size), -3.0, np.float32)
    shade = np.zeros_like(crown)
    conical = rng.random() < 0.25
    for _ in range(int(rng.integers(9, 18))):
        level = rng.uniform(0.12, 0.72)
        spread = (0.15 + 0.75 * level) if conical else 0.62 * np.sin(np.pi * min(level / 0.85, 1)) ** 0.7
        middle, radius = rng.uniform(-spread, spread), rng.uniform(0.14, 0.3)
        lump = 1 - (((x - middle) * 0.9) ** 2 + ((y - level) * 1.7) ** 2) / radius**2
        # Each lump is lit on its upper side, towards the sun, and dark below.
        lit = (level - y) / radius * 0.9 + np.sign(light.to_sun[0]) * (x - middle) / radius * 0.4
        shade = np.where(lump > crown, lit, shade)
        crown = np.maximum(crown, lump)
    return np.asarray(crown, np.float32), np.asarray(shade, np.float32)


def paint_sign(rng: np.random.Generator, light: Light) -> Floats:
    """Paint a road sign on its post as ``(128, 64, 4)`` premultiplied RGBA, 0-255."""
    sheet = np.zeros((128, 64, 4), np.float32)

    def tone(color: tuple[int, int, int], shine: float = 1.0) -> tuple[float, ...]:
        return (*np.clip(light.on(color) * (shine if light.dark else 1), 0, 255).tolist(), 255.0)

    pale = tone((226, 226, 222), 1.8)
    cv2.rectangle(sheet, (30, 40), (33, 127), tone((120, 122, 124)), -1)
    face = tone([(24, 86, 60), (38, 70, 132), (206, 168, 40), (220, 220, 216)][int(rng.integers(4))], 1.8)
    form = int(rng.integers(3))
    if form == 0:
        cv2.rectangle(sheet, (6, 6), (57, 48), face, -1, cv2.LINE_AA)
        for y in (16, 26, 36):
            cv2.line(sheet, (13, y), (int(rng.integers(34, 51)), y), pale, 3)
    elif form == 1:
        cv2.fillPoly(sheet, [np.array([(32, 2), (60, 30), (32, 58), (4, 30)])], face, cv2.LINE_AA)
    else:
        cv2.circle(sheet, (32, 30), 26, tone((190, 40, 40), 1.8), -1, cv2.LINE_AA)
        cv2.circle(sheet, (32, 30), 19, pale, -1, cv2.LINE_AA)
    return sheet


_DASH, _DASH_PERIOD = 3.6, 12.0
_PROP_PERIOD = 240.0
_FAR = 400.0
_RAIL_BANDS = ((0.46, 0.54, 108), (0.54, 0.6, 136), (0.6, 0.64, 100), (0.64, 0.71, 128), (0.71, 0.76, 150))
_WALL_BANDS = ((0.0, 0.07, 74), (0.07, 0.3, 150), (0.3, 0.55, 136), (0.55, 0.8, 142), (0.8, 0.85, 186))


class Canvas:
    """What polygons are painted on: a picture, and the number of the vehicle that each pixel shows."""

    def __init__(
        self, camera: Pinhole, image: NDArray[np.uint8] | None, seen: NDArray[np.int32] | None = None
    ) -> None:
        self.camera, self.image, self.seen = camera, image, seen

    def fill(self, corners: NDArray[np.float64], color: NDArray[np.float64]) -> None:
        """Fill a polygon of ``(column, row)`` corners; what it hides is no vehicle any more."""
        points = [np.rint((corners - 0.5) * 16).astype(np.int32)]
        if self.image is not None:
            cv2.fillPoly(self.image, points, np.clip(color, 0, 255).tolist(), cv2.LINE_AA, 4)
        if self.seen is not None:
            cv2.fillPoly(self.seen, points, 0, cv2.LINE_8, 4)


@dataclass(frozen=True, eq=False)
class _Prop:
    """Something upright beside the road that comes again: a picture, its place and size in meters."""

    rgba: Floats
    lateral: float
    ahead: float
    width: float
    height: float


class Scenery:
    """Everything but the vehicles."""

    def __init__(self, shape: tuple[int, int], camera: Pinhole, light: Light, road: Road, seed: int) -> None:
        self.shape, self.camera, self.light, self.road = shape, camera, light, road
        rng = np.random.default_rng([seed, 3])
        dry = float(rng.random())
        self._concrete = bool(rng.random() < 0.65)
        self._rail = bool(rng.random() < 0.4)
        self._worn = float(rng.uniform(0.8, 1.0))
        self._yellow = bool(rng.random() < 0.5)
        self._backdrop = draw_backdrop(shape, camera, light, dry, rng)
        self._ground = Ground(shape, camera, light, road, dry, rng)
        self._hedges = self._grow(dry, rng)
        self._props = self._plant(dry, rng)

    def render(self, travel: float) -> NDArray[np.uint8]:
        """Draw the road without vehicles and without the barrier, `travel` meters into the drive."""
        image = self._backdrop.copy()
        ground = image[self._ground.first :]
        if len(ground):
            ground[:] = self._ground.color
            self._draw_lines(Canvas(self.camera, image), travel)
            self._ground.wear(ground, travel)
        for hedge in self._hedges:
            hedge.draw(image, travel)
        places = [((prop.ahead - travel) % _PROP_PERIOD, prop) for prop in self._props]
        for ahead, prop in sorted(places, key=lambda place: -place[0]):
            if ahead > 4.0:
                self._draw_prop(image, prop, ahead)
        if self._rail:
            self._draw_rail(Canvas(self.camera, image), self.road.right + self.road.shoulder + 0.4, travel)
        return image

    def draw_barrier(self, canvas: Canvas, travel: float) -> None:
        """Draw the barrier that stands before the oncoming lanes, in place."""
        x = self.road.barrier
        if not self._concrete:
            self._draw_rail(canvas, x, travel)
            return
        # Its face is turned to the right: in the shade when the sun stands to the left.
        face = 0.62 if self.light.to_sun[0] < 0 and self.light.sun > 0.2 else 1.0
        for low, high, tone in _WALL_BANDS:
            foot = 0.2 * max(0.0, (0.45 - low) / 0.45)
            shade = tone * (face if high < 0.82 else 1.0)
            self._wall(canvas, x + foot, low, high, np.array([1.0, 0.99, 0.95]) * shade)
        self._posts(canvas, x, travel, every=6.0, top=0.8, width=0.03, color=(86, 85, 82))

    def _draw_lines(self, canvas: Canvas, travel: float) -> None:
        """Solid lines at both edges, dashed ones between the lanes."""
        road = self.road
        white, yellow = np.array([222, 222, 216]) * self._worn, np.array([206, 158, 46]) * self._worn
        self._stripe(canvas, road.left + 0.2, 0.0, _FAR, yellow if self._yellow else white)
        self._stripe(canvas, road.right - 0.2, 0.0, _FAR, white)
        inner = [road.left + lane * LANE for lane in range(1, road.lanes)]
        for x in (*inner, road.barrier - 1.4 - LANE, road.barrier - 1.4 - 2 * LANE):
            for start in np.arange(-(travel % _DASH_PERIOD), 160, _DASH_PERIOD):
                self._stripe(canvas, x, float(start), float(start) + _DASH, white)

    def _stripe(
        self, canvas: Canvas, x: float, start: float, stop: float, color: NDArray[np.float64]
    ) -> None:
        """Paint a line along the road, in pieces: the light falls off along it."""
        camera = self.camera
        nearest = camera.focal_px * camera.height_m / (self.shape[0] - camera.horizon_px) * 0.9
        first, last = max(start, nearest), min(stop, _FAR)
        if last - first < 0.05:
            return
        shine = 1.6 if self.light.dark else 1.0
        edges = np.geomspace(first, last, 2 + int(np.log2(last / first) * 2))
        for near, far in pairwise(edges):
            corners = camera.project(
                [x - 0.075, x + 0.075, x + 0.075, x - 0.075], 0.0, [near, near, far, far]
            )
            canvas.fill(corners, self.light.on(color * shine, float(np.sqrt(near * far))))

    def _wall(self, canvas: Canvas, x: float, low: float, high: float, color: ArrayLike) -> None:
        """Paint an upright band along the road, in pieces: the light falls off along it."""
        first = max(abs(x) / ((self.shape[1] / 2 + 40) / self.camera.focal_px), 1.2)
        edges = np.geomspace(first, max(_FAR, 2 * first), 14)
        for near, far in pairwise(edges):
            corners = canvas.camera.project(x, [low, low, high, high], [near, far, far, near])
            canvas.fill(corners, self.light.on(color, float(np.sqrt(near * far))))

    def _posts(
        self,
        canvas: Canvas,
        x: float,
        travel: float,
        *,
        every: float,
        top: float,
        width: float,
        color: ArrayLike,
    ) -> None:
        """Upright posts along the road, far ones first."""
        for ahead in np.arange(20 * every - travel % every, 2.5, -every):
            (foot_x, foot_y), (head_x, head_y) = canvas.camera.project(x, [0.0, top], ahead)
            half = max(width * canvas.camera.focal_px / ahead / 2, 0.35)
            if foot_x + half >= 0 and foot_x - half <= self.shape[1]:
                corners = [
                    (foot_x - half, foot_y),
                    (foot_x + half, foot_y),
                    (head_x + half, head_y),
                    (head_x - half, head_y),
                ]
                canvas.fill(np.array(corners), self.light.on(color, float(ahead)))

    def _draw_rail(self, canvas: Canvas, x: float, travel: float) -> None:
        """Draw a guard-rail on posts: two bulges of a steel band, lit from above."""
        self._posts(canvas, x + 0.1, travel, every=4.0, top=0.72, width=0.12, color=(92, 92, 92))
        for low, high, tone in _RAIL_BANDS:
            self._wall(canvas, x, low, high, (tone, tone, tone + 2))

    def _grow(self, dry: float, rng: np.random.Generator) -> list[Hedge]:
        """Rows of shrubs on both sides, low ones before tall ones."""
        right = self.road.right + self.road.shoulder
        left = self.road.barrier - 3 * LANE - 5.0
        rows = [
            (right + 11.0, 1.5, 6.5),
            (left - 7.0, 1.5, 6.5),
            (right + float(rng.uniform(4, 7)), -1.2, 1.8),
        ]
        return [
            Hedge(self.shape, self.camera, self.light, *row, dry, rng) for row in rows if rng.random() < 0.65
        ]

    def _plant(self, dry: float, rng: np.random.Generator) -> list[_Prop]:
        """Trees and bushes on both sides, signs on the right."""
        kinds = [paint_tree(rng, dry, self.light) for _ in range(5)]
        density = rng.uniform(0.35, 1.0)
        verge = self.road.right + self.road.shoulder
        props = []
        for side, base in ((1, verge + 3.0), (-1, self.road.barrier - 3 * LANE - 5.0)):
            for ahead in np.arange(0, _PROP_PERIOD, 6.0):
                if rng.random() > density:
                    continue
                rgba, slender = kinds[int(rng.integers(len(kinds)))]
                bush = rng.random() < 0.35
                height = float(rng.uniform(1.2, 2.6) if bush else rng.uniform(4.5, 13))
                width = height * slender * float(rng.uniform(0.8, 1.25)) * (1.5 if bush else 1.0)
                lateral = base + side * float(rng.uniform(0, 3) if bush else rng.uniform(2, 16))
                picture = rgba[:, ::-1] if rng.random() < 0.5 else rgba
                props.append(_Prop(picture, lateral, float(ahead + rng.uniform(0, 5)), width, height))
        signs = [float(ahead) for ahead in np.arange(0, _PROP_PERIOD, 60.0) if rng.random() < 0.35]
        return props + [_Prop(paint_sign(rng, self.light), verge + 2.2, ahead, 1.2, 2.4) for ahead in signs]

    def _draw_prop(self, image: NDArray[np.uint8], prop: _Prop, ahead: float) -> None:
        scale = self.camera.focal_px / ahead
        width, height = round(prop.width * scale), round(prop.height * scale)
        foot_x, foot_y = self.camera.project(prop.lateral, 0.0, ahead).tolist()
        left, top = round(foot_x - width / 2), round(foot_y) - height
        x1, x2 = max(left, 0), min(left + width, self.shape[1])
        y1, y2 = max(top, 0), min(top + height, self.shape[0])
        if min(width, height) < 2 or x1 >= x2 or y1 >= y2:
            return
        sx, sy = prop.rgba.shape[1] / width, prop.rgba.shape[0] / height
        if sx > 1 and sy > 1:
            whole = cv2.resize(prop.rgba, (width, height), interpolation=cv2.INTER_AREA)
            seen = whole[y1 - top : y2 - top, x1 - left : x2 - left]
        else:
            # Only the visible part is scaled: a near tree is far larger than the picture.
            matrix = np.array([[sx, 0, (x1 - left + 0.5) * sx - 0.5], [0, sy, (y1 - top + 0.5) * sy - 0.5]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            seen = cv2.warpAffine(prop.rgba, matrix, (x2 - x1, y2 - y1), flags=flags)
        clear = self.light.clarity(ahead)
        alpha = seen[..., 3:] / 255
        color = seen[..., :3] * (clear * self.light.reach(ahead)) + self.light.haze * (1 - clear) * alpha
        part = image[y1:y2, x1:x2]
        part[:] = np.clip(part * (1 - alpha) + color, 0, 255)
