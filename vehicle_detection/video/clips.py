"""Annotate clips of moviepy."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.tracking import USUAL_FPS, FrameResult

Clip = TypeVar("Clip")

# Frames: rounding error of a time times the frame rate, as in moviepy.
_FRAME_TOLERANCE = 1e-5


def annotate_clip(
    clip: Clip, detector: Any, *, every: int = 1, on_result: Callable[[FrameResult], object] | None = None
) -> Clip:
    """Annotate a moviepy clip: a new clip with the same duration, frame rate and audio.

    The new clip has tracks of its own, numbered from 1; those of the detector and of other clips are neither
    used nor changed. Frames are processed when they are read, with their times in `clip`. Before and after,
    every method and effect of moviepy applies, such as ``subclipped``, ``resized`` and
    ``concatenate_videoclips``. Change the speed afterwards: the estimated speeds are those of `clip`.

    Parameters
    ----------
    clip, detector
        A video clip of moviepy 2, and a `VehicleDetector`.
    every
        Search every n-th frame, to save time; the tracks of the frames between are predicted.
    on_result
        Function that is called with the result of each processed frame. moviepy may read a frame more than
        once: for a preview, a second rendering, or effects such as ``Loop``. A result with the index 0 is the
        first one of another pass; drop the results before it.

    Returns
    -------
    moviepy.VideoClip
        Reading frames in ascending order tracks the vehicles. The frame that was read last is not processed
        again. Going back in time, as a second rendering does, forgets all frames and starts anew; its result
        equals that of the first. Skipping more than ``track_params.max_gap`` seconds ends all tracks.

    Examples
    --------
    >>> from moviepy import VideoFileClip  # doctest: +SKIP
    >>> clip = VideoFileClip("drive.mp4").subclipped(2, 12)  # doctest: +SKIP
    >>> annotate_clip(clip, VehicleDetector()).write_videofile("found.mp4")  # doctest: +SKIP
    """
    if not all(hasattr(detector, name) for name in ("process", "reset", "annotator")):
        raise invalid("detector", "be a VehicleDetector", detector)
    given: Any = clip
    if not all(hasattr(given, name) for name in ("transform", "get_frame", "size")):
        remedy = "pass VideoFileClip(path), or use process_video for a file"
        raise invalid("clip", "be a video clip of moviepy 2", clip, remedy)
    every = check.integer(every, "every", low=1, high=1000)
    check.function(on_result, "on_result", "a result")
    own, fps = copy.copy(detector), getattr(given, "fps", None)
    last_time: float | None = None
    count, picture = 0, np.empty(0, np.uint8)

    def annotate(get_frame: Callable[[float], NDArray[np.uint8]], t: float) -> NDArray[np.uint8]:
        """Return the annotated frame at `t` seconds."""
        nonlocal last_time, count, picture
        # Times within one frame, as in slow motion, show the same frame.
        time = float(t) if not fps else int(t * fps + _FRAME_TOLERANCE) / fps
        if time != last_time:
            if last_time is None or time < last_time:
                own.reset(fps=fps or USUAL_FPS)
                count = 0
            frame = get_frame(time)
            if frame.dtype != np.uint8:  # effects such as FadeIn return fractions of gray levels
                frame = np.clip(frame, 0, 255).astype(np.uint8)
            result = own.process(frame, time, search=count % every == 0)
            picture, last_time = own.annotate(frame, result), time
            count += 1
            if on_result is not None:
                on_result(result)
        return picture.copy()

    annotated: Clip = given.transform(annotate)
    return annotated
