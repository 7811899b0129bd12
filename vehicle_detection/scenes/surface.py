"""Drawing on the surfaces of a vehicle body, in meters."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection.scenes.raster import Doubles, Floats, blend

PIXELS_PER_METER = 112


@dataclass(frozen=True, eq=False)
class Surface:
    """A painted surface: ``(H, W, 4)`` premultiplied RGBA, 0-255."""

    rgba: Floats
    left: float  # position of the upper left corner (m)
    top: float
    depth: Floats | None = None  # (H, W) distance behind the nearest point (m)
    _mipmaps: dict[tuple[int, ...], Floats] = field(default_factory=dict, init=False)

    def mipmap(self, x_ratio: float, y_ratio: float) -> tuple[Floats, float, float]:
        """Return the surface reduced by up to these ratios, and its pixels per meter along x and y."""
        steps = [int(np.clip(np.log2(max(ratio, 1.0)) + 0.25, 0, 6)) for ratio in (x_ratio, y_ratio)]
        height, width = self.rgba.shape[:2]
        size = (max(1, width >> steps[0]), max(1, height >> steps[1]))
        if size not in self._mipmaps:
            rgba = cv2.resize(self.rgba, size, interpolation=cv2.INTER_AREA) if any(steps) else self.rgba
            self._mipmaps[size] = np.asarray(rgba, np.float32)
        return self._mipmaps[size], PIXELS_PER_METER * size[0] / width, PIXELS_PER_METER * size[1] / height


@dataclass(frozen=True, eq=False)
class Mask:
    """Coverage of pixels by a shape, 0-1, in the part of a canvas where the shape lies."""

    values: Floats
    region: tuple[slice, slice]  # rows and columns of the part
    size: tuple[int, int]  # of the canvas

    def _aligned(self, other: Mask) -> Floats:
        """Values of another mask in this region, 0 where the other does not reach."""
        values = np.zeros(self.size, np.float32)
        values[other.region] = other.values
        return values[self.region]

    def __and__(self, other: Mask) -> Mask:
        return replace(self, values=self.values * self._aligned(other))

    def __sub__(self, other: Mask) -> Mask:
        return replace(self, values=np.maximum(self.values - self._aligned(other), 0))


class SurfaceCanvas:
    """A canvas from `left` to `right` and `low` to `top` in meters, to paint polygons on."""

    def __init__(self, left: float, right: float, low: float, top: float) -> None:
        ppm = PIXELS_PER_METER
        self.left, self.top = left, top
        height, width = self.size = round((top - low) * ppm), round((right - left) * ppm)
        columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
        self.x: Floats = np.asarray(left + (columns[None, :] + 0.5) / ppm, np.float32)
        self.y: Floats = np.asarray(top - (rows[:, None] + 0.5) / ppm, np.float32)
        self.color: Floats = np.zeros((*self.size, 3), np.float32)
        self.alpha: Floats = np.zeros(self.size, np.float32)

    def polygon(self, points: ArrayLike, *, soften: float = 0.0) -> Mask:
        """Mask of a polygon of ``(x, y)`` points, blurred by `soften` meters."""
        corners = (np.asarray(points, np.float64) - (self.left, self.top)) * (1, -1) * PIXELS_PER_METER - 0.5
        margin = 2 + int(3 * soften * PIXELS_PER_METER)
        x1, y1 = np.maximum(np.floor(corners.min(0)).astype(int) - margin, 0).tolist()
        x2, y2 = np.minimum(np.ceil(corners.max(0)).astype(int) + margin + 1, self.size[::-1]).tolist()
        filled = np.zeros((y2 - y1, x2 - x1), np.uint8)
        cv2.fillPoly(filled, [np.rint((corners - (x1, y1)) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        values = filled.astype(np.float32) / 255
        if soften:
            values = cv2.GaussianBlur(values, (0, 0), soften * PIXELS_PER_METER)  # type: ignore[assignment]
        return Mask(np.asarray(values, np.float32), (slice(y1, y2), slice(x1, x2)), self.size)

    def between(self, left: Doubles, right: Doubles, y: Doubles, *, soften: float = 0.0) -> Mask:
        """Mask of the area between two curves, given by their `x` at ascending heights `y`."""
        outline = np.column_stack([np.append(left, right[::-1]), np.append(y, y[::-1])])
        return self.polygon(outline, soften=soften)

    def box(self, x: float, y: float, width: float, height: float, *, radius: float = 0.0) -> Mask:
        """Mask of a box centered at ``(x, y)`` with rounded corners."""
        w, h = width / 2, height / 2
        corners = [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]
        return self.polygon(round_corners(corners, radius))

    def paint(self, mask: Mask, color: ArrayLike, opacity: float = 1.0) -> None:
        """Composite a color, or an ``(H, W, 3)`` image of colors, under a mask."""
        paint = np.asarray(color, np.float32)
        if paint.ndim == 3:
            paint = np.broadcast_to(paint, self.color.shape)[mask.region]
        blend(self.color[mask.region], paint, (mask.values * opacity)[..., None])

    def multiply(self, mask: Mask, gain: float) -> None:
        """Multiply the color under a mask by `gain`."""
        self.color[mask.region] *= (1 + mask.values * (gain - 1))[..., None]

    def make_opaque(self, mask: Mask) -> None:
        """Add a mask to the opaque part of the canvas."""
        alpha = self.alpha[mask.region]
        np.maximum(alpha, mask.values, out=alpha)

    def surface(self, depth: Floats | None = None) -> Surface:
        """Return what has been painted."""
        color = np.clip(self.color, 0, 255) * self.alpha[..., None]
        return Surface(np.dstack([color, self.alpha * 255]), self.left, self.top, depth)


def round_corners(corners: ArrayLike, radius: float) -> Doubles:
    """Replace each corner of a polygon by a curve that starts `radius` before it."""
    points = np.asarray(corners, np.float64)
    if radius <= 0:
        return points
    t = np.linspace(0, 1, 7)[:, None]
    curves = []
    for before, corner, after in zip(np.roll(points, 1, 0), points, np.roll(points, -1, 0)):
        start, end = (
            corner + (other - corner) * min(0.5, radius / max(float(np.linalg.norm(other - corner)), 1e-9))
            for other in (before, after)
        )
        curves.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(curves)
