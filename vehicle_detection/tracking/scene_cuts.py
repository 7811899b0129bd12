"""Cuts from one scene of a video to another, where all tracks end."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check

Thumbnail = NDArray[np.float32]

# Longer side of a thumbnail, each pixel of which is the mean of `_SAMPLES` x `_SAMPLES` pixels of the frame.
_THUMBNAIL_SIDE, _SAMPLES = 64, 4
# Standard deviation (pixels of a thumbnail) of the Gaussian whose result is subtracted, so that a change of
# brightness does not matter.
_BLUR = 4.0
# Blocks in rows and columns, and the part of a block on each side by which its content may move.
_BLOCKS, _MARGIN = (2, 4), 0.5
# The limits of a cut: the mean absolute difference of two thumbnails (gray values), and the mean correlation
# of their blocks, which is `_BASE` plus `_SLOPE` times the difference, but at most `_MAX_CORRELATION`.
# Measured by ``python -m benchmarks cuts`` on real drives and on pairs of frames of different roads.
_MIN_DIFFERENCE, _BASE, _SLOPE, _MAX_CORRELATION = 12.0, 0.5, 0.01, 0.78
# Standard deviation of a thumbnail's details (gray values) below which nothing can be recognized.
_MIN_DETAIL = 2.0


class SceneCuts:
    """Finds the frames with which a new scene begins, given the frames of a video in their order.

    Frames of a drive are similar block by block, each of which may have moved, also when the camera turns
    fast or the brightness changes. A frame without any detail (a flash, a fade) belongs to the scene before,
    and the frame after it is compared with the last one that has details.

    Examples
    --------
    >>> cuts, random = SceneCuts(), np.random.default_rng(0)
    >>> scenes = random.integers(0, 200, (2, 9, 16, 3), np.uint8)
    >>> first, second = scenes.repeat(10, axis=1).repeat(10, axis=2)
    >>> [cuts.update(frame) for frame in (first, first + 50, first, second, second)]
    [False, False, False, True, False]
    """

    def __init__(self) -> None:
        self._last: tuple[Thumbnail, Thumbnail] | None = None  # the last frame's, and its details

    @staticmethod
    def sample_size(shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width to which a frame of this shape may be sampled before, with the same result."""
        scale = _THUMBNAIL_SIDE / max(shape[:2])
        height, width = (max(8, round(side * scale)) * _SAMPLES for side in shape[:2])
        return height, width

    def update(self, frame: NDArray[np.uint8]) -> bool:
        """Whether the next ``(H, W, 3)`` frame, of any size, belongs to another scene than the one before."""
        check.image(frame, "frame")
        thumbnail = _make_thumbnail(frame)
        details = thumbnail - cv2.GaussianBlur(thumbnail, (0, 0), _BLUR)
        if self._last is not None and details.std() < _MIN_DETAIL:
            return False
        before, self._last = self._last, (thumbnail, details)
        if before is None:
            return False
        last, last_details = before
        if last.shape != thumbnail.shape:
            return True
        # Most frames need the first comparison only.
        difference = float(np.abs(last - thumbnail).mean())
        if difference <= _MIN_DIFFERENCE:
            return False
        limit = min(_BASE + _SLOPE * difference, _MAX_CORRELATION)
        return _correlate_blocks(last_details, details) < limit


def _make_thumbnail(frame: NDArray[np.uint8]) -> Thumbnail:
    """Gray values of a frame's thumbnail, with its aspect ratio."""
    height, width = SceneCuts.sample_size(frame.shape)
    sampled = cv2.resize(frame, (width, height), interpolation=cv2.INTER_NEAREST)
    shrunk = cv2.resize(sampled, (width // _SAMPLES, height // _SAMPLES), interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk.mean(axis=2, dtype=np.float32))


def _correlate_blocks(first: Thumbnail, second: Thumbnail) -> float:
    """Mean over the blocks of `second` of the best correlation with a place near them in `first`."""
    rows, columns = (
        [(index * side // count, (index + 1) * side // count) for index in range(count)]
        for side, count in zip(first.shape, _BLOCKS)
    )
    best = []
    for (top, bottom), (left, right) in itertools.product(rows, columns):
        inner_y, inner_x = (bottom - top) // 5, (right - left) // 5
        block = second[top + inner_y : bottom - inner_y, left + inner_x : right - inner_x]
        margin_y, margin_x = int(_MARGIN * (bottom - top)), int(_MARGIN * (right - left))
        near = first[max(0, top - margin_y) : bottom + margin_y, max(0, left - margin_x) : right + margin_x]
        best.append(cv2.matchTemplate(near, block, cv2.TM_CCOEFF_NORMED).max())
    return float(np.mean(best))
