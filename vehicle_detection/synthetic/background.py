"""What stays where it is along a drive: sky, clouds, hills and the far line of trees."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole, wrapped_noise


def draw_backdrop(
    shape: tuple[int, int], camera: Pinhole, light: Light, dry: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Draw everything above the horizon into an ``(H, W, 3)`` uint8 picture; below it is black."""
    height, width = shape
    # A row beyond the horizon, so that the ground meets no gap.
    rows = min(height, int(camera.horizon_px) + 2)
    image = np.zeros((height, width, 3), np.uint8)
    if rows > 0:
        sky = _draw_sky((rows, width), camera, light, rng)
        for layer in range(3):
            if layer == 2 or rng.random() < 0.75:
                _draw_hills(sky, camera, light, dry, layer, rng)
        _draw_treeline(sky, camera, light, rng)
        image[:rows] = np.clip(sky, 0, 255)
    return image


def _draw_sky(shape: tuple[int, int], camera: Pinhole, light: Light, rng: np.random.Generator) -> Floats:
    height, width = shape
    rise = np.clip(1 - (np.arange(height) + 0.5) / max(camera.horizon_px, 1), 0, 1) ** 0.8
    low, top = np.asarray(light.sky_low, np.float32), np.asarray(light.sky_top, np.float32)
    sky = np.repeat((low + (top - low) * rise[:, None]).astype(np.float32)[:, None], width, axis=1)
    noise = wrapped_noise(rng, (128, 256), falloff=1.7, stretch=2.6)
    cloud = cv2.resize(noise[:80], (width, height), interpolation=cv2.INTER_CUBIC)
    cover = np.clip((cloud - rng.uniform(0.3, 1.6)) * 0.7, 0, 1)[..., None] * (0.3 if light.dark else 0.8)
    white = np.minimum(low * 1.15 + 14, 250)
    sky += cover * (white - sky)
    return sky


def _below(edge: NDArray[np.float64], rows: int) -> Floats:
    """Cover, 0-1, of what lies under a line given by its row in each column."""
    cover = np.clip(np.arange(rows)[:, None] + 0.5 - edge[None, :], 0, 1)
    return np.asarray(cover[..., None], np.float32)


def _texture(rng: np.random.Generator, shape: tuple[int, ...], falloff: float) -> Floats:
    tile = wrapped_noise(rng, (256, 256), falloff=falloff)
    turns = (shape[0] // 256 + 1, shape[1] // 256 + 1)
    return np.tile(tile, turns)[: shape[0], : shape[1], None]


def _draw_hills(
    sky: Floats, camera: Pinhole, light: Light, dry: float, layer: int, rng: np.random.Generator
) -> None:
    """One range of hills in place, the bluer the farther; layer 0 is the farthest."""
    rows, width = sky.shape[:2]
    tall = rng.uniform(0.02, 0.06) / (1 + 0.5 * layer) * camera.focal_px
    ridge = wrapped_noise(rng, (1, 512), falloff=1.6)[0]
    ridge = (ridge - ridge.min()) / (ridge.max() - ridge.min() + 1e-6)
    line = np.interp(np.linspace(0, 300, width), np.arange(512), ridge)
    edge = camera.horizon_px - tall * (0.25 + 0.75 * line)
    first = max(int(edge.min()) - 1, 0)
    part = sky[first:]
    clear = 0.9 if light.dark else 0.35 + 0.25 * layer
    ground = light.on((70, 82, 62) if dry < 0.5 else (112, 100, 74))
    base = ground * clear + light.haze * np.array([0.73, 0.79, 0.85]) * (1 - clear)
    hill = base.astype(np.float32) * (1 + 0.09 * _texture(rng, part.shape, 0.9))
    part += _below(edge - first, rows - first) * (hill - part)


def _draw_treeline(sky: Floats, camera: Pinhole, light: Light, rng: np.random.Generator) -> None:
    """Far trees on both sides in place, lower towards the point where the road vanishes."""
    rows, width = sky.shape[:2]
    columns = (np.arange(width) + 0.5 - camera.center_px) / camera.focal_px
    rough = wrapped_noise(rng, (1, 1024), falloff=1.0)[0]
    fine = np.interp(np.linspace(0, 700, width), np.arange(1024), rough)
    distance = 170.0 + 160.0 * np.exp(-((columns / 0.08) ** 2))
    tall = np.clip(6.0 + 2.6 * fine, 1.5, 14) * camera.focal_px / distance
    edge = camera.horizon_px - tall
    first = max(int(edge.min()) - 1, 0)
    part = sky[first:]
    down = np.arange(first, rows)[:, None] - edge[None, :]
    depth = np.clip(down / np.maximum(tall, 1), 0, 1)[..., None].astype(np.float32)
    leaves = _texture(rng, part.shape, 0.75)
    green = light.on((66, 78, 50), 60.0).astype(np.float32) * (1.1 - 0.45 * depth) * (1 + 0.28 * leaves)
    part += _below(edge - first, rows - first) * (green - part)
