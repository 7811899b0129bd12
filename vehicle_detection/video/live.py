"""Reading streams: standard input, cameras and the network, with frames that may be dropped."""

from __future__ import annotations

import contextlib
import math
import re
import threading
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import VideoError
from vehicle_detection.video.ffmpeg import Process, VideoInfo, check_frame_size, last_line, pixel_limit
from vehicle_detection.video.yuv import ColorEncoding, rgb_from_planes

_MAX_HEADER_BYTES = 4096


class LiveProcess:
    """An ffmpeg that decodes a stream from its first frame on; the stream is opened only once.

    ffmpeg writes YUV4MPEG2, whose header states the frame size and rate, at a constant rate: the times of
    the frames are those of the stream.
    """

    def __init__(self, name: str, options: Sequence[str], *, stdin: int | None = None) -> None:
        self.name = name
        filters = "crop=trunc(iw/2)*2:trunc(ih/2)*2,scale=out_color_matrix=bt601:out_range=tv"
        output = ("-map", "0:V:0", "-vf", filters, "-pix_fmt", "yuv420p", "-f", "yuv4mpegpipe", "pipe:1")
        nostdin = () if stdin is not None else ("-nostdin",)
        descriptor: bool | int = False if stdin is None else stdin
        self.process = Process((*nostdin, *pixel_limit(), *options, *output), stdin=descriptor, stdout=True)
        try:
            self.info = self._read_header()
        except BaseException:
            self.process.close()
            raise

    def _read_header(self) -> VideoInfo:
        header = self.read_line()
        size = re.match(rb"YUV4MPEG2 W(\d+) H(\d+) F(\d+):(\d+)", header)
        if size is None:
            self.process.wait()
            log = self.process.log()
            check_frame_size(self.name, log)
            raise VideoError(
                f"{self.name} is not a video that ffmpeg can read ({last_line(log)}); check the source"
            )
        width, height, numerator, denominator = (int(number) for number in size.groups())
        return VideoInfo(
            width=width, height=height, fps=Fraction(numerator, denominator or 1), frames=0, duration=0.0
        )

    def read_line(self) -> bytes:
        """Read a line of a header; empty at the end of the stream."""
        line = bytearray()
        while not line.endswith(b"\n"):
            byte = self.process.stdout.read(1)
            if not byte or len(line) > _MAX_HEADER_BYTES:
                return b""
            line += byte
        return bytes(line)

    def read_planes(self, planes: NDArray[np.uint8]) -> bool:
        """Read the next frame into `planes`; False at the end of the stream."""
        if not self.read_line():
            return False
        view, done = planes.data.cast("B"), 0
        while done < len(view):
            size = self.process.stdout.readinto(view[done:])
            if not size:
                return False
            done += size
        return True

    def close(self) -> None:
        """End ffmpeg."""
        self.process.close()


class LiveReader:
    """Frames of a `LiveProcess`, in order: an iterator of ``(index, time, frame)`` and a context manager.

    With `drop`, a thread reads all frames, and the iterator returns the newest one: a slow consumer sees
    gaps in the indices. Without, ffmpeg and the sender wait for the consumer.
    """

    damage = ""

    def __init__(self, process: LiveProcess, *, drop: bool, first: int = 0, count: int | None = None) -> None:
        self.info = process.info
        self._process = process
        self._first, self._end = first, math.inf if count is None else first + count
        self._number = -1  # of the last frame read
        height, width = self.info.shape[:2]
        self._planes_shape = (height * 3 // 2, width)
        self._channels = np.empty((3, height, width), np.uint8)
        self._changed = threading.Condition()
        self._newest: tuple[int, NDArray[np.uint8]] | None = None
        self._finished = self._killed = False
        self._thread = None
        if drop:
            self._thread = threading.Thread(target=self._read_all, name="vehicle-live", daemon=True)
            self._thread.start()

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg, known after it has ended."""
        return self._process.process.cpu_seconds

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        number, planes = self._next_planes()
        frame = rgb_from_planes(planes, ColorEncoding(), self._channels)
        return number, float(number / self.info.fps), frame

    def _next_planes(self) -> tuple[int, NDArray[np.uint8]]:
        if self._thread is None:
            planes = self._read()
        else:
            with self._changed:
                while self._newest is None and not self._finished:
                    self._changed.wait()
                planes, self._newest = self._newest, None
        if planes is None:
            self._finish()
            raise StopIteration
        return planes

    def _read(self) -> tuple[int, NDArray[np.uint8]] | None:
        """Read the next frame of the range; None at its end."""
        while not self._killed and self._number + 1 < self._end:
            planes = np.empty(self._planes_shape, np.uint8)
            try:
                if not self._process.read_planes(planes):
                    return None
            except ValueError:  # closed by another thread
                return None
            self._number += 1
            if self._number >= self._first:
                return self._number, planes
        return None

    def _read_all(self) -> None:
        """Read until the end of the stream, and keep the newest frame."""
        while (item := self._read()) is not None:
            with self._changed:
                self._newest = item
                self._changed.notify_all()
        with self._changed:
            self._finished = True
            self._changed.notify_all()

    def _finish(self) -> None:
        """Raise an error if the stream had no frame of the range."""
        if not self._killed and self._number < self._first:
            log = last_line(self._process.process.log())
            start = float(self._first / self.info.fps)
            raise VideoError(f"{self._process.name} has no frame after {start:g} s ({log})")

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that reads sees the end."""
        self._killed = True
        self._process.process.kill()

    def close(self) -> None:
        """End ffmpeg and the thread."""
        self.kill()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        with contextlib.suppress(OSError):
            self._process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
