"""Drawing on images and video: boxes, regions, tracks with labels, bird's-eye views, blurred vehicles."""

from vehicle_detection.drawing.birds_eye import (
    LANE_WIDTH_M,
    MAX_SPEED_STD,
    TRAIL_SECONDS,
    BirdsEyePanel,
    RoadPosition,
    Trails,
    road_position,
)
from vehicle_detection.drawing.blur import BLUR_REGIONS, blur_boxes
from vehicle_detection.drawing.boxes import (
    draw_boxes,
    draw_detections,
    draw_labeled_bboxes,
    draw_texts,
    score_texts,
)
from vehicle_detection.drawing.diagnostics import draw_cell_shares, draw_diagnostics, heat_image
from vehicle_detection.drawing.primitives import blend
from vehicle_detection.drawing.tracks import (
    TRACK_COLORS,
    TrackDrawer,
    color_index,
    draw_tracks,
    track_color,
)

__all__ = [
    "BLUR_REGIONS",
    "LANE_WIDTH_M",
    "MAX_SPEED_STD",
    "TRACK_COLORS",
    "TRAIL_SECONDS",
    "BirdsEyePanel",
    "RoadPosition",
    "TrackDrawer",
    "Trails",
    "blend",
    "blur_boxes",
    "color_index",
    "draw_boxes",
    "draw_cell_shares",
    "draw_detections",
    "draw_diagnostics",
    "draw_labeled_bboxes",
    "draw_texts",
    "draw_tracks",
    "heat_image",
    "road_position",
    "score_texts",
    "track_color",
]
