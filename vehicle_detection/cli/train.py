"""The commands around models: train one, fetch the patches for it, tell what one is."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehicle_detection.cli.output import (
    check_apart,
    codec_messages,
    interruptible,
    output_folder,
    print_facts,
    print_table,
)
from vehicle_detection.cli.train_frames import print_road_scores

if TYPE_CHECKING:
    from vehicle_detection.training import TrainingReport


def train(
    vehicles: Annotated[Path, typer.Option(metavar="PATH", help="Folder or zip of patches with a vehicle.")],
    non_vehicles: Annotated[Path, typer.Option(metavar="PATH", help="Folder or zip of patches without one.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Model file to write.")],
    features: Annotated[
        str, typer.Option(metavar="PRESET", help="lab-9432, lab-8460, ycrcb-8460, ycrcb-6156 or luv-2384.")
    ] = "lab-9432",
    split: Annotated[
        str, typer.Option(metavar="random|sequences", help="The split whose accuracy stands for the model.")
    ] = "random",
    C: Annotated[
        float, typer.Option("--C", metavar="F", help="Inverse strength of the regularisation.")
    ] = 1e-4,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the solver and of the first split.")] = 0,
    no_mirror: Annotated[bool, typer.Option("--no-mirror", help="Leave out the mirrored patches.")] = False,
    gamma: Annotated[
        float, typer.Option(metavar="F", help="Spread of the mirrored patches' brightness; 0.4 is much.")
    ] = 0.0,
    degraded: Annotated[
        float,
        typer.Option(metavar="W", help="Weight of blurred, pale and compressed copies of each patch, 0-1."),
    ] = 0.0,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Accuracy on every split, counts, timings.")
    ] = None,
    card: Annotated[Path | None, typer.Option(metavar="FILE.md", help="Model card to write.")] = None,
    compare: Annotated[
        list[str] | None,
        typer.Option(metavar="PRESET", help="Judge these features too, for the card; may be repeated."),
    ] = None,
) -> None:
    """Train a model, and judge it on splits of its patches."""
    from vehicle_detection._common import check_target, written_whole
    from vehicle_detection.datasets import load_training_patches
    from vehicle_detection.params import FeatureParams
    from vehicle_detection.training import model_card, train_and_judge

    named = {"-o": output, "--report": report, "--card": card}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_apart({"--non-vehicles": non_vehicles, **targets}, {"--vehicles": vehicles})
    presets = [FeatureParams.preset(name) for name in (features, *(compare or ()))]
    options: dict[str, Any] = {"C": C, "mirror": not no_mirror, "gamma": gamma}
    options["degraded"] = degraded
    options |= {"random_state": seed, "split": split}

    with codec_messages():
        patches = load_training_patches(vehicles, non_vehicles)

    def work() -> list[Any]:
        return [train_and_judge(patches, params=params, progress=True, **options) for params in presets]

    (classifier, judged), *rest = interruptible(work)
    others = [other for _, other in rest]
    for each in (judged, *others):
        _show(each)
    classifier.save(output)
    if report is not None:
        plain = judged.to_dict() | {"others": [other.to_dict() for other in others]}
        with written_whole(report) as part:
            part.write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    if card is not None:
        words = ["--vehicles", vehicles.name, "--non-vehicles", non_vehicles.name, "--features", features]
        words += ["--split", split, "--C", f"{C:g}", "--seed", str(seed)] + ["--no-mirror"] * no_mirror
        words += ["--gamma", f"{gamma:g}"] if gamma else []
        words += ["--degraded", f"{degraded:g}"] if degraded else []
        words += [word for name in compare or () for word in ("--compare", name)]
        words += ["-o", output.name, "--card", card.name]
        text = model_card(
            classifier, judged, others=others, command=shlex.join(["vehicle-detection", "train", *words])
        )
        with written_whole(card) as part:
            part.write_text(text, encoding="utf-8")
    typer.echo(f"wrote {', '.join(map(str, targets.values()))}")


def _show(report: TrainingReport) -> None:
    """Print what a training found."""
    from vehicle_detection.training import SPLITS

    print_table(
        f"{report.features}: {report.vehicles:,} vehicles, {report.non_vehicles:,} others, accuracy "
        f"{report.accuracy:.4f} on the split {report.split!r}",
        ("tested on", "trained", "tested", "accuracy", "missed vehicles", "false vehicles", "near-copies"),
        [
            (
                SPLITS[name],
                f"{score.train:,}",
                f"{score.test:,}",
                f"{score.accuracy:.4f}",
                f"{score.missed:.2%}",
                f"{score.false:.2%}",
                f"{score.leakage:.1%}",
            )
            for name, score in report.splits.items()
        ],
    )
    if report.calibration_error is not None:
        typer.echo(f"calibration error on the split 'sequences': {report.calibration_error:.4f}")
    for name, reason in report.skipped.items():
        typer.echo(f"left out {SPLITS[name]!r}: {reason}")
    typer.echo(", ".join(f"{name} {seconds:.1f} s" for name, seconds in report.seconds.items()))


def fetch(
    to: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder to write to; the user's cache if none is given."),
    ] = None,
) -> None:
    """Download the course's training patches (110 MB), once."""
    from vehicle_detection.datasets import fetch_patches

    with output_folder(to, "--to"):
        paths = fetch_patches(to, progress=sys.stderr.isatty())
    for path in paths:
        typer.echo(str(path))


def info(
    model: Annotated[
        str, typer.Argument(metavar="[MODEL]", help='"default", "highway" or a model file.')
    ] = "default",
) -> None:
    """Show what a model is: parameters, accuracy, data, versions."""
    from vehicle_detection.mixture import TemplateMixture, load_model
    from vehicle_detection.training import SPLITS

    loaded = load_model(model)
    count = len(loaded.templates)
    templates = f"{count} template{'s' * (count > 1)}"
    if isinstance(loaded, TemplateMixture):
        shapes = {
            str(number): "box of {:g}x{:g} cells".format(*template.box_cells)
            + " at the frame's border" * template.border
            for number, template in enumerate(loaded.templates, 1)
        }
        if loaded.verification is not None:
            second = loaded.verification
            shapes["second opinion"] = f"{len(second.weights):,} vectors, share {second.share:g}"
        print_facts(f"{model}: {templates}, threshold {loaded.threshold:.2f} (log-odds)", shapes)
    else:
        print_facts(
            f"{model}: {loaded.params.length} features, {templates}", dataclasses.asdict(loaded.params)
        )
    for name, values in loaded.metadata.items():
        scores = values.get("splits") if isinstance(values, dict) else None
        left_out = values.get("left_out") if isinstance(values, dict) else None
        if name == "metrics" and isinstance(scores, dict) and scores.keys() <= SPLITS.keys():
            columns = ("accuracy", "missed", "false", "near_copies", "test")
            rows = [
                (title, *(str(scores[split].get(column, "")) for column in columns))
                for split, title in SPLITS.items()
                if split in scores
            ]
            print_table(name, ("tested on", *(column.replace("_", " ") for column in columns)), rows)
        elif name == "metrics" and isinstance(left_out, dict):
            print_road_scores(left_out)
        else:  # a model that was not trained by this command line tells what it likes
            print_facts(name, values if isinstance(values, dict) else {"": values})
