"""Estimate the horizon of a video before searching it."""

from __future__ import annotations

import itertools
import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import HorizonEstimate, estimate_horizon
from vehicle_detection.video.opening import Source, borrow_source
from vehicle_detection.video.reading import check_span, frame_range

_MAX_STD = 0.05  # as a fraction of the frame's height
# Seconds between searched frames, their number at least (in a short video) and at most, and the number of
# boxes that suffices.
_INTERVAL, _MIN_FRAMES, _MAX_FRAMES, _ENOUGH_BOXES = 0.5, 15, 60, 150


class ImageDetector(Protocol):
    """Detects the vehicles of single images, such as :class:`VehicleDetector`."""

    def detect(self, image: NDArray[np.uint8], /) -> Detections:
        """Return the vehicles of an ``(H, W, 3)`` uint8 RGB image."""


def estimate_video_horizon(
    source: Source,
    detector: ImageDetector,
    *,
    height_m: float | None = None,
    start: float | None = None,
    end: float | None = None,
) -> HorizonEstimate | None:
    """Estimate the horizon from the vehicles in two frames per second of the first 30 seconds after `start`.

    `height_m` is the height of the camera above the road, if known. In a video of less than 7.5 seconds,
    frames follow one another faster. None if there are too few vehicles,
    or if the estimate is too uncertain.
    """
    boxes: list[NDArray[np.floating]] = []
    start, end = check_span(start, end)
    with borrow_source(source) as opened:
        if not opened.rereadable:
            raise InvalidInputError(
                f"horizon cannot be estimated from {opened.name}, which is read only once; pass a fraction"
            )
        info, fps = opened.info, float(opened.info.fps)
        seconds = min(info.frames / fps, math.inf if end is None else end) - (start or 0.0)
        step = max(1, round(fps * min(_INTERVAL, seconds / _MIN_FRAMES)))
        with opened.read(*frame_range(info, start, end)) as frames:
            for _, _, frame in itertools.islice(frames.decoded(), 0, step * _MAX_FRAMES, step):
                boxes.append(detector.detect(frame.rgb()).boxes)
                if sum(map(len, boxes)) >= _ENOUGH_BOXES:
                    break
    try:
        found = estimate_horizon(np.concatenate(boxes), info.shape, height_m=height_m)
    except InvalidInputError:  # too few boxes
        return None
    return found if found.horizon_std <= _MAX_STD and 0 <= found.horizon <= 1 else None
