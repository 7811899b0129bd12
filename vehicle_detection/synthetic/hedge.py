"""Shrubs along the road: an upright sheet of foliage that passes by."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole, wrapped_noise

_PERIOD = 96.0
_ALONG, _UP = 0.15, 0.1
_TALLEST = 6.4
_NEAREST, _FARTHEST = 6.0, 320.0
_LEVELS = 6


class _Strip(NamedTuple):
    """Columns of the picture that show the hedge in one level of detail."""

    columns: slice
    rows: slice
    map_x: Floats
    map_y: Floats
    sheet: Floats
    haze: Floats


class Hedge:
    """Shrubs at `lateral` metres beside the road, between `low` and `high` metres tall."""

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
        level = np.log2(np.maximum(ahead**2 / (camera.focal_px * abs(lateral)) / _ALONG, 1))
        sheets = [_draw_sheet(low, high, dry, light, rng)]
        while len(sheets) < _LEVELS:
            size = (sheets[-1].shape[1] // 2, max(sheets[-1].shape[0] // (2 if len(sheets) > 2 else 1), 4))
            sheets.append(np.asarray(cv2.resize(sheets[-1], size, interpolation=cv2.INTER_AREA), np.float32))
        chosen = np.clip(np.rint(level), 0, _LEVELS - 1).astype(int)
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
        map_x = np.broadcast_to(ahead / _PERIOD * sheet.shape[1] - 0.5, map_y.shape)
        clear = np.exp(-ahead / self._light.visibility) * [self._light.reach(float(z)) for z in ahead]
        return _Strip(
            columns, rows, map_x.astype(np.float32), map_y.astype(np.float32), sheet, clear.astype(np.float32)
        )

    def draw(self, image: NDArray[np.uint8], travel: float) -> None:
        """Draw the hedge, `travel` metres into the drive, in place."""
        for columns, rows, map_x, map_y, sheet, clear in self._strips:
            shift = np.float32(travel % _PERIOD / _PERIOD * sheet.shape[1])
            # The sheet repeats along the road; above its top and below its foot it is empty.
            x = np.mod(map_x + shift, np.float32(sheet.shape[1] - 1))
            seen = cv2.remap(sheet, x, map_y, cv2.INTER_LINEAR)
            alpha = seen[..., 3:] * np.float32(1 / 255)
            color = seen[..., :3] * clear[:, None] + self._light.haze * (1 - clear[:, None]) * alpha
            part = image[rows, columns]
            part[:] = np.clip(part * (1 - alpha) + color, 0, 255)


def _draw_sheet(low: float, high: float, dry: float, light: Light, rng: np.random.Generator) -> Floats:
    """Paint foliage as premultiplied RGBA: a ragged top, lit clumps, gaps."""
    size = (round(_TALLEST / _UP), round(_PERIOD / _ALONG))
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
