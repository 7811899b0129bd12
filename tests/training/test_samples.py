import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.training.frames import TrainingFrame
from vehicle_detection.training.samples import Sampler, move_boxes

SIZE = 160, 96  # width, height


def frame(boxes=((30, 30, 90, 70),), ignored=(), shape=(120, 200), source="road"):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    arrays = (np.array(each, np.float64).reshape(-1, 4) for each in (boxes, ignored))
    return TrainingFrame(image, *arrays, source)


@given(st.integers(0, 10_000))
def test_boxes_lie_inside_the_sample_and_have_a_size(seed):
    sampler = Sampler([frame(ignored=[(100, 10, 190, 60)])], SIZE)
    sample = sampler.draw(np.random.default_rng(seed))
    assert sample.image.shape == (SIZE[1], SIZE[0], 3)
    assert sample.image.dtype == np.uint8
    for boxes in sample.boxes, sample.ignored:
        assert (boxes >= 0).all()
        assert (boxes <= [*SIZE, *SIZE]).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all()


def test_a_sample_depends_on_the_seed_alone():
    sampler = Sampler([frame(), frame(boxes=())], SIZE)
    one, again, other = (sampler.draw(np.random.default_rng(seed)) for seed in (5, 5, 6))
    for a, b in zip(one, again):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.image, other.image)


@given(
    st.tuples(st.floats(0.2, 3), st.floats(0.2, 3), st.floats(-50, 50), st.floats(-50, 50), st.booleans()),
    st.lists(st.tuples(*[st.floats(0, 80)] * 2, *[st.floats(1, 40)] * 2), min_size=1, max_size=4),
)
def test_moving_boxes_there_and_back(view, sides):
    """Without rotation, the inverse matrix restores boxes that stay inside."""
    sx, sy, tx, ty, mirror = view
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in sides])
    matrix = np.array([[-sx if mirror else sx, 0, tx + 500], [0, sy, ty + 200]])
    moved, visible = move_boxes(boxes, matrix, (2000, 2000))
    np.testing.assert_allclose(visible, 1)
    linear = np.linalg.inv(matrix[:, :2])
    inverse = np.column_stack([linear, -linear @ matrix[:, 2]])
    back, _ = move_boxes(moved, inverse, (2000, 2000))
    np.testing.assert_allclose(back, boxes, atol=1e-6)


def test_a_source_counts_with_the_square_root_of_its_size():
    many = [dataclasses.replace(frame(), source="many") for _ in range(16)]
    weights = Sampler([*many, frame()], SIZE).weights
    assert weights[:16].sum() == pytest.approx(4 * weights[16])
