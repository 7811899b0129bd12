"""`track`: the one engine that processes a source: decode, search in parallel, track in order.

The results do not depend on the number of `jobs`. In memory are the frames decoded ahead (`lookahead`),
those between two searched frames, and those held back for backfilling (`delay`).
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from fractions import Fraction
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol, Self
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    available_cores,
    call_in_thread,
    check,
    describe,
    pluralize,
    progress_bar,
    single_threaded_opencv,
    suggest_keywords,
)
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import (
    FrameResult,
    SceneCuts,
    backfill_results,
    interpolate_results,
    search_delay,
    search_interval,
)
from vehicle_detection.video.opening import Source, borrow_source
from vehicle_detection.video.queues import ClosableQueue, QueueClosed
from vehicle_detection.video.reading import AudioSource, Reader, check_span, frame_range
from vehicle_detection.video.sources import FrameSource
from vehicle_detection.video.yuv import DecodedFrame

if TYPE_CHECKING:
    import pandas

_LOGGER = logging.getLogger(__name__)

# Seconds between log lines on the progress.
_LOG_INTERVAL = 60.0
# Frames per second below which fast drives have false scene cuts.
_MIN_FPS = 5
# Maximum size of the frames that are decoded ahead of the search, unless each worker has only one.
_LOOKAHEAD_BYTES = 256 << 20

Frame = NDArray[np.uint8]


class VideoDetector(Protocol):
    """The methods of a detector that `track` calls, such as a `VehicleDetector`.

    It may have more attributes: `searches_every_frame`, whether no frame may be skipped (True if missing);
    `track_params`, the `TrackParams` for backfilling (none if missing); and `reduction`, a method that
    returns the whole factor by which frames of a shape are reduced before `search` (1 if missing).
    """

    def search(self, frame: Frame, /) -> Any:
        """Search one frame; called from several threads, and before earlier frames are tracked."""

    def track(self, found: Any, /, *, time: float | None, frames: int, cut: bool) -> Any:
        """Update the tracks with a frame's search result, in frame order, and return the frame's result.

        `frames` is 1 plus the number of unsearched frames before it; with `cut` it begins another scene.
        """

    def reset(self, *, fps: float) -> None:
        """Forget all frames."""


@dataclass(frozen=True, kw_only=True)
class VideoReport:
    """Counts and times of a run of `track` or `process_video`.

    The stages are ``"decode"``, ``"search"``, the detector's other stages, ``"draw"`` and ``"encode"``, which
    run in parallel; their times are processor time over all cores, with that of ffmpeg. The search has what
    no other stage of this process has used. The stage that waits least limits the speed.

    >>> stages, waiting = {"decode": 1.0, "search": 3.0, "encode": 4.0}, {"decode": 3.5, "encode": 0.5}
    >>> shape, fps = (720, 1280, 3), Fraction(25)
    >>> times = {"seconds": 5.0, "stages": stages, "waiting": waiting}
    >>> print(VideoReport(frames=250, fps=fps, shape=shape, tracks=2, **times))
    250 frames of 1280x720 in 5.0 s: 50.0 frames/s, 2.0 times real time, 2 vehicles
    stage    ms/frame  fraction  waiting
    decode       4.00     12.5%    14.00
    search      12.00     37.5%
    encode      16.00     50.0%     2.00
    """

    frames: int
    fps: Fraction  # exact frame rate of the video
    shape: tuple[int, int, int]  # of a frame: height, width and 3
    seconds: float  # elapsed time
    stages: Mapping[str, float]  # seconds of work
    tracks: int  # number of different tracks shown
    waiting: Mapping[str, float] = field(default_factory=dict)  # seconds that stages waited for others
    dropped: int = 0  # frames of a live source that were dropped because the search was busy
    damage: str = ""  # what is damaged in the source, such as missing frames; empty if nothing is

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
        (height, width, _), rate, fractions = self.shape, self.frames_per_second, self.stage_fractions
        dropped = f", {pluralize(self.dropped, 'frame')} dropped" if self.dropped else ""
        lines = [
            f"{pluralize(self.frames, 'frame')} of {width}x{height} in {self.seconds:.1f} s: {rate:.1f} "
            f"frames/s, {rate / self.fps:.1f} times real time, {pluralize(self.tracks, 'vehicle')}{dropped}",
            "stage    ms/frame  fraction" + "  waiting" * bool(self.waiting),
        ]
        scale = 1e3 / max(self.frames, 1)
        for name, seconds in self.stages.items():
            waiting = f" {self.waiting[name] * scale:>8.2f}" if name in self.waiting else ""
            lines.append(f"{name:<8} {seconds * scale:>8.2f} {fractions[name]:>9.1%}{waiting}")
        return "\n".join(lines)


@dataclass
class _QueuedFrame:
    time: float
    frame: DecodedFrame | None  # None if nobody asked for it
    cut: bool  # whether it begins another scene
    search: SimpleQueue[Future[Any]] | None  # gets the search when it is done; None: not searched
    dropped: int = 0  # frames that a live source dropped before this one


@dataclass(eq=False, kw_only=True)
class _Pipeline:
    """Decodes in a thread, searches in a pool, and tracks in the calling thread.

    Searched are: every n-th frame (`interval`), the first of each scene, and the first after dropped frames.
    The frames between wait for the next searched frame, and get interpolated tracks. With a `delay` above 0,
    that many searched frames are held back, because a track that is confirmed later is shown in them, too. Up
    to `lookahead` frames are decoded ahead.

    The decoding thread also starts and ends the reader: Python raises KeyboardInterrupt in the main thread,
    where it must not interrupt the start of a process. The first error stops everything.
    """

    source: FrameSource
    detector: Any
    first: int
    count: int | None
    jobs: int
    interval: int
    delay: int
    lookahead: int
    frames: bool  # whether the results hold their frames
    reduction: int  # factor by which frames are reduced before the search

    def __post_init__(self) -> None:
        self.stages: defaultdict[str, float] = defaultdict(float)
        self.waiting: dict[str, float] = {}
        self.searching = 0.0  # elapsed seconds of all searches
        self.decoding = 0.0  # processor time of the decoding thread
        self.dropped = 0  # frames that a live source dropped
        self.damage = ""  # what is damaged in the source; known after the last frame
        self._queue: ClosableQueue[_QueuedFrame] = ClosableQueue(self.lookahead)
        self._pool = ThreadPoolExecutor(self.jobs, thread_name_prefix="vehicle-search")
        self._reader: Reader | None = None
        self._lock = threading.Lock()
        self._aborted = self.stopped = False

    def run(self) -> Generator[Any]:
        """Yield the result of each frame, in order; closing the generator stops all threads."""
        thread = threading.Thread(target=self._decode_in_thread, name="vehicle-decode")
        try:
            call_in_thread(thread.start)
            yield from self._track_frames()
        finally:
            self._abort()  # no effect after a complete run
            if thread.is_alive():
                thread.join()

    def stop(self) -> None:
        """End the source, so that the run completes with the frames read so far."""
        with self._lock:
            self.stopped = True
            if self._reader is not None:
                self._reader.kill()

    def _abort(self) -> None:
        """Stop the decoding thread, the pool and the reader, or prevent them from starting."""
        with self._lock:
            self._aborted = True
            self._queue.abort()
            self._pool.shutdown(wait=False, cancel_futures=True)
            if self._reader is not None:
                self._reader.kill()

    def _decode_in_thread(self) -> None:
        error: BaseException | None = None
        started = time.perf_counter()
        try:
            with self.source.read(self.first, self.count) as reader:
                with self._lock:
                    if self._aborted:
                        return
                    self._reader = reader
                self._decode(reader)
            self.damage = reader.damage
            self.stages["decode"] += reader.cpu_seconds
        except QueueClosed:
            pass
        except BaseException as caught:  # raised in the calling thread after the frames before it
            error = caught
        finally:
            cpu = time.thread_time()
            self.waiting["decode"] = time.perf_counter() - started - cpu
            self.stages["decode"] += cpu
            self.decoding = cpu
            self._queue.finish(error)
            self._pool.shutdown()

    def _decode(self, reader: Reader) -> None:
        """Submit the frames to search to the pool, and queue all of them in order."""
        cuts, skipped, expected = SceneCuts(), 0, None
        running: deque[Future[Any]] = deque(maxlen=self.jobs)  # the last searches
        sample = SceneCuts.sample_size(self.source.info.shape)
        for index, moment, frame in reader.decoded():
            if self.stopped:
                break
            cut = cuts.update(frame.sampled(sample)) or index in self.source.breaks
            skipped += 1
            dropped = index - expected if expected is not None else 0
            search = None
            if expected is None or dropped or cut or skipped >= self.interval:
                if self.reduction == 1:  # once for the search and for drawing
                    frame = DecodedFrame(frame.rgb())
                search, skipped = SimpleQueue[Future[Any]](), 0
                running.append(self._pool.submit(self._search, frame))
                running[-1].add_done_callback(search.put)
            kept = frame if self.frames else None
            self._queue.put(_QueuedFrame(moment, kept, cut, search, dropped))
            del frame, kept
            self.dropped += dropped
            expected = index + 1
            if self.source.live and skipped + 1 >= self.interval:
                _wait_for_one(running)

    def _search(self, frame: DecodedFrame) -> tuple[Any, float]:
        start, factor = time.perf_counter(), self.reduction
        if factor == 1:
            found = self.detector.search(frame.rgb())
        else:
            found = self.detector.search(frame.reduced(factor)).enlarged(factor)
        return found, time.perf_counter() - start

    def _track_frames(self) -> Iterator[Any]:
        """Track the searched frames, and yield the results of all frames in their order."""
        block: list[_QueuedFrame] = []  # frames that are not searched, then one that is
        held: deque[tuple[list[_QueuedFrame], Any]] = deque()  # blocks with the results of searched frames
        before = None
        for item in self._queue:
            block.append(item)
            if item.search is None:
                continue
            held.append((block, self._track(item, len(block))))
            block = []
            if self.delay:
                results = backfill_results([result for _, result in held])
                held = deque((items, result) for (items, _), result in zip(held, results, strict=True))
            if len(held) > self.delay:
                items, result = held.popleft()
                yield from self._release(items, before, result)
                before = result
        for items, result in (*held, (block, None)):
            yield from self._release(items, before, result)
            before = result

    def _track(self, item: _QueuedFrame, frames: int) -> Any:
        """Track a searched frame, the last one of a block of `frames`."""
        assert item.search is not None
        try:
            found, seconds = item.search.get().result()  # does not wait: see `ClosableQueue`
        except DetectorError as error:
            raise DetectorError(f"at {item.time:.2f} s: {error}") from error
        self.searching += seconds
        return self.detector.track(found, time=item.time, frames=frames + item.dropped, cut=item.cut)

    def _release(self, items: list[_QueuedFrame], before: Any, result: Any) -> Iterator[Any]:
        """Yield the results of a block: interpolated ones, and that of its searched frame.

        `before` is the result of the searched frame before the block; without `result`, the source ends.
        """
        results = [] if result is None else [result]
        times = [item.time for item in items[: len(items) - len(results)]]
        if times:
            results = interpolate_results(before, result, times, self.source.info.shape) + results
        for item, each in zip(items, results, strict=True):
            for name, seconds in each.seconds.items():
                if name != "search":  # measured here, because a detector may omit it
                    self.stages[name] += seconds
            frame, item.frame = item.frame, None
            yield each if frame is None else replace(each, frame=frame.rgb())


def _wait_for_one(running: deque[Future[Any]]) -> None:
    """Wait until not all of the last searches run, so that the next one begins with the newest frame."""
    while len(running) == running.maxlen and not any(search.done() for search in running):
        wait(running, timeout=0.1, return_when=FIRST_COMPLETED)  # which does not notice cancelled ones


# The latest run of each detector, by its address: a run keeps its detector alive.
_LATEST_RUNS: WeakValueDictionary[int, TrackRun] = WeakValueDictionary()


class TrackRun(Closing):
    """Results of a source, frame by frame, as `track` returns it: an iterator and a context manager.

    Closing or deleting it ends all processes and threads; nothing is started before the first result. `info`
    holds the properties of the source's video, and `has_frames` says whether the results hold their frames.

    >>> with track("test_images/*.jpg", "highway", end=0.08) as run:
    ...     print(run.info.shape, [len(result.detections) for result in run])
    (720, 1280, 3) [2, 4]
    """

    def __init__(
        self, pipeline: _Pipeline, *, end: float | None, progress: bool, on_close: contextlib.ExitStack
    ) -> None:
        self.source, self.detector = pipeline.source, pipeline.detector
        self.info, self.has_frames = self.source.info, pipeline.frames
        self._end, self._progress = end, progress
        self._total = pipeline.count or max(self.info.frames - pipeline.first, 0) or None
        self._pipeline, self._results = pipeline, pipeline.run()
        # Detector and source; bar and threads. After the last result the source stays open for the sound.
        self._on_close, self._on_end = on_close, contextlib.ExitStack()
        self._entered = self.stopped = False
        self._frames, self._track_ids = 0, set[int]()
        self._started = self._logged = self._seconds = 0.0
        self._cpu_started = _processor_times()
        self._cpu: tuple[float, float] | None = None

    def __enter__(self) -> Self:
        self._entered = True  # the sound of the source may be read after the last result
        return self

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> FrameResult:
        if not self._started:
            self._start()
        elif not self._seconds and _LATEST_RUNS.get(id(self.detector)) is not self:
            self.close()
            raise InvalidInputError(
                "another run has begun to track with this detector; pass copy.copy(detector) to one of them"
            )
        try:
            result = next(self._results)
        except BaseException:
            self._on_end.close()
            if not self._entered:
                self.close()
            raise
        self._frames += 1
        self._track_ids.update(track.id for track in result.tracks if track.shown)
        self._bar.update()
        now = time.perf_counter()
        if self._progress and now - self._logged >= _LOG_INTERVAL:
            self._logged = now
            length = f" of {self._position(self._total)}" if self._total else ""
            rate = self._frames / (now - self._started)
            _LOGGER.info("%s%s, %.0f frames/s", self._position(self._frames), length, rate)
        return result  # type: ignore[no-any-return]

    def _start(self) -> None:
        # The pipeline's threads use all cores; more threads would only compete with them.
        self._on_end.enter_context(single_threaded_opencv())
        bar = progress_bar(self._progress, self._total, unit="frame", interactive_only=True)
        self._bar = self._on_end.enter_context(bar)
        self._on_end.callback(self._results.close)
        self.detector.reset(fps=float(self.info.fps))
        if self.info.fps < _MIN_FPS:
            text = "%s has %g frames/s: below %d, fast drives have false scene cuts, and vehicles count twice"
            _LOGGER.warning(text, self.source.name, self.info.fps, _MIN_FPS)
        _LATEST_RUNS[id(self.detector)] = self
        self._started = self._logged = time.perf_counter()
        self._cpu_started = _processor_times()

    def _position(self, frames: int) -> str:
        """Return the length of a number of frames in minutes and seconds."""
        minutes, seconds = divmod(int(frames / self.info.fps), 60)
        return f"{minutes}:{seconds:02d}"

    def to_pandas(self) -> pandas.DataFrame:
        """Process the source to its end; return a row per frame and shown track, as in files, and ``time_s``.

        Frame by frame, in constant memory, ``result.to_pandas()`` of each result returns the same rows.
        """
        with self:
            return TrackTable.from_results(self).to_pandas()

    def sound(self) -> AudioSource | None:
        """Return the sound of the frames; None if there is none."""
        return self.source.audio(self._pipeline.first, self._end)

    def report(self) -> VideoReport:
        """Return counts and times so far; the time of the run is complete once it is closed."""
        pipeline, seconds = self._pipeline, self._seconds or time.perf_counter() - self._started
        own, others = self._cpu or self._measure()
        pipeline.stages["search"] = max(others - pipeline.decoding, 0.0)
        waiting = {"search": seconds - pipeline.searching / pipeline.jobs, "track": seconds - own}
        order = {"decode": -2, "search": -1, "draw": 1, "encode": 2}
        stages = sorted(pipeline.stages.items(), key=lambda stage: order.get(stage[0], 0))
        return VideoReport(
            frames=self._frames,
            fps=self.info.fps,
            shape=self.info.shape,
            seconds=seconds,
            stages=dict(stages),
            waiting=pipeline.waiting | waiting,
            tracks=len(self._track_ids),
            dropped=self._pipeline.dropped,
            damage="; ".join(filter(None, (self._pipeline.damage, self.source.find_change()))),
        )

    def _measure(self) -> tuple[float, float]:
        """Processor time of the calling thread, and of the others, since the start."""
        own, others = (now - start for now, start in zip(_processor_times(), self._cpu_started, strict=True))
        return own, others

    def stop(self) -> None:
        """End the source, from any thread; the frames read so far complete the run."""
        self.stopped = True
        self._pipeline.stop()

    def close(self) -> None:
        """End all processes and threads."""
        if self._started and not self._seconds:
            self._seconds, self._cpu = time.perf_counter() - self._started, self._measure()
        self._on_end.close()
        self._on_close.close()

    def __del__(self) -> None:
        if hasattr(self, "_on_close"):
            self.close()


@suggest_keywords
def track(
    source: Source,
    detector: VideoDetector | str | os.PathLike[str] = "default",
    *,
    start: float | None = None,
    end: float | None = None,
    every: int | None = None,
    jobs: int | None = None,
    frames: bool = False,
    progress: bool = False,
) -> TrackRun:
    """Track the vehicles of a video or of any other source, frame by frame.

    Parameters
    ----------
    source
        A video file, a folder of images, a pattern, ``"-"``, a camera, a URL, or what `open_source` returns.
    detector
        A `VehicleDetector`, whose state is used, or the model of one; or another object with its methods
        ``search``, ``track`` and ``reset``.
    start, end
        Time range in seconds: frames with ``start <= time < end`` are processed. None: no limit.
    every
        Search every n-th frame; the tracks of the frames between are interpolated. None: at least 12 frames
        per second, but every frame where the detector or what is drawn needs it.
    jobs
        Number of frames searched in parallel; None: one per core, at most four. The results do not depend on
        it.
    frames
        Whether the results hold their frames (``result.frame``), to draw or write them.
    progress
        Show a progress bar in a terminal or a notebook, and log the progress once a minute (level INFO).

    Returns
    -------
    TrackRun
        An iterator of `FrameResult`. Closing it, deleting it or leaving its ``with`` block ends all processes
        and threads. It raises a `VideoError` where the source cannot be decoded.

    Examples
    --------
    >>> for result in track("test_images/*.jpg", "highway", end=0.08, frames=True):
    ...     print(result.index, result.time, result.frame.shape, len(result.detections))
    0 0.0 (720, 1280, 3) 2
    1 0.04 (720, 1280, 3) 4
    >>> track("test_images/*.jpg", "highway", end=0.08).to_pandas()[["frame", "track_id", "time_s"]].shape
    (5, 3)
    """
    check.flags(frames=frames, progress=progress)
    start, end = check_span(start, end)
    jobs = min(available_cores(), 4) if jobs is None else check.integer(jobs, "jobs", low=1)
    if every is not None:
        every = check.integer(every, "every", low=1, high=1000)
    with contextlib.ExitStack() as stack:
        found: Any = stack.enter_context(_open_detector(detector))
        opened = stack.enter_context(borrow_source(source))
        info = opened.info
        first, count = frame_range(info, start, end)
        fps = float(info.fps)
        interval = every or (1 if getattr(found, "searches_every_frame", True) else search_interval(fps))
        params = getattr(found, "track_params", None)
        reduction = getattr(found, "reduction", lambda shape: 1)(info.shape)
        ahead = min(jobs * interval, _LOOKAHEAD_BYTES // math.prod(info.shape))
        pipeline = _Pipeline(
            source=opened,
            detector=found,
            first=first,
            count=count,
            jobs=jobs,
            interval=interval,
            delay=0 if opened.live or params is None else search_delay(params, fps, interval),
            # A live source may send many frames at once at first, which would grow old in a long queue.
            lookahead=max(jobs - 1, 1) if opened.live else max(jobs, ahead) + 1,
            frames=frames,
            reduction=reduction,
        )
        return TrackRun(pipeline, end=end, progress=progress, on_close=stack.pop_all())


def _processor_times() -> tuple[float, float]:
    """Processor time in seconds of the calling thread, and of the other threads of this process."""
    own = time.thread_time()
    return own, time.process_time() - own


@contextlib.contextmanager
def _open_detector(detector: object) -> Iterator[Any]:
    """Yield a detector, or that of a model for the time of a block."""
    if isinstance(detector, (str, os.PathLike)):
        from vehicle_detection.detector import VehicleDetector

        with VehicleDetector(detector) as opened:
            yield opened
        return
    for method in ("search", "track", "reset"):
        if not callable(getattr(detector, method, None)):
            raise InvalidInputError(
                f"detector must have the methods search, track and reset, got {describe(detector)} without "
                f"{method}; pass a VehicleDetector(), or detector_from(function)"
            )
    yield detector
