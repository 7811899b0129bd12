"""The commands around models: train one, fetch the patches for it, tell what one is."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehicle_detection.cli.output import (
    capture_stderr,
    check_distinct_paths,
    interruptible,
    output_folder,
    print_facts,
    print_table,
)

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
    from vehicle_detection._common import atomic_write, check_target
    from vehicle_detection.datasets import load_training_patches
    from vehicle_detection.params import FeatureParams
    from vehicle_detection.training import model_card, train_and_evaluate

    named = {"-o": output, "--report": report, "--card": card}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_distinct_paths({"--non-vehicles": non_vehicles, **targets}, {"--vehicles": vehicles})
    presets = [FeatureParams.preset(name) for name in (features, *(compare or ()))]
    options: dict[str, Any] = {"C": C, "mirror": not no_mirror, "gamma": gamma}
    options["degraded"] = degraded
    options |= {"random_state": seed, "split": split}

    with capture_stderr():
        patches = load_training_patches(vehicles, non_vehicles)

    def work() -> list[Any]:
        return [train_and_evaluate(patches, params=params, progress=True, **options) for params in presets]

    (classifier, judged), *rest = interruptible(work)
    others = [other for _, other in rest]
    for each in (judged, *others):
        _show(each)
    classifier.save(output)
    if report is not None:
        plain = judged.to_dict() | {"others": [other.to_dict() for other in others]}
        with atomic_write(report) as part:
            part.write_text(json.dumps(plain, indent=2) + "\n", encoding="utf-8")
    if card is not None:
        words = ["--vehicles", vehicles.name, "--non-vehicles", non_vehicles.name, "--features", features]
        words += ["--split", split, "--C", f"{C:g}", "--seed", str(seed)] + ["--no-mirror"] * no_mirror
        words += ["--gamma", f"{gamma:g}"] if gamma else []
        words += ["--degraded", f"{degraded:g}"] if degraded else []
        words += [word for name in compare or () for word in ("--compare", name)]
        words += ["-o", output.name, "--card", card.name]
        text = model_card(
            classifier,
            judged,
            name=output.stem,
            others=others,
            command=shlex.join(["vehicle-detection", "train", *words]),
        )
        with atomic_write(card) as part:
            part.write_text(text, encoding="utf-8")
    typer.echo(f"wrote {', '.join(map(str, targets.values()))}")


def _show(report: TrainingReport) -> None:
    """Print what a training found."""
    from vehicle_detection.training import SPLITS

    print_table(
        f"{report.features}: {report.vehicles:,} vehicles, {report.non_vehicles:,} others, accuracy "
        f"{report.accuracy:.4f} on the split {report.split!r}",
        (
            "tested on",
            "trained",
            "tested",
            "accuracy",
            "missed vehicles",
            "false vehicles",
            "near duplicates",
        ),
        [
            (
                SPLITS[name],
                f"{score.train:,}",
                f"{score.test:,}",
                f"{score.accuracy:.4f}",
                f"{score.false_negative_rate:.2%}",
                f"{score.false_positive_rate:.2%}",
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
        if loaded.rescorer is not None:
            second = loaded.rescorer
            shapes["second opinion"] = f"{len(second.weights):,} vectors, share {second.blend_weight:g}"
        print_facts(f"{model}: {templates}, threshold {loaded.threshold:.2f} (log-odds)", shapes)
    else:
        print_facts(
            f"{model}: {loaded.params.length} features, {templates}", dataclasses.asdict(loaded.params)
        )
    for name, values in loaded.metadata.items():
        scores = values.get("splits") if isinstance(values, dict) else None
        left_out = values.get("left_out") if isinstance(values, dict) else None
        if name == "metrics" and isinstance(scores, dict) and scores.keys() <= SPLITS.keys():
            columns = ("accuracy", "false_negative_rate", "false_positive_rate", "near_duplicates", "test")
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


# Columns of the table: titles, and digits behind the point.
_COLUMNS = {
    "f1": ("F1", 3),
    "best_f1": ("best F1", 3),
    "average_precision": ("AP", 3),
    "precision": ("precision", 3),
    "recall": ("recall", 3),
    "mean_iou": ("mean IoU", 3),
    "false_per_frame": ("false", 2),
    "false_per_empty_frame": ("on empty", 2),
    "region_f1": ("region F1", 3),
    "region_average_precision": ("region AP", 3),
}


def train_frames(
    data: Annotated[
        Path,
        typer.Argument(
            metavar="DATA",
            help="Folder with labels/NAME.csv and frames/NAME/ or videos/NAME.mp4; the course's patches in "
            "vehicles.zip or vehicles/ are used where they are there.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="Model file to write.")],
    card: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Model card to write, from these measurements.")
    ] = None,
    curves: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Precision and recall of every source left out.")
    ] = None,
    drawn: Annotated[
        bool, typer.Option("--drawn/--no-drawn", help="Train on frames that the project draws, too.")
    ] = True,
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the curves and the worst mistakes as pictures."),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of everything random.")] = 0,
) -> None:
    """Train the model for any road, and judge it on sources that it was not trained on."""
    from vehicle_detection._common import check_target
    from vehicle_detection.mixture_training import (
        as_metadata,
        check_sources,
        cross_validate_mixture,
        drawn_source,
        find_patches,
        find_sources,
        write_card,
        write_curves,
    )

    named = {"-o": output, "--card": card, "--curves": curves}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_distinct_paths(targets, {"DATA": data})
    sources = find_sources(data)
    check_sources(sources, least=2)
    patches = find_patches(data)
    always = [drawn_source(random_state=seed)] if drawn else []
    with output_folder(pictures, "--pictures"):
        trained, scores, held = cross_validate_mixture(
            sources, always=always, patches=patches, random_state=seed, on_step=typer.echo
        )
        sources += always
        trained.with_metadata(as_metadata(scores, sources, seed, len(patches))).save(output)
        if card is not None:
            write_card(card, trained, scores, sources, seed, len(patches))
        if curves is not None:
            write_curves(curves, held)
        written = [*targets.values()]
        if pictures is not None:
            from vehicle_detection.mixture_training import write_pictures

            written += [pictures / name for name in write_pictures(pictures, scores, held)]
    print_road_scores({score.name: score.to_dict() for score in scores})
    typer.echo(f"wrote {', '.join(map(str, written))}")


def print_road_scores(scores: Mapping[str, Mapping[str, Any]]) -> None:
    """Print a table of `FoldScore` values, a row for each set of frames."""
    rows = [
        (
            name,
            *(f"{values[key]:.{digits}f}" if key in values else "" for key, (_, digits) in _COLUMNS.items()),
        )
        for name, values in scores.items()
    ]
    titles = (title for title, _ in _COLUMNS.values())
    print_table("on sources left out of training, IoU 0.5", ("frames", *titles), rows)
