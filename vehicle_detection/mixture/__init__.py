"""The mixture of templates: a model for any road, and its search."""

from vehicle_detection.mixture.boxes import mostly_inside, nms, vote_boxes
from vehicle_detection.mixture.crops import (
    CROP_CELLS,
    EDGE_OFFSET,
    N_EDGE_FEATURES,
    N_INPUTS,
    edge_features,
    rescoring_inputs,
    window_grid,
)
from vehicle_detection.mixture.denoise import denoise
from vehicle_detection.mixture.features import (
    MIRROR_ORDER,
    N_CHANNELS,
    CellGrid,
    EdgePyramid,
    FeatureMap,
    mirror_channels,
)
from vehicle_detection.mixture.haze import prepare, reduce_haze
from vehicle_detection.mixture.model import TemplateMixture, load_model
from vehicle_detection.mixture.rescoring import (
    KERNEL,
    RESCORE_MIN,
    STRIDES,
    Layer,
    Network,
    Rescorer,
    inputs_after,
)
from vehicle_detection.mixture.search import MixtureSearch, frame_grid
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box

__all__ = [
    "CROP_CELLS",
    "EDGE_OFFSET",
    "KERNEL",
    "MIRROR_ORDER",
    "N_CHANNELS",
    "N_EDGE_FEATURES",
    "N_INPUTS",
    "RESCORE_MIN",
    "STRIDES",
    "CellGrid",
    "EdgePyramid",
    "FeatureMap",
    "Layer",
    "MixtureSearch",
    "MixtureTemplate",
    "Network",
    "Rescorer",
    "TemplateMixture",
    "denoise",
    "edge_features",
    "frame_grid",
    "inputs_after",
    "load_model",
    "mirror_channels",
    "mostly_inside",
    "nms",
    "prepare",
    "reduce_haze",
    "rescoring_inputs",
    "smallest_box",
    "vote_boxes",
    "window_grid",
]
