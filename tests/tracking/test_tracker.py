import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.evaluation.cases import boxes_of
from vehicle_detection import Camera, InvalidInputError, evaluate_tracks, render_drive
from vehicle_detection.boxes import Detections, Platt, iou_matrix
from vehicle_detection.tracking import Track, Tracker, TrackParams

SHAPE = (720, 1280, 3)
LIMITS = np.array([1280.0, 720.0, 1280.0, 720.0])
CAMERA = Camera.for_frame(SHAPE)
CAR = [600.0, 400.0, 700.0, 490.0]


def found(*boxes, score=1.0):
    return Detections(np.array(boxes, float).reshape(-1, 4), np.full(len(boxes), float(score)))


def after(frames, *boxes, score=1.0, **options):
    """A tracker after this number of frames with these boxes, by default a car."""
    tracker = Tracker(**options)
    for _ in range(frames):
        tracker.update(found(*boxes or (CAR,), score=score), SHAPE)
    return tracker


def on_road(distance, *, x=0.0, width=1.8, height=1.5, length=0.0):
    """Box of a vehicle `distance` meters ahead and `x` meters to the right; None behind the camera.

    With a length, the box shows the side of a vehicle in another lane.
    """
    if distance < 1:
        return None
    pixel, far = CAMERA.focal_px / distance, CAMERA.focal_px / (distance + length)
    bottom, left, right = CAMERA.horizon_px + pixel * CAMERA.height_m, x - width / 2, x + width / 2
    left, right = left * (far if left > 0 else pixel), right * (far if right < 0 else pixel)
    return np.array([640 + left, bottom - pixel * height, 640 + right, bottom])


def play(scene, seconds, *, fps=25.0, noise=0.05, seed=0, undetected=None, extra=None, **options):
    """Track a scene: `scene` maps names to boxes as functions of time; `undetected` suppresses detections.

    Detections are the visible parts, with noise on each edge inside the frame; vehicles of which less than a
    third is visible are not detected. Returns time, visible boxes by name, and tracks of each frame.
    """
    rng = np.random.default_rng(seed)
    tracker, steps = Tracker(fps=fps, **options), []
    for index in range(round(seconds * fps)):
        time, truth, boxes = index / fps, {}, []
        for name, where in scene.items():
            box = where(time)
            if box is None:
                continue
            inside = np.clip(box, 0, LIMITS)
            visible = np.prod(inside[2:] - inside[:2]) / np.prod(box[2:] - box[:2])
            if visible <= 0:
                continue
            truth[name] = inside
            if visible < 1 / 3 or (undetected and undetected(name, time)):
                continue
            size = np.tile(inside[2:] - inside[:2], 2)
            noisy = inside + rng.normal(0, noise, 4) * size * (inside == box)
            boxes.append(np.clip(noisy, 0, LIMITS))
        boxes += extra(time) if extra else []
        steps.append((time, truth, tracker.update(found(*boxes), SHAPE)))
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
    """Mean change of the edge errors from frame to frame in pixels."""
    errors = [
        next(t.box for t in tracks if t.shown) - truth[name]
        for _, truth, tracks in steps
        if name in truth and any(t.shown for t in tracks)
    ]
    return float(np.abs(np.diff(errors, axis=0)).mean())


class TestSmoothing:
    def test_a_vehicle_at_constant_speed_is_tracked_without_lag(self):
        steps = play({"car": lambda t: np.array(CAR) + np.array([120.0, 0, 120.0, 0]) * t}, 4, noise=0.0)
        last = steps[-1]
        np.testing.assert_allclose(last[2][0].box, last[1]["car"], atol=0.5)
        assert last[2][0].velocity == pytest.approx((120, 0), abs=3)

    @pytest.mark.parametrize("seed", range(4))
    def test_boxes_are_smooth(self, seed):
        """Detections change by 5.5 px per frame; the target for tracks is at most 1.5."""
        steps = play({"car": lambda t: on_road(20 + t, x=2.0)}, 8, seed=seed)
        assert jitter(steps, "car") < 1.5
        overlaps = [overlap for time, overlap, _ in matched(steps, "car") if time > 0.5]
        assert np.mean(overlaps) > 0.9

    def test_one_wrong_box_hardly_moves_the_track(self):
        (track,) = after(30).update(found([560.0, 340.0, 760.0, 520.0]), SHAPE)
        assert np.abs(track.box - CAR).max() < 12

    def test_a_lane_change_after_a_long_straight_is_tracked(self):
        steps = play({"car": lambda t: on_road(15, x=3.6 / (1 + np.exp(-4 * (t - 6))))}, 9, noise=0.02)
        errors = [
            np.abs(tracks[0].box - truth["car"])[[0, 2]].max() for t, truth, tracks in steps if 5 < t < 7
        ]
        assert max(errors) < 25

    @pytest.mark.parametrize("fps", [10.0, 25.0, 60.0])
    def test_a_wrong_track_adapts_within_a_second(self, fps):
        tracker, larger = after(int(2 * fps), fps=fps), [570.0, 380.0, 720.0, 520.0]
        for _ in range(int(0.7 * fps)):
            (track,) = tracker.update(found(larger), SHAPE)
        assert iou_matrix([larger], [track.box])[0, 0] > 0.85

    def test_a_box_that_alternates_between_two_sizes_keeps_the_track_smooth(self):
        tracker, boxes = Tracker(), []
        for index in range(100):
            part = [600.0, 400.0, 700.0, 450.0]
            tracks = tracker.update(found(part if index % 3 == 2 else CAR), SHAPE)
            boxes += [track.box for track in tracks if track.shown and index > 20]
        assert np.abs(np.diff(boxes, axis=0)).max() < 6

    @pytest.mark.parametrize("speed", [8.0, 18.0, 25.0])
    def test_oncoming_vehicles_are_tracked_as_they_grow(self, speed):
        steps = play({"car": lambda t: on_road(60 - speed * t, x=-3.0)}, 48 / speed)
        assert ids(steps, "car") == {1}
        overlaps = [overlap for time, overlap, _ in matched(steps, "car") if time > 0.5]
        assert np.mean(overlaps) > 0.75


class TestLifeCycle:
    @pytest.mark.parametrize("frames", [1, 2, 3])
    def test_false_positives_of_up_to_three_frames_are_never_shown(self, frames):
        tracker, shown = Tracker(), []
        for index in range(60):
            noise = found(CAR, score=5.0) if 0 < index % 12 <= frames else Detections.empty()
            shown += [track for track in tracker.update(noise, SHAPE) if track.shown]
        assert not shown

    def test_a_strong_detection_at_the_start_is_shown_at_once(self):
        tracker = Tracker()
        for ids_so_far in ([1], [2]):
            tracks = tracker.update(found(CAR, score=1.5), SHAPE)
            assert [track.id for track in tracks if track.shown] == ids_so_far
            assert not any(track.shown for track in tracker.update(Detections.empty(), SHAPE))
            tracker.end_tracks()
        (track,) = tracker.update(found(CAR, score=1.0), SHAPE)
        assert not track.shown

    def test_a_lower_score_delays_confirmation_and_a_very_low_one_prevents_it(self):
        first = {}
        for score in (1.5, 0.3, 0.15):
            tracker = Tracker()
            tracker.update(Detections.empty(), SHAPE)
            shown = [any(t.shown for t in tracker.update(found(CAR, score=score), SHAPE)) for _ in range(100)]
            first[score] = shown.index(True) if any(shown) else None
        assert first[1.5] < first[0.3] < 12
        assert first[0.15] is None

    def test_scores_below_the_high_threshold_continue_tracks_but_start_none(self):
        tracker = Tracker(TrackParams(high_threshold=0.5))
        assert tracker.update(found(CAR, score=0.4), SHAPE) == ()
        for _ in range(10):
            tracker.update(found(CAR, score=1.0), SHAPE)
        (track,) = tracker.update(found(CAR, score=0.4), SHAPE)
        assert (track.state, track.misses) == ("confirmed", 0)

    @pytest.mark.parametrize(("score", "misses"), [(-0.4, 0), (-1.4, 0), (-1.6, 5)])
    def test_a_confirmed_track_is_continued_by_low_score_detections(self, score, misses):
        tracker = after(10, score=3.0)
        for _ in range(5):
            (track,) = tracker.update(found(CAR, score=score), SHAPE)
        assert track.misses == misses

    def test_a_low_score_detection_does_not_replace_a_high_score_one(self):
        moved = [612.0, 400.0, 712.0, 490.0]
        (track,) = after(10, score=3.0).update(Detections([CAR, moved], [-0.6, 3.0]), SHAPE)
        assert track.score > 2
        assert track.box[0] > CAR[0] + 2

    def test_the_maximum_distance_is_smaller_for_low_score_detections(self):
        width = CAR[2] - CAR[0]
        for shift, high, low in ((0.2, 0, 0), (0.5, 0, 1)):
            beside = np.array(CAR) + np.array([shift * width, 0, shift * width, 0])
            for score, misses in ((3.0, high), (-1.0, low)):
                tracks = after(10, score=3.0).update(found(beside, score=score), SHAPE)
                assert tracks[0].misses == misses

    def test_a_low_score_detection_of_another_size_does_not_change_the_box(self):
        """Such as one around a car and the lamp post above it."""
        height = CAR[3] - CAR[1]
        for above, misses in ((0.5, 0), (1.4, 9)):
            tracker = after(10, score=3.0)
            for _ in range(8):
                tracker.update(found(), SHAPE)
            taller = np.array(CAR) - np.array([0, above * height, 0, 0])
            (track,) = tracker.update(found(taller, score=-1.0), SHAPE)
            assert track.misses == misses
            if misses:
                np.testing.assert_allclose(track.box, CAR, atol=2)

    def test_taller_low_score_detections_do_not_make_the_box_grow(self):
        """Several of them, and no detection after them: the box would go on growing."""
        tracker, taller = Tracker(), np.array(CAR) - np.array([0, 0.8 * (CAR[3] - CAR[1]), 0, 0])
        for detections in [found(CAR, score=3.0)] * 10 + [found(taller, score=-0.8)] * 3 + [found()] * 12:
            (track,) = tracker.update(detections, SHAPE)
        np.testing.assert_allclose(track.box, CAR, atol=3)

    def test_a_vehicle_that_stops_growing_is_not_overshot(self):
        """A vehicle that enters from the left, fast at first: its box must not move beyond it later."""
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

    @pytest.mark.parametrize(("detected", "expected"), [(50, 7), (5, 1)])  # 0.3 s at 25 fps
    def test_a_vehicle_without_detections_is_shown_briefly_and_ends_later(self, detected, expected):
        tracker = after(detected)
        frames = [tracker.update(Detections.empty(), SHAPE) for _ in range(40)]
        assert sum(any(t.shown for t in tracks) for tracks in frames) == expected
        assert sum(bool(tracks) for tracks in frames) == 25  # 1 s

    @pytest.mark.parametrize(
        ("params", "fps", "frames"),
        [
            ({"confirm_hits": 6}, 25, 6),
            ({"confirm_seconds": 0.4}, 25, 11),
            ({}, 10, 3),  # two hits take 0.1 s
            ({}, 60, 9),  # three hits take 0.03 s
        ],
    )
    def test_confirmation_requires_hits_and_time_at_any_frame_rate(self, params, fps, frames):
        tracker = Tracker(TrackParams(**params), fps=fps)
        tracker.update(Detections.empty(), SHAPE)
        shown = [any(t.shown for t in tracker.update(found(CAR, score=9.0), SHAPE)) for _ in range(20)]
        assert shown.index(True) + 1 == frames

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
        """The velocity decays: without the decay the box would move by 72 px."""
        tracker = Tracker()
        for index in range(50):
            (last,) = tracker.update(found(np.add(CAR, [3 * index, 0, 3 * index, 0])), SHAPE)
        for _ in range(24):
            (track,) = tracker.update(Detections.empty(), SHAPE)
        assert 40 < track.box[0] - last.box[0] < 62

    @pytest.mark.parametrize(
        ("others", "start"),
        [
            ([[620.0, 410.0, 670.0, 460.0], [600.0, 400.0, 660.0, 490.0]], 0),
            # IoU 0.48, and neither covers 0.7 of the other.
            ([[635.0, 400.0, 735.0, 490.0]], 10),
        ],
    )
    def test_several_boxes_on_one_vehicle_make_one_track(self, others, start):
        tracker, shown = Tracker(), set()
        for index in range(50):
            tracks = tracker.update(found(CAR, *others * (index >= start)), SHAPE)
            shown |= {track.id for track in tracks if track.shown}
        assert shown == {1}

    def test_ids_are_consecutive_despite_false_positives(self):
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

    def test_several_tentative_tracks_are_continued_beside_a_confirmed_one(self):
        tracker, others = after(10), [[100.0, 400, 180, 470], [900.0, 400, 980, 470]]
        tracker.update(found(CAR, *others), SHAPE)
        car, *tentative = tracker.update(found(CAR, *others), SHAPE)
        assert (car.id, car.misses, car.key) == (1, 0, 1)
        np.testing.assert_allclose(car.box, CAR, atol=1)
        assert [(track.state, track.misses) for track in tentative] == [("tentative", 0)] * 2
        assert [track.age for track in tentative] == pytest.approx([0.04] * 2)
        np.testing.assert_allclose([track.box for track in tentative], others, atol=1)

    def test_the_score_is_an_average_that_begins_at_zero(self):
        tracker, weight = Tracker(fps=10), 1 - math.exp(-0.1 / TrackParams().score_time_constant)
        (track,) = tracker.update(found(CAR, score=0.8), SHAPE)
        assert track.score == pytest.approx(0.8 * weight)
        (track,) = tracker.update(found(CAR, score=0.4), SHAPE)
        assert track.score == pytest.approx(0.8 * weight * (1 - weight) + 0.4 * weight)

    def test_the_confidence_is_the_probability_of_the_mean_score_as_log_odds(self):
        tracker, decay = Tracker(fps=10), math.exp(-0.1 / TrackParams().score_time_constant)
        (track,) = tracker.update(found(CAR, score=3.0), SHAPE)
        assert track.confidence == pytest.approx(1 / (1 + math.exp(-3.0)))
        (track,) = tracker.update(found(), SHAPE)
        assert track.confidence == pytest.approx(1 / (1 + math.exp(-3.0)))
        (track,) = tracker.update(found(CAR, score=1.0), SHAPE)
        mean = (3.0 * decay**2 + 1.0) / (decay**2 + 1)
        assert track.confidence == pytest.approx(1 / (1 + math.exp(-mean)))
        (track,) = Tracker(calibration=None).update(found(CAR), SHAPE)
        assert track.confidence is None

    @given(time_constant=st.floats(1e-9, 3600), threshold=st.floats(-2, 2))
    def test_a_shifted_threshold_leaves_the_confidence(self, time_constant, threshold):
        """The scores and their calibration shift alike if `conf` chooses another threshold."""
        seen = []
        for shift in (0.0, threshold):
            params = TrackParams(score_time_constant=time_constant)
            tracker = Tracker(params=params, fps=10, calibration=Platt(-1.0, -shift))
            updates = [tracker.update(found(CAR, score=score - shift), SHAPE) for score in (3.0, 2.5, 4.0)]
            seen.append([track.confidence for (track,) in updates])
        np.testing.assert_allclose(*seen)


class TestOcclusion:
    @pytest.mark.parametrize("seed", range(4))
    def test_identity_survives_a_second_behind_another_vehicle(self, seed):
        scene = {"near": lambda t: on_road(12, x=-3 + 1.5 * t), "far": lambda t: on_road(25, x=1 - 0.5 * t)}
        steps = play(scene, 5, seed=seed, undetected=lambda name, t: name == "far" and 1.5 <= t < 2.5)
        assert ids(steps, "near") != ids(steps, "far")
        assert len(ids(steps, "near")) == len(ids(steps, "far")) == 1
        assert shown_ids(steps) == {1, 2}

    def test_a_hidden_vehicle_is_shown_throughout(self):
        scene = {"near": lambda t: on_road(10), "far": lambda t: on_road(20, x=3 - min(t, 4) * 0.8)}
        steps = play(scene, 5, undetected=lambda name, t: name == "far" and 2 <= t < 3)
        assert all(track for time, _, track in matched(steps, "far") if 0.5 < time < 3)

    @pytest.mark.parametrize(
        ("left", "seconds"), [(745.0, 1.0), (690.0, 0.4)], ids=["partly visible", "not visible"]
    )
    def test_a_hidden_vehicle_is_shown_for_a_while_and_kept_for_four_seconds(self, left, seconds):
        tracker, near = Tracker(fps=10), [300.0, 380, 800, 600]
        for x in [*np.linspace(850, left, 20), *[left] * 10]:
            tracks = tracker.update(found(near, [x, 420, x + 90, 465]), SHAPE)
        assert [(track.id, track.misses) for track in tracks] == [(1, 0), (2, 0)]
        steps = [tracker.update(found(near), SHAPE) for _ in range(52)]
        assert sum(sum(t.shown for t in tracks) == 2 for tracks in steps) == 10 * seconds
        assert sum(len(tracks) == 2 for tracks in steps) == 40

    @pytest.mark.parametrize("seed", range(4))
    def test_crossing_vehicles_keep_their_identity(self, seed):
        def is_hidden(name, t):
            return name == "far" and abs((-4 + 3 * t) / 12 - (2 - 1.5 * t) / 22) * CAMERA.focal_px < 70

        scene = {"near": lambda t: on_road(12, x=-4 + 3 * t), "far": lambda t: on_road(22, x=2 - 1.5 * t)}
        steps = play(scene, 2.6, seed=seed, undetected=is_hidden)
        assert len(ids(steps, "near")) == len(ids(steps, "far")) == 1
        assert shown_ids(steps) == {1, 2}

    @pytest.mark.parametrize("seed", range(4))
    def test_two_vehicles_in_one_merged_box_stay_two(self, seed):
        scene = {"left": lambda _: on_road(15, x=-1.2), "right": lambda t: on_road(16, x=1 - 0.2 * min(t, 3))}

        def region(t):
            one, two = (vehicle(t) for vehicle in scene.values())
            together = np.array([*np.minimum(one[:2], two[:2]), *np.maximum(one[2:], two[2:])])
            return [together] if 1.5 <= t < 3 else []

        steps = play(scene, 5, seed=seed, undetected=lambda name, t: 1.5 <= t < 3, extra=region)
        for name in scene:
            assert len(ids(steps, name)) == 1
            assert all(overlap > 0.6 for time, overlap, _ in matched(steps, name) if time > 0.3)
        assert shown_ids(steps) == {1, 2}

    def test_a_track_of_the_side_of_a_vehicle_ends(self):
        """A detector that shows a near vehicle's side as a second vehicle does so in few frames."""
        tracker, rear, side = Tracker(), [500.0, 400, 680, 520], [620.0, 405, 720, 515]
        seen = []
        for index in range(40):
            boxes, scores = [rear], [5.0]
            if index % 4 < 2 and index < 30:
                boxes, scores = [rear, side], [5.0, 1.5]
            tracks = tracker.update(Detections(np.array(boxes), np.array(scores)), SHAPE)
            seen.append([track.id for track in tracks if track.shown])
        assert seen[-1] == [1]
        assert sum(len(ids) > 1 for ids in seen) < 8

    def test_vehicles_of_one_distance_that_touch_stay_two(self):
        tracker = Tracker()
        for _ in range(40):
            boxes = np.array([[500.0, 400, 620, 520], [590.0, 405, 700, 515]])
            tracks = tracker.update(Detections(boxes, np.array([6.0, 1.0])), SHAPE)
        assert [track.id for track in tracks if track.shown] == [1, 2]

    def test_a_hidden_vehicle_that_must_have_moved_far_is_not_shown(self):
        """Its position is only a guess."""
        tracker, near = Tracker(), [300.0, 380, 800, 600]
        for index in range(40):
            far = [900.0 - 8 * index, 420, 960 - 8 * index, 465]
            tracker.update(found(near, far), SHAPE)
        shown = [sum(t.shown for t in tracker.update(found(near), SHAPE)) for _ in range(30)]
        # At 200 px per second, a box of 60 px moves by half of its width in 0.15 s.
        assert shown[:3] == [2, 2, 2]
        assert set(shown[4:]) == {1}

    def test_a_briefly_detected_vehicle_is_shown_only_briefly_behind_another(self):
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
        # The outer edge stays at the border while the vehicle enters.
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
        steps = play(scene, 5.5, fps=fps, undetected=lambda name, t: name == "far" and 1.5 <= t < 2.5)
        assert shown_ids(steps) == {1, 2}
        for name in scene:
            assert len(ids(steps, name)) == 1
            first = next(time for time, _, track in matched(steps, name) if track)
            assert 0.1 <= first <= 0.31
            overlaps = [overlap for time, overlap, track in matched(steps, name) if time > 0.5 and track]
            assert np.mean(overlaps) > 0.88
        far = ids(steps, "far").pop()
        hidden = max(time for time, _, tracks in steps for t in tracks if t.id == far and t.shown)
        ended = max(time for time, _, tracks in steps for t in tracks if t.id == far)
        assert hidden - 4 == pytest.approx(0.3, abs=0.11)
        assert ended - 4 == pytest.approx(1.0, abs=0.11)

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

    def test_duplicated_frames_do_not_disturb_the_tracks(self):
        """Film at 24 fps in a video of 30 fps: every fifth frame is a duplicate."""
        tracker, seen = Tracker(fps=30), []
        for index in range(90):
            film_frame = index - index // 5
            seen.append(tracker.update(found(on_road(20 + 0.1 * film_frame)), SHAPE)[0])
        assert {track.id for track in seen[10:]} == {1}
        assert all(track.shown for track in seen[10:])
        assert np.abs(np.diff([track.box for track in seen[20:]], axis=0)).mean() < 1.0

    def test_a_scene_cut_resets_tracks_and_horizon(self):
        tracker = Tracker()
        for index in range(50):
            tracker.update(found(on_road(15 + 0.1 * index), on_road(40, x=3.6)), SHAPE)
        estimated_std = tracker.camera.horizon_std_px
        tracker.end_tracks()
        assert tracker.update(Detections.empty(), SHAPE) == ()
        assert tracker.camera.horizon_std_px > 2 * estimated_std

    @pytest.mark.parametrize("times", [[0.0, 0.04, 0.0], [0.0, 0.04, 2.0]], ids=["back", "gap"])
    def test_a_jump_in_time_ends_all_tracks_and_ids_continue(self, times):
        tracker = Tracker(TrackParams(confirm_hits=1, confirm_seconds=0.0, confirm_score=0.1))
        seen = [[t.id for t in tracker.update(found(CAR, score=2.0), SHAPE, time=time)] for time in times]
        assert seen == [[1], [1], [2]]

    def test_another_frame_size_ends_all_tracks(self):
        (track,) = after(10).update(found(CAR), (1080, 1920, 3))
        assert (track.id, track.age) == (0, 0.0)

    def test_reset_restores_the_initial_state(self):
        tracker = Tracker()
        runs = []
        for _ in range(2):
            runs.append([tracker.update(found(CAR), SHAPE, time=index / 25) for index in range(10)])
            tracker.reset()
        assert [t.id for t in runs[0][-1]] == [t.id for t in runs[1][-1]] == [1]
        np.testing.assert_array_equal(runs[0][-1][0].box, runs[1][-1][0].box)

    def test_a_slow_frame_rate_is_no_gap(self):
        assert [track.id for track in after(5, fps=0.8).update(found(CAR), SHAPE)] == [1]


class TestDistance:
    @pytest.mark.parametrize(("start", "speed"), [(12.0, 0.0), (10.0, 5.0), (40.0, -6.0), (25.0, 2.0)])
    def test_distance_and_speed_lie_within_their_errors(self, start, speed):
        distances, speeds, trials = [], [], 8
        for seed in range(trials):
            steps = play({"car": lambda t: on_road(start + speed * t, x=1.0)}, 3, seed=seed, noise=0.04)
            time, _, tracks = steps[-1]
            (track,) = tracks
            truth = start + speed * time
            distances.append(abs(track.distance_m - truth) / track.distance_std_m)
            speeds.append(abs(track.speed_mps - speed) / track.speed_std_mps)
            assert track.distance_std_m < 0.35 * truth
            assert track.speed_std_mps < 3
        # Camera and vehicle are the assumed ones, so only the noise of the boxes contributes.
        assert np.mean(np.array(distances) < 2) > 0.9
        assert np.mean(np.array(speeds) < 2) > 0.9

    @pytest.mark.parametrize("lens", ["fisheye-120", "fisheye-170"])
    def test_distances_through_a_fisheye_lens(self, lens):
        camera = Camera.for_frame(SHAPE, lens=lens, horizon=0.5)

        def through_lens(x, y):
            dx, dy = x - 640, y - 360
            radius = math.hypot(dx, dy)
            factor = camera.focal_px * math.atan(radius / camera.focal_px) / radius
            return 640 + factor * dx, 360 + factor * dy

        pixel = camera.focal_px / 18.0
        left, right = 640 + pixel * 2.7, 640 + pixel * 4.5
        bottom, top = 360 + pixel * 1.3, 360 - pixel * 0.2
        middle_x, middle_y = (left + right) / 2, (top + bottom) / 2
        box = (through_lens(left, middle_y)[0], through_lens(middle_x, top)[1])
        box += (through_lens(right, middle_y)[0], through_lens(middle_x, bottom)[1])
        for known, error in ((camera, 0.12), (dataclasses.replace(camera, fisheye=False), 0.02)):
            tracker = Tracker(fps=25, camera=known)
            for _ in range(20):
                (track,) = tracker.update(Detections([box], [1.0]), SHAPE)
            if known is camera:
                assert track.distance_m == pytest.approx(18.0, rel=error)
                nearer = track.distance_m
        assert track.distance_m > nearer  # the lens makes vehicles at the side smaller

    def test_the_distance_of_a_truck_is_corrected_over_time(self):
        scene = {"truck": lambda t: on_road(20.0, width=2.5, height=3.5)}
        *_, (_, _, (track,)) = play(scene, 6, noise=0.03, camera=CAMERA)
        by_width_alone = 20 * 1.8 / 2.5
        assert abs(track.distance_m - 20) < abs(by_width_alone - 20) / 2

    @pytest.mark.parametrize("lens", ["standard-58", "fisheye-120"])
    def test_the_camera_is_scaled_to_the_frames(self, lens):
        camera = Camera.for_frame(SHAPE, lens=lens)
        distances = []
        for scale in (1, 2):
            shape = SHAPE[0] // scale, SHAPE[1] // scale
            tracker = Tracker(camera=camera)
            for _ in range(20):
                (track,) = tracker.update(found([edge / scale for edge in CAR]), shape)
            distances.append(track.distance_m)
        assert distances[0] == pytest.approx(distances[1], rel=0.03)
        with pytest.raises(InvalidInputError, match="frames of 640x480 pixels"):
            tracker.update(found(CAR), (480, 640))
        Tracker(camera=dataclasses.replace(camera, shape=None)).update(found(CAR), (480, 640))

    def test_distance_is_unknown_where_nothing_can_be_measured(self):
        box = [900.0, 420, 1280, 720]
        (track,) = after(19, box, camera=CAMERA).update(found(box), SHAPE)
        assert track.distance_m is track.distance_std_m is track.speed_mps is track.speed_std_mps is None

    def test_a_box_above_the_horizon_is_measured_by_its_width(self):
        box = [600.0, 250, 700, 340]
        (track,) = after(29, box, camera=CAMERA).update(found(box), SHAPE)
        assert track.distance_m is None or track.distance_m > 15

    def test_distance_is_unknown_after_coasting_long(self):
        tracker = after(30)
        frames = [tracker.update(Detections.empty(), SHAPE)[0] for _ in range(20)]
        assert frames[0].distance_m is not None
        assert frames[-1].distance_m is None

    @pytest.mark.parametrize("seed", range(3))
    def test_the_horizon_of_an_unknown_camera_is_estimated(self, seed):
        """The initial guess is wrong by 43 px, which changes a distance of 30 m to 50 m or 22 m."""
        scene = {"near": lambda t: on_road(14 + 2 * t), "far": lambda t: on_road(45 - 3 * t, x=3.6, length=4)}
        wrong = Camera.for_frame(SHAPE, horizon=0.5, horizon_std_px=43.0)
        steps = play(scene, 6, seed=seed, noise=0.04, camera=wrong)
        for name, distance in (("near", 26.0), ("far", 27.0)):
            _, _, track = matched(steps, name)[-1]
            assert track.distance_m == pytest.approx(distance, rel=0.15)
            assert abs(track.distance_m - distance) < 2.5 * track.distance_std_m

    def test_only_confirmed_tracks_change_the_horizon(self):
        tracker = Tracker()
        tracker.update(Detections.empty(), SHAPE)
        before = tracker.camera
        for _ in range(3):
            assert tracker.camera is before
            (track,) = tracker.update(found(CAR), SHAPE)
        while not track.id:
            assert tracker.camera is before
            (track,) = tracker.update(found(CAR), SHAPE)
        assert tracker.camera.horizon_std_px < before.horizon_std_px


class TestPrediction:
    def drive(self, tracker, frames, *, speed=150.0, start=300.0):
        """Track a vehicle that moves right by `speed` pixels per second; returns its box at a time."""

        def truth(time):
            left = start + speed * time
            return np.array([left, 400.0, left + 100, 490.0])

        for index in range(frames):
            tracker.update(found(truth(index / 25)), SHAPE)
        return truth

    @pytest.mark.parametrize("ahead", [1 / 25, 0.2, 1.0])
    def test_a_vehicle_at_constant_velocity_is_predicted(self, ahead):
        tracker = Tracker()
        truth = self.drive(tracker, 75)
        now = 74 / 25
        (track,) = tracker.predict(time=now + ahead)
        np.testing.assert_allclose(track.box, truth(now + ahead), atol=1 + ahead)
        np.testing.assert_allclose(track.velocity, (150, 0), atol=2)
        if ahead == 1 / 25:
            np.testing.assert_allclose(tracker.predict()[0].box, track.box, atol=1e-9)

    def test_the_distance_is_predicted(self):
        tracker = Tracker(camera=CAMERA)
        for index in range(75):
            (last,) = tracker.update(found(on_road(15 + 5 * index / 25)), SHAPE)
        (track,) = tracker.predict(time=74 / 25 + 0.4)
        assert track.distance_m == pytest.approx(last.distance_m + 0.4 * last.speed_mps)
        assert track.distance_m == pytest.approx(15 + 5 * (74 / 25 + 0.4), rel=0.1)
        assert track.distance_std_m > last.distance_std_m
        assert tracker.predict(time=74 / 25 + 0.6)[0].distance_m is None  # as after coasting long

    def test_prediction_changes_nothing(self):
        one, other = Tracker(), Tracker()
        rng = np.random.default_rng(3)
        for index in range(60):
            boxes = [np.array(CAR) + 2 * index, np.array([300.0, 410, 380, 480]) - index]
            detections = found(*(box + rng.normal(0, 2, 4) for box in boxes if rng.random() < 0.8))
            first, second = one.update(detections, SHAPE), other.update(detections, SHAPE)
            for predicted in (other.predict(), other.predict(time=index / 25 + 0.7)):
                assert [track.key for track in predicted] == [track.key for track in second]
                for track in predicted:
                    assert_valid(track)
            assert_equal(first, second)

    def test_a_prediction_is_what_the_next_frame_without_detection_returns(self):
        tracker = Tracker()
        self.drive(tracker, 50)
        (predicted,), (track,) = tracker.predict(), tracker.update(Detections.empty(), SHAPE)
        np.testing.assert_allclose(predicted.box, track.box)
        for name in ("id", "state", "misses"):
            assert getattr(predicted, name) == getattr(track, name), name
        for name in ("age", "time_since_update", "velocity", "distance_m"):
            assert getattr(predicted, name) == pytest.approx(getattr(track, name)), name

    def test_tracks_inside_the_frame_are_predicted(self):
        tracker = Tracker()
        assert tracker.predict() == tracker.predict(time=3.0) == ()
        tracker.update(found(CAR, score=0.1), SHAPE)
        (tentative,) = tracker.predict()  # to blur it
        assert (tentative.id, tentative.state, tentative.shown) == (0, "tentative", False)
        self.drive(tracker, 75)
        assert tracker.predict(time=30.0) == ()  # beyond the right edge of the frame

    def test_the_time_of_the_last_frame_returns_its_tracks(self):
        tracker = Tracker()
        for index in range(20):
            tracks = tracker.update(found(CAR), SHAPE, time=5 + index / 25)
        assert tracker.predict(time=5 + 19 / 25) == tracks
        with pytest.raises(InvalidInputError, match=r"time must be a number, at least 5\.76"):
            tracker.predict(time=5.5)


class TestDeterminism:
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
            assert_equal(first, second)


class TestArguments:
    def test_rejects_malformed_frames_and_keeps_its_state(self):
        tracker = after(10)
        good = {"detections": found(CAR), "shape": SHAPE}
        for name, value in ("detections", [CAR]), ("shape", 720), ("time", math.nan), ("gray", [1, [2, 3]]):
            with pytest.raises(InvalidInputError, match=f"{name} must be"):
                tracker.update(**good | {name: value})
        (track,) = tracker.update(found(CAR), SHAPE)
        assert (track.id, track.misses) == (1, 0)

    def test_boxes_outside_the_frame_are_ignored(self):
        outside = found([1300.0, 400, 1400, 500], [-90.0, 10, -5, 60], [100.0, 100, 100, 200])
        assert Tracker().update(outside, SHAPE) == ()

    def test_integer_boxes_become_floats_and_results_are_immutable(self):
        (track,) = Tracker().update(Detections(np.array([[600, 400, 700, 490]]), [1.0]), SHAPE)
        assert track.box.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            track.box[0] = 1


def test_a_track_keeps_its_key_when_it_is_confirmed():
    tracker = Tracker(fps=25)
    keys = []
    for frame in range(6):
        boxes = [[600, 400, 700, 490]] + ([[100, 400, 200, 490]] if frame == 1 else [])
        keys += [(track.key, track.id) for track in tracker.update(found(*boxes), SHAPE)]
    assert {key for key, number in keys if number} == {1}
    assert (1, 0) in keys
    assert (2, 0) in keys
    tracker.reset()
    assert tracker.update(found([600, 400, 700, 490]), SHAPE)[0].key == 1


def simulated_detections(truth, shape, *, seed, misses=0.1, clutter=0.3):
    """Simulate the detections of a good detector on a drive that is not rendered.

    Edges have an error of 3 pixels at a width of 1280, one box in ten is missing, and false positives have
    random positions.
    """
    rng = np.random.default_rng(seed)
    height, width = shape
    pixel = width / 1280
    limits = np.array([width, height, width, height], float)
    for rows in truth:
        boxes, scores = [], []
        for row in rows:
            box = np.array(row.box, float)
            invisible = row.occluded_fraction > 0.5 or row.truncated > 0.65
            if box[2] - box[0] < 32 * pixel or invisible or rng.random() < misses:
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


@pytest.mark.parametrize("scenario", ["highway", "overtaking", "crossing", "occlusion"])
def test_rendered_drives_are_tracked_from_good_detections(scenario):
    """With nearly correct detections of every second frame, the remaining errors are those of the tracker."""
    shape, frames = (360, 640), 100 if scenario == "highway" else 200
    drive = render_drive(frames=frames, scenario=scenario, shape=shape, random_state=21)
    camera = Camera.for_frame(shape, horizon=0.5, horizon_std_px=0.06 * shape[0])
    tracker = Tracker(fps=drive.fps / 2, camera=camera)
    truth = [drive.truth_of(frame) for frame in range(0, frames, 2)]
    shown = [
        [track for track in tracker.update(boxes, shape) if track.shown]
        for boxes in simulated_detections(truth, shape, seed=1)
    ]
    labels = [(frame, row) for frame, rows in enumerate(truth) for row in rows]
    scores = evaluate_tracks(
        boxes_of(*((frame, track.id, track.box) for frame, tracks in enumerate(shown) for track in tracks)),
        boxes_of(
            *((frame, row.track, row.box) for frame, row in labels),
            ignore=[bool(row.ignore) for _, row in labels],
        ),
        frames=range(len(truth)),
    )
    assert scores.mota >= 0.93
    assert scores.idf1 >= 0.95
    assert scores.id_switches == 0
    distances, speeds = [], []
    for tracks, rows in zip(shown, truth, strict=True):
        near = [row for row in rows if not row.ignore and 10 <= row.distance_m <= 60]
        for track in tracks:
            overlaps = [iou_matrix([track.box], [row.box])[0, 0] for row in near]
            if max(overlaps, default=0) < 0.5 or track.distance_m is None:
                continue
            row = near[int(np.argmax(overlaps))]
            distances.append(abs(track.distance_m - row.distance_m) / row.distance_m)
            if track.speed_mps is not None:
                speeds.append(abs(track.speed_mps - row.speed_mps))
    assert len(speeds) > 30
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


@settings(max_examples=40)
@given(st.lists(frame_strategy, min_size=1, max_size=25))
def test_arbitrary_detections_give_valid_tracks(frames):
    params = TrackParams(confirm_hits=1, confirm_seconds=0.0, confirm_score=-1.0)
    tracker, time, known = Tracker(params), 0.0, 0
    for rows, step, repeats in frames:
        detections = Detections([box for box, _ in rows], [score for _, score in rows])
        for _ in range(repeats):
            time += step
            tracks = tracker.update(detections, SHAPE, time=time)
            confirmed_ids = [track.id for track in tracks if track.id]
            assert len(set(confirmed_ids)) == len(confirmed_ids)
            assert confirmed_ids == sorted(confirmed_ids)
            assert max(confirmed_ids, default=0) <= known + len(detections)
            known = max([known, *confirmed_ids])
            for track in tracks:
                assert_valid(track)
            states = tracker._states
            for cov in (states.cov, states.range_cov):
                assert np.isfinite(cov).all()
                if len(cov):
                    assert np.linalg.eigvalsh(cov).min() > -1e-3


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_the_nearer_of_two_nested_boxes_with_equal_scores_is_tracked(order):
    near, far = [290.0, 190, 390, 282], [320.0, 205, 360, 243]
    (track,) = after(20, *[near, far][order]).update(found(*[near, far][order]), SHAPE)
    np.testing.assert_allclose(track.box, near, atol=3)


def test_a_box_beside_a_coasting_track_is_another_vehicle():
    tracker = after(25)
    for _ in range(10):
        tracker.update(found(), SHAPE)
    for _ in range(10):
        tracks = tracker.update(found([705.0, 400, 805, 490]), SHAPE)
    assert [track.id for track in tracks if track.state == "confirmed"] == [2]


def assert_equal(first, second):
    for one, other in zip(first, second, strict=True):
        for field in dataclasses.fields(Track):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def assert_valid(track: Track) -> None:
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


def test_a_vehicle_that_comes_fast_is_tracked():
    # Both cars drive at 100 km/h; the box moves by most of its width between two searched frames.
    tracker, ids = Tracker(fps=12.5), []
    tracker.update(Detections.empty(), SHAPE)
    for frame in range(7):
        distance = 46.0 - 56 * frame / 12.5
        left, right = 640 - 1150 * 9.4 / distance, 640 - 1150 * 7.6 / distance
        box = [left, 400 - 1150 * 0.3 / distance, right, 400 + 1150 * 1.2 / distance]
        tracks = tracker.update(Detections([np.clip(box, 0, 1280)], [3.0]), SHAPE)
        ids.append([track.id for track in tracks])
    assert ids[3:] == [[1]] * 4


def test_a_vehicle_hidden_in_steps_keeps_its_size_place_and_id():
    tracker, far = Tracker(fps=12.5, camera=CAMERA), on_road(33)
    for step in range(75):
        near = on_road(20, x=-4 + 8 * step / 75)
        # The detection of the far car is what remains visible of it, beside the near one.
        visible = far.copy()
        if near[0] <= visible[0] < near[2]:
            visible[0] = near[2]
        elif near[0] < visible[2] <= near[2]:
            visible[2] = near[0]
        is_detected = visible[2] - visible[0] > 0.3 * (far[2] - far[0])
        tracks = tracker.update(found(near, *([visible] if is_detected else [])), SHAPE)
        if 20 < step < 44:  # until it is detected again
            (box,) = (track.box for track in tracks if track.id and track.box[3] < near[3] - 10)
            assert iou_matrix([box], [far])[0, 0] > 0.7
    assert [track.id for track in tracks] == [1, 2]


def test_the_distance_of_a_vehicle_that_emerges_from_behind_another_one_is_right():
    """It seems far away if its visible part is taken for its width, and fast as that part grows."""
    tracker, near, estimates = Tracker(fps=25, camera=CAMERA), on_road(12), []
    for step in range(90):
        visible = on_road(30, x=1 + step / 25, length=4.5)
        whole = visible[2] - visible[0]
        visible[0] = max(visible[0], near[2])
        is_detected = visible[2] - visible[0] > 0.5 * whole
        tracks = tracker.update(found(near, *([visible] if is_detected else [])), SHAPE)
        estimates += [track for track in tracks if track.id == 2]
    errors = [track.distance_m / 30 - 1 for track in estimates]
    assert len(errors) > 20
    assert np.abs(errors).max() < 0.12
    assert abs(estimates[-1].speed_mps or 0.0) < 2


@pytest.mark.parametrize("height_std", [0.02, 0.05, 0.1])
def test_the_distance_of_a_near_vehicle_follows_its_bottom_edge(height_std):
    # A car that the right border cuts, and that pulls away; its first box seems farther than the second one.
    camera = Camera(focal_px=576, horizon_px=201.6, height_std_m=height_std, focal_std=0.01, shape=(360, 640))
    bottoms = [319, 347, 345, 331, 319, 310, 302, 295]
    tracker = Tracker(fps=25, camera=camera)
    for frame, bottom in enumerate(bottoms):
        box = [450 + 60 * (bottom - 295) / 50, 2 * 201.6 - bottom + 15, 640, bottom]
        (track,) = tracker.update(Detections([box], [4.0]), (360, 640), time=frame * 0.08)
    true = 576 * camera.height_m / (bottoms[-1] - 201.6) - camera.overhang_m
    assert abs(track.distance_m - true) < track.distance_std_m < 0.3 * true


def test_a_frame_with_thousands_of_detections_is_limited_with_a_warning():
    random = np.random.default_rng(0)
    corners = random.uniform(0, 600, (2000, 2))
    found = Detections(np.concatenate([corners, corners + 40], axis=1), random.uniform(0, 3, 2000))
    tracker = Tracker(fps=25)
    with pytest.warns(UserWarning, match="2000 detections"):
        assert 0 < len(tracker.update(found, (720, 1280))) <= 500
    tracker.update(found, (720, 1280))  # the warning comes once
