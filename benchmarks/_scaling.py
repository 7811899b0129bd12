"""What the search costs as frames, windows and cores change, and where one frame's time goes."""

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
from vehicle_detection._kernels import Filter
from vehicle_detection._kernels import color as _color_kernels
from vehicle_detection._kernels import hog as _hog_kernels
from vehicle_detection.params import SearchBand
from vehicle_detection.search import BandSearch

SIZES = ((640, 360), (960, 540), (1280, 720), (1600, 900), (1920, 1080))
SCALES = (1.5, 1.0, 0.8, 0.7, 0.6, 0.5)
CALLS = 20

Points = Mapping[int, float]
"""Milliseconds of a search by what it depends on."""


def run(context: Context) -> list[Row]:
    """Measure, and draw what was measured if a folder for plots was given."""
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
                what=f"default search of a {width}x{height} frame ({count:,} windows), all cores",
                value=cost,
                unit="ms",
                material=f"{source}; windows, cores and stages: {model}",
            )
            for (width, height), (cost, count) in sizes.items()
        ),
        *(
            Row(what=f"search of {count:,} windows, one core", value=cost, unit="ms")
            for count, cost in windows.items()
        ),
        *(
            Row(what=f"three scales, {n} core{'s' * (n > 1)}", value=cost, unit="ms")
            for n, cost in cores.items()
        ),
        *(
            Row(what=f"three scales, one core: {name}", value=seconds * 1e3, unit="ms")
            for name, seconds in stages.items()
        ),
    ]


def _milliseconds(
    frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams, jobs: int | None
) -> float:
    with BandSearch(classifier, n_jobs=jobs) as bands:
        return median_seconds(lambda: bands.find_windows(frame, params), CALLS) * 1e3


def _default_cost(frame: NDArray[np.uint8], classifier: VehicleClassifier) -> tuple[float, int]:
    """Milliseconds and number of windows of the default search."""
    params = SearchParams.preset()
    return _milliseconds(frame, classifier, params, None), count_windows(frame, classifier, params)


def count_windows(frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams) -> int:
    """Count the windows of a search: all of them are hits if any score will do."""
    with BandSearch(classifier, n_jobs=1) as bands:
        return len(bands.find_windows(frame, dataclasses.replace(params, min_score=-1e6)))


def _cost_of_windows(frame: NDArray[np.uint8], classifier: VehicleClassifier) -> dict[int, float]:
    """Milliseconds of searches with more and more scales, by their number of windows."""
    costs = {}
    for number in range(1, len(SCALES) + 1):
        bands = tuple(SearchBand(window=(64 * s, 64 * s), y=(0.0, 256.0)) for s in SCALES[:number])
        params = SearchParams(bands=bands, horizon=400 / 720)
        costs[count_windows(frame, classifier, params)] = _milliseconds(frame, classifier, params, 1)
    return costs


class _Clock:
    """Adds up the seconds of wrapped functions; a call inside another one counts for the outer."""

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


class _Watched:
    """A module some of whose functions are timed; with no names given, all of them."""

    def __init__(self, module: Any, clock: _Clock, names: Mapping[str, str], *, everything: bool) -> None:
        self._module, self._clock, self._names, self._everything = module, clock, names, everything

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._module, name)
        if name in self._names or (self._everything and callable(value)):
            return self._clock.wrap(self._names.get(name, name), value)
        return value


_KERNELS = {
    "hog_cells": "HOG cells",
    "normalize_blocks": "blocks",
    "histogram_cells": "histogram",
    "add_root_histograms": "histogram",
    "spatial_cells": "spatial bins",
}
_MODULES = {"cv2": {"resize": "spatial bins"}}
_FUNCTIONS = {"resize_band": "resize", "convert_color": "color", "_hits": "hits"}


@contextlib.contextmanager
def _watch(clock: _Clock) -> Iterator[None]:
    """Time the steps of the search from outside, for the duration of a block."""
    with contextlib.ExitStack() as stack:

        def put(name: str, value: Any) -> None:
            stack.enter_context(mock.patch.object(search, name, value))

        put("_hog_kernels", _Watched(_hog_kernels, clock, _KERNELS, everything=True))
        put("_color_kernels", _Watched(_color_kernels, clock, _KERNELS, everything=True))
        for name, functions in _MODULES.items():
            put(name, _Watched(getattr(search, name), clock, functions, everything=False))
        for name, stage in _FUNCTIONS.items():
            put(name, clock.wrap(stage, getattr(search, name)))
        timed = clock.wrap("correlation", Filter.add_to)
        stack.enter_context(mock.patch.object(Filter, "add_to", timed))
        yield


def stage_seconds(
    frame: NDArray[np.uint8], classifier: VehicleClassifier, params: SearchParams, *, calls: int = CALLS
) -> dict[str, float]:
    """Median seconds of each step of a search on one core; ``rest`` is what no step accounts for."""
    runs: list[dict[str, float]] = []
    with BandSearch(classifier, n_jobs=1) as bands:
        for _ in range(3):
            bands.find_windows(frame, params)
        for _ in range(calls):
            clock = _Clock()
            with _watch(clock):
                whole = seconds_of(lambda: bands.find_windows(frame, params))
            runs.append({**clock.seconds, "rest": whole - sum(clock.seconds.values())})
    return {name: median_of(one[name] for one in runs) for name in runs[0]}


def _plot(
    folder: Path,
    sizes: Mapping[tuple[int, int], tuple[float, int]],
    windows: Points,
    cores: Points,
    stages: Mapping[str, float],
) -> None:
    """Draw the four curves as ``scaling.png``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7.5), layout="constrained")
    by_size, by_windows, by_cores, by_stage = figure.subplots(2, 2).ravel()
    pixels = [width * height / 1e6 for width, height in sizes]
    by_size.plot(pixels, [cost for cost, _ in sizes.values()], "o-")
    by_size.set_xticks(pixels, [f"{width}x{height}" for width, height in sizes], rotation=20)
    by_size.set(title="default search, all cores; its windows grow with the frame", xlabel="frame")
    by_windows.plot([count / 1000 for count in windows], list(windows.values()), "o-")
    by_windows.set(title="1280x720 at more and more scales, one core", xlabel="thousand windows")
    by_cores.plot(list(cores), list(cores.values()), "o-", label="measured")
    by_cores.plot(list(cores), [cores[1] / n for n in cores], "--", color="gray", label="shared evenly")
    by_cores.set(title="three scales, 11,580 windows of 1280x720", xlabel="cores", xticks=list(cores))
    by_cores.legend()
    bars = by_stage.barh(list(stages), [seconds * 1e3 for seconds in stages.values()])
    by_stage.bar_label(bars, fmt="%.2f", padding=3)
    by_stage.invert_yaxis()
    by_stage.set(title="one frame by stage: three scales, one core", xlabel="ms")
    by_stage.margins(x=0.12)
    for axes in (by_size, by_windows, by_cores):
        axes.set_ylabel("ms a frame")
        axes.set_ylim(0, 1.08 * axes.get_ylim()[1])
        axes.grid(alpha=0.3)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "scaling.png", dpi=120)
