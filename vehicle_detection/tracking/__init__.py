"""Tracking: detections of single frames in, vehicles with constant identities out."""

from vehicle_detection.tracking.distance import measure_distances
from vehicle_detection.tracking.horizon import HorizonEstimate, estimate_horizon
from vehicle_detection.tracking.interpolation import (
    backfill_results,
    interpolate_results,
    search_delay,
    search_interval,
)
from vehicle_detection.tracking.pixels import SceneCuts, small_gray
from vehicle_detection.tracking.track import (
    TRACK_VALUES,
    UNKNOWN_LABEL,
    USUAL_FPS,
    FrameResult,
    Track,
    TrackParams,
    is_result,
    shown_tracks,
)
from vehicle_detection.tracking.tracker import Tracker

__all__ = [
    "TRACK_VALUES", "UNKNOWN_LABEL", "USUAL_FPS", "FrameResult", "HorizonEstimate", "SceneCuts", "Track",
    "TrackParams", "Tracker", "backfill_results", "estimate_horizon", "interpolate_results", "is_result",
    "measure_distances", "search_delay", "search_interval", "shown_tracks", "small_gray",
]  # fmt: skip
