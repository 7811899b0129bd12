"""What stands beside the road: trees, bushes and signs, painted from noise."""

from __future__ import annotations

import cv2
import numpy as np

from vehicle_detection.synthetic.camera_light import Floats, Light, wrapped_noise

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
