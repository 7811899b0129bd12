"""Reading streams: standard input, cameras and the network, with frames that may be dropped."""

from __future__ import annotations

import contextlib
import logging
import math
import re
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NETWORK_TIMEOUT
from vehicle_detection.errors import TransientVideoError, VideoError
from vehicle_detection.video.ffmpeg import (
    SQUARE_PIXELS,
    Process,
    check_frame_size,
    check_resources,
    last_line,
    pixel_limit,
    video_error,
)
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.queues import ClosableQueue, QueueClosed
from vehicle_detection.video.reading import Reader
from vehicle_detection.video.yuv import ColorEncoding, DecodedFrame, PlanarFrame

_LOGGER = logging.getLogger(__name__)

_MAX_HEADER_BYTES = 4096
# Seconds that a network stream has to send enough for ffmpeg to recognize it.
_OPEN_TIMEOUT = 30.0
# Seconds before each attempt to open a network stream again.
_RECONNECT_DELAYS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# Seconds of frames after which the attempts are counted from the start again.
_STEADY_SECONDS = 10.0


class LiveStream(Reader):
    """Frames of a stream, which is opened at once and read once: in the range that `start` chooses.

    ffmpeg decodes it to YUV4MPEG2, whose header states the frame size and the constant rate. A network stream
    without data for some seconds has ended. With `reconnect`, one that breaks off or stalls is opened again,
    some times in a row; missed frames leave a gap in the numbers.
    """

    def __init__(
        self,
        name: str,
        options: Sequence[str],
        *,
        stdin: int = subprocess.DEVNULL,
        network: bool = False,
        reconnect: bool = False,
    ) -> None:
        self.name, self._options, self._stdin, self._network = name, tuple(options), stdin, network
        self._delays = _RECONNECT_DELAYS if network and reconnect else ()
        self._attempts = 0
        self._lock = threading.Lock()
        self._killed = threading.Event()
        self._process: Process | None = None
        self._stalled = False  # whether the last wait for data was in vain
        self._number = -1  # of the last frame
        self.info = self._open(None)
        self._opened = self._last_read = time.monotonic()
        height, width = self.info.shape[:2]
        self._planes_shape = (height * 3 // 2, width)
        self._newest: ClosableQueue[tuple[int, NDArray[np.uint8]]] = ClosableQueue(1)
        self._thread: threading.Thread | None = None

    def start(self, *, drop: bool, first: int = 0, count: int | None = None) -> Self:
        """Choose the frames to read.

        With `drop`, a thread reads all of them, and the iterator returns the first one, then the newest ones:
        a slow consumer sees gaps in the indices. Without, ffmpeg and the sender wait for the consumer.
        """
        self._first, self._end = first, math.inf if count is None else first + count
        self._frames = self._read_range()
        if drop:
            self._thread = threading.Thread(target=self._read_all, name="vehicle-live", daemon=True)
            self._frames = iter(self._newest)
            self._thread.start()
        return self

    def read_next(self) -> tuple[int, float, DecodedFrame] | None:
        """Return number, time and content of the next frame; None at the end."""
        with contextlib.suppress(QueueClosed):
            for number, planes in self._frames:
                return number, float(number / self.info.fps), PlanarFrame(planes, ColorEncoding())
            if not self._killed.is_set() and self._number < self._first:
                start = float(self._first / self.info.fps)
                raise VideoError(f"{self.name} has no frame after {start:g} s ({self._reason()})")
        return None

    def _read_range(self) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield the numbers and planes of the chosen frames."""
        while not self._killed.is_set() and self._number + 1 < self._end:
            planes = np.empty(self._planes_shape, np.uint8)
            number = self.read(planes)
            if number is None:
                return
            if self._first <= number < self._end:
                yield number, planes

    def _read_all(self) -> None:
        """Read until the end of the stream, and keep the first frame until it is taken, then the newest."""
        error = None
        try:
            for count, item in enumerate(self._read_range()):
                self._newest.put(item, replace=count > 1)
        except QueueClosed:
            pass
        except BaseException as caught:  # raised in the thread of the consumer
            error = None if self._killed.is_set() else caught
        finally:
            self._newest.finish(error)

    def _open(self, like: VideoInfo | None) -> VideoInfo:
        """Start ffmpeg, in place of one that has ended, with the frame size and rate of `like`."""
        filters = (
            f"{SQUARE_PIXELS},crop=trunc(iw/2)*2:trunc(ih/2)*2,scale=out_color_matrix=bt601:out_range=tv"
        )
        rate: tuple[str, ...] = ()
        if like is not None:
            filters = f"scale={like.width}:{like.height}:out_color_matrix=bt601:out_range=tv"
            rate = ("-r", str(like.fps))
        output = ("-an", "-vf", filters, *rate, "-pix_fmt", "yuv420p", "-f", "yuv4mpegpipe", "pipe:1")
        # Level "info": its log states the format of the input.
        options = ("-nostats", *pixel_limit(), *self._options, *output)
        with self._lock:
            if self._killed.is_set():
                raise VideoError(f"{self.name} has been closed")
            self._end_process()
            process = self._process = Process(options, level="info", stdin=self._stdin, stdout=True)
        try:
            return self._read_info(process)
        except ValueError as error:  # closed by another thread
            raise VideoError(f"{self.name} has been closed") from error
        except BaseException:
            with self._lock:
                self._end_process()
            raise

    def _end_process(self) -> None:
        if self._process is not None:
            self._process.close()
            self.cpu_seconds += self._process.cpu_seconds
            self._process = None

    def _read_info(self, process: Process) -> VideoInfo:
        """Read the header of the stream."""
        header = self._read_line(process, _OPEN_TIMEOUT)
        size = re.match(rb"YUV4MPEG2 W(\d+) H(\d+) F(\d+):(\d+)", header)
        if size is None:
            if self._stalled:
                raise TransientVideoError(
                    f"{self.name} sends no video within {_OPEN_TIMEOUT:g} s; check the source"
                )
            code, log = process.wait(), process.log()
            check_resources(self.name, code, log)
            check_frame_size(self.name, log)
            reason, remedy = last_line(log), "check the source"
            if "received no packets" in reason and self.name == "-":
                remedy = (
                    "pass the file's path, because MP4 needs its index at the start to come through a pipe"
                )
            message = f"{self.name} is not a video that ffmpeg can read ({reason}); {remedy}"
            raise video_error(message, self.name, code, log)
        width, height, numerator, denominator = (int(number) for number in size.groups())
        found = re.search(r"^Input #0, (\S+),", process.log(), re.MULTILINE)
        return VideoInfo(
            width=width,
            height=height,
            fps=Fraction(numerator, denominator or 1),
            frames=0,
            duration=0.0,
            container=found[1] if found else "",
        )

    def _read_line(self, process: Process, timeout: float) -> bytes:
        """Read a line of a header; empty at the end of the stream."""
        line = bytearray()
        while not line.endswith(b"\n"):
            byte = process.stdout.read(1) if line or self._has_data(process, timeout) else b""
            if not byte or len(line) > _MAX_HEADER_BYTES:
                return b""
            line += byte
        return bytes(line)

    def _has_data(self, process: Process, timeout: float) -> bool:
        """Wait for data or the end of the pipe."""
        self._stalled = self._network and not process.has_data(timeout)
        return not self._stalled

    def read(self, planes: NDArray[np.uint8]) -> int | None:
        """Read the next frame into `planes` and return its number from 0; None at the end."""
        step = 1
        while not self._read_planes(planes):
            if not self._reconnect():
                return None
            step = max(1, round((time.monotonic() - self._last_read) * self.info.fps))
        self._number += step
        self._last_read = time.monotonic()
        return self._number

    def _read_planes(self, planes: NDArray[np.uint8]) -> bool:
        """Read the next frame of a connection into `planes`; False at its end."""
        process = self._process
        try:
            if process is None or not self._read_line(process, NETWORK_TIMEOUT):
                return False
            return process.read_into(planes, lambda: self._has_data(process, NETWORK_TIMEOUT))
        except ValueError:  # closed by another thread
            return False

    def _reconnect(self) -> bool:
        """Open the stream again; False if it does not answer any more, or does not reconnect."""
        if self._killed.is_set() or not self._delays:
            return False
        if self._last_read - self._opened > _STEADY_SECONDS:
            self._attempts = 0
        place = f"{self.name} broke off after {float((self._number + 1) / self.info.fps):.1f} s"
        reason = "it sends no frames"
        if self._attempts < len(self._delays):
            _LOGGER.warning("%s; opening it again", place)
        while self._attempts < len(self._delays):
            delay = self._delays[self._attempts]
            self._attempts += 1
            if self._killed.wait(delay):
                return False
            try:
                self._open(self.info)
            except VideoError as error:
                if self._killed.is_set():
                    return False
                reason = str(error)
                continue
            self._opened = time.monotonic()
            return True
        _LOGGER.warning("%s, and opening it again has failed %d times (%s)", place, self._attempts, reason)
        return False

    def _reason(self) -> str:
        """Last message of ffmpeg."""
        return last_line("" if self._process is None else self._process.log())

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads sees the end."""
        self._killed.set()
        with self._lock:
            if self._process is not None:
                self._process.kill()
        self._newest.abort()

    def close(self) -> None:
        """End ffmpeg and the thread."""
        self.kill()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        with self._lock, contextlib.suppress(OSError):
            self._end_process()
