"""Boxes of vehicles: arithmetic, and their scores.

Boxes are ``(N, 4)`` arrays ``[x1, y1, x2, y2]`` in half-open pixels: the width is ``x2 - x1``.
"""

from vehicle_detection.boxes.detections import Detections, check_class_ids, select_classes
from vehicle_detection.boxes.geometry import (
    box_areas,
    clip_boxes,
    greedy_nms,
    intersection_matrix,
    iou_matrix,
    iter_nms,
    non_max_suppression,
    on_one_vehicle,
    overlap_matrices,
)
from vehicle_detection.boxes.scores import (
    Platt,
    ScoreScale,
    check_score_scale,
    log_odds,
    logit,
)

__all__ = [
    "Detections",
    "Platt",
    "ScoreScale",
    "box_areas",
    "check_class_ids",
    "check_score_scale",
    "clip_boxes",
    "greedy_nms",
    "intersection_matrix",
    "iou_matrix",
    "iter_nms",
    "log_odds",
    "logit",
    "non_max_suppression",
    "on_one_vehicle",
    "overlap_matrices",
    "select_classes",
]
