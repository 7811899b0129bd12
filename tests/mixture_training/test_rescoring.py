import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.mixture import EdgePyramid, rescoring_inputs
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training import rescoring as training
from vehicle_detection.mixture_training.rescoring import Samples, sample_boxes, train_rescorer
from vehicle_detection.mixture_training.sources import TrainingFrame, load_training_frames
from vehicle_detection.params import MixtureParams


def random_samples(count, seed=0):
    rng = np.random.default_rng(seed)
    inputs = rng.normal(size=(23, count, 12, 12)).astype(np.float32)
    return Samples(inputs, np.arange(count) % 2 == 0, rng.normal(0, 0.1, (count, 4)).astype(np.float32))


def loss(values, batch):
    """Mean logistic loss plus mean smooth error of the vehicles' shifts, in double precision."""
    current = batch.inputs.astype(np.float64)
    for number, (weights, bias) in enumerate(zip(values[::2], values[1::2])):
        if number < 3:
            stride = (1, 2, 1)[number]
            side = (current.shape[2] - 3) // stride + 1
            stop = stride * (side - 1) + 1
            parts = [
                current[:, :, y : y + stop : stride, x : x + stop : stride]
                for y in range(3)
                for x in range(3)
            ]
            count, current = current.shape[1], np.concatenate(parts).reshape(9 * len(current), -1)
        current = weights @ current + bias[:, None]
        if number < 4:
            current = np.maximum(current, 0)
        if number < 3:
            current = current.reshape(-1, count, side, side)
        if number == 2:
            current = current.transpose(0, 2, 3, 1).reshape(-1, count)
    signs = np.where(batch.is_vehicle, 1, -1)
    error = np.abs(current[1:] - batch.shifts.T)
    smooth = np.where(error < 0.05, error**2 / 0.1, error - 0.025)
    return np.log1p(np.exp(-signs * current[0])).mean() + smooth[:, batch.is_vehicle].sum() / sum(signs > 0)


def test_gradients_are_the_derivatives_of_the_loss():
    rng, batch = np.random.default_rng(1), random_samples(6)
    values = [value.astype(np.float64) for value in training._initial_values(rng)]
    found = training._gradients([value.astype(np.float32) for value in values], batch, None)
    for value, gradient in zip(values, found):
        assert gradient.shape == value.shape
        for _ in range(4):
            place = tuple(rng.integers(side) for side in value.shape)
            known = value[place]
            value[place] = known + 1e-5
            higher = loss(values, batch)
            value[place] = known - 1e-5
            slope = (higher - loss(values, batch)) / 2e-5
            value[place] = known
            np.testing.assert_allclose(gradient[place], slope, atol=1e-4)


def test_training_reduces_the_loss_and_repeats_itself(monkeypatch):
    monkeypatch.setattr(training, "_EPOCHS", 2)
    batch = random_samples(96)
    start = training._initial_values(np.random.default_rng(5))
    layers = training.fit_network(batch, np.random.default_rng(5)).layers
    values = [value for layer in layers for value in (layer.weights, layer.bias)]
    assert loss(values, batch) < 0.97 * loss(start, batch)
    repeated = training.fit_network(batch, np.random.default_rng(5))
    for one, two in zip(layers, repeated.layers):
        np.testing.assert_array_equal(one.weights, two.weights)
        np.testing.assert_array_equal(one.bias, two.bias)


def test_a_mirrored_sample_is_that_of_the_mirrored_image():
    image = np.random.default_rng(3).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    boxes = np.array([[16.0, 16.0, 80.0, 80.0]])
    seen, expected = (
        rescoring_inputs(EdgePyramid(np.ascontiguousarray(each)), boxes).transpose(1, 3, 0, 2)
        for each in (image, image[:, ::-1])
    )
    sample = Samples(seen, np.array([True]), np.float32([[0.1, 0.2, 0.3, 0.4]]))
    drawn_samples = [training._draw(sample, np.array([0]), np.random.default_rng(seed)) for seed in range(8)]
    mirrored = [each for each in drawn_samples if each.shifts[0, 0] != np.float32(0.1)]
    assert 0 < len(mirrored) < 8
    for each in mirrored:
        np.testing.assert_allclose(each.inputs, expected, atol=2e-3)
        np.testing.assert_allclose(each.shifts, [[-0.3, 0.2, -0.1, 0.4]], rtol=1e-6)
    np.testing.assert_array_equal(sample.inputs, seen)


def test_varied_samples_show_the_same_edges_in_other_contrast_and_colors():
    batch = random_samples(200)
    known = batch.inputs.copy()
    varied = training._vary(batch, np.random.default_rng(4))
    np.testing.assert_array_equal(batch.inputs, known)
    assert varied.inputs.dtype == np.float32
    # The edges of a crop have one factor, where no edge stays no edge; the lightness is as it was.
    factors = (varied.inputs[:20] + 0.5) / (known[:20] + 0.5)
    contrast = np.median(factors, axis=(0, 2, 3))
    np.testing.assert_allclose(
        varied.inputs[:20] + 0.5, (known[:20] + 0.5) * contrast[:, None, None], atol=1e-4
    )
    assert 0.2 < np.log(contrast).std() < 0.3
    np.testing.assert_array_equal(varied.inputs[20], known[20])
    for channel in (21, 22):
        for seen, before in zip(varied.inputs[channel], known[channel]):
            factor, tint = np.polyfit(before.ravel(), seen.ravel(), 1)
            np.testing.assert_allclose(seen, factor * before + tint, atol=1e-4)
            assert factor > 0
    np.testing.assert_array_equal(varied.shifts, batch.shifts)


def test_folding_is_the_transpose_of_unfolding():
    rng = np.random.default_rng(2)
    for stride in (1, 2):
        values = rng.normal(size=(3, 2, 9, 9)).astype(np.float32)
        unfolded, _ = training._unfold(values, stride)
        other = rng.normal(size=unfolded.shape).astype(np.float32)
        folded = training._fold(other, values.shape, stride)
        np.testing.assert_allclose((unfolded * other).sum(), (values * folded).sum(), rtol=1e-3)


def test_a_trained_rescorer_separates_vehicles_from_clutter(small_mixture):
    rescorer = small_mixture.rescorer
    assert rescorer is not None
    assert rescorer.blend_weight == MixtureParams().blend_weight
    search, rng = small_mixture.open_search(n_jobs=1), np.random.default_rng(0)
    right, wrong = [], []
    for frame in load_training_frames([FrameDataset("others", (drawn(range(12, 18)),))]):
        vehicles, clutter = sample_boxes(frame.image, frame, search, SMALL_MIXTURE, rng)
        for boxes, values in (vehicles, right), (clutter, wrong):
            inputs = rescoring_inputs(EdgePyramid(frame.image), boxes)
            values += rescorer.predict(inputs, np.zeros(len(boxes)))[0].tolist()
    right, wrong = np.array(right), np.array(wrong)
    assert (right > 0).mean() > 0.8
    assert (wrong < 0).mean() > 0.8


def test_boxes_to_train_on_agree_with_the_labels(drawn_source, small_mixture):
    search = small_mixture.open_search(n_jobs=1)
    for frame in load_training_frames([drawn_source])[:4]:
        right, wrong = sample_boxes(frame.image, frame, search, SMALL_MIXTURE, np.random.default_rng(1))
        assert (iou_matrix(right, frame.boxes).max(axis=1, initial=0) >= 0.5).all()
        assert (iou_matrix(wrong, frame.boxes).max(axis=1, initial=0) < 0.45).all()


def test_a_weight_of_zero_trains_no_rescorer(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, blend_weight=0.0, mining_schedule=(0.5,))
    assert train_mixture([drawn_source], params, n_jobs=1).rescorer is None


def test_frames_without_vehicles_train_no_rescorer(small_mixture):
    search = small_mixture.open_search(n_jobs=1)
    empty = TrainingFrame(np.full((200, 356, 3), 90, np.uint8), np.empty((0, 4)), np.empty((0, 4)), 0.0)
    with ThreadPoolExecutor(1) as pool:
        assert train_rescorer([empty], search, SMALL_MIXTURE, np.random.default_rng(0), pool) is None
