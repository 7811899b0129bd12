"""Images with their labels: `LabelledFrames`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid, pluralize
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.matching import match_names
from vehicle_detection.tables import FrameKey, TrackTable

Frames = Mapping[FrameKey, NDArray[np.uint8]] | FrameSet | Sequence[NDArray[np.uint8]]
"""Images by key, a `FrameSet`, or a list of images that are numbered from 0."""


def keyed_frames(frames: Frames) -> Mapping[FrameKey, NDArray[np.uint8]] | FrameSet:
    """Return frames with keys; the images of a list are numbered from 0."""
    given: object = frames
    if isinstance(given, (FrameSet, Mapping)):
        return given
    if isinstance(given, (list, tuple)):
        return dict(enumerate(given))
    must = "be a list of images, a mapping from key to image, or the frames of load_frames"
    raise invalid("frames", must, given)


@dataclass(frozen=True, eq=False, repr=False)
class LabelledFrames:
    """A named set of frames with its labels. A frame without any box shows no vehicle.

    >>> labels = TrackTable([0], None, [[10, 10, 60, 50]])
    >>> LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    LabelledFrames('road', 1 frame, 1 box)
    """

    name: str  #: name of the set in tables
    #: ``(H, W, 3)`` uint8 RGB images by key (``{7: image}``), in a list that is numbered from 0, or in a
    #: `FrameSet`, which reads each image when it is used.
    frames: Mapping[FrameKey, NDArray[np.uint8]] | FrameSet
    labels: TrackTable  #: true boxes; those of other frames are dropped
    #: Row of the horizon as a fraction of the frame height; None keeps the default of the search.
    horizon: float | None = None

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name:
            raise invalid("name", "be a non-empty string", name)
        object.__setattr__(self, "frames", keyed_frames(self.frames))
        keys, labels = self.keys, self.labels
        if not keys:
            raise InvalidInputError("frames must hold at least one image, got none")
        check.instance(labels, "labels", TrackTable, "read a file with read_labels")
        labels = match_names(labels, keys, ("labels", "frames"))
        if labels.frame_keys and not set(keys) & set(labels.frame_keys):
            raise InvalidInputError(
                f"labels must name the frames, such as {keys[0]!r}, got {labels.frame_keys[0]!r}; "
                "use the same names in both"
            )
        if self.horizon is not None:
            object.__setattr__(self, "horizon", check.number(self.horizon, "horizon", low=0, high=1))
        object.__setattr__(self, "labels", labels.select(keys))

    def __repr__(self) -> str:
        frames, boxes = pluralize(len(self), "frame"), pluralize(len(self.labels), "box", "es")
        return f"LabelledFrames({self.name!r}, {frames}, {boxes})"

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of the frames."""
        return tuple(self.frames) if isinstance(self.frames, Mapping) else self.frames.names

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, key: FrameKey) -> NDArray[np.uint8]:
        """Read the image of one frame."""
        frames = self.frames
        image = frames[frames.names.index(str(key))] if isinstance(frames, FrameSet) else frames[key]
        return check.image(image, f"frame {key!r}")

    def __iter__(self) -> Iterator[tuple[FrameKey, NDArray[np.uint8]]]:
        return ((key, self[key]) for key in self.keys)

    @classmethod
    def from_video(
        cls,
        path: str | os.PathLike[str],
        labels: TrackTable,
        *,
        every: int = 1,
        name: str | None = None,
        horizon: float | None = None,
    ) -> LabelledFrames:
        """Read every n-th frame of a video, whose labels are keyed by frame number, into memory.

        `every` is the step between the chosen frames. None as `name` takes the file name without its suffix.
        """
        from vehicle_detection.video import read_frames

        step = check.integer(every, "every", low=1)
        with read_frames(path) as reader:
            chosen: dict[FrameKey, NDArray[np.uint8]] = {
                index: frame for index, _, frame in reader if index % step == 0
            }
        return cls(Path(path).stem if name is None else name, chosen, labels, horizon)
