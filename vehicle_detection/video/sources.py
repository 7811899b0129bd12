"""`open_source`: any source of frames, such as video files, images, cameras and network streams."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from vehicle_detection._common import check_number, check_path, describe, local_path, temporary_folder
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.ffmpeg import NETWORK_TIMEOUT, input_options, source_name
from vehicle_detection.video.files import IMAGE_SUFFIXES, check_file, list_files
from vehicle_detection.video.frame_source import FrameSource
from vehicle_detection.video.image_sequence import ImageSequence
from vehicle_detection.video.live import LiveReader, LiveStream
from vehicle_detection.video.probe import VideoInfo, probe
from vehicle_detection.video.remote import download
from vehicle_detection.video.segments import VideoSegments
from vehicle_detection.video.streams import AudioSource, FrameReader, Reader

_URL = re.compile(r"^([a-zA-Z][a-zA-Z0-9+.-]+)://")
_STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "srt", "tcp")
_RTSP_OPTIONS = ("-rtsp_transport", "tcp", "-timeout", f"{NETWORK_TIMEOUT * 1e6:.0f}")


class _VideoFile(FrameSource):
    """A video file, or the URL of one."""

    def __init__(self, path: Path | str, info: VideoInfo) -> None:
        super().__init__(source_name(path), info, () if isinstance(path, str) else (path,))
        self._path = path

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> FrameReader:
        return FrameReader(self._path, self.info, first=first, count=count, strict=strict)

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        if not self.info.has_audio:
            return None
        return AudioSource(
            input=input_options(self._path),
            start=self.info.start_time + float(first / self.info.fps),
            audio_offset=self.info.audio_offset,
            length=length,
            copyable=not first and length is None,
        )


class _Stream(FrameSource):
    """A stream that can be read once: standard input, a camera or a network stream."""

    rereadable = False

    def __init__(self, stream: LiveStream, *, live: bool) -> None:
        super().__init__(stream.name, stream.info)
        self._stream, self.live, self._read = stream, live, False
        self._on_close.callback(stream.close)

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        if self._read:
            raise InvalidInputError(f"source {self.name} can be read only once; open it again")
        self._read = True
        return LiveReader(self._stream, drop=self.live, first=first, count=count)


Source = str | os.PathLike[str] | int | Sequence[str | os.PathLike[str]] | FrameSource
"""What `open_source` takes."""


def open_source(
    source: Source,
    *,
    fps: float = 25.0,
    live: bool | None = None,
    reconnect: bool = True,
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
    reconnect
        Whether to open a network stream of unknown length again when it ends or sends nothing for 10 seconds:
        six attempts within about half a minute, which start over after 10 seconds of frames.

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
    fps = check_number(fps, "fps", above=0, high=1000)
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
    scheme = _URL.match(text)
    if text == "-":
        return _open_stdin(bool(live))
    if scheme is not None:
        return _open_url(text, scheme[1].lower(), fps, live, reconnect)
    path = check_path(text, "source", kind="the path of a video file")
    if (text.isdecimal() and not path.exists()) or text.startswith("/dev/video"):
        return _open_camera(text, live is not False)
    if path.is_fifo():
        return _Stream(LiveStream(text, input_options(path)), live=bool(live))
    files = list_files(path)
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
        return ImageSequence(files, fps)
    if images:
        raise InvalidInputError(
            f"source must be videos or images, got both ({files[0]}, {images[0]}); select one kind"
        )
    if len(files) == 1:
        return _VideoFile(files[0], probe(files[0]))
    broken = next((path for path in files if "\n" in str(path) or "\r" in str(path)), None)
    if broken is not None:  # the list of files for ffmpeg has a line for each
        raise InvalidInputError(f"source {str(broken)!r} has a line break in its name; rename the file")
    return VideoSegments(files)


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
    if scheme in _STREAM_SCHEMES:
        options = (*(_RTSP_OPTIONS if scheme.startswith("rtsp") else ()), "-i", url)
        return _open_stream(url, options, live, reconnect)
    if scheme in ("http", "https"):
        info = None if live else probe(url)
        if info is not None and info.duration:
            return _VideoFile(url, info)
        return _open_stream(url, ("-i", url), live, reconnect)
    if scheme == "file":
        return open_source(local_path(url), fps=fps, live=live)
    return _download(url)


def _open_stream(url: str, options: Sequence[str], live: bool | None, reconnect: bool) -> FrameSource:
    """Open a network stream."""
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
