"""Write a trained network as a model file: ONNX with 8-bit weights, and its parameters as metadata."""

from __future__ import annotations

import contextlib
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vehicle_detection.network import FORMAT_VERSION, METADATA_KEY
from vehicle_detection.training.architecture import CENTER, SCALE, Deployed, Network
from vehicle_detection.training.frames import TrainingFrame
from vehicle_detection.training.pixel_groups import group_pixels

_OPSET = 17
_CALIBRATION_SIZE = 640, 352  # px
_CALIBRATION_FRAMES = 96


def export_network(
    network: Network,
    frames: Sequence[TrainingFrame],
    params: Mapping[str, Any],
    metadata: Mapping[str, Any],
    *,
    quantize: bool = True,
) -> bytes:
    """Return the model file of a network; some of the frames set the 8-bit ranges of its activations.

    The graph takes uint8 RGB images ``(1, H, W, 3)``, sides multiples of 32, and returns ``(1, 5, cells)``:
    center, width, height and probability of a box for each cell, as YOLOv8 does for one class. Weights have
    7 bits, so that sums of products fit into 16 bits on processors without VNNI; the output convolution stays
    float32, and without `quantize` everything does.
    """
    import onnx

    with tempfile.TemporaryDirectory() as folder:
        names = ("plain.onnx", "prepared.onnx", "int8.onnx")
        plain, prepared, small = (Path(folder) / name for name in names)
        width, height = _CALIBRATION_SIZE
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the exporter, about sizes that are traced as constants
            torch.onnx.export(
                Deployed(network.cpu()).eval(),
                (torch.zeros(1, height, width, 3),),
                plain,
                input_names=["image"],
                output_names=["boxes"],
                dynamic_axes={"image": {1: "height", 2: "width"}, "boxes": {2: "cells"}},
                opset_version=_OPSET,
                dynamo=False,
            )
        if quantize:
            _quantize(plain, prepared, small, frames)
        model = onnx.load(small if quantize else plain)
    _take_bytes(model)
    group_pixels(model.graph)
    model.producer_name, model.producer_version, model.doc_string = "vehicle_detection", "", ""
    onnx.checker.check_model(model)
    return set_metadata(model.SerializeToString(), params, metadata)


def set_metadata(content: bytes, params: Mapping[str, Any], metadata: Mapping[str, Any]) -> bytes:
    """Return a model file with other parameters and facts, see `export_network`."""
    import onnx

    model = onnx.load_model_from_string(content)
    del model.metadata_props[:]
    header = {"format_version": FORMAT_VERSION, "params": dict(params), "metadata": dict(metadata)}
    for key, value in ((METADATA_KEY, json.dumps(header, sort_keys=True)), ("names", "{0: 'vehicle'}")):
        model.metadata_props.add(key=key, value=value)
    return bytes(model.SerializeToString(deterministic=True))


def _quantize(plain: Path, prepared: Path, target: Path, frames: Sequence[TrainingFrame]) -> None:
    """Quantize weights and activations to 8 bits (static, symmetric weights per channel)."""
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        CalibrationMethod,
        QuantFormat,
        QuantType,
        quantize_static,
    )
    from onnxruntime.quantization.shape_inference import quant_pre_process

    chosen = np.linspace(0, len(frames) - 1, min(len(frames), _CALIBRATION_FRAMES)).astype(int)

    class Images(CalibrationDataReader):  # type: ignore[misc]
        def __len__(self) -> int:
            return len(chosen)

        def set_range(self, start_index: int, end_index: int) -> None:
            self._inputs = iter([_calibration_input(frames[row]) for row in chosen[start_index:end_index]])

        def get_next(self) -> dict[str, NDArray[np.float32]] | None:
            return next(self._inputs, None)

    quant_pre_process(plain, prepared, skip_symbolic_shape=True)
    nodes = onnx.load(prepared).graph.node
    # The output convolutions and all arithmetic of boxes stay float.
    weights = {each.name: each.dims for each in onnx.load(prepared).graph.initializer}
    convolutions = [node for node in nodes if node.op_type == "Conv"]
    last = [node.name for node in convolutions if weights[node.input[1]][0] == 5]
    others = [node.name for node in nodes if node.op_type not in ("Conv", "Relu", "Add", "Resize", "Slice")]
    after = _names_after(nodes, last)
    # The normalization of bytes: see `_take_bytes`.
    image = next(node.output[0] for node in nodes if node.op_type == "Transpose")
    normalized = {"scale": np.array(1 / SCALE, np.float32), "zero_point": np.array(CENTER, np.uint8)}
    with contextlib.redirect_stdout(None):  # of the calibration, a line for each frame
        quantize_static(
            prepared,
            target,
            Images(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            op_types_to_quantize=["Conv", "Relu", "Add", "Resize", "Slice", "Transpose"],
            calibrate_method=CalibrationMethod.Percentile,
            extra_options={
                "TensorQuantOverrides": {image: [{"quant_type": QuantType.QUInt8} | normalized]},
                "CalibStridedMinMax": 1,  # one frame's activations in memory at a time, with any method
            },
            nodes_to_exclude=[*last, *after, *(name for name in others if "Transpose" not in name)],
        )


def _names_after(nodes: Sequence[Any], first: Sequence[str]) -> list[str]:
    """Names of the nodes that depend on some nodes."""
    reached = {output for node in nodes if node.name in first for output in node.output}
    names = []
    for node in nodes:  # in the order of computation
        if reached & set(node.input):
            reached |= set(node.output)
            names.append(node.name)
    return names


def _calibration_input(frame: TrainingFrame) -> dict[str, NDArray[np.float32]]:
    image = cv2.resize(frame.image, _CALIBRATION_SIZE, interpolation=cv2.INTER_AREA)
    return {"image": ((image[None].astype(np.float32) - CENTER) / SCALE).astype(np.float32)}


def _take_bytes(model: Any) -> None:
    """Let the graph take uint8 images, whose normalization is a scale and a zero point."""
    import onnx

    graph = model.graph
    graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.UINT8
    transpose = next(node for node in graph.node if graph.input[0].name in node.input)
    image = transpose.output[0]
    for value in graph.value_info:
        if value.name == image:
            value.type.tensor_type.elem_type = onnx.TensorProto.UINT8
    readers = [node for node in graph.node if image in node.input]
    if readers[0].op_type == "QuantizeLinear":
        # Bytes are what this node would return.
        graph.node.remove(readers[0])
        following = next(node for node in graph.node if readers[0].output[0] in node.input)
        following.input[0] = image
        return
    names = [image, "image_scale", "image_zero_point"]
    constants = np.array(1 / SCALE, np.float32), np.array(CENTER, np.uint8)
    graph.initializer.extend(map(onnx.numpy_helper.from_array, constants, names[1:]))
    node = onnx.helper.make_node("DequantizeLinear", names, ["image_normalized"], name="normalize")
    readers[0].input[0] = node.output[0]
    graph.node.insert(list(graph.node).index(readers[0]), node)
