"""Perspective: whether a box is as high as a vehicle at its place on the road."""

from __future__ import annotations

import numpy as np

from vehicle_detection._common import Floats

# Horizons, as fractions of the frame's height, and how likely they are before a vehicle is seen.
_HORIZONS = np.linspace(0.15, 0.75, 41)
_HORIZON_MEAN, _HORIZON_STD = 0.45, 0.2
# Log ratio of a vehicle's height to that of the camera: mean, standard deviation and share of cars, and of
# trucks and buses.
_LOG_RATIOS = ((0.15, 0.35, 0.85), (0.8, 0.35, 0.15))
# Range of the log heights of boxes without a vehicle, and share of vehicles that are not on a flat road.
_CLUTTER_RANGE, _NOT_FLAT = 3.5, 0.02
# Log-odds of a vehicle by the margin of a box.
_SLOPE, _OFFSET = 4.2, 1.6
_MAX_LOG_RATIO = 2.0
# A box that ends this close to the lower border, as a fraction of the frame's height, may be truncated.
_BORDER = 0.015


def perspective_ratios(boxes: Floats, margins: Floats, height: int) -> Floats:
    """Log ratio of the probabilities of each box's height with and without a vehicle, from -2 to 2.

    The height of a vehicle on a flat road is proportional to the distance of its lower edge from the horizon.
    The horizon is not known: the other boxes of the frame vote for those that explain their heights, each
    according to its margin. Hoiem, Efros and Hebert, "Putting objects in perspective" (IJCV 2008).

    Parameters
    ----------
    boxes, margins
        Boxes ``(N, 4)`` of a frame and their margins ``(N,)``.
    height
        Height of the frame in pixels.

    >>> cars = [[100.0, 205, 240, 320], [400, 212, 470, 270], [600, 216, 635, 245]]
    >>> sign = [300.0, 100, 340, 140]
    >>> perspective_ratios(np.array([*cars, sign]), np.zeros(4), 480).round(1)
    array([ 1.1,  0.9,  0.4, -2. ])
    """
    if not len(boxes):
        return np.empty(0)
    bottoms = boxes[:, 3] / height
    heights = np.maximum(boxes[:, 3] - boxes[:, 1], 1) / height
    # Probability density of each box's height under each horizon.
    below = bottoms[:, None] - _HORIZONS
    log_ratios = np.log(heights)[:, None] - np.log(np.maximum(below, 1e-3))
    density = np.zeros_like(below)
    for mean, std, share in _LOG_RATIOS:
        density += share / (std * np.sqrt(2 * np.pi)) * np.exp(-0.5 * ((log_ratios - mean) / std) ** 2)
    density[below <= 0] = 0
    ratios = (1 - _NOT_FLAT) * density * _CLUTTER_RANGE + _NOT_FLAT
    probabilities = 1 / (1 + np.exp(-(_SLOPE * margins + _OFFSET).clip(-50, 50)))[:, None]
    votes = np.log(probabilities * ratios + 1 - probabilities)
    of_others = votes.sum(axis=0) - votes - 0.5 * ((_HORIZONS - _HORIZON_MEAN) / _HORIZON_STD) ** 2
    weights = np.exp(of_others - of_others.max(axis=1, keepdims=True))
    expected = np.log((weights * ratios).sum(axis=1) / weights.sum(axis=1))
    expected = np.clip(expected, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)
    # The lower edge of a truncated vehicle is below the frame, so that it seems too high.
    truncated = bottoms > 1 - _BORDER
    return np.asarray(np.where(truncated, np.maximum(expected, 0), expected))
