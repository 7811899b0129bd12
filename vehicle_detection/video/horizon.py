"""Estimate the horizon of a video before searching it."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import Detections
from vehicle_detection.camera import HorizonEstimate, estimate_horizon
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.process import read_frames

_MAX_STD = 0.05  # as a fraction of the frame's height
# Camera heights in meters; side views, or vehicles that are all equally far away, give others.
_MIN_CAMERA_HEIGHT, _MAX_CAMERA_HEIGHT = 0.6, 4.0
# Seconds between searched frames, their maximum number, and the number of boxes that suffices.
_INTERVAL, _MAX_FRAMES, _ENOUGH_BOXES = 0.5, 60, 150


class ImageDetector(Protocol):
    """Detects the vehicles of single images, such as :class:`VehicleDetector`."""

    def detect(self, image: NDArray[np.uint8], /) -> Detections:
        """Return the vehicles of an ``(H, W, 3)`` uint8 RGB image."""


def estimate_video_horizon(
    source: Path, detector: ImageDetector, *, start: float | None = None, end: float | None = None
) -> HorizonEstimate | None:
    """Estimate the horizon from the vehicles in two frames per second of the first 30 seconds after `start`.

    None if there are too few vehicles, or if the estimate is too uncertain or implies an implausible camera
    height.
    """
    boxes: list[NDArray[np.floating]] = []
    with read_frames(source, start=start, end=end) as frames:
        shape, step = frames.info.shape, max(1, round(_INTERVAL * float(frames.info.fps)))
        for count, (_, _, frame) in enumerate(frames):
            if count >= step * _MAX_FRAMES or sum(map(len, boxes)) >= _ENOUGH_BOXES:
                break
            if count % step == 0:
                boxes.append(detector.detect(frame).boxes)
    try:
        found = estimate_horizon(np.concatenate(boxes), shape)
    except InvalidInputError:  # too few boxes, or all of one width
        return None
    plausible = (
        found.horizon_std <= _MAX_STD and _MIN_CAMERA_HEIGHT <= found.camera_height_m <= _MAX_CAMERA_HEIGHT
    )
    return found if plausible and 0 <= found.horizon <= 1 else None
