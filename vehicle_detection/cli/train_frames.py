"""``vehicle-detection train-frames``: the model for any road, from labelled frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from vehicle_detection.cli.output import check_apart, output_folder, print_table

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
        drawn_source,
        find_patches,
        find_sources,
        judge_mixture,
        write_card,
        write_curves,
    )

    named = {"-o": output, "--card": card, "--curves": curves}
    targets = {name: check_target(path, name) for name, path in named.items() if path is not None}
    check_apart(targets, {"DATA": data})
    sources = find_sources(data)
    check_sources(sources, least=2)
    patches = find_patches(data)
    always = [drawn_source(random_state=seed)] if drawn else []
    with output_folder(pictures, "--pictures"):
        trained, scores, held = judge_mixture(
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
    """Print a table of `RoadScore` values, a row for each set of frames."""
    rows = [
        (
            name,
            *(f"{values[key]:.{digits}f}" if key in values else "" for key, (_, digits) in _COLUMNS.items()),
        )
        for name, values in scores.items()
    ]
    titles = (title for title, _ in _COLUMNS.values())
    print_table("on sources left out of training, IoU 0.5", ("frames", *titles), rows)
