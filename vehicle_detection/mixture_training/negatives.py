"""Negative windows of labelled frames: random ones at first, then hard negatives."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, single_threaded_opencv
from vehicle_detection.boxes import box_areas, greedy_nms, intersection_matrix, iou_matrix
from vehicle_detection.mixture import (
    EdgePyramid,
    FeatureMap,
    MixtureTemplate,
    frame_grid,
    mirror_channels,
    mostly_inside,
    smallest_box,
)
from vehicle_detection.mixture_training.sources import TrainingFrame
from vehicle_detection.params import MixtureParams

Choice = Callable[[NDArray[np.float32]], NDArray[np.intp]]
"""Chooses windows by their margins; returns indices."""
Margins = Callable[[MixtureTemplate, NDArray[np.float32]], NDArray[np.float32]]
"""Margins of a template's windows over FHOG channels, as `MixtureTemplate.margins`."""
Block = tuple[tuple[int, ...], NDArray[np.float32]]
"""Position and features, ``(20, rows, columns)``, of a window."""

# Margin above which a window is a hard negative, and the most of them per pyramid level.
_HARD_MARGIN, _MAX_PER_LEVEL = -0.9, 400
_RANDOM_PER_LEVEL = 0.15  # expected number of random windows per pyramid level
_MAX_OVERLAP = 0.3  # of a negative: IoU with a vehicle, and fraction of its own area in an ignored box
_DUPLICATE_IOU = 0.7  # IoU above which two negatives of a frame are duplicates


@dataclass(frozen=True, eq=False)
class View:
    """A template to search with: the trained template `index`, or its mirror image."""

    template: MixtureTemplate
    index: int
    mirrored: bool


class HardNegative(NamedTuple):
    """A negative window of a frame."""

    template: int  # index of the trained template
    place: tuple[int, ...]  # view and position, unique within the frame
    features: NDArray[np.float32]


def with_mirrored(templates: Sequence[MixtureTemplate], mirrored: Sequence[bool]) -> list[View]:
    """List the templates, followed by the mirror images of those marked in `mirrored`."""
    views = [View(template, index, False) for index, template in enumerate(templates)]
    for index, template in enumerate(templates):
        if mirrored[index]:
            weights = mirror_channels(template.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
            views.append(View(replace(template, weights=weights), index, True))
    return views


def is_negative(boxes: Floats, frame: TrainingFrame) -> NDArray[np.bool_]:
    """Which windows certainly show no vehicle according to the labels."""
    negative = boxes[:, 2] - boxes[:, 0] >= frame.min_labelled_width
    if len(frame.boxes):
        negative &= iou_matrix(boxes, frame.boxes).max(axis=1) < _MAX_OVERLAP
    if len(frame.ignored):
        centers = ((boxes[:, :2] + boxes[:, 2:]) / 2)[:, None]
        inside = np.asarray((centers > frame.ignored[:, :2]) & (centers < frame.ignored[:, 2:])).all(axis=2)
        negative &= ~np.asarray(inside).any(axis=1)
        shared = intersection_matrix(boxes, frame.ignored)
        negative &= (shared / box_areas(boxes)[:, None]).max(axis=1) < _MAX_OVERLAP
    return np.asarray(negative, np.bool_)


def random_windows(
    frame: TrainingFrame, seed: int, views: Sequence[View], params: MixtureParams
) -> list[HardNegative]:
    """Draw a few random negatives."""
    rng = np.random.default_rng(seed)

    def choose(margins: NDArray[np.float32]) -> NDArray[np.intp]:
        return rng.permutation(margins.size)[: rng.poisson(_RANDOM_PER_LEVEL)]

    def equal(template: MixtureTemplate, channels: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.zeros(template.window_counts(channels), np.float32)

    return _negatives(frame, views, params, choose, equal)


def mine_windows(frame: TrainingFrame, views: Sequence[View], params: MixtureParams) -> list[HardNegative]:
    """Find the negatives with the highest margins."""

    def choose(margins: NDArray[np.float32]) -> NDArray[np.intp]:
        hits = np.flatnonzero(margins > _HARD_MARGIN)
        if len(hits) > _MAX_PER_LEVEL:
            hits = np.sort(hits[np.argpartition(-margins[hits], _MAX_PER_LEVEL)[:_MAX_PER_LEVEL]])
        return hits

    return _negatives(frame, views, params, choose)


def _negatives(
    frame: TrainingFrame,
    views: Sequence[View],
    params: MixtureParams,
    choose: Choice,
    margins: Margins = MixtureTemplate.margins,
) -> list[HardNegative]:
    """Negatives of a frame among the windows that `choose` takes, for each view."""
    shape = frame.image.shape[:2]
    sizes = params.search.sizes(*smallest_box([view.template for view in views]), shape)
    with single_threaded_opencv():
        pyramid = EdgePyramid(frame.image)
    maps = [pyramid.feature_map(frame_grid(size, shape)) for size in sizes]
    found = []
    for number, view in enumerate(views):
        blocks = _border_blocks if view.template.border else _inner_blocks
        for place, block in blocks(frame, maps, view, params, choose, margins):
            found.append(HardNegative(view.index, (number, *place), block.transpose(1, 2, 0).ravel()))
    return found


def _inner_blocks(
    frame: TrainingFrame,
    maps: Sequence[FeatureMap],
    view: View,
    params: MixtureParams,
    choose: Choice,
    margins: Margins,
) -> Iterator[Block]:
    """Negatives of one view anywhere in a frame."""
    places, boxes, scores = [], [], []
    for size, features in enumerate(maps):
        grid = margins(view.template, features.channels)
        rows, columns = np.divmod(choose(grid.ravel()), max(grid.shape[1], 1))
        places += [(size, row, column) for row, column in zip(rows.tolist(), columns.tolist())]
        boxes.append(view.template.boxes(features.grid, rows, columns))
        scores.append(grid[rows, columns].astype(np.float64))
    height, width = view.template.weights.shape[:2]
    for chosen in _select(frame, np.concatenate(boxes), np.concatenate(scores), params.max_per_frame):
        size, top, left = places[chosen]
        block = maps[size].channels[:, top : top + height, left : left + width]
        yield places[chosen], mirror_channels(block) if view.mirrored else block


def _border_blocks(
    frame: TrainingFrame,
    maps: Sequence[FeatureMap],
    view: View,
    params: MixtureParams,
    choose: Choice,
    margins: Margins,
) -> Iterator[Block]:
    """Negatives of one border template at the actual borders of a frame and at simulated ones."""
    template, width = view.template, frame.image.shape[1]
    height = template.weights.shape[0]
    narrowest = params.search.smallest_width(frame.image.shape)
    for left, fraction in itertools.product((False, True), (1.0, *params.simulated_borders)):
        end = round(width * (1 - fraction if left else fraction))
        strips = {}
        places, boxes, scores = [], [np.empty((0, 4))], [np.empty(0)]
        for size, features in enumerate(maps):
            strip = template.border_strip(features, end, left=left)
            if strip is None or template.box_cells[0] * features.grid.step_x <= 0.999 * narrowest:
                continue
            strips[size] = strip
            line = margins(template, strip).ravel()
            rows = choose(line)
            places += [(size, row) for row in rows.tolist()]
            boxes.append(template.border_boxes(features.grid, rows, end, left=left))
            scores.append(line[rows].astype(np.float64))
        visible = truncate_labels(frame, end, left=left)
        max_count = max(1, params.max_per_frame // 5)
        for chosen in _select(visible, np.concatenate(boxes), np.concatenate(scores), max_count):
            size, top = places[chosen]
            yield (size, top, 2 * end + left), strips[size][:, top : top + height]


def _select(frame: TrainingFrame, boxes: Floats, margins: Floats, max_count: int) -> list[int]:
    """Rows of the windows with the highest margins that show no vehicle, without near duplicates."""
    inside = np.flatnonzero(mostly_inside(boxes, frame.image.shape))
    rows = inside[is_negative(boxes[inside], frame)]
    rows = rows[np.argsort(-margins[rows], kind="stable")][: 20 * max_count]
    kept = greedy_nms(boxes[rows], margins[rows], max_iou=_DUPLICATE_IOU, max_boxes=max_count)
    return [int(row) for row in rows[kept]]


def truncate_labels(frame: TrainingFrame, end: float, *, left: bool) -> TrainingFrame:
    """Clip a frame's labels to what lies right (`left`) or left of the column `end`; the image is kept."""

    def clip(boxes: Floats) -> Floats:
        boxes, sides = boxes.copy(), [0, 2]
        side = boxes[:, sides]
        boxes[:, sides] = np.maximum(side, end) if left else np.minimum(side, end)
        return boxes[boxes[:, 2] > boxes[:, 0]]

    return replace(frame, boxes=clip(frame.boxes), ignored=clip(frame.ignored))


class NegativePool:
    """The negatives collected for each template, without repetition."""

    def __init__(self, lengths: Sequence[int]) -> None:
        self.rows: list[NDArray[np.float32]] = [np.empty((0, length), np.float32) for length in lengths]
        self._known: list[set[tuple[int, ...]]] = [set() for _ in lengths]

    def add(self, found: Iterable[tuple[int, Sequence[HardNegative]]]) -> int:
        """Add the negatives of numbered frames, in their order; return how many are new."""
        fresh: list[list[NDArray[np.float32]]] = [[] for _ in self.rows]
        for number, negatives in found:
            for index, place, features in negatives:
                if (number, *place) not in self._known[index]:
                    self._known[index].add((number, *place))
                    fresh[index].append(features)
        for index, rows in enumerate(fresh):
            if rows:
                self.rows[index] = np.concatenate([self.rows[index], rows])
        return sum(map(len, fresh))

    def trim(self, templates: Sequence[MixtureTemplate], max_count: int) -> None:
        """Drop the negatives with the lowest margins beyond `max_count`; `add` does not take them again."""
        for index, template in enumerate(templates):
            rows = self.rows[index]
            if len(rows) > max_count:
                margins = rows @ template.weights.ravel() + template.bias
                self.rows[index] = rows[np.sort(np.argsort(-margins, kind="stable")[:max_count])]
