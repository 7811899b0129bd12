"""Write results to files: CSV, JSON Lines, Parquet, MOTChallenge text and archives, COCO JSON, YOLO folders.

Every table has the columns ``frame,track_id,x1,y1,x2,y2,score``. Tables of tracks go on with
``distance_m,speed_mps,confidence,distance_std_m,speed_std_mps`` and, with a frame rate, ``time_s``; tables of
boxes with ``confidence``.
"""

from vehicle_detection.export.coco import CocoImages, coco_document, coco_images, coco_result
from vehicle_detection.export.files import (
    FOLDER_FORMATS,
    FORMATS,
    check_format,
    mot_line,
    new_folder,
    open_row_file,
)
from vehicle_detection.export.rows import (
    BOX_COLUMNS,
    DIGITS,
    STILL_COLUMNS,
    TRACK_COLUMNS,
    Row,
    check_items,
    is_result,
    shown_tracks,
    track_rows,
)
from vehicle_detection.export.writers import TrackWriter, write_boxes, write_tracks

__all__ = [
    "BOX_COLUMNS",
    "DIGITS",
    "FOLDER_FORMATS",
    "FORMATS",
    "STILL_COLUMNS",
    "TRACK_COLUMNS",
    "CocoImages",
    "Row",
    "TrackWriter",
    "check_format",
    "check_items",
    "coco_document",
    "coco_images",
    "coco_result",
    "is_result",
    "mot_line",
    "new_folder",
    "open_row_file",
    "shown_tracks",
    "track_rows",
    "write_boxes",
    "write_tracks",
]
