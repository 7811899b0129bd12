"""Labels, and the scores of detections and tracks against them."""

from vehicle_detection.evaluation.calibration import Platt, calibrate_scores, calibration_error
from vehicle_detection.evaluation.detections import (
    DetectionScores,
    evaluate_detections,
    match_detections,
    precision_recall_curve,
)
from vehicle_detection.evaluation.labels import (
    NO_TRACK,
    FrameBoxes,
    FrameKey,
    Frames,
    LabelledFrames,
    check_labels_of,
    keyed_frames,
    keys_of,
    pairs_of,
)
from vehicle_detection.evaluation.matching import prepare_sides
from vehicle_detection.evaluation.readers import read_labels
from vehicle_detection.evaluation.tracks import TrackScores, evaluate_tracks

__all__ = [
    "NO_TRACK",
    "DetectionScores",
    "FrameBoxes",
    "FrameKey",
    "Frames",
    "LabelledFrames",
    "Platt",
    "TrackScores",
    "calibrate_scores",
    "calibration_error",
    "check_labels_of",
    "evaluate_detections",
    "evaluate_tracks",
    "keyed_frames",
    "keys_of",
    "match_detections",
    "pairs_of",
    "precision_recall_curve",
    "prepare_sides",
    "read_labels",
]
