"""The mixture of templates: a model for any road, and its search."""

from vehicle_detection.mixture.boxes import BoxRegressor, mostly_inside, overlaps, vote_boxes
from vehicle_detection.mixture.crops import (
    COLORS,
    CROP,
    CROP_LENGTH,
    EDGES,
    box_planes,
    crop_features,
    crop_views,
)
from vehicle_detection.mixture.denoise import without_noise
from vehicle_detection.mixture.features import (
    COARSE,
    FINE,
    PLANES,
    FeatureMap,
    border_strip,
    image_pyramid,
    level_maps,
    mirror_planes,
    pyramid_levels,
    strip_boxes,
)
from vehicle_detection.mixture.model import TemplateMixture, load_model
from vehicle_detection.mixture.rescoring import Projection, Rescorer
from vehicle_detection.mixture.search import MixtureSearch
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box

__all__ = [
    "COARSE",
    "COLORS",
    "CROP",
    "CROP_LENGTH",
    "EDGES",
    "FINE",
    "PLANES",
    "BoxRegressor",
    "FeatureMap",
    "MixtureSearch",
    "MixtureTemplate",
    "Projection",
    "Rescorer",
    "TemplateMixture",
    "border_strip",
    "box_planes",
    "crop_features",
    "crop_views",
    "image_pyramid",
    "level_maps",
    "load_model",
    "mirror_planes",
    "mostly_inside",
    "overlaps",
    "pyramid_levels",
    "smallest_box",
    "strip_boxes",
    "vote_boxes",
    "without_noise",
]
