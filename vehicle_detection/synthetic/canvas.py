"""A sheet in metres to paint a vehicle's surface on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic.camera_light import Floats

PIXELS_PER_METRE = 112

Outline = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """A painted surface: ``(H, W, 4)`` premultiplied RGBA, 0-255, and the metres of its upper left corner."""

    rgba: Floats
    left: float
    top: float
    depth: Floats | None = None


@dataclass(frozen=True, eq=False)
class Cover:
    """How much a shape covers of each pixel, 0-1, in the part of the sheet where it lies."""

    values: Floats
    top: int
    left: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Rows and columns of the part."""
        height, width = self.values.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)

    def _aligned(self, other: Cover) -> Floats:
        """Give the other's values where this one lies, 0 outside it."""
        sheet = np.zeros_like(self.values)
        y1, x1 = max(self.top, other.top), max(self.left, other.left)
        y2 = min(self.top + self.values.shape[0], other.top + other.values.shape[0])
        x2 = min(self.left + self.values.shape[1], other.left + other.values.shape[1])
        if y1 < y2 and x1 < x2:
            inside = other.values[y1 - other.top : y2 - other.top, x1 - other.left : x2 - other.left]
            sheet[y1 - self.top : y2 - self.top, x1 - self.left : x2 - self.left] = inside
        return sheet

    def within(self, other: Cover) -> Cover:
        """Return the part that lies in another cover."""
        return Cover(self.values * self._aligned(other), self.top, self.left)

    def without(self, other: Cover) -> Cover:
        """Return what another cover leaves of it."""
        return Cover(np.maximum(self.values - self._aligned(other), 0), self.top, self.left)

    def __mul__(self, gain: Floats) -> Cover:
        """Thin it out by a gain for the whole sheet."""
        return Cover(self.values * gain[self.place], self.top, self.left)


class Easel:
    """A sheet in metres, `left`..`right` by `low`..`top`, to paint polygons on."""

    def __init__(self, left: float, right: float, low: float, top: float) -> None:
        ppm = PIXELS_PER_METRE
        self.left, self.top = left, top
        self.size = (round((top - low) * ppm), round((right - left) * ppm))
        self.x: Floats = (left + (np.arange(self.size[1], dtype=np.float32) + 0.5) / ppm)[None, :].astype(
            np.float32
        )
        self.y: Floats = (top - (np.arange(self.size[0], dtype=np.float32) + 0.5) / ppm)[:, None].astype(
            np.float32
        )
        self.color: Floats = np.zeros((*self.size, 3), np.float32)
        self.alpha: Floats = np.zeros(self.size, np.float32)

    def mask(self, points: ArrayLike, *, soften: float = 0.0) -> Cover:
        """Cover of a polygon of ``(x, y)`` points, its edge softened by some metres."""
        corners = (np.asarray(points, np.float64) - (self.left, self.top)) * (1, -1) * PIXELS_PER_METRE - 0.5
        margin = 2 + int(3 * soften * PIXELS_PER_METRE)
        x1, y1 = np.maximum(np.floor(corners.min(0)).astype(int) - margin, 0).tolist()
        x2, y2 = np.minimum(np.ceil(corners.max(0)).astype(int) + margin + 1, self.size[::-1]).tolist()
        if x1 >= x2 or y1 >= y2:
            return Cover(np.zeros((0, 0), np.float32), 0, 0)
        sheet = np.zeros((y2 - y1, x2 - x1), np.uint8)
        cv2.fillPoly(sheet, [np.rint((corners - (x1, y1)) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
        cover = sheet.astype(np.float32) / 255
        if soften:
            cover = cv2.GaussianBlur(cover, (0, 0), soften * PIXELS_PER_METRE)  # type: ignore[assignment]
        return Cover(np.asarray(cover, np.float32), y1, x1)

    def box(self, x: float, y: float, width: float, height: float, *, round_by: float = 0.0) -> Cover:
        """Cover of a box around ``(x, y)`` with rounded corners."""
        w, h = width / 2, height / 2
        corners = [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]
        return self.mask(rounded(corners, round_by))

    def paint(self, cover: Cover, color: ArrayLike, strength: float = 1.0) -> None:
        """Lay a colour, or a sheet of colours, over what is there."""
        paint = np.asarray(color, np.float32)
        if paint.ndim == 3:
            paint = np.broadcast_to(paint, self.color.shape)[cover.place]
        part = self.color[cover.place]
        part += (cover.values * strength)[..., None] * (paint - part)

    def dim(self, cover: Cover, gain: float) -> None:
        """Multiply what is there by `gain` under a cover."""
        self.color[cover.place] *= (1 + cover.values * (gain - 1))[..., None]

    def show(self, cover: Cover) -> None:
        """Make the sheet opaque under a cover."""
        part = self.alpha[cover.place]
        np.maximum(part, cover.values, out=part)

    def surface(self, depth: Floats | None = None) -> Surface:
        """Return what has been painted."""
        color = np.clip(self.color, 0, 255) * self.alpha[..., None]
        return Surface(np.dstack([color, self.alpha * 255]), self.left, self.top, depth)


def rounded(corners: ArrayLike, radius: float) -> Outline:
    """Replace each corner of a polygon by a curve that starts `radius` before it."""
    points = np.asarray(corners, np.float64)
    if radius <= 0:
        return points
    t = np.linspace(0, 1, 7)[:, None]
    out = []
    for before, corner, after in zip(np.roll(points, 1, 0), points, np.roll(points, -1, 0)):
        start, end = (
            corner + (other - corner) * min(0.5, radius / max(float(np.linalg.norm(other - corner)), 1e-9))
            for other in (before, after)
        )
        out.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(out)
