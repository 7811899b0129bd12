import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import boxes_on_a_road
from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking.horizon import HorizonFilter, estimate_horizon

FRAME = (720, 1280)
TRUE = Camera.for_frame(FRAME, horizon=0.56)
INITIAL_STD = 43.0
GUESS = Camera.for_frame(FRAME, horizon=0.5, horizon_std_px=INITIAL_STD)


def on_road(distance, *, x=0.0, width=1.8, height=1.5, length=4.0):
    """Box of a vehicle `distance` meters ahead and `x` meters to the right, with its visible side."""
    near, far = TRUE.focal_px / distance, TRUE.focal_px / (distance + length)
    bottom = TRUE.horizon_px + near * TRUE.height_m
    left, right = near * (x - width / 2), near * (x + width / 2)
    if x > width / 2:
        left = far * (x - width / 2)
    if x < -width / 2:
        right = far * (x + width / 2)
    return [640 + left, bottom - near * height, 640 + right, bottom]


def estimated(scenes, *, camera=GUESS, noise=0.0, fps=25.0, seed=0):
    """Camera after the boxes of all frames; the id of a vehicle is its index in the list."""
    rng = np.random.default_rng(seed)
    horizon = HorizonFilter(camera)
    for boxes in scenes:
        array = np.array(boxes, float).reshape(-1, 4)
        array = array + rng.normal(0, noise, array.shape)
        horizon.update(np.arange(len(array)) + 1, array, FRAME, 1 / fps)
    return horizon.camera


def error(camera):
    return abs(camera.horizon_px - TRUE.horizon_px)


@pytest.mark.parametrize("seed", range(3))
def test_several_vehicles_determine_the_horizon(seed):
    cars = [on_road(15), on_road(30, x=3.6), on_road(50, x=-3.6), on_road(40)]
    camera = estimated([cars] * 125, noise=2.0, seed=seed)
    assert error(camera) < 8
    assert camera.horizon_std_px < 12
    assert error(GUESS) > 40


def test_an_approaching_vehicle_contributes_more_than_one_at_constant_distance():
    constant = estimated([[on_road(30)]] * 100)
    approaching = estimated([[on_road(50 - 0.4 * step)] for step in range(100)])
    assert approaching.horizon_std_px < 0.7 * constant.horizon_std_px < 0.7 * INITIAL_STD
    assert error(approaching) < 5


def test_moving_vehicles_of_other_widths_determine_the_horizon():
    cars = [[on_road(50 - 0.35 * step, width=1.6), on_road(20 + 0.3 * step, width=2.1)] for step in range(99)]
    assert error(estimated(cars)) < 5


def test_the_side_of_a_vehicle_in_another_lane_does_not_count_as_width():
    cars = [[on_road(12 + 0.2 * step, x=3.6), on_road(30 - 0.1 * step, x=-3.6)] for step in range(100)]
    assert error(estimated(cars)) < 5


def test_a_vehicle_that_turns_hardly_moves_the_horizon():
    """It shows its rear alone far to the side, where the others show a side, too."""
    boxes = [[on_road(12, x=8 - 0.1 * i, length=0)] for i in range(25)]
    assert error(estimated(boxes)) < error(GUESS)
    right = Camera.for_frame(FRAME, horizon=0.56, horizon_std_px=20)
    assert error(estimated(boxes, camera=right)) < 30  # 49 if the side is taken for certain


def test_boxes_that_are_not_on_the_road_are_ignored():
    cars = [on_road(15), on_road(30), on_road(50)]
    plain = estimated([cars] * 100)
    sign = [600.0, 20.0, 660.0, 80.0]
    assert estimated([[*cars, sign]] * 100).horizon_px == pytest.approx(plain.horizon_px, abs=1.5)


def test_a_fixed_horizon_is_kept():
    known = Camera.for_frame(FRAME, horizon=0.5)
    assert estimated([[on_road(15), on_road(40)]] * 50, camera=known) is known


def test_the_estimate_does_not_depend_on_the_frame_rate():
    cars = [on_road(15), on_road(40, x=3.6)]
    slow, fast = (estimated([cars] * int(4 * fps), fps=fps) for fps in (10.0, 50.0))
    assert slow.horizon_px == pytest.approx(fast.horizon_px, abs=2)
    assert slow.horizon_std_px == pytest.approx(fast.horizon_std_px, rel=0.15)


def test_the_estimate_adapts_to_vehicles_that_do_not_fit():
    horizon = HorizonFilter(GUESS)
    ids = np.array([1, 2, 3])
    for shift, seconds in ((-40.0, 20), (0.0, 20)):
        boxes = np.array([on_road(25), on_road(40), on_road(60)]) + np.array([0, shift, 0, shift])
        for _ in range(5 * seconds):
            horizon.update(ids, boxes, FRAME, 0.2)
        ids = ids + 3
    assert error(horizon.camera) < 12


@given(
    st.lists(
        st.tuples(st.floats(8, 80), st.floats(-6, 6), st.floats(1.2, 2.6)).map(
            lambda car: on_road(car[0], x=car[1], width=car[2])
        ),
        max_size=6,
    ),
    st.integers(1, 30),
    st.randoms(use_true_random=False),
)
def test_the_error_never_grows_and_the_order_of_boxes_does_not_matter(cars, frames, random):
    boxes = np.array(cars, float).reshape(-1, 4)
    boxes = boxes[~truncated_edges(boxes, FRAME).any(axis=1)]
    order = list(range(len(boxes)))
    random.shuffle(order)
    one, other = HorizonFilter(GUESS), HorizonFilter(GUESS)
    std = INITIAL_STD
    for _ in range(frames):
        one.update(np.arange(len(boxes)), boxes, FRAME, 0.04)
        other.update(np.array(order, np.int64), boxes[order], FRAME, 0.04)
        assert np.isfinite(one.camera.horizon_px)
        assert 0 < one.camera.horizon_std_px <= INITIAL_STD
        assert one.camera.horizon_std_px <= std * (1 + 1e-9) or len(boxes)
        std = one.camera.horizon_std_px
    assert other.camera.horizon_px == pytest.approx(one.camera.horizon_px, abs=1e-6)


def least_squares(camera, boxes, seconds):
    """Horizon and its standard error after one frame with vehicles straight ahead, without outliers.

    The unknowns are the horizon, the mean slope, and the deviation of each vehicle's slope from it.
    """
    count, slope = len(boxes), camera.height_m / camera.vehicle_width_m
    width, height = (boxes[:, 2:] - boxes[:, :2]).T
    # The bottom edge is that of the tires, where the vehicle seems narrower.
    measured = width
    width = measured / (1 + camera.overhang_m * measured / (camera.focal_px * camera.vehicle_width_m))
    rows = np.hstack([np.ones((count, 1)), width[:, None], np.diag(width)])
    bottom_std, pitch_std = np.array([camera.bottom_std_px, camera.pitch_std_px]) * camera.pixel_scale
    variance = bottom_std**2 + (camera.box_std * height) ** 2 + pitch_std**2
    variance += 2 * slope**2 * (bottom_std**2 + (camera.box_std * measured) ** 2)
    # The errors are correlated over half a second.
    weights = seconds / 0.5 / variance
    prior_std = [
        camera.horizon_std_px,
        slope
        * math.hypot(camera.height_std_m / camera.height_m, camera.mean_width_std_m / camera.vehicle_width_m),
    ]
    prior_std += [slope * camera.vehicle_width_std_m / camera.vehicle_width_m] * count
    prior = np.diag(np.array(prior_std) ** -2.0)
    cov = np.linalg.inv(prior + (rows.T * weights) @ rows)
    mean = cov @ (prior @ [camera.horizon_px, slope, *[0] * count] + (rows.T * weights) @ boxes[:, 3])
    return mean[0], np.sqrt(cov[0, 0])


@pytest.mark.parametrize("distances", [[20], [12, 30, 60]])
def test_one_frame_gives_the_least_squares_estimate(distances):
    boxes = np.array([on_road(distance) for distance in distances])
    found = estimated([boxes], fps=5.0)
    assert (found.horizon_px, found.horizon_std_px) == pytest.approx(least_squares(GUESS, boxes, 0.2))
    assert found.horizon_px > GUESS.horizon_px + 5


def test_a_wide_vehicle_nearby_is_no_outlier():
    """Its bottom edge is far from that of a car of its width, but widths differ between vehicles."""
    camera = Camera.for_frame(FRAME, horizon=0.56, horizon_std_px=5.0)
    assert estimated([[on_road(10, width=2.5)]] * 10, camera=camera).horizon_std_px < 4.99
    # A narrow box at the same place is too far below the horizon.
    left, top, right, bottom = on_road(10, width=2.5)
    narrow = estimated([[[left + 130, top, right - 130, bottom]]] * 10, camera=camera)
    assert (narrow.horizon_px, narrow.horizon_std_px) == pytest.approx((camera.horizon_px, 5))


def test_vehicles_of_long_ago_are_forgotten():
    horizon, box = HorizonFilter(GUESS), np.array([on_road(20)])
    known = []
    for frame in range(30):
        horizon.update(np.array([1 if frame == 0 else 2]), box, FRAME, 10.0)
        known.append(len(horizon._ids))
    # The first weight decays by exp(-t / 30 s); the others sum to 3.5 of its initial value.
    assert known[1:20] == [2] * 19
    assert known[25:] == [1] * 5


@given(st.floats(0.35, 0.6), st.floats(0.9, 2.0), st.integers(0, 1000))
def test_horizon_of_a_flat_road_is_nearly_exact(horizon, camera_height, seed):
    found = estimate_horizon(boxes_on_a_road(horizon, camera_height, seed=seed), FRAME)
    assert found.horizon == pytest.approx(horizon, abs=0.015)
    assert found.camera_height_m == pytest.approx(camera_height, rel=0.1)
    assert found.horizon_std < 0.015


def test_standard_error_is_realistic_and_shrinks_with_more_boxes():
    few, many = (
        [estimate_horizon(boxes_on_a_road(0.5, 1.3, count, seed, 0.08), FRAME) for seed in range(12)]
        for count in (20, 200)
    )
    for found in (few, many):
        spread = np.sqrt(np.mean([(each.horizon - 0.5) ** 2 for each in found]))
        assert spread < 2.5 * np.mean([each.horizon_std for each in found])
    assert np.mean([each.horizon_std for each in many]) < 0.6 * np.mean([each.horizon_std for each in few])


def test_false_boxes_and_trucks_hardly_change_the_horizon():
    boxes = boxes_on_a_road(0.5, 1.3, 60)
    boxes[::6, 1::2] -= 150
    boxes[1::6, 1] -= boxes[1::6, 3] - boxes[1::6, 1]
    assert estimate_horizon(boxes, FRAME).horizon == pytest.approx(0.5, abs=0.03)


def test_the_sides_of_vehicles_do_not_change_the_horizon():
    boxes = boxes_on_a_road(0.5, 1.3, 30)
    wider = boxes.copy()
    wider[:, 2] += 60
    assert estimate_horizon(wider, FRAME).horizon == pytest.approx(estimate_horizon(boxes, FRAME).horizon)


def test_a_few_boxes_of_one_size_give_an_uncertain_horizon():
    boxes = np.tile([[600.0, 400.0, 660.0, 450.0]], (20, 1))
    found = estimate_horizon(boxes, FRAME)
    assert found.horizon == pytest.approx(405 / 720, abs=0.01)
    assert found.camera_height_m == pytest.approx(1.35, abs=0.05)
    assert 0.008 < found.horizon_std < 0.05


def test_boxes_without_a_common_line_give_an_uncertain_horizon():
    corners = np.random.default_rng(0).uniform((50, 50), (1100, 600), (30, 2))
    boxes = np.hstack([corners, corners + np.array([70, 50])])
    assert estimate_horizon(boxes, FRAME).horizon_std > 0.05


def test_truncated_boxes_are_ignored():
    boxes = boxes_on_a_road(0.5, 1.3, 20)
    truncated = np.tile([[0.0, 300.0, 400.0, 720.0]], (30, 1))
    found = estimate_horizon(np.concatenate([boxes, truncated]), FRAME)
    assert found == estimate_horizon(boxes, FRAME)
    assert found.n_boxes == 20


def test_too_few_boxes_are_rejected():
    with pytest.raises(InvalidInputError, match=r"^boxes must contain 4 vehicles .* got 3; use more frames"):
        estimate_horizon(boxes_on_a_road(0.5, 1.3, 3), FRAME)


def test_a_known_height_of_the_camera_improves_the_estimate():
    boxes = boxes_on_a_road(0.5, 2.2, 8, seed=1)
    guessed, known = estimate_horizon(boxes, FRAME), estimate_horizon(boxes, FRAME, height_m=2.2)
    assert abs(known.horizon - 0.5) < abs(guessed.horizon - 0.5)
    assert known.horizon_std < guessed.horizon_std
    with pytest.raises(InvalidInputError, match="height_m"):
        estimate_horizon(boxes, FRAME, height_m=0)
