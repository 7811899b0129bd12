"""The command that compares parameters: ``vehicle-detection tune``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.options import PATCHES, flag, option
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
    store="--output",
    scales="--grid",
    overlaps="--grid",
    thresholds="--grid",
    patches_or_labels=PATCHES,
    patch_set=PATCHES,
)
def tune(
    grid: str = option(
        "GRID",
        "Values to try: 'orient=8,9 color_space=YCrCb,LAB C=1e-4,1', or of the search of a trained model: "
        "'scales=1,0.8+1+1.5 overlap=0.5,0.75 threshold=1,4'.",
        default=...,
    ),
    output: Path = option(
        "FILE.csv",
        "Table to write: .csv, .jsonl or .parquet. Trained models are saved one by one in a .jsonl file; the "
        "same command resumes an interrupted run.",
        "-o",
        "--output",
        default=...,
    ),
    vehicles: Path | None = option("PATH", "Patches of vehicles to train on, such as vehicles.zip."),
    non_vehicles: Path | None = option("PATH", "Other patches, such as non-vehicles.zip."),
    model: str | None = option("FILE", "Model of the search, such as a.safetensors; default: highway."),
    plot: Path | None = option("FILE.png", "Accuracy against search time."),
    split: str = option("sequences|groups|random", "Held-out patches.", default="sequences"),
    halving: bool = flag("--halving", "Eliminate poor configurations on few patches (successive halving)."),
    finalists: int = option("N", "Configurations to measure fully after --halving.", default=3),
    frames: Path | None = option("DIR", "Labelled frames to score models on, such as test_images."),
    labels: Path | None = option("FILE.csv", "True boxes of --frames."),
    horizon: float | None = option("F", "Horizon of --frames, 0 (top) to 1, such as 0.55."),
    seed: int = option("N", "Random seed of splits and training.", default=0),
    cache: Path | None = option("DIR", "Folder to keep features in, such as cache."),
) -> None:
    """Measure every combination of a grid of parameters, of training or of the search, and show the best."""
    common.check.integer(finalists, "--finalists", low=1)
    values = vd.training.parse_grid(grid)
    common.check.choice(split, "--split", ("sequences", "groups", "random"))
    sources = {"--vehicles": vehicles, "--non-vehicles": non_vehicles, "--labels": labels}
    given = {name: path for name, path in sources.items() if path is not None}
    targets = check_targets({"--output": output, "--plot": plot}, given)
    common.check_suffix(output, "--output", (".csv", ".jsonl", ".parquet"))
    searches = not set(values).isdisjoint(_SEARCH)
    for name in values if searches else ():
        common.check.choice(name, "--grid of a search", tuple(_SEARCH))
    writes_table = searches or output.suffix.lower() != ".jsonl"  # rows of trials are stored one by one
    if writes_table:
        vd.training.check_replaceable(output, "--output")
    if plot is not None:
        common.check_suffix(plot, "--plot", (".png", ".svg", ".pdf"))
    labelled = _read_frames(frames, labels, horizon)
    if searches:
        if labelled is None:
            raise InvalidInputError("--grid of a search needs labelled frames; give --frames and --labels")
        table = run_interruptible(lambda: _compare_searches(model or "highway", labelled, values))
        look = {"quality": "f1", "label": "scales"}
    else:
        if model is not None:
            raise InvalidInputError(f"--model needs a --grid of a search ({', '.join(_SEARCH)}); omit it")
        if vehicles is None or non_vehicles is None:
            raise InvalidInputError(f"--grid of features needs patches to train on; give {PATCHES}")
        options = {"splits": split, "seeds": (seed,), "store": output.with_suffix(".jsonl")}
        options["options"] = vd.training.TrialOptions(frames=labelled, cache=cache)
        count = finalists if halving else None
        table, look = _compare_models((vehicles, non_vehicles), values, options, count), {}
    if writes_table:
        vd.training.write_results(table, output)
    if plot is not None:
        _draw(table, plot, look)
    print_line(f"wrote {', '.join(map(str, targets))}")


# Arguments of `compare_searches` by the names in a grid, which are those of its columns.
_SEARCH = {"scales": "scales", "overlap": "overlaps", "threshold": "thresholds"}


def _compare_searches(
    model: str, frames: vd.LabelledFrames, values: Mapping[str, Sequence[Any]]
) -> DataFrame:
    """Measure the searches of a model in labelled frames, and show the best."""
    lists: dict[str, Any] = {_SEARCH[name]: each for name, each in values.items()}
    if "scales" in lists:
        try:
            lists["scales"] = [tuple(map(float, str(each).split("+"))) for each in lists["scales"]]
        except ValueError:
            must = "join scales by +, as in 'scales=1,0.8+1+1.5'"
            raise common.invalid("--grid", must, lists["scales"]) from None
    table = vd.training.compare_searches(vd.load_classifier(model), frames, **lists)
    table["scales"] = ["+".join(f"{side:g}" for side in sides) for sides in table["scales"]]
    rows = [
        [each if isinstance(each, str) else "" if math.isnan(each) else f"{each:.3g}" for each in row]
        for row in table.head(_MAX_ROWS).itertuples(index=False)
    ]
    print_table(f"{len(table)} searches, best first", list(table.columns), rows)
    return table


def _compare_models(
    sources: tuple[Path, Path],
    values: Mapping[str, Sequence[Any]],
    options: dict[str, Any],
    finalists: int | None,
) -> DataFrame:
    """Train and measure models, or those `finalists` that halving leaves, and show the best."""
    store = options["store"]
    is_new = not store.exists()

    def work() -> DataFrame:
        patches = vd.load_training_patches(*sources, progress=sys.stderr.isatty())
        configurations = vd.training.expand_grid(values)
        if finalists is not None:
            halved = {"split": options["splits"], "random_state": options["seeds"][0]}
            found = vd.training.halve_configurations(patches, configurations, finalists, **halved)
            configurations = found or configurations  # all are impossible, which their rows say
        return vd.training.compare_configurations(patches, configurations, progress=True, **options)

    table = run_interruptible(work)
    _show(table, values)
    if table["accuracy"].isna().all():
        if is_new:
            store.unlink(missing_ok=True)
        raise InvalidInputError("--grid has no configuration that can be trained, for the reasons above")
    return table


def _read_frames(frames: Path | None, labels: Path | None, horizon: float | None) -> vd.LabelledFrames | None:
    if frames is None and labels is None:
        if horizon is not None:
            raise InvalidInputError("--horizon needs --frames, which it concerns; omit it")
        return None
    if frames is None or labels is None:
        raise InvalidInputError("--frames and --labels belong together; give both")
    return vd.training.read_labelled_folder(frames, labels, name=frames.name or "frames", horizon=horizon)


def _show(table: DataFrame, grid: Mapping[str, Sequence[Any]]) -> None:
    """Print the best rows, with a star on the Pareto front, and the errors of failed configurations."""
    measured = table[table["accuracy"].notna()].sort_values("accuracy", ascending=False, kind="stable")
    front = set(vd.training.pareto_front(table)["trial"])
    # Options of which the grid has several values; the configuration is a name for the features.
    swept = [name for name, each in grid.items() if name != "C" and len(each) > 1]
    columns = {"accuracy": ("accuracy", 4), "train_accuracy": ("training", 4), "search_ms": ("search ms", 1)}
    if measured["frame_f1"].notna().any():
        columns |= {"frame_f1": ("frames F1", 3), "frame_best_f1": ("best F1", 3)}
    rows = []
    for row in measured.head(_MAX_ROWS).to_dict("records"):
        cells = ["*" * (row["trial"] in front), row["configuration"], *(f"{row[name]}" for name in swept)]
        values = [(row[name], digits) for name, (_, digits) in columns.items()]
        numbers = ["" if math.isnan(value) else f"{value:.{digits}f}" for value, digits in values]
        rows.append([*cells, f"{row['C']:g}", *numbers])
    title = f"{len(measured)} measured; *: no other is as accurate and faster, or as fast and more accurate"
    if rows:
        print_table(title, ["", "configuration", *swept, "C", *(head for head, _ in columns.values())], rows)
    for row in table[table["message"].notna()].drop_duplicates("configuration").to_dict("records"):
        print_line(f"{row['configuration']} {row['status']}: {row['message']}")


def _draw(table: DataFrame, path: Path, look: Mapping[str, str]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    vd.notebook.plot_tradeoff(table, ax=figure.subplots(), **look)
    with common.atomic_write(path) as part:
        figure.savefig(part)
