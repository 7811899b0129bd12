"""The road and its surroundings, drawn once for a camera and light and shifted by the distance traveled."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.scenes.camera_light import (
    Doubles,
    Floats,
    Image,
    Light,
    Rng,
    SceneConfig,
    alpha_over,
    blend,
    tile_to,
    wrapped_noise,
)

LANE = 3.6  # width of a lane (m)
_PERIOD = 96.0  # length after which ground and hedges repeat (m)


class Road:
    """A straight road with three lanes; positions are in meters to the right of the camera."""

    lanes = 3

    def __init__(self, own: int) -> None:
        self.own = own  # lane of the camera, counted from the left
        self.left = -(own + 0.5) * LANE  # outer edges of the lanes
        self.right = (self.lanes - own - 0.5) * LANE
        self.verge = self.right + 2.2  # right edge of the shoulder, where the grass begins
        self.barrier = self.left - 1.1  # the barrier to the oncoming lanes

    def lane(self, number: int) -> float:
        """Middle of a lane; -1 and below are the oncoming lanes behind the barrier."""
        return self.barrier - 1.4 + (number + 0.5) * LANE if number < 0 else (number - self.own) * LANE


def draw_backdrop(config: SceneConfig, dryness: float, rng: Rng) -> Image:
    """Draw everything above the horizon into an ``(H, W, 3)`` image that is black below it."""
    # One row below the horizon is included, so that no gap opens above the ground.
    rows = min(config.shape[0], int(config.camera.horizon_px) + 2)
    image = np.zeros((*config.shape, 3), np.uint8)
    if rows > 0:
        sky = _draw_sky(rows, config, rng)
        for layer in range(3):
            if layer == 2 or rng.random() < 0.75:
                _draw_hills(sky, config, dryness, layer, rng)
        _draw_tree_line(sky, config, rng)
        image[:rows] = np.clip(sky, 0, 255)
    return image


def _draw_sky(height: int, config: SceneConfig, rng: Rng) -> Floats:
    """Draw a vertical color gradient with clouds, ``(height, W, 3)``."""
    light, width = config.light, config.shape[1]
    elevation = np.clip(1 - (np.arange(height) + 0.5) / max(config.camera.horizon_px, 1), 0, 1) ** 0.8
    low, top = np.asarray(light.sky_low, np.float32), np.asarray(light.sky_top, np.float32)
    sky = np.repeat((low + (top - low) * elevation[:, None]).astype(np.float32)[:, None], width, axis=1)
    noise = wrapped_noise(rng, (128, 256), falloff=1.7, stretch=2.6)
    cloud = cv2.resize(noise[:80], (width, height), interpolation=cv2.INTER_CUBIC)
    cover = np.clip((cloud - rng.uniform(0.3, 1.6)) * 0.7, 0, 1)[..., None] * (0.3 if light.dark else 0.8)
    blend(sky, np.minimum(low * 1.15 + 14, 250), cover)
    return sky


def _draw_hills(sky: Floats, config: SceneConfig, dryness: float, layer: int, rng: Rng) -> None:
    """Draw one range of hills in place; layer 0 is the farthest and haziest."""
    light = config.light
    max_height = rng.uniform(0.02, 0.06) / (1 + 0.5 * layer) * config.camera.focal_px
    ridge = wrapped_noise(rng, (1, 512), falloff=1.6)[0]
    ridge = (ridge - ridge.min()) / (ridge.max() - ridge.min() + 1e-6)
    ridge_line = np.interp(np.linspace(0, 300, sky.shape[1]), np.arange(512), ridge)
    edge = config.camera.horizon_px - max_height * (0.25 + 0.75 * ridge_line)
    clear = 0.9 if light.dark else 0.35 + 0.25 * layer
    ground = light.shade((70, 82, 62) if dryness < 0.5 else (112, 100, 74))
    color = ground * clear + light.haze * np.array([0.73, 0.79, 0.85]) * (1 - clear)
    _paint_below(sky, edge, color.astype(np.float32), 0.09, wrapped_noise(rng, (256, 256), falloff=0.9))


def _draw_tree_line(sky: Floats, config: SceneConfig, rng: Rng) -> None:
    """Draw distant trees in place, lower towards the vanishing point of the road."""
    width, camera = sky.shape[1], config.camera
    slopes = (np.arange(width) + 0.5 - config.center_px) / camera.focal_px
    noise = wrapped_noise(rng, (1, 1024), falloff=1.0)[0]
    noise = np.interp(np.linspace(0, 700, width), np.arange(1024), noise)
    distance = 170.0 + 160.0 * np.exp(-((slopes / 0.08) ** 2))
    height = np.clip(6.0 + 2.6 * noise, 1.5, 14) * camera.focal_px / distance
    edge = camera.horizon_px - height
    depth = np.clip((np.arange(len(sky))[:, None] - edge) / np.maximum(height, 1), 0, 1)[..., None]
    green = config.light.shade((66, 78, 50), 60.0).astype(np.float32)
    green = green * (1.1 - 0.45 * depth.astype(np.float32))
    _paint_below(sky, edge, green, 0.28, wrapped_noise(rng, (256, 256), falloff=0.75))


def _paint_below(sky: Floats, edge: Doubles, color: Floats, contrast: float, noise: Floats) -> None:
    """Paint a color with a texture of noise below a line, given by its row in each column, in place."""
    first = max(int(edge.min()) - 1, 0)
    part = sky[first:]
    texture = 1 + contrast * tile_to(noise, *part.shape[:2])[..., None]
    mask = np.clip(np.arange(len(part))[:, None] + 0.5 - (edge - first), 0, 1)[..., None]
    blend(part, np.broadcast_to(color, sky.shape)[first:] * texture, mask.astype(np.float32))


def _mipmap_parts(
    footprint: Doubles, n_levels: int, shown: NDArray[np.bool_] | bool = True
) -> Iterator[tuple[int, slice]]:
    """Yield the mipmap levels in use and the rows or columns that use each, by their texels per pixel."""
    chosen = np.clip(np.rint(np.log2(np.maximum(footprint, 1))), 0, n_levels - 1).astype(int)
    for level in range(n_levels):
        here = np.flatnonzero(shown & (chosen == level))
        if len(here):
            yield level, slice(int(here[0]), int(here[-1]) + 1)


class _TexturedPart(NamedTuple):
    """A part of the image, one mipmap level of a texture, and where in it each pixel is looked up."""

    region: tuple[slice, slice]
    texture: NDArray[Any]
    map_x: Floats
    map_y: Floats


_TILE_ACROSS, _TILE_ALONG = 0.1, 0.12  # meters per pixel of the road texture
_TILE_HALF_WIDTH = 28.0  # meters to each side of the camera


class Ground:
    """Asphalt and grass below the horizon, without the lane markings."""

    def __init__(self, config: SceneConfig, road: Road, dryness: float, rng: Rng) -> None:
        camera, (height, width) = config.camera, config.shape
        self.first = int(np.clip(np.ceil(camera.horizon_px + 0.5), 0, height))
        rows = np.arange(self.first, height) + 0.5
        ahead = camera.focal_px * camera.height_m / np.maximum(rows - camera.horizon_px, 0.3)
        slopes = (np.arange(width) + 0.5 - config.center_px) / camera.focal_px
        self._ahead: Floats = ahead.astype(np.float32)[:, None]
        self._across: Floats = (slopes[None, :] * ahead[:, None]).astype(np.float32)
        self.color = self._paint(config, road, dryness, rng)
        row_length = ahead**2 / (camera.focal_px * camera.height_m)
        self._parts = self._make_parts(row_length, _draw_road_texture(config.light, road, rng))

    def _paint(self, config: SceneConfig, road: Road, dryness: float, rng: Rng) -> Image:
        """Asphalt, shoulder and grass in daylight and haze, or illuminated by the headlights."""
        light, across, ahead = config.light, self._across, self._ahead
        tone = rng.uniform(70, 118)
        asphalt = np.array([tone, tone, tone * rng.uniform(0.97, 1.05)], np.float32)
        grass = np.array([84, 90, 62] if dryness < 0.5 else [138, 121, 88], np.float32)
        blur = ahead / config.camera.focal_px * 1.2
        paved = _ramp(across, road.barrier - 2.2 - 3 * LANE, blur) - _ramp(across, road.verge, blur)
        # Tires polish two tracks in each lane, oil darkens its middle; the shoulder is paler.
        inside = _ramp(across, road.left, 0.3) - _ramp(across, road.right, 0.3)
        phase = (across - road.left) * np.float32(2 * np.pi / LANE)
        tracks = 0.03 * np.cos(phase) - 0.045 * np.cos(2 * phase)
        shade = paved * (1.12 + inside * (tracks - 0.12))
        color = shade[..., None] * asphalt + (1 - paved)[..., None] * grass
        # At a low angle the road reflects more of the sky.
        sheen = 1 + 0.12 * (1 - np.exp(-ahead / 60.0))
        clear = np.exp(-ahead / light.visibility)
        gain = (light.ambient + 0.75 * light.sun) * (0.8 if light.dark else 1.0)
        color *= (gain * sheen * clear)[..., None]
        color += light.haze * (1 - clear)[..., None]
        if light.dark:
            beam = np.exp(-((across / ahead / 0.33) ** 2)) * np.exp(-ahead / 30.0)
            color *= (0.13 + 0.95 * beam)[..., None]
        return np.asarray(np.clip(color, 0, 255), np.uint8)

    def _make_parts(self, row_length: Doubles, texture: Floats) -> list[_TexturedPart]:
        """Choose for each row, which covers `row_length` meters of road, the mipmap level of that length."""
        levels: list[Any] = [np.clip(texture * 128, 0, 255).astype(np.uint8)]
        while len(levels) < 7:
            size = (levels[-1].shape[1], levels[-1].shape[0] // 2)
            levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
        parts = []
        for level, rows in _mipmap_parts(row_length / _TILE_ALONG, len(levels)):
            map_x = ((self._across[rows] + _TILE_HALF_WIDTH) / _TILE_ACROSS - 0.5).astype(np.float32)
            map_y = (self._ahead[rows] / (_TILE_ALONG * 2**level) - 0.5).astype(np.float32)
            map_y = np.broadcast_to(map_y, map_x.shape)
            parts.append(_TexturedPart((rows, slice(None)), levels[level], map_x, map_y))
        return parts

    def apply_texture(self, ground: Image, travel: float) -> None:
        """Multiply the rows below the horizon, markings included, by the road texture in place."""
        gain = np.empty(ground.shape[:2], np.uint8)
        for region, texture, map_x, map_y in self._parts:
            y = map_y + np.float32(travel % _PERIOD / _PERIOD * texture.shape[0])
            cv2.remap(texture, map_x, y, cv2.INTER_LINEAR, dst=gain[region], borderMode=cv2.BORDER_WRAP)
        cv2.multiply(ground, cv2.merge([gain] * 3), dst=ground, scale=1 / 128)


def _ramp(values: Floats, edge: float, width: ArrayLike) -> Floats:
    """0 below an edge, 1 above it, linear over `width`."""
    return np.asarray(np.clip((values - np.float32(edge)) / np.maximum(width, 1e-3) + 0.5, 0, 1), np.float32)


def _draw_road_texture(light: Light, road: Road, rng: Rng) -> Floats:
    """Gain of the road's brightness over one period, seamless along the road (rows)."""
    size = (round(_PERIOD / _TILE_ALONG), round(2 * _TILE_HALF_WIDTH / _TILE_ACROSS))
    coarse, fine = wrapped_noise(rng, size, falloff=1.1, stretch=0.5), wrapped_noise(rng, size, falloff=0.2)
    edges = np.array([road.barrier - 2.2 - 3 * LANE, road.barrier, road.verge])
    outer, barrier, verge = ((edges + _TILE_HALF_WIDTH) / _TILE_ACROSS).astype(int).tolist()
    # Grass is far less even than asphalt.
    contrast = np.full(size[1], 0.16, np.float32)
    contrast[max(outer, 0) : verge] = 0.035
    texture = 1 + contrast * (coarse + fine)
    # Patches, seams and cracks in the asphalt on the camera's side of the barrier.
    paved = texture[:, barrier:verge]
    for _ in range(int(rng.integers(0, 5))):
        x, y = int(rng.integers(paved.shape[1])), int(rng.integers(size[0]))
        width, length = int(rng.uniform(1, 3.6) / _TILE_ACROSS), int(rng.uniform(3, 25) / _TILE_ALONG)
        paved[y : y + length, x : x + width] *= rng.uniform(0.82, 1.1)
    for _ in range(int(rng.integers(0, 6))):
        paved[int(rng.integers(size[0]))] *= rng.uniform(0.7, 0.9)
    for _ in range(int(rng.integers(0, 4))):
        crack = np.cumsum(rng.normal(0, 0.35, size[0]))
        crack -= np.linspace(0, crack[-1], size[0])
        x = np.clip(int(rng.integers(paved.shape[1])) + crack.astype(int), 0, paved.shape[1] - 1)
        paved[np.arange(size[0]), x] *= 0.75
    if light.sun > 0.2 and rng.random() < 0.5:
        texture *= _tree_shadows(light, size, rng)
    return np.asarray(texture, np.float32)


def _tree_shadows(light: Light, size: tuple[int, int], rng: Rng) -> Floats:
    """Gain of the shadows that trees cast across the road."""
    leaves = wrapped_noise(rng, size, falloff=1.0)
    y = np.arange(size[0], dtype=np.float32)[:, None] * _TILE_ALONG
    x = np.arange(size[1], dtype=np.float32)[None, :] * _TILE_ACROSS - _TILE_HALF_WIDTH
    cover = np.zeros(size, np.float32)
    side = -np.sign(light.to_sun[0])
    for _ in range(int(rng.integers(1, 4))):
        middle, length, reach = rng.uniform(12, _PERIOD - 12), rng.uniform(2, 7), rng.uniform(3, 16)
        inside = 1.6 - np.abs(y - middle - 0.3 * x) / length * 1.6
        inside -= np.clip((side * x - reach) / 3, -0.5, 4)
        cover = np.maximum(cover, np.clip(inside + 0.7 * leaves, 0, 1))
    return np.asarray(1 - 0.5 * cover, np.float32)


_HEDGE_ALONG, _HEDGE_UP = 0.15, 0.1  # meters per pixel of the hedge texture
_HEDGE_TOP = 6.4  # height of the hedge texture (m)


class Hedge:
    """Shrubs `lateral` meters beside the camera, `low` to `high` meters tall."""

    def __init__(
        self, config: SceneConfig, lateral: float, low: float, high: float, dryness: float, rng: Rng
    ) -> None:
        self._config, focal = config, config.camera.focal_px
        columns = np.arange(config.shape[1]) + 0.5 - config.center_px
        ahead = focal * lateral / np.where(np.abs(columns) < 0.25, 0.25, columns)
        levels = [_draw_foliage(low, high, dryness, config.light, rng)]
        while len(levels) < 6:
            size = (levels[-1].shape[1] // 2, max(levels[-1].shape[0] // (2 if len(levels) > 2 else 1), 4))
            levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA), np.float32))
        column_length = ahead**2 / (focal * abs(lateral))
        parts = _mipmap_parts(column_length / _HEDGE_ALONG, len(levels), (ahead > 6.0) & (ahead < 320.0))
        self._parts = [self._make_part(part, ahead[part], levels[level]) for level, part in parts]

    def _make_part(self, columns: slice, ahead: Doubles, texture: Floats) -> tuple[_TexturedPart, Floats]:
        """Columns of the image that show one mipmap level, and the gain of each."""
        camera, light = self._config.camera, self._config.light
        scale = camera.focal_px / ahead.min()
        first = camera.horizon_px - scale * (_HEDGE_TOP - camera.height_m)
        last = camera.horizon_px + scale * camera.height_m
        rows = slice(*np.clip([int(first) - 1, int(last) + 2], 0, self._config.shape[0]).tolist())
        slopes = (camera.horizon_px - np.arange(rows.start, rows.stop) - 0.5)[:, None] / camera.focal_px
        height = camera.height_m + slopes * ahead[None, :]
        map_y = ((_HEDGE_TOP - height) / _HEDGE_TOP * texture.shape[0] - 0.5).astype(np.float32)
        map_x = np.broadcast_to(ahead / _PERIOD * texture.shape[1] - 0.5, map_y.shape).astype(np.float32)
        gain = np.exp(-ahead / light.visibility) * [light.headlight_gain(float(z)) for z in ahead]
        return _TexturedPart((rows, columns), texture, map_x, map_y), gain.astype(np.float32)

    def draw(self, image: Image, travel: float) -> None:
        """Draw the hedge in place, `travel` meters into the drive."""
        haze = self._config.light.haze
        for (region, texture, map_x, map_y), gain in self._parts:
            shift = np.float32(travel % _PERIOD / _PERIOD * texture.shape[1])
            # The texture repeats along the road; above and below it the layer is empty.
            x = np.mod(map_x + shift, np.float32(texture.shape[1] - 1))
            layer = cv2.remap(texture, x, map_y, cv2.INTER_LINEAR)
            alpha = layer[..., 3:] * np.float32(1 / 255)
            color = layer[..., :3] * gain[:, None] + haze * (1 - gain[:, None]) * alpha
            image[region] = np.clip(alpha_over(image[region], color, alpha), 0, 255)


def _draw_foliage(low: float, high: float, dryness: float, light: Light, rng: Rng) -> Floats:
    """Paint a hedge as premultiplied RGBA: a ragged top, lit clumps, gaps."""
    size = (round(_HEDGE_TOP / _HEDGE_UP), round(_PERIOD / _HEDGE_ALONG))
    y = _HEDGE_TOP - (np.arange(size[0]) + 0.5)[:, None] * _HEDGE_UP
    ridge = wrapped_noise(rng, (1, size[1]), falloff=1.0)
    top = np.clip(low + (high - low) * (0.5 + 0.32 * ridge), 0.0, _HEDGE_TOP - 0.4)
    clumps = wrapped_noise(rng, (128, size[1]), falloff=1.1)[: size[0]]
    leaves = wrapped_noise(rng, (128, size[1]), falloff=0.4)[: size[0]]
    alpha = np.clip((top - y) * 2.2 + 0.55 * clumps + 0.5 * leaves, 0, 1)
    # The lower edge is ragged too: grass of different heights grows in front of it.
    alpha *= np.clip(y * 3.0 + 0.4 * clumps + 0.3 * leaves + 0.2, 0, 1)
    green = np.array([78, 90, 52]) * (1 - 0.6 * dryness) + np.array([112, 102, 68]) * 0.6 * dryness
    rise = np.clip(y / np.maximum(top, 0.5), 0, 1)
    gain = light.ambient * (0.6 + 0.25 * rise) + light.sun * 0.4 * np.clip(0.45 * clumps + 0.6 * rise, 0, 1.2)
    tone = np.clip(gain * (1 + 0.3 * leaves + 0.15 * clumps), 0.05, 1.5) * (0.35 if light.dark else 1.0)
    color = np.clip(green * tone[..., None], 0, 255) * alpha[..., None]
    return np.dstack([color, alpha * 255]).astype(np.float32)


def _draw_tree(rng: Rng, dryness: float, light: Light) -> tuple[Floats, float]:
    """Paint a tree as ``(192, W, 4)`` premultiplied RGBA, 0-255; also return its width over its height."""
    aspect_ratio = rng.uniform(0.55, 1.0)
    height, width = 192, round(192 * aspect_ratio)
    x: Floats = ((np.arange(width) + 0.5) / width * 2 - 1).astype(np.float32)[None, :]
    y: Floats = ((np.arange(height) + 0.5) / height).astype(np.float32)[:, None]
    crown, shade = _draw_crown(rng, x, y, light)
    leaves = wrapped_noise(rng, (256, 256), falloff=0.75)[:height, :width]
    twigs = wrapped_noise(rng, (256, 256), falloff=1.2)[:height, :width]
    alpha = np.clip((crown + 0.3 * leaves + 0.35 * twigs + 0.1) * 4, 0, 1)
    # The crown fades out before the border of the image, which would show as a vertical line.
    alpha *= np.clip((1 - np.abs(x)) * 10, 0, 1) * np.clip(y * 30, 0, 1) * np.clip((0.93 - y) * 14, 0, 1)
    trunk = np.clip((0.035 - np.abs(x + 0.05 * np.sin(6 * y))) * 60, 0, 1) * (y > 0.5) * (1 - alpha)
    hue = rng.uniform(0, 1)
    green = np.array([74, 88, 50]) * (1 - hue) + np.array([102, 98, 62]) * hue
    green = (green * (1 - 0.3 * dryness) + np.array([116, 104, 74]) * 0.3 * dryness).astype(np.float32)
    gain = light.ambient * 0.78 + light.sun * 0.55 * np.clip(shade, 0, 1.2) - 0.14 * np.clip(-shade, 0, 1)
    tone = np.clip(gain * (1 + 0.42 * leaves + 0.12 * twigs), 0.08, 1.6) * (0.35 if light.dark else 1.0)
    bark = np.array([70, 60, 50], np.float32) * (light.ambient * (0.4 if light.dark else 0.8))
    color = green * (tone * alpha)[..., None] + bark * trunk[..., None]
    return np.dstack([np.clip(color, 0, 255), (alpha + trunk) * 255]).astype(np.float32), aspect_ratio


def _draw_crown(rng: Rng, x: Floats, y: Floats, light: Light) -> tuple[Floats, Floats]:
    """Clusters of leaves: a map that is above 0 inside them, and one of the light on them."""
    crown = np.full((y.size, x.size), -3.0, np.float32)
    shade = np.zeros_like(crown)
    conical = rng.random() < 0.25
    for _ in range(int(rng.integers(9, 18))):
        level = rng.uniform(0.12, 0.72)
        spread = (0.15 + 0.75 * level) if conical else 0.62 * np.sin(np.pi * min(level / 0.85, 1)) ** 0.7
        middle, radius = rng.uniform(-spread, spread), rng.uniform(0.14, 0.3)
        cluster = 1 - (((x - middle) * 0.9) ** 2 + ((y - level) * 1.7) ** 2) / radius**2
        # Each cluster is lit from above and from the side of the sun.
        lit = (level - y) / radius * 0.9 + np.sign(light.to_sun[0]) * (x - middle) / radius * 0.4
        shade = np.where(cluster > crown, lit, shade)
        crown = np.maximum(crown, cluster)
    return np.asarray(crown, np.float32), np.asarray(shade, np.float32)


def _draw_sign(rng: Rng, light: Light) -> Floats:
    """Paint a road sign with a pale bar on its post as ``(128, 64, 4)`` premultiplied RGBA, 0-255."""
    sign = np.zeros((128, 64, 4), np.float32)
    faces = [(24, 86, 60), (38, 70, 132), (206, 168, 40), (220, 220, 216), (190, 40, 40)]
    gain = 1.8 if light.dark else 1.0
    post, pale, face = (
        (*np.clip(light.shade(color) * factor, 0, 255).tolist(), 255.0)
        for color, factor in (((120, 122, 124), 1.0), ((226, 226, 222), gain), (faces[rng.integers(5)], gain))
    )
    cv2.rectangle(sign, (30, 40), (33, 127), post, -1)
    if rng.random() < 0.5:
        cv2.rectangle(sign, (6, 6), (57, 48), face, -1, cv2.LINE_AA)
    else:
        cv2.circle(sign, (32, 30), 26, face, -1, cv2.LINE_AA)
    cv2.line(sign, (16, 29), (48, 29), pale, 4)
    return sign


def draw_layer(image: Image, rgba: Floats, light: Light, distance: float, *, offset: float = 0.0) -> None:
    """Composite premultiplied RGBA at a distance (m) over an image in place; an `offset` of 0.5 rounds."""
    clear = light.transmission(distance)
    alpha = rgba[..., 3:] / 255
    color = rgba[..., :3] * (clear * light.headlight_gain(distance)) + light.haze * (1 - clear) * alpha
    image[:] = np.clip(alpha_over(image, color, alpha) + offset, 0, 255)


class Canvas(NamedTuple):
    """An image to fill polygons in, and the map of the vehicle that each pixel shows."""

    config: SceneConfig
    image: Image | None
    instance_map: NDArray[np.int32] | None = None

    def fill(self, corners: Doubles, color: Doubles) -> None:
        """Fill a polygon of ``(column, row)`` corners; it hides the vehicles behind it."""
        points = [np.rint((corners - 0.5) * 16).astype(np.int32)]
        if self.image is not None:
            cv2.fillPoly(self.image, points, np.clip(color, 0, 255).tolist(), cv2.LINE_AA, 4)
        if self.instance_map is not None:
            cv2.fillPoly(self.instance_map, points, 0, cv2.LINE_8, 4)


class _Prop(NamedTuple):
    """An upright object beside the road: premultiplied RGBA, position and size in meters."""

    rgba: Floats
    lateral: float
    ahead: float
    width: float
    height: float


_PROP_PERIOD = 240.0  # length after which trees and signs repeat (m)
_MARKING_END = 400.0  # distance up to which markings and barriers are drawn (m)
# Lower and upper edge (m) and gray value of the bands that a barrier consists of.
_RAIL_BANDS = ((0.46, 0.54, 108), (0.54, 0.6, 136), (0.6, 0.64, 100), (0.64, 0.71, 128), (0.71, 0.76, 150))
_WALL_BANDS = ((0.0, 0.07, 74), (0.07, 0.3, 150), (0.3, 0.55, 136), (0.55, 0.8, 142), (0.8, 0.85, 186))


class Scenery:
    """Everything in a scene except the vehicles."""

    def __init__(self, config: SceneConfig, road: Road) -> None:
        self.config, self.road = config, road
        rng = np.random.default_rng([config.seed, 3])
        dryness = rng.random()
        self._has_wall = rng.random() < 0.65
        self._has_right_rail = rng.random() < 0.4
        wear = rng.uniform(0.8, 1.0)
        self._white = np.array([222, 222, 216]) * wear
        self._left_line = np.array([206, 158, 46]) * wear if rng.random() < 0.5 else self._white
        self._backdrop = draw_backdrop(config, dryness, rng)
        self._ground = Ground(config, road, dryness, rng)
        # Rows of shrubs on both sides, tall ones behind low ones.
        right, left = road.verge, road.barrier - 3 * LANE - 5.0
        rows = [(right + 11.0, 1.5, 6.5), (left - 7.0, 1.5, 6.5), (right + rng.uniform(4, 7), -1.2, 1.8)]
        self._hedges = [Hedge(config, *row, dryness, rng) for row in rows if rng.random() < 0.65]
        self._props = self._make_props(dryness, rng)

    def render(self, travel: float) -> Image:
        """Draw the road without vehicles and barrier, `travel` meters into the drive."""
        image = self._backdrop.copy()
        ground = image[self._ground.first :]
        if len(ground):
            ground[:] = self._ground.color
            self._draw_markings(Canvas(self.config, image), travel)
            self._ground.apply_texture(ground, travel)
        for hedge in self._hedges:
            hedge.draw(image, travel)
        props = [((prop.ahead - travel) % _PROP_PERIOD, prop) for prop in self._props]
        for ahead, prop in sorted(props, key=lambda pair: -pair[0]):
            if ahead > 4.0:
                self._draw_prop(image, prop, ahead)
        if self._has_right_rail:
            self._draw_rail(Canvas(self.config, image), self.road.verge + 0.4, travel)
        return image

    def draw_barrier(self, canvas: Canvas, travel: float) -> None:
        """Draw the barrier in front of the oncoming lanes in place."""
        x, light = self.road.barrier, self.config.light
        if not self._has_wall:
            self._draw_rail(canvas, x, travel)
            return
        # The visible face points to the right: it is in the shade when the sun is on the left.
        gain = 0.62 if light.to_sun[0] < 0 and light.sun > 0.2 else 1.0
        for low, high, tone in _WALL_BANDS:
            base_width = 0.2 * max(0.0, (0.45 - low) / 0.45)
            shade = tone * (gain if high < 0.82 else 1.0)
            self._draw_wall(canvas, x + base_width, low, high, np.array([1.0, 0.99, 0.95]) * shade)
        self._draw_posts(canvas, x, travel, every=6.0, top=0.8, width=0.03, color=(86, 85, 82))

    def _draw_markings(self, canvas: Canvas, travel: float) -> None:
        """Solid lines at both edges, dashed lines between the lanes."""
        road, period = self.road, 12.0
        self._draw_line(canvas, road.left + 0.2, 0.0, _MARKING_END, self._left_line)
        self._draw_line(canvas, road.right - 0.2, 0.0, _MARKING_END, self._white)
        inner = [road.left + lane * LANE for lane in range(1, road.lanes)]
        for x in (*inner, road.barrier - 1.4 - LANE, road.barrier - 1.4 - 2 * LANE):
            for start in np.arange(-(travel % period), 160, period):
                self._draw_line(canvas, x, float(start), float(start) + 3.6, self._white)

    def _draw_line(self, canvas: Canvas, x: float, start: float, stop: float, color: Doubles) -> None:
        """Draw a line along the road."""
        camera, light = self.config.camera, self.config.light
        nearest = camera.focal_px * camera.height_m / (self.config.shape[0] - camera.horizon_px) * 0.9
        first, last = max(start, nearest), min(stop, _MARKING_END)
        if last - first >= 0.05:
            pieces = 2 + int(np.log2(last / first) * 2)
            sides = ([x - 0.075, x + 0.075, x + 0.075, x - 0.075], 0.0)
            self._draw_strip(canvas, sides, first, last, pieces, color * (1.6 if light.dark else 1.0))

    def _draw_wall(self, canvas: Canvas, x: float, low: float, high: float, color: ArrayLike) -> None:
        """Draw an upright band along the road."""
        first = max(abs(x) / ((canvas.config.shape[1] / 2 + 40) / canvas.config.camera.focal_px), 1.2)
        sides = (x, [low, high, high, low])
        self._draw_strip(canvas, sides, first, max(_MARKING_END, 2 * first), 14, color)

    @staticmethod
    def _draw_strip(
        canvas: Canvas, sides: tuple[Any, Any], first: float, last: float, pieces: int, color: ArrayLike
    ) -> None:
        """Draw a strip along the road in pieces, because haze and headlights change along it."""
        for near, far in pairwise(np.geomspace(first, last, pieces)):
            corners = canvas.config.project(*sides, [near, near, far, far])
            canvas.fill(corners, canvas.config.light.shade(color, float(np.sqrt(near * far))))

    def _draw_posts(
        self, canvas: Canvas, x: float, travel: float, *, every: float, top: float, width: float,
        color: ArrayLike,
    ) -> None:  # fmt: skip
        """Draw upright posts along the road, far ones first."""
        config = canvas.config
        for ahead in np.arange(20 * every - travel % every, 2.5, -every):
            (x1, y1), (x2, y2) = config.project(x, [0.0, top], ahead)
            half = max(width * config.camera.focal_px / ahead / 2, 0.35)
            if x1 + half >= 0 and x1 - half <= config.shape[1]:
                corners = np.array([(x1 - half, y1), (x1 + half, y1), (x2 + half, y2), (x2 - half, y2)])
                canvas.fill(corners, config.light.shade(color, float(ahead)))

    def _draw_rail(self, canvas: Canvas, x: float, travel: float) -> None:
        """Draw a guard rail on posts: a steel beam with two bulges, lit from above."""
        self._draw_posts(canvas, x + 0.1, travel, every=4.0, top=0.72, width=0.12, color=(92, 92, 92))
        for low, high, tone in _RAIL_BANDS:
            self._draw_wall(canvas, x, low, high, (tone, tone, tone + 2))

    def _make_props(self, dryness: float, rng: Rng) -> list[_Prop]:
        """Trees and bushes on both sides, signs on the right."""
        trees = [_draw_tree(rng, dryness, self.config.light) for _ in range(5)]
        density = rng.uniform(0.35, 1.0)
        verge = self.road.verge
        props = []
        for side, base in ((1, verge + 3.0), (-1, self.road.barrier - 3 * LANE - 5.0)):
            for ahead in np.arange(0, _PROP_PERIOD, 6.0):
                if rng.random() > density:
                    continue
                rgba, aspect_ratio = trees[int(rng.integers(len(trees)))]
                bush = rng.random() < 0.35
                height = float(rng.uniform(1.2, 2.6) if bush else rng.uniform(4.5, 13))
                width = height * aspect_ratio * rng.uniform(0.8, 1.25) * (1.5 if bush else 1.0)
                lateral = base + side * float(rng.uniform(0, 3) if bush else rng.uniform(2, 16))
                rgba = rgba[:, ::-1] if rng.random() < 0.5 else rgba
                props.append(_Prop(rgba, lateral, float(ahead + rng.uniform(0, 5)), width, height))
        signs = [float(ahead) for ahead in np.arange(0, _PROP_PERIOD, 60.0) if rng.random() < 0.35]
        light = self.config.light
        return props + [_Prop(_draw_sign(rng, light), verge + 2.2, ahead, 1.2, 2.4) for ahead in signs]

    def _draw_prop(self, image: Image, prop: _Prop, ahead: float) -> None:
        scale = self.config.camera.focal_px / ahead
        width, height = round(prop.width * scale), round(prop.height * scale)
        middle, bottom = self.config.project(prop.lateral, 0.0, ahead).tolist()
        left, top = round(middle - width / 2), round(bottom) - height
        x1, x2 = max(left, 0), min(left + width, image.shape[1])
        y1, y2 = max(top, 0), min(top + height, image.shape[0])
        if min(width, height) < 2 or x1 >= x2 or y1 >= y2:
            return
        sx, sy = prop.rgba.shape[1] / width, prop.rgba.shape[0] / height
        if sx > 1 and sy > 1:
            rgba = cv2.resize(prop.rgba, (width, height), interpolation=cv2.INTER_AREA)
            rgba = rgba[y1 - top : y2 - top, x1 - left : x2 - left]
        else:
            # A near tree is far larger than the frame: only the visible part is resampled.
            matrix = np.array([[sx, 0, (x1 - left + 0.5) * sx - 0.5], [0, sy, (y1 - top + 0.5) * sy - 0.5]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            rgba = cv2.warpAffine(prop.rgba, matrix, (x2 - x1, y2 - y1), flags=flags)
        draw_layer(image[y1:y2, x1:x2], np.asarray(rgba, np.float32), self.config.light, ahead)
