"""One template of a mixture: a linear SVM over the FHOG channels of a window."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check_bool, check_number, describe, finite_array, store_number
from vehicle_detection._kernels import Filter
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.features import N_CHANNELS, CellGrid, FeatureMap, mirror_channels


@dataclass(frozen=True, eq=False)
class MixtureTemplate:
    """A linear SVM over the cells of a window.

    A template with `border` is for vehicles that the frame's right border truncates: its windows end at that
    border, without padding there. Its mirror image is used at the left border.
    """

    weights: NDArray[np.float32]  # (rows, columns, 20)
    bias: float
    padding: tuple[float, float]  # cells left and right of the vehicle's box, and above and below it
    border: bool = False

    def __post_init__(self) -> None:
        weights = finite_array(self.weights, "weights", (None, None, N_CHANNELS))
        store_number(self, "bias", low=-1e9, high=1e9)
        rows, columns = weights.shape[:2]
        padding: object = self.padding
        if not isinstance(padding, tuple) or len(padding) != 2:
            raise InvalidInputError(f"padding must be two numbers of cells, got {describe(padding)}")
        for cells, side in zip(padding, (columns, rows)):
            if not check_number(cells, "padding", low=-1) < side / 2:
                raise InvalidInputError(
                    f"padding must be less than half of the window's {columns}x{rows} cells, "
                    f"got {describe(padding)}"
                )
        object.__setattr__(self, "border", check_bool(self.border, "border"))
        object.__setattr__(self, "weights", weights)

    @property
    def box_cells(self) -> tuple[float, float]:
        """Columns and rows of cells that the vehicle's box fills."""
        rows, columns = self.weights.shape[:2]
        return columns - self.padding[0] * (1 if self.border else 2), rows - 2 * self.padding[1]

    @functools.cached_property
    def _filter(self) -> Filter:
        return Filter(self.weights)

    @functools.cached_property
    def _strip_filter(self) -> Filter:
        return Filter(self.weights.transpose(0, 2, 1).reshape(1, len(self.weights), -1))

    def window_counts(self, channels: NDArray[np.float32]) -> tuple[int, int]:
        """Count the windows of FHOG channels below and beside each other; 0 if no window fits."""
        rows, columns = self.weights.shape[:2]
        return max(channels.shape[1] - rows + 1, 0), max(channels.shape[2] - columns + 1, 0)

    def margins(self, channels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Margin of every window of FHOG channels, ``(rows, columns)``; empty if no window fits."""
        margins = np.full(self.window_counts(channels), self.bias, np.float32)
        if margins.shape[1] == 1:
            # A strip as wide as the template: place its windows side by side, which vectorizes better.
            line = np.ascontiguousarray(channels.transpose(0, 2, 1)).reshape(-1, 1, channels.shape[1])
            self._strip_filter.add_to(line, margins.reshape(1, -1))
        elif margins.size:
            self._filter.add_to(channels, margins)
        return margins

    def boxes(self, grid: CellGrid, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
        """Boxes, in pixels of the frame, of the windows that start at these cells; ``(N, 4)``."""
        width, height = self.box_cells
        left = grid.left + (columns + self.padding[0]) * grid.step_x
        top = grid.top + (rows + self.padding[1]) * grid.step_y
        return np.stack([left, top, left + width * grid.step_x, top + height * grid.step_y], axis=1)

    def border_strip(
        self, feature_map: FeatureMap, border_x: float, *, left: bool
    ) -> NDArray[np.float32] | None:
        """FHOG channels ``(20, rows, columns of the template)`` that end at a border in column `border_x`.

        They are mirrored at the left border. None if the map has too few columns.
        """
        columns, grid = self.weights.shape[1], feature_map.grid
        first = round((border_x - grid.left) / grid.step_x) - (0 if left else columns)
        if first < 0 or first + columns > feature_map.channels.shape[2]:
            return None
        strip = feature_map.channels[:, :, first : first + columns]
        return mirror_channels(strip) if left else np.ascontiguousarray(strip)

    def border_boxes(self, grid: CellGrid, rows: NDArray[np.intp], border_x: float, *, left: bool) -> Floats:
        """Boxes, in pixels of the frame, of the windows that start in these rows and end at a border."""
        width = self.box_cells[0] * grid.step_x
        top = grid.top + (rows + self.padding[1]) * grid.step_y
        boxes = np.empty((len(rows), 4))
        boxes[:, 0], boxes[:, 2] = (border_x, border_x + width) if left else (border_x - width, border_x)
        boxes[:, 1], boxes[:, 3] = top, top + self.box_cells[1] * grid.step_y
        return boxes


def smallest_box(templates: Sequence[MixtureTemplate]) -> tuple[float, float]:
    """Minimum columns and rows of the templates' boxes; border templates only if there are no others."""
    boxes = [each.box_cells for each in templates if not each.border] or [t.box_cells for t in templates]
    return min(columns for columns, _ in boxes), min(rows for _, rows in boxes)
