"""A vehicle of a video, as the tracker tells of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
State = Literal["tentative", "confirmed", "coasting"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """A vehicle as it stands after one frame.

    Attributes
    ----------
    id
        Number of the vehicle, from 1 in the order in which they were believed; 0 while tentative.
    box
        ``(4,)`` float64 box inside the frame; read-only.
    score
        Running mean of the detections' scores, in which a frame without a detection counts as 0.
    state
        ``"tentative"`` (not yet believed), ``"confirmed"`` (seen in this frame) or ``"coasting"`` (believed,
        but not seen in this frame: the box is a prediction).
    shown
        Whether to draw it.
    age
        Seconds since the first detection.
    misses, unseen
        Frames and seconds since the last detection.
    velocity
        Velocity of the box's centre in pixels a second, right and down.
    distance_m, distance_error_m
        Distance along the road in metres and its standard error; None where it is unknown.
    speed_mps, speed_error_mps
        Speed relative to the camera in metres a second, positive when moving away, and its standard error;
        None where it is unknown.
    """

    id: int
    box: Floats
    score: float
    state: State
    shown: bool
    age: float
    misses: int
    unseen: float
    velocity: tuple[float, float]
    distance_m: float | None = None
    distance_error_m: float | None = None
    speed_mps: float | None = None
    speed_error_mps: float | None = None
