"""Annotate a video with its vehicles, and read frames and properties of a video.

The result does not depend on the number of workers, and only a few frames are in memory at any time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from vehicle_detection._common import (
    atomic_write,
    available_cores,
    check_choice,
    check_integer,
    check_number,
    check_target,
    describe,
    progress_bar,
    single_threaded_opencv,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.ffmpeg import VideoInfo, probe
from vehicle_detection.video.pipeline import FramePipeline, VideoDetector
from vehicle_detection.video.streams import CONTAINERS, AudioSource, FrameReader, FrameWriter

PRESETS = (
    "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow", "placebo",
)  # fmt: skip
"""Presets of the H.264 encoder, from the fastest to the one with the smallest files."""


@dataclass(frozen=True, kw_only=True)
class VideoReport:
    """Counts and times of a run of `process_video`.

    Attributes
    ----------
    frames
        Number of frames.
    fps
        Exact frame rate of the video.
    shape
        Shape of a frame: ``(height, width, 3)``.
    seconds
        Elapsed time of the run.
    stages
        Seconds of work per stage, without waiting: ``"decode"``, ``"search"``, the detector's other stages,
        ``"draw"`` and ``"encode"``. Decode and encode are processor time over all cores, the others elapsed
        time. Stages run in parallel, so their sum may exceed `seconds`.
    tracks
        Number of different tracks shown.

    Examples
    --------
    >>> stages = {"decode": 1.0, "search": 3.0, "encode": 4.0}
    >>> report = VideoReport(
    ...     frames=250, fps=Fraction(25), shape=(720, 1280, 3), seconds=5.0, stages=stages, tracks=2
    ... )
    >>> report.frames_per_second, report.stage_fractions["encode"]
    (50.0, 0.5)
    >>> print(report)
    250 frames of 1280x720 in 5.0 s: 50.0 frames/s, 2.0 times real time, 2 vehicles
    stage    ms/frame  fraction
    decode       4.00     12.5%
    search      12.00     37.5%
    encode      16.00     50.0%
    """

    frames: int
    fps: Fraction
    shape: tuple[int, int, int]
    seconds: float
    stages: Mapping[str, float]
    tracks: int

    @property
    def frames_per_second(self) -> float:
        """Frames processed per second."""
        return self.frames / self.seconds if self.seconds else math.inf

    @property
    def stage_fractions(self) -> dict[str, float]:
        """Fraction of the work per stage, in [0, 1]; the sum is 1 unless there was no work."""
        total = sum(self.stages.values())
        return {name: seconds / total if total else 0.0 for name, seconds in self.stages.items()}

    def __str__(self) -> str:
        height, width = self.shape[:2]
        rate = self.frames_per_second
        vehicles = "1 vehicle" if self.tracks == 1 else f"{self.tracks} vehicles"
        lines = [
            f"{self.frames} frames of {width}x{height} in {self.seconds:.1f} s: {rate:.1f} frames/s, "
            f"{rate / self.fps:.1f} times real time, {vehicles}",
            "stage    ms/frame  fraction",
        ]
        fractions = self.stage_fractions
        for name, seconds in self.stages.items():
            lines.append(f"{name:<8} {seconds / max(self.frames, 1) * 1e3:>8.2f} {fractions[name]:>9.1%}")
        return "\n".join(lines)


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Read the properties of a video file: frame size, exact frame rate, length, sound and rotation.

    Parameters
    ----------
    path
        A file that ffmpeg can read.

    Returns
    -------
    VideoInfo
        The properties; ``frames`` is an estimate, because counting requires decoding the whole video.

    Raises
    ------
    InvalidInputError
        If the file is missing, a folder, or not readable.
    VideoError
        If the file is not a video, or its first frame cannot be decoded.

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
        Time range in seconds: frames with ``start <= time < end`` are read. None: no limit.

    Returns
    -------
    FrameReader
        An iterator of ``(index, time, frame)``: the frame's number in the file from 0, its time in seconds,
        and an upright ``(H, W, 3)`` uint8 RGB array. Its ``info`` is the file's `VideoInfo`. ffmpeg ends
        after the last frame, and at the end of a ``with`` block.

    Raises
    ------
    InvalidInputError
        If the file is missing, or there is no frame between `start` and `end`.
    VideoError
        If the file is not a video; while reading, if it is incomplete.

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
    detector: VideoDetector,
    *,
    start: float | None = None,
    end: float | None = None,
    audio: bool = True,
    preset: str = "veryfast",
    workers: int | None = None,
    progress: bool = True,
    on_result: Callable[[Any], object] | None = None,
) -> VideoReport:
    """Detect and track the vehicles of a video, and write a copy with their boxes.

    A `VehicleDetector` searches at least 12 frames per second and interpolates the tracks of the frames
    between, unless its option `every` says otherwise.

    The copy is H.264 in yuv420p, which browsers play, with the frame rate, all frames and the sound of the
    source. The rotation stored in the source is applied. A varying frame rate is converted to a constant one.
    An odd width or height is extended by one pixel, which repeats the last column or row.

    Parameters
    ----------
    source
        A video file that ffmpeg can read.
    target
        The file to write: .mp4, .m4v, .mov or .mkv. After an error, an existing file is unchanged. None:
        write no video.
    detector
        A :class:`VehicleDetector`, or another object with its methods ``search``, ``track``, ``annotate``
        and ``reset``; optionally ``annotated_shape(shape)``, the shape of what ``annotate`` returns for a
        frame, by default that of the frame.
    start, end
        Time range in seconds: frames with ``start <= time < end`` are processed. None: no limit.
    audio
        Keep the sound. It is copied if the whole video is processed and every player supports its codec,
        otherwise it is encoded as AAC.
    preset
        Speed of the encoder: "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow",
        "slower", "veryslow" or "placebo".
    workers
        Number of frames searched in parallel, at least 1; None: one per core, at most four. The result does
        not depend on it.
    progress
        Show a progress bar if standard error is a terminal.
    on_result
        Function that is called with each frame's result, in frame order, in the calling thread.

    Returns
    -------
    VideoReport
        Numbers of frames and vehicles, and the time of each stage.

    Raises
    ------
    InvalidInputError
        If an argument is invalid.
    VideoError
        If the source is not a video or is incomplete, or the target cannot be written.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector  # doctest: +SKIP
    >>> print(process_video("drive.mp4", "found.mp4", VehicleDetector()))  # doctest: +SKIP
    """
    path = _check_source(source)
    output = None if target is None else _check_video_target(target, path)
    _check_span(start, end)
    check_choice(preset, "preset", PRESETS)
    n_workers = min(available_cores(), 4) if workers is None else check_integer(workers, "workers", low=1)
    for method in ("search", "track", "annotate", "reset"):
        if not callable(getattr(detector, method, None)):
            raise InvalidInputError(
                "detector must have the methods search, track, annotate and reset, "
                f"got {describe(detector)} without {method}; pass a VehicleDetector()"
            )
    if on_result is not None and not callable(on_result):
        raise InvalidInputError(f"on_result must be a function of a result, got {describe(on_result)}")

    info = probe(path)
    first, count = _frame_range(info, start, end)
    sound = _audio_source(path, info, end, first) if audio and info.has_audio else None
    detector.reset(fps=float(info.fps))
    started = time.perf_counter()
    drawn_shape = getattr(detector, "annotated_shape", lambda shape: shape)(info.shape)
    drawn_info = dataclasses.replace(info, height=drawn_shape[0], width=drawn_shape[1])
    pipeline = FramePipeline(
        functools.partial(FrameReader, path, info, first=first, count=count),
        None if output is None else functools.partial(_open_writer, output, drawn_info, preset, sound),
        detector,
        n_workers,
        drawn_shape=drawn_shape,
        interval=getattr(detector, "search_interval", lambda fps: 1)(float(info.fps)),
    )
    frames, track_ids = 0, set[int]()
    total = count or max(info.frames - first, 0) or None
    # The pipeline's threads use all cores; more threads would only compete with them.
    with (
        single_threaded_opencv(),
        progress_bar(progress, total, unit="frame", terminal_only=True) as bar,
        contextlib.closing(pipeline.run()) as results,
    ):
        for result in results:
            frames += 1
            track_ids.update(track.id for track in result.tracks if getattr(track, "shown", True))
            if on_result is not None:
                on_result(result)
            bar.update()
    return VideoReport(
        frames=frames,
        fps=info.fps,
        shape=info.shape,
        seconds=time.perf_counter() - started,
        stages=pipeline.stage_seconds,
        tracks=len(track_ids),
    )


def cut_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    start: float | None = None,
    end: float | None = None,
    preset: str = "veryfast",
) -> int:
    """Copy a part of a video, with its sound, to another file; returns the number of frames.

    The arguments are those of `process_video`, and so are the errors.
    """
    path = _check_source(source)
    output = _check_video_target(target, path)
    _check_span(start, end)
    check_choice(preset, "preset", PRESETS)
    info = probe(path)
    first, count = _frame_range(info, start, end)
    sound = _audio_source(path, info, end, first) if info.has_audio else None
    with (
        FrameReader(path, info, first=first, count=count) as frames,
        _open_writer(output, info, preset, sound) as writer,
    ):
        for _, _, frame in frames:
            writer.write(frame)
        writer.finish()
    return frames.frames_read


@contextlib.contextmanager
def _open_writer(
    target: Path, info: VideoInfo, preset: str, audio: AudioSource | None
) -> Iterator[FrameWriter]:
    """Open a video file that is written atomically."""
    with atomic_write(target) as part, FrameWriter(part, info, preset=preset, audio=audio) as writer:
        yield writer


def _as_path(value: object, name: str) -> Path:
    if not isinstance(value, (str, os.PathLike)):
        raise InvalidInputError(
            f"{name} must be the path of a video file, got {describe(value)}; pass a file name"
        )
    return Path(value)


def _check_source(source: str | os.PathLike[str]) -> Path:
    path = _as_path(source, "source")
    if path.is_dir():
        raise InvalidInputError(f"source {path} is a folder; choose a video file in it")
    if not path.exists():
        raise InvalidInputError(f"source {path} does not exist; check the path")
    if not path.is_file():
        raise InvalidInputError(f"source {path} is not a regular file; record the stream to a file first")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} is not readable; change its permissions")
    return path


def _check_video_target(target: str | os.PathLike[str], source: Path) -> Path:
    path = check_target(_as_path(target, "target"))
    if path.suffix.lower() not in CONTAINERS:
        raise InvalidInputError(
            f"target must end in {', '.join(CONTAINERS)}; got {path.name!r}, use {path.stem + '.mp4'!r}"
        )
    if path.exists() and path.samefile(source):
        raise InvalidInputError(f"target {path} is the source; choose another name")
    return path


def _check_span(start: float | None, end: float | None) -> None:
    for name, value in (("start", start), ("end", end)):
        if value is not None:
            check_number(value, name, low=0, high=1e7)
    if end is not None and (start or 0) >= end:
        raise InvalidInputError(
            f"end must be later than the start; got {start or 0:g} s to {end:g} s, choose a later end"
        )


def _frame_range(info: VideoInfo, start: float | None, end: float | None) -> tuple[int, int | None]:
    """Convert seconds to the index of the first frame and the number of frames."""
    if start is not None and info.duration and start >= info.duration:
        raise InvalidInputError(
            f"start must be less than the video's length of {info.duration:g} s; got {start:g} s"
        )
    # Tolerance: a frame's rounded time selects that frame.
    first, last = (
        None if value is None else math.ceil(Fraction(value) * info.fps - Fraction(1, 100))
        for value in (start, end)
    )
    first = first or 0
    if last is not None and last <= first:
        raise InvalidInputError(
            f"end must be at least one frame later than the start, at {float(info.fps):g} frames/s; "
            f"got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return first, None if last is None else last - first


def _audio_source(path: Path, info: VideoInfo, end: float | None, first: int) -> AudioSource:
    """Select the sound of the processed frames."""
    if not first and end is None:
        return AudioSource(path=path)
    start = float(first / info.fps)
    length = None if end is None else float(Fraction(end)) - start
    return AudioSource(path=path, start=start + info.start_time, length=length)
