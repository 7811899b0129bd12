"""Sources of frames: video files, segments of a trip, images, standard input, cameras, network streams."""

from __future__ import annotations

import contextlib
import glob
import math
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, check_path, describe
from vehicle_detection.errors import InvalidInputError, VideoError
from vehicle_detection.images import read_image
from vehicle_detection.video.ffmpeg import VideoInfo, input_options, probe
from vehicle_detection.video.live import LiveProcess, LiveReader
from vehicle_detection.video.streams import AudioSource, FrameReader, Reader
from vehicle_detection.video.trips import find_trips, is_video_file

Result = TypeVar("Result")

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
"""Suffixes of the images that a folder is searched for."""

_URL = re.compile(r"^([a-zA-Z][a-zA-Z0-9+.-]+)://")
_STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "srt", "tcp")
# Seconds before the second and the third attempt of a request.
_RETRY_DELAYS = (0.2, 1.0)
# Seconds without data after which a network source has ended.
_NETWORK_TIMEOUT = 10
_HTTP_OPTIONS = ("-rw_timeout", str(_NETWORK_TIMEOUT * 1_000_000))


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
    """

    live = False
    rereadable = True

    def __init__(self, name: str, info: VideoInfo, files: Sequence[Path] = ()) -> None:
        self.name, self.info, self.files = name, info, tuple(files)
        self._on_close = contextlib.ExitStack()

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


class _VideoFile(FrameSource):
    """A video file, or the URL of one."""

    def __init__(self, path: Path | str, info: VideoInfo) -> None:
        super().__init__(str(path), info, () if isinstance(path, str) else (path,))
        self._path = path

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> FrameReader:
        return FrameReader(self._path, self.info, first=first, count=count, strict=strict)

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        if not self.info.has_audio:
            return None
        if not first and length is None:
            return AudioSource(input=input_options(self._path))
        start = float(first / self.info.fps) + self.info.start_time
        return AudioSource(input=input_options(self._path), start=start, length=length)


class _VideoSegments(FrameSource):
    """Consecutive video files as one video, with the frame size and rate of the first one."""

    def __init__(self, paths: Sequence[Path]) -> None:
        infos = [probe(path) for path in paths]
        first = infos[0]
        self._infos = [
            replace(
                info,
                width=first.width,
                height=first.height,
                fps=first.fps,
                constant_rate=info.constant_rate and info.fps == first.fps,
            )
            for info in infos
        ]
        duration = sum(info.duration for info in infos)
        sound = all(info.has_audio for info in infos)
        super().__init__(
            f"{paths[0]} to {paths[-1].name}",
            replace(
                first,
                frames=sum(round(info.duration * first.fps) for info in infos),
                duration=duration,
                audio_track=first.audio_track if sound else None,
                audio_codec=first.audio_codec if sound else None,
                start_time=0.0,
            ),
            paths,
        )

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        segments = list(zip(self.files, self._infos, strict=True))
        return _SegmentReader(self.info, segments, first, count, strict=strict)

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        if not self.info.has_audio:
            return None
        with tempfile.NamedTemporaryFile(
            "w", prefix="vehicle-segments-", suffix=".txt", encoding="utf-8", delete=False
        ) as file:
            self._on_close.callback(Path(file.name).unlink, missing_ok=True)
            for path, info in zip(self.files, self._infos, strict=True):
                quoted = str(path.resolve()).replace("'", r"'\''")
                # Sound may be longer than the frames, which would add up.
                seconds = float(info.frames / info.fps)
                file.write(f"file '{quoted}'\noutpoint {seconds:.6f}\nduration {seconds:.6f}\n")
        options = ("-f", "concat", "-safe", "0", "-i", f"file:{file.name}")
        if not first and length is None:
            return AudioSource(input=options)
        return AudioSource(input=options, start=float(first / self.info.fps), length=length)


class _SegmentReader:
    """Reader of the frames of several files, one after the other."""

    def __init__(
        self,
        info: VideoInfo,
        segments: Sequence[tuple[Path, VideoInfo]],
        first: int,
        count: int | None,
        *,
        strict: bool,
    ) -> None:
        self.info = info
        self.damage = ""
        self._strict = strict
        self.cpu_seconds = 0.0
        self._segments = list(segments)
        self._index = first
        self._end = math.inf if count is None else first + count
        self._lock = threading.Lock()
        self._killed = False
        self._reader: FrameReader | None = None
        # Lengths of skipped segments are known from their headers only.
        while len(self._segments) > 1 and first >= self._segments[0][1].frames:
            first -= self._segments.pop(0)[1].frames
        self._first = first

    def __iter__(self) -> Self:
        return self

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
            self._reader = FrameReader(path, info, first=self._first, strict=self._strict)
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class _ImageSequence(FrameSource):
    """Image files as the frames of a video."""

    def __init__(self, paths: Sequence[Path], fps: float) -> None:
        height, width = read_image(paths[0]).shape[:2]
        rate = Fraction(fps).limit_denominator(1001)
        info = VideoInfo(
            width=width, height=height, fps=rate, frames=len(paths), duration=float(len(paths) / rate)
        )
        super().__init__(f"{paths[0]} to {paths[-1].name}", info, paths)

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        return _ImageReader(self.info, self.files, first, count)


class _ImageReader:
    """Reader of image files."""

    cpu_seconds = 0.0
    damage = ""

    def __init__(self, info: VideoInfo, paths: Sequence[Path], first: int, count: int | None) -> None:
        self.info = info
        self._paths = paths[: None if count is None else first + count]
        self._index, self._killed = first, False

    def __iter__(self) -> Self:
        return self

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

    def close(self) -> None:
        self.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class _Stream(FrameSource):
    """A stream that can be read once: standard input, a camera or a network stream."""

    rereadable = False

    def __init__(self, name: str, options: Sequence[str], *, live: bool, stdin: int | None = None) -> None:
        self._process = LiveProcess(name, options, stdin=stdin)
        super().__init__(name, self._process.info)
        self.live, self._read = live, False
        self._on_close.callback(self._process.close)

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        if self._read:
            raise InvalidInputError(f"source {self.name} can be read only once; open it again")
        self._read = True
        return LiveReader(self._process, drop=self.live, first=first, count=count)


Source = str | os.PathLike[str] | int | Sequence[str | os.PathLike[str]] | FrameSource
"""What `open_source` takes."""


def open_source(
    source: Source,
    *,
    fps: float = 25.0,
    live: bool | None = None,
) -> FrameSource:
    """Open any source of frames.

    Parameters
    ----------
    source
        - a video file, or a named pipe;
        - a folder, a glob pattern such as ``"CARD/*F.MP4"``, or a list of files: the consecutive segments of
          one trip, which become one video, or else images, in the order of their names;
        - ``"-"``: a video on standard input;
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

    Returns
    -------
    FrameSource
        A context manager and an iterable of ``(index, time, frame)``. Dropped frames leave gaps in the
        indices, and times stay right.

    Raises
    ------
    InvalidInputError
        If the source is missing, holds no video and no images, or holds several trips.
    VideoError
        If it cannot be decoded.

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
    check_number(fps, "fps", above=0, high=1000)
    if isinstance(source, int) and not isinstance(source, bool):
        source = str(source)
    if isinstance(source, (list, tuple)):
        return _open_files([_check_file(path) for path in source], fps)
    if not isinstance(source, (str, os.PathLike)):
        raise InvalidInputError(
            f"source must be the path of a video file, a folder, a pattern, a list of files, a URL, '-' or a "
            f"camera's number, got {describe(source)}; pass a file name"
        )
    text = os.fsdecode(source)
    scheme = _URL.match(text)
    if text == "-":
        return _open_stdin(bool(live))
    if scheme is not None:
        return _open_url(text, scheme[1].lower(), live)
    path = check_path(text, "source", kind="the path of a video file")
    if (text.isdecimal() and not path.exists()) or text.startswith("/dev/video"):
        return _open_camera(text, live is not False)
    if path.is_fifo():
        return _Stream(text, input_options(path), live=bool(live))
    files = list_files(path)
    return _open_files(files, fps)


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
    return _Stream("-", ("-i", "pipe:0"), live=live, stdin=descriptor)


def _open_camera(name: str, live: bool) -> FrameSource:
    if sys.platform == "darwin":
        return _Stream(name, ("-f", "avfoundation", "-framerate", "30", "-i", name), live=live)
    if sys.platform == "win32":
        raise InvalidInputError(
            f"source {name}: cameras are not supported on Windows; pipe the output of ffmpeg -f dshow to '-'"
        )
    device = f"/dev/video{name}" if name.isdecimal() else name
    if not Path(device).exists():
        raise InvalidInputError(f"source {name}: there is no camera {device}; see ls /dev/video*")
    return _Stream(name, ("-f", "v4l2", "-i", device), live=live)


def _open_url(url: str, scheme: str, live: bool | None) -> FrameSource:
    if scheme in _STREAM_SCHEMES:
        options = ("-rtsp_transport", "tcp", "-timeout", str(_NETWORK_TIMEOUT * 1_000_000))
        return _Stream(url, (*(options if scheme == "rtsp" else ()), "-i", url), live=live is not False)
    if scheme in ("http", "https"):
        info = None if live else probe(url)
        if info is not None and info.duration:
            return _VideoFile(url, info)
        return _Stream(url, (*_HTTP_OPTIONS, "-i", url), live=live is not False)
    if scheme == "file":
        return open_source(url.removeprefix("file://"), live=live)
    return _download(url)


def _download(url: str) -> FrameSource:
    """Copy a file of other storage to a temporary one, because a video is read at several places."""
    with contextlib.ExitStack() as on_error:
        folder = on_error.enter_context(tempfile.TemporaryDirectory(prefix="vehicle-source-"))
        path = download(url, Path(folder))
        source = _VideoFile(path, probe(path))
        source.name = url
        source._on_close = on_error.pop_all()
    return source


def download(url: str, folder: Path) -> Path:
    """Copy a file from storage that fsspec knows to a folder."""
    path = folder / (url.rstrip("/").rpartition("/")[2] or "video")
    try:
        filesystem, remote = open_filesystem(url)
        with_retries(lambda: filesystem.get_file(remote, str(path)))
    except InvalidInputError:
        raise
    except FileNotFoundError:
        raise InvalidInputError(f"source {url} does not exist; check the URL") from None
    except (OSError, ValueError) as error:
        raise VideoError(f"{url} cannot be copied ({error}); check the connection") from error
    return path


def with_retries(request: Callable[[], Result]) -> Result:
    """Call a function of remote storage again if it fails, up to three times in all."""
    for delay in _RETRY_DELAYS:
        try:
            return request()
        except FileNotFoundError:
            raise
        except OSError:
            time.sleep(delay)
    return request()


def open_filesystem(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it."""
    try:
        import fsspec
    except ImportError:
        raise InvalidInputError(
            f"source {url} needs fsspec; pip install 'vehicle-detection[batch]', or copy the file"
        ) from None
    try:
        filesystem, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:  # an unknown scheme, or a missing package such as s3fs
        raise InvalidInputError(f"source {url} cannot be opened ({error})") from None
    return filesystem, str(path)


def list_files(path: Path) -> list[Path]:
    """List the files of a source: a file, or the videos of one trip or images of a folder or pattern."""
    if path.is_dir():
        found = sorted(each for each in path.rglob("*") if each.is_file() and each.name[0] != ".")
    elif not path.exists() and glob.has_magic(str(path)):
        found = sorted(Path(each) for each in glob.glob(str(path), recursive=True))
        found = [each for each in found if each.is_file()]
    else:
        return [_check_file(path)]
    videos = [each for each in found if is_video_file(each)]
    if not videos:
        images = [each for each in found if each.suffix.lower() in IMAGE_SUFFIXES]
        if not images:
            raise InvalidInputError(f"source {path} holds no videos and no images; check the path")
        return sorted(images, key=_natural_order)
    trips = find_trips(videos, duration=lambda each: probe(each).duration)
    if len(trips) > 1:
        listed = "; ".join(f"{trip} from {Path(trip.files[0]).name}" for trip in trips[:4])
        example = videos[0].parent / f"*{Path(trips[0].files[0]).name[-5:]}"
        raise InvalidInputError(
            f"source {path} holds {len(trips)} trips ({listed}{', ...' if len(trips) > 4 else ''}); select "
            f"one with a pattern such as '{example}', or process all with vehicle-detection batch"
        )
    return [Path(file) for file in trips[0].files]


def _natural_order(path: Path) -> list[Any]:
    """Sorting key of file names in which 9 comes before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [int(part) if part.isdecimal() else part for part in parts]


def _check_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of a readable regular file."""
    path = check_path(path, "source", kind="the path of a video file")
    if path.is_dir():
        raise InvalidInputError(f"source {path} is a folder; choose a video file in it")
    if not path.exists():
        raise InvalidInputError(f"source {path} does not exist; check the path")
    if not path.is_file():
        raise InvalidInputError(f"source {path} is not a regular file; record the stream to a file first")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} is not readable; change its permissions")
    return path


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Read the properties of a video file: frame size, exact frame rate, length, sound and rotation.

    Parameters
    ----------
    path
        A file that ffmpeg can read.

    Returns
    -------
    VideoInfo
        The properties; ``frames`` is an estimate, because counting requires decoding the whole video.

    Raises
    ------
    InvalidInputError
        If the file is missing, a folder, or not readable.
    VideoError
        If the file is not a video, or its first frame cannot be decoded.

    Examples
    --------
    >>> probe_video("missing.mp4")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    return probe(_check_file(path))


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
        Raise an error after the last frame if the file is damaged: frames are missing, or ffmpeg reports
        decoding errors. Otherwise a warning is logged, and the reader's ``damage`` says it.

    Returns
    -------
    FrameReader
        An iterator of ``(index, time, frame)``: the frame's number in the file from 0, its time in seconds,
        and an upright ``(H, W, 3)`` uint8 RGB array. Its ``info`` is the file's `VideoInfo`. ffmpeg ends
        after the last frame, and at the end of a ``with`` block.

    Raises
    ------
    InvalidInputError
        If the file is missing, or there is no frame between `start` and `end`.
    VideoError
        If the file is not a video; while reading, if it is incomplete.

    Examples
    --------
    >>> with read_frames("missing.mp4", end=2.0) as frames:  # doctest: +IGNORE_EXCEPTION_DETAIL
    ...     means = [frame.mean() for index, time, frame in frames]
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    path = _check_file(source)
    check_span(start, end)
    info = probe(path)
    first, count = frame_range(info, start, end)
    return FrameReader(path, info, first=first, count=count, strict=strict)


def check_span(start: float | None, end: float | None) -> None:
    """Check a time range in seconds."""
    for name, value in (("start", start), ("end", end)):
        if value is not None:
            check_number(value, name, low=0, high=1e7)
    if end is not None and (start or 0) >= end:
        raise InvalidInputError(
            f"end must be later than the start; got {start or 0:g} s to {end:g} s, choose a later end"
        )


def frame_range(info: VideoInfo, start: float | None, end: float | None) -> tuple[int, int | None]:
    """Convert seconds to the index of the first frame and the number of frames."""
    if start is not None and info.duration and start >= info.duration:
        raise InvalidInputError(
            f"start must be less than the video's length of {info.duration:g} s; got {start:g} s"
        )
    # Tolerance: a frame's rounded time selects that frame.
    first, last = (
        None if value is None else math.ceil(Fraction(value) * info.fps - Fraction(1, 100))
        for value in (start, end)
    )
    first = first or 0
    if last is not None and last <= first:
        raise InvalidInputError(
            f"end must be at least one frame later than the start, at {float(info.fps):g} frames/s; "
            f"got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return first, None if last is None else last - first
