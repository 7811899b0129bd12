"""Sources of frames: video files, consecutive segments, images, cameras and network streams."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Closing, temporary_folder
from vehicle_detection.errors import InvalidInputError, TransientVideoError, VideoError
from vehicle_detection.images import IMAGE_SUFFIXES, read_image
from vehicle_detection.tracking import USUAL_FPS
from vehicle_detection.video.ffmpeg import input_options, restrict_input, source_name
from vehicle_detection.video.live import LiveStream
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.reading import AudioSource, FrameReader, Reader, stream_duration
from vehicle_detection.video.yuv import DecodedFrame

_LOGGER = logging.getLogger(__name__)

NO_RATE = "%s states no frame rate: 25 is assumed, on which times and speeds depend; set it with fps or --fps"
"""Warning of the assumed frame rate."""


class FrameSource(Closing):
    """Frames of a file, of several files or of a stream, as `open_source` returns it.

    A context manager, and an iterable of ``(index, time, frame)``: the frame's number from 0, its time in
    seconds, and an upright ``(H, W, 3)`` uint8 RGB array.

    >>> from vehicle_detection import open_source
    >>> with open_source("test_images/*.jpg", fps=10) as source:
    ...     print(source.info.frames, source.live, source.rereadable)
    6 False True
    """

    live = False  # whether frames that are not read in time are dropped
    rereadable = True  # whether it can be read more than once
    strict = False  # whether a damaged file is an error after its last frame, instead of a warning

    def __init__(self, name: str, info: VideoInfo, files: Sequence[Path] = ()) -> None:
        self.name, self.info = name, info
        self.files = tuple(files)  # that are read, in order; empty for streams
        self.segment_starts: tuple[float, ...] = (0.0,)  # of the files of a trip, in seconds of the video
        self.breaks: set[int] = set()  # frames that begin another scene, as after a gap between files
        self._states = {path: _state(path) for path in files if path.suffix.lower() not in IMAGE_SUFFIXES}
        self._on_close = contextlib.ExitStack()

    def __repr__(self) -> str:
        info = self.info
        length = f", {info.duration:g} s" if info.duration else ""
        return f"FrameSource({self.name}, {info.width}x{info.height} at {float(info.fps):g} Hz{length})"

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        """Open a reader of the frames from number `first` on, `count` or all of them."""
        raise NotImplementedError

    def audio(self, first: int = 0, end: float | None = None) -> AudioSource | None:
        """Return the sound from a frame on, up to an end in seconds; None if there is none."""
        length = None if end is None else float(Fraction(float(end)) - first / self.info.fps)
        return self._audio(first, length) if self.info.has_audio else None

    def _audio(self, first: int, length: float | None) -> AudioSource | None:
        return None

    def find_change(self) -> str:
        """Say which video file was replaced or truncated since the source was opened; empty if none."""
        for path, (inode, size) in self._states.items():
            now = _state(path)
            if now[0] != inode or now[1] < size:
                return f"{path} was replaced or truncated while it was read; process it again"
        return ""

    def __iter__(self) -> Iterator[tuple[int, float, NDArray[np.uint8]]]:
        with self.read() as reader:
            yield from reader

    def close(self) -> None:
        """End its processes and remove its temporary files."""
        self._on_close.close()


def _state(path: Path) -> tuple[int, int]:
    """Identity and size of a file; that of a recording may grow."""
    try:
        status = path.stat()
    except OSError:
        return -1, -1
    return status.st_ino, status.st_size


class VideoFile(FrameSource):
    """A video file, or the URL of one."""

    def __init__(self, path: Path | str, info: VideoInfo) -> None:
        super().__init__(source_name(path), info, () if isinstance(path, str) else (path,))
        self._path = path

    def read(self, first: int = 0, count: int | None = None) -> FrameReader:
        """Open a reader of the file."""
        return FrameReader(self._path, self.info, first=first, count=count, strict=self.strict)

    def _audio(self, first: int, length: float | None) -> AudioSource:
        return AudioSource(
            input=input_options(self._path),
            start=self.info.start_time + float(first / self.info.fps),
            audio_offset=self.info.audio_offset,
            length=length,
            copyable=not first and length is None,
        )


def exact_rate(fps: float) -> Fraction:
    """Return a frame rate as the fraction that it is meant to be, such as 30000/1001."""
    return Fraction(fps).limit_denominator(1001) if fps > 1 else 1 / Fraction(1 / fps).limit_denominator(1001)


class ImageSequence(FrameSource):
    """Image files as the frames of a video."""

    def __init__(self, paths: Sequence[Path], fps: float | None) -> None:
        height, width = read_image(paths[0]).shape[:2]
        if fps is None and len(paths) > 1:
            _LOGGER.warning(NO_RATE, paths[0].parent)
        fps = USUAL_FPS if fps is None else fps
        rate = exact_rate(fps)
        duration = float(len(paths) / rate)
        info = VideoInfo(width=width, height=height, fps=rate, frames=len(paths), duration=duration)
        super().__init__(f"{paths[0]} to {paths[-1].name}", info, paths)

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        """Open a reader of the images."""
        return _ImageReader(self.info, self.files, first, count)


class _ImageReader(Reader):
    def __init__(self, info: VideoInfo, paths: Sequence[Path], first: int, count: int | None) -> None:
        self.info = info
        self._first = paths[0]
        chosen = list(enumerate(paths))[first : None if count is None else first + count]
        self._files: Iterator[tuple[int, Path]] = iter(chosen)

    def read_next(self) -> tuple[int, float, DecodedFrame] | None:
        found = next(self._files, None)
        if found is None:
            return None
        index, path = found
        frame = read_image(path)
        if frame.shape != self.info.shape:
            raise InvalidInputError(
                f"source must hold images of one size; {path} is {frame.shape[1]}x{frame.shape[0]} and "
                f"{self._first} {self.info.width}x{self.info.height}; select the images of one camera"
            )
        return index, float(index / self.info.fps), DecodedFrame(frame)

    def kill(self) -> None:
        self._files = iter(())


class VideoSegments(FrameSource):
    """Consecutive video files as one video, with the frame size and rate of the first one.

    A last one that cannot be read, as after a loss of power, is left out unless `strict`.
    """

    def __init__(
        self, paths: Sequence[Path], probe: Callable[[Path], VideoInfo], *, strict: bool = False
    ) -> None:
        infos = [probe(path) for path in paths[:-1]]
        self.lost = ""
        try:
            infos.append(probe(paths[-1]))
        except VideoError as error:
            if strict or isinstance(error, TransientVideoError):
                raise
            self.lost, paths = f"the last segment is left out: {error}", paths[:-1]
        first = infos[0]
        # Sound may be longer than the frames, which would add up.
        lengths = [
            (stream_duration(path, info) if info.has_audio else None) or float(info.frames / info.fps)
            for path, info in zip(paths, infos, strict=True)
        ]
        self.infos = [
            replace(
                info,
                width=first.width,
                height=first.height,
                fps=first.fps,
                frames=round(length * first.fps),
                constant_rate=info.constant_rate and info.fps == first.fps,
            )
            for info, length in zip(infos, lengths, strict=True)
        ]
        sound = all(info.has_audio and info.audio_format == first.audio_format for info in infos)
        self._sound_differs = first.has_audio and not sound
        total = sum(info.frames for info in self.infos)
        whole = replace(first, frames=total, duration=sum(lengths), start_time=0.0)
        if not sound:
            whole = replace(whole, audio_track=None, audio_codec=None)
        super().__init__(f"{paths[0]} to {paths[-1].name}", whole, paths)
        self.segment_starts = tuple(itertools.accumulate(lengths[:-1], initial=0.0))

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        """Open a reader of the segments."""
        return _SegmentReader(self, first, count)

    def audio(self, first: int = 0, end: float | None = None) -> AudioSource | None:
        """Return the joined sound; None if not all segments have the same kind."""
        if self._sound_differs:
            _LOGGER.warning(
                "the segments after %s have sound of another format, or none; the video has none",
                self.files[0],
            )
        return super().audio(first, end)

    def _audio(self, first: int, length: float | None) -> AudioSource:
        """Join the sound of the segments."""
        parent = Path(tempfile.gettempdir())
        folder = self._on_close.enter_context(temporary_folder(parent, "vehicle-segments"))
        listing = folder / "segments.txt"
        text = ""
        for path, info in zip(self.files, self.infos, strict=True):
            quoted = str(path.resolve()).replace("'", r"'\''")
            begin, seconds = info.first_timestamp, float(info.frames / info.fps)
            text += f"file '{quoted}'\ninpoint {begin:.6f}\n"
            text += f"outpoint {begin + seconds:.6f}\nduration {seconds:.6f}\n"
        # A path that is not UTF-8 keeps its bytes.
        listing.write_bytes(text.encode("utf-8", "surrogateescape"))
        # Times as in the list: the first sound may lie before 0, which ffmpeg would take for the start.
        options: tuple[str, ...] = ("-seek_timestamp", "1", "-f", "concat", "-safe", "0")
        options += (*restrict_input("file", ",concat"), "-i", f"file:{listing}")
        return AudioSource(input=options, start=float(first / self.info.fps), length=length)


class _SegmentReader(Reader):
    """Reader of the frames of several files, one after the other."""

    def __init__(self, source: VideoSegments, first: int, count: int | None) -> None:
        self.info, self._strict = source.info, source.strict
        self._segments = list(zip(source.files, source.infos, strict=True))
        self._index, self._end = first, math.inf if count is None else first + count
        self._lock = threading.Lock()
        self._killed = False
        self._reader: FrameReader | None = None
        # Lengths of skipped segments are known from their headers only, if at all.
        while len(self._segments) > 1 and first >= (self._segments[0][1].frames or math.inf):
            first -= self._segments.pop(0)[1].frames
        self._first, self._lost = first, source.lost

    def read_next(self) -> tuple[int, float, DecodedFrame] | None:
        while self._index < self._end and (reader := self._reader or self._open_next()):
            found = reader.read_next()
            if found is not None:
                index = self._index
                self._index += 1
                return index, float(index / self.info.fps), found[2]
            self._close_reader()
        return None

    def _open_next(self) -> FrameReader | None:
        with self._lock:
            if self._lost and not self._killed and not self._segments:
                _LOGGER.warning("%s", self._lost)
                self.damage, self._lost = "; ".join(filter(None, (self.damage, self._lost))), ""
            if self._killed or not self._segments:
                return None
            path, info = self._segments.pop(0)
            # After a segment that is cut off, times and sound of the next one would be wrong.
            whole = bool(self._segments)
            self._reader = FrameReader(path, info, first=self._first, strict=self._strict, whole=whole)
            self._first = 0
            return self._reader

    def _close_reader(self) -> None:
        with self._lock:
            if self._reader is not None:
                self._reader.close()
                self.cpu_seconds += self._reader.cpu_seconds
                self.damage = "; ".join(filter(None, (self.damage, self._reader.damage)))
                self._reader = None

    def kill(self) -> None:
        with self._lock:
            self._killed = True
            if self._reader is not None:
                self._reader.kill()

    def close(self) -> None:
        self.kill()
        self._close_reader()


class Stream(FrameSource):
    """A stream that can be read once: standard input, a camera or a network stream."""

    rereadable = False

    def __init__(self, stream: LiveStream, *, live: bool) -> None:
        super().__init__(stream.name, stream.info)
        self._stream, self.live, self._read = stream, live, False
        self._on_close.callback(stream.close)

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        """Start to read; once only."""
        if self._read:
            raise InvalidInputError(f"source {self.name} can be read only once; open it again")
        self._read = True
        return self._stream.start(drop=self.live, first=first, count=count)
