import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.training import samples
from vehicle_detection.training.frames import TrainingFrame
from vehicle_detection.training.samples import Sampler, move_boxes

SIZE = 160, 96  # width, height


def frame(boxes=((30, 30, 90, 70),), ignored=(), shape=(120, 200), source="road"):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    arrays = (np.array(each, np.float64).reshape(-1, 4) for each in (boxes, ignored))
    return TrainingFrame(image, *arrays, source)


def sampler(*frames):
    return Sampler(frames, SIZE, torch.device("cpu"))


@given(st.integers(0, 10_000))
def test_boxes_lie_inside_the_sample_and_have_a_size(seed):
    images, targets = sampler(frame(ignored=[(100, 10, 190, 60)])).draw(np.random.default_rng(seed), 3)
    assert images.shape == (3, SIZE[1], SIZE[0], 3)
    assert images.dtype == torch.uint8
    for boxes in targets.boxes[targets.usable], targets.ignored:
        boxes = boxes.numpy()[(boxes != 0).any(-1).numpy()]
        assert (boxes >= 0).all()
        assert (boxes <= [*SIZE, *SIZE]).all()
        assert (boxes[..., 2:] > boxes[..., :2]).all()


def test_samples_depend_on_the_seed_alone():
    draw = sampler(frame(), frame(boxes=())).draw
    (one, boxes), (again, same), (other, _) = (draw(np.random.default_rng(seed), 4) for seed in (5, 5, 6))
    for a, b in zip((one, *boxes), (again, *same)):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one, other)


def test_boxes_move_with_the_pixels(monkeypatch):
    """Vehicles that are brighter than all else stay so inside their boxes, and nowhere else."""
    image = np.full((120, 200, 3), 40, np.uint8)
    image[30:70, 30:90] = 240
    dark = dataclasses.replace(frame(), image=image)
    monkeypatch.setattr(Sampler, "_change_light", lambda self, image, rng: image)
    monkeypatch.setattr(samples, "_random_covers", lambda boxes, *_: np.zeros((len(boxes), 3, 4)))
    images, targets = sampler(dark).draw(np.random.default_rng(0), 40)
    shown = 0
    for pixels, boxes, ignored in zip(images.numpy()[..., 0], targets.boxes.numpy(), targets.ignored.numpy()):
        inside, near = np.zeros_like(pixels, bool), np.zeros_like(pixels, bool)
        for x1, y1, x2, y2 in np.rint(np.concatenate([boxes, ignored])).astype(int):
            inside[y1 + 4 : y2 - 4, x1 + 4 : x2 - 4] = True
            near[max(y1 - 4, 0) : y2 + 4, max(x1 - 4, 0) : x2 + 4] = True
        assert not (pixels[~near] > 140).any()
        shown += int((pixels[inside] > 140).sum())
    assert shown > 40 * 500


@given(
    st.tuples(st.floats(0.2, 3), st.floats(0.2, 3), st.floats(-50, 50), st.floats(-50, 50), st.booleans()),
    st.lists(st.tuples(*[st.floats(0, 80)] * 2, *[st.floats(1, 40)] * 2), min_size=1, max_size=4),
)
def test_moving_boxes_there_and_back(view, sides):
    """Without rotation, the inverse matrix restores boxes that stay inside."""
    sx, sy, tx, ty, mirror = view
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in sides])
    matrix = np.array([[-sx if mirror else sx, 0, tx + 500], [0, sy, ty + 200]])
    moved, visible = move_boxes(boxes[None], matrix[None], (2000, 2000))
    np.testing.assert_allclose(visible, 1)
    linear = np.linalg.inv(matrix[:, :2])
    inverse = np.column_stack([linear, -linear @ matrix[:, 2]])
    back, _ = move_boxes(moved, inverse[None], (2000, 2000))
    np.testing.assert_allclose(back[0], boxes, atol=1e-6)


def test_a_source_counts_with_the_square_root_of_its_size():
    many = [dataclasses.replace(frame(), source="many") for _ in range(16)]
    weights = sampler(*many, frame()).weights
    assert weights[:16].sum() == pytest.approx(4 * weights[16])
