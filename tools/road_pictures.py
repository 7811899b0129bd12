"""Make pictures of roads: ``python -m tools.road_pictures -o FILE.jpg`` or ``--clip CLIP.mp4``.

That of docs/roads.md shows what both models find in rendered scenes, which neither was trained on. With the
course's project video as ``--clip``, its last frame is annotated for the README; docs/road_license.txt is its
license.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tools.rendered import rendered_source
from vehicle_detection import Annotator, Camera, DrawParams, VehicleDetector, track, write_image
from vehicle_detection._common import atomic_write
from vehicle_detection.notebook import show_images

SEED = 99
"""Seed of the scenes; the shipped network was trained on those of seed 0."""

SCENES = {"day": 22, "dusk": 29, "night, rain": 38}
"""Names of the shown scenes, and their numbers in `rendered_source`."""


def make_picture(path: Path, *, jobs: int | None = None) -> None:
    """Write the picture."""
    (scenes,) = rendered_source(frames=max(SCENES.values()) + 1, random_state=SEED).sets
    rendered = {key: image for key, image in scenes if key in SCENES.values()}
    images = {name: rendered[key] for name, key in SCENES.items()}
    truth = [scenes.labels.frame(key) for key in SCENES.values()]
    figure = Figure(figsize=(10, 9), layout="constrained")
    columns: Any = figure.subfigures(1, 2)
    for model, column in zip(("highway", "default"), columns):
        with VehicleDetector(model, jobs=jobs) as detector:
            found = [detector.detect(image) for image in images.values()]
        names = [f"{name}, {model}: {len(boxes)} boxes" for name, boxes in zip(images, found)]
        show_images(list(images.values()), names, boxes=found, truth=truth, columns=1, figure=column)
    with atomic_write(path) as part:
        figure.savefig(part, format="jpg", dpi=90, pil_kwargs={"quality": 86})


def annotate_last_frame(clip: Path, path: Path) -> None:
    """Write the last frame of a clip with its tracks and the bird's-eye view."""
    annotator = Annotator(DrawParams(panel="corner"))
    detector = VehicleDetector(camera=Camera.dashcam(fov=58), annotator=annotator)
    with detector, track(clip, detector, start=12.0, frames=True) as run:
        for result in run:
            assert result.frame is not None
            picture = detector.annotate(result.frame, result)
    write_image(path, picture)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, detect and write the picture."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.road_pictures", description="Make the picture of docs/roads.md."
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE.jpg", type=Path, default=Path("docs/results/rendered_roads.jpg")
    )
    parser.add_argument("--clip", metavar="CLIP.mp4", type=Path, help="write docs/road.jpg from it instead")
    options = parser.parse_args(arguments)
    if options.clip is None:
        make_picture(options.output)
    else:
        annotate_last_frame(options.clip, Path("docs/road.jpg"))


if __name__ == "__main__":
    main()
