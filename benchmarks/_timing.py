"""Wall-clock time and medians."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable


def seconds_of(function: Callable[[], object]) -> float:
    """Seconds of one call."""
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def median_of(values: Iterable[float]) -> float:
    """Median as a plain float."""
    return float(statistics.median(values))


def median_seconds(function: Callable[[], object], repetitions: int) -> float:
    """Median seconds of several calls after a warm-up call."""
    function()
    return median_of(seconds_of(function) for _ in range(repetitions))
