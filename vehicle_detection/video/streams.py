"""Frames out of a video file and frames into one: lean pipes to ffmpeg.

moviepy's own reader and writer copy twice and round the rate to two decimals.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import VideoError
from vehicle_detection.video.ffmpeg import Process, VideoInfo, last_line
from vehicle_detection.video.yuv import FORMATS, planes_from_rgb, rgb_from_planes

CONTAINERS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""Suffix of a file that can be written, and ffmpeg's name for its container."""

# What every browser plays is copied as it is; Matroska holds anything.
_COPIED_AUDIO = {"mp4": {"aac", "mp3"}, "mov": {"aac", "mp3"}}
_COPIED_AUDIO["matroska"] = {*_COPIED_AUDIO["mp4"], "ac3", "eac3", "flac", "opus", "vorbis"}
_LONGEST_STILL = 5
"""Seconds for which one frame of a video with a varying rate may be shown, when reading starts inside it."""
# More threads than that wait for each other, and the search needs the cores.
_DECODER_THREADS = "2"
_CUT = re.compile(r"partial file|ended prematurely")


class FrameReader:
    """Frames of a video, in order: an iterator of ``(index, time, frame)`` and a context manager.

    ``index`` is the frame's number in the file, counted from 0, ``time`` its second in it, ``frame`` an
    ``(H, W, 3)`` uint8 RGB array that is the caller's own. ffmpeg ends with the last frame, on
    :meth:`close`, at the end of a ``with`` block, and when the reader is dropped.
    """

    def __init__(self, path: Path, info: VideoInfo, *, first: int = 0, count: int | None = None) -> None:
        self.info = info
        self.frames_read = 0
        self._killed = False
        self._path, self._first, self._count = path, first, count
        # A stream may change its size on the way; frames keep that of the first.
        filters = [f"scale={info.width}:{info.height}:flags=bicubic"]
        if info.constant_rate:  # half a frame early: rounding cannot hit the neighbor
            seek = float((first - Fraction(1, 2)) / info.fps) + info.first_time if first else 0.0
        else:  # some seconds early: the frame that is still shown at the start may be an old one
            early = min(first, math.ceil(_LONGEST_STILL * info.fps))
            seek = float((first - early) / info.fps)
            filters = [f"fps={info.fps}:start_time=0", f"trim=start_frame={early}", *filters]
        options = ["-ss", f"{seek:.6f}"] if seek else []
        options += ["-threads", _DECODER_THREADS, "-i", f"file:{path}"]
        options += ["-map", "0:V:0", "-vf", ",".join(filters)]
        if count is not None:
            options += ["-frames:v", str(count)]
        options += ["-fps_mode", "passthrough"]
        height, width = info.shape[:2]
        # Planes are read as they are stored, in half the time, and become frames here.
        self._in_planes = info.pixel_format in FORMATS and info.coding.known and not (height % 2 or width % 2)
        pixels = info.pixel_format if self._in_planes else "rgb24"
        shape = (height * 3 // 2, width) if self._in_planes else info.shape
        self._stored = np.empty(shape, np.uint8)
        self._channels = np.empty((3, height, width), np.uint8)
        options += ["-pix_fmt", pixels, "-f", "rawvideo", "pipe:1"]
        self._process = Process(("-nostdin", *options), stdout=True)

    def __iter__(self) -> FrameReader:
        return self

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        if self._process.stdout.closed:
            raise StopIteration
        view = self._stored.data.cast("B")
        done = 0
        while done < len(view):
            got = self._process.stdout.readinto(view[done:])  # type: ignore[attr-defined]
            if not got:
                self._end()
                raise StopIteration
            done += got
        if self._in_planes:
            frame = rgb_from_planes(self._stored, self.info.coding, self._channels)
        else:
            frame = self._stored.copy()
        index = self._first + self.frames_read
        self.frames_read += 1
        return index, float(index / self.info.fps), frame

    def _end(self) -> None:
        """Close ffmpeg after its last frame, and say so if that came too early."""
        code = self._process.wait()
        log = self._process.log()
        self.close()
        if self._killed or (self._count is not None and self.frames_read >= self._count):
            return
        end = self._first + self.frames_read
        if end < self.info.frames - 1 and _CUT.search(log):
            seconds = math.floor(end / self.info.fps * 100) / 100
            raise VideoError(
                f"{self._path} is cut off: {end} of about {self.info.frames} frames can be decoded; "
                f"copy the file again, or pass end={seconds:g} to take the part that is there"
            )
        if code:
            raise VideoError(
                f"{self._path} cannot be decoded after frame {end} ({last_line(log)}); copy the file again"
            )
        if not self.frames_read:
            start = float(self._first / self.info.fps)
            raise VideoError(f"{self._path} has no frame from {start:g} s on; choose an earlier start")

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg, once it has ended."""
        return self._process.cpu_seconds

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads then sees the end of the video."""
        self._killed = True  # an end that we made is no damage to the file
        self._process.kill()

    def close(self) -> None:
        """End ffmpeg, if it still runs."""
        self._process.close()

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()


@dataclass(frozen=True, kw_only=True)
class AudioSource:
    """Audio for a written video: all of `path`'s as it is, or from `start` on, or `length` seconds of it."""

    path: Path
    start: float | None = None
    length: float | None = None


class FrameWriter:
    """H.264 video out of ``(H, W, 3)`` uint8 RGB frames at a constant rate, with the audio of another file.

    H.264 that every player reads has even sides: an odd side grows by one pixel, which repeats the last
    column or row.
    """

    def __init__(self, path: Path, info: VideoInfo, *, preset: str, audio: AudioSource | None = None) -> None:
        container = CONTAINERS[path.suffix.lower()]
        width, height = info.width + info.width % 2, info.height + info.height % 2
        self._planes = np.empty((height * 3 // 2, width), np.uint8)
        self._channels = np.empty((3, height, width), np.uint8)
        picture = ["-f", "rawvideo", "-pixel_format", "yuv420p", "-video_size", f"{width}x{height}"]
        picture += ["-framerate", str(info.fps)]
        sound: list[str] = []
        mapped = ["-map", "0:v:0"]
        if audio is not None:
            whole = audio.start is None and audio.length is None
            if whole and info.first_time:  # a picture that starts after the sound keeps doing so
                picture += ["-itsoffset", f"{info.first_time:.6f}"]
            sound += [] if audio.start is None else ["-ss", f"{audio.start:.6f}"]
            sound += [] if audio.length is None else ["-t", f"{audio.length:.6f}"]
            sound += ["-vn", "-i", f"file:{audio.path}"]
            copied = whole and info.audio_codec in _COPIED_AUDIO[container]
            mapped += ["-map", f"1:a:{info.audio_track}"]
            mapped += ["-c:a", "copy"] if copied else ["-c:a", "aac", "-b:a", "192k"]
        filters = "setparams=colorspace=smpte170m:color_primaries=bt709:color_trc=bt709:range=tv"
        if info.pixel_aspect != 1:
            filters += f",setsar={info.pixel_aspect}"
        encoder = ["-vf", filters, "-c:v", "libx264", "-preset", preset, "-fps_mode", "passthrough"]
        encoder += ["-f", container]
        if container != "matroska":  # the index in front: a browser plays before it has the whole file
            encoder += ["-movflags", "+faststart"]
        options = ["-y", *picture, "-i", "pipe:0", *sound, *mapped, *encoder, f"file:{path}"]
        self._process = Process(options, stdin=True)

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Hand one frame to ffmpeg."""
        planes_from_rgb(frame, self._planes, self._channels)
        view = self._planes.data.cast("B")
        done = 0
        try:
            while done < len(view):
                done += self._process.stdin.write(view[done:])
        except OSError as error:
            raise self._failure() from error

    def finish(self) -> None:
        """Wait until ffmpeg has written the last frame."""
        self._process.stdin.close()
        if self._process.wait():
            raise self._failure()

    def _failure(self) -> VideoError:
        self._process.wait()
        reason = last_line(self._process.log())
        return VideoError(f"the video cannot be written: ffmpeg says {reason!r}; is the disk full?")

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg, once it has ended."""
        return self._process.cpu_seconds

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that writes to it gets an error."""
        self._process.kill()

    def close(self) -> None:
        """End ffmpeg, if it still runs."""
        self._process.close()

    def __enter__(self) -> FrameWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
