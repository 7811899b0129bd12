"""FHOG channels of the cells of a frame, at any position and size, from one edge pyramid.

The gradients of a frame are summed over small squares once per octave. A cell of any size is interpolated
from these sums: one pass over the pixels serves all window sizes and all crops.

A cell has 20 channels: 16 signed gradient orientations, each normalized by the contrast around the cell, and
4 texture sums. The gradients are those of the square roots of the pixel values, which gives dark regions more
weight. Felzenszwalb et al., "Object detection with discriminatively trained part-based models" (PAMI 2010),
section 6, without unsigned orientations, which are nearly sums of signed ones; Dollár et al., "Fast feature
pyramids for object detection" (PAMI 2014), for features between the octaves.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import CALLING_THREAD, NEW_ARRAYS, ThreadTeam, Workspace
from vehicle_detection._kernels import BYTE_LIMIT
from vehicle_detection._kernels import fhog as _fhog_kernels

SQUARE = _fhog_kernels.SQUARE

N_CHANNELS = 20
"""FHOG channels of a cell."""

MIRROR_ORDER = np.concatenate([(8 - np.arange(16)) % 16, [17, 16, 19, 18]])
"""Channel of the mirrored image that corresponds to each channel."""

_BIN_BOUNDS = np.deg2rad(np.arange(11.25, 180, 22.5))
_COTANGENTS = (np.cos(_BIN_BOUNDS) / np.sin(_BIN_BOUNDS)).astype(np.float32)
# Added to the energy of a block, in squared gray levels of the mean gradient. Noise of one gray level on a
# medium gray surface has about this energy, and must not be normalized to full contrast.
_EPS = np.float32(2)
# Indices of a single grid.
_FIRST = np.zeros(1, np.intp)
# Empty arrays for outputs of the kernel that the caller does not need.
_NO_CHANNELS, _NO_WORDS = np.empty((0, 0, 0, 0), np.float32), np.empty((0, 0, 0, 0), np.int32)
# Smallest cell of every octave but the first, in pixels of the resized frame: cells have 1.5 to 3 squares a
# side. And the shortest side of a resized frame.
_MIN_CELL, _MIN_SIDE = 6.0, 16
# Rows of squares, and of pixels, that one thread computes at a time; the latter is even.
_PART_ROWS, _SPLIT_ROWS = 24, 180
# Largest values of an orientation and of a texture sum: four and sixteen terms of 0.2, weighted.
_LARGEST = np.where(np.arange(N_CHANNELS) < 16, 0.4, 0.2357 * 16 * 0.2)

CHANNEL_SCALES = (BYTE_LIMIT / _LARGEST).astype(np.float32)
"""Factor of each channel that maps its range to 0 to 127."""

Rows = tuple[int, int]
"""Half-open range of rows of a frame."""


def mirror_channels(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """FHOG channels ``(20, rows, columns)`` of the mirrored image."""
    return np.ascontiguousarray(channels[MIRROR_ORDER, :, ::-1])


@dataclass(frozen=True)
class CellGrid:
    """A grid of cells in pixels of the frame; `left` and `top` are its corner, negative beyond the border."""

    left: float
    top: float
    step_x: float  # width and height of a cell
    step_y: float
    rows: int
    columns: int

    @functools.cached_property
    def first_cell(self) -> NDArray[np.float64]:
        """Corner and size of the first cell, ``(1, 4)``."""
        return np.array([[self.left, self.top, self.step_x, self.step_y]])


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """FHOG channels of a grid of cells, ``(20, rows, columns)``."""

    channels: NDArray[np.float32]
    grid: CellGrid


@dataclass(frozen=True, eq=False)
class Octave:
    """A frame at 1, 1/2, 1/4, ... of its size, with its sums of gradients by orientation."""

    planes: NDArray[np.uint8]  # (3, H, W)
    sums: NDArray[np.float32]  # (rows, columns, 16), of squares from row `first` and column -1 on
    first: int

    def split(self, rows: int) -> list[Octave]:
        """Split the sums into parts of at most so many rows."""
        starts = range(0, len(self.sums), rows)
        return [Octave(self.planes, self.sums[start : start + rows], self.first + start) for start in starts]

    def compute(self) -> None:
        """Compute the sums, in place."""
        _fhog_kernels.orientation_sums(self.planes, self._region, _COTANGENTS, SQUARE, self.sums.reshape(-1))

    @functools.cached_property
    def _region(self) -> NDArray[np.intp]:
        """Place of the sums, see `orientation_sums`: a region that is the whole image."""
        (_, height, width), (rows, columns, _) = self.planes.shape, self.sums.shape
        return np.array([[0, 0, width, height, self.first, rows, columns, 0]], np.intp)

    def channels_of(
        self,
        grids: NDArray[np.float64],
        chosen: NDArray[np.intp],
        cells: NDArray[np.float32],
        channels: NDArray[np.float32],
        packed: NDArray[np.int32],
    ) -> None:
        """Compute the channels of the chosen grids, in squares; see `cell_channels` for the memory."""
        sums = self.sums.reshape(-1)
        _fhog_kernels.cell_channels(
            sums, self._region, SQUARE, grids, chosen, _EPS, CHANNEL_SCALES, cells, channels, packed
        )


class EdgePyramid:
    """Gradient sums of a frame in octaves, from which the channels of any cell follow.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    row_ranges
        For each octave, the rows of the frame whose sums are needed; None or beyond the end: all rows. Cells
        elsewhere take the nearest known rows.
    workspace, team
        Memory and threads of a search; with that memory, a pyramid is valid until the next one. Both also
        serve what follows from the pyramid.
    """

    def __init__(
        self,
        image: NDArray[np.uint8],
        row_ranges: Sequence[Rows] = (),
        workspace: Workspace = NEW_ARRAYS,
        team: ThreadTeam = CALLING_THREAD,
    ) -> None:
        self.shape = image.shape[0], image.shape[1]
        self.workspace, self.team = workspace, team
        self.octaves: list[Octave] = []
        parts: list[Octave] = []
        for number, planes in enumerate(_octave_planes(image, workspace, team)):
            scale, squares = 2**number * SQUARE, -(-planes.shape[1] // SQUARE)
            top, bottom = row_ranges[number] if number < len(row_ranges) else (0, self.shape[0])
            # One row of squares beyond the image is the replica of its border.
            first = min(max(math.floor(top / scale) - 1, -1), squares - 1)
            last = max(min(math.ceil(bottom / scale) + 1, squares + 1), first + 1)
            size = last - first, -(-planes.shape[2] // SQUARE) + 2, 16
            octave = Octave(planes, workspace.take(size, np.float32, f"sums {number}"), first)
            self.octaves.append(octave)
            parts += octave.split(_PART_ROWS)
        team.map(Octave.compute, parts, cost=lambda part: part.sums.size)

    def by_octave(self, sizes: NDArray[np.float64]) -> list[tuple[int, NDArray[np.intp]]]:
        """Octaves, and which of several cells each of them serves; sizes are in pixels of the frame."""
        octaves = np.log2(np.maximum(sizes, _MIN_CELL) / _MIN_CELL).astype(np.intp)
        octaves = np.minimum(octaves, len(self.octaves) - 1)
        return [(number, np.flatnonzero(octaves == number)) for number in set(octaves.tolist())]

    def crops(self, grids: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float32]:
        """FHOG channels of several grids of as many cells, ``(N, 20, rows, columns)``.

        `grids` is ``(N, 4)``: left, top, width and height of each grid's first cell in pixels of the frame.
        Small cells are computed from the pixels, in more detail than those of `feature_map`. With a workspace
        for the pyramid, the channels are valid until the next call in the same thread.
        """
        channels = self.workspace.take((len(grids), N_CHANNELS, rows, columns), np.float32, "crops")
        cells = np.empty(_fhog_kernels.cells_shape(rows, columns), np.float32)
        sizes = np.sqrt(grids[:, 2] * grids[:, 3])
        for number, chosen in self.by_octave(sizes):
            if number == 0:
                self._compute_small(grids, np.flatnonzero(sizes < _MIN_CELL), cells, channels)
                chosen = chosen[sizes[chosen] >= _MIN_CELL]
            scaled = grids / (SQUARE * 2**number)
            self.octaves[number].channels_of(scaled, chosen, cells, channels, _NO_WORDS)
        return channels

    def _compute_small(
        self,
        grids: NDArray[np.float64],
        chosen: NDArray[np.intp],
        cells: NDArray[np.float32],
        channels: NDArray[np.float32],
    ) -> None:
        """FHOG channels of the chosen grids of small cells, from small squares of the pixels around each."""
        planes, square = self.octaves[0].planes, _fhog_kernels.SMALL_SQUARE
        shape, corners, steps = np.array(planes.shape[:0:-1]), grids[:, :2], grids[:, 2:]
        # Two cells and two squares around the grid; the image's own border is replicated.
        ends = corners + (np.array(channels.shape[:1:-1]) + 2) * steps
        low = (np.floor(corners - 2 * steps) - 2 * square).clip(0, shape - 1).astype(np.intp)
        high = (np.ceil(ends) + 2 * square).clip(low + 1, shape).astype(np.intp)
        scaled = np.hstack([corners - low, steps]) / square
        columns, rows = ((high - low + 1)[chosen] // square + 2).T
        counts = 16 * rows * columns
        first, places = np.full_like(rows, -1), counts.cumsum() - counts
        regions = np.column_stack([low[chosen], high[chosen], first, rows, columns, places])
        # A power of two: few different sizes of memory.
        size = 1 << int(counts.sum()).bit_length()
        sums = self.workspace.take((size,), np.float32, "small sums")
        _fhog_kernels.orientation_sums(planes, regions, _COTANGENTS, square, sums)
        _fhog_kernels.cell_channels(
            sums, regions, square, scaled, chosen, _EPS, CHANNEL_SCALES, cells, channels, _NO_WORDS
        )

    def feature_map(self, grid: CellGrid) -> FeatureMap:
        """FHOG channels of one grid."""
        channels = np.empty((1, N_CHANNELS, grid.rows, grid.columns), np.float32)
        cells = np.empty(_fhog_kernels.cells_shape(grid.rows, grid.columns), np.float32)
        self._grid_channels(grid, cells, channels, _NO_WORDS)
        return FeatureMap(channels[0], grid)

    def packed_channels(self, grid: CellGrid) -> NDArray[np.int32]:
        """FHOG channels of a grid, times `CHANNEL_SCALES` and rounded, as words of four channels.

        ``(words, rows, columns)``; the value of a word's first channel is in its lowest bits.
        """
        shape = _fhog_kernels.cells_shape(grid.rows, grid.columns)
        cells = self.workspace.take(shape, np.float32, "cells")
        packed = self.workspace.take((1, N_CHANNELS // 4, grid.rows, grid.columns), np.int32, "packed")
        self._grid_channels(grid, cells, _NO_CHANNELS, packed)
        return np.asarray(packed[0])

    def _grid_channels(
        self,
        grid: CellGrid,
        cells: NDArray[np.float32],
        channels: NDArray[np.float32],
        packed: NDArray[np.int32],
    ) -> None:
        number = octave_of(math.sqrt(grid.step_x * grid.step_y), len(self.octaves))
        first_cell = grid.first_cell / (SQUARE * 2**number)
        self.octaves[number].channels_of(first_cell, _FIRST, cells, channels, packed)


def octave_count(shape: tuple[int, ...]) -> int:
    """Return the number of octaves of a frame of ``(height, width, ...)``."""
    return max(math.floor(math.log2(min(shape[:2]) / _MIN_SIDE)), 0) + 1


def octave_of(cell_size: float, count: int) -> int:
    """Return the octave, of `count`, from which cells of a size in pixels of the frame are interpolated."""
    return min(max(math.floor(math.log2(cell_size / _MIN_CELL)), 0), count - 1)


def _octave_planes(
    image: NDArray[np.uint8], workspace: Workspace, team: ThreadTeam
) -> list[NDArray[np.uint8]]:
    """Channels of an image at 1, 1/2, 1/4, ... of its size, ``(3, H, W)`` each; sides are rounded up."""
    height, width = image.shape[:2]
    planes = []
    for number in range(octave_count(image.shape)):
        planes.append(workspace.take((3, height, width), np.uint8, f"planes {number}"))
        height, width = -(-height // 2), -(-width // 2)
    image = np.ascontiguousarray(image)
    halves = planes[1] if len(planes) > 1 else np.empty((3, 0, 0), np.uint8)

    def split(first: int) -> None:
        last = min(first + _SPLIT_ROWS, len(image))
        _fhog_kernels.split_channels(image, first, last, planes[0], halves)

    team.map(split, range(0, len(image), _SPLIT_ROWS), cost=lambda first: -first)
    for whole, half in pairwise(planes[1:]):
        _half_size(whole, half)
    return planes


def _half_size(planes: NDArray[np.uint8], halves: NDArray[np.uint8]) -> None:
    """Average 2x2 pixels; an odd last row or column is replicated first."""
    below, right = planes.shape[1] % 2, planes.shape[2] % 2
    for plane, half in zip(planes, halves):
        if below or right:
            plane = cv2.copyMakeBorder(plane, 0, below, 0, right, cv2.BORDER_REPLICATE)
        cv2.resize(plane, half.shape[::-1], dst=half, interpolation=cv2.INTER_AREA)
