"""Running ffmpeg: its processes, options and messages."""

from __future__ import annotations

import contextlib
import errno
import functools
import math
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import IO, Any

from numpy.typing import NDArray

from vehicle_detection._common import (
    NETWORK_DEADLINE,
    NETWORK_TIMEOUT,
    REFUSED,
    Limit,
    call_in_thread,
    hide_credentials,
    is_web_address,
    web_proxy,
)
from vehicle_detection.errors import TransientVideoError, VideoError

_PIPE_BYTES = 1 << 18
# Free bytes below which the folder of temporary files is full.
_FULL = 1 << 16
# Signals by which ffmpeg ends itself, because of the file.
_CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGILL}
# Messages of ffmpeg about a server, a connection or an expired signature, rather than about the video.
_NETWORK_FAULT = re.compile(
    r"Connection (refused|reset|timed out)|Operation timed out|Server returned (5|40[013]|429)"
    r"|Failed to resolve|Network is unreachable|No route to host|Input/output error|ends prematurely"
    r"|Broken pipe"
)
# Errors of the system that refuses memory, processes or open files.
_LIMITS = {errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE}
_RAISE_LIMITS = "close other programs, or raise the limits of this process (ulimit), and try again"
# Messages of ffmpeg about threads or open files that the system refuses.
_SYSTEM_FAULT = re.compile(r"^.*(Resource temporarily unavailable|Too many open files).*$", re.MULTILINE)
# Lines that follow the messages about errors.
_STATISTICS = re.compile(r"Conversion failed!|frame= |video:")
_NO_MEMORY = "Cannot allocate memory"


# Formats that hold a video or a sound. Others, such as lists and manifests, name further files to read.
_FORMATS = (
    "mov,matroska,avi,mpegts,mpegtsraw,mpeg,mpegvideo,flv,live_flv,asf,ogg,mxf,gxf,nut,wtv,rm,dv,dhav,nsv,kux,mtv,"
    "h261,h263,h264,hevc,vvc,m4v,av1,obu,ivf,vc1,avs2,avs3,mjpeg,mjpeg_2000,mpjpeg,rawvideo,yuv4mpegpipe,gif,apng,"
    "webp_anim,jpeg_pipe,png_pipe,bmp_pipe,webp_pipe,tiff_pipe,wav,mp3,aac,ac3,flac,aiff"
)
_NETWORK = (
    "http,https,httpproxy,tls,tcp,udp,rtp,srtp,srt,crypto,rtmp,rtmps,rtmpt,rtmpts,rtmpe,rtmpte,ffrtmphttp,"
    "ffrtmpcrypt"
)


def restrict_input(protocols: str, formats: str = "") -> tuple[str, ...]:
    """Return the options of ffmpeg that let its next input open files or servers by some protocols only."""
    return ("-protocol_whitelist", protocols, "-format_whitelist", _FORMATS + formats)


def input_options(path: Path | str) -> tuple[str, ...]:
    """Return the options of ffmpeg that open a file, or a URL, whose connection is repaired if it breaks."""
    if isinstance(path, Path):
        return (*restrict_input("file"), "-i", f"file:{path}")
    limit = ("-rw_timeout", f"{NETWORK_TIMEOUT * 1e6:.0f}")
    return (*limit, "-reconnect", "1", "-reconnect_delay_max", "4", *network_options(path))


def network_options(url: str) -> tuple[str, ...]:
    """Return the options of ffmpeg that open a URL, which may be that of a playlist at an HTTP server."""
    if not is_web_address(url):
        return (*restrict_input(_NETWORK, ",rtsp,rtp"), "-i", url)
    proxy = web_proxy(url)
    options = restrict_input(f"{_NETWORK},data", ",hls,dash")
    return (*options, *(("-http_proxy", proxy) if proxy else ()), "-i", url)


def source_name(path: Path | str) -> str:
    """Name of a file or URL in messages."""
    return str(path) if isinstance(path, Path) else hide_credentials(path.replace(" ", "%20"))


SQUARE_PIXELS = "scale=w='if(gt(abs(sar-1),0.02)*between(sar,1/3,3),round(iw*sar/2)*2,iw)':h=ih"
"""ffmpeg's filter that stretches anamorphic frames to square pixels, with an even width as H.264 requires.

Ratios near 1, such as 4095:4096, count as square, and so do wild ones, which come from damaged headers.
"""


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


def check_resources(name: str, code: int, log: str) -> None:
    """Raise a TransientVideoError if ffmpeg has failed for lack of memory, threads or open files."""
    refused = bool(_SYSTEM_FAULT.search(log))
    # Damaged tables of a file ask for any amount of memory, too.
    short = _is_memory_limited() and (-code in _CRASHES or _NO_MEMORY in log)
    if code and (refused or short):
        raise TransientVideoError(f"{name} cannot be read: {exit_reason(code, log)}; {_RAISE_LIMITS}")


def _is_memory_limited() -> bool:
    """Whether the address space is limited; ffmpeg then crashes when it runs out of it."""
    try:
        import resource
    except ImportError:  # Windows
        return False
    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


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

    try:
        return str(get_ffmpeg_exe())
    except RuntimeError as error:  # the wheel for this platform has no program
        raise TransientVideoError(
            "no ffmpeg program was found; install ffmpeg, or set FFMPEG_BINARY to its path"
        ) from error


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
        started: list[Future[subprocess.Popen[bytes]]] = []

        def submit_and_wait() -> None:
            with self._lock:
                self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="ffmpeg-starter")
                started.append(self._pool.submit(self._start, command, options))
            wait(started)

        try:
            call_in_thread(submit_and_wait)
            return started[0].result()
        except BaseException:  # also KeyboardInterrupt: nobody else knows the process
            for future in started:
                _kill_started(future)
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
        stdin: int = subprocess.DEVNULL,
        stdout: bool = False,
    ) -> None:
        """Start ffmpeg; `stdin` is a descriptor that it reads, or ``subprocess.PIPE`` for a pipe to it."""
        # In its own process group, so that Ctrl-C in the terminal reaches only Python, which ends ffmpeg. Not
        # in its own session: Linux schedules by session, which costs a third of the speed on a busy machine.
        group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        nostdin = ["-nostdin"] if stdin == subprocess.DEVNULL else []
        if "-http_proxy" in options:  # also for hosts in no_proxy, and for what a playlist names
            kept = {name: value for name, value in os.environ.items() if name.lower() != "no_proxy"}
            group["env"] = kept | {"http_proxy": options[options.index("-http_proxy") + 1]}
        self.cpu_seconds = 0.0
        """Processor time, known after the process has ended, on systems that report it."""
        self._lock = threading.Lock()
        with contextlib.ExitStack() as on_error:
            self._log = on_error.enter_context(tempfile.TemporaryFile())
            try:
                self._popen: subprocess.Popen[bytes] = _STARTER.start(
                    [ffmpeg_binary(), "-hide_banner", "-loglevel", level, *nostdin, *options],
                    stdin=stdin,
                    stdout=subprocess.PIPE if stdout else subprocess.DEVNULL,
                    stderr=self._log,
                    bufsize=0,
                    **group,
                )
            except (OSError, ValueError, RuntimeError) as error:  # a RuntimeError: no thread can be started
                limited = isinstance(error, RuntimeError) or getattr(error, "errno", None) in _LIMITS
                remedy = "reinstall imageio-ffmpeg or unset FFMPEG_BINARY"
                raise TransientVideoError(
                    f"ffmpeg cannot be started ({error}); {_RAISE_LIMITS if limited else remedy}"
                ) from error
            on_error.pop_all()
        # None unless requested.
        self.stdin: Any = self._popen.stdin
        self.stdout: Any = self._popen.stdout
        for pipe in (self.stdin, self.stdout):
            _enlarge(pipe)

    def wait(self, timeout: float = math.inf) -> int:
        """Wait until the process has ended, or kill it after some seconds, and return its exit code.

        The code is 0 where SIGCHLD is ignored and the system keeps no code, so outputs need a check.
        """
        if sys.platform == "win32":
            with contextlib.suppress(subprocess.TimeoutExpired):
                return self._popen.wait(None if math.isinf(timeout) else timeout)
            self.kill()
            return self._popen.wait()
        end = time.monotonic() + timeout
        # wait4 reports the processor time. It must not block while it holds the lock that `kill` needs.
        while True:
            with self._lock:
                if self._popen.returncode is None:
                    self._poll()
                if self._popen.returncode is not None:
                    return self._popen.returncode
            if time.monotonic() > end:
                self.kill()
            time.sleep(0.002)

    def _poll(self) -> None:
        try:
            pid, status, usage = os.wait4(self._popen.pid, os.WNOHANG)
        except ChildProcessError:  # SIGCHLD is ignored, as under some supervisors
            self._popen.returncode = 0
            return
        if pid:
            self._popen.returncode = os.waitstatus_to_exitcode(status)
            self.cpu_seconds = usage.ru_utime + usage.ru_stime

    def read_into(self, buffer: NDArray[Any], ready: Callable[[], bool] = lambda: True) -> bool:
        """Fill a buffer from its output; False at the end, or when `ready` is False before a read."""
        view, done = buffer.data.cast("B"), 0
        while done < len(view):
            size = self.stdout.readinto(view[done:]) if ready() else 0
            if not size:
                return False
            done += size
        return True

    def has_data(self, timeout: float) -> bool:
        """Wait some seconds for output, or for its end; on Windows, where pipes cannot be polled, do not."""
        if sys.platform == "win32":
            return True
        poll = select.poll()
        poll.register(self.stdout, select.POLLIN)
        return bool(poll.poll(timeout * 1000))

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


def run_ffmpeg(path: Path | str, options: Sequence[str], *, level: str) -> tuple[int, str]:
    """Run ffmpeg on a file or URL to its end, and return its exit code and its log."""
    timeout = math.inf if isinstance(path, Path) else NETWORK_DEADLINE
    with contextlib.closing(Process(options, level=level)) as process:
        begun = time.monotonic()
        code, log = process.wait(timeout), process.log()
        if time.monotonic() - begun > timeout:
            raise too_slow(source_name(path))
    check_resources(source_name(path), code, log)
    return code, log


def too_slow(name: str) -> TransientVideoError:
    """Return the error of a server that sends, but too little."""
    return TransientVideoError(
        f"{name} sends too little data for a frame within {NETWORK_DEADLINE:g} s; check the connection"
    )


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
    if not log and shutil.disk_usage(folder := tempfile.gettempdir()).free < _FULL:  # where its log is
        return f"the folder of temporary files, {folder}, is full; free some disk space"
    hint = "; free some disk space" if "No space left" in log else ""
    fault = _SYSTEM_FAULT.search(log)  # other messages may follow
    return f"ffmpeg reports {last_line(fault[0] if fault else log)!r}{hint}"


def video_error(message: str, source: Path | str, code: int, log: str) -> VideoError:
    """Return the error of a failed ffmpeg: transient if it was killed, or a server did not answer."""
    killed = code < 0 and -code not in _CRASHES
    offline = isinstance(source, str) and _NETWORK_FAULT.search(log) is not None
    return TransientVideoError(message) if killed or offline else VideoError(message)


def last_line(log: str) -> str:
    """Last message of ffmpeg's log, without the prefix ``[component @ address]``; or that of `web_proxy`."""
    if refused := re.search(rf"HTTP error (?:{REFUSED}|502) (.+)", log):
        return refused[1]
    lines = [re.sub(r"^(\[[^\]]*\] *)+", "", line).strip() for line in log.splitlines()]
    return next((line for line in reversed(lines) if line and not _STATISTICS.match(line)), "no reason given")


def seconds_of(time: str) -> float:
    """Convert a time of ffmpeg's log, such as ``"00:01:02.50"``, to seconds."""
    hours, minutes, seconds = time.split(":")
    return int(hours) * 3600 + int(minutes) * 60 + float(seconds)
