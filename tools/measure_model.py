"""Measure a model on labelled frames: ``python -m tools.measure_model DATA --model FILE -o out.json``.

DATA holds ``labels/NAME.csv`` with frames in ``frames/NAME/``. The set ``bdd`` is also scored by light.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_target, write_text
from vehicle_detection.detector import load_model
from vehicle_detection.errors import DatasetError, VehicleDetectionError
from vehicle_detection.training import (
    FoldDetections,
    FrameDataset,
    detect_in_source,
    find_sources,
    markdown_table,
    score_fold,
    select_frames,
)

SOURCES = ("bdd", "camvid", "dawn", "dhaka", "india", "indonesia", "us_side")
"""Sets of frames that are measured by default."""

RIDES = "bdd"
"""Set of one frame a ride, which `--rides` selects and which is also scored by light."""

LIGHTS = {"day": (71.05, np.inf), "dusk": (35.77, 71.05), "night": (0.0, 35.77)}
"""Half-open ranges of the mean of all values of a frame."""

COLUMNS = {
    "f1": "F1", "precision": "precision", "recall": "recall", "best_f1": "best F1", "region_f1": "region F1",
    "average_precision": "AP50", "region_average_precision": "region AP50", "recall_occluded": "occluded",
    "recall_truncated": "truncated", "recall_narrow": "under 32 px", "calibration_error": "ECE",
    "false_per_empty_frame": "on empty", "false_per_vehicle_free_frame": "without vehicle",
}  # fmt: skip
"""Columns of the table, after those of the set, its frames and its vehicles."""


def light_of(image: NDArray[np.uint8]) -> str:
    """Name the light of a frame, one of `LIGHTS`, by its brightness."""
    mean = float(image.mean())
    return next(name for name, (low, high) in LIGHTS.items() if low <= mean < high)


def choose_sources(
    folder: str | os.PathLike[str],
    names: Sequence[str],
    rides: Collection[str] | None = None,
    *,
    clip_rate: float = 3.0,
) -> list[FrameDataset]:
    """Read the named sets of a data folder, in this order; of `RIDES` only those in `rides`, if given."""
    found = {source.name: source for source in find_sources(folder, clip_rate=clip_rate)}
    missing = [name for name in names if name not in found]
    if missing:
        raise DatasetError(f"folder {folder} lacks {', '.join(f'labels/{name}.csv' for name in missing)}")
    chosen = [found[name] for name in names]
    if rides is None:
        return chosen
    return [_only(source, rides) if source.name == RIDES else source for source in chosen]


def _only(source: FrameDataset, rides: Collection[str]) -> FrameDataset:
    """Frames of a set by their names."""
    absent = set(rides) - {key for part in source.sets for key in part.keys}
    if absent:
        raise DatasetError(f"{source.name} has no frame {min(absent)!r}; list the names of its images")
    return FrameDataset(source.name, tuple(select_frames(part, rides) for part in source.sets))


def measure(model: Any, sources: Iterable[FrameDataset], *, jobs: int | None = None) -> list[dict[str, Any]]:
    """Score a model on each set of frames at its own threshold, and on the frames of `RIDES` also by light.

    Returns
    -------
    list of dict
        Values of `FoldScore` by name, one dictionary for each row of the table.
    """
    calibration = model.calibration
    # The confidence is 1 / (1 + exp(a score + b)).
    log_odds = (-calibration.a, -calibration.b) if calibration is not None else (1.0, 0.0)
    rows = []
    for source in sources:
        for fold in detect_in_source(model, source, jobs=jobs):
            parts = [fold, *(by_light(fold) if source.name == RIDES else ())]
            rows += [score_fold(part, 0.0, log_odds).to_dict() for part in parts]
    return rows


def by_light(fold: FoldDetections) -> list[FoldDetections]:
    """Split the detections by `LIGHTS`; lights without a frame are left out."""
    lights = {key: light_of(image) for key, image in fold.frames}
    return [
        fold.select([key for key in lights if lights[key] == name], f"{fold.frames.name} {name}")
        for name in LIGHTS
        if name in lights.values()
    ]


def format_rows(rows: Iterable[dict[str, Any]]) -> str:
    """Format the rows of `measure` as a Markdown table; recall with the number of vehicles."""
    counts = {f"recall_{name}": name for name in ("occluded", "truncated", "narrow")}
    lines = []
    for row in rows:
        cells = [row["name"], str(row["frames"]), str(row["vehicles"])]
        for name in COLUMNS:
            text = f"{row[name]:.3f}" if name in row else "-"
            cells.append(f"{text} of {row[counts[name]]}" if name in counts and name in row else text)
        lines.append(cells)
    return markdown_table(["set", "frames", "vehicles", *COLUMNS.values()], lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure a model, print the table and write it as JSON."""
    parser = argparse.ArgumentParser(prog="python -m tools.measure_model", description="Measure a model.")
    parser.add_argument("data", metavar="DATA", type=Path, help="data folder")
    parser.add_argument("--model", metavar="FILE", default="default", help="name or file of the model")
    parser.add_argument("--sources", metavar="A,B", default=",".join(SOURCES), help="names of the sets")
    parser.add_argument("--rides", metavar="FILE.txt", type=Path, help=f"names of frames of {RIDES} to use")
    parser.add_argument("--jobs", metavar="N", type=int, help="frames searched at the same time")
    parser.add_argument("-o", "--output", metavar="FILE.json", type=Path, help="write the values")
    options = parser.parse_args(arguments)
    try:
        _measure(options)
    except (VehicleDetectionError, OSError) as error:
        parser.error(str(error))


def _measure(options: argparse.Namespace) -> None:
    if options.output is not None:
        check_target(options.output, "--output")
    rides = None if options.rides is None else options.rides.read_text(encoding="utf-8").split()
    names = [name for name in options.sources.split(",") if name]
    sources = choose_sources(options.data, names, rides)
    model = load_model(options.model)
    rows = measure(model, sources, jobs=options.jobs)
    print(format_rows(rows))
    if options.output is not None:
        write_text(
            options.output, json.dumps({"model": options.model, "sets": rows}, indent=2) + "\n", "--output"
        )


if __name__ == "__main__":
    main()
