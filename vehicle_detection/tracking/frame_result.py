"""`FrameResult`: what a detector has found in one frame of a video."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vehicle_detection._common import pluralize
from vehicle_detection.boxes import Detections
from vehicle_detection.tracking.track import Track


@dataclass(frozen=True, eq=False, repr=False)
class FrameResult:
    """The result of one frame of a video.

    Attributes
    ----------
    index
        Number of the frame since the last reset, from 0.
    time
        Time of the frame in seconds; None if unknown.
    windows
        Positive windows of this frame.
    detections
        Boxes of this frame, before tracking.
    tracks
        All tracks; those with ``track.shown`` are vehicles to draw.
    seconds
        Time spent per stage: ``"search"``, ``"regions"``, ``"track"``.
    searched
        Whether the frame was searched. If not, it has neither windows nor detections, and its tracks are
        interpolated or predicted.
    """

    index: int
    time: float | None
    windows: Detections
    detections: Detections
    tracks: tuple[Track, ...]
    seconds: dict[str, float] = field(default_factory=dict)
    searched: bool = True

    @property
    def shown(self) -> tuple[Track, ...]:
        """The tracks to draw."""
        return tuple(track for track in self.tracks if track.shown)

    def __repr__(self) -> str:
        time = "" if self.time is None else f" at {self.time:.2f} s"
        found = pluralize(len(self.detections), "detection") if self.searched else "not searched"
        shown = f"{pluralize(len(self.shown), 'vehicle')} shown"
        return f"{type(self).__name__}({self.index}{time}: {found}, {shown})"

    def to_supervision(self) -> Any:
        """Convert the shown tracks to ``supervision.Detections`` with their ids as ``tracker_id``."""
        boxes = np.array([track.box for track in self.shown]).reshape(-1, 4)
        confidences = [track.confidence for track in self.shown]
        known = None if None in confidences else np.array(confidences, np.float64)
        found = Detections(boxes, np.array([track.score for track in self.shown]), known)
        return found.to_supervision(tracker_id=[track.id for track in self.shown])
