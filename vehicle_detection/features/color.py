"""Color spaces, and the channels that HOG is computed on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_image
from vehicle_detection.params import COLOR_SPACES, FeatureParams

_CODES = {
    "HSV": cv2.COLOR_RGB2HSV,
    "LUV": cv2.COLOR_RGB2LUV,
    "HLS": cv2.COLOR_RGB2HLS,
    "YUV": cv2.COLOR_RGB2YUV,
    "YCrCb": cv2.COLOR_RGB2YCrCb,
    "LAB": cv2.COLOR_RGB2LAB,
}


def convert_color(
    image: NDArray[np.uint8], color_space: str = "YCrCb", *, out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Convert an RGB image to another color space, with OpenCV's 8-bit ranges.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    color_space
        ``"RGB"``, ``"HSV"`` (hue 0-179), ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``; the
        course's spelling ``"RGB2YCrCb"`` is accepted, too.
    out
        Output array of the image's shape; None allocates a new one.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` uint8; a copy, also for ``"RGB"``.

    Raises
    ------
    InvalidInputError
        If the image is not uint8 RGB or the color space is unknown.

    Examples
    --------
    >>> convert_color(np.full((1, 1, 3), 200, np.uint8), "YCrCb").tolist()
    [[[200, 128, 128]]]
    """
    check_image(image)
    space = str(color_space).removeprefix("RGB2")
    check_choice(space, "color_space", COLOR_SPACES)
    if space != "RGB":
        return np.asarray(cv2.cvtColor(image, _CODES[space], dst=out), np.uint8)
    if out is None:
        return image.copy()
    out[:] = image
    return out


def hog_source(image: NDArray[np.uint8], params: FeatureParams) -> NDArray[np.uint8]:
    """Channels of an RGB image that HOG is computed on: ``(H, W, hog_channels)`` uint8."""
    if params.hog_channel == "GRAY":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)[..., None]
    return pick_hog_channels(convert_color(image, params.color_space), params)


def pick_hog_channels(converted: NDArray[np.uint8], params: FeatureParams) -> NDArray[np.uint8]:
    """Select the channels of HOG from an image that is already converted; not for ``"GRAY"``."""
    if params.hog_channel == "ALL":
        return converted
    return np.ascontiguousarray(converted[..., int(params.hog_channel), None])
