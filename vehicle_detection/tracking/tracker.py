"""Tracks vehicles from frame to frame: detections in, vehicles with constant identities out.

Detections are assigned to tracks by the Hungarian method, and each track has a constant-velocity Kalman
filter for its box and another one for its distance (Bewley et al., *Simple Online and Realtime Tracking*,
ICIP 2016). Low-score detections continue confirmed tracks (Zhang et al., *ByteTrack: Multi-Object Tracking by
Associating Every Detection Box*, ECCV 2022). The life cycle depends on scores and seconds instead of frame
counts, and on the reason for a missing detection: hidden by another vehicle, merged with it, or outside the
frame.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check, invalid, warn
from vehicle_detection.boxes import LOG_ODDS, Detections, Platt, box_areas, on_one_vehicle
from vehicle_detection.camera import Camera, FrameShape, truncated_edges
from vehicle_detection.tracking.association import (
    covered_fractions,
    distinct_vehicles,
    hidden_edges,
    match_approaching,
    match_boxes,
    merged_detections,
    nearer_cover,
)
from vehicle_detection.tracking.distance import (
    estimate_distances,
    initiate_states,
    predict_distances,
    update_distances,
)
from vehicle_detection.tracking.horizon import HorizonFilter
from vehicle_detection.tracking.kalman import (
    OUTWARD,
    KalmanSmoother,
    KalmanStates,
    Measurements,
    coasted_distance,
    exit_times,
)
from vehicle_detection.tracking.pixels import Gray, measure_growth
from vehicle_detection.tracking.track import TIME_TOLERANCE, UNKNOWN_LABEL, USUAL_FPS, Track, TrackParams

# Visible fraction of a box below which its vehicle leaves the frame if it moves outwards, and below which it
# has left; covered fractions above which a vehicle is hidden, and above which nothing of it is visible.
_LEAVING, _LEFT, _HIDDEN, _COVERED = 0.5, 0.15, 0.5, 0.9
# Seconds until a track that reaches the border has moved out, below which it has left if it is not detected.
_EXIT_TIME = 0.5
# Distance in box sizes that a track may coast before its position is only a guess.
_MAX_COAST_DISTANCE = 0.5
# Factors of `max_distance` for tentative tracks, and for low-score detections.
_TENTATIVE_DISTANCE, _LOW_SCORE_DISTANCE = 0.6, 0.5
# Smallest IoU of a confirmed track with a low-score detection, that of ByteTrack's code: a box that also
# covers the lamp post above a vehicle says nothing about its height.
_LOW_SCORE_IOU = 0.5
# Smallest IoU of a track that was not detected in the last frame with a detection: one beside it shows
# another vehicle.
_COASTING_IOU = 0.1
# Difference of the scores of two tracks on one vehicle from which on the lower one shows a part of it.
_PART_GAP = 2.0
# Largest number of detections of a frame, for which an update takes a third of a second.
_MAX_DETECTIONS = 500
# Seconds without a detection after which `max_distance` stops growing.
_MAX_GAP = 2.0


def weight_of(dt: float, params: TrackParams) -> float:
    """Weight of a frame in the exponential moving average of scores, `dt` seconds after the frame before."""
    return -math.expm1(-dt / params.score_time_constant)


@dataclass(eq=False, slots=True)
class TrackState:
    """Life cycle of a track; its Kalman states are a row of `KalmanStates`. Times are in seconds."""

    score: float
    weight: float = 1.0  # sum of the weights that the detections have in the score
    mean_score: float = field(init=False)  # mean of the detections' scores with these weights
    confirm_at_birth: bool = False  # whether its first detection suffices to confirm it
    key: int = 0
    id: int = 0
    hits: int = 1
    misses: int = 0  # since the last detection
    all_misses: int = 0
    age: float = 0.0
    time_since_update: float = 0.0
    last_gap: float = 0.0  # time without a detection before the last one
    unexplained_gap: float = 0.0  # time without a detection while no other vehicle hides it
    hidden_gap: float = 0.0  # time without a detection while another vehicle hides it
    coast_budget: float = 0.0  # time for which it is still shown without a detection
    covered_budget: float = 0.0  # time for which it is still shown while nothing of it is visible
    hidden: bool = False  # whether another vehicle explains the missing detection
    covered: float = 0.0  # fraction of its box that nearer vehicles cover
    lost: bool = False  # whether its predicted position is only a guess
    votes: Counter[str] = field(default_factory=Counter)  # number of detections of each class

    def __post_init__(self) -> None:
        self.mean_score = self.score / self.weight

    @property
    def state(self) -> Literal["tentative", "confirmed", "coasting"]:
        """Stage of the life cycle."""
        if not self.id:
            return "tentative"
        return "coasting" if self.misses else "confirmed"

    @property
    def label(self) -> str:
        """Class of most of its detections."""
        return max(self.votes, key=self.votes.__getitem__, default=UNKNOWN_LABEL)

    @property
    def shown(self) -> bool:
        """Whether to draw it."""
        if not self.id or self.lost:
            return False
        if self.misses and self.hidden:  # shown for as long as it was detected before
            long_enough = 2 * self.time_since_update < self.age + TIME_TOLERANCE
            return long_enough and self.covered_budget > -TIME_TOLERANCE
        return not self.misses or self.coast_budget > -TIME_TOLERANCE

    def update_score(self, score: float | None, dt: float, params: TrackParams) -> None:
        """Advance by a frame, with the score of the assigned detection, or None without one."""
        new = weight_of(dt, params)
        self.score = (1 - new) * self.score + new * (score or 0.0)
        self.weight = (1 - new) * self.weight + new * (score is not None)
        self.age += dt
        self.hidden = self.lost = False
        if score is None:
            self.misses += 1
            self.all_misses += 1
            self.time_since_update += dt
        else:
            self.mean_score = self.score / self.weight
            self.hits += 1
            self.last_gap = self.time_since_update
            self.misses, self.time_since_update = 0, 0.0
            self.unexplained_gap, self.hidden_gap, self.covered_budget = 0.0, 0.0, params.show_covered
            self.coast_budget = min(self.coast_budget + dt, params.show_coast) if self.id else 0.0

    def mark_missed(self, dt: float, *, hidden: bool, covered: bool, lost: bool) -> None:
        """Account for a frame without a detection, behind another vehicle or for an unknown reason."""
        self.hidden, self.lost = hidden, lost
        if hidden:
            self.hidden_gap += dt
            self.covered_budget -= dt if covered else 0.0
        else:
            self.unexplained_gap += dt
            self.coast_budget -= dt

    def can_confirm(self, params: TrackParams) -> bool:
        """Whether a tentative track meets the conditions of confirmation in this frame."""
        hits = self.hits - self.all_misses >= params.confirm_hits
        old = self.age > params.confirm_seconds - TIME_TOLERANCE
        convincing = self.confirm_at_birth or (hits and old and self.score >= params.confirm_score)
        return convincing and not self.id and not self.misses

    def is_expired(self, params: TrackParams) -> bool:
        """Whether it has had no detection for too long."""
        if self.id:
            unexplained = self.unexplained_gap > params.max_coast + TIME_TOLERANCE
            return unexplained or self.hidden_gap > params.max_hidden + TIME_TOLERANCE
        return self.time_since_update > params.tentative_coast + TIME_TOLERANCE


class Tracker:
    """Track vehicles through the frames of one video.

    Parameters
    ----------
    params, fps
        Thresholds, times and noise of the tracks; frames per second where `update` is called without a time.
    camera
        For distances and speeds, by default `Camera.dashcam`. An uncertain horizon is estimated from the
        vehicles.
    calibration
        Converts scores to the confidences of the tracks; by default scores are log-odds, and 0 is 50%. None
        leaves the confidences unknown.

    Examples
    --------
    >>> tracker = Tracker(fps=25)
    >>> for frame in range(10):
    ...     found = Detections([[600 + frame, 400, 700 + frame, 490]], [1.0])
    ...     tracks = tracker.update(found, (720, 1280, 3))
    >>> tracks[0].id, tracks[0].state, tracks[0].box.round()
    (1, 'confirmed', array([609., 400., 709., 490.]))
    """

    def __init__(
        self,
        params: TrackParams | None = None,
        *,
        fps: float = USUAL_FPS,
        camera: Camera | None = None,
        calibration: Platt | None = LOG_ODDS,
    ) -> None:
        check.instance(params, "params", TrackParams | None, "pass TrackParams()")
        check.instance(camera, "camera", Camera | None, "pass what open_camera returns")
        check.instance(calibration, "calibration", Platt | None, "calibrate_scores makes one")
        self._calibration = calibration
        self._frame_seconds = 1 / check.number(fps, "fps", above=0, high=1e6)
        self.params = params or TrackParams()
        self._smoother = KalmanSmoother(self.params)
        self._given_camera = camera or Camera.dashcam()
        self._warned = False
        self.reset()

    def reset(self) -> None:
        """Restore the initial state: the next frame is the first, and the next vehicle gets the id 1."""
        self._shape: FrameShape | None = None
        self._open_horizon(self._given_camera.shape or (720, 1280))
        self._time: float | None = None
        self._next_id = self._next_key = 1
        self.end_tracks()

    def _open_horizon(self, shape: FrameShape) -> None:
        """Start the estimate of the horizon for frames of this shape."""
        camera = self._given_camera.for_shape(shape)
        # The camera, if boxes must be rectified.
        self._lens = camera if camera.fisheye else None
        self._horizon, self._horizon_shape = HorizonFilter(camera.to_pinhole(shape)), shape

    @property
    def camera(self) -> Camera:
        """The camera with the current estimate of its horizon; for a fisheye lens that of rectified boxes."""
        return self._horizon.camera

    def end_tracks(self) -> None:
        """End all tracks and reset the horizon, as at a scene cut; ids and time continue."""
        self._horizon = HorizonFilter(self._horizon.prior_camera)
        self._live: list[TrackState] = []  # confirmed tracks by id, then tentative ones
        self._states = KalmanStates.empty()
        self._at_start = True
        self._gray: Gray | None = None  # the last frame
        self._tracks: tuple[Track, ...] = ()

    def follows(self, shape: tuple[int, ...], time: float | None = None) -> bool:
        """Whether a frame of this shape and time continues the video, so that `predict` applies to it."""
        if self._shape is None or self._time is None or tuple(shape[:2]) != self._shape:
            return False
        return time is None or 0 < time - self._time <= self.params.max_gap

    def update(
        self,
        detections: Detections,
        shape: tuple[int, ...],
        *,
        time: float | None = None,
        frames: int = 1,
        cut: bool = False,
        gray: Gray | None = None,
    ) -> tuple[Track, ...]:
        """Process the detections of the next frame; return confirmed tracks by id, then tentative ones.

        Parameters
        ----------
        detections, shape
            Boxes and scores (log-odds) of this frame, and its ``(height, width, ...)``. The confidences of a
            ``supervision.Detections`` are taken as probabilities.
        time, frames
            Time of the frame in seconds, by default `frames` frames after the last. A frame with the same
            time as the last one changes nothing. An earlier time, a gap of more than ``params.max_gap`` and
            another `shape` end all tracks, as does `cut`, the beginning of another scene (`SceneCuts`).
        gray
            The frame in gray and small (`small_gray`), from which speeds are measured more exactly.
        """
        if hasattr(detections, "xyxy"):
            detections = Detections.from_supervision(detections)
        check.instance(detections, "detections", Detections, "pass Detections(boxes, scores)")
        frame = check.shape(shape)
        if gray is not None:
            gray = check.array(gray, "gray")
            if gray.ndim != 2 or gray.dtype != np.uint8:
                raise invalid("gray", "be an (H, W) uint8 array", gray, "pass tracking.small_gray(frame)")
        if check.boolean(cut, "cut"):
            self.end_tracks()
        dt = self._advance(frame, time, check.integer(frames, "frames", low=1))
        if dt == 0:
            return self._tracks
        found = _sorted_inside(detections, frame)
        used = found.scores >= min(self.params.high_threshold, self.params.low_threshold)
        found = self._limit(found[used])
        unassigned = np.ones(len(found), np.bool_)
        if self._live:
            coasting = np.array([track.misses > 0 for track in self._live])
            before = self._states.boxes()
            states = self._smoother.predict(self._states, coasting, dt)
            self._states = predict_distances(states, dt, self.camera)
            unassigned = self._correct(found, frame, dt, before, gray)
            self._end_lost_tracks(frame, dt)
            self._end_parts(frame)
        self._start(found[unassigned], frame, dt)
        self._confirm(frame)
        self._update_horizon(frame, dt)
        self._tracks, self._at_start, self._gray = self._snapshot(frame, self._states), False, gray
        return self._tracks

    def _limit(self, found: Detections) -> Detections:
        """Keep the best detections of a frame that has too many, and warn of the first such frame."""
        if len(found) > _MAX_DETECTIONS and not self._warned:
            self._warned = True
            warn(
                f"a frame has {len(found)} detections; the {_MAX_DETECTIONS} best of a frame are tracked: "
                "raise the threshold of the detector"
            )
        return found[:_MAX_DETECTIONS]

    def predict(self, *, time: float | None = None, frames: int = 1) -> tuple[Track, ...]:
        """Estimate where the tracks will be, without changing the state of the tracker.

        `time` is in seconds, not before the last frame; by default `frames` frames after it. Returns the
        tracks as `update` would if nothing was detected: confirmed ones are ``"coasting"``, and ages and
        misses have grown; score and ``shown`` are those of the last frame. A track that has left the frame by
        then is left out.

        >>> tracker = Tracker(fps=25)
        >>> for frame in range(50):
        ...     found = Detections([[600 + 4 * frame, 400, 700 + 4 * frame, 490]], [1.0])
        ...     tracks = tracker.update(found, (720, 1280, 3))
        >>> tracks[0].box.round(), tracker.predict()[0].box.round()
        (array([796., 400., 896., 490.]), array([800., 400., 900., 490.]))
        """
        last = 0.0 if self._time is None else self._time
        dt = check.integer(frames, "frames", low=1) * self._frame_seconds
        if time is not None:
            dt = check.number(time, "time", low=last, high=1e12) - last
        if self._shape is None or not self._live:
            return ()
        if dt == 0:
            return self._tracks
        coasting = np.array([track.misses > 0 for track in self._live])
        states = self._smoother.predict(self._states, coasting, dt)
        tracks = []
        for track in self._snapshot(self._shape, predict_distances(states, dt, self.camera), dt):
            times: Any = {"age": track.age + dt, "time_since_update": track.time_since_update + dt}
            if box_areas(track.box[None]) >= 1:
                state: Any = "coasting" if track.id else "tentative"
                tracks.append(replace(track, state=state, misses=track.misses + 1, **times))
        return tuple(tracks)

    def _advance(self, frame: FrameShape, time: float | None, frames: int) -> float:
        """Set the time of this frame and return the seconds since the last; end all tracks at a jump."""
        usual = frames * self._frame_seconds
        last = -usual if self._time is None else self._time
        now = last + usual if time is None else check.number(time, "time", low=-1e12, high=1e12)
        dt = usual if self._time is None else now - last
        jump = dt < 0 or dt > max(self.params.max_gap, 1.5 * usual)
        if self._horizon_shape != frame:
            self._open_horizon(frame)
        if jump or frame != self._shape:
            self.end_tracks()
            dt = usual
        self._time, self._shape = now, frame
        return dt

    def _correct(
        self, found: Detections, frame: FrameShape, dt: float, before: Floats, gray: Gray | None
    ) -> NDArray[np.bool_]:
        """Correct the tracks by their detections; return which detections belong to no track."""
        boxes, scores = found.boxes, found.scores
        unassigned = np.ones(len(boxes), np.bool_)
        own, shared, merged = self._assign(boxes, scores, frame)
        for row, track in enumerate(self._live):
            track.update_score(float(scores[own[row]]) if row in own else None, dt, self.params)
            track.hidden = row in shared
            if row in own and found.labels is not None:
                track.votes[str(found.labels[own[row]])] += 1
        source = shared | own
        if not source:
            return unassigned
        unassigned[list(own.values())] = False
        rows = sorted(source)
        tracks, boxes = [self._live[row] for row in rows], boxes[[source[row] for row in rows]]
        in_front, predicted = self._in_front(), _clip(self._states.boxes(), frame)
        covered = nearer_cover(predicted, in_front)
        for track, fraction in zip(self._live, covered.tolist()):
            track.covered = fraction
        is_merged = [row in shared or row in merged for row in rows]
        # A low-score box of a vehicle may also cover the lamp post above it.
        low = scores < self.params.high_threshold
        unsure = [track.id > 0 and low[source[row]] for row, track in zip(rows, tracks)]
        hidden = hidden_edges(boxes, predicted, rows, in_front)
        measured = Measurements.from_boxes(boxes, frame, is_merged, self._lens, covered[rows], hidden, unsure)
        measured = measured._replace(growth=self._growth(tracks, measured, before[rows], frame, gray))
        gaps = np.array([track.last_gap for track in tracks])
        states = self._smoother.correct(self._states.take(rows), gaps, measured, dt)
        states = update_distances(states, measured, self.camera, dt, self.params.measurement_correlation_time)
        self._states = self._states.put(rows, states)
        return unassigned

    def _growth(
        self,
        tracks: Sequence[TrackState],
        measured: Measurements,
        before: Floats,
        frame: FrameShape,
        gray: Gray | None,
    ) -> Floats | None:
        """Growth of tracks since the last frame, in which they had the boxes `before`; see `Measurements`."""
        if gray is None or self._gray is None or gray.shape != self._gray.shape:
            return None
        result = np.tile([0.0, np.inf], (len(tracks), 1))
        seen = np.array([track.last_gap == 0 and track.hits > 1 for track in tracks])
        rows = np.flatnonzero(
            seen & ~measured.merged & (measured.covered == 0) & ~measured.truncated[:, [0, 2]].any(axis=1)
        )
        scale = gray.shape[1] / frame[1]
        boxes, new_boxes = scale * before[rows], scale * measured.boxes[rows]
        camera = (self._lens or self.camera).for_shape(gray.shape)
        result[rows] = np.stack(measure_growth(self._gray, gray, boxes, new_boxes, camera), axis=1)
        return result

    def _assign(
        self, boxes: Floats, scores: Floats, frame: FrameShape
    ) -> tuple[dict[int, int], dict[int, int], set[int]]:
        """Assign detections (best first) to tracks in five rounds.

        Returns the detection of each track, the merged detection of each track without one, and the tracks
        whose own detection is merged.
        """
        params = self.params
        predicted = _clip(self._states.boxes(), frame)
        confirmed = sum(track.id > 0 for track in self._live)
        # The distance grows with the time without a detection, and is smaller for tentative tracks, so that
        # false positives at changing places do not form a track.
        gaps = [min(track.time_since_update, _MAX_GAP) for track in self._live]
        factors = np.array([1.0 if track.id else _TENTATIVE_DISTANCE for track in self._live]) + gaps
        max_distance = params.max_distance * factors
        # 1. Confirmed tracks that were detected in the last frame, or hidden, with high-score detections.
        high = int((scores >= params.high_threshold).sum())
        lost = [track.misses > 0 and not track.hidden for track in self._live]
        rows = [row for row in range(confirmed) if not lost[row]]
        pairs = match_boxes(predicted[rows], boxes[:high], max_distance[rows])
        own = {rows[row]: column for row, column in pairs}
        # 2. Lost tracks, which must overlap them, and tentative ones with the other ones.
        rows = [row for row in range(len(self._live)) if lost[row] or row >= confirmed]
        columns = sorted({*range(high)} - {*own.values()})
        min_iou = np.array([_COASTING_IOU if row < confirmed else 0.0 for row in rows])[:, None]
        for row, column in match_boxes(predicted[rows], boxes[columns], max_distance[rows], min_iou):
            own[rows[row]] = columns[column]
        of_confirmed = {row: column for row, column in own.items() if row < confirmed}
        merged, shared = merged_detections(predicted[:confirmed], boxes[:high], of_confirmed)
        # 3. Remaining confirmed tracks with low-score detections.
        rows = [row for row in range(confirmed) if row not in own and row not in shared]
        near = _LOW_SCORE_DISTANCE * max_distance[rows]
        for row, column in match_boxes(predicted[rows], boxes[high:], near, _LOW_SCORE_IOU):
            own[rows[row]] = high + column
        # 4. Remaining tentative tracks with low-score detections.
        columns = sorted({*range(high, len(boxes))} - {*own.values()})
        rows = [row for row in range(confirmed, len(self._live)) if row not in own]
        for row, column in match_boxes(predicted[rows], boxes[columns], max_distance[rows]):
            own[rows[row]] = columns[column]
        # 5. Tentative tracks, whose speed is not known, with sure detections of approaching vehicles. Unsure
        # ones may be of what stands beside the road, which comes nearer, too.
        sure = int((scores >= params.instant_confirm_score).sum())
        columns = sorted({*range(sure)} - {*own.values()})
        rows = [row for row in range(confirmed, len(self._live)) if row not in own]
        focus = frame[1] / 2, self.camera.horizon_px
        for row, column in match_approaching(predicted[rows], boxes[columns], focus, frame):
            own[rows[row]] = columns[column]
        return own, shared, merged

    def _end_lost_tracks(self, frame: FrameShape, dt: float) -> None:
        """End tracks that have no visible part, or that have no detection and expired or left the frame."""
        whole = self._states.boxes()
        inside = _clip(whole, frame)
        area = box_areas(inside)
        missed = np.array([track.misses > 0 for track in self._live])
        ended = area < 1
        if missed.any():
            self._mark_missed(whole, inside, dt)
            visible = area / box_areas(whole)
            beyond = (whole - inside) * OUTWARD > 0
            outwards = self._states.mean[:, [4, 5, 4, 5]] * OUTWARD > 0
            leaving = (visible < _LEAVING) & (beyond & outwards).any(axis=1)
            leaving |= exit_times(self._states.mean, frame) < _EXIT_TIME
            expired = np.array([track.is_expired(self.params) for track in self._live])
            ended |= missed & ((visible < _LEFT) | leaving | expired)
        self._keep(np.flatnonzero(~ended).tolist())

    def _end_parts(self, frame: FrameShape) -> None:
        """End tracks that show a part of the vehicle of a much better one, such as its side."""
        if len(self._live) < 2:
            return
        scores = np.array([track.score for track in self._live])
        detected = np.array([track.misses == 0 for track in self._live])
        better = self._in_front()[:, None] & (scores[:, None] > scores + _PART_GAP)
        ended = detected & (better & on_one_vehicle(_clip(self._states.boxes(), frame))).any(axis=0)
        if ended.any():
            self._keep(np.flatnonzero(~ended).tolist())

    def _mark_missed(self, whole: Floats, inside: Floats, dt: float) -> None:
        """Account for missing detections, given the boxes of all tracks and their parts inside the frame."""
        nearer = whole[None, :, 3] > whole[:, None, 3]
        fractions = np.where(nearer & self._in_front(), covered_fractions(inside, inside), 0.0).max(axis=1)
        gap = np.array([track.time_since_update for track in self._live])
        lost = coasted_distance(self._states.mean, gap) > _MAX_COAST_DISTANCE
        lost |= gap > self.params.max_coast + TIME_TOLERANCE
        for track, fraction, is_lost in zip(self._live, fractions.tolist(), lost.tolist()):
            if track.misses:
                is_merged, covered = track.hidden, fraction > _COVERED and not track.hidden
                track.mark_missed(dt, hidden=is_merged or fraction > _HIDDEN, covered=covered, lost=is_lost)

    def _in_front(self) -> NDArray[np.bool_]:
        """Return which tracks are confirmed and detected in this frame, and so may hide others."""
        return np.array([track.id > 0 and track.misses == 0 for track in self._live], np.bool_)

    def _keep(self, rows: list[int]) -> None:
        """Keep these tracks, in this order."""
        self._live = [self._live[row] for row in rows]
        self._states = self._states.take(rows)

    def _start(self, found: Detections, frame: FrameShape, dt: float) -> None:
        """Start a tentative track at each high-score detection that shows no tracked vehicle."""
        boxes, scores = found.boxes, found.scores
        high = int((scores >= self.params.high_threshold).sum())
        visible = [row for row, track in enumerate(self._live) if track.misses == 0 or track.shown]
        known = _clip(self._states.boxes()[visible], frame)
        rows = distinct_vehicles(boxes, range(high), known, self.params) if high else []
        if not rows:
            return
        tracked = _clip(self._states.boxes(), frame)
        hidden = hidden_edges(boxes[rows], tracked, [-1] * len(rows), self._in_front())
        measured = Measurements.from_boxes(boxes[rows], frame, camera=self._lens, hidden=hidden)
        states = initiate_states(*self._smoother.initiate(measured), self.camera)
        correlation = self.params.measurement_correlation_time
        self._states = self._states.join(update_distances(states, measured, self.camera, dt, correlation))
        weight = weight_of(dt, self.params)
        labels = [] if found.labels is None else found.labels[rows].tolist()
        for score, label in itertools.zip_longest(scores[rows].tolist(), labels):
            confirm_at_birth = self._at_start and score >= self.params.instant_confirm_score
            track = TrackState(score * weight, weight, confirm_at_birth=confirm_at_birth, key=self._next_key)
            track.votes.update([label] if label else [])
            self._live.append(track)
            self._next_key += 1

    def _confirm(self, frame: FrameShape) -> None:
        """Confirm tentative tracks that meet the conditions, best score first, and assign their ids."""
        tracks = self._live
        ready = [row for row, track in enumerate(tracks) if track.can_confirm(self.params)]
        if not ready:
            return
        boxes = _clip(self._states.boxes(), frame)
        areas = box_areas(boxes)
        ready.sort(key=lambda row: (-tracks[row].score, -areas[row], boxes[row].tolist()))
        shown = [row for row, track in enumerate(tracks) if track.shown]
        for row in distinct_vehicles(boxes, ready, boxes[shown], self.params):
            tracks[row].id, self._next_id = self._next_id, self._next_id + 1
        self._keep(sorted(range(len(tracks)), key=lambda row: tracks[row].id or math.inf))

    def _update_horizon(self, frame: FrameShape, dt: float) -> None:
        """Update the horizon from confirmed tracks that are fully visible in this frame."""
        boxes, ids = self._states.boxes(), np.array([track.id for track in self._live], np.int64)
        visible = self._in_front() & np.array([track.covered == 0 for track in self._live], np.bool_)
        visible &= ~truncated_edges(boxes, frame).any(axis=1)
        road_boxes = boxes[visible]
        if self._lens is not None:
            road_boxes = self._lens.rectify_boxes(road_boxes, frame)
        self._horizon.update(ids[visible], road_boxes, frame, dt)

    def _snapshot(self, frame: FrameShape, states: KalmanStates, dt: float = 0.0) -> tuple[Track, ...]:
        """Return the tracks, whose states have been predicted by `dt` seconds."""
        boxes, live = _clip(states.boxes(), frame), self._live
        boxes.setflags(write=False)
        gap = np.array([track.time_since_update + dt for track in live])
        confidences = [None] * len(live)
        if self._calibration is not None:
            scores = np.array([track.mean_score for track in live])
            confidences = self._calibration.probability(scores).tolist()
        velocities = map(tuple, states.mean[:, 4:6].tolist())
        ranges = estimate_distances(states, gap, self.camera)
        names = ("id", "key", "score", "state", "shown", "age", "misses", "time_since_update", "label")
        tracks = []
        for track, box, velocity, confidence, estimate in zip(live, boxes, velocities, confidences, ranges):
            life = {name: getattr(track, name) for name in names}
            tracks.append(Track(box=box, velocity=velocity, confidence=confidence, **estimate, **life))
        return tuple(tracks)


def _sorted_inside(detections: Detections, frame: FrameShape) -> Detections:
    """Clip detections to the frame, best score first and then the largest, in any order of the input."""
    boxes = _clip(detections.boxes.astype(np.float64), frame)
    order = np.lexsort((*boxes.T, -box_areas(boxes), -detections.scores))
    order = order[(boxes[order, 2:] - boxes[order, :2] >= 1).all(axis=1)]
    return detections.with_columns(boxes=boxes)[order]


def _clip(boxes: Floats, frame: FrameShape) -> Floats:
    height, width = frame
    return np.minimum(np.maximum(boxes, 0.0), np.array([width, height, width, height], np.float64))
