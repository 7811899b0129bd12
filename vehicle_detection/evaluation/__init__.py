"""Labelled frames, label files, scores of detections and tracks, and calibration of scores."""

from vehicle_detection.boxes import Platt
from vehicle_detection.evaluation.calibration import calibrate_scores, calibration_error
from vehicle_detection.evaluation.detections import (
    DetectionScores,
    best_f1,
    evaluate_detections,
    precision_recall_curve,
)
from vehicle_detection.evaluation.distances import DistanceScores, evaluate_distances
from vehicle_detection.evaluation.explanation import Explanation, explain
from vehicle_detection.evaluation.labelled_frames import Frames, LabelledFrames, keyed_frames
from vehicle_detection.evaluation.matching import (
    DetectionMatches,
    match_detections,
    match_names,
    prepare_evaluation,
)
from vehicle_detection.evaluation.tracks import TrackScores, evaluate_tracks

__all__ = [
    "DetectionMatches",
    "DetectionScores",
    "DistanceScores",
    "Explanation",
    "Frames",
    "LabelledFrames",
    "Platt",
    "TrackScores",
    "best_f1",
    "calibrate_scores",
    "calibration_error",
    "evaluate_detections",
    "evaluate_distances",
    "evaluate_tracks",
    "explain",
    "keyed_frames",
    "match_detections",
    "match_names",
    "precision_recall_curve",
    "prepare_evaluation",
]
