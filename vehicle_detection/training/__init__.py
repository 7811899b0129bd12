"""Training: patch classifiers with their evaluation, and the labelled or rendered frames of detectors."""

from vehicle_detection.training.frames import (
    FrameDataset,
    TrainingFrame,
    check_sources,
    find_sources,
    load_training_frames,
)
from vehicle_detection.training.patches import (
    SPLITS,
    SplitScore,
    TrainingReport,
    markdown_table,
    markdown_text,
    model_card,
    report_table,
    split_table,
    train_and_evaluate,
)
from vehicle_detection.training.rendered import rendered_source
from vehicle_detection.training.validation import (
    FOLD_COLUMNS,
    FoldDetections,
    FoldScore,
    SearchableModel,
    best_threshold,
    detect_in_source,
    fit_log_odds,
    format_fold,
    score_fold,
    write_curves,
)

__all__ = [
    "FOLD_COLUMNS",
    "SPLITS",
    "FoldDetections",
    "FoldScore",
    "FrameDataset",
    "SearchableModel",
    "SplitScore",
    "TrainingFrame",
    "TrainingReport",
    "best_threshold",
    "check_sources",
    "detect_in_source",
    "find_sources",
    "fit_log_odds",
    "format_fold",
    "load_training_frames",
    "markdown_table",
    "markdown_text",
    "model_card",
    "rendered_source",
    "report_table",
    "score_fold",
    "split_table",
    "train_and_evaluate",
    "write_curves",
]
