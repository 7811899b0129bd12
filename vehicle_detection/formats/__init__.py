"""Files of tracks, detections and labels: CSV, JSON Lines, Parquet, MOT, CVAT, COCO, KITTI and YOLO.

Every table has the columns ``frame,track_id,x1,y1,x2,y2,score``. Tables of tracks go on with
``distance_m,speed_mps,confidence,distance_std_m,speed_std_mps`` and, with a frame rate, ``time_s``; tables of
detections in images with ``confidence``.
"""

from vehicle_detection.formats.read import FORMATS, read_labels
from vehicle_detection.formats.rows import without_suffix
from vehicle_detection.formats.write import DIGITS, open_tracks, track_records, write_labels, write_tracks

__all__ = [
    "DIGITS",
    "FORMATS",
    "open_tracks",
    "read_labels",
    "track_records",
    "without_suffix",
    "write_labels",
    "write_tracks",
]
