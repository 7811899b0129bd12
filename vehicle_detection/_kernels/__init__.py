"""Compiled numba kernels: HOG, FHOG, color, correlation, convolutional networks and the SVM solver."""

import vehicle_detection._common  # noqa: F401 - checks the environment variables of numba first
from vehicle_detection._kernels.correlation import Filter, PackedFilters, PackedSearch
from vehicle_detection._kernels.fhog import cell_means
from vehicle_detection._kernels.hog import (
    bin_of_value,
    degree_bounds,
    orientation_cotangents,
    sqrt_gradients,
)
from vehicle_detection._kernels.linear_svm import fit_svm, hinge_loss
from vehicle_detection._kernels.network import Convolution, ConvolutionalNetwork
from vehicle_detection._kernels.suppression import group
from vehicle_detection._kernels.vector import BYTE_LIMIT
from vehicle_detection._kernels.yuv import channels_from_planes, planes_from_channels

__all__ = [
    "BYTE_LIMIT",
    "Convolution",
    "ConvolutionalNetwork",
    "Filter",
    "PackedFilters",
    "PackedSearch",
    "bin_of_value",
    "cell_means",
    "channels_from_planes",
    "degree_bounds",
    "fit_svm",
    "group",
    "hinge_loss",
    "orientation_cotangents",
    "planes_from_channels",
    "sqrt_gradients",
]
