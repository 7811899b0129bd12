import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._common import Workspace
from vehicle_detection._kernels import Filter
from vehicle_detection._kernels.vector import Block, block_adder, host_block


def reference(weights, planes, spread=1):
    """Sum the products window by window, in double precision."""
    rows, columns, _ = weights.shape
    height = planes.shape[1] - (rows - 1) * spread
    width = planes.shape[2] - (columns - 1) * spread
    scores = np.zeros((height, width))
    for i, j in np.ndindex(rows, columns):
        part = planes[:, i * spread : i * spread + height, j * spread : j * spread + width]
        scores += np.tensordot(weights[i, j].astype(np.float64), part, axes=1)
    return scores


def drawn(rows, columns, depth, height, width, seed=0):
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(rows, columns, depth))
    return weights, rng.normal(size=(depth, height, width)).astype(np.float32)


@settings(deadline=None, max_examples=60)
@given(
    rows=st.integers(1, 10),
    columns=st.integers(1, 10),
    depth=st.integers(1, 30),
    spread=st.integers(1, 2),
    more=st.tuples(st.integers(0, 5), st.integers(0, 120)),
    seed=st.integers(0, 99),
)
def test_scores_equal_the_sums_of_products(rows, columns, depth, spread, more, seed):
    height, width = (rows - 1) * spread + 1 + more[0], (columns - 1) * spread + 1 + more[1]
    weights, planes = drawn(rows, columns, depth, height, width, seed)
    expected = reference(weights, planes, spread)
    scores = np.zeros(expected.shape, np.float32)
    Filter(weights, spread=spread).add_to(planes, scores)
    np.testing.assert_allclose(scores, expected, rtol=1e-4, atol=1e-4)


def test_scores_are_added_to_what_is_there():
    weights, planes = drawn(2, 3, 4, 6, 70)
    scores = np.full((5, 68), 7, np.float32)
    Filter(weights).add_to(planes, scores)
    np.testing.assert_allclose(scores, reference(weights, planes) + 7, rtol=1e-4, atol=1e-4)


def test_fewer_windows_than_fit_are_the_first_ones():
    weights, planes = drawn(3, 3, 5, 9, 50)
    scores = np.zeros((4, 20), np.float32)
    Filter(weights).add_to(planes, scores)
    np.testing.assert_allclose(scores, reference(weights, planes)[:4, :20], rtol=1e-4, atol=1e-4)


def test_memory_that_was_used_before_does_not_show():
    weights, planes = drawn(4, 4, 6, 12, 60)
    workspace = Workspace()
    first, second = np.zeros((2, 9, 57), np.float32)
    Filter(weights).add_to(planes, first, workspace)
    Filter(-weights).add_to(100 * planes, np.zeros((9, 57), np.float32), workspace)
    Filter(weights).add_to(planes, second, workspace)
    np.testing.assert_array_equal(first, second)


def test_values_behind_the_last_cell_do_not_show():
    weights, planes = drawn(2, 2, 3, 4, 5)
    room = np.full((3 * 4 * 5 + 200,), np.nan, np.float32)
    room[: planes.size] = planes.ravel()
    scores = np.zeros((3, 4), np.float32)
    Filter(weights).add_to(room[: planes.size].reshape(planes.shape), scores)
    assert np.isfinite(scores).all()


@pytest.mark.parametrize("block", [Block(16, 8, 3), Block(8, 4, 3), Block(4, 8, 3), Block(4, 4, 3)])
def test_blocks_of_every_processor_add_the_same_products(block):
    add_products = block_adder(block)

    @numba.njit
    def run(weights, planes, sums, offsets):
        add_products(weights, 1, planes, 2, sums, offsets, 5)

    rng = np.random.default_rng(4)
    weights = rng.normal(size=(2, 7, block.rows)).astype(np.float32)
    planes = rng.normal(size=(7, block.columns + 6)).astype(np.float32)
    offsets = np.arange(2 * block.rows).reshape(2, -1) * (block.columns + 1)
    sums = rng.normal(size=5 + 2 * block.rows * (block.columns + 1)).astype(np.float32)
    expected = sums.astype(np.float64)
    for row in range(block.rows):
        place = 5 + offsets[1, row]
        expected[place : place + block.columns] += weights[1, :, row] @ planes[:, 2 : 2 + block.columns]
    run(weights, planes, sums, offsets)
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-5)


def test_this_processor_has_a_block():
    assert host_block().rows % 4 == 0
    assert host_block().columns == 3 * host_block().lanes
