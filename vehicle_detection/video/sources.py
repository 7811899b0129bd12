"""Sources of frames: video files, consecutive segments, images, cameras and network streams."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    check_flags,
    check_number,
    check_path,
    describe,
    local_path,
    temporary_folder,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image
from vehicle_detection.video.ffmpeg import NETWORK_TIMEOUT, input_options, source_name
from vehicle_detection.video.files import IMAGE_SUFFIXES, check_file, is_video_file, list_files
from vehicle_detection.video.live import LiveStream
from vehicle_detection.video.probe import VideoInfo, probe
from vehicle_detection.video.reading import (
    AudioSource,
    FrameReader,
    Reader,
    check_span,
    frame_range,
    stream_duration,
)
from vehicle_detection.video.remote import download

_LOGGER = logging.getLogger(__name__)

_URL = re.compile(r"^([a-zA-Z][a-zA-Z0-9+.-]+)://")
_STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "srt", "tcp")
_RTSP_OPTIONS = ("-rtsp_transport", "tcp", "-timeout", f"{NETWORK_TIMEOUT * 1e6:.0f}")


class FrameSource(Closing):
    """Frames of a file, of several files or of a stream, as `open_source` returns it.

    A context manager, and an iterable of ``(index, time, frame)``: the frame's number from 0, its time in
    seconds, and an upright ``(H, W, 3)`` uint8 RGB array.

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

    def __iter__(self) -> Iterator[tuple[int, float, NDArray[np.uint8]]]:
        with self.read() as reader:
            yield from reader

    def close(self) -> None:
        """End its processes and remove its temporary files."""
        self._on_close.close()


class _VideoFile(FrameSource):
    """A video file, or the URL of one."""

    def __init__(self, path: Path | str, info: VideoInfo) -> None:
        super().__init__(source_name(path), info, () if isinstance(path, str) else (path,))
        self._path = path

    def read(self, first: int = 0, count: int | None = None) -> FrameReader:
        return FrameReader(self._path, self.info, first=first, count=count, strict=self.strict)

    def _audio(self, first: int, length: float | None) -> AudioSource:
        return AudioSource(
            input=input_options(self._path),
            start=self.info.start_time + float(first / self.info.fps),
            audio_offset=self.info.audio_offset,
            length=length,
            copyable=not first and length is None,
        )


class _ImageSequence(FrameSource):
    """Image files as the frames of a video."""

    def __init__(self, paths: Sequence[Path], fps: float) -> None:
        height, width = read_image(paths[0]).shape[:2]
        exact = Fraction(fps)
        rate = exact.limit_denominator(1001) if fps > 1 else 1 / Fraction(1 / fps).limit_denominator(1001)
        duration = float(len(paths) / rate)
        info = VideoInfo(width=width, height=height, fps=rate, frames=len(paths), duration=duration)
        super().__init__(f"{paths[0]} to {paths[-1].name}", info, paths)

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        return _ImageReader(self.info, self.files, first, count)


class _ImageReader(Reader):
    def __init__(self, info: VideoInfo, paths: Sequence[Path], first: int, count: int | None) -> None:
        self.info = info
        self._first = paths[0]
        chosen = list(enumerate(paths))[first : None if count is None else first + count]
        self._files: Iterator[tuple[int, Path]] = iter(chosen)

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        index, path = next(self._files)
        frame = read_image(path)
        if frame.shape != self.info.shape:
            raise InvalidInputError(
                f"source must hold images of one size; {path} is {frame.shape[1]}x{frame.shape[0]} and "
                f"{self._first} {self.info.width}x{self.info.height}; select the images of one camera"
            )
        return index, float(index / self.info.fps), frame

    def kill(self) -> None:
        self._files = iter(())


class _VideoSegments(FrameSource):
    """Consecutive video files as one video, with the frame size and rate of the first one."""

    def __init__(self, paths: Sequence[Path]) -> None:
        infos = [probe(path) for path in paths]
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

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        return _SegmentReader(self, first, count)

    def audio(self, first: int = 0, end: float | None = None) -> AudioSource | None:
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
        listing.write_bytes(
            text.encode("utf-8", "surrogateescape")
        )  # a path that is not UTF-8 keeps its bytes
        # Times as in the list: the first sound may lie before 0, which ffmpeg would take for the start.
        options = ("-seek_timestamp", "1", "-f", "concat", "-safe", "0", "-i", f"file:{listing}")
        return AudioSource(input=options, start=float(first / self.info.fps), length=length)


class _SegmentReader(Reader):
    """Reader of the frames of several files, one after the other."""

    def __init__(self, source: _VideoSegments, first: int, count: int | None) -> None:
        self.info, self._strict = source.info, source.strict
        self._segments = list(zip(source.files, source.infos, strict=True))
        self._index, self._end = first, math.inf if count is None else first + count
        self._lock = threading.Lock()
        self._killed = False
        self._reader: FrameReader | None = None
        # Lengths of skipped segments are known from their headers only, if at all.
        while len(self._segments) > 1 and first >= (self._segments[0][1].frames or math.inf):
            first -= self._segments.pop(0)[1].frames
        self._first = first

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        while self._index < self._end:
            reader = self._reader or self._open_next()
            for _, _, frame in reader:
                index = self._index
                self._index += 1
                return index, float(index / self.info.fps), frame
            self._close_reader()
        raise StopIteration

    def _open_next(self) -> FrameReader:
        with self._lock:
            if self._killed or not self._segments:
                raise StopIteration
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


class _Stream(FrameSource):
    """A stream that can be read once: standard input, a camera or a network stream."""

    rereadable = False

    def __init__(self, stream: LiveStream, *, live: bool) -> None:
        super().__init__(stream.name, stream.info)
        self._stream, self.live, self._read = stream, live, False
        self._on_close.callback(stream.close)

    def read(self, first: int = 0, count: int | None = None) -> Reader:
        if self._read:
            raise InvalidInputError(f"source {self.name} can be read only once; open it again")
        self._read = True
        return self._stream.start(drop=self.live, first=first, count=count)


Source = str | os.PathLike[str] | int | Sequence[str | os.PathLike[str]] | FrameSource
"""What `open_source` takes."""


def open_source(
    source: Source,
    *,
    fps: float = 25.0,
    live: bool | None = None,
    reconnect: bool = True,
    strict: bool = False,
) -> FrameSource:
    """Open any source of frames.

    Parameters
    ----------
    source
        - a video file, or a named pipe; ``"-"``: a video on standard input;
        - a list of files: consecutive videos, which become one, or images; `open_trip` finds the files of a
          trip in a folder;
        - a folder or a glob pattern with images, in the order of their names, or with one video;
        - a camera: its number (``0`` or ``"0"``) or device (``"/dev/video0"``);
        - a network stream: ``rtsp://``, ``rtmp://``, ``udp://``, ``srt://``, or ``http(s)://``, which may
          also be a file;
        - a file on storage that fsspec knows, such as ``"s3://bucket/drive.mp4"``, which is copied to a
          temporary file (extra ``[batch]``).
    fps
        Frame rate of images.
    live
        Whether to drop frames that are not read in time, so that the newest frame is read next. None: for
        cameras and network streams of unknown length. Otherwise, the sender has to wait.
    reconnect
        Whether to open a network stream of unknown length again when it ends or sends nothing for 10 seconds:
        six attempts within about half a minute, which start over after 10 seconds of frames.
    strict
        Raise an error after the last frame if a file is damaged: frames are missing, or ffmpeg reports
        decoding errors. Otherwise a warning is logged, and ``damage`` of the reader or of the report says it.
        Streams are not checked.

    Returns
    -------
    FrameSource
        A context manager and an iterable of ``(index, time, frame)``. Dropped frames leave gaps in the
        indices, and times stay right.

    Examples
    --------
    >>> with open_source("test_images/*.jpg", fps=10) as source:
    ...     for index, time, frame in source:
    ...         if time >= 0.2:
    ...             break
    >>> index, frame.shape, source.info.frames
    (2, (720, 1280, 3), 6)
    """
    if isinstance(source, FrameSource):
        return source
    check_flags(reconnect=reconnect, strict=strict)
    opened = _open(source, check_number(fps, "fps", above=0, high=1000), live, reconnect)
    opened.strict = strict
    return opened


def _open(source: object, fps: float, live: bool | None, reconnect: bool) -> FrameSource:
    """Open a source that is not yet open."""
    if isinstance(source, int) and not isinstance(source, bool):
        source = str(source)
    if isinstance(source, (list, tuple)):
        return _open_files([check_file(path) for path in source], fps)
    if not isinstance(source, (str, os.PathLike)):
        raise InvalidInputError(
            f"source must be the path of a video file, a folder, a pattern, a list of files, a URL, '-' or a "
            f"camera's number, got {describe(source)}; pass a file name, or call detector.process(frame, "
            "time) with frames of your own"
        )
    text = os.fsdecode(source)
    if text == "-":
        return _open_stdin(bool(live))
    if scheme := _URL.match(text):
        return _open_url(text, scheme[1].lower(), fps, live, reconnect)
    path = check_path(text, "source", kind="the path of a video file")
    if (text.isdecimal() and not path.exists()) or text.startswith("/dev/video"):
        return _open_camera(text, live is not False)
    if path.is_fifo():
        return _Stream(LiveStream(text, input_options(path)), live=bool(live))
    files = list_files(path) or [check_file(path)]
    if len(files) > 1 and is_video_file(files[0]):
        raise InvalidInputError(
            f"source {path} holds {len(files)} videos; open the segments of one trip with open_trip, or pass "
            "a list of consecutive files"
        )
    return _open_files(files, fps)


@contextlib.contextmanager
def borrow_source(source: Source) -> Iterator[FrameSource]:
    """Open a source for a block; one that the caller has opened stays open."""
    if isinstance(source, FrameSource):
        yield source
        return
    with open_source(source) as opened:
        yield opened


def _open_files(files: Sequence[Path], fps: float) -> FrameSource:
    """Open one file, the segments of a trip or images."""
    if not files:
        raise InvalidInputError("source must name at least one file, got an empty list; add a file")
    images = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    if len(images) == len(files):
        return _ImageSequence(files, fps)
    if images:
        raise InvalidInputError(
            f"source must be videos or images, got both ({files[0]}, {images[0]}); select one kind"
        )
    if len(files) == 1:
        return _VideoFile(files[0], probe(files[0]))
    broken = next((path for path in files if "\n" in str(path) or "\r" in str(path)), None)
    if broken is not None:  # the list of files for ffmpeg has a line for each
        raise InvalidInputError(f"source {str(broken)!r} has a line break in its name; rename the file")
    return _VideoSegments(files)


def _open_stdin(live: bool) -> FrameSource:
    try:
        descriptor = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        descriptor = -1
    if descriptor < 0 or os.isatty(descriptor):
        raise InvalidInputError(
            "source - reads a video from standard input, which is not a pipe; use: cat drive.mp4 | ..."
        )
    return _Stream(LiveStream("-", ("-i", "pipe:0"), stdin=descriptor), live=live)


def _open_camera(name: str, live: bool) -> FrameSource:
    if sys.platform == "darwin":
        options = ("-f", "avfoundation", "-framerate", "30", "-i", name)
        return _Stream(LiveStream(name, options), live=live)
    if sys.platform == "win32":
        raise InvalidInputError(
            f"source {name}: cameras are not supported on Windows; pipe the output of ffmpeg -f dshow to '-'"
        )
    device = f"/dev/video{name}" if name.isdecimal() else name
    if not Path(device).exists():
        raise InvalidInputError(f"source {name}: there is no camera {device}; see ls /dev/video*")
    return _Stream(LiveStream(name, ("-f", "v4l2", "-i", device)), live=live)


def _open_url(url: str, scheme: str, fps: float, live: bool | None, reconnect: bool) -> FrameSource:
    if scheme == "file":
        return _open(local_path(url), fps, live, reconnect)
    if scheme in ("http", "https"):
        info = None if live else probe(url)
        if info is not None and info.duration:
            return _VideoFile(url, info)
    elif scheme not in _STREAM_SCHEMES:
        return _download(url)
    options = (*(_RTSP_OPTIONS if scheme.startswith("rtsp") else ()), "-i", url)
    stream = LiveStream(source_name(url), options, network=True, reconnect=reconnect)
    return _Stream(stream, live=live is not False)


def _download(url: str) -> FrameSource:
    """Copy a file of other storage to a temporary one, because a video is read at several places."""
    with contextlib.ExitStack() as on_error:
        folder = on_error.enter_context(temporary_folder(Path(tempfile.gettempdir()), "vehicle-source"))
        path = download(url, folder)
        source = _VideoFile(path, probe(path))
        source.name = source_name(url)
        source._on_close = on_error.pop_all()
    return source


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Read the properties of a video file: frame size, exact frame rate, length, sound and rotation.

    >>> probe_video("missing.mp4")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    return probe(check_file(path))


def read_frames(
    source: str | os.PathLike[str],
    *,
    start: float | None = None,
    end: float | None = None,
    strict: bool = False,
) -> FrameReader:
    """Read the frames of a video file, one at a time; for other sources see `open_source`.

    Parameters
    ----------
    source
        A file that ffmpeg can read.
    start, end
        Time range in seconds: frames with ``start <= time < end`` are read. None: no limit.
    strict
        Raise an error after the last frame if the file is damaged, as in `open_source`.

    Returns
    -------
    FrameReader
        An iterator of ``(index, time, frame)``: the frame's number in the file from 0, its time in seconds,
        and an upright ``(H, W, 3)`` uint8 RGB array. Its ``info`` is the file's `VideoInfo`. ffmpeg ends
        after the last frame, and at the end of a ``with`` block.

    Examples
    --------
    >>> with read_frames("drive.mp4", end=2.0) as frames:  # doctest: +SKIP
    ...     means = [frame.mean() for index, time, frame in frames]
    """
    path = check_file(source)
    info = probe(path)
    first, count = frame_range(info, *check_span(start, end))
    return FrameReader(path, info, first=first, count=count, strict=strict)
