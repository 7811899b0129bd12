"""The road's surface and the verge: colours that stay, and a grain that passes beneath the camera."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole, wrapped_noise
from vehicle_detection.synthetic.road import LANE, Road

_PERIOD = 96.0
_ACROSS = 0.1
_ALONG = 0.12
_HALF = 28.0
_LEVELS = 7


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
        while len(levels) < _LEVELS:
            size = (levels[-1].shape[1], levels[-1].shape[0] // 2)
            levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))  # type: ignore[arg-type]
        chosen = np.clip(np.rint(np.log2(np.maximum(step / _ALONG, 1))), 0, _LEVELS - 1).astype(int)
        bands = []
        for number, level in enumerate(levels):
            here = np.flatnonzero(chosen == number)
            if len(here):
                rows = slice(int(here[0]), int(here[-1]) + 1)
                map_x = (self._across[rows] + _HALF) / _ACROSS - 0.5
                map_y = np.broadcast_to(self._ahead[rows] / (_ALONG * 2**number) - 0.5, map_x.shape)
                bands.append(_Band(rows, map_x.astype(np.float32), map_y.astype(np.float32), level))
        return bands

    def wear(self, ground: NDArray[np.uint8], travel: float) -> None:
        """Give the rows below the horizon, lines and all, their grain, in place."""
        grain = np.empty(ground.shape[:2], np.uint8)
        for rows, map_x, map_y, tile in self._bands:
            shift = np.float32(travel % _PERIOD / _PERIOD * tile.shape[0])
            cv2.remap(
                tile, map_x, map_y + shift, cv2.INTER_LINEAR, dst=grain[rows], borderMode=cv2.BORDER_WRAP
            )
        cv2.multiply(ground, cv2.merge([grain] * 3), dst=ground, scale=1 / 128)


def _ramp(values: Floats, edge: float, width: ArrayLike) -> Floats:
    """0 below an edge, 1 above it, linear over `width`."""
    return np.asarray(np.clip((values - np.float32(edge)) / np.maximum(width, 1e-3) + 0.5, 0, 1), np.float32)


def _draw_tile(light: Light, road: Road, rng: np.random.Generator) -> Floats:
    """Gain of the road's brightness over one period, seamless along the road."""
    size = (round(_PERIOD / _ALONG), round(2 * _HALF / _ACROSS))
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
        width, length = int(rng.uniform(1, 3.6) / _ACROSS), int(rng.uniform(3, 25) / _ALONG)
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
    y = np.arange(size[0], dtype=np.float32)[:, None] * _ALONG
    x = np.arange(size[1], dtype=np.float32)[None, :] * _ACROSS - _HALF
    cover = np.zeros(size, np.float32)
    side = -np.sign(light.to_sun[0])
    for _ in range(int(rng.integers(1, 4))):
        place, wide, far = rng.uniform(12, _PERIOD - 12), rng.uniform(2, 7), rng.uniform(3, 16)
        inside = 1.6 - np.abs(y - place - 0.3 * x) / wide * 1.6
        inside -= np.clip((side * x - far) / 3, -0.5, 4)
        cover = np.maximum(cover, np.clip(inside + 0.7 * leaf, 0, 1))
    return np.asarray(1 - 0.5 * cover, np.float32)
