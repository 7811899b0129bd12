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

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
# In place of an output of the kernel that is not wanted.
_NO_CHANNELS, _NO_WORDS = np.empty((0, 0, 0, 0), np.float32), np.empty((0, 0, 0, 0), np.int32)
# Smallest cell of every octave but the first, in pixels of the resized frame: cells have 1.5 to 3 squares a
# side. And the shortest side of a resized frame.
_MIN_CELL, _MIN_SIDE = 6.0, 16
# Rows of squares that one thread computes at a time.
_PART_ROWS = 24
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
        _fhog_kernels.orientation_sums(self.planes, _COTANGENTS, SQUARE, self.first, self.sums)

    def channels_of(
        self,
        grids: NDArray[np.float64],
        cells: NDArray[np.float32],
        channels: NDArray[np.float32],
        packed: NDArray[np.int32],
    ) -> None:
        """Compute the channels of grids, in squares; see `cell_channels` for the memory."""
        squares = -(-self.planes.shape[1] // SQUARE)
        _fhog_kernels.cell_channels(
            self.sums, SQUARE, self.first, squares, grids, _EPS, CHANNEL_SCALES, cells, channels, packed
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
        Memory and threads of a search; with that memory, a pyramid is valid until the next one. The threads
        also compute what follows from the pyramid.
    """

    def __init__(
        self,
        image: NDArray[np.uint8],
        row_ranges: Sequence[Rows] = (),
        workspace: Workspace = NEW_ARRAYS,
        team: ThreadTeam = CALLING_THREAD,
    ) -> None:
        self.shape = image.shape[0], image.shape[1]
        self.team = team
        planes = workspace.take((3, *self.shape), np.uint8, "planes 0")
        cv2.split(image, list(planes))
        self.octaves: list[Octave] = []
        parts: list[Octave] = []
        for number in range(octave_count(self.shape)):
            if number:
                planes = _half_size(planes, workspace, f"planes {number}")
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

    def octave_of(self, cell_size: float) -> int:
        """Octave from which cells of a size in pixels of the frame are interpolated."""
        return octave_of(cell_size, len(self.octaves))

    def crops(self, grids: NDArray[np.float64], rows: int, columns: int) -> NDArray[np.float32]:
        """FHOG channels of several grids of as many cells, ``(N, 20, rows, columns)``.

        `grids` is ``(N, 4)``: left, top, width and height of each grid's first cell in pixels of the frame.
        Small cells are computed from the pixels, in more detail than those of `feature_map`.
        """
        channels = np.empty((len(grids), N_CHANNELS, rows, columns), np.float32)
        sizes = np.sqrt(grids[:, 2] * grids[:, 3])
        numbers = np.array([octave_of(size, len(self.octaves)) for size in sizes.tolist()], np.intp)
        numbers[sizes < _MIN_CELL] = -1
        for number in np.unique(numbers).tolist():
            chosen = numbers == number
            found = np.empty((int(chosen.sum()), *channels.shape[1:]), np.float32)
            if number < 0:
                self._compute_small(grids[chosen], found)
            else:
                self._interpolate(number, grids[chosen], found)
            channels[chosen] = found
        return channels

    def _interpolate(self, number: int, grids: NDArray[np.float64], channels: NDArray[np.float32]) -> None:
        octave, scaled = self.octaves[number], grids / (SQUARE * 2**number)
        cells = np.empty(_cells_shape(channels.shape), np.float32)
        octave.channels_of(scaled, cells, channels, _NO_WORDS)

    def _compute_small(self, grids: NDArray[np.float64], channels: NDArray[np.float32]) -> None:
        """FHOG channels of grids of small cells, from small squares of the pixels around each."""
        planes, square = self.octaves[0].planes, _fhog_kernels.SMALL_SQUARE
        shape, steps = np.array(planes.shape[:0:-1]), grids[:, 2:]
        # Two cells and two squares around the grid; the image's own border is replicated.
        ends = grids[:, :2] + (np.array(channels.shape[:1:-1]) + 2) * steps
        low = (np.floor(grids[:, :2] - 2 * steps) - 2 * square).clip(0, shape - 1).astype(np.intp)
        high = (np.ceil(ends) + 2 * square).clip(low + 1, shape).astype(np.intp)
        scaled = np.hstack([grids[:, :2] - low, steps]) / square
        cells = np.empty(_cells_shape(channels.shape), np.float32)
        for number, ((left, top), (right, bottom)) in enumerate(zip(low.tolist(), high.tolist())):
            region = np.ascontiguousarray(planes[:, top:bottom, left:right])
            down, across = (bottom - top + 1) // square, (right - left + 1) // square
            sums = np.empty((down + 2, across + 2, 16), np.float32)
            _fhog_kernels.orientation_sums(region, _COTANGENTS, square, -1, sums)
            outputs = channels[number : number + 1], _NO_WORDS
            grid = scaled[number : number + 1]
            _fhog_kernels.cell_channels(sums, square, -1, down, grid, _EPS, CHANNEL_SCALES, cells, *outputs)

    def feature_map(self, grid: CellGrid) -> FeatureMap:
        """FHOG channels of one grid."""
        corner = np.array([[grid.left, grid.top, grid.step_x, grid.step_y]])
        channels = np.empty((1, N_CHANNELS, grid.rows, grid.columns), np.float32)
        self._interpolate(self.octave_of(math.sqrt(grid.step_x * grid.step_y)), corner, channels)
        return FeatureMap(channels[0], grid)

    def packed_channels(self, grid: CellGrid, workspace: Workspace = NEW_ARRAYS) -> NDArray[np.int32]:
        """FHOG channels of a grid, times `CHANNEL_SCALES` and rounded, as words of four channels.

        ``(words, rows, columns)``; the value of a word's first channel is in its lowest bits.
        """
        number = self.octave_of(math.sqrt(grid.step_x * grid.step_y))
        cells = workspace.take((16, grid.rows + 2, grid.columns + 2), np.float32, "cells")
        packed = workspace.take((1, N_CHANNELS // 4, grid.rows, grid.columns), np.int32, "packed")
        corner = np.array([[grid.left, grid.top, grid.step_x, grid.step_y]]) / (SQUARE * 2**number)
        self.octaves[number].channels_of(corner, cells, _NO_CHANNELS, packed)
        return np.asarray(packed[0])


def _cells_shape(channels: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of the cells of a grid with channels of shape ``(N, 20, rows, columns)``, and those around it."""
    return 16, channels[2] + 2, channels[3] + 2


def octave_count(shape: tuple[int, ...]) -> int:
    """Return the number of octaves of a frame of ``(height, width, ...)``."""
    return max(math.floor(math.log2(min(shape[:2]) / _MIN_SIDE)), 0) + 1


def octave_of(cell_size: float, count: int) -> int:
    """Return the octave, of `count`, from which cells of a size in pixels of the frame are interpolated."""
    return min(max(math.floor(math.log2(cell_size / _MIN_CELL)), 0), count - 1)


def _half_size(planes: NDArray[np.uint8], workspace: Workspace, name: str) -> NDArray[np.uint8]:
    """Average 2x2 pixels; an odd last row or column is replicated first."""
    odd = planes.shape[1] % 2, planes.shape[2] % 2
    if any(odd):
        planes = np.pad(planes, ((0, 0), (0, odd[0]), (0, odd[1])), mode="edge")
    height, width = planes.shape[1] // 2, planes.shape[2] // 2
    half = workspace.take((3, height, width), np.uint8, name)
    for plane, out in zip(planes, half):
        cv2.resize(plane, (width, height), dst=out, interpolation=cv2.INTER_AREA)
    return half
