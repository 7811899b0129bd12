"""Drawing of vehicles into a scene: perspective, shadows, lamps, occlusion and ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.scenes.camera_light import Doubles, Floats, Image, SceneConfig, alpha_over
from vehicle_detection.scenes.scenery import Canvas, Scenery, draw_layer
from vehicle_detection.scenes.vehicles import PIXELS_PER_METER, Surface, VehicleBody, profile_at

NEAR_PLANE = 1.0  # distance from which on anything is drawn (m)
_INVERSE = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


@dataclass(frozen=True)
class VehicleTruth:
    """Ground truth of one vehicle in one image.

    `box` is ``(x1, y1, x2, y2)`` in half-open pixels, without the shadow, and includes parts that other
    vehicles hide; `full_box` also includes the parts outside the image. `distance_m` is along the road to the
    nearest part, and negative behind the camera.
    `ignore` is 1 if the vehicle is not scored: largely occluded, truncated by more than 0.7, narrower than
    40 pixels, or oncoming behind the barrier.
    """

    track: int  # the same in every frame of a drive
    box: tuple[int, int, int, int]
    full_box: tuple[float, float, float, float]
    distance_m: float
    speed_mps: float  # rate of change of the distance
    occluded_fraction: float  # of its pixels, covered by nearer vehicles and the barrier
    occluded: int  # 0 visible, 1 partly occluded (10% or more), 2 largely occluded (over 50%)
    truncated: float  # fraction of `full_box` outside the image
    ignore: int

    @property
    def hard_to_see(self) -> bool:
        """Whether it is largely occluded, truncated by more than 0.7, or narrower than 40 pixels."""
        return self.occluded == 2 or self.truncated > 0.7 or self.box[2] - self.box[0] < 40


@dataclass(frozen=True)
class VehiclePose:
    """A vehicle and its position at one moment."""

    body: VehicleBody
    track: int
    lateral: float  # from the camera to its middle, to the right (m)
    distance: float  # to its nearer tires (m)
    speed: float = 0.0  # away from the camera (m/s)
    oncoming: bool = False
    slope: float = 0.0  # height of the road below it over that below the camera, over its distance

    @property
    def start(self) -> float:
        """Distance to its near end (m)."""
        return self.distance - self.body.overhang


@dataclass(frozen=True, eq=False)
class Sprite:
    """Image of a vehicle: ``(h, w, 4)`` premultiplied RGBA, 0-255, at column `left` and row `top`."""

    rgba: Floats
    left: int
    top: int

    @property
    def region(self) -> tuple[slice, slice]:
        """Rows and columns of the frame that it covers."""
        height, width = self.rgba.shape[:2]
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    @cached_property
    def solid(self) -> NDArray[np.bool_]:
        """``(h, w)``: True where it is more opaque than transparent."""
        return np.asarray(self.rgba[..., 3] > 127.5)

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Bounding box of its solid pixels."""
        x, y, width, height = cv2.boundingRect(self.solid.astype(np.uint8))
        return self.left + x, self.top + y, self.left + x + width, self.top + y + height


def composite(
    poses: Sequence[VehiclePose], scenery: Scenery, config: SceneConfig, travel: float, image: Image | None
) -> tuple[tuple[VehicleTruth, ...], NDArray[np.int32]]:
    """Draw vehicles and the barrier into `image` in place, far ones first; None: only find the truth.

    Returns the truth by track, and the ``(H, W)`` map of the track that each pixel shows, 0 where none.
    """
    instance_map = np.zeros(config.shape, np.int32)
    canvas = Canvas(config, image, instance_map)
    drawn: list[tuple[VehiclePose, Sprite]] = []
    # The barrier stands between the oncoming vehicles and the others.
    for oncoming in (True, False):
        group = [pose for pose in poses if pose.oncoming == oncoming]
        for pose in sorted(group, key=lambda pose: -pose.distance):
            sprite = draw_vehicle(image, config.on_hill(pose.slope), pose)
            if sprite is not None:
                instance_map[sprite.region][sprite.solid] = pose.track
                drawn.append((pose, sprite))
        if oncoming:
            scenery.draw_barrier(canvas, travel)
    truth = (ground_truth(pose, sprite, instance_map, config.on_hill(pose.slope)) for pose, sprite in drawn)
    return tuple(sorted(truth, key=lambda row: row.track)), instance_map


def draw_vehicle(image: Image | None, config: SceneConfig, pose: VehiclePose) -> Sprite | None:
    """Draw a single vehicle into `image`, if given, in place and return it; None if it is outside.

    It has a shadow and lamps, and its lens blur and haze grow with the distance.
    """
    sprite = draw_sprite(pose, config)
    if sprite is not None and image is not None:
        _draw_shadow(image, config, pose)
        light, distance = config.light, max(pose.distance, 0.0)
        sigma = (0.2 + 0.004 * min(distance, 60.0)) * max(1.0, config.camera.focal_px / 1152)
        rgba = np.asarray(cv2.GaussianBlur(sprite.rgba, (0, 0), sigma), np.float32)
        draw_layer(image[sprite.region], rgba, light, distance, offset=0.5)
        if light.lamps > 0.3 and pose.distance > 2.5:
            _draw_glow(image, config, pose)
    return sprite


def ground_truth(
    pose: VehiclePose, sprite: Sprite, instance_map: NDArray[np.int32], config: SceneConfig
) -> VehicleTruth:
    """Compute the truth of a vehicle from the pixels that it covers and those that remain visible."""
    height, width = config.shape
    # The silhouette gives the exact box; where the border cuts it, the projected outline extends it.
    box = np.array(sprite.box, np.float64)
    full = np.where(box == (0, 0, width, height), projected_box(pose, config), box)
    full = np.concatenate([np.minimum(full[:2], box[:2]), np.maximum(full[2:], box[2:])])
    if config.roll:
        box, full = _rolled_boxes(sprite, box, full, config)
    x1, y1, x2, y2 = full.tolist()
    truncated = 1 - float((box[2] - box[0]) * (box[3] - box[1])) / ((x2 - x1) * (y2 - y1))
    visible = instance_map[sprite.region][sprite.solid] == pose.track
    fraction = 1 - np.count_nonzero(visible) / visible.size
    occluded = 2 if fraction > 0.5 else 1 if fraction >= 0.1 else 0
    corners: Any = tuple(map(int, box))
    facts = pose.track, corners, (x1, y1, x2, y2), pose.start, pose.speed, fraction, occluded, truncated
    truth = VehicleTruth(*facts, ignore=int(pose.oncoming))
    return replace(truth, ignore=1) if truth.hard_to_see else truth


def _rolled_boxes(
    sprite: Sprite, box: Doubles, full: Doubles, config: SceneConfig
) -> tuple[Doubles, Doubles]:
    """Box of a vehicle's pixels, and of those inside the frame or not, after the image is rolled."""
    columns = np.flatnonzero(sprite.solid.any(axis=0))
    solid = sprite.solid[:, columns]
    fall = config.roll * (sprite.left + columns + 0.5 - config.center_px)
    top = sprite.top + solid.argmax(axis=0) + fall
    bottom = sprite.top + len(solid) - solid[::-1].argmax(axis=0) + fall
    inside = np.clip(np.rint([top.min(), bottom.max()]), 0, config.shape[0])
    first, last = full[[1, 3]] + (top.min() - box[1], bottom.max() - box[3])
    rolled = np.array([box[0], inside[0], box[2], inside[1]])
    around = np.where(rolled == (0, 0, *config.shape[::-1]), (full[0], first, full[2], last), rolled)
    return rolled, np.concatenate([np.minimum(around[:2], rolled[:2]), np.maximum(around[2:], rolled[2:])])


def projected_box(pose: VehiclePose, config: SceneConfig) -> Doubles:
    """Bounding box of a vehicle's outline, inside the image or not; points before `NEAR_PLANE` move there."""
    body, dims = pose.body, pose.body.dimensions
    y = np.linspace(dims.clearance, dims.height, 40)
    half, near = body.half_width(y), profile_at(body.end, y)
    middle = np.where(y < dims.belt, dims.length / 2, near)
    far = dims.length - profile_at(body.far_end, y)
    tires = np.full_like(y, dims.width / 2 - 0.03)
    outlines = [
        (0.93 * half, y, near + 0.22 * dims.corner),
        (0.5 * half, y, near),
        (half, y, near + 0.8 * dims.corner),
        (half, y, middle),
        (half, y, far),
        (tires, 0 * y, np.full_like(y, body.overhang)),
    ]
    x, up, behind = (np.concatenate(values) for values in zip(*outlines))
    ahead = np.maximum(pose.start + behind, NEAR_PLANE)
    points = np.concatenate([config.project(pose.lateral + side * x, up, ahead) for side in (-1, 1)])
    return np.concatenate([points.min(0), points.max(0)])


def draw_sprite(pose: VehiclePose, config: SceneConfig) -> Sprite | None:
    """Draw a vehicle in perspective; None if no pixel of it is in the frame."""
    dims = pose.body.dimensions
    if pose.start + dims.length < NEAR_PLANE + 0.5:
        return None
    x1, y1, x2, y2 = projected_box(pose, config).tolist()
    left, top = max(int(x1) - 3, 0), max(int(y1) - 3, 0)
    right, bottom = min(int(x2) + 4, config.shape[1]), min(int(y2) + 4, config.shape[0])
    if right <= left or bottom <= top:
        return None
    buffer = _SpriteBuffer(config, left, top, right, bottom, samples=2 if x2 - x1 < 240 else 1)
    if pose.distance > NEAR_PLANE:
        _draw_end(buffer, pose, pose.body.underside, pose.distance)
    for side in (-1, 1):
        if side * pose.lateral < -dims.width / 2:
            _draw_flank(buffer, pose, side)
    if pose.start > NEAR_PLANE:
        _draw_end(buffer, pose, pose.body.near_end, pose.start)
    sprite = buffer.sprite()
    return sprite if sprite.solid.any() else None


class _SpriteBuffer:
    """Supersampled image of a sprite, with `samples` samples along each side of a pixel."""

    def __init__(
        self, config: SceneConfig, left: int, top: int, right: int, bottom: int, *, samples: int
    ) -> None:
        self.config, self.left, self.top, self.samples = config, left, top, samples
        self.rgba: Floats = np.zeros(((bottom - top) * samples, (right - left) * samples, 4), np.float32)

    def columns(self, x: Doubles, z: Doubles) -> slice:
        """Columns of samples between the outermost of some points in meters, with a margin."""
        columns = (self.config.project(x, 0.0, z)[..., 0] - self.left) * self.samples
        first, last = np.clip([columns.min() - 3, columns.max() + 4], 0, self.rgba.shape[1])
        return slice(int(first), int(last))

    def rays(self, columns: slice) -> tuple[Floats, Floats]:
        """Slopes to the right ``(1, w)`` and upwards ``(h, 1)`` of the camera rays through some columns."""
        x = self.left + (np.arange(columns.start, columns.stop) + 0.5) / self.samples
        y = self.top + (np.arange(self.rgba.shape[0]) + 0.5) / self.samples
        camera = self.config.camera
        right = (x - self.config.center_px) / camera.focal_px
        up = (camera.horizon_px - y) / camera.focal_px
        return right.astype(np.float32)[None, :], up.astype(np.float32)[:, None]

    def composite(self, columns: slice, layer: NDArray[Any]) -> None:
        """Composite premultiplied RGBA over some columns."""
        rgba = np.asarray(layer, np.float32)
        part = self.rgba[:, columns]
        part[:] = alpha_over(part, rgba, rgba[..., 3:] * np.float32(1 / 255))

    def sprite(self) -> Sprite:
        """Average the samples of each pixel."""
        rgba = self.rgba
        if self.samples > 1:
            size = (rgba.shape[1] // self.samples, rgba.shape[0] // self.samples)
            rgba = np.asarray(cv2.resize(rgba, size, interpolation=cv2.INTER_AREA), np.float32)
        return Sprite(rgba, self.left, self.top)


def _draw_flank(buffer: _SpriteBuffer, pose: VehiclePose, side: int) -> None:
    """Draw the flank towards the camera: an upright plane, and one that leans inwards above the belt."""
    config, samples, start = buffer.config, buffer.samples, pose.start
    body, dims, light, camera = pose.body, pose.body.dimensions, config.light, config.camera
    plane = pose.lateral + side * dims.width / 2
    belt_half, roof_half = body.half_width([dims.belt, dims.height - 0.06]).tolist()
    lean = 0.0 if dims.is_box else (belt_half - roof_half) / (dims.height - 0.06 - dims.belt)
    first, last = max(start - 0.1, NEAR_PLANE), start + dims.length
    inner = pose.lateral + side * roof_half
    columns = buffer.columns(np.array([plane, plane, inner, inner]), np.array([first, last] * 2))
    size = (columns.stop - columns.start, buffer.rgba.shape[0])
    if size[0] < 1:
        return
    surface = body.flank
    width = abs(camera.focal_px * plane * (1 / first - 1 / last)) * samples
    scale = camera.focal_px / np.sqrt(first * last) * samples
    rgba, across, upwards = surface.mipmap(
        PIXELS_PER_METER * dims.length / max(width, 1.0), PIXELS_PER_METER / scale
    )
    sample_to_ray = np.array([
        [1 / samples, 0, buffer.left + (columns.start + 0.5) / samples - config.center_px],
        [0, -1 / samples, camera.horizon_px - buffer.top - 0.5 / samples],
        [0, 0, camera.focal_px],
    ])  # fmt: skip

    def warp(offset: float, tilt: float) -> Floats:
        # The plane x = offset + tilt * y meets the ray (right * z, height + up * z, z) at
        # z = (offset + tilt * height) / (right - tilt * up): a homography from samples to the surface.
        reach = offset + tilt * camera.height_m
        weight = np.array([1.0, -tilt, 0.0])
        depth = np.array([0.0, 0.0, reach]) - start * weight
        height = camera.height_m * weight + np.array([0.0, reach, 0.0])
        column = across * (depth - surface.left * weight) - 0.5 * weight
        row = upwards * (surface.top * weight - height) - 0.5 * weight
        matrix = np.stack([column, row, weight]) @ sample_to_ray
        # OpenCV gives NaN for a ray parallel to the plane.
        return np.nan_to_num(np.asarray(cv2.warpPerspective(rgba, matrix, size, flags=_INVERSE), np.float32))

    layer = warp(plane, 0.0)
    if lean:
        # Where the upright plane would be seen above the belt, the leaning plane is seen.
        right, up = buffer.rays(columns)
        ahead = plane / np.where(np.abs(right) > 1e-4, right, 1e-4 * np.sign(plane))
        above = (camera.height_m + up * ahead > dims.belt)[..., None]
        leaning = warp(pose.lateral + side * (belt_half + lean * dims.belt), -side * lean)
        layer = np.where(above, leaning, layer)
    sun = light.sun * max(0.0, side * light.to_sun[0])
    layer[..., :3] = np.minimum(layer[..., :3] * (0.86 + 0.5 * sun / light.ambient), layer[..., 3:])
    buffer.composite(columns, layer)


def _draw_end(buffer: _SpriteBuffer, pose: VehiclePose, surface: Surface, start: float) -> None:
    """Draw the near end, or tires and underside: the intersection of each ray with a surface across the road.

    A ray is at ``(right * z, height + up * z, z)``, the surface at ``z = start + depth(x, y)``: a point on
    the ray gives a depth, the depth the next point (fixed-point iteration).
    """
    config = buffer.config
    scale = config.camera.focal_px / start * buffer.samples
    rgba, across, upwards = surface.mipmap(PIXELS_PER_METER / scale, PIXELS_PER_METER / scale)
    sides = pose.lateral + np.array([-0.5, 0.5, -0.5, 0.5]) * pose.body.dimensions.width
    columns = buffer.columns(sides, start + np.array([0.0, 0.0, 2.5, 2.5]))
    if columns.stop <= columns.start:
        return
    right, up = buffer.rays(columns)
    left = np.float32(pose.lateral + surface.left)
    top = np.float32(surface.top - config.camera.height_m)
    ahead = np.full((up.size, right.size), start, np.float32)

    def surface_pixels(x_scale: float, y_scale: float) -> tuple[Floats, Floats]:
        x = (right * ahead - left) * np.float32(x_scale) - 0.5
        return x, (top - up * ahead) * np.float32(y_scale) - 0.5

    for _ in range(4):
        if surface.depth is not None:
            x, y = surface_pixels(PIXELS_PER_METER, PIXELS_PER_METER)
            depth = cv2.remap(surface.depth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            ahead = np.asarray(np.float32(start) + depth, np.float32)
    buffer.composite(columns, cv2.remap(rgba, *surface_pixels(across, upwards), cv2.INTER_LINEAR))


def _draw_shadow(image: Image, config: SceneConfig, pose: VehiclePose) -> None:
    """Darken the road under a vehicle and where it blocks the sun."""
    dims, light = pose.body.dimensions, config.light
    first, last = max(pose.start + 0.15, NEAR_PLANE), pose.start + dims.length - 0.1
    if last <= first + 0.2:
        return
    half = dims.width / 2 - 0.06
    left, right = pose.lateral - half, pose.lateral + half
    footprint = [(left, first), (right, first), (right, last), (left, last)]
    shadows = [(footprint, 0.78, 0.07)]
    if light.sun > 0.15:
        to_sun = light.to_sun
        reach = min(dims.height / max(to_sun[1], 0.2), 4.0)
        roof = [(x - to_sun[0] * reach, max(z - to_sun[2] * reach, NEAR_PLANE)) for x, z in footprint]
        shadows.insert(0, (footprint + roof, 0.55 * light.sun / (light.sun + 0.35 * light.ambient), 0.1))
    scale = config.camera.focal_px / max(pose.distance, 2.0)
    for points, strength, softness in shadows:
        x, z = (np.array(values) for values in zip(*points))
        hull = cv2.convexHull(config.project(x, 0.0, z).astype(np.float32))[:, 0]
        sigma = max(softness * scale * 0.6, 0.6)
        region = _clipped_region(hull, int(3 * sigma) + 2, image)
        if region is None:
            continue
        part = image[region]
        mask = np.zeros(part.shape[:2], np.uint8)
        corners = (hull - (region[1].start + 0.5, region[0].start + 0.5)) * 16
        cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 255, cv2.LINE_AA, 4)
        soft = cv2.GaussianBlur(mask, (0, 0), sigma, sigmaY=max(0.6, sigma * 0.4))
        gain = np.rint(255 - strength * soft).astype(np.uint8)
        cv2.multiply(part, cv2.merge([gain] * 3), dst=part, scale=1 / 255)


def _draw_glow(image: Image, config: SceneConfig, pose: VehiclePose) -> None:
    """Add a glow around each lamp."""
    dims, light = pose.body.dimensions, config.light
    scale = config.camera.focal_px / pose.distance
    if pose.body.view == "front":
        height, radius, strength, color = 0.68, 0.34, 0.9, (255, 244, 220)
    else:
        height, radius, strength, color = dims.belt - 0.14, 0.16, 0.55, (230, 30, 24)
    if dims.is_box:
        height = 0.86
    radius = max(radius * scale, 1.2)
    strength = strength * light.lamps * (1.0 if light.dark else 0.35)
    for side in (-1, 1):
        x = pose.lateral + side * (dims.width / 2 - 0.2)
        center = config.project(x, height, pose.distance - 0.6 * pose.body.overhang)
        region = _clipped_region(center[None], int(3 * radius) + 1, image)
        if region is None:
            continue
        rows, columns = (np.arange(part.start, part.stop) + 0.5 for part in region)
        squared = (columns[None, :] - center[0]) ** 2 + (rows[:, None] - center[1]) ** 2
        glow = np.exp(-squared / (2 * radius**2))[..., None]
        image[region] = np.clip(image[region] + strength * glow * np.array(color, np.float32), 0, 255)


def _clipped_region(points: NDArray[Any], margin: int, image: Image) -> tuple[slice, slice] | None:
    """Rows and columns of the image around ``(column, row)`` points; None if they are outside."""
    x1, y1 = np.maximum(np.floor(points.min(0)).astype(int) - margin, 0).tolist()
    x2, y2 = np.minimum(np.ceil(points.max(0)).astype(int) + margin, image.shape[1::-1]).tolist()
    return (slice(y1, y2), slice(x1, x2)) if x1 < x2 and y1 < y2 else None
