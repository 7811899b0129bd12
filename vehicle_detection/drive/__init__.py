"""What a drive is made of: trips, own speed, events, counts, subtitles, report, and batches of trips."""

from vehicle_detection.drive.batch import BatchReport, run_batch
from vehicle_detection.drive.batch_records import BatchStatus, batch_status, batch_summary, with_source
from vehicle_detection.drive.counts import COUNTED, MinuteCounts, VehicleCounts, count_vehicles
from vehicle_detection.drive.dask_cluster import open_dask
from vehicle_detection.drive.event_files import EVENT_SUFFIXES, cut_clips, write_events
from vehicle_detection.drive.events import EVENT_COLUMNS, KINDS, Event, find_events
from vehicle_detection.drive.explained_tracks import explain_tracks
from vehicle_detection.drive.own_speed import OwnSpeed, own_speeds, read_own_speed
from vehicle_detection.drive.report import ReportWriter
from vehicle_detection.drive.report_page import TrackPicture
from vehicle_detection.drive.subtitles import SUBTITLE_SUFFIXES, write_subtitles
from vehicle_detection.drive.trips import Trip, find_trips, open_trip

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
    "with_source",
    "write_events",
    "write_subtitles",
]
