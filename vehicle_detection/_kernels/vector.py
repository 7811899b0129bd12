"""Sums of products in vector registers: the innermost step of the correlation, as an LLVM intrinsic.

A compiler keeps at most a vector or two of a sum in registers, and loads and stores them for every few
products. Here a block of sums stays in registers over the whole depth of the product (Goto and van de Geijn,
"Anatomy of high-performance matrix multiplication", ACM TOMS 2008), which is two to three times as fast.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray


class Block(NamedTuple):
    """Sums that a processor keeps in its registers: rows of vectors of lanes."""

    lanes: int
    rows: int
    vectors: int

    @property
    def columns(self) -> int:
        """Sums of a row."""
        return self.lanes * self.vectors


def host_block() -> Block:
    """Choose the block for this processor's vector registers.

    AVX-512 has 32 registers of 16 floats, NEON 32 of 4, AVX 16 of 8 and SSE 16 of 4. A few of them hold the
    factors.
    """
    features = _host_features()
    if features.get("avx512f"):
        return Block(16, 8, 3)
    if features.get("avx"):
        return Block(8, 4, 2)
    return Block(4, 8 if features.get("neon") else 4, 3)


class PackedFormat(NamedTuple):
    """Small integers in words of 32 bits: unsigned ones of up to 8 bits, and signed factors of 8 bits.

    The type of the words tells the kernels the format: int32 holds four bytes, uint32 two half-words.
    """

    per_word: int

    @property
    def dtype(self) -> type[np.int32] | type[np.uint32]:
        """Type of the words."""
        return np.int32 if self.per_word == 4 else np.uint32

    def pack(self, values: NDArray[np.integer]) -> NDArray[Any]:
        """Pack the last axis, of a multiple of `per_word` values; the first one is in the lowest bits."""
        bits = 32 // self.per_word
        groups = values.astype(np.int64).reshape(*values.shape[:-1], -1, self.per_word) & (2**bits - 1)
        words = (groups << (bits * np.arange(self.per_word))).sum(axis=-1)
        return np.asarray(words.astype(np.uint32).view(self.dtype))


BYTES, HALF_WORDS = PackedFormat(4), PackedFormat(2)


def host_packing() -> PackedFormat:
    """Choose the format for this processor: bytes where it multiplies them (VNNI), else half-words."""
    return BYTES if _vnni_lanes() else HALF_WORDS


def _host_features() -> Mapping[str, bool]:
    """Features of the processor that numba compiles for."""
    if numba.config.CPU_NAME or numba.config.CPU_FEATURES:
        return {}  # another processor than the host
    return binding.get_host_cpu_features()  # type: ignore[no-any-return]


def _vnni_lanes() -> int:
    """Words of a vector of which the processor multiplies four bytes each and adds the products; 0: none."""
    features = _host_features()
    if features.get("avx512vnni") and features.get("avx512f"):
        return 16
    return 8 if features.get("avxvnni") else 0


def block_adder(block: Block) -> Callable[..., None]:
    """Build ``add_products(weights, index, channels, first, sums, offsets, position)`` for use in kernels.

    For each row `r` of the block it adds ``weights[index, :, r] @ channels[:, first : first + columns]`` to
    ``sums[position + offsets[index, r] :]``. `weights` is ``(blocks, depth, rows)``, `channels`
    ``(depth, N)``, `sums` 1-D, and `offsets` ``(blocks, rows)`` intp; all are C-contiguous. Numbers are
    float32, or words of a `PackedFormat` with sums of int32. Nothing is checked.
    """
    lanes, rows, vectors = block
    int_type = ir.IntType(32)

    @intrinsic
    def add_products(
        _context: Any,
        weights: Any,
        index: Any,
        channels: Any,
        first: Any,
        sums: Any,
        offsets: Any,
        position: Any,
    ) -> Any:
        signature = types.void(weights, types.intp, channels, types.intp, sums, offsets, types.intp)
        products = _PRODUCTS[channels.dtype]

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            left, right, out, shifts = (
                context.make_array(signature.args[number])(context, builder, arguments[number])
                for number in (0, 2, 4, 5)
            )
            element = ir.FloatType() if channels.dtype == types.float32 else int_type
            vector = ir.VectorType(element, lanes)

            def constant(value: int) -> Any:
                return context.get_constant(types.intp, value)

            def address(array: Any, offset: Any, kind: Any) -> Any:
                data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
                return builder.bitcast(builder.gep(data, [offset]), kind.as_pointer())

            def load(array: Any, offset: Any, kind: Any) -> Any:
                value = builder.load(address(array, offset, kind))
                value.align = 8 if kind is index_type else 4
                return value

            def vector_offsets(offset: Any) -> list[Any]:
                return [builder.add(offset, constant(4 * lanes * part)) for part in range(vectors)]

            index_type = context.get_value_type(types.intp)
            depth = cgutils.unpack_tuple(builder, left.shape)[1]
            block_bytes = cgutils.unpack_tuple(builder, left.strides)[0]
            channel_bytes = cgutils.unpack_tuple(builder, right.strides)[0]
            start = builder.block
            weight_start = builder.mul(arguments[1], block_bytes)
            channel_start = builder.mul(arguments[3], constant(4))
            loop, done = builder.append_basic_block("depth"), builder.append_basic_block("sums")
            builder.branch(loop)
            # The loop over the depth: its counters and sums are phi nodes, which stay in registers.
            builder.position_at_end(loop)
            count, weight, channel = (builder.phi(depth.type) for _ in range(3))
            totals = [[builder.phi(vector) for _ in range(vectors)] for _ in range(rows)]
            values = [load(right, offset, vector) for offset in vector_offsets(channel)]
            updated = []
            for row, line in enumerate(totals):
                number = load(left, builder.add(weight, constant(4 * row)), element)
                factor = _broadcast(builder, number, vector)
                updated.append(
                    [products(builder, total, value, factor) for value, total in zip(values, line)]
                )
            for counter, origin, step in (
                (count, constant(0), constant(1)),
                (weight, weight_start, constant(4 * rows)),
                (channel, channel_start, channel_bytes),
            ):
                counter.add_incoming(origin, start)
                counter.add_incoming(builder.add(counter, step), loop)
            for line, updated_line in zip(totals, updated):
                for total, new_total in zip(line, updated_line):
                    total.add_incoming(ir.Constant(vector, [0] * lanes), start)
                    total.add_incoming(new_total, loop)
            unfinished = builder.icmp_signed("<", builder.add(count, constant(1)), depth)
            builder.cbranch(unfinished, loop, done)
            builder.position_at_end(done)
            index_bytes = context.get_abi_sizeof(index_type)
            block_offset = builder.mul(arguments[1], constant(rows * index_bytes))
            add = builder.fadd if channels.dtype == types.float32 else builder.add
            for row, line in enumerate(updated):
                shift = load(shifts, builder.add(block_offset, constant(row * index_bytes)), index_type)
                origin = builder.mul(builder.add(arguments[6], shift), constant(4))
                for offset, total in zip(vector_offsets(origin), line):
                    known = load(out, offset, vector)
                    stored = builder.store(add(known, total), address(out, offset, vector))
                    stored.align = 4
            return context.get_dummy_value()

        return signature, generate

    return add_products  # type: ignore[no-any-return]


LANES = 16
"""Numbers that `weighted_sum` adds side by side."""


@intrinsic
def weighted_sum(_context: Any, values: Any, starts: Any, weights: Any, terms: Any, out: Any) -> Any:
    """Write ``sum(weights[i] * values[starts[i] : starts[i] + LANES] for i in range(terms))`` to `out`.

    For use in kernels, where plain loops stay scalar, because `out` might overlap `values`. Two products are
    added at a time; `terms` is even and at least 2. `starts` is int64, the others are float32; all are 1-D
    and contiguous. Nothing is checked.
    """
    signature = types.void(values, starts, weights, types.intp, out)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, places, factors, target = (
            context.make_array(signature.args[number])(context, builder, arguments[number]).data
            for number in (0, 1, 2, 4)
        )
        vector = ir.VectorType(ir.FloatType(), LANES)
        zero, one, two = (context.get_constant(types.intp, number) for number in range(3))

        def product(term: Any) -> Any:
            start = builder.load(builder.gep(places, [term]))
            chosen = builder.load(builder.bitcast(builder.gep(source, [start]), vector.as_pointer()))
            chosen.align = 4
            factor = _broadcast(builder, builder.load(builder.gep(factors, [term])), vector)
            return builder.fmul(factor, chosen)

        total = cgutils.alloca_once_value(builder, ir.Constant(vector, [0.0] * LANES))
        with cgutils.for_range_slice(builder, zero, arguments[3], two, zero.type) as (term, _):
            pair = builder.fadd(product(term), product(builder.add(term, one)))
            builder.store(builder.fadd(builder.load(total), pair), total)
        stored = builder.store(builder.load(total), builder.bitcast(target, vector.as_pointer()))
        stored.align = 4
        return context.get_dummy_value()

    return signature, generate


def _broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """Vector whose elements are all `value`."""
    undefined, index = ir.Constant(vector, ir.Undefined), ir.IntType(32)
    single = builder.insert_element(undefined, value, ir.Constant(index, 0))
    zeros = ir.Constant(ir.VectorType(index, vector.count), [0] * vector.count)
    return builder.shuffle_vector(single, undefined, zeros)


def _add_floats(builder: Any, total: Any, value: Any, factor: Any) -> Any:
    """``total + value * factor``."""
    lanes = total.type.count
    kind = ir.FunctionType(total.type, [total.type] * 3)
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{lanes}f32")
    return builder.call(function, [factor, value, total])


def _add_bytes(builder: Any, total: Any, value: Any, factor: Any) -> Any:
    """Add four products of an unsigned and a signed byte to each lane: the instruction ``vpdpbusd``."""
    lanes = total.type.count
    operand = ir.VectorType(ir.IntType(8), 4 * lanes) if binding.llvm_version_info[0] >= 22 else total.type
    kind = ir.FunctionType(total.type, [total.type, operand, operand])
    name = f"llvm.x86.avx512.vpdpbusd.{32 * lanes}"
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, [total, builder.bitcast(value, operand), builder.bitcast(factor, operand)])


def _add_half_words(builder: Any, total: Any, value: Any, factor: Any) -> Any:
    """Add two products of half-words to each lane: the instruction ``pmaddwd`` where there is one."""
    lanes = total.type.count
    halves = ir.VectorType(ir.IntType(16), 2 * lanes)
    value, factor = builder.bitcast(value, halves), builder.bitcast(factor, halves)
    name = _multiply_add_name(lanes)
    if name is not None:
        kind = ir.FunctionType(total.type, [halves, halves])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.add(total, builder.call(function, [value, factor]))
    for half in range(2):
        chosen = ir.Constant(ir.VectorType(ir.IntType(32), lanes), list(range(half, 2 * lanes, 2)))
        parts = (
            builder.shuffle_vector(each, ir.Constant(halves, ir.Undefined), chosen)
            for each in (value, factor)
        )
        total = builder.add(total, builder.mul(*(builder.sext(part, total.type) for part in parts)))
    return total


def _multiply_add_name(lanes: int) -> str | None:
    """LLVM's name of ``pmaddwd`` for vectors of so many sums; None without it."""
    features = _host_features()
    if lanes == 16 and features.get("avx512bw"):
        return "llvm.x86.avx512.pmaddw.d.512"
    if lanes == 8 and features.get("avx2"):
        return "llvm.x86.avx2.pmadd.wd"
    return "llvm.x86.sse2.pmadd.wd" if lanes == 4 and features.get("sse2") else None


_PRODUCTS = {types.float32: _add_floats, types.int32: _add_bytes, types.uint32: _add_half_words}
