"""First convolutions on groups of pixels: the same results in less time.

Inference libraries copy the pixels of each window before they multiply, which takes longer than to multiply
if a pixel has few channels. Here the values of neighboring pixels of a row are the channels of one group. The
first convolution takes groups of four pixels, 12 channels in place of 3, and returns two pixels at once; the
second takes these pairs and returns single pixels. Kernels have zeros where a group has a pixel that the
window does not cover.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_GROUPS = (4, 2)
"""Pixels in a group of the input of the first and of the second convolution, both 3x3 with stride 2."""

# A window reaches from the group before, whose last pixel it covers, to its own group.
_WINDOW = {"kernel_shape": [3, 2], "strides": [2, 1], "pads": [1, 1, 1, 0]}


def group_pixels(graph: Any) -> None:
    """Let the first two convolutions of an ONNX graph work on groups of pixels.

    The graph takes images ``(1, H, W, 3)``, `W` a multiple of 4, of which a Transpose makes channels first.
    """
    import onnx

    arrays = {each.name: each for each in graph.initializer}
    makers = {output: node for node in graph.node for output in node.output}
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    for node, pixels in zip(convolutions, _GROUPS):
        # Kernel and bias, or their 8-bit values with scales and zero points of each output channel.
        for name in (part for each in node.input[1:] for part in _constants(each, makers)):
            value = onnx.numpy_helper.to_array(arrays[name])
            value = widen(value, pixels) if value.ndim == 4 else np.tile(value, pixels // 2)
            arrays[name].CopyFrom(onnx.numpy_helper.from_array(value, name))
        kept = [each for each in node.attribute if each.name not in _WINDOW]
        del node.attribute[:]
        node.attribute.extend([*kept, *(onnx.helper.make_attribute(*each) for each in _WINDOW.items())])
    image = graph.input[0].name
    transpose = next(node for node in graph.node if image in node.input)
    shape = np.array([1, 0, -1, 3 * _GROUPS[0]])  # 0: as it is, -1: what is left
    graph.initializer.append(onnx.numpy_helper.from_array(shape, "image_groups_shape"))
    node = onnx.helper.make_node("Reshape", [image, "image_groups_shape"], ["image_groups"], name="group")
    transpose.input[0] = node.output[0]
    graph.node.insert(0, node)
    del graph.value_info[:]  # shapes of intermediate results, which have changed


def _constants(name: str, makers: dict[str, Any]) -> list[str]:
    """Names of the arrays that a constant input of a node is made of."""
    return list(makers[name].input) if name in makers else [name]


def widen(kernel: NDArray[Any], pixels: int) -> NDArray[Any]:
    """Return the kernel on groups of pixels of a 3x3 kernel with stride 2.

    ``(outputs, inputs, 3, 3)`` becomes ``(pixels / 2 * outputs, pixels * inputs, 3, 2)``.
    """
    outputs, inputs, rows, _ = kernel.shape
    wide = np.zeros((pixels // 2, outputs, pixels, inputs, rows, 2), kernel.dtype)
    for position in range(pixels // 2):
        for column in range(3):
            group, pixel = divmod(pixels + 2 * position + column - 1, pixels)
            wide[position, :, pixel, ..., group] = kernel[..., column]
    return wide.reshape(-1, pixels * inputs, rows, 2)


def narrow(kernel: NDArray[Any], inputs: int) -> NDArray[Any]:
    """Return the 3x3 kernel of a kernel of `widen`, given its number of input channels."""
    pixels = kernel.shape[1] // inputs
    first = kernel[: len(kernel) * 2 // pixels].reshape(-1, pixels, inputs, kernel.shape[2], 2)
    return np.stack([first[:, -1, ..., 0], first[:, 0, ..., 1], first[:, 1, ..., 1]], axis=-1)
