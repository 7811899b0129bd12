"""The interface of all sources of frames."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Closing
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.streams import AudioSource, Reader


class FrameSource(Closing):
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
        """Open a reader of some or all frames.

        Parameters
        ----------
        first, count
            Number of the first frame, from 0, and how many frames to read; None: to the end.
        strict
            Raise a `VideoError` after the last frame of a damaged file. Otherwise a warning is logged.

        Returns
        -------
        Reader
            An iterator of ``(index, time, frame)`` and a context manager, like that of `read_frames`.

        Raises
        ------
        InvalidInputError
            If the source is not `rereadable` and has been read.
        """
        raise NotImplementedError

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        """Return the sound from a frame on; None if there is none.

        Parameters
        ----------
        first
            Number of the frame, from 0.
        length
            Length in seconds; None: to the end.

        Returns
        -------
        AudioSource or None
            Input of the writer of a video.
        """
        return None

    def __iter__(self) -> Iterator[tuple[int, float, NDArray[np.uint8]]]:
        with self.read() as reader:
            yield from reader

    def close(self) -> None:
        """End its processes and remove its temporary files."""
        self._on_close.close()
