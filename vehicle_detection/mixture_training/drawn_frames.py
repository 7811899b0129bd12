"""Frames of the project's own drawn drives, as one more source to train on."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from vehicle_detection._common import check_integer
from vehicle_detection.evaluation import FrameBoxes, FrameKey, LabelledFrames
from vehicle_detection.mixture_training.negatives import FrameDataset
from vehicle_detection.synthetic import Drive, render_drive

DRAWN = "drawn"
"""Name of the source of drawn frames."""

_CASES: tuple[dict[str, Any], ...] = (
    {},
    {"scenario": "overtaking"},
    {"scenario": "crossing"},
    {"scenario": "occlusion"},
    {"scenario": "empty"},
    {"rain": 0.6},
    {"light": "overcast"},
    {"light": "dusk"},
    {"light": "night"},
    {"shape": (540, 960)},
    {"shape": (1080, 1920)},
    {"light": "night", "rain": 0.6},
    {"light": "night", "shape": (540, 960)},
    {"scenario": "overtaking", "cut": True},
    {"scenario": "overtaking", "light": "night", "cut": True},
)
"""Options of `render_drive` for each kind; "cut": shown where the frame's border cuts a vehicle."""

_FRAMES = 200
# Share of a vehicle outside the frame from which on the border cuts it.
_CUT = 0.2
# Frames from one that is looked at for such a vehicle to the next.
_STEP = 5


def drawn_source(*, drives: int = 2 * len(_CASES), frames: int = 2, random_state: int = 0) -> FrameDataset:
    """Draw frames of different roads, lights and sizes, with their vehicles.

    Parameters
    ----------
    drives
        Number of drives, one of each kind in turn.
    frames
        Frames of each drive, at equal distances.
    random_state
        Seed; every drive has a seed of its own that follows from it.

    Returns
    -------
    FrameDataset
        A set of frames for each drive.

    Raises
    ------
    InvalidInputError
        If a number is out of range.

    Examples
    --------
    >>> drawn_source(drives=1, frames=2).sets
    (LabelledFrames('drawn 1', 2 frames, 16 boxes),)
    """
    count = check_integer(drives, "drives", low=1)
    taken = check_integer(frames, "frames", low=1, high=_FRAMES)
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    parts = []
    for number, case in zip(range(count), itertools.cycle(_CASES)):
        # Two numbers: a drive that somebody draws from one number is another one.
        rng = np.random.default_rng([random_state, number])
        options = {name: value for name, value in case.items() if name != "cut"}
        drive = render_drive(frames=_FRAMES, random_state=rng, **options)
        parts.append(_sampled(f"{DRAWN} {number + 1}", drive, taken, cut=case.get("cut", False)))
    return FrameDataset(DRAWN, tuple(parts))


def _sampled(name: str, drive: Drive, frames: int, *, cut: bool) -> LabelledFrames:
    """Take frames at equal distances from a drive, or those near them in which the border cuts a vehicle."""
    chosen = np.linspace(0, len(drive) - 1, frames + 2)[1:-1].astype(int).tolist()
    if cut:
        chosen = [_where_cut(drive, index) for index in chosen]
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
    return LabelledFrames(name, images, labels)


def _where_cut(drive: Drive, index: int) -> int:
    """Find the frame next to this one in which the border cuts a vehicle; this one if there is none."""
    for other in sorted(range(index % _STEP, len(drive), _STEP), key=lambda other: abs(other - index)):
        if any(row.truncated > _CUT and not row.ignore for row in drive[other].truth):
            return other
    return index
