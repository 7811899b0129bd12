"""Training of patch classifiers and of networks, their validation, and parameter search.

Names are listed in ``__init__.pyi`` and imported on first use, as some need PyTorch or scikit-learn.
"""

from typing import Any

import lazy_loader

from vehicle_detection.errors import InvalidInputError

_load, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("torch", "onnx", "google"):
            raise
        raise InvalidInputError(
            f"training a network needs the package {error.name}, which is not installed; run "
            'pip install "vehicle-detection[train]"'
        ) from error
