"""Model files: safetensors with parameters, metadata and a checksum of everything in the header."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection._common.files import atomic_write
from vehicle_detection._common.limits import Limit, read_regular_file
from vehicle_detection.errors import InvalidInputError, ModelFileError

FORMAT = "vehicle-detection-model"
FORMAT_VERSION = "3"

SHIPPED = ("default", "highway")
"""Names of the models that the package ships: a network, and a classifier of patches."""

_MAX_WEIGHT = 1e12

Tensors = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class ModelData:
    """The verified content of a model file; the model class interprets it."""

    name: str  # how messages refer to the file
    kind: str  # which model class wrote it
    params: dict[str, Any]
    metadata: dict[str, Any]
    tensors: Tensors


def write_model(
    path: str | os.PathLike[str],
    kind: str,
    params: Mapping[str, Any],
    tensors: Tensors,
    metadata: Mapping[str, Any],
) -> None:
    """Write a model file; equal models give identical bytes."""
    from safetensors.numpy import save

    try:
        metadata_json = json.dumps(dict(metadata), sort_keys=True)
    except (TypeError, ValueError) as error:
        remedy = "convert NumPy numbers with .item()"
        raise InvalidInputError(f"metadata must contain JSON values only: {error}; {remedy}") from error
    header = {"format": FORMAT, "format_version": FORMAT_VERSION, "kind": kind}
    header |= {"params": json.dumps(dict(params), sort_keys=True), "metadata": metadata_json}
    header["sha256"] = checksum(header, tensors)
    data = save(dict(tensors), metadata=header)
    # Sort the keys of the header: safetensors writes the metadata in random order.
    stop = 8 + int.from_bytes(data[:8], "little")
    ordered = json.dumps(json.loads(data[8:stop]), sort_keys=True, separators=(",", ":")).encode()
    ordered += b" " * (-len(ordered) % 8)
    with atomic_write(path, "path") as part:
        part.write_bytes(len(ordered).to_bytes(8, "little") + ordered + data[stop:])


def checksum(header: Mapping[str, str], tensors: Tensors) -> str:
    """SHA-256 of the header and the tensors, to detect edited files."""
    digest = hashlib.sha256()
    for key in sorted(header):
        if key != "sha256":
            digest.update(f"{key}={header[key]}\n".encode())
    for name in sorted(tensors):
        digest.update(f"{name} {tensors[name].shape} {tensors[name].dtype}\n".encode())
        digest.update(np.ascontiguousarray(tensors[name]).tobytes())
    return digest.hexdigest()


def read_model(path: str | os.PathLike[str], kind: str) -> ModelData:
    """Read and verify a model file, or a shipped model by its name."""
    if not isinstance(path, (str, os.PathLike)):
        raise check.invalid("path", f"be a model file or one of {', '.join(map(repr, SHIPPED))}", path)
    if str(path) == "default":
        raise ModelFileError("the model 'default' is no classifier of patches; load it with load_model")
    if str(path) in SHIPPED:
        resource = resources.files("vehicle_detection") / "models" / f"{path}.safetensors"
        if not resource.is_file():
            raise ModelFileError(f"the shipped model {path!r} is missing; install the package again")
        return _parse(resource.read_bytes(), f"the shipped model {path!r}", kind)
    file = check.path(path)
    name = f"model file {file}"
    if not os.path.lexists(file) and file.name == str(file):
        raise ModelFileError(
            f"{name} does not exist; check the path, or name a shipped model: {', '.join(SHIPPED)}"
        )
    return _parse(read_regular_file(file, name, Limit.MODEL_BYTES, error=ModelFileError), name, kind)


def _check_tensors(tensors: Tensors, name: str) -> None:
    """Raise unless all tensors are floating-point numbers with which no score can overflow."""
    for key, tensor in tensors.items():
        if tensor.dtype.kind != "f":
            problem = f"{key} must be floating-point numbers, got {tensor.dtype}"
        elif not (np.abs(tensor) <= _MAX_WEIGHT).all():  # also false for NaN
            problem = f"{key} must be finite numbers of at most {_MAX_WEIGHT:g}"
        else:
            continue
        raise ModelFileError(f"{name} does not fit its own parameters: {problem}; train again")


def _parse(data: bytes, name: str, kind: str) -> ModelData:
    """Verify and decode the bytes of a model file."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = load(data)
        length = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + length])["__metadata__"]
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        if data[:1] == b"\x80" or name.lower().endswith((".p", ".pkl", ".pickle", ".joblib", ".sav")):
            raise ModelFileError(
                f"{name} looks like a pickle, which is not opened because it may run any code; load it "
                "yourself, and pass its classifier and scaler to VehicleClassifier.from_pipeline"
            ) from error
        reason = f"is not a complete safetensors file ({error})"
        raise ModelFileError(f"{name} {reason}; download it again or train a model") from error
    if header.get("format") != FORMAT:
        raise ModelFileError(f"{name} is a safetensors file, but not a model of this library; train one")
    if header.get("format_version") != FORMAT_VERSION:
        raise ModelFileError(
            f"{name} has format version {header.get('format_version')}, this release reads "
            f"{FORMAT_VERSION}; train again or install the release that wrote it"
        )
    if header.get("sha256") != checksum(header, tensors):
        raise ModelFileError(f"{name} was changed after writing (checksum differs); restore a copy of it")
    if header.get("kind") != kind:
        raise ModelFileError(f"{name} is a model of kind {header.get('kind')!r}, not {kind!r}; train one")
    _check_tensors(tensors, name)
    try:
        params, metadata = json.loads(header["params"]), json.loads(header["metadata"])
        return ModelData(name, str(header["kind"]), dict(params), dict(metadata), tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ModelFileError(f"{name} has no readable parameters ({error}); download it again") from error


def model_terms(metadata: Mapping[str, Any]) -> str:
    """State the terms of a model's weights, which are those of its training data, in one sentence."""
    data = metadata.get("data")
    inner = data.get("sources") if isinstance(data, Mapping) else None
    sources = [*data, *(inner or ())] if isinstance(data, Mapping) else []
    if any(str(name).startswith(("GTI", "KITTI", "bdd")) for name in sources):
        return (
            "the code is MIT; these weights are for non-commercial use only, with attribution, because of "
            "their training data (see the model card); train weights of your own on other data"
        )
    return "the code is MIT; the weights have the terms of the data they were trained on"
