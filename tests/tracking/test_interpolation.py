from dataclasses import replace

import numpy as np
import pytest

from vehicle_detection.tracking import Track
from vehicle_detection.tracking.interpolation import backfill_tracks, interpolate_tracks

SHAPE = (720, 1280, 3)


def track(number, box, *, velocity=(0.0, 0.0), age=1.0, **options):
    known = {"score": 1.0, "state": "confirmed", "shown": True, "misses": 0, "time_since_update": 0.0}
    return Track(id=number, box=np.array(box, float), velocity=velocity, age=age, **known, **options)


def test_a_track_of_both_frames_is_interpolated():
    first = track(3, [100, 200, 150, 260], age=1.0, distance_m=20.0, speed_mps=2.0)
    second = track(3, [104, 202, 156, 264], age=1.08, distance_m=18.0, speed_mps=None)
    (found,) = interpolate_tracks([first], [second], 0.02, 0.06, SHAPE)
    np.testing.assert_allclose(found.box, [101, 200.5, 151.5, 261])
    assert (found.id, found.state, found.shown) == (3, "confirmed", True)
    assert (found.age, found.time_since_update) == (pytest.approx(1.02), pytest.approx(0.02))
    assert found.distance_m == pytest.approx(19.5)
    assert found.speed_mps == 2.0
    with pytest.raises(ValueError, match="read-only"):
        found.box[0] = 0


def test_a_track_that_has_ended_moves_on():
    first = track(1, [100, 200, 150, 260], velocity=(50.0, -25.0), age=2.0)
    (found,) = interpolate_tracks([first], [], 0.04, 0.04, SHAPE)
    np.testing.assert_allclose(found.box, [102, 199, 152, 259])
    assert (found.age, found.time_since_update) == (pytest.approx(2.04), pytest.approx(0.04))
    leaving = track(1, [0, 200, 3, 260], velocity=(-100.0, 0.0))
    assert interpolate_tracks([leaving], [], 0.04, 0.04, SHAPE) == ()


def test_the_distance_of_a_track_that_has_ended_moves_on():
    known = {"distance_m": 10.0, "distance_std_m": 0.3, "speed_mps": -5.0, "speed_std_mps": 1.0}
    (found,) = interpolate_tracks([track(1, [100, 200, 150, 260], **known)], [], 0.4, 0.0, SHAPE)
    assert (found.distance_m, found.distance_std_m) == (pytest.approx(8.0), pytest.approx(0.5))
    np.testing.assert_allclose(found.box, [93.75, 192.5, 156.25, 267.5])
    near = track(1, [100, 200, 150, 260], **known | {"distance_m": 1.5})
    (found,) = interpolate_tracks([near], [], 0.4, 0.0, SHAPE)
    assert found.distance_m == 1.0


def test_a_track_is_shown_from_its_first_detection_on():
    tentative = track(0, [100, 200, 150, 260])
    confirmed = track(5, [104, 200, 154, 260], velocity=(50.0, 0.0), age=0.3)
    (found,) = interpolate_tracks([tentative], [confirmed], 0.04, 0.04, SHAPE)
    np.testing.assert_allclose(found.box, [102, 200, 152, 260])
    assert (found.id, found.age, found.time_since_update > 0) == (5, pytest.approx(0.26), True)
    # Not one that was detected for the first time after this frame.
    new = track(5, [104, 200, 154, 260], age=0.0)
    assert interpolate_tracks([], [new], 0.04, 0.04, SHAPE) == ()


def test_tentative_tracks_are_interpolated_too():
    """Otherwise their vehicles would be blurred in searched frames only."""
    before = [replace(track(0, [left, 200, left + 50, 260], key=key), shown=False) for key, left in
              ((7, 100), (8, 300), (9, 500))]  # fmt: skip
    confirmed = track(2, [900, 200, 950, 260], key=1)
    new = track(0, [0, 0, 9, 9], age=0.0, key=10)
    after = [confirmed, track(1, [504, 200, 554, 260], key=9), before[0], new]
    found = interpolate_tracks([confirmed, *before], after, 0.04, 0.04, SHAPE)
    # Confirmed, confirmed in the second frame, tentative in both, and ended.
    assert [(each.id, each.key) for each in found] == [(2, 1), (1, 9), (0, 7), (0, 8)]
    assert not any(each.shown for each in found if not each.id)


def test_a_track_is_backfilled_with_what_is_known_later():
    options = {"confidence": 0.5}
    tentative = replace(track(0, [100, 200, 150, 260], key=4, **options), state="tentative", shown=False)
    missed = replace(tentative, key=6, misses=1)
    other = replace(tentative, key=5)
    known = track(2, [500, 200, 550, 260], key=1)
    confirmed = track(3, [104, 200, 154, 260], key=4, confidence=0.9)
    later = [known, confirmed, track(1, [0, 0, 50, 50], key=6), replace(other, key=7)]
    found = backfill_tracks([known, tentative, missed, other], later)
    assert [each.id for each in found] == [1, 2, 3, 0]
    assert [each.state for each in found] == ["coasting", "confirmed", "confirmed", "tentative"]
    assert [each.shown for each in found] == [True, True, True, False]
    assert found[1] is known
    assert found[2].confidence == 0.9
    np.testing.assert_array_equal(found[2].box, tentative.box)


def test_tracks_without_a_key_are_not_backfilled():
    tentative = replace(track(0, [100, 200, 150, 260]), state="tentative", shown=False)
    assert backfill_tracks([tentative], [track(3, [104, 200, 154, 260])]) == (tentative,)
