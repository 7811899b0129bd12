"""Patches to feature vectors ``[spatial | histogram | HOG | coarse HOG]``."""

from vehicle_detection.features.color import convert_color, hog_source, pick_hog_channels
from vehicle_detection.features.extract import (
    PatchFeatures,
    bin_spatial,
    color_hist,
    extract_features,
    get_hog_features,
    hog_blocks,
    hog_picture,
    single_img_features,
)
from vehicle_detection.features.transformer import PatchFeatures

__all__ = [
    "PatchFeatures",
    "bin_spatial",
    "color_hist",
    "convert_color",
    "extract_features",
    "get_hog_features",
    "hog_blocks",
    "hog_picture",
    "hog_source",
    "pick_hog_channels",
    "single_img_features",
]
