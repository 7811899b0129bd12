from unittest import mock

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._common import Workspace
from vehicle_detection._kernels import Filter, PackedFilters, correlation
from vehicle_detection._kernels.vector import (
    BYTES,
    HALF_WORDS,
    Block,
    PackedFormat,
    block_adder,
    host_block,
    host_packing,
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
        "correlation uses plain, slower loops: no such intrinsic"
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


@pytest.mark.parametrize("block", [Block(16, 8, 3), Block(8, 4, 2), Block(4, 8, 3), Block(4, 4, 3)])
def test_blocks_of_every_processor_add_the_same_products(block):
    add_products = block_adder(block)

    @numba.njit
    def run(weights, channels, sums, offsets):
        add_products(weights, 1, channels, 2, sums, offsets, 5)

    rng = np.random.default_rng(4)
    weights = rng.normal(size=(2, 7, block.rows)).astype(np.float32)
    channels = rng.normal(size=(7, block.columns + 6)).astype(np.float32)
    offsets = np.arange(2 * block.rows).reshape(2, -1) * (block.columns + 1)
    sums = rng.normal(size=5 + 2 * block.rows * (block.columns + 1)).astype(np.float32)
    expected = sums.astype(np.float64)
    for row in range(block.rows):
        start = 5 + offsets[1, row]
        expected[start : start + block.columns] += weights[1, :, row] @ channels[:, 2 : 2 + block.columns]
    run(weights, channels, sums, offsets)
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-5)


def test_this_processor_has_a_block():
    assert host_block().rows % 4 == 0
    assert host_block().columns == host_block().vectors * host_block().lanes


# The bytes are tested where the processor multiplies them; everywhere the result is that of integers.
PACKINGS = sorted({HALF_WORDS, host_packing()})


@pytest.mark.parametrize("packing", [BYTES, HALF_WORDS])
def test_packed_values_are_in_the_bits_of_a_word(packing):
    values = np.array([[1, 255, 0, 127], [-1, -128, 5, 0]])
    words = packing.pack(values)
    assert words.dtype == packing.dtype
    assert words.shape == (2, 4 // packing.per_word)
    bits = 32 // packing.per_word
    parts = [(words.astype(np.int64) >> (bits * part)) % 2**bits for part in range(packing.per_word)]
    np.testing.assert_array_equal(np.stack(parts, axis=-1).reshape(2, 4), values % 2**bits)


def packed_reference(weights, cells, limit):
    """Rows, columns and scores of the windows with an integer score above a limit."""
    scores = reference(weights, cells).round().astype(np.int64)
    rows, columns = np.nonzero(scores > limit)
    return np.column_stack([rows, columns, scores[rows, columns]])


@pytest.mark.parametrize("packing", PACKINGS)
@settings(max_examples=60, deadline=None)
@given(
    sizes=st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=3),
    more=st.tuples(st.integers(0, 6), st.integers(0, 90)),
    groups=st.integers(1, 7),
    extreme=st.booleans(),
    seed=st.integers(0, 99),
)
def test_windows_are_those_with_the_highest_sums_of_integers(packing, sizes, more, groups, extreme, seed):
    rng = np.random.default_rng(seed)
    rows, columns = (max(size[axis] for size in sizes) + more[axis] for axis in range(2))
    cells = rng.integers(255 if extreme else 0, 256, (4 * groups, rows, columns))
    weights = [rng.normal(size=(*size, 4 * groups)) for size in sizes]
    if extreme:
        # The largest products of bytes, which overflow 16 bits.
        weights = [np.where(each > -1.5, 1.0, -1.0) for each in weights]
    filters = PackedFilters(weights, packing=packing)
    packed = np.ascontiguousarray(packing.pack(cells.transpose(1, 2, 0)).transpose(2, 0, 1))
    row_ranges = [(0, rows), *[(min(1, rows - size[0]), rows) for size in sizes[1:]]]
    rounded = [np.rint(each / unit) for each, unit in zip(weights, filters.units)]
    assert max(np.abs(each).max() for each in rounded) == 127
    for bound in (-1e12, 0.0, 1e12):
        search = filters.on_map(columns, range(len(sizes)), row_ranges, [bound] * len(sizes))
        found = search.find(packed)
        for number, (each, (first, _)) in enumerate(zip(rounded, row_ranges)):
            expected = packed_reference(each, cells, np.floor(bound / filters.units[number]))
            expected = expected[expected[:, 0] >= first]
            np.testing.assert_array_equal(found[found[:, 0] == number][:, 1:], expected)


def test_columns_of_a_map_become_channels():
    rng = np.random.default_rng(1)
    cells, weights = rng.integers(0, 256, (8, 30, 9)), rng.normal(size=(4, 3, 8))
    packed = np.ascontiguousarray(HALF_WORDS.pack(cells.transpose(1, 2, 0)).transpose(2, 0, 1))
    whole = PackedFilters([weights], packing=HALF_WORDS).on_map(3, [0], [(0, 30)], [-1e12])
    strip = PackedFilters([weights.reshape(1, 4, -1)], packing=HALF_WORDS).on_map(30, [0], [(0, 1)], [-1e12])
    expected = whole.find(np.ascontiguousarray(packed[:, :, 5:8]))
    found = strip.find(packed, np.arange(5, 8))
    np.testing.assert_array_equal(found[:, [0, 2, 3]], expected[:, [0, 1, 3]])


def test_no_template_is_no_search():
    assert PackedFilters([]).on_map(9, [], [], []) is None


def test_a_processor_without_the_instruction_uses_half_words(caplog):
    broken = mock.Mock()
    broken.compile.side_effect = RuntimeError("no such intrinsic")
    correlation._packed_format.cache_clear()
    try:
        with mock.patch.object(correlation, "_correlate_blocks", broken):
            assert correlation._packed_format() == HALF_WORDS
    finally:
        correlation._packed_format.cache_clear()
    assert [record.getMessage() for record in caplog.records] == [
        "correlation uses slower instructions: no such intrinsic"
    ]
    assert correlation._packed_format() == host_packing()


@pytest.mark.parametrize(
    ("features", "packing", "block"),
    [
        ({"avx512f": True, "avx512bw": True, "avx512vnni": True, "avx": True}, BYTES, Block(16, 8, 3)),
        ({"avx512f": True, "avx": True, "avx2": True}, HALF_WORDS, Block(16, 8, 3)),
        ({"avxvnni": True, "avx": True, "avx2": True}, BYTES, Block(8, 4, 2)),
        ({"avx": True, "avx2": True}, HALF_WORDS, Block(8, 4, 2)),
        ({"neon": True}, HALF_WORDS, Block(4, 8, 3)),
        ({}, HALF_WORDS, Block(4, 4, 3)),
    ],
)
def test_the_processor_decides_the_format_and_the_block(features, packing, block):
    with mock.patch("llvmlite.binding.get_host_cpu_features", return_value=features):
        assert host_packing() == packing
        assert host_block() == block
    assert isinstance(packing, PackedFormat)


def test_code_for_another_processor_uses_no_special_instructions():
    with mock.patch.object(numba.config, "CPU_NAME", "generic"):
        assert host_packing() == HALF_WORDS
        assert host_block() == Block(4, 4, 3)
