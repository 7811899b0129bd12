"""Sums of products in vector registers: the innermost step of the correlation, as an LLVM intrinsic.

A compiler keeps at most a vector or two of a sum in registers, and loads and stores them for every few
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
    features = binding.get_host_cpu_features()
    if features.get("avx512f"):
        return Block(16, 8, 3)
    if features.get("avx"):
        return Block(8, 4, 3)
    return Block(4, 8 if features.get("neon") else 4, 3)


def block_adder(block: Block) -> Callable[..., None]:
    """Build ``add_products(weights, index, channels, first, sums, offsets, position)`` for use in kernels.

    For each row `r` of the block it adds ``weights[index, :, r] @ channels[:, first : first + columns]`` to
    ``sums[position + offsets[index, r] :]``. `weights` is ``(blocks, depth, rows)``, `channels`
    ``(depth, N)``, `sums` 1-D, all float32, and `offsets` ``(blocks, rows)`` intp; all are C-contiguous.
    Nothing is checked.
    """
    lanes, rows, vectors = block
    float_type, int_type = ir.FloatType(), ir.IntType(32)
    vector = ir.VectorType(float_type, lanes)

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

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            left, right, out, shifts = (
                context.make_array(signature.args[number])(context, builder, arguments[number])
                for number in (0, 2, 4, 5)
            )

            def constant(value: int) -> Any:
                return context.get_constant(types.intp, value)

            def address(array: Any, offset: Any, kind: Any) -> Any:
                data = builder.bitcast(array.data, ir.IntType(8).as_pointer())
                return builder.bitcast(builder.gep(data, [offset]), kind.as_pointer())

            def load(array: Any, offset: Any, kind: Any) -> Any:
                value = builder.load(address(array, offset, kind))
                value.align = 8 if kind is index_type else 4
                return value

            def broadcast(value: Any) -> Any:
                undefined = ir.Constant(vector, ir.Undefined)
                single = builder.insert_element(undefined, value, ir.Constant(int_type, 0))
                zeros = ir.Constant(ir.VectorType(int_type, lanes), [0] * lanes)
                return builder.shuffle_vector(single, undefined, zeros)

            def vector_offsets(offset: Any) -> list[Any]:
                return [builder.add(offset, constant(4 * lanes * part)) for part in range(vectors)]

            multiply_add = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fmuladd.v{lanes}f32"
            )
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
                factor = broadcast(load(left, builder.add(weight, constant(4 * row)), float_type))
                updated.append(
                    [builder.call(multiply_add, [factor, value, total]) for value, total in zip(values, line)]
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
                    total.add_incoming(ir.Constant(vector, [0.0] * lanes), start)
                    total.add_incoming(new_total, loop)
            unfinished = builder.icmp_signed("<", builder.add(count, constant(1)), depth)
            builder.cbranch(unfinished, loop, done)
            builder.position_at_end(done)
            index_bytes = context.get_abi_sizeof(index_type)
            block_offset = builder.mul(arguments[1], constant(rows * index_bytes))
            for row, line in enumerate(updated):
                shift = load(shifts, builder.add(block_offset, constant(row * index_bytes)), index_type)
                origin = builder.mul(builder.add(arguments[6], shift), constant(4))
                for offset, total in zip(vector_offsets(origin), line):
                    known = load(out, offset, vector)
                    stored = builder.store(builder.fadd(known, total), address(out, offset, vector))
                    stored.align = 4
            return context.get_dummy_value()

        return signature, generate

    return add_products  # type: ignore[no-any-return]
