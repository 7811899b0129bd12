"""The interface of all sources of frames."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.streams import AudioSource, Reader


class FrameSource:
    """Frames of a file, of several files or of a stream, as `open_source` returns it.

    A context manager, and an iterable of ``(index, time, frame)``: the frame's number from 0, its time in
    seconds, and an upright ``(H, W, 3)`` uint8 RGB array.

    Attributes
    ----------
    name
        What was opened, for messages.
    info
        Properties of the video; ``frames`` and ``duration`` are 0 where the length is unknown.
    live, rereadable
        Whether frames that are not read in time are dropped; whether it can be read more than once.
    files
        Files that are read, in order; empty for streams.

    Examples
    --------
    >>> from vehicle_detection import open_source
    >>> with open_source("test_images/*.jpg", fps=10) as source:
    ...     print(source.info.frames, source.live, source.rereadable)
    6 False True
    """

    live = False
    rereadable = True

    def __init__(self, name: str, info: VideoInfo, files: Sequence[Path] = ()) -> None:
        self.name, self.info, self.files = name, info, tuple(files)
        self._on_close = contextlib.ExitStack()

    def __repr__(self) -> str:
        info = self.info
        length = f", {info.duration:g} s" if info.duration else ""
        return f"FrameSource({self.name}, {info.width}x{info.height} at {float(info.fps):g} Hz{length})"

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        """Open a reader of `count` frames from number `first` on; None: to the end.

        With `strict`, the reader raises an error after the last frame of a damaged file.
        """
        raise NotImplementedError

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        """Sound from frame `first` on, `length` seconds long; None if there is none."""
        return None

    def __iter__(self) -> Iterator[tuple[int, float, NDArray[np.uint8]]]:
        with self.read() as reader:
            yield from reader

    def close(self) -> None:
        """End its processes and remove its temporary files."""
        self._on_close.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
