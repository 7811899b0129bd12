"""From a frame to the input of a network: its size, padding, layout and number format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
from vehicle_detection.network.runtime import Array

Size = tuple[int, int]
"""Height and width in pixels."""

# Largest change of the aspect ratio that avoids padding, and largest enlargement of small frames.
_MAX_SQUEEZE, _MAX_ENLARGEMENT = 0.03, 2.0

# Mean and standard deviation of ImageNet's RGB values, 0 to 1.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def fit_input(shape: tuple[int, ...], input_size: int, multiple: int = 32) -> tuple[Size, Size]:
    """Size of a frame in a network's input, and size of the input.

    Parameters
    ----------
    shape
        ``(height, width, ...)`` of the frame.
    input_size
        Longer side of the input in pixels; small frames are enlarged to twice their size at most.
    multiple
        Number that divides both sides of the input.

    Returns
    -------
    scaled, padded : tuple of int
        Height and width of the resized frame and of the input. They are equal where that changes the aspect
        ratio by at most 3%.

    Examples
    --------
    >>> fit_input((720, 1280), 640), fit_input((480, 600), 640)
    (((352, 640), (352, 640)), ((512, 640), (512, 640)))
    >>> fit_input((1000, 1600), 640)
    ((400, 640), (416, 640))
    """
    longer, shorter = max(shape[:2]), min(shape[:2])
    long_side = _fit_side(min(float(input_size), longer * _MAX_ENLARGEMENT), multiple)
    short_side = _fit_side(shorter * long_side[0] / longer, multiple)
    sides = (short_side, long_side) if shape[0] <= shape[1] else (long_side, short_side)
    return (sides[0][0], sides[1][0]), (sides[0][1], sides[1][1])


def _fit_side(exact: float, multiple: int) -> Size:
    """Length of a side in the input, and with padding."""
    nearest = max(round(exact / multiple), 1) * multiple
    if abs(nearest - exact) <= _MAX_SQUEEZE * exact:
        return nearest, nearest
    scaled = max(round(exact), 1)
    return scaled, -(-scaled // multiple) * multiple


def _resize(
    frame: NDArray[np.uint8], size: Size, target: NDArray[np.uint8] | None, workspace: Workspace
) -> NDArray[Any]:
    """Resize a frame: by means over areas, and then linearly by less than 2.

    OpenCV takes means over whole pixels in a tenth of the time of others.
    """
    height, width = frame.shape[:2]
    factor = min(height // size[0], width // size[1])
    if factor > 1 and height % factor == width % factor == 0:
        memory = workspace.take((height // factor, width // factor, 3), np.uint8, "reduced")
        cv2.resize(frame, (width // factor, height // factor), dst=memory, interpolation=cv2.INTER_AREA)
        frame = memory
    by_less_than_2 = frame.shape[0] < 2 * size[0] and frame.shape[1] < 2 * size[1]
    method = cv2.INTER_LINEAR if by_less_than_2 else cv2.INTER_AREA
    return cv2.resize(frame, size[::-1], dst=target, interpolation=method)


@dataclass(frozen=True)
class InputFormat:
    """What a network expects as its input.

    Attributes
    ----------
    size
        Fixed height and width; None: any multiples of `multiple`.
    dtype
        ``"uint8"``, ``"float32"`` or ``"float16"``.
    channels_first
        Whether the channels are the second axis instead of the last one.
    padding
        Gray level of the padding.
    stretch
        Whether the frame fills the whole input, whatever its aspect ratio.
    bgr, scaled, standardized
        Whether the channels are in the order BGR; floating-point numbers are 0 to 1 instead of 0 to 255; they
        are reduced by the mean of ImageNet and divided by its standard deviation.
    """

    size: Size | None
    dtype: str
    channels_first: bool
    multiple: int = 32
    padding: int = 114
    stretch: bool = False
    bgr: bool = False
    scaled: bool = True
    standardized: bool = False

    def fit(self, shape: tuple[int, ...], input_size: int) -> tuple[Size, Size]:
        """Size of a frame in the input, and size of the input; see `fit_input`."""
        size = (input_size, input_size) if self.size is None and self.stretch else self.size
        if size is None:
            return fit_input(shape, input_size, self.multiple)
        if self.stretch:
            return size, size
        factor = min(size[0] / shape[0], size[1] / shape[1])
        height, width = (min(max(round(side * factor), 1), limit) for side, limit in zip(shape[:2], size))
        return (height, width), size

    def prepare(
        self, frame: NDArray[np.uint8], input_size: int, workspace: Workspace = NEW_ARRAYS
    ) -> tuple[Array, Size]:
        """Resize, pad and convert a frame.

        Returns
        -------
        array : numpy.ndarray
            The input, with a batch of one; valid until the next call with the same workspace in this thread.
        scaled : tuple of int
            Height and width of the frame in it; the padding is at the right and at the bottom.
        """
        scaled, padded = self.fit(frame.shape, input_size)
        image = workspace.take((*padded, 3), np.uint8, "input")
        image[scaled[0] :] = image[: scaled[0], scaled[1] :] = self.padding
        target = image if scaled == padded else None
        resized = _resize(frame, scaled, target, workspace)
        if scaled != padded:
            image[: scaled[0], : scaled[1]] = resized
        return self._convert(image), scaled

    def _convert(self, image: NDArray[np.uint8]) -> Array:
        if self.dtype == "uint8":
            array: Array = image[..., ::-1] if self.bgr else image
            return np.ascontiguousarray((array.transpose(2, 0, 1) if self.channels_first else array)[None])
        factor = 1 / 255 if self.scaled else 1.0
        array = np.asarray(cv2.dnn.blobFromImage(image, factor, swapRB=self.bgr))
        if self.standardized:
            mean, std = np.array([_MEAN, _STD], np.float32)[..., None, None]
            array = (array - mean) / std
        if not self.channels_first:
            array = array.transpose(0, 2, 3, 1)
        return np.ascontiguousarray(array, self.dtype)
