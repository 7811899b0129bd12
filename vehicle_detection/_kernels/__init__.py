"""Compiled numba kernels: HOG, color, correlation and the SVM solver."""

import vehicle_detection._common  # noqa: F401 - checks the environment variables of numba first
from vehicle_detection._kernels.correlation import Filter
from vehicle_detection._kernels.features import (
    bin_of_value,
    degree_bounds,
    orientation_cotangents,
    sqrt_gradients,
)
from vehicle_detection._kernels.linear_svm import fit_svm
from vehicle_detection._kernels.yuv import channels_from_planes, planes_from_channels

__all__ = [
    "Filter",
    "bin_of_value",
    "channels_from_planes",
    "degree_bounds",
    "fit_svm",
    "orientation_cotangents",
    "planes_from_channels",
    "sqrt_gradients",
]
