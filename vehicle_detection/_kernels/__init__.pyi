from .correlation import Filter
from .features import (
    add_root_histograms,
    bin_of_value,
    degree_bounds,
    find_bins,
    histogram_cells,
    hog_cells,
    normalize_blocks,
    orientation_cotangents,
    patch_histograms,
    patch_hog,
    patch_hog_from_angles,
    pool_cells,
    spatial_cells,
    sqrt_gradients,
    sum_orientations,
)
from .linear_svm import fit_svm

__all__ = [
    "Filter",
    "add_root_histograms",
    "bin_of_value",
    "degree_bounds",
    "find_bins",
    "fit_svm",
    "histogram_cells",
    "hog_cells",
    "normalize_blocks",
    "orientation_cotangents",
    "patch_histograms",
    "patch_hog",
    "patch_hog_from_angles",
    "pool_cells",
    "spatial_cells",
    "sqrt_gradients",
    "sum_orientations",
]
