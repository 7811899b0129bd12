"""The command that trains a classifier on patches."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.options import NON_VEHICLES, PATCHES, VEHICLES, flag, option
from vehicle_detection.cli.output import (
    capture_stderr,
    check_distinct_paths,
    check_targets,
    name_kept_files,
    option_names,
    output_folder,
    print_error,
    print_line,
    print_table,
    run_interruptible,
)


def fetch(
    output: Path | None = option("DIR", "Folder, such as data; default: the user's cache.", "-o", "--output"),
) -> None:
    """Download the course's training patches (110 MB) once."""
    with output_folder(output, "--output"):
        paths = vd.fetch_patches(output, progress=sys.stderr.isatty())
    for path in paths:
        print_line(str(path))


@option_names(random_state="--seed", patches_or_labels=PATCHES, patch_set=PATCHES)
def train(
    vehicles: Path = VEHICLES,
    non_vehicles: Path = NON_VEHICLES,
    output: Path = option(
        "FILE", "Model file to write, such as own.safetensors.", "-o", "--output", default=...
    ),
    features: str = option(
        "PRESET", "lab-9432, lab-8460, ycrcb-8460, ycrcb-6156 or luv-2384.", default="lab-9432"
    ),
    split: str = option(
        "random|sequences", "Split whose accuracy is reported as the model's.", default="random"
    ),
    C: float = option("F", "Inverse regularization strength.", "--C", default=1e-4),
    seed: int = option("N", "Random seed of solver and first split.", default=0),
    no_mirror: bool = flag("--no-mirror", "Train without mirrored copies."),
    gamma: float | None = option(
        "F", "Brightness range of mirrored copies, such as 0.3; default: 0.4, without mirroring 0."
    ),
    degraded: float = option(
        "W", "Weight of blurred, pale and compressed copies of each patch, 0-1.", default=0.05
    ),
    report: Path | None = option("FILE.json", "Scores on every split, timings."),
    card: Path | None = option("FILE.md", "Model card to write."),
    compare: list[str] | None = option("PRESET", "Other features to evaluate, such as luv-2384; repeatable."),
) -> None:
    """Train a model on patches, and evaluate it on held-out patches; by default like the model "highway"."""
    check_distinct_paths({"--non-vehicles": non_vehicles}, {"--vehicles": vehicles})
    sources = {"--vehicles": vehicles, "--non-vehicles": non_vehicles}
    targets = check_targets({"--output": output, "--report": report, "--card": card}, sources)
    with option_names(preset="--features"):
        presets = [vd.FeatureParams.preset(features)]
    with option_names(preset="--compare"):
        presets += [vd.FeatureParams.preset(name) for name in compare or ()]
    if gamma is None:
        gamma = 0.0 if no_mirror else 0.4
    training = vd.TrainingOptions(
        C=C, mirror=not no_mirror, gamma=gamma, degraded=degraded, random_state=seed
    )
    options: dict[str, Any] = {"options": training, "split": split, "progress": True}

    with capture_stderr() as messages:
        patches = vd.load_training_patches(vehicles, non_vehicles)
    for message in messages:
        if message.startswith("warning: "):  # of the library, not of a decoder
            print_error(message)

    def train_all() -> list[Any]:
        return [vd.train_and_evaluate(patches, params=params, **options) for params in presets]

    (classifier, evaluated), *rest = run_interruptible(train_all)
    others = [other for _, other in rest]
    for each in (evaluated, *others):
        _print_report(each)
    with name_kept_files(targets):
        classifier.save(output)
        if report is not None:
            plain = evaluated.to_dict() | {"others": [other.to_dict() for other in others]}
            common.write_text(report, json.dumps(plain, indent=2) + "\n")
        if card is not None:
            words = ["--vehicles", vehicles.name, "--non-vehicles", non_vehicles.name, "--features", features]
            words += ["--split", split, "--C", f"{C:g}", "--seed", str(seed)] + ["--no-mirror"] * no_mirror
            words += ["--gamma", f"{gamma:g}", "--degraded", f"{degraded:g}"]
            words += [word for name in compare or () for word in ("--compare", name)]
            words += ["-o", output.name, "--card", card.name]
            command = shlex.join(["vehicle-detection", "train", *words])
            text = vd.training.model_card(
                classifier, evaluated, name=output.stem, others=others, command=command
            )
            common.write_text(card, common.encodable(text))
    print_line(f"wrote {', '.join(map(str, targets))}")


def _print_report(report: vd.training.TrainingReport) -> None:
    print_table(
        f"{report.features}: {report.vehicles:,} vehicles, {report.non_vehicles:,} others, accuracy "
        f"{report.accuracy:.4f} on the split {report.split!r}",
        *vd.training.report_table(report),
    )
    if report.calibration_error is not None:
        print_line(f"calibration error on the split 'sequences': {report.calibration_error:.4f}")
    for name, reason in report.skipped.items():
        print_line(f"left out {vd.training.SPLITS[name]!r}: {reason}")
    print_line(", ".join(f"{name} {seconds:.1f} s" for name, seconds in report.seconds.items()))
