from . import plotting
from .boxes import Detections, clip_boxes, iou_matrix, non_max_suppression
from .camera import Camera, HorizonEstimate, estimate_horizon
from .classifier import VehicleClassifier, load_classifier, train_classifier
from .datasets import (
    FrameSet,
    PatchSet,
    Split,
    fetch_patches,
    find_near_duplicates,
    load_frames,
    load_patches,
    load_training_patches,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)
from .detector import FrameResult, VehicleDetector
from .drawing import draw_boxes, draw_diagnostics, draw_labeled_bboxes, draw_tracks
from .errors import (
    DatasetError,
    InvalidInputError,
    ModelFileError,
    VehicleDetectionError,
    VideoError,
)
from .evaluation import (
    DetectionScores,
    FrameBoxes,
    LabelledFrames,
    TrackScores,
    calibrate_scores,
    calibration_error,
    evaluate_detections,
    evaluate_tracks,
    precision_recall_curve,
    read_labels,
)
from .explorer import Explorer
from .export import TrackWriter, write_boxes, write_tracks
from .features import (
    PatchFeatures,
    bin_spatial,
    color_hist,
    convert_color,
    extract_features,
    get_hog_features,
    hog_image,
    single_img_features,
)
from .heatmap import HeatHistory, add_heat, apply_threshold, bounding_boxes, label_boxes
from .images import read_image, write_image
from .mixture import TemplateMixture, load_model
from .mixture_training import FrameDataset, cross_validate_mixture, train_mixture
from .params import (
    FeatureParams,
    HeatParams,
    MixtureParams,
    PyramidParams,
    RegionParams,
    SearchBand,
    SearchParams,
    TrackParams,
)
from .regions import find_vehicles
from .report import ReportWriter
from .search import SearchResult, find_cars
from .synthetic import render_drive, render_patches, render_scene
from .tracking import Track, Tracker
from .training import train_and_evaluate
from .tuning import compare_configurations, mine_negatives, read_results, search_parameters
from .video import VideoInfo, VideoReport, probe_video, process_video, read_frames
from .windows import search_windows, slide_window

__version__: str
__all__ = [
    "Camera",
    "DatasetError",
    "DetectionScores",
    "Detections",
    "Explorer",
    "FeatureParams",
    "FrameBoxes",
    "FrameDataset",
    "FrameResult",
    "FrameSet",
    "HeatHistory",
    "HeatParams",
    "HorizonEstimate",
    "InvalidInputError",
    "LabelledFrames",
    "MixtureParams",
    "ModelFileError",
    "PatchFeatures",
    "PatchSet",
    "PyramidParams",
    "RegionParams",
    "ReportWriter",
    "SearchBand",
    "SearchParams",
    "SearchResult",
    "Split",
    "TemplateMixture",
    "Track",
    "TrackParams",
    "TrackScores",
    "TrackWriter",
    "Tracker",
    "VehicleClassifier",
    "VehicleDetectionError",
    "VehicleDetector",
    "VideoError",
    "VideoInfo",
    "VideoReport",
    "add_heat",
    "apply_threshold",
    "bin_spatial",
    "bounding_boxes",
    "calibrate_scores",
    "calibration_error",
    "clip_boxes",
    "color_hist",
    "compare_configurations",
    "convert_color",
    "cross_validate_mixture",
    "draw_boxes",
    "draw_diagnostics",
    "draw_labeled_bboxes",
    "draw_tracks",
    "estimate_horizon",
    "evaluate_detections",
    "evaluate_tracks",
    "extract_features",
    "fetch_patches",
    "find_cars",
    "find_near_duplicates",
    "find_vehicles",
    "get_hog_features",
    "hog_image",
    "iou_matrix",
    "label_boxes",
    "load_classifier",
    "load_frames",
    "load_model",
    "load_patches",
    "load_training_patches",
    "mine_negatives",
    "non_max_suppression",
    "plotting",
    "precision_recall_curve",
    "probe_video",
    "process_video",
    "read_frames",
    "read_image",
    "read_labels",
    "read_results",
    "render_drive",
    "render_patches",
    "render_scene",
    "search_parameters",
    "search_windows",
    "single_img_features",
    "slide_window",
    "split_groups",
    "split_leakage",
    "split_random",
    "split_sequences",
    "split_sources",
    "train_and_evaluate",
    "train_classifier",
    "train_mixture",
    "write_boxes",
    "write_image",
    "write_tracks",
]
