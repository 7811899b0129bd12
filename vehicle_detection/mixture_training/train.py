"""Train the templates of a mixture on labelled frames, with hard negatives mined from the same frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_image,
    check_integer,
    check_type,
    describe,
    resolve_jobs,
)
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import (
    N_CHANNELS,
    N_REGRESSION_FEATURES,
    BoxRegressor,
    MixtureSearch,
    MixtureTemplate,
    TemplateMixture,
    regression_features,
    vote_boxes,
)
from vehicle_detection.mixture_training.negatives import (
    Frame,
    FrameDataset,
    HardNegatives,
    Negatives,
    check_sources,
    frames_of,
    mine_windows,
    random_windows,
    with_mirrored,
)
from vehicle_detection.mixture_training.positives import (
    align_mirrored,
    jitter_boxes,
    mirror_boxes,
    patch_features,
    truncated_vehicles,
    vehicle_features,
    whole_vehicles,
)
from vehicle_detection.mixture_training.rescoring import train_rescorer
from vehicle_detection.params import MixtureParams

__all__ = ["FrameDataset", "MixtureParams", "train_mixture"]

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
log = logging.getLogger(__name__)

# Steps of the solver while negatives are still looked for, and in the end.
_FEW_STEPS, _MANY_STEPS = 50, 200


def train_mixture(
    sources: Sequence[FrameDataset],
    params: MixtureParams | None = None,
    *,
    patches: Sequence[Image] = (),
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
    patches
        Further vehicles: ``(H, W, 3)`` uint8 RGB images of any size, of which one vehicle fills most, such
        as the course's patches. Where it is on them is told by what is learned about boxes.
    random_state
        Seed of the jitter and of the first negatives.
    n_jobs
        Threads; the model does not depend on them.
    on_step
        Called with a line about each step that is done.

    Returns
    -------
    TemplateMixture
        Uncalibrated: its scores are the templates' values. See `cross_validate_mixture`.

    Raises
    ------
    InvalidInputError
        If there is no source, no vehicle for one of the templates, or a patch is no image.

    Notes
    -----
    Linear SVMs on the vehicles and on windows without one, at random at first and then those that the
    templates so far wrongly like best: Felzenszwalb et al. (PAMI 2010), section 5. What they find then is
    corrected, and trains a second opinion (`Rescorer`).
    """
    sources = check_sources(sources)
    params = params if params is not None else MixtureParams()
    check_type(params, "params", MixtureParams, "leave it out for the project's own")
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    given: object = patches
    if not isinstance(given, (list, tuple, np.ndarray)):
        raise InvalidInputError(f"patches must be images of one vehicle each, got {describe(given)}")
    for image in patches:
        check_image(image, "patches")
    tell = on_step or log.info
    frames = frames_of(sources)
    rng = np.random.default_rng(random_state)
    templates = [_blank(shape, params.margin) for shape in params.shapes]
    at_border = [_blank(shape, params.margin, border=True) for shape in params.border_shapes]
    with ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool:
        positives = _positives(frames, patches, templates, at_border, params, rng, pool)
        tell(f"{[len(rows) for rows in positives]} vehicles")
        templates += at_border
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
            found,
            BoxRegressor.none(),
            size_prior_weight=params.size_prior_weight,
            vote_weight=params.vote_weight,
        )
        search = MixtureSearch(plain, n_jobs=1)
        refined = replace(plain, box_regressor=_fit_box_regressor(frames, rng, params, pool, search))
        search.close()
        search = MixtureSearch(refined, n_jobs=1)
        rescorer = train_rescorer(frames, search, params, rng, pool) if params.rescorer else None
        search.close()
    return replace(refined, rescorer=rescorer)


def _positives(
    frames: Sequence[Frame],
    patches: Sequence[Image],
    templates: Sequence[MixtureTemplate],
    at_border: Sequence[MixtureTemplate],
    params: MixtureParams,
    rng: np.random.Generator,
    pool: ThreadPoolExecutor,
) -> list[NDArray[np.float32]]:
    """Features of the vehicles of each template."""
    found = vehicle_features(whole_vehicles(frames, params, rng), templates, params)
    cut = vehicle_features(truncated_vehicles(frames, params, rng), at_border, params)
    for shape, rows in zip(params.shapes + params.border_shapes, found + cut):
        if not len(rows):
            raise InvalidInputError(
                f"sources must hold vehicles of every shape, got none like {shape[0]:g}x{shape[1]:g} that is "
                f"{params.min_width:g} pixels wide or more; leave that shape out of MixtureParams"
            )
    if len(patches):
        placing = _fit_box_regressor(frames, rng, params, pool)
        more = patch_features(patches, placing, templates, found, params)
        found = [np.concatenate(both) for both in zip(found, more)]
    for index in np.flatnonzero(params.facing).tolist():
        found[index] = align_mirrored(found[index], rng)
    return found + cut


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

        def windows(number: int) -> tuple[int, HardNegatives]:
            return number, random_windows(self._frames[number], seeds[number], views, self._params)

        self._negatives.add(self._pool.map(windows, range(len(self._frames))))

    def mine(self, templates: Sequence[MixtureTemplate], numbers: Sequence[int]) -> tuple[int, int]:
        """Take hard negatives from these frames; return how many are new, and how many there are."""
        self._negatives.trim(templates, self._params.max_negatives)
        views = with_mirrored(templates, self._facing)

        def windows(number: int) -> tuple[int, HardNegatives]:
            return number, mine_windows(self._frames[number], views, self._params)

        new = self._negatives.add(self._pool.map(windows, numbers))
        return new, sum(len(rows) for rows in self._negatives.rows)

    def solve(self, templates: Sequence[MixtureTemplate], steps: int) -> list[MixtureTemplate]:
        """Train the templates on what there is, from where they stand."""

        def solved(index: int) -> Floats:
            rows = self._positives[index], self._negatives.rows[index]
            C = self._params.border_C if templates[index].border else self._params.C
            return _solve(*rows, C, self._params.vehicles, self._vectors[index], steps)

        self._vectors = list(self._pool.map(solved, range(len(templates))))
        return [_filled(template, vector) for template, vector in zip(templates, self._vectors)]


def _blank(shape: tuple[float, float], margin: float, *, border: bool = False) -> MixtureTemplate:
    columns, rows = round(shape[0] + margin * (1 if border else 2)), round(shape[1] + 2 * margin)
    across = (columns - shape[0]) / (1 if border else 2)
    weights = np.zeros((rows, columns, N_CHANNELS), np.float32)
    return MixtureTemplate(weights, 0.0, (across, (rows - shape[1]) / 2), border)


def _filled(template: MixtureTemplate, vector: Floats) -> MixtureTemplate:
    weights = vector[:-1].astype(np.float32).reshape(template.weights.shape)
    return replace(template, weights=weights, bias=float(np.float32(vector[-1])))


def _solve(
    positives: NDArray[np.float32],
    negatives: NDArray[np.float32],
    C: float,
    vehicles: float,
    start: Floats,
    steps: int,
) -> Floats:
    """Weights and bias of a linear SVM with squared hinge loss, in the primal (Chapelle, 2007)."""
    from scipy.optimize import minimize

    sides = (positives, 1.0, vehicles / len(positives)), (negatives, -1.0, 1.0)

    def loss(vector: Floats) -> tuple[float, Floats]:
        weights, bias = vector[:-1].astype(np.float32), vector[-1]
        gradient = np.append(vector[:-1], 0.0)
        value = 0.5 * float(vector[:-1] @ vector[:-1])
        for rows, sign, weight in sides:
            margin = np.maximum(1 - sign * ((rows @ weights).astype(np.float64) + bias), 0)
            value += C * weight * float(margin @ margin)
            pull = (-2 * C * weight * sign * margin).astype(np.float32)
            gradient[:-1] += pull @ rows
            gradient[-1] += float(pull.sum())
        return value, gradient

    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": steps})
    return np.asarray(found.x, np.float64)


def _fit_box_regressor(
    frames: Sequence[Frame],
    rng: np.random.Generator,
    params: MixtureParams,
    pool: ThreadPoolExecutor,
    search: MixtureSearch | None = None,
) -> BoxRegressor:
    """Learn how boxes that a search finds, and others moved at random, differ from the true ones.

    By ridge regression; without a search, from the moved ones alone.
    """
    from sklearn.linear_model import Ridge

    seeds = rng.integers(2**32, size=len(frames)).tolist()

    def pairs(frame: Frame, seed: int) -> tuple[NDArray[np.float32], Floats]:
        if not len(frame.boxes):
            return np.empty((0, N_REGRESSION_FEATURES), np.float32), np.empty((0, 4))
        found = np.empty((0, 4))
        if search is not None:
            found = vote_boxes(search.score_windows(frame.image, params.search), min_margin=-1.0)[0].boxes
        overlap = iou_matrix(found, frame.boxes)
        near = overlap.max(axis=1) >= 0.4
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
        copies = np.tile(wide, (params.jitter, 1))
        boxes = np.concatenate([found[near], jitter_boxes(copies, np.random.default_rng(seed))])
        true = np.concatenate([frame.boxes[overlap.argmax(axis=1)[near]], copies])
        shifts = (true - boxes) / np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        width = frame.image.shape[1]
        flipped, back = mirror_boxes(boxes, width), mirror_boxes(shifts, 0)
        features = np.concatenate(
            [regression_features(frame.image, boxes), regression_features(mirrored, flipped)]
        )
        return features, np.concatenate([shifts, back])

    found = list(pool.map(pairs, frames, seeds))
    features, shifts = (np.concatenate(side) for side in zip(*found))
    if not len(features):
        return BoxRegressor.none()
    fitted = Ridge(alpha=30.0).fit(features.astype(np.float64), np.clip(shifts, -0.5, 0.5))
    weights, bias = fitted.coef_.T.astype(np.float32), fitted.intercept_.astype(np.float32)
    return BoxRegressor(weights, bias, params.n_iterations)
