from unittest import mock

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from llvmlite import binding

from vehicle_detection._common import Workspace
from vehicle_detection._kernels import BYTE_LIMIT, Filter, PackedFilters, PackedSearch, correlation
from vehicle_detection._kernels.vector import (
    GROUP,
    Block,
    block_adder,
    byte_block,
    float_block,
    pack_bytes,
    transposer,
    unpack_bytes,
)

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


def test_the_block_kernel_is_used_here():
    assert correlation._kernel() is correlation._correlate_blocks


def test_products_are_added_to_the_scores():
    weights, channels = random_inputs(2, 3, 4, 6, 70)
    scores = np.full((5, 68), 7, np.float32)
    Filter(weights).add_to(channels, scores)
    np.testing.assert_allclose(scores, reference(weights, channels) + 7, rtol=1e-4, atol=1e-4)


def test_a_smaller_output_takes_the_first_windows():
    weights, channels = random_inputs(3, 3, 5, 9, 50)
    scores = np.zeros((4, 20), np.float32)
    Filter(weights).add_to(channels, scores)
    np.testing.assert_allclose(scores, reference(weights, channels)[:4, :20], rtol=1e-4, atol=1e-4)


def test_reused_memory_does_not_change_the_scores():
    weights, channels = random_inputs(4, 4, 6, 12, 60)
    workspace = Workspace()
    first, second = np.zeros((2, 9, 57), np.float32)
    Filter(weights).add_to(channels, first, workspace)
    Filter(-weights).add_to(100 * channels, np.zeros((9, 57), np.float32), workspace)
    Filter(weights).add_to(channels, second, workspace)
    np.testing.assert_array_equal(first, second)


def test_values_beyond_the_last_cell_are_not_used():
    weights, channels = random_inputs(2, 2, 3, 4, 5)
    memory = np.full((3 * 4 * 5 + 200,), np.nan, np.float32)
    memory[: channels.size] = channels.ravel()
    scores = np.zeros((3, 4), np.float32)
    Filter(weights).add_to(memory[: channels.size].reshape(channels.shape), scores)
    assert np.isfinite(scores).all()


@pytest.mark.parametrize("depth", [1, 7])
@pytest.mark.parametrize("block", [Block(16, 3, 8), Block(8, 2, 4), Block(4, 3, 8), Block(4, 3, 4)])
def test_blocks_of_every_processor_add_the_same_products(block, depth):
    add_products = block_adder(block, block)

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
    ("lanes", "features"), [(16, {}), (8, {}), (4, {}), (4, {"ssse3": True}), (8, {"avx2": True})]
)
@pytest.mark.parametrize("extreme", [False, True])
def test_bytes_are_multiplied_exactly_on_every_processor(lanes, features, extreme):
    if not all(binding.get_host_cpu_features().get(feature) for feature in features):
        pytest.skip("this processor lacks the instructions")
    block = Block(lanes, 2, 3)
    add_products = block_adder(block, block)

    @numba.njit
    def run(weights, cells, sums):
        add_products(weights, 0, 2, cells, 0, 80, 2, sums, 200, 100)

    rng = np.random.default_rng(2)
    cells = rng.integers(BYTE_LIMIT if extreme else 0, BYTE_LIMIT + 1, (80 * GROUP, 4))
    weights = rng.integers(-25, 26, (2, GROUP, 3, 4))
    if extreme:
        # Two of the largest products, and sums of 16 bits that are nearly the largest.
        weights[...] = -25
        weights[:, 0, :, :2], weights[:, 1:, :, :2] = BYTE_LIMIT, 0
    sums = np.zeros(200 + 100, np.int32)
    with mock.patch("llvmlite.binding.get_host_cpu_features", return_value=features):
        run(pack_bytes(weights).reshape(2, GROUP, 3), pack_bytes(cells).ravel(), sums)
    for row in range(3):
        expected = np.zeros(block.columns, np.int64)
        for number, word in np.ndindex(2, GROUP):
            first = 2 * number + 80 * word
            expected += cells[first : first + block.columns] @ weights[number, word, row]
        start = 200 - 100 * row
        np.testing.assert_array_equal(sums[start : start + block.columns], expected)


def test_bytes_are_in_the_bits_of_a_word():
    values = np.array([[1, 127, 0, 64], [-1, -127, 5, 0]])
    words = pack_bytes(values)
    assert words.dtype == np.int32
    assert words.shape == (2, 1)
    assert words[0, 0] == 1 + 127 * 256 + 64 * 256**3
    np.testing.assert_array_equal(unpack_bytes(words), values)


def packed_reference(weights, cells, limit):
    """Rows, columns and scores of the windows with an integer score above a limit."""
    scores = reference(weights, cells).round().astype(np.int64)
    rows, columns = np.nonzero(scores > limit)
    return np.column_stack([rows, columns, scores[rows, columns]])


PACKED_KERNELS = {"blocks": correlation._find_windows, "plain": correlation._find_windows_plain}


@pytest.mark.parametrize("kernel", PACKED_KERNELS)
@settings(max_examples=60, deadline=None)
@given(
    sizes=st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=3),
    more=st.tuples(st.integers(0, 6), st.integers(0, 90)),
    groups=st.integers(1, 7),
    extreme=st.booleans(),
    seed=st.integers(0, 99),
)
def test_windows_are_those_with_the_highest_sums_of_integers(kernel, sizes, more, groups, extreme, seed):
    rng = np.random.default_rng(seed)
    rows, columns = (max(size[axis] for size in sizes) + more[axis] for axis in range(2))
    cells = rng.integers(BYTE_LIMIT if extreme else 0, BYTE_LIMIT + 1, (4 * groups, rows, columns))
    weights = [rng.normal(size=(*size, 4 * groups)) for size in sizes]
    if extreme:
        # The largest products of bytes, which would overflow 16 bits.
        weights = [np.where(each > -1.5, 1.0, -1.0) for each in weights]
    filters = PackedFilters(weights)
    packed = np.ascontiguousarray(pack_bytes(cells.transpose(1, 2, 0)).transpose(2, 0, 1))
    row_ranges = [(0, rows), *[(min(1, rows - size[0]), rows) for size in sizes[1:]]]
    rounded = [np.rint(each / unit) for each, unit in zip(weights, filters.units)]
    for bound in (-1e12, 0.0, 1e12):
        search = filters.on_map(columns, range(len(sizes)), row_ranges, [bound] * len(sizes))
        with mock.patch.object(correlation, "_packed_kernel", return_value=PACKED_KERNELS[kernel]):
            found = search.find(packed)
        for number, (each, (first, _)) in enumerate(zip(rounded, row_ranges)):
            expected = packed_reference(each, cells, np.floor(bound / filters.units[number]))
            expected = expected[expected[:, 0] >= first]
            np.testing.assert_array_equal(found[found[:, 1] == number][:, 2:], expected)


@given(words=st.integers(1, 12), scale=st.sampled_from([1e-6, 1.0, 1e6]), seed=st.integers(0, 99))
def test_weights_are_bytes_whose_sums_do_not_overflow(words, scale, seed):
    weights = scale * np.random.default_rng(seed).normal(0.2, 1, (3, 2, 4 * words))
    unit = PackedFilters([weights]).units[0]
    rounded = np.rint(weights / unit)
    assert np.abs(rounded).max() <= BYTE_LIMIT
    group = correlation._group(words)
    halves = rounded.reshape(3, 2, -1, group, 2, 2)
    for sign in (1, -1):
        sums = np.maximum(sign * halves, 0).sum(axis=(3, 5))
        assert sums.max() * BYTE_LIMIT <= 2**15 - 1


@pytest.mark.parametrize("kernel", PACKED_KERNELS)
def test_columns_of_a_map_become_channels(kernel):
    rng = np.random.default_rng(1)
    cells, weights = rng.integers(0, BYTE_LIMIT + 1, (8, 30, 9)), rng.integers(-12, 13, (4, 3, 8))
    weights[0, 0] = [BYTE_LIMIT, 0, 0, 0, 0, 0, 0, 0]  # the same unit for both
    packed = np.ascontiguousarray(pack_bytes(cells.transpose(1, 2, 0)).transpose(2, 0, 1))
    whole = PackedFilters([weights]).on_map(3, [0], [(0, 30)], [-1e12])
    strip = PackedFilters([weights.reshape(1, 4, -1)]).on_map(30, [0], [(0, 1)], [-1e12], np.arange(5, 8))
    expected = whole.find(np.ascontiguousarray(packed[:, :, 5:8]))
    with mock.patch.object(correlation, "_packed_kernel", return_value=PACKED_KERNELS[kernel]):
        found = strip.find(packed)
    np.testing.assert_array_equal(found[:, [1, 3, 4]], expected[:, [1, 2, 4]])


@pytest.mark.parametrize("kernel", PACKED_KERNELS)
def test_joined_searches_find_the_windows_of_each(kernel):
    rng = np.random.default_rng(3)
    packed = pack_bytes(rng.integers(0, BYTE_LIMIT + 1, (5, 20, 40, 4)))[..., 0]
    filters = PackedFilters([rng.normal(0.1, size=(rows, 4, 20)) for rows in (5, 3, 2)])
    strips = PackedFilters([rng.normal(0.1, size=(1, 6, 3 * 20))])
    searches = [
        filters.on_map(40, [0, 2], [(0, 20), (5, 20)], [0.0, 50.0]),
        strips.on_map(20, [0], [(0, 1)], [0.0], np.array([39, 38, 37])),
        filters.on_map(40, [1], [(3, 12)], [0.0]),
        strips.on_map(20, [0], [(0, 1)], [10.0], np.array([0, 1, 2])),
    ]
    with mock.patch.object(correlation, "_packed_kernel", return_value=PACKED_KERNELS[kernel]):
        found = PackedSearch.join(searches).find(packed)
    for number, search in enumerate(searches):
        alone = search.find(packed)
        assert len(alone)
        np.testing.assert_array_equal(found[found[:, 0] == number][:, 1:], alone[:, 1:])


def test_no_template_is_no_search():
    assert PackedFilters([]).on_map(9, [], [], []) is None


def test_an_instruction_that_does_not_compile_is_replaced(caplog):
    broken = mock.Mock()
    broken.compile.side_effect = RuntimeError("no such intrinsic")
    correlation._packed_kernel.cache_clear()
    try:
        with mock.patch.object(correlation, "_find_windows", broken):
            assert correlation._packed_kernel() is correlation._find_windows_plain
    finally:
        correlation._packed_kernel.cache_clear()
    assert [record.getMessage() for record in caplog.records] == [
        "products are computed without vector instructions, which is slower: no such intrinsic"
    ]
    assert correlation._packed_kernel() is correlation._find_windows


@pytest.mark.parametrize(
    ("features", "floats", "packed"),
    [
        ({"avx512f": True, "avx512vnni": True, "avx": True}, Block(16, 3, 8), Block(16, 3, 8)),
        ({"avx512f": True, "avx": True, "avx2": True}, Block(16, 3, 8), Block(16, 3, 4)),
        ({"avxvnni": True, "avx": True, "avx2": True}, Block(8, 2, 4), Block(8, 2, 4)),
        ({"avx": True, "avx2": True}, Block(8, 2, 4), Block(8, 3, 2)),
        ({"neon": True}, Block(4, 3, 8), Block(4, 3, 4)),
        ({}, Block(4, 3, 4), Block(4, 3, 2)),
    ],
)
def test_the_processor_decides_the_blocks(features, floats, packed):
    with mock.patch("llvmlite.binding.get_host_cpu_features", return_value=features):
        assert float_block() == floats
        assert byte_block() == packed


def test_code_for_another_processor_uses_no_special_instructions():
    with mock.patch.object(numba.config, "CPU_NAME", "generic"):
        assert float_block() == Block(4, 3, 4)
        assert byte_block() == Block(4, 3, 2)


@pytest.mark.parametrize("features", [{"avx512f": True, "avx512vnni": True, "avx": True}, {"avx": True}])
def test_numba_without_avx_uses_none(features):
    with (
        mock.patch.object(numba.config, "ENABLE_AVX", 0),
        mock.patch("llvmlite.binding.get_host_cpu_features", return_value=features),
    ):
        assert float_block() == Block(4, 3, 4)
        assert byte_block() == Block(4, 3, 2)


@pytest.mark.parametrize("lanes", [2, 4, 8, 16])
def test_squares_of_numbers_are_transposed(lanes):
    transpose = transposer(lanes)

    @numba.njit
    def run(values, out):
        transpose(values, 5, 20, out, 3, 30)

    values = np.random.default_rng(0).random((lanes + 2, 20), np.float32)
    out = np.zeros((lanes + 1, 30), np.float32)
    run(values.ravel(), out.reshape(-1))
    expected = np.zeros_like(out)
    expected[:lanes, 3 : 3 + lanes] = values.ravel()[5:-35].reshape(lanes, 20)[:, :lanes].T
    np.testing.assert_array_equal(out, expected)
