"""Training and cross-validation of the mixture of templates."""

from vehicle_detection.mixture_training.cross_validation import cross_validate_mixture, training_metadata
from vehicle_detection.mixture_training.drawn_frames import drawn_source
from vehicle_detection.mixture_training.sources import FrameDataset, find_sources
from vehicle_detection.mixture_training.train import train_mixture
from vehicle_detection.training import (
    FOLD_COLUMNS,
    FoldDetections,
    FoldScore,
    check_sources,
    format_fold,
    write_curves,
)

__all__ = [
    "FOLD_COLUMNS",
    "FoldDetections",
    "FoldScore",
    "FrameDataset",
    "check_sources",
    "cross_validate_mixture",
    "drawn_source",
    "find_sources",
    "format_fold",
    "train_mixture",
    "training_metadata",
    "write_curves",
]
