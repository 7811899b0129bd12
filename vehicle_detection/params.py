"""The parameters of every stage: frozen, validated, with the presets of the three course systems."""

from __future__ import annotations

from vehicle_detection._feature_params import COLOR_SPACES, HOG_CHANNELS, PATCH_SIZE, FeatureParams
from vehicle_detection._pyramid_params import PyramidParams
from vehicle_detection._region_params import HeatParams, RegionParams
from vehicle_detection._search_params import REFERENCE_WIDTH, PixelBand, SearchBand, SearchParams
from vehicle_detection._track_params import TrackParams

__all__ = [
    "COLOR_SPACES",
    "HOG_CHANNELS",
    "PATCH_SIZE",
    "REFERENCE_WIDTH",
    "FeatureParams",
    "HeatParams",
    "PixelBand",
    "PyramidParams",
    "RegionParams",
    "SearchBand",
    "SearchParams",
    "TrackParams",
]
