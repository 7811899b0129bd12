"""Follow vehicles from frame to frame: regions in, vehicles that keep their identity out.

Each frame's boxes are assigned to the tracks (Hungarian assignment on overlap and distance), each track is a
constant-velocity Kalman filter over its box and another one over its distance. The scheme is that of Bewley
et al., *Simple Online and Realtime Tracking* (ICIP 2016), with a life that weighs scores instead of counting
frames, and that knows why a vehicle may be unseen: hidden by another, merged with it, cut off by the frame.
Detections that would be too weak for a still keep a believed track alive, as in Zhang et al., *ByteTrack:
Multi-Object Tracking by Associating Every Detection Box* (ECCV 2022).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, describe
from vehicle_detection.boxes import Detections, box_areas
from vehicle_detection.camera import Camera, check_shape, truncated_edges
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import TrackParams
from vehicle_detection.tracking.association import (
    match_boxes,
    match_nearest,
    merged_regions,
    overlap_matrices,
    same_vehicle,
)
from vehicle_detection.tracking.horizon_filter import HorizonFilter
from vehicle_detection.tracking.track import (
    OUTWARDS,
    TINY,
    Filters,
    Floats,
    Frame,
    Track,
    Vehicle,
    correct_filters,
    follow_box,
    known_ranges,
    moved_unseen,
    predict_filters,
    start_filters,
)

__all__ = ["Track", "Tracker"]

# Shares of a box: inside the frame, below which it leaves or has left; covered, above which it is hidden.
_LEAVES, _LEFT, _HIDDEN = 0.5, 0.15, 0.5
# How far, in its own sizes, a vehicle may move unseen and still be drawn: farther on it is a guess.
_BLIND = 0.5
# Standard error of a horizon that nobody stated, as a share of the frame's height.
_HORIZON_DOUBT = 0.05
# Share of the gate for tracks that are not believed yet.
_TENTATIVE_GATE = 0.6
# The same for weak detections.
_WEAK_GATE = 0.5


class Tracker:
    """Follow vehicles through the frames of one video.

    Parameters
    ----------
    params
        How tracks live and move; by default ``TrackParams()``.
    fps
        Frames a second, used where `update` is not told the time.
    camera
        The camera, for distances and speeds; by default ``Camera.for_frame`` of each video's frame size,
        with a horizon that is learned from the vehicles.

    Raises
    ------
    InvalidInputError
        If an argument is of the wrong kind or out of range.

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
        self, params: TrackParams | None = None, *, fps: float = 25.0, camera: Camera | None = None
    ) -> None:
        if params is not None and not isinstance(params, TrackParams):
            raise InvalidInputError(
                f"params must be a TrackParams, got {describe(params)}; pass TrackParams()"
            )
        if camera is not None and not isinstance(camera, Camera):
            raise InvalidInputError(
                f"camera must be a Camera, got {describe(camera)}; pass Camera.for_frame(image.shape)"
            )
        try:
            self._frame_seconds = 1 / check_number(fps, "fps", above=0, high=1e6)
        except InvalidInputError as error:
            raise InvalidInputError(f"{error}; pass the video's frame rate, such as fps=25") from None
        self.params = params or TrackParams()
        self._fixed_camera = camera
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next frame is the first, and the next vehicle has the id 1."""
        self._horizon = HorizonFilter(self._fixed_camera or _guess_camera((720, 1280)))
        self._shape: Frame | None = None
        self._time: float | None = None
        self._next_id = 1
        self.cut()

    def set_camera(self, camera: Camera) -> None:
        """Look through another camera from the next frame on, as where frames of another size follow."""
        if camera != self._fixed_camera:
            self._fixed_camera, self._horizon = camera, HorizonFilter(camera)

    @property
    def camera(self) -> Camera:
        """The camera as it is known by now: a horizon in doubt is learned from the vehicles."""
        return self._horizon.camera

    def cut(self) -> None:
        """End all tracks and forget the horizon, as the picture jumps elsewhere; ids and time go on."""
        self._horizon = HorizonFilter(self._horizon.given)
        self._vehicles: list[Vehicle] = []
        self._filters = Filters.empty()
        self._at_start = True
        self._tracks: tuple[Track, ...] = ()

    def update(
        self, detections: Detections, shape: tuple[int, ...], *, time: float | None = None
    ) -> tuple[Track, ...]:
        """Take the detections of the next frame and return all tracks, those that are not to be drawn too.

        Parameters
        ----------
        detections
            Boxes and scores of this frame, in any order.
        shape
            ``(height, width, ...)`` of the frame.
        time
            Time of the frame in seconds; by default one frame after the last. A frame of the same time as the
            last changes nothing. A time before it, a gap of more than ``params.max_gap`` and another `shape`
            end all tracks.

        Returns
        -------
        tuple of Track
            Believed tracks by id, then tentative ones.

        Raises
        ------
        InvalidInputError
            If an argument is malformed, or `time` is not finite.
        """
        if not isinstance(detections, Detections):
            raise InvalidInputError(
                f"detections must be a Detections, got {describe(detections)}; pass Detections(boxes, scores)"
            )
        frame = check_shape(shape)
        dt = self._advance(frame, time)
        if dt == 0:
            return self._tracks
        boxes, scores = _inside(detections, frame)
        known = scores >= min(self.params.high_threshold, self.params.low_threshold)
        boxes, scores = boxes[known], scores[known]
        free = np.ones(len(boxes), np.bool_)
        if self._vehicles:
            time_since_update = np.array([vehicle.misses > 0 for vehicle in self._vehicles])
            self._filters = predict_filters(self._filters, time_since_update, dt, self.camera, self.params)
            free = self._correct(boxes, scores, frame, dt)
        self._end(frame, dt)
        self._begin(boxes[free], scores[free], frame, dt)
        self._confirm(frame)
        self._learn(frame, dt)
        self._tracks, self._at_start = self._snapshot(frame), False
        return self._tracks

    def _advance(self, frame: Frame, time: float | None) -> float:
        """Set the clock to this frame and return the seconds since the last; end the tracks at a jump."""
        last, usual = self._time, self._frame_seconds
        if time is None:
            now = 0.0 if last is None else last + usual
        else:
            now = check_number(time, "time", low=-1e12, high=1e12)
        dt = usual if last is None else now - last
        jump = dt < 0 or dt > max(self.params.max_gap, 1.5 * usual)
        if jump or frame != self._shape:
            self.cut()
            dt = usual
        if self._shape != frame:
            self._horizon = HorizonFilter(self._fixed_camera or _guess_camera(frame))
        self._time, self._shape = now, frame
        return dt

    def _correct(self, boxes: Floats, scores: Floats, frame: Frame, dt: float) -> NDArray[np.bool_]:
        """Correct the tracks by the detections that belong to them; return which detections are left."""
        vehicles, free = self._vehicles, np.ones(len(boxes), np.bool_)
        own, region, merged = self._assign(boxes, scores, frame)
        for row, vehicle in enumerate(vehicles):
            vehicle.live(float(scores[own[row]]) if row in own else None, dt, self.params)
            vehicle.hidden = row in region
        source = region | own
        if not source:
            return free
        free[list(own.values())] = False
        rows = sorted(source)
        measured = boxes[[source[row] for row in rows]]
        partly = np.array([row in region or row in merged for row in rows])
        before = self._filters.take(rows)
        after = correct_filters(before, measured, partly, frame, dt, self.camera, self.params)
        if self.params.smoother != "kalman":
            moved = [
                follow_box(vehicles[row], old, box, dt, self.params)
                for row, old, box in zip(rows, before.mean, measured)
            ]
            after = after._replace(mean=np.stack(moved))
        self._filters = self._filters.put(rows, after)
        return free

    def _assign(
        self, boxes: Floats, scores: Floats, frame: Frame
    ) -> tuple[dict[int, int], dict[int, int], set[int]]:
        """Find each track's detection, the regions that show one beside another, and those others."""
        predicted = _clip(self._filters.boxes(), frame)
        # The longer unseen, the farther off it may be; clutter that leaps about shall not pass for a vehicle.
        near = (1.0 if v.id else _TENTATIVE_GATE for v in self._vehicles)
        gate = np.array([self.params.gate * (n + v.time_since_update) for n, v in zip(near, self._vehicles)])
        match = match_nearest if self.params.smoother == "nearest" else match_boxes
        # Believed tracks come first in the list, and choose first.
        believed = sum(v.id > 0 for v in self._vehicles)
        # Detections come the best one first; weak ones are for tracks that found no other.
        clear = int((scores >= self.params.high_threshold).sum())
        own = dict(match(predicted[:believed], boxes[:clear], gate[:believed]))
        merged, region = merged_regions(predicted[:believed], boxes[:clear], own)
        lost = [row for row in range(believed) if row not in own and row not in region]
        for row, column in match(predicted[lost], boxes[clear:], _WEAK_GATE * gate[lost]):
            own[lost[row]] = clear + column
        taken = set(own.values())
        left = [column for column in range(len(boxes)) if column not in taken]
        for row, column in match(predicted[believed:], boxes[left], gate[believed:]):
            own[believed + row] = left[column]
        return own, region, merged

    def _end(self, frame: Frame, dt: float) -> None:
        """End the tracks that are lost or have left the picture; find out which are hidden by others."""
        vehicles = self._vehicles
        if not vehicles:
            return
        whole = self._filters.boxes()
        inside = _clip(whole, frame)
        area = box_areas(inside)
        gone = area < 1
        if any(v.misses for v in vehicles):
            share = area / box_areas(whole)
            beyond = (whole - inside) * OUTWARDS > 0
            moving = self._filters.mean[:, [4, 5, 4, 5]] * OUTWARDS > 0
            gone |= (share < _LEFT) | ((share < _LEAVES) & (beyond & moving).any(axis=1))
            front = np.array([v.id > 0 and v.misses == 0 for v in vehicles])
            nearer = whole[None, :, 3] > whole[:, None, 3]
            hiding = (overlap_matrices(inside, inside)[1] > _HIDDEN) & nearer & front
            time_since_update = np.array([v.time_since_update for v in vehicles])
            far = moved_unseen(self._filters.mean, time_since_update) > _BLIND
            far |= time_since_update > self.params.max_coast + TINY
            for vehicle, unseen_behind, lost in zip(vehicles, hiding.any(axis=1).tolist(), far.tolist()):
                if vehicle.misses:
                    vehicle.wait(vehicle.hidden or unseen_behind, dt, lost)
        self._keep(
            [
                row
                for row, (vehicle, outside, tiny) in enumerate(zip(vehicles, gone, area < 1))
                if not (tiny or (vehicle.misses and (outside or vehicle.over(self.params))))
            ]
        )

    def _keep(self, rows: list[int]) -> None:
        """Keep these tracks, in this order."""
        self._vehicles = [self._vehicles[row] for row in rows]
        self._filters = self._filters.take(rows)

    def _begin(self, boxes: Floats, scores: Floats, frame: Frame, dt: float) -> None:
        """Start a tentative track at each detection that no track explains, the best first."""
        if not len(boxes):
            return
        params = self.params
        known = [row for row, v in enumerate(self._vehicles) if v.misses == 0 or v.shown]
        taken = _clip(self._filters.boxes()[known], frame)
        for index in np.argsort(-scores, kind="stable"):
            box, score = boxes[index], float(scores[index])
            if score < params.high_threshold or same_vehicle(
                box, taken, params.max_overlap, params.max_cover
            ):
                continue
            taken = np.vstack((taken, box))
            filters = start_filters(box, frame, dt, self.camera, params)
            vehicle = Vehicle(score * (1 - math.exp(-dt / params.memory)))
            vehicle.sure = self._at_start and score >= params.start_score
            vehicle.past.append((0.0, filters.mean[0, :4]))
            self._vehicles.append(vehicle)
            self._filters = self._filters.join(filters)

    def _confirm(self, frame: Frame) -> None:
        """Believe the tentative tracks that have earned it, and give them their ids."""
        vehicles, params = self._vehicles, self.params
        ready = [row for row, vehicle in enumerate(vehicles) if vehicle.believable(params)]
        if not ready:
            return
        boxes = _clip(self._filters.boxes(), frame)
        for row in sorted(ready, key=lambda row: (-vehicles[row].score, boxes[row].tolist())):
            shown = [other for other, vehicle in enumerate(vehicles) if vehicle.shown]
            if not same_vehicle(boxes[row], boxes[shown], params.max_overlap, params.max_cover):
                vehicles[row].id, self._next_id = self._next_id, self._next_id + 1
        self._keep(sorted(range(len(vehicles)), key=lambda row: vehicles[row].id or math.inf))

    def _learn(self, frame: Frame, dt: float) -> None:
        """Learn the horizon from the vehicles that are seen whole."""
        boxes = self._filters.boxes()
        seen = np.array([v.id > 0 and v.misses == 0 for v in self._vehicles], np.bool_)
        seen &= ~truncated_edges(boxes, frame).any(axis=1)
        ids = np.array([v.id for v in self._vehicles], np.int64)
        self._horizon.take(ids[seen], boxes[seen], frame, dt)

    def _snapshot(self, frame: Frame) -> tuple[Track, ...]:
        """Describe the tracks as they stand now."""
        boxes = _clip(self._filters.boxes(), frame)
        boxes.setflags(write=False)
        time_since_update = np.array([v.time_since_update for v in self._vehicles])
        ranges = known_ranges(self._filters, time_since_update, self.camera)
        speeds = self._filters.mean[:, 4:6].tolist()
        return tuple(
            Track(
                id=vehicle.id,
                box=box,
                score=vehicle.score,
                state="tentative" if not vehicle.id else "coasting" if vehicle.misses else "confirmed",
                shown=vehicle.shown,
                age=vehicle.age,
                misses=vehicle.misses,
                time_since_update=vehicle.time_since_update,
                velocity=(speed[0], speed[1]),
                distance_m=told[0],
                distance_std_m=told[1],
                speed_mps=told[2],
                speed_std_mps=told[3],
            )
            for vehicle, box, speed, told in zip(self._vehicles, boxes, speeds, ranges)
        )


def _guess_camera(frame: Frame) -> Camera:
    return Camera.for_frame(frame, horizon_std_px=_HORIZON_DOUBT * frame[0])


def _inside(detections: Detections, frame: Frame) -> tuple[Floats, Floats]:
    """Boxes and scores inside the frame, in an order that does not depend on the one they came in."""
    boxes = _clip(detections.boxes.astype(np.float64), frame)
    order = np.lexsort((*boxes.T, -detections.scores))
    order = order[(boxes[order, 2:] - boxes[order, :2] >= 1).all(axis=1)]
    return boxes[order], detections.scores[order]


def _clip(boxes: Floats, frame: Frame) -> Floats:
    height, width = frame
    return np.minimum(np.maximum(boxes, 0.0), np.array([width, height, width, height], np.float64))
