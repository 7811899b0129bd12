from unittest import mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vehicle_detection._common import Workspace
from vehicle_detection._kernels import Convolution, ConvolutionalNetwork, network


def random_layers(rng, channels, side, shapes):
    """Layers of as many outputs, sides and strides, and a last one for all cells that they leave."""
    layers = []
    for outputs, kernel, stride in shapes:
        kernel = min(kernel, side)
        layers.append((outputs, kernel, channels, stride))
        channels, side = outputs, (side - kernel) // stride + 1
    layers.append((5, side, channels, 1))
    return [
        Convolution(
            rng.normal(0, 0.3, (outputs, kernel, kernel, depth)).astype(np.float32),
            rng.normal(size=outputs).astype(np.float32),
            stride,
        )
        for outputs, kernel, depth, stride in layers
    ]


def reference(layers, image):
    """Outputs for one image ``(channels, rows, columns)``, cell by cell in double precision."""
    values = image.astype(np.float64)
    for number, (weights, bias, stride) in enumerate(layers):
        kernel = weights.shape[1]
        side = (values.shape[1] - kernel) // stride + 1
        found = np.empty((len(bias), side, side))
        for y, x in np.ndindex(side, side):
            part = values[:, y * stride : y * stride + kernel, x * stride : x * stride + kernel]
            found[:, y, x] = np.einsum("oijc,cij->o", weights, part) + bias
        values = np.maximum(found, 0) if number + 1 < len(layers) else found
    return values[:, 0, 0]


@pytest.mark.parametrize("plain", [False, True])
@settings(max_examples=40, deadline=None)
@given(
    shapes=st.lists(st.tuples(st.integers(1, 9), st.integers(1, 4), st.integers(1, 3)), max_size=3),
    channels=st.integers(1, 6),
    side=st.integers(1, 11),
    count=st.integers(0, 20),
    seed=st.integers(0, 99),
)
@example(shapes=[(3, 3, 3)], channels=2, side=4, count=6, seed=0)
@example(shapes=[(4, 3, 1), (3, 2, 3)], channels=2, side=9, count=20, seed=0)
@example(shapes=[(2, 1, 2)], channels=1, side=5, count=3, seed=0)
def test_the_outputs_equal_the_reference(plain, shapes, channels, side, count, seed):
    rng = np.random.default_rng(seed)
    layers = random_layers(rng, channels, side, shapes)
    images = rng.normal(size=(channels, count, side, side)).astype(np.float32)
    values = images.transpose(2, 0, 3, 1)
    workspace = Workspace()
    with mock.patch.object(network, "_compiles", return_value=not plain):
        outputs = ConvolutionalNetwork(layers)(values)
        ConvolutionalNetwork(layers)(1 - values, workspace)
        repeated = ConvolutionalNetwork(layers)(values, workspace)
    expected = [reference(layers, images[:, number]) for number in range(count)]
    assert outputs.shape == (5, count)
    np.testing.assert_allclose(outputs.T, np.reshape(expected, (-1, 5)), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(repeated, outputs)


def test_the_kernel_is_used_here():
    assert network._compiles()


def test_a_kernel_that_does_not_compile_is_replaced(caplog):
    broken = mock.Mock()
    broken.compile.side_effect = RuntimeError("no such intrinsic")
    network._compiles.cache_clear()
    layer = Convolution(np.ones((1, 2, 2, 1), np.float32), np.float32([1]), 1)
    try:
        with mock.patch.object(network, "_run_layers", broken):
            outputs = ConvolutionalNetwork([layer])(np.ones((2, 1, 2, 3), np.float32))
    finally:
        network._compiles.cache_clear()
    np.testing.assert_array_equal(outputs, [[5, 5, 5]])
    assert [record.getMessage() for record in caplog.records] == [
        "products are computed without vector instructions, which is slower: no such intrinsic"
    ]
