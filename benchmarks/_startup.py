"""Time to import the package and to detect on the first frame, each in a new interpreter."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._material import Context, searched_frame
from benchmarks._probe import run_probe
from benchmarks._report import Row, at_most
from benchmarks._timing import median_of

WARM, COLD = 5, 3


def run(context: Context) -> list[Row]:
    """Measure with an empty kernel cache and with a filled one."""
    image, material = searched_frame()
    frame = context.work / "frame.npy"
    np.save(frame, image)
    cache = context.work / "kernels"
    cold = []
    for _ in range(COLD):
        shutil.rmtree(cache, ignore_errors=True)
        cold.append(_start(frame, cache))
    warm = [_start(frame, cache) for _ in range(WARM)]
    kernels = _kernel_seconds(frame, context.work / "kernels for the profile")
    return [
        Row(
            "import vehicle_detection",
            median_of(start["import"] for start in warm),
            unit="s",
            target=at_most(0.1),
            material=f"medians of {WARM} warm and {COLD} cold starts, {material}",
        ),
        Row(
            "first frame after the import, kernels in the cache",
            median_of(start["first_frame"] for start in warm),
            unit="s",
            target=at_most(0.6),
        ),
        Row(
            "first frame after the import, no kernel in the cache",
            median_of(start["first_frame"] for start in cold),
            unit="s",
            target=at_most(2.5),
        ),
        *(Row(f"compile {name}", seconds, unit="s") for name, seconds in kernels.items()),
    ]


def _start(frame: Path, cache: Path, *options: str) -> dict[str, Any]:
    """Start an interpreter that finds compiled Python modules, as after an installation."""
    variables = {"NUMBA_CACHE_DIR": cache, "PYTHONPYCACHEPREFIX": cache.with_name("bytecode")}
    environment = {name: str(value) for name, value in variables.items()}
    return run_probe("startup", str(frame), *options, PYTHONDONTWRITEBYTECODE="", **environment)


def _kernel_seconds(frame: Path, cache: Path) -> dict[str, float]:
    """Compilation time of each kernel of the first frame, longest first."""
    seconds: dict[str, float] = _start(frame, cache, "--kernels")["kernels"]
    return dict(sorted(seconds.items(), key=lambda pair: -pair[1]))
