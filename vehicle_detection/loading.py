"""Load a model of any kind: a network, or a classifier of patches."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import PurePath

from vehicle_detection._common import check_choice, describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.network import Device, NetworkModel, load_network
from vehicle_detection.svm import VehicleClassifier, load_classifier

# Files of PyTorch are refused with a message that says how to export them.
_NETWORK_SUFFIXES = (".onnx", ".pt", ".pth")


def load_model(
    path: str | os.PathLike[str] = "default",
    *,
    classes: Collection[str | int] | None = None,
    device: Device = "cpu",
) -> NetworkModel | VehicleClassifier:
    """Load a model of either kind.

    Parameters
    ----------
    path
        ``"default"``, a network for any road; ``"highway"``, the course's classifier of patches; an ``.onnx``
        file, of this library or of another detector; or a ``.safetensors`` file.
    classes, device
        For networks, as in `load_network`.

    Returns
    -------
    NetworkModel or VehicleClassifier
        A network for ``"default"`` and ``.onnx`` files; otherwise a classifier.

    Raises
    ------
    ModelFileError
        If the file is missing, truncated, edited, of another version, or does not fit its own parameters.
    InvalidInputError
        If `path` is neither a path nor a name, or `classes` or `device` do not fit the model.

    Examples
    --------
    >>> load_model("highway").params.color_space
    'LAB'
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InvalidInputError(
            f"path must be a model file, 'default' or 'highway', got {describe(path)}; omit it for 'default'"
        )
    if str(path) == "default" or PurePath(os.fsdecode(path)).suffix.lower() in _NETWORK_SUFFIXES:
        return load_network(os.fspath(path), classes=classes, device=device)
    refuse_network_options(classes, device, f"for {str(path)!r}, which is no network")
    return load_classifier(path)


def refuse_network_options(classes: object, device: object, reason: str) -> None:
    """Raise if options of networks are given, for the stated reason."""
    check_choice(device, "device", ("cpu", "cuda"))
    for name, value in ("classes", classes), ("device", None if device == "cpu" else device):
        if value is not None:
            raise InvalidInputError(f"{name} must be omitted {reason}; got {describe(value)}")
