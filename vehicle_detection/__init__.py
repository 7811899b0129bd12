"""Classical vehicle detection and tracking in dash-cam images and video.

The names below are loaded when they are first used, so that importing the package takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from vehicle_detection.boxes import Detections, clip_boxes, iou_matrix, non_max_suppression
    from vehicle_detection.camera import Camera, HorizonEstimate, estimate_horizon
    from vehicle_detection.classifier import VehicleClassifier, load_classifier, train_classifier
    from vehicle_detection.datasets import (
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
    from vehicle_detection.detector import FrameResult, VehicleDetector
    from vehicle_detection.drawing import draw_boxes, draw_diagnostics, draw_labeled_bboxes, draw_tracks
    from vehicle_detection.errors import (
        DatasetError,
        InvalidInputError,
        ModelFileError,
        VehicleDetectionError,
        VideoError,
    )
    from vehicle_detection.evaluation import (
        LabelledFrames,
        calibrate_scores,
        calibration_error,
        evaluate_detections,
        evaluate_tracks,
        precision_recall_curve,
        read_labels,
    )
    from vehicle_detection.explorer import Explorer
    from vehicle_detection.export import TrackWriter, write_boxes, write_tracks
    from vehicle_detection.features import (
        PatchFeatures,
        bin_spatial,
        color_hist,
        convert_color,
        extract_features,
        get_hog_features,
        hog_blocks,
        hog_image,
        single_img_features,
    )
    from vehicle_detection.heatmap import HeatHistory, add_heat, apply_threshold, bounding_boxes, label_boxes
    from vehicle_detection.images import read_image, write_image
    from vehicle_detection.mixture import MixtureSearch, TemplateMixture, load_model
    from vehicle_detection.mixture_training import (
        FrameDataset,
        cross_validate_mixture,
        train_mixture,
    )
    from vehicle_detection.params import (
        FeatureParams,
        HeatParams,
        MixtureParams,
        PyramidParams,
        RegionParams,
        SearchBand,
        SearchParams,
        TrackParams,
    )
    from vehicle_detection.plotting import (
        describe_image,
        plot_balance,
        plot_bands,
        plot_channels,
        plot_comparison,
        plot_errors,
        plot_f1,
        plot_features,
        plot_heatmap,
        plot_hog,
        plot_methods,
        plot_near_duplicates,
        plot_parameter,
        plot_patches,
        plot_precision_recall,
        plot_scores,
        plot_speedups,
        plot_split_scores,
        plot_stage_times,
        plot_tracks,
        plot_tradeoff,
        plot_weights,
        plot_windows,
        show_images,
    )
    from vehicle_detection.regions import find_vehicles, fit_boxes, group_windows
    from vehicle_detection.report import ReportWriter
    from vehicle_detection.search import find_cars
    from vehicle_detection.synthetic import render_drive, render_patches, render_scene
    from vehicle_detection.tracking import Track, Tracker
    from vehicle_detection.training import train_and_evaluate
    from vehicle_detection.tuning import (
        TrialOptions,
        compare_configurations,
        mine_negatives,
        pareto_front,
        read_results,
        search_parameters,
    )
    from vehicle_detection.video import VideoReport, probe_video, process_video, read_frames
    from vehicle_detection.windows import search_windows, slide_window

__all__ = [
    "Camera",
    "DatasetError",
    "Detections",
    "Explorer",
    "FeatureParams",
    "FrameDataset",
    "FrameResult",
    "HeatHistory",
    "HeatParams",
    "HorizonEstimate",
    "InvalidInputError",
    "LabelledFrames",
    "MixtureParams",
    "MixtureSearch",
    "ModelFileError",
    "PatchFeatures",
    "PyramidParams",
    "RegionParams",
    "ReportWriter",
    "SearchBand",
    "SearchParams",
    "TemplateMixture",
    "Track",
    "TrackParams",
    "TrackWriter",
    "Tracker",
    "TrialOptions",
    "VehicleClassifier",
    "VehicleDetectionError",
    "VehicleDetector",
    "VideoError",
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
    "describe_image",
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
    "fit_boxes",
    "get_hog_features",
    "group_windows",
    "hog_blocks",
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
    "pareto_front",
    "plot_balance",
    "plot_bands",
    "plot_channels",
    "plot_comparison",
    "plot_errors",
    "plot_f1",
    "plot_features",
    "plot_heatmap",
    "plot_hog",
    "plot_methods",
    "plot_near_duplicates",
    "plot_parameter",
    "plot_patches",
    "plot_precision_recall",
    "plot_scores",
    "plot_speedups",
    "plot_split_scores",
    "plot_stage_times",
    "plot_tracks",
    "plot_tradeoff",
    "plot_weights",
    "plot_windows",
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
    "show_images",
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

_ROOMS = {
    "tuning": (
        "TrialOptions",
        "compare_configurations",
        "mine_negatives",
        "pareto_front",
        "read_results",
        "search_parameters",
    ),
    "plotting": (
        "describe_image",
        "plot_balance",
        "plot_bands",
        "plot_channels",
        "plot_comparison",
        "plot_errors",
        "plot_f1",
        "plot_features",
        "plot_heatmap",
        "plot_hog",
        "plot_methods",
        "plot_near_duplicates",
        "plot_parameter",
        "plot_patches",
        "plot_precision_recall",
        "plot_scores",
        "plot_speedups",
        "plot_split_scores",
        "plot_stage_times",
        "plot_tracks",
        "plot_tradeoff",
        "plot_weights",
        "plot_windows",
        "show_images",
    ),
    "explorer": ("Explorer",),
    "horizon": ("HorizonEstimate", "estimate_horizon"),
    "mixture": ("MixtureSearch", "TemplateMixture", "load_model"),
    "mixture_training": ("FrameDataset", "train_mixture"),
    "mixture_report": ("cross_validate_mixture",),
    "training": ("train_and_evaluate",),
    "errors": ("DatasetError", "InvalidInputError", "ModelFileError", "VehicleDetectionError", "VideoError"),
    "params": (
        "FeatureParams",
        "HeatParams",
        "MixtureParams",
        "PyramidParams",
        "RegionParams",
        "SearchBand",
        "SearchParams",
        "TrackParams",
    ),
    "images": ("read_image", "write_image"),
    "boxes": ("Detections", "clip_boxes", "iou_matrix", "non_max_suppression"),
    "camera": ("Camera",),
    "features": (
        "PatchFeatures",
        "bin_spatial",
        "color_hist",
        "convert_color",
        "extract_features",
        "get_hog_features",
        "hog_blocks",
        "hog_image",
        "single_img_features",
    ),
    "datasets": (
        "fetch_patches",
        "find_near_duplicates",
        "load_frames",
        "load_patches",
        "load_training_patches",
        "split_groups",
        "split_leakage",
        "split_random",
        "split_sequences",
        "split_sources",
    ),
    "synthetic": ("render_drive", "render_patches", "render_scene"),
    "classifier": ("VehicleClassifier", "load_classifier", "train_classifier"),
    "windows": ("search_windows", "slide_window"),
    "search": ("find_cars",),
    "heatmap": ("HeatHistory", "add_heat", "apply_threshold", "bounding_boxes", "label_boxes"),
    "regions": ("find_vehicles", "fit_boxes", "group_windows"),
    "tracking": ("Track", "Tracker"),
    "drawing": ("draw_boxes", "draw_diagnostics", "draw_labeled_bboxes", "draw_tracks"),
    "detector": ("FrameResult", "VehicleDetector"),
    "video": ("VideoReport", "probe_video", "process_video", "read_frames"),
    "evaluation": (
        "LabelledFrames",
        "calibrate_scores",
        "calibration_error",
        "evaluate_detections",
        "evaluate_tracks",
        "precision_recall_curve",
        "read_labels",
    ),
    "export": ("TrackWriter", "write_boxes", "write_tracks"),
    "report": ("ReportWriter",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_ROOM_OF})
