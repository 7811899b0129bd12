"""A small convolutional network: all layers in one compiled call."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple, cast

import numba
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace, with_spare
from vehicle_detection._kernels.jit import compiles, inlined, jit
from vehicle_detection._kernels.vector import block_adder, byte_block, float_block

Singles = NDArray[np.float32]

_BLOCK = float_block()
_LANES = _BLOCK.lanes
_add_products = block_adder(_BLOCK, byte_block())
# For at most one vector of each row.
_add_few = block_adder(_BLOCK._replace(vectors=1), byte_block())


class Convolution(NamedTuple):
    """A layer of a network."""

    weights: Singles  # (outputs, rows, columns, channels), as many rows as columns
    bias: Singles  # (outputs,)
    stride: int


class ConvolutionalNetwork:
    """Layers of convolutions with rectified outputs, except for the last, which has one row and column.

    The outputs for an image do not depend on the others, and one thread computes them; except where the
    kernel does not compile, so that numpy computes them.

    >>> layer = Convolution(np.ones((1, 2, 2, 1), np.float32), np.float32([1]), 1)
    >>> ConvolutionalNetwork([layer])(np.ones((2, 1, 2, 3), np.float32))
    array([[5., 5., 5.]], dtype=float32)
    """

    def __init__(self, layers: Sequence[Convolution]) -> None:
        self._layers = layers
        table, weights, biases = [], [], []
        sizes = [0, 0]
        for layer in layers:
            outputs, side, _, channels = layer.weights.shape
            blocks = -(-outputs // _BLOCK.rows)
            padding = blocks * _BLOCK.rows - outputs
            table.append((*sizes, blocks, outputs, channels, side, layer.stride))
            # The rows of a block are reversed.
            weights_by_phase = layer.weights[:, :, _phases(side, layer.stride)]
            padded = np.pad(weights_by_phase, ((0, padding), (0, 0), (0, 0), (0, 0)))
            split = padded.reshape(blocks, _BLOCK.rows, side, side, channels)[:, ::-1]
            weights.append(split.transpose(0, 2, 3, 4, 1).ravel())
            biases.append(np.pad(layer.bias, (0, padding)))
            sizes = [sizes[0] + padded.size, sizes[1] + len(biases[-1])]
        self._table = np.array(table, np.int64)
        self._weights, self._biases = (np.concatenate(each).astype(np.float32) for each in (weights, biases))

    def __call__(self, images: Singles, workspace: Workspace = NEW_ARRAYS) -> Singles:
        """Return ``(outputs, N)`` of square images ``(rows, channels, columns, N)``.

        With a workspace, they are valid until the next call in the same thread.
        """
        if not _compiles():
            return self._run_plain(images)
        side, count = images.shape[0], images.shape[-1]
        if self._layers[0].stride > 1:
            images = images[:, :, _phases(side, self._layers[0].stride)]
        memory = self._memory(side, count, workspace)
        weights = self._table, self._weights, self._biases
        values = with_spare(images).reshape(-1)
        outputs = _run_layers(values, side, count, *weights, _BLOCK.rows, _BLOCK.columns, *memory)
        return cast("Singles", outputs)

    def _memory(self, side: int, count: int, workspace: Workspace) -> list[Singles]:
        """Memory for the sums of a row of a layer, and for the outputs of every other layer."""
        sizes = [0, 0, 0]
        for number, (blocks, outputs, _, kernel, stride) in enumerate(self._table[:, 2:].tolist()):
            side = (side - kernel) // stride + 1
            sizes[0] = max(sizes[0], blocks * _BLOCK.rows * (side * count + _BLOCK.columns))
            sizes[1 + number % 2] = max(sizes[1 + number % 2], side * outputs * side * count)
        names = "sums", "even layers", "odd layers"
        return [workspace.take((size,), np.float32, name) for size, name in zip(sizes, names)]

    def _run_plain(self, images: Singles) -> Singles:
        """Compute the outputs with numpy."""
        values = images.transpose(1, 0, 2, 3)
        for number, (weights, bias, stride) in enumerate(self._layers, 1):
            side = weights.shape[1]
            cells = sliding_window_view(values, (side, side), axis=(1, 2))[:, ::stride, ::stride]
            values = np.tensordot(weights, cells, axes=((1, 2, 3), (4, 5, 0))) + bias[:, None, None, None]
            if number < len(self._layers):
                values = np.maximum(values, 0)
        return values[:, 0, 0]


def _phases(columns: int, stride: int) -> NDArray[np.intp]:
    """List columns so that those of each phase of a stride lie together: 0, 2, 4, ..., 1, 3, 5, ..."""
    return np.argsort(np.arange(columns) % stride, kind="stable")


@functools.cache
def _compiles() -> bool:
    line, size = numba.float32[::1], numba.intp
    arguments = line, size, size, numba.int64[:, ::1], line, line, size, size, line, line, line
    return compiles(_run_layers, *arguments)


@jit
def _run_layers(values, side, count, table, weights, biases, block, tile, sums, even, odd):
    """Compute the outputs of a `ConvolutionalNetwork`, row by row of each layer.

    `values` are those of `count` images, ``(rows, channels, columns, count)``: a row of outputs is a sum of
    shifted rows of values. The columns are in the order of `_phases` for the stride of the next layer. Values
    are read up to a tile beyond the end of a row, also of the last one; sums of them are not used.

    `table` lists for each layer the places of its weights and biases, the blocks of `block` outputs, the
    outputs, the channels, the side of the kernel, and the stride. `tile` is the columns of a block. `sums`,
    `even` and `odd` are memory for the sums of a row of a layer, and for the outputs of every other layer.
    """
    for number in range(len(table)):
        first, first_bias, blocks, outputs, channels, kernel, stride = table[number]
        taps = kernel * kernel
        factors = weights[first : first + blocks * taps * channels * block]
        factors = factors.reshape(blocks * taps, channels, block)
        across = (side - kernel) // stride + 1
        length = across * count + tile
        found = odd if number % 2 else even
        last = number + 1 == len(table)
        next_stride = 1 if last else table[number + 1, 6]
        lowest = np.float32(-np.inf if last else 0)
        for y in range(across):
            for place in range(blocks * block * length):
                sums[place] = 0
            for x in range(0, across * count, tile):
                for part in range(blocks):
                    position = (part * block + block - 1) * length + x
                    tap = part * taps
                    for i in range(kernel):
                        start = (y * stride + i) * channels * side * count + x
                        for phase in range(stride):
                            stop = tap + (kernel - phase + stride - 1) // stride
                            place = start + _place(phase, side, stride) * count
                            step = side * count
                            if tap < stop and across * count - x > _LANES:
                                _add_products(
                                    factors, tap, stop, values, place, step, count, sums, position, length
                                )
                            elif tap < stop:
                                _add_few(
                                    factors, tap, stop, values, place, step, count, sums, position, length
                                )
                            tap = stop
            for output in range(outputs):
                bias = biases[first_bias + output]
                for x in range(across):
                    place = (y * outputs + output) * across + _place(x, across, next_stride)
                    source = sums[output * length + x * count : output * length + (x + 1) * count]
                    target = found[place * count : (place + 1) * count]
                    for n in range(count):
                        value = source[n] + bias
                        target[n] = lowest if value < lowest else value
        values, side = found, across
    return values[: outputs * count].reshape(outputs, count)


@inlined
def _place(column, columns, stride):
    """Place of a column in the order of `_phases`."""
    phase = column % stride
    return phase * (columns // stride) + min(phase, columns % stride) + column // stride
