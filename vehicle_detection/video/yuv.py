"""RGB frames out of the planes of video, and planes out of frames.

Video is stored as yuv420p: a plane of luma and two of chroma of half the size, half the bytes of RGB. They go
through the pipes as they are, and the conversion costs a fraction of ffmpeg's, which besides rounds down.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels import channels_from_planes, planes_from_channels

FORMATS = ("yuv420p", "yuvj420p")
"""ffmpeg's names of the pixel formats that are read as planes."""

# Weights of red and blue in luma, by ffmpeg's name of the color space; of green the rest.
_BT_601 = (0.299, 0.114)
_LUMA = {
    "unknown": _BT_601,
    "bt470bg": _BT_601,
    "smpte170m": _BT_601,
    "bt709": (0.2126, 0.0722),
    "bt2020nc": (0.2627, 0.0593),
}

Planes = NDArray[np.uint8]
"""``(H * 3 / 2, W)`` uint8: `H` rows of luma, then the two chroma planes one after the other."""


@dataclass(frozen=True)
class Coding:
    """How the numbers of a video mean colors.

    Attributes
    ----------
    space
        ffmpeg's name of the color space: ``"bt709"``, ``"bt470bg"``, ``"smpte170m"``, ``"bt2020nc"``, or
        ``"unknown"``, which is taken for BT.601.
    full
        Whether luma uses 0-255, as phones have it; else 16-235.
    """

    space: str = "unknown"
    full: bool = False

    @property
    def known(self) -> bool:
        """Whether frames can be made here; else ffmpeg has to."""
        return self.space in _LUMA

    def constants(self) -> tuple[np.int32, ...]:
        """Zero of luma, and the factors of luma and chroma in red, green and blue, times 2**14."""
        red, blue = _LUMA[self.space]
        luma, chroma = (1.0, 1.0) if self.full else (255 / 219, 255 / 224)
        to_red, to_blue = 2 * (1 - red) * chroma, 2 * (1 - blue) * chroma
        green = 1 - red - blue
        factors = (luma, to_red, -to_blue * blue / green, -to_red * red / green, to_blue)
        return np.int32(0 if self.full else 16), *(np.int32(round(value * (1 << 14))) for value in factors)


def _parts(planes: Planes) -> tuple[Planes, Planes, Planes]:
    """Luma and the two planes of chroma, as views."""
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    blue, red = planes[height:].reshape(2, height // 2, width // 2)
    return planes[:height], blue, red


def rgb_from_planes(planes: Planes, coding: Coding, channels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Make a frame from its planes; a chroma value colors four pixels.

    Parameters
    ----------
    planes
        ``(H * 3 / 2, W)`` uint8, `H` and `W` even.
    coding
        What the numbers mean.
    channels
        ``(3, H, W)`` uint8, memory that is written over.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` uint8 RGB, a new array.
    """
    channels_from_planes(*_parts(planes), *coding.constants(), channels)
    return np.asarray(cv2.merge(list(channels)), np.uint8)


def planes_from_rgb(frame: NDArray[np.uint8], planes: Planes, channels: NDArray[np.uint8]) -> None:
    """Convert a frame to planes by BT.601 in the range 16-235; a chroma value is the mean of four pixels.

    An odd side grows by one pixel, which repeats the last column or row.

    Parameters
    ----------
    frame
        ``(H, W, 3)`` uint8 RGB.
    planes
        Output, ``(H' * 3 / 2, W')`` uint8, with `H` and `W` rounded up to even numbers.
    channels
        ``(3, H', W')`` uint8, memory that is written over.
    """
    height, width = channels.shape[1:]
    if frame.shape[:2] != (height, width):
        grown = height - frame.shape[0], width - frame.shape[1]
        grown_frame = cv2.copyMakeBorder(frame, 0, grown[0], 0, grown[1], cv2.BORDER_REPLICATE)
        frame = np.asarray(grown_frame, np.uint8)
    cv2.split(frame, list(channels))
    planes_from_channels(channels, *_parts(planes))
