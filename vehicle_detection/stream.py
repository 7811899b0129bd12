"""`track`: the vehicles of any source, frame by frame."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_flags
from vehicle_detection.confidence import Model
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import FrameResult
from vehicle_detection.video import Source, VideoRun, open_viewer


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TrackedFrame(FrameResult):
    """One frame of `track` with its vehicles: a `FrameResult` that holds the frame, too.

    Attributes
    ----------
    frame
        ``(H, W, 3)`` uint8 RGB.

    Examples
    --------
    >>> (first,) = track("test_images/*.jpg", "highway", stream=True, end=0.04)
    >>> first, first.frame.shape
    (TrackedFrame(0 at 0.00 s: 2 detections, 2 vehicles shown), (720, 1280, 3))
    """

    time: float
    frame: NDArray[np.uint8]
    _detector: VehicleDetector

    @property
    def result(self) -> FrameResult:
        """The result without the frame."""
        return FrameResult(**{each.name: getattr(self, each.name) for each in fields(FrameResult)})

    @cached_property
    def picture(self) -> NDArray[np.uint8]:
        """A copy of the frame with its vehicles, drawn on first access and then kept."""
        return self._detector.annotate(self.frame, self)


@overload
def track(
    source: Source,
    model: str | os.PathLike[str] | Model | VehicleDetector = ...,
    *,
    stream: Literal[True],
    start: float | None = ...,
    end: float | None = ...,
    workers: int | None = ...,
    show: bool = ...,
    progress: bool = ...,
    **options: Any,
) -> Generator[TrackedFrame]: ...
@overload
def track(
    source: Source,
    model: str | os.PathLike[str] | Model | VehicleDetector = ...,
    *,
    stream: Literal[False] = ...,
    start: float | None = ...,
    end: float | None = ...,
    workers: int | None = ...,
    show: bool = ...,
    progress: bool = ...,
    **options: Any,
) -> list[FrameResult]: ...
@overload
def track(
    source: Source,
    model: str | os.PathLike[str] | Model | VehicleDetector = ...,
    *,
    stream: bool,
    start: float | None = ...,
    end: float | None = ...,
    workers: int | None = ...,
    show: bool = ...,
    progress: bool = ...,
    **options: Any,
) -> Generator[TrackedFrame] | list[FrameResult]: ...


def track(
    source: Source,
    model: str | os.PathLike[str] | Model | VehicleDetector = "default",
    *,
    stream: bool = False,
    start: float | None = None,
    end: float | None = None,
    workers: int | None = None,
    show: bool = False,
    progress: bool = False,
    **options: Any,
) -> Generator[TrackedFrame] | list[FrameResult]:
    """Track the vehicles of a video or of any other source.

    Parameters
    ----------
    source
        A video file, a folder or pattern, ``"-"``, a camera, a URL, or what `open_source` returns.
    model
        A model as in `VehicleDetector`, or a detector, whose state is used.
    stream
        True: return a generator of frames, for long videos and live sources. False: process the whole source
        and return the list of its results, without the frames.
    start, end
        Time range in seconds: frames with ``start <= time < end`` are processed. None: no limit.
    workers
        Number of frames searched in parallel; None: one per core, at most four. The results do not depend on
        it.
    show
        Show the annotated frames in a window, or in a notebook below the cell. Closing the window, or the key
        Escape, ends the results.
    progress
        As in `process_video`.
    **options
        Further arguments of `VehicleDetector`, such as ``horizon``, ``camera`` and ``every``.

    Returns
    -------
    generator of TrackedFrame, or list of FrameResult
        Every frame in order, the same as with `process_video`. Closing the generator, deleting it or leaving
        its loop ends all processes and threads.

    Raises
    ------
    InvalidInputError
        If an argument is invalid.
    VideoError
        If the source cannot be decoded; while reading, if a server sends only a part of it.

    Examples
    --------
    >>> for result in track("test_images/*.jpg", "highway", stream=True, end=0.08):
    ...     print(result.index, result.time, result.picture.shape, len(result.detections))
    0 0.0 (720, 1280, 3) 2
    1 0.04 (720, 1280, 3) 0
    """
    check_flags(stream=stream, show=show, progress=progress)
    given = isinstance(model, VehicleDetector)
    if given and options:
        raise InvalidInputError(
            f"model is a detector, which has its options already; got {', '.join(options)} in addition, pass "
            "them to the detector"
        )
    detector = model if isinstance(model, VehicleDetector) else VehicleDetector(model, **options)
    frames: Literal["none", "plain"] = "plain" if stream or show else "none"
    try:
        run = VideoRun(source, detector, start=start, end=end, workers=workers, frames=frames)
    except BaseException:
        if not given:
            detector.close()
        raise
    results = _frames(run, detector, close=not given, show=show, progress=progress)
    next(results)  # enter the generator: closing it now closes the source
    if stream:
        return results  # type: ignore[return-value]
    if run.source.live and end is None:
        results.close()
        raise InvalidInputError(
            f"source {run.source.name} has no end, so its results cannot be listed; pass stream=True, "
            "or an end in seconds"
        )
    return [each.result if isinstance(each, TrackedFrame) else each for each in results if each is not None]


def _frames(
    run: VideoRun, detector: VehicleDetector, *, close: bool, show: bool, progress: bool
) -> Generator[FrameResult | None]:
    """Yield None once, then the results, with frames if the run keeps them; close everything at the end."""
    with contextlib.ExitStack() as stack:
        if close:
            stack.callback(detector.close)
        stack.callback(run.close)
        yield None
        viewer = stack.enter_context(contextlib.closing(open_viewer(run.source.name))) if show else None
        results = stack.enter_context(contextlib.closing(run.results(progress=progress)))
        for frame, result in results:
            if frame is None:
                yield result
                continue
            tracked = TrackedFrame(**vars(result), frame=frame, _detector=detector)
            if viewer is not None:
                viewer.show(tracked.picture)
            yield tracked
            if viewer is not None and viewer.closed:
                break
