"""The road and what is around it, for one camera, light and road.

What does not change along a drive is drawn once; what passes by is moved with the distance travelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection.synthetic.background import draw_backdrop
from vehicle_detection.synthetic.camera_light import Floats, Light, Pinhole
from vehicle_detection.synthetic.ground import Ground
from vehicle_detection.synthetic.hedge import Hedge
from vehicle_detection.synthetic.road import LANE, Road
from vehicle_detection.synthetic.trees import paint_sign, paint_tree

_DASH, _DASH_PERIOD = 3.6, 12.0
_PROP_PERIOD = 240.0
_FAR = 400.0
_RAIL_BANDS = ((0.46, 0.54, 108), (0.54, 0.6, 136), (0.6, 0.64, 100), (0.64, 0.71, 128), (0.71, 0.76, 150))
_WALL_BANDS = ((0.0, 0.07, 74), (0.07, 0.3, 150), (0.3, 0.55, 136), (0.55, 0.8, 142), (0.8, 0.85, 186))


class Canvas:
    """What polygons are painted on: a picture, and the number of the vehicle that each pixel shows."""

    def __init__(
        self, camera: Pinhole, image: NDArray[np.uint8] | None, seen: NDArray[np.int32] | None = None
    ) -> None:
        self.camera, self.image, self.seen = camera, image, seen

    def fill(self, corners: NDArray[np.float64], color: NDArray[np.float64]) -> None:
        """Fill a polygon of ``(column, row)`` corners; what it hides is no vehicle any more."""
        points = [np.rint((corners - 0.5) * 16).astype(np.int32)]
        if self.image is not None:
            cv2.fillPoly(self.image, points, np.clip(color, 0, 255).tolist(), cv2.LINE_AA, 4)
        if self.seen is not None:
            cv2.fillPoly(self.seen, points, 0, cv2.LINE_8, 4)


@dataclass(frozen=True, eq=False)
class _Prop:
    """Something upright beside the road that comes again: a picture, its place and size in metres."""

    rgba: Floats
    lateral: float
    ahead: float
    width: float
    height: float


class Scenery:
    """Everything but the vehicles."""

    def __init__(self, shape: tuple[int, int], camera: Pinhole, light: Light, road: Road, seed: int) -> None:
        self.shape, self.camera, self.light, self.road = shape, camera, light, road
        rng = np.random.default_rng([seed, 3])
        dry = float(rng.random())
        self._concrete = bool(rng.random() < 0.65)
        self._rail = bool(rng.random() < 0.4)
        self._worn = float(rng.uniform(0.8, 1.0))
        self._yellow = bool(rng.random() < 0.5)
        self._backdrop = draw_backdrop(shape, camera, light, dry, rng)
        self._ground = Ground(shape, camera, light, road, dry, rng)
        self._hedges = self._grow(dry, rng)
        self._props = self._plant(dry, rng)

    def render(self, travel: float) -> NDArray[np.uint8]:
        """Draw the road without vehicles and without the barrier, `travel` metres into the drive."""
        image = self._backdrop.copy()
        ground = image[self._ground.first :]
        if len(ground):
            ground[:] = self._ground.color
            self._draw_lines(Canvas(self.camera, image), travel)
            self._ground.wear(ground, travel)
        for hedge in self._hedges:
            hedge.draw(image, travel)
        places = [((prop.ahead - travel) % _PROP_PERIOD, prop) for prop in self._props]
        for ahead, prop in sorted(places, key=lambda place: -place[0]):
            if ahead > 4.0:
                self._draw_prop(image, prop, ahead)
        if self._rail:
            self._draw_rail(Canvas(self.camera, image), self.road.right + self.road.shoulder + 0.4, travel)
        return image

    def draw_barrier(self, canvas: Canvas, travel: float) -> None:
        """Draw the barrier that stands before the oncoming lanes, in place."""
        x = self.road.barrier
        if not self._concrete:
            self._draw_rail(canvas, x, travel)
            return
        # Its face is turned to the right: in the shade when the sun stands to the left.
        face = 0.62 if self.light.to_sun[0] < 0 and self.light.sun > 0.2 else 1.0
        for low, high, tone in _WALL_BANDS:
            foot = 0.2 * max(0.0, (0.45 - low) / 0.45)
            shade = tone * (face if high < 0.82 else 1.0)
            self._wall(canvas, x + foot, low, high, np.array([1.0, 0.99, 0.95]) * shade)
        self._posts(canvas, x, travel, every=6.0, top=0.8, width=0.03, color=(86, 85, 82))

    def _draw_lines(self, canvas: Canvas, travel: float) -> None:
        """Solid lines at both edges, dashed ones between the lanes."""
        road = self.road
        white, yellow = np.array([222, 222, 216]) * self._worn, np.array([206, 158, 46]) * self._worn
        self._stripe(canvas, road.left + 0.2, 0.0, _FAR, yellow if self._yellow else white)
        self._stripe(canvas, road.right - 0.2, 0.0, _FAR, white)
        inner = [road.left + lane * LANE for lane in range(1, road.lanes)]
        for x in (*inner, road.barrier - 1.4 - LANE, road.barrier - 1.4 - 2 * LANE):
            for start in np.arange(-(travel % _DASH_PERIOD), 160, _DASH_PERIOD):
                self._stripe(canvas, x, float(start), float(start) + _DASH, white)

    def _stripe(
        self, canvas: Canvas, x: float, start: float, stop: float, color: NDArray[np.float64]
    ) -> None:
        """Paint a line along the road, in pieces: the light falls off along it."""
        camera = self.camera
        nearest = camera.focal_px * camera.height_m / (self.shape[0] - camera.horizon_px) * 0.9
        first, last = max(start, nearest), min(stop, _FAR)
        if last - first < 0.05:
            return
        shine = 1.6 if self.light.dark else 1.0
        edges = np.geomspace(first, last, 2 + int(np.log2(last / first) * 2))
        for near, far in pairwise(edges):
            corners = camera.project(
                [x - 0.075, x + 0.075, x + 0.075, x - 0.075], 0.0, [near, near, far, far]
            )
            canvas.fill(corners, self.light.on(color * shine, float(np.sqrt(near * far))))

    def _wall(self, canvas: Canvas, x: float, low: float, high: float, color: ArrayLike) -> None:
        """Paint an upright band along the road, in pieces: the light falls off along it."""
        first = max(abs(x) / ((self.shape[1] / 2 + 40) / self.camera.focal_px), 1.2)
        edges = np.geomspace(first, max(_FAR, 2 * first), 14)
        for near, far in pairwise(edges):
            corners = canvas.camera.project(x, [low, low, high, high], [near, far, far, near])
            canvas.fill(corners, self.light.on(color, float(np.sqrt(near * far))))

    def _posts(
        self,
        canvas: Canvas,
        x: float,
        travel: float,
        *,
        every: float,
        top: float,
        width: float,
        color: ArrayLike,
    ) -> None:
        """Upright posts along the road, far ones first."""
        for ahead in np.arange(20 * every - travel % every, 2.5, -every):
            (foot_x, foot_y), (head_x, head_y) = canvas.camera.project(x, [0.0, top], ahead)
            half = max(width * canvas.camera.focal_px / ahead / 2, 0.35)
            if foot_x + half >= 0 and foot_x - half <= self.shape[1]:
                corners = [
                    (foot_x - half, foot_y),
                    (foot_x + half, foot_y),
                    (head_x + half, head_y),
                    (head_x - half, head_y),
                ]
                canvas.fill(np.array(corners), self.light.on(color, float(ahead)))

    def _draw_rail(self, canvas: Canvas, x: float, travel: float) -> None:
        """Draw a guard-rail on posts: two bulges of a steel band, lit from above."""
        self._posts(canvas, x + 0.1, travel, every=4.0, top=0.72, width=0.12, color=(92, 92, 92))
        for low, high, tone in _RAIL_BANDS:
            self._wall(canvas, x, low, high, (tone, tone, tone + 2))

    def _grow(self, dry: float, rng: np.random.Generator) -> list[Hedge]:
        """Rows of shrubs on both sides, low ones before tall ones."""
        right = self.road.right + self.road.shoulder
        left = self.road.barrier - 3 * LANE - 5.0
        rows = [
            (right + 11.0, 1.5, 6.5),
            (left - 7.0, 1.5, 6.5),
            (right + float(rng.uniform(4, 7)), -1.2, 1.8),
        ]
        return [
            Hedge(self.shape, self.camera, self.light, *row, dry, rng) for row in rows if rng.random() < 0.65
        ]

    def _plant(self, dry: float, rng: np.random.Generator) -> list[_Prop]:
        """Trees and bushes on both sides, signs on the right."""
        kinds = [paint_tree(rng, dry, self.light) for _ in range(5)]
        density = rng.uniform(0.35, 1.0)
        verge = self.road.right + self.road.shoulder
        props = []
        for side, base in ((1, verge + 3.0), (-1, self.road.barrier - 3 * LANE - 5.0)):
            for ahead in np.arange(0, _PROP_PERIOD, 6.0):
                if rng.random() > density:
                    continue
                rgba, slender = kinds[int(rng.integers(len(kinds)))]
                bush = rng.random() < 0.35
                height = float(rng.uniform(1.2, 2.6) if bush else rng.uniform(4.5, 13))
                width = height * slender * float(rng.uniform(0.8, 1.25)) * (1.5 if bush else 1.0)
                lateral = base + side * float(rng.uniform(0, 3) if bush else rng.uniform(2, 16))
                picture = rgba[:, ::-1] if rng.random() < 0.5 else rgba
                props.append(_Prop(picture, lateral, float(ahead + rng.uniform(0, 5)), width, height))
        signs = [float(ahead) for ahead in np.arange(0, _PROP_PERIOD, 60.0) if rng.random() < 0.35]
        return props + [_Prop(paint_sign(rng, self.light), verge + 2.2, ahead, 1.2, 2.4) for ahead in signs]

    def _draw_prop(self, image: NDArray[np.uint8], prop: _Prop, ahead: float) -> None:
        scale = self.camera.focal_px / ahead
        width, height = round(prop.width * scale), round(prop.height * scale)
        foot_x, foot_y = self.camera.project(prop.lateral, 0.0, ahead).tolist()
        left, top = round(foot_x - width / 2), round(foot_y) - height
        x1, x2 = max(left, 0), min(left + width, self.shape[1])
        y1, y2 = max(top, 0), min(top + height, self.shape[0])
        if min(width, height) < 2 or x1 >= x2 or y1 >= y2:
            return
        sx, sy = prop.rgba.shape[1] / width, prop.rgba.shape[0] / height
        if sx > 1 and sy > 1:
            whole = cv2.resize(prop.rgba, (width, height), interpolation=cv2.INTER_AREA)
            seen = whole[y1 - top : y2 - top, x1 - left : x2 - left]
        else:
            # Only the visible part is scaled: a near tree is far larger than the picture.
            matrix = np.array([[sx, 0, (x1 - left + 0.5) * sx - 0.5], [0, sy, (y1 - top + 0.5) * sy - 0.5]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            seen = cv2.warpAffine(prop.rgba, matrix, (x2 - x1, y2 - y1), flags=flags)
        clear = self.light.clarity(ahead)
        alpha = seen[..., 3:] / 255
        color = seen[..., :3] * (clear * self.light.reach(ahead)) + self.light.haze * (1 - clear) * alpha
        part = image[y1:y2, x1:x2]
        part[:] = np.clip(part * (1 - alpha) + color, 0, 255)
