import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection.boxes import Detections, iou_matrix
from vehicle_detection.camera import Camera
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, evaluate_tracks
from vehicle_detection.params import TrackParams
from vehicle_detection.synthetic import render_drive
from vehicle_detection.tracking import Track, Tracker
from vehicle_detection.tracking import kalman_filter as _kalman

SHAPE = (720, 1280, 3)
LIMITS = np.array([1280.0, 720.0, 1280.0, 720.0])
CAMERA = Camera.for_frame(SHAPE)
CAR = [600.0, 400.0, 700.0, 490.0]


def found(*boxes, score=1.0):
    return Detections(np.array(boxes, float).reshape(-1, 4), np.full(len(boxes), float(score)))


def on_road(distance, *, x=0.0, width=1.8, height=1.5):
    """Box of a vehicle `distance` meters ahead and `x` meters to the right; None behind the camera."""
    if distance < 1:
        return None
    pixel = CAMERA.focal_px / distance
    foot, center = CAMERA.horizon_px + pixel * CAMERA.height_m, 640 + pixel * x
    return np.array([center - pixel * width / 2, foot - pixel * height, center + pixel * width / 2, foot])


def play(
    scene,
    seconds,
    *,
    fps=25.0,
    noise=0.05,
    seed=0,
    params=None,
    time_since_update=None,
    extra=None,
    score=1.0,
    camera=None,
):
    """Track a drive: `scene` gives each vehicle's box at a time, `time_since_update` who is not detected then.

    Detections are the visible parts, with noise on each edge that is no frame border; vehicles that show less
    than a third are not detected. Yields time, visible boxes by name, and tracks.
    """
    rng = np.random.default_rng(seed)
    tracker, steps = Tracker(params, fps=fps, camera=camera), []
    for index in range(round(seconds * fps)):
        time, truth, boxes = index / fps, {}, []
        for name, where in scene.items():
            box = where(time)
            if box is None:
                continue
            inside = np.clip(box, 0, LIMITS)
            share = np.prod(inside[2:] - inside[:2]) / np.prod(box[2:] - box[:2])
            if share <= 0:
                continue
            truth[name] = inside
            if share < 1 / 3 or (time_since_update and time_since_update(name, time)):
                continue
            size = np.tile(inside[2:] - inside[:2], 2)
            noisy = inside + rng.normal(0, noise, 4) * size * (inside == box)
            boxes.append(np.clip(noisy, 0, LIMITS))
        boxes += extra(time) if extra else []
        steps.append((time, truth, tracker.update(found(*boxes, score=score), SHAPE)))
    return steps


def matched(steps, name, *, overlap=0.5):
    """Time, overlap and shown track at each step where `name` is visible; None where no track is on it."""
    result = []
    for time, truth, tracks in steps:
        if name not in truth:
            continue
        shown = [track for track in tracks if track.shown]
        best, track = 0.0, None
        if shown:
            overlaps = iou_matrix(truth[name][None], np.array([t.box for t in shown]))[0]
            best = float(overlaps.max())
            track = shown[int(overlaps.argmax())] if best >= overlap else None
        result.append((time, best, track))
    return result


def ids(steps, name):
    return {track.id for _, _, track in matched(steps, name) if track}


def shown_ids(steps):
    return {track.id for _, _, tracks in steps for track in tracks if track.shown}


def jitter(steps, name):
    """Mean change of the four edge errors from one frame to the next, in pixels."""
    errors = [
        next(t.box for t in tracks if t.shown) - truth[name]
        for _, truth, tracks in steps
        if name in truth and any(t.shown for t in tracks)
    ]
    return float(np.abs(np.diff(errors, axis=0)).mean())


class TestFollowing:
    def test_a_vehicle_at_constant_speed_is_followed_without_lag(self):
        steps = play({"car": lambda t: np.array(CAR) + np.array([120.0, 0, 120.0, 0]) * t}, 4, noise=0.0)
        last = steps[-1]
        np.testing.assert_allclose(last[2][0].box, last[1]["car"], atol=0.5)
        assert last[2][0].velocity == pytest.approx((120, 0), abs=3)

    @pytest.mark.parametrize("seed", range(4))
    def test_boxes_are_steady(self, seed):
        """The raw boxes jump by 5.5 px a frame; tracked ones stay below the target of 1.5."""
        steps = play({"car": lambda t: on_road(20 + t, x=2.0)}, 8, seed=seed)
        assert jitter(steps, "car") < 1.5
        overlaps = [overlap for time, overlap, _ in matched(steps, "car") if time > 0.5]
        assert np.mean(overlaps) > 0.9

    def test_one_wrong_box_does_not_throw_the_track(self):
        tracker = Tracker()
        for _ in range(30):
            tracker.update(found(CAR), SHAPE)
        (track,) = tracker.update(found([560.0, 340.0, 760.0, 520.0]), SHAPE)
        assert np.abs(track.box - CAR).max() < 12

    def test_a_vehicle_that_changes_lanes_after_a_long_straight_is_followed(self):
        steps = play({"car": lambda t: on_road(15, x=3.6 / (1 + np.exp(-4 * (t - 6))))}, 9, noise=0.02)
        errors = [
            np.abs(tracks[0].box[[0, 2]] - truth["car"][[0, 2]]).max()
            for time, truth, tracks in steps
            if 5 < time < 7
        ]
        assert max(errors) < 25

    @pytest.mark.parametrize("fps", [10.0, 25.0, 60.0])
    def test_a_track_that_is_wrong_comes_round_soon(self, fps):
        tracker, larger = Tracker(fps=fps), [570.0, 380.0, 720.0, 520.0]
        for _ in range(int(2 * fps)):
            tracker.update(found(CAR), SHAPE)
        for _ in range(int(0.7 * fps)):
            (track,) = tracker.update(found(larger), SHAPE)
        assert iou_matrix([larger], [track.box])[0, 0] > 0.85

    def test_a_box_that_flickers_between_two_sizes_leaves_the_track_steady(self):
        tracker, boxes = Tracker(), []
        for index in range(100):
            part = [600.0, 400.0, 700.0, 450.0]
            tracks = tracker.update(found(part if index % 3 == 2 else CAR), SHAPE)
            boxes += [track.box for track in tracks if track.shown and index > 20]
        assert np.abs(np.diff(boxes, axis=0)).max() < 6

    @pytest.mark.parametrize("speed", [8.0, 18.0, 25.0])
    def test_oncoming_vehicles_are_followed_as_they_grow(self, speed):
        steps = play({"car": lambda t: on_road(60 - speed * t, x=-3.0)}, 48 / speed)
        assert ids(steps, "car") == {1}
        overlaps = [overlap for time, overlap, _ in matched(steps, "car") if time > 0.5]
        assert np.mean(overlaps) > 0.75

    @pytest.mark.parametrize("smoother", ["history", "nearest"])
    def test_the_simple_smoothers_follow_a_slow_vehicle_too(self, smoother):
        params = TrackParams(smoother=smoother)
        steps = play({"car": lambda t: on_road(20 + t, x=2.0)}, 6, params=params)
        assert ids(steps, "car") == {1}
        assert np.mean([overlap for time, overlap, _ in matched(steps, "car") if time > 0.5]) > 0.85

    def test_the_kalman_smoother_follows_a_fast_one_better(self):
        scene = {"car": lambda t: np.array([100.0, 400, 200, 490]) + np.array([220.0, 0, 220.0, 0]) * t}
        best = {}
        for smoother in ("kalman", "history", "nearest"):
            steps = play(scene, 4, params=TrackParams(smoother=smoother))
            best[smoother] = np.mean([overlap for time, overlap, _ in matched(steps, "car") if time > 1])
        assert best["kalman"] > best["nearest"] + 0.05
        assert best["kalman"] > best["history"] + 0.05


class TestLife:
    @pytest.mark.parametrize("frames", [1, 2, 3])
    def test_false_positives_of_up_to_three_frames_are_never_shown(self, frames):
        tracker, shown = Tracker(), []
        for index in range(60):
            noise = found(CAR, score=5.0) if 0 < index % 12 <= frames else Detections.empty()
            shown += [track for track in tracker.update(noise, SHAPE) if track.shown]
        assert not shown

    def test_a_strong_detection_is_shown_in_its_fourth_frame(self):
        tracker = Tracker()
        tracker.update(Detections.empty(), SHAPE)
        shown = [any(t.shown for t in tracker.update(found(CAR, score=1.5), SHAPE)) for _ in range(6)]
        assert shown == [False, False, False, True, True, True]

    def test_a_strong_detection_at_the_start_is_shown_at_once(self):
        tracker = Tracker()
        for ids_so_far in ([1], [2]):
            tracks = tracker.update(found(CAR, score=1.5), SHAPE)
            assert [track.id for track in tracks if track.shown] == ids_so_far
            assert not any(track.shown for track in tracker.update(Detections.empty(), SHAPE))
            tracker.cut()
        (weak,) = tracker.update(found(CAR, score=1.0), SHAPE)
        assert not weak.shown

    def test_a_weak_vehicle_is_shown_later_and_a_very_weak_one_never(self):
        first = {}
        for score in (1.5, 0.3, 0.15):
            tracker = Tracker()
            tracker.update(Detections.empty(), SHAPE)
            shown = [any(t.shown for t in tracker.update(found(CAR, score=score), SHAPE)) for _ in range(100)]
            first[score] = shown.index(True) if any(shown) else None
        assert first[1.5] < first[0.3] < 12
        assert first[0.15] is None

    def test_scores_below_the_birth_score_start_no_track_but_keep_one(self):
        tracker = Tracker(TrackParams(high_threshold=0.5))
        assert tracker.update(found(CAR, score=0.4), SHAPE) == ()
        for _ in range(10):
            tracker.update(found(CAR, score=1.0), SHAPE)
        (track,) = tracker.update(found(CAR, score=0.4), SHAPE)
        assert (track.state, track.misses) == ("confirmed", 0)

    @pytest.mark.parametrize(("score", "misses"), [(-0.4, 0), (-1.4, 0), (-1.6, 5)])
    def test_a_believed_vehicle_is_kept_by_weak_detections(self, score, misses):
        tracker = Tracker()
        for _ in range(10):
            tracker.update(found(CAR, score=3.0), SHAPE)
        for _ in range(5):
            (track,) = tracker.update(found(CAR, score=score), SHAPE)
        assert track.misses == misses

    def test_weak_detections_alone_are_no_vehicle(self):
        for score in (-0.4, -1.0):
            tracker = Tracker()
            for _ in range(100):
                assert not any(track.shown for track in tracker.update(found(CAR, score=score), SHAPE))

    def test_a_vehicle_that_wavers_about_the_least_score_is_followed_without_a_gap(self):
        tracker, shown = Tracker(), []
        for frame in range(100):
            tracks = tracker.update(found(CAR, score=0.9 if frame % 3 else -0.7), SHAPE)
            shown.append([track.id for track in tracks if track.shown])
        assert shown.index([1]) < 25
        assert all(ids == [1] for ids in shown[25:])

    def test_a_weak_detection_takes_no_vehicle_from_a_clear_one(self):
        tracker, moved = Tracker(), [612.0, 400.0, 712.0, 490.0]
        for _ in range(10):
            tracker.update(found(CAR, score=3.0), SHAPE)
        (track,) = tracker.update(Detections([CAR, moved], [-0.6, 3.0]), SHAPE)
        assert track.score > 2
        assert track.box[0] > CAR[0] + 2

    def test_a_weak_detection_must_be_nearer_than_a_clear_one(self):
        width = CAR[2] - CAR[0]
        for share, clear, weak in ((0.2, 0, 0), (0.5, 0, 1)):
            beside = np.array(CAR) + np.array([share * width, 0, share * width, 0])
            for score, misses in ((3.0, clear), (-1.0, weak)):
                tracker = Tracker()
                for _ in range(10):
                    tracker.update(found(CAR, score=3.0), SHAPE)
                tracks = tracker.update(found(beside, score=score), SHAPE)
                assert tracks[0].misses == misses

    def test_a_vehicle_that_stops_growing_does_not_run_away(self):
        """As one that comes in from the left, fast at first: its box shall not shoot beyond it later on."""
        rng = np.random.default_rng(0)
        tracker = Tracker()
        for frame in range(120):
            right = 40 + 3 * min(frame, 40) + 1.2 * max(frame - 40, 0)
            width = min(right, 140.0)
            height = 40 + 50 * min(frame / 30, 1) - 0.2 * max(frame - 40, 0)
            box = np.array([right - width, 390 - height, right, 390]) + rng.normal(0, 3, 4)
            (track,) = tracker.update(found(box, score=3.0), SHAPE)
            assert frame < 10 or iou_matrix(track.box[None], box[None].clip(0))[0, 0] > 0.6
        assert track.id == 1
        assert np.abs(track.velocity).max() < 100

    def test_states_and_ids(self):
        tracker = Tracker()
        states = []
        for index in range(12):
            tracks = tracker.update(found(CAR) if index < 10 else Detections.empty(), SHAPE)
            states.append((tracks[0].state, tracks[0].id, tracks[0].misses))
        assert states[0] == ("tentative", 0, 0)
        assert states[9] == ("confirmed", 1, 0)
        assert states[11] == ("coasting", 1, 2)

    def test_a_lost_vehicle_is_shown_for_a_while_then_hidden_then_ended(self):
        tracker = Tracker()
        for _ in range(50):
            tracker.update(found(CAR), SHAPE)
        frames = [tracker.update(Detections.empty(), SHAPE) for _ in range(40)]
        shown = sum(any(t.shown for t in tracks) for tracks in frames)
        alive = sum(bool(tracks) for tracks in frames)
        assert shown == 7  # 0.3 s at 25 fps
        assert alive == 25  # 1 s

    @pytest.mark.parametrize(
        ("params", "least"), [({"confirm_hits": 6}, 6), ({"confirm_seconds": 0.4}, 11)], ids=["hits", "time"]
    )
    def test_hits_and_time_each_hold_a_track_back(self, params, least):
        tracker = Tracker(TrackParams(**params))
        tracker.update(Detections.empty(), SHAPE)
        shown = [any(t.shown for t in tracker.update(found(CAR, score=9.0), SHAPE)) for _ in range(20)]
        assert shown.index(True) + 1 == least

    @pytest.mark.parametrize("fps", [10.0, 60.0])
    def test_neither_few_boxes_nor_a_short_time_are_enough(self, fps):
        """At 10 frames a second three boxes take 0.2 s, at 60 four boxes take 0.05 s: not shown yet."""
        tracker = Tracker(fps=fps)
        tracker.update(Detections.empty(), SHAPE)
        shown = [any(t.shown for t in tracker.update(found(CAR, score=9.0), SHAPE)) for _ in range(12)]
        assert shown.index(True) + 1 == (4 if fps == 10 else 9)

    def test_a_vehicle_seen_for_a_moment_is_shown_for_a_moment_only(self):
        tracker = Tracker()
        for _ in range(5):
            tracker.update(found(CAR), SHAPE)
        shown = sum(any(t.shown for t in tracker.update(Detections.empty(), SHAPE)) for _ in range(20))
        assert shown == 1

    def test_a_coasting_box_keeps_its_size(self):
        tracker = Tracker()
        for index in range(30):
            tracker.update(found(on_road(20 - 0.3 * index)), SHAPE)
        before = tracker.update(found(on_road(11)), SHAPE)[0].box
        for _ in range(24):
            (track,) = tracker.update(Detections.empty(), SHAPE)
        growth = np.prod(track.box[2:] - track.box[:2]) / np.prod(before[2:] - before[:2])
        assert 0.5 < growth < 2.5

    def test_a_coasting_vehicle_slows_down(self):
        """Speeds in the image do not last: undamped it would be 72 px on."""
        tracker = Tracker()
        for index in range(50):
            (last,) = tracker.update(found(np.add(CAR, [3 * index, 0, 3 * index, 0])), SHAPE)
        for _ in range(24):
            (track,) = tracker.update(Detections.empty(), SHAPE)
        assert 40 < track.box[0] - last.box[0] < 62

    def test_two_boxes_on_one_vehicle_make_one_track(self):
        nested, part = [620.0, 410.0, 670.0, 460.0], [600.0, 400.0, 660.0, 490.0]
        tracker, shown = Tracker(), set()
        for _ in range(50):
            tracks = tracker.update(found(CAR, nested, part), SHAPE)
            shown |= {track.id for track in tracks if track.shown}
        assert shown == {1}

    def test_a_second_box_that_comes_later_makes_no_second_track(self):
        steps = play(
            {"car": lambda t: on_road(15)}, 4, extra=lambda t: [np.array([600, 420, 670, 500.0])] * (t > 1)
        )
        assert shown_ids(steps) == {1}

    def test_a_box_of_the_same_size_that_is_shifted_by_a_third_makes_no_second_track(self):
        shifted = [635.0, 400.0, 735.0, 490.0]  # IoU 0.48, and neither covers 0.7 of the other
        tracker, shown = Tracker(), set()
        for index in range(50):
            tracks = tracker.update(found(CAR, *[shifted] * (index > 10)), SHAPE)
            shown |= {track.id for track in tracks if track.shown}
        assert shown == {1}

    def test_ids_are_consecutive_whatever_else_was_tried(self):
        rng = np.random.default_rng(3)
        tracker, seen = Tracker(), []
        for index in range(200):
            clutter = [[x, 500, x + 60, 550] for x in rng.uniform(0, 1200, 2)] * (index % 3 > 0)
            cars = [CAR] * (index > 20) + [[200.0, 400, 300, 480]] * (index > 80)
            for track in tracker.update(found(*clutter, *cars), SHAPE):
                if track.shown and track.id not in seen:
                    seen.append(track.id)
        assert seen == list(range(1, len(seen) + 1))
        assert len(seen) <= 3


class TestMeetings:
    @pytest.mark.parametrize("seed", range(4))
    def test_identity_survives_a_second_behind_another_vehicle(self, seed):
        scene = {"near": lambda t: on_road(12, x=-3 + 1.5 * t), "far": lambda t: on_road(25, x=1 - 0.5 * t)}
        steps = play(scene, 5, seed=seed, time_since_update=lambda name, t: name == "far" and 1.5 <= t < 2.5)
        assert ids(steps, "near") != ids(steps, "far")
        assert len(ids(steps, "near")) == len(ids(steps, "far")) == 1
        assert shown_ids(steps) == {1, 2}

    def test_a_hidden_vehicle_is_shown_throughout(self):
        scene = {"near": lambda t: on_road(10), "far": lambda t: on_road(20, x=3 - min(t, 4) * 0.8)}
        steps = play(scene, 5, time_since_update=lambda name, t: name == "far" and 2 <= t < 3)
        assert all(track for time, _, track in matched(steps, "far") if 0.5 < time < 3)

    def test_a_hidden_vehicle_is_drawn_for_a_second_and_remembered_for_two(self):
        tracker, near, far = Tracker(), [300.0, 380, 800, 600], [745.0, 420, 835, 465]
        for _ in range(60):
            tracker.update(found(near, far), SHAPE)
        steps = [tracker.update(found(near), SHAPE) for _ in range(70)]
        assert sum(sum(t.shown for t in tracks) == 2 for tracks in steps) == 25
        assert sum(len(tracks) == 2 for tracks in steps) == 50

    @pytest.mark.parametrize("seed", range(4))
    def test_crossing_vehicles_keep_their_identity(self, seed):
        def hides(name, t):
            return name == "far" and abs((-4 + 3 * t) / 12 - (2 - 1.5 * t) / 22) * CAMERA.focal_px < 70

        scene = {"near": lambda t: on_road(12, x=-4 + 3 * t), "far": lambda t: on_road(22, x=2 - 1.5 * t)}
        steps = play(scene, 2.6, seed=seed, time_since_update=hides)
        assert len(ids(steps, "near")) == len(ids(steps, "far")) == 1
        assert shown_ids(steps) == {1, 2}

    @pytest.mark.parametrize("seed", range(4))
    def test_two_vehicles_in_one_region_stay_two(self, seed):
        def left(t):
            return on_road(15, x=-1.2)

        def right(t):
            return on_road(16, x=1.0 - 0.2 * min(t, 3))

        def region(t):
            one, two = left(t), right(t)
            together = np.array([*np.minimum(one[:2], two[:2]), *np.maximum(one[2:], two[2:])])
            return [together] if 1.5 <= t < 3 else []

        scene = {"left": left, "right": right}
        steps = play(scene, 5, seed=seed, time_since_update=lambda name, t: 1.5 <= t < 3, extra=region)
        for name in scene:
            assert len(ids(steps, name)) == 1
            assert all(overlap > 0.6 for time, overlap, _ in matched(steps, name) if time > 0.3)
        assert shown_ids(steps) == {1, 2}

    def test_a_vehicle_that_would_have_moved_far_is_no_longer_drawn_behind_another(self):
        """Where it is by now is a guess, for which nothing is seen."""
        tracker, near = Tracker(), [300.0, 380, 800, 600]
        for index in range(40):
            far = [900.0 - 8 * index, 420, 960 - 8 * index, 465]
            tracker.update(found(near, far), SHAPE)
        shown = [sum(t.shown for t in tracker.update(found(near), SHAPE)) for _ in range(30)]
        # At 200 px a second a box of 60 px has moved by half of itself after 0.15 s.
        assert shown[:3] == [2, 2, 2]
        assert set(shown[4:]) == {1}

    def test_a_vehicle_seen_for_a_moment_is_not_drawn_for_long_behind_another(self):
        tracker, near = Tracker(), [300.0, 380, 800, 600]
        for index in range(40):
            tracks = tracker.update(found(near, *[[745.0, 420, 835, 465]] * (index >= 34)), SHAPE)
        assert sum(track.shown for track in tracks) == 2
        shown = [sum(t.shown for t in tracker.update(found(near), SHAPE)) for _ in range(20)]
        assert set(shown[7:]) == {1}


class TestFrameBorder:
    @pytest.mark.parametrize("seed", range(3))
    def test_an_overtaking_vehicle_enters_at_the_right_border(self, seed):
        steps = play({"car": lambda t: on_road(4 + 5 * t, x=3.5)}, 3, seed=seed)
        assert ids(steps, "car") == {1}
        first = next(time for time, _, track in matched(steps, "car") if track)
        overlaps = [overlap for time, overlap, _ in matched(steps, "car") if time > first]
        assert first < 0.6
        assert min(overlaps) > 0.75
        assert np.mean(overlaps) > 0.9

    def test_the_outer_edge_stays_at_the_border_while_a_vehicle_enters(self):
        steps = play({"car": lambda t: on_road(4 + 5 * t, x=3.5)}, 3)
        for _, truth, tracks in steps:
            if "car" in truth and truth["car"][2] == 1280 and truth["car"][0] < 1100:
                assert all(track.box[2] > 1275 for track in tracks if track.shown)

    def test_a_vehicle_that_leaves_at_the_side_is_dropped_at_once(self):
        steps = play({"car": lambda t: on_road(20 - 6 * t, x=3.5)}, 3.6)
        gone = next(time for time, truth, _ in steps if "car" not in truth)
        assert not [track for time, _, tracks in steps for track in tracks if time > gone]
        assert shown_ids(steps) == {1}

    def test_a_vehicle_lost_at_the_border_while_it_moves_inwards_coasts(self):
        tracker = Tracker()
        for index in range(10):
            tracker.update(found([1200.0 - 4 * index, 400, 1280, 520]), SHAPE)
        assert tracker.update(Detections.empty(), SHAPE)[0].shown


class TestTime:
    @pytest.mark.parametrize("fps", [10.0, 25.0, 30000 / 1001, 50.0, 60.0])
    def test_behavior_does_not_depend_on_the_frame_rate(self, fps):
        scene = {
            "near": lambda t: on_road(12, x=-3 + 1.5 * t),
            "far": lambda t: on_road(25, x=1 - 0.5 * t) if t < 4 else None,
        }
        steps = play(scene, 5.5, fps=fps, time_since_update=lambda name, t: name == "far" and 1.5 <= t < 2.5)
        assert shown_ids(steps) == {1, 2}
        for name in scene:
            assert len(ids(steps, name)) == 1
            first = next(time for time, _, track in matched(steps, name) if track)
            assert 0.1 <= first <= 0.31
            assert np.mean([overlap for time, overlap, _ in matched(steps, name) if time > 0.5]) > 0.88
        far = ids(steps, "far").pop()
        hidden = max(time for time, _, tracks in steps for t in tracks if t.id == far and t.shown)
        ended = max(time for time, _, tracks in steps for t in tracks if t.id == far)
        assert hidden - 4 == pytest.approx(0.3, abs=0.11)
        assert ended - 4 == pytest.approx(1.0, abs=0.11)

    def test_speed_in_the_image_is_a_second_not_a_frame(self):
        speeds = []
        for fps in (10.0, 25.0, 60.0):
            scene = {"car": lambda t: np.array(CAR) + np.array([60.0, 0, 60.0, 0]) * t}
            speeds.append(play(scene, 3, fps=fps, noise=0.0)[-1][2][0].velocity[0])
        assert speeds == pytest.approx([60, 60, 60], abs=3)

    def test_times_of_the_frames_replace_the_frame_rate(self):
        by_rate, by_time = Tracker(fps=50), Tracker(fps=25)
        for index in range(30):
            box = np.array(CAR) + index
            first = by_rate.update(found(box), SHAPE)
            second = by_time.update(found(box), SHAPE, time=100 + index / 50)
        assert second[0].velocity == pytest.approx(first[0].velocity, rel=0.02)

    def test_a_repeated_frame_changes_nothing(self):
        tracker = Tracker()
        for index in range(10):
            before = tracker.update(found(CAR), SHAPE, time=index / 25)
        assert tracker.update(Detections.empty(), SHAPE, time=9 / 25) is before
        assert tracker.update(found(CAR), SHAPE, time=10 / 25)[0].misses == 0

    def test_pictures_that_come_twice_do_not_disturb(self):
        """Film at 24 frames a second in a video of 30: each fifth picture is a copy."""
        tracker, seen = Tracker(fps=30), []
        for index in range(90):
            picture = index - index // 5
            seen.append(tracker.update(found(on_road(20 + 0.1 * picture)), SHAPE)[0])
        assert {track.id for track in seen[10:]} == {1}
        assert all(track.shown for track in seen[10:])
        assert np.abs(np.diff([track.box for track in seen[20:]], axis=0)).mean() < 1.0

    def test_after_a_cut_nothing_is_dragged_along(self):
        tracker = Tracker()
        for index in range(50):
            tracker.update(found(on_road(15 + 0.1 * index), on_road(40, x=3.6)), SHAPE)
        learned = tracker.camera.horizon_std_px
        tracker.cut()
        assert tracker.update(Detections.empty(), SHAPE) == ()
        assert tracker.camera.horizon_std_px > 2 * learned

    @pytest.mark.parametrize("times", [[0.0, 0.04, 0.0], [0.0, 0.04, 2.0]], ids=["back", "gap"])
    def test_a_jump_in_time_ends_all_tracks_and_ids_go_on(self, times):
        tracker = Tracker(TrackParams(confirm_hits=1, confirm_seconds=0.0, confirm_score=0.1))
        seen = [[t.id for t in tracker.update(found(CAR, score=2.0), SHAPE, time=time)] for time in times]
        assert seen == [[1], [1], [2]]

    def test_another_frame_size_ends_all_tracks(self):
        tracker = Tracker()
        for _ in range(10):
            tracker.update(found(CAR), SHAPE)
        (track,) = tracker.update(found(CAR), (1080, 1920, 3))
        assert (track.id, track.age) == (0, 0.0)

    def test_cut_ends_all_tracks_and_ids_go_on(self):
        tracker = Tracker()
        for _ in range(10):
            tracker.update(found(CAR), SHAPE)
        tracker.cut()
        for _ in range(10):
            tracks = tracker.update(found(CAR), SHAPE)
        assert [track.id for track in tracks] == [2]

    def test_reset_starts_afresh(self):
        tracker = Tracker()
        runs = []
        for _ in range(2):
            runs.append([tracker.update(found(CAR), SHAPE, time=index / 25) for index in range(10)])
            tracker.reset()
        assert [t.id for t in runs[0][-1]] == [t.id for t in runs[1][-1]] == [1]
        np.testing.assert_array_equal(runs[0][-1][0].box, runs[1][-1][0].box)

    def test_a_slow_frame_rate_is_no_gap(self):
        tracker = Tracker(fps=0.8)
        for _ in range(6):
            tracks = tracker.update(found(CAR), SHAPE)
        assert [track.id for track in tracks] == [1]


class TestDistance:
    @pytest.mark.parametrize(("start", "speed"), [(12.0, 0.0), (10.0, 5.0), (40.0, -6.0), (25.0, 2.0)])
    def test_distance_and_speed_lie_within_their_errors(self, start, speed):
        distances, speeds, trials = [], [], 12
        for seed in range(trials):
            steps = play({"car": lambda t: on_road(start + speed * t, x=1.0)}, 3, seed=seed, noise=0.04)
            time, _, tracks = steps[-1]
            (track,) = tracks
            truth = start + speed * time
            distances.append(abs(track.distance_m - truth) / track.distance_std_m)
            speeds.append(abs(track.speed_mps - speed) / track.speed_std_mps)
            assert track.distance_std_m < 0.25 * truth
            assert track.speed_std_mps < 3
        # The scene's camera and vehicle are the assumed ones, so that only the boxes' noise is left.
        assert np.mean(np.array(distances) < 2) > 0.9
        assert np.mean(np.array(speeds) < 2) > 0.9

    def test_a_truck_is_not_taken_for_a_near_car_forever(self):
        scene = {"truck": lambda t: on_road(20.0, width=2.5, height=3.5)}
        steps = play(scene, 6, noise=0.03, camera=CAMERA)
        (track,) = steps[-1][2]
        by_width_alone = 20 * 1.8 / 2.5
        assert abs(track.distance_m - 20) < abs(by_width_alone - 20) / 2

    def test_distance_is_unknown_where_nothing_can_be_measured(self):
        tracker = Tracker(camera=CAMERA)
        for _ in range(20):
            (track,) = tracker.update(found([900.0, 420, 1280, 720]), SHAPE)
        assert track.distance_m is track.distance_std_m is track.speed_mps is track.speed_std_mps is None

    def test_a_box_above_the_horizon_is_measured_by_its_width(self):
        tracker = Tracker(camera=CAMERA)
        for _ in range(30):
            (track,) = tracker.update(found([600.0, 250, 700, 340]), SHAPE)
        assert track.distance_m is None or track.distance_m > 15

    def test_distance_is_unknown_after_coasting_long(self):
        tracker = Tracker()
        for _ in range(30):
            tracker.update(found(CAR), SHAPE)
        frames = [tracker.update(Detections.empty(), SHAPE)[0] for _ in range(20)]
        assert frames[0].distance_m is not None
        assert frames[-1].distance_m is None

    @pytest.mark.parametrize("seed", range(3))
    def test_the_horizon_of_an_unknown_camera_is_learned(self, seed):
        """The guess is 43 px off; with it, what is 30 m ahead would be 50 m or 22 m ahead."""
        scene = {"near": lambda t: on_road(14 + 2 * t), "far": lambda t: on_road(45 - 3 * t, x=3.6)}
        wrong = Camera.for_frame(SHAPE, horizon=0.5, horizon_std_px=43.0)
        steps = play(scene, 6, seed=seed, noise=0.04, camera=wrong)
        for name, distance in (("near", 26.0), ("far", 27.0)):
            _, _, track = matched(steps, name)[-1]
            assert track.distance_m == pytest.approx(distance, rel=0.15)
            assert abs(track.distance_m - distance) < 2.5 * track.distance_std_m

    def test_another_camera_is_learned_anew(self):
        tracker = Tracker()
        for index in range(50):
            tracker.update(found(on_road(15 + 0.1 * index), on_road(40, x=3.6)), SHAPE)
        tracker.set_camera(CAMERA)
        assert tracker.camera is CAMERA

    def test_a_given_camera_is_used(self):
        low, high = (Camera.for_frame(SHAPE, horizon=0.5, height_m=height) for height in (1.0, 2.0))
        told = []
        for camera in (low, high):
            tracker = Tracker(camera=camera)
            for _ in range(50):
                (track,) = tracker.update(found([600.0, 400, 700, 490]), SHAPE)
            told.append(track.distance_m)
        assert told[1] > told[0] * 1.2


class TestFilters:
    def state(self):
        mean, cov = _kalman.start(np.array([CAR, [100.0, 300, 180, 420]]), np.full((2, 4), 5.0))
        mean[:, 4:] = [[30.0, -4.0, 6.0, 3.0], [-80.0, 2.0, 9.0, 8.0]]
        return mean, cov, np.full((2, 4), 7.0)

    def test_boxes_and_states_are_inverse(self):
        mean, _, _ = self.state()
        np.testing.assert_allclose(_kalman.boxes_of(mean), [CAR, [100.0, 300, 180, 420]])
        np.testing.assert_allclose(_kalman.state_of(np.array(CAR)), mean[0, :4])

    def test_two_predictions_equal_one_over_the_whole_time(self):
        mean, cov, density = self.state()
        once = _kalman.predict(mean, cov, 0.3, density)
        twice = _kalman.predict(*_kalman.predict(mean, cov, 0.1, density), 0.2, density)
        for one, two in zip(once, twice, strict=True):
            np.testing.assert_allclose(one, two, atol=1e-9)

    def test_no_time_changes_nothing(self):
        mean, cov, density = self.state()
        for before, after in zip((mean, cov), _kalman.predict(mean, cov, 0.0, density), strict=True):
            np.testing.assert_array_equal(before, after)

    def test_a_measured_box_draws_the_state_and_makes_it_surer(self):
        mean, cov, density = self.state()
        mean, cov = _kalman.predict(mean, cov, 0.04, density)
        edges = _kalman.boxes_of(mean) + 4.0
        after, spread, _ = _kalman.update(
            mean, cov, np.zeros((2, 4)), edges, np.full((2, 4), 25.0), np.zeros(2, bool), 0.75
        )
        moved = _kalman.boxes_of(after) - _kalman.boxes_of(mean)
        assert ((moved > 0) & (moved < 4)).all()
        assert (np.linalg.eigvalsh(cov - spread) > -1e-9).all()

    def test_edges_that_are_not_seen_do_not_count(self):
        mean, cov, _ = self.state()
        variance = np.array([[25.0, 25.0, _kalman.UNKNOWN, 25.0]] * 2)
        results = []
        for right in (0.0, 500.0):
            edges = _kalman.boxes_of(mean) + np.array([3.0, 1.0, right, 1.0])
            results.append(
                _kalman.update(mean, cov, np.zeros((2, 4)), edges, variance, np.zeros(2, bool), 0.75)[0]
            )
        np.testing.assert_allclose(*results, atol=0.02)

    def test_inputs_are_not_changed(self):
        mean, cov, density = self.state()
        copies = mean.copy(), cov.copy()
        _kalman.predict(mean, cov, 0.1, density)
        far = _kalman.boxes_of(mean) + 90.0
        _kalman.update(mean, cov, np.full((2, 4), 5.0), far, density, np.zeros(2, bool), 0.75)
        start, spread = _kalman.range_start(CAMERA)
        start, spread = start[None], spread[None]
        _kalman.range_update(
            start,
            spread,
            np.array([CAR]),
            np.zeros((1, 4), bool),
            np.zeros(1),
            CAMERA,
            dt=0.04,
            alike=0.04,
        )
        np.testing.assert_array_equal(mean, copies[0])
        np.testing.assert_array_equal(cov, copies[1])
        np.testing.assert_array_equal(start[0], _kalman.range_start(CAMERA)[0])


class TestSameResult:
    def drive(self, order):
        rng, shuffler = np.random.default_rng(5), np.random.default_rng(order)
        tracker, result = Tracker(), []
        for index in range(60):
            cars = [np.array(CAR) + index, np.array([300.0, 410, 380, 480]) - index, [900.0, 400, 1000, 480]]
            clutter = [[x, 500, x + 60, 550] for x in rng.uniform(0, 1200, 2)]
            boxes = np.array([*cars, *clutter]) + rng.normal(0, 3, (5, 4))
            scores = np.array([1.0, 1.0, 1.0, 0.4, 0.4])
            keep = rng.random(5) > 0.1
            boxes, scores = boxes[keep], scores[keep]
            if order:
                rows = shuffler.permutation(len(boxes))
                boxes, scores = boxes[rows], scores[rows]
            result.append(tracker.update(Detections(boxes, scores), SHAPE))
        return result

    @pytest.mark.parametrize("order", [0, 1, 2])
    def test_repeating_or_permuting_the_detections_changes_nothing(self, order):
        for first, second in zip(self.drive(0), self.drive(order), strict=True):
            assert [(t.id, t.state, t.score, t.distance_m) for t in first] == [
                (t.id, t.state, t.score, t.distance_m) for t in second
            ]
            for one, other in zip(first, second, strict=True):
                np.testing.assert_array_equal(one.box, other.box)

    def test_trackers_share_no_ids(self):
        one, other = Tracker(), Tracker()
        for _ in range(10):
            first, second = one.update(found(CAR), SHAPE), other.update(found(CAR), SHAPE)
        assert first[0].id == second[0].id == 1


class TestArguments:
    @pytest.mark.parametrize("fps", [0, -25, math.nan, math.inf, None, "25"])
    def test_refuses_a_frame_rate(self, fps):
        with pytest.raises(InvalidInputError, match=r"fps must be a number.*; pass the video's frame rate"):
            Tracker(fps=fps)

    def test_refuses_other_params_and_cameras(self):
        with pytest.raises(
            InvalidInputError, match=r"params must be a TrackParams, got .*pass TrackParams\(\)"
        ):
            Tracker({"gate": 1})
        with pytest.raises(InvalidInputError, match=r"camera must be a Camera, got 3 \(int\)"):
            Tracker(camera=3)

    def test_refuses_malformed_frames_and_keeps_its_state(self):
        tracker = Tracker()
        for _ in range(10):
            tracker.update(found(CAR), SHAPE)
        with pytest.raises(
            InvalidInputError, match=r"detections must be a Detections, got .*pass Detections"
        ):
            tracker.update([CAR], SHAPE)
        with pytest.raises(InvalidInputError, match=r"shape must be \(height, width, ...\)"):
            tracker.update(found(CAR), 720)
        with pytest.raises(InvalidInputError, match="time must be a number"):
            tracker.update(found(CAR), SHAPE, time=math.nan)
        (track,) = tracker.update(found(CAR), SHAPE)
        assert (track.id, track.misses) == (1, 0)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"smoother": "mean"}, "smoother must be one of 'kalman', 'history', 'nearest'"),
            ({"memory": 0}, "memory must be a number, greater than 0"),
            ({"confirm_hits": 0}, "confirm_hits must be an integer from 1"),
            ({"confirm_seconds": -1}, "confirm_seconds must be a number, at least 0"),
            ({"max_coast": 0.1}, "show_coast must be at most max_coast.*change both"),
            ({"gate": math.nan}, "gate must be a number, greater than 0"),
            ({"max_overlap": 1.5}, "max_overlap must be a number, at least 0 and at most 1"),
            ({"box_noise": 0}, "box_noise must be a number, greater than 0"),
            ({"nearest_weight": 0}, "nearest_weight must be a number, greater than 0"),
            ({"high_threshold": "low"}, "high_threshold must be a number"),
        ],
    )
    def test_params_refuse(self, arguments, message):
        with pytest.raises(InvalidInputError, match=message):
            TrackParams(**arguments)

    def test_boxes_outside_the_frame_are_left_out(self):
        outside = found([1300.0, 400, 1400, 500], [-90.0, 10, -5, 60], [100.0, 100, 100, 200])
        assert Tracker().update(outside, SHAPE) == ()

    def test_results_cannot_be_changed(self):
        (track,) = Tracker().update(found(CAR), SHAPE)
        with pytest.raises(ValueError, match="read-only"):
            track.box[0] = 1
        with pytest.raises(AttributeError):
            track.id = 7

    def test_integer_boxes_are_taken(self):
        tracker = Tracker()
        for _ in range(5):
            tracks = tracker.update(Detections(np.array([[600, 400, 700, 490]]), np.array([1.0])), SHAPE)
        assert tracks[0].box.dtype == np.float64


def hand_over(truth, shape, *, seed, misses=0.1, clutter=0.3):
    """Detections of a drawn drive as a good detector would make them, without drawing it.

    Edges are off by 3 pixels of a frame of 1280, one box in ten is missing, false ones come at random places.
    """
    rng = np.random.default_rng(seed)
    height, width = shape
    pixel = width / 1280
    limits = np.array([width, height, width, height], float)
    for rows in truth:
        boxes, scores = [], []
        for row in rows:
            box = np.array(row.box, float)
            if (
                box[2] - box[0] < 32 * pixel
                or row.occluded_fraction > 0.5
                or row.truncated > 0.65
                or rng.random() < misses
            ):
                continue
            box += rng.normal(0, 3 * pixel, 4) * (box != limits) * (box != 0)
            boxes.append(np.clip(box, 0, limits))
            scores.append(max(rng.normal(3, 1), 0.05))
        for _ in range(rng.poisson(clutter)):
            side = rng.uniform(32, 150) * pixel
            x, y = rng.uniform(0, width - side), rng.uniform(0.45, 0.7) * height
            boxes.append(np.array([x, y, x + side, y + 0.8 * side]))
            scores.append(rng.uniform(0, 2))
        yield Detections(np.array(boxes).reshape(-1, 4), np.array(scores))


def labels_of(frames):
    """Labels from ``(track, box, ignore)`` of each frame."""
    rows = [(index, *row) for index, frame in enumerate(frames) for row in frame]
    return FrameBoxes(
        [row[0] for row in rows],
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows], float).reshape(-1, 4),
        ignore=np.array([row[3] for row in rows], bool),
    )


DRIVES = [
    ("highway", (360, 640), 125),
    ("highway", (540, 960), 60),
    ("overtaking", (720, 1280), 200),
    ("crossing", (360, 640), 200),
    ("occlusion", (360, 640), 200),
]


@pytest.mark.parametrize(("scenario", "shape", "frames"), DRIVES)
def test_the_tracker_does_its_part_of_the_drawn_drives(scenario, shape, frames):
    """With boxes that are nearly right, what is left of the benchmark's errors is the tracker's own."""
    drive = render_drive(frames=frames, scenario=scenario, shape=shape, random_state=21)
    camera = Camera.for_frame(shape, horizon=0.5, horizon_std_px=0.06 * shape[0])
    tracker = Tracker(fps=drive.fps, camera=camera)
    shown = [
        [track for track in tracker.update(boxes, shape) if track.shown]
        for boxes in hand_over(drive.truth, shape, seed=1)
    ]
    scores = evaluate_tracks(
        labels_of([[(track.id, track.box, False) for track in tracks] for tracks in shown]),
        labels_of([[(row.track, row.box, bool(row.ignore)) for row in rows] for rows in drive.truth]),
        frames=range(frames),
    )
    assert scores.mota >= 0.95
    assert scores.idf1 >= 0.95
    assert scores.id_switches == 0
    distances, speeds = [], []
    for tracks, rows in zip(shown, drive.truth, strict=True):
        near = [row for row in rows if not row.ignore and 10 <= row.distance_m <= 60]
        for track in tracks:
            overlaps = [iou_matrix([track.box], [row.box])[0, 0] for row in near]
            if max(overlaps, default=0) < 0.5 or track.distance_m is None:
                continue
            row = near[int(np.argmax(overlaps))]
            distances.append(abs(track.distance_m - row.distance_m) / row.distance_m)
            if track.speed_mps is not None:
                speeds.append(abs(track.speed_mps - row.speed_mps))
    assert len(speeds) > 100
    assert np.median(distances) <= 0.15
    assert np.median(speeds) <= 1.5
    assert tracker.camera.horizon_px == pytest.approx(0.56 * shape[0], abs=0.02 * shape[0])


edge = st.floats(-200, 1500, width=32)
box_strategy = st.tuples(edge, edge, st.floats(0, 900, width=32), st.floats(0, 700, width=32)).map(
    lambda b: [b[0], b[1], b[0] + b[2], b[1] + b[3]]
)
frame_strategy = st.tuples(
    st.lists(st.tuples(box_strategy, st.floats(-1, 4)), max_size=5),
    st.sampled_from([0.0, 1e-9, 0.001, 0.02, 0.04, 0.1, 0.5, 0.9, 3.0, -1.0]),
    st.integers(1, 4),
)


@settings(max_examples=60)
@given(st.lists(frame_strategy, min_size=1, max_size=25), st.sampled_from(["kalman", "history", "nearest"]))
def test_whatever_comes_tracks_are_sound(frames, smoother):
    params = TrackParams(smoother=smoother, confirm_hits=1, confirm_seconds=0.0, confirm_score=-1.0)
    tracker, time, known = Tracker(params), 0.0, 0
    for rows, step, repeats in frames:
        detections = Detections([box for box, _ in rows], [score for _, score in rows])
        for _ in range(repeats):
            time += step
            tracks = tracker.update(detections, SHAPE, time=time)
            believed = [track.id for track in tracks if track.id]
            assert len(set(believed)) == len(believed)
            assert believed == sorted(believed)
            assert max(believed, default=0) <= known + len(detections)
            known = max([known, *believed])
            for track in tracks:
                assert_sound(track)
            filters = tracker._filters
            for cov in (filters.cov, filters.range_cov):
                assert np.isfinite(cov).all()
                if len(cov):
                    assert np.linalg.eigvalsh(cov).min() > -1e-3


def assert_sound(track: Track) -> None:
    x1, y1, x2, y2 = track.box
    assert 0 <= x1 < x2 <= 1280
    assert 0 <= y1 < y2 <= 720
    assert np.isfinite([track.score, track.age, track.time_since_update, *track.velocity]).all()
    assert (track.state == "tentative") == (track.id == 0)
    assert (track.state == "confirmed") == (track.id > 0 and track.misses == 0)
    assert not (track.shown and track.id == 0)
    assert (track.distance_m is None) == (track.distance_std_m is None)
    assert (track.speed_mps is None) == (track.speed_std_mps is None)
    for error in (track.distance_std_m, track.speed_std_mps):
        assert error is None or (math.isfinite(error) and error >= 0)
    assert track.distance_m is None or track.distance_m > 0
