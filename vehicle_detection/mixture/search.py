"""The search of a frame with a mixture of templates, over one edge pyramid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check_type, single_threaded_opencv
from vehicle_detection._kernels import PackedFilters, PackedSearch
from vehicle_detection.boxes import Detections
from vehicle_detection.mixture.boxes import MIN_MARGIN, ScoredWindows, mostly_inside
from vehicle_detection.mixture.features import (
    CHANNEL_SCALES,
    MIRROR_ORDER,
    CellGrid,
    EdgePyramid,
    Rows,
    octave_count,
    octave_of,
)
from vehicle_detection.mixture.haze import prepare
from vehicle_detection.mixture.model import TemplateMixture
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box
from vehicle_detection.params import PyramidParams
from vehicle_detection.search import FrameSearch

# Cells that windows may extend beyond the frame, and cells around the windows of an octave whose gradients
# are computed too, for crops.
_BEYOND, _CONTEXT = 4, 4
_MAX_WINDOWS = 2000
_MAX_PLANS = 8


INNER, RIGHT, LEFT = range(3)
"""Where windows lie: anywhere, or at a border of the frame."""


@dataclass(frozen=True, eq=False)
class _Level:
    """The cells of one size, and their searches: at one place each, with some of the templates there."""

    grid: CellGrid
    places: list[int]
    templates: list[list[int]]  # indices, for each search
    search: PackedSearch


@dataclass(frozen=True, eq=False)
class _Plan:
    """What to search in frames of one shape, and the rows of the frame that each octave needs."""

    levels: list[_Level]
    row_ranges: list[Rows]
    # For each search of all levels: place, corner and size of its cells, and indices of its templates.
    places: NDArray[np.intp]
    corners: Floats
    steps: Floats
    templates: NDArray[np.intp]
    first_searches: NDArray[np.intp]  # of each level

    @classmethod
    def of(cls, levels: list[_Level], row_ranges: list[Rows]) -> _Plan:
        """List the facts of the searches that turn their windows into boxes."""
        grids = [level.grid for level in levels for _ in level.places]
        indices = [each for level in levels for each in level.templates]
        templates = np.zeros((len(indices), max(map(len, indices), default=0)), np.intp)
        for row, each in zip(templates, indices):
            row[: len(each)] = each
        return cls(
            levels,
            row_ranges,
            np.array([place for level in levels for place in level.places], np.intp),
            np.array([(grid.left, grid.top) for grid in grids]).reshape(-1, 2),
            np.array([(grid.step_x, grid.step_y) for grid in grids]).reshape(-1, 2),
            templates,
            np.cumsum([0, *(len(level.places) for level in levels)]),
        )


class MixtureSearch(FrameSearch):
    """The search of frames with a mixture of templates.

    Vehicles lie inside the frame; windows may extend beyond it. Sensor noise and haze are removed
    first. The weights are rounded to 8 bits and the channels to 7: a margin differs by about 0.004 from the
    exact one.
    """

    params_type = PyramidParams

    def __init__(self, model: TemplateMixture, *, n_jobs: int | None = None) -> None:
        check_type(model, "model", TemplateMixture, 'load_model("default") or train_mixture return one')
        super().__init__(n_jobs)
        self.model = model
        templates = model.templates
        self._numbers = [
            [index for index, each in enumerate(templates) if each.border == border]
            for border in (False, True, True)
        ]
        scaled = [each.weights / CHANNEL_SCALES for each in templates]
        # Windows at a border have one position in each row, so their cells become channels; the first ones
        # are those at the border.
        self._strip_cells = np.arange(
            max((scaled[index].shape[1] for index in self._numbers[RIGHT]), default=0), dtype=np.intp
        )
        self._filters = [
            PackedFilters([scaled[index] for index in self._numbers[INNER]]),
            PackedFilters([self._strip_weights(scaled[index][:, ::-1]) for index in self._numbers[RIGHT]]),
            PackedFilters(
                [self._strip_weights(scaled[index][:, ::-1, MIRROR_ORDER]) for index in self._numbers[LEFT]]
            ),
        ]
        self._box_cells = np.array([each.box_cells for each in templates])
        self._paddings = np.array([each.padding for each in templates])
        self._biases = np.array([each.bias for each in templates])
        # Units of each place and template.
        self._units = np.zeros((len(self._filters), len(templates)))
        for units, numbers, filters in zip(self._units, self._numbers, self._filters):
            units[numbers] = filters.units
        self._plans: dict[tuple[tuple[int, int], PyramidParams], _Plan] = {}

    def _strip_weights(self, weights: NDArray[np.float32]) -> NDArray[np.float32]:
        missing = len(self._strip_cells) - weights.shape[1]
        return np.pad(weights, ((0, 0), (0, missing), (0, 0))).reshape(1, len(weights), -1)

    def _search(
        self, frame: NDArray[np.uint8], params: PyramidParams, min_vehicle_score: float
    ) -> tuple[Detections, Detections]:
        model = self.model
        with single_threaded_opencv():
            pyramid, found = self.score_windows(prepare(frame), params)
            vehicles = model.detect_vehicles(pyramid, found, min_margin=model.margin_of(min_vehicle_score))
        scores = model.window_scores(found.margins + vehicles.shift)
        shown = scores >= params.min_score
        return (
            Detections(found.boxes[shown], scores[shown]),
            Detections(vehicles.boxes, model.scores(vehicles.margins)),
        )

    def score_windows(
        self, image: NDArray[np.uint8], params: PyramidParams
    ) -> tuple[EdgePyramid, ScoredWindows]:
        """Windows with their templates' margins, best first; weak ones are included because they vote.

        Sensor noise and haze are not removed here. The pyramid is valid until the next search in the same
        thread.
        """
        min_margin = min(MIN_MARGIN, self.model.window_margin(params.min_score))
        plan = self._plan((image.shape[0], image.shape[1]), params, min_margin)
        with single_threaded_opencv():
            pyramid = EdgePyramid(image, plan.row_ranges, self.workspace, self._team)
            found = self._team.map(
                lambda level: level.search.find(pyramid.packed_channels(level.grid), self.workspace),
                plan.levels,
                cost=lambda level: level.grid.rows * level.grid.columns,
            )
        windows = self._to_windows(plan, found, pyramid.shape)
        return pyramid, windows.best(_MAX_WINDOWS)

    def _to_windows(
        self, plan: _Plan, found: list[NDArray[np.int32]], shape: tuple[int, int]
    ) -> ScoredWindows:
        """Boxes and margins of the windows of all searches, without those mostly outside the frame."""
        search, number, row, column, score = np.concatenate([np.empty((0, 5), np.int32), *found]).T
        search = search + np.repeat(plan.first_searches[:-1], [len(each) for each in found])
        place, index, steps = plan.places[search], plan.templates[search, number], plan.steps[search]
        # The rows of a strip lie side by side.
        row = np.where(place == INNER, row, column)
        sizes = self._box_cells[index] * steps
        start = plan.corners[search] + (np.column_stack([column, row]) + self._paddings[index]) * steps
        start[place == LEFT, 0] = 0
        at_right = place == RIGHT
        start[at_right, 0] = shape[1] - sizes[at_right, 0]
        margins = score * self._units[place, index] + self._biases[index]
        boxes = np.hstack([start, start + sizes])
        inside = mostly_inside(boxes, shape)
        return ScoredWindows(boxes, margins, index)[np.flatnonzero(inside)]

    def _plan(self, shape: tuple[int, int], params: PyramidParams, min_margin: float) -> _Plan:
        plan = self._plans.get((shape, params))
        if plan is None:
            plan = self._make_plan(shape, params, min_margin)
            while len(self._plans) >= _MAX_PLANS:
                self._plans.pop(next(iter(self._plans)), None)
            self._plans[shape, params] = plan
        return plan

    def _make_plan(self, shape: tuple[int, int], params: PyramidParams, min_margin: float) -> _Plan:
        """Choose the templates and the rows of each cell size."""
        templates = self.model.templates
        levels = []
        octaves: list[list[Rows]] = [[] for _ in range(octave_count(shape))]
        for size in params.sizes(*smallest_box(templates), shape):
            columns = frame_grid(size, shape).columns
            used = [
                index
                for index, template in enumerate(templates)
                if template.box_cells[0] * size >= params.smallest_width(shape) * 0.999
                and template.box_cells[1] * size <= params.max_height * shape[0]
                and template.weights.shape[1] <= columns - _BEYOND * template.border
            ]
            ranges = {index: _row_range(templates[index], size, params, shape) for index in used}
            rows = (
                min((top for top, _ in ranges.values()), default=0),
                max((bottom for _, bottom in ranges.values()), default=0),
            )
            if rows[1] - rows[0] < size:
                continue
            grid = frame_grid(size, shape, rows)
            places, chosen_templates, searches = [], [], []
            for place, (numbers, filters) in enumerate(zip(self._numbers, self._filters)):
                chosen = [number for number, index in enumerate(numbers) if index in ranges]
                indices = [numbers[number] for number in chosen]
                spans = [_cell_rows(grid, ranges[index], shape) for index in indices]
                if place != INNER:
                    spans = [(0, 1)] * len(indices)
                columns = grid.columns if place == INNER else grid.rows
                bounds = [min_margin - templates[index].bias for index in indices]
                cells = np.minimum(_BEYOND + self._strip_cells, grid.columns - 1)
                merged = {INNER: cells[:0], LEFT: cells, RIGHT: grid.columns - 1 - cells}[place]
                search = filters.on_map(columns, chosen, spans, bounds, merged)
                if search is not None:
                    places.append(place)
                    chosen_templates.append(indices)
                    searches.append(search)
            levels.append(_Level(grid, places, chosen_templates, PackedSearch.join(searches)))
            context = math.ceil(_CONTEXT * size)
            octaves[octave_of(size, len(octaves))].append((rows[0] - context, rows[1] + context))
        row_ranges = [
            (max(min(top for top, _ in each), 0), min(max(bottom for _, bottom in each), shape[0]))
            if each
            else (0, shape[0])
            for each in octaves
        ]
        return _Plan.of(levels, row_ranges)


def frame_grid(size: float, shape: tuple[int, ...], rows: Rows | None = None) -> CellGrid:
    """Cells of about a size in pixels on some rows of a frame, and beyond its borders.

    The width of a cell is rounded so that whole cells lie between the left and the right border.
    """
    height, width = shape[:2]
    top, bottom = (0, height) if rows is None else rows
    inside = max(round(width / size), 1)
    step_x = width / inside
    above, below = (_BEYOND if at_border else 0 for at_border in (top == 0, bottom == height))
    count = max(math.ceil((bottom - top) / size), 1) + above + below
    return CellGrid(-_BEYOND * step_x, top - above * size, step_x, size, count, inside + 2 * _BEYOND)


def _cell_rows(grid: CellGrid, rows: Rows, shape: tuple[int, ...]) -> Rows:
    """Rows of a grid that cover a half-open range of rows of the frame, and those beyond its borders."""
    first = 0 if rows[0] == 0 else math.floor((rows[0] - grid.top) / grid.step_y)
    last = grid.rows if rows[1] == shape[0] else math.ceil((rows[1] - grid.top) / grid.step_y)
    return first, min(last, grid.rows)


def _row_range(template: MixtureTemplate, size: float, params: PyramidParams, shape: tuple[int, ...]) -> Rows:
    """Rows of the frame that a template with cells of `size` pixels covers, as a half-open range."""
    width, height = (cells * size for cells in template.box_cells)
    if template.border:
        # A truncated vehicle is wider than its visible part.
        width = max(width, height)
    top, bottom = params.rows(width, height, shape)
    padding = round(template.padding[1] * size)
    return max(0, top - padding), min(shape[0], bottom + padding)
