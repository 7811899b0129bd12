"""Reading the frames of one video file through a pipe from ffmpeg, and finding what is damaged in it.

moviepy's reader copies each frame twice and rounds the frame rate to two decimals. ffmpeg skips what it
cannot decode and ends with exit code 0, so its frames and its log must be checked.
"""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NETWORK_DEADLINE, Closing, check, pluralize
from vehicle_detection.errors import InvalidInputError, VideoError
from vehicle_detection.video.ffmpeg import (
    Process,
    check_resources,
    exit_reason,
    input_options,
    last_line,
    pixel_limit,
    run_ffmpeg,
    seconds_of,
    source_name,
    too_slow,
    video_error,
)
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.yuv import FORMATS, DecodedFrame, PlanarFrame

_LOGGER = logging.getLogger(__name__)

# Part of a frame by which reading starts early: less than half, because ffmpeg rounds to the nearest frame.
_EARLY = Fraction(2, 5)
# Maximum duration in seconds of one frame of a video with a varying rate, when reading starts inside it.
_MAX_FRAME_DURATION = 5
# More threads wait for each other, and the search needs the cores.
_DECODER_THREADS = "2"
_TRUNCATED = re.compile(r"partial file|ended prematurely")
# Containers with an index of their key frames. It may hold the times of decoding, which are earlier than
# those of display by this many seconds at most.
_INDEXED = ("mov", "matroska")
_REORDERING = 0.5
# Steps in seconds by which a seek is moved back until decoding begins before the wanted time; in a network,
# where each costs a connection, only some.
_STEPS: tuple[float, ...] = (0, 1, 4, 16, 64)
_NETWORK_STEPS: tuple[float, ...] = (4, 64)
# Error of a frame rate that ffmpeg has derived from the file's times.
_RATE_ERROR = Fraction(6, 1000)
_REPEATED = re.compile(r"Last message repeated (\d+) times")


class Reader(Closing):
    """Frames of a source, in order: an iterator of ``(index, time, frame)`` and a context manager."""

    info: VideoInfo
    damage: str = ""
    """What is damaged in the source; known after the last frame, and empty if nothing is."""
    cpu_seconds: float = 0.0
    """Processor time of ffmpeg, known after it has ended."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        found = self.read_next()
        if found is None:
            raise StopIteration
        index, moment, frame = found
        return index, moment, frame.rgb()

    def decoded(self) -> Iterator[tuple[int, float, DecodedFrame]]:
        """Iterate over the same frames, which are converted to RGB only if and as far as they are used."""
        return iter(self.read_next, None)

    def read_next(self) -> tuple[int, float, DecodedFrame] | None:
        """Return number, time and content of the next frame; None at the end."""
        raise NotImplementedError

    def kill(self) -> None:
        """End at once, from any thread; a thread that reads sees the end."""
        raise NotImplementedError

    def close(self) -> None:
        """End and release everything."""
        self.kill()


class FrameReader(Reader):
    """Frames of a video file, as `read_frames` returns it; ffmpeg ends after the last one, or on `close`.

    Damage is logged as a warning; with `strict` it is raised as an error. With `whole`, missing frames at the
    end are an error.
    """

    def __init__(
        self,
        path: Path | str,
        info: VideoInfo,
        *,
        first: int = 0,
        count: int | None = None,
        strict: bool = False,
        whole: bool = False,
    ) -> None:
        self.info = info
        self.frames_read = 0
        self._strict, self._whole = strict, whole
        self._killed = False
        self._path, self._first, self._count = path, first, count
        if first and info.times_restart:
            raise VideoError(
                f"{source_name(path)} cannot be read from {float(first / info.fps):g} s on: its times begin "
                "again, as in joined files; copy it first, without loss: ffmpeg -i IN -c copy OUT.mkv"
            )
        # All frames get the probed size: a stream may change its size, and pixels may not be square.
        filters = [f"scale={info.width}:{info.height}:flags=bicubic"]
        early = _EARLY
        if not info.constant_rate:  # some seconds, to decode the frame that is still shown at the start
            early = Fraction(min(first, math.ceil(_MAX_FRAME_DURATION * info.fps)))
        wanted = info.start_time + float((first - early) / info.fps)
        seek = find_seek_time(path, info, wanted) if first else info.video_offset
        begin = f"{wanted - seek:.6f}"
        if not info.constant_rate:
            filters = [f"fps={info.fps}:start_time={begin}", f"trim=start_frame={early}", *filters]
        elif first:
            filters = [f"trim=start={begin}", *filters]
        options = ["-ss", f"{seek:.6f}"] if seek > info.video_offset else []
        self._sought = bool(options)
        options += ["-r", str(info.fps)] if info.is_raw else []
        options += ["-threads", _DECODER_THREADS, *pixel_limit(), *input_options(path)]
        options += ["-map", f"0:{info.stream}", "-vf", ",".join(filters)]
        if count is not None:
            options += ["-frames:v", str(count)]
        options += ["-fps_mode", "passthrough"]
        height, width = info.shape[:2]
        # Planes are read as stored and converted here, in at most half the time of reading RGB.
        even = height % 2 == 0 and width % 2 == 0
        self._in_planes = info.pixel_format in FORMATS and info.color_encoding.supported and even
        pixel_format = info.pixel_format if self._in_planes else "rgb24"
        self._stored_shape = (height * 3 // 2, width) if self._in_planes else info.shape
        options += ["-pix_fmt", pixel_format, "-f", "rawvideo", "pipe:1"]
        self._process = Process(options, stdout=True)

    def read_next(self) -> tuple[int, float, DecodedFrame] | None:
        """Return number, time and content of the next frame; None at the end."""
        if self._process.stdout.closed:
            return None
        content = np.empty(self._stored_shape, np.uint8)
        if not self._process.read_into(content, self._has_data):
            self._finish()
            return None
        encoding = self.info.color_encoding
        frame = PlanarFrame(content, encoding) if self._in_planes else DecodedFrame(content)
        index = self._first + self.frames_read
        self.frames_read += 1
        return index, float(index / self.info.fps), frame

    def _has_data(self) -> bool:
        """Whether a file, or a server in time, has something for the next frame."""
        if isinstance(self._path, Path) or self._process.has_data(NETWORK_DEADLINE):
            return True
        self.close()
        raise too_slow(source_name(self._path))

    def _finish(self) -> None:
        """Close ffmpeg after its last frame; raise an error if frames are missing."""
        code, log = self._process.wait(), self._process.log()
        self.close()
        if self._killed:
            return
        end, name = self._first + self.frames_read, source_name(self._path)
        start = float(self._first / self.info.fps)
        incomplete = ""
        if self._count is None or self.frames_read < self._count:
            check_resources(name, code, log)
            cut = _TRUNCATED.search(log)
            announced = self.info.frames if cut else _frames_of_cut_avi(self._path, self.info)
            if end < announced - 1:
                known = f"{end} of about {announced} frames" if self.frames_read else ""
                incomplete = f"{name} is incomplete: {known or f'no frame after {start:g} s'} can be decoded"
            elif code:
                message = (
                    f"{name} cannot be decoded after frame {end}: {exit_reason(code, log)}; "
                    "if this happens again, copy the file again"
                )
                raise video_error(message, self._path, code, log)
        if incomplete and isinstance(self._path, str):  # the server or the network may be to blame
            raise video_error(f"{incomplete}; try again", self._path, code, log)
        if incomplete and self._whole:
            raise VideoError(f"{incomplete}; copy it again, or leave it out")
        if not self.frames_read:
            what = incomplete or f"{name} has no frame after {start:g} s"
            raise VideoError(f"{what}; choose an earlier start")
        if incomplete:
            self.damage = f"{incomplete}; copy it again"
        else:
            # After a jump into the file, the first frames may refer to frames before it: this is no damage.
            errors = "" if self._sought else log
            stop = None if self._count is None else self._first + self._count
            self.damage = find_damage(self._path, self.info, end, errors, stop=stop)
        if self.damage and self._strict:
            raise VideoError(self.damage)
        if self.damage:
            _LOGGER.warning("%s", self.damage)

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads sees the end of the video."""
        self._killed = True  # not an error in the file
        self._process.kill()

    def close(self) -> None:
        """End ffmpeg if it is still running."""
        self._process.close()
        self.cpu_seconds = self._process.cpu_seconds

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()


def find_seek_time(path: Path | str, info: VideoInfo, wanted: float) -> float:
    """Return a time in the file from which ffmpeg decodes the frame at `wanted`, in seconds.

    In files without an index, such as MPEG-TS, decoding begins with the next key frame after it, perhaps
    seconds later, and without key frames, as with intra refresh, when all parts of a frame are new. Therefore
    the time of the first decoded frame is checked.
    """
    if not info.duration:  # raw streams have no times; ffmpeg's are wrong after a seek
        return info.video_offset
    steps = _NETWORK_STEPS if isinstance(path, str) else _STEPS
    if info.container.startswith(_INDEXED):
        steps = (_REORDERING, *steps[1:])
    for seconds in steps:
        # A whole number of frames earlier, because ffmpeg may round times to frames.
        seek = wanted - float(math.ceil(seconds * info.fps) / info.fps)
        if seek <= info.video_offset:
            break
        if _first_time(path, info.stream, seek) <= wanted - seek:
            return seek
    return info.video_offset


def _first_time(path: Path | str, stream: int, seek: float) -> float:
    """Time of the first frame that is decoded after a seek, from there, in seconds.

    It is infinite if the frame is no key frame: some decoders begin with others, which are gray then.
    """
    options = ("-noaccurate_seek", "-ss", f"{seek:.6f}", *input_options(path), "-map", f"0:{stream}")
    options += ("-frames:v", "1", "-vf", "showinfo", "-f", "null", "-")
    _, log = run_ffmpeg(path, options, level="info")
    found = re.search(r"n: *0 .*?pts_time:(-?[\d.]+).*? iskey:1 ", log)
    return float(found[1]) if found else math.inf


def find_damage(path: Path | str, info: VideoInfo, end: int, log: str, *, stop: int | None = None) -> str:
    """Say what is damaged, or return an empty text.

    `end` is the number of the file's frames up to the last decoded one, `stop` that up to the last one
    wanted, which may lie after the file's end. `log` holds ffmpeg's errors.
    """
    parts = []
    count, message = _decode_errors(log)
    announced = end if end == stop else _announced_frames(path, info, end, exact=count > 0)
    expected, name = min(announced, stop or sys.maxsize), source_name(path)
    if expected > end and not count and not info.container.startswith(_INDEXED):
        return (
            f"{name} lacks {expected - end} of {expected} frames, or the times of its frames have gaps, and "
            "later times are too early; if its rate varies, copy it first: ffmpeg -i IN -c copy OUT.mkv"
        )
    if expected > end:
        parts.append(f"{expected - end} of {expected} frames cannot be decoded")
    if count:
        parts.append(f"ffmpeg reports {pluralize(count, 'decoding error')} ({message})")
    return f"{name} is damaged: {', and '.join(parts)}; copy or record it again" if parts else ""


def _frames_of_cut_avi(path: Path | str, info: VideoInfo) -> int:
    """Return the number of frames that an AVI file states, if its end is missing; otherwise 0.

    ffmpeg reads such a file without an error.
    """
    if info.container != "avi" or isinstance(path, str):
        return 0
    with path.open("rb") as file:
        header = file.read(52)
    size, frames = (int.from_bytes(header[at : at + 4], "little") for at in (4, 48))
    return frames if header[24:28] == b"avih" and size + 8 > path.stat().st_size else 0


def _decode_errors(log: str) -> tuple[int, str]:
    """Count the decoder's errors, and return the last one.

    The demuxer's errors concern other streams, too, and those of the output only times of frames.
    """
    count, last, counted = 0, "", False
    for line in log.splitlines():
        repeated = _REPEATED.search(line)
        if repeated:
            count += int(repeated[1]) if counted else 0
            continue
        counted = line.startswith("[") and not line.startswith(("[in#", "[rawvideo @"))
        if counted:
            count, last = count + 1, line
    return count, last_line(last)


def _announced_frames(path: Path | str, info: VideoInfo, end: int, *, exact: bool) -> int:
    """Return how many frames a file announces; `end` if unknown or, unless `exact`, about as many."""
    if info.frames <= end + (0 if exact else 1):
        return end
    # The file's duration is that of its longest stream, which may be the sound.
    duration = stream_duration(path, info)
    if duration is None:
        duration = 0.0 if info.has_audio else float(info.frames / info.fps)
    expected = round(duration * info.fps)
    # With a varying rate, the duration of the last frame is unknown.
    tolerance = (0 if exact else 1) + duration * float(_RATE_ERROR)
    tolerance += 0 if info.constant_rate else float(info.fps)
    return expected if expected - end > math.floor(tolerance) else end


def stream_duration(path: Path | str, info: VideoInfo) -> float | None:
    """Duration of the video stream in seconds; None if the file does not state it."""
    options = (*input_options(path), "-map", f"0:{info.stream}", "-c", "copy", "-frames:v", "1")
    _, log = run_ffmpeg(path, (*options, "-f", "null", "-"), level="trace")
    mapped = re.search(r"Stream #0:(\d+) -> #0:0", log)
    index = mapped[1] if mapped else "0"
    exact = re.search(rf"stream {index}: start_time: \S+ duration: ([\d.]+)", log)
    if exact:
        return float(exact[1])
    # Matroska states the stream's end in a tag, which the log repeats for the output.
    ends = re.findall(r"DURATION +: (\d+:\d+:[\d.]+)", log)
    return seconds_of(ends[-1]) - info.first_timestamp if ends else None


def check_span(start: float | None, end: float | None) -> tuple[float | None, float | None]:
    """Return a time range in seconds if it is valid."""
    start, end = (
        None if value is None else check.number(value, name, low=0, high=1e7)
        for name, value in (("start", start), ("end", end))
    )
    if end is not None and (start or 0) >= end:
        raise InvalidInputError(
            f"end must be later than the start; got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return start, end


def frame_range(info: VideoInfo, start: float | None, end: float | None) -> tuple[int, int | None]:
    """Convert seconds to the index of the first frame and the number of frames."""
    if start is not None and info.duration and start >= info.duration:
        raise InvalidInputError(
            f"start must be less than the video's length of {info.duration:g} s; got {start:g} s"
        )
    # Tolerance: a frame's rounded time selects that frame.
    first, last = (
        None if value is None else math.ceil(Fraction(float(value)) * info.fps - Fraction(1, 100))
        for value in (start, end)
    )
    first = first or 0
    if last is not None and last <= first:
        raise InvalidInputError(
            f"end must be at least one frame later than the start, at {float(info.fps):g} frames/s; "
            f"got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return first, None if last is None else last - first


@dataclass(frozen=True, kw_only=True)
class AudioSource:
    """Sound for a written video."""

    input: tuple[str, ...]  # options of ffmpeg that open it
    start: float = 0.0  # time (s) of the first written frame in the file
    audio_offset: float = 0.0  # time (s) in the file that is ffmpeg's time 0
    length: float | None = None  # maximum (s)
    copyable: bool = False  # without decoding: it is the whole track of one file
