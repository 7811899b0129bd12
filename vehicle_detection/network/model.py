"""The model of a network: an ONNX file, how to run it, and the calibration of its probabilities."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Floats,
    Limit,
    atomic_write,
    check_choice,
    check_path,
    check_sequence,
    describe,
    read_regular_file,
    store_number,
)
from vehicle_detection.boxes import Platt, logit
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.network.inputs import InputFormat, Size
from vehicle_detection.network.outputs import OutputFormat, class_names, recognize, usual_names
from vehicle_detection.network.runtime import (
    Array,
    Device,
    GraphFacts,
    Port,
    Runtime,
    check_device,
    open_session,
    read_facts,
)
from vehicle_detection.network.search import NetworkSearch, to_log_odds, to_probability
from vehicle_detection.params import NetworkParams

METADATA_KEY = "vehicle_detection"
"""Key of the ONNX metadata with the parameters of a network of this library, as JSON."""

FORMAT_VERSION = 1
"""Version of that JSON."""

VEHICLE_CLASSES = ("car", "truck", "bus", "van", "vehicle")
"""Names of the classes that count as vehicles by default."""

# Side of the input on which a network without fixed sizes is tried once, and that it has by default.
_PROBE_SIZE, _INPUT_SIZE = 320, 640
_SHIPPED = "default"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class NetworkModel:
    """A network that finds vehicles; `load_network` creates it.

    Attributes
    ----------
    graph, name
        Content of the ONNX file, and how messages refer to it.
    input_format, output_format
        How to make its input, and to decode its outputs.
    input_size
        Longer side of its input in pixels, unless `NetworkParams` has one.
    classes
        Names of the classes by their numbers; None if they are unknown.
    class_ids
        Numbers of the classes to keep; None: all.
    slope, offset
        Platt scaling: ``slope * logit(p) + offset`` is the log-odds that a box contains a vehicle, given its
        probability in the network's output.
    threshold
        Minimum log-odds of a vehicle.
    nms_iou
        IoU above which the less probable box is dropped.
    device, runtime
        Arguments of `load_network`.
    metadata
        Training facts stored in the file, or its ONNX metadata.

    Examples
    --------
    >>> model = load_network("default")
    >>> model.input_size, model.classes
    (640, {0: 'vehicle'})
    """

    search_params_type: ClassVar[type[NetworkParams]] = NetworkParams
    searches_every_frame: ClassVar[bool] = False

    graph: bytes
    name: str
    input_format: InputFormat
    output_format: OutputFormat
    extra_inputs: tuple[Port, ...] = ()
    input_name: str = "image"
    input_size: int = _INPUT_SIZE
    classes: Mapping[int, str] | None = None
    class_ids: NDArray[np.intp] | None = None
    slope: float = 1.0
    offset: float = 0.0
    threshold: float = 0.0
    nms_iou: float = 0.6
    device: Device = "cpu"
    runtime: Runtime = "auto"
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        store_number(self, "slope", above=0, high=1e9)
        store_number(self, "offset", low=-1e9, high=1e9)
        store_number(self, "threshold", low=-1e9, high=1e9)
        store_number(self, "nms_iou", low=0, high=1)

    @property
    def calibration(self) -> Platt:
        """Probability that a box contains a vehicle, by its score: the log-odds above the threshold."""
        return Platt(-1.0, -self.threshold)

    def open_search(
        self, n_jobs: int | None = None, method: Literal["shared", "windows"] = "shared"
    ) -> NetworkSearch:
        """Open a search of frames with this network.

        Parameters
        ----------
        n_jobs
            Threads that share a frame.
        method
            ``"shared"``, the only search of this kind of model.

        Returns
        -------
        NetworkSearch
            A thread-safe context manager; its parameters are `NetworkParams`.

        Raises
        ------
        InvalidInputError
            If `method` is ``"windows"``, or `n_jobs` is malformed.
        """
        check_choice(method, "method", ("shared", "windows"))
        if method != "shared":
            raise InvalidInputError(
                f"method must be 'shared' for a network, got {method!r}; use the model 'highway'"
            )
        return NetworkSearch(self, n_jobs=n_jobs)

    def __repr__(self) -> str:
        return f"NetworkModel({self.summary()[0]})"

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        probability = float(Platt(-1.0, 0.0).probability(self.threshold))
        size = self.input_format.size
        facts = {
            "input": f"{self.input_size} px" if size is None else f"{size[1]}x{size[0]} px",
            "file": f"{len(self.graph) / 1e6:.1f} MB",
        }
        if self.classes is not None and len(self.classes) > 1:
            ids = self.classes if self.class_ids is None else self.class_ids.tolist()
            facts["classes"] = ", ".join(self.classes.get(number, str(number)) for number in ids)
        return f"network, threshold at a probability of {probability:.2g}", facts

    def scores(self, probabilities: Floats) -> Floats:
        """Convert probabilities of the network to log-odds above the threshold."""
        return self.slope * to_log_odds(probabilities) + self.offset - self.threshold

    def probability(self, score: float) -> float:
        """Probability of the network for a score, rounded down: the inverse of `scores`."""
        return to_probability((score + self.threshold - self.offset) / self.slope - 1e-6)

    def input_size_for(self, params: NetworkParams) -> int:
        """Longer side of the input in pixels."""
        size = self.input_format.size
        if params.input_size is None:
            return self.input_size
        if size is not None and params.input_size != max(size):
            raise InvalidInputError(
                f"input_size must be omitted for {self.name}, whose input has the fixed size "
                f"{size[1]}x{size[0]}; got {params.input_size}"
            )
        return params.input_size

    def feeds(self, image: Array, size: Size) -> dict[str, Array]:
        """Return the network's inputs by name, for an image of this height and width."""
        sizes = np.array([[size[1], size[0]]], np.int64)  # of the image to which boxes are scaled
        return {self.input_name: image} | {port.name: sizes.astype(port.dtype) for port in self.extra_inputs}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the ONNX file from which the model was loaded."""
        with atomic_write(path, "path") as part:
            part.write_bytes(self.graph)


def load_network(
    path: str | os.PathLike[str] = _SHIPPED,
    *,
    classes: Collection[str | int] | None = None,
    device: Device = "cpu",
    runtime: Runtime = "auto",
) -> NetworkModel:
    """Load a network from an ONNX file: of this library, or of another detector.

    Networks of other detectors are YOLOv5, v8, v10, 11 and 26, YOLOX, RT-DETR, RF-DETR, D-FINE and others
    with the same outputs. Their default threshold is a probability of 0.25, as usual, and 0.5 for those of
    the DETR family, and their probabilities are not calibrated.

    Parameters
    ----------
    path
        The file, or ``"default"`` for the shipped network.
    classes
        Names or numbers of the classes to keep. Default: those named car, truck, bus, van or vehicle, in any
        case; all classes if their names are unknown.
    device
        ``"cpu"``, or ``"cuda"`` with the package onnxruntime-gpu.
    runtime
        ``"onnxruntime"``, ``"openvino"``, or ``"auto"``: OpenVINO if it is installed and the processor
        multiplies matrices (AMX).

    Returns
    -------
    NetworkModel
        A model for `VehicleDetector`.

    Raises
    ------
    ModelFileError
        If the file is missing, damaged, too large, or no network that finds boxes.
    InvalidInputError
        If an argument is malformed, a class is unknown, none has the name of a vehicle and `classes` is
        omitted, or the device or the library is not available.
    """
    check_device(device, runtime)
    graph, name = _read(path)
    facts = read_facts(graph, name)
    model = _own_model(graph, facts) if METADATA_KEY in facts.metadata else _foreign_model(graph, facts)
    class_ids = _class_ids(classes, model, facts.name)
    return dataclasses.replace(model, class_ids=class_ids, device=device, runtime=runtime)


def _read(path: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Content of a file, or of the shipped network, and its name for messages."""
    if isinstance(path, str) and path == _SHIPPED:
        name, resource = f"the shipped model {path!r}", resources.files("vehicle_detection") / "models"
        if not (resource / f"{path}.onnx").is_file():
            raise ModelFileError(f"{name} is missing; install the package again")
        return (resource / f"{path}.onnx").read_bytes(), name
    file = check_path(path)
    name = f"model file {file}"
    data = read_regular_file(file, name, Limit.NETWORK_BYTES, error=ModelFileError)
    if data[:2] == b"PK" or data[:1] == b"\x80":
        raise ModelFileError(
            f"{name} is a file of PyTorch or a pickle, not ONNX; export it, such as with "
            "yolo export model=... format=onnx"
        )
    return data, name


def _own_model(graph: bytes, facts: GraphFacts) -> NetworkModel:
    """Model of a file that this library has written."""
    name = facts.name
    try:
        header = json.loads(facts.metadata[METADATA_KEY])
        if header["format_version"] != FORMAT_VERSION:
            raise ModelFileError(
                f"{name} has format version {header['format_version']}, this release reads {FORMAT_VERSION}; "
                "train again or install the release that wrote it"
            )
        params, metadata = header["params"], dict(header["metadata"])
        size = int(params["input_size"])
        NetworkParams(input_size=size)
        image, boxes = facts.inputs[0], facts.outputs[0]
        is_image = image.dtype == "uint8" and len(image.shape) == 4
        if not is_image or len(boxes.shape) != 3 or boxes.shape[1] not in (5, None):
            raise ValueError(f"input {image.dtype} {image.shape}, output {boxes.shape}")
        return NetworkModel(
            graph=graph,
            name=name,
            input_format=InputFormat(_fixed_size(image, False, name), "uint8", False, padding=115),
            output_format=OutputFormat("columns", 1),
            input_name=image.name,
            input_size=size,
            classes={0: "vehicle"},
            slope=float(params["slope"]),
            offset=float(params["offset"]),
            threshold=float(params["threshold"]),
            nms_iou=float(params["nms_iou"]),
            metadata=metadata,
        )
    except (InvalidInputError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise ModelFileError(f"{name} does not fit its own parameters: {error}; train again") from error


def _foreign_model(graph: bytes, facts: GraphFacts) -> NetworkModel:
    """Model of a file that another library has written."""
    name, metadata = facts.name, facts.metadata
    if metadata.get("task", "detect") != "detect":
        raise ModelFileError(
            f"{name} is a network for the task {metadata['task']!r}; export one for detection"
        )
    _check_inputs(facts)
    image, *extra = facts.inputs
    channels_first = image.shape[1] == 3 or image.shape[3] != 3
    size = _fixed_size(image, channels_first, name)
    names = class_names(facts)
    input_format = InputFormat(size, image.dtype, channels_first, _stride(metadata))
    model = NetworkModel(
        graph=graph,
        name=name,
        input_format=input_format,
        output_format=OutputFormat("columns"),
        extra_inputs=tuple(extra),
        input_name=image.name,
        input_size=max(size) if size else _INPUT_SIZE,
        metadata=dict(metadata),
    )
    tried = size or (_PROBE_SIZE, _PROBE_SIZE)
    output_format = recognize(
        facts, _output_shapes(model, facts, tried), tried, None if names is None else len(names)
    )
    is_set = output_format.normalized or output_format.kind == "lists"
    yolox = output_format.kind == "yolox"
    input_format = dataclasses.replace(
        input_format,
        stretch=output_format.normalized or bool(extra),
        bgr=yolox,
        scaled=not yolox,
        standardized=output_format.kind == "detr" and {"dets", "labels"} <= {p.name for p in facts.outputs},
    )
    return dataclasses.replace(
        model,
        input_format=input_format,
        output_format=output_format,
        classes=names or usual_names(output_format.n_classes),
        threshold=0.0 if is_set else logit(0.25),
    )


def _check_inputs(facts: GraphFacts) -> None:
    """Raise unless the first input is an image, and a second one the size of the image."""
    image, *extra = facts.inputs or (Port("none", (), ""),)
    fits = (
        len(image.shape) == 4
        and image.shape[0] in (1, None)
        and (3 in image.shape[1::2] or None in image.shape[1::2])
        and image.dtype in ("float32", "float16", "uint8")
        and len(extra) <= 1
        and all("size" in port.name for port in extra)
    )
    if not fits:
        listed = ", ".join(f"{port.name} {port.dtype} {port.shape}" for port in facts.inputs)
        raise ModelFileError(
            f"{facts.name} must have one input, float32, float16 or uint8 of shape (1, 3, height, width) or "
            f"(1, height, width, 3), got {listed}; export it with a batch of 1 and three color channels"
        )


def _fixed_size(image: Port, channels_first: bool, name: str) -> Size | None:
    height, width = image.shape[2:] if channels_first else image.shape[1:3]
    if height is None and width is None:
        return None
    if height is None or width is None:
        raise ModelFileError(
            f"{name} has an input of shape {image.shape}; export it with both sides fixed, or none"
        )
    return height, width


def _stride(metadata: Mapping[str, str]) -> int:
    text = metadata.get("stride", "32")
    return max(int(text), 32) if text.isdecimal() and len(text) < 4 else 32


def _output_shapes(model: NetworkModel, facts: GraphFacts, size: Size) -> list[tuple[int, ...]]:
    """Shapes of the outputs for an input of this size: as stated in the file, or tried."""
    if all(None not in port.shape and port.shape for port in facts.outputs) and model.input_format.size:
        return [tuple(side or 0 for side in port.shape) for port in facts.outputs]
    image, _ = model.input_format.prepare(np.full((*size, 3), 114, np.uint8), max(size))
    session = open_session(model.graph, model.name, runtime="onnxruntime")
    try:
        return [output.shape for output in session.run(model.feeds(image, size))]
    finally:
        session.close()


def _class_ids(
    classes: Collection[str | int] | None, model: NetworkModel, name: str
) -> NDArray[np.intp] | None:
    """Numbers of the classes to keep; None: all."""
    known = model.classes or {}
    numbers = {text.lower(): number for number, text in known.items()}
    if classes is None:
        ids = [numbers[text] for text in VEHICLE_CLASSES if text in numbers]
        if known and not ids:
            listed = ", ".join(known.values())
            raise InvalidInputError(
                f"classes must be given for {name}, which has none of {', '.join(VEHICLE_CLASSES)}; name "
                f"those of its classes that are vehicles: {listed}"
            )
        return np.array(sorted(ids), np.intp) if known else None
    ids = []
    count = model.output_format.n_classes or 1 << 31
    for each in check_sequence(classes, "classes", "names or numbers of classes"):
        number = numbers.get(each.lower(), -1) if isinstance(each, str) else each
        is_number = isinstance(number, (int, np.integer)) and not isinstance(number, bool)
        if not is_number or not 0 <= number < count or (known and number not in known):
            listed = ", ".join(f"{text} ({n})" for n, text in known.items())
            listed = listed or "numbers only" + f", below {count}" * (count < 1 << 31)
            raise InvalidInputError(
                f"classes must be classes of {name}, got {describe(each)}; it has {listed}"
            )
        ids.append(int(number))
    if not ids:
        raise InvalidInputError("classes must hold at least one class; omit it for all vehicles")
    return np.array(sorted(set(ids)), np.intp)
