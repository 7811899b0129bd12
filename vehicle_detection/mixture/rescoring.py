"""Rescoring: a second-stage RBF SVM on the boxes that the templates propose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, describe, finite_array
from vehicle_detection._kernels import product
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.crops import COLORS, EDGES, crop_views

Floats = NDArray[np.float64]

RESCORE_MIN = -0.8
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
        mean = _half_precision(self.mean, "rescorer.mean", (None,))
        axes = _half_precision(self.axes, "rescorer.axes", (None, len(mean)))
        columns = np.ascontiguousarray(axes.T)
        for name, array in ("mean", mean), ("axes", axes), ("_columns", columns):
            object.__setattr__(self, name, array)

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Project rows of features, ``(N, length)`` to ``(N, count)``."""
        return product(rows - self.mean, self._columns)


@dataclass(frozen=True, eq=False)
class Rescorer:
    """Tells by the edges and colors of a box, seen together, whether it shows a vehicle.

    Attributes
    ----------
    edges, colors
        Projections of what `crop_views` gives.
    vectors
        ``(n, count)`` float32: support vectors, edges first.
    weights
        ``(n,)`` float32, with the sign of their class. These too are rounded to half precision.
    bias
        Added to the weighted sum of kernels.
    gamma
        Width of the kernel ``exp(-gamma * distance**2)``.
    blend_weight
        Share of this opinion in a vehicle's value; the templates have the rest.

    Raises
    ------
    InvalidInputError
        If arrays do not fit one another, or a number is out of range.
    """

    edges: Projection
    colors: Projection
    vectors: NDArray[np.float32]
    weights: NDArray[np.float32]
    bias: float
    gamma: float
    blend_weight: float
    _columns: NDArray[np.float32] = field(init=False, repr=False)
    _squares: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for projection, name, length in (self.edges, "edges", EDGES), (self.colors, "colors", COLORS):
            if len(projection.mean) != length:
                raise InvalidInputError(
                    f"rescorer.{name} must take {length} values, got {len(projection.mean)}; train again"
                )
        count = len(self.edges.axes) + len(self.colors.axes)
        vectors = _half_precision(self.vectors, "rescorer.vectors", (None, count))
        object.__setattr__(self, "vectors", vectors)
        object.__setattr__(
            self, "weights", _half_precision(self.weights, "rescorer.weights", (len(vectors),))
        )
        check_number(self.bias, "rescorer.bias")
        check_number(self.gamma, "rescorer.gamma", above=0, high=1e6)
        check_number(self.blend_weight, "rescorer.blend_weight", above=0, high=1)
        object.__setattr__(self, "_columns", np.ascontiguousarray(vectors.T))
        object.__setattr__(self, "_squares", (vectors**2).sum(axis=1))

    def coordinates(self, edges: NDArray[np.float32], colors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Where crops lie in the space of the kernel, ``(N, count)``."""
        return np.hstack([self.edges(edges), self.colors(colors)])

    def decision_function(self, points: NDArray[np.float32]) -> Floats:
        """Value of each point: about 1 and more for vehicles, -1 and less for others."""
        distances = (points**2).sum(axis=1)[:, None] + self._squares - 2 * product(points, self._columns)
        kernels = np.exp(-np.float32(self.gamma) * distances) * self.weights
        return np.asarray(kernels.sum(axis=1, dtype=np.float64) + self.bias)

    def apply(self, image: NDArray[np.uint8], boxes: Floats, values: Floats) -> Floats:
        """Give boxes of a frame a value in which both opinions have their share."""
        if not len(boxes):
            return values
        found = self.decision_function(self.coordinates(*crop_views(image, boxes)))
        return np.asarray((1 - self.blend_weight) * values + self.blend_weight * found, np.float64)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays for a model file, by name, in half precision."""
        arrays = {
            "edges.mean": self.edges.mean,
            "edges.axes": self.edges.axes,
            "colors.mean": self.colors.mean,
            "colors.axes": self.colors.axes,
            "vectors": self.vectors,
            "weights": self.weights,
        }
        return {f"rescorer.{name}": array.astype(np.float16) for name, array in arrays.items()}

    def numbers(self) -> dict[str, float]:
        """Numbers for a model file."""
        return {"bias": self.bias, "gamma": self.gamma, "blend_weight": self.blend_weight}

    @classmethod
    def build(cls, tensors: Mapping[str, NDArray[Any]], numbers: Mapping[str, float]) -> Rescorer:
        """Put together again what `tensors` and `numbers` gave."""
        projections = [
            Projection(tensors[f"rescorer.{name}.mean"], tensors[f"rescorer.{name}.axes"])
            for name in ("edges", "colors")
        ]
        return cls(
            projections[0],
            projections[1],
            tensors["rescorer.vectors"],
            tensors["rescorer.weights"],
            *(float(numbers[name]) for name in ("bias", "gamma", "blend_weight")),
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
