from . import course, datasets, drive, evaluation, notebook, tracking, training
from .annotator import Annotator, DrawParams, draw_diagnostics, draw_tracks
from .boxes import Detections, clip_boxes, iou_matrix, non_max_suppression
from .camera import Camera, open_camera, read_camera, write_camera
from .course import HeatmapDetector, bin_spatial, color_hist, draw_labeled_bboxes, get_hog_features
from .datasets import (
    FrameSet,
    PatchSet,
    fetch_patches,
    load_frames,
    load_patches,
    load_training_patches,
    open_tracks,
    read_labels,
    write_labels,
    write_tracks,
)
from .detector import Detector, VehicleDetector, detect, load_model
from .drawing import blur_boxes, draw_boxes, draw_detections
from .drive import (
    ReportWriter,
    count_vehicles,
    find_events,
    open_trip,
    read_own_speed,
    run_batch,
    write_events,
    write_subtitles,
)
from .errors import (
    DatasetError,
    DetectorError,
    InvalidInputError,
    ModelFileError,
    OutputError,
    TransientVideoError,
    VehicleDetectionError,
    VideoError,
)
from .evaluation import LabelledFrames, evaluate_detections, evaluate_tracks, explain
from .features import (
    FeatureParams,
    convert_color,
    extract_features,
    single_img_features,
)
from .function_model import FunctionParams, detector_from
from .heatmap import HeatHistory, HeatParams, add_heat, apply_threshold, bounding_boxes, label_boxes
from .images import read_image, write_image
from .network import NetworkModel, NetworkParams
from .notebook import Explorer
from .regions import RegionParams, find_vehicles
from .results import ImageDetections
from .scenes import render_drive, render_patches, render_scene
from .search import SearchBand, SearchParams
from .svm import VehicleClassifier, load_classifier
from .tables import TrackTable
from .tracking import FrameResult, Track, Tracker, TrackParams, estimate_horizon
from .training import TrainingOptions, train_and_evaluate, train_classifier
from .video import (
    VideoInfo,
    annotate_clip,
    open_source,
    probe_video,
    process_video,
    read_frames,
    track,
    write_video,
)
from .windows import find_cars, search_windows, slide_window

__version__: str
__all__ = [
    "Annotator",
    "Camera",
    "DatasetError",
    "Detections",
    "Detector",
    "DetectorError",
    "DrawParams",
    "Explorer",
    "FeatureParams",
    "FrameResult",
    "FrameSet",
    "FunctionParams",
    "HeatHistory",
    "HeatParams",
    "HeatmapDetector",
    "ImageDetections",
    "InvalidInputError",
    "LabelledFrames",
    "ModelFileError",
    "NetworkModel",
    "NetworkParams",
    "OutputError",
    "PatchSet",
    "RegionParams",
    "ReportWriter",
    "SearchBand",
    "SearchParams",
    "Track",
    "TrackParams",
    "TrackTable",
    "Tracker",
    "TrainingOptions",
    "TransientVideoError",
    "VehicleClassifier",
    "VehicleDetectionError",
    "VehicleDetector",
    "VideoError",
    "VideoInfo",
    "add_heat",
    "annotate_clip",
    "apply_threshold",
    "bin_spatial",
    "blur_boxes",
    "bounding_boxes",
    "clip_boxes",
    "color_hist",
    "convert_color",
    "count_vehicles",
    "course",
    "datasets",
    "detect",
    "detector_from",
    "draw_boxes",
    "draw_detections",
    "draw_diagnostics",
    "draw_labeled_bboxes",
    "draw_tracks",
    "drive",
    "estimate_horizon",
    "evaluate_detections",
    "evaluate_tracks",
    "evaluation",
    "explain",
    "extract_features",
    "fetch_patches",
    "find_cars",
    "find_events",
    "find_vehicles",
    "get_hog_features",
    "iou_matrix",
    "label_boxes",
    "load_classifier",
    "load_frames",
    "load_model",
    "load_patches",
    "load_training_patches",
    "non_max_suppression",
    "notebook",
    "open_camera",
    "open_source",
    "open_tracks",
    "open_trip",
    "probe_video",
    "process_video",
    "read_camera",
    "read_frames",
    "read_image",
    "read_labels",
    "read_own_speed",
    "render_drive",
    "render_patches",
    "render_scene",
    "run_batch",
    "search_windows",
    "single_img_features",
    "slide_window",
    "track",
    "tracking",
    "train_and_evaluate",
    "train_classifier",
    "training",
    "write_camera",
    "write_events",
    "write_image",
    "write_labels",
    "write_subtitles",
    "write_tracks",
    "write_video",
]
