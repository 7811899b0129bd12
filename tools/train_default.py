"""Train the shipped default model: ``python -m tools.train_default DATA -o default.safetensors``.

DATA holds ``labels/NAME.csv`` with the frames of the sets `ROADS` in ``frames/NAME/`` and those of the sets
`COURSE_SETS` in ``NAME/`` or ``videos/NAME.mp4``, and the course's patches of vehicles in ``vehicles.zip`` or
``vehicles/``. Other sets are not trained on.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.error_pictures import write_pictures
from tools.model_card import write_card
from vehicle_detection._common import check_target
from vehicle_detection.datasets import load_patches
from vehicle_detection.errors import DatasetError, VehicleDetectionError
from vehicle_detection.mixture_training import (
    FrameDataset,
    cross_validate_mixture,
    drawn_source,
    find_sources,
    training_metadata,
    write_curves,
)

ROADS = ("camvid", "dawn", "india", "indonesia")
"""Sets of frames that are sources of their own."""

COURSE_SETS = ("project_clip", "test_images", "test_video")
"""Sets of frames of one road, which together are the source ``"course"``."""

# Indonesia's labels leave out small vehicles in the background.
_MIN_LABELLED_WIDTHS = {"indonesia": 60.0}
# Frames per second of the clips, and every n-th patch: neighbors show nearly the same.
_CLIP_RATE, _PATCH_STEP = 6.0, 6


def load_sources(folder: str | os.PathLike[str]) -> list[FrameDataset]:
    """Read the labelled frames of a data folder; the last source is the course's road."""
    found = find_sources(folder, min_labelled_widths=_MIN_LABELLED_WIDTHS, clip_rate=_CLIP_RATE)
    sources = {source.name: source for source in found}
    missing = [name for name in (*ROADS, *COURSE_SETS) if name not in sources]
    if missing:
        raise DatasetError(f"folder {folder} lacks {', '.join(f'labels/{name}.csv' for name in missing)}")
    course = FrameDataset("course", tuple(part for name in COURSE_SETS for part in sources[name].sets))
    return [*(sources[name] for name in ROADS), course]


def load_vehicle_patches(folder: str | os.PathLike[str]) -> list[NDArray[np.uint8]]:
    """Read every sixth of the course's vehicle patches, ``(64, 64, 3)`` each; none if there are none."""
    for path in (Path(folder) / "vehicles.zip", Path(folder) / "vehicles"):
        if path.exists():
            return list(load_patches(path, label=1).patches[::_PATCH_STEP])
    return []


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, cross-validate and write the model, its card, its curves and pictures of its errors."""
    parser = argparse.ArgumentParser(prog="python -m tools.train_default", description="Train the model.")
    parser.add_argument("data", metavar="DATA", type=Path, help="data folder")
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True, help="model file")
    parser.add_argument("--card", metavar="FILE.md", type=Path, help="model card")
    parser.add_argument("--curves", metavar="FILE.csv", type=Path, help="precision and recall of each set")
    parser.add_argument("--pictures", metavar="DIR", type=Path, help="folder for curves and worst errors")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="random seed")
    options = parser.parse_args(arguments)
    try:
        _train(options)
    except VehicleDetectionError as error:
        parser.error(str(error))


def _train(options: argparse.Namespace) -> None:
    for name in "output", "card", "curves":
        if getattr(options, name) is not None:
            check_target(getattr(options, name), f"--{name}")
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    sources, patches = load_sources(options.data), load_vehicle_patches(options.data)
    extra = [drawn_source(random_state=options.seed)]
    model, scores, folds = cross_validate_mixture(
        sources, extra_sources=extra, patches=patches, random_state=options.seed, on_step=print
    )
    sources += extra
    model = model.with_metadata(training_metadata(scores, sources, options.seed, len(patches)))
    model.save(options.output)
    if options.card is not None:
        write_card(options.card, model, scores, sources, seed=options.seed, patches=len(patches), folds=folds)
    if options.curves is not None:
        write_curves(options.curves, folds)
    if options.pictures is not None:
        write_pictures(options.pictures, scores, folds)
    for score in scores:
        print(f"{score.name}: F1 {score.f1:.3f}, as regions {score.region_f1:.3f}")


if __name__ == "__main__":
    main()
