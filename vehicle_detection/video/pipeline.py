"""The threads of a video run: decode, search frames in parallel, track and draw in order, encode."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import call_in_thread, describe
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.images import is_cut, make_thumbnail
from vehicle_detection.video.streams import FrameWriter, Reader

Item = TypeVar("Item")
Frame = NDArray[np.uint8]
Frames = Literal["none", "plain", "drawn"]
"""Which frames come with the results."""


class VideoDetector(Protocol):
    """The methods of a detector that :func:`process_video` calls, such as :class:`VehicleDetector`."""

    def search(self, frame: Frame, /) -> Any:
        """Search one frame; called from several threads, and before earlier frames are tracked."""

    def track(self, found: Any, /, *, time: float | None) -> Any:
        """Update the tracks with a frame's search result, in frame order, and return the frame's result.

        Its ``tracks`` have an ``id`` each; its ``seconds`` map each stage to its time.
        """

    def annotate(self, frame: Frame, result: Any, /) -> Frame:
        """Draw a result on a copy of its frame.

        If the copy has another shape, a method ``annotated_shape`` returns it for that of a frame.
        """

    def reset(self, *, fps: float) -> None:
        """Forget all frames."""


class IntervalDetector(VideoDetector, Protocol):
    """A detector that need not search every frame."""

    def search_interval(self, fps: float, /) -> int:
        """Interval of the frames to search, at a frame rate."""

    def skip(self, thumbnail: NDArray[np.float32], /) -> None:
        """Count the next frame, which is not searched."""

    def interpolate(self, before: Any, after: Any, times: Sequence[float], /) -> list[Any]:
        """Results of the frames at `times` between two searched frames; `after` may be None."""

    def search_delay(self, fps: float, /) -> int:
        """Return how many searched frames to hold back, so that `backfill` can change their results."""

    def backfill(self, results: Sequence[Any], /) -> list[Any]:
        """Results of consecutive searched frames, changed by what is known since the last one."""


@dataclass
class _TrackedFrame:
    """A searched frame, and those before it that were not searched."""

    between: list[_QueuedFrame]
    item: _QueuedFrame
    result: Any


@dataclass
class _QueuedFrame:
    time: float
    frame: Frame | None  # None if it is neither drawn nor asked for
    thumbnail: NDArray[np.float32]
    search: Future[tuple[Any, float]] | None  # None: the frame is not searched
    missed: int = 0  # frames that a live source dropped before this one
    last_thumbnail: NDArray[np.float32] | None = None  # of the frame before


class QueueClosed(Exception):  # noqa: N818 - a signal between threads, not an error
    """The other side has closed the queue."""


class ClosableQueue(Generic[Item]):
    """A bounded queue between two threads that either side can close.

    With ``queue.Queue`` a producer would wait forever for a consumer that has failed.
    """

    def __init__(self, size: int) -> None:
        self._items: deque[Item] = deque()
        self._size = size
        # Used instead of the condition's own __enter__, whose interrupt could leave the lock acquired.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._finished = self._aborted = False
        self._error: BaseException | None = None

    def put(self, item: Item) -> None:
        """Append an item when there is space; raise the error of `abort`, or `QueueClosed`."""
        with self._lock:
            while len(self._items) >= self._size and not self._aborted:
                self._changed.wait()
            if self._aborted:
                raise self._error or QueueClosed
            self._items.append(item)
            self._changed.notify_all()

    def finish(self, error: BaseException | None = None) -> None:
        """Close the queue after the last item; the consumer gets the remaining items, then the error."""
        with self._lock:
            self._finished = True
            self._error = self._error or error
            self._changed.notify_all()

    def abort(self, error: BaseException | None = None) -> None:
        """Close the queue for both sides at once; waiting items are dropped."""
        with self._lock:
            self._aborted = True
            self._error = self._error or error
            self._items.clear()
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Item]:
        while True:
            with self._lock:
                while not self._items and not self._finished and not self._aborted:
                    self._changed.wait()
                if not self._items:
                    if self._aborted or self._error is not None:
                        raise self._error or QueueClosed
                    return
                item = self._items.popleft()
                self._changed.notify_all()
            yield item


class FramePipeline:
    """The threads that process a video.

    The decoding thread submits frames to the search workers and queues them in order; the tracking thread
    takes them from the queue, tracks and draws; the encoding thread writes to ffmpeg. The first error stops
    all of them. The calling thread only receives results: Python raises KeyboardInterrupt in the main thread,
    where it must not interrupt the start of a process or the removal of a file.

    `open_writer` returns a context that, on exit, completes the target or removes it after an error.

    With an `interval` above 1, only every n-th frame and the first one of each scene are searched. The frames
    between wait for the next searched frame, and get interpolated tracks. With a `delay` above 0, that many
    searched frames are held back, so that the detector can still change their results.

    `drawn_shape` is the shape of drawn frames, by default that of the frames themselves. Where a live source
    drops frames, the next frame is searched, and the written video repeats the last frame as often, so that
    its times stay those of the source.

    Up to `lookahead` frames are decoded before they are needed.
    """

    def __init__(
        self,
        open_reader: Callable[[], Reader],
        open_writer: Callable[[], AbstractContextManager[FrameWriter]] | None,
        detector: VideoDetector | IntervalDetector,
        workers: int,
        interval: int = 1,
        drawn_shape: tuple[int, ...] | None = None,
        *,
        delay: int = 0,
        lookahead: int = 8,
        frames: Frames = "none",
    ) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._open_reader, self._open_writer = open_reader, open_writer
        self._detector: Any = detector
        self._workers, self._interval, self._drawn_shape = workers, interval, drawn_shape
        self._frames, self._delay = frames, delay
        self._keeps_frames = open_writer is not None or frames != "none"
        self.missed_frames = 0
        """Number of frames that a live source dropped."""
        self._searched: ClosableQueue[_QueuedFrame] = ClosableQueue(lookahead)
        self._drawn: ClosableQueue[tuple[Frame, int]] = ClosableQueue(2)
        self._results: ClosableQueue[tuple[Frame | None, Any]] = ClosableQueue(4)
        self._reader: Reader | None = None
        self._streams: list[Reader | FrameWriter] = []
        self._lock = threading.Lock()
        self._aborted = self._stopped = False
        self.damage = ""
        """What is damaged in the source; known after the last frame."""

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds of work per stage, in the order of processing."""
        order = {"decode": -2, "search": -1, "draw": 1, "encode": 2}
        return dict(sorted(self._seconds.items(), key=lambda stage: order.get(stage[0], 0)))

    def run(self) -> Generator[tuple[Frame | None, Any]]:
        """Yield the plain or drawn frame (None unless `frames` asks for it) and the result of each frame.

        Closing the generator stops all threads.
        """
        thread = threading.Thread(target=self._track_in_thread, name="vehicle-track")
        try:
            call_in_thread(thread.start)
            yield from self._results
        finally:
            self._abort()  # no effect after a complete run
            if thread.is_alive():
                thread.join()

    def stop(self) -> None:
        """End the source, so that the run completes with the frames read so far."""
        with self._lock:
            self._stopped = True
            if self._reader is not None:
                self._reader.kill()

    def _abort(self) -> None:
        """Stop all threads and streams, and prevent new ones."""
        with self._lock:
            self._aborted = True
            streams = list(self._streams)
        for queue in (self._searched, self._drawn, self._results):
            queue.abort()
        for stream in streams:
            stream.kill()

    def _register(self, stream: Reader | FrameWriter) -> None:
        with self._lock:
            if self._aborted:
                raise QueueClosed
            self._streams.append(stream)

    def _track_in_thread(self) -> None:
        try:
            with contextlib.ExitStack() as stack:
                # Exit order: the threads end, then the pipes close, then an unfinished file is removed.
                writer = stack.enter_context(self._open_writer()) if self._open_writer else None
                reader = stack.enter_context(self._open_reader())
                for stream in (reader, writer):
                    if stream is not None:
                        self._register(stream)
                self._reader = reader
                self._run_threads(reader, writer)
        except QueueClosed:
            return
        except BaseException as error:  # raised in the calling thread
            self._results.finish(error)
        else:
            self._results.finish()

    def _run_threads(self, reader: Reader, writer: FrameWriter | None) -> None:
        """Decode and encode in threads, search in a pool, and track and draw in this thread."""
        pool = ThreadPoolExecutor(self._workers, thread_name_prefix="vehicle-search")
        threads = [threading.Thread(target=self._decode, args=(reader, pool), name="vehicle-decode")]
        if writer is not None:
            threads.append(threading.Thread(target=self._encode, args=(writer,), name="vehicle-encode"))
        try:
            for thread in threads:
                thread.start()
            self._track_frames(draw=writer is not None)
            self._drawn.finish()
            for thread in threads:
                thread.join()
            for _ in self._drawn:  # raises an error of the encoding thread after the last frame
                pass
        finally:
            self._searched.abort()
            self._drawn.abort()
            for stream in self._streams:
                stream.kill()
            pool.shutdown(cancel_futures=True)
            for thread in threads:
                if thread.ident is not None:
                    thread.join()
        self.damage = reader.damage
        self._seconds["decode"] += reader.cpu_seconds
        if writer is not None:
            self._seconds["encode"] += writer.cpu_seconds

    def _track_frames(self, *, draw: bool) -> None:
        """Track the searched frames, and queue all frames in their order."""
        waiting: list[_QueuedFrame] = []
        held: deque[_TrackedFrame] = deque()
        before = None
        for item in self._searched:
            if item.search is None:
                waiting.append(item)
                continue
            held.append(_TrackedFrame(waiting, item, self._track(item, waiting)))
            waiting = []
            if self._delay:
                results = self._detector.backfill([tracked.result for tracked in held])
                for tracked, result in zip(held, results, strict=True):
                    tracked.result = result
            if len(held) > self._delay:
                before = self._emit_tracked(before, held.popleft(), draw=draw)
            del item  # free the frame before waiting for the next one
        while held:
            before = self._emit_tracked(before, held.popleft(), draw=draw)
        self._emit_between(before, None, waiting, draw=draw)

    def _emit_tracked(self, before: Any, tracked: _TrackedFrame, *, draw: bool) -> Any:
        """Queue a searched frame after those before it that were not searched; returns its result."""
        self._emit_between(before, tracked.result, tracked.between, draw=draw)
        self._emit(tracked.item, tracked.result, draw=draw)
        return tracked.result

    def _track(self, item: _QueuedFrame, waiting: list[_QueuedFrame]) -> Any:
        """Track a searched frame after the `waiting` ones, which are not searched."""
        assert item.search is not None
        try:
            found, seconds = item.search.result()
        except DetectorError as error:
            raise DetectorError(f"at {item.time:.2f} s: {error}") from error
        for skipped in waiting:
            self._detector.skip(skipped.thumbnail)
        if item.missed and hasattr(self._detector, "skip"):
            for _ in range(item.missed):
                self._detector.skip(item.last_thumbnail)
        self._seconds["search"] += seconds
        return self._detector.track(found, time=item.time)

    def _emit_between(self, before: Any, after: Any, waiting: list[_QueuedFrame], *, draw: bool) -> None:
        """Interpolate the results of the `waiting` frames, draw and queue them."""
        if waiting:
            results = self._detector.interpolate(before, after, [item.time for item in waiting])
            for item, result in zip(waiting, results, strict=True):
                self._emit(item, result, draw=draw)

    def _emit(self, item: _QueuedFrame, result: Any, *, draw: bool) -> None:
        """Draw a frame's result, and queue it."""
        for name, seconds in result.seconds.items():
            if name != "search":  # measured here, because a detector may omit it
                self._seconds[name] += seconds
        drawn = None
        if item.frame is not None and (draw or self._frames == "drawn"):
            drawn = self._draw(item.frame, result)
        if draw and drawn is not None:
            self._drawn.put((drawn, item.missed))
        self._results.put(({"none": None, "plain": item.frame, "drawn": drawn}[self._frames], result))

    def _decode(self, reader: Reader, pool: ThreadPoolExecutor) -> None:
        try:
            last, skipped, expected = None, 0, None
            for index, moment, frame in reader:
                if self._stopped:
                    break
                thumbnail = make_thumbnail(frame)
                skipped += 1
                missed = index - expected if expected is not None else 0
                if last is None or missed or skipped >= self._interval or is_cut(last, thumbnail):
                    search, skipped = pool.submit(self._search, frame), 0
                else:
                    search = None
                kept = frame if self._keeps_frames else None
                self._searched.put(_QueuedFrame(moment, kept, thumbnail, search, missed, last))
                del frame, kept
                self.missed_frames += missed
                last, expected = thumbnail, index + 1
        except QueueClosed:
            return
        except BaseException as error:  # raised in the tracking thread
            self._searched.finish(error)
        else:
            self._searched.finish()
        finally:
            self._seconds["decode"] += time.thread_time()

    def _search(self, frame: Frame) -> tuple[Any, float]:
        start = time.perf_counter()
        return self._detector.search(frame), time.perf_counter() - start

    def _draw(self, frame: Frame, result: Any) -> Frame:
        start = time.perf_counter()
        drawn = self._detector.annotate(frame, result)
        expected = self._drawn_shape or frame.shape
        if getattr(drawn, "shape", None) != expected or drawn.dtype != np.uint8:
            raise InvalidInputError(
                f"detector.annotate must return a {expected} uint8 array, got {describe(drawn)}; "
                "draw on a copy of the frame"
            )
        self._seconds["draw"] += time.perf_counter() - start
        return np.ascontiguousarray(drawn)

    def _encode(self, writer: FrameWriter) -> None:
        try:
            for drawn, missed in self._drawn:
                for _ in range(missed):
                    writer.repeat()
                writer.write(drawn)
            writer.finish(trim_sound=self._stopped)
        except QueueClosed:
            return
        except BaseException as error:  # raised in the tracking thread at its next frame
            self._drawn.abort(error)
        finally:
            self._seconds["encode"] += time.thread_time()
