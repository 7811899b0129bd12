"""Rescoring: a second-stage RBF SVM on the boxes that the templates propose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, describe, finite_array
from vehicle_detection._kernels import matmul
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.crops import N_COLOR_FEATURES, N_EDGE_FEATURES, rescoring_features

Floats = NDArray[np.float64]

RESCORE_MIN = -0.8
"""Minimum margin of a proposed box that is rescored."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Scaled principal components; arrays are rounded to half precision, as in the model file."""

    mean: NDArray[np.float32]  # (length,)
    axes: NDArray[np.float32]  # (count, length)
    _columns: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        mean = _half_precision(self.mean, "rescorer.mean", (None,))
        axes = _half_precision(self.axes, "rescorer.axes", (None, len(mean)))
        columns = np.ascontiguousarray(axes.T)
        for name, array in ("mean", mean), ("axes", axes), ("_columns", columns):
            object.__setattr__(self, name, array)

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Project features, ``(N, length)`` to ``(N, count)``."""
        return matmul(rows - self.mean, self._columns)


@dataclass(frozen=True, eq=False)
class Rescorer:
    """An RBF SVM on the projected edge and color features of boxes.

    `vectors` and `weights` are rounded to half precision. The kernel is ``exp(-gamma * distance**2)``.
    """

    edges: Projection  # of the two kinds of `rescoring_features`
    colors: Projection
    vectors: NDArray[np.float32]  # (n, count): support vectors, projected edges first
    weights: NDArray[np.float32]  # (n,): dual coefficients with the sign of the class
    bias: float
    gamma: float
    blend_weight: float  # weight of the rescorer in the final margin; that of the templates is the rest to 1
    _columns: NDArray[np.float32] = field(init=False, repr=False)
    _squares: NDArray[np.float32] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        lengths = (self.edges, "edges", N_EDGE_FEATURES), (self.colors, "colors", N_COLOR_FEATURES)
        for projection, name, length in lengths:
            if len(projection.mean) != length:
                raise InvalidInputError(
                    f"rescorer.{name} must take {length} values, got {len(projection.mean)}; train again"
                )
        count = len(self.edges.axes) + len(self.colors.axes)
        vectors = _half_precision(self.vectors, "rescorer.vectors", (None, count))
        weights = _half_precision(self.weights, "rescorer.weights", (len(vectors),))
        check_number(self.bias, "rescorer.bias")
        check_number(self.gamma, "rescorer.gamma", above=0, high=1e6)
        check_number(self.blend_weight, "rescorer.blend_weight", above=0, high=1)
        object.__setattr__(self, "vectors", vectors)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "_columns", np.ascontiguousarray(vectors.T))
        object.__setattr__(self, "_squares", (vectors**2).sum(axis=1))

    def project(self, edges: NDArray[np.float32], colors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Project `rescoring_features` to the space of the support vectors, ``(N, count)``."""
        return np.hstack([self.edges(edges), self.colors(colors)])

    def decision_function(self, points: NDArray[np.float32]) -> Floats:
        """SVM decision values of projected features: at least about 1 for vehicles, at most -1 for others."""
        distances = (points**2).sum(axis=1)[:, None] + self._squares - 2 * matmul(points, self._columns)
        kernels = np.exp(-np.float32(self.gamma) * distances) * self.weights
        return np.asarray(kernels.sum(axis=1, dtype=np.float64) + self.bias)

    def apply(self, image: NDArray[np.uint8], boxes: Floats, margins: Floats) -> Floats:
        """Weighted mean of the margins that the templates gave and the decision values of the boxes."""
        if not len(boxes):
            return margins
        decisions = self.decision_function(self.project(*rescoring_features(image, boxes)))
        return np.asarray((1 - self.blend_weight) * margins + self.blend_weight * decisions, np.float64)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays for the model file by name, in half precision."""
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
        """Numbers for the model file."""
        return {"bias": self.bias, "gamma": self.gamma, "blend_weight": self.blend_weight}

    @classmethod
    def build(cls, tensors: Mapping[str, NDArray[Any]], numbers: Mapping[str, float]) -> Rescorer:
        """Rebuild a rescorer from its `tensors` and `numbers`."""
        edges, colors = (
            Projection(tensors[f"rescorer.{name}.mean"], tensors[f"rescorer.{name}.axes"])
            for name in ("edges", "colors")
        )
        arrays = tensors["rescorer.vectors"], tensors["rescorer.weights"]
        scalars = (float(numbers[name]) for name in ("bias", "gamma", "blend_weight"))
        return cls(edges, colors, *arrays, *scalars)


def _half_precision(values: object, name: str, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """Check finite numbers and round them to half precision, as float32."""
    array = finite_array(values, name, shape)
    with np.errstate(over="ignore"):
        rounded = array.astype(np.float16).astype(np.float32)
    if not np.isfinite(rounded).all():
        raise InvalidInputError(f"{name} must be numbers below 65,504, got {describe(values)}; train again")
    rounded.setflags(write=False)
    return rounded
