"""Frames in a folder, read one at a time."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, natural_key
from vehicle_detection.datasets.archives import is_image
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import read_image


@dataclass(frozen=True)
class FrameSet:
    """Image files of a folder, each read on access; iterating yields ``(name, image)``.

    >>> frames = load_frames("test_images")
    >>> len(frames), frames.names[0], frames[0].shape
    (6, 'road1.jpg', (720, 1280, 3))
    """

    folder: Path
    names: tuple[str, ...]  # in natural order

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"FrameSet({len(self)} frames in {self.folder})"

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Read one frame: ``(H, W, 3)`` uint8 RGB."""
        try:
            return read_image(self.folder / self.names[operator.index(index)])
        except InvalidInputError as error:
            raise DatasetError(f"{error}; replace or remove it") from error

    def __iter__(self) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        return ((name, self[index]) for index, name in enumerate(self.names))


def load_frames(folder: str | os.PathLike[str]) -> FrameSet:
    """List the frames (PNG, JPEG) in a folder, without its subfolders; `read_labels` reads their boxes.

    ``frames.names[i]`` is the file name that labels refer to; ``frames[i]`` reads the image.

    >>> load_frames("missing")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: folder missing does not exist or is not a folder; check the path
    """
    path = check.path(folder, "folder", kind="the path of a folder")
    if not path.is_dir():
        raise DatasetError(f"folder {path} does not exist or is not a folder; check the path")
    names = [file.name for file in path.iterdir() if is_image(file.name) and file.is_file()]
    if not names:
        raise DatasetError(f"folder {path} holds no PNG or JPEG frames; pass the folder that contains them")
    return FrameSet(path, tuple(sorted(names, key=natural_key)))
