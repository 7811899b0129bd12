"""Training and cross-validation of the mixture of templates."""

from vehicle_detection.mixture_training.card import write_card, write_curves
from vehicle_detection.mixture_training.cross_validation import as_metadata, cross_validate_mixture
from vehicle_detection.mixture_training.drawn_frames import drawn_source
from vehicle_detection.mixture_training.negatives import FrameDataset, check_sources
from vehicle_detection.mixture_training.pictures import write_pictures
from vehicle_detection.mixture_training.sources import find_patches, find_sources
from vehicle_detection.mixture_training.train import train_mixture

__all__ = [
    "FrameDataset",
    "as_metadata",
    "check_sources",
    "cross_validate_mixture",
    "drawn_source",
    "find_patches",
    "find_sources",
    "train_mixture",
    "write_card",
    "write_curves",
    "write_pictures",
]
