"""The horizon of a video, found out before it is searched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.camera import HorizonEstimate, estimate_horizon
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.process import read_frames

LARGEST_ERROR = 0.05
"""Standard error, as a share of the frame's height, above which an estimate is a guess."""

# Heights in meters at which a camera may be: what vehicles tell that are seen from the side, or all about as
# far away, lies outside.
_LOWEST, _HIGHEST = 0.6, 4.0
# Seconds from one frame that is looked at to the next; frames and boxes that are enough.
_EVERY, _FRAMES, _BOXES = 0.5, 60, 150


def estimate_video_horizon(
    source: Path, detector: VehicleDetector, *, start: float | None = None, end: float | None = None
) -> HorizonEstimate | None:
    """Estimate the horizon of a video from the vehicles in its first half minute, two frames a second.

    Parameters
    ----------
    source
        The video.
    detector
        Searches the frames; its state is not used.
    start, end
        Seconds between which to look.

    Returns
    -------
    HorizonEstimate or None
        None where the vehicles do not tell the horizon: too few of them, all about as far away, or such as
        would put the camera where none is.

    Raises
    ------
    InvalidInputError, VideoError
        As from `read_frames`.
    """
    boxes: list[NDArray[np.floating]] = []
    with read_frames(source, start=start, end=end) as frames:
        shape, step = frames.info.shape, max(1, round(_EVERY * float(frames.info.fps)))
        for count, (_, _, frame) in enumerate(frames):
            if count >= step * _FRAMES or sum(map(len, boxes)) >= _BOXES:
                break
            if count % step == 0:
                boxes.append(detector.detect(frame).boxes)
    try:
        found = estimate_horizon(np.concatenate(boxes), shape)
    except InvalidInputError:
        return None
    likely = found.horizon_std <= LARGEST_ERROR and _LOWEST <= found.camera_height_m <= _HIGHEST
    return found if likely and 0 <= found.horizon <= 1 else None
