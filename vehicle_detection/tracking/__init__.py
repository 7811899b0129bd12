"""Tracking: detections of single frames in, vehicles with constant identities out."""

from vehicle_detection.tracking.interpolation import backfill_tracks, interpolate_tracks
from vehicle_detection.tracking.track import FrameResult, Track, TrackParams
from vehicle_detection.tracking.tracker import Tracker

__all__ = ["FrameResult", "Track", "TrackParams", "Tracker", "backfill_tracks", "interpolate_tracks"]
