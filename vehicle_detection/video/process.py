"""Frames in, annotated video out.

ffmpeg decodes, workers search frames side by side, one thread follows the vehicles and draws in frame order,
ffmpeg encodes. The result is the same for any number of workers, and only a handful of frames is in memory at
any time.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from vehicle_detection._common import (
    atomic_write,
    check_choice,
    check_integer,
    check_number,
    check_target,
    describe,
    single_threaded_opencv,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.ffmpeg import VideoInfo, probe
from vehicle_detection.video.pipeline import Line, SupportsFrames
from vehicle_detection.video.streams import CONTAINERS, AudioSource, FrameReader, FrameWriter

PRESETS = (
    "ultrafast",
    "superfast",
    "veryfast",
    "faster",
    "fast",
    "medium",
    "slow",
    "slower",
    "veryslow",
    "placebo",
)
"""Presets of the H.264 encoder, from the fastest to the smallest file."""


@dataclass(frozen=True, kw_only=True)
class VideoReport:
    """What a run over a video did, and where the time went.

    Attributes
    ----------
    frames
        Number of frames.
    fps
        Exact frame rate of the video.
    shape
        Shape of a frame: ``(height, width, 3)``.
    seconds
        Time of the whole run.
    stages
        Seconds of work, without the waiting for other stages, in ``"decode"``, ``"search"``, the detector's
        further stages, ``"draw"`` and ``"encode"``. Decode and encode are processor time, over all cores, the
        others time on the clock. Stages run side by side, so their sum may exceed `seconds`.
    tracks
        Number of vehicles that were shown: of different track ids.

    Examples
    --------
    >>> stages = {"decode": 1.0, "search": 3.0, "encode": 4.0}
    >>> report = VideoReport(
    ...     frames=250, fps=Fraction(25), shape=(720, 1280, 3), seconds=5.0, stages=stages, tracks=2
    ... )
    >>> report.frames_per_second, report.shares["encode"]
    (50.0, 0.5)
    >>> print(report)
    250 frames of 1280x720 in 5.0 s: 50.0 frames/s, 2.0 times real time, 2 vehicles
    stage    ms a frame   share
    decode         4.00   12.5%
    search        12.00   37.5%
    encode        16.00   50.0%
    """

    frames: int
    fps: Fraction
    shape: tuple[int, int, int]
    seconds: float
    stages: Mapping[str, float]
    tracks: int

    @property
    def frames_per_second(self) -> float:
        """Frames of the video in a second of the run."""
        return self.frames / self.seconds if self.seconds else math.inf

    @property
    def shares(self) -> dict[str, float]:
        """Each stage's share of the work, in [0, 1]; they sum to 1 unless there was none."""
        total = sum(self.stages.values())
        return {name: seconds / total if total else 0.0 for name, seconds in self.stages.items()}

    def __str__(self) -> str:
        height, width = self.shape[:2]
        rate = self.frames_per_second
        vehicles = "1 vehicle" if self.tracks == 1 else f"{self.tracks} vehicles"
        lines = [
            f"{self.frames} frames of {width}x{height} in {self.seconds:.1f} s: {rate:.1f} frames/s, "
            f"{rate / self.fps:.1f} times real time, {vehicles}",
            "stage    ms a frame   share",
        ]
        shares = self.shares
        for name, seconds in self.stages.items():
            lines.append(f"{name:<8} {seconds / max(self.frames, 1) * 1e3:>10.2f} {shares[name]:>7.1%}")
        return "\n".join(lines)


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Tell the facts of a video file: upright size, exact rate, estimated length, sound, rotation.

    Parameters
    ----------
    path
        A file that ffmpeg can read.

    Returns
    -------
    VideoInfo
        The facts; its ``frames`` is an estimate, as only decoding all of a video counts them.

    Raises
    ------
    InvalidInputError
        If the file is missing, a folder, or not readable.
    VideoError
        If it is no video, or not a frame of it can be decoded.

    Examples
    --------
    >>> probe_video("missing.mp4")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    return probe(_check_source(path))


def read_frames(
    source: str | os.PathLike[str], *, start: float | None = None, end: float | None = None
) -> FrameReader:
    """Read the frames of a video, one at a time.

    Parameters
    ----------
    source
        A file that ffmpeg can read.
    start, end
        Seconds; the frames with ``start <= time < end`` are read. None: from the first, to the last.

    Returns
    -------
    FrameReader
        An iterator of ``(index, time, frame)``: the frame's number in the file from 0, its second in the
        file, and an upright ``(H, W, 3)`` uint8 RGB array. Its ``info`` has the facts of the file. ffmpeg
        ends with the last frame, and at the end of a ``with`` block.

    Raises
    ------
    InvalidInputError
        If the file is missing, or `start` and `end` hold no frame.
    VideoError
        If the file is no video; while reading, if it is cut off.

    Examples
    --------
    >>> with read_frames("missing.mp4", end=2.0) as frames:  # doctest: +IGNORE_EXCEPTION_DETAIL
    ...     means = [frame.mean() for index, time, frame in frames]
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    path = _check_source(source)
    _check_span(start, end)
    info = probe(path)
    first, count = _frame_range(info, start, end)
    return FrameReader(path, info, first=first, count=count)


def process_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str] | None,
    detector: SupportsFrames,
    *,
    start: float | None = None,
    end: float | None = None,
    audio: bool = True,
    preset: str = "veryfast",
    workers: int | None = None,
    progress: bool = True,
    on_result: Callable[[Any], object] | None = None,
) -> VideoReport:
    """Find and follow the vehicles of a video, and write it again with their boxes.

    The new video is H.264 in yuv420p that browsers play, with the exact frame rate, the frames one for one
    and the sound of the source. Frames stand upright, whatever rotation the source carries. A source whose
    rate varies is brought to a constant one. An odd width or height grows by one pixel, which repeats the
    last column or row.

    Parameters
    ----------
    source
        A video file that ffmpeg can read.
    target
        The file to write: .mp4, .m4v, .mov or .mkv. It appears whole or not at all. None: only look for
        vehicles.
    detector
        A :class:`VehicleDetector`, or another object with its ``search``, ``follow``, ``annotate`` and
        ``reset``.
    start, end
        Seconds; the frames with ``start <= time < end`` are taken. None: from the first, to the last.
    audio
        Keep the sound. It is copied as it is if the whole video is taken and every player knows its codec,
        else encoded as AAC.
    preset
        Speed of the encoder: "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow",
        "slower", "veryslow" or "placebo".
    workers
        Number of frames searched at the same time, at least 1; None: one for each core, at most four. The
        result does not depend on it.
    progress
        Show a bar on stderr if that is a terminal.
    on_result
        Called with each frame's result, in frame order, from the calling thread.

    Returns
    -------
    VideoReport
        Number of frames and vehicles, and where the time went.

    Raises
    ------
    InvalidInputError
        If an argument is not what it should be; nothing has been read or written then.
    VideoError
        If the source is no video or is cut off, or the target cannot be written. An earlier target stays.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector  # doctest: +SKIP
    >>> print(process_video("drive.mp4", "found.mp4", VehicleDetector()))  # doctest: +SKIP
    """
    path = _check_source(source)
    goal = None if target is None else _check_video_target(target, path)
    _check_span(start, end)
    check_choice(preset, "preset", PRESETS)
    crew = min(_cores(), 4) if workers is None else check_integer(workers, "workers", low=1)
    for method in ("search", "follow", "annotate", "reset"):
        if not callable(getattr(detector, method, None)):
            raise InvalidInputError(
                "detector must have the methods search, follow, annotate and reset, "
                f"got {describe(detector)} without {method}; pass a VehicleDetector()"
            )
    if on_result is not None and not callable(on_result):
        raise InvalidInputError(f"on_result must be a function of a result, got {describe(on_result)}")

    info = probe(path)
    first, count = _frame_range(info, start, end)
    sound = _sound(path, info, start, end, first) if audio and info.has_audio else None
    detector.reset(fps=float(info.fps))
    began = time.perf_counter()
    line = Line(
        functools.partial(FrameReader, path, info, first=first, count=count),
        None if goal is None else functools.partial(_whole_video, goal, info, preset, sound),
        detector,
        crew,
    )
    frames, vehicles = 0, set[int]()
    total = count or max(info.frames - first, 0) or None
    # The line's own threads keep the cores busy: more of them would only get into each other's way.
    with (
        single_threaded_opencv(),
        _progress_bar(progress, total) as bar,
        contextlib.closing(line.run()) as results,
    ):
        for result in results:
            frames += 1
            vehicles.update(track.id for track in result.tracks if getattr(track, "shown", True))
            if on_result is not None:
                on_result(result)
            bar.update()
    return VideoReport(
        frames=frames,
        fps=info.fps,
        shape=info.shape,
        seconds=time.perf_counter() - began,
        stages=line.stages,
        tracks=len(vehicles),
    )


@contextlib.contextmanager
def _whole_video(
    target: Path, info: VideoInfo, preset: str, audio: AudioSource | None
) -> Iterator[FrameWriter]:
    """Open a video to write that appears whole or not at all."""
    with atomic_write(target) as part, FrameWriter(part, info, preset=preset, audio=audio) as writer:
        yield writer


def _as_path(value: object, name: str) -> Path:
    if not isinstance(value, (str, os.PathLike)):
        raise InvalidInputError(
            f"{name} must be the path of a video file, got {describe(value)}; pass a name"
        )
    return Path(value)


def _check_source(source: str | os.PathLike[str]) -> Path:
    path = _as_path(source, "source")
    if path.is_dir():
        raise InvalidInputError(f"source {path} is a folder; name a video file in it")
    if not path.exists():
        raise InvalidInputError(f"source {path} does not exist; check the path")
    if not path.is_file():
        raise InvalidInputError(f"source {path} is no regular file; record the stream to a file first")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} may not be read; change its permissions")
    return path


def _check_video_target(target: str | os.PathLike[str], source: Path) -> Path:
    path = check_target(_as_path(target, "target"))
    if path.suffix.lower() not in CONTAINERS:
        raise InvalidInputError(
            f"target must end in {', '.join(CONTAINERS)}; got {path.name!r}, write {path.stem + '.mp4'!r}"
        )
    if path.exists() and path.samefile(source):
        raise InvalidInputError(f"target {path} is the source itself; choose another name")
    return path


def _check_span(start: float | None, end: float | None) -> None:
    for name, value in (("start", start), ("end", end)):
        if value is not None:
            check_number(value, name, low=0, high=1e7)
    if end is not None and (start or 0) >= end:
        raise InvalidInputError(
            f"start must be before end, got start={start or 0:g} and end={end:g}; swap them"
        )


def _frame_range(info: VideoInfo, start: float | None, end: float | None) -> tuple[int, int | None]:
    """Turn seconds into the first frame's number and the number of frames."""
    if start is not None and info.duration and start >= info.duration:
        raise InvalidInputError(
            f"start must lie inside the video, which is {info.duration:g} s long; got {start:g} s"
        )
    # A frame's own time, rounded to a float or a few digits, still means that frame.
    first, last = (
        None if value is None else math.ceil(Fraction(value) * info.fps - Fraction(1, 100))
        for value in (start, end)
    )
    first = first or 0
    if last is not None and last <= first:
        raise InvalidInputError(
            f"start and end must hold a frame, of which there are {float(info.fps):g} a second; "
            f"got {start or 0:g} s to {end:g} s"
        )
    return first, None if last is None else last - first


def _sound(path: Path, info: VideoInfo, start: float | None, end: float | None, first: int) -> AudioSource:
    """Choose the part of the sound that goes with the frames."""
    if not first and end is None:
        return AudioSource(path=path)
    begin = float(first / info.fps) + info.first_time
    length = None if end is None else float(Fraction(end)) - float(first / info.fps)
    return AudioSource(path=path, start=begin, length=length)


def _cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _progress_bar(progress: bool, total: int | None) -> Any:
    from tqdm import tqdm

    # None: tqdm stays quiet unless its file is a terminal.
    return tqdm(total=total, unit="frame", file=sys.stderr, disable=None if progress else True)
