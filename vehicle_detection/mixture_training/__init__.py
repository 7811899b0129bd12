"""Training and cross-validation of the mixture of templates."""

from vehicle_detection.mixture_training.card import write_card, write_curves
from vehicle_detection.mixture_training.cross_validation import as_metadata, judge_mixture
from vehicle_detection.mixture_training.drawn_frames import drawn_source
from vehicle_detection.mixture_training.negatives import FrameSource, check_sources
from vehicle_detection.mixture_training.pictures import write_pictures
from vehicle_detection.mixture_training.sources import find_patches, find_sources
from vehicle_detection.mixture_training.train import MixtureParams, train_mixture

__all__ = [
    "FrameSource",
    "MixtureParams",
    "as_metadata",
    "check_sources",
    "drawn_source",
    "find_patches",
    "find_sources",
    "judge_mixture",
    "train_mixture",
    "write_card",
    "write_curves",
    "write_pictures",
]
