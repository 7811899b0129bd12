"""The labelled frames of a data folder, by source."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.datasets import load_frames, load_patches
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames, read_labels
from vehicle_detection.mixture_training.negatives import FrameDataset

COURSE = "course"
"""Source of everything that is not below ``frames``: the images and clips of the course's road."""

# Frames a second of the clips that are trained on; neighbors show the same.
_CLIP_RATE = 3.0
# Sources that leave small vehicles of the background unlabelled, and the width from which on they do not.
_COMPLETE_FROM = {"indonesia": 60.0}
# One of so many of the course's patches are trained on; neighbors show the same car.
_PATCH_STEP = 6


def find_sources(folder: str | os.PathLike[str]) -> list[FrameDataset]:
    """Find the labelled frames of a folder.

    Parameters
    ----------
    folder
        Holds ``labels/NAME.csv`` for each set of frames, and these in ``frames/NAME/`` (a source of its own),
        ``NAME/`` or ``videos/NAME.mp4`` (together the source ``"course"``).

    Returns
    -------
    list of FrameDataset
        By name, the course last.

    Raises
    ------
    DatasetError
        If there are no labels, or frames to labels are missing.
    InvalidInputError
        If a file of labels is damaged, or knows none of its frames.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DatasetError(f"folder {root} does not exist; name the folder of the labelled frames")
    files = sorted(root.glob("labels/*.csv"))
    if not files:
        raise DatasetError(f"folder {root} has no labels/NAME.csv; name the folder of the labelled frames")
    sources, course = [], []
    for file in files:
        name, labels = file.stem, read_labels(file)
        frames, images, video = root / "frames" / name, root / name, root / "videos" / f"{name}.mp4"
        try:
            if frames.is_dir():
                part = LabelledFrames(name, load_frames(frames), labels)
                sources.append(FrameDataset(name, (part,), _COMPLETE_FROM.get(name, 0.0)))
            elif images.is_dir():
                course.append(LabelledFrames(name, load_frames(images), labels))
            elif video.is_file():
                course.append(_sampled(video, labels))
            else:
                raise DatasetError(
                    f"{file} has no frames: neither {frames}, {images} nor {video} exists; add them"
                )
        except InvalidInputError as error:
            raise InvalidInputError(f"{file}: {error}") from error
    return sources + ([FrameDataset(COURSE, tuple(course))] if course else [])


def find_patches(folder: str | os.PathLike[str]) -> list[NDArray[np.uint8]]:
    """Take some of the course's vehicle patches, ``(64, 64, 3)`` each, from a folder; none where it has none.

    Parameters
    ----------
    folder
        May hold ``vehicles.zip``, or what it unpacks to in ``vehicles/``.

    Raises
    ------
    DatasetError
        As in `datasets.load_patches`.
    """
    for place in (Path(folder) / "vehicles.zip", Path(folder) / "vehicles"):
        if place.exists():
            return list(load_patches(place, label=1).patches[::_PATCH_STEP])
    return []


def _sampled(video: Path, labels: FrameBoxes) -> LabelledFrames:
    from vehicle_detection.video import probe_video

    every = max(1, round(float(probe_video(video).fps) / _CLIP_RATE))
    return LabelledFrames.from_video(video, labels, every=every)
