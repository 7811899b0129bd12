"""The command that compares parameters: ``vehicle-detection tune``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vehicle_detection as vd
from vehicle_detection.cli.options import NON_VEHICLES, PATCHES, VEHICLES, flag, option
from vehicle_detection.cli.output import (
    check_targets,
    option_names,
    print_line,
    print_table,
    run_interruptible,
)
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from pandas import DataFrame

_MAX_ROWS = 15


@option_names(
    random_state="--seed",
    seeds="--seed",
    n_finalists="--finalists",
    store="--output",
    patches_or_labels=PATCHES,
    patch_set=PATCHES,
)
def tune(
    vehicles: Path = VEHICLES,
    non_vehicles: Path = NON_VEHICLES,
    grid: str = option(..., "GRID", "Values to try: 'orient=8,9 color_space=YCrCb,LAB C=1e-4,1'."),
    output: Path = option(
        ...,
        "FILE.csv",
        "Table to write: .csv, .jsonl or .parquet. Results are saved one by one; the same command "
        "resumes an interrupted run.",
        "-o",
        "--output",
    ),
    plot: Path | None = option(None, "FILE.png", "Accuracy against search time."),
    split: str = option("sequences", "sequences|groups|random", "Held-out patches."),
    halving: bool = flag("--halving", "Eliminate poor configurations on few patches (successive halving)."),
    finalists: int = option(3, "N", "Configurations to measure fully after --halving."),
    frames: Path | None = option(None, "DIR", "Labelled frames to score models on, such as test_images."),
    labels: Path | None = option(None, "FILE.csv", "True boxes of --frames."),
    horizon: float | None = option(None, "F", "Horizon of --frames, 0 (top) to 1, such as 0.55."),
    seed: int = option(0, "N", "Random seed of splits and training."),
    cache: Path | None = option(None, "DIR", "Folder to keep features in, such as cache."),
) -> None:
    """Train and measure every combination of a grid of parameters, and show the best."""
    from vehicle_detection._common import check_choice, check_integer, check_suffix

    training = vd.training
    values = training.parse_grid(grid)
    check_choice(split, "--split", ("sequences", "groups", "random"))
    check_integer(finalists, "--finalists", low=1)
    sources = {"--vehicles": vehicles, "--non-vehicles": non_vehicles}
    targets = check_targets({"--output": output, "--plot": plot}, sources)
    check_suffix(output, "--output", (".csv", ".jsonl", ".parquet"))
    if plot is not None:
        check_suffix(plot, "--plot", (".png", ".svg", ".pdf"))
    labelled = _read_frames(frames, labels, horizon)
    # Rows cannot be appended to Parquet, so they are stored in a .jsonl file beside it.
    parquet = output.suffix.lower() == ".parquet"
    store = output.with_suffix(".jsonl") if parquet else output
    is_new = not store.exists()
    measured = training.TrialOptions(frames=labelled, cache=cache)
    options: dict[str, Any] = {"store": store, "options": measured, "progress": True}

    def work() -> DataFrame:
        patches = vd.load_training_patches(vehicles, non_vehicles, progress=sys.stderr.isatty())
        if halving:
            chosen = training.Halving(n_finalists=finalists)
            options.update(split=split, halving=chosen, random_state=seed)
            return training.search_parameters(patches, values, **options)
        options.update(splits=split, seeds=(seed,))
        return training.compare_configurations(patches, training.expand_grid(values), **options)

    table = run_interruptible(work)
    final = table[table["stage"] == ("final" if halving else "compare")]
    _show(final, table, values)
    if final["accuracy"].isna().all():
        if is_new:
            store.unlink(missing_ok=True)
        raise InvalidInputError("--grid has no configuration that can be trained, for the reasons above")
    if parquet:
        training.write_results(table, output)
    if plot is not None:
        _draw(final, plot)
    print_line(f"wrote {', '.join(map(str, targets))}")


def _read_frames(frames: Path | None, labels: Path | None, horizon: float | None) -> vd.LabelledFrames | None:
    if frames is None and labels is None:
        if horizon is not None:
            raise InvalidInputError("--horizon needs --frames, which it concerns; omit it")
        return None
    if frames is None or labels is None:
        raise InvalidInputError("--frames and --labels belong together; give both")
    name, true = frames.name or "frames", vd.read_labels(labels)
    return vd.LabelledFrames(name, vd.load_frames(frames), true, horizon)


def _show(final: DataFrame, table: DataFrame, grid: Mapping[str, Sequence[Any]]) -> None:
    """Print the best rows, with a star on the Pareto front, and the errors of failed configurations."""
    measured = final[final["accuracy"].notna()].sort_values("accuracy", ascending=False, kind="stable")
    front = set(vd.training.pareto_front(final)["trial"])
    # Options of which the grid has several values; the configuration is a name for the features.
    swept = [name for name, each in grid.items() if name != "C" and len(each) > 1]
    heads = ["", "configuration", *swept, "C", "accuracy", "training", "search ms"]
    scored = bool(measured["frame_f1"].notna().any())
    rows = []
    for row in measured.head(_MAX_ROWS).to_dict("records"):
        cells = ["*" * (row["trial"] in front), row["configuration"], *(f"{row[name]}" for name in swept)]
        cells += [f"{row['C']:g}"]
        cells += [_text(row[name], 4) for name in ("accuracy", "train_accuracy")]
        cells += [_text(row["search_ms"], 1)]
        rows.append(cells + ([_text(row["frame_f1"], 3), _text(row["frame_best_f1"], 3)] if scored else []))
    heads += ["frames F1", "best F1"] if scored else []
    title = f"{len(measured)} measured; *: no other is as accurate and faster, or as fast and more accurate"
    if rows:
        print_table(title, heads, rows)
    for row in table[table["message"].notna()].drop_duplicates("configuration").to_dict("records"):
        print_line(f"{row['configuration']} {row['status']}: {row['message']}")


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _draw(table: DataFrame, path: Path) -> None:
    from matplotlib.figure import Figure

    from vehicle_detection._common import atomic_write

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    vd.notebook.plot_tradeoff(table, ax=figure.subplots())
    with atomic_write(path) as part:
        figure.savefig(part)
