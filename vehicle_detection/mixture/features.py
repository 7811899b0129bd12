"""FHOG channels of an image pyramid: the features of each cell of a frame.

A cell has 28 channels: 16 signed and 8 unsigned gradient orientations, each normalized by the contrast around
the cell, and 4 texture sums. The gradients are those of the square roots of the pixel values, which gives
dark regions more weight. Felzenszwalb et al., "Object detection with discriminatively trained part-based
models" (PAMI 2010), section 6, with 8 unsigned orientations instead of 9.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace
from vehicle_detection._kernels import fhog as _fhog_kernels

N_CHANNELS = 28
"""FHOG channels of a cell."""

COARSE, FINE = 8, 4
"""Side of a cell in pixels of the resized frame. Fine cells avoid enlarging the frame for small vehicles."""

BORDER, WIDE_BORDER = 24, 48
"""Replicated pixels around a resized frame. The wide border is for levels of coarse cells only: vehicles of
that size are near, and often truncated by the frame's border."""

MIRROR_ORDER = np.concatenate([(8 - np.arange(16)) % 16, 16 + (8 - np.arange(8)) % 8, [25, 24, 27, 26]])
"""Channel of the mirrored image that corresponds to each channel."""

_BIN_BOUNDS = np.deg2rad(np.arange(11.25, 180, 22.5))
_COTANGENTS = (np.cos(_BIN_BOUNDS) / np.sin(_BIN_BOUNDS)).astype(np.float32)
# Added to the energy of a block, in squared gray levels of the mean gradient. Noise of one gray level on a
# medium gray surface has about this energy, and must not be normalized to full contrast.
_EPS = np.float32(2)


def orientation_sums(image: NDArray[np.uint8], workspace: Workspace = NEW_ARRAYS) -> NDArray[np.float32]:
    """Gradient magnitudes by signed orientation, summed over 4x4 pixels; ``(16, H // 4, W // 4)``."""
    height, width = image.shape[:2]
    channels = workspace.take((3, height, width), np.uint8, "channels")
    cv2.split(image, list(channels))
    sums = workspace.take((16, height // FINE, width // FINE), np.float32, "sums")
    _fhog_kernels.orientation_sums(channels, _COTANGENTS, sums)
    return sums


def channels_from_sums(
    sums: NDArray[np.float32], cell: int, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """FHOG channels of `FINE` or `COARSE` cells from `orientation_sums`; ``(28, H // cell, W // cell)``."""
    per_cell = cell // FINE
    shape = sums.shape[1] // per_cell, sums.shape[2] // per_cell
    cells = workspace.take((16, *shape), np.float32, "cells")
    if per_cell == 1:
        _fhog_kernels.smooth_cells(sums, np.float32(1 / (64 * cell * cell)), cells)
    else:
        _fhog_kernels.pool_bilinear(sums, np.float32(1 / (16 * cell * cell)), cells)
    channels = workspace.take((N_CHANNELS, *shape), np.float32, "fhog")
    _fhog_kernels.fhog_normalize(cells, _EPS, channels)
    return channels


def fhog_channels(
    image: NDArray[np.uint8], cell: int, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """FHOG channels of an image of at least one cell, ``(28, H // cell, W // cell)`` float32."""
    return channels_from_sums(orientation_sums(image, workspace), cell, workspace)


def mirror_channels(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """FHOG channels ``(28, rows, columns)`` of the mirrored image."""
    return np.ascontiguousarray(channels[MIRROR_ORDER, :, ::-1])


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """FHOG channels of a frame at one cell size, with their position in pixels of the frame."""

    channels: NDArray[np.float32]  # (28, rows, columns)
    left: float  # position of the first cell's corner, negative beyond the frame's border
    top: float
    step_x: float  # width and height of a cell
    step_y: float


def image_pyramid(image: NDArray[np.uint8], min_side: int = 64) -> list[NDArray[np.uint8]]:
    """Halve an image repeatedly while its shorter side stays at least `min_side` pixels."""
    images = [image]
    while min(images[-1].shape[:2]) >= 2 * min_side:
        height, width = images[-1].shape[:2]
        smaller = cv2.resize(images[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        images.append(np.asarray(smaller, np.uint8))
    return images


@dataclass(frozen=True)
class PyramidLevel:
    """One resized frame with fine cells, coarse cells or both; their sizes in pixels of the frame."""

    fine: float | None
    coarse: float | None

    @property
    def scale(self) -> float:
        """Size of the resized frame relative to the frame."""
        return FINE / self.fine if self.fine is not None else COARSE / (self.coarse or COARSE)

    @property
    def sizes(self) -> list[tuple[float, int]]:
        """Size of each kind of cell, in pixels of the frame and of the resized frame."""
        both = (self.fine, FINE), (self.coarse, COARSE)
        return [(size, cell) for size, cell in both if size is not None]


def pyramid_levels(sizes: list[float], *, share: bool = True) -> list[PyramidLevel]:
    """Choose fine or coarse cells for each cell size; with `share`, a size and its double share a level."""
    fine = [size for size in sizes if size < COARSE]
    coarse = [size for size in sizes if size >= COARSE]
    levels = []
    for size in fine:
        double = next((other for other in coarse if share and abs(other / size - 2) < 1e-6), None)
        if double is not None:
            coarse.remove(double)
        levels.append(PyramidLevel(size, double))
    return levels + [PyramidLevel(None, size) for size in coarse]


def feature_maps(
    images: list[NDArray[np.uint8]],
    level: PyramidLevel,
    rows: tuple[int, int],
    workspace: Workspace = NEW_ARRAYS,
) -> Iterator[tuple[float, FeatureMap]]:
    """Yield each cell size of a level, in pixels of the frame, with the feature map of a range of rows.

    `images` is the `image_pyramid` of the frame, `rows` a half-open range in the frame. With reused memory
    (`workspace`), a map is valid until the next one.
    """
    height, width = images[0].shape[:2]
    octave = min(max(int(math.log2(1 / level.scale)), 0), len(images) - 1)
    source = images[octave]
    # The strip consists of whole rows of the source; `top` and `bottom` are its exact limits in the frame.
    count = source.shape[0]
    first = min(round(rows[0] * count / height), count - 1)
    last = max(round(rows[1] * count / height), first + 1)
    strip = source[first:last]
    top, bottom = first * height / count, last * height / count
    size = max(round(width * level.scale), COARSE), max(round((bottom - top) * level.scale), COARSE)
    small = np.asarray(
        cv2.resize(strip, size, dst=workspace.take((size[1], size[0], 3), np.uint8, "strip")), np.uint8
    )
    # Only the frame's own border is replicated: `rows` already includes the context of the windows.
    border = BORDER if level.fine is not None else WIDE_BORDER
    above, below = (border if at_border else 0 for at_border in (first == 0, last == count))
    padding = (above, below + -(size[1] + above + below) % COARSE, border, border + -size[0] % COARSE)
    shape = (size[1] + padding[0] + padding[1], size[0] + padding[2] + padding[3], 3)
    memory = workspace.take(shape, np.uint8, "padded")
    padded = np.asarray(cv2.copyMakeBorder(small, *padding, cv2.BORDER_REPLICATE, dst=memory), np.uint8)
    sums = orientation_sums(padded, workspace)
    pixel_x, pixel_y = width / size[0], (bottom - top) / size[1]
    left, top = -border * pixel_x, top - above * pixel_y
    for cell_size, cell in level.sizes:
        channels = channels_from_sums(sums, cell, workspace)
        yield cell_size, FeatureMap(channels, left, top, cell * pixel_x, cell * pixel_y)
