"""Estimate the horizon of a video before searching it."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import HorizonEstimate, estimate_horizon
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.reading import check_span, frame_range
from vehicle_detection.video.sources import Source, borrow_source

_MAX_STD = 0.05  # as a fraction of the frame's height
# Seconds between searched frames, their number at least (in a short video) and at most, and the number of
# boxes that suffices.
_INTERVAL, _MIN_FRAMES, _MAX_FRAMES, _ENOUGH_BOXES = 0.5, 15, 60, 150


class ImageDetector(Protocol):
    """Detects the vehicles of single images, such as :class:`VehicleDetector`."""

    def detect(self, image: NDArray[np.uint8], /) -> Detections:
        """Return the vehicles of an ``(H, W, 3)`` uint8 RGB image."""


def estimate_video_horizon(
    source: Source, detector: ImageDetector, *, start: float | None = None, end: float | None = None
) -> HorizonEstimate | None:
    """Estimate the horizon from the vehicles in two frames per second of the first 30 seconds after `start`.

    In a video of less than 7.5 seconds, frames follow one another faster. None if there are too few vehicles,
    or if the estimate is too uncertain.
    """
    boxes: list[NDArray[np.floating]] = []
    start, end = check_span(start, end)
    with borrow_source(source) as opened:
        if not opened.rereadable:
            raise InvalidInputError(
                f"horizon cannot be estimated from {opened.name}, which is read only once; pass a fraction"
            )
        shape, step = opened.info.shape, _step(opened.info, start, end)
        with opened.read(*frame_range(opened.info, start, end)) as frames:
            for count, (_, _, frame) in enumerate(frames):
                if count >= step * _MAX_FRAMES or sum(map(len, boxes)) >= _ENOUGH_BOXES:
                    break
                if count % step == 0:
                    boxes.append(detector.detect(frame).boxes)
    try:
        found = estimate_horizon(np.concatenate(boxes), shape)
    except InvalidInputError:  # too few boxes
        return None
    return found if found.horizon_std <= _MAX_STD and 0 <= found.horizon <= 1 else None


def _step(info: VideoInfo, start: float | None, end: float | None) -> int:
    """Frames from one searched frame to the next."""
    fps = float(info.fps)
    seconds = min(info.frames / fps, math.inf if end is None else end) - (start or 0.0)
    return max(1, round(fps * min(_INTERVAL, seconds / _MIN_FRAMES)))
