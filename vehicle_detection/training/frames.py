"""Labelled frames to train and validate on: data sets, the folder they are read from, and loaded frames."""

from __future__ import annotations

import glob
import logging
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid, is_hidden
from vehicle_detection.datasets import load_frames, read_labels
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, match_names
from vehicle_detection.tables import FrameKey, TrackTable
from vehicle_detection.video import is_video_file, probe_video, read_frames

_LABEL_SUFFIXES = (".csv", ".json", ".jsonl", ".parquet")

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FrameDataset:
    """Labelled frames of one camera or country: a name, and one or more sets.

    >>> from vehicle_detection.tables import TrackTable
    >>> labels = TrackTable([0], None, [[9, 9, 60, 50]])
    >>> road = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], labels)
    >>> FrameDataset("camera", [road]).sets
    (LabelledFrames('road', 1 frame, 1 box),)
    """

    name: str
    sets: tuple[LabelledFrames, ...]

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name:
            raise invalid("name", "be a non-empty string", name)
        sets: object = self.sets
        if not isinstance(sets, (tuple, list)) or not sets:
            raise invalid("sets", "be a tuple of at least one entry", sets)
        for part in sets:
            check.instance(part, "sets", LabelledFrames, "pass frames with labels as LabelledFrames")
        object.__setattr__(self, "sets", tuple(sets))


def check_sources(sources: object) -> tuple[FrameDataset, ...]:
    """Return one or more data sets with different names."""
    if not isinstance(sources, (tuple, list)) or not sources:
        raise invalid("sources", "be a list of FrameDataset, one or more", sources)
    for source in sources:
        check.instance(source, "sources", FrameDataset, "wrap the frames of each camera or country in one")
    names = [source.name for source in sources]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InvalidInputError(
            f"sources must have different names, got {min(twice)!r} twice; merge them into one"
        )
    return tuple(sources)


def select_frames(part: LabelledFrames, keys: Collection[FrameKey]) -> LabelledFrames:
    """Return some frames of a set, in its order; images of a folder are not read."""
    frames = part.frames
    if isinstance(frames, Mapping):
        chosen: Any = {key: image for key, image in frames.items() if key in keys}
    else:
        chosen = replace(frames, names=tuple(name for name in frames.names if name in keys))
    return replace(part, frames=chosen)


def find_sources(folder: str | os.PathLike[str], *, clip_rate: float = 3.0) -> list[FrameDataset]:
    """Read a folder of labelled frames, as one data set for each file ``labels/NAME.csv``.

    The labels may also be .json (a COCO data set), .jsonl or .parquet.
    Its frames are in ``frames/NAME/``, ``NAME/`` or a video ``videos/NAME.mp4`` (or another suffix), of which
    `clip_rate` frames per second are taken. If the labels name most frames of a folder or video, the others
    show no vehicle; if they name fewer, only these are taken.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DatasetError(f"folder {root} does not exist; pass the folder of the labelled frames")
    listed = (path for path in root.glob("labels/*") if not is_hidden(path.name))  # as macOS adds some
    files = sorted(path for path in listed if path.suffix.lower() in _LABEL_SUFFIXES)
    if not files:
        raise DatasetError(
            f"folder {root} has no labels/NAME.csv (or {', '.join(_LABEL_SUFFIXES[1:])}); pass the folder of "
            "the labelled frames; convert other labels with write_labels(read_labels(...), "
            "'labels/NAME.csv')"
        )
    by_name: dict[str, Path] = {}
    for file in files:
        other = by_name.setdefault(file.stem, file)
        if other != file:
            raise DatasetError(f"{other} and {file} label the same frames; leave one in the folder")
    sources = []
    for file in files:
        try:
            frames = _read_frames(root, file, clip_rate)
        except InvalidInputError as error:
            raise InvalidInputError(f"{file}: {error}") from error
        sources.append(FrameDataset(file.stem, (frames,)))
    return sources


def _read_frames(root: Path, file: Path, clip_rate: float) -> LabelledFrames:
    """Frames of one file of labels, from a folder of images or a video."""
    name, folders = file.stem, (root / "frames" / file.stem, root / file.stem)
    for folder in folders:
        if folder.is_dir():
            return read_labelled_folder(folder, file, name=name)
    videos = [path for path in (root / "videos").glob(f"{glob.escape(name)}.*") if is_video_file(path)]
    if videos:
        return _frames_of_video(min(videos), read_labels(file), clip_rate)
    video = root / "videos" / f"{name}.mp4"
    raise DatasetError(f"{file} has no frames: add {folders[0]}, {folders[1]} or {video}")


def read_labelled_folder(
    folder: Path, file: Path, *, name: str, horizon: float | None = None
) -> LabelledFrames:
    """Images of a folder with the labels of a file; a warning says if some of either are left out."""
    labels = read_labels(file, images=folder)
    found = LabelledFrames(name, load_frames(folder), labels, horizon)
    named, keys = set(match_names(labels, found.keys, ("labels", "frames")).frame_keys), set(found.keys)
    absent, n_unlabelled = sorted(named - keys, key=str), len(keys - named)
    if absent:
        # A label may be that of an image with another name, which would count as an empty frame.
        log.warning(
            "%s: %d of %d labelled frames have no image in %s, such as %r; they are left out, and so are %d "
            "images without labels",
            *(file, len(absent), len(named), folder, absent[0], n_unlabelled),
        )
    elif named and n_unlabelled > len(named):
        log.warning(
            "%s names %d of %d images in %s; the others are left out, as they seem to be unlabelled. If they "
            "show no vehicle, move them to a folder with a table without rows",
            *(file, len(named), len(keys), folder),
        )
    else:
        return found
    return select_frames(found, named)


def _frames_of_video(video: Path, labels: TrackTable, clip_rate: float) -> LabelledFrames:
    """Take some frames per second of a video: all of them if most are labelled, or else labelled ones.

    Where most frames are labelled, the others show no vehicle.
    """
    info = probe_video(video)
    every = max(1, round(float(info.fps) / clip_rate))
    numbers = [key for key in labels.frame_keys if isinstance(key, int)]
    if not numbers or len(numbers) > 0.5 * info.frames:
        return LabelledFrames.from_video(video, labels, every=every)
    chosen = numbers[:1]
    for number in numbers:
        if number >= chosen[-1] + every:
            chosen.append(number)
    wanted = set(chosen)
    with read_frames(video) as reader:
        frames: dict[FrameKey, NDArray[np.uint8]] = {
            index: frame for index, _, frame in reader if index in wanted
        }
    if not frames:
        raise InvalidInputError(f"labels name no frame of {video}, but {numbers[0]}; count frames from 0")
    return LabelledFrames(video.stem, frames, labels)


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """A loaded frame and its labels, in pixels of the loaded image."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB
    boxes: NDArray[np.float64]  # (N, 4) vehicles
    ignored: NDArray[np.float64]  # (M, 4) ignored boxes
    source: str  # name of the data set


def load_training_frames(
    sources: Sequence[FrameDataset], *, max_side: int | None = None
) -> list[TrainingFrame]:
    """Load all frames of some data sets into memory.

    A frame whose longer side exceeds `max_side` pixels is reduced to it, and its boxes with it.
    """
    if max_side is not None:
        max_side = check.integer(max_side, "max_side", low=16)
    loaded = []
    for source in check_sources(sources):
        for part in source.sets:
            for key, image in part:
                labels = part.labels.frame(key)
                _check_inside(labels.boxes[~labels["ignore"]], image.shape, f"{part.name}, frame {key!r}")
                reduced, scale = _reduce(image, max_side)
                boxes = labels.boxes * scale
                loaded.append(
                    TrainingFrame(reduced, boxes[~labels["ignore"]], boxes[labels["ignore"]], source.name)
                )
    return loaded


def _check_inside(boxes: NDArray[np.float64], shape: tuple[int, ...], where: str) -> None:
    """Raise unless every box shows a part of the image."""
    height, width = shape[:2]
    outside = (boxes[:, :2] >= (width, height)).any(axis=1) | (boxes[:, 2:] <= 0).any(axis=1)
    if outside.any():
        box = boxes[int(np.argmax(outside))].tolist()
        raise InvalidInputError(
            f"{where}: the box {box} lies outside the {width}x{height} image; check that the labels were "
            "drawn at this resolution"
        )


def _reduce(image: NDArray[np.uint8], max_side: int | None) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Reduce an image to `max_side`; return it and the factors of the corners of its boxes."""
    height, width = image.shape[:2]
    if max_side is None or max(height, width) <= max_side:
        return image, np.ones(4)
    factor = max_side / max(height, width)
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    reduced = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return reduced, np.tile((size[0] / width, size[1] / height), 2)
