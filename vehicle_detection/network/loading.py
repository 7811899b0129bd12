"""Load a network from an ONNX file: of this library, or of another detector, whose kind is recognized."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
from collections.abc import Collection
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Limit, check, invalid, read_regular_file
from vehicle_detection.boxes import VEHICLE_CLASSES, logit, warn_of_vehicles
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.network.model import INPUT_SIZE, NetworkModel, NetworkParams
from vehicle_detection.network.runtime import (
    Device,
    GraphFacts,
    Port,
    Runtime,
    check_device,
    open_session,
    read_facts,
)
from vehicle_detection.network.tensors import (
    InputFormat,
    OutputFormat,
    Size,
    class_names,
    recognize,
    usual_names,
)

_LOGGER = logging.getLogger(__name__)

METADATA_KEY = "vehicle_detection"
"""Key of the ONNX metadata with the parameters of a network of this library, as JSON."""

FORMAT_VERSION = 1
"""Version of that JSON."""

# Side of the input on which a network without fixed sizes is tried once.
_PROBE_SIZE = 320
_SHIPPED = "default"


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
    the DETR family, and their probabilities are not calibrated. `path`, `classes` and `device` are those of
    `load_model`; `runtime` is ``"onnxruntime"``, ``"openvino"``, or ``"auto"``: OpenVINO if it is installed
    and the processor multiplies matrices (AMX).
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
    file = check.path(path)
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
        params, image, boxes = header["params"], facts.inputs[0], facts.outputs[0]
        size = int(params["input_size"])
        NetworkParams(input_size=size)
        scores: Any = {name: float(params[name]) for name in ("slope", "offset", "threshold", "nms_iou")}
        side, share, top = map(float, params.get("margins", (0, 0, 0)))
        if not (0 <= side < 100 and -1 < share < 1 and 0 <= top < 100):
            raise ValueError(f"margins {params['margins']}")
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
            margins=(side, share, top),
            classes={0: "vehicle"},
            metadata=dict(header["metadata"]),
            **scores,
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
    image, *extra = _check_inputs(facts)
    channels_first = image.shape[1] == 3 or image.shape[3] != 3
    size = _fixed_size(image, channels_first, name)
    names, stride = class_names(facts), metadata.get("stride", "")
    multiple = max(int(stride), 32) if stride.isdecimal() and len(stride) < 4 else 32
    input_format = InputFormat(size, image.dtype, channels_first, multiple)
    model = NetworkModel(
        graph=graph,
        name=name,
        input_format=input_format,
        output_format=OutputFormat("columns"),
        extra_inputs=tuple(extra),
        input_name=image.name,
        input_size=max(size) if size else INPUT_SIZE,
        metadata=dict(metadata),
    )
    tried = size or (_PROBE_SIZE, _PROBE_SIZE)
    shapes = _output_shapes(model, facts, tried)
    output_format = recognize(facts, shapes, tried, None if names is None else len(names))
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


def _check_inputs(facts: GraphFacts) -> tuple[Port, ...]:
    """Return the inputs if the first is an image, and a second one the size of the image."""
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
    return facts.inputs


def _fixed_size(image: Port, channels_first: bool, name: str) -> Size | None:
    height, width = image.shape[2:] if channels_first else image.shape[1:3]
    if height is None and width is None:
        return None
    if height is None or width is None:
        raise ModelFileError(
            f"{name} has an input of shape {image.shape}; export it with both sides fixed, or none"
        )
    return height, width


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
    numbers: dict[str, list[int]] = {}  # merged data sets have several, such as those of "car" and "Car"
    for key, text in known.items():
        numbers.setdefault(text.strip().lower(), []).append(key)
    if classes is None:
        ids = [number for text in VEHICLE_CLASSES for number in numbers.get(text, ())]
        if known and not ids:
            listed = ", ".join(known.values())
            raise InvalidInputError(
                f"classes must be given for {name}, which has none of {', '.join(VEHICLE_CLASSES)}; name "
                f"those of its classes that are vehicles: {listed}"
            )
        warn_of_vehicles(name, numbers, VEHICLE_CLASSES)
        if not known and model.output_format.n_classes != 1:
            text = (
                "%s names no classes, so all are vehicles; classes= selects some, such as [2, 5, 7] of COCO"
            )
            _LOGGER.warning(text, name)
        return np.array(sorted(ids), np.intp) if known else None
    ids = []
    count = model.output_format.n_classes or 1 << 31
    for each in check.sequence(classes, "classes", "names or numbers of classes"):
        found = numbers.get(each.strip().lower(), [-1]) if isinstance(each, str) else [each]
        number = found[0]
        is_number = isinstance(number, (int, np.integer)) and not isinstance(number, bool)
        if not is_number or not 0 <= number < count or (known and number not in known):
            listed = ", ".join(f"{text} ({n})" for n, text in known.items())
            listed = listed or "numbers only" + f", below {count}" * (count < 1 << 31)
            raise invalid("classes", f"be classes of {name}", each, f"it has {listed}")
        ids += map(int, found)
    if not ids:
        raise InvalidInputError("classes must hold at least one class; omit it for all vehicles")
    return np.array(sorted(set(ids)), np.intp)
