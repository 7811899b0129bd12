"""Conversion between RGB frames and the YUV 4:2:0 planes of video.

A plane of luma and two of chroma of half the size take half the bytes of RGB in the pipes to ffmpeg, and the
conversion here takes a fraction of the time of ffmpeg's own, which also rounds down.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels import channels_from_planes, planes_from_channels

FORMATS = ("yuv420p", "yuvj420p")
"""ffmpeg's names of the pixel formats that are read as planes."""

# Weights of red and blue in luma, by ffmpeg's name of the color space; green has the rest.
_BT_601 = (0.299, 0.114)
_LUMA_WEIGHTS = {
    "unknown": _BT_601,
    "bt470bg": _BT_601,
    "smpte170m": _BT_601,
    "bt709": (0.2126, 0.0722),
    "bt2020nc": (0.2627, 0.0593),
}

Planes = NDArray[np.uint8]
"""``(H * 3 / 2, W)`` uint8: `H` rows of luma, then the two chroma planes one after the other."""


@dataclass(frozen=True)
class ColorEncoding:
    """How luma and chroma encode colors."""

    space: str = "unknown"  # ffmpeg's name, such as "bt709"; "unknown" is read as BT.601
    full_range: bool = False  # luma is 0-255, as in videos of phones, instead of 16-235

    @property
    def supported(self) -> bool:
        """Whether this module can convert it; otherwise ffmpeg does."""
        return self.space in _LUMA_WEIGHTS

    def constants(self) -> tuple[np.int32, ...]:
        """Zero of luma, and the factors of luma and chroma in red, green and blue, scaled by 2**14."""
        red, blue = _LUMA_WEIGHTS[self.space]
        luma, chroma = (1.0, 1.0) if self.full_range else (255 / 219, 255 / 224)
        to_red, to_blue = 2 * (1 - red) * chroma, 2 * (1 - blue) * chroma
        green = 1 - red - blue
        factors = (luma, to_red, -to_blue * blue / green, -to_red * red / green, to_blue)
        zero = np.int32(0 if self.full_range else 16)
        return zero, *(np.int32(round(value * (1 << 14))) for value in factors)


def _split_planes(planes: Planes) -> tuple[Planes, Planes, Planes]:
    """Return views of the luma plane and the two chroma planes."""
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    blue, red = planes[height:].reshape(2, height // 2, width // 2)
    return planes[:height], blue, red


def rgb_from_planes(
    planes: Planes, encoding: ColorEncoding, channels: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Convert planes of even height and width to a new ``(H, W, 3)`` frame; one chroma value colors 4 pixels.

    `channels` is a ``(3, H, W)`` uint8 scratch array.
    """
    channels_from_planes(*_split_planes(planes), *encoding.constants(), channels)
    return np.asarray(cv2.merge(list(channels)), np.uint8)


def planes_from_rgb(frame: NDArray[np.uint8], planes: Planes, channels: NDArray[np.uint8]) -> None:
    """Convert an ``(H, W, 3)`` frame to BT.601 `planes` (output) in the range 16-235.

    A chroma value is the mean of four pixels. Odd sides are extended by one pixel, which repeats the last
    column or row. `channels` is a ``(3, H', W')`` uint8 scratch array with the even sides.
    """
    height, width = channels.shape[1:]
    if frame.shape[:2] != (height, width):
        bottom, right = height - frame.shape[0], width - frame.shape[1]
        extended = cv2.copyMakeBorder(frame, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        frame = np.asarray(extended, np.uint8)
    cv2.split(frame, list(channels))
    planes_from_channels(channels, *_split_planes(planes))
