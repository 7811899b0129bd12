"""A second opinion on the boxes that templates found, by a kernel machine.

Linear templates are fast enough for every window of a frame, but cannot tell that two parts mean a vehicle
only together. For the few boxes that are left a support vector machine with a Gaussian kernel can be
afforded: a cascade as in Harzallah, Jurie and Schmid, "Combining efficient object localization and image
classification" (ICCV 2009), and in Vedaldi et al., "Multiple kernels for object detection" (ICCV 2009).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, describe
from vehicle_detection._kernels import product
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.boxes import finite_array
from vehicle_detection.mixture.crops import COLOURS, EDGES, crop_views

Floats = NDArray[np.float64]

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
