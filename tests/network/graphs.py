"""Small ONNX graphs with the outputs of each kind of detector."""

import json

import numpy as np
from onnx import TensorProto, helper, numpy_helper

TYPES = {"uint8": TensorProto.UINT8, "float32": TensorProto.FLOAT, "float16": TensorProto.FLOAT16}
PARAMS = {"slope": 0.5, "offset": -0.25, "threshold": -0.5, "input_size": 640, "nms_iou": 0.6}


def serialize(nodes, inputs, outputs, initializers=(), metadata=None, opset=17):
    """An ONNX file of these nodes; inputs and outputs are ``(name, dtype, shape)``."""
    ports = [
        [helper.make_tensor_value_info(name, TYPES.get(dtype, dtype), shape) for name, dtype, shape in each]
        for each in (inputs, outputs)
    ]
    arrays = [numpy_helper.from_array(np.asarray(array), name) for name, array in initializers]
    graph = helper.make_graph(list(nodes), "network", *ports, arrays)
    domains = {node.domain for node in nodes if node.domain}
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(each, 1) for each in domains)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8)
    helper.set_model_props(model, metadata or {})
    return model.SerializeToString()


def own_network(seed=0, *, size=("height", "width"), weights=None, params=None, version=1):
    """A network of the library's own kind with random weights, of stride 32."""
    rng = np.random.default_rng(seed)
    kernel = rng.normal(0, 0.02, (5, 3, 32, 32)).astype(np.float32)
    kernel[:4] *= 1.5
    kernel[4] *= 2
    bias = np.array([0, 0, 4, 4, 0.3], np.float32)
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Sub", ["float", "gray"], ["centered"]),
        helper.make_node("Mul", ["centered", "factor"], ["scaled"]),
        helper.make_node("Transpose", ["scaled"], ["planes"], perm=[0, 3, 1, 2]),
        helper.make_node("Conv", ["planes", "kernel", "bias"], ["maps"], strides=[32, 32]),
        helper.make_node("Reshape", ["maps", "flat"], ["columns"]),
        helper.make_node("Split", ["columns", "parts"], ["centers", "sides", "logits"], axis=1),
        # Centers: positions spread over the input by the number of the column.
        helper.make_node("Mul", ["centers", "spread"], ["moved"]),
        helper.make_node("Add", ["moved", "middle"], ["xy"]),
        helper.make_node("Exp", ["sides"], ["wh"]),
        helper.make_node("Sigmoid", ["logits"], ["p"]),
        helper.make_node("Concat", ["xy", "wh", "p"], ["boxes"], axis=1),
    ]
    header = {"format_version": version, "params": params or PARAMS, "metadata": {"frames": 12}}
    initializers = [
        ("gray", np.float32(115)), ("factor", np.float32(1 / 64)),
        ("kernel", kernel if weights is None else np.full_like(kernel, weights)), ("bias", bias),
        ("flat", np.array([1, 5, -1])), ("parts", np.array([2, 2, 1])), ("spread", np.float32(60)),
        ("middle", np.float32(160)),
    ]  # fmt: skip
    return serialize(
        nodes,
        [("image", "uint8", [1, *size, 3])],
        [("boxes", "float32", [1, 5, "n"])],
        initializers,
        {"vehicle_detection": json.dumps(header)},
    )


def spot_network():
    """A network of the library's own kind that finds bright spots: boxes of 64 px around squares of 32 px."""
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["float"], ["planes"], perm=[0, 3, 1, 2]),
        helper.make_node("Conv", ["planes", "mean", "offset"], ["logits"], strides=[32, 32]),
        helper.make_node("Sigmoid", ["logits"], ["p"]),
        # Positions of the cells: sums of ones along each axis.
        helper.make_node("Mul", ["logits", "zero"], ["zeros"]),
        helper.make_node("Add", ["zeros", "stride"], ["strides"]),
        helper.make_node("CumSum", ["strides", "horizontal"], ["right"]),
        helper.make_node("CumSum", ["strides", "vertical"], ["bottom"]),
        helper.make_node("Sub", ["right", "half"], ["x"]),
        helper.make_node("Sub", ["bottom", "half"], ["y"]),
        helper.make_node("Add", ["strides", "stride"], ["side"]),
        helper.make_node("Concat", ["x", "y", "side", "side", "p"], ["maps"], axis=1),
        helper.make_node("Reshape", ["maps", "flat"], ["boxes"]),
    ]
    initializers = [
        ("mean", np.full((1, 3, 32, 32), 0.1 / (3 * 32 * 32), np.float32)),
        ("offset", np.array([-0.1 * 180], np.float32)), ("zero", np.float32(0)), ("stride", np.float32(32)),
        ("half", np.float32(16)), ("horizontal", np.array(3)), ("vertical", np.array(2)),
        ("flat", np.array([1, 5, -1])),
    ]  # fmt: skip
    params = PARAMS | {"slope": 1.0, "offset": 0.0, "threshold": 0.0}
    header = {"format_version": 1, "params": params, "metadata": {}}
    ports = [("image", "uint8", [1, "height", "width", 3])], [("boxes", "float32", [1, 5, "n"])]
    return serialize(nodes, *ports, initializers, {"vehicle_detection": json.dumps(header)})


def constant_network(
    outputs, *, size=(96, 96), dtype="float32", layout="NCHW", metadata=None, dynamic=False, sizes=False
):
    """A network whose outputs are these arrays by name, whatever the image.

    With `sizes`, it has a second input, the size of the image to which boxes are scaled.
    """
    spatial = ["height", "width"] if size is None else list(size)
    shape = [1, 3, *spatial] if layout == "NCHW" else [1, *spatial, 3]
    inputs = [("images", dtype, shape)]
    nodes = [
        helper.make_node("Cast", ["images"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["float"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
    ]
    if sizes:
        inputs.append(("orig_target_sizes", TensorProto.INT64, [1, 2]))
        nodes.append(helper.make_node("Tile", ["orig_target_sizes", "twice"], ["four"]))
        nodes.append(helper.make_node("Cast", ["four"], ["factors"], to=TensorProto.FLOAT))
    initializers = [("zero", np.float32(0)), ("twice", np.array([1, 2]))]
    ports = []
    for name, values in outputs.items():
        values = np.asarray(values)
        initializers.append((f"{name} values", values))
        if values.dtype == np.int64:
            nodes.append(helper.make_node("Identity", [f"{name} values"], [name]))
            kind = TensorProto.INT64
        elif sizes and name == "boxes":
            nodes.append(helper.make_node("Mul", [f"{name} values", "factors"], [name]))
            kind = "float32"
        else:
            nodes.append(helper.make_node("Add", [f"{name} values", "nothing"], [name]))
            kind = "float32"
        shape = [f"{name} {axis}" for axis in range(values.ndim)] if dynamic else values.shape
        ports.append((name, kind, shape))
    return serialize(nodes, inputs, ports, initializers, metadata)


def echo_network(*, dtype="float32", layout="NCHW", size=(64, 64)):
    """A network whose only box has the mean of each channel, 0 to 1 or 0 to 255, as its coordinates."""
    axes = [2, 3] if layout == "NCHW" else [1, 2]
    shape = [1, 3, *size] if layout == "NCHW" else [1, *size, 3]
    nodes = [
        helper.make_node("Cast", ["images"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["float"], ["means"], axes=axes, keepdims=0),
        helper.make_node("Reshape", ["means", "column"], ["channels"]),
        helper.make_node("Concat", ["channels", "rest"], ["one"], axis=1),
        helper.make_node("Tile", ["one", "times"], ["output0"]),
    ]
    initializers = [
        ("column", np.array([1, 3, 1])),
        ("rest", np.float32([[[10], [0.9]]])),
        ("times", np.array([1, 1, 84])),
    ]
    return serialize(nodes, [("images", dtype, shape)], [("output0", "float32", [1, 5, 84])], initializers)
