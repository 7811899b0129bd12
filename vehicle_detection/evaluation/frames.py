"""Frames with their true boxes: what a detector is scored on, and where its false windows are found."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image, check_integer, check_number, describe
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.detections import Labels

FrameKey = int | str

Frames = Mapping[FrameKey, NDArray[np.uint8]] | FrameSet | Sequence[NDArray[np.uint8]]


def keyed_frames(frames: Frames, name: str = "frames") -> Mapping[FrameKey, NDArray[np.uint8]] | FrameSet:
    """Return frames that go by keys; those of a list go by their numbers."""
    given: object = frames
    if isinstance(given, (FrameSet, Mapping)):
        return given
    if isinstance(given, (list, tuple)):
        return dict(enumerate(given))
    raise InvalidInputError(
        f"{name} must be a list of images, a mapping from key to image, or the frames of load_frames; "
        f"got {describe(given)}"
    )


def pairs_of(
    frames: Mapping[FrameKey, NDArray[np.uint8]] | FrameSet,
) -> Iterator[tuple[FrameKey, NDArray[np.uint8]]]:
    """Yield each key with its checked image."""
    for key, image in frames.items() if isinstance(frames, Mapping) else frames:
        yield key, check_image(image, f"frame {key!r}")


def keys_of(frames: Mapping[FrameKey, NDArray[np.uint8]] | FrameSet) -> tuple[FrameKey, ...]:
    """List the frames' keys."""
    return tuple(frames) if isinstance(frames, Mapping) else frames.names


def check_labels_of(keys: Sequence[FrameKey], labels: object, name: str = "labels") -> Labels:
    """Return `labels` if they know at least one of the frames."""
    if not isinstance(labels, Labels):
        raise InvalidInputError(
            f"{name} must be Labels, got {describe(labels)}; read a file with read_labels"
        )
    if keys and not set(keys) & set(labels.frame_keys):
        known = f"such as {labels.frame_keys[0]!r}" if labels.frame_keys else "but it is empty"
        raise InvalidInputError(
            f"{name} know none of the frames, such as {keys[0]!r}, {known}; convert with Labels.renamed"
        )
    return labels


@dataclass(frozen=True, eq=False, repr=False)
class LabelledFrames:
    """Frames and their labels under a name.

    Attributes
    ----------
    name
        Name of the set in a table.
    frames
        Images by key (``{7: image}``), a list of images that go by their numbers, or a `FrameSet`, which
        reads an image when it is needed: ``(H, W, 3)`` uint8 RGB.
    labels
        True boxes; those of other frames do not matter. A frame without any box counts as empty.
    horizon
        Height of the horizon as a share of the frames' height; None keeps the search's.

    Examples
    --------
    >>> labels = Labels([0], None, [[10, 10, 60, 50]])
    >>> LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    LabelledFrames('road', 1 frame, 1 box)
    """

    name: str
    frames: Mapping[FrameKey, NDArray[np.uint8]] | FrameSet
    labels: Labels
    horizon: float | None = None

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name:
            raise InvalidInputError(f"name must be a word for the frames, got {describe(name)}")
        frames = keyed_frames(self.frames)
        keys = keys_of(frames)
        if not keys:
            raise InvalidInputError("frames must hold at least one image, got none")
        labels = check_labels_of(keys, self.labels)
        if self.horizon is not None:
            check_number(self.horizon, "horizon", low=0, high=1)
        known = set(keys)
        mask = np.array([key in known for key in labels.frames], np.bool_)
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "labels", labels[mask])

    def __repr__(self) -> str:
        frames, boxes = len(self.keys), len(self.labels)
        return (
            f"LabelledFrames({self.name!r}, {frames} frame{'s' * (frames != 1)}, "
            f"{boxes} box{'es' * (boxes != 1)})"
        )

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of the frames."""
        return keys_of(self.frames)

    def __len__(self) -> int:
        return len(self.keys)

    def __iter__(self) -> Iterator[tuple[FrameKey, NDArray[np.uint8]]]:
        return pairs_of(self.frames)

    @classmethod
    def from_video(
        cls,
        path: str | os.PathLike[str],
        labels: Labels,
        *,
        every: int = 1,
        name: str | None = None,
        horizon: float | None = None,
    ) -> LabelledFrames:
        """Take every n-th frame of a video, with labels that go by its frames' numbers.

        Parameters
        ----------
        path
            A file that ffmpeg can read. The chosen frames are kept in memory.
        labels
            True boxes.
        every
            Distance between the chosen frames; neighbours show the same.
        name
            Name of the set; None takes the file's.
        horizon
            As in the class.

        Raises
        ------
        InvalidInputError, VideoError
            If the file is missing or no video, or the labels know none of its frames.
        """
        from vehicle_detection.video import read_frames

        step = check_integer(every, "every", low=1)
        with read_frames(path) as reader:
            chosen: dict[FrameKey, NDArray[np.uint8]] = {
                index: frame for index, _, frame in reader if index % step == 0
            }
        return cls(name or Path(path).stem, chosen, labels, horizon)
