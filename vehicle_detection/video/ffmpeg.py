"""ffmpeg processes, and the properties of a video file.

moviepy's own probe (2.2) rounds 59.94 frames/s and, with a current ffmpeg, ignores the rotation of phone
videos. This one reads the log of ffmpeg's filter graph, which has the exact rate and the upright size.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import IO, Any

from vehicle_detection._common import Limit, call_in_thread, hide_credentials
from vehicle_detection.errors import TransientVideoError, VideoError
from vehicle_detection.video.yuv import ColorEncoding

_PIPE_BYTES = 1 << 18
# Signals by which ffmpeg ends itself, because of the file.
_CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL}
# Messages of ffmpeg about a server, a connection or an expired signature, rather than about the video.
_NETWORK_FAULT = re.compile(
    r"Connection (refused|reset|timed out)|Operation timed out|Server returned (5|40[013]|429)"
    r"|Failed to resolve|Network is unreachable|No route to host|Input/output error|ends prematurely"
    r"|Broken pipe"
)
# Containers in which ffmpeg's time 0 is the start of the only stream that is read, not that of the file.
_OWN_STARTS = ("mpegts", "mpeg", "hls", "ogg")
_STREAM_START = r", start (-?[\d.]+)"
# Containers whose duration counts from time 0 instead of from the file's start.
_DURATION_IS_END = ("matroska,webm", "flv")
# Rate in Hz above which a rate may be that of a clock, or of frames that arrive in bursts.
_MAX_RATE = 60
NETWORK_TIMEOUT = 10.0
"""Seconds without data after which a server has failed."""


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Properties of a video file.

    Attributes
    ----------
    width, height
        Size of a frame in pixels, after the rotation stored in the file.
    fps
        Exact frame rate, such as 30000/1001; ``float(info.fps)`` is 29.97. If the file's rate varies, the
        constant rate to which its frames are converted.
    frames
        Number of frames, estimated from the duration; 0 if unknown.
    duration
        Length in seconds; 0.0 if unknown.
    rotation
        Clockwise rotation in degrees from the stored frames to upright ones.
    constant_rate
        Whether the file's frame rate is constant.
    start_time
        Time of the first frame in seconds after the file's start, if the sound starts earlier; otherwise 0.0.
    pixel_aspect
        Width over height of a pixel; other than 1 for anamorphic video.
    pixel_format
        ffmpeg's name of the pixel format, such as ``"yuv420p"``; empty if unknown.
    color_encoding
        How luma and chroma encode colors.
    container
        ffmpeg's names of the container format, such as ``"matroska,webm"``; empty if unknown.
    first_timestamp
        Timestamp of the first frame in seconds, as stored in the file.
    video_offset, audio_offset
        ffmpeg's time 0 in seconds after the file's start, if it reads only that stream. It is the start of
        the stream in MPEG-TS and similar containers, and 0.0 in others.
    audio_track, audio_codec
        Index and codec (such as ``"aac"``) of the first audio track that can be decoded; None without one.
    audio_format
        Stream number, codec, rate and channels of that track, as ffmpeg prints them; empty without one.

    Examples
    --------
    >>> info = VideoInfo(width=1280, height=720, fps=Fraction(30000, 1001), frames=60, duration=2.002)
    >>> info.shape, info.has_audio
    ((720, 1280, 3), False)
    """

    width: int
    height: int
    fps: Fraction
    frames: int
    duration: float
    rotation: int = 0
    constant_rate: bool = True
    start_time: float = 0.0
    pixel_aspect: Fraction = Fraction(1)
    pixel_format: str = ""
    color_encoding: ColorEncoding = field(default_factory=ColorEncoding)
    container: str = ""
    first_timestamp: float = 0.0
    video_offset: float = 0.0
    audio_offset: float = 0.0
    audio_track: int | None = None
    audio_codec: str | None = None
    audio_format: tuple[str, ...] = ()

    @property
    def has_audio(self) -> bool:
        """Whether there is a decodable audio track."""
        return self.audio_track is not None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a frame: ``(height, width, 3)``."""
        return (self.height, self.width, 3)


def input_options(path: Path | str) -> tuple[str, ...]:
    """Return the options of ffmpeg that open a file, or a URL, whose connection is repaired if it breaks."""
    if isinstance(path, Path):
        return ("-i", f"file:{path}")
    limit = ("-rw_timeout", f"{NETWORK_TIMEOUT * 1e6:.0f}")
    return (*limit, "-reconnect", "1", "-reconnect_delay_max", "4", "-i", path)


def source_name(path: Path | str) -> str:
    """Name of a file or URL in messages."""
    return str(path) if isinstance(path, Path) else hide_credentials(path)


def probe(path: Path | str) -> VideoInfo:
    """Read the properties of a video and decode its first frame; raise a VideoError if there is none."""
    # Python raises KeyboardInterrupt in the main thread only; another thread cannot lose the started process.
    return call_in_thread(lambda: _probe(path))


def _probe(path: Path | str) -> VideoInfo:
    # "V" excludes cover pictures. Only the showinfo filter prints the exact frame rate.
    options = ("-map", "0:V:0", "-frames:v", "1", "-vf", "showinfo", "-f", "null", "-")
    source = ("-nostdin", *pixel_limit(), *input_options(path))
    name = source_name(path)
    with contextlib.closing(Process((*source, *options), level="info")) as process:
        code = process.wait()
        log = process.log()
    if code < 0:
        raise video_error(f"{name} cannot be read: {exit_reason(code, log)}", path, code, log)
    check_frame_size(name, log)
    header, mapped, decoded = log.partition("Stream mapping:")
    container = re.search(r"^Input #0, (\S+),", header, re.MULTILINE)
    if container is None:
        if _is_text(Path(path)):
            raise VideoError(f"{name} is a text file, not a video; choose the video")
        truncated = "moov atom not found" in log
        reason = "its index is missing: the recording or copy is incomplete" if truncated else last_line(log)
        message = f"{name} is not a video that ffmpeg can read ({reason}); record or copy it again"
        raise video_error(message, path, code, log)
    if not mapped:
        raise VideoError(f"{name} has no video track; choose a file with one")
    frame = re.search(r"n: *0 .*?pts_time:(\S+).*? sar:(\d+)/(\d+) s:(\d+)x(\d+)", decoded)
    if frame is None:
        message = f"{name} has no frame that can be decoded ({last_line(log)}); copy it again"
        raise video_error(message, path, code, log)
    width, height = int(frame[4]), int(frame[5])
    aspect = int(frame[2]), int(frame[3])
    pixel_format = re.search(r"n: *0 .*? fmt:(\w+)", decoded)
    colors = re.search(r"color_range:(\w+) color_space:(\w+)", decoded)
    index = re.search(r"Stream #0:(\d+)", decoded)
    stream = _stream_lines(header, int(index[1]) if index else 0)
    fps, constant = frame_rate(decoded, stream)
    stated = re.search(r"^  Duration: (\d+):(\d+):([\d.]+)", header, re.MULTILINE)
    duration = int(stated[1]) * 3600 + int(stated[2]) * 60 + float(stated[3]) if stated else 0.0
    begin = _number(r"^  Duration: .*?, start: (-?[\d.]+)", header)
    if container[1] in _DURATION_IS_END:
        duration = max(duration - begin, 0.0)
    if container[1] == "matroska,webm":  # its header may state a wrong rate
        fps, constant = _rate_of_times(fps, _frame_times(path))
    rotation = re.search(r"rotation of (-?[\d.]+) degrees", stream)
    audio = re.findall(r"^  Stream #0:(\d+).*?: Audio: (\w+)(.*)", header, re.MULTILINE)
    track = next((number for number, (_, codec, _) in enumerate(audio) if codec != "none"), None)
    video_offset, audio_offset = 0.0, 0.0
    if container[1] in _OWN_STARTS:
        video_offset = _number(_STREAM_START, stream, begin) - begin
        audio_offset = 0.0 if track is None else _number(_STREAM_START, audio[track][2], begin) - begin
    # With a varying rate, the gap before the first frame is filled with copies of it.
    start_time = float(frame[1]) if constant and frame[1][-1].isdigit() else 0.0
    start_time += video_offset
    # The duration in AVI files is that of the frames.
    length = duration if container[1] == "avi" else max(duration - start_time, 0.0)
    sound = re.search(r", (\d+) Hz, ([^,]+)", audio[track][2]) if track is not None else None
    return VideoInfo(
        width=width,
        height=height,
        fps=fps,
        frames=round(length * fps),
        duration=duration,
        rotation=round(-float(rotation[1])) % 360 if rotation else 0,
        constant_rate=constant,
        start_time=start_time,
        pixel_aspect=Fraction(*aspect) if all(aspect) else Fraction(1),
        pixel_format=pixel_format[1] if pixel_format else "",
        color_encoding=ColorEncoding(colors[2], colors[1] == "pc") if colors else ColorEncoding(),
        container=container[1],
        first_timestamp=begin + start_time,
        video_offset=video_offset,
        audio_offset=audio_offset,
        audio_track=track,
        audio_codec=None if track is None else audio[track][1],
        audio_format=() if track is None else (*audio[track][:2], *(sound.groups() if sound else ())),
    )


def _number(pattern: str, text: str, default: float = 0.0) -> float:
    """Return the number that a pattern's group finds."""
    found = re.search(pattern, text, re.MULTILINE)
    return float(found[1]) if found else default


def _is_text(path: Path) -> bool:
    """Whether a file starts with UTF-8 text, such as a saved web page or a pointer to large-file storage."""
    try:
        with path.open("rb") as file:
            start = file.read(512)
    except OSError:
        return False
    text = start.decode("utf-8", "ignore")
    control = sum(ord(letter) < 32 and letter not in "\t\n\r\f" for letter in text)
    return bool(start) and not control and len(text.encode()) >= len(start) - 3


def _stream_lines(header: str, index: int) -> str:
    """Lines of ffmpeg's log that describe one stream of a file."""
    for block in re.split(r"^(?=  Stream #)", header, flags=re.MULTILINE):
        if re.match(rf"  Stream #0:{index}\b", block):
            return block
    return ""


def frame_rate(decoded: str, stream: str) -> tuple[Fraction, bool]:
    """Frame rate, and whether it is constant, from ffmpeg's log."""
    exact = re.search(r"frame_rate: (\d+)/(\d+)", decoded)
    printed = re.search(r"([\d.]+)(k?) fps", stream)
    mean = Fraction(printed[1]) * (1000 if printed[2] else 1) if printed else Fraction(0)
    rate = Fraction(int(exact[1]), int(exact[2])) if exact and int(exact[1]) and int(exact[2]) else mean
    if not rate:
        return Fraction(25), False
    # Tolerance: ffmpeg prints the mean rate with two decimals.
    constant = not mean or abs(rate - mean) <= Fraction(6, 1000)
    return (rate if constant else _resampling_rate(rate, mean)), constant


def _frame_times(path: Path | str) -> list[float]:
    """List the times of all frames in seconds, without decoding them."""
    options = ("-nostdin", *input_options(path), "-map", "0:V:0", "-c", "copy", "-f", "framecrc", "pipe:1")
    with contextlib.closing(Process(options, stdout=True)) as process:
        listing = process.stdout.read().decode()
        process.wait()
    unit = re.search(r"^#tb 0: (\d+)/(\d+)", listing, re.MULTILINE)
    ticks = re.findall(r"^0, +-?\d+, +(-?\d+),", listing, re.MULTILINE)
    return sorted(int(tick) * int(unit[1]) / int(unit[2]) for tick in ticks) if unit else []


def _rate_of_times(rate: Fraction, times: Sequence[float]) -> tuple[Fraction, bool]:
    """Frame rate, and whether it is constant, from a nominal rate and the times of all frames."""
    if all(abs((moment - times[0]) * float(rate) - n) < 0.75 for n, moment in enumerate(times)):
        return rate, True
    mean = Fraction((len(times) - 1) / ((times[-1] - times[0]) or 1.0))
    # A nominal rate that is the mean over gaps would drop frames between them.
    steps = [after - before for before, after in itertools.pairwise(times)]
    usual = [step for step in steps if step < 1.5 * statistics.median(steps)]
    without_gaps = Fraction(len(usual) / (sum(usual) or 1.0))
    if Fraction(101, 100) * rate < without_gaps <= _MAX_RATE:
        return without_gaps.limit_denominator(1001), False
    return _resampling_rate(rate, mean), False


def _resampling_rate(rate: Fraction, mean: Fraction) -> Fraction:
    """Choose the constant rate for a varying one; screen recorders state their 1000 Hz clock as the rate."""
    return mean.limit_denominator(1001) if rate > _MAX_RATE and rate > 2 * mean else rate


def pixel_limit() -> tuple[str, str]:
    """Options that limit the size of decoded frames."""
    return "-max_pixels", str(min(Limit.PIXELS.current(), 2**31 - 1))


def check_frame_size(name: str, log: str) -> None:
    """Raise a VideoError if ffmpeg has refused frames because of `pixel_limit`."""
    too_large = re.search(r"Picture size (\d+)x(\d+) exceeds specified max pixel count", log)
    if too_large:
        raise VideoError(
            f"{name} has frames of {too_large[1]}x{too_large[2]} pixels, more than "
            f"{Limit.PIXELS.current():,}; if they are meant to be so large, set {Limit.PIXELS.variable}"
        )


def ffmpeg_binary() -> str:
    """Return the ffmpeg that moviepy uses, without importing moviepy, which takes half a second."""
    config = sys.modules.get("moviepy.config")
    if config is not None:
        return str(config.FFMPEG_BINARY)
    chosen = os.environ.get("FFMPEG_BINARY", "ffmpeg-imageio")
    if chosen == "auto-detect":
        return shutil.which("ffmpeg") or "ffmpeg"
    if chosen != "ffmpeg-imageio":
        return chosen
    from imageio_ffmpeg import get_ffmpeg_exe

    return str(get_ffmpeg_exe())


@functools.cache
def _death_signal() -> tuple[str, ...]:
    """Return a command prefix that makes Linux kill the command when the thread that started it ends.

    A killed Python cannot end its ffmpeg: one that reads frames from it would first write the whole sound.
    ``setpriv`` is part of util-linux. Where it is missing, ffmpeg ends when its pipe does.
    """
    program = shutil.which("setpriv") if sys.platform == "linux" else None
    if program is None:
        return ()
    command = (program, "--pdeathsig", "KILL")
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        # BusyBox has a setpriv without this option.
        if subprocess.run((*command, "true"), capture_output=True, timeout=10).returncode == 0:
            return command
    return ()


class _Starter:
    """Starts processes in one thread that lives as long as Python.

    The death signal follows the end of the thread that started a process, not that of Python.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
        """Start a process, which is killed when Python ends in whatever way."""
        with self._lock:
            self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="ffmpeg-starter")
            future = self._pool.submit(self._start, command, options)
        try:
            return future.result()
        except BaseException:  # also KeyboardInterrupt: nobody else knows the process
            future.add_done_callback(_kill_started)
            raise

    @staticmethod
    def _start(command: Sequence[str], options: Mapping[str, Any]) -> subprocess.Popen[bytes]:
        program = shutil.which(command[0]) or command[0]
        # setpriv would report a missing program by its exit code only.
        prefix = _death_signal() if os.access(program, os.X_OK) else ()
        return subprocess.Popen([*prefix, program, *command[1:]], **options)


def _kill_started(future: Future[subprocess.Popen[bytes]]) -> None:
    if not future.cancelled() and future.exception() is None:
        process = future.result()
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


_STARTER = _Starter()
if hasattr(os, "register_at_fork"):
    # The thread does not exist in a forked child.
    os.register_at_fork(after_in_child=_STARTER.__init__)  # type: ignore[misc]


class Process:
    """A running ffmpeg. Its log goes to a file, because a full pipe would block it."""

    def __init__(
        self,
        options: Sequence[str],
        *,
        level: str = "error",
        stdin: bool | int = False,
        stdout: bool = False,
    ) -> None:
        """Start ffmpeg; `stdin` is True for a pipe to it, or the descriptor of a file that it reads."""
        # In its own process group, so that Ctrl-C in the terminal reaches only Python, which ends ffmpeg. Not
        # in its own session: Linux schedules by session, which costs a third of the speed on a busy machine.
        group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        self.cpu_seconds = 0.0
        """Processor time, known after the process has ended, on systems that report it."""
        self._lock = threading.Lock()
        with contextlib.ExitStack() as on_error:
            self._log = on_error.enter_context(tempfile.TemporaryFile())
            try:
                self._popen: subprocess.Popen[bytes] = _STARTER.start(
                    [ffmpeg_binary(), "-hide_banner", "-loglevel", level, *options],
                    stdin=(subprocess.PIPE if stdin else subprocess.DEVNULL)
                    if isinstance(stdin, bool)
                    else stdin,
                    stdout=subprocess.PIPE if stdout else subprocess.DEVNULL,
                    stderr=self._log,
                    bufsize=0,
                    **group,
                )
            except (OSError, ValueError) as error:
                raise TransientVideoError(
                    f"ffmpeg cannot be started ({error}); reinstall imageio-ffmpeg or unset FFMPEG_BINARY"
                ) from error
            on_error.pop_all()
        # None unless requested.
        self.stdin: Any = self._popen.stdin
        self.stdout: Any = self._popen.stdout
        for pipe in (self.stdin, self.stdout):
            _enlarge(pipe)

    def wait(self) -> int:
        """Wait until the process has ended and return its exit code."""
        if sys.platform == "win32":
            return self._popen.wait()
        # wait4 reports the processor time. It must not block while it holds the lock that `kill` needs.
        while True:
            with self._lock:
                if self._popen.returncode is None:
                    pid, status, usage = os.wait4(self._popen.pid, os.WNOHANG)
                    if pid:
                        self._popen.returncode = os.waitstatus_to_exitcode(status)
                        self.cpu_seconds = usage.ru_utime + usage.ru_stime
                if self._popen.returncode is not None:
                    return self._popen.returncode
            time.sleep(0.002)

    def kill(self) -> None:
        """End the process at once; threads that read from it or write to it stop waiting."""
        with self._lock:
            if self._popen.returncode is None:
                self._popen.kill()

    def close(self) -> None:
        """End the process if it is still running, and close its pipes."""
        self.kill()
        self.wait()
        for stream in (self.stdin, self.stdout, self._log):
            if stream is not None:
                stream.close()

    def log(self) -> str:
        """Return the log, or its last 256 KiB, without the passwords of URLs."""
        size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, size - (1 << 18)))
        return hide_credentials(self._log.read().decode("utf-8", "replace"))


def _enlarge(pipe: IO[bytes] | None) -> None:
    """Enlarge the buffer of a pipe on Linux, for fewer context switches per frame."""
    if pipe is not None and sys.platform == "linux":
        import fcntl

        with contextlib.suppress(OSError):  # limited for unprivileged users; the default of 64 KiB works too
            fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def exit_reason(code: int, log: str) -> str:
    """Say why ffmpeg has ended, from its exit code and its log."""
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        if -code in _CRASHES:
            return f"ffmpeg has crashed ({name})"
        if name == "SIGXFSZ":
            return "the file would exceed the limit of the system for the size of a file (ulimit -f)"
        hint = ", perhaps because memory ran out" if name == "SIGKILL" else ""
        return f"another process ended ffmpeg by the signal {name}{hint}"
    hint = "; free some disk space" if "No space left" in log else ""
    return f"ffmpeg reports {last_line(log)!r}{hint}"


def video_error(message: str, source: Path | str, code: int, log: str) -> VideoError:
    """Return the error of a failed ffmpeg: transient if it was killed, or a server did not answer."""
    killed = code < 0 and -code not in _CRASHES
    offline = isinstance(source, str) and _NETWORK_FAULT.search(log) is not None
    return TransientVideoError(message) if killed or offline else VideoError(message)


def last_line(log: str) -> str:
    """Last message of ffmpeg's log, without the prefix ``[component @ address]``."""
    lines = [re.sub(r"^(\[[^\]]*\] *)+", "", line).strip() for line in log.splitlines()]
    return next((line for line in reversed(lines) if line), "no reason given")
