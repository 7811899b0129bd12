"""What the notebooks work on: drawn by the project itself, or real where you have it.

Where the environment variable ``VEHICLE_DETECTION_DATA`` names a folder, the notebooks take the
real patches, images and clips in it; without it they need nothing but the project. What they show
of the library they import from the library.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from IPython.display import Markdown
from numpy.typing import NDArray

import vehicle_detection as vd
from vehicle_detection.datasets import PatchSet
from vehicle_detection.evaluation import FrameBoxes
from vehicle_detection.synthetic import SceneVehicle

Image = NDArray[np.uint8]

ROOT = Path(__file__).resolve().parent.parent
"""The project."""

_FOLDER = os.environ.get("VEHICLE_DETECTION_DATA")

DATA = Path(_FOLDER) if _FOLDER else None
"""Folder of the real data; None where there is none."""

DRAWN_HORIZON = 0.56
"""Where the horizon of a drawn scene lies, as a share of its height."""


def patches(drawn: int = 400, real: int = 3000) -> PatchSet:
    """Training patches, about so many: drawn ones, or an even choice of the course's 17,760.

    Half of the drawn ones come from `render_patches` (source ``studio``), each of another vehicle,
    and half are cut out of drawn drives (source ``drive``), frame after frame.
    """
    if DATA is None:
        images, labels = vd.render_patches(drawn // 2)
        names = [f"{_folder(label)}/studio/{row:04}.png" for row, label in enumerate(labels)]
        return PatchSet.concatenate(
            [PatchSet(images, labels, names), _drive_patches(drawn - len(images))]
        )
    whole = vd.load_training_patches(DATA / "vehicles.zip", DATA / "non-vehicles.zip")
    return whole[:: max(1, len(whole) // real)]


def _folder(label: bool) -> str:
    return "vehicles" if label else "non-vehicles"


# Seed, light and rain of the drives, and the share of all patches that is cut out by their end.
_DRIVES = ((0, "day", 0.0, 0.4), (2, "overcast", 0.6, 0.8), (3, "dusk", 0.0, 1.0))


def _drive_patches(count: int) -> PatchSet:
    """Cut patches out of drawn drives: their vehicles, and as many places without any."""
    rng = np.random.default_rng(0)
    cut: dict[bool, list[Image]] = {True: [], False: []}
    for seed, light, rain, share in _DRIVES:
        wanted = round(share * count / 2)
        drive = vd.render_drive(
            frames=3 * count, shape=(540, 960), light=light, rain=rain, random_state=seed
        )
        for scene in (drive[frame] for frame in range(0, len(drive), 3)):
            boxes = np.array([row.box for row in scene.truth], float).reshape(-1, 4)
            whole = [
                not row.ignore and row.occluded < 2 and row.truncated < 0.2 for row in scene.truth
            ]
            seen = boxes[np.array(whole, bool)]
            for x1, y1, x2, y2 in seen:
                # A vehicle fills nine tenths of its patch, as in the course's.
                side = max(x2 - x1, y2 - y1) / 0.9
                cut[True].append(
                    _square(scene.image, (x1 + x2 - side) / 2, (y1 + y2 - side) / 2, side)
                )
            for _ in range(2 * len(seen)):
                side = float(rng.integers(40, 130))
                x, y = rng.uniform(0, 960 - side), rng.uniform(230, 420 - side / 2)
                free = not (vd.iou_matrix([[x, y, x + side, y + side]], boxes) > 0.02).any()
                if free and len(cut[False]) < len(cut[True]):
                    cut[False].append(_square(scene.image, x, y, side))
            if min(map(len, cut.values())) >= wanted:
                break
    rows = [
        (label, row, image)
        for label, found in cut.items()
        for row, image in enumerate(found[:wanted])
    ]
    names = [f"{_folder(label)}/drive/{row:04}.png" for label, row, _ in rows]
    return PatchSet(np.stack([image for *_, image in rows]), [label for label, *_ in rows], names)


def _square(image: Image, x: float, y: float, side: float) -> Image:
    x1, y1, wide = round(max(x, 0)), round(max(y, 0)), round(side)
    return np.asarray(cv2.resize(image[y1 : y1 + wide, x1 : x1 + wide], (64, 64)), np.uint8)


def road_images() -> vd.LabelledFrames:
    """Six road images with their true boxes: those of ``test_images/``, or the course's."""
    if DATA is None:
        folder, labels = ROOT / "test_images", ROOT / "test_images" / "labels.csv"
    else:
        folder, labels = DATA / "test_images", DATA / "labels" / "test_images.csv"
    return vd.LabelledFrames("test images", vd.load_frames(folder), vd.read_labels(labels))


def scenes(count: int = 24) -> vd.LabelledFrames:
    """Frames with their true boxes: drawn scenes, or every n-th frame of the course's clip."""
    if DATA is not None:
        labels = vd.read_labels(DATA / "labels" / "project_clip.csv")
        path = DATA / "videos" / "project_clip.mp4"
        every = max(1, len(labels.frame_keys) // count)
        return vd.LabelledFrames.from_video(path, labels, every=every, name="clip")
    lights = ("day", "overcast", "dusk")
    drawn = [
        vd.render_scene(shape=(540, 960), light=lights[seed % 3], random_state=seed)
        for seed in range(count)
    ]
    return labelled("drawn scenes", drawn)


CARS = ("hatchback", "estate", "sedan", "mpv", "suv")
HEAVY = ("van", "truck")


def other_roads(count: int = 8) -> list[vd.LabelledFrames]:
    """So many frames of each of several kinds of roads: drawn ones, or those of other countries."""
    if DATA is not None:
        return [_thinned(name, 3 * count) for name in ("camvid", "india", "indonesia")]
    return [
        labelled("cars from behind", _queue(count, CARS)),
        labelled("cars from the front", _queue(count, CARS, view="front")),
        labelled("vans and trucks", _queue(count, HEAVY)),
        labelled("rain at dusk", _queue(count, CARS + HEAVY, light="dusk", rain=0.8)),
        labelled("night", _queue(count, CARS + HEAVY, light="night")),
    ]


def _queue(count: int, kinds: Sequence[str], *, view: str = "rear", **options: Any) -> list[Any]:
    """Draw scenes with a vehicle in each of three lanes."""
    rng = np.random.default_rng(0)
    drawn = []
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
        drawn.append(
            vd.render_scene(
                shape=(432, 768), lane=1, vehicles=vehicles, random_state=seed, **options
            )
        )
    return drawn


def _thinned(name: str, count: int) -> vd.LabelledFrames:
    """Take every n-th frame of a folder of real frames."""
    assert DATA is not None
    frames = vd.load_frames(DATA / "frames" / name)
    labels = vd.read_labels(DATA / "labels" / f"{name}.csv")
    step = max(1, len(frames) // count)
    chosen = {frames.names[row]: frames[row] for row in range(0, len(frames), step)}
    return vd.LabelledFrames(name, chosen, labels)


def labelled(name: str, drawn: Sequence[Any]) -> vd.LabelledFrames:
    """Put drawn scenes and their truth together under a name."""
    rows = [(number, row) for number, scene in enumerate(drawn) for row in scene.truth]
    labels = FrameBoxes(
        [number for number, _ in rows],
        np.array([row.track for _, row in rows], int),
        np.array([row.box for _, row in rows], float).reshape(-1, 4),
        ignore=np.array([row.ignore for _, row in rows], bool),
        frame_keys=range(len(drawn)),
    )
    return vd.LabelledFrames(name, [scene.image for scene in drawn], labels)


@dataclass(frozen=True)
class Clip:
    """A short video file.

    Attributes
    ----------
    path
        The file.
    horizon
        Where its horizon lies, as a share of the height.
    end
        How many of its seconds to take.
    labels
        Its true boxes.
    truth
        The same; of a drawn drive with distances and speeds.
    """

    path: Path
    horizon: float
    end: float
    labels: FrameBoxes
    truth: Any


def clip(folder: str | os.PathLike[str], frames: int = 50) -> Clip:
    """Write a drawn drive of so many frames to a folder, or take as many of the course's clip."""
    if DATA is not None:
        labels = vd.read_labels(DATA / "labels" / "project_clip.csv")
        path = DATA / "videos" / "project_clip.mp4"
        fps = float(vd.probe_video(path).fps)
        labels = labels[np.array(labels.frames) < frames]
        return Clip(path, 0.58, frames / fps, labels, labels)
    from moviepy import ImageSequenceClip

    drive = vd.render_drive(frames=frames, shape=(540, 960))
    path, table = Path(folder) / "drive.mp4", Path(folder) / "truth.csv"
    film = ImageSequenceClip([scene.image for scene in drive], fps=drive.fps)
    film.write_videofile(str(path), preset="veryfast", audio=False, logger=None)
    drive.write_labels(table)
    return Clip(path, DRAWN_HORIZON, frames / drive.fps, vd.read_labels(table), drive.truth)


def zoom(figure: Any, top: float = 0.45, bottom: float = 0.82) -> Any:
    """Show of each picture of a figure only the rows between two shares of its height: the road."""
    for panel in figure.axes:
        if panel.images:
            low, high = sorted(panel.get_ylim())
            panel.set_ylim(low + bottom * (high - low), low + top * (high - low))
    figure.set_figheight(figure.get_figheight() * (bottom - top) * 1.2)
    return figure


def table(rows: Sequence[Mapping[str, object]]) -> Markdown:
    """Show rows as a table; numbers with few digits."""
    columns = list(rows[0])
    lines = [" | ".join(columns), " | ".join("---" for _ in columns)]
    lines += [" | ".join(_cell(row.get(column)) for column in columns) for row in rows]
    return Markdown("\n".join(f"| {line} |" for line in lines))


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1 else f"{value:,.2f}"
    return f"{value:,}" if isinstance(value, (int, np.integer)) else str(value)
