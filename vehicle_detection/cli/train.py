"""The commands on models: train, download training patches, show a model."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from vehicle_detection.cli.options import PATCHES, flag, option
from vehicle_detection.cli.output import (
    capture_stderr,
    check_distinct_paths,
    name_kept_files,
    option_names,
    output_folder,
    print_facts,
    print_line,
    print_table,
    run_interruptible,
)

if TYPE_CHECKING:
    from vehicle_detection.training import TrainingReport

# Columns of the model card that a terminal has no room for.
_HIDDEN_FOLD_COLUMNS = (
    "best_f1", "false_per_vehicle_free_frame", "strict_average_precision", "recall_occluded",
    "recall_truncated", "recall_narrow", "calibration_error",
)  # fmt: skip


@option_names(random_state="--seed", patches_or_labels=PATCHES, patch_set=PATCHES)
def train(
    vehicles: Annotated[Path, option("PATH", "Folder or zip of patches of vehicles, such as vehicles.zip.")],
    non_vehicles: Annotated[
        Path, option("PATH", "Folder or zip of other patches, such as non-vehicles.zip.")
    ],
    output: Annotated[
        Path, option("FILE", "Model file to write, such as own.safetensors.", "-o", "--output")
    ],
    features: Annotated[
        str, option("PRESET", "lab-9432, lab-8460, ycrcb-8460, ycrcb-6156 or luv-2384.")
    ] = "lab-9432",
    split: Annotated[
        str, option("random|sequences", "Split whose accuracy is reported as the model's.")
    ] = "random",
    C: Annotated[float, option("F", "Inverse regularization strength.", "--C")] = 1e-4,
    seed: Annotated[int, option("N", "Random seed of solver and first split.")] = 0,
    no_mirror: Annotated[bool, flag("--no-mirror", help="Train without mirrored copies.")] = False,
    gamma: Annotated[
        float | None,
        option("F", "Brightness range of mirrored copies, such as 0.3; default: 0.4, without mirroring 0."),
    ] = None,
    degraded: Annotated[
        float, option("W", "Weight of blurred, pale and compressed copies of each patch, 0-1.")
    ] = 0.05,
    solver: Annotated[str, option("dual|liblinear", "liblinear is LinearSVC: same model, slower.")] = "dual",
    report: Annotated[Path | None, option("FILE.json", "Scores on every split, timings.")] = None,
    card: Annotated[Path | None, option("FILE.md", "Model card to write.")] = None,
    compare: Annotated[
        list[str] | None, option("PRESET", "Other features to evaluate, such as luv-2384; repeatable.")
    ] = None,
) -> None:
    """Train a model on patches, and evaluate it on held-out patches; by default like the model "highway"."""
    from vehicle_detection._common import check_target, encodable, write_text
    from vehicle_detection.datasets import load_training_patches
    from vehicle_detection.params import FeatureParams
    from vehicle_detection.training import model_card, train_and_evaluate

    named = {"--output": output, "--report": report, "--card": card}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_distinct_paths({"--non-vehicles": non_vehicles, **targets}, {"--vehicles": vehicles})
    with option_names(preset="--features"):
        presets = [FeatureParams.preset(features)]
    with option_names(preset="--compare"):
        presets += [FeatureParams.preset(name) for name in compare or ()]
    if gamma is None:
        gamma = 0.0 if no_mirror else 0.4
    options: dict[str, Any] = {"C": C, "mirror": not no_mirror, "gamma": gamma, "degraded": degraded}
    options |= {"solver": solver, "random_state": seed, "split": split}

    with capture_stderr():
        patches = load_training_patches(vehicles, non_vehicles)

    def train_all() -> list[Any]:
        return [train_and_evaluate(patches, params=params, progress=True, **options) for params in presets]

    (classifier, evaluated), *rest = run_interruptible(train_all)
    others = [other for _, other in rest]
    for each in (evaluated, *others):
        _print_report(each)
    with name_kept_files(targets.values()):
        classifier.save(output)
        if report is not None:
            plain = evaluated.to_dict() | {"others": [other.to_dict() for other in others]}
            write_text(report, json.dumps(plain, indent=2) + "\n")
        if card is not None:
            words = ["--vehicles", vehicles.name, "--non-vehicles", non_vehicles.name, "--features", features]
            words += ["--split", split, "--C", f"{C:g}", "--seed", str(seed)] + ["--no-mirror"] * no_mirror
            words += ["--gamma", f"{gamma:g}", "--degraded", f"{degraded:g}"]
            words += ["--solver", solver] if solver != "dual" else []
            words += [word for name in compare or () for word in ("--compare", name)]
            words += ["-o", output.name, "--card", card.name]
            command = shlex.join(["vehicle-detection", "train", *words])
            text = model_card(classifier, evaluated, name=output.stem, others=others, command=command)
            write_text(card, encodable(text))
    print_line(f"wrote {', '.join(map(str, targets.values()))}")


def _print_report(report: TrainingReport) -> None:
    from vehicle_detection.training import SPLITS, report_table

    print_table(
        f"{report.features}: {report.vehicles:,} vehicles, {report.non_vehicles:,} others, accuracy "
        f"{report.accuracy:.4f} on the split {report.split!r}",
        *report_table(report),
    )
    if report.calibration_error is not None:
        print_line(f"calibration error on the split 'sequences': {report.calibration_error:.4f}")
    for name, reason in report.skipped.items():
        print_line(f"left out {SPLITS[name]!r}: {reason}")
    print_line(", ".join(f"{name} {seconds:.1f} s" for name, seconds in report.seconds.items()))


def fetch(
    output: Annotated[
        Path | None, option("DIR", "Folder, such as data; default: the user's cache.", "-o", "--output")
    ] = None,
) -> None:
    """Download the course's training patches (110 MB) once."""
    from vehicle_detection.datasets import fetch_patches

    with output_folder(output, "--output"):
        paths = fetch_patches(output, progress=sys.stderr.isatty())
    for path in paths:
        print_line(str(path))


def info(
    model: Annotated[
        str, Argument(metavar="MODEL", help='"default", "highway" or a model file, such as own.onnx.')
    ] = "default",
) -> None:
    """Show a model's parameters, accuracy, training data and versions."""
    from vehicle_detection.loading import load_model

    loaded = load_model(model)
    title, facts = loaded.summary()
    print_facts(f"{model}: {title}", facts)
    for name, values in loaded.metadata.items():
        if name != "metrics" or not _print_metrics(values):
            print_facts(name, values if isinstance(values, dict) else {"": values})


def _print_metrics(metrics: object) -> bool:
    """Print a model's metrics as a table; False if they are not those of `train` or `train-frames`."""
    from vehicle_detection.training import SPLITS, split_table

    splits, folds = (
        metrics.get(key) if isinstance(metrics, dict) else None for key in ("splits", "left_out")
    )
    if isinstance(splits, dict) and splits.keys() <= SPLITS.keys():
        print_table("metrics", *split_table(splits))
        return True
    if isinstance(folds, dict):
        print_fold_scores(folds)
        return True
    return False


def print_fold_scores(scores: Mapping[str, Mapping[str, Any]]) -> None:
    """Print a table of the values of `FoldScore`, with a row per set of frames."""
    from vehicle_detection.mixture_training import FOLD_COLUMNS, format_fold

    shown = [number for number, name in enumerate(FOLD_COLUMNS) if name not in _HIDDEN_FOLD_COLUMNS]
    titles = [title for title, _ in FOLD_COLUMNS.values()]
    rows = []
    for name, values in scores.items():
        cells = format_fold(values)
        rows.append((name, *(cells[number] for number in shown)))
    heads = ("frames", *(titles[number] for number in shown))
    print_table("on sources left out of training, IoU 0.5", heads, rows)


@option_names(random_state="--seed", sources="DATA")
def train_frames(
    data: Annotated[
        Path,
        Argument(metavar="DATA", help="Folder with labels/NAME.csv and frames/NAME/ or videos/NAME.mp4."),
    ],
    output: Annotated[
        Path, option("FILE", "Model file to write, such as own.safetensors.", "-o", "--output")
    ],
    patches: Annotated[
        Path | None, option("PATH", "Folder or zip of patches with more vehicles, such as vehicles.zip.")
    ] = None,
    curves: Annotated[
        Path | None, option("FILE.csv", "Precision and recall on each source left out of training.")
    ] = None,
    drawn: Annotated[bool, Option("--drawn/--no-drawn", help="Also train on rendered frames.")] = True,
    seed: Annotated[int, option("N", "Random seed.")] = 0,
) -> None:
    """Train a model for any road on labelled frames, and evaluate it by cross-validation over the sources."""
    from vehicle_detection._common import check_suffix, check_target, pluralize
    from vehicle_detection.datasets import load_patches
    from vehicle_detection.mixture_training import (
        check_sources,
        cross_validate_mixture,
        drawn_source,
        find_sources,
        training_metadata,
        write_curves,
    )

    named = {"--output": output, "--curves": curves}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_distinct_paths(targets, {"DATA": data})
    check_suffix(output, "--output", (".safetensors",))
    sources = find_sources(data)
    check_sources(sources, min_count=2)
    for source in sources:
        for part in source.sets:
            empty = sum(not len(part.labels.rows(key)) for key in part.keys)
            boxes = pluralize(len(part.labels), "box", "es")
            print_line(f"{source.name}: {pluralize(len(part), 'frame')}, {boxes}, {empty} frames without any")
    vehicles = [] if patches is None else list(load_patches(patches, label=1).patches)
    extra = [drawn_source(random_state=seed)] if drawn else []
    model, scores, folds = cross_validate_mixture(
        sources, extra_sources=extra, patches=vehicles, random_state=seed, on_step=print_line
    )
    metadata = training_metadata(scores, [*sources, *extra], seed, len(vehicles))
    with name_kept_files(targets.values()):
        model.with_metadata(metadata).save(output)
        if curves is not None:
            write_curves(curves, folds)
    print_fold_scores({score.name: score.to_dict() for score in scores})
    print_line(f"wrote {', '.join(map(str, targets.values()))}")
