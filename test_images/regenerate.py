"""Render the test images and write their labels: ``python test_images/regenerate.py``.

The images are rendered by the project itself, so no other license applies to them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2

from vehicle_detection import write_labels
from vehicle_detection.scenes import Scene, SceneVehicle, render_scene, truth_table

JPEG_QUALITY = 88
FOLDER = Path(__file__).parent


def _car(distance_m: float, lane: float, kind: str, color: str) -> SceneVehicle:
    return SceneVehicle(distance_m=distance_m, lateral_m=3.6 * lane, kind=kind, color=color)


SCENES: dict[str, dict[str, Any]] = {
    "road1.jpg": {
        "vehicles": [_car(19, 1, "sedan", "white"), _car(34, 0, "hatchback", "black")],
        "lane": 1,
        "random_state": 7,
    },
    "road2.jpg": {
        "vehicles": [
            _car(15, -1, "estate", "silver"),
            _car(24, 0, "suv", "anthracite"),
            _car(42, 1, "hatchback", "red"),
        ],
        "light": "overcast",
        "lane": 1,
        "random_state": 3,
    },
    "road3.jpg": {"vehicles": [], "random_state": 1},
    "road4.jpg": {
        "vehicles": [_car(14, 0, "mpv", "navy"), _car(27, 1, "sedan", "gray"), _car(40, -1, "van", "white")],
        "lane": 1,
        "random_state": 5,
    },
    "road5.jpg": {
        "vehicles": [_car(17, 0, "hatchback", "blue"), _car(30, -1, "sedan", "silver")],
        "light": "dusk",
        "lane": 1,
        "random_state": 0,
    },
    "road6.jpg": {
        "shape": (540, 960),
        "vehicles": [_car(16, 1, "estate", "wine"), _car(26, 0, "sedan", "white")],
        "light": "overcast",
        "rain": 0.3,
        "lane": 1,
        "random_state": 2,
    },
}
"""Options of each image; lanes of the cars are relative to that of the camera, positive to the right."""


def draw(name: str) -> Scene:
    """Render one of the images."""
    return render_scene(**SCENES[name])


def main(folder: Path) -> None:
    """Write all images and ``labels.csv`` to a folder."""
    truth = {}
    for name in SCENES:
        scene = draw(name)
        pixels = cv2.cvtColor(scene.image, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / name), pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        truth[name] = scene.truth
    write_labels(truth_table(truth), folder / "labels.csv")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
