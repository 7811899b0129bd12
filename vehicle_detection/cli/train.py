"""The commands on models: train, download training patches, show a model."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument

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
    from vehicle_detection.features import FeatureParams
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

    if not isinstance(metrics, dict):
        return False
    splits, left_out, held_out = (metrics.get(key) for key in ("splits", "left_out", "held_out"))
    if isinstance(splits, dict) and splits.keys() <= SPLITS.keys():
        print_table("metrics", *split_table(splits))
    elif isinstance(left_out, dict):
        print_fold_scores(left_out, "on frames of sources that training left out, IoU 0.5")
    elif isinstance(held_out, dict):
        _print_held_out(held_out, metrics.get("held_out_before", {}))
    else:
        return False
    return True


def print_fold_scores(scores: Mapping[str, Mapping[str, Any]], title: str) -> None:
    """Print a table of the values of `FoldScore`, with a row per set of frames."""
    from vehicle_detection.training import FOLD_COLUMNS, format_fold

    shown = [number for number, name in enumerate(FOLD_COLUMNS) if name not in _HIDDEN_FOLD_COLUMNS]
    titles = [title for title, _ in FOLD_COLUMNS.values()]
    rows = []
    for name, values in scores.items():
        cells = format_fold(values)
        rows.append((name, *(cells[number] for number in shown)))
    print_table(title, ("frames", *(titles[number] for number in shown)), rows)


def _print_held_out(after: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Print the scores of a fine-tuned network and those of the initial one."""
    if not after:
        print_line("no frame was held out: the accuracy is unknown")
        return
    rows: dict[str, Mapping[str, Any]] = {}
    for name, values in after.items():
        rows |= {f"{name}, before": before.get(name, {}), name: values}
    print_fold_scores(rows, "on the frames held out of training, IoU 0.5")


@option_names(random_state="--seed", sources="DATA", initial="--model")
def train_frames(
    data: Annotated[
        Path,
        Argument(metavar="DATA", help="Folder with labels/NAME.csv and frames/NAME/ or videos/NAME.mp4."),
    ],
    output: Annotated[Path, option("FILE", "Model file to write, such as own.onnx.", "-o", "--output")],
    model: Annotated[
        str, option("MODEL", '"default" or a file of this command to continue from, such as own.onnx.')
    ] = "default",
    steps: Annotated[
        int | None,
        option("N", "Steps of 8 samples, 0.6 s each on two cores; default: 5 per frame, 200 to 1200."),
    ] = None,
    device: Annotated[str | None, option("cpu|cuda", "Default: cuda where PyTorch offers it.")] = None,
    curves: Annotated[
        Path | None, option("FILE.csv", "Precision and recall on each set of held-out frames.")
    ] = None,
    jobs: Annotated[int | None, option("N", "Threads, such as 2; default: all cores.")] = None,
    seed: Annotated[int, option("N", "Random seed.")] = 0,
) -> None:
    """Continue the training of the default model on labelled frames, and evaluate it on a fifth of them.

    An interrupted training is continued by the same command.
    """
    from vehicle_detection._common import check_suffix, check_target, pluralize
    from vehicle_detection.training import find_sources, fine_tune_network, write_curves

    named = {"--output": output, "--curves": curves}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_distinct_paths(targets, {"DATA": data})
    check_suffix(output, "--output", (".onnx",))
    sources = find_sources(data)
    for source in sources:
        for part in source.sets:
            empty = sum(not len(part.labels.rows(key)) for key in part.keys)
            boxes = pluralize(len(part.labels), "box", "es")
            print_line(f"{source.name}: {pluralize(len(part), 'frame')}, {boxes}, {empty} frames without any")
    checkpoint = output.with_name(f"{output.name}.checkpoint")
    if checkpoint.exists():
        print_line(f"continuing the training of {checkpoint}")
    try:
        tuned = fine_tune_network(
            sources,
            initial=model,
            steps=steps,
            random_state=seed,
            n_jobs=jobs,
            device=device,
            checkpoint=checkpoint,
            on_step=lambda _, line: print_line(line),
        )
    except KeyboardInterrupt as error:
        if checkpoint.exists():
            error.args = (f"; the same command continues from {checkpoint}",)
        raise
    with name_kept_files(targets.values()):
        tuned.model.save(output)
        if curves is not None:
            write_curves(curves, tuned.folds)
    metrics = tuned.model.metadata["metrics"]
    _print_held_out(metrics["held_out"], metrics["held_out_before"])
    print_line(f"wrote {', '.join(map(str, targets.values()))}")
