"""The command that shows a model, and the tables of scores that training prints too."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.output import print_facts, print_line, print_table

# Columns of the model card that a terminal has no room for.
_HIDDEN_FOLD_COLUMNS = (
    "best_f1", "false_per_vehicle_free_frame", "strict_average_precision", "recall_occluded",
    "recall_truncated", "recall_narrow", "calibration_error",
)  # fmt: skip


def info(
    model: str = Argument(
        "default", metavar="MODEL", help='"default", "highway" or a model file, such as own.onnx.'
    ),
) -> None:
    """Show a model's parameters, accuracy, training data and versions."""
    loaded = vd.load_model(model)
    title, facts = loaded.summary()
    print_facts(f"{model}: {title}", {"license": common.model_terms(loaded.metadata), **facts})
    for name, values in loaded.metadata.items():
        printed = False  # metrics of another shape are printed as they are
        with contextlib.suppress(AttributeError, KeyError, OverflowError, TypeError, ValueError):
            printed = name == "metrics" and _print_metrics(values)
        if not printed:
            print_facts(name, values if isinstance(values, dict) else {"": values})


def _print_metrics(metrics: object) -> bool:
    """Print a model's metrics as a table; False if they are not those of `train` or `train-frames`."""
    from vehicle_detection.training import SPLITS, split_table

    if not isinstance(metrics, dict):
        return False
    splits, left_out, held_out = (metrics.get(key) for key in ("splits", "left_out", "held_out"))
    if isinstance(splits, dict) and splits.keys() <= SPLITS.keys():
        print_table("metrics", *split_table(splits))
    elif isinstance(left_out, dict):
        _print_fold_scores(left_out, "on frames of sources that training left out, IoU 0.5")
    elif isinstance(held_out, dict):
        print_held_out(held_out, metrics.get("held_out_before", {}))
    else:
        return False
    return True


def print_held_out(after: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Print the scores of a fine-tuned network and those of the initial one."""
    if not after:
        print_line("no frame was held out: the accuracy is unknown")
        return
    rows: dict[str, Mapping[str, Any]] = {}
    for name, values in after.items():
        rows |= {f"{name}, before": before.get(name, {}), name: values}
    _print_fold_scores(rows, "on the frames held out of training, IoU 0.5")


def _print_fold_scores(scores: Mapping[str, Mapping[str, Any]], title: str) -> None:
    """Print a table of the values of `FoldScore`, with a row per set of frames."""
    from vehicle_detection.training import FOLD_COLUMNS, format_fold

    shown = [number for number, name in enumerate(FOLD_COLUMNS) if name not in _HIDDEN_FOLD_COLUMNS]
    titles = [title for title, _ in FOLD_COLUMNS.values()]
    rows = [(name, *(format_fold(values)[number] for number in shown)) for name, values in scores.items()]
    print_table(title, ("frames", *(titles[number] for number in shown)), rows)
