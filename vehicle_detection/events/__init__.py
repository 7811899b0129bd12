"""Events and counts of a drive, derived from its tracks."""

from vehicle_detection.events.counts import COUNTED, MinuteCounts, VehicleCounts, count_vehicles
from vehicle_detection.events.files import EVENT_SUFFIXES, cut_clips, write_events
from vehicle_detection.events.find import EVENT_COLUMNS, KINDS, Event, check_events, find_events
from vehicle_detection.events.history import TrackHistory, TrackLog, bin_means, split_runs
from vehicle_detection.events.motion import Motion, estimate_motion
from vehicle_detection.events.subtitles import SUBTITLE_SUFFIXES, write_subtitles

__all__ = [
    "COUNTED",
    "EVENT_COLUMNS",
    "EVENT_SUFFIXES",
    "KINDS",
    "SUBTITLE_SUFFIXES",
    "Event",
    "MinuteCounts",
    "Motion",
    "TrackHistory",
    "TrackLog",
    "VehicleCounts",
    "bin_means",
    "check_events",
    "count_vehicles",
    "cut_clips",
    "estimate_motion",
    "find_events",
    "split_runs",
    "write_events",
    "write_subtitles",
]
