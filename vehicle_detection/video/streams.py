"""Reading frames from a video file and writing frames to one, through pipes to ffmpeg.

moviepy's reader and writer copy each frame twice and round the frame rate to two decimals.
"""

from __future__ import annotations

import logging
import math
import re
import shutil
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Closing, temporary_folder
from vehicle_detection.errors import TransientVideoError, VideoError
from vehicle_detection.video.damage import find_damage
from vehicle_detection.video.ffmpeg import (
    Process,
    check_resources,
    exit_reason,
    input_options,
    pixel_limit,
    source_name,
    video_error,
)
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.seeking import find_seek_time
from vehicle_detection.video.yuv import FORMATS, planes_from_rgb, rgb_from_planes

_LOGGER = logging.getLogger(__name__)

CONTAINERS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""ffmpeg's name of the container for each suffix that can be written."""

# Codecs that are copied instead of encoded again: those that every browser plays; Matroska holds any.
_COPIED_AUDIO = {"mp4": {"aac", "mp3"}, "mov": {"aac", "mp3"}}
_COPIED_AUDIO["matroska"] = {*_COPIED_AUDIO["mp4"], "ac3", "eac3", "flac", "opus", "vorbis"}
# Fills and cuts the sound where its times and its samples differ by more than 20 ms.
_SYNCHRONIZED = "aresample=async=1:min_hard_comp=0.02"
# Part of a frame by which reading starts early: less than half, because ffmpeg rounds to the nearest frame.
_EARLY = Fraction(2, 5)
# Maximum duration in seconds of one frame of a video with a varying rate, when reading starts inside it.
_MAX_FRAME_DURATION = 5
# More threads wait for each other, and the search needs the cores.
_DECODER_THREADS = "2"
_TRUNCATED = re.compile(r"partial file|ended prematurely")


class Reader(Closing):
    """Frames of a source, in order: an iterator of ``(index, time, frame)`` and a context manager."""

    info: VideoInfo
    damage: str = ""
    """What is damaged in the source; known after the last frame, and empty if nothing is."""

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg, known after it has ended."""
        return 0.0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        raise NotImplementedError

    def kill(self) -> None:
        """End at once, from any thread; a thread that reads sees the end."""
        raise NotImplementedError

    def close(self) -> None:
        """End and release everything."""
        self.kill()


class _FfmpegStream(Closing):
    """A pipe to or from an ffmpeg process, which ends with the ``with`` block."""

    _process: Process

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg, known after it has ended."""
        return self._process.cpu_seconds

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads sees the end, one that writes an error."""
        self._process.kill()

    def close(self) -> None:
        """End ffmpeg if it is still running."""
        self._process.close()


class FrameReader(_FfmpegStream, Reader):
    """Frames of a video, in order: an iterator of ``(index, time, frame)`` and a context manager.

    ``index`` is the frame's number in the file from 0, ``time`` its time in seconds, ``frame`` a new
    ``(H, W, 3)`` uint8 RGB array. ffmpeg ends after the last frame, on :meth:`close`, at the end of a
    ``with`` block, and when the reader is deleted.

    Attributes
    ----------
    info
        Properties of the file.
    frames_read
        Number of frames read so far.
    damage
        Known after the last frame: what is damaged, such as missing frames, which is also logged as a
        warning; empty if nothing is. With ``strict`` it is raised as an error instead.
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
        options += ["-threads", _DECODER_THREADS, *pixel_limit(), *input_options(path)]
        options += ["-map", "0:V:0", "-vf", ",".join(filters)]
        if count is not None:
            options += ["-frames:v", str(count)]
        options += ["-fps_mode", "passthrough"]
        height, width = info.shape[:2]
        # Planes are read as stored and converted here, which takes half the time of reading RGB.
        even = height % 2 == 0 and width % 2 == 0
        self._in_planes = info.pixel_format in FORMATS and info.color_encoding.supported and even
        pixel_format = info.pixel_format if self._in_planes else "rgb24"
        self._buffer = np.empty((height * 3 // 2, width) if self._in_planes else info.shape, np.uint8)
        self._channels = np.empty((3, height, width), np.uint8)
        options += ["-pix_fmt", pixel_format, "-f", "rawvideo", "pipe:1"]
        self._process = Process(("-nostdin", *options), stdout=True)

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        if self._process.stdout.closed:
            raise StopIteration
        view = self._buffer.data.cast("B")
        done = 0
        while done < len(view):
            size = self._process.stdout.readinto(view[done:])
            if not size:
                self._finish()
                raise StopIteration
            done += size
        if self._in_planes:
            frame = rgb_from_planes(self._buffer, self.info.color_encoding, self._channels)
        else:
            frame = self._buffer.copy()
        index = self._first + self.frames_read
        self.frames_read += 1
        return index, float(index / self.info.fps), frame

    def _finish(self) -> None:
        """Close ffmpeg after its last frame; raise an error if frames are missing."""
        code = self._process.wait()
        log = self._process.log()
        self.close()
        if self._killed:
            return
        end, name = self._first + self.frames_read, source_name(self._path)
        complete = self._count is not None and self.frames_read >= self._count
        incomplete = ""
        if not complete:
            check_resources(name, code, log)
        if not complete and end < self.info.frames - 1 and _TRUNCATED.search(log):
            incomplete = f"{name} is incomplete: {end} of about {self.info.frames} frames can be decoded"
        if incomplete and not self.frames_read:
            start = float(self._first / self.info.fps)
            incomplete = f"{name} is incomplete: no frame after {start:g} s can be decoded"
        if incomplete and isinstance(self._path, str):  # the server or the network may be to blame
            raise video_error(f"{incomplete}; try again", self._path, code, log)
        if incomplete and self._whole:
            raise VideoError(f"{incomplete}; copy it again, or leave it out")
        if code and not complete and not incomplete:
            message = (
                f"{name} cannot be decoded after frame {end}: {exit_reason(code, log)}; "
                "if this happens again, copy the file again"
            )
            raise video_error(message, self._path, code, log)
        if not self.frames_read:
            start = float(self._first / self.info.fps)
            what = incomplete or f"{name} has no frame after {start:g} s"
            raise VideoError(f"{what}; choose an earlier start")
        # After a jump into the file, the first frames may refer to frames before it, which is no damage.
        errors = "" if self._sought else log
        stop = None if self._count is None else self._first + self._count
        self.damage = (
            f"{incomplete}; copy it again"
            if incomplete
            else find_damage(self._path, self.info, end, errors, stop=stop)
        )
        if self.damage and self._strict:
            raise VideoError(self.damage)
        if self.damage:
            _LOGGER.warning("%s", self.damage)

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads sees the end of the video."""
        self._killed = True  # not an error in the file
        super().kill()

    def __del__(self) -> None:
        if hasattr(self, "_process"):
            self.close()


@dataclass(frozen=True, kw_only=True)
class AudioSource:
    """Sound for a written video.

    Attributes
    ----------
    input
        Options of ffmpeg that open it.
    start
        Time of the first written frame in the file in seconds.
    audio_offset
        Time in the file that is ffmpeg's time 0; later than `start` if the sound starts later.
    length
        Maximum length in seconds; None for all.
    copyable
        Whether it may be copied without decoding: it is the whole track of one file.
    """

    input: tuple[str, ...]
    start: float = 0.0
    audio_offset: float = 0.0
    length: float | None = None
    copyable: bool = False


class FrameWriter(_FfmpegStream):
    """Writer of ``(H, W, 3)`` uint8 RGB frames as H.264 at a constant rate, with the audio of another file.

    H.264 that every player supports needs even sides, so odd ones are extended by one pixel, which repeats
    the last column or row.
    """

    def __init__(
        self,
        path: Path,
        info: VideoInfo,
        *,
        name: str,
        preset: str,
        audio: AudioSource | None = None,
    ) -> None:
        """Start ffmpeg, which writes to `path`; `name` names the video in errors."""
        container = CONTAINERS[path.suffix.lower()]
        self.frames_written = 0
        self._path, self._name, self._has_sound = path, name, audio is not None
        self._fps = info.fps
        width, height = info.width + info.width % 2, info.height + info.height % 2
        self._planes = np.empty((height * 3 // 2, width), np.uint8)
        self._channels = np.empty((3, height, width), np.uint8)
        video = ["-f", "rawvideo", "-pixel_format", "yuv420p", "-video_size", f"{width}x{height}"]
        video += ["-framerate", str(info.fps)]
        sound: list[str] = []
        mapped = ["-map", "0:v:0"]
        if audio is not None:
            lead = audio.start - audio.audio_offset
            sound += ["-ss", f"{audio.start:.6f}"] if lead > 0 else []
            sound += ["-itsoffset", f"{-lead:.6f}"] if lead < 0 else []
            sound += ["-vn", *audio.input]
            # Matroska has no times before 0, for the part of a packet before the first frame.
            copyable = audio.copyable and (lead <= 0 or container != "matroska")
            copied = copyable and info.audio_codec in _COPIED_AUDIO[container]
            mapped += ["-map", f"1:a:{info.audio_track}"]
            end = "" if audio.length is None else f",atrim=end={audio.length:.6f}"
            encoded = ["-c:a", "aac", "-b:a", "192k", "-af", _SYNCHRONIZED + end]
            mapped += ["-c:a", "copy"] if copied else encoded
        filters = "setparams=colorspace=smpte170m:color_primaries=bt709:color_trc=bt709:range=tv"
        encoder = ["-vf", filters, "-c:v", "libx264", "-preset", preset, "-fps_mode", "passthrough"]
        # Chapters and other metadata are those of the whole source, and its title and place may be private.
        self._muxer = ["-map_chapters", "-1", "-map_metadata", "-1", "-f", container]
        if container != "matroska":  # the index at the front lets a browser play while it downloads
            self._muxer += ["-movflags", "+faststart"]
        options = ["-y", *video, "-i", "pipe:0", *sound, *mapped, *encoder, *self._muxer, f"file:{path}"]
        self._process = Process(options, stdin=True)

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Send one frame to ffmpeg."""
        planes_from_rgb(frame, self._planes, self._channels)
        self.repeat()

    def repeat(self) -> None:
        """Send the last frame once more."""
        view = self._planes.data.cast("B")
        done = 0
        try:
            while done < len(view):
                done += self._process.stdin.write(view[done:])
        except OSError as error:
            raise self._error() from error
        self.frames_written += 1

    def finish(self, *, trim_sound: bool = False) -> None:
        """Wait until ffmpeg has written the last frame, and all of the sound.

        With `trim_sound`, for frames that end before the source does, the sound ends with them.
        """
        if not self.frames_written:
            raise VideoError("no frame was read, so no video was written")
        self._process.stdin.close()
        if self._process.wait():
            raise self._error()
        if trim_sound and self._has_sound:
            self._trim_sound()

    def _trim_sound(self) -> None:
        """Copy the file with the sound up to the end of the last frame."""
        seconds = float(self.frames_written / self._fps)
        whole = ("-i", f"file:{self._path}")
        with temporary_folder(self._path.parent, self._path.stem) as folder:
            trimmed = folder / self._path.name
            options = ["-nostdin", *whole, "-t", f"{seconds:.6f}", *whole, "-map", "0:v:0", "-map", "1:a:0"]
            self.close()
            self._process = Process([*options, "-c", "copy", *self._muxer, f"file:{trimmed}"])
            if self._process.wait():
                raise self._error()
            # Not renamed: other processes recognize a file in use by its lock.
            shutil.copyfile(trimmed, self._path)

    def _error(self) -> TransientVideoError:
        reason = exit_reason(self._process.wait(), self._process.log())
        return TransientVideoError(f"{self._name} cannot be written: {reason}; nothing of it was kept")
