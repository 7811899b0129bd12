"""Finds tracks of what stands above the road, such as signs: it rises in the image as it comes nearer.

The image of what moves straight towards the camera spreads from the focus of expansion, which is on the
horizon (Gibson, *The Perception of the Visual World*, 1950). The lower edge of a vehicle is below the horizon
by the height of its box times the ratio of the camera's height to the vehicle's. So a growing box sinks, at
least by its growth times that ratio for the highest vehicles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import Floats
from vehicle_detection.camera import Camera, FrameShape, truncated_edges
from vehicle_detection.tracking.kalman_filter import boxes_from_states

# Growth per second from which on a track is judged, and height of the highest vehicles (m).
_MIN_GROWTH, _MAX_HEIGHT_M = 0.5, 4.0
# Speed (rad/s) at which a change of the camera's pitch may lift a vehicle in the image.
_PITCH_SPEED = 0.0125
# Distance from the left or right border, in widths, below which a box may grow because it enters the frame.
_BORDER = 0.25
# Time (s) over which the motion is measured.
_STEP = 0.1


def are_elevated(
    mean: Floats, frame: FrameShape, camera: Camera, horizon_px: float, lens: Camera | None = None
) -> NDArray[np.bool_]:
    """``(N,)``: whether tracks whose boxes have these states ``(N, 8)`` show what is above the road.

    Their boxes grow without sinking as those of vehicles do, and are not clearly below the horizon, which is
    above the row `horizon_px`. `camera` is a pinhole camera, and `lens` the fisheye camera whose rectified
    boxes it sees, if there is one.
    """
    boxes = boxes_from_states(mean)
    later = boxes_from_states(mean[:, :4] + _STEP * mean[:, 4:])
    distance = np.minimum(boxes[:, 0], frame[1] - boxes[:, 2])
    enters = (distance < _BORDER * (boxes[:, 2] - boxes[:, 0])) | truncated_edges(boxes, frame).any(axis=1)
    if lens is not None:
        boxes, later = lens.rectify_boxes(boxes, frame), lens.rectify_boxes(later, frame)
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    growth = (later[:, 2:] - later[:, :2] - sides) / _STEP
    sinking = (later[:, 3] - boxes[:, 3]) / _STEP
    min_ratio = camera.height_m / _MAX_HEIGHT_M
    grows = (growth > _MIN_GROWTH * sides).all(axis=1)
    rises = sinking < min_ratio * growth[:, 1] - _PITCH_SPEED * camera.focal_px
    is_high = boxes[:, 3] < horizon_px + min_ratio * sides[:, 1]
    return np.asarray(grows & rises & is_high & ~enters)
