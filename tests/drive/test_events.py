"""Events of simulated drives with known truth."""

import dataclasses
import functools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.drives import CAMERA, FPS, SHAPE, box_of, cut_in_times, log_frames, passing_times, simulate
from vehicle_detection import Camera, InvalidInputError, Track, TrackTable, find_events
from vehicle_detection._common import UNITS
from vehicle_detection.drive import Event
from vehicle_detection.drive.motion import estimate_motion, track_histories

SEEDS = (0, 1, 2)
simulated = functools.cache(simulate)


def events_of(scenario, seed, **options):
    return find_events(simulated(scenario, seed)[1], fps=FPS, shape=SHAPE, **options)


def matches(found, true, *, tolerance=2.5):
    """Number of true events that are found, each at most once; both are ``(kind, side, time)``."""
    left = list(true)
    for kind, side, time in found:
        near = [each for each in left if each[:2] == (kind, side) and abs(each[2] - time) < tolerance]
        if near:
            left.remove(near[0])
    return len(true) - len(left)


def listed(events, *kinds):
    return [(event.kind, event.side, event.time_s) for event in events if event.kind in kinds]


@pytest.mark.parametrize("scenario", ["passing", "cut_in", "crossing"])
def test_overtakes_and_cut_ins_are_found(scenario):
    found_count = true_count = correct = 0
    for seed in SEEDS:
        traffic, _ = simulated(scenario, seed)
        sides = {True: "left", False: "right"}
        true = [
            ("overtook_us" if from_behind else "we_overtook", sides[lane < 0], time)
            for time, from_behind, lane in passing_times(traffic, 10)
        ]
        true += [("cut_in", sides[lane < 0], time) for time, lane in cut_in_times(traffic)]
        found = listed(events_of(scenario, seed), "overtook_us", "we_overtook", "cut_in", "met", "passed")
        correct += matches(found, true)
        found_count, true_count = found_count + len(found), true_count + len(true)
    assert true_count >= len(SEEDS)
    assert correct / found_count >= 0.9
    assert correct / true_count >= 0.9


@pytest.mark.parametrize("scenario", ["closing", "highway"])
def test_steady_traffic_has_no_passing_events(scenario):
    for seed in SEEDS:
        assert not listed(events_of(scenario, seed), "overtook_us", "we_overtook", "cut_in")


def test_oncoming_vehicles_are_met():
    found_count = 0
    for seed in SEEDS:
        traffic, _ = simulated("highway", seed)
        found = listed(events_of("highway", seed), "met")
        true = [("met", "left", time) for time, *_ in passing_times(traffic, 12, first=0, oncoming=True)]
        assert matches(found, true, tolerance=1.5) == len(found)
        found_count += len(found)
    assert found_count >= 2, "few of them are tracked, at a relative speed of 50 m/s"


def test_time_to_collision_is_within_15_percent_at_3_seconds():
    errors, normalized = [], []
    for seed in SEEDS:
        (vehicle,), table = simulated("closing", seed)
        motion = estimate_motion(track_histories(table)[0], fps=FPS, shape=SHAPE, camera=CAMERA)
        true = np.array([vehicle.distance(time) / -vehicle.relative_speed(time) for time in motion.seconds])
        near = np.abs(true - 3) < 0.4
        difference = motion.time_to_collision[near] - true[near]
        errors += (difference / true[near]).tolist()
        normalized += (difference / motion.time_to_collision_std[near]).tolist()
    assert len(errors) > 20
    assert np.median(np.abs(errors)) < 0.15
    assert np.mean(np.abs(normalized) < 2) > 0.75, "the stated standard errors are about right"


def test_a_vehicle_that_closes_in_is_an_event():
    for seed in SEEDS:
        (vehicle,), _ = simulated("closing", seed)
        first = next(event for event in events_of("closing", seed) if event.ttc_s is not None)
        times = np.arange(0.5, 4, 0.05)
        true = [vehicle.distance(time) / -vehicle.relative_speed(time) for time in times]
        assert first.kind in ("closing", "hard_closing")
        assert abs(first.time_s - times[np.argmin(true)]) < 1.0
        assert abs(first.ttc_s - min(true)) < max(0.25 * min(true), 2 * first.ttc_std_s)
        assert first.closing_mps > 3


def test_frames_that_were_not_processed_do_not_change_the_speeds():
    (_, table), dropped = simulated("closing", 0), TrackTable()
    number = 0
    for frame, time, tracks in log_frames("closing", 0):
        if frame % 2 == 0:
            dropped.append(number, time, tracks)
            number += 1
    whole, half = (find_events(each, fps=FPS, shape=SHAPE) for each in (table, dropped))
    found, expected = (next(event for event in events if event.ttc_s is not None) for events in (half, whole))
    assert found.kind == expected.kind
    assert found.ttc_s == pytest.approx(expected.ttc_s, rel=0.15)
    assert found.closing_mps == pytest.approx(expected.closing_mps, rel=0.1)


def test_the_headway_is_at_the_smallest_stated_distance():
    table = simulated("closing", 0)[1]
    (history,) = (each for each in track_histories(table) if each.id == 1)
    for event in find_events(table, fps=FPS, shape=SHAPE):
        if event.kind == "headway" and event.track_id == 1:
            rows = (history.frames >= event.start_frame) & (history.frames <= event.end_frame)
            stated = history.columns["distance_m"][rows]
            assert event.distance_m == pytest.approx(np.nanmin(stated), abs=0.01)


def test_headway_in_seconds_needs_the_own_speed():
    unknown = [event for event in events_of("closing", 0) if event.kind == "headway"]
    known = [event for event in events_of("closing", 0, own_speed_mps=25) if event.kind == "headway"]
    assert [event.headway_s for event in unknown] == [None] * len(unknown) != []
    assert known[0].headway_s == pytest.approx(known[0].distance_m / 25, abs=0.01)
    stopped = events_of("closing", 0, own_speed_mps=np.zeros(200))
    assert all(event.headway_s is None for event in stopped)


def test_the_own_speed_tells_standing_from_moving_vehicles():
    slow = next(event for event in events_of("passing", 0) if event.kind == "we_overtook")
    for own_speed, kind in ((slow.closing_mps, "passed"), (0.0, "met")):
        found = events_of("passing", 0, own_speed_mps=own_speed)
        assert [event.kind for event in found if event.track_id == slow.track_id and event.side] == [kind]


def test_speeds_over_ground_where_the_own_speed_is_known():
    (vehicle,), _ = simulated("closing", 0)
    own = np.full(200, 30.0)
    own[60:] = np.nan
    for event in events_of("closing", 0, own_speed_mps=own):
        if event.closing_mps is None or event.frame >= 60:
            assert event.speed_mps is None
        else:
            assert event.speed_mps == pytest.approx(30.0 - event.closing_mps, abs=0.011)
            true = 30.0 + vehicle.relative_speed(event.time_s)
            assert abs(event.speed_mps - true) < max(3 * event.closing_std_mps, 2.0)
    assert any(event.speed_mps is not None for event in events_of("closing", 0, own_speed_mps=own))
    unknown = events_of("closing", 0, own_speed_mps=np.full(200, np.nan))
    assert unknown == events_of("closing", 0)


def test_an_event_is_a_value_with_a_description():
    event = Event(kind="closest_approach", track_id=3, frame=10, start_frame=10, end_frame=10, time_s=0.4,
                  distance_m=8.0, distance_std_m=1.0, side="left")  # fmt: skip
    text = "vehicle 3 closest approach, on the left, distance"
    assert event.text(UNITS["imperial"], with_time=False) == f"{text} 26.2 ± 3.3 ft"
    assert str(event) == f"0.4 s: {text} 8.0 ± 1.0 m"
    with pytest.raises(dataclasses.FrozenInstanceError):
        event.frame = 3


def test_what_is_stated_is_known_and_in_order():
    for scenario in ("passing", "cut_in"):
        table, events = simulated(scenario, 1)[1], events_of(scenario, 1)
        frames = {track.id: track.frames.tolist() for track in track_histories(table)}
        assert [event.frame for event in events] == sorted(event.frame for event in events)
        for event in events:
            assert event.start_frame <= event.frame <= event.end_frame
            assert {event.start_frame, event.frame, event.end_frame} <= set(frames[event.track_id])
            assert event.time_s == pytest.approx(event.frame / FPS, abs=1e-3)
            for name in ("distance_m", "headway_s", "ttc_s"):
                value, std = getattr(event, name), getattr(event, name.replace("_", "_std_"))
                assert (value is None) == (std is None)
                assert value is None or 0 < std <= 0.31 * value
            assert f"vehicle {event.track_id}" in str(event)


def test_the_camera_changing_lanes_is_no_cut_in():
    table = simulated("cut_in", 0)[1]
    (event,) = (each for each in find_events(table, fps=FPS, shape=SHAPE) if each.kind == "cut_in")
    (mover,) = (track for track in track_histories(table) if track.id == event.track_id)
    shift = np.array([200.0, 0, 200, 0]) * (1 if event.side == "right" else -1)
    columns = {name: np.tile(values, 2) for name, values in mover.columns.items()}
    numbers, boxes = np.repeat([mover.id, 99], len(mover.frames)), [*mover.boxes, *(mover.boxes + shift)]
    both = TrackTable(np.tile(mover.frames, 2), numbers, boxes, **columns)
    found = find_events(both, fps=FPS, shape=SHAPE)
    assert not listed(found, "cut_in")


@given(seed=st.integers(0, 10_000), known=st.booleans(), speed=st.sampled_from([None, 20.0]))
def test_any_track_gives_consistent_events(seed, known, speed):
    rng = np.random.default_rng(seed)
    frames = np.flatnonzero(rng.random(80) > 0.3)
    steps = rng.normal(0, 12, (len(frames), 4)).cumsum(axis=0)
    first = rng.uniform(-100, 700, 2)
    x, y = first[0] + steps[:, 0], first[1] + steps[:, 1]
    sides = 20 * np.exp(np.abs(steps[:, 2:]) / 30)
    boxes = np.clip(np.stack([x, y, x + sides[:, 0], y + sides[:, 1]], axis=1), 0, [1280, 720, 1280, 720])
    distance = 2000 / sides[:, 1] if known else np.full(len(frames), np.nan)
    ones = np.ones(len(frames), int)
    table = TrackTable(frames, ones, boxes, distance_m=distance, distance_std_m=0.1 * distance)
    for event in find_events(table, fps=FPS, shape=SHAPE, own_speed_mps=speed):
        assert event.start_frame <= event.frame <= event.end_frame
        assert event.ttc_s is None or event.ttc_s > 0
        assert event.distance_m is None or event.distance_m > 0
        assert all(math.isfinite(value) for value in vars(event).values() if isinstance(value, float))


def table_on(distance, lateral, *, seconds=4.0, frames=120, confidence=0.9, first=1, **columns):
    """Table of a vehicle at these distances and lateral positions (m), functions of the time (s)."""
    vehicle = SimpleNamespace(distance=distance, lateral=lateral)
    table = TrackTable()
    for frame in range(frames):
        box = box_of(vehicle, frame / 25) if frame < 25 * seconds else None
        inside = None if box is None else np.clip(box, 0, [1280, 720, 1280, 720])
        shown = inside is not None and inside[2] - inside[0] > 0.2 * (box[2] - box[0])
        track = Track(
            id=1, box=inside, score=2.0, state="confirmed", shown=True, age=1.0, misses=0,
            time_since_update=0.0, velocity=(0, 0), confidence=confidence,
            **{name: value(frame / 25) if callable(value) else value for name, value in columns.items()},
        ) if shown else None  # fmt: skip
        table.append(frame, frame / 25, [track] if track else [])
    return table


def kinds_on(distance, lateral, *, own_speed_mps=None, **options):
    events = find_events(
        table_on(distance, lateral, **options), fps=25, shape=SHAPE, own_speed_mps=own_speed_mps
    )
    return [event.kind for event in events]


PASSED = {"distance": lambda time: 30 - 8 * time, "lateral": lambda time: 3.0}
CAME_PAST = {"distance": lambda time: 2 + 6 * time, "lateral": lambda time: -3.5}


def test_a_vehicle_that_leaves_or_comes_into_the_frame_passes():
    assert kinds_on(**PASSED) == ["we_overtook"]
    assert kinds_on(**CAME_PAST) == ["overtook_us"]


@pytest.mark.parametrize(
    ("path", "options"),
    [
        (PASSED, {"frames": 60}),  # the video ends, and the vehicle is in view
        (PASSED, {"frames": 71}),  # the border has cut it off
        (PASSED, {"seconds": 2.0}),  # the track ends in full view
        ({"distance": lambda time: 15, "lateral": lambda time: -14 + 8 * time}, {}),  # crosses a junction
        ({"distance": lambda time: 12 + 2 * time, "lateral": lambda time: -9 + 8 * time}, {}),
        # The camera turns into the road of a vehicle ahead.
        ({"distance": lambda time: 14 + 4 * time, "lateral": lambda time: 12 - 8 * min(time, 1.5)}, {}),
        (PASSED, {"confidence": 0.4}),
        (CAME_PAST, {"confidence": 0.4}),
    ],
)
def test_what_does_not_pass_is_no_event(path, options):
    passing = {"we_overtook", "overtook_us", "met", "passed"}
    assert not passing & set(kinds_on(**path, **options))


def test_vehicles_that_end_together_are_cut_off_by_the_next_scene():
    one = table_on(**PASSED, seconds=2.8)
    rows = one["frame"].astype(int)
    both = TrackTable(
        [*rows, *rows, 119], [*one["track_id"].astype(int), *np.full(len(rows), 2), 3],
        [*one.boxes, *(one.boxes - np.array([500, 0, 500, 0])), [0, 0, 9, 9]],
    )  # fmt: skip
    assert [event.kind for event in find_events(one, fps=25, shape=SHAPE)] == ["we_overtook"]
    assert not find_events(both, fps=25, shape=SHAPE)


@pytest.mark.parametrize(("own_speed", "kind"), [(8.0, "passed"), (9.5, "passed"), (20.0, "we_overtook")])
def test_a_parked_vehicle_is_not_met_where_the_own_speed_is_known(own_speed, kind):
    assert kinds_on(**PASSED, own_speed_mps=own_speed) == [kind]


def test_no_vehicle_closes_in_whose_stated_distance_grows():
    near = {"distance": lambda time: 25 - 5 * time, "lateral": lambda time: 0.0}
    assert {"closing", "hard_closing"} & set(kinds_on(**near, speed_mps=-5.0, speed_std_mps=1.0))
    assert not {"closing", "hard_closing"} & set(kinds_on(**near, speed_mps=1.0, speed_std_mps=1.0))


def test_the_distance_of_a_vehicle_that_the_frame_cuts_off_is_a_bound():
    path = {"distance": lambda time: 8 - 3 * math.sin(time), "lateral": lambda time: 3.0}
    table = table_on(**path, distance_m=path["distance"], distance_std_m=0.5)
    events = find_events(table, fps=25, shape=SHAPE)
    (event,) = (each for each in events if each.kind == "closest_approach")
    assert event.is_bound
    assert "distance at most" in str(event)


def test_the_confidence_of_an_event_is_that_of_its_vehicle_at_most():
    for scenario in ("passing", "cut_in", "closing"):
        confidences = [event.confidence for event in events_of(scenario, 0)]
        assert confidences
        assert all(0.5 <= confidence <= 1 for confidence in confidences)
    (event,) = find_events(table_on(**PASSED, confidence=0.7), fps=25, shape=SHAPE)
    assert 0.6 < event.confidence <= 0.7


def test_speeds_of_an_overtaking_vehicle_are_of_one_moment():
    seconds = np.arange(75) / 25
    distance = np.where(seconds < 0.6, 9 - 0.5 * seconds, 8.7 + 8 * (seconds - 0.6))
    height, middle = 1155 * 1.55 / distance, 640 - 1155 * 3 / distance
    boxes = np.stack([middle - height / 2, 500 - height, middle + height / 2, 500 + 0 * height], axis=1)
    boxes[:5, 0] = 0  # it comes in at the left border
    table = TrackTable(np.arange(25, 100), np.ones(75, int), boxes)
    speeds = np.arange(100.0)  # differ by 1 m/s from frame to frame
    (event,) = find_events(table, fps=25, shape=SHAPE, own_speed_mps=speeds)
    assert event.kind == "overtook_us"
    # The frame is that of the least distance, the speeds are of the first certain motion away.
    assert round(event.speed_mps + event.closing_mps, 6) in speeds
    assert round(event.speed_mps + event.closing_mps) < event.frame


def test_a_camera_of_another_size_is_scaled_or_refused():
    table = simulated("cut_in", 0)[1]
    large = Camera.for_frame((2 * SHAPE[0], 2 * SHAPE[1]))
    same = find_events(table, fps=FPS, shape=SHAPE, camera=Camera.for_frame(SHAPE))
    assert find_events(table, fps=FPS, shape=SHAPE, camera=large) == same
    with pytest.raises(InvalidInputError, match="camera must be one for frames of"):
        find_events(table, fps=FPS, shape=(500, 500), camera=large)


@pytest.mark.parametrize("own_speed", [-1.0, [1.0], "fast"])
def test_an_own_speed_that_is_none_is_refused(own_speed):
    assert find_events(TrackTable(), fps=FPS, shape=SHAPE) == ()
    with pytest.raises(InvalidInputError, match="own_speed_mps must be a number of at least 0, or one for"):
        events_of("closing", 0, own_speed_mps=own_speed)


def test_no_vehicle_is_followed_while_it_is_not_seen():
    frames = np.array([*range(8), *range(95, 103)])
    boxes = np.array([[620 - 0.1 * (frame % 2), 380, 660, 420] for frame in frames])
    known = {"distance_m": np.full(16, 20.0), "distance_std_m": np.ones(16)}
    found = find_events(TrackTable(frames, np.ones(16, int), boxes, **known), fps=25, shape=SHAPE)
    assert not listed(found, "headway")


def test_distances_of_a_fisheye_lens():
    """A car in the next lane, whose box at the border of the image is far from that of a pinhole camera."""
    camera = dataclasses.replace(CAMERA, fisheye=True)
    (history,) = track_histories(simulated("closing", 0)[1])[:1]
    unknown = {**history.columns, "distance_m": np.full(len(history.frames), np.nan)}
    far = dataclasses.replace(history, boxes=history.boxes + np.array([200.0, 0, 200, 0]), columns=unknown)
    boxes = camera.rectify_boxes(far.boxes, SHAPE)
    plain = dataclasses.replace(far, boxes=boxes)
    found = estimate_motion(far, fps=FPS, shape=SHAPE, camera=camera)
    expected = estimate_motion(plain, fps=FPS, shape=SHAPE, camera=CAMERA)
    inside = boxes[:, 2] < 1200
    assert inside.sum() > 20
    np.testing.assert_allclose(found.distance[inside], expected.distance[inside])
