"""Tracking: detections in, vehicles with steady identities out."""

from vehicle_detection.tracking.track import Track
from vehicle_detection.tracking.tracker import Tracker

__all__ = [
    "Track",
    "Tracker",
]
