"""Cost of the search by frame size, number of windows and cores, and by stage."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks._material import Context, classifier_for_search, searched_frame
from benchmarks._report import Row
from benchmarks._timing import median_of, median_seconds, seconds_of
from vehicle_detection import SearchParams, VehicleClassifier, load_classifier, search
from vehicle_detection._common import available_cores
from vehicle_detection.search import SearchBand

SIZES = ((640, 360), (960, 540), (1280, 720), (1600, 900), (1920, 1080))
SCALES = (1.5, 1.0, 0.8, 0.7, 0.6, 0.5)
CALLS = 20

Points = Mapping[int, float]
"""Milliseconds of a search by the number of windows or cores."""


def run(context: Context) -> list[Row]:
    """Measure, and plot if a folder for plots is given."""
    frame, source = searched_frame()
    classifier, model = classifier_for_search()
    default = load_classifier()
    three_scales = SearchParams.preset("three-scales")
    resized = {size: np.asarray(cv2.resize(frame, size), np.uint8) for size in SIZES}
    sizes = {size: _default_cost(image, default) for size, image in resized.items()}
    windows = _cost_of_windows(frame, classifier)
    cores = {
        jobs: _milliseconds(frame, classifier, three_scales, jobs) for jobs in range(1, available_cores() + 1)
    }
    stages = stage_seconds(frame, classifier, three_scales)
    if context.plots is not None:
        _plot(context.plots, sizes, windows, cores, stages)
    return [
        *(
            Row(
                f"default search of a {width}x{height} frame ({count:,} windows), all cores",
                cost,
                unit="ms",
                material=f"{source}; windows, cores and stages: {model}",
            )
            for (width, height), (cost, count) in sizes.items()
        ),
        *(Row(f"search of {count:,} windows, one core", cost, unit="ms") for count, cost in windows.items()),
        *(Row(f"three scales, {n} core{'s' * (n > 1)}", cost, unit="ms") for n, cost in cores.items()),
        *(
            Row(f"three scales, one core: {name}", seconds * 1e3, unit="ms")
            for name, seconds in stages.items()
        ),
    ]


def _milliseconds(
    frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams, jobs: int | None
) -> float:
    with classifier.open_search(jobs) as bands:
        return median_seconds(lambda: bands.find_windows(frame, params), CALLS) * 1e3


def _default_cost(frame: NDArray[np.uint8], classifier: VehicleClassifier) -> tuple[float, int]:
    """Milliseconds and number of windows of the default search."""
    params = SearchParams.preset()
    return _milliseconds(frame, classifier, params, None), count_windows(frame, classifier, params)


def count_windows(frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams) -> int:
    """Count the windows of a search."""
    with classifier.open_search(1) as bands:
        return len(bands.find_windows(frame, dataclasses.replace(params, min_score=-1e6)))


def _cost_of_windows(frame: NDArray[np.uint8], classifier: VehicleClassifier) -> dict[int, float]:
    """Milliseconds of searches with an increasing number of scales, by number of windows."""
    costs = {}
    for number in range(1, len(SCALES) + 1):
        bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in SCALES[:number])
        params = SearchParams(bands=bands, horizon=400 / 720)
        costs[count_windows(frame, classifier, params)] = _milliseconds(frame, classifier, params, 1)
    return costs


class _Stopwatch:
    """Sums the seconds of wrapped functions; nested calls count for the outer function."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inside = False

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `function`, timed under `name`."""

        def timed(*args: Any, **options: Any) -> Any:
            if self._inside:
                return function(*args, **options)
            self._inside = True
            began = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                self.seconds[name] += time.perf_counter() - began
                self._inside = False

        return timed


class _TimedModule:
    """A module with timed functions: those with a stage in `names`, or all of them."""

    def __init__(
        self, module: Any, stopwatch: _Stopwatch, names: Mapping[str, str], *, everything: bool
    ) -> None:
        self._module, self._stopwatch, self._names, self._everything = module, stopwatch, names, everything

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._module, name)
        if name in self._names or (self._everything and callable(value)):
            return self._stopwatch.wrap(self._names.get(name, name), value)
        return value


_KERNELS = {
    "hog_cells": "HOG cells",
    "hog_blocks": "blocks",
    "histogram_cells": "histogram",
    "add_root_histograms": "histogram",
    "add_correlation": "correlation",
}
_MODULES = {"cv2": {"resize": "spatial bins"}}
_FUNCTIONS = {
    "resize_band": "resize",
    "convert_color": "color",
    "_hits": "hits",
}


@contextlib.contextmanager
def _timed_stages(stopwatch: _Stopwatch) -> Iterator[None]:
    """Replace the stages of the search by timed ones for the duration of a block."""
    with contextlib.ExitStack() as stack:

        def put(name: str, value: Any) -> None:
            stack.enter_context(mock.patch.object(search, name, value))

        put("kernels", _TimedModule(search.kernels, stopwatch, _KERNELS, everything=True))
        for name, functions in _MODULES.items():
            put(name, _TimedModule(getattr(search, name), stopwatch, functions, everything=False))
        for name, stage in _FUNCTIONS.items():
            put(name, stopwatch.wrap(stage, getattr(search, name)))
        yield


def stage_seconds(
    frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams, *, calls: int = CALLS
) -> dict[str, float]:
    """Median seconds of each stage of a search on one core, and of the ``rest``."""
    runs: list[dict[str, float]] = []
    with classifier.open_search(1) as bands:
        for _ in range(3):
            bands.find_windows(frame, params)
        for _ in range(calls):
            stopwatch = _Stopwatch()
            with _timed_stages(stopwatch):
                whole = seconds_of(lambda: bands.find_windows(frame, params))
            runs.append({**stopwatch.seconds, "rest": whole - sum(stopwatch.seconds.values())})
    return {name: median_of(one[name] for one in runs) for name in runs[0]}


def _plot(
    folder: Path,
    sizes: Mapping[tuple[int, int], tuple[float, int]],
    windows: Points,
    cores: Points,
    stages: Mapping[str, float],
) -> None:
    """Plot cost by frame size, windows, cores and stage as ``scaling.png``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    by_size, by_windows, by_cores, by_stage = figure.subplots(2, 2).ravel()
    pixels = [width * height / 1e6 for width, height in sizes]
    by_size.plot(pixels, [cost for cost, _ in sizes.values()], "o-")
    by_size.set_xticks(pixels, [f"{width}x{height}" for width, height in sizes], rotation=20)
    by_size.set(title="default search, all cores; windows scale with the frame", xlabel="frame")
    by_windows.plot([count / 1000 for count in windows], list(windows.values()), "o-")
    by_windows.set(title="1280x720 with an increasing number of scales, one core", xlabel="thousand windows")
    by_cores.plot(list(cores), list(cores.values()), "o-", label="measured")
    by_cores.plot(list(cores), [cores[1] / n for n in cores], "--", color="gray", label="ideal")
    by_cores.set(title="three scales, 11,580 windows of 1280x720", xlabel="cores", xticks=list(cores))
    by_cores.legend()
    bars = by_stage.barh(list(stages), [seconds * 1e3 for seconds in stages.values()])
    by_stage.bar_label(bars, fmt="%.2f", padding=3)
    by_stage.invert_yaxis()
    by_stage.set(title="one frame by stage: three scales, one core", xlabel="ms")
    by_stage.margins(x=0.12)
    for axes in (by_size, by_windows, by_cores):
        axes.set_ylabel("ms/frame")
        axes.set_ylim(0, 1.08 * axes.get_ylim()[1])
        axes.grid(alpha=0.3)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "scaling.png", dpi=120)
