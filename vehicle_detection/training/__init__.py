"""Training of patch classifiers and of networks, their validation, and parameter search.

What needs PyTorch or scikit-learn is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training.classifier import (
    DEFAULT_C,
    TrainingOptions,
    check_labels,
    fit_features,
    patch_features,
    train_classifier,
)
from vehicle_detection.training.feature_cache import FeatureCache, digest_of
from vehicle_detection.training.frames import (
    FrameDataset,
    TrainingFrame,
    check_sources,
    find_sources,
    load_training_frames,
    select_frames,
)
from vehicle_detection.training.mining import mine_negatives
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
from vehicle_detection.training.results import (
    RowStore,
    check_column,
    make_table,
    numeric_column,
    pareto_front,
    read_results,
    write_results,
)
from vehicle_detection.training.trials import TrialConfig, TrialOptions, expand_grid, parse_grid
from vehicle_detection.training.tuning import (
    Halving,
    compare_classifiers,
    compare_configurations,
    search_parameters,
)
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

if TYPE_CHECKING:
    from vehicle_detection.training.export import export_network, set_metadata
    from vehicle_detection.training.fine_tune import (
        FineTuning,
        detect_logits,
        file_params,
        fine_tune_network,
        fingerprint,
        load_content,
        package_versions,
        score_logits,
    )
    from vehicle_detection.training.network import (
        NetworkTraining,
        load_weights,
        save_weights,
        train_network,
    )
    from vehicle_detection.training.pipeline import PatchFeatures, to_pipeline
    from vehicle_detection.training.weights import read_weights

_MODULES = {
    "export": ("export_network", "set_metadata"),
    "fine_tune": (
        "FineTuning", "detect_logits", "file_params", "fine_tune_network", "fingerprint", "load_content",
        "package_versions", "score_logits",
    ),
    "pipeline": ("PatchFeatures", "to_pipeline"),
    "network": ("NetworkTraining", "load_weights", "save_weights", "train_network"),
    "weights": ("read_weights",),
}  # fmt: skip
_PACKAGES = ("torch", "onnx", "google")


def __getattr__(name: str) -> Any:
    """Import what needs PyTorch, onnx or scikit-learn, when it is used."""
    for module, names in _MODULES.items():
        if name in names:
            try:
                return getattr(importlib.import_module(f"{__name__}.{module}"), name)
            except ModuleNotFoundError as error:
                if (error.name or "").partition(".")[0] not in _PACKAGES:
                    raise
                raise InvalidInputError(
                    f"training a network needs the package {error.name}, which is not installed; run "
                    'pip install "vehicle-detection[train]"'
                ) from error
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "DEFAULT_C",
    "FOLD_COLUMNS",
    "SPLITS",
    "FeatureCache",
    "FineTuning",
    "FoldDetections",
    "FoldScore",
    "FrameDataset",
    "Halving",
    "NetworkTraining",
    "PatchFeatures",
    "RowStore",
    "SearchableModel",
    "SplitScore",
    "TrainingFrame",
    "TrainingOptions",
    "TrainingReport",
    "TrialConfig",
    "TrialOptions",
    "best_threshold",
    "check_column",
    "check_labels",
    "check_sources",
    "compare_classifiers",
    "compare_configurations",
    "detect_in_source",
    "detect_logits",
    "digest_of",
    "expand_grid",
    "export_network",
    "file_params",
    "find_sources",
    "fine_tune_network",
    "fingerprint",
    "fit_features",
    "fit_log_odds",
    "format_fold",
    "load_content",
    "load_training_frames",
    "load_weights",
    "make_table",
    "markdown_table",
    "markdown_text",
    "mine_negatives",
    "model_card",
    "numeric_column",
    "package_versions",
    "pareto_front",
    "parse_grid",
    "patch_features",
    "read_results",
    "read_weights",
    "rendered_source",
    "report_table",
    "save_weights",
    "score_fold",
    "score_logits",
    "search_parameters",
    "select_frames",
    "set_metadata",
    "split_table",
    "to_pipeline",
    "train_and_evaluate",
    "train_classifier",
    "train_network",
    "write_curves",
    "write_results",
]
