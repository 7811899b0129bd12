"""A vehicle of a video, as the tracker tells of it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.camera import Camera, inner_edges, truncated_edges
from vehicle_detection.params import TrackParams
from vehicle_detection.tracking import kalman_filter as _kalman

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
        Velocity of the box's center in pixels a second, right and down.
    distance_m, distance_std_m
        Distance along the road in meters and its standard error; None where it is unknown.
    speed_mps, speed_std_mps
        Speed relative to the camera in meters a second, positive when moving away, and its standard error;
        None where it is unknown.
    """

    id: int
    box: Floats
    score: float
    state: State
    shown: bool
    age: float
    misses: int
    time_since_update: float
    velocity: tuple[float, float]
    distance_m: float | None = None
    distance_std_m: float | None = None
    speed_mps: float | None = None
    speed_std_mps: float | None = None


Frame = tuple[int, int]

OUTWARDS = np.array([-1.0, -1.0, 1.0, 1.0])
"""Direction in which each edge of a box looks."""

TINY = 1e-6
"""Seconds by which sums of frame times may miss a limit."""

# Seconds in which an unseen vehicle forgets the speed of its center, and of its size.
_DAMPING = np.array([1.5, 1.5, 0.5, 0.5])
# Time, and weight from frame to frame, of the memory for errors that last.
_DRIFT_SECONDS, _DRIFT_KEPT = 0.15, 0.75
# Mean error of an edge, in standard errors, above which the distance is in doubt; by how much in a second.
_RESTLESS, _RANGE_DOUBT = 1.5, 0.5
# Fastest change of size that is taken for an approach, as a share a second.
_MOST_GROWTH = 1.5
# A box that the frame's border cuts is thought to be this wide for its height, give or take a share.
_CUT_ASPECT, _CUT_ERROR = 1.5, 0.3
# A distance is told while its error is below this share and it is unseen for less than these seconds; a speed
# while its error is below these meters a second.
_DISTANCE_LIMIT, _DISTANCE_SECONDS, _SPEED_LIMIT = 0.4, 0.5, 6.0


@dataclass(eq=False, slots=True)
class Vehicle:
    """The life of a vehicle: what the tracker keeps of it besides its filters.

    Attributes
    ----------
    idle
        Seconds unseen, of which those behind another vehicle count half.
    credit
        Seconds for which it may still be drawn without a detection.
    hidden
        Whether another vehicle is the reason why it is unseen.
    astray
        Whether it has been unseen for so long, or moved so far since, that its place is a guess.
    sure
        Whether its first detection is reason enough to believe it.
    past
        Age, and center and size, at the last detections, for the smoother ``"history"``.
    """

    score: float
    id: int = 0
    hits: int = 1
    misses: int = 0
    age: float = 0.0
    time_since_update: float = 0.0
    idle: float = 0.0
    credit: float = 0.0
    hidden: bool = False
    astray: bool = False
    sure: bool = False
    past: deque[tuple[float, Floats]] = field(default_factory=deque)

    @property
    def shown(self) -> bool:
        """Whether to draw it."""
        if not self.id or self.astray:
            return False
        # Behind another vehicle it is drawn for as long as it was seen.
        known = 2 * self.time_since_update < self.age + TINY if self.hidden else self.credit > -TINY
        return self.misses == 0 or known

    def live(self, score: float | None, dt: float, params: TrackParams) -> None:
        """Grow older by a frame, with the score of its detection or without one."""
        keep = math.exp(-dt / params.memory)
        self.score = keep * self.score + (1 - keep) * (score or 0.0)
        self.age += dt
        self.hidden = self.astray = False
        if score is None:
            self.misses += 1
            self.time_since_update += dt
        else:
            self.hits += 1
            self.misses, self.time_since_update, self.idle = 0, 0.0, 0.0
            self.credit = min(self.credit + dt, params.show_coast) if self.id else 0.0

    def wait(self, hidden: bool, dt: float, astray: bool = False) -> None:
        """Spend a frame unseen, behind another vehicle or for no known reason."""
        self.hidden, self.astray = hidden, astray
        self.idle += dt / 2 if hidden else dt
        self.credit -= 0.0 if hidden else dt

    def believable(self, params: TrackParams) -> bool:
        """Whether a tentative track has earned to be believed in this frame."""
        if self.id or self.misses:
            return False
        return self.sure or (
            self.hits >= params.confirm_hits
            and self.age > params.confirm_seconds - TINY
            and self.score >= params.confirm_score
        )

    def over(self, params: TrackParams) -> bool:
        """Whether it has been unseen for too long."""
        if self.id:
            return self.idle > params.max_coast + TINY
        return self.time_since_update > params.tentative_coast + TINY


class Filters(NamedTuple):
    """The two filters of `_kalman`: states, covariances and drift, a row for each vehicle."""

    mean: Floats
    cov: Floats
    drift: Floats
    range_mean: Floats
    range_cov: Floats

    @classmethod
    def empty(cls) -> Filters:
        """No vehicles."""
        shapes = (0, 8), (0, 8, 8), (0, 4), (0, 3), (0, 3, 3)
        return cls(*(np.empty(shape) for shape in shapes))

    def boxes(self) -> Floats:
        """Boxes, with the parts outside the frame."""
        return _kalman.boxes_of(self.mean)

    def take(self, rows: Sequence[int]) -> Filters:
        """Keep these rows, in this order."""
        if list(rows) == list(range(len(self.mean))):
            return self
        index = np.array(rows, np.intp)
        return Filters(*(column[index] for column in self))

    def put(self, rows: Sequence[int], other: Filters) -> Filters:
        """Replace these rows by those of `other`."""
        if list(rows) == list(range(len(self.mean))):
            return other
        index = np.array(rows, np.intp)
        columns = [column.copy() for column in self]
        for column, new in zip(columns, other):
            column[index] = new
        return Filters(*columns)

    def join(self, other: Filters) -> Filters:
        """Append the rows of `other`."""
        return Filters(*(np.concatenate(pair) for pair in zip(self, other)))


def start_filters(box: Floats, frame: Frame, dt: float, camera: Camera, params: TrackParams) -> Filters:
    """Start the filters of one vehicle at its first detection."""
    width, height = box[2:] - box[:2]
    cut = truncated_edges(box[None], frame)
    whole, error = box.copy(), np.array([width, height, width, height]) * params.box_noise
    if params.smoother == "kalman" and cut[0, 0] != cut[0, 2]:
        # Think of the part outside from the start: then the inner edge's motion is not taken for growth.
        side = 0 if cut[0, 0] else 2
        reach = max(width, _CUT_ASPECT * height)
        whole[side] = box[2 - side] + reach * OUTWARDS[side]
        error[side] = _CUT_ERROR * reach
    mean, cov = _kalman.start(whole[None], error[None])
    distance, spread = _kalman.range_start(camera)
    alike = params.box_noise_seconds
    aside = inner_edges(box[None], frame)
    distances = _kalman.range_update(distance[None], spread[None], box[None], cut, aside, camera, dt, alike)
    return Filters(mean, cov, np.zeros((1, 4)), *distances)


def predict_filters(
    filters: Filters, time_since_update: NDArray[np.bool_], dt: float, camera: Camera, params: TrackParams
) -> Filters:
    """Move vehicles `dt` seconds on, seen ones at constant speed on the road; `time_since_update` ones slow down."""
    mean, cov = filters.mean, filters.cov
    if params.smoother == "kalman":
        # At constant speed on the road, what grows in the image moves there ever faster: v' = 2 v w'/w.
        growth = np.clip((mean[:, 6:] / mean[:, 2:4]).mean(axis=1), -_MOST_GROWTH, _MOST_GROWTH)
        rates = np.where(time_since_update[:, None], -1 / _DAMPING, 2 * growth[:, None])
        faster = np.concatenate((np.ones_like(rates), np.exp(dt * rates)), axis=1)
        # An error of a speed grows as the speed does, and that of a growth by what it adds to itself as well.
        spread = faster.copy()
        spread[:, 6:] *= 1 + dt * np.maximum(2 * growth[:, None], 0) * ~time_since_update[:, None]
        mean = mean * faster
        cov = cov * spread[:, :, None] * spread[:, None, :]
        wander = np.array(
            [params.process_noise_position, params.process_noise_position, params.growth, params.growth]
        )
        mean, cov = _kalman.predict(mean, cov, dt, np.square(mean[:, [2, 3, 2, 3]] * wander))
        cov = _kalman.bound(mean, cov)
    ranges = _kalman.range_predict(filters.range_mean, filters.range_cov, dt, camera)
    return Filters(mean, cov, filters.drift, *ranges)


def moved_unseen(mean: Floats, time_since_update: Floats) -> Floats:
    """Sizes by which vehicles have moved since they were last seen, at the speeds that are slowing down."""
    pace = np.abs(mean[:, 4:6] / mean[:, 2:4]).max(axis=1)
    return np.asarray(pace * _DAMPING[0] * np.expm1(time_since_update / _DAMPING[0]))


def correct_filters(
    filters: Filters,
    boxes: Floats,
    partly: NDArray[np.bool_],
    frame: Frame,
    dt: float,
    camera: Camera,
    params: TrackParams,
) -> Filters:
    """Correct vehicles by a box each; `partly` where the box shows another vehicle too."""
    mean, cov, drift = filters.mean, filters.cov, filters.drift
    cut = truncated_edges(boxes, frame)
    if params.smoother == "kalman":
        # An edge at the border says only that the vehicle reaches it: right if it is thought to.
        beyond = cut & ((_kalman.boxes_of(mean) - boxes) * OUTWARDS >= 0)
        alike = max(1.0, params.box_noise_seconds / dt)
        noise = np.square(mean[:, [2, 3, 2, 3]] * params.box_noise) * alike
        variance = np.where(beyond, _kalman.UNKNOWN, noise)
        # An error lasts if it does so for some time, and for some frames.
        keep = max(math.exp(-dt / _DRIFT_SECONDS), _DRIFT_KEPT)
        mean, cov, drift = _kalman.update(mean, cov, drift, boxes, variance, partly, keep)
    # A box of two vehicles has neither's foot nor width: all its edges are as if cut off.
    cut |= partly[:, None]
    # While the edges do not come to rest, neither does the distance that they tell.
    restless = (np.abs(drift) > _RESTLESS).any(axis=1)
    range_mean, range_cov = filters.range_mean, filters.range_cov.copy()
    range_cov[:, 0, 0] += restless * np.square(_RANGE_DOUBT * range_mean[:, 0]) * dt
    aside, alike = inner_edges(boxes, frame), params.box_noise_seconds
    ranges = _kalman.range_update(range_mean, range_cov, boxes, cut, aside, camera, dt, alike)
    return Filters(mean, cov, drift, *ranges)


def follow_box(vehicle: Vehicle, mean: Floats, box: Floats, dt: float, params: TrackParams) -> Floats:
    """Move a state ``(8,)`` to a box as the course's systems did, without a model of its motion."""
    measured = _kalman.state_of(box)
    if params.smoother == "nearest":
        share = 1 - (1 - params.nearest_weight) ** (dt / 0.04)
        new = mean[:4] + share * (measured - mean[:4])
    else:
        vehicle.past.append((vehicle.age, measured))
        while vehicle.past[0][0] < vehicle.age - params.history:
            vehicle.past.popleft()
        weights = [1.0 - (vehicle.age - age) / (params.history + dt) for age, _ in vehicle.past]
        new = np.average([state for _, state in vehicle.past], axis=0, weights=weights)
    keep = math.exp(-dt / params.memory)
    return np.concatenate((new, keep * mean[4:] + (1 - keep) * (new - mean[:4]) / dt))


def known_ranges(
    filters: Filters, time_since_update: Floats, camera: Camera
) -> list[tuple[float | None, float | None, float | None, float | None]]:
    """Distance, its error, speed and its error of each vehicle; None where they are too uncertain to tell."""
    distance, speed = filters.range_mean[:, 0], filters.range_mean[:, 1]
    variance, speed_variance = filters.range_cov[:, 0, 0], filters.range_cov[:, 1, 1]
    # The focal length scales all measurements alike, so that no filter averages its error out.
    error = np.hypot(np.sqrt(np.maximum(variance, 0)), distance * camera.focal_std)
    speed_error = np.hypot(np.sqrt(np.maximum(speed_variance, 0)), speed * camera.focal_std)
    near = (error <= _DISTANCE_LIMIT * distance) & (time_since_update <= _DISTANCE_SECONDS)
    steady = near & (speed_error <= _SPEED_LIMIT)
    columns = (distance, near), (error, near), (speed, steady), (speed_error, steady)
    told = [[v if known else None for v, known in zip(c.tolist(), k.tolist())] for c, k in columns]
    return list(zip(*told))
