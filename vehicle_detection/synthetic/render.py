"""A moment of traffic becomes a picture: vehicles in order of distance, shadows, lamps, and their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.camera_light import Light, Pinhole
from vehicle_detection.synthetic.scenery import Canvas, Scenery
from vehicle_detection.synthetic.sprites import NEAR_PLANE, Sprite, draw_sprite, full_box
from vehicle_detection.synthetic.vehicles import Car

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
        How fast the distance grows, in metres per second.
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
