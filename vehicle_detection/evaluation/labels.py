"""Boxes in frames as columns; ``evaluation`` shows `FrameBoxes` to the users."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_image, check_integer, check_number, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError

FrameKey = int | str

NO_TRACK = -1
"""Track of a box without identity; a row to ignore with this track is a region, not a vehicle's box."""

# What Labels holds a row besides its frame.
_ARRAYS = ("tracks", "boxes", "occluded", "truncated", "ignore", "scores", "distance_m", "speed_mps")


def check_keys(values: object, name: str) -> tuple[FrameKey, ...]:
    """Return frame keys as Python ints or strs, one kind throughout."""
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise InvalidInputError(
            f"{name} must be a sequence of frame keys (int or str), got {describe(values)}"
        )
    keys = tuple(key.item() if isinstance(key, np.generic) else key for key in values)
    kinds = {type(key) for key in keys}
    if kinds - {int} and kinds - {str}:
        listed = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise InvalidInputError(f"{name} must be all int or all str, got {listed}; convert them to one kind")
    return keys


def frame_order(key: FrameKey) -> tuple[tuple[int, str], ...]:
    """Sort key under which frame 2 comes before frame 10, in file names too."""
    if isinstance(key, int):
        return ((key, ""),)
    parts = re.split(r"([0-9]+)", key)
    return tuple((int(part), "") if index % 2 else (-1, part) for index, part in enumerate(parts))


def _column(values: ArrayLike | None, name: str, rows: int, kinds: str, default: Any) -> NDArray[Any]:
    """One value a row, of one of the dtype `kinds`, as the dtype of `default`."""
    dtype = np.asarray(default).dtype
    column = np.full(rows, default) if values is None else np.asarray(values)
    if column.size == 0:
        column = column.reshape(-1).astype(dtype)
    if column.shape != (rows,) or column.dtype.kind not in kinds:
        raise InvalidInputError(
            f"{name} must be one value for each of the {rows} boxes, got {describe(column)}"
        )
    return column.astype(dtype)


@dataclass(frozen=True, eq=False, repr=False)
class FrameBoxes:
    """Boxes in frames, true or predicted, as columns that are checked on construction.

    Attributes
    ----------
    frames
        Key of each row's frame: all int (counted from 0) or all str (the image's file name).
    tracks
        ``(N,)`` int, the vehicle's number within the clip, -1 for none; None where no box has one.
    boxes
        ``(N, 4)`` float64 ``[x1, y1, x2, y2]``, half-open pixels.
    occluded
        ``(N,)`` int, 0 visible (the default), 1 partly, 2 largely hidden.
    truncated
        ``(N,)`` float64, share outside the image, 0-1; default 0.
    ignore
        ``(N,)`` bool, rows that are not scored; with track -1 the row is a region. Default False.
    scores
        ``(N,)`` float64 score of a prediction, or None.
    distance_m, speed_mps
        ``(N,)`` float64, NaN where unknown, or None.
    frame_keys
        All frames in order, those without a box too; those of the rows are added by themselves.

    Raises
    ------
    InvalidInputError
        If columns differ in length, hold values they must not, or a track comes twice in a frame.

    Examples
    --------
    >>> labels = Labels([0, 0, 2], [1, 2, 1], [[0, 0, 50, 40], [90, 0, 140, 40], [5, 0, 55, 40]])
    >>> labels, labels.frame_keys, labels.frame(2).boxes
    (Labels(3 boxes in 2 frames), (0, 2), array([[ 5.,  0., 55., 40.]]))
    """

    frames: Sequence[FrameKey]
    tracks: NDArray[np.int64]
    boxes: NDArray[np.float64]
    _: KW_ONLY
    occluded: NDArray[np.int64] = None  # type: ignore[assignment]
    truncated: NDArray[np.float64] = None  # type: ignore[assignment]
    ignore: NDArray[np.bool_] = None  # type: ignore[assignment]
    scores: NDArray[np.float64] | None = None
    distance_m: NDArray[np.float64] | None = None
    speed_mps: NDArray[np.float64] | None = None
    frame_keys: Sequence[FrameKey] = ()
    _rows: dict[FrameKey, NDArray[np.intp]] = field(init=False)

    def __post_init__(self) -> None:
        frames = check_keys(self.frames, "frames")
        boxes = check_boxes(self.boxes).astype(np.float64)
        count = len(boxes)
        if len(frames) != count:
            raise InvalidInputError(
                f"frames must be one key for each of the {count} boxes, got {len(frames)} keys"
            )
        columns: dict[str, Any] = {
            "frames": frames,
            "boxes": boxes,
            "tracks": _column(self.tracks, "tracks", count, "iu", np.int64(NO_TRACK)),
            "occluded": _column(self.occluded, "occluded", count, "iub", np.int64(0)),
            "truncated": _column(self.truncated, "truncated", count, "iufb", 0.0),
            "ignore": _column(self.ignore, "ignore", count, "b", False),
        }
        for name in ("scores", "distance_m", "speed_mps"):
            values = getattr(self, name)
            columns[name] = None if values is None else _column(values, name, count, "iuf", 0.0)
        if columns["scores"] is not None and not np.isfinite(columns["scores"]).all():
            raise InvalidInputError("scores must be finite, got NaN or infinity; drop those rows")
        if (columns["tracks"] < NO_TRACK).any():
            lowest = columns["tracks"].min()
            raise InvalidInputError(f"tracks must be numbers from 0, or -1 for none; got {lowest}")
        if not (columns["occluded"] >= 0).all():
            raise InvalidInputError(
                "occluded must be 0 (visible), 1 (partly) or 2 (largely); got less than 0"
            )
        if not ((columns["truncated"] >= 0) & (columns["truncated"] <= 1)).all():
            raise InvalidInputError("truncated must be a share from 0 to 1; got a value outside")
        seen: set[tuple[FrameKey, int]] = set()
        for key, track in zip(frames, columns["tracks"].tolist()):
            if track != NO_TRACK and (key, track) in seen:
                raise InvalidInputError(
                    f"frame {key!r} holds track {track} twice; give each vehicle its number"
                )
            seen.add((key, track))
        keys = check_keys((*check_keys(self.frame_keys, "frame_keys"), *frames), "frame_keys")
        columns["frame_keys"] = tuple(sorted(set(keys), key=frame_order))
        rows: dict[FrameKey, list[int]] = {}
        for row, key in enumerate(frames):
            rows.setdefault(key, []).append(row)
        columns["_rows"] = {key: np.array(found, np.intp) for key, found in rows.items()}
        for name, column in columns.items():
            object.__setattr__(self, name, column)

    @classmethod
    def from_detections(cls, found: Mapping[FrameKey, Detections]) -> FrameBoxes:
        """Predictions out of the detections of each frame; frames without any still count as frames.

        Examples
        --------
        >>> Labels.from_detections({0: Detections([[0, 0, 50, 40]], [1.5]), 1: Detections.empty()})
        Labels(1 box in 2 frames)
        """
        parts = [np.empty((0, 4)), *(detections.boxes for detections in found.values())]
        return cls(
            [key for key, detections in found.items() for _ in range(len(detections))],
            None,  # type: ignore[arg-type]
            np.concatenate(parts),
            scores=np.concatenate([np.empty(0), *(detections.scores for detections in found.values())]),
            frame_keys=tuple(found),
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __repr__(self) -> str:
        boxes, frames = len(self), len(self.frame_keys)
        return f"Labels({boxes} box{'es' * (boxes != 1)} in {frames} frame{'s' * (frames != 1)})"

    def __getitem__(self, rows: slice | NDArray[Any] | list[int]) -> FrameBoxes:
        """Take rows by a slice, a mask or a list of indices; all frames stay frames."""
        return self._take(np.arange(len(self))[rows], self.frame_keys)

    def rows(self, key: FrameKey) -> NDArray[np.intp]:
        """Row numbers of a frame's boxes; none for a frame without boxes."""
        return self._rows.get(key, np.empty(0, np.intp))

    def frame(self, key: FrameKey) -> FrameBoxes:
        """Take the boxes of one frame; none for a frame without boxes."""
        return self._take(self.rows(key), (key,))

    def renamed(self, rename: Callable[[Any], FrameKey]) -> FrameBoxes:
        """Give every frame another key.

        Examples
        --------
        >>> Labels(["000007"], None, [[0, 0, 50, 40]]).renamed(lambda key: key + ".png").frame_keys
        ('000007.png',)
        """
        frames, keys = ([rename(key) for key in each] for each in (self.frames, self.frame_keys))
        return dataclasses.replace(self, frames=frames, frame_keys=keys)

    def _take(self, rows: NDArray[np.intp], keys: Sequence[FrameKey]) -> FrameBoxes:
        frames = [self.frames[row] for row in rows.tolist()]
        columns = {name: getattr(self, name) for name in _ARRAYS}
        taken = {name: column[rows] for name, column in columns.items() if column is not None}
        return dataclasses.replace(self, frames=frames, frame_keys=keys, **taken)


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


def check_labels_of(keys: Sequence[FrameKey], labels: object, name: str = "labels") -> FrameBoxes:
    """Return `labels` if they know at least one of the frames."""
    if not isinstance(labels, FrameBoxes):
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
    labels: FrameBoxes
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
        labels: FrameBoxes,
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
            Distance between the chosen frames; neighbors show the same.
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
