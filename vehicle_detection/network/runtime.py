"""One interface over the inference libraries: onnxruntime, and OpenVINO where it is faster.

OpenVINO is used if it is installed and the processor multiplies bfloat16 or 8-bit matrices (AMX), which makes
it about twice as fast. On other processors, the two are equally fast, and onnxruntime starts sooner.
"""

from __future__ import annotations

import functools
import importlib.util
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, resolve_jobs, shorten
from vehicle_detection.errors import DetectorError, InvalidInputError, ModelFileError

Array = NDArray[Any]
Device = Literal["cpu", "cuda"]
Runtime = Literal["auto", "onnxruntime", "openvino"]

# Compiled models that OpenVINO keeps, one for each size of the input.
_MAX_COMPILED = 4


@dataclass(frozen=True)
class Port:
    """An input or output of a graph; None in `shape` stands for any size."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str


@dataclass(frozen=True)
class GraphFacts:
    """What an ONNX file says about itself; `name` is how messages refer to it."""

    name: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: dict[str, str]


class Session(Protocol):
    """A graph that is ready to run, in several threads at once."""

    def run(self, inputs: dict[str, Array]) -> list[Array]:
        """Compute all outputs, given an array for the name of each input."""

    def close(self) -> None:
        """Release threads and memory."""


def open_session(
    graph: bytes, name: str, *, jobs: int | None = None, device: Device = "cpu", runtime: Runtime = "auto"
) -> Session:
    """Make a graph ready to run on a device, with a number of threads that share one run.

    A `ModelFileError` is raised if the file is damaged, no ONNX file, or needs other files or operators.
    """
    n_threads = resolve_jobs(jobs)
    check_device(device, runtime)
    has_openvino = importlib.util.find_spec("openvino") is not None
    is_faster = runtime == "auto" and has_openvino and _multiplies_matrices()
    if device == "cpu" and (runtime == "openvino" or is_faster):
        return _OpenVinoSession(graph, name, n_threads)
    return _OnnxSession(graph, name, n_threads, device)


def read_facts(graph: bytes, name: str) -> GraphFacts:
    """Return inputs, outputs and metadata of an ONNX file; raises as `open_session` does."""
    session = _onnx_session(graph, name, 1, "cpu", optimize=False)
    inputs, outputs = (
        tuple(_port(each) for each in ports) for ports in (session.get_inputs(), session.get_outputs())
    )
    return GraphFacts(name, inputs, outputs, dict(session.get_modelmeta().custom_metadata_map))


def check_device(device: Device, runtime: Runtime) -> None:
    """Raise unless the device and the library are known and available."""
    check.choice(device, "device", ("cpu", "cuda"))
    check.choice(runtime, "runtime", ("auto", "onnxruntime", "openvino"))
    if runtime == "openvino" and importlib.util.find_spec("openvino") is None:
        raise InvalidInputError(
            "runtime 'openvino' needs the package openvino, which is not installed; run "
            "pip install 'vehicle-detection[openvino]', or omit runtime"
        )
    if device == "cpu":
        return
    if runtime == "openvino":
        raise InvalidInputError("runtime must be 'onnxruntime' with device 'cuda', got 'openvino'; omit it")
    import onnxruntime

    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        raise InvalidInputError(
            "device 'cuda' needs onnxruntime with CUDA, which is not installed; run pip uninstall "
            "onnxruntime and pip install onnxruntime-gpu, or omit device"
        )


@functools.cache
def _multiplies_matrices(cpu_info: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor multiplies bfloat16 and 8-bit matrices."""
    try:
        return "amx_tile" in cpu_info.read_text()
    except OSError:  # not Linux
        return False


def _onnx_session(graph: bytes, name: str, n_threads: int, device: Device, *, optimize: bool = True) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = n_threads, 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4  # nothing is printed: errors are raised
    # Idle threads that spin would take time from the tracker and the encoder.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if not optimize:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    providers = ["CUDAExecutionProvider"] * (device == "cuda") + ["CPUExecutionProvider"]
    session = _open(name, lambda: onnxruntime.InferenceSession(graph, options, providers=providers))
    if session.get_providers()[0] != providers[0]:
        raise InvalidInputError(
            "device 'cuda' cannot be used: onnxruntime found no working GPU, driver or CUDA libraries; "
            "run nvidia-smi, or omit device"
        )
    return session


def _port(port: Any) -> Port:
    shape = tuple(side if isinstance(side, int) and side > 0 else None for side in port.shape)
    dtype = port.type.removeprefix("tensor(").removesuffix(")")
    return Port(port.name, shape, {"float": "float32", "double": "float64"}.get(dtype, dtype))


class _OnnxSession:
    def __init__(self, graph: bytes, name: str, n_threads: int, device: Device) -> None:
        self._name, self._session = name, _onnx_session(graph, name, n_threads, device)

    def run(self, inputs: dict[str, Array]) -> list[Array]:
        session = self._session
        return _run(self._name, inputs, lambda: list(session.run(None, inputs)))

    def close(self) -> None:
        self._session = None


class _OpenVinoSession:
    def __init__(self, graph: bytes, name: str, n_threads: int) -> None:
        import openvino

        self._name, self._core = name, openvino.Core()
        self._config: dict[str, Any] = {
            "INFERENCE_NUM_THREADS": n_threads,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,
        }
        if not _multiplies_matrices():  # bfloat16 is no faster there, and less exact
            self._config["INFERENCE_PRECISION_HINT"] = "f32"
        self._model = _open(name, lambda: self._core.read_model(graph, b""))
        self._lock = threading.Lock()
        # By the shapes of the inputs: a compiled model and its idle requests.
        self._compiled: dict[tuple[tuple[int, ...], ...], tuple[Any, list[Any]]] = {}

    def run(self, inputs: dict[str, Array]) -> list[Array]:
        return _run(self._name, inputs, lambda: self._infer(inputs))

    def _infer(self, inputs: dict[str, Array]) -> list[Array]:
        with self._lock:
            compiled, idle = self._compile(inputs)
            request = idle.pop() if idle else compiled.create_infer_request()
        request.infer(inputs, share_inputs=True)
        outputs = [np.array(request.get_output_tensor(index).data) for index in range(len(compiled.outputs))]
        idle.append(request)
        return outputs

    def _compile(self, inputs: dict[str, Array]) -> tuple[Any, list[Any]]:
        """Compile the model for inputs of these shapes, which is faster than for any shape."""
        shapes = tuple(each.shape for each in inputs.values())
        if shapes not in self._compiled:
            model = self._model.clone()
            model.reshape({each: list(array.shape) for each, array in inputs.items()})
            while len(self._compiled) >= _MAX_COMPILED:
                self._compiled.pop(next(iter(self._compiled)))
            self._compiled[shapes] = self._core.compile_model(model, "CPU", self._config), []
        return self._compiled[shapes]

    def close(self) -> None:
        with self._lock:
            self._compiled.clear()
        self._model = self._core = None


def _open(name: str, build: Callable[[], Any]) -> Any:
    """Build a session; the errors of the libraries, of many classes, become one with a remedy."""
    try:
        return build()
    except Exception as error:
        text = " ".join(str(error).split())
        raise ModelFileError(f"{name} {_explain(text)} ({shorten(text, 160)})") from error


def _explain(text: str) -> str:
    lower = text.lower()
    if "ir version" in lower or "opset" in lower:
        return "is too new for this onnxruntime; update onnxruntime, or export it with a lower opset"
    if "external data" in lower or "external_data" in lower or "model_path" in lower:
        return "has its weights in another file; store them in the file: onnx.save(onnx.load(path), target)"
    if "not a registered" in lower or "no op registered" in lower or "not implemented" in lower:
        return "needs operators that are not part of ONNX; export it with standard operators"
    if "protobuf" in lower or "parse" in lower or "unable to read the model" in lower:
        return "is not a complete ONNX file; download or export it again"
    return "cannot be used as a network; export it again"


def _run(name: str, inputs: dict[str, Array], infer: Callable[[], list[Array]]) -> list[Array]:
    try:
        return infer()
    except Exception as error:
        shape, text = next(iter(inputs.values())).shape, shorten(" ".join(str(error).split()), 160)
        raise DetectorError(
            f"{name} failed on an input of shape {shape}: {text}; pass another input_size, or export the "
            "network with a fixed size"
        ) from error
