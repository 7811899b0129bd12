"""Windows of labelled frames that are no vehicles, for the training of a mixture."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, check_type, describe, single_threaded_opencv
from vehicle_detection.boxes import box_areas, intersection_matrix, iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames
from vehicle_detection.mixture import (
    FeatureMap,
    MixtureTemplate,
    denoise,
    feature_maps,
    image_pyramid,
    mirror_channels,
    mostly_inside,
    overlaps,
    pyramid_levels,
    smallest_box,
)
from vehicle_detection.params import MixtureParams, entries

Floats = NDArray[np.float64]

# A window above this value is a hard negative; so many of one size at most are looked at.
_HARD, _MOST_HITS = -0.9, 400


@dataclass(frozen=True, eq=False)
class FrameDataset:
    """Labelled frames of one camera or country.

    Attributes
    ----------
    name
        Name of the source.
    sets
        Its frames.
    min_labelled_width
        Width in pixels from which on every vehicle is labelled: narrower windows are no negatives.

    Raises
    ------
    InvalidInputError
        If the name is none, or there are no frames.

    Examples
    --------
    >>> from vehicle_detection.evaluation.detections import Labels
    >>> road = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], Labels([0], None, [[9, 9, 60, 50]]))
    >>> FrameDataset("camera", [road], min_labelled_width=40).sets
    (LabelledFrames('road', 1 frame, 1 box),)
    """

    name: str
    sets: tuple[LabelledFrames, ...]
    min_labelled_width: float = 0.0

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name:
            raise InvalidInputError(f"name must be a word for the source, got {describe(name)}")
        sets = entries(self.sets, "sets")
        for part in sets:
            check_type(part, "sets", LabelledFrames, "pass the frames with their labels as LabelledFrames")
        check_number(self.min_labelled_width, "min_labelled_width", low=0)
        object.__setattr__(self, "sets", sets)


def check_sources(sources: object, *, least: int = 1) -> tuple[FrameDataset, ...]:
    """Return sources of different names, `least` or more."""
    if not isinstance(sources, (tuple, list)):
        raise InvalidInputError(f"sources must be a list of FrameDataset, got {describe(sources)}")
    for source in sources:
        check_type(source, "sources", FrameDataset, "name the frames of each camera or country with one")
    names = [source.name for source in sources]
    if len(names) < least:
        more = "two or more, so that one can be left out" if least > 1 else "one or more"
        raise InvalidInputError(f"sources must be {more}; got {len(names)}: add labelled frames")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InvalidInputError(
            f"sources must have different names, got {min(twice)!r} twice; put its sets into one source"
        )
    return tuple(sources)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame and its labels.

    Attributes
    ----------
    image
        ``(H, W, 3)`` uint8 RGB, without noise.
    boxes
        ``(N, 4)`` boxes of the vehicles, inside the frame.
    ignored
        ``(M, 4)`` boxes to ignore.
    min_labelled_width
        Width from which on every vehicle is labelled.
    """

    image: NDArray[np.uint8]
    boxes: Floats
    ignored: Floats
    min_labelled_width: float


def frames_of(sources: Sequence[FrameDataset]) -> list[Frame]:
    """Load all frames of some sources."""
    found = []
    for source in sources:
        for part in source.sets:
            for key, image in part:
                labels = part.labels.frame(key)
                boxes, ignored = labels.boxes[~labels.ignore], labels.boxes[labels.ignore]
                found.append(Frame(denoise(image), boxes, ignored, source.min_labelled_width))
    return found


@dataclass(frozen=True, eq=False)
class View:
    """A template to search with, the number of the one it is trained as, and whether it is its mirror."""

    template: MixtureTemplate
    index: int
    mirrored: bool


def with_mirrored(templates: Sequence[MixtureTemplate], facing: Sequence[bool]) -> list[View]:
    """List the templates and, behind them, the mirror images of those that show one side."""
    views = [View(template, index, False) for index, template in enumerate(templates)]
    for index, template in enumerate(templates):
        if facing[index]:
            weights = mirror_channels(template.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
            views.append(View(replace(template, weights=weights), index, True))
    return views


def is_negative(boxes: Floats, frame: Frame) -> NDArray[np.bool_]:
    """Tell which windows surely show no vehicle, by the labels."""
    sure = boxes[:, 2] - boxes[:, 0] >= frame.min_labelled_width
    if len(frame.boxes):
        sure &= iou_matrix(boxes, frame.boxes).max(axis=1) < 0.3
    if len(frame.ignored):
        centers = ((boxes[:, :2] + boxes[:, 2:]) / 2)[:, None]
        low, high = frame.ignored[None, :, :2], frame.ignored[None, :, 2:]
        within = np.asarray((centers > low) & (centers < high)).all(axis=2)
        sure &= ~np.asarray(within).any(axis=1)
        shared = intersection_matrix(boxes, frame.ignored)
        sure &= (shared / box_areas(boxes)[:, None]).max(axis=1) < 0.3
    return np.asarray(sure, np.bool_)


HardNegatives = list[tuple[int, tuple[int, ...], NDArray[np.float32]]]
"""Template, place in the frame and features of each negative window."""


def random_windows(frame: Frame, seed: int, views: Sequence[View], params: MixtureParams) -> HardNegatives:
    """Take some windows at random, of one size in seven or so."""
    rng = np.random.default_rng(int(seed))
    return _windows_of(frame, views, params, lambda scores: rng.permutation(scores.size)[: rng.poisson(0.15)])


def mine_windows(frame: Frame, views: Sequence[View], params: MixtureParams) -> HardNegatives:
    """Take the windows that the templates wrongly like best."""

    def choose(scores: NDArray[np.float32]) -> NDArray[np.intp]:
        hits = np.flatnonzero(scores > _HARD)
        if len(hits) > _MOST_HITS:
            hits = np.sort(hits[np.argpartition(-scores[hits], _MOST_HITS)[:_MOST_HITS]])
        return hits

    return _windows_of(frame, views, params, choose)


def _windows_of(
    frame: Frame,
    views: Sequence[View],
    params: MixtureParams,
    choose: Callable[[NDArray[np.float32]], NDArray[np.intp]],
) -> HardNegatives:
    """Windows of a frame that `choose` takes by their scores, and that are no vehicles."""
    shape = frame.image.shape[:2]
    sizes = params.search.sizes(*smallest_box([view.template for view in views]), shape)
    with single_threaded_opencv():
        images = image_pyramid(frame.image)
        levels = [
            features
            for level in pyramid_levels(sizes)
            for _, features in feature_maps(images, level, (0, shape[0]))
        ]
    mined: HardNegatives = []
    for number, view in enumerate(views):
        if view.template.border:
            mined += _windows_at_ends(frame, levels, number, view, params, choose)
            continue
        places, parts, values = [], [], []
        for size, level in enumerate(levels):
            scores = view.template.margins(level.channels)
            rows, columns = np.divmod(choose(scores.ravel()), max(scores.shape[1], 1))
            parts.append(view.template.boxes(level, rows, columns))
            values.append(scores[rows, columns].astype(np.float64))
            places += [(size, r, c) for r, c in zip(rows.tolist(), columns.tolist())]
        boxes = np.concatenate(parts)
        inside = np.flatnonzero(mostly_inside(boxes, shape))
        allowed = inside[is_negative(boxes[inside], frame)]
        for row in _apart(boxes, np.concatenate(values), allowed, params.per_frame):
            size, top, left = places[row]
            high, wide = view.template.weights.shape[:2]
            block = levels[size].channels[:, top : top + high, left : left + wide]
            block = mirror_channels(block) if view.mirrored else block
            mined.append((view.index, (number, size, top, left), block.transpose(1, 2, 0).ravel()))
    return mined


def _windows_at_ends(
    frame: Frame,
    levels: Sequence[FeatureMap],
    number: int,
    view: View,
    params: MixtureParams,
    choose: Callable[[NDArray[np.float32]], NDArray[np.intp]],
) -> HardNegatives:
    """Windows next to the borders of a frame, and where it might as well have ended."""
    template, (height, width) = view.template, frame.image.shape[:2]
    mined: HardNegatives = []
    for left, share in itertools.product((False, True), (1.0, *params.cuts)):
        end = round(width * (1 - share if left else share))
        strips = {
            size: (level, strip)
            for size, level in enumerate(levels)
            if template.box_cells[0] * level.step_x > 0.999 * params.search.min_width
            and (strip := template.border_strip(level, end, left=left)) is not None
        }
        places, parts, values = [], [np.empty((0, 4))], [np.empty(0)]
        for size, (level, strip) in strips.items():
            scores = template.margins(strip).ravel()
            rows = choose(scores)
            parts.append(template.border_boxes(level, rows, end, left=left))
            values.append(scores[rows].astype(np.float64))
            places += [(size, row) for row in rows.tolist()]
        boxes = np.concatenate(parts)
        inside = np.flatnonzero(mostly_inside(boxes, (height, width)))
        allowed = inside[is_negative(boxes[inside], cut_labels(frame, end, left=left))]
        for row in _apart(boxes, np.concatenate(values), allowed, max(1, params.per_frame // 5)):
            size, top = places[row]
            block = strips[size][1][:, top : top + template.weights.shape[0]]
            place = (number, size, top, 2 * end + left)
            mined.append((view.index, place, block.transpose(1, 2, 0).ravel()))
    return mined


def cut_labels(frame: Frame, end: float, *, left: bool) -> Frame:
    """Cut a frame's labels where the frame is taken to end; the image stays whole."""

    def rest(boxes: Floats) -> Floats:
        boxes = boxes.copy()
        side = boxes[:, 0:3:2]
        side[:] = np.maximum(side, end) if left else np.minimum(side, end)
        return boxes[boxes[:, 2] > boxes[:, 0]]

    return replace(frame, boxes=rest(frame.boxes), ignored=rest(frame.ignored))


def _apart(boxes: Floats, values: Floats, rows: NDArray[np.intp], most: int) -> list[int]:
    """Choose the best rows whose boxes do not nearly coincide."""
    left = rows[np.argsort(-values[rows], kind="stable")][: 20 * most]
    kept: list[int] = []
    while len(left) and len(kept) < most:
        best, left = left[0], left[1:]
        kept.append(int(best))
        left = left[overlaps(boxes[best], boxes[left])[0] <= 0.7]
    return kept


class Negatives:
    """Negative windows of each template, each once."""

    def __init__(self, lengths: Sequence[int]) -> None:
        self.rows: list[NDArray[np.float32]] = [np.empty((0, length), np.float32) for length in lengths]
        self._known: list[set[tuple[int, ...]]] = [set() for _ in lengths]

    def add(self, mined: Iterable[tuple[int, HardNegatives]]) -> int:
        """Take the windows of all frames, in their order; return how many are new."""
        fresh: list[list[NDArray[np.float32]]] = [[] for _ in self.rows]
        for number, windows in mined:
            for index, place, features in windows:
                key = (number, *place)
                if key not in self._known[index]:
                    self._known[index].add(key)
                    fresh[index].append(features)
        for index, rows in enumerate(fresh):
            if rows:
                self.rows[index] = np.concatenate([self.rows[index], np.array(rows, np.float32)])
        return sum(len(rows) for rows in fresh)

    def trim(self, templates: Sequence[MixtureTemplate], most: int) -> None:
        """Forget the easiest windows beyond `most`, for good: `add` does not take them again."""
        for index, template in enumerate(templates):
            rows = self.rows[index]
            if len(rows) > most:
                values = rows @ template.weights.ravel() + template.bias
                self.rows[index] = rows[np.sort(np.argsort(-values, kind="stable")[:most])]
