"""Sums of products in vector registers: the innermost step of correlation and networks, as LLVM intrinsics.

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
    vectors: int
    rows: int

    @property
    def columns(self) -> int:
        """Sums of a row."""
        return self.lanes * self.vectors


def float_block() -> Block:
    """Choose the block for sums of float32 in this processor's vector registers.

    AVX-512 has 32 registers of 16 numbers, NEON 32 of 4, AVX 16 of 8 and SSE 16 of 4. A few of them hold the
    factors.
    """
    features = _host_features()
    if features.get("avx512f"):
        return Block(16, 3, 8)
    if features.get("avx"):
        return Block(8, 2, 4)
    return Block(4, 3, 8 if features.get("neon") else 4)


def byte_block() -> Block:
    """Choose the block for sums of products of bytes.

    A sum takes two registers where the processor has no instruction that adds four products to it (VNNI), and
    adds them in 16 bits first.
    """
    block = float_block()
    if _adds_bytes(block.lanes, _host_features()):
        return block
    return Block(block.lanes, 3, 4 if block.rows == 8 else 2)


def _adds_bytes(lanes: int, features: Mapping[str, bool]) -> bool:
    """Whether the processor multiplies the four bytes of so many words, and adds the products."""
    return bool(features.get({16: "avx512vnni", 8: "avxvnni"}.get(lanes, "")))


BYTE_LIMIT = 127
"""Largest packed value, and largest absolute factor."""

GROUP = 5
"""Words whose products are added at a time: those of a cell. Their sums may have 16 bits."""

MAX_FACTORS = (2**15 - 1) // BYTE_LIMIT
"""Limit for the positive, and for the negative factors whose products are added in 16 bits.

These are the first or the second halves of the words of a group.
"""


def pack_bytes(values: NDArray[np.integer]) -> NDArray[np.int32]:
    """Pack the last axis, of a multiple of four values, into words; the first byte is in the lowest bits."""
    return np.ascontiguousarray(values.astype("<i1")).view("<i4").astype(np.int32)


def unpack_bytes(words: NDArray[np.int32]) -> NDArray[np.int32]:
    """Invert `pack_bytes`."""
    return np.ascontiguousarray(words.astype("<i4")).view("<i1").astype(np.int32)


def _host_features() -> Mapping[str, bool]:
    """Features of the processor that numba compiles for."""
    if numba.config.CPU_NAME or numba.config.CPU_FEATURES:
        return {}  # another processor than the host
    features = binding.get_host_cpu_features()
    avx = bool(numba.config.ENABLE_AVX)
    return {name: has and (avx or not name.startswith("avx")) for name, has in features.items()}


def block_adder(floats: Block, packed: Block) -> Callable[..., None]:
    """Build ``add_products(weights, first, last, cells, start, stride, step, sums, position, row_step)``.

    For use in kernels. With the `columns` of the block, for each of its rows `r` it adds ::

        weights[first + k, c, r] * cells[start + k * step + c * stride + x]   for x in range(columns)

    to ``sums[position - r * row_step + x]``, for all `k` with ``first + k < last`` and all `c`, at least one
    of each. `weights` is ``(N, depth, rows)``, `cells` and `sums` are 1-D, and all are C-contiguous. Numbers
    are float32, or words of `pack_bytes` with sums of int32; then the depth is at most `GROUP`. Nothing is
    checked.
    """

    @intrinsic
    def add_products(
        _context: Any,
        weights: Any,
        first: Any,
        last: Any,
        cells: Any,
        start: Any,
        stride: Any,
        step: Any,
        sums: Any,
        position: Any,
        row_step: Any,
    ) -> Any:
        size = types.intp
        signature = types.void(weights, size, size, cells, size, size, size, sums, size, size)
        is_float = cells.dtype == types.float32
        lanes, vectors, rows = floats if is_float else packed
        products = _float_products(lanes) if is_float else _byte_products(lanes)
        vector = ir.VectorType(ir.FloatType() if is_float else ir.IntType(32), lanes)
        zero_vector = ir.Constant(products.total, [0] * products.total.count)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            left, right, out = (
                context.make_array(signature.args[number])(context, builder, arguments[number])
                for number in (0, 3, 7)
            )
            _, first, last, _, start, stride, step, _, position, row_step = arguments
            depth = cgutils.unpack_tuple(builder, left.shape)[1]

            def constant(value: int) -> Any:
                return context.get_constant(types.intp, value)

            def address(array: Any, place: Any, kind: Any) -> Any:
                return builder.bitcast(builder.gep(array.data, [place]), kind.as_pointer())

            def load(array: Any, place: Any, kind: Any) -> Any:
                value = builder.load(address(array, place, kind))
                value.align = 4
                return value

            def places(place: Any) -> list[Any]:
                return [builder.add(place, constant(lanes * part)) for part in range(vectors)]

            def grid_of(function: Callable[[int, int], Any]) -> list[list[Any]]:
                return [[function(row, part) for part in range(vectors)] for row in range(rows)]

            def connect(phis: Any, block: Any, values: Any) -> None:
                for phi, value in zip(phis, values, strict=True):
                    phi.add_incoming(value, block)

            # Two loops, over `k` and over the channels `c`. Their counters and sums are phi nodes: these stay
            # in registers.
            entry = builder.block
            outer, inner, latch, done = (
                builder.append_basic_block(name) for name in ("cells", "channels", "next", "sums")
            )
            factor_step = builder.mul(depth, constant(rows))
            origin = first, builder.mul(first, factor_step), start
            builder.branch(outer)

            builder.position_at_end(outer)
            counters = [builder.phi(depth.type) for _ in range(3)]
            totals = grid_of(lambda row, part: builder.phi(vector))
            builder.branch(inner)

            builder.position_at_end(inner)
            channel, factor_place, place = inner_counters = [builder.phi(depth.type) for _ in range(3)]
            parts = grid_of(lambda row, part: builder.phi(products.total))
            values = [load(right, each, vector) for each in places(place)]
            numbers = [
                load(left, builder.add(factor_place, constant(row)), vector.element) for row in range(rows)
            ]
            factors = [_broadcast(builder, number, vector) for number in numbers]
            added = grid_of(
                lambda row, part: products.add(builder, parts[row][part], values[part], factors[row])
            )
            following = builder.add(channel, constant(1))
            connect(inner_counters, outer, [constant(0), *counters[1:]])
            moved = builder.add(factor_place, constant(rows)), builder.add(place, stride)
            connect(inner_counters, inner, [following, *moved])
            for line, known, new in zip(parts, totals, added):
                connect(line, outer, known if products.finish is None else [zero_vector] * vectors)
                connect(line, inner, new)
            builder.cbranch(builder.icmp_signed("<", following, depth), inner, latch)

            # The end of the outer loop: short sums of one `k` are added to those of all.
            builder.position_at_end(latch)
            finish = products.finish
            if finish is not None:
                added = grid_of(
                    lambda row, part: builder.add(totals[row][part], finish(builder, added[row][part]))
                )
            following = builder.add(counters[0], constant(1))
            moved = builder.add(counters[1], factor_step), builder.add(counters[2], step)
            connect(counters, entry, origin)
            connect(counters, latch, [following, *moved])
            for line, new in zip(totals, added):
                connect(line, entry, [ir.Constant(vector, [0] * lanes)] * vectors)
                connect(line, latch, new)
            builder.cbranch(builder.icmp_signed("<", following, last), outer, done)

            builder.position_at_end(done)
            add = builder.fadd if is_float else builder.add
            for line in added:
                for each, total in zip(places(position), line):
                    stored = builder.store(add(load(out, each, vector), total), address(out, each, vector))
                    stored.align = 4
                position = builder.sub(position, row_step)
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


def transposer(lanes: int) -> Callable[..., None]:
    """Build ``transpose(values, start, step, out, place, out_step)`` for squares of as many numbers a side.

    For use in kernels. For all rows `r` and columns `c` of the square it does ::

        out[place + c * out_step + r] = values[start + r * step + c]

    Both arrays are 1-D, C-contiguous and float32, and `lanes` is a power of two. Nothing is checked. Parts of
    1, 2, 4, ... numbers a side change places: Eklundh, "A fast computer method for matrix transposing" (IEEE
    Transactions on Computers, 1972).
    """
    vector, masks = ir.VectorType(ir.FloatType(), lanes), ir.VectorType(ir.IntType(32), lanes)

    @intrinsic
    def transpose(
        _context: Any, values: Any, start: Any, step: Any, out: Any, place: Any, out_step: Any
    ) -> Any:
        signature = types.void(values, types.intp, types.intp, out, types.intp, types.intp)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            source, target = (
                context.make_array(signature.args[number])(context, builder, arguments[number]).data
                for number in (0, 3)
            )
            _, start, step, _, place, out_step = arguments

            def address(array: Any, first: Any, step: Any, number: int) -> Any:
                offset = builder.mul(step, context.get_constant(types.intp, number))
                return builder.bitcast(builder.gep(array, [builder.add(first, offset)]), vector.as_pointer())

            rows = [builder.load(address(source, start, step, number)) for number in range(lanes)]
            for row in rows:
                row.align = 4
            for size in (1 << bit for bit in range(lanes.bit_length() - 1)):
                upper = [lanes + lane - size if lane & size else lane for lane in range(lanes)]
                lower = [lanes + lane if lane & size else lane + size for lane in range(lanes)]
                for number in range(lanes):
                    if not number & size:
                        pair = rows[number], rows[number + size]
                        rows[number] = builder.shuffle_vector(*pair, ir.Constant(masks, upper))
                        rows[number + size] = builder.shuffle_vector(*pair, ir.Constant(masks, lower))
            for number, row in enumerate(rows):
                stored = builder.store(row, address(target, place, out_step, number))
                stored.align = 4
            return context.get_dummy_value()

        return signature, generate

    return transpose  # type: ignore[no-any-return]


def _broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """Vector whose elements are all `value`."""
    undefined, index = ir.Constant(vector, ir.Undefined), ir.IntType(32)
    single = builder.insert_element(undefined, value, ir.Constant(index, 0))
    zeros = ir.Constant(ir.VectorType(index, vector.count), [0] * vector.count)
    return builder.shuffle_vector(single, undefined, zeros)


class _Products(NamedTuple):
    """How a block adds products: the type of its sums, `add` for one more product, and how to widen the sums.

    `add` takes builder, total, value and factor; `finish` takes builder and total, and is None where the sums
    need not be widened.
    """

    total: Any
    add: Callable[..., Any]
    finish: Callable[..., Any] | None = None


def _float_products(lanes: int) -> _Products:
    total = ir.VectorType(ir.FloatType(), lanes)

    def add(builder: Any, total: Any, value: Any, factor: Any) -> Any:
        return _call(builder, f"llvm.fmuladd.v{lanes}f32", total.type, factor, value, total)

    return _Products(total, add)


def _byte_products(lanes: int) -> _Products:
    """Products of the four bytes of each word; where the processor has no instruction, sums of 16 bits."""
    features = _host_features()
    bytes_type, halves = ir.VectorType(ir.IntType(8), 4 * lanes), ir.VectorType(ir.IntType(16), 2 * lanes)
    words = ir.VectorType(ir.IntType(32), lanes)
    if _adds_bytes(lanes, features):
        operand = bytes_type if binding.llvm_version_info[0] >= 22 else words

        def add_word(builder: Any, total: Any, value: Any, factor: Any) -> Any:
            value, factor = builder.bitcast(value, operand), builder.bitcast(factor, operand)
            return _call(builder, f"llvm.x86.avx512.vpdpbusd.{32 * lanes}", words, total, value, factor)

        return _Products(words, add_word)
    feature, multiply, add_pairs = _BYTE_INSTRUCTIONS.get(lanes, ("", "", ""))
    if features.get(feature):

        def add(builder: Any, total: Any, value: Any, factor: Any) -> Any:
            value, factor = builder.bitcast(value, bytes_type), builder.bitcast(factor, bytes_type)
            return builder.add(total, _call(builder, multiply, halves, value, factor))

        def finish(builder: Any, total: Any) -> Any:
            return _call(builder, add_pairs, words, total, ir.Constant(halves, [1] * halves.count))

    else:

        def add(builder: Any, total: Any, value: Any, factor: Any) -> Any:
            value, factor = builder.bitcast(value, bytes_type), builder.bitcast(factor, bytes_type)
            for part in range(2):
                numbers = (_every_second(builder, each, part, halves) for each in (value, factor))
                total = builder.add(total, builder.mul(*numbers))
            return total

        def finish(builder: Any, total: Any) -> Any:
            return builder.add(*(_every_second(builder, total, part, words) for part in range(2)))

    return _Products(halves, add, finish)


# For vectors of so many words: the feature of processors with instructions that multiply bytes and add pairs
# of products, and that add pairs of half-words; and their names.
_BYTE_INSTRUCTIONS = {
    16: ("avx512bw", "llvm.x86.avx512.pmaddubs.w.512", "llvm.x86.avx512.pmaddw.d.512"),
    8: ("avx2", "llvm.x86.avx2.pmadd.ub.sw", "llvm.x86.avx2.pmadd.wd"),
    4: ("ssse3", "llvm.x86.ssse3.pmadd.ub.sw.128", "llvm.x86.sse2.pmadd.wd"),
}


def _every_second(builder: Any, vector: Any, first: int, wide: Any) -> Any:
    """Every second element of a vector as the elements of a type with twice the bits."""
    numbers = ir.Constant(ir.VectorType(ir.IntType(32), wide.count), list(range(first, 2 * wide.count, 2)))
    chosen = builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), numbers)
    return builder.sext(chosen, wide)


def _call(builder: Any, name: str, result: Any, *arguments: Any) -> Any:
    """Call an intrinsic function of LLVM."""
    kind = ir.FunctionType(result, [each.type for each in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)
