"""Annotate a video with its vehicles.

The result does not depend on the number of workers. Only a few frames are in memory: those being searched,
and those between two searched frames, which wait to be drawn.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    atomic_write,
    available_cores,
    check_choice,
    check_flags,
    check_integer,
    check_path,
    check_target,
    describe,
    pluralize,
    progress_bar,
    single_threaded_opencv,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.export import shown_tracks
from vehicle_detection.video.frame_source import FrameSource
from vehicle_detection.video.pipeline import FramePipeline, Frames, VideoDetector
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.reading import check_span, frame_range
from vehicle_detection.video.sources import Source, borrow_source, open_source
from vehicle_detection.video.streams import CONTAINERS, AudioSource, FrameWriter
from vehicle_detection.video.viewer import open_viewer

if TYPE_CHECKING:
    from vehicle_detection.tracking import FrameResult

PRESETS = (
    "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow", "placebo",
)  # fmt: skip
"""Presets of the H.264 encoder, from the fastest to the one with the smallest files."""

_LOGGER = logging.getLogger(__name__)

# Seconds between log lines on the progress.
_LOG_INTERVAL = 60.0

# Maximum size of the frames that are decoded ahead of the search, unless each worker has only one.
_LOOKAHEAD_BYTES = 256 << 20


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
    dropped
        Number of frames of a live source that were dropped because the search was busy.
    damage
        What is damaged in the source, such as missing frames; empty if nothing is.

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
    dropped: int = 0
    damage: str = ""

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
        lines = [
            f"{pluralize(self.frames, 'frame')} of {width}x{height} in {self.seconds:.1f} s: "
            f"{rate:.1f} frames/s, {rate / self.fps:.1f} times real time, {pluralize(self.tracks, 'vehicle')}"
            + (f", {pluralize(self.dropped, 'frame')} dropped" if self.dropped else ""),
            "stage    ms/frame  fraction",
        ]
        fractions = self.stage_fractions
        for name, seconds in self.stages.items():
            lines.append(f"{name:<8} {seconds / max(self.frames, 1) * 1e3:>8.2f} {fractions[name]:>9.1%}")
        return "\n".join(lines)


def process_video(
    source: Source,
    target: str | os.PathLike[str] | None,
    detector: VideoDetector,
    *,
    start: float | None = None,
    end: float | None = None,
    audio: bool = True,
    preset: str = "veryfast",
    workers: int | None = None,
    progress: bool = True,
    strict: bool = False,
    show: bool = False,
    on_result: Callable[[FrameResult], object] | None = None,
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
        A video file, or any other source of `open_source`: the segments of a trip, images, standard input, a
        camera or a network stream. Ctrl-C ends a live source, and completes the target.
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
        Show a progress bar in a terminal or a notebook, and log the progress once a minute (level INFO).
    strict
        Raise an error, and write nothing, if a file of the source is damaged: frames are missing, or ffmpeg
        reports decoding errors. Otherwise a warning is logged, and ``damage`` of the result says it. Streams
        are not checked.
    show
        Show the annotated frames in a window, or in a notebook below the cell. Closing the window, or the key
        Escape, ends the run and completes the target.
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
        If the source is not a video, or is damaged and `strict` is set, or the target cannot be written.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector  # doctest: +SKIP
    >>> print(process_video("drive.mp4", "found.mp4", VehicleDetector()))  # doctest: +SKIP
    """
    check_flags(audio=audio, strict=strict, progress=progress, show=show)
    if on_result is not None and not callable(on_result):
        raise InvalidInputError(f"on_result must be a function of a result, got {describe(on_result)}")
    with VideoRun(
        source,
        detector,
        target=target,
        start=start,
        end=end,
        audio=audio,
        preset=preset,
        workers=workers,
        strict=strict,
        frames="drawn" if show else "none",
    ) as run:
        with (
            _stop_on_interrupt(run),
            contextlib.closing(open_viewer(run.source.name)) if show else contextlib.nullcontext() as viewer,
            contextlib.closing(run.results(progress=progress)) as results,
        ):
            for drawn, result in results:
                if on_result is not None:
                    on_result(result)
                if viewer is not None and drawn is not None:
                    viewer.show(drawn)
                    if viewer.closed:
                        run.stop()
        return run.report()


class VideoRun(Closing):
    """One pass of a detector over a source, which `process_video` and `track` have in common.

    The arguments are those of `process_video`; `results` does the work, then `report` sums it up.
    """

    def __init__(
        self,
        source: Source,
        detector: VideoDetector,
        *,
        target: str | os.PathLike[str] | None = None,
        start: float | None = None,
        end: float | None = None,
        audio: bool = True,
        preset: str = "veryfast",
        workers: int | None = None,
        frames: Frames = "none",
        strict: bool = False,
    ) -> None:
        start, end = check_span(start, end)
        check_choice(preset, "preset", PRESETS)
        n_workers = min(available_cores(), 4) if workers is None else check_integer(workers, "workers", low=1)
        for method in ("search", "track", "annotate", "reset"):
            if not callable(getattr(detector, method, None)):
                raise InvalidInputError(
                    "detector must have the methods search, track, annotate and reset, "
                    f"got {describe(detector)} without {method}; pass a VehicleDetector()"
                )
        output = None if target is None else _check_video_target(target)
        self._owned = not isinstance(source, FrameSource)
        self.source = open_source(source)
        with contextlib.ExitStack() as on_error:
            on_error.callback(self.close)
            if output is not None:
                _check_not_a_source(output, self.source.files)
            info = self.info = self.source.info
            first, count = frame_range(info, start, end)
            sound = _sound(self.source, first, end) if audio and output is not None else None
            drawn_shape = getattr(detector, "annotated_shape", lambda shape: shape)(info.shape)
            drawn = dataclasses.replace(info, height=drawn_shape[0], width=drawn_shape[1])
            self._total = count or max(info.frames - first, 0) or None
            self._frames, self._seconds, self._track_ids = 0, 0.0, set[int]()
            self._detector = detector
            fps = float(info.fps)
            interval = getattr(detector, "search_interval", lambda fps: 1)(fps)
            ahead = min(n_workers * interval, _LOOKAHEAD_BYTES // math.prod(info.shape))
            self._pipeline = FramePipeline(
                functools.partial(self.source.read, first, count, strict=strict),
                None if output is None else functools.partial(_open_writer, output, drawn, preset, sound),
                detector,
                n_workers,
                drawn_shape=drawn_shape,
                interval=interval,
                delay=0 if self.source.live else getattr(detector, "search_delay", lambda fps: 0)(fps),
                lookahead=max(n_workers, ahead) + 1,
                frames=frames,
            )
            on_error.pop_all()

    def results(self, *, progress: bool = False) -> Generator[tuple[NDArray[np.uint8] | None, Any]]:
        """Yield each frame, None unless `frames` asks for it, and its result; closing it stops everything."""
        self._detector.reset(fps=float(self.info.fps))
        started = logged = time.perf_counter()
        try:
            # The pipeline's threads use all cores; more threads would only compete with them.
            with (
                single_threaded_opencv(),
                progress_bar(progress, self._total, unit="frame", interactive_only=True) as bar,
                contextlib.closing(self._pipeline.run()) as results,
            ):
                for frame, result in results:
                    self._frames += 1
                    self._track_ids.update(track.id for track in shown_tracks(result))
                    yield frame, result
                    del frame, result
                    bar.update()
                    if progress and (now := time.perf_counter()) - logged >= _LOG_INTERVAL:
                        logged = now
                        self._log_progress(now - started)
        finally:
            self._seconds = time.perf_counter() - started

    def _log_progress(self, seconds: float) -> None:
        length = f" of {self._position(self._total)}" if self._total else ""
        rate = self._frames / seconds
        _LOGGER.info("%s%s, %.0f frames/s", self._position(self._frames), length, rate)

    def _position(self, frames: int) -> str:
        """Return the length of a number of frames in minutes and seconds."""
        minutes, seconds = divmod(int(frames / self.info.fps), 60)
        return f"{minutes}:{seconds:02d}"

    def report(self) -> VideoReport:
        """Return counts and times of the finished pass."""
        return VideoReport(
            frames=self._frames,
            fps=self.info.fps,
            shape=self.info.shape,
            seconds=self._seconds,
            stages=self._pipeline.stage_seconds,
            tracks=len(self._track_ids),
            dropped=self._pipeline.missed_frames,
            damage=self._pipeline.damage,
        )

    def stop(self) -> None:
        """End the source; the frames read so far complete the run."""
        self._pipeline.stop()

    def close(self) -> None:
        """Close the source, unless the caller opened it."""
        if self._owned:
            self.source.close()


@contextlib.contextmanager
def _stop_on_interrupt(run: VideoRun) -> Iterator[None]:
    """Let the first Ctrl-C end a live source, which has no other end; a second one interrupts the run."""
    if not run.source.live or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        signal.signal(signal.SIGINT, before)
        # In a thread: the handler may interrupt a thread that holds the locks which `stop` needs.
        threading.Thread(target=run.stop, name="vehicle-stop").start()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _sound(source: FrameSource, first: int, end: float | None) -> AudioSource | None:
    """Sound of a source from a frame up to an end in seconds."""
    return source.audio(first, None if end is None else float(Fraction(float(end)) - first / source.info.fps))


def cut_video(
    source: Source,
    target: str | os.PathLike[str],
    *,
    start: float | None = None,
    end: float | None = None,
    preset: str = "veryfast",
) -> int:
    """Copy a part of a video, with its sound, to another file; returns the number of frames.

    The arguments are those of `process_video`, and so are the errors.
    """
    start, end = check_span(start, end)
    check_choice(preset, "preset", PRESETS)
    output = _check_video_target(target)
    with borrow_source(source) as opened:
        _check_not_a_source(output, opened.files)
        first, count = frame_range(opened.info, start, end)
        with (
            opened.read(first, count) as frames,
            _open_writer(output, opened.info, preset, _sound(opened, first, end)) as writer,
        ):
            written = 0
            for _, _, frame in frames:
                writer.write(frame)
                written += 1
            writer.finish()
    return written


@contextlib.contextmanager
def _open_writer(
    target: Path, info: VideoInfo, preset: str, audio: AudioSource | None
) -> Iterator[FrameWriter]:
    """Open a video file that is written atomically."""
    with (
        atomic_write(target) as part,
        FrameWriter(part, info, name=str(target), preset=preset, audio=audio) as writer,
    ):
        yield writer


def _check_video_target(target: object) -> Path:
    path = check_target(check_path(target, "target", kind="the path of a video file"))
    if path.suffix.lower() not in CONTAINERS:
        raise InvalidInputError(
            f"target must end in {', '.join(CONTAINERS)}; got {path.name!r}, use {path.stem + '.mp4'!r}"
        )
    return path


def _check_not_a_source(target: Path, sources: Sequence[Path]) -> None:
    if target.exists() and any(target.samefile(source) for source in sources):
        raise InvalidInputError(f"target {target} is the source; choose another name")
