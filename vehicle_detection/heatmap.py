"""Heat map of windows and its labelled regions: how the course turns windows into vehicles."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, fields, invalid, warn
from vehicle_detection.boxes import Detections, clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.search import SearchParams

Heat = TypeVar("Heat", bound=NDArray[Any])


class HeatRange(NamedTuple):
    """Heat thresholds that suit a search: the default, and the limits beyond which most vehicles are lost."""

    default: float
    low: float
    high: float


# Heat thresholds by weighting, and whether regions are reduced to their peak, chosen on single frames of the
# labelled clips: the default has the best F1, or close to it, and beyond the limits F1 is about 0.5 or lower.
_BAND_HEAT = {
    ("score", True): HeatRange(2.0, 0.0, 40.0),
    ("count", True): HeatRange(8.0, 0.0, 56.0),
    ("score", False): HeatRange(12.0, 4.0, 40.0),
    ("count", False): HeatRange(16.0, 10.0, 56.0),
}
_START_WITH_ZEROS = "start with numpy.zeros(image.shape[:2], numpy.float32)"
# Factor of the default thresholds of whole regions if all windows are of similar size.
_SIMILAR_SIZES_FACTOR = 0.6


@dataclass(frozen=True, kw_only=True)
class HeatParams(fields.Checked):
    """How windows become boxes by a heat map, as in the course.

    Attributes
    ----------
    weighting
        ``"score"``: each window adds its score to the heat; ``"count"``: it adds 1, as in the course.
    frames
        Number of frames over which the heat is averaged.
    threshold
        Highest heat that is removed; fits one density of windows only. None: chosen for the search.
    peak_fraction
        A region is reduced to the part around its peak that has at least this fraction of the peak's heat,
        in [0, 1); 0 keeps whole regions, as in the course.

    Examples
    --------
    >>> HeatParams(weighting="count", threshold=8.0).frames
    5
    """

    weighting: Literal["score", "count"] = fields.choice("score", ("score", "count"))
    frames: int = fields.integer(5, low=1, high=1000)
    threshold: float | None = fields.number(None, low=0, high=1e9)
    peak_fraction: float = fields.number(0.35, low=0, high=0.99)

    def for_search(self, search: Any) -> HeatParams:
        """Return the same parameters with a threshold for `search`; warn if the given one cannot fit it."""
        expected = heat_range(search, self)
        if self.threshold is None:
            return dataclasses.replace(self, threshold=expected.default)
        if not expected.low <= self.threshold <= expected.high:
            many = "few" if self.threshold > expected.high else "many"
            warn(
                f"the heat threshold {self.threshold:g} does not fit the density of this search: too {many} "
                f"windows are hot. With weighting={self.weighting!r} and peak_fraction="
                f"{self.peak_fraction:g} expect {expected.low:.2g} to {expected.high:.2g}; omit the "
                f"threshold for the default of {expected.default:.2g}"
            )
        return self


def heat_range(search: Any, params: HeatParams) -> HeatRange:
    """Heat thresholds for the windows of a search: those of the default search, scaled by density.

    The density of the boxes of a network or a function is unknown: any threshold is valid.
    """
    if not isinstance(search, SearchParams):
        return HeatRange(0.0, 0.0, math.inf)
    factor = search.window_density / SearchParams.default().window_density
    default, low, high = (factor * value for value in _BAND_HEAT[params.weighting, params.peak_fraction > 0])
    # Only windows much larger than a vehicle join it to others, which takes a higher threshold.
    sides = [side for band in search.bands for side in band.window]
    if params.peak_fraction == 0 and max(sides) <= 4 * min(sides):
        default, low = _SIMILAR_SIZES_FACTOR * default, 0.0
    return HeatRange(default, low, high)


def _check_heat(heatmap: object, *, in_place: bool = False) -> NDArray[Any]:
    array = heatmap if isinstance(heatmap, np.ndarray) else np.array(None)
    if array.ndim != 2 or not array.size or array.dtype.kind not in "iuf":
        raise invalid("heatmap", "be an (H, W) number array", heatmap, f"{_START_WITH_ZEROS}")
    if in_place and not array.flags.writeable:
        raise InvalidInputError("heatmap must be writable, because it is changed in place; pass a copy")
    return array


def add_heat(heatmap: Heat, boxes: Detections | ArrayLike, *, scores: ArrayLike | None = None) -> Heat:
    """Add each window's heat to the pixels that it covers, in place, and return the same array.

    Parameters
    ----------
    heatmap
        ``(H, W)`` map of a number type that holds the new heat; changed, but not in case of an error.
    boxes, scores
        ``(N, 4)`` windows, which are rounded to whole pixels and clipped to the map, and ``(N,)`` heat that
        each adds; by default 1, as in the course.

    Examples
    --------
    >>> heat = np.zeros((2, 4))
    >>> add_heat(heat, [[0, 0, 2, 2], [1, 0, 3, 1]]) is heat
    True
    >>> heat
    array([[1., 2., 1., 0.],
           [1., 1., 0., 0.]])
    """
    heat = _check_heat(heatmap, in_place=True)
    windows = check.boxes(boxes)
    given = np.ones(len(windows)) if scores is None else check.array(scores, "scores")
    weights = Detections(windows, given).scores
    windows = clip_boxes(np.rint(windows), heat.shape).astype(np.int64)
    if not len(windows):
        return heatmap
    # A window is four corner differences, and their cumulative sum follows, in the rectangle around all
    # windows: the cost does not depend on the area of a window.
    (left, top), (right, bottom) = windows[:, :2].min(axis=0), windows[:, 2:].max(axis=0)
    x1, y1, x2, y2 = (windows - (left, top, left, top)).T
    corners = np.zeros((bottom - top + 1, right - left + 1))
    for rows, columns, sign in ((y1, x1, 1), (y1, x2, -1), (y2, x1, -1), (y2, x2, 1)):
        np.add.at(corners, (rows, columns), sign * weights)
    added = corners[:-1, :-1].cumsum(axis=0).cumsum(axis=1)
    # Set rounding errors of the sums to zero.
    added[np.abs(added) < 1e-9 * max(1.0, np.abs(weights).sum())] = 0
    part = heat[top:bottom, left:right]
    total = part + added
    if heat.dtype.kind != "f" and part.size:
        _check_holds(total, heat.dtype)
    part[:] = total
    return heatmap


def _check_holds(values: NDArray[np.float64], dtype: np.dtype[Any]) -> None:
    """Raise unless an integer type holds the values exactly."""
    limits = np.iinfo(dtype)
    if (values != np.rint(values)).any() or values.min() < limits.min or values.max() > limits.max:
        raise InvalidInputError(
            f"heatmap of dtype {dtype} holds whole numbers from {limits.min} to {limits.max} only; the new "
            f"heat is {values.min():g} to {values.max():g}; {_START_WITH_ZEROS}"
        )


def apply_threshold(heatmap: Heat, threshold: float) -> Heat:
    """Set heat at or below the threshold to zero, in place, and return the same ``(H, W)`` array.

    Examples
    --------
    >>> heat = np.array([[1.0, 2.0, 3.0]])
    >>> apply_threshold(heat, 2) is heat, heat.tolist()
    (True, [[0.0, 0.0, 3.0]])
    """
    heat = _check_heat(heatmap, in_place=True)
    heat[heat <= check.number(threshold, "threshold")] = 0
    return heatmap


def label_boxes(heatmap: NDArray[Any], *, threshold: float = 0.0, peak_fraction: float = 0.0) -> Detections:
    """Find the boxes of a heat map's connected regions and the heat of their peaks, from top to bottom.

    Parameters
    ----------
    heatmap, threshold
        ``(H, W)`` heat; heat at or below `threshold` belongs to no region.
    peak_fraction
        As in `HeatParams`: windows extend beyond the vehicle, where the heat is lower.

    Examples
    --------
    >>> heat = np.array([[0, 0, 0, 0, 0], [0, 1, 4, 3, 0], [0, 0, 0, 0, 0]])
    >>> label_boxes(heat).boxes.tolist(), label_boxes(heat, peak_fraction=0.5).boxes.tolist()
    ([[1, 1, 4, 2]], [[2, 1, 4, 2]])
    """
    heat = _check_heat(heatmap)
    peak_fraction = check.number(peak_fraction, "peak_fraction", low=0, high=0.99)
    labels, stats = _connected_components(heat > check.number(threshold, "threshold", low=0))
    boxes, peaks = [], []
    # From top to bottom, because OpenCV labels components by blocks of two rows and columns.
    for label in (1 + np.lexsort((stats[1:, 0], stats[1:, 1]))).tolist():
        x, y, width, height, _ = stats[label].tolist()
        region = slice(y, y + height), slice(x, x + width)
        part = np.where(labels[region] == label, heat[region], 0)
        peak = float(part.max())
        if peak_fraction > 0:
            inner_labels, inner_stats = _connected_components(part >= peak_fraction * peak)
            left, top, width, height, _ = inner_stats[inner_labels.flat[part.argmax()]].tolist()
            x, y = x + left, y + top
        boxes.append((x, y, x + width, y + height))
        peaks.append(peak)
    return Detections(np.array(boxes, np.int64).reshape(-1, 4), np.array(peaks))


def _connected_components(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Label image of the 8-connected components, and ``[x, y, width, height, area]`` by label."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats  # type: ignore[return-value]


def bounding_boxes(shape: tuple[int, ...], windows: Any, *, params: HeatParams | None = None) -> Detections:
    """Find the boxes of a frame's positive windows: heat map, threshold and labels, see `label_boxes`.

    Parameters
    ----------
    shape, windows
        ``(height, width, ...)`` of the frame, and its positive windows; boxes without scores are enough for
        ``weighting="count"``.
    params
        By default ``HeatParams()``. Without a threshold in it, that for the windows of `find_cars`.

    Examples
    --------
    >>> windows = Detections([[0, 0, 8, 8], [4, 0, 12, 8]], [2.0, 1.5])
    >>> bounding_boxes((20, 20), windows, params=HeatParams(threshold=1.0, peak_fraction=0)).boxes.tolist()
    [[0, 0, 12, 8]]
    """
    params = HeatParams() if params is None else params
    check.instance(params, "params", HeatParams, "omit it for the default")
    if params.weighting == "count" and not isinstance(windows, Detections):
        boxes = check.boxes(windows, "windows")
        windows = Detections(boxes, np.ones(len(boxes)))
    remedy = 'pass Detections(boxes, scores), or HeatParams(weighting="count") for boxes without scores'
    check.instance(windows, "windows", Detections, remedy)
    return label_heat(frame_heat(shape, windows, params), params)


def label_heat(heatmap: NDArray[Any], params: HeatParams) -> Detections:
    """Boxes of a heat map as of `label_boxes`; without a threshold that of a classifier's default search."""
    threshold = params.threshold
    if threshold is None:
        threshold = heat_range(SearchParams.default(), params).default
    return label_boxes(heatmap, threshold=threshold, peak_fraction=params.peak_fraction)


def frame_heat(shape: tuple[int, ...], windows: Detections, params: HeatParams) -> NDArray[np.float32]:
    """Heat of one frame's windows, ``(H, W)`` float32, weighted as `params` say."""
    scores = windows.scores.clip(0) if params.weighting == "score" else None
    return add_heat(np.zeros(check.shape(shape), np.float32), windows.boxes, scores=scores)


class HeatHistory:
    """Mean heat over the last `frames`, which smooths regions and suppresses short false positives.

    Examples
    --------
    >>> history = HeatHistory(2)
    >>> _ = history.add(np.full((1, 1), 4.0))
    >>> history.add(np.full((1, 1), 2.0)).tolist()
    [[3.0]]
    """

    def __init__(self, frames: int = 5) -> None:
        self._maps: deque[NDArray[np.float32]] = deque(maxlen=check.integer(frames, "frames", low=1))

    def add(self, heatmap: NDArray[Any]) -> NDArray[np.float32]:
        """Add ``(H, W)`` heat and return the mean, float32; another size clears the history first."""
        heat = _check_heat(heatmap).astype(np.float32)
        if self._maps and self._maps[-1].shape != heat.shape:
            self._maps.clear()
        self._maps.append(heat)
        mean = self._maps[0].copy()
        for other in islice(self._maps, 1, None):
            mean += other
        mean /= len(self._maps)
        return mean

    def clear(self) -> None:
        """Remove all frames."""
        self._maps.clear()
