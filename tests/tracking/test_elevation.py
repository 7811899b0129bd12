import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.camera import Camera
from vehicle_detection.tracking.elevation import are_elevated
from vehicle_detection.tracking.kalman_filter import centers_and_sizes

FRAME = (720, 1280)
CAMERA = Camera.for_frame(FRAME)
HORIZON = CAMERA.horizon_px + 3
GUESS = HORIZON + 36
FISHEYE = Camera.for_frame(FRAME, lens="fisheye-120")
DT = 1e-3


def seen(distance, *, x=0.0, width=2.0, height=1.5, clearance=0.0, camera=CAMERA):
    """Box of what is `distance` meters ahead, `x` meters to the right and `clearance` above the road."""
    sides = np.array([x - width / 2, x + width / 2])
    levels = np.array([camera.height_m - clearance - height, camera.height_m - clearance])
    if camera.fisheye:
        angle = np.arctan(np.hypot(x, levels) / distance)
        levels = levels * angle / np.tan(angle)
        angle = np.arctan(np.hypot(sides, levels.mean()) / distance)
        sides = sides * angle / np.tan(angle)
    left, right = FRAME[1] / 2 + camera.focal_px * sides / distance
    top, bottom = camera.horizon_px + camera.focal_px * levels / distance
    return np.array([left, top, right, bottom])


def state(distance, speed, *, pitch_speed=0.0, **options):
    """State ``(1, 8)`` of what approaches at `speed` m/s while the image rises at `pitch_speed` rad/s."""
    now, later = seen(distance, **options), seen(distance - speed * DT, **options)
    later[[1, 3]] -= CAMERA.focal_px * pitch_speed * DT
    position, then = centers_and_sizes(np.stack([now, later]))
    return np.concatenate([position, (then - position) / DT])[None]


SIGN = {"clearance": 2.0, "height": 1.0, "width": 1.5, "x": 4.0}


def test_a_sign_is_elevated_as_it_comes_near():
    assert are_elevated(state(40, 25, **SIGN), FRAME, CAMERA, HORIZON) == [True]
    assert are_elevated(state(40, 25, **SIGN), FRAME, CAMERA, GUESS) == [True]


@pytest.mark.parametrize("speed", [0, 10, -25])
def test_a_sign_that_hardly_grows_is_not_judged(speed):
    assert are_elevated(state(40, speed, **SIGN), FRAME, CAMERA, HORIZON) == [False]


def test_a_sign_whose_width_alone_grows_is_not_judged():
    mean = state(40, 25, **SIGN)
    mean[0, 7] = 0.0
    assert are_elevated(mean, FRAME, CAMERA, HORIZON) == [False]


@given(
    distance=st.floats(8, 80),
    speed=st.floats(-30, 60),
    x=st.floats(-6, 6),
    height=st.floats(1.2, 4.0),
    pitch_speed=st.floats(-0.5, 0.012),
    known=st.booleans(),
)
def test_no_vehicle_is_elevated_on_a_flat_road(distance, speed, x, height, pitch_speed, known):
    mean = state(distance, speed, x=x, height=height, pitch_speed=pitch_speed)
    assert not are_elevated(mean, FRAME, CAMERA, HORIZON if known else GUESS).any()


def test_a_near_vehicle_is_not_elevated_at_a_bump():
    bump = 0.3
    assert not are_elevated(state(12, 8, pitch_speed=bump), FRAME, CAMERA, HORIZON).any()
    assert not are_elevated(state(12, 8, pitch_speed=bump), FRAME, CAMERA, GUESS).any()


def test_what_enters_or_leaves_the_frame_is_not_judged():
    mean = state(40, 25, **SIGN)
    width = mean[0, 2]
    for x, expected in (
        (640, True),
        (1280 - 0.7 * width, False),
        (1280 - 0.8 * width, True),
        (0.7 * width, False),
    ):
        mean[0, 0] = x
        assert are_elevated(mean, FRAME, CAMERA, HORIZON) == [expected]


def test_a_fisheye_camera_sees_the_same():
    pinhole = FISHEYE.to_pinhole(FRAME)
    sign = state(15, 20, camera=FISHEYE, **SIGN)
    car = state(15, 20, camera=FISHEYE, x=4.0)
    truck = state(15, 20, camera=FISHEYE, x=-4.0, height=3.8)
    mean = np.concatenate([sign, car, truck])
    assert are_elevated(mean, FRAME, pinhole, pinhole.horizon_px, FISHEYE).tolist() == [True, False, False]


def test_each_row_is_judged_by_itself():
    rows = [state(40, 25, **SIGN), state(40, 25), state(40, 0, **SIGN)]
    assert are_elevated(np.concatenate(rows), FRAME, CAMERA, HORIZON).tolist() == [True, False, False]
    assert are_elevated(np.empty((0, 8)), FRAME, CAMERA, HORIZON).tolist() == []
