"""Make the picture of docs/roads.md: ``python -m tools.road_pictures -o docs/results/rendered_roads.jpg``.

It shows what both models find in rendered scenes, which neither was trained on; no real frame is shown.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from vehicle_detection import VehicleDetector
from vehicle_detection._common import atomic_write
from vehicle_detection.notebook import plot_methods
from vehicle_detection.training import rendered_source

SEED = 99
"""Seed of the scenes; the shipped network was trained on those of seed 0."""

SCENES = {"day": 22, "dusk": 29, "night, rain": 38}
"""Names of the shown scenes, and their numbers in `rendered_source`."""


def make_picture(path: Path, *, jobs: int | None = None) -> None:
    """Write the picture."""
    (scenes,) = rendered_source(frames=max(SCENES.values()) + 1, random_state=SEED).sets
    rendered = {key: image for key, image in scenes if key in SCENES.values()}
    images = {name: rendered[key] for name, key in SCENES.items()}
    found = {}
    for model in "highway", "default":
        with VehicleDetector(model, jobs=jobs) as detector:
            found[model] = [detector.detect(image) for image in images.values()]
    truth = [scenes.labels.frame(key) for key in SCENES.values()]
    figure = Figure(figsize=(10, 9), layout="constrained")
    plot_methods(images, found, truth=truth, figure=figure)
    with atomic_write(path) as part:
        figure.savefig(part, format="jpg", dpi=90, pil_kwargs={"quality": 86})


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, detect and write the picture."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.road_pictures", description="Make the picture of docs/roads.md."
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE.jpg", type=Path, default=Path("docs/results/rendered_roads.jpg")
    )
    make_picture(parser.parse_args(arguments).output)


if __name__ == "__main__":
    main()
