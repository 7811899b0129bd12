"""The mixture of templates: a model for any road, and its search."""

from vehicle_detection.mixture.boxes import Refinement, mostly_inside, overlaps, suppress
from vehicle_detection.mixture.denoise import without_noise
from vehicle_detection.mixture.features import (
    COARSE,
    FINE,
    PLANES,
    FeatureMap,
    border_strip,
    halved,
    level_maps,
    mirror_planes,
    pair_levels,
    strip_boxes,
)
from vehicle_detection.mixture.model import MixtureSearch, TemplateMixture, load_model
from vehicle_detection.mixture.rescoring import (
    COLOURS,
    CROP,
    CROP_LENGTH,
    EDGES,
    Projection,
    Verification,
    box_planes,
    crop_features,
    crop_views,
)
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box

__all__ = [
    "COARSE",
    "COLOURS",
    "CROP",
    "CROP_LENGTH",
    "EDGES",
    "FINE",
    "PLANES",
    "FeatureMap",
    "MixtureSearch",
    "MixtureTemplate",
    "Projection",
    "Refinement",
    "TemplateMixture",
    "Verification",
    "border_strip",
    "box_planes",
    "crop_features",
    "crop_views",
    "halved",
    "level_maps",
    "load_model",
    "mirror_planes",
    "mostly_inside",
    "overlaps",
    "pair_levels",
    "smallest_box",
    "strip_boxes",
    "suppress",
    "without_noise",
]
