"""Sums of products in vector registers: the innermost step of the correlation, written for the processor.

A compiler keeps at most a vector or two of a sum in registers and loads and stores them for every few
products. Here a block of sums stays in registers over the whole depth of the product (Goto and van de Geijn,
"Anatomy of high-performance matrix multiplication", ACM TOMS 2008), which is two to three times as fast.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.extending import intrinsic


class Block(NamedTuple):
    """How many sums a processor keeps in its registers: rows of vectors of lanes."""

    lanes: int
    rows: int
    vectors: int

    @property
    def columns(self) -> int:
        """Sums of a row."""
        return self.lanes * self.vectors


def host_block() -> Block:
    """Choose the block for this processor's vector registers.

    AVX-512 has 32 registers of 16 numbers, NEON 32 of 4, AVX 16 of 8 and SSE 16 of 4. A few of them hold what
    is multiplied.
    """
    features = binding.get_host_cpu_features()
    if features.get("avx512f"):
        return Block(16, 8, 3)
    if features.get("avx"):
        return Block(8, 4, 3)
    return Block(4, 8 if features.get("neon") else 4, 3)


def block_adder(block: Block) -> Callable[..., None]:
    """Make the step ``add_products(weights, number, planes, first, sums, offsets, place)`` for kernels.

    For each row `r` of the block it adds ``weights[number, :, r] @ planes[:, first : first + columns]`` to as
    many entries of ``sums`` from ``place + offsets[number, r]`` on.

    Parameters
    ----------
    block
        Rows and columns of the step.

    Returns
    -------
    Callable
        For kernels alone. It takes `weights` ``(blocks, depth, rows)``, `planes` ``(depth, N)`` and `sums`,
        1-D, all float32, and `offsets` ``(blocks, rows)`` intp, all with neighboring values next to each
        other. Nothing is checked.
    """
    lanes, rows, vectors = block
    number, bits = ir.FloatType(), ir.IntType(32)
    vector = ir.VectorType(number, lanes)

    @intrinsic
    def add_products(
        _context: Any, weights: Any, index: Any, planes: Any, first: Any, sums: Any, offsets: Any, place: Any
    ) -> Any:
        signature = types.void(weights, types.intp, planes, types.intp, sums, offsets, types.intp)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kinds = signature.args
            left, right, out, shifts = (
                context.make_array(kinds[place])(context, builder, arguments[place]) for place in (0, 2, 4, 5)
            )

            def whole(value: int) -> Any:
                return context.get_constant(types.intp, value)

            def address(array: Any, offset: Any, kind: Any) -> Any:
                data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
                return builder.bitcast(builder.gep(data, [offset]), kind.as_pointer())

            def load(array: Any, offset: Any, kind: Any) -> Any:
                value = builder.load(address(array, offset, kind))
                value.align = 8 if kind is index_kind else 4
                return value

            def spread(value: Any) -> Any:
                nothing = ir.Constant(vector, ir.Undefined)
                single = builder.insert_element(nothing, value, ir.Constant(bits, 0))
                return builder.shuffle_vector(
                    single, nothing, ir.Constant(ir.VectorType(bits, lanes), [0] * lanes)
                )

            def columns(offset: Any) -> list[Any]:
                return [builder.add(offset, whole(4 * lanes * part)) for part in range(vectors)]

            multiply_add = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fmuladd.v{lanes}f32"
            )
            index_kind = context.get_value_type(types.intp)
            depth = cgutils.unpack_tuple(builder, left.shape)[1]
            block_bytes = cgutils.unpack_tuple(builder, left.strides)[0]
            plane_bytes = cgutils.unpack_tuple(builder, right.strides)[0]
            start = builder.block
            weight_start = builder.mul(arguments[1], block_bytes)
            plane_start = builder.mul(arguments[3], whole(4))
            loop, done = builder.append_basic_block("depth"), builder.append_basic_block("sums")
            builder.branch(loop)
            builder.position_at_end(loop)
            count, weight, plane = (builder.phi(depth.type) for _ in range(3))
            totals = [[builder.phi(vector) for _ in range(vectors)] for _ in range(rows)]
            values = [load(right, offset, vector) for offset in columns(plane)]
            raised = []
            for row, line in enumerate(totals):
                factor = spread(load(left, builder.add(weight, whole(4 * row)), number))
                raised.append(
                    [builder.call(multiply_add, [factor, value, total]) for value, total in zip(values, line)]
                )
            steps = (count, whole(0), whole(1)), (weight, weight_start, whole(4 * rows)), (
                plane, plane_start, plane_bytes
            )  # fmt: skip
            for counter, origin, step in steps:
                counter.add_incoming(origin, start)
                counter.add_incoming(builder.add(counter, step), loop)
            for line, sums_of_line in zip(totals, raised):
                for total, more in zip(line, sums_of_line):
                    total.add_incoming(ir.Constant(vector, [0.0] * lanes), start)
                    total.add_incoming(more, loop)
            going_on = builder.icmp_signed("<", builder.add(count, whole(1)), depth)
            builder.cbranch(going_on, loop, done)
            builder.position_at_end(done)
            size = context.get_abi_sizeof(index_kind)
            of_block = builder.mul(arguments[1], whole(rows * size))
            for row, line in enumerate(raised):
                shift = load(shifts, builder.add(of_block, whole(row * size)), index_kind)
                origin = builder.mul(builder.add(arguments[6], shift), whole(4))
                for offset, more in zip(columns(origin), line):
                    known = load(out, offset, vector)
                    stored = builder.store(builder.fadd(known, more), address(out, offset, vector))
                    stored.align = 4
            return context.get_dummy_value()

        return signature, generate

    return add_products  # type: ignore[no-any-return]
