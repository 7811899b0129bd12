import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.camera import (
    Camera,
    Distance,
    distance_from_foot,
    distance_from_width,
    estimate_distance,
    join_distances,
    truncated_edges,
)
from vehicle_detection.errors import InvalidInputError

SHAPE = (720, 1280)
CAMERA = Camera.for_frame(SHAPE)


def vehicle_box(distance, camera=CAMERA, *, x=0.0, width=1.8, height=1.5):
    """Box of an upright rectangle `distance` meters ahead, `x` meters to the right."""
    pixel = camera.focal_px / distance
    foot, center = camera.horizon_px + pixel * camera.height_m, 640 + pixel * x
    return [center - pixel * width / 2, foot - pixel * height, center + pixel * width / 2, foot]


def test_for_frame_places_horizon_and_focal_length():
    camera = Camera.for_frame((1000, 500, 3), horizon=0.4, field_of_view=90.0, height_m=1.5)
    assert camera.focal_px == pytest.approx(500)
    assert camera.horizon_px == pytest.approx(400)
    assert camera.height_m == 1.5


def test_for_frame_defaults_match_a_focal_length_of_nine_tenths_of_the_longer_side():
    assert Camera.for_frame(SHAPE).focal_px == pytest.approx(0.9 * 1280, rel=0.01)
    assert Camera.for_frame((1920, 1080)).focal_px == pytest.approx(0.9 * 1920, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"focal_px": 0.0, "horizon_px": 1.0}, "focal_px must be a number, greater than 0"),
        ({"focal_px": math.nan, "horizon_px": 1.0}, "focal_px must be a number"),
        ({"focal_px": 900.0, "horizon_px": math.inf}, "horizon_px must be a number"),
        (
            {"focal_px": 900.0, "horizon_px": 1.0, "height_m": -1.0},
            "height_m must be a number, greater than 0",
        ),
        ({"focal_px": 900.0, "horizon_px": 1.0, "box_error": -0.1}, "box_error must be a number, at least 0"),
        ({"focal_px": 900.0, "horizon_px": 1.0, "focal_std": "1"}, "focal_std must be a number"),
    ],
)
def test_camera_refuses(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        Camera(**arguments)


def test_for_frame_refuses():
    with pytest.raises(InvalidInputError, match=r"shape must be \(height, width, ...\).*pass image.shape"):
        Camera.for_frame(720)
    with pytest.raises(InvalidInputError, match=r"shape\[0\] must be an integer at least 1"):
        Camera.for_frame((0, 100))
    with pytest.raises(InvalidInputError, match="field_of_view must be a number, at least 1 and at most 170"):
        Camera.for_frame(SHAPE, field_of_view=180)
    with pytest.raises(InvalidInputError, match=r"lens is no argument of Camera.for_frame"):
        Camera.for_frame(SHAPE, lens=1.0)
    with pytest.raises(InvalidInputError, match=r"focal_px is no argument.*pass field_of_view"):
        Camera.for_frame(SHAPE, focal_px=1.0)


@given(st.floats(3, 80), st.floats(0.8, 2.0), st.floats(30, 90))
def test_distances_invert_the_projection(distance, height, angle):
    camera = Camera.for_frame(
        SHAPE, height_m=height, field_of_view=angle, horizon_error_px=0.0, bottom_std_px=0.1
    )
    box = vehicle_box(distance, camera)
    assert distance_from_foot(box[3], camera).meters == pytest.approx(distance)
    assert distance_from_width(box[2] - box[0], camera).meters == pytest.approx(distance)


def test_foot_is_unknown_at_and_above_the_horizon():
    rows = CAMERA.horizon_px + np.array([-50.0, 0.0, 1.0, 3.0, 60.0])
    meters, error = distance_from_foot(rows, CAMERA)
    assert np.isnan(meters[:4]).all()
    assert np.isinf(error[:4]).all()
    assert np.isfinite([meters[4], error[4]]).all()


def test_relative_error_of_the_foot_grows_with_distance_that_of_the_width_hardly():
    boxes = np.array([vehicle_box(distance) for distance in (8.0, 16.0, 32.0)])
    foot = distance_from_foot(boxes[:, 3], CAMERA)
    width = distance_from_width(boxes[:, 2] - boxes[:, 0], CAMERA)
    assert (np.diff(foot.error / foot.meters) > 0).all()
    assert np.ptp(width.error / width.meters) < 0.02


def test_a_vehicle_aside_is_wider_by_its_flank():
    """Face and flank as a pinhole sees them: the inner edge is that of the far end."""
    distance, aside, length = 20.0, 3.6, CAMERA.vehicle_length_m
    outer = CAMERA.focal_px * (aside + 0.9) / distance
    inner = CAMERA.focal_px * (aside - 0.9) / (distance + length)
    width = distance_from_width(outer - inner, CAMERA, aside_px=inner)
    assert width.meters == pytest.approx(distance)
    assert distance_from_width(outer - inner, CAMERA).meters < 0.81 * distance
    foot = CAMERA.horizon_px + CAMERA.focal_px * CAMERA.height_m / distance
    for left, right in ((640 + inner, 640 + outer), (640 - outer, 640 - inner)):
        assert estimate_distance([[left, 300, right, foot]], CAMERA, SHAPE).meters == pytest.approx(
            [distance]
        )


def test_a_doubtful_horizon_leaves_the_word_to_the_width():
    doubtful = Camera.for_frame(SHAPE, horizon=0.5, horizon_std_px=40.0)
    foot, width = CAMERA.horizon_px + CAMERA.focal_px * 1.3 / 30, CAMERA.focal_px * 1.8 / 30
    box = [[640 - width / 2, foot - width, 640 + width / 2, foot]]
    assert estimate_distance(box, doubtful, SHAPE).meters == pytest.approx([30.0], rel=0.15)
    sure = Camera.for_frame(SHAPE, horizon=0.5)
    assert estimate_distance(box, sure, SHAPE).meters < 25


def test_width_is_unknown_below_a_pixel():
    meters, error = distance_from_width([0.0, -3.0, 0.5], CAMERA)
    assert np.isnan(meters).all()
    assert np.isinf(error).all()


def test_errors_given_by_the_caller_replace_the_cameras():
    exact = Camera.for_frame(
        SHAPE, focal_std=0.0, height_std_m=0.0, horizon_error_px=0.0, vehicle_width_std_m=0.0
    )
    foot = distance_from_foot(exact.horizon_px + 100, exact, bottom_std_px=1.0)
    assert foot.error / foot.meters == pytest.approx(0.01)
    width = distance_from_width(100.0, exact, width_std_px=2.0)
    assert width.error / width.meters == pytest.approx(0.02)


measured = st.tuples(st.floats(2, 100), st.floats(0.05, 30))


@given(measured, measured)
def test_joined_distance_lies_between_and_does_not_depend_on_the_order(one, two):
    first, second = (Distance(np.array([z]), np.array([e])) for z, e in (one, two))
    joined = join_distances(first, second)
    assert min(one[0], two[0]) - 1e-9 <= joined.meters[0] <= max(one[0], two[0]) + 1e-9
    swapped = join_distances(second, first)
    assert joined.meters[0] == pytest.approx(swapped.meters[0])
    assert joined.error[0] == pytest.approx(swapped.error[0])
    agree = abs(one[0] - two[0]) <= math.hypot(one[1], two[1])
    assert (joined.error[0] <= min(one[1], two[1]) + 1e-9) or not agree


def test_join_takes_what_is_known():
    known = Distance(np.array([20.0]), np.array([2.0]))
    unknown = Distance(np.array([np.nan]), np.array([np.inf]))
    for pair in ((known, unknown), (unknown, known)):
        joined = join_distances(*pair)
        assert (joined.meters[0], joined.error[0]) == (20.0, pytest.approx(2.0))
    nothing = join_distances(unknown, unknown)
    assert np.isnan(nothing.meters[0])
    assert np.isinf(nothing.error[0])


def test_measurements_that_contradict_each_other_join_to_a_larger_error():
    far = join_distances(*(Distance(np.array([z]), np.array([1.0])) for z in (10.0, 30.0)))
    assert far.error[0] > 5


def test_estimate_leaves_out_what_the_border_cuts_off():
    whole = vehicle_box(12.0)
    right_cut, bottom_cut = [1100.0, 420.0, 1280.0, 520.0], [600.0, 420.0, 760.0, 720.0]
    boxes = np.array([whole, right_cut, bottom_cut, [1100.0, 420.0, 1280.0, 720.0]])
    meters, error = estimate_distance(boxes, CAMERA, SHAPE)
    assert meters[0] == pytest.approx(12.0)
    assert meters[1] == pytest.approx(distance_from_foot(520.0, CAMERA).meters)
    assert meters[2] == pytest.approx(distance_from_width(160.0, CAMERA).meters)
    assert np.isnan(meters[3])
    assert np.isinf(error[3])


def test_estimate_of_no_boxes_is_empty():
    assert estimate_distance(np.empty((0, 4)), CAMERA, SHAPE).meters.shape == (0,)


def test_estimate_refuses_malformed_boxes():
    with pytest.raises(InvalidInputError, match=r"boxes must be an \(N, 4\)"):
        estimate_distance([1, 2, 3], CAMERA, SHAPE)


def test_standard_errors_cover_the_truth():
    """Vehicles, cameras and boxes that scatter as the camera says lie within two standard errors."""
    rng = np.random.default_rng(7)
    inside, trials = 0, 1500
    for _ in range(trials):
        distance = rng.uniform(8, 40)
        real = Camera(
            focal_px=CAMERA.focal_px * (1 + rng.normal(0, CAMERA.focal_std)),
            horizon_px=CAMERA.horizon_px + rng.normal(0, CAMERA.horizon_error_px),
            height_m=CAMERA.height_m + rng.normal(0, CAMERA.height_std_m),
        )
        width = max(1.0, rng.normal(CAMERA.vehicle_width_m, CAMERA.vehicle_width_std_m))
        box = np.array(vehicle_box(distance, real, width=width))
        size = np.tile(box[2:] - box[:2], 2)
        box += rng.normal(0, 1, 4) * np.hypot(CAMERA.bottom_std_px, CAMERA.box_error * size)
        meters, error = estimate_distance(box[None], CAMERA, (2000, 1280))
        inside += abs(meters[0] - distance) < 2 * error[0]
    # 0.954 for normal errors; the distance is not quite normal in the row.
    assert 0.92 < inside / trials < 0.99


def test_cut_edges_allow_for_a_search_that_ends_short_of_the_border():
    boxes = np.array(
        [[0.0, 300.0, 100.0, 400.0], [1076.0, 400.0, 1276.0, 500.0], [600.0, 400.0, 700.0, 719.0]]
    )
    assert truncated_edges(boxes, SHAPE).tolist() == [
        [True, False, False, False],
        [False, False, True, False],
        [False, False, False, True],
    ]
