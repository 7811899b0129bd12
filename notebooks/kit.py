"""Data of the notebooks: rendered by the project, or real data if available.

If the environment variable ``VEHICLE_DETECTION_DATA`` names a folder, the notebooks use the real
patches, images and videos in it; otherwise they need only this project.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

import vehicle_detection as vd
from vehicle_detection.scenes import SceneVehicle, truth_table

Image = NDArray[np.uint8]

ROOT = Path(__file__).resolve().parent.parent
"""The project's folder."""

_FOLDER = os.environ.get("VEHICLE_DETECTION_DATA")

DATA = Path(_FOLDER) if _FOLDER else None
"""Folder of the real data, or None."""

SYNTHETIC_HORIZON = 0.56
"""Horizon of rendered scenes, as a fraction of the frame's height."""

# Seed, light and rain of the rendered drives that patches are cut from, and the fraction of these
# patches that is available after each drive.
_DRIVES = ((0, "day", 0.0, 0.4), (2, "overcast", 0.6, 0.8), (3, "dusk", 0.0, 1.0))

CARS = ("hatchback", "estate", "sedan", "mpv", "suv")
HEAVY = ("van", "truck")


def patches(synthetic: int = 400, real: int = 3000) -> vd.PatchSet:
    """About this many training patches: rendered, or evenly spaced ones of the course's 17,760.

    Half of the rendered ones are those of `render_patches` (source ``studio``), each of another
    vehicle; the other half is cut from the frames of rendered drives (source ``drive``).
    """
    if DATA is None:
        images, labels = vd.render_patches(synthetic // 2)
        names = [f"{_folder(label)}/studio/{row:04}.png" for row, label in enumerate(labels)]
        return vd.PatchSet.concatenate(
            [vd.PatchSet(images, labels, names), _drive_patches(synthetic - len(images))]
        )
    patch_set = vd.load_training_patches(DATA / "vehicles.zip", DATA / "non-vehicles.zip")
    return patch_set[:: max(1, len(patch_set) // real)]


def _folder(label: bool) -> str:
    return "vehicles" if label else "non-vehicles"


def _drive_patches(count: int) -> vd.PatchSet:
    """Cut patches from rendered drives: the vehicles, and as many places without vehicles."""
    rng = np.random.default_rng(0)
    crops: dict[bool, list[Image]] = {True: [], False: []}
    for seed, light, rain, fraction in _DRIVES:
        drive = vd.render_drive(
            frames=3 * count, shape=(540, 960), light=light, rain=rain, random_state=seed
        )
        for scene in (drive[frame] for frame in range(0, len(drive), 3)):
            boxes = np.array([row.box for row in scene.truth], float).reshape(-1, 4)
            visible = [
                not row.ignore and row.occluded < 2 and row.truncated < 0.2 for row in scene.truth
            ]
            vehicles = boxes[np.array(visible, bool)]
            for x1, y1, x2, y2 in vehicles:
                # A vehicle fills 90% of its patch, as in the course's patches.
                side = max(x2 - x1, y2 - y1) / 0.9
                left, top = (x1 + x2 - side) / 2, (y1 + y2 - side) / 2
                crops[True].append(_crop(scene.image, left, top, side))
            for _ in range(2 * len(vehicles)):
                side = float(rng.integers(40, 130))
                x, y = rng.uniform(0, 960 - side), rng.uniform(230, 420 - side / 2)
                free = not (vd.iou_matrix([[x, y, x + side, y + side]], boxes) > 0.02).any()
                if free and len(crops[False]) < len(crops[True]):
                    crops[False].append(_crop(scene.image, x, y, side))
            if min(map(len, crops.values())) >= round(fraction * count / 2):
                break
    selected = [
        (label, row, image)
        for label, images in crops.items()
        for row, image in enumerate(images[: round(count / 2)])
    ]
    names = [f"{_folder(label)}/drive/{row:04}.png" for label, row, _ in selected]
    images = np.stack([image for *_, image in selected])
    return vd.PatchSet(images, [label for label, *_ in selected], names)


def _crop(image: Image, x: float, y: float, side: float) -> Image:
    left, top, size = round(max(x, 0)), round(max(y, 0)), round(side)
    return np.asarray(cv2.resize(image[top : top + size, left : left + size], (64, 64)), np.uint8)


def road_images() -> vd.LabelledFrames:
    """Six road images with their true boxes: those of ``test_images/``, or the course's."""
    if DATA is None:
        folder, labels = ROOT / "test_images", ROOT / "test_images" / "labels.csv"
    else:
        folder, labels = DATA / "test_images", DATA / "labels" / "test_images.csv"
    return vd.LabelledFrames("test images", vd.load_frames(folder), vd.read_labels(labels))


def scenes(count: int = 24) -> vd.LabelledFrames:
    """Frames with their true boxes: rendered scenes, or evenly spaced frames of a course video."""
    if DATA is not None:
        labels = vd.read_labels(DATA / "labels" / "project_clip.csv")
        path = DATA / "videos" / "project_clip.mp4"
        every = max(1, len(labels.frame_keys) // count)
        return vd.LabelledFrames.from_video(path, labels, every=every, name="clip")
    lights = ("day", "overcast", "dusk")
    rendered = [
        vd.render_scene(shape=(540, 960), light=lights[seed % 3], random_state=seed)
        for seed in range(count)
    ]
    return _label("rendered scenes", rendered)


def other_roads(count: int = 8) -> list[vd.LabelledFrames]:
    """About `count` frames of each of several kinds of roads: rendered, or of other countries."""
    if DATA is not None:
        return [_subsample(name, 3 * count) for name in ("camvid", "india", "indonesia")]
    return [
        _label("cars from behind", _render_traffic(count, CARS)),
        _label("cars from the front", _render_traffic(count, CARS, view="front")),
        _label("vans and trucks", _render_traffic(count, HEAVY)),
        _label("rain at dusk", _render_traffic(count, CARS + HEAVY, light="dusk", rain=0.8)),
        _label("night", _render_traffic(count, CARS + HEAVY, light="night")),
    ]


def _render_traffic(
    count: int, kinds: Sequence[str], *, view: str = "rear", **options: Any
) -> list[Any]:
    """Render scenes with a vehicle in each of three lanes."""
    rng = np.random.default_rng(0)
    rendered = []
    for seed in range(count):
        vehicles = [
            SceneVehicle(
                distance_m=float(rng.uniform(9, 30)),
                lateral_m=lateral + float(rng.uniform(-0.3, 0.3)),
                kind=str(rng.choice(kinds)),
                view=view,
            )
            for lateral in (-3.6, 0.0, 3.6)
        ]
        scene = vd.render_scene(
            shape=(432, 768), lane=1, vehicles=vehicles, random_state=seed, **options
        )
        rendered.append(scene)
    return rendered


def _subsample(name: str, count: int) -> vd.LabelledFrames:
    """Read evenly spaced frames of a folder of real frames."""
    assert DATA is not None
    frames = vd.load_frames(DATA / "frames" / name)
    labels = vd.read_labels(DATA / "labels" / f"{name}.csv")
    step = max(1, len(frames) // count)
    selected = {frames.names[row]: frames[row] for row in range(0, len(frames), step)}
    return vd.LabelledFrames(name, selected, labels)


def _label(name: str, rendered: Sequence[Any]) -> vd.LabelledFrames:
    """Combine rendered scenes and their true boxes."""
    labels = truth_table({number: scene.truth for number, scene in enumerate(rendered)})
    return vd.LabelledFrames(name, [scene.image for scene in rendered], labels)


@dataclass(frozen=True)
class Clip:
    """A short video file.

    Attributes
    ----------
    path
        The file.
    horizon
        Its horizon, as a fraction of the frame's height.
    end
        Number of seconds to process.
    labels
        The true boxes; for a rendered drive with distances and speeds.
    """

    path: Path
    horizon: float
    end: float
    labels: vd.TrackTable


def clip(folder: str | os.PathLike[str], frames: int = 50) -> Clip:
    """Write a rendered drive to a folder, or use the first frames of a course video."""
    if DATA is not None:
        labels = vd.read_labels(DATA / "labels" / "project_clip.csv")
        path = DATA / "videos" / "project_clip.mp4"
        fps = float(vd.probe_video(path).fps)
        labels = labels[labels["frame"] < frames]
        return Clip(path, 0.58, frames / fps, labels)
    from moviepy import ImageSequenceClip

    drive = vd.render_drive(frames=frames, shape=(540, 960))
    path = Path(folder) / "drive.mp4"
    video = ImageSequenceClip([scene.image for scene in drive], fps=drive.fps)
    video.write_videofile(str(path), preset="veryfast", audio=False, logger=None)
    return Clip(path, SYNTHETIC_HORIZON, frames / drive.fps, drive.labels)


def zoom(figure: Any, top: float = 0.45, bottom: float = 0.82) -> Any:
    """Restrict the images of a figure to rows between two fractions of their height: the road."""
    for panel in figure.axes:
        if panel.images:
            low, high = sorted(panel.get_ylim())
            panel.set_ylim(low + bottom * (high - low), low + top * (high - low))
    figure.set_figheight(figure.get_figheight() * (bottom - top) * 1.2)
    return figure


def score_table(scores: Mapping[Any, vd.evaluation.DetectionScores]) -> pd.DataFrame:
    """Tabulate detection scores, one row per entry."""
    columns = {"F1": "f1", "found": "tp", "missed": "fn", "false": "fp", "mean IoU": "mean_iou"}
    rows = {
        name: {column: getattr(score, field) for column, field in columns.items()}
        for name, score in scores.items()
    }
    return pd.DataFrame.from_dict(rows, orient="index")


pd.set_option("display.precision", 3)
