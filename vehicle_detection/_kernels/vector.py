"""Sums of products in vector registers: the innermost step of correlation, as an LLVM intrinsic.

A compiler keeps at most a vector or two of a sum in registers, and loads and stores them for every few
products. Here a block of sums stays in registers over the whole depth of the product (Goto and van de Geijn,
"Anatomy of high-performance matrix multiplication", ACM TOMS 2008), which is two to three times as fast.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numba
from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic


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


def _host_features() -> Mapping[str, bool]:
    """Features of the processor that numba compiles for."""
    if numba.config.CPU_NAME or numba.config.CPU_FEATURES:
        return {}  # another processor than the host
    features = binding.get_host_cpu_features()
    avx = bool(numba.config.ENABLE_AVX)
    return {name: has and (avx or not name.startswith("avx")) for name, has in features.items()}


def block_adder(block: Block) -> Callable[..., None]:
    """Build ``add_products(weights, first, last, cells, start, stride, step, sums, position, row_step)``.

    For use in kernels. With the `columns` of the block, for each of its rows `r` it adds ::

        weights[first + k, c, r] * cells[start + k * step + c * stride + x]   for x in range(columns)

    to ``sums[position - r * row_step + x]``, for all `k` with ``first + k < last`` and all `c`, at least one
    of each. `weights` is ``(N, depth, rows)``, `cells` and `sums` are 1-D, and all are C-contiguous and
    float32. Nothing is checked.
    """

    @intrinsic
    def add_products(_, weights, first, last, cells, start, stride, step, sums, position, row_step):
        size = types.intp
        signature = types.void(weights, size, size, cells, size, size, size, sums, size, size)
        return signature, lambda context, builder, _, arguments: _generate(
            block, context, builder, signature, arguments
        )

    return add_products  # type: ignore[no-any-return]


def _generate(block: Block, context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Generate the code of `add_products`: two loops, over `k` and over the channels `c`.

    Their counters and sums are phi nodes, one for each variable that a loop changes: these stay in registers.
    """
    lanes, vectors, rows = block
    vector = ir.VectorType(ir.FloatType(), lanes)
    left, right, out = (
        context.make_array(signature.args[number])(context, builder, arguments[number])
        for number in (0, 3, 7)
    )
    _, first, last, _, start, stride, step, _, position, row_step = arguments
    depth = cgutils.unpack_tuple(builder, left.shape)[1]
    memory = _Memory(builder, vector, vectors)
    zero, one, row_count = (context.get_constant(types.intp, value) for value in (0, 1, rows))

    def grid_of(function: Callable[[int, int], Any]) -> list[list[Any]]:
        return [[function(row, part) for part in range(vectors)] for row in range(rows)]

    def connect(phis: Any, block: Any, values: Any) -> None:
        for phi, value in zip(phis, values, strict=True):
            phi.add_incoming(value, block)

    entry = builder.block
    outer, inner, latch, done = (
        builder.append_basic_block(name) for name in ("cells", "channels", "next", "sums")
    )
    factor_step = builder.mul(depth, row_count)
    origin = first, builder.mul(first, factor_step), start
    builder.branch(outer)

    builder.position_at_end(outer)
    counters = [builder.phi(depth.type) for _ in range(3)]
    totals = grid_of(lambda row, part: builder.phi(vector))
    builder.branch(inner)

    builder.position_at_end(inner)
    channel, factor_place, place = inner_counters = [builder.phi(depth.type) for _ in range(3)]
    parts = grid_of(lambda row, part: builder.phi(vector))
    values = memory.load_vectors(right, place)
    factors = memory.load_factors(left, factor_place, rows)
    name = f"llvm.fmuladd.v{lanes}f32"
    added = grid_of(lambda row, part: _call(builder, name, factors[row], values[part], parts[row][part]))
    following = builder.add(channel, one)
    connect(inner_counters, outer, [zero, *counters[1:]])
    moved = builder.add(factor_place, row_count), builder.add(place, stride)
    connect(inner_counters, inner, [following, *moved])
    for line, known, new in zip(parts, totals, added):
        connect(line, outer, known)
        connect(line, inner, new)
    builder.cbranch(builder.icmp_signed("<", following, depth), inner, latch)

    builder.position_at_end(latch)
    following = builder.add(counters[0], one)
    moved = builder.add(counters[1], factor_step), builder.add(counters[2], step)
    connect(counters, entry, origin)
    connect(counters, latch, [following, *moved])
    for line, new in zip(totals, added):
        connect(line, entry, [ir.Constant(vector, [0] * lanes)] * vectors)
        connect(line, latch, new)
    builder.cbranch(builder.icmp_signed("<", following, last), outer, done)

    builder.position_at_end(done)
    for line in added:
        memory.add_vectors(out, position, line)
        position = builder.sub(position, row_step)
    return context.get_dummy_value()


class _Memory:
    """Generates the loads and stores of vectors; arrays need not be aligned to them."""

    def __init__(self, builder: Any, vector: Any, vectors: int) -> None:
        self._builder, self._vector, self._vectors = builder, vector, vectors

    def _address(self, array: Any, place: Any, offset: int, kind: Any) -> Any:
        place = self._builder.add(place, ir.Constant(place.type, offset)) if offset else place
        return self._builder.bitcast(self._builder.gep(array.data, [place]), kind.as_pointer())

    def _load(self, address: Any) -> Any:
        value = self._builder.load(address)
        value.align = 4
        return value

    def _addresses(self, array: Any, place: Any) -> list[Any]:
        offsets = [self._vector.count * part for part in range(self._vectors)]
        return [self._address(array, place, offset, self._vector) for offset in offsets]

    def load_vectors(self, array: Any, place: Any) -> list[Any]:
        """Load adjacent vectors."""
        return [self._load(address) for address in self._addresses(array, place)]

    def load_factors(self, array: Any, place: Any, count: int) -> list[Any]:
        """Load adjacent numbers, each as a vector whose elements are all this number."""
        kind = self._vector.element
        numbers = [self._load(self._address(array, place, row, kind)) for row in range(count)]
        return [_broadcast(self._builder, number, self._vector) for number in numbers]

    def add_vectors(self, array: Any, place: Any, values: list[Any]) -> None:
        """Add vectors to adjacent ones of an array."""
        for address, value in zip(self._addresses(array, place), values):
            self._builder.store(self._builder.fadd(self._load(address), value), address).align = 4


def _broadcast(builder: Any, value: Any, vector: Any) -> Any:
    """Vector whose elements are all `value`."""
    undefined, index = ir.Constant(vector, ir.Undefined), ir.IntType(32)
    single = builder.insert_element(undefined, value, ir.Constant(index, 0))
    zeros = ir.Constant(ir.VectorType(index, vector.count), [0] * vector.count)
    return builder.shuffle_vector(single, undefined, zeros)


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    """Call an intrinsic function of LLVM whose arguments and result have one type."""
    kind = ir.FunctionType(arguments[0].type, [each.type for each in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments)
