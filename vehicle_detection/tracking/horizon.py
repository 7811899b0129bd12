"""Estimates the horizon of a video from the tracked vehicles.

On a flat road the bottom edge of a box lies below the horizon by the box's width times the ratio of the
camera's height to the vehicle's width: a straight line for each vehicle, whose value at width 0 is the
horizon. The slopes differ between vehicles, as their widths do, around a mean that is roughly known. All
lines are fitted together, with the slopes as random effects (Laird and Ware, *Biometrics*, 1982). A vehicle
at constant distance therefore contributes little, several vehicles more, and an approaching one most.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.camera import Camera, FrameShape, lateral_offsets

# Times (s): correlation of the errors of a vehicle's boxes; decay of the sums; faster decay of the sums where
# no vehicle fits them.
_CORRELATION_TIME, _MEMORY_TIME, _MISFIT_TIME = 0.5, 30.0, 3.0
# Standard errors beyond which a vehicle is an outlier; minimum weight of a vehicle, relative to the largest.
_OUTLIER, _MIN_WEIGHT = 3.0, 1e-4
# Minimum standard error of the estimate, in pixels of the reference camera.
_MIN_STD_PX = 1.0


class HorizonFilter:
    """Recursive estimate of the camera's horizon from the tracked vehicles.

    `prior_camera` is the camera as given, whose horizon is fixed if its standard error is 0, and `camera` the
    current estimate.
    """

    def __init__(self, camera: Camera) -> None:
        self.prior_camera = self.camera = camera
        # Bottom edge below the horizon per width; standard deviation of its mean, and of one vehicle.
        self._slope = camera.height_m / camera.vehicle_width_m
        self._mean_slope_std = self._slope * camera.height_std_m / camera.height_m
        vehicle_std = self._slope * camera.vehicle_width_std_m / camera.vehicle_width_m
        self._slope_std = math.hypot(self._mean_slope_std, vehicle_std)
        self._ids = np.empty(0, np.int64)
        # Weighted sums of 1, width, width², bottom and width * bottom for each vehicle.
        self._sums = np.empty((0, 5))

    def update(self, ids: NDArray[np.int64], boxes: Floats, frame: FrameShape, dt: float) -> None:
        """Add the vehicles of a frame: ids ``(N,)`` and boxes ``(N, 4)`` that are not truncated."""
        if not self.prior_camera.horizon_std_px or not len(boxes):
            return
        camera, scale = self.camera, self.prior_camera.pixel_scale
        sides = boxes[:, 2:] - boxes[:, :2]
        # The width of the near face alone.
        face_scale = camera.focal_px * camera.vehicle_width_m
        width = sides[:, 0] * face_scale / camera.width_times_distance(lateral_offsets(boxes, frame))
        edge_std = np.hypot(camera.bottom_std_px * scale, camera.box_std * sides)
        variance = (
            np.square(edge_std[:, 1])
            + 2 * np.square(self._slope * edge_std[:, 0])
            + np.square(camera.pitch_std_px * scale)
        )
        residual = boxes[:, 3] - (camera.horizon_px + self._slope * width)
        expected = variance + camera.horizon_std_px**2 + np.square(self._slope_std * width)
        fits = np.square(residual) < _OUTLIER**2 * expected
        # If most vehicles do not fit the estimate, the estimate is wrong: forget it faster.
        misfit = 1 - float(fits.mean())
        self._sums *= math.exp(-dt / _MEMORY_TIME - dt * misfit**2 / _MISFIT_TIME)
        weight = min(dt / _CORRELATION_TIME, 1.0) / variance[fits]
        x, y = width[fits], boxes[fits, 3]
        self._add(
            ids[fits], np.stack([weight, weight * x, weight * x * x, weight * y, weight * x * y], axis=1)
        )
        self._solve()

    def _add(self, ids: NDArray[np.int64], sums: Floats) -> None:
        """Add to the sums of these vehicles, and drop vehicles whose weight has decayed."""
        new = ids[~np.isin(ids, self._ids)]
        self._ids = np.concatenate((self._ids, new))
        self._sums = np.concatenate((self._sums, np.zeros((len(new), 5))))
        if len(ids):
            self._sums[(self._ids[None] == ids[:, None]).argmax(axis=1)] += sums
        kept = self._sums[:, 0] > _MIN_WEIGHT * self._sums[:, 0].max(initial=0.0)
        self._ids, self._sums = self._ids[kept], self._sums[kept]

    def _solve(self) -> None:
        """Solve for horizon and mean slope, and update `camera`."""
        camera, mean_std = self.prior_camera, self._mean_slope_std
        vehicle_variance = max(self._slope_std**2 - mean_std**2, 1e-12)
        n, x, xx, y, xy = self._sums.T
        # Information of each line about (horizon, mean slope), with its own part of the slope integrated out.
        factor = 1 / (xx + 1 / vehicle_variance)
        crossed = (x - x * xx * factor).sum()
        information = np.array(
            [[(n - x * x * factor).sum(), crossed], [crossed, (xx - xx * xx * factor).sum()]]
        )
        vector = np.array([(y - x * xy * factor).sum(), (xy - xx * xy * factor).sum()])
        prior = np.array([1 / camera.horizon_std_px**2, 1 / max(mean_std, 1e-6) ** 2])
        information[[0, 1], [0, 1]] += prior
        vector += prior * (camera.horizon_px, self._slope)
        cov = np.linalg.inv(information)
        horizon = float((cov @ vector)[0])
        std = max(math.sqrt(max(float(cov[0, 0]), 0.0)), _MIN_STD_PX * camera.pixel_scale)
        self.camera = dataclasses.replace(
            camera, horizon_px=horizon, horizon_std_px=min(std, camera.horizon_std_px)
        )
