"""Results of the frames between two searched frames, and of those before a track was confirmed."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vehicle_detection._common import Floats
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking.track import TIME_TOLERANCE, FrameResult, Track, TrackParams

_INTERPOLATED = ("score", "confidence", "age")
_MEASURED = ("distance_m", "distance_std_m", "speed_mps", "speed_std_mps")
_MIN_DISTANCE = 1.0  # of a vehicle that moves on after its last detection (m)
_MIN_SEARCH_RATE = 12.0  # searches per second of a video, at least


def search_interval(fps: float) -> int:
    """Interval of the frames of a video to search: every one, or fewer if its rate is above 24 per second."""
    return max(1, int(fps / _MIN_SEARCH_RATE + 0.01))  # 23.976 counts as 24


def search_delay(params: TrackParams, fps: float, interval: int) -> int:
    """Return how many searched frames to hold back for `backfill_results`."""
    return int(params.backfill * fps / interval + 0.01)


def interpolate_results(
    before: FrameResult, after: FrameResult | None, times: Sequence[float], shape: tuple[int, ...]
) -> list[FrameResult]:
    """Return the results of the frames at `times` between two searched frames, with interpolated tracks.

    `before` and `after` have times; `after` is None at the end of a video.
    """
    end = before.time if after is None else after.time
    if before.time is None or end is None:
        raise InvalidInputError("before and after must have times; pass time= to track")
    results, following = [], () if after is None else after.tracks
    for number, time in enumerate(times):
        start = clock.thread_time()
        tracks = interpolate_tracks(before.tracks, following, time - before.time, end - time, shape)
        results.append(FrameResult.unsearched(before.index + 1 + number, time, tracks, start))
    return results


def backfill_results(results: Sequence[FrameResult]) -> list[FrameResult]:
    """Show the tracks that are confirmed in the last of consecutive searched frames in the others, too."""
    if not results or not any(track.id for track in results[-1].tracks):
        return list(results)
    *earlier, last = results
    return [*(replace(each, tracks=backfill_tracks(each.tracks, last.tracks)) for each in earlier), last]


def interpolate_tracks(
    before: Sequence[Track], after: Sequence[Track], dt: float, dt_after: float, shape: tuple[int, ...]
) -> tuple[Track, ...]:
    """Estimate the tracks of a frame between two frames by linear interpolation, confirmed ones first.

    The frame is `dt` seconds after the tracks `before` and `dt_after` seconds before the tracks `after`. A
    track that has ended in `after`, or that was not confirmed yet in `before`, moves at its velocity and
    speed, unless it is outside the frame. Tentative tracks are included, so that their vehicles can be
    blurred.
    """
    confirmed = {track.key for track in after if track.id}
    following = {_identity(track): track for track in after}
    found = []
    for track in before:
        other = following.pop(_identity(track), None)
        if track.id or track.key not in confirmed:
            found.append(_move(track, dt, shape) if other is None else _mean(track, other, dt, dt_after))
    # Detected before this frame, but confirmed after it.
    started = [track for track in following.values() if track.age >= dt_after - TIME_TOLERANCE]
    found += [_move(track, -dt_after, shape) for track in started]
    found.sort(key=lambda track: track.id == 0)
    return tuple(track for track in found if (track.box[2:] - track.box[:2]).min() >= 1)


def _identity(track: Track) -> tuple[int, int]:
    """Return what identifies a confirmed or a tentative track in two frames."""
    return (track.id, 0) if track.id else (0, track.key)


def backfill_tracks(earlier: Sequence[Track], later: Sequence[Track]) -> tuple[Track, ...]:
    """Confirm and show the tentative tracks of an earlier frame that are confirmed in a later one.

    They get the id, the score and the confidence that they have there.
    """
    confirmed = {track.key: track for track in later if track.id and track.key}
    found = []
    for track in earlier:
        other = None if track.id else confirmed.get(track.key)
        if other is not None:
            values: Any = {name: getattr(other, name) for name in ("id", "score", "confidence")}
            track = replace(track, state="coasting" if track.misses else "confirmed", shown=True, **values)
        found.append(track)
    # Confirmed tracks by id, then tentative ones.
    return tuple(sorted(found, key=lambda track: track.id or math.inf))


def _mean(first: Track, second: Track, dt: float, dt_after: float) -> Track:
    """Interpolate between two states of a track."""
    fraction = dt / (dt + dt_after)
    values: dict[str, Any] = {"box": _read_only(first.box + fraction * (second.box - first.box))}
    values["time_since_update"] = first.time_since_update + dt  # as it was not searched for here
    for name in _INTERPOLATED + _MEASURED:
        a, b = getattr(first, name), getattr(second, name)
        if a is not None and b is not None:
            values[name] = (1 - fraction) * a + fraction * b
    return replace(first, **values)


def _move(track: Track, dt: float, shape: tuple[int, ...]) -> Track:
    """Move a track by `dt` seconds at its velocity and, where it is known, its speed."""
    box = track.box + dt * np.tile(track.velocity, 2)
    values: dict[str, Any] = {"age": track.age + dt, "time_since_update": track.time_since_update + abs(dt)}
    if track.distance_m is not None and track.speed_mps is not None:
        distance = max(track.distance_m + dt * track.speed_mps, _MIN_DISTANCE)
        center, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2 * track.distance_m / distance
        box = np.concatenate((center - half, center + half))
        std = math.hypot(track.distance_std_m or 0.0, dt * (track.speed_std_mps or 0.0))
        values |= {"distance_m": distance, "distance_std_m": std}
    return replace(track, box=_read_only(clip_boxes(box[None], shape)[0]), **values)


def _read_only(box: Floats) -> Floats:
    box.setflags(write=False)
    return box
