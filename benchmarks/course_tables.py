"""Measure the course's tables again, with mean and deviation: ``python -m benchmarks.course_tables``.

Writes a CSV and a figure for each table to ``OUT/results``, and the page ``OUT/results.md``. This takes an
hour or two on two cores. Finished runs are stored in ``OUT/results`` row by row, so that a killed run
continues; delete ``rows.jsonl`` and ``extra_rows.jsonl`` to measure everything again.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks._course_runs import COURSE_C, PLANS, SPLITS, Runs, summarize
from benchmarks._report import machine_facts
from vehicle_detection._common import atomic_write, write_text
from vehicle_detection.datasets import load_training_patches
from vehicle_detection.svm import load_classifier
from vehicle_detection.training import write_results

_HEAD = """# The course's tables, measured again

Written by

    python -m benchmarks.course_tables --data FOLDER

where FOLDER holds the course's `vehicles.zip` and `non-vehicles.zip` (8,792 and 8,968 patches). `results/`
holds a CSV and a figure of each table, and every run in `rows.jsonl`.

All models are linear SVMs behind a `StandardScaler`, both fitted on the training part only, on the original
patches (not mirrored). `random` is the course's split, 80 to 20, and `groups` tests on whole groups of near
duplicates: both with five seeds, mean ± standard deviation. The other splits are deterministic: `sequences`
tests on the last fifth of each folder by the number in the file name, `GTI to KITTI` trains on the GTI
folders and tests on `KITTI_extracted` and `Extras`, and `KITTI to GTI` is the reverse. `search, ms` is the
time of the fast search of a 1280x720 frame in the default bands on one core: the fastest of 15 runs.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.course_tables", description=__doc__)
    parser.add_argument("--data", help="folder of the two archives; default: VEHICLE_DETECTION_DATA")
    parser.add_argument("--out", default="docs", help="folder of results.md and results/")
    options = parser.parse_args(arguments)
    folder = options.data or os.environ.get("VEHICLE_DETECTION_DATA")
    if not folder:
        sys.exit("name the folder of vehicles.zip and non-vehicles.zip with --data or VEHICLE_DETECTION_DATA")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    results = Path(options.out) / "results"
    results.mkdir(parents=True, exist_ok=True)
    runs = Runs(
        load_training_patches(Path(folder) / "vehicles.zip", Path(folder) / "non-vehicles.zip"), results
    )
    parts = [_HEAD, *(section(runs, results) for section in _SECTIONS), _machine()]
    write_text(Path(options.out) / "results.md", "\n".join(parts))


def _svm_section(name: str) -> Callable[[Runs, Path], str]:
    title, text = _SVM_TEXTS[name]
    return lambda runs, folder: _section(folder, name, title, _with_times(runs, name), text)


_SVM_TEXTS = {
    "systems": (
        "The three systems",
        "C = 1 is the course's value (scikit-learn's default), C = 1e-4 this library's.",
    ),
    "third_configurations": (
        "Five configurations (third system)",
        "(orientations, pixels per cell, cells per block, channels) of YCrCb HOG, with 32x32 spatial bins "
        "and 32 histogram bins, C = 1.",
    ),
    "second_ideas": (
        "8 orientations, HLS with the S channel (second system's discussion)",
        "16x16 spatial bins, 32 histogram bins, 8 pixels per cell, 2 cells per block, C = 1.",
    ),
    "luv_channels": ("One or three HOG channels in LUV (first system)", "2384 and 5520 features, C = 1."),
}


def _bayes(runs: Runs, folder: Path) -> str:
    plan = PLANS["systems"]
    svm = runs.compare(plan)
    second = list(plan.configurations)[1]
    svm = svm[(svm["configuration"] == second) & (svm["C"] == COURSE_C) & svm["split"].isin(SPLITS[:3])]
    svm = svm.assign(configuration="linear SVM, C = 1")
    columns = ["configuration", "C", "split", "accuracy"]
    table = summarize(pd.concat([runs.bayes()[columns], svm[columns]]))
    text = _section(
        folder, "bayes_or_svm", "Naive Bayes or SVM (second system)", table,
        "Gaussian naive Bayes and the linear SVM on the same 6156 scaled features.",
    )  # fmt: skip
    predictions = runs.first_predictions()
    write_results(predictions, folder / "first_answers.csv")
    lines = ["", "The first 15 test samples of the first random split, shuffled (V is a vehicle):", "", "```"]
    lines += [f"{row.model:<12} {' '.join(row.answers)}" for row in predictions.itertuples()]
    return text + "\n".join([*lines, "```", ""])


def _prediction(runs: Runs, folder: Path) -> str:
    table = runs.prediction_times()
    samples = table["samples"][0]
    summary = summarize(table, ["model"], ["milliseconds"])
    write_results(summary, folder / "prediction_time.csv")
    _draw_bars(
        summary, "model", "milliseconds", folder / "prediction_time.png", f"ms for {samples:,} samples"
    )
    lines = [
        "## Prediction time (first system)", "",
        f"Milliseconds for {samples:,} test samples of 2384 features: mean ± standard deviation of five",
        "runs.", "",
        "| what | ms |", "|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {row.model} | {row.milliseconds:.1f} ± {row.milliseconds_std:.1f} |"
        for row in summary.itertuples()
    ]
    return "\n".join([*lines, "", "![](results/prediction_time.png)", ""])


def _leakage(runs: Runs, folder: Path) -> str:
    table = runs.leakage()
    limits = [name for name in table.columns if name.startswith("leakage_")]
    summary = summarize(table, ["split", "train", "test"], limits)
    write_results(summary, folder / "leakage.csv")
    title = "fraction of near duplicates, correlation 0.95"
    _draw_bars(summary, "split", "leakage_0.95", folder / "leakage.png", title)
    titles = " | ".join(name.replace("leakage_", "from ") for name in limits)
    lines = [
        "## How much each split leaks", "",
        "Fraction of the test patches that have a near duplicate in the training part (`split_leakage`): the",
        "16x16 gray thumbnails of the two have at least this correlation.", "",
        f"| split | trained on | tested on | {titles} |", "|---|---|---|" + "---|" * len(limits),
    ]  # fmt: skip
    for row in summary.to_dict("records"):
        fractions = " | ".join(_mean_text(row[name], row[f"{name}_std"], 3) for name in limits)
        lines.append(f"| {row['split']} | {row['train']:,} | {row['test']:,} | {fractions} |")
    return "\n".join([*lines, "", "![](results/leakage.png)", ""])


def _shipped(runs: Runs, folder: Path) -> str:
    """Compare the shipped model with the best of the three systems trained like in the course."""
    metrics = load_classifier().metadata["metrics"]
    table = runs.compare(PLANS["systems"])
    best = summarize(table[table["C"] == COURSE_C]).groupby("split")["accuracy"].max()
    columns = "tested on", "shipped model", "best system, C = 1", "errors left", "near duplicates in training"
    lines = [
        "## The shipped model", "",
        "`highway`, trained and evaluated by the command in its card, with mirrored copies of varied",
        "brightness and degraded copies. Errors left: its errors relative to those of the best system.", "",
        f"| {' | '.join(columns)} |", "|---" * len(columns) + "|",
    ]  # fmt: skip
    for split in (split for split in SPLITS if split in _SPLIT_KEYS):
        own = metrics["splits"][_SPLIT_KEYS[split]]
        left = f"{(1 - own['accuracy']) / (1 - best[split]):.0%}" if best[split] < 1 else "-"
        cells = f"{own['accuracy']:.4f} | {best[split]:.4f} | {left} | {own['near_duplicates']:.1%}"
        lines.append(f"| {split} | {cells} |")
    text = f"The expected calibration error is {metrics['calibration_error']:.4f} on the split by sequences."
    return "\n".join([*lines, "", text, ""])


_SPLIT_KEYS = {
    "random": "random",
    "sequences": "sequences",
    "GTI to KITTI": "gti_to_kitti",
    "KITTI to GTI": "kitti_to_gti",
}
_SECTIONS = (
    _leakage,
    _svm_section("systems"),
    _shipped,
    _svm_section("third_configurations"),
    _bayes,
    _svm_section("second_ideas"),
    _svm_section("luv_channels"),
    _prediction,
)


def _with_times(runs: Runs, name: str) -> pd.DataFrame:
    """Mean and deviation of a table's accuracies, with the time of the search."""
    plan = PLANS[name]
    times = {label: runs.search_times[params] for label, params in plan.configurations.items()}
    summary = summarize(runs.compare(plan))
    return summary.assign(search_ms=summary["configuration"].map(times))


def _section(folder: Path, name: str, title: str, table: pd.DataFrame, text: str) -> str:
    """Write a table of accuracies and its figure; return its part of the page."""
    write_results(table, folder / f"{name}.csv")
    several = table["C"].dropna().nunique() > 1
    labels = [
        f"{row.configuration}; C = {row.C:g}" if several else row.configuration for row in table.itertuples()
    ]
    table = table.assign(label=labels)
    _draw_accuracies(table, folder / f"{name}.png")
    splits = [split for split in SPLITS if split in set(table["split"])]
    timed = "search_ms" in table
    head = ["configuration", *splits, *(["search, ms"] if timed else [])]
    lines = [f"## {title}", "", text, "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for label, rows in table.groupby("label", sort=False):
        rows = rows.set_index("split")
        cells = [_mean_text(rows["accuracy"][split], rows["accuracy_std"][split], 4) for split in splits]
        cells += [f"{rows['search_ms'].iloc[0]:.1f}"] if timed else []
        lines.append(f"| {' | '.join([label, *cells])} |")
    best = table.loc[table.groupby("split", sort=False)["accuracy"].idxmax()].set_index("split")["label"]
    winners = "; ".join(f"{split}: {best[split]}" for split in splits)
    return "\n".join([*lines, "", f"Highest mean on {winners}.", "", f"![](results/{name}.png)", ""])


def _mean_text(mean: float, std: float, digits: int) -> str:
    return f"{mean:.{digits}f}" if math.isnan(std) else f"{mean:.{digits}f} ± {std:.{digits}f}"


def _draw_accuracies(table: pd.DataFrame, path: Path) -> None:
    import matplotlib.pyplot as plt

    labels = table["label"].unique().tolist()
    figure, axes = plt.subplots(figsize=(7, 1.4 + 0.42 * len(labels)), layout="constrained")
    markers = dict(zip(SPLITS, "os^<>"))
    for split in SPLITS:
        rows = table[table["split"] == split]
        if len(rows):
            places = [labels.index(label) for label in rows["label"]]
            std = rows["accuracy_std"].fillna(0)
            axes.errorbar(
                rows["accuracy"], places, xerr=std, fmt=markers[split], label=split, capsize=3, alpha=0.85
            )
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel("accuracy")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    _save(figure, path)


def _draw_bars(table: pd.DataFrame, label: str, value: str, path: Path, title: str) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 1 + 0.4 * len(table)), layout="constrained")
    std = table[f"{value}_std"].fillna(0)
    bars = axes.barh(table[label], table[value], xerr=std, color="C0", capsize=3)
    axes.bar_label(bars, fmt="%.3g", padding=4)
    axes.invert_yaxis()
    axes.margins(x=0.12)
    axes.set_xlabel(title)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    with atomic_write(path) as part:
        figure.savefig(part, dpi=100)
    plt.close(figure)


def _machine() -> str:
    facts = machine_facts()
    libraries = ", ".join(f"{name} {number}" for name, number in facts["libraries"].items())
    return (
        f"## Measured on\n\n{facts['cores']} cores of {facts['processor']}, {facts['system']}, "
        f"Python {facts['python']}; {libraries}.\n"
    )


if __name__ == "__main__":
    import matplotlib as mpl

    mpl.use("Agg")
    main()
