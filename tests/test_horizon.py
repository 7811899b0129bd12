"""The horizon, from the boxes of vehicles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import SHAPE, boxes_on_a_road
from vehicle_detection.camera import estimate_horizon
from vehicle_detection.errors import InvalidInputError


@given(st.floats(0.35, 0.6), st.floats(0.9, 2.0), st.integers(0, 1000))
def test_a_flat_road_tells_its_horizon(horizon, camera_height, seed):
    found = estimate_horizon(boxes_on_a_road(horizon, camera_height, seed=seed), SHAPE)
    assert found.horizon == pytest.approx(horizon, abs=1e-6)
    assert found.camera_height_m == pytest.approx(camera_height, rel=1e-6)
    assert found.error < 1e-6


def test_the_error_is_about_the_true_one_and_shrinks_with_more_boxes():
    few, many = (
        [estimate_horizon(boxes_on_a_road(0.5, 1.3, count, seed, 0.08), SHAPE) for seed in range(12)]
        for count in (20, 200)
    )
    for found in (few, many):
        spread = np.sqrt(np.mean([(each.horizon - 0.5) ** 2 for each in found]))
        assert spread < 2.5 * np.mean([each.error for each in found])
    assert np.mean([each.error for each in many]) < 0.6 * np.mean([each.error for each in few])


def test_false_boxes_do_little_harm():
    boxes = boxes_on_a_road(0.5, 1.3, 60)
    boxes[::6, 1::2] -= 150
    assert estimate_horizon(boxes, SHAPE).horizon == pytest.approx(0.5, abs=0.03)


def test_boxes_that_the_frame_cuts_are_left_out():
    boxes = boxes_on_a_road(0.5, 1.3, 20)
    cut = np.tile([[0.0, 300.0, 400.0, 720.0]], (30, 1))
    found = estimate_horizon(np.concatenate([boxes, cut]), SHAPE)
    assert (found.boxes, round(found.horizon, 6)) == (20, 0.5)


def test_the_same_boxes_give_the_same_estimate():
    boxes = boxes_on_a_road(0.5, 1.3, 400, noise=0.1)
    assert estimate_horizon(boxes, SHAPE) == estimate_horizon(boxes, SHAPE)


def test_too_little_is_refused():
    with pytest.raises(InvalidInputError, match=r"^boxes must hold 12 vehicles .* got 5; take more frames"):
        estimate_horizon(boxes_on_a_road(0.5, 1.3, 5), SHAPE)
    alike = np.tile([[600.0, 400.0, 660.0, 450.0]], (20, 1))
    with pytest.raises(InvalidInputError, match=r"^boxes must differ in width, got 60 to 60 pixels"):
        estimate_horizon(alike, SHAPE)
