"""The ffmpeg binary that moviepy uses: a process of it that ends with us, and the facts of a video file.

moviepy's own probe (2.2) rounds 59.94 frames/s and, with a current ffmpeg, overlooks the rotation of phone
videos; this one asks ffmpeg's filter graph, which knows the exact rate and the upright size.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import IO, Any

from vehicle_detection.errors import VideoError
from vehicle_detection.video.yuv import Coding

PIPE_SIZE = 1 << 18


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Facts of a video file.

    Attributes
    ----------
    width, height
        Size in pixels of an upright frame: a rotation that the file asks for is already applied.
    fps
        Exact frame rate, as 30000/1001; ``float(info.fps)`` is 29.97. For a file whose rate varies, the rate
        that its frames are brought to.
    frames
        Number of frames, estimated from the duration; 0 where the file does not tell.
    duration
        Length in seconds; 0.0 where the file does not tell.
    rotation
        Clockwise degrees by which the stored frames are turned to stand upright.
    constant_rate
        Whether the frames come at a constant rate.
    first_time
        Second at which the first frame is shown, where the sound starts earlier; else 0.0.
    pixel_aspect
        Width over height of a pixel; 1 but for anamorphic video.
    pixel_format
        ffmpeg's name of how pixels are stored, as ``"yuv420p"``; empty where it is not known.
    coding
        How the numbers of a pixel mean colors.
    audio_track, audio_codec
        Number among the audio tracks, and codec (``"aac"``), of the first that can be decoded; else None.
    """

    width: int
    height: int
    fps: Fraction
    frames: int
    duration: float
    rotation: int = 0
    constant_rate: bool = True
    first_time: float = 0.0
    pixel_aspect: Fraction = Fraction(1)
    pixel_format: str = ""
    coding: Coding = field(default_factory=Coding)
    audio_track: int | None = None
    audio_codec: str | None = None

    @property
    def has_audio(self) -> bool:
        """Whether there is an audio track that can be decoded."""
        return self.audio_track is not None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a frame: ``(height, width, 3)``."""
        return (self.height, self.width, 3)


def probe(path: Path) -> VideoInfo:
    """Ask ffmpeg for the facts of a video, decoding its first frame; :class:`VideoError` if it is none."""
    # In a thread, where Ctrl-C cannot strike between the start of ffmpeg and the moment when we hold it.
    with ThreadPoolExecutor(1, thread_name_prefix="vehicle-probe") as helper:
        return helper.submit(_probe, path).result()


def _probe(path: Path) -> VideoInfo:
    # V leaves out cover pictures; showinfo is the one place where ffmpeg prints the exact rate.
    options = ("-map", "0:V:0", "-frames:v", "1", "-vf", "showinfo", "-f", "null", "-")
    with contextlib.closing(Process(("-nostdin", "-i", f"file:{path}", *options), level="info")) as process:
        process.wait()
        log = process.log()
    header, mapped, decoded = log.partition("Stream mapping:")
    if not re.search(r"^Input #0", header, re.MULTILINE):
        cut = "moov atom not found" in log
        reason = "its index is missing: the recording or the copy was cut off" if cut else last_line(log)
        raise VideoError(f"{path} is no video that ffmpeg can read ({reason}); record or copy it again")
    if not mapped:
        raise VideoError(f"{path} has no video track; pass a file with moving pictures")
    frame = re.search(r"n: *0 .*?pts_time:(\S+).*? sar:(\d+)/(\d+) s:(\d+)x(\d+)", decoded)
    if frame is None:
        raise VideoError(f"{path} has no frame that can be decoded ({last_line(log)}); copy it again")
    first_time, width, height = frame[1], int(frame[4]), int(frame[5])
    pixel = int(frame[2]), int(frame[3])
    pixels = re.search(r"n: *0 .*? fmt:(\w+)", decoded)
    colors = re.search(r"color_range:(\w+) color_space:(\w+)", decoded)
    number = re.search(r"Stream #0:(\d+)", decoded)
    stream = _stream_lines(header, int(number[1]) if number else 0)
    fps, constant = _frame_rate(decoded, stream)
    if re.search(r"^Input #0, matroska", header, re.MULTILINE):  # its header's rate is a wish
        fps, constant = _true_rate(fps, _frame_times(path))
    span = re.search(r"^  Duration: (\d+):(\d+):([\d.]+)", header, re.MULTILINE)
    duration = int(span[1]) * 3600 + int(span[2]) * 60 + float(span[3]) if span else 0.0
    turn = re.search(r"rotation of (-?[\d.]+) degrees", stream)
    codecs = re.findall(r"^  Stream #0:\d+.*?: Audio: (\w+)", header, re.MULTILINE)
    track = next((place for place, codec in enumerate(codecs) if codec != "none"), None)
    return VideoInfo(
        width=width,
        height=height,
        fps=fps,
        frames=round(duration * fps),
        duration=duration,
        rotation=round(-float(turn[1])) % 360 if turn else 0,
        constant_rate=constant,
        # The frames of a varying rate are filled up from 0 on.
        first_time=float(first_time) if constant and first_time[-1].isdigit() else 0.0,
        pixel_aspect=Fraction(*pixel) if all(pixel) else Fraction(1),
        pixel_format=pixels[1] if pixels else "",
        coding=Coding(colors[2], colors[1] == "pc") if colors else Coding(),
        audio_track=track,
        audio_codec=None if track is None else codecs[track],
    )


def _stream_lines(header: str, number: int) -> str:
    """Take the lines that describe one stream out of ffmpeg's description of a file."""
    for block in re.split(r"^(?=  Stream #)", header, flags=re.MULTILINE):
        if re.match(rf"  Stream #0:{number}\b", block):
            return block
    return ""


def _frame_rate(decoded: str, stream: str) -> tuple[Fraction, bool]:
    """Return the exact rate, and whether the frames really come at it, from what ffmpeg says."""
    exact = re.search(r"frame_rate: (\d+)/(\d+)", decoded)
    printed = re.search(r"([\d.]+)(k?) fps", stream)
    mean = Fraction(printed[1]) * (1000 if printed[2] else 1) if printed else Fraction(0)
    rate = Fraction(int(exact[1]), int(exact[2])) if exact and int(exact[1]) and int(exact[2]) else mean
    if not rate:
        return Fraction(25), False
    # ffmpeg prints the mean rate with two decimals.
    constant = not mean or abs(rate - mean) <= Fraction(6, 1000)
    return (rate if constant else _sensible_rate(rate, mean)), constant


def _frame_times(path: Path) -> list[float]:
    """List the seconds of all frames, without decoding them."""
    options = ("-nostdin", "-i", f"file:{path}", "-map", "0:V:0", "-c", "copy", "-f", "framecrc", "pipe:1")
    with contextlib.closing(Process(options, stdout=True)) as process:
        listing = process.stdout.read().decode()
        process.wait()
    unit = re.search(r"^#tb 0: (\d+)/(\d+)", listing, re.MULTILINE)
    ticks = re.findall(r"^0, +-?\d+, +(-?\d+),", listing, re.MULTILINE)
    return sorted(int(tick) * int(unit[1]) / int(unit[2]) for tick in ticks) if unit else []


def _true_rate(rate: Fraction, times: Sequence[float]) -> tuple[Fraction, bool]:
    """Return the rate at which frames are to be shown, and whether they come at it."""
    steps = float(rate)
    if all(abs((moment - times[0]) * steps - n) < 0.75 for n, moment in enumerate(times)):
        return rate, True
    return _sensible_rate(rate, Fraction((len(times) - 1) / ((times[-1] - times[0]) or 1.0))), False


def _sensible_rate(rate: Fraction, mean: Fraction) -> Fraction:
    """Choose a rate for frames that have none: screen recorders call a clock of 1000 ticks theirs."""
    return mean.limit_denominator(1001) if rate > 60 and rate > 2 * mean else rate


class Process:
    """A running ffmpeg. Its messages go to a file: no pipe of them can fill up and block it."""

    def __init__(
        self, options: Sequence[str], *, level: str = "error", stdin: bool = False, stdout: bool = False
    ) -> None:
        from moviepy.config import FFMPEG_BINARY  # the binary that the user told moviepy to take

        # A group of its own: Ctrl-C in the terminal reaches Python alone, which ends ffmpeg. No session of
        # its own: Linux shares out the processor by session, and on a busy machine that costs a third.
        group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        self.cpu_seconds = 0.0
        """Processor time, once the process has ended, where the system tells."""
        self._reaping = threading.Lock()
        with contextlib.ExitStack() as on_error:
            self._log = on_error.enter_context(tempfile.TemporaryFile())
            try:
                self._popen: subprocess.Popen[bytes] = subprocess.Popen(
                    [FFMPEG_BINARY, "-hide_banner", "-loglevel", level, *options],
                    stdin=subprocess.PIPE if stdin else subprocess.DEVNULL,
                    stdout=subprocess.PIPE if stdout else subprocess.DEVNULL,
                    stderr=self._log,
                    bufsize=0,
                    **group,
                )
            except OSError as error:
                raise VideoError(
                    f"ffmpeg cannot be started ({error}); reinstall imageio-ffmpeg or unset FFMPEG_BINARY"
                ) from error
            on_error.pop_all()
        for pipe in (self._popen.stdin, self._popen.stdout):
            _widen(pipe)

    @property
    def stdin(self) -> IO[bytes]:
        """The pipe into the process."""
        assert self._popen.stdin is not None
        return self._popen.stdin

    @property
    def stdout(self) -> IO[bytes]:
        """The pipe out of the process."""
        assert self._popen.stdout is not None
        return self._popen.stdout

    def wait(self) -> int:
        """Wait for the end of the process and return its code."""
        if sys.platform == "win32":
            return self._popen.wait()
        # wait4 tells the processor time. It must not block with the lock in hand: another thread may kill.
        while True:
            with self._reaping:
                if self._popen.returncode is None:
                    pid, status, usage = os.wait4(self._popen.pid, os.WNOHANG)
                    if pid:
                        self._popen.returncode = os.waitstatus_to_exitcode(status)
                        self.cpu_seconds = usage.ru_utime + usage.ru_stime
                if self._popen.returncode is not None:
                    return self._popen.returncode
            time.sleep(0.002)

    def kill(self) -> None:
        """End the process at once, which also wakes a thread that reads from it or writes to it."""
        with self._reaping:
            if self._popen.returncode is None:
                self._popen.kill()

    def close(self) -> None:
        """End the process if it still runs, and close its pipes."""
        self.kill()
        self.wait()
        for stream in (self._popen.stdin, self._popen.stdout, self._log):
            if stream is not None:
                stream.close()

    def log(self) -> str:
        """Return the messages, or the last of them where a damaged file makes very many."""
        size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, size - (1 << 18)))
        return self._log.read().decode("utf-8", "replace")


def _widen(pipe: IO[bytes] | None) -> None:
    """Give a pipe the room of a part of a frame, where the system can: fewer switches to and fro."""
    if pipe is not None and sys.platform == "linux":
        import fcntl

        with contextlib.suppress(OSError):  # an unprivileged user has only so much; 64 kB work too
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_SIZE)


def last_line(log: str) -> str:
    """Take the last message out of ffmpeg's log, without the `[part @ address]` in front."""
    lines = [re.sub(r"^(\[[^\]]*\] *)+", "", line).strip() for line in log.splitlines()]
    return next((line for line in reversed(lines) if line), "no reason given")
