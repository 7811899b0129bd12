"""Compiled numba kernels: HOG, color, correlation and the SVM solver."""

import vehicle_detection._common  # noqa: F401 - checks the environment variables of numba first
from vehicle_detection._kernels.correlation import Filter
from vehicle_detection._kernels.linear_svm import fit_svm
from vehicle_detection._kernels.yuv import channels_from_planes, planes_from_channels

__all__ = ["Filter", "channels_from_planes", "fit_svm", "planes_from_channels"]
