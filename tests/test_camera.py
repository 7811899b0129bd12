import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import SHAPE, boxes_on_a_road
from vehicle_detection.camera import (
    LENSES,
    Camera,
    estimate_horizon,
    lateral_offsets,
    read_camera,
    truncated_edges,
    write_camera,
)
from vehicle_detection.errors import InvalidInputError

CAMERA = Camera.for_frame(SHAPE)


@pytest.mark.parametrize(("name", "remedy"), [("focal_px", "field_of_view"), ("horizon_px", "horizon")])
def test_for_frame_refuses_what_it_computes(name, remedy):
    with pytest.raises(
        InvalidInputError, match=f"{name} is not an argument of Camera.for_frame; pass {remedy}"
    ):
        Camera.for_frame(SHAPE, **{name: 300})


def test_for_frame_places_horizon_and_focal_length():
    camera = Camera.for_frame((1000, 500, 3), horizon=0.4, field_of_view=90.0, height_m=1.5)
    assert camera.focal_px == pytest.approx(500)
    assert camera.horizon_px == pytest.approx(400)
    assert camera.height_m == 1.5


def test_default_focal_length_is_nine_tenths_of_the_longer_side():
    assert Camera.for_frame(SHAPE).focal_px == pytest.approx(0.9 * 1280, rel=0.01)
    assert Camera.for_frame((1920, 1080)).focal_px == pytest.approx(0.9 * 1920, rel=0.01)


def test_pixel_errors_scale_with_the_focal_length():
    double = Camera.for_frame((1440, 2560), horizon_std_px=8.0)
    assert double.pixel_scale == pytest.approx(2 * CAMERA.pixel_scale)
    assert double.total_horizon_std_px == pytest.approx(math.hypot(2 * CAMERA.total_horizon_std_px, 8.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"focal_px": 0.0}, "focal_px must be a number, greater than 0"),
        ({"focal_px": math.nan}, "focal_px must be a number"),
        ({"horizon_px": math.inf}, "horizon_px must be a number"),
        ({"height_m": -1.0}, "height_m must be a number, greater than 0"),
        ({"box_std": -0.1}, "box_std must be a number, at least 0"),
        ({"focal_std": "1"}, "focal_std must be a number"),
    ],
)
def test_camera_rejects_invalid_values(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        Camera(**({"focal_px": 900.0, "horizon_px": 1.0} | arguments))


@pytest.mark.parametrize(
    ("shape", "known", "message"),
    [
        (720, {}, r"shape must be \(height, width, ...\).*pass image.shape"),
        ((0, 100), {}, r"shape\[0\] must be an integer at least 1"),
        (SHAPE, {"field_of_view": 180}, "field_of_view must be a number, at least 1 and at most 170"),
        (SHAPE, {"zoom": 1.0}, "zoom is not an argument of Camera.for_frame"),
        (SHAPE, {"lens": "wide"}, "lens must be one of 'standard-58', 'wide-90', 'fisheye-120'"),
        (
            SHAPE,
            {"fisheye": True, "k1": -0.9, "field_of_view": 150},
            "k1 and k2 must keep the radius positive",
        ),
        (SHAPE, {"focal_px": 1.0}, "focal_px is not an argument.*pass field_of_view"),
    ],
)
def test_for_frame_rejects_invalid_arguments(shape, known, message):
    with pytest.raises(InvalidInputError, match=message):
        Camera.for_frame(shape, **known)


@given(st.floats(5, 80), st.floats(1.5, 8))
def test_width_of_a_vehicle_in_another_lane_includes_its_side(distance, lateral_m):
    """In a pinhole camera, the inner edge of the box belongs to the far end of the vehicle."""
    half, length = CAMERA.vehicle_width_m / 2, CAMERA.vehicle_length_m
    outer = CAMERA.focal_px * (lateral_m + half) / distance
    inner = CAMERA.focal_px * (lateral_m - half) / (distance + length)
    boxes = np.array([[640 + inner, 300, 640 + outer, 400], [640 - outer, 300, 640 - inner, 400]])
    lateral_px = lateral_offsets(boxes, SHAPE)
    np.testing.assert_allclose(lateral_px, inner)
    np.testing.assert_allclose(CAMERA.width_times_distance(lateral_px), (outer - inner) * distance)


def test_lateral_offset_of_a_box_across_the_middle_is_zero():
    assert lateral_offsets(np.array([[600.0, 300, 700, 400], [640, 300, 700, 400]]), SHAPE).tolist() == [0, 0]


def test_truncated_edges_allow_for_a_search_that_ends_short_of_the_border():
    boxes = np.array(
        [[0.0, 300.0, 100.0, 400.0], [1076.0, 400.0, 1276.0, 500.0], [600.0, 400.0, 700.0, 719.0]]
    )
    assert truncated_edges(boxes, SHAPE).tolist() == [
        [True, False, False, False],
        [False, False, True, False],
        [False, False, False, True],
    ]


@given(st.floats(0.35, 0.6), st.floats(0.9, 2.0), st.integers(0, 1000))
def test_horizon_of_a_flat_road_is_nearly_exact(horizon, camera_height, seed):
    found = estimate_horizon(boxes_on_a_road(horizon, camera_height, seed=seed), SHAPE)
    assert found.horizon == pytest.approx(horizon, abs=0.015)
    assert found.camera_height_m == pytest.approx(camera_height, rel=0.1)
    assert found.horizon_std < 0.015


def test_standard_error_is_realistic_and_shrinks_with_more_boxes():
    few, many = (
        [estimate_horizon(boxes_on_a_road(0.5, 1.3, count, seed, 0.08), SHAPE) for seed in range(12)]
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
    assert estimate_horizon(boxes, SHAPE).horizon == pytest.approx(0.5, abs=0.03)


def test_the_sides_of_vehicles_do_not_change_the_horizon():
    boxes = boxes_on_a_road(0.5, 1.3, 30)
    wider = boxes.copy()
    wider[:, 2] += 60
    assert estimate_horizon(wider, SHAPE).horizon == pytest.approx(estimate_horizon(boxes, SHAPE).horizon)


def test_a_few_boxes_of_one_size_give_an_uncertain_horizon():
    boxes = np.tile([[600.0, 400.0, 660.0, 450.0]], (20, 1))
    found = estimate_horizon(boxes, SHAPE)
    assert found.horizon == pytest.approx(405 / 720, abs=0.01)
    assert found.camera_height_m == pytest.approx(1.35, abs=0.05)
    assert 0.008 < found.horizon_std < 0.05


def test_boxes_without_a_common_line_give_an_uncertain_horizon():
    corners = np.random.default_rng(0).uniform((50, 50), (1100, 600), (30, 2))
    boxes = np.hstack([corners, corners + np.array([70, 50])])
    assert estimate_horizon(boxes, SHAPE).horizon_std > 0.05


def test_truncated_boxes_are_ignored():
    boxes = boxes_on_a_road(0.5, 1.3, 20)
    truncated = np.tile([[0.0, 300.0, 400.0, 720.0]], (30, 1))
    found = estimate_horizon(np.concatenate([boxes, truncated]), SHAPE)
    assert found == estimate_horizon(boxes, SHAPE)
    assert found.n_boxes == 20


def test_too_few_boxes_are_rejected():
    with pytest.raises(InvalidInputError, match=r"^boxes must contain 4 vehicles .* got 3; use more frames"):
        estimate_horizon(boxes_on_a_road(0.5, 1.3, 3), SHAPE)


# --- lenses ---


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (0.08, -0.01), (-0.04, 0.003)])
def test_rectified_points_equal_those_of_opencv(k1, k2):
    camera = Camera.for_frame(SHAPE, field_of_view=140, fisheye=True, k1=k1, k2=k2)
    corners = np.random.default_rng(0).uniform((40, 200), (1000, 500), (40, 2))
    boxes = np.hstack([corners, corners + np.array([120, 90])])
    rectified = camera.rectify_boxes(boxes, SHAPE)
    matrix = np.array([[camera.focal_px, 0, 640], [0, camera.focal_px, 360], [0, 0, 1]])
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    for column, points in (
        (0, np.column_stack([boxes[:, 0], middle[:, 1]])),
        (1, np.column_stack([middle[:, 0], boxes[:, 1]])),
        (2, np.column_stack([boxes[:, 2], middle[:, 1]])),
        (3, np.column_stack([middle[:, 0], boxes[:, 3]])),
    ):
        expected = cv2.fisheye.undistortPoints(points[:, None], matrix, np.array([k1, k2, 0, 0]), P=matrix)
        np.testing.assert_allclose(rectified[:, column], expected[:, 0, column % 2], atol=1e-3)


def test_a_fisheye_sees_its_field_of_view():
    for lens, (angle, fisheye) in LENSES.items():
        camera = Camera.for_frame(SHAPE, lens=lens)
        assert camera.fisheye is fisheye
        edge = camera.rectify_boxes(np.array([[600.0, 300, 1280, 420]]), SHAPE)[0, 2] - 640
        degrees = 2 * math.degrees(math.atan(edge / camera.focal_px))
        assert degrees == pytest.approx(min(angle, 160), abs=0.1)


def test_boxes_of_small_integers_are_rectified():
    camera = Camera.for_frame(SHAPE, lens="fisheye-120")
    boxes = [[100, 100, 200, 200]]
    expected = camera.rectify_boxes(np.array(boxes, np.float64), SHAPE)
    np.testing.assert_array_equal(camera.rectify_boxes(np.array(boxes, np.uint8), SHAPE), expected)
    np.testing.assert_array_equal(camera.rectify_boxes(boxes, SHAPE), expected)


def test_a_pinhole_camera_keeps_boxes_and_horizon():
    boxes = np.array([[600.0, 300, 700, 420]])
    assert CAMERA.rectify_boxes(boxes, SHAPE) is boxes
    assert CAMERA.to_pinhole(SHAPE) is CAMERA


def test_the_horizon_of_a_fisheye_is_rectified():
    camera = Camera.for_frame(SHAPE, lens="fisheye-140", horizon=0.6)
    pinhole = camera.to_pinhole(SHAPE)
    assert not pinhole.fisheye
    angle = (camera.horizon_px - 360) / camera.focal_px
    assert pinhole.horizon_px == pytest.approx(360 + camera.focal_px * math.tan(angle))


def test_a_camera_file_holds_the_camera(tmp_path):
    camera = Camera.for_frame(SHAPE, field_of_view=130, fisheye=True, k1=0.02, k2=-0.01, horizon=0.47)
    write_camera(camera, tmp_path / "camera.json", SHAPE)
    assert read_camera(tmp_path / "camera.json", SHAPE) == camera
    half = read_camera(tmp_path / "camera.json", (360, 640))
    assert half.focal_px == pytest.approx(camera.focal_px / 2)
    assert half.horizon_px == pytest.approx(camera.horizon_px / 2)
    assert half.shape == (360, 640)
    write_camera(camera, tmp_path / "half.json", (360, 640))
    assert read_camera(tmp_path / "half.json", SHAPE) == camera


def test_numbers_of_numpy_become_floats(tmp_path):
    camera = Camera(focal_px=np.float32(900), horizon_px=np.int64(360), fisheye=np.bool_(True))
    write_camera(camera, tmp_path / "camera.json", SHAPE)
    assert read_camera(tmp_path / "camera.json", SHAPE) == camera
    assert type(camera.focal_px) is float


def test_a_camera_is_scaled_to_frames_of_the_same_aspect_ratio():
    half = CAMERA.for_shape((360, 640))
    assert (half.focal_px, half.horizon_px) == (CAMERA.focal_px / 2, CAMERA.horizon_px / 2)
    assert half.height_m == CAMERA.height_m
    assert half.for_shape(SHAPE) == CAMERA
    assert CAMERA.for_shape(SHAPE) is CAMERA
    unknown = Camera(focal_px=900, horizon_px=360)
    assert unknown.for_shape((480, 640)) is unknown
    with pytest.raises(InvalidInputError, match=r"for frames of 640x480 pixels .* got one for 1280x720; use"):
        CAMERA.for_shape((480, 640))


def test_the_shape_of_a_camera_is_not_compared():
    assert dataclasses.replace(CAMERA, shape=None) == CAMERA
    with pytest.raises(InvalidInputError, match="shape must be"):
        Camera(focal_px=900, horizon_px=360, shape=720)


def test_a_camera_file_by_hand(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"lens": "wide-90", "horizon": 0.5, "height_m": 1.6}')
    camera = read_camera(path, SHAPE)
    assert (camera.focal_px, camera.horizon_px, camera.height_m) == (pytest.approx(640), 360, 1.6)
    assert camera.horizon_std_px == 0
    path.write_text('{"focal_px": 900, "image_size": [1280, 720]}')
    camera = read_camera(path, SHAPE)
    assert (camera.focal_px, camera.horizon_std_px) == (900, 36)
    path.write_text("{}")
    assert read_camera(path, SHAPE).focal_std == 0.25


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"camera file .+ is not JSON"),
        pytest.param("[" * 100_000, r"camera file .+ is not JSON: it is nested too deeply", id="deep"),
        ("[1]", r"camera file .+ must be an object with the names .*; got \[1\]"),
        ('{"zoom": 1}', r"must be an object with the names .*; got zoom"),
        ('{"focal_px": 900}', r"camera.json: focal_px needs image_size"),
        (
            '{"focal_px": 900, "lens": "wide-90", "image_size": [1280, 720]}',
            "must hold lens or focal_px, not both",
        ),
        (
            '{"focal_px": 900, "image_size": [1280, 960]}',
            r"image_size must have the aspect ratio .* 1280x720",
        ),
        ('{"focal_px": 900, "image_size": 1280}', r"image_size must be \[width, height\], got 1280"),
        ('{"field_of_view": 900}', r"camera.json: field_of_view must be a number"),
        ('{"height_m": "low"}', r"camera.json: height_m must be a number"),
    ],
)
def test_invalid_camera_files(tmp_path, text, message):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=message):
        read_camera(path, SHAPE)


def test_a_missing_camera_file(tmp_path):
    with pytest.raises(InvalidInputError, match=r"^camera file .+ does not exist; check the path"):
        read_camera(tmp_path / "camera.json", SHAPE)


@pytest.mark.parametrize("lens", ["standard-58", "fisheye-120"])
def test_a_camera_of_another_size_rectifies_as_one_of_this_size(lens):
    large, small = (Camera.for_frame(shape, lens=lens) for shape in ((720, 1280), (360, 640)))
    boxes = np.array([[450.0, 200, 550, 260]])
    np.testing.assert_allclose(large.rectify_boxes(boxes, (360, 640)), small.rectify_boxes(boxes, (360, 640)))
    assert large.to_pinhole((360, 640)).horizon_px == pytest.approx(small.to_pinhole((360, 640)).horizon_px)
