"""Files of tracks, detections and labels: CSV, JSON Lines, Parquet, MOT, CVAT, COCO, KITTI and YOLO."""

from vehicle_detection.formats.read import FORMATS, read_labels
from vehicle_detection.formats.rows import without_suffix
from vehicle_detection.formats.write import DIGITS, open_tracks, track_records, write_labels, write_tracks

__all__ = [
    "DIGITS", "FORMATS", "open_tracks", "read_labels", "track_records", "without_suffix", "write_labels",
    "write_tracks",
]  # fmt: skip
