"""Windows of labelled frames that are no vehicles, for the training of a mixture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._checks import check_integer, check_number, check_type, describe
from vehicle_detection._feature_maps import halved, level_maps, mirror_planes, pair_levels
from vehicle_detection._jobs import single_threaded_opencv
from vehicle_detection._labelled_frames import LabelledFrames
from vehicle_detection._refinement import mostly_inside, overlaps
from vehicle_detection.boxes import box_areas, intersection_matrix, iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import MixtureTemplate
from vehicle_detection.params import PyramidParams

Floats = NDArray[np.float64]

# A window above this value is a hard negative; so many of one size at most are looked at.
_HARD, _MOST_HITS = -0.9, 400


@dataclass(frozen=True, kw_only=True)
class MixtureParams:
    """How a mixture is trained.

    Attributes
    ----------
    shapes
        Columns and rows of cells that the boxes of each template fill.
    facing
        Which of them show one side of a vehicle: their vehicles are turned to face the same way, and the
        mirrored template is searched for too.
    margin
        Cells of context on every side.
    C
        Inverse strength of the regularisation, as in ``LinearSVC``.
    vehicles
        Weight of all vehicles of a template together; a negative weighs 1.
    least_width
        Width in pixels of the narrowest box that is trained on.
    near
        A box trains every template whose logarithmic aspect ratio is this near, and the nearest.
    jitter
        Copies of each box, of which all but the first are moved by up to ``shake`` of its sides.
    rounds
        Shares of the frames that the rounds of mining look at; one of all frames that brings under 1% new
        negatives is the last.
    per_frame
        Negatives that a round takes from a frame for each template, at most.
    most_negatives
        Negatives that are kept for each template; the easiest go.
    search
        Sizes at which negatives are looked for.

    Raises
    ------
    InvalidInputError
        If a value is out of range, or `facing` is not as long as `shapes`.

    Examples
    --------
    >>> MixtureParams(shapes=((8, 6),), facing=(True,), rounds=(1.0,)).margin
    1.0
    """

    shapes: tuple[tuple[float, float], ...] = ((6, 8), (7, 6), (10, 6))
    facing: tuple[bool, ...] = (False, False, False)
    margin: float = 1.0
    C: float = 5e-4
    vehicles: float = 1500.0
    least_width: float = 28.0
    near: float = 0.2
    jitter: int = 2
    shake: float = 0.03
    rounds: tuple[float, ...] = (0.15, 0.3, 0.6, 1.0)
    per_frame: int = 30
    most_negatives: int = 12_000
    search: PyramidParams = PyramidParams(least_width=24.0, horizon=None)  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        shapes, facing = _entries(self.shapes, "shapes"), _entries(self.facing, "facing")
        for shape in shapes:
            if not isinstance(shape, (tuple, list)) or len(shape) != 2:
                raise InvalidInputError(
                    f"shapes must be (columns, rows) of cells each, such as ((7, 6),); got {describe(shape)}"
                )
            for cells in shape:
                check_number(cells, "shapes", low=2, high=64)
        if len(facing) != len(shapes) or not all(isinstance(each, (bool, np.bool_)) for each in facing):
            raise InvalidInputError(
                f"facing must be True or False for each of {len(shapes)} shapes; got {describe(facing)}"
            )
        check_number(self.margin, "margin", low=0, high=8)
        check_number(self.C, "C", above=0, high=1e6)
        check_number(self.vehicles, "vehicles", above=0, high=1e9)
        check_number(self.least_width, "least_width", low=8, high=10_000)
        check_number(self.near, "near", low=0, high=10)
        check_integer(self.jitter, "jitter", low=1, high=100)
        check_number(self.shake, "shake", low=0, high=0.25)
        rounds = _entries(self.rounds, "rounds")
        for share in rounds:
            check_number(share, "rounds", above=0, high=1)
        check_integer(self.per_frame, "per_frame", low=1)
        check_integer(self.most_negatives, "most_negatives", low=1)
        check_type(self.search, "search", PyramidParams, "it tells where negatives are looked for")
        for name, values in (("shapes", tuple(map(tuple, shapes))), ("facing", facing), ("rounds", rounds)):
            object.__setattr__(self, name, values)


def _entries(values: object, name: str) -> tuple[Any, ...]:
    if not isinstance(values, (tuple, list)) or not values:
        raise InvalidInputError(f"{name} must be a tuple of at least one entry; got {describe(values)}")
    return tuple(values)


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Labelled frames of one camera or country.

    Attributes
    ----------
    name
        Name of the source.
    sets
        Its frames.
    complete_from
        Width in pixels from which on every vehicle is labelled: narrower windows are no negatives.

    Raises
    ------
    InvalidInputError
        If the name is none, or there are no frames.

    Examples
    --------
    >>> from vehicle_detection.evaluation import Labels
    >>> road = LabelledFrames("road", [np.zeros((90, 120, 3), np.uint8)], Labels([0], None, [[9, 9, 60, 50]]))
    >>> FrameSource("camera", [road], complete_from=40).sets
    (LabelledFrames('road', 1 frame, 1 box),)
    """

    name: str
    sets: tuple[LabelledFrames, ...]
    complete_from: float = 0.0

    def __post_init__(self) -> None:
        name: object = self.name
        if not isinstance(name, str) or not name:
            raise InvalidInputError(f"name must be a word for the source, got {describe(name)}")
        sets = _entries(self.sets, "sets")
        for part in sets:
            check_type(part, "sets", LabelledFrames, "pass the frames with their labels as LabelledFrames")
        check_number(self.complete_from, "complete_from", low=0)
        object.__setattr__(self, "sets", sets)


def check_sources(sources: object, *, least: int = 1) -> tuple[FrameSource, ...]:
    """Return sources of different names, `least` or more."""
    if not isinstance(sources, (tuple, list)):
        raise InvalidInputError(f"sources must be a list of FrameSource, got {describe(sources)}")
    for source in sources:
        check_type(source, "sources", FrameSource, "name the frames of each camera or country with one")
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
        ``(H, W, 3)`` uint8 RGB.
    boxes
        ``(N, 4)`` boxes of the vehicles, inside the frame.
    ignored
        ``(M, 4)`` boxes to ignore.
    complete_from
        Width from which on every vehicle is labelled.
    """

    image: NDArray[np.uint8]
    boxes: Floats
    ignored: Floats
    complete_from: float


def frames_of(sources: Sequence[FrameSource]) -> list[Frame]:
    """Load all frames of some sources."""
    found = []
    for source in sources:
        for part in source.sets:
            for key, image in part:
                labels = part.labels.frame(key)
                boxes, ignored = labels.boxes[~labels.ignore], labels.boxes[labels.ignore]
                found.append(Frame(image, boxes, ignored, source.complete_from))
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
            weights = mirror_planes(template.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
            views.append(View(MixtureTemplate(weights, template.bias, template.margin), index, True))
    return views


def is_negative(boxes: Floats, frame: Frame) -> NDArray[np.bool_]:
    """Tell which windows surely show no vehicle, by the labels."""
    sure = boxes[:, 2] - boxes[:, 0] >= frame.complete_from
    if len(frame.boxes):
        sure &= iou_matrix(boxes, frame.boxes).max(axis=1) < 0.3
    if len(frame.ignored):
        centres = ((boxes[:, :2] + boxes[:, 2:]) / 2)[:, None]
        low, high = frame.ignored[None, :, :2], frame.ignored[None, :, 2:]
        within = np.asarray((centres > low) & (centres < high)).all(axis=2)
        sure &= ~np.asarray(within).any(axis=1)
        shared = intersection_matrix(boxes, frame.ignored)
        sure &= (shared / box_areas(boxes)[:, None]).max(axis=1) < 0.3
    return np.asarray(sure, np.bool_)


Mined = list[tuple[int, tuple[int, ...], NDArray[np.float32]]]
"""Template, place in the frame and features of each negative window."""


def random_windows(frame: Frame, seed: int, views: Sequence[View], params: MixtureParams) -> Mined:
    """Take some windows at random, of one size in seven or so."""
    rng = np.random.default_rng(int(seed))
    return _windows_of(frame, views, params, lambda scores: rng.permutation(scores.size)[: rng.poisson(0.15)])


def mine_windows(frame: Frame, views: Sequence[View], params: MixtureParams) -> Mined:
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
) -> Mined:
    """Windows of a frame that `choose` takes by their scores, and that are no vehicles."""
    shape = frame.image.shape[:2]
    cells = [view.template.box_cells for view in views]
    sizes = params.search.sizes(min(c for c, _ in cells), min(r for _, r in cells), shape)
    with single_threaded_opencv():
        images = halved(frame.image)
        levels = [
            features
            for level in pair_levels(sizes)
            for _, features in level_maps(images, level, (0, shape[0]))
        ]
    mined: Mined = []
    for number, view in enumerate(views):
        places, parts, values = [], [], []
        for size, level in enumerate(levels):
            scores = view.template.scores(level.planes)
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
            block = levels[size].planes[:, top : top + high, left : left + wide]
            block = mirror_planes(block) if view.mirrored else block
            mined.append((view.index, (number, size, top, left), block.transpose(1, 2, 0).ravel()))
    return mined


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

    def add(self, mined: Iterable[tuple[int, Mined]]) -> int:
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
