"""The features of many patches at once, by the kernels."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels import bin_of_value, degree_bounds, orientation_cotangents, sqrt_gradients
from vehicle_detection._kernels import color as _colour_kernels
from vehicle_detection._kernels import hog as _hog_kernels
from vehicle_detection.features.color import convert_color, hog_source, pick_hog_channels
from vehicle_detection.params import PATCH_SIZE, FeatureParams


def batch_extractor(params: FeatureParams) -> Callable[[NDArray[np.uint8], NDArray[np.float32]], None]:
    """Build the function that fills the features of a batch of patches."""
    channels, cell, block = params.hog_channels, params.pix_per_cell, params.cell_per_block
    coarse = params.coarse_blocks
    cotangents = orientation_cotangents(params.orient)
    bounds = degree_bounds(params.orient)
    bins = bin_of_value(params.hist_bins)
    size = params.spatial_size
    spatial_stop = params.spatial_length
    hist_stop = spatial_stop + params.hist_length

    def extract(patches: NDArray[np.uint8], features: NDArray[np.float32]) -> None:
        n = len(patches)
        # Colour conversion is pixel by pixel: the batch is converted as one tall image.
        tall = np.ascontiguousarray(patches).reshape(n * PATCH_SIZE, PATCH_SIZE, 3)
        converted = convert_color(tall, params.color_space).reshape(patches.shape)
        if params.spatial_feat:
            for index, patch in enumerate(converted):
                small = cv2.resize(patch, (size, size))
                features[index, :spatial_stop].reshape(3, size, size)[:] = small.transpose(2, 0, 1)
        if params.hist_feat:
            counts = features[:, spatial_stop:hist_stop]
            _colour_kernels.patch_histograms(converted, bins, params.hist_bins, counts)
            if params.hist_sqrt:
                np.sqrt(counts, out=counts)
        if params.hog_feat:
            gray = params.hog_channel == "GRAY"
            source = hog_source(tall, params) if gray else pick_hog_channels(converted, params)
            source = source.reshape(n, PATCH_SIZE, PATCH_SIZE, channels)
            hog = features[:, hist_stop:]
            if params.transform_sqrt:
                gradients = sqrt_gradients(source)
                _hog_kernels.patch_hog_of_angles(*gradients, bounds, channels, cell, block, coarse, hog)
            else:
                flat = source.reshape(n, PATCH_SIZE, PATCH_SIZE * channels)
                _hog_kernels.patch_hog(flat, channels, cell, block, coarse, cotangents, hog)

    return extract
