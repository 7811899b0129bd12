"""One template of a mixture: its weights over the cells of a map, the scores they give, and the boxes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Workspace, check_number, describe, finite_array
from vehicle_detection._kernels import Filter
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.features import PLANES, FeatureMap, border_strip, strip_boxes


@dataclass(frozen=True, eq=False)
class MixtureTemplate:
    """One linear template over the cells of a feature map.

    Attributes
    ----------
    weights
        ``(rows, columns, 28)`` float32.
    bias
        Added to the weighted sum.
    padding
        Cells around the vehicle's box at the left and right, and above and below.
    border
        Whether it shows what is seen of a vehicle that the frame's right border cuts: it ends there, without
        a padding, and is searched for at the border alone; at the left one it is mirrored.
    """

    weights: NDArray[np.float32]
    bias: float
    padding: tuple[float, float]
    border: bool = False

    def __post_init__(self) -> None:
        weights = finite_array(self.weights, "weights", (None, None, PLANES))
        check_number(self.bias, "bias")
        rows, columns = weights.shape[:2]
        padding: object = self.padding
        if not isinstance(padding, tuple) or len(padding) != 2:
            raise InvalidInputError(f"padding must be two numbers of cells, got {describe(padding)}")
        for cells, side in zip(padding, (columns, rows)):
            # Above half a side nothing would be left for the box.
            if not check_number(cells, "padding", low=-1) < side / 2:
                raise InvalidInputError(
                    f"padding must leave cells for the box of {columns}x{rows} cells, got {describe(padding)}"
                )
        border: object = self.border
        if not isinstance(border, bool):
            raise InvalidInputError(f"border must be True or False, got {describe(border)}")
        object.__setattr__(self, "weights", weights)

    @property
    def box_cells(self) -> tuple[float, float]:
        """Columns and rows of cells that the vehicle's box fills."""
        rows, columns = self.weights.shape[:2]
        return columns - self.padding[0] * (1 if self.border else 2), rows - 2 * self.padding[1]

    def margins(self, planes: NDArray[np.float32], workspace: Workspace = NEW_ARRAYS) -> NDArray[np.float32]:
        """Score of every window of a map, ``(rows, columns)`` float32; empty where none fits."""
        rows, columns = self.weights.shape[:2]
        shape = max(planes.shape[1] - rows + 1, 0), max(planes.shape[2] - columns + 1, 0)
        scores = np.full(shape, self.bias, np.float32)
        if scores.shape[1] == 1:
            # Of a strip, the places of its windows are put side by side: they are worked on together.
            line = np.ascontiguousarray(planes.transpose(0, 2, 1)).reshape(-1, 1, planes.shape[1])
            self._strip_filter.add_to(line, scores.reshape(1, -1), workspace)
        elif scores.size:
            self._filter.add_to(planes, scores, workspace)
        return scores

    @functools.cached_property
    def _filter(self) -> Filter:
        return Filter(self.weights)

    @functools.cached_property
    def _strip_filter(self) -> Filter:
        return Filter(self.weights.transpose(0, 2, 1).reshape(1, len(self.weights), -1))

    def boxes(
        self, level: FeatureMap, rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Boxes, in pixels of the frame, of the windows that start at these cells of a map."""
        width, height = self.box_cells
        left = level.left + (columns + self.padding[0]) * level.step_x
        top = level.top + (rows + self.padding[1]) * level.step_y
        return np.stack([left, top, left + width * level.step_x, top + height * level.step_y], axis=1)

    def border_windows(
        self,
        level: FeatureMap,
        end: float,
        *,
        left: bool,
        min_margin: float,
        workspace: Workspace = NEW_ARRAYS,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Boxes and scores, above the least, of the windows that end at a border at this pixel."""
        strip = border_strip(level, self.weights.shape[1], end, left=left)
        scores = self.margins(strip, workspace)[:, 0] if strip is not None else np.empty(0, np.float32)
        hits = np.flatnonzero(scores > min_margin)
        boxes = strip_boxes(level, hits, end, left=left, cells=self.box_cells, above=self.padding[1])
        return boxes, scores[hits].astype(np.float64)


def smallest_box(templates: Sequence[MixtureTemplate]) -> tuple[float, float]:
    """Least columns and rows of a box, of whole vehicles where a template shows one."""
    boxes = [each.box_cells for each in templates if not each.border] or [t.box_cells for t in templates]
    return min(columns for columns, _ in boxes), min(rows for _, rows in boxes)
