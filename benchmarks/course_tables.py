"""The course's tables, measured again with mean and spread: ``python -m benchmarks.course_tables``.

Every table becomes a CSV and a figure under ``OUT/results``, and all of them the page ``OUT/results.md``. It
takes an hour or two on two cores. Finished runs are kept in ``OUT/results`` row by row, so that a killed run
goes on; delete ``rows.csv`` and ``extra_rows.csv`` to measure everything again.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks._course_runs import COURSE_C, PLANS, SPLITS, Runs
from benchmarks._report import machine_facts
from vehicle_detection._common import atomic_write
from vehicle_detection.classifier import load_classifier
from vehicle_detection.datasets import load_training_patches
from vehicle_detection.tuning import ResultTable

_HEAD = """# The course's tables, measured again

Written by

    python -m benchmarks.course_tables --data FOLDER

where FOLDER holds the course's `vehicles.zip` and `non-vehicles.zip` (8,792 and 8,968 patches). Beside this
page, each table stands as a CSV and a figure in `results/`, and every single run in `results/rows.csv`.

All are linear SVMs behind a `StandardScaler` that saw the training part alone, on the patches as they are
(not mirrored). `random` is the course's split, 80 to 20, and `groups` tests on whole groups of near duplicates:
both with five seeds, mean ± standard deviation. The other splits have no chance in them: `sequences` tests
on the last fifth of each folder by the number in the file name, `GTI to KITTI` trains on the GTI folders
and tests on `KITTI_extracted` and `Extras`, and `KITTI to GTI` the other way round. `search, ms` is the
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
    with atomic_write(Path(options.out) / "results.md") as part:
        part.write_text("\n".join(parts), encoding="utf-8")


def _systems(runs: Runs, folder: Path) -> str:
    table = _with_times(runs, "systems")
    return _section(
        folder, "systems", "The three systems", table,
        "C = 1 is the course's (scikit-learn's default), C = 1e-4 this library's.",
    )  # fmt: skip


def _third(runs: Runs, folder: Path) -> str:
    table = _with_times(runs, "third_configurations")
    return _section(
        folder, "third_configurations", "Five configurations (third system)", table,
        "(orientations, pixels a cell, cells a block, channels) of YCrCb HOG, with 32x32 spatial bins and 32 "
        "histogram bins, C = 1.",
    )  # fmt: skip


def _bayes(runs: Runs, folder: Path) -> str:
    plan = PLANS["systems"]
    second = list(plan.configurations)[1]
    svm = runs.compare(plan).where(configuration=second, C=COURSE_C)
    rows = [{**row, "configuration": "linear SVM, C = 1"} for row in svm if row["split"] in SPLITS[:3]]
    table = ResultTable([*runs.bayes(), *rows]).summarize()
    text = _section(
        folder, "bayes_or_svm", "Naive Bayes or SVM (second system)", table,
        "Gaussian naive Bayes and the linear SVM on the same 6156 scaled features.",
    )  # fmt: skip
    answers = runs.first_answers()
    answers.write(folder / "first_answers.csv")
    lines = ["", "The first 15 test samples of the first random split, shuffled (V is a vehicle):", "", "```"]
    lines += [f"{row['model']:<12} {' '.join(row['answers'])}" for row in answers]
    return text + "\n".join([*lines, "```", ""])


def _ideas(runs: Runs, folder: Path) -> str:
    table = _with_times(runs, "second_ideas")
    return _section(
        folder, "second_ideas", "8 orientations, HLS with the S channel (second system's discussion)", table,
        "16x16 spatial bins, 32 histogram bins, 8 pixels a cell, 2 cells a block, C = 1.",
    )  # fmt: skip


def _luv(runs: Runs, folder: Path) -> str:
    table = _with_times(runs, "luv_channels")
    return _section(
        folder, "luv_channels", "One or three HOG channels in LUV (first system)", table,
        "2384 and 5520 features, C = 1.",
    )  # fmt: skip


def _prediction(runs: Runs, folder: Path) -> str:
    table = runs.prediction_times()
    samples = table[0]["samples"]
    summary = table.summarize(by=("model",), values=("milliseconds",))
    summary.write(folder / "prediction_time.csv")
    _draw_bars(
        summary, "model", "milliseconds", folder / "prediction_time.png", f"ms for {samples:,} samples"
    )
    lines = [
        "## Prediction time (first system)", "",
        f"Milliseconds for {samples:,} test samples of 2384 features: mean ± deviation of five runs.", "",
        "| what | ms |", "|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {row['model']} | {row['milliseconds']:.1f} ± {row['milliseconds_std']:.1f} |" for row in summary
    ]
    return "\n".join([*lines, "", "![](results/prediction_time.png)", ""])


def _leakage(runs: Runs, folder: Path) -> str:
    table = runs.leakage()
    limits = [name for name in table.columns if name.startswith("leakage_")]
    summary = table.summarize(by=("split", "train", "test"), values=limits)
    summary.write(folder / "leakage.csv")
    _draw_bars(
        summary, "split", "leakage_0.95", folder / "leakage.png", "share of near duplicates, correlation 0.95"
    )
    titles = " | ".join(name.replace("leakage_", "from ") for name in limits)
    lines = [
        "## How much each split leaks", "",
        "Share of the test patches that have a near duplicate among the training patches (`split_leakage`): the",
        "16x16 gray thumbnails of the two correlate by at least this much.", "",
        f"| split | trained on | tested on | {titles} |", "|---|---|---|" + "---|" * len(limits),
    ]  # fmt: skip
    for row in summary:
        shares = " | ".join(_mean_text(row[name], row[f"{name}_std"], 3) for name in limits)
        lines.append(f"| {row['split']} | {row['train']:,} | {row['test']:,} | {shares} |")
    return "\n".join([*lines, "", "![](results/leakage.png)", ""])


def _shipped(runs: Runs, folder: Path) -> str:
    """Put the shipped model beside the best of the three systems as the course trained them."""
    metrics = load_classifier().metadata["metrics"]
    course = runs.compare(PLANS["systems"]).where(C=COURSE_C).summarize()
    columns = "tested on", "shipped model", "best system, C = 1", "errors left", "near duplicates in training"
    lines = [
        "## The shipped model", "",
        "`highway`, trained and judged by the command in its card on mirrored, lighter, darker and degraded",
        "copies of the training part. Errors left: its errors as a share of the best system's.", "",
        f"| {' | '.join(columns)} |", "|---" * len(columns) + "|",
    ]  # fmt: skip
    for split in (split for split in SPLITS if split in _SPLIT_KEYS):
        own = metrics["splits"][_SPLIT_KEYS[split]]
        best = max(row["accuracy"] for row in course.where(split=split))
        left = f"{(1 - own['accuracy']) / (1 - best):.0%}" if best < 1 else "-"
        lines.append(
            f"| {split} | {own['accuracy']:.4f} | {best:.4f} | {left} | {own['near_duplicates']:.1%} |"
        )
    text = f"The expected calibration error is {metrics['calibration_error']:.4f} on the split by sequences."
    return "\n".join([*lines, "", text, ""])


_SPLIT_KEYS = {
    "random": "random",
    "sequences": "sequences",
    "GTI to KITTI": "gti_to_kitti",
    "KITTI to GTI": "kitti_to_gti",
}
_SECTIONS = (_leakage, _systems, _shipped, _third, _bayes, _ideas, _luv, _prediction)


def _with_times(runs: Runs, name: str) -> ResultTable:
    """Mean and spread of a table's accuracies, with the time of the search."""
    plan = PLANS[name]
    times = {label: runs.search_times[params] for label, params in plan.configurations.items()}
    summary = runs.compare(plan).summarize()
    return ResultTable([{**row, "search_ms": times[row["configuration"]]} for row in summary])


def _section(folder: Path, name: str, title: str, table: ResultTable, text: str) -> str:
    """Write a table of accuracies and its figure; return its part of the page."""
    table.write(folder / f"{name}.csv")
    _draw_accuracies(table, folder / f"{name}.png")
    splits = [split for split in SPLITS if split in table.column("split")]
    timed = "search_ms" in table.columns
    names = _names(table)
    head = ["configuration", *splits, *(["search, ms"] if timed else [])]
    lines = [f"## {title}", "", text, "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for (configuration, C), label in names.items():
        rows = {row["split"]: row for row in table.where(configuration=configuration, C=C)}
        cells = [_mean_text(rows[split]["accuracy"], rows[split]["accuracy_std"], 4) for split in splits]
        cells += [f"{rows[splits[0]]['search_ms']:.1f}"] if timed else []
        lines.append(f"| {' | '.join([label, *cells])} |")
    best = (table.where(split=split).sort("accuracy")[0] for split in splits)
    winners = "; ".join(f"{row['split']}: {names[row['configuration'], row['C']]}" for row in best)
    return "\n".join([*lines, "", f"Highest mean on {winners}.", "", f"![](results/{name}.png)", ""])


def _names(table: ResultTable) -> dict[tuple[str, float | None], str]:
    """Name of each configuration and C, with C where the table has several."""
    pairs = list(dict.fromkeys((row["configuration"], row["C"]) for row in table))
    several = len({C for _, C in pairs if C is not None}) > 1
    return {(name, C): f"{name}; C = {C:g}" if several else name for name, C in pairs}


def _mean_text(mean: float, spread: float | None, digits: int) -> str:
    return f"{mean:.{digits}f}" if spread is None else f"{mean:.{digits}f} ± {spread:.{digits}f}"


def _draw_accuracies(table: ResultTable, path: Path) -> None:
    import matplotlib.pyplot as plt

    names = _names(table)
    pairs = list(names)
    figure, axes = plt.subplots(figsize=(7, 1.4 + 0.42 * len(pairs)), layout="constrained")
    markers = dict(zip(SPLITS, "os^<>"))
    for split in SPLITS:
        rows = {(row["configuration"], row["C"]): row for row in table if row["split"] == split}
        places = [place for place, pair in enumerate(pairs) if pair in rows]
        if places:
            means = [rows[pairs[place]]["accuracy"] for place in places]
            spreads = [rows[pairs[place]]["accuracy_std"] or 0.0 for place in places]
            axes.errorbar(means, places, xerr=spreads, fmt=markers[split], label=split, capsize=3, alpha=0.85)
    axes.set_yticks(range(len(names)), list(names.values()))
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("accuracy")
    axes.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    _save(figure, path)


def _draw_bars(table: ResultTable, label: str, value: str, path: Path, title: str) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 1 + 0.4 * len(table)), layout="constrained")
    spreads = [spread or 0.0 for spread in table.column(f"{value}_std")]
    bars = axes.barh(table.column(label), table.numbers(value), xerr=spreads, color="C0", capsize=3)
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
