"""Tracks: their parameters, and what users see of them after a frame."""

from __future__ import annotations

import time as clock
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, fields, invalid, pluralize
from vehicle_detection.boxes import Detections

if TYPE_CHECKING:
    import pandas

TRACK_VALUES = ("score", "distance_m", "speed_mps", "confidence", "distance_std_m", "speed_std_mps", "label")
"""What tables state of a track besides its id and box, in the order of their columns."""
UNKNOWN_LABEL = "vehicle"
"""Class of a vehicle whose kind is unknown."""
USUAL_FPS = 25.0
"""Frame rate that is assumed where it is unknown."""
TIME_TOLERANCE = 1e-6
"""Float tolerance in seconds when comparing summed frame times with a limit."""


@dataclass(frozen=True, kw_only=True)
class TrackParams(fields.Checked):
    """How detections become tracks; times are in seconds of the video, sizes in fractions of a box's size.

    Attributes
    ----------
    score_time_constant
        Time constant of the exponential moving average of a track's scores.
    high_threshold, low_threshold
        Detections from `high_threshold` on can start tracks. Detections between the two thresholds only
        continue tracks that have no better detection, and confirmed tracks only within half of
        `max_distance` and at an IoU of at least 0.5 (as in ByteTrack). Lower ones are dropped.
    confirm_score
        Average score at which a track is confirmed. A vehicle with constant score `s` reaches it after
        ``score_time_constant * log(s / (s - confirm_score))`` seconds, and never if `s` is lower.
    confirm_hits, confirm_seconds
        Minimum number of detections beyond the number of frames without one, and minimum time since the first
        one, before a track is confirmed.
    instant_confirm_score
        In the first frame, and in the first one after a scene cut, a detection with this score is confirmed
        at once, because no earlier frame could have shown it.
    tentative_coast, max_coast, max_hidden
        A tentative and a confirmed track end after these times without a detection; a vehicle that is
        detected again later gets another id. The time in which another vehicle hides a confirmed one has a
        limit of its own, `max_hidden`.
    show_coast, show_covered
        A confirmed track is shown for `show_coast` without a detection, and no longer than it was detected
        since its confirmation. While another vehicle hides it, it is shown up to `max_coast`, no longer than
        it was detected, and for `show_covered` if nothing of it is visible. It is not shown once it must have
        moved by half of its size.
    backfill
        A track is also shown for this time before its confirmation, where frames can wait: in
        `process_video` and `track`, unless the source is live.
    max_gap
        A longer gap between two frames ends all tracks.
    max_distance
        Maximum distance between the centers of a detection and of a prediction, in box widths and heights.
    max_iou, max_coverage
        A detection starts no track if its IoU with a track exceeds `max_iou`, or if the two share more than
        the fraction `max_coverage` of the smaller box.
    measurement_noise, measurement_correlation_time
        Standard error of a detection's edges, and time over which it is correlated, so that twice the frame
        rate is not twice the evidence.
    process_noise_position, process_noise_size
        Process noise of the center and of the size: standard deviation by which their speeds change in a
        second, in sizes per second.

    Examples
    --------
    >>> TrackParams(max_coast=0.5).show_coast
    0.3
    """

    score_time_constant: float = fields.number(0.3, above=0, high=3600)
    high_threshold: float = fields.number(-0.3, low=-1e6, high=1e6)
    low_threshold: float = fields.number(-1.5, low=-1e6, high=1e6)
    confirm_score: float = fields.number(0.2, low=-1e6, high=1e6)
    confirm_hits: int = fields.integer(3, low=1, high=10_000)
    confirm_seconds: float = fields.number(0.12, low=0, high=3600)
    instant_confirm_score: float = fields.number(1.3, low=-1e6, high=1e6)
    tentative_coast: float = fields.number(0.1, low=0, high=3600)
    show_coast: float = fields.number(0.3, low=0, high=3600)
    show_covered: float = fields.number(0.4, low=0, high=3600)
    max_coast: float = fields.number(1.0, low=0, high=3600)
    max_hidden: float = fields.number(4.0, low=0, high=3600)
    backfill: float = fields.number(0.32, low=0, high=3600)
    max_gap: float = fields.number(1.0, above=0, high=3600)
    max_distance: float = fields.number(0.7, above=0, high=100)
    max_iou: float = fields.number(0.3, low=0, high=1)
    max_coverage: float = fields.number(0.7, low=0, high=1)
    measurement_noise: float = fields.number(0.07, above=0, high=1)
    measurement_correlation_time: float = fields.number(0.04, low=0, high=3600)
    process_noise_position: float = fields.number(0.18, above=0, high=100)
    process_noise_size: float = fields.number(0.1, above=0, high=100)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.show_coast > self.max_coast:
            must = f"be at most max_coast, {self.max_coast:g}: a track that ended is not shown"
            raise invalid("show_coast", must, self.show_coast, "change both")


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """A vehicle with a constant identity, as estimated after one frame.

    Attributes
    ----------
    id, key
        Number of the vehicle, from 1 in order of confirmation, 0 while the track is tentative; and number of
        the track from its first detection on, from 1, which tracks that are never confirmed have, too.
    box, velocity
        ``(4,)`` box inside the frame, read-only, and velocity of its center in pixels per second.
    score
        Exponential moving average of the detections' scores; a frame without a detection counts as 0.
    confidence
        Calibrated probability that the track shows a vehicle, in [0, 1]: that of the mean of its detections'
        scores, in which older ones weigh less. It stays while there are no detections.
    state, shown
        ``"tentative"`` (not confirmed yet), ``"confirmed"`` (detected in this frame) or ``"coasting"``
        (confirmed, but not detected in this frame: the box is a prediction); whether to draw the track.
    age, misses, time_since_update
        Seconds since the first detection, and frames and seconds since the last.
    distance_m, distance_std_m, speed_mps, speed_std_mps
        Distance along the road in meters, and speed relative to the camera in meters per second, positive
        when moving away, with their standard errors; None where they are unknown.
    label
        Class of most of its detections, ``"vehicle"`` if the model does not tell kinds apart.

    Examples
    --------
    >>> from vehicle_detection import Detections, Tracker
    >>> (track,) = Tracker().update(Detections([[600, 400, 700, 480]], [2.0]), (720, 1280))
    >>> track.id, track.state, track.shown
    (1, 'confirmed', True)
    """

    id: int
    box: Floats
    score: float
    state: Literal["tentative", "confirmed", "coasting"]
    shown: bool
    age: float
    misses: int
    time_since_update: float
    velocity: tuple[float, float]
    key: int = 0
    confidence: float | None = None
    distance_m: float | None = None
    distance_std_m: float | None = None
    speed_mps: float | None = None
    speed_std_mps: float | None = None
    label: str = UNKNOWN_LABEL

    @property
    def name(self) -> str:
        """Class, if known, and id, such as ``"car #3"``."""
        return f"#{self.id}" if self.label == UNKNOWN_LABEL else f"{self.label} #{self.id}"


@dataclass(frozen=True, eq=False, repr=False)
class FrameResult:
    """The result of one frame of a video.

    Attributes
    ----------
    index, time
        Number of the frame since the last reset, from 0, and its time in seconds, None if unknown.
    windows, detections, tracks
        Positive windows and boxes of this frame, before tracking; and all tracks, of which those with
        ``track.shown`` are vehicles to draw.
    seconds
        Seconds per stage: ``"search"`` (elapsed), ``"regions"`` and ``"track"`` (processor time).
    searched
        Whether the frame was searched. If not, it has neither windows nor detections, and its tracks are
        interpolated or predicted.
    frame
        The ``(H, W, 3)`` uint8 RGB frame, if `track` was asked for frames; otherwise None.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector, read_image
    >>> VehicleDetector("highway").process(read_image("test_images/road1.jpg"), time=0.0)
    FrameResult(0 at 0.00 s: 2 detections, 2 vehicles shown)
    """

    index: int
    time: float | None
    windows: Detections
    detections: Detections
    tracks: tuple[Track, ...]
    seconds: dict[str, float] = field(default_factory=dict)
    searched: bool = True
    frame: NDArray[np.uint8] | None = field(default=None, compare=False)

    @classmethod
    def unsearched(
        cls, index: int, time: float | None, tracks: tuple[Track, ...], started: float
    ) -> FrameResult:
        """Make the result of a frame that was not searched, whose tracking `started` at this thread time."""
        none, seconds = Detections.empty(), {"track": clock.thread_time() - started}
        return cls(index, time, none, none, tracks, seconds, searched=False)

    @property
    def shown(self) -> tuple[Track, ...]:
        """The tracks to draw."""
        return tuple(track for track in self.tracks if track.shown)

    def __repr__(self) -> str:
        time = "" if self.time is None else f" at {self.time:.2f} s"
        found = pluralize(len(self.detections), "detection") if self.searched else "not searched"
        shown = f"{pluralize(len(self.shown), 'vehicle')} shown"
        return f"{type(self).__name__}({self.index}{time}: {found}, {shown})"

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table of the shown tracks: the rows of this frame in `TrackRun.to_pandas`."""
        import pandas

        rows = [
            (self.index, track.id, *track.box.tolist(), *(getattr(track, name) for name in TRACK_VALUES))
            for track in self.shown
        ]
        data = pandas.DataFrame(rows, columns=["frame", "track_id", "x1", "y1", "x2", "y2", *TRACK_VALUES])
        numbers = dict.fromkeys((*data.columns[2:6], *TRACK_VALUES[:-1]), float)
        return data.astype(numbers | {"frame": int, "track_id": int, "label": str}).assign(time_s=self.time)

    def to_supervision(self) -> Any:
        """Convert the shown tracks to ``supervision.Detections`` with their ids as ``tracker_id``.

        The classes are numbers in no order of a model; their names are in ``data["class_name"]``.
        """
        boxes = np.array([track.box for track in self.shown]).reshape(-1, 4)
        confidences = [track.confidence for track in self.shown]
        known = None if None in confidences else np.array(confidences, np.float64)
        labels = [track.label for track in self.shown]
        found = Detections(boxes, np.array([track.score for track in self.shown]), known, labels)
        return found.to_supervision(tracker_id=[track.id for track in self.shown])


def is_result(item: Any) -> bool:
    """Whether `item` is a frame's result (a tuple has an ``index`` method, too)."""
    return hasattr(item, "tracks") and hasattr(item, "index") and not isinstance(item, (Mapping, Sequence))


def shown_tracks(tracks: Iterable[Any]) -> list[Any]:
    """Tracks that are drawn and written, which have different ids."""
    shown = []
    for track in [tracks] if isinstance(tracks, str) or not isinstance(tracks, Iterable) else tracks:
        if not hasattr(track, "id") or not hasattr(track, "box"):
            raise invalid("tracks", "be Track objects", track, "pass result.tracks")
        if getattr(track, "shown", True):
            shown.append(track)
    repeated = next((track for track, times in Counter(each.id for each in shown).items() if times > 1), None)
    if repeated is not None:
        raise invalid("tracks", "have unique ids", repeated, "it comes twice; pass result.tracks")
    return shown
