"""Maps of road features: what a vehicle of any size looks like, cell by cell, on a pyramid of a frame.

A cell holds 16 signed and 8 unsigned orientations of its edges, each normalized by the contrast around it,
and four sums that tell how strong they are there: 28 values. Edges are those of the square roots of the
pixels' values, which shows what is dark. The scheme is that of Felzenszwalb et al., "Object detection with
discriminatively trained part-based models" (PAMI 2010), section 6, with 8 orientations instead of 9.
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

PLANES = 28
"""Values of a cell."""

BORDER, WIDE_BORDER = 24, 48
"""Pixels by which a resized frame is continued beyond its border, by repeating the outermost ones; with
coarse cells alone it is the wide one: vehicles that near are often cut off."""

# Where a plane is found in the map of the mirrored image.
MIRRORED = np.concatenate([(8 - np.arange(16)) % 16, 16 + (8 - np.arange(8)) % 8, [25, 24, 27, 26]])

COARSE, FINE = 8, 4
"""Side of a cell in pixels of the resized frame; cells are fine where the frame would have to be enlarged."""

_BOUNDS = np.deg2rad(np.arange(11.25, 180, 22.5))
_COTANGENTS = (np.cos(_BOUNDS) / np.sin(_BOUNDS)).astype(np.float32)
# Added to the energy of a block, in squared gray levels of the mean gradient: noise of one gray level on a
# surface of medium gray has about as much, and shall not be stretched to full contrast.
_EPS = np.float32(2)


def edge_sums(image: NDArray[np.uint8], workspace: Workspace = NEW_ARRAYS) -> NDArray[np.float32]:
    """Sum the edges of an image, by orientation, over squares of 4x4 pixels: ``(16, H // 4, W // 4)``."""
    height, width = image.shape[:2]
    channels = workspace.take((3, height, width), np.uint8, "channels")
    cv2.split(image, list(channels))
    sums = workspace.take((16, height // FINE, width // FINE), np.float32, "sums")
    _fhog_kernels.orientation_sums(channels, _COTANGENTS, sums)
    return sums


def planes_of_sums(
    sums: NDArray[np.float32], cell: int, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """Turn the edge sums of an image into the features of fine or coarse cells.

    Parameters
    ----------
    sums
        As `edge_sums` gives them.
    cell
        `FINE` or `COARSE`.

    Returns
    -------
    numpy.ndarray
        ``(28, H // cell, W // cell)`` float32.
    """
    per_cell = cell // FINE
    shape = sums.shape[1] // per_cell, sums.shape[2] // per_cell
    cells = workspace.take((16, *shape), np.float32, "cells")
    if per_cell == 1:
        _fhog_kernels.smooth_cells(sums, np.float32(1 / (64 * cell * cell)), cells)
    else:
        _fhog_kernels.pool_bilinear(sums, np.float32(1 / (16 * cell * cell)), cells)
    planes = workspace.take((PLANES, *shape), np.float32, "planes")
    _fhog_kernels.fhog_normalize(cells, _EPS, planes)
    return planes


def feature_planes(
    image: NDArray[np.uint8], cell: int, workspace: Workspace = NEW_ARRAYS
) -> NDArray[np.float32]:
    """Compute the road features of an image.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8, at least one cell high and wide; what is left of its sides is not used.
    cell
        Side of a cell in pixels, `FINE` or `COARSE`.
    workspace
        Provides the scratch arrays.

    Returns
    -------
    numpy.ndarray
        ``(28, H // cell, W // cell)`` float32.
    """
    return planes_of_sums(edge_sums(image, workspace), cell, workspace)


def mirror_planes(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give the features ``(28, rows, columns)`` of the mirrored image."""
    return np.ascontiguousarray(planes[MIRRORED, :, ::-1])


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Features of a frame at one size of cells.

    Attributes
    ----------
    planes
        ``(28, rows, columns)`` float32.
    left, top
        Place of the first cell's corner in pixels of the frame; negative beyond its border.
    step_x, step_y
        Width and height of a cell in pixels of the frame.
    """

    planes: NDArray[np.float32]
    left: float
    top: float
    step_x: float
    step_y: float


def image_pyramid(image: NDArray[np.uint8], least: int = 64) -> list[NDArray[np.uint8]]:
    """List an image and its halves, quarters and so on, down to sides of `least` pixels."""
    images = [image]
    while min(images[-1].shape[:2]) >= 2 * least:
        height, width = images[-1].shape[:2]
        smaller = cv2.resize(images[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        images.append(np.asarray(smaller, np.uint8))
    return images


@dataclass(frozen=True)
class Level:
    """Sizes of cells, in pixels of the frame, that one resized frame serves: fine, coarse, or both."""

    fine: float | None
    coarse: float | None

    @property
    def shrink(self) -> float:
        """Pixels of the resized frame for one of the frame."""
        return FINE / self.fine if self.fine is not None else COARSE / (self.coarse or COARSE)

    @property
    def sizes(self) -> list[tuple[float, int]]:
        """Pixels of the frame a cell, and of the resized frame."""
        both = (self.fine, FINE), (self.coarse, COARSE)
        return [(pixels, cell) for pixels, cell in both if pixels is not None]


def pyramid_levels(sizes: list[float], *, share: bool = True) -> list[Level]:
    """Choose fine or coarse cells for each size; with `share`, a size and its double use one frame."""
    fine = [size for size in sizes if size < COARSE]
    coarse = [size for size in sizes if size >= COARSE]
    levels = []
    for size in fine:
        double = next((other for other in coarse if share and abs(other / size - 2) < 1e-6), None)
        if double is not None:
            coarse.remove(double)
        levels.append(Level(size, double))
    return levels + [Level(None, size) for size in coarse]


def level_maps(
    images: list[NDArray[np.uint8]], level: Level, rows: tuple[int, int], workspace: Workspace = NEW_ARRAYS
) -> Iterator[tuple[float, FeatureMap]]:
    """Compute the maps of a frame, or of some of its rows, for each size of cells of a level.

    Parameters
    ----------
    images
        The frame and its halves, as `image_pyramid` lists them.
    level
        The sizes.
    rows
        First row and the one after the last.
    workspace
        Provides the scratch arrays; a map is then valid until the next one is computed.

    Yields
    ------
    tuple
        Pixels a cell, and the map.
    """
    height, width = images[0].shape[:2]
    half = min(max(int(math.log2(1 / level.shrink)), 0), len(images) - 1)
    source = images[half]
    # Whole rows of the source: `top` and `bottom` are where they are in the frame, to the fraction.
    count = source.shape[0]
    first = min(round(rows[0] * count / height), count - 1)
    last = max(round(rows[1] * count / height), first + 1)
    strip = source[first:last]
    top, bottom = first * height / count, last * height / count
    size = max(round(width * level.shrink), COARSE), max(round((bottom - top) * level.shrink), COARSE)
    small = np.asarray(
        cv2.resize(strip, size, dst=workspace.take((size[1], size[0], 3), np.uint8, "strip")), np.uint8
    )
    # Rows of the frame next to the wanted ones are in them already: only its own border is made up.
    border = BORDER if level.fine is not None else WIDE_BORDER
    above, below = (border if at_border else 0 for at_border in (first == 0, last == count))
    padding = (above, below + -(size[1] + above + below) % COARSE, border, border + -size[0] % COARSE)
    shape = (size[1] + padding[0] + padding[1], size[0] + padding[2] + padding[3], 3)
    memory = workspace.take(shape, np.uint8, "padded")
    padded = np.asarray(cv2.copyMakeBorder(small, *padding, cv2.BORDER_REPLICATE, dst=memory), np.uint8)
    sums = edge_sums(padded, workspace)
    pixel_x, pixel_y = width / size[0], (bottom - top) / size[1]
    for pixels, cell in level.sizes:
        planes = planes_of_sums(sums, cell, workspace)
        yield (
            pixels,
            FeatureMap(planes, -border * pixel_x, top - above * pixel_y, cell * pixel_x, cell * pixel_y),
        )


def border_strip(level: FeatureMap, columns: int, end: float, *, left: bool) -> NDArray[np.float32] | None:
    """Take the columns of a map that end at a border, turned so that it is at their right.

    Parameters
    ----------
    level
        The map.
    columns
        Number of columns.
    end
        Place of the border in pixels of the frame; the nearest border of cells is taken.
    left
        Whether the frame lies at the right of it.

    Returns
    -------
    numpy.ndarray or None
        ``(28, rows, columns)`` float32; None where the map has too few columns.
    """
    first = round((end - level.left) / level.step_x) - (0 if left else columns)
    if first < 0 or first + columns > level.planes.shape[2]:
        return None
    strip = level.planes[:, :, first : first + columns]
    return mirror_planes(strip) if left else np.ascontiguousarray(strip)


def strip_boxes(
    level: FeatureMap,
    rows: NDArray[np.intp],
    end: float,
    *,
    left: bool,
    cells: tuple[float, float],
    above: float,
) -> NDArray[np.float64]:
    """Boxes of windows of a strip, in pixels of the frame, ``(N, 4)``: each ends at the border.

    Parameters
    ----------
    level
        The map of which the strip was taken.
    rows
        First row of cells of each window.
    end, left
        As for `border_strip`.
    cells
        Columns and rows of cells that a box fills.
    above
        Rows of cells of a window above its box.
    """
    width = cells[0] * level.step_x
    top = level.top + (rows + above) * level.step_y
    boxes = np.empty((len(rows), 4))
    boxes[:, 0], boxes[:, 2] = (end, end + width) if left else (end - width, end)
    boxes[:, 1], boxes[:, 3] = top, top + cells[1] * level.step_y
    return boxes
