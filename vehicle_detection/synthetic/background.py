"""The static part of a scene above the road: sky, clouds, hills and a distant tree line."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.camera_light import SceneConfig
from vehicle_detection.synthetic.raster import Floats, Image, blend, tile_to, wrapped_noise


def draw_backdrop(config: SceneConfig, dryness: float, rng: np.random.Generator) -> Image:
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


def _draw_sky(height: int, config: SceneConfig, rng: np.random.Generator) -> Floats:
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


def _draw_hills(
    sky: Floats, config: SceneConfig, dryness: float, layer: int, rng: np.random.Generator
) -> None:
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
    first = max(int(edge.min()) - 1, 0)
    part = sky[first:]
    hills = color.astype(np.float32) * (1 + 0.09 * _texture(rng, part.shape, 0.9))
    blend(part, hills, _mask_below(edge - first, len(part)))


def _draw_tree_line(sky: Floats, config: SceneConfig, rng: np.random.Generator) -> None:
    """Draw distant trees in place, lower towards the vanishing point of the road."""
    width, camera = sky.shape[1], config.camera
    slopes = (np.arange(width) + 0.5 - config.center_px) / camera.focal_px
    noise = np.interp(
        np.linspace(0, 700, width), np.arange(1024), wrapped_noise(rng, (1, 1024), falloff=1.0)[0]
    )
    distance = 170.0 + 160.0 * np.exp(-((slopes / 0.08) ** 2))
    height = np.clip(6.0 + 2.6 * noise, 1.5, 14) * camera.focal_px / distance
    edge = camera.horizon_px - height
    first = max(int(edge.min()) - 1, 0)
    part = sky[first:]
    below = np.arange(first, len(sky))[:, None] - edge[None, :]
    depth = np.clip(below / np.maximum(height, 1), 0, 1)[..., None].astype(np.float32)
    leaves = _texture(rng, part.shape, 0.75)
    green = config.light.shade((66, 78, 50), 60.0).astype(np.float32)
    blend(part, green * (1.1 - 0.45 * depth) * (1 + 0.28 * leaves), _mask_below(edge - first, len(part)))


def _mask_below(edge: NDArray[np.float64], rows: int) -> Floats:
    """Antialiased mask ``(rows, W, 1)`` of what lies below a line given by its row in each column."""
    mask = np.clip(np.arange(rows)[:, None] + 0.5 - edge[None, :], 0, 1)
    return np.asarray(mask[..., None], np.float32)


def _texture(rng: np.random.Generator, shape: tuple[int, ...], falloff: float) -> Floats:
    """Noise ``(H, W, 1)`` for an image of a shape."""
    return tile_to(wrapped_noise(rng, (256, 256), falloff=falloff), shape[0], shape[1])[..., None]
