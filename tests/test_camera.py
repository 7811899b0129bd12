import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import SHAPE
from vehicle_detection import Camera, InvalidInputError, open_camera, read_camera, write_camera
from vehicle_detection.camera import LENSES, lateral_offsets, truncated_edges

CAMERA = Camera.for_frame(SHAPE)


def test_for_frame_places_horizon_and_focal_length():
    camera = Camera.for_frame((1000, 500, 3), horizon=0.4, fov=90.0, height_m=1.5)
    assert camera.focal_px == pytest.approx(500)
    assert camera.horizon_px == pytest.approx(400)
    assert camera.height_m == 1.5


def test_pixel_errors_scale_with_the_focal_length():
    double = Camera.for_frame((1440, 2560), horizon_std_px=8.0)
    assert double.pixel_scale == pytest.approx(2 * CAMERA.pixel_scale)
    assert double.total_horizon_std_px == pytest.approx(math.hypot(2 * CAMERA.total_horizon_std_px, 8.0))


@pytest.mark.parametrize(
    ("shape", "known", "message"),
    [
        (SHAPE, {"zoom": 1.0}, "zoom is not an argument of Camera.for_frame"),
        (SHAPE, {"fisheye": True, "k1": -0.9, "fov": 150}, "k1 and k2 must keep the radius positive"),
        (SHAPE, {"focal_px": 1.0}, "focal_px is not an argument.*pass fov"),
        (SHAPE, {"horizon_px": 1.0}, "horizon_px is not an argument.*pass horizon"),
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
    boxes = np.array([[0.0, 300, 100, 400], [1076, 400, 1276, 500], [600, 400, 700, 719]])
    assert truncated_edges(boxes, SHAPE).tolist() == [
        [True, False, False, False],
        [False, False, True, False],
        [False, False, False, True],
    ]


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (0.08, -0.01), (-0.04, 0.003)])
def test_rectified_points_equal_those_of_opencv(k1, k2):
    camera = Camera.for_frame(SHAPE, fov=140, fisheye=True, k1=k1, k2=k2)
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


def test_a_fisheye_sees_its_fov():
    for lens, (angle, fisheye) in LENSES.items():
        camera = Camera.for_frame(SHAPE, lens=lens)
        assert camera.fisheye is fisheye
        edge = camera.rectify_boxes(np.array([[600.0, 300, 1280, 420]]), SHAPE)[0, 2] - 640
        degrees = 2 * math.degrees(math.atan(edge / camera.focal_px))
        assert degrees == pytest.approx(min(angle, 160), abs=0.1)


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
    camera = Camera.for_frame(SHAPE, fov=130, fisheye=True, k1=0.02, k2=-0.01, horizon=0.47)
    write_camera(camera, tmp_path / "camera.json")
    assert read_camera(tmp_path / "camera.json") == camera
    half = read_camera(tmp_path / "camera.json").for_shape((360, 640))
    assert half.focal_px == pytest.approx(camera.focal_px / 2)
    assert half.horizon_px == pytest.approx(camera.horizon_px / 2)
    assert half.shape == (360, 640)
    write_camera(camera, tmp_path / "half.json", (360, 640))
    assert read_camera(tmp_path / "half.json").for_shape(SHAPE) == camera
    camera = Camera(focal_px=np.float32(900), horizon_px=np.int64(360), fisheye=np.bool_(True))
    assert type(camera.focal_px) is float
    write_camera(camera, tmp_path / "numpy.json")
    assert read_camera(tmp_path / "numpy.json") == camera.for_shape(SHAPE)


def test_a_camera_is_scaled_to_frames_of_the_same_aspect_ratio():
    half = CAMERA.for_shape((360, 640))
    assert (half.focal_px, half.horizon_px) == (CAMERA.focal_px / 2, CAMERA.horizon_px / 2)
    assert half.height_m == CAMERA.height_m
    assert half.for_shape(SHAPE) == CAMERA
    assert CAMERA.for_shape(SHAPE) is CAMERA
    with pytest.raises(InvalidInputError, match=r"for frames of 640x480 pixels .* got one for 1280x720; use"):
        CAMERA.for_shape((480, 640))


def test_a_camera_without_a_shape_fits_all_frames():
    camera = Camera(focal_px=900, horizon_px=360).for_shape((480, 640))
    assert (camera.focal_px, camera.horizon_px, camera.shape) == (450, 240, (480, 640))
    portrait = Camera.dashcam(fov=90).for_shape((1920, 1080))
    assert (portrait.focal_px, portrait.horizon) == (pytest.approx(960), pytest.approx(0.5))
    with pytest.raises(InvalidInputError, match="shape must be"):
        Camera(focal_px=900, horizon_px=360, shape=720)


def test_what_is_not_known_of_a_dashcam_has_a_large_error():
    known = Camera.dashcam(fov=90, height_m=1.5, horizon=0.55)
    unknown = Camera.dashcam()
    assert (known.lens_is_known, known.horizon_is_known) == (True, True)
    assert (unknown.lens_is_known, unknown.horizon_is_known) == (False, False)
    for name in ("focal_std", "height_std_m", "horizon_std_px"):
        assert getattr(known, name) < getattr(unknown, name) / 1.9


def test_a_camera_is_opened_from_what_a_user_states(tmp_path):
    (tmp_path / "camera.json").write_text('{"fov": 90, "horizon": 0.4}')
    camera = Camera.for_frame(SHAPE)
    assert open_camera(camera) is camera
    assert open_camera() == Camera.dashcam()
    assert open_camera("wide-90", height_m=1.5) == Camera.dashcam(lens="wide-90", height_m=1.5)
    assert open_camera(tmp_path / "camera.json").horizon == pytest.approx(0.4)
    for each in (camera, tmp_path / "camera.json", "wide-90", None):
        assert open_camera(each, horizon=0.6).horizon == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "wide-90", "fov": 90}, "fov must be omitted with a camera"),
        ({"camera": CAMERA, "height_m": 1}, "height_m must be omitted with a camera"),
        ({"camera": "no.json"}, "camera must be a Camera, a file or one of standard-58.*got 'no.json'"),
    ],
)
def test_invalid_cameras_of_a_user(options, message):
    with pytest.raises(InvalidInputError, match=message):
        open_camera(**options)


def test_a_camera_file_by_hand(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text('{"lens": "wide-90", "horizon": 0.5, "height_m": 1.6}')
    camera = read_camera(path).for_shape(SHAPE)
    assert (camera.focal_px, camera.horizon_px, camera.height_m) == (pytest.approx(640), 360, 1.6)
    assert camera.horizon_std_px == 0
    path.write_text('{"focal_px": 900, "image_size": [1280, 720]}')
    camera = read_camera(path)
    assert (camera.focal_px, camera.horizon_is_known) == (900, False)
    path.write_text("{}")
    assert read_camera(path) == Camera.dashcam()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"camera file .+ is not JSON"),
        pytest.param("[" * 100_000, r"camera file .+ is not JSON: it is nested too deeply", id="deep"),
        ("[1]", r"camera file .+ must be an object with the names of read_camera, got"),
        ('{"zoom": 1}', r"must be an object with the names .*; got zoom"),
        ('{"focal_px": 900}', r"camera.json: focal_px needs image_size"),
        ('{"focal_px": 900, "lens": "wide-90", "image_size": [1280, 720]}', "lens or focal_px, not both"),
        ('{"fov": 150, "lens": "wide-90"}', "must hold fov or lens, not both"),
        ('{"focal_px": 900, "image_size": 1280}', r"image_size must be \[width, height\], got 1280"),
        ('{"fov": 900}', r"camera.json: fov must be a number"),
        ('{"height_m": "low"}', r"camera.json: height_m must be a number"),
    ],
)
def test_invalid_camera_files(tmp_path, text, message):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=message):
        read_camera(path)


@pytest.mark.parametrize("lens", ["standard-58", "fisheye-120"])
def test_a_camera_of_another_size_rectifies_as_one_of_this_size(lens):
    large, small = (Camera.for_frame(shape, lens=lens) for shape in ((720, 1280), (360, 640)))
    boxes = np.array([[450.0, 200, 550, 260]])
    np.testing.assert_allclose(large.rectify_boxes(boxes, (360, 640)), small.rectify_boxes(boxes, (360, 640)))
    assert large.to_pinhole((360, 640)).horizon_px == pytest.approx(small.to_pinhole((360, 640)).horizon_px)


@pytest.mark.parametrize(
    ("stated", "warning"),
    [
        ({"fov": 120}, "choose a fisheye lens"),
        ({"height_m": 0.13}, "height of 0.13 m is unusual"),
        ({"fov": 110, "height_m": 3.2}, ""),
    ],
)
def test_unusual_cameras_give_a_warning(stated, warning, caplog):
    open_camera(**stated)
    assert warning in caplog.text
    assert bool(caplog.text) == bool(warning)


def test_the_error_of_a_height_that_is_not_stated_covers_vans_and_trucks():
    for known, std in (({}, 0.1), ({"fov": 90}, 0.2), ({"fov": 90, "height_m": 2}, 0.05)):
        assert open_camera(**known).height_std_m == std


MATRIX = np.array([[1000.0, 0, 645], [0, 1004, 355], [0, 0, 1]])
ROS = """image_width: 1280
image_height: 720
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [{matrix}]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{distortion}]
"""


def write_calibration(path, distortion, *, fisheye=False, ros=False):
    """Write a calibration as OpenCV's programs do, or ROS."""
    if ros:
        values = {"matrix": MATRIX.ravel(), "distortion": distortion}
        text = {name: ", ".join(map(str, row)) for name, row in values.items()}
        model = "equidistant" if fisheye else "plumb_bob"
        path.write_text(ROS.format(**text, model=model, count=len(distortion)))
        return
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Mon 02 Feb 2026")
    for name, value in (("image_width", 1280), ("image_height", 720), ("fisheye_model", int(fisheye))):
        file.write(name, value)
    file.write("camera_matrix", MATRIX)
    file.write("distortion_coefficients", np.array(distortion).reshape(-1, 1))
    file.release()


@pytest.mark.parametrize(
    ("suffix", "ros"), [(".yml", False), (".xml", False), (".json", False), (".yaml", True)]
)
@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [
        ([-0.25, 0.05, 0.0, 0.0, 0.0], False),
        ([0.1, -0.02, 0.0, 0.0, 0.0], False),
        ([0.0, 0.0, 0.0, 0.0, 0.0], False),
        ([0.02, -0.005, 0.001, 0.0], True),
    ],
)
def test_calibrations_of_opencv_and_ros(distortion, fisheye, suffix, ros, tmp_path):
    write_calibration(path := tmp_path / f"camera{suffix}", distortion, fisheye=fisheye, ros=ros)
    camera = read_camera(path)
    assert camera.lens_is_known
    assert not camera.horizon_is_known
    # A point is where OpenCV projects it, and comes back as that of a pinhole.
    rays = np.array([[x, y, 1.0] for x in (-0.5, 0.2, 0.45) for y in (-0.2, 0.01, 0.3)])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    matrix, zero = np.array([[1002.0, 0, 640], [0, 1002, 360], [0, 0, 1]]), np.zeros(3)
    points = project(rays[:, None], zero, zero, matrix, np.array(distortion))[0][:, 0]
    boxes = camera.rectify_boxes(np.concatenate([points - 2, points + 2], axis=1), SHAPE)
    expected = 1002 * rays[:, :2] + [640, 360]
    assert (boxes[:, :2] + boxes[:, 2:]) / 2 == pytest.approx(expected, abs=6)
    assert open_camera(path, height_m=1.5, horizon=0.5).height_m == 1.5


def ros(matrix, distortion=""):
    return ROS.format(matrix=matrix, model="", count=len(distortion.split(",")), distortion=distortion)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "camera_matrix: {data: [1, 2]}", "must hold image_width, image_height"),
        ("a.yaml", ros("1, " * 9), "fit the image"),
        ("a.yaml", ros("900,0,640,0,500,360,0,0,1"), "agree"),
        ("a.yaml", ros("900,0,640,0,900,360,0,0,1", "-9,50"), "fits"),
        ("a.yaml", ros("900,0,640,0,.nan,360,0,0,1"), "finite"),
        ("a.yaml", ros("900,0,640,0,0,360,0,0,1", "1e308,1e308,0,0,0,9"), "finite"),
        ("a.json", '{"image_width": Infinity, "image_height": 9, "camera_matrix": {}}', "must hold image_w"),
        ("a.yaml", "a: [", "is not YAML"),
        ("a.yaml", "a: !!bool of", "is not YAML"),
        ("a.yaml", "a: !!int ''", "is not YAML"),
        ("a.yaml", "- 1", "must be an object"),
        ("a.xml", "<a", "is not XML"),
        ("a.xml", "<!DOCTYPE a><opencv_storage><image_width>9</image_width></opencv_storage>", "must hold"),
    ],
)
def test_calibrations_that_cannot_be_used(name, text, message, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidInputError, match=message):
        read_camera(tmp_path / name)
