"""Train the templates of a mixture on labelled frames, with hard negatives mined from the same frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._checks import check_integer, check_type
from vehicle_detection._feature_maps import COARSE, FINE, PLANES, mirror_planes
from vehicle_detection._jobs import resolve_jobs
from vehicle_detection._mixture_params import MixtureParams
from vehicle_detection._mixture_template import MixtureTemplate
from vehicle_detection._mixture_windows import (
    Frame,
    FrameSource,
    Mined,
    Negatives,
    check_sources,
    frames_of,
    mine_windows,
    random_windows,
    with_mirrored,
)
from vehicle_detection._refinement import CROP_LENGTH, Refinement, box_planes, crop_features, suppress
from vehicle_detection._variants import relight
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import MixtureSearch, TemplateMixture

__all__ = ["FrameSource", "MixtureParams", "train_mixture"]

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
log = logging.getLogger(__name__)

# Steps of the solver while negatives are still looked for, and in the end.
_FEW_STEPS, _MANY_STEPS = 50, 200
# A vehicle is cut by a border that it comes nearer to than this, in pixels; share of a vehicle that is left
# where it is cut on purpose.
_AT_BORDER, _SHOWN = 3, (0.3, 0.85)


def train_mixture(
    sources: Sequence[FrameSource],
    params: MixtureParams | None = None,
    *,
    random_state: int = 0,
    n_jobs: int | None = None,
    on_step: Callable[[str], object] | None = None,
) -> TemplateMixture:
    """Train a mixture of templates.

    Parameters
    ----------
    sources
        Labelled frames.
    params
        Shapes of the templates, and how they are trained.
    random_state
        Seed of the jitter and of the first negatives.
    n_jobs
        Threads; the model does not depend on them.
    on_step
        Called with a line about each step that is done.

    Returns
    -------
    TemplateMixture
        Uncalibrated: its scores are the templates' values. See `judge_mixture`.

    Raises
    ------
    InvalidInputError
        If there is no source, or no vehicle for one of the templates.

    Notes
    -----
    Linear SVMs on the vehicles and on windows without one, at random at first and then those that the
    templates so far wrongly like best: Felzenszwalb et al. (PAMI 2010), section 5.
    """
    sources = check_sources(sources)
    params = params if params is not None else MixtureParams()
    check_type(params, "params", MixtureParams, "leave it out for the project's own")
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    tell = on_step or log.info
    frames = frames_of(sources)
    rng = np.random.default_rng(random_state)
    templates = [_blank(shape, params.margin) for shape in params.shapes]
    positives = _positives(_whole(frames, params, rng), templates, params)
    at_border = [_blank(shape, params.margin, border=True) for shape in params.border_shapes]
    positives += _positives(_cut(frames, params, rng), at_border, params)
    templates += at_border
    for shape, rows in zip(params.shapes + params.border_shapes, positives):
        if not len(rows):
            raise InvalidInputError(
                f"sources must hold vehicles of every shape, got none like {shape[0]:g}x{shape[1]:g} that is "
                f"{params.least_width:g} pixels wide or more; leave that shape out of MixtureParams"
            )
    for index in np.flatnonzero(params.facing).tolist():
        positives[index] = turned(positives[index], rng)
    tell(f"{[len(rows) for rows in positives]} vehicles")
    with ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool:
        facing = params.facing + (False,) * len(at_border)
        rounds = _Rounds(frames, positives, facing, params, pool)
        seeds = rng.integers(2**32, size=len(frames)).tolist()
        rounds.draw(templates, seeds)
        for step, share in enumerate(params.rounds):
            templates = rounds.solve(templates, _FEW_STEPS)
            chosen = rng.permutation(len(frames))[: math.ceil(share * len(frames))]
            new, total = rounds.mine(templates, chosen.tolist())
            tell(f"round {step + 1}: {new} new of {total} negatives")
            if share == 1 and new < 0.01 * total:
                break
        templates = rounds.solve(templates, _MANY_STEPS)
        templates = [
            replace(each, bias=each.bias + params.border_bias) if each.border else each for each in templates
        ]
        found = tuple(view.template for view in with_mirrored(templates, facing))
        plain = TemplateMixture(
            found, Refinement.none(), near_gain=params.near_gain, support_gain=params.support_gain
        )
        seeds = rng.integers(2**32, size=len(frames)).tolist()
        refinement = _fit_refinement(plain, frames, seeds, params, pool)
    return replace(plain, refinement=refinement)


class _Rounds:
    """The rounds of mining and solving, with what they keep."""

    def __init__(
        self,
        frames: Sequence[Frame],
        positives: list[NDArray[np.float32]],
        facing: Sequence[bool],
        params: MixtureParams,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._frames, self._positives, self._params, self._pool = frames, positives, params, pool
        self._facing = facing
        self._negatives = Negatives([rows.shape[1] for rows in positives])
        self._vectors = [np.zeros(rows.shape[1] + 1) for rows in positives]

    def draw(self, templates: Sequence[MixtureTemplate], seeds: Sequence[int]) -> None:
        """Take windows at random."""
        views = with_mirrored(templates, self._facing)

        def windows(number: int) -> tuple[int, Mined]:
            return number, random_windows(self._frames[number], seeds[number], views, self._params)

        self._negatives.add(self._pool.map(windows, range(len(self._frames))))

    def mine(self, templates: Sequence[MixtureTemplate], numbers: Sequence[int]) -> tuple[int, int]:
        """Take hard negatives from these frames; return how many are new, and how many there are."""
        self._negatives.trim(templates, self._params.most_negatives)
        views = with_mirrored(templates, self._facing)

        def windows(number: int) -> tuple[int, Mined]:
            return number, mine_windows(self._frames[number], views, self._params)

        new = self._negatives.add(self._pool.map(windows, numbers))
        return new, sum(len(rows) for rows in self._negatives.rows)

    def solve(self, templates: Sequence[MixtureTemplate], steps: int) -> list[MixtureTemplate]:
        """Train the templates on what there is, from where they stand."""

        def solved(index: int) -> Floats:
            rows = self._positives[index], self._negatives.rows[index]
            return _solve(*rows, self._params, self._vectors[index], steps)

        self._vectors = list(self._pool.map(solved, range(len(templates))))
        return [_filled(template, vector) for template, vector in zip(templates, self._vectors)]


def turned(rows: NDArray[np.float32], rng: np.random.Generator, tries: int = 5) -> NDArray[np.float32]:
    """Choose of each vehicle and its mirror image, which are neighbouring rows, the one like the others.

    Two clusters that are each other's mirror image, by k-means from a few random starts.
    """
    if not len(rows):
        return rows
    pairs = rows.reshape(len(rows) // 2, 2, -1)
    centred = pairs - pairs.mean(axis=(0, 1))
    number = np.arange(len(pairs))
    best, length = np.zeros(len(pairs), np.intp), -1.0
    for _ in range(tries):
        chosen = rng.integers(0, 2, len(pairs))
        for _ in range(15):
            mean = centred[number, chosen].mean(axis=0)
            chosen = (centred @ mean).argmax(axis=1)
        if float(np.linalg.norm(mean)) > length:
            best, length = chosen, float(np.linalg.norm(mean))
    return np.ascontiguousarray(pairs[number, best])


def _blank(shape: tuple[float, float], margin: float, *, border: bool = False) -> MixtureTemplate:
    columns, rows = round(shape[0] + margin * (1 if border else 2)), round(shape[1] + 2 * margin)
    across = (columns - shape[0]) / (1 if border else 2)
    weights = np.zeros((rows, columns, PLANES), np.float32)
    return MixtureTemplate(weights, 0.0, (across, (rows - shape[1]) / 2), border)


def _filled(template: MixtureTemplate, vector: Floats) -> MixtureTemplate:
    weights = vector[:-1].astype(np.float32).reshape(template.weights.shape)
    return replace(template, weights=weights, bias=float(np.float32(vector[-1])))


def _window(image: Image, box: Floats, template: MixtureTemplate) -> NDArray[np.float32]:
    """Features of a box as a template sees it, ``(28, rows, columns)``."""
    inside = template.box_cells
    rows, columns = template.weights.shape[:2]
    step_x, step_y = (box[2] - box[0]) / inside[0], (box[3] - box[1]) / inside[1]
    cell = FINE if np.sqrt(step_x * step_y) < COARSE else COARSE
    if template.border:
        # The window ends with the box: its margin is part of what is warped.
        box, inside = box - [template.margin[0] * step_x, 0, 0, 0], (float(columns), inside[1])
    return box_planes(image, box.tolist(), inside, (columns, rows), cell)


Seen = Iterator[tuple[Image, Floats]]
"""Images and the place of a vehicle in each."""


def _whole(frames: Sequence[Frame], params: MixtureParams, rng: np.random.Generator) -> Seen:
    """Vehicles where they are, moved a little, and at other exposures."""
    for frame in frames:
        boxes = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.least_width]
        for box in boxes:
            for copy in range(params.jitter):
                shift = rng.uniform(-1, 1, 4) * params.shake * np.tile(box[2:] - box[:2], 2)
                yield frame.image, box + shift * (copy > 0)
        for _ in range(params.exposures if len(boxes) else 0):
            image = relight(frame.image, rng)
            for box in boxes:
                yield image, box


def _cut(frames: Sequence[Frame], params: MixtureParams, rng: np.random.Generator) -> Seen:
    """Vehicles that the right border cuts, and whole ones in images that are cut through them."""
    for frame in frames:
        width = frame.image.shape[1]
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        for image, boxes in (frame.image, frame.boxes), (mirrored, mirror_boxes(frame.boxes, width)):
            for box in boxes[boxes[:, 2] - boxes[:, 0] >= params.least_width]:
                sides = np.tile(box[2:] - box[:2], 2)
                if box[2] >= width - _AT_BORDER:
                    for copy in range(params.jitter):
                        x1, y1, _, y2 = box + rng.uniform(-1, 1, 4) * params.shake * sides * (copy > 0)
                        yield image, np.array([x1, y1, width, y2])
                end = round(box[0] + rng.uniform(*_SHOWN) * sides[0])
                if box[0] > _AT_BORDER and params.least_width <= end - box[0] and end < width - _AT_BORDER:
                    yield image[:, :end], np.array([*box[:2], end, box[3]])


def mirror_boxes(boxes: Floats, width: float) -> Floats:
    """Boxes in the mirrored image of this width."""
    return np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1)


def _positives(
    vehicles: Seen, templates: Sequence[MixtureTemplate], params: MixtureParams
) -> list[NDArray[np.float32]]:
    """Features of the vehicles of each template, ``(N, length)``."""
    found: list[list[NDArray[np.float32]]] = [[] for _ in templates]
    aspects = np.log([template.box_cells[0] / template.box_cells[1] for template in templates])
    for image, box in vehicles if templates else ():
        apart = np.abs(np.log((box[2] - box[0]) / (box[3] - box[1])) - aspects)
        for index in np.flatnonzero((apart == apart.min()) | (apart < params.near)).tolist():
            planes = _window(image, box, templates[index])
            # At the border every vehicle comes from both sides already.
            for view in (planes,) if templates[index].border else (planes, mirror_planes(planes)):
                found[index].append(view.transpose(1, 2, 0).ravel())
    return [np.array(rows, np.float32).reshape(-1, t.weights.size) for rows, t in zip(found, templates)]


def _solve(
    positives: NDArray[np.float32],
    negatives: NDArray[np.float32],
    params: MixtureParams,
    start: Floats,
    steps: int,
) -> Floats:
    """Weights and bias of a linear SVM with squared hinge loss, in the primal (Chapelle, 2007)."""
    from scipy.optimize import minimize

    sides = (positives, 1.0, params.vehicles / len(positives)), (negatives, -1.0, 1.0)

    def loss(vector: Floats) -> tuple[float, Floats]:
        weights, bias = vector[:-1].astype(np.float32), vector[-1]
        gradient = np.append(vector[:-1], 0.0)
        value = 0.5 * float(vector[:-1] @ vector[:-1])
        for rows, sign, weight in sides:
            margin = np.maximum(1 - sign * ((rows @ weights).astype(np.float64) + bias), 0)
            value += params.C * weight * float(margin @ margin)
            pull = (-2 * params.C * weight * sign * margin).astype(np.float32)
            gradient[:-1] += pull @ rows
            gradient[-1] += float(pull.sum())
        return value, gradient

    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": steps})
    return np.asarray(found.x, np.float64)


def _fit_refinement(
    mixture: TemplateMixture,
    frames: Sequence[Frame],
    seeds: Sequence[int],
    params: MixtureParams,
    pool: ThreadPoolExecutor,
) -> Refinement:
    """Learn how boxes that are found, or moved at random, differ from the true ones, by ridge regression."""
    from sklearn.linear_model import Ridge

    search = MixtureSearch(mixture, n_jobs=1)

    def pairs(frame: Frame, seed: int) -> tuple[NDArray[np.float32], Floats]:
        if not len(frame.boxes):
            return np.empty((0, CROP_LENGTH), np.float32), np.empty((0, 4))
        found = suppress(search.candidates(frame.image, params.search), least=-1.0)[0].boxes
        overlap = iou_matrix(found, frame.boxes)
        near = overlap.max(axis=1) >= 0.4
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.least_width]
        copies = np.tile(wide, (params.jitter, 1))
        boxes = np.concatenate([found[near], _moved(copies, np.random.default_rng(seed))])
        true = np.concatenate([frame.boxes[overlap.argmax(axis=1)[near]], copies])
        shifts = (true - boxes) / np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        width = frame.image.shape[1]
        flipped, back = mirror_boxes(boxes, width), mirror_boxes(shifts, 0)
        features = np.concatenate([crop_features(frame.image, boxes), crop_features(mirrored, flipped)])
        return features, np.concatenate([shifts, back])

    found = list(pool.map(pairs, frames, seeds))
    search.close()
    features, shifts = (np.concatenate(side) for side in zip(*found))
    if not len(features):
        return Refinement.none()
    fitted = Ridge(alpha=30.0).fit(features.astype(np.float64), np.clip(shifts, -0.5, 0.5))
    weights, bias = fitted.coef_.T.astype(np.float32), fitted.intercept_.astype(np.float32)
    return Refinement(weights, bias, params.looks)


def _moved(boxes: Floats, rng: np.random.Generator) -> Floats:
    """Boxes as a search may find them: beside their vehicles, too small or too large, of another shape."""
    sides = boxes[:, 2:] - boxes[:, :2]
    centres = boxes[:, :2] + sides * (0.5 + rng.uniform(-0.2, 0.2, sides.shape))
    size, shape = rng.uniform(-0.45, 0.3, (len(boxes), 1)), rng.uniform(-0.15, 0.15, sides.shape)
    halves = sides / 2 * np.exp(size + shape)
    return np.concatenate([centres - halves, centres + halves], axis=1)
