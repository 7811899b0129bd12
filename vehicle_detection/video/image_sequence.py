"""Image files that are read as the frames of a video."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image
from vehicle_detection.video.frame_source import FrameSource
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.streams import Reader


class ImageSequence(FrameSource):
    """Image files as the frames of a video."""

    def __init__(self, paths: Sequence[Path], fps: float) -> None:
        height, width = read_image(paths[0]).shape[:2]
        rate = (
            Fraction(fps).limit_denominator(1001)
            if fps > 1
            else 1 / Fraction(1 / fps).limit_denominator(1001)
        )
        info = VideoInfo(
            width=width, height=height, fps=rate, frames=len(paths), duration=float(len(paths) / rate)
        )
        super().__init__(f"{paths[0]} to {paths[-1].name}", info, paths)

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        """Open a reader of `count` images from number `first` on."""
        return _ImageReader(self.info, self.files, first, count)


class _ImageReader(Reader):
    """Reader of image files."""

    def __init__(self, info: VideoInfo, paths: Sequence[Path], first: int, count: int | None) -> None:
        self.info = info
        self._paths = paths[: None if count is None else first + count]
        self._index, self._killed = first, False

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        if self._killed or self._index >= len(self._paths):
            raise StopIteration
        index, path = self._index, self._paths[self._index]
        frame = read_image(path)
        if frame.shape != self.info.shape:
            raise InvalidInputError(
                f"source must hold images of one size; {path} is {frame.shape[1]}x{frame.shape[0]} and "
                f"{self._paths[0]} {self.info.width}x{self.info.height}; select the images of one camera"
            )
        self._index += 1
        return index, float(index / self.info.fps), frame

    def kill(self) -> None:
        self._killed = True
