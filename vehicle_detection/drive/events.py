"""Events of a drive, derived from its tracks: following, closing in, cut-ins, overtaking and meeting."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import UNITS, Floats, Units, check, invalid
from vehicle_detection.camera import Camera
from vehicle_detection.drive.motion import (
    LANE_HALF_WIDTH_M,
    Bools,
    Motion,
    TrackHistory,
    estimate_motion,
    split_runs,
    track_histories,
)
from vehicle_detection.tables import TrackTable

Kind = Literal[
    "headway", "closest_approach", "closing", "hard_closing", "cut_in", "we_overtook", "overtook_us", "met",
    "passed",
]  # fmt: skip
Side = Literal["left", "right"]

KINDS: dict[Kind, str] = {
    "headway": "following",
    "closest_approach": "closest approach",
    "closing": "closing in",
    "hard_closing": "closing in hard",
    "cut_in": "cut-in",
    "we_overtook": "overtaken by us",
    "overtook_us": "overtook us",
    "met": "met (oncoming)",
    "passed": "passed by us",
}
"""Name of each kind of event for readers."""

# Least confidence of an event that is stated: it is more likely true than not.
_MIN_CONFIDENCE = 0.5
# Shortest duration (s) of a track, of following a vehicle, and of being in or out of the camera's lane.
_MIN_TRACK, _MIN_FOLLOWING, _MIN_IN_LANE = 0.2, 2.0, 0.5
# Largest relative error of a distance, a headway and a time to collision that is stated.
_MAX_STD = 0.3
# Largest relative error of a growth rate whose sign is certain.
_MAX_PASSING_STD = 0.6
# Largest standard error (m/s) of a closing speed that is stated.
_MAX_SPEED_STD = 5.0
# Largest distance (m) of a closest approach and of a cut-in.
_NEAR_M, _CUT_IN_M = 12.0, 40.0
# Times to collision (s), required deceleration (m/s^2) and shortest duration (s) of the closing kinds.
_CLOSING_TIME, _HARD_TIME, _HARD_DECELERATION, _MIN_CLOSING = 4.0, 2.5, 3.0, 0.3
# Time (s) for which a vehicle is seen before and after its closest approach; else a smaller distance may have
# been missed.
_MIN_AROUND = 0.5
# Longest duration (s) of a lane change; and largest lateral speed (m/s; or a part of the closing speed) of
# what neither crosses the road nor is seen from a camera that turns.
_LANE_CHANGE, _MAX_LATERAL_SPEED, _MAX_SLOPE = 6.0, 3.0, 0.25
# A passing vehicle's middle leaves the frame at most this long (s) after the vehicle was last seen, or enters
# it at most this long before it was first seen; and the least change of its distance.
_UNSEEN_TIME, _PASSING_RATIO = 0.5, 1.15
# Greatest distance (m) of a vehicle that comes into the frame beside the camera.
_PASSING_M = 25.0
# Least closing speed (m/s) of an oncoming vehicle and greatest of an overtaken one, where the own speed is
# unknown. Faster vehicles do not cut in.
_SLOWEST_ONCOMING, _FASTEST_OVERTAKEN = 20.0, 14.0
# Speed (m/s) over the road from which a vehicle moves.
_MOVING = 2.0


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened between the camera's vehicle and another one.

    Attributes
    ----------
    kind
        ``"headway"``: it was followed, at its smallest distance; ``"closest_approach"``: it was nearer than
        12 m; ``"closing"`` and ``"hard_closing"``: the time to collision was at most 4 s, and at most 2.5 s
        or the deceleration that avoids a collision at least 3 m/s²; ``"cut_in"``: it moved into the lane of
        the camera; ``"we_overtook"``, ``"overtook_us"``, ``"met"``: the camera overtook it, it overtook the
        camera, it came towards the camera; ``"passed"``: it was passed, and either stood or its direction is
        not certain.
    track_id, frame, start_frame, end_frame
        Track of the vehicle; frame of the event, counted from 0 in the processed part of the video; and first
        and last frame that belong to it.
    time_s
        `frame` divided by the frame rate: the time in the annotated copy, in seconds.
    side
        ``"left"`` or ``"right"`` of the camera, for vehicles that pass or cut in.
    confidence
        Probability that the event is true: that the track shows a vehicle, if this is known, times that of
        what the kind states, by the standard errors. It is at least 0.5.
    distance_m, distance_std_m, is_bound
        Distance at `frame` and its standard error, where the relative error is at most 0.3; and whether the
        vehicle may have been nearer, because the frame cuts its box off.
    closing_mps, closing_std_mps
        Speed of approach, negative when moving away, where its standard error is at most 5 m/s.
    headway_s, headway_std_s
        Distance over own speed, where the own speed is known.
    ttc_s, ttc_std_s
        Smallest time to collision at constant speeds, for the closing kinds.
    speed_mps
        Speed of the vehicle over ground in the camera's direction, negative when oncoming: own speed minus
        `closing_mps`, where both are known. For ``"overtook_us"`` both are those of the first frame in which
        it certainly moves away.

    Examples
    --------
    >>> event = Event(kind="met", track_id=1, frame=50, start_frame=40, end_frame=50, time_s=2.0, side="left")
    >>> event.distance_m is None, event.is_bound
    (True, False)
    """

    kind: Kind
    track_id: int
    frame: int
    start_frame: int
    end_frame: int
    time_s: float
    side: Side | None = None
    confidence: float | None = None
    distance_m: float | None = None
    distance_std_m: float | None = None
    is_bound: bool = False
    closing_mps: float | None = None
    closing_std_mps: float | None = None
    headway_s: float | None = None
    headway_std_s: float | None = None
    ttc_s: float | None = None
    ttc_std_s: float | None = None
    speed_mps: float | None = None

    def __str__(self) -> str:
        return self.text(UNITS["metric"])

    def text(self, units: Units, *, with_time: bool = True) -> str:
        """Describe the event, such as "12.0 s: following vehicle 4, headway 0.6 ± 0.1 s"."""
        vehicle, kind = f"vehicle {self.track_id}", KINDS[self.kind]
        # The camera's vehicle follows; in all other events the other one acts, or is met.
        what = f"{kind} {vehicle}" if self.kind == "headway" else f"{vehicle} {kind}"
        parts = [f"{self.time_s:.1f} s: " * with_time + what]
        parts += [f"on the {self.side}"] if self.side else []
        listed = (
            ("time to collision", self.ttc_s, self.ttc_std_s, 1.0, "s"),
            ("headway", self.headway_s, self.headway_std_s, 1.0, "s"),
            ("distance", self.distance_m, self.distance_std_m, units.distance, units.distance_symbol),
        )
        for name, value, std, factor, unit in listed:
            if value is not None:
                name += " at most" * (self.is_bound and name == "distance")
                parts.append(f"{name} {factor * value:.1f} ± {factor * (std or 0):.1f} {unit}")
        return ", ".join(parts)


EVENT_COLUMNS = tuple(field.name for field in fields(Event))
"""Columns of a table of events."""


def check_events(events: object) -> list[Event]:
    """Return `events` as a list, unless one is something else."""
    listed = list(check.sequence(events, "events", "Event"))
    for event in listed:
        check.instance(event, "events", Event, "pass what find_events returned")
    return listed


def find_events(
    table: TrackTable,
    *,
    fps: float,
    shape: tuple[int, ...],
    camera: Camera | None = None,
    own_speed_mps: float | ArrayLike | None = None,
) -> tuple[Event, ...]:
    """Find the events of a drive in its tracks.

    Each event is stated only where the errors of the camera and of the boxes allow it; what is not listed may
    have happened all the same. The events describe footage and are no basis for safety decisions.

    Parameters
    ----------
    table, fps, shape
        The tracks of the video, its frame rate, and ``(height, width, ...)`` of its frames.
    camera
        The camera, whose focal length converts columns to meters; None: a typical dash-cam.
    own_speed_mps
        Speed of the camera's vehicle in m/s, a number or one for each frame, NaN where it is unknown; None:
        unknown. Headways in seconds need it, and it tells oncoming from overtaken vehicles.

    Returns
    -------
    tuple of Event
        In the order of their times. A lane change of the camera's own vehicle behind another one looks like a
        cut-in, unless other vehicles show that all of them moved.

    Examples
    --------
    >>> from vehicle_detection import Detections, Tracker, TrackTable
    >>> tracker, table = Tracker(fps=25), TrackTable()
    >>> for frame in range(75):  # a car that is nearer by 10 m every second
    ...     size = 1155 / (45 - 0.4 * frame)
    ...     box = [640 - 0.9 * size, 420 - 0.3 * size, 640 + 0.9 * size, 420 + 1.2 * size]
    ...     table.append(frame, frame / 25, tracker.update(Detections([box], [2.0]), (720, 1280, 3)))
    >>> [event.kind for event in find_events(table, fps=25, shape=(720, 1280, 3))]
    ['hard_closing', 'headway']
    """
    rate = check.number(fps, "fps", above=0, high=1e6)
    frame_shape = check.shape(shape)
    if camera is None:
        # Events use the focal length, which Camera.dashcam, the tracker's default, has too, but neither the
        # horizon nor the errors of the lens, in which the two differ.
        camera = Camera.for_frame(frame_shape)
    check.instance(camera, "camera", Camera, "omit it for a typical dash-cam")
    camera = camera.for_shape(frame_shape)
    check.instance(table, "table", TrackTable, "pass TrackTable.from_results(results) or from_pandas(table)")
    histories = track_histories(table)
    length = max((track.last + 1 for track in histories), default=0)
    own_speed = _check_speed(own_speed_mps, length)
    motions = [
        estimate_motion(track, fps=rate, shape=frame_shape, camera=camera)
        for track in histories
        if len(track.frames) >= _MIN_TRACK * rate and np.isfinite(track.boxes).all()
    ]
    last = len(table.counts()) - 1
    events: list[Event] = []
    for motion in motions:
        finder = _Finder(motion, rate, own_speed, _scene_of(motion.track, histories, last))
        events += [*finder.following(), *finder.closest(), *finder.closing(), *finder.cut_in(motions)]
        events += finder.passing()
    stated = (event for event in events if event.confidence is None or event.confidence >= _MIN_CONFIDENCE)
    return tuple(sorted(stated, key=lambda event: (event.frame, event.track_id, event.kind)))


def _scene_of(track: TrackHistory, histories: Sequence[TrackHistory], last: int) -> tuple[int, int]:
    """First and last frame of the scene: a cut is where several tracks begin or end and none goes on."""
    others = [other for other in histories if other is not track]

    def is_cut(frame: int, frames: list[int]) -> bool:
        return frame in frames and not any(other.first < frame < other.last for other in others)

    begins = is_cut(track.first, [other.first for other in others])
    ends = is_cut(track.last, [other.last for other in others])
    return track.first if begins else 0, track.last if ends else last


def _check_speed(speed: float | ArrayLike | None, length: int) -> Floats:
    """Own speed in each frame, NaN where it is unknown."""
    if speed is None:
        return np.full(length, np.nan)
    array = check.array(speed, "own_speed_mps")
    shaped = array.ndim == 0 or (array.ndim == 1 and len(array) >= length)
    if not shaped or array.dtype.kind not in "iuf" or np.isinf(array).any() or (array < 0).any():
        expected = "be a number of at least 0, or one for each frame"
        raise invalid("own_speed_mps", expected, speed, "pass meters per second")
    return np.asarray(np.broadcast_to(array, length) if array.ndim == 0 else array, np.float64)


@dataclass(frozen=True)
class _Finder:
    """Finds the events of one track."""

    motion: Motion
    fps: float
    own_speed: Floats  # in each frame; NaN where it is unknown
    scene: tuple[int, int]  # its first and last frame

    def following(self) -> Iterable[Event]:
        """Yield each time that the vehicle was followed, at the smallest distance."""
        motion = self.motion
        near = motion.in_path & (motion.distance_std <= _MAX_STD * motion.distance)
        for start, stop in self._runs(near, _MIN_FOLLOWING):
            rows = _rows(near, start, stop)
            stated = motion.track.columns["distance_m"]
            distance = np.where(np.isfinite(stated), stated, motion.distance)
            row, certainty = int(rows[np.argmin(distance[rows])]), float(self._in_path[rows].mean())
            yield self._event("headway", row, start, stop, certainty)

    def closest(self) -> Iterable[Event]:
        """Yield the closest approach, if it was near."""
        found, seconds = self.motion.track.closest_approach(self.fps), self.motion.seconds
        if found is None or found.distance_m > _NEAR_M:
            return
        row = int(np.searchsorted(self.motion.track.frames, found.frame))
        certainty = _probability(_NEAR_M - found.distance_m, found.std_m or 1.0)
        event = self._event("closest_approach", row, row, row + 1, certainty)
        whole = min(seconds[row] - seconds[0], seconds[-1] - seconds[row]) >= _MIN_AROUND
        if whole and event.distance_m is not None:
            yield event

    def closing(self) -> Iterable[Event]:
        """Yield each time that the time to collision was short."""
        motion = self.motion
        time, std = motion.time_to_collision, motion.time_to_collision_std
        with np.errstate(invalid="ignore"):
            ahead = np.abs(motion.lateral + motion.lateral_rate * time) < LANE_HALF_WIDTH_M
            short = motion.in_path & ahead & (time > 0) & (time <= _CLOSING_TIME) & (std <= _MAX_STD * time)
            short &= ~motion.is_cut
        for start, stop in self._runs(short, _MIN_CLOSING):
            rows = _rows(short, start, stop)
            row = int(rows[np.argmin(time[rows])])
            speeds = motion.track.columns["speed_mps"][rows]
            if np.isfinite(speeds).any() and np.nanmedian(speeds) > 0:  # only its box grows
                continue
            # The largest of many estimates is too large, so each is lowered by its standard error.
            closing = motion.closing[rows] * (1 - std[rows] / time[rows])
            deceleration = float((closing**2 / (2 * motion.distance[rows])).max())
            hard = time[row] <= _HARD_TIME or deceleration >= _HARD_DECELERATION
            certainty = float(self._in_path[row]) * _probability(_CLOSING_TIME - time[row], std[row])
            yield self._event("hard_closing" if hard else "closing", row, start, stop, certainty)

    def cut_in(self, motions: Sequence[Motion]) -> Iterable[Event]:
        """Yield each time that the vehicle moved from another lane into that of the camera."""
        motion = self.motion
        with np.errstate(invalid="ignore"):
            slow = np.nan_to_num(np.abs(motion.closing)) < _FASTEST_OVERTAKEN
            near = (motion.distance <= _CUT_IN_M) & slow
        beside = self._runs(motion.beside_path & near, _MIN_IN_LANE)
        for start, _ in self._runs(motion.in_path & near, _MIN_IN_LANE):
            before = [end for _, end in beside if end <= start]
            if not before or motion.seconds[start] - motion.seconds[before[-1] - 1] > _LANE_CHANGE:
                continue
            begin = before[-1] - 1
            if np.nanmedian(np.abs(motion.lateral_rate[begin : start + 1])) > _MAX_LATERAL_SPEED:
                continue
            # Where it went on to the other half of the lane, it crosses the road.
            crossed = motion.lateral[begin] * motion.lateral[start] < -(LANE_HALF_WIDTH_M**2)
            if crossed or self._moved_alike(motions, begin, start):
                continue
            inside = np.flatnonzero(np.abs(motion.lateral[begin : start + 1]) < LANE_HALF_WIDTH_M)
            row = begin + int(inside[0])
            side: Side = "right" if motion.lateral[begin] > 0 else "left"
            certainty = float(self._in_path[start] * (1 - self._in_path[begin]))
            yield self._event("cut_in", row, begin, start + 1, certainty, side=side)

    def _moved_alike(self, motions: Sequence[Motion], begin: int, end: int) -> bool:
        """Whether other vehicles moved sideways as this one did, which is a motion of the camera."""
        own = self.motion
        change = own.lateral[end] - own.lateral[begin]
        changes = []
        begin_s, end_s = own.seconds[[begin, end]]
        for other in motions:
            inside = (other.seconds >= begin_s) & (other.seconds <= end_s) & (other.at_side == 0)
            rows = np.flatnonzero(inside)
            if other is own or not len(rows):
                continue
            # The other track covers most of the lane change.
            if other.seconds[rows[-1]] - other.seconds[rows[0]] > 0.6 * (end_s - begin_s):
                changes.append(other.lateral[rows[-1]] - other.lateral[rows[0]])
        # In the same direction, by at least half as much.
        return bool(changes) and float(np.median(changes)) / change > 0.5

    def passing(self) -> Iterable[Event]:
        """Yield its passing where it left the frame, and its overtaking where it came into the frame."""
        motion = self.motion
        known = np.isfinite(motion.time_to_collision) & (motion.distance > 0) & (motion.at_side == 0)
        if known.any():
            first, last = np.flatnonzero(known)[[0, -1]].tolist()
            yield from self._left_behind(first, last)
            yield from self._came_past(first, last)

    def _left_behind(self, first: int, last: int) -> Iterable[Event]:
        """Yield the passing of a vehicle that left the frame soon after its last known row."""
        motion, frames = self.motion, self.motion.track.frames
        time, error = motion.time_to_collision[last], motion.slope_error[last]
        rows = np.arange(max(first, last - round(self.fps)), last + 1)
        rows = rows[motion.time_to_collision[rows] > 0]
        if not time > 0 or error > _MAX_PASSING_STD or not self._goes_straight(last, rows):
            return
        # Columns are proportional to the reciprocal distance, so that its middle reaches the border then.
        unseen = time * (1 - motion.outward[last]) - (motion.seconds[-1] - motion.seconds[last])
        after = (self.scene[1] - frames[-1]) / self.fps  # time of the scene after the track
        leaves = motion.at_side[last:].any() or unseen <= min(_UNSEEN_TIME, after)
        grown = np.nanmax(motion.distance[first : last + 1]) / motion.distance[last]
        if grown < _PASSING_RATIO or not (after and leaves):
            return
        closing, closing_std = (float(np.median(each[rows])) for each in (motion.closing, motion.closing_std))
        kind, certainty = self._passing_kind(closing, closing_std, int(frames[last]))
        certainty *= _probability(1.0, error)
        row, side = len(frames) - 1, self._side(last)
        yield self._event(kind, row, int(rows[0]), row + 1, certainty, side=side, speed_row=last)

    def _came_past(self, first: int, last: int) -> Iterable[Event]:
        """Yield the overtaking of a vehicle that was beside the camera and then moved away."""
        motion, frames = self.motion, self.motion.track.frames
        time = motion.time_to_collision
        sure = np.flatnonzero((time < 0) & (motion.slope_error < _MAX_PASSING_STD))
        near = first + int(np.nanargmin(motion.distance[first : first + max(round(self.fps), 1)]))
        if not sure.size or motion.distance[near] > _PASSING_M:
            return
        row = int(sure[0])  # first row where its motion away is certain
        stop = max(row, near) + 1
        if not self._goes_straight(first, np.arange(first, stop)):
            return
        since = -time[row] - (motion.seconds[row] - motion.seconds[first])  # it was beside the camera
        unseen = since * (1 - motion.outward[first]) - (motion.seconds[first] - motion.seconds[0])
        before = (frames[0] - self.scene[0]) / self.fps  # time of the scene before the track
        came_in = motion.at_side[: first + 1].any() or (since > 0 and unseen <= min(_UNSEEN_TIME, before))
        if came_in and motion.distance[last] / motion.distance[near] >= _PASSING_RATIO:
            certainty = _probability(1.0, motion.slope_error[row])
            yield self._event("overtook_us", near, 0, stop, certainty, side=self._side(first), speed_row=row)

    def _goes_straight(self, row: int, rows: NDArray[np.intp]) -> bool:
        """Whether the vehicle is beside the camera's lane at a row, and crosses no road at others."""
        beside = abs(self.motion.lateral[row]) > 0.7 * LANE_HALF_WIDTH_M
        limit = np.fmax(_MAX_LATERAL_SPEED, _MAX_SLOPE * np.abs(self.motion.closing[rows]))
        crosses = np.abs(self.motion.lateral_rate[rows]) > limit  # False where unknown
        return bool(beside and crosses.mean() < 0.5)

    def _passing_kind(self, closing: float, std: float, frame: int) -> tuple[Kind, float]:
        """Kind of a vehicle that left the frame, by its speed over the road, and the kind's certainty."""
        speed = float(self.own_speed[frame]) - closing  # over the road, in the camera's direction
        if math.isfinite(speed):
            if abs(speed) > max(_MOVING, 2 * std):
                return "we_overtook" if speed > 0 else "met", _probability(abs(speed), std)
        elif closing - std > _SLOWEST_ONCOMING:
            return "met", _probability(closing - _SLOWEST_ONCOMING, std)
        elif closing + std < _FASTEST_OVERTAKEN:
            return "we_overtook", _probability(_FASTEST_OVERTAKEN - closing, std)
        return "passed", 1.0

    def _side(self, row: int) -> Side:
        return "right" if self.motion.lateral[row] > 0 else "left"

    @cached_property
    def _in_path(self) -> Floats:
        """Probability that the vehicle is in the lane of the camera, ``(N,)``."""
        margin = (LANE_HALF_WIDTH_M - np.abs(self.motion.lateral)) / self.motion.lateral_std
        return np.array([_probability(each, 1.0) for each in margin.tolist()])

    def _runs(self, mask: Bools, seconds: float) -> list[tuple[int, int]]:
        """Half-open ranges of rows where `mask` holds for so long; gaps up to 0.25 s are closed."""
        rows = np.flatnonzero(mask)
        step = max(int(0.25 * self.fps), 1)
        runs = [rows[each] for each in split_runs(self.motion.track.frames[rows], step)]
        times = self.motion.seconds
        return [
            (int(run[0]), int(run[-1]) + 1)
            for run in runs
            if times[run[-1]] - times[run[0]] >= seconds - 1e-9
        ]

    def _event(
        self,
        kind: Kind,
        row: int,
        start: int,
        stop: int,
        certainty: float,
        *,
        side: Side | None = None,
        speed_row: int | None = None,
    ) -> Event:
        """Describe an event whose kind has this certainty; its speeds are those at `speed_row`."""
        motion, frames = self.motion, self.motion.track.frames
        frame, own_speed = int(frames[row]), self.own_speed[frames[row]]
        values: dict[str, float] = {}
        confidences = motion.track.columns["confidence"][start:stop]
        if np.isfinite(confidences).any():
            certainty *= float(np.nanmean(confidences))
        distance, std = motion.distance[row], motion.distance_std[row]
        stated = motion.track.columns["distance_m"][row], motion.track.columns["distance_std_m"][row]
        if np.isfinite(stated).all():  # as labels and tables have it
            distance, std = stated
        if std <= _MAX_STD * distance:
            values |= {"distance_m": distance, "distance_std_m": std}
            if kind == "headway" and own_speed > _MOVING:
                values |= {"headway_s": distance / own_speed, "headway_std_s": std / own_speed}
        speed_row = row if speed_row is None else speed_row
        if motion.closing_std[speed_row] <= _MAX_SPEED_STD:
            closing = motion.closing[speed_row], motion.closing_std[speed_row]
            values |= dict(zip(("closing_mps", "closing_std_mps"), closing))
            speed = self.own_speed[frames[speed_row]] - closing[0]
            values |= {"speed_mps": speed} if math.isfinite(speed) else {}
        if kind in ("closing", "hard_closing"):
            time_to_collision = motion.time_to_collision[row], motion.time_to_collision_std[row]
            values |= dict(zip(("ttc_s", "ttc_std_s"), time_to_collision))
        rounded = {name: round(float(value), 2) for name, value in values.items()}
        return Event(
            kind=kind,
            track_id=motion.track.id,
            frame=frame,
            start_frame=int(frames[start]),
            end_frame=int(frames[stop - 1]),
            time_s=round(frame / self.fps, 3),
            side=side,
            confidence=round(certainty, 3),
            is_bound="distance_m" in values and bool(motion.is_cut[row]),
            **rounded,
        )


def _probability(margin: float, std: float) -> float:
    """Probability that a value exceeds a limit, given its estimate's margin over it and standard error."""
    return 0.5 * (1 + math.erf(margin / std / math.sqrt(2)))


def _rows(mask: Bools, start: int, stop: int) -> NDArray[np.intp]:
    """Rows of a range where a mask holds."""
    return np.asarray(start + np.flatnonzero(mask[start:stop]))
