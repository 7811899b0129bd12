from .features import (
    add_correlation,
    add_root_histograms,
    bin_of_value,
    count_bins,
    find_bins,
    histogram_cells,
    hog_blocks,
    hog_cells,
    pool_cells,
)
from .linear_svm import fit_svm

__all__ = [
    "add_correlation",
    "add_root_histograms",
    "bin_of_value",
    "count_bins",
    "find_bins",
    "fit_svm",
    "histogram_cells",
    "hog_blocks",
    "hog_cells",
    "pool_cells",
]
