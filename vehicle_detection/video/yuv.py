"""Conversion between RGB frames and the YUV 4:2:0 planes of video.

A plane of luma and two of chroma of half the size take half the bytes of RGB in the pipes to ffmpeg, and
OpenCV's conversion takes a fraction of the time of ffmpeg's, which also rounds down.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

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
# Blue and red chroma of RGB in BT.601, 16-240, with their offset; OpenCV is fast for three outputs only.
_CHROMA = np.array(
    [
        [-0.299 / 1.772, -0.587 / 1.772, 0.5, 128 * 255 / 224],
        [0.5, -0.587 / 1.402, -0.114 / 1.402, 128 * 255 / 224],
        [0, 0, 0, 0],
    ]
) * (224 / 255)  # fmt: skip

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

    def matrix(self) -> NDArray[np.float64]:
        """Return the ``(3, 4)`` matrix from ``(luma, blue, red, 1)`` to RGB."""
        red, blue = _LUMA_WEIGHTS[self.space]
        luma, chroma = (1.0, 1.0) if self.full_range else (255 / 219, 255 / 224)
        to_red, to_blue = 2 * (1 - red) * chroma, 2 * (1 - blue) * chroma
        green = 1 - red - blue
        factors = np.array(
            [
                [luma, 0.0, to_red],
                [luma, -to_blue * blue / green, -to_red * red / green],
                [luma, to_blue, 0.0],
            ]
        )
        zero = [0.0 if self.full_range else 16.0, 128.0, 128.0]
        return np.column_stack([factors, -factors @ zero])


def rgb_from_planes(planes: Planes, encoding: ColorEncoding) -> NDArray[np.uint8]:
    """Convert planes of even height and width to a new ``(H, W, 3)`` frame."""
    if _LUMA_WEIGHTS[encoding.space] == _BT_601 and not encoding.full_range:
        # Luma below 16 counts as 16.
        return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420), np.uint8)
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    channels = [planes[:height]]
    for chroma in planes[height:].reshape(2, height // 2, width // 2):
        # Each value twice, as a number of two bytes; then each row twice.
        wide = (chroma.astype(np.uint16) * 257).view(np.uint8)
        channels.append(wide.repeat(2, axis=0))
    return np.asarray(cv2.transform(cv2.merge(channels), encoding.matrix()), np.uint8)


def planes_from_rgb(frame: NDArray[np.uint8], planes: Planes) -> None:
    """Convert an ``(H, W, 3)`` frame to BT.601 `planes` (output) in the range 16-235.

    A chroma value is that of the mean of four pixels. Odd sides are extended by one pixel, which repeats the
    last column or row.
    """
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    if frame.shape[:2] != (height, width):
        bottom, right = height - frame.shape[0], width - frame.shape[1]
        extended = cv2.copyMakeBorder(frame, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        frame = np.asarray(extended, np.uint8)
    cv2.cvtColor(frame, cv2.COLOR_RGB2YUV_I420, dst=planes)
    # OpenCV's chroma is that of one pixel of four.
    means = cv2.resize(frame, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    blue, red = planes[height:].reshape(2, height // 2, width // 2)
    blue[:], red[:], _ = cv2.split(cv2.transform(means, _CHROMA))
