"""The library's helpers, imported on first use: the help of the commands needs no NumPy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehicle_detection._common import *  # noqa: F403


def __getattr__(name: str) -> Any:
    return getattr(importlib.import_module("vehicle_detection._common"), name)
