"""Frames of synthetic drives, as an additional data set to train on."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from vehicle_detection._common import check_integer
from vehicle_detection.evaluation import FrameBoxes, FrameKey, LabelledFrames
from vehicle_detection.mixture_training.sources import FrameDataset
from vehicle_detection.synthetic import Drive, render_drive

# Options of `render_drive`; "truncated" chooses frames in which the border truncates a vehicle.
_CASES: tuple[dict[str, Any], ...] = (
    {}, {"scenario": "overtaking"}, {"scenario": "crossing"}, {"scenario": "occlusion"},
    {"scenario": "empty"}, {"rain": 0.6}, {"light": "overcast"}, {"light": "dusk"}, {"light": "night"},
    {"shape": (540, 960)}, {"shape": (1080, 1920)},
    {"light": "night", "rain": 0.6}, {"light": "night", "shape": (540, 960)},
    {"scenario": "overtaking", "truncated": True},
    {"scenario": "overtaking", "light": "night", "truncated": True},
)  # fmt: skip

_FRAMES = 200
# Smallest fraction of a truncated vehicle outside the frame; one frame in so many is searched for one.
_MIN_TRUNCATED, _STEP = 0.2, 5


def drawn_source(*, drives: int = 2 * len(_CASES), frames: int = 2, random_state: int = 0) -> FrameDataset:
    """Render frames of different roads, lights and sizes, with their vehicles as labels.

    The kinds of drives take turns, and the frames of a drive are equally spaced. The seed of every drive
    follows from `random_state`.

    >>> drawn_source(drives=1, frames=2).sets
    (LabelledFrames('drawn 1', 2 frames, 16 boxes),)
    """
    n_drives = check_integer(drives, "drives", low=1)
    n_frames = check_integer(frames, "frames", low=1, high=_FRAMES)
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    parts = []
    for number, case in zip(range(n_drives), itertools.cycle(_CASES)):
        # A seed of two numbers differs from every seed of one number that a user may pass to render_drive.
        rng = np.random.default_rng([random_state, number])
        options = {name: value for name, value in case.items() if name != "truncated"}
        drive = render_drive(frames=_FRAMES, random_state=rng, **options)
        chosen = np.linspace(0, len(drive) - 1, n_frames + 2)[1:-1].astype(int).tolist()
        if case.get("truncated", False):
            chosen = [_closest_truncation(drive, index) for index in chosen]
        scenes = {index: drive[index] for index in chosen}
        images: dict[FrameKey, Any] = {index: scene.image for index, scene in scenes.items()}
        rows = [(index, row) for index, scene in scenes.items() for row in scene.truth]
        labels = FrameBoxes(
            [index for index, _ in rows],
            np.array([row.track for _, row in rows], np.intp),
            np.array([row.box for _, row in rows], np.float64).reshape(-1, 4),
            ignore=np.array([row.ignore for _, row in rows], np.bool_),
            frame_keys=chosen,
        )
        parts.append(LabelledFrames(f"drawn {number + 1}", images, labels))
    return FrameDataset("drawn", tuple(parts))


def _closest_truncation(drive: Drive, index: int) -> int:
    """Find the closest frame to `index` in which the border truncates a vehicle; `index` if there is none."""
    for other in sorted(range(index % _STEP, len(drive), _STEP), key=lambda other: abs(other - index)):
        if any(row.truncated > _MIN_TRUNCATED and not row.ignore for row in drive[other].truth):
            return other
    return index
