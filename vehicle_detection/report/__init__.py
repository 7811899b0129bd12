"""The report: one self-contained HTML page about a run of `process_video`."""

from vehicle_detection.report.page import TrackPicture
from vehicle_detection.report.writer import ReportWriter

__all__ = ["ReportWriter", "TrackPicture"]
