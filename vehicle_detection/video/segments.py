"""Consecutive video files that are read as one video."""

from __future__ import annotations

import logging
import math
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import temporary_folder
from vehicle_detection.video.damage import stream_duration
from vehicle_detection.video.frame_source import FrameSource
from vehicle_detection.video.probe import VideoInfo, probe
from vehicle_detection.video.streams import AudioSource, FrameReader, Reader

_LOGGER = logging.getLogger(__name__)


class VideoSegments(FrameSource):
    """Consecutive video files as one video, with the frame size and rate of the first one."""

    def __init__(self, paths: Sequence[Path]) -> None:
        infos = [probe(path) for path in paths]
        first = infos[0]
        # Sound may be longer than the frames, which would add up.
        lengths = [
            (stream_duration(path, info) if info.has_audio else None) or float(info.frames / info.fps)
            for path, info in zip(paths, infos, strict=True)
        ]
        self._infos = [
            replace(
                info,
                width=first.width,
                height=first.height,
                fps=first.fps,
                frames=round(length * first.fps),
                constant_rate=info.constant_rate and info.fps == first.fps,
            )
            for info, length in zip(infos, lengths, strict=True)
        ]
        sound = all(info.has_audio and info.audio_format == first.audio_format for info in infos)
        self._sound_differs = first.has_audio and not sound
        super().__init__(
            f"{paths[0]} to {paths[-1].name}",
            replace(
                first,
                frames=sum(info.frames for info in self._infos),
                duration=sum(lengths),
                audio_track=first.audio_track if sound else None,
                audio_codec=first.audio_codec if sound else None,
                start_time=0.0,
            ),
            paths,
        )

    def read(self, first: int = 0, count: int | None = None, *, strict: bool = False) -> Reader:
        """Open a reader of `count` frames from number `first` on, whichever segments hold them."""
        segments = list(zip(self.files, self._infos, strict=True))
        return _SegmentReader(self.info, segments, first, count, strict=strict)

    def audio(self, first: int = 0, length: float | None = None) -> AudioSource | None:
        """Join the sound of the segments; None if one of them has none."""
        if self._sound_differs:
            _LOGGER.warning(
                "the segments after %s have sound of another format, or none; the video has none",
                self.files[0],
            )
        if not self.info.has_audio:
            return None
        parent = Path(tempfile.gettempdir())
        folder = self._on_close.enter_context(temporary_folder(parent, "vehicle-segments"))
        # A path that is not UTF-8 keeps its bytes.
        with (folder / "segments.txt").open(
            "w", encoding="utf-8", errors="surrogateescape", newline="\n"
        ) as file:
            for path, info in zip(self.files, self._infos, strict=True):
                quoted = str(path.resolve()).replace("'", r"'\''")
                seconds = float(info.frames / info.fps)
                begin = info.first_timestamp
                file.write(f"file '{quoted}'\ninpoint {begin:.6f}\n")
                file.write(f"outpoint {begin + seconds:.6f}\nduration {seconds:.6f}\n")
        # Times as in the list: the first sound may lie before 0, which ffmpeg would take for the start.
        options = ("-seek_timestamp", "1", "-f", "concat", "-safe", "0", "-i", f"file:{file.name}")
        return AudioSource(input=options, start=float(first / self.info.fps), length=length)


class _SegmentReader(Reader):
    """Reader of the frames of several files, one after the other."""

    def __init__(
        self,
        info: VideoInfo,
        segments: Sequence[tuple[Path, VideoInfo]],
        first: int,
        count: int | None,
        *,
        strict: bool,
    ) -> None:
        self.info = info
        self._strict = strict
        self._cpu_seconds = 0.0
        self._segments = list(segments)
        self._index = first
        self._end = math.inf if count is None else first + count
        self._lock = threading.Lock()
        self._killed = False
        self._reader: FrameReader | None = None
        # Lengths of skipped segments are known from their headers only, if at all.
        while len(self._segments) > 1 and first >= (self._segments[0][1].frames or math.inf):
            first -= self._segments.pop(0)[1].frames
        self._first = first

    @property
    def cpu_seconds(self) -> float:
        """Processor time of ffmpeg for the segments that have been read."""
        return self._cpu_seconds

    def __next__(self) -> tuple[int, float, NDArray[np.uint8]]:
        while self._index < self._end:
            reader = self._reader or self._open_next()
            for _, _, frame in reader:
                index = self._index
                self._index += 1
                return index, float(index / self.info.fps), frame
            self._close_reader()
        raise StopIteration

    def _open_next(self) -> FrameReader:
        with self._lock:
            if self._killed or not self._segments:
                raise StopIteration
            path, info = self._segments.pop(0)
            # After a segment that is cut off, times and sound of the next one would be wrong.
            whole = bool(self._segments)
            self._reader = FrameReader(path, info, first=self._first, strict=self._strict, whole=whole)
            self._first = 0
            return self._reader

    def _close_reader(self) -> None:
        with self._lock:
            if self._reader is not None:
                self._reader.close()
                self._cpu_seconds += self._reader.cpu_seconds
                self.damage = "; ".join(filter(None, (self.damage, self._reader.damage)))
                self._reader = None

    def kill(self) -> None:
        with self._lock:
            self._killed = True
            if self._reader is not None:
                self._reader.kill()

    def close(self) -> None:
        self.kill()
        self._close_reader()
