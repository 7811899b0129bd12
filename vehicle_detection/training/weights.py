"""Read the weights of a model file back into a network, to continue its training."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from vehicle_detection.errors import ModelFileError
from vehicle_detection.training.architecture import STRIDES, Network
from vehicle_detection.training.pixel_groups import narrow


def read_weights(graph: bytes, name: str) -> Network:
    """Return the network of a model file that `export_network` has written, in evaluation mode.

    Batch normalization is a part of the convolutions in the file. In the returned network, it only adds the
    bias of its convolution: with a running mean of 0 and a variance of 1, and a weight of 1. The outputs are
    those of the file up to the 8-bit rounding of its activations.
    """
    import onnx
    from google.protobuf.message import DecodeError

    try:
        constants = _Constants(onnx.load_model_from_string(graph).graph)
    except DecodeError as error:
        raise ModelFileError(f"{name} is no complete ONNX file; train from another model") from error
    network = Network()
    try:
        with torch.no_grad():
            _set_convolutions(network, constants)
            network.scale.copy_(torch.tensor(_level_scales(constants)))
    except (ArithmeticError, LookupError, RuntimeError, ValueError) as error:
        raise ModelFileError(
            f"{name} is not a network of this version's architecture ({error}); train from the model "
            "'default', or from a file that train-frames of this version has written"
        ) from error
    network.eval()
    return network


class _Constants:
    """The nodes of a graph by their outputs, and the values of its constants."""

    def __init__(self, graph: Any) -> None:
        import onnx

        self.nodes: Mapping[str, Any] = {output: node for node in graph.node for output in node.output}
        self._arrays = {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}
        for node in graph.node:
            if node.op_type == "Constant":
                self._arrays[node.output[0]] = onnx.numpy_helper.to_array(node.attribute[0].t)

    def array(self, name: str) -> Any:
        """Value of a constant; 8-bit and 32-bit integers are converted to what they stand for."""
        if name in self._arrays:
            return self._arrays[name]
        node = self.nodes[name]
        if node.op_type == "Identity":
            return self.array(node.input[0])
        if node.op_type != "DequantizeLinear":
            raise LookupError(f"{name} is no constant")
        value, scale, zero_point = (self.array(each) for each in node.input)
        shape = (-1,) + (1,) * (value.ndim - 1)  # one scale for each output channel
        difference = value.astype(np.float32) - zero_point.astype(np.float32).reshape(shape)
        return difference * scale.reshape(shape)


def _set_convolutions(network: Network, constants: _Constants) -> None:
    """Copy kernels and biases; the head occurs once for each level, with the same values."""
    read = {}
    for node in constants.nodes.values():
        if node.op_type == "Conv":
            read[_module_name(node.name)] = [constants.array(each) for each in node.input[1:]]
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            kernel, bias = read.pop(name)
            if kernel.shape[2:] == (3, 2):  # on groups of pixels
                kernel, bias = narrow(kernel, module.in_channels), bias[: module.out_channels]
            _copy(module.weight, kernel, name)
            parent, _, index = name.rpartition(".")
            target = module
            if module.bias is None:  # batch normalization follows
                target = network.get_submodule(f"{parent}.{int(index) + 1}")
                nn.init.ones_(target.weight)
                target.running_mean.zero_()
                target.running_var.fill_(1 - target.eps)
            _copy(target.bias, bias, name)
    if read:
        raise LookupError(f"unknown convolution {min(read)}")


def _copy(target: torch.Tensor | None, array: NDArray[np.float32], name: str) -> None:
    assert target is not None
    value = torch.from_numpy(array.copy())
    if target.shape != value.shape:
        raise ValueError(f"{name} has the shape {tuple(value.shape)}, expected {tuple(target.shape)}")
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name} has values that are not finite")
    target.copy_(value)


def _module_name(node: str) -> str:
    """Name of the module of a node, such as ``stem.2.first.0`` for ``/stem/stem.2/first/first.0/Conv``."""
    parts = node.strip("/").split("/")[:-1]
    last = [a for a, b in zip(parts, [*parts[1:], ""]) if not b.startswith(f"{a}.")]
    return re.sub(r"_\d+$", "", ".".join(last))  # the number of the level


def _level_scales(constants: _Constants) -> list[float]:
    """Factors of the distances of each level; factors of 1 may be absent from the graph."""
    scales: dict[int, float] = {}
    for node in constants.nodes.values():
        if node.op_type == "Softplus":
            scale, above = 1.0, constants.nodes[node.input[0]]
            while above.op_type != "Conv":
                if above.op_type == "Mul":
                    scale = float(constants.array(above.input[1]).reshape(()))
                above = constants.nodes[above.input[0]]
            suffix = re.search(r"_(\d+)/Conv$", above.name)
            scales[int(suffix[1]) if suffix else 0] = scale
    if sorted(scales) != list(range(len(STRIDES))):
        raise LookupError(f"{len(scales)} levels of boxes, expected {len(STRIDES)}")
    return [scales[level] for level in range(len(STRIDES))]
