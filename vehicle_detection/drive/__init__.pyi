from .batch import BatchReport, run_batch
from .batch_store import BatchStatus, batch_status, batch_summary, with_source
from .counts import COUNTED, MinuteCounts, VehicleCounts, count_vehicles
from .events import EVENT_COLUMNS, KINDS, Event, find_events
from .outputs import EVENT_SUFFIXES, SUBTITLE_SUFFIXES, cut_clips, write_events, write_subtitles
from .own_speed import OwnSpeed, own_speeds, read_own_speed
from .report import ReportWriter, TrackPicture, explain_tracks
from .trips import Trip, find_trips, open_trip, segment_clock
from .worker_pool import open_dask

__all__ = [
    "COUNTED",
    "EVENT_COLUMNS",
    "EVENT_SUFFIXES",
    "KINDS",
    "SUBTITLE_SUFFIXES",
    "BatchReport",
    "BatchStatus",
    "Event",
    "MinuteCounts",
    "OwnSpeed",
    "ReportWriter",
    "TrackPicture",
    "Trip",
    "VehicleCounts",
    "batch_status",
    "batch_summary",
    "count_vehicles",
    "cut_clips",
    "explain_tracks",
    "find_events",
    "find_trips",
    "open_dask",
    "open_trip",
    "own_speeds",
    "read_own_speed",
    "run_batch",
    "segment_clock",
    "with_source",
    "write_events",
    "write_subtitles",
]
