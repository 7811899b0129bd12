"""The growth of vehicles in the image, measured from their pixels."""

import math

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from vehicle_detection import Camera, Detections, Tracker
from vehicle_detection.tracking import small_gray
from vehicle_detection.tracking.pixels import measure_growth

SHAPE = (360, 640)
CAMERA = Camera.dashcam(fov=60, height_m=1.4, horizon=0.5).for_shape(SHAPE)
TEXTURE = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, (480, 480), dtype=np.uint8), (0, 0), 6)
TEXTURE = cv2.normalize(TEXTURE, None, 0, 255, cv2.NORM_MINMAX)


def scene(center, width):
    """Gray frame with a textured vehicle, and its box."""
    scale, frame = width / 480, np.full((720, 1280), 90, np.uint8)
    shift = [2 * (center[0] - width / 2), 2 * (center[1] - width / 2)]
    matrix = np.array([[2 * scale, 0, shift[0]], [0, 2 * scale, shift[1]]])
    small = cv2.resize(TEXTURE, None, fx=2 * scale, fy=2 * scale, interpolation=cv2.INTER_AREA)
    matrix[:, :2] /= small.shape[0] / 480
    cv2.warpAffine(small, matrix, (1280, 720), frame, borderMode=cv2.BORDER_TRANSPARENT)
    left, top = center[0] - width / 2, center[1] - width / 2
    box = np.array([left, top, left + width, top + width])
    return cv2.resize(frame, SHAPE[::-1], interpolation=cv2.INTER_AREA), box


@pytest.mark.parametrize("width", [24, 60, 150])
@pytest.mark.parametrize("growth", [0.95, 1.0, 1.04, 1.15])
def test_growth_is_measured_although_the_edges_of_boxes_are_wrong(width, growth):
    before, box = scene((330, 200), width)
    after, new = scene((320 + 10 * growth, 180 + 20 * growth), width * growth)
    wrong = width * np.array([[0.03, -0.02, 0.04, 0.02]])
    found, std = measure_growth(before, after, box[None] + wrong, new[None] - wrong, CAMERA)
    assert abs(found[0] - math.log(growth)) < 0.01 + 0.1 / width
    assert std[0] < 0.02


def test_a_turn_of_the_camera_is_no_growth():
    turn, focal = 0.03, CAMERA.focal_px
    grow = {}
    for camera_turns in (False, True):
        before, box = scene((500, 200), 60)
        t = (500 - 320) / focal
        x = 320 + focal * math.tan(math.atan(t) + turn * camera_turns)
        after, new = scene((x, 200), 60 * (1 + 1.5 * t * turn * camera_turns))
        grow[camera_turns], _ = measure_growth(before, after, box[None], new[None], CAMERA)
    assert_allclose(grow[True], grow[False], atol=0.004)


def test_a_vehicle_without_texture_or_too_small_has_no_growth():
    flat = np.full(SHAPE, 128, np.uint8)
    boxes = np.array([[300.0, 180, 360, 240], [100, 180, 105, 184]])
    growth, std = measure_growth(flat, flat, boxes, boxes, CAMERA)
    assert np.isinf(std).all()
    assert not growth.any()
    none, _ = measure_growth(flat, flat, boxes[:0], boxes[:0], CAMERA)
    assert len(none) == 0


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((720, 1280, 3), SHAPE), ((1280, 720, 3), (640, 360)), ((240, 320, 3), (240, 320))],
)
def test_gray_frames_are_small(shape, expected):
    assert small_gray(np.zeros(shape, np.uint8)).shape == expected


def test_pixels_make_the_speed_of_an_approaching_vehicle_exact():
    random, errors, stds = np.random.default_rng(5), {}, {}
    trackers = {with_gray: Tracker(camera=CAMERA, fps=10) for with_gray in (False, True)}
    distances = 30 - 6 * np.arange(0, 2.5, 0.1)
    for distance in distances:
        width = CAMERA.focal_px * CAMERA.vehicle_width_m / distance
        bottom = CAMERA.horizon_px + CAMERA.focal_px * CAMERA.height_m / (distance + CAMERA.overhang_m)
        gray, box = scene((320, bottom - width / 2), width)
        found = Detections((box + random.normal(0, 0.04 * width, 4))[None], [3.0])
        for with_gray, tracker in trackers.items():
            (track,) = tracker.update(found, SHAPE, gray=gray if with_gray else None)
            errors[with_gray], stds[with_gray] = abs((track.speed_mps or 0) + 6), track.speed_std_mps
    assert errors[True] < 0.6
    assert stds[True] < stds[False] / 1.5
