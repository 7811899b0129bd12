"""A moment of traffic becomes a picture: vehicles in order of distance, shadows, lamps, and their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.bodywork import PIXELS_PER_METRE, Surface
from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole
from vehicle_detection.synthetic.scenery import Canvas, Scenery
from vehicle_detection.synthetic.shapes import profile_at
from vehicle_detection.synthetic.vehicles import Car

NEAR_PLANE = 1.0
"""Metres ahead of the camera from which on anything is drawn."""

_ROUNDS = 4
_INVERSE = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


@dataclass(frozen=True, eq=False)
class Sprite:
    """Pixels of a vehicle: ``(h, w, 4)`` premultiplied RGBA, 0-255, from column `left` and row `top` on."""

    rgba: Floats
    left: int
    top: int


class _Sheet:
    """Samples of a sprite, `fine` of them along a pixel's side, and the rays of the camera through them."""

    def __init__(self, camera: Pinhole, left: int, top: int, right: int, bottom: int, fine: int) -> None:
        self.camera, self.left, self.top, self.fine = camera, left, top, fine
        self.rgba: Floats = np.zeros(((bottom - top) * fine, (right - left) * fine, 4), np.float32)

    def columns(self, x: NDArray[np.float64], z: NDArray[np.float64]) -> slice:
        """Find the samples between the outermost of some points in meters, and a few more."""
        seen = (self.camera.project(x, 0.0, z)[..., 0] - self.left) * self.fine
        first, last = np.clip([seen.min() - 3, seen.max() + 4], 0, self.rgba.shape[1])
        return slice(int(first), int(last))

    def rays(self, columns: slice) -> tuple[Floats, Floats]:
        """Slopes to the right ``(1, w)`` and upwards ``(h, 1)`` of the rays through some columns."""
        x = self.left + (np.arange(columns.start, columns.stop) + 0.5) / self.fine
        y = self.top + (np.arange(self.rgba.shape[0]) + 0.5) / self.fine
        right = (x - self.camera.center_px) / self.camera.focal_px
        up = (self.camera.horizon_px - y) / self.camera.focal_px
        return right.astype(np.float32)[None, :], up.astype(np.float32)[:, None]

    def lay(self, columns: slice, layer: Floats) -> None:
        """Lay premultiplied pixels over some columns."""
        part = self.rgba[:, columns]
        part *= 1 - layer[..., 3:] * np.float32(1 / 255)
        part += layer

    def sprite(self) -> Sprite:
        """Average the samples to pixels."""
        if self.fine == 1:
            return Sprite(self.rgba, self.left, self.top)
        size = (self.rgba.shape[1] // self.fine, self.rgba.shape[0] // self.fine)
        pixels = cv2.resize(self.rgba, size, interpolation=cv2.INTER_AREA)
        return Sprite(np.asarray(pixels, np.float32), self.left, self.top)


def full_box(car: Car, camera: Pinhole, lateral: float, distance: float) -> NDArray[np.float64]:
    """Box of a whole vehicle in the picture, seen or not: its outline, projected.

    Whatever is nearer than `NEAR_PLANE` is taken to be there.
    """
    d = car.design
    y = np.linspace(d.clearance, d.height, 40)
    half, near = car.half_width(y), profile_at(car.end, y)
    middle = np.where(y < d.belt, d.length / 2, near)
    far = d.length - profile_at(car.far_end, y)
    foot = np.full_like(y, d.width / 2 - 0.03)
    groups = [
        (0.93 * half, y, near + 0.22 * d.corner),
        (0.5 * half, y, near),
        (half, y, near + 0.8 * d.corner),
        (half, y, middle),
        (half, y, far),
        (foot, 0 * y, np.full_like(y, car.overhang)),
    ]
    x, up, behind = (np.concatenate([group[axis] for group in groups]) for axis in range(3))
    ahead = np.maximum(distance - car.overhang + behind, NEAR_PLANE)
    seen = np.concatenate([camera.project(lateral + side * x, up, ahead) for side in (-1, 1)])
    return np.concatenate([seen.min(0), seen.max(0)])


def draw_sprite(
    car: Car, camera: Pinhole, lateral: float, distance: float, shape: tuple[int, int]
) -> Sprite | None:
    """Draw a vehicle whose nearer tyres stand `distance` meters ahead and its middle `lateral` meters right.

    Returns None when no part of it can be in a picture of `shape`.
    """
    d = car.design
    start = distance - car.overhang
    if start + d.length < NEAR_PLANE + 0.5:
        return None
    x1, y1, x2, y2 = full_box(car, camera, lateral, distance).tolist()
    left, top = max(int(x1) - 3, 0), max(int(y1) - 3, 0)
    right, bottom = min(int(x2) + 4, shape[1]), min(int(y2) + 4, shape[0])
    if right <= left or bottom <= top:
        return None
    sheet = _Sheet(camera, left, top, right, bottom, fine=2 if x2 - x1 < 240 else 1)
    if distance > NEAR_PLANE:
        _draw_under(sheet, car, lateral, distance)
    for side in (-1, 1):
        if side * lateral < -d.width / 2:
            _draw_flank(sheet, car, side, lateral, start)
    if start > NEAR_PLANE:
        _draw_near(sheet, car, lateral, start)
    return sheet.sprite()


def _level(car: Car, name: str, wide: float, high: float) -> tuple[Surface, float, float]:
    """Take a surface at about the size it is drawn at, with its pixels per metre across and upwards.

    `wide` and `high` say how many of its pixels fall on one sample.
    """
    steps = [int(np.clip(np.log2(max(ratio, 1.0)) + 0.25, 0, 6)) for ratio in (wide, high)]
    full: Surface = getattr(car, name)
    key = (name, steps[0], steps[1])
    if key not in car.levels:
        height, width = full.rgba.shape[:2]
        size = (max(1, width >> steps[0]), max(1, height >> steps[1]))
        rgba = cv2.resize(full.rgba, size, interpolation=cv2.INTER_AREA) if any(steps) else full.rgba
        car.levels[key] = Surface(np.asarray(rgba, np.float32), full.left, full.top, full.depth)
    level = car.levels[key]
    across = PIXELS_PER_METRE * level.rgba.shape[1] / full.rgba.shape[1]
    upwards = PIXELS_PER_METRE * level.rgba.shape[0] / full.rgba.shape[0]
    return level, across, upwards


def _draw_under(sheet: _Sheet, car: Car, lateral: float, distance: float) -> None:
    """Tyres and underside, in an upright plane across the road: a scaling."""
    scale = sheet.camera.focal_px / distance * sheet.fine
    level, across, upwards = _level(car, "under", PIXELS_PER_METRE / scale, PIXELS_PER_METRE / scale)
    x, y = sheet.camera.project(lateral + level.left, level.top, distance).tolist()
    a, b = across / scale, upwards / scale
    shift = ((0.5 - (x - sheet.left) * sheet.fine) * a - 0.5, (0.5 - (y - sheet.top) * sheet.fine) * b - 0.5)
    matrix = np.array([[a, 0, shift[0]], [0, b, shift[1]]])
    size = (sheet.rgba.shape[1], sheet.rgba.shape[0])
    layer = cv2.warpAffine(level.rgba, matrix, size, flags=_INVERSE)
    sheet.lay(slice(0, size[0]), np.asarray(layer, np.float32))


def _draw_flank(sheet: _Sheet, car: Car, side: int, lateral: float, start: float) -> None:
    """Draw the flank towards the camera: an upright plane, and one that leans inwards above the belt."""
    d, camera, fine = car.design, sheet.camera, sheet.fine
    plane = lateral + side * d.width / 2
    belt_half, roof_half = car.half_width([d.belt, d.height - 0.06]).tolist()
    lean = 0.0 if d.box else (belt_half - roof_half) / (d.height - 0.06 - d.belt)
    first, last = max(start - 0.1, NEAR_PLANE), start + d.length
    inner = lateral + side * roof_half
    columns = sheet.columns(np.array([plane, plane, inner, inner]), np.array([first, last] * 2))
    size = (columns.stop - columns.start, sheet.rgba.shape[0])
    if size[0] < 1:
        return
    scale = camera.focal_px / np.sqrt(first * last) * fine
    shown = abs(camera.focal_px * plane * (1 / first - 1 / last)) * fine
    level, across, upwards = _level(
        car, "flank", PIXELS_PER_METRE * d.length / max(shown, 1.0), PIXELS_PER_METRE / scale
    )
    sample = np.array(
        [
            [1 / fine, 0, sheet.left + (columns.start + 0.5) / fine - camera.center_px],
            [0, -1 / fine, camera.horizon_px - sheet.top - 0.5 / fine],
            [0, 0, camera.focal_px],
        ]
    )

    def warp(offset: float, tilt: float) -> Floats:
        # The plane x = offset + tilt * y meets the ray (right * z, height + up * z, z) at
        # z = (offset + tilt * height) / (right - tilt * up): a homography from pixels to the surface.
        reach = offset + tilt * camera.height_m
        weight = np.array([1.0, -tilt, 0.0])
        depth = np.array([0.0, 0.0, reach]) - start * weight
        height = camera.height_m * weight + np.array([0.0, reach, 0.0])
        column = across * (depth - level.left * weight) - 0.5 * weight
        row = upwards * (level.top * weight - height) - 0.5 * weight
        matrix = np.stack([column, row, weight]) @ sample
        # A ray along the plane never meets it: OpenCV gives NaN there.
        return np.nan_to_num(
            np.asarray(cv2.warpPerspective(level.rgba, matrix, size, flags=_INVERSE), np.float32)
        )

    layer = warp(plane, 0.0)
    if lean:
        # Above the belt line of the upright plane a pixel shows the leaning one.
        right, up = sheet.rays(columns)
        away = plane / np.where(np.abs(right) > 1e-4, right, 1e-4 * np.sign(plane))
        above = (camera.height_m + up * away > d.belt)[..., None]
        layer = np.where(above, warp(lateral + side * (belt_half + lean * d.belt), -side * lean), layer)
    # A flank in the sun is brighter than one in the shade.
    sun = car.light.sun * max(0.0, side * car.light.to_sun[0])
    layer[..., :3] = np.minimum(layer[..., :3] * (0.86 + 0.5 * sun / car.light.ambient), layer[..., 3:])
    sheet.lay(columns, layer)


def _draw_near(sheet: _Sheet, car: Car, lateral: float, start: float) -> None:
    """Draw the near end: each ray meets its curved surface where some rounds of substitution say.

    A ray is at ``(right * z, height + up * z, z)``, the surface at ``z = start + depth(x, y)``: a point on
    the ray gives a depth, the depth the next point.
    """
    d, camera = car.design, sheet.camera
    scale = camera.focal_px / start * sheet.fine
    level, across, upwards = _level(car, "near", PIXELS_PER_METRE / scale, PIXELS_PER_METRE / scale)
    assert level.depth is not None
    sides = lateral + np.array([-0.5, 0.5, -0.5, 0.5]) * d.width
    columns = sheet.columns(sides, start + np.array([0.0, 0.0, 2.5, 2.5]))
    if columns.stop <= columns.start:
        return
    right, up = sheet.rays(columns)
    left, drop = np.float32(lateral + level.left), np.float32(level.top - camera.height_m)
    ppm = np.float32(PIXELS_PER_METRE)
    away = np.full((up.size, right.size), start, np.float32)
    for _ in range(_ROUNDS):
        x, y = (right * away - left) * ppm - 0.5, (drop - up * away) * ppm - 0.5
        depth = cv2.remap(level.depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        away = np.asarray(np.float32(start) + depth, np.float32)
    x, y = (right * away - left) * np.float32(across) - 0.5, (drop - up * away) * np.float32(upwards) - 0.5
    sheet.lay(columns, np.asarray(cv2.remap(level.rgba, x, y, cv2.INTER_LINEAR), np.float32))


Image = NDArray[np.uint8]

PARTLY_HIDDEN = 0.1
LARGELY_HIDDEN = 0.5
MOST_TRUNCATED = 0.7
LEAST_WIDTH = 40
_SOLID = 127.5


@dataclass(frozen=True)
class VehicleTruth:
    """What is true of one vehicle in one picture.

    Attributes
    ----------
    track
        Its number, the same in every frame of a drive.
    box
        ``(x1, y1, x2, y2)``, half-open pixels, around the vehicle as it is drawn, inside the picture. Other
        vehicles may hide a part of it; its shadow does not belong to it.
    full_box
        The same with what lies outside the picture. It may lie below 0 and beyond the picture's size.
    distance_m
        Metres along the road from the camera to where the nearer tyres stand; below 0 beside and behind it.
        The row where they stand is ``horizon + focal * camera height / distance_m``.
    speed_mps
        How fast the distance grows, in meters per second.
    hidden
        Share in [0, 1] of the vehicle's pixels that nearer vehicles and the barrier cover.
    occluded
        0 visible, 1 partly hidden (10% or more), 2 largely (over 50%).
    truncated
        Share of `full_box` outside the picture, in [0, 1].
    ignore
        1 for what is not scored: largely hidden, truncated by more than 0.7, under 40 pixels wide, or
        oncoming behind the barrier.
    """

    track: int
    box: tuple[int, int, int, int]
    full_box: tuple[float, float, float, float]
    distance_m: float
    speed_mps: float
    hidden: float
    occluded: int
    truncated: float
    ignore: int


@dataclass(frozen=True)
class Placed:
    """A vehicle at one moment."""

    car: Car
    track: int
    lateral: float
    distance: float
    speed: float
    oncoming: bool = False


def stage(
    placed: Sequence[Placed],
    scenery: Scenery,
    camera: Pinhole,
    travel: float,
    shape: tuple[int, int],
    image: Image | None,
) -> tuple[tuple[VehicleTruth, ...], NDArray[np.int32]]:
    """Draw vehicles into `image`, in place and far ones first; without an image find the truth alone.

    Returns
    -------
    tuple
        The truth, by track, and the ``(H, W)`` map of the track that each pixel shows, 0 where none does.
    """
    seen = np.zeros(shape, np.int32)
    sprites: list[tuple[Placed, Sprite, NDArray[np.bool_]]] = []
    ordered = sorted(placed, key=lambda one: (not one.oncoming, -one.distance))
    barrier_due = True
    for one in ordered:
        if barrier_due and not one.oncoming:
            scenery.draw_barrier(Canvas(camera, image, seen), travel)
            barrier_due = False
        sprite = draw_sprite(one.car, camera, one.lateral, one.distance, shape)
        if sprite is None:
            continue
        solid = sprite.rgba[..., 3] > _SOLID
        if not solid.any():
            continue
        if image is not None:
            _cast_shadow(image, camera, scenery.light, one)
            _blend(image, sprite, one, camera, scenery.light)
        height, width = solid.shape
        seen[sprite.top : sprite.top + height, sprite.left : sprite.left + width][solid] = one.track
        sprites.append((one, sprite, solid))
    if barrier_due:
        scenery.draw_barrier(Canvas(camera, image, seen), travel)
    truth = (_judge(one, sprite, solid, seen, camera, shape) for one, sprite, solid in sprites)
    return tuple(sorted(truth, key=lambda row: row.track)), seen


def draw_one(image: Image, camera: Pinhole, light: Light, one: Placed) -> NDArray[np.int64] | None:
    """Draw a single vehicle into `image`, in place, and return its box; None if it is outside."""
    sprite = draw_sprite(one.car, camera, one.lateral, one.distance, image.shape[:2])
    if sprite is None or not (solid := sprite.rgba[..., 3] > _SOLID).any():
        return None
    _cast_shadow(image, camera, light, one)
    _blend(image, sprite, one, camera, light)
    return np.array(_solid_box(sprite, solid), np.int64)


def _solid_box(sprite: Sprite, solid: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(solid.any(1)), np.flatnonzero(solid.any(0))
    return (
        sprite.left + int(columns[0]),
        sprite.top + int(rows[0]),
        sprite.left + int(columns[-1]) + 1,
        sprite.top + int(rows[-1]) + 1,
    )


def _judge(
    one: Placed,
    sprite: Sprite,
    solid: NDArray[np.bool_],
    seen: NDArray[np.int32],
    camera: Pinhole,
    shape: tuple[int, int],
) -> VehicleTruth:
    """Find the truth of a vehicle from the pixels it covers and those that are left of it."""
    box = _solid_box(sprite, solid)
    # Inside the picture the silhouette is exact; where the border cuts it, the projected outline goes on.
    outline = full_box(one.car, camera, one.lateral, one.distance)
    limits = (0, 0, shape[1], shape[0])
    whole = [float(b) if b != limit else float(o) for b, o, limit in zip(box, outline, limits)]
    whole = [min(w, b) if side < 2 else max(w, b) for side, (w, b) in enumerate(zip(whole, box))]
    area = (whole[2] - whole[0]) * (whole[3] - whole[1])
    truncated = 1 - (box[2] - box[0]) * (box[3] - box[1]) / area
    part = seen[sprite.top : sprite.top + solid.shape[0], sprite.left : sprite.left + solid.shape[1]]
    hidden = 1 - np.count_nonzero(part[solid] == one.track) / np.count_nonzero(solid)
    occluded = 2 if hidden > LARGELY_HIDDEN else 1 if hidden >= PARTLY_HIDDEN else 0
    ignore = occluded == 2 or truncated > MOST_TRUNCATED or box[2] - box[0] < LEAST_WIDTH or one.oncoming
    return VehicleTruth(
        one.track, box, (whole[0], whole[1], whole[2], whole[3]), one.distance, one.speed,
        float(hidden), occluded, float(truncated), int(ignore),
    )  # fmt: skip


def _cast_shadow(image: Image, camera: Pinhole, light: Light, one: Placed) -> None:
    """Darken the road under a vehicle, and where it keeps the sun away."""
    d = one.car.design
    start = one.distance - one.car.overhang
    first, last = max(start + 0.15, NEAR_PLANE), start + d.length - 0.1
    if last <= first + 0.2:
        return
    half = d.width / 2 - 0.06
    scale = camera.focal_px / max(one.distance, 2.0)
    left, right, near, far = one.lateral - half, one.lateral + half, first, last
    foot = [(left, near), (right, near), (right, far), (left, far)]
    shadows = [(foot, 0.78, 0.07)]
    if light.sun > 0.15:
        to_sun = light.to_sun
        reach = min(d.height / max(to_sun[1], 0.2), 4.0)
        shift = (-to_sun[0] * reach, -to_sun[2] * reach)
        moved = [(x + shift[0], max(z + shift[1], NEAR_PLANE)) for x, z in foot]
        shadows.insert(0, (foot + moved, 0.55 * light.sun / (light.sun + 0.35 * light.ambient), 0.1))
    for points, strength, softness in shadows:
        x, z = (np.array(values) for values in zip(*points))
        corners = camera.project(x, 0.0, z)
        hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
        sigma = max(softness * scale * 0.6, 0.6)
        margin = int(3 * sigma) + 2
        x1, y1 = np.maximum(np.floor(hull.min(0)).astype(int) - margin, 0)
        x2, y2 = np.minimum(np.ceil(hull.max(0)).astype(int) + margin, image.shape[1::-1])
        if x1 >= x2 or y1 >= y2:
            continue
        mask = np.zeros((y2 - y1, x2 - x1), np.uint8)
        cv2.fillConvexPoly(
            mask, np.rint((hull - (x1 + 0.5, y1 + 0.5)) * 16).astype(np.int32), 255, cv2.LINE_AA, 4
        )
        soft = cv2.GaussianBlur(mask, (0, 0), sigma, sigmaY=max(0.6, sigma * 0.4))
        gain = np.rint(255 - strength * soft).astype(np.uint8)
        part = image[y1:y2, x1:x2]
        cv2.multiply(part, cv2.merge([gain] * 3), dst=part, scale=1 / 255)


def _blend(image: Image, sprite: Sprite, one: Placed, camera: Pinhole, light: Light) -> None:
    """Lay a sprite over the picture: lens blur and haze grow with the distance, lamps shine at night."""
    away = max(one.distance, 0.0)
    rgba = cv2.GaussianBlur(
        sprite.rgba, (0, 0), (0.2 + 0.004 * min(away, 60.0)) * max(1.0, camera.focal_px / 1152)
    )
    clear = light.clarity(away)
    alpha = rgba[..., 3:] / 255
    color = rgba[..., :3] * (clear * light.reach(away)) + light.haze * (1 - clear) * alpha
    height, width = sprite.rgba.shape[:2]
    part = image[sprite.top : sprite.top + height, sprite.left : sprite.left + width]
    part[:] = np.clip(part * (1 - alpha) + color + 0.5, 0, 255)
    if light.lamps > 0.3 and one.distance > 2.5:
        _shine(image, camera, light, one)


def _shine(image: Image, camera: Pinhole, light: Light, one: Placed) -> None:
    """Add a glow around each lamp."""
    d = one.car.design
    front = one.car.facing == "front"
    high = 0.86 if d.box else d.belt - 0.14 if not front else 0.68
    color = np.array([255, 244, 220] if front else [230, 30, 24], np.float32)
    scale = camera.focal_px / one.distance
    radius = max((0.34 if front else 0.16) * scale, 1.2)
    strength = (0.9 if front else 0.55) * light.lamps * (1.0 if light.dark else 0.35)
    for side in (-1, 1):
        middle = camera.project(
            one.lateral + side * (d.width / 2 - 0.2), high, one.distance - 0.6 * one.car.overhang
        )
        reach = int(3 * radius) + 1
        x1, y1 = np.maximum(np.floor(middle).astype(int) - reach, 0)
        x2, y2 = np.minimum(np.ceil(middle).astype(int) + reach, image.shape[1::-1])
        if x1 >= x2 or y1 >= y2:
            continue
        x, y = np.arange(x1, x2) + 0.5 - middle[0], np.arange(y1, y2) + 0.5 - middle[1]
        glow = np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / (2 * radius**2))[..., None]
        part = image[y1:y2, x1:x2]
        part[:] = np.clip(part + strength * glow * color, 0, 255)
