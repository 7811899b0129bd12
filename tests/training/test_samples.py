import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")

from vehicle_detection.training import samples  # noqa: E402
from vehicle_detection.training.frames import TrainingFrame  # noqa: E402
from vehicle_detection.training.samples import Sampler, move_boxes  # noqa: E402

SIZE = 160, 96  # width, height


def frame(boxes=((30, 30, 90, 70),), ignored=(), shape=(120, 200), source="road"):
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    arrays = (np.array(each, np.float64).reshape(-1, 4) for each in (boxes, ignored))
    return TrainingFrame(image, *arrays, source)


def sampler(*frames):
    return Sampler(frames, SIZE, torch.device("cpu"))


@settings(max_examples=10)
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


@pytest.mark.parametrize("shape", [(33, 33), (1, 200), (200, 1), (1, 1)])
def test_tiny_frames_are_enlarged(shape):
    tiny = frame(boxes=[(0, 0, shape[1], shape[0])], shape=shape)
    images, _ = sampler(tiny, frame(boxes=())).draw(np.random.default_rng(0), 8)
    assert images.shape == (8, SIZE[1], SIZE[0], 3)


@pytest.mark.parametrize("boxes", [[], [(-20, -20, 30, 30), (190, 110, 230, 140), (50, 20, 50, 60)]])
@pytest.mark.parametrize("ignored", [[], [(100, 10, 190, 60)]])
def test_frames_without_a_vehicle_that_counts(boxes, ignored):
    _, targets = sampler(frame(boxes, ignored)).draw(np.random.default_rng(0), 4)
    for each in targets:
        assert each.isfinite().all()
    assert bool(boxes) or not targets.usable.any()
    assert bool(boxes) or bool(ignored) == bool(targets.ignored.any())


def test_the_layout_of_the_pixels_in_memory_does_not_matter():
    plain = frame()
    reversed_twice = np.ascontiguousarray(plain.image[..., ::-1])[..., ::-1]
    fixed = plain.image.copy()
    fixed.flags.writeable = False
    expected, _ = sampler(plain).draw(np.random.default_rng(0), 3)
    for image in reversed_twice, np.asfortranarray(plain.image), fixed:
        images, _ = sampler(dataclasses.replace(plain, image=image)).draw(np.random.default_rng(0), 3)
        np.testing.assert_array_equal(images, expected)


@pytest.mark.parametrize("change", [Sampler._blur, Sampler._reduce])
def test_blurred_and_reduced_images_keep_their_borders_and_do_not_move(change):
    ramp = torch.linspace(0, 255, 256).expand(2, 3, 96, 256)
    for seed in range(20):
        changed = change(sampler(frame()), ramp.contiguous(), np.random.default_rng(seed))
        inner = slice(8, -8)
        assert (changed - ramp)[..., inner].abs().max() < 0.2
        assert (changed - ramp).abs().max() < 2.5


def test_a_sample_is_not_mixed_with_itself():
    draw = sampler(frame()).draw
    assert max(int(draw(np.random.default_rng(seed), 1)[1].usable.sum()) for seed in range(15)) == 1


@pytest.mark.parametrize(
    ("shift", "cover", "part", "kept", "ignored"),
    [
        (0, (0.0, 0.4), (0.0, 0.0), [0, 100], None),
        (0, (0.0, 0.4), (0.6, 1.0), [60, 100], [0, 100]),  # of 100 px, two rectangles hide 80
        (-50, (0.0, 0.0), (0.5, 1.0), [0, 50], [25, 50]),  # half is in view, and half of that in the part
    ],
)
def test_vehicles_that_are_hidden_twice_are_judged_by_what_remains(
    monkeypatch, shift, cover, part, kept, ignored
):
    def rectangles(boxes, of):
        x1, y1, x2, y2 = np.moveaxis(boxes[:, 0], -1, 0)
        sides = [x1 + of[0] * (x2 - x1), y1, x1 + of[1] * (x2 - x1), y2]
        return np.stack(sides, -1) * (of[1] > of[0])

    view = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
    monkeypatch.setattr(Sampler, "_random_views", lambda self, rows, rng: np.tile(view, (len(rows), 1, 1)))
    covers = lambda boxes, *_: rectangles(boxes, cover)[:, None] * np.array([1, 0, 0])[:, None]  # noqa: E731
    monkeypatch.setattr(samples, "_random_covers", covers)
    monkeypatch.setattr(samples, "_random_parts", lambda boxes, *_: rectangles(boxes, part))
    _, targets = sampler(frame(boxes=[(0, 20, 100, 60)])).draw(np.random.default_rng(0), 2)
    assert targets.boxes[targets.usable][:, ::2].tolist() == [kept] * 2
    assert targets.ignored.any() == (ignored is not None)
    if ignored is not None:
        assert targets.ignored[..., ::2].tolist() == [[ignored]] * 2


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
