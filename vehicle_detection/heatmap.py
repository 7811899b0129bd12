"""Windows to a heat map, and the heat map to labelled regions: the course's way from hits to vehicles."""

from __future__ import annotations

from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_integer, check_number, describe
from vehicle_detection.boxes import Detections, clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import HeatParams


def _check_heat(heatmap: object) -> NDArray[Any]:
    if not isinstance(heatmap, np.ndarray) or heatmap.ndim != 2 or heatmap.dtype.kind not in "iuf":
        raise InvalidInputError(
            f"heatmap must be an (H, W) number array, got {describe(heatmap)}; start with "
            "numpy.zeros(image.shape[:2], numpy.float32)"
        )
    return heatmap


def add_heat(
    heatmap: NDArray[Any], boxes: ArrayLike, *, scores: ArrayLike | None = None
) -> NDArray[np.float32]:
    """Add each window to the heat of the pixels it covers.

    A rectangle is added as four corner differences and the map is summed up once, so that the cost does
    not grow with the windows' area.

    Parameters
    ----------
    heatmap
        ``(H, W)``; not changed.
    boxes
        ``(N, 4)`` windows; fractions of a pixel are rounded, parts outside the map are cut off.
    scores
        ``(N,)`` heat that each window adds; None adds 1 each, as in the course.

    Returns
    -------
    numpy.ndarray
        A new ``(H, W)`` float32 map.

    Raises
    ------
    InvalidInputError
        If the map is not two-dimensional, or boxes and scores do not fit each other.

    Examples
    --------
    >>> add_heat(np.zeros((2, 4)), [[0, 0, 2, 2], [1, 0, 3, 1]])
    array([[1., 2., 1., 0.],
           [1., 1., 0., 0.]], dtype=float32)
    """
    heat = _check_heat(heatmap)
    height, width = heat.shape
    windows = check_boxes(boxes)
    weights = np.ones(len(windows)) if scores is None else Detections(windows, np.asarray(scores)).scores
    x1, y1, x2, y2 = clip_boxes(np.rint(windows), heat.shape).astype(np.int64).T
    corners = np.zeros((height + 1, width + 1))
    for rows, columns, sign in ((y1, x1, 1), (y1, x2, -1), (y2, x1, -1), (y2, x2, 1)):
        np.add.at(corners, (rows, columns), sign * weights)
    # Only the part that windows touch is summed up.
    result = heat.astype(np.float32)
    if len(windows):
        top, bottom, left, right = y1.min(), y2.max(), x1.min(), x2.max()
        part = corners[top:bottom, left:right].cumsum(axis=0).cumsum(axis=1)
        # Sums of floats leave dust where the heat is zero.
        part[np.abs(part) < 1e-9 * max(1.0, np.abs(weights).sum())] = 0
        result[top:bottom, left:right] += part.astype(np.float32)
    return result


def apply_threshold(heatmap: NDArray[Any], threshold: float) -> NDArray[np.float32]:
    """Return the map with heat at or below the threshold set to zero; the argument is not changed.

    Examples
    --------
    >>> apply_threshold(np.array([[1.0, 2.0, 3.0]]), 2)
    array([[0., 0., 3.]], dtype=float32)
    """
    heat = _check_heat(heatmap).astype(np.float32)
    check_number(threshold, "threshold")
    heat[heat <= threshold] = 0
    return heat


def label_boxes(heatmap: NDArray[Any], *, threshold: float = 0.0, peak_fraction: float = 0.0) -> Detections:
    """Find the connected regions of a heat map and their boxes.

    Parameters
    ----------
    heatmap
        ``(H, W)`` heat.
    threshold
        Heat at or below this belongs to no region.
    peak_fraction
        0 gives the box of the whole region, as the course does. In (0, 1), the box of the part around the
        region's peak that reaches this share of the peak's heat: windows spill over the vehicle, and the
        spill is cooler.

    Returns
    -------
    Detections
        ``(N, 4)`` int64 boxes and the heat of their peaks, from top to bottom.

    Raises
    ------
    InvalidInputError
        If the map is not two-dimensional or a number is out of range.

    Examples
    --------
    >>> heat = np.array([[0, 0, 0, 0, 0], [0, 1, 4, 3, 0], [0, 0, 0, 0, 0]])
    >>> label_boxes(heat).boxes.tolist(), label_boxes(heat, share=0.5).boxes.tolist()
    ([[1, 1, 4, 2]], [[2, 1, 4, 2]])
    """
    heat = _check_heat(heatmap)
    check_number(peak_fraction, "peak_fraction", low=0, high=0.99)
    boxes, peaks = [], []
    for left, top, region, member in _components(heat > check_number(threshold, "threshold", low=0)):
        part = np.where(member, heat[region], 0)
        peak = float(part.max())
        x1, y1, x2, y2 = left, top, left + part.shape[1], top + part.shape[0]
        if peak_fraction > 0:
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            for x, y, inner, around in _components(part >= peak_fraction * peak):
                rows, columns = inner
                if rows.start <= row < rows.stop and columns.start <= column < columns.stop:
                    if not around[row - rows.start, column - columns.start]:
                        continue
                    x1, y1 = left + x, top + y
                    x2, y2 = x1 + around.shape[1], y1 + around.shape[0]
        boxes.append((x1, y1, x2, y2))
        peaks.append(peak)
    return Detections(np.array(boxes, np.int64).reshape(-1, 4), np.array(peaks))


def _components(mask: NDArray[np.bool_]) -> list[tuple[int, int, tuple[slice, slice], NDArray[np.bool_]]]:
    """Left, top, slices and own mask of each 8-connected component, from top to bottom."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    found = []
    for index in range(1, count):
        x, y, width, height = (int(value) for value in stats[index, :4])
        region = (slice(y, y + height), slice(x, x + width))
        found.append((x, y, region, labels[region] == index))
    # OpenCV counts by blocks of two rows and columns.
    return sorted(found, key=lambda component: component[1::-1])


def bounding_boxes(
    shape: tuple[int, ...], windows: Detections, *, params: HeatParams | None = None
) -> Detections:
    """Heat, threshold and labels in one: the boxes that a frame's positive windows make.

    Parameters
    ----------
    shape
        ``(height, width, ...)`` of the frame.
    windows
        Positive windows and scores.
    params
        Weighting, threshold and share of the peak; the default is ``HeatParams()``.

    Returns
    -------
    Detections
        Boxes and the heat of their peaks.

    Examples
    --------
    >>> windows = Detections([[0, 0, 8, 8], [4, 0, 12, 8]], [2.0, 1.5])
    >>> bounding_boxes((20, 20), windows, params=HeatParams(threshold=1.0, share=0.0)).boxes.tolist()
    [[0, 0, 12, 8]]
    """
    params = params or HeatParams()
    return label_boxes(
        frame_heat(shape, windows, params), threshold=params.threshold, peak_fraction=params.peak_fraction
    )


def frame_heat(shape: tuple[int, ...], windows: Detections, params: HeatParams) -> NDArray[np.float32]:
    """Heat of one frame's windows, ``(H, W)`` float32, by the weighting of `params`."""
    scores = windows.scores.clip(0) if params.weighting == "score" else None
    return add_heat(np.zeros(shape[:2], np.float32), windows.boxes, scores=scores)


class HeatHistory:
    """Mean heat over the last frames, which steadies regions and drowns hits that do not last.

    Parameters
    ----------
    frames
        How many frames are remembered.

    Examples
    --------
    >>> history = HeatHistory(2)
    >>> _ = history.add(np.full((1, 1), 4.0))
    >>> history.add(np.full((1, 1), 2.0)).tolist()
    [[3.0]]
    """

    def __init__(self, frames: int = 5) -> None:
        self._maps: deque[NDArray[np.float32]] = deque(maxlen=check_integer(frames, "frames", low=1))

    def add(self, heatmap: NDArray[Any]) -> NDArray[np.float32]:
        """Remember a frame's heat and return the mean over the remembered ones, ``(H, W)`` float32.

        A map of another size starts the history anew.
        """
        heat = _check_heat(heatmap).astype(np.float32)
        if self._maps and self._maps[-1].shape != heat.shape:
            self._maps.clear()
        self._maps.append(heat)
        return np.asarray(np.mean(self._maps, axis=0), np.float32)

    def clear(self) -> None:
        """Forget all frames."""
        self._maps.clear()
