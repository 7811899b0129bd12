"""`open_source`, which opens any source of frames."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vehicle_detection._common import NETWORK_TIMEOUT, check, invalid, local_path, temporary_folder
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import IMAGE_SUFFIXES
from vehicle_detection.tracking import USUAL_FPS
from vehicle_detection.video.ffmpeg import input_options, network_options, restrict_input, source_name
from vehicle_detection.video.files import check_file, download, is_video_file, list_files
from vehicle_detection.video.live import LiveStream
from vehicle_detection.video.probe import VideoInfo, joined_length, probe, with_repeats
from vehicle_detection.video.reading import FrameReader, check_span, frame_range
from vehicle_detection.video.sources import (
    NO_RATE,
    FrameSource,
    ImageSequence,
    Stream,
    VideoFile,
    VideoSegments,
    exact_rate,
)

_LOGGER = logging.getLogger(__name__)

_URL = re.compile(r"^([a-zA-Z][a-zA-Z0-9+.-]+)://")
_STREAM_SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "udp", "rtp", "srt", "tcp")
_RTSP_OPTIONS = ("-rtsp_transport", "tcp", "-timeout", f"{NETWORK_TIMEOUT * 1e6:.0f}")


Source = str | os.PathLike[str] | int | Sequence[str | os.PathLike[str]] | FrameSource
"""What `open_source` takes."""


def open_source(
    source: Source,
    *,
    fps: float | None = None,
    stream: int | None = None,
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
        Frame rate of images, raw streams such as ``drive.h264``, pipes, cameras and network streams; an error
        for files with times. None: that which they state, else 25, with a warning.
    stream
        ffmpeg's number of the video stream, where a file has several. None: that which is marked as the
        default, else the largest one, with a warning that lists the others.
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
        if fps is not None or stream is not None:
            raise InvalidInputError(f"source {source.name} is open already; omit fps and stream")
        return source
    check.flags(reconnect=reconnect, strict=strict)
    if fps is not None:
        fps = check.number(fps, "fps", above=0, high=1000)
    if stream is not None:
        stream = check.integer(stream, "stream", low=0, high=1000)
    opened = _open(source, _Options(fps, stream, live, reconnect, strict))
    opened.strict = strict
    return opened


@dataclass(frozen=True)
class _Options:
    """The options of `open_source`; each warning is logged once, not for every segment of a trip."""

    fps: float | None
    stream: int | None
    live: bool | None
    reconnect: bool
    strict: bool
    warned: set[str] = field(default_factory=set)

    def _warn(self, message: str, *values: object) -> None:
        if message not in self.warned:
            self.warned.add(message)
            _LOGGER.warning(message, *values)

    def probe(self, path: Path | str) -> VideoInfo:
        """Read the properties of a file or URL, and apply the options to it."""
        return self.apply(path, with_repeats(path, probe(path, self.stream)))

    def apply(self, path: Path | str, info: VideoInfo) -> VideoInfo:
        """Return the properties with the frame rate of the options, if the file has no times."""
        name = source_name(path)
        if self.fps is None:
            if not info.rate_stated:
                self._warn(NO_RATE, name)
        elif info.is_raw:
            if info.rate_stated and abs(info.fps - self.fps) > 0.01:
                self._warn("%s states %.5g frames/s; read with %g", name, float(info.fps), self.fps)
            info = replace(info, fps=exact_rate(self.fps))
        else:
            raise InvalidInputError(
                f"fps must be omitted for {name}, whose frames have times of their own "
                f"({float(info.fps):.5g} frames/s); to change its speed, convert it with ffmpeg"
            )
        if info.other_index:
            self._warn(
                "%s seems to be joined of several files, of which only the first one is read; read them as a "
                "list or a folder, or join them with ffmpeg -f concat",
                name,
            )
        if info.other_streams and self.stream is None:
            self._warn(
                "%s has several video streams: %d (%dx%d) is read, not %s; choose another one by its number, "
                "with stream or --stream",
                *(name, info.stream, info.width, info.height, info.other_streams),
            )
        return info

    def open_stream(
        self, name: str, options: Sequence[str], stdin: int = subprocess.DEVNULL, *, network: bool = False
    ) -> LiveStream:
        """Open a stream that is read once."""
        if self.fps is not None:
            *options, flag, place = options
            rate = "-framerate" if "-f" in options else "-r"
            options = [*options, rate, str(exact_rate(self.fps)), flag, place]
        if self.stream is not None:
            options = [*options, "-map", f"0:{self.stream}"]
        opened = LiveStream(name, options, stdin=stdin, network=network, reconnect=self.reconnect)
        if self.fps is None and opened.info.is_raw and opened.info.fps == USUAL_FPS:
            self._warn(NO_RATE, name)
        return opened


def _open(source: object, options: _Options) -> FrameSource:
    """Open a source that is not yet open."""
    if isinstance(source, int) and not isinstance(source, bool):
        source = str(source)
    is_path = (str, os.PathLike)
    if isinstance(source, (list, tuple)) and all(isinstance(each, is_path) for each in source):
        return _open_files([check_file(path) for path in source], options)
    if not isinstance(source, is_path):
        must = "be a video file, a folder, a pattern, a list of files, a URL, '-' or a camera's number"
        remedy = "pass a file name, or call detector.process(frame, time) with frames of your own"
        raise invalid("source", must, source, remedy)
    text = os.fsdecode(source)
    if text == "-":
        return _open_stdin(options)
    if scheme := _URL.match(text):
        return _open_url(text, scheme[1].lower(), options)
    path = check.path(text, "source", kind="the path of a video file")
    if (text.isdecimal() and not path.exists()) or text.startswith("/dev/video"):
        return _open_camera(text, options)
    if path.is_fifo():
        return Stream(options.open_stream(text, input_options(path)), live=bool(options.live))
    files = list_files(text) or [check_file(path)]
    if len(files) > 1 and is_video_file(files[0]):
        raise InvalidInputError(
            f"source {path} holds {len(files)} videos; open the segments of one trip with open_trip, pass a "
            "list of consecutive files, or process all of them with run_batch"
        )
    return _open_files(files, options)


@contextlib.contextmanager
def borrow_source(source: Source) -> Iterator[FrameSource]:
    """Open a source for a block; one that the caller has opened stays open."""
    if isinstance(source, FrameSource):
        yield source
        return
    with open_source(source) as opened:
        yield opened


def _open_files(files: Sequence[Path], options: _Options) -> FrameSource:
    """Open one file, the segments of a trip or images."""
    if not files:
        raise InvalidInputError("source must name at least one file, got an empty list; add a file")
    images = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    if len(images) == len(files):
        if options.stream is not None:
            raise InvalidInputError(f"stream must be omitted for images, got {options.stream}; omit it")
        return ImageSequence(files, options.fps)
    if images:
        raise InvalidInputError(
            f"source must be videos or images, got both ({files[0]}, {images[0]}); select one kind"
        )
    if len(files) == 1:
        return VideoFile(files[0], _with_joined(files[0], options.probe(files[0])))
    broken = next((path for path in files if "\n" in str(path) or "\r" in str(path)), None)
    if broken is not None:  # the list of files for ffmpeg has a line for each
        raise InvalidInputError(f"source {str(broken)!r} has a line break in its name; rename the file")
    return VideoSegments(files, options.probe, strict=options.strict)


def _with_joined(path: Path, info: VideoInfo) -> VideoInfo:
    """Return the properties of a file with the length of all the recordings that were joined to it."""
    length = joined_length(path, info)
    if not length:
        return info
    _LOGGER.warning(
        "%s seems to be joined of several recordings, whose times begin again: it can only be read from its "
        "beginning; for other parts, copy it first: ffmpeg -i IN -c copy OUT.mkv",
        path,
    )
    frames = round(length * info.fps)
    return replace(info, duration=length, frames=frames, times_restart=True)


def _open_stdin(options: _Options) -> FrameSource:
    try:
        descriptor = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        descriptor = -1
    if descriptor < 0 or os.isatty(descriptor):
        raise InvalidInputError(
            "source - reads a video from standard input, which is not a pipe; use: cat drive.mp4 | ..."
        )
    return Stream(
        options.open_stream("-", (*restrict_input("pipe"), "-i", "pipe:0"), descriptor),
        live=bool(options.live),
    )


def _open_camera(name: str, options: _Options) -> FrameSource:
    live = options.live is not False
    if sys.platform == "darwin":
        settings = ("-f", "avfoundation", "-framerate", "30", "-i", name)
        return Stream(options.open_stream(name, settings), live=live)
    if sys.platform == "win32":
        raise InvalidInputError(
            f"source {name}: cameras are not supported on Windows; pipe the output of ffmpeg -f dshow to '-'"
        )
    device = f"/dev/video{name}" if name.isdecimal() else name
    if not Path(device).exists():
        raise InvalidInputError(f"source {name}: there is no camera {device}; see ls /dev/video*")
    return Stream(options.open_stream(name, ("-f", "v4l2", "-i", device)), live=live)


def _open_url(url: str, scheme: str, options: _Options) -> FrameSource:
    if scheme == "file":
        return _open(local_path(url), options)
    if scheme in ("http", "https"):
        info = None if options.live else probe(url, options.stream)
        if info is not None and info.duration:
            return VideoFile(url, options.apply(url, info))
    elif scheme not in _STREAM_SCHEMES:
        return _download(url, options)
    settings = (*(_RTSP_OPTIONS if scheme.startswith("rtsp") else ()), *network_options(url))
    opened = options.open_stream(source_name(url), settings, network=True)
    return Stream(opened, live=options.live is not False)


def _download(url: str, options: _Options) -> FrameSource:
    """Copy a file of other storage to a temporary one, because a video is read at several places."""
    with contextlib.ExitStack() as on_error:
        folder = on_error.enter_context(temporary_folder(Path(tempfile.gettempdir()), "vehicle-source"))
        path = download(url, folder)
        source = VideoFile(path, _with_joined(path, options.probe(path)))
        source.name = source_name(url)
        source._on_close = on_error.pop_all()
    return source


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Read the properties of a video file or web address: frame size, exact frame rate, length, sound.

    >>> probe_video("missing.mp4")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    return probe(path if isinstance(path, str) and _URL.match(path) else check_file(path))


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
    path, span = check_file(source), check_span(start, end)
    info = _with_joined(path, _Options(None, None, None, False, strict).probe(path))
    first, count = frame_range(info, *span)
    return FrameReader(path, info, first=first, count=count, strict=strict)
