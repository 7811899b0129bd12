"""The mixture of templates: a model for any road, and its search."""

from vehicle_detection.mixture.boxes import BoxRegressor, mostly_inside, nms, vote_boxes
from vehicle_detection.mixture.crops import (
    CROP_CELLS,
    N_COLOR_FEATURES,
    N_EDGE_FEATURES,
    N_REGRESSION_FEATURES,
    crop_channels,
    regression_features,
    rescoring_features,
)
from vehicle_detection.mixture.denoise import denoise
from vehicle_detection.mixture.features import (
    COARSE,
    FINE,
    N_CHANNELS,
    FeatureMap,
    feature_maps,
    image_pyramid,
    mirror_channels,
    pyramid_levels,
)
from vehicle_detection.mixture.model import TemplateMixture, load_model
from vehicle_detection.mixture.rescoring import Projection, Rescorer
from vehicle_detection.mixture.search import MixtureSearch
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box

__all__ = [
    "COARSE",
    "CROP_CELLS",
    "FINE",
    "N_CHANNELS",
    "N_COLOR_FEATURES",
    "N_EDGE_FEATURES",
    "N_REGRESSION_FEATURES",
    "BoxRegressor",
    "FeatureMap",
    "MixtureSearch",
    "MixtureTemplate",
    "Projection",
    "Rescorer",
    "TemplateMixture",
    "crop_channels",
    "denoise",
    "feature_maps",
    "image_pyramid",
    "load_model",
    "mirror_channels",
    "mostly_inside",
    "nms",
    "pyramid_levels",
    "regression_features",
    "rescoring_features",
    "smallest_box",
    "vote_boxes",
]
