"""Cuts from one scene of a video to another, where all tracks end."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image

_THUMBNAIL_SHAPE = (18, 32)
# Mean absolute difference of the thumbnails of consecutive frames, 0-255, above which the scene has been cut.
_CUT_DIFFERENCE = 40.0


class SceneCuts:
    """Finds the frames with which a new scene begins, given the frames of a video in their order.

    Examples
    --------
    >>> cuts, dark = SceneCuts(), np.zeros((90, 160, 3), np.uint8)
    >>> [cuts.update(frame) for frame in (dark, dark + 20, dark + 200, dark + 210)]
    [False, False, True, False]
    """

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def update(self, frame: NDArray[np.uint8]) -> bool:
        """Whether the next ``(H, W, 3)`` frame, of any size, belongs to another scene than the one before."""
        check_image(frame, "frame")
        # The gray values of some pixels are enough, and take no time.
        thumbnail = frame[_thumbnail_pixels(frame.shape[:2])].mean(axis=2, dtype=np.float32)
        last, self._last = self._last, thumbnail
        if last is None:
            return False
        return bool(cv2.norm(last, thumbnail, cv2.NORM_L1) > _CUT_DIFFERENCE * thumbnail.size)


@functools.lru_cache(8)
def _thumbnail_pixels(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Rows and columns of the pixels of a thumbnail."""
    sides = zip(shape, _THUMBNAIL_SHAPE)
    return np.ix_(*(np.linspace(0, side - 1, count).astype(np.intp) for side, count in sides))
