"""Training: patch classifiers with their evaluation, and the labelled or rendered frames of detectors."""

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

__all__ = [
    "SPLITS",
    "SplitScore",
    "TrainingReport",
    "markdown_table",
    "markdown_text",
    "model_card",
    "report_table",
    "split_table",
    "train_and_evaluate",
]
