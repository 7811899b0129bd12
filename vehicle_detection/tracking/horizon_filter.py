"""The horizon of a video, learned from the vehicles that are followed.

On a flat road a foot lies below the horizon by the width of the vehicle in pixels, times the camera's height
over the vehicle's width: a straight line for each vehicle, whose value at the width 0 is the horizon. Its
slope differs from vehicle to vehicle, as their widths do, around one that is known roughly. All lines are
fitted together, the slopes as random effects (Laird and Ware, *Biometrics*, 1982), so that one vehicle that
stays where it is says little, several ones more, and one that comes nearer most.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.camera import Camera, inner_edges, width_times_distance

Floats = NDArray[np.float64]

# The errors of a vehicle's boxes stay alike for the first time; memory fades in the second, and in the third
# where no vehicle fits it.
_ALIKE_SECONDS, _MEMORY_SECONDS, _RETHINK_SECONDS = 0.5, 30.0, 3.0
# Standard errors beyond which a vehicle is no car on this road; least weight of one that is remembered, as a
# share of the greatest.
_FAR_OFF, _LEAST = 3.0, 1e-4
# No less than this standard error is ever claimed, in pixels of the reference camera.
_SUREST = 1.0


class HorizonFilter:
    """What the vehicles of a video tell about the camera's horizon.

    Parameters
    ----------
    camera
        The camera; a horizon without doubt is left as it is.

    Attributes
    ----------
    given, camera
        The camera as it was given, and as it is known by now.
    """

    def __init__(self, camera: Camera) -> None:
        self.given = self.camera = camera
        self._ids = np.empty(0, np.int64)
        # For each vehicle the sums of 1, width, width squared, foot, and width times foot, over variances.
        self._sums = np.empty((0, 5))

    def take(self, ids: NDArray[np.int64], boxes: Floats, frame: tuple[int, int], dt: float) -> None:
        """Learn from the vehicles of a frame.

        Parameters
        ----------
        ids
            ``(N,)`` numbers of the vehicles.
        boxes
            ``(N, 4)`` boxes that the frame's border does not cut.
        frame
            ``(height, width)``.
        dt
            Seconds since the last frame.
        """
        if not self.given.horizon_std_px or not len(boxes):
            return
        camera, scale = self.camera, self.given.pixel_scale
        sides = boxes[:, 2:] - boxes[:, :2]
        # The width that the face alone has, and its foot.
        straight = camera.focal_px * camera.vehicle_width_m
        width = sides[:, 0] * straight / width_times_distance(camera, inner_edges(boxes, frame))
        slope = camera.height_m / camera.vehicle_width_m
        edge = np.hypot(camera.bottom_std_px * scale, camera.box_error * sides)
        variance = (
            np.square(edge[:, 1])
            + 2 * np.square(slope * edge[:, 0])
            + np.square(camera.horizon_error_px * scale)
        )
        off = boxes[:, 3] - (camera.horizon_px + slope * width)
        allowed = variance + camera.horizon_std_px**2 + np.square(self._slope_errors()[1] * width)
        good = np.square(off) < _FAR_OFF**2 * allowed
        # Where most vehicles do not fit what is remembered, it is that which is wrong.
        strange = 1 - float(good.mean())
        self._sums *= math.exp(-dt / _MEMORY_SECONDS - dt * strange**2 / _RETHINK_SECONDS)
        weight = min(dt / _ALIKE_SECONDS, 1.0) / variance[good]
        x, y = width[good], boxes[good, 3]
        self._add(
            ids[good], np.stack([weight, weight * x, weight * x * x, weight * y, weight * x * y], axis=1)
        )
        self._solve()

    def _add(self, ids: NDArray[np.int64], sums: Floats) -> None:
        """Add to the sums of the vehicles; those of which next to nothing is remembered go."""
        fresh = ids[~np.isin(ids, self._ids)]
        self._ids = np.concatenate((self._ids, fresh))
        self._sums = np.concatenate((self._sums, np.zeros((len(fresh), 5))))
        if len(ids):
            self._sums[(self._ids[None] == ids[:, None]).argmax(axis=1)] += sums
        kept = self._sums[:, 0] > _LEAST * self._sums[:, 0].max(initial=0.0)
        self._ids, self._sums = self._ids[kept], self._sums[kept]

    def _slope_errors(self) -> tuple[float, float]:
        """Spread of the slope that all vehicles have in common, and that of one vehicle's."""
        camera = self.given
        slope = camera.height_m / camera.vehicle_width_m
        common = slope * camera.height_std_m / camera.height_m
        own = slope * camera.vehicle_width_std_m / camera.vehicle_width_m
        return common, math.hypot(common, own)

    def _solve(self) -> None:
        """Find the horizon, and with it the camera as it is known now."""
        camera = self.given
        slope = camera.height_m / camera.vehicle_width_m
        common, both = self._slope_errors()
        own = max(both**2 - common**2, 1e-12)
        n, x, xx, y, xy = self._sums.T
        # Information about (horizon, common slope) of each line, its own part of the slope integrated out.
        left = 1 / (xx + 1 / own)
        matrix = np.array(
            [
                [(n - x * x * left).sum(), (x - x * xx * left).sum()],
                [(x - x * xx * left).sum(), (xx - xx * xx * left).sum()],
            ]
        )
        vector = np.array([(y - x * xy * left).sum(), (xy - xx * xy * left).sum()])
        prior = np.array([1 / camera.horizon_std_px**2, 1 / max(common, 1e-6) ** 2])
        matrix[[0, 1], [0, 1]] += prior
        vector += prior * (camera.horizon_px, slope)
        spread = np.linalg.inv(matrix)
        horizon = float((spread @ vector)[0])
        error = max(math.sqrt(max(float(spread[0, 0]), 0.0)), _SUREST * camera.pixel_scale)
        self.camera = dataclasses.replace(
            camera, horizon_px=horizon, horizon_std_px=min(error, camera.horizon_std_px)
        )
