from unittest import mock

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._kernels import Filter, correlation
from vehicle_detection._kernels.vector import Block, block_adder, float_block

KERNELS = {"blocks": correlation._correlate_blocks, "plain": correlation._correlate_plain}


def reference(weights, channels, dilation=1):
    """Sum the products window by window, in double precision."""
    rows, columns, _ = weights.shape
    height = channels.shape[1] - (rows - 1) * dilation
    width = channels.shape[2] - (columns - 1) * dilation
    scores = np.zeros((height, width))
    for i, j in np.ndindex(rows, columns):
        top, left = i * dilation, j * dilation
        part = channels[:, top : top + height, left : left + width]
        scores += np.tensordot(weights[i, j].astype(np.float64), part, axes=1)
    return scores


def random_inputs(rows, columns, depth, height, width, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(rows, columns, depth))
    return weights, rng.normal(size=(depth, height, width)).astype(np.float32)


@pytest.mark.parametrize("kernel", KERNELS)
@settings(max_examples=60)
@given(
    rows=st.integers(1, 10),
    columns=st.integers(1, 10),
    depth=st.integers(1, 30),
    dilation=st.integers(1, 2),
    more=st.tuples(st.integers(0, 5), st.integers(0, 120)),
    seed=st.integers(0, 99),
)
def test_scores_equal_the_sums_of_products(kernel, rows, columns, depth, dilation, more, seed):
    height, width = (rows - 1) * dilation + 1 + more[0], (columns - 1) * dilation + 1 + more[1]
    weights, channels = random_inputs(rows, columns, depth, height, width, seed)
    expected = reference(weights, channels, dilation)
    scores = np.zeros(expected.shape, np.float32)
    with mock.patch.object(correlation, "_kernel", return_value=KERNELS[kernel]):
        Filter(weights, dilation=dilation).add_to(channels, scores)
    np.testing.assert_allclose(scores, expected, rtol=1e-4, atol=1e-4)


def test_a_block_kernel_that_does_not_compile_is_replaced(caplog):
    weights, channels = random_inputs(3, 2, 4, 6, 70)
    scores = np.zeros((4, 69), np.float32)
    broken = mock.Mock()
    broken.compile.side_effect = numba.core.errors.LoweringError("no such intrinsic")
    correlation._kernel.cache_clear()
    try:
        with mock.patch.object(correlation, "_correlate_blocks", broken):
            Filter(weights).add_to(channels, scores)
            Filter(weights).add_to(channels, scores)
    finally:
        correlation._kernel.cache_clear()
    np.testing.assert_allclose(scores, 2 * reference(weights, channels), rtol=1e-4, atol=1e-4)
    broken.assert_not_called()
    assert [record.getMessage() for record in caplog.records] == [
        "products are computed without vector instructions, which is slower: no such intrinsic"
    ]


def test_products_are_added_to_the_scores_of_the_first_windows():
    weights, channels = random_inputs(3, 3, 5, 9, 50)
    scores = np.full((4, 20), 7, np.float32)
    Filter(weights).add_to(channels, scores)
    np.testing.assert_allclose(scores, reference(weights, channels)[:4, :20] + 7, rtol=1e-4, atol=1e-4)
    assert correlation._kernel() is correlation._correlate_blocks


@pytest.mark.parametrize("depth", [1, 7])
@pytest.mark.parametrize("block", [Block(16, 3, 8), Block(8, 2, 4), Block(4, 3, 8), Block(4, 3, 4)])
def test_blocks_of_every_processor_add_the_same_products(block, depth):
    add_products = block_adder(block)

    @numba.njit
    def run(weights, cells, sums):
        add_products(weights, 1, 4, cells, 2, 100, 3, sums, 5 + 60 * block.rows, 60)

    rng = np.random.default_rng(4)
    weights = rng.normal(size=(5, depth, block.rows)).astype(np.float32)
    cells = rng.normal(size=2 + 100 * depth).astype(np.float32)
    sums = rng.normal(size=5 + 60 * (block.rows + 1)).astype(np.float32)
    expected = sums.astype(np.float64)
    for row in range(block.rows):
        start = 5 + 60 * (block.rows - row)
        for number, channel in np.ndindex(3, depth):
            first = 2 + 3 * number + 100 * channel
            values = cells[first : first + block.columns].astype(np.float64)
            expected[start : start + block.columns] += weights[1 + number, channel, row] * values
    run(weights, cells, sums)
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("features", "block"),
    [
        ({"avx512f": True, "avx": True}, Block(16, 3, 8)),
        ({"avx": True, "avx2": True}, Block(8, 2, 4)),
        ({"neon": True}, Block(4, 3, 8)),
        ({}, Block(4, 3, 4)),
    ],
)
def test_the_processor_decides_the_blocks(features, block):
    with mock.patch("llvmlite.binding.get_host_cpu_features", return_value=features):
        assert float_block() == block
