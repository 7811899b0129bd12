"""The line of threads of a video: read, search side by side, follow and draw in order, write."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.streams import FrameReader, FrameWriter

Item = TypeVar("Item")
Frame = NDArray[np.uint8]


class SupportsTrack(Protocol):
    """A vehicle of one frame, as far as a video needs it."""

    @property
    def id(self) -> int:
        """Number that the vehicle keeps."""


class SupportsResult(Protocol):
    """What a detector says of one frame, as far as a video needs it."""

    @property
    def tracks(self) -> Sequence[SupportsTrack]:
        """The vehicles."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Time of each stage, by name."""


class SupportsFrames(Protocol):
    """What :func:`process_video` asks of a detector; :class:`VehicleDetector` is one."""

    def search(self, frame: Frame, /) -> Any:
        """Find windows in one frame; runs in any thread and ahead of the order."""

    def track(self, found: Any, /, *, time: float | None) -> Any:
        """Update the tracks with one frame's search result, in frame order, and return the frame's result."""

    def annotate(self, frame: Frame, result: Any, /) -> Frame:
        """Draw a result on a copy of its frame."""

    def reset(self, *, fps: float) -> None:
        """Forget all frames so far."""


class Closed(Exception):  # noqa: N818 - a signal between threads, not an error
    """The other side wants no more."""


class Channel(Generic[Item]):
    """A queue of bounded length between two threads, which either side can end.

    ``queue.Queue`` cannot: a producer would wait for ever for a consumer that has failed.
    """

    def __init__(self, size: int) -> None:
        self._items: deque[Item] = deque()
        self._size = size
        self._change = threading.Condition()
        self._finished = self._aborted = False
        self._error: BaseException | None = None

    def put(self, item: Item) -> None:
        """Add an item, waiting for room; an error of the other side is raised here."""
        with self._change:
            while len(self._items) >= self._size and not self._aborted:
                self._change.wait()
            if self._aborted:
                raise self._error or Closed
            self._items.append(item)
            self._change.notify_all()

    def finish(self, error: BaseException | None = None) -> None:
        """Say, as the producer, that no item follows; the consumer gets the rest, then the error."""
        with self._change:
            self._finished = True
            self._error = self._error or error
            self._change.notify_all()

    def abort(self, error: BaseException | None = None) -> None:
        """End both sides at once; waiting items are dropped."""
        with self._change:
            self._aborted = True
            self._error = self._error or error
            self._items.clear()
            self._change.notify_all()

    def __iter__(self) -> Iterator[Item]:
        while True:
            with self._change:
                while not self._items and not self._finished and not self._aborted:
                    self._change.wait()
                if not self._items:
                    if self._aborted or self._error is not None:
                        raise self._error or Closed
                    return
                item = self._items.popleft()
                self._change.notify_all()
            yield item


class Line:
    """The line of threads from one ffmpeg to the other.

    A reading thread hands frames to the workers and queues them in order; the following thread takes them
    from there, follows and draws; a writing thread feeds ffmpeg. Whichever fails first ends the others. The
    calling thread does nothing but take the results: Ctrl-C, which Python raises in the main thread wherever
    that may be, finds no process half started and no file half removed there.

    Parameters
    ----------
    open_reader
        Opens the source.
    open_writer
        Opens the target; on leaving its context the file must be whole, or gone after an error.
    """

    def __init__(
        self,
        open_reader: Callable[[], FrameReader],
        open_writer: Callable[[], AbstractContextManager[FrameWriter]] | None,
        detector: SupportsFrames,
        workers: int,
    ) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._open_reader, self._open_writer = open_reader, open_writer
        self._detector, self._workers = detector, workers
        self._found: Channel[tuple[float, Frame, Future[tuple[Any, float]]]] = Channel(workers + 1)
        self._drawn: Channel[Frame] = Channel(2)
        self._results: Channel[Any] = Channel(4)
        self._running: list[FrameReader | FrameWriter] = []
        self._starting = threading.Lock()
        self._aborted = False

    @property
    def stages(self) -> dict[str, float]:
        """Seconds of work of each stage, in the order in which a frame passes them."""
        ends = {"decode": -2, "search": -1, "draw": 1, "encode": 2}
        return dict(sorted(self._seconds.items(), key=lambda stage: ends.get(stage[0], 0)))

    def run(self) -> Generator[Any]:
        """Yield the result of each frame, in order; closing the generator ends everything at once."""
        follower = threading.Thread(target=self._follow, name="vehicle-follow")
        try:
            follower.start()
            yield from self._results
        finally:
            self._abort()  # on the good way out nothing runs any more
            if follower.is_alive():
                follower.join()

    def _abort(self) -> None:
        """End what runs and let nothing start any more."""
        with self._starting:
            self._aborted = True
            running = list(self._running)
        for channel in (self._found, self._drawn, self._results):
            channel.abort()
        for stream in running:
            stream.kill()

    def _register(self, stream: FrameReader | FrameWriter) -> None:
        with self._starting:
            if self._aborted:
                raise Closed
            self._running.append(stream)

    def _follow(self) -> None:
        try:
            with contextlib.ExitStack() as stack:
                # The threads have ended before the pipes close, and those before an unfinished file goes.
                writer = stack.enter_context(self._open_writer()) if self._open_writer else None
                reader = stack.enter_context(self._open_reader())
                for stream in (reader, writer):
                    if stream is not None:
                        self._register(stream)
                self._flow(reader, writer)
        except Closed:
            return
        except BaseException as error:  # the calling thread raises it
            self._results.finish(error)
        else:
            self._results.finish()

    def _flow(self, reader: FrameReader, writer: FrameWriter | None) -> None:
        """Let all frames pass."""
        pool = ThreadPoolExecutor(self._workers, thread_name_prefix="vehicle-search")
        threads = [threading.Thread(target=self._read, args=(reader, pool), name="vehicle-decode")]
        if writer is not None:
            threads.append(threading.Thread(target=self._write, args=(writer,), name="vehicle-encode"))
        try:
            for thread in threads:
                thread.start()
            for moment, frame, search in self._found:
                windows, seconds = search.result()
                result = self._detector.track(windows, time=moment)
                self._count(result, seconds)
                if writer is not None:
                    self._drawn.put(self._draw(frame, result))
                del frame, windows, search  # not one frame more in memory than needed
                self._results.put(result)
            self._drawn.finish()
            for thread in threads:
                thread.join()
            for _ in self._drawn:  # raises what the writing thread met after the last frame
                pass
        finally:
            self._found.abort()
            self._drawn.abort()
            for stream in self._running:
                stream.kill()
            pool.shutdown(cancel_futures=True)
            for thread in threads:
                if thread.ident is not None:
                    thread.join()
        self._seconds["decode"] += reader.cpu_seconds
        if writer is not None:
            self._seconds["encode"] += writer.cpu_seconds

    def _read(self, reader: FrameReader, pool: ThreadPoolExecutor) -> None:
        try:
            for _, moment, frame in reader:
                self._found.put((moment, frame, pool.submit(self._search, frame)))
        except Closed:
            return
        except BaseException as error:  # the following thread raises it
            self._found.finish(error)
        else:
            self._found.finish()
        finally:
            self._seconds["decode"] += time.thread_time()

    def _search(self, frame: Frame) -> tuple[Any, float]:
        began = time.perf_counter()
        return self._detector.search(frame), time.perf_counter() - began

    def _count(self, result: SupportsResult, search_seconds: float) -> None:
        self._seconds["search"] += search_seconds
        for name, seconds in result.seconds.items():
            if name != "search":  # measured here, as a detector may leave it out
                self._seconds[name] += seconds

    def _draw(self, frame: Frame, result: Any) -> Frame:
        began = time.perf_counter()
        picture = self._detector.annotate(frame, result)
        if getattr(picture, "shape", None) != frame.shape or picture.dtype != np.uint8:
            raise InvalidInputError(
                f"detector.annotate must return a {frame.shape} uint8 array, got {describe(picture)}; "
                "draw on a copy of the frame"
            )
        self._seconds["draw"] += time.perf_counter() - began
        return np.ascontiguousarray(picture)

    def _write(self, writer: FrameWriter) -> None:
        try:
            for picture in self._drawn:
                writer.write(picture)
            writer.finish()
        except Closed:
            return
        except BaseException as error:  # the following thread raises it at its next frame
            self._drawn.abort(error)
        finally:
            self._seconds["encode"] += time.thread_time()
