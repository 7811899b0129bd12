"""Conversion between RGB frames and the YUV 4:2:0 planes of video.

A plane of luma and two of chroma of half the size take half the bytes of RGB in the pipes to ffmpeg, and
OpenCV's conversion takes a fraction of the time of ffmpeg's, which also rounds down.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
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

    @functools.cache  # noqa: B019 - for a few encodings
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


class DecodedFrame:
    """A frame of a source: RGB pixels, or what they are computed from where they are needed."""

    def __init__(self, pixels: NDArray[np.uint8]) -> None:
        self._pixels = pixels

    def rgb(self) -> NDArray[np.uint8]:
        """Return the ``(H, W, 3)`` pixels."""
        return self._pixels

    def reduced(self, factor: int) -> NDArray[np.uint8]:
        """Return the means over squares of `factor` pixels, by which the sides are divisible."""
        return _resize(self._pixels, [side // factor for side in self._pixels.shape[:2]], cv2.INTER_AREA)

    def sampled(self, size: Sequence[int]) -> NDArray[np.uint8]:
        """Return one pixel each for those of another height and width."""
        return _resize(self._pixels, size, cv2.INTER_NEAREST)


class PlanarFrame(DecodedFrame):
    """A frame as planes of even height and width."""

    def __init__(self, planes: Planes, encoding: ColorEncoding) -> None:
        self.planes, self.encoding = planes, encoding

    def rgb(self) -> NDArray[np.uint8]:
        """Convert the planes to a new array."""
        return rgb_from_planes(self.planes, self.encoding)

    def reduced(self, factor: int) -> NDArray[np.uint8]:
        """Convert fewer pixels, the means over squares of luma; chroma has half the size already."""
        luma, *chroma = split_planes(self.planes)
        size = luma.shape[0] // factor, luma.shape[1] // factor
        # Chroma is reduced by 1.5 then: OpenCV takes means over parts of pixels slowly, and chroma is smooth.
        method = cv2.INTER_LINEAR if factor == 3 else cv2.INTER_AREA
        return self._convert(
            _resize(luma, size, cv2.INTER_AREA), *(_resize(plane, size, method) for plane in chroma)
        )

    def sampled(self, size: Sequence[int]) -> NDArray[np.uint8]:
        """Convert only the pixels that are returned."""
        return self._convert(
            *(_resize(plane, size, cv2.INTER_NEAREST) for plane in split_planes(self.planes))
        )

    def _convert(self, *channels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.transform(cv2.merge(channels), self.encoding.matrix()), np.uint8)


def _resize(image: NDArray[np.uint8], size: Sequence[int], method: int) -> NDArray[np.uint8]:
    """Resize an image to a height and width."""
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=method), np.uint8)


def split_planes(planes: Planes) -> tuple[Planes, Planes, Planes]:
    """Return views of luma ``(H, W)``, and of blue and red chroma ``(H / 2, W / 2)``."""
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    blue, red = planes[height:].reshape(2, height // 2, width // 2)
    return planes[:height], blue, red


def rgb_from_planes(planes: Planes, encoding: ColorEncoding) -> NDArray[np.uint8]:
    """Convert planes of even height and width to a new ``(H, W, 3)`` frame."""
    if _LUMA_WEIGHTS[encoding.space] == _BT_601 and not encoding.full_range:
        # Luma below 16 counts as 16.
        return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420), np.uint8)
    luma, *chroma = split_planes(planes)
    # Each value twice, as a number of two bytes.
    wide = [(plane.astype(np.uint16) * 257).view(np.uint8) for plane in chroma]
    frame, matrix = np.empty((*luma.shape, 3), np.uint8), encoding.matrix()
    for first in (0, 1):  # two rows of luma share one of chroma
        cv2.transform(cv2.merge([luma[first::2], *wide]), matrix, dst=frame[first::2])
    return frame


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
    _, blue, red = split_planes(planes)
    blue[:], red[:], _ = cv2.split(cv2.transform(means, _CHROMA))
