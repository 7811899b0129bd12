"""Labelled frames to train the mixture on, without noise and haze."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import store_number
from vehicle_detection.training import FrameDataset as LabelledDataset
from vehicle_detection.training import find_sources as find_datasets
from vehicle_detection.training import load_training_frames as load_frames


@dataclass(frozen=True, eq=False)
class FrameDataset(LabelledDataset):
    """Labelled frames of one camera or country, for `train_mixture`.

    Attributes
    ----------
    name, sets
        Name of the data set, and its sets of labelled frames.
    min_labelled_width
        Width in pixels from which on every vehicle is labelled; narrower windows are never negatives.

    Raises
    ------
    InvalidInputError
        If the name is empty, or there are no frames.

    Examples
    --------
    >>> from vehicle_detection.evaluation import FrameBoxes, LabelledFrames
    >>> labels = FrameBoxes([0], None, [[9, 9, 60, 50]])
    >>> road = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    >>> FrameDataset("camera", [road], min_labelled_width=40).sets
    (LabelledFrames('road', 1 frame, 1 box),)
    """

    min_labelled_width: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        store_number(self, "min_labelled_width", low=0)


def find_sources(
    folder: str | os.PathLike[str],
    *,
    min_labelled_widths: Mapping[str, float] | None = None,
    clip_rate: float = 3.0,
) -> list[FrameDataset]:
    """Read a folder as `vehicle_detection.training.find_sources` does.

    `min_labelled_widths` gives the ``min_labelled_width`` of data sets by name, else 0.
    """
    widths = min_labelled_widths or {}
    found = find_datasets(folder, clip_rate=clip_rate)
    return [FrameDataset(each.name, each.sets, widths.get(each.name, 0.0)) for each in found]


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """A loaded frame and its labels."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB, without noise and haze
    boxes: NDArray[np.float64]  # (N, 4) vehicles
    ignored: NDArray[np.float64]  # (M, 4) ignored boxes
    min_labelled_width: float  # width in pixels from which on every vehicle is labelled


def load_training_frames(sources: Sequence[LabelledDataset]) -> list[TrainingFrame]:
    """Load all frames of some data sets into memory."""
    # Imported here, because mypy takes the name for a module if it is the only one imported at the top.
    from vehicle_detection.mixture import prepare

    widths = {each.name: getattr(each, "min_labelled_width", 0.0) for each in sources}
    return [
        TrainingFrame(prepare(each.image), each.boxes, each.ignored, widths[each.source])
        for each in load_frames(sources)
    ]
