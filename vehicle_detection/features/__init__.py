"""Feature vectors ``[spatial | histogram | HOG | coarse HOG]`` of patches."""

from typing import TYPE_CHECKING, Any

from vehicle_detection.features.extract import (
    bin_spatial,
    color_hist,
    convert_color,
    extract_features,
    get_hog_features,
    hog_blocks,
    hog_image,
    hog_source,
    pick_hog_channels,
    read_patches,
    single_img_features,
)
from vehicle_detection.features.layout import part_slices, sum_blocks

if TYPE_CHECKING:
    from vehicle_detection.features.transformer import PatchFeatures

__all__ = [
    "PatchFeatures",
    "bin_spatial",
    "color_hist",
    "convert_color",
    "extract_features",
    "get_hog_features",
    "hog_blocks",
    "hog_image",
    "hog_source",
    "part_slices",
    "pick_hog_channels",
    "read_patches",
    "single_img_features",
    "sum_blocks",
]


def __getattr__(name: str) -> Any:
    # Loaded on first use: it imports scikit-learn, which takes a second.
    if name == "PatchFeatures":
        from vehicle_detection.features.transformer import PatchFeatures

        return PatchFeatures
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
