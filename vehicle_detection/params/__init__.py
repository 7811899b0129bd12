"""The parameters of every stage: frozen, validated, with the presets of the three course systems."""

from __future__ import annotations

from vehicle_detection.params.features import (
    COLOR_SPACES,
    HOG_CHANNELS,
    PATCH_SIZE,
    SPATIAL_ORDERS,
    FeatureParams,
)
from vehicle_detection.params.regions import HeatParams, HeatRange
from vehicle_detection.params.search import (
    REFERENCE_WIDTH,
    FunctionParams,
    PixelBand,
    SearchBand,
    SearchParams,
    entries,
)

__all__ = [
    "COLOR_SPACES",
    "HOG_CHANNELS",
    "PATCH_SIZE",
    "REFERENCE_WIDTH",
    "SPATIAL_ORDERS",
    "FeatureParams",
    "FunctionParams",
    "HeatParams",
    "HeatRange",
    "PixelBand",
    "SearchBand",
    "SearchParams",
    "entries",
]
