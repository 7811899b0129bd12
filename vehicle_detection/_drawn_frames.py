"""Frames of the project's own drawn drives, as one more source to train on."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from vehicle_detection._checks import check_integer
from vehicle_detection._labelled_frames import FrameKey, LabelledFrames
from vehicle_detection._mixture_windows import FrameSource
from vehicle_detection.evaluation import Labels
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
)
_FRAMES = 200


def drawn_source(*, drives: int = 2 * len(_CASES), frames: int = 1, random_state: int = 0) -> FrameSource:
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
    FrameSource
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
        drive = render_drive(frames=_FRAMES, random_state=rng, **case)
        parts.append(_sampled(f"{DRAWN} {number + 1}", drive, taken))
    return FrameSource(DRAWN, tuple(parts))


def _sampled(name: str, drive: Drive, frames: int) -> LabelledFrames:
    chosen = np.linspace(0, len(drive) - 1, frames + 2)[1:-1].astype(int).tolist()
    images: dict[FrameKey, Any] = {index: drive[index].image for index in chosen}
    rows = [(index, row) for index in chosen for row in drive.truth[index]]
    labels = Labels(
        [index for index, _ in rows],
        np.array([row.track for _, row in rows], np.intp),
        np.array([row.box for _, row in rows], np.float64).reshape(-1, 4),
        ignore=np.array([row.ignore for _, row in rows], np.bool_),
        frame_keys=chosen,
    )
    return LabelledFrames(name, images, labels)
