import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import random_mixture
from vehicle_detection.mixture import EdgePyramid
from vehicle_detection.mixture.boxes import ScoredWindows
from vehicle_detection.mixture.perspective import perspective_ratios

HEIGHT = 400


def standing(bottom, horizon, ratio=1.2, left=50.0):
    """Box of a vehicle `ratio` times as high as the camera, with its lower edge at `bottom`."""
    height = ratio * (bottom - horizon)
    return [left, bottom - height, left + 1.4 * height, bottom]


@pytest.mark.parametrize("horizon", [120, 180, 240])
def test_boxes_on_one_road_support_each_other_under_any_horizon(horizon):
    road = [standing(horizon + distance, horizon) for distance in (25, 60, 100)]
    clutter = [10.0, horizon - 60, 60.0, horizon - 10]
    alone = perspective_ratios(np.array([clutter]), np.zeros(1), HEIGHT)
    ratios = perspective_ratios(np.array([*road, clutter]), np.array([2.0, 2.0, 2.0, -0.5]), HEIGHT)
    assert ratios[:3].min() > 0
    assert ratios[:3].mean() > 0.5
    assert ratios[3] == -2
    assert ratios[3] <= alone[0]


def test_confident_boxes_decide_on_the_horizon():
    horizon = 150
    road = [standing(bottom, horizon) for bottom in (190, 230, 280)]
    too_small = standing(300, horizon, ratio=0.15)
    boxes = np.array([*road, too_small])
    trusted, doubted = (
        perspective_ratios(boxes, np.array([margin] * 3 + [-0.5]), HEIGHT)[3] for margin in (1.5, -2.5)
    )
    assert trusted == -2
    assert trusted <= doubted


def test_a_horizon_near_the_middle_is_likely_before_other_vehicles_are_seen():
    usual, low = (
        perspective_ratios(np.array([standing(300, horizon)]), np.zeros(1), HEIGHT)[0]
        for horizon in (180, 275)
    )
    assert low < 0 < usual


def test_a_box_at_the_lower_border_is_not_too_high():
    box = [100.0, 60.0, 390.0, 399.0]
    others = [standing(bottom, 330) for bottom in (345, 360, 390)]
    inside = [*others, [100.0, 50.0, 390.0, 389.0]]
    margins = np.array([1.0, 1.0, 1.0, 0.0])
    assert perspective_ratios(np.array([*others, box]), margins, HEIGHT)[3] == 0
    assert perspective_ratios(np.array(inside), margins, HEIGHT)[3] < 0


@given(seed=st.integers(0, 1000), count=st.integers(0, 12), scale=st.sampled_from([0.5, 2.0, 3.7]))
@settings(max_examples=40)
def test_ratios_are_bounded_and_depend_on_neither_scale_nor_order(seed, count, scale):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 380, (count, 2))
    boxes = np.hstack([corners, corners + rng.uniform(10, 200, (count, 2))])
    margins = rng.uniform(-2, 3, count)
    ratios = perspective_ratios(boxes, margins, HEIGHT)
    assert ratios.shape == (count,)
    assert (np.abs(ratios) <= 2).all()
    np.testing.assert_allclose(perspective_ratios(scale * boxes, margins, scale * HEIGHT), ratios, atol=1e-9)
    order = rng.permutation(count)
    np.testing.assert_allclose(perspective_ratios(boxes[order], margins[order], HEIGHT), ratios[order])


def test_a_mixture_adds_weighted_ratios_and_sorts_again():
    model, pyramid = random_mixture(), EdgePyramid(np.full((HEIGHT, 600, 3), 90, np.uint8))
    road = [
        standing(200 + distance, 160, left=120.0 * number) for number, distance in enumerate((20, 60, 110))
    ]
    boxes = np.array([[450.0, 20, 500, 60], *road])
    margins = np.array([0.5, 0.45, 0.4, 0.35])
    windows = ScoredWindows(boxes, margins, np.zeros(4, np.intp))
    weighted = dataclasses.replace(model, perspective_weight=0.2)
    found = weighted.detect_vehicles(pyramid, windows, min_margin=-2.0)
    assert found.boxes[-1].tolist() == boxes[0].tolist()
    assert (np.diff(found.margins) <= 0).all()
    order = [boxes.tolist().index(box) for box in found.boxes.tolist()]
    expected = 0.2 * perspective_ratios(boxes, margins, HEIGHT)
    np.testing.assert_allclose(found.perspective, expected[order])
    np.testing.assert_allclose(found.margins, (margins + expected)[order])
