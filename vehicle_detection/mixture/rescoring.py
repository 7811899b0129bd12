"""A second opinion on the boxes that templates found, by a kernel machine.

Linear templates are fast enough for every window of a frame, but cannot tell that two parts mean a vehicle
only together. For the few boxes that are left a support vector machine with a Gaussian kernel can be
afforded: a cascade as in Harzallah, Jurie and Schmid, "Combining efficient object localization and image
classification" (ICCV 2009), and in Vedaldi et al., "Multiple kernels for object detection" (ICCV 2009).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, describe
from vehicle_detection._kernels import product
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.boxes import finite_array
from vehicle_detection.mixture.features import COARSE, PLANES, feature_planes

CROP = 12
"""Cells of a side of the crop that corrects a box: the box fills 8 of them."""

CROP_LENGTH = PLANES * CROP * CROP + 4
"""Features of a crop."""

EDGES, COLOURS = PLANES * CROP * CROP, 3 * CROP * CROP
"""Values of a crop's edges, and of its colours."""

_INSIDE = (8.0, 8.0)

Floats = NDArray[np.float64]


def crop_features(image: NDArray[np.uint8], boxes: Floats) -> NDArray[np.float32]:
    """Features of boxes and what is around them, each warped to 12x12 cells of which the box fills 8x8.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    boxes
        ``(N, 4)``, with any part outside.

    Returns
    -------
    numpy.ndarray
        ``(N, 28 * 12 * 12 + 4)`` float32; the last four tell by how much of its sides a box lies outside.
    """
    features = np.empty((len(boxes), CROP_LENGTH), np.float32)
    height, width = image.shape[:2]
    for row, (x1, y1, x2, y2) in zip(features, boxes):
        row[:-4] = box_planes(image, (x1, y1, x2, y2), _INSIDE, (CROP, CROP), COARSE).ravel()
        outside = (-x1 / (x2 - x1), -y1 / (y2 - y1), (x2 - width) / (x2 - x1), (y2 - height) / (y2 - y1))
        row[-4:] = np.clip(outside, 0, 1)
    return features


def crop_views(image: NDArray[np.uint8], boxes: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Edges and colours of boxes and what is around them, of the same 12x12 cells as in `crop_features`.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB; beyond its border the outermost pixels go on.
    boxes
        ``(N, 4)``, with any part outside.

    Returns
    -------
    tuple of numpy.ndarray
        ``(N, 28 * 12 * 12)`` and ``(N, 3 * 12 * 12)`` float32. The colours are the mean lightness of each
        cell, by how many standard deviations it is above the crop's, and its CIELAB a and b in steps of 20.
    """
    count = len(boxes)
    edges = np.empty((count, EDGES), np.float32)
    means = np.empty((count, CROP, CROP, 3), np.uint8)
    for row, mean, box in zip(edges, means, boxes):
        patch = _around(image, box.tolist(), _INSIDE, (CROP, CROP), COARSE)
        row[:] = _planes(patch, COARSE).ravel()
        cv2.resize(patch[COARSE:-COARSE, COARSE:-COARSE], (CROP, CROP), mean, interpolation=cv2.INTER_AREA)
    if not count:
        return edges, np.empty((0, COLOURS), np.float32)
    # All crops at once, one below the other.
    values = means.reshape(-1, CROP, 3).astype(np.float32) / 255
    lab = cv2.cvtColor(values, cv2.COLOR_RGB2LAB).reshape(count, -1, 3).transpose(2, 0, 1)
    lightness, a, b = lab
    # Of a plain crop the noise is not stretched to full contrast.
    spread = lightness.std(axis=1, keepdims=True) + 5
    lightness = (lightness - lightness.mean(axis=1, keepdims=True)) / spread
    return edges, np.hstack([lightness, a / 20, b / 20], dtype=np.float32)


def box_planes(
    image: NDArray[np.uint8],
    box: Sequence[float],
    inside: tuple[float, float],
    cells: tuple[int, int],
    cell: int,
) -> NDArray[np.float32]:
    """Compute the features of one box, warped to a grid of cells with what is around it.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    box
        ``(x1, y1, x2, y2)``.
    inside
        Columns and rows of cells that the box fills.
    cells
        Columns and rows of the grid, around the same centre.
    cell
        Side of a cell in pixels of the warped box.

    Returns
    -------
    numpy.ndarray
        ``(28, rows, columns)`` float32.
    """
    return _planes(_around(image, box, inside, cells, cell), cell)


def _planes(patch: NDArray[np.uint8], cell: int) -> NDArray[np.float32]:
    return feature_planes(patch, cell)[:, 1:-1, 1:-1]


def _around(
    image: NDArray[np.uint8],
    box: Sequence[float],
    inside: tuple[float, float],
    cells: tuple[int, int],
    cell: int,
) -> NDArray[np.uint8]:
    """Warp a box to a grid of cells, with one more on each side.

    So the normalisation of the outermost one sees its neighbours.
    """
    x1, y1, x2, y2 = box
    step_x, step_y = (x2 - x1) / inside[0], (y2 - y1) / inside[1]
    columns, rows = cells[0] + 2, cells[1] + 2
    left = x1 - (columns - inside[0]) / 2 * step_x
    top = y1 - (rows - inside[1]) / 2 * step_y
    return _warp(image, (left, top), (step_x / cell, step_y / cell), (columns * cell, rows * cell))


def _warp(
    image: NDArray[np.uint8], corner: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> NDArray[np.uint8]:
    """Take ``size * scale`` pixels of an image from `corner` on as an image of `size`, without aliasing."""
    origin, real = np.array(corner), np.array(scale)
    if real.max() > 1.5:
        # Reduce the part first: the warp alone looks at four pixels only.
        low = np.clip(np.floor(origin), 0, None).astype(int)
        high = np.clip(np.ceil(origin + real * size), 0, image.shape[1::-1]).astype(int)
        if (high - low >= 2).all():
            part = image[low[1] : high[1], low[0] : high[0]]
            reduced = np.maximum(np.rint((high - low) / np.maximum(real, 1)), 1).astype(int)
            small = cv2.resize(part, (int(reduced[0]), int(reduced[1])), interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
            factor = (high - low) / reduced
            origin, real = (origin - low) / factor, real / factor
    shift = origin + real / 2 - 0.5
    matrix = np.array([[real[0], 0, shift[0]], [0, real[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


LEAST_VALUE = -0.8
"""What templates and the gains give a box that is worth a second opinion."""


@dataclass(frozen=True, eq=False)
class Projection:
    """A linear projection onto a few axes: principal components, scaled.

    Attributes
    ----------
    mean
        ``(length,)`` float32, taken off first.
    axes
        ``(count, length)`` float32. Both are rounded to half precision, as the model file holds them.
    """

    mean: NDArray[np.float32]
    axes: NDArray[np.float32]
    _columns: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        mean = _half_precision(self.mean, "verification.mean", (None,))
        axes = _half_precision(self.axes, "verification.axes", (None, len(mean)))
        columns = np.ascontiguousarray(axes.T)
        for name, array in ("mean", mean), ("axes", axes), ("_columns", columns):
            object.__setattr__(self, name, array)

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Project rows of features, ``(N, length)`` to ``(N, count)``."""
        return product(rows - self.mean, self._columns)


@dataclass(frozen=True, eq=False)
class Verification:
    """Tells by the edges and colours of a box, seen together, whether it shows a vehicle.

    Attributes
    ----------
    edges, colours
        Projections of what `crop_views` gives.
    vectors
        ``(n, count)`` float32: support vectors, edges first.
    weights
        ``(n,)`` float32, with the sign of their class. These too are rounded to half precision.
    bias
        Added to the weighted sum of kernels.
    gamma
        Width of the kernel ``exp(-gamma * distance**2)``.
    share
        Share of this opinion in a vehicle's value; the templates have the rest.

    Raises
    ------
    InvalidInputError
        If arrays do not fit one another, or a number is out of range.
    """

    edges: Projection
    colours: Projection
    vectors: NDArray[np.float32]
    weights: NDArray[np.float32]
    bias: float
    gamma: float
    share: float
    _columns: NDArray[np.float32] = field(init=False, repr=False)
    _squares: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for projection, name, length in (self.edges, "edges", EDGES), (self.colours, "colours", COLOURS):
            if len(projection.mean) != length:
                raise InvalidInputError(
                    f"verification.{name} must take {length} values, got {len(projection.mean)}; train again"
                )
        count = len(self.edges.axes) + len(self.colours.axes)
        vectors = _half_precision(self.vectors, "verification.vectors", (None, count))
        object.__setattr__(self, "vectors", vectors)
        object.__setattr__(
            self, "weights", _half_precision(self.weights, "verification.weights", (len(vectors),))
        )
        check_number(self.bias, "verification.bias")
        check_number(self.gamma, "verification.gamma", above=0, high=1e6)
        check_number(self.share, "verification.share", above=0, high=1)
        object.__setattr__(self, "_columns", np.ascontiguousarray(vectors.T))
        object.__setattr__(self, "_squares", (vectors**2).sum(axis=1))

    def coordinates(self, edges: NDArray[np.float32], colours: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where crops lie in the space of the kernel, ``(N, count)``."""
        return np.hstack([self.edges(edges), self.colours(colours)])

    def decide(self, points: NDArray[np.float32]) -> Floats:
        """Value of each point: about 1 and more for vehicles, -1 and less for others."""
        distances = (points**2).sum(axis=1)[:, None] + self._squares - 2 * product(points, self._columns)
        kernels = np.exp(-np.float32(self.gamma) * distances) * self.weights
        return np.asarray(kernels.sum(axis=1, dtype=np.float64) + self.bias)

    def apply(self, image: NDArray[np.uint8], boxes: Floats, values: Floats) -> Floats:
        """Give boxes of a frame a value in which both opinions have their share."""
        if not len(boxes):
            return values
        found = self.decide(self.coordinates(*crop_views(image, boxes)))
        return np.asarray((1 - self.share) * values + self.share * found, np.float64)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays for a model file, by name, in half precision."""
        arrays = {
            "edges.mean": self.edges.mean,
            "edges.axes": self.edges.axes,
            "colours.mean": self.colours.mean,
            "colours.axes": self.colours.axes,
            "vectors": self.vectors,
            "weights": self.weights,
        }
        return {f"verification.{name}": array.astype(np.float16) for name, array in arrays.items()}

    def numbers(self) -> dict[str, float]:
        """Numbers for a model file."""
        return {"bias": self.bias, "gamma": self.gamma, "share": self.share}

    @classmethod
    def build(cls, tensors: Mapping[str, NDArray[Any]], numbers: Mapping[str, float]) -> Verification:
        """Put together again what `tensors` and `numbers` gave."""
        projections = [
            Projection(tensors[f"verification.{name}.mean"], tensors[f"verification.{name}.axes"])
            for name in ("edges", "colours")
        ]
        return cls(
            projections[0],
            projections[1],
            tensors["verification.vectors"],
            tensors["verification.weights"],
            *(float(numbers[name]) for name in ("bias", "gamma", "share")),
        )


def _half_precision(values: object, name: str, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """Return finite float32 numbers that half precision can hold, rounded to it."""
    array = finite_array(values, name, shape)
    with np.errstate(over="ignore"):
        rounded = array.astype(np.float16).astype(np.float32)
    if not np.isfinite(rounded).all():
        raise InvalidInputError(f"{name} must be numbers below 65,504, got {describe(values)}; train again")
    rounded.setflags(write=False)
    return rounded
