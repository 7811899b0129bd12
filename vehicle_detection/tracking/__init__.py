"""Tracking: detections of single frames in, vehicles with constant identities out."""

from vehicle_detection.tracking.interpolation import interpolate_tracks
from vehicle_detection.tracking.track import Track
from vehicle_detection.tracking.tracker import Tracker

__all__ = ["Track", "Tracker", "interpolate_tracks"]
