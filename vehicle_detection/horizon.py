"""The height of the horizon, from the vehicles found: the farther one is, the nearer is its foot to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes
from vehicle_detection.camera import check_shape, cut_edges
from vehicle_detection.errors import InvalidInputError

_LEAST_BOXES = 12
_MOST_BOXES = 250
_RESAMPLES = 60
_VEHICLE_WIDTH_M = 1.8


@dataclass(frozen=True, kw_only=True)
class HorizonEstimate:
    """Where the horizon is, as far as the vehicles tell.

    Attributes
    ----------
    horizon
        Height as a share of the frame's height, 0 at the top.
    error
        Its standard error, in the same unit: above 0.05 it is a guess.
    camera_height_m
        Height of the camera over the road in metres, if vehicles are 1.8 m wide.
    boxes
        Number of boxes that it rests on.
    """

    horizon: float
    error: float
    camera_height_m: float
    boxes: int


def estimate_horizon(boxes: ArrayLike, shape: tuple[int, ...], *, random_state: int = 0) -> HorizonEstimate:
    """Estimate the height of the horizon from the boxes of vehicles, of one frame or of many.

    On a flat road a foot lies below the horizon by the width in pixels times the camera's height over the
    vehicle's width: a straight line, whose value for the width 0 is the horizon. Side views, false boxes and
    hills lie off the line; the median of the slopes between all pairs of boxes does not mind up to 29% of
    them (Theil, 1950; Sen, *Journal of the American Statistical Association*, 1968).

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, 12 or more of them whole and of different widths.
    shape
        ``(height, width, ...)`` of the frames.
    random_state
        Seed of the resampling that tells the error.

    Raises
    ------
    InvalidInputError
        If there are too few whole boxes, or all of them are about as wide.

    Examples
    --------
    >>> width = np.arange(40, 200, 10)
    >>> foot = 396 + 0.7 * width
    >>> boxes = np.stack([600 - width / 2, foot - width, 600 + width / 2, foot], axis=1)
    >>> found = estimate_horizon(boxes, (720, 1280))
    >>> round(found.horizon, 3), round(found.camera_height_m, 2)
    (0.55, 1.26)
    """
    frame = check_shape(shape)
    array = check_boxes(boxes).astype(np.float64)
    whole = array[~cut_edges(array, frame).any(axis=1)]
    width = whole[:, 2] - whole[:, 0]
    if len(whole) < _LEAST_BOXES:
        raise InvalidInputError(
            f"boxes must hold {_LEAST_BOXES} vehicles that the frame does not cut, got {len(whole)}; "
            "take more frames"
        )
    low, high = np.percentile(width, [10, 90])
    if high < 1.3 * low:
        raise InvalidInputError(
            f"boxes must differ in width, got {low:.0f} to {high:.0f} pixels; take frames with near and far "
            "vehicles"
        )
    rng = np.random.default_rng(random_state)
    if len(whole) > _MOST_BOXES:
        rows = rng.permutation(len(whole))[:_MOST_BOXES]
        whole, width = whole[rows], width[rows]
    foot = whole[:, 3]
    horizon, slope = _fit_line(width, foot)
    again = []
    for _ in range(_RESAMPLES):
        rows = rng.integers(len(width), size=len(width))
        again.append(_fit_line(width[rows], foot[rows])[0])
    return HorizonEstimate(
        horizon=horizon / frame[0],
        error=float(np.std(again)) / frame[0],
        camera_height_m=slope * _VEHICLE_WIDTH_M,
        boxes=len(whole),
    )


def _fit_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Value at 0 and slope of the line through points, robustly."""
    first, second = np.triu_indices(len(x), 1)
    apart = x[second] - x[first]
    # Pairs that are nearly as wide tell nothing about the slope.
    far = np.abs(apart) > 0.1 * np.maximum(x[first], x[second])
    slope = float(np.median((y[second] - y[first])[far] / apart[far])) if far.any() else 0.0
    return float(np.median(y - slope * x)), slope
