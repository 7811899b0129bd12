"""The horizon of a video: recursively from its tracks, or once from the boxes of some frames.

On a flat road the bottom edge of a box lies below the horizon by the box's size times the ratio of the
camera's height to the vehicle's: a straight line for each vehicle, whose value at size 0 is the horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check, invalid
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera, FrameShape, lateral_offsets, truncated_edges

# Times (s): correlation of the errors of a vehicle's boxes; decay of the sums; faster decay of the sums where
# no vehicle fits them.
_CORRELATION_TIME, _MEMORY_TIME, _MISFIT_TIME = 0.5, 30.0, 3.0
# Standard errors beyond which a vehicle is an outlier; minimum weight of a vehicle, relative to the largest.
_OUTLIER, _MIN_WEIGHT = 3.0, 1e-4
# Standard deviation of the width of a visible side, as a fraction: a turn shows more of it or less.
_SIDE_STD = 0.5
# Minimum standard error of the estimate, in pixels of the reference camera.
_MIN_STD_PX = 1.0
# The following constants are those of `estimate_horizon`. Number of boxes required.
_MIN_BOXES = 4
# Prior of the camera's height (m), and its standard deviation; error of a given height, as a fraction, which
# is mostly that of the vehicles' mean height.
_CAMERA_HEIGHT, _CAMERA_HEIGHT_STD, _GIVEN_HEIGHT_STD = 1.35, 0.3, 0.06
# Prior standard deviation of the horizon around the middle row, as a fraction of the frame's height.
_PRIOR_STD = 0.15
# Standard error of a bottom edge in pixels of a frame 1280 wide.
_EDGE_STD_PX = 3.5
# Standard deviation of vehicles' heights, as a fraction.
_RELATIVE_STD = 0.12
# Boxes with a larger residual, in standard errors, are ignored.
_BIWEIGHT = 4.7
# Number of boxes that count as one, because they show the same vehicle.
_CORRELATED_BOXES = 3.0
# 80th percentile of the absolute values of a normal distribution.
_NORMAL_80 = 1.282


class HorizonFilter:
    """Recursive estimate of the camera's horizon from the tracked vehicles.

    The widths of the boxes are used, without the visible sides. The slopes of the lines differ between
    vehicles, as their widths do, around a mean that is roughly known. All lines are fitted together, with the
    slopes as random effects (Laird and Ware, *Biometrics*, 1982): a vehicle at constant distance contributes
    little, several vehicles more, and an approaching one most.

    `prior_camera` is the camera as given, and `camera` the current estimate: of the horizon, and of the mean
    width of vehicles and the camera's height, on which the slope depends. Nothing is estimated if the
    standard error of the horizon is 0.
    """

    def __init__(self, camera: Camera) -> None:
        self.prior_camera = self.camera = camera
        # Bottom edge below the horizon per width; standard deviation of its mean, and of one vehicle.
        self._slope = camera.height_m / camera.vehicle_width_m
        self._relative_std = (
            camera.height_std_m / camera.height_m,
            camera.mean_width_std_m / camera.vehicle_width_m,
        )
        self._mean_slope_std = self._slope * math.hypot(*self._relative_std)
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
        face = face_scale / camera.width_times_distance(lateral_offsets(boxes, frame))
        width = sides[:, 0] * face
        # The width that the face would have at the distance of the tires, where the box ends.
        width /= 1 + camera.overhang_m * width / face_scale
        edge_std = np.hypot(camera.bottom_std_px * scale, camera.box_std * sides)
        variance = (
            np.square(edge_std[:, 1])
            + 2 * np.square(self._slope * edge_std[:, 0])
            + np.square(self._slope * _SIDE_STD * (1 - face) * sides[:, 0])
            + np.square(camera.pitch_std_px * scale)
        )
        slope = camera.height_m / camera.vehicle_width_m
        residual = boxes[:, 3] - (camera.horizon_px + slope * width)
        expected = variance + camera.horizon_std_px**2 + np.square(self._slope_std * width)
        fits = np.square(residual) < _OUTLIER**2 * expected
        # If most vehicles do not fit the estimate, the estimate is wrong: forget it faster.
        misfit = 1 - float(fits.mean())
        self._sums *= math.exp(-dt / _MEMORY_TIME - dt * misfit**2 / _MISFIT_TIME)
        weight = min(dt / _CORRELATION_TIME, 1.0) / variance[fits]
        x, y = width[fits], boxes[fits, 3]
        sums = np.stack([weight, weight * x, weight * x * x, weight * y, weight * x * y], axis=1)
        # Add to the sums of these vehicles, and drop vehicles whose weight has decayed.
        ids = ids[fits]
        new = ids[(ids[:, None] != self._ids).all(axis=1)]
        if len(new):
            self._ids = np.concatenate((self._ids, new))
            self._sums = np.concatenate((self._sums, np.zeros((len(new), 5))))
        if len(ids):
            self._sums[(self._ids == ids[:, None]).argmax(axis=1)] += sums
        kept = self._sums[:, 0] > _MIN_WEIGHT * self._sums[:, 0].max(initial=0.0)
        self._ids, self._sums = self._ids[kept], self._sums[kept]
        self._solve()

    def _solve(self) -> None:
        """Solve for horizon and mean slope, and update `camera`."""
        camera, mean_std = self.prior_camera, self._mean_slope_std
        vehicle_variance = max(self._slope_std**2 - mean_std**2, 1e-12)
        n, x, xx, y, xy = self._sums.T
        # A vehicle's line is bottom = horizon + (slope + own) * width, where `own` has the vehicle variance.
        # Its normal equations in (horizon, slope, own) are the weighted sums; eliminating `own` (the Schur
        # complement) subtracts the products with `factor` and leaves 2x2 equations, which add up.
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
        horizon, slope = map(float, cov @ vector)
        # The camera's height and the vehicles' width share the change of the slope by their prior variances.
        # A slope of less than half the prior one is not that of vehicles; below 0 it has no logarithm.
        by_height, by_width = np.square(self._relative_std)
        change = math.log(max(slope / self._slope, 0.5)) / max(by_height + by_width, 1e-12)
        std = max(math.sqrt(max(float(cov[0, 0]), 0.0)), _MIN_STD_PX * camera.pixel_scale)
        self.camera = camera.with_values(
            horizon_px=horizon,
            horizon_std_px=min(std, camera.horizon_std_px),
            height_m=camera.height_m * math.exp(change * by_height),
            vehicle_width_m=camera.vehicle_width_m * math.exp(-change * by_width),
        )


@dataclass(frozen=True, kw_only=True)
class HorizonEstimate:
    """Estimate of the horizon from the boxes of vehicles.

    The row of the horizon is a fraction of the frame's height, 0 at the top; treat it as a guess if its
    standard error exceeds 0.05. The height of the camera above the road, in meters, assumes that vehicles are
    1.5 m high.

    >>> estimate = HorizonEstimate(horizon=0.5, horizon_std=0.02, camera_height_m=1.3, n_boxes=40)
    >>> 720 * estimate.horizon  # row of a frame 720 high
    360.0
    """

    horizon: float
    horizon_std: float
    camera_height_m: float
    n_boxes: int


def estimate_horizon(
    boxes: Detections | ArrayLike, shape: tuple[int, ...], *, height_m: float | None = None
) -> HorizonEstimate:
    """Estimate the height of the horizon from the boxes of vehicles, of one frame or of many.

    At least 4 boxes must not be truncated. Their height is used, because the width includes the side of a
    vehicle in another lane. `height_m` is the camera's height, if known; that of most cameras is roughly
    known (1.35 m, standard deviation 0.3 m), so that boxes of similar sizes suffice. The line is fitted by
    iteratively reweighted least squares with Tukey's biweight, which ignores trucks and false boxes (Beaton
    and Tukey, *Technometrics*, 1974).

    >>> height = np.arange(40, 200, 10)
    >>> bottom = 396 + 0.9 * height
    >>> boxes = np.stack([600 - height / 2, bottom - height, 600 + height / 2, bottom], axis=1)
    >>> found = estimate_horizon(boxes, (720, 1280))
    >>> round(found.horizon, 3), round(found.camera_height_m, 2)
    (0.55, 1.35)
    """
    frame = check.shape(shape)
    array = check.boxes(boxes).astype(np.float64)
    whole = array[~truncated_edges(array, frame).any(axis=1)]
    if len(whole) < _MIN_BOXES:
        must = f"contain {_MIN_BOXES} vehicles that are not truncated by the frame"
        raise invalid("boxes", must, len(whole), "use more frames")
    height, height_std = _CAMERA_HEIGHT, _CAMERA_HEIGHT_STD
    if height_m is not None:
        height = check.number(height_m, "height_m", above=0, high=100)
        height_std = _GIVEN_HEIGHT_STD * height
    mean = np.array([0.5 * frame[0], height])
    information = np.diag([1 / (_PRIOR_STD * frame[0]) ** 2, 1 / height_std**2])
    size, bottom = (whole[:, 3] - whole[:, 1]) / Camera.vehicle_height_m, whole[:, 3]
    edge_std = _EDGE_STD_PX * max(frame) / 1280
    found = np.array([np.median(bottom - height * size), height])
    for _ in range(30):
        variance = edge_std**2 + np.square(_RELATIVE_STD * found[1] * size)
        residual = (bottom - found[0] - found[1] * size) / np.sqrt(variance)
        weight = np.square(np.maximum(1 - np.square(residual / _BIWEIGHT), 0)) / variance / _CORRELATED_BOXES
        crossed = (weight * size).sum()
        normal = information + np.array([[weight.sum(), crossed], [crossed, (weight * size * size).sum()]])
        vector = np.array([(weight * bottom).sum(), (weight * size * bottom).sum()])
        found = np.linalg.solve(normal, vector + information @ mean)
    std = math.sqrt(np.linalg.inv(normal)[0, 0])
    # Boxes that do not lie on a line are no vehicles on a flat road.
    std *= max(1.0, float(np.percentile(np.abs(residual), 80)) / _NORMAL_80)
    return HorizonEstimate(
        horizon=float(found[0]) / frame[0],
        horizon_std=std / frame[0],
        camera_height_m=float(found[1]),
        n_boxes=len(whole),
    )
