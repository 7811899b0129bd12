"""The library compared with other detectors on the same frame and the same cores.

The others run in an environment of their own, which is created once, because OpenCV 5 has no HOG detector any
more. The neural network has the size of current "nano" detectors and random weights: its speed does not
depend on them, and nothing is downloaded but the packages.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skimage.feature import hog

from benchmarks._material import Context, searched_frame
from benchmarks._report import Row
from benchmarks._timing import median_of, median_seconds
from vehicle_detection import VehicleDetector

PACKAGES = ("opencv-python-headless<5", "onnx", "onnxruntime")
_CALLS, _ROUNDS = 15, 5

# Runs in the environment of the others: `frame.npy` and the number of threads in, milliseconds out.
_OTHERS = r"""
import json, sys, time
import cv2, numpy as np, onnx, onnxruntime
from onnx import TensorProto, helper, numpy_helper

frame, threads = np.load(sys.argv[1]), int(sys.argv[2])
cv2.setNumThreads(threads)
rng = np.random.default_rng(0)
nodes, weights, operations = [], [], 0


def convolve(name, source, height, width, inputs, outputs, stride=1, size=3, activate=True):
    global operations
    values = rng.normal(0, (2 / (inputs * size * size)) ** 0.5, (outputs, inputs, size, size))
    weights.append(numpy_helper.from_array(values.astype(np.float32), f"{name}_w"))
    pads = [size // 2] * 4
    nodes.append(helper.make_node("Conv", [source, f"{name}_w"], [name], kernel_shape=[size] * 2,
                                  strides=[stride] * 2, pads=pads))
    operations += 2 * (height // stride) * (width // stride) * inputs * outputs * size * size
    if activate:  # x * sigmoid(x)
        nodes.append(helper.make_node("Sigmoid", [name], [f"{name}_s"]))
        nodes.append(helper.make_node("Mul", [name, f"{name}_s"], [f"{name}_a"]))
        return f"{name}_a"
    return name


height, width = 384, 640
x, h, w, depth, outputs = "image", height, width, 3, []
for stage, (channels, blocks) in enumerate([(16, 0), (32, 4), (64, 8), (128, 8), (256, 4)]):
    x = convolve(f"down{stage}", x, h, w, depth, channels, stride=2)
    h, w, depth = h // 2, w // 2, channels
    for block in range(blocks):
        y = convolve(f"half{stage}_{block}", x, h, w, depth, depth // 2, size=1)
        y = convolve(f"full{stage}_{block}", y, h, w, depth // 2, depth)
        nodes.append(helper.make_node("Add", [x, y], [f"sum{stage}_{block}"]))
        x = f"sum{stage}_{block}"
    if stage >= 2:
        y = convolve(f"head{stage}", convolve(f"neck{stage}", x, h, w, depth, 64), h, w, 64, 64)
        outputs.append((convolve(f"out{stage}", y, h, w, 64, 84, size=1, activate=False), h, w))
graph = helper.make_graph(
    nodes, "nano",
    [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])],
    [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 84, rows, columns])
     for name, rows, columns in outputs],
    weights,
)
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
onnx.checker.check_model(model)
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = threads
session = onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
network = cv2.dnn.readNetFromONNX(np.frombuffer(model.SerializeToString(), np.uint8))
people = cv2.HOGDescriptor()
people.setSVMDetector(cv2.HOGDescriptor_getDefaultPeopleDetector())


def blob():
    return cv2.dnn.blobFromImage(frame, 1 / 255, (width, height))


def run_dnn():
    network.setInput(blob())
    network.forward(network.getUnconnectedOutLayersNames())


def milliseconds(function):
    function()
    times = []
    for _ in range(15):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return sorted(times)[7] * 1e3


print(json.dumps({
    "gflop": operations / 1e9,
    "parameters": sum(int(np.prod(each.dims)) for each in weights),
    "onnxruntime": milliseconds(lambda: session.run(None, {"image": blob()})),
    "dnn": milliseconds(run_dnn),
    "hog": milliseconds(lambda: people.detectMultiScale(frame)),
}))
"""


def run(context: Context) -> list[Row]:
    """Measure every detector with one and with two threads."""
    frame, source = searched_frame()
    np.save(context.work / "frame.npy", frame)
    python = _environment()
    rows: list[Row] = []
    for threads in (1, 2):
        cores = "one core" if threads == 1 else "two cores"
        # In turns, because other work on the machine slows down some of them.
        rounds = [_measure_all(python, context.work / "frame.npy", frame, threads) for _ in range(_ROUNDS)]
        for name in rounds[0]:
            found = median_of(each[name] for each in rounds)
            rows.append(Row(f"{name}, {cores}", found, unit="ms", material="" if rows else source))
    gray = frame.mean(axis=2)
    seconds = median_seconds(lambda: hog(gray, 9, (8, 8), (2, 2), feature_vector=False), 3)
    return [*rows, Row("scikit-image's HOG of the gray frame alone", seconds * 1e3, unit="ms")]


def _measure_all(python: Path, path: Path, frame: NDArray[np.uint8], threads: int) -> dict[str, float]:
    """Milliseconds of each detector; `path` is the file of the frame."""
    found = {}
    for model in ("default", "highway"):
        with VehicleDetector(model, jobs=threads) as detector:
            seconds = median_seconds(partial(detector.detect, frame), _CALLS)
        found[f"{model}: detect"] = seconds * 1e3
    others = _measure_others(python, path, threads)
    size = f"{others['gflop']:.1f} GFLOP, {others['parameters'] / 1e6:.1f} million weights, 384x640"
    return found | {
        f"neural network ({size}), onnxruntime": others["onnxruntime"],
        "the same network, OpenCV dnn": others["dnn"],
        "OpenCV's HOG detector of pedestrians": others["hog"],
    }


def _environment() -> Path:
    """Create the environment of the others, or find it; return its interpreter."""
    folder = Path(tempfile.gettempdir()) / "vehicle-detection-benchmarks" / "peers"
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if not (folder / "complete").exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", *PACKAGES], check=True)
        (folder / "complete").touch()
    return python


def _measure_others(python: Path, frame: Path, threads: int) -> dict[str, float]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(python), "-c", _OTHERS, str(frame), str(threads)],
        env=environment | {"OMP_NUM_THREADS": str(threads)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found
