import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import mixture_template
from vehicle_detection._common import ThreadTeam
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import (
    EdgePyramid,
    Layer,
    MixtureSearch,
    Network,
    Rescorer,
    TemplateMixture,
    load_model,
    rescoring_inputs,
)
from vehicle_detection.mixture.boxes import nms
from vehicle_detection.mixture.rescoring import LAYERS, RESCORE_AGAIN_MIN, RESCORE_MIN
from vehicle_detection.params import PyramidParams

BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])
# Outputs and inputs of each layer.
SHAPES = [(4, 9 * 23), (6, 9 * 4), (5, 9 * 6), (7, 4 * 5), (5, 7)]


def random_network(seed=0):
    rng = np.random.default_rng(seed)
    return Network(tuple(Layer(rng.normal(0, 0.2, shape), rng.normal(0, 0.2, shape[0])) for shape in SHAPES))


def random_rescorer(seed=0, blend_weight=0.4):
    return Rescorer(tuple(random_network(seed + number) for number in range(3)), blend_weight)


def one_template_mixture(**options):
    return TemplateMixture((mixture_template(seed=1),), **options)


def noise(seed, shape=(120, 160, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def network_reference(network, crop):
    """Outputs for one crop ``(23, 12, 12)``, cell by cell in double precision."""
    values = crop.astype(np.float64)
    for layer, stride in zip(network.layers[:3], (1, 2, 1)):
        side = (values.shape[1] - 3) // stride + 1
        found = np.zeros((len(layer.bias), side, side))
        weights = layer.weights.reshape(-1, 3, 3, len(values))
        for y, x in np.ndindex(side, side):
            part = values[:, y * stride : y * stride + 3, x * stride : x * stride + 3]
            found[:, y, x] = np.einsum("oijc,cij->o", weights, part) + layer.bias
        values = np.maximum(found, 0)
    hidden = np.maximum(network.layers[3].weights @ values.ravel() + network.layers[3].bias, 0)
    return network.layers[4].weights @ hidden + network.layers[4].bias


@given(seed=st.integers(0, 1000), count=st.integers(0, 5))
@settings(max_examples=25)
def test_the_networks_equal_the_reference(seed, count):
    rescorer = random_rescorer(seed)
    inputs = np.random.default_rng(seed).normal(0, 1, (12, 23, 12, count)).astype(np.float32)
    margins = np.random.default_rng(seed).uniform(-2, 1, count)
    log_odds, shifts = rescorer.predict(inputs, margins)
    for row in range(count):
        outputs = [network_reference(net, inputs[..., row].swapaxes(0, 1)) for net in rescorer.networks]
        # Only boxes that the first network leaves with a margin are shown to the others.
        after_first = margins[row] + 0.4 * outputs[0][0].clip(-6, 6)
        expected = np.mean(outputs, axis=0) if after_first >= -1 else outputs[0]
        np.testing.assert_allclose(log_odds[row], expected[0], atol=1e-4)
        np.testing.assert_allclose(shifts[row], expected[1:].clip(-0.4, 0.4), atol=1e-4)


def test_the_outputs_of_a_crop_do_not_depend_on_the_others():
    rescorer, rng = random_rescorer(), np.random.default_rng(3)
    inputs, margins = rng.normal(0, 1, (12, 23, 12, 40)).astype(np.float32), rng.uniform(-2, 1, 40)
    log_odds, shifts = rescorer.predict(inputs, margins)
    for rows in (slice(7, 8), slice(3, 30)):
        part = rescorer.predict(np.ascontiguousarray(inputs[..., rows]), margins[rows])
        np.testing.assert_array_equal(part[0], log_odds[rows])
        np.testing.assert_array_equal(part[1], shifts[rows])


@pytest.mark.parametrize("count", [1, 15, 16, 60])
def test_rescoring_does_not_depend_on_the_threads(count):
    rescorer, image, rng = random_rescorer(), noise(1), np.random.default_rng(5)
    corners = rng.uniform(-10, 100, (count, 2))
    boxes = np.hstack([corners, corners + rng.uniform(10, 60, (count, 2))])
    margins = rng.uniform(-1, 1, count)
    alone = rescorer.apply(EdgePyramid(image), boxes, margins)
    for n_threads in (2, 3):
        with contextlib.closing(ThreadTeam(n_threads, name="networks")) as team:
            found = rescorer.apply(EdgePyramid(image, team=team), boxes, margins)
        for one, other in zip(found, alone):
            np.testing.assert_array_equal(one, other)


def test_the_number_of_weights():
    per_network = sum(outputs * (inputs + 1) for outputs, inputs in SHAPES)
    assert random_rescorer().n_weights == 3 * per_network


def test_rescoring_adds_log_odds_and_corrects_boxes():
    rescorer, pyramid = random_rescorer(), EdgePyramid(noise(1))
    margins = np.array([0.5, -0.2, 1.0])
    log_odds, shifts = rescorer.predict(rescoring_inputs(pyramid, BOXES), margins)
    boxes, found = rescorer.apply(pyramid, BOXES, margins)
    np.testing.assert_allclose(found, margins + 0.4 * log_odds.clip(-6, 6))
    expected = BOXES + shifts * np.tile(BOXES[:, 2:] - BOXES[:, :2], 2)
    np.testing.assert_allclose(boxes, clip_boxes(expected, (120, 160)))
    boxes, found = rescorer.apply(pyramid, BOXES[:0], margins[:0])
    assert boxes.shape == (0, 4)
    assert found.shape == (0,)


def test_the_second_stage_rescores_twice_with_suppression_after_each():
    image = noise(2, (200, 300, 3))
    model = one_template_mixture(rescorer=random_rescorer(4))
    search = MixtureSearch(model, n_jobs=1)
    pyramid, windows = search.score_windows(image, PyramidParams(min_width=24, horizon=None))
    proposals, margins = model.propose_boxes(pyramid, windows, min_margin=RESCORE_MIN)
    found = model.rescore_boxes(pyramid, proposals, margins)
    vehicles = model.detect_vehicles(pyramid, windows, min_margin=-9.0)
    np.testing.assert_array_equal(vehicles[0], found[0])
    np.testing.assert_array_equal(vehicles[1], found[1])
    middle = float(np.median(found[1]))
    fewer = model.detect_vehicles(pyramid, windows, min_margin=middle)[1]
    np.testing.assert_array_equal(fewer, found[1][found[1] >= middle])
    # With lower margins, some boxes are not rescored again.
    margins = margins + RESCORE_AGAIN_MIN - np.median(margins)
    boxes, final = model.rescorer.apply(pyramid, proposals, margins)
    left = nms(boxes, final)
    boxes, final = boxes[left], final[left]
    again = np.flatnonzero(final >= RESCORE_AGAIN_MIN)
    assert 0 < len(again) < len(left) < len(proposals)
    for row in again:
        box, margin = model.rescorer.apply(pyramid, boxes[[row]], margins[left[[row]]])
        boxes[row], final[row] = box[0], (final[row] + margin[0]) / 2
    kept = nms(boxes, final)
    found = model.rescore_boxes(pyramid, proposals, margins)
    np.testing.assert_allclose(found[0], boxes[kept])
    np.testing.assert_allclose(found[1], final[kept])
    np.testing.assert_array_equal(found[2], left[kept])


def test_without_a_rescorer_boxes_are_only_suppressed():
    boxes = np.array([[10.0, 10, 50, 50], [12, 10, 52, 50], [100, 10, 140, 50]])
    found = one_template_mixture().rescore_boxes(EdgePyramid(noise(1)), boxes, np.array([0.1, 0.3, 0.2]))
    np.testing.assert_array_equal(found[2], [1, 2])
    np.testing.assert_array_equal(found[0], boxes[[1, 2]])
    np.testing.assert_array_equal(found[1], [0.3, 0.2])


@pytest.mark.parametrize(
    ("number", "weights", "bias", "message"),
    [
        (0, np.zeros((4, 9)), np.zeros(4), r"rescorer.convolution 1 must be .* shape \(4, 207\)"),
        (1, np.zeros((6, 35)), np.zeros(6), r"rescorer.convolution 2 must be .* shape \(6, 36\)"),
        (2, np.full((5, 54), np.nan), np.zeros(5), r"rescorer.convolution 3 must be finite numbers"),
        (3, np.zeros((7, 20)), np.zeros((7, 1)), r"rescorer.hidden bias must be .* shape \(7\)"),
        (4, np.zeros((4, 7)), np.zeros(4), r"rescorer.output must have 5 outputs, got 4; train again"),
        (4, "many", np.zeros(5), "rescorer.output must be finite numbers"),
    ],
)
def test_invalid_layers_are_rejected(number, weights, bias, message):
    layers = list(random_network().layers)
    layers[number] = Layer(weights, bias)
    with pytest.raises(InvalidInputError, match=message):
        Network(tuple(layers))


def test_invalid_rescorers_are_rejected():
    with pytest.raises(InvalidInputError, match="layers must be 5, got 1; train again"):
        Network(random_network().layers[:1])
    with pytest.raises(InvalidInputError, match="networks must hold at least one network, got none"):
        Rescorer((), 0.4)
    with pytest.raises(InvalidInputError, match=r"rescorer\.blend_weight must be a number"):
        random_rescorer(blend_weight=1.5)


def test_a_mixture_takes_a_rescorer_or_none():
    with pytest.raises(InvalidInputError, match="rescorer must be a Rescorer"):
        one_template_mixture(rescorer="yes")


def test_a_model_file_preserves_the_rescorer(tmp_path):
    model = one_template_mixture(rescorer=random_rescorer(), slope=2.0)
    model.save(tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    assert loaded.rescorer.blend_weight == model.rescorer.blend_weight
    pyramid = EdgePyramid(noise(5))
    for found, expected in zip(
        loaded.rescorer.apply(pyramid, BOXES, np.zeros(3)), model.rescorer.apply(pyramid, BOXES, np.zeros(3))
    ):
        np.testing.assert_array_equal(found, expected)
    one_template_mixture().save(tmp_path / "plain.safetensors")
    assert load_model(tmp_path / "plain.safetensors").rescorer is None


def test_a_file_with_an_incomplete_rescorer_is_rejected(tmp_path, monkeypatch):
    model = one_template_mixture(rescorer=random_rescorer())
    tensors = model.rescorer.tensors()
    tensors.pop(f"rescorer.2.{LAYERS[3]}.bias")
    monkeypatch.setattr(Rescorer, "tensors", lambda self: tensors)
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(
        ModelFileError, match=r"model.safetensors does not fit its own parameters.*hidden.bias"
    ):
        load_model(tmp_path / "model.safetensors")
