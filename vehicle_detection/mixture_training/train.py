"""Train the templates of a mixture on labelled frames, with hard negatives mined from the same frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_image,
    check_integer,
    check_number,
    check_type,
    describe,
    resolve_jobs,
)
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import (
    CROP_LENGTH,
    PLANES,
    MixtureSearch,
    MixtureTemplate,
    Refinement,
    TemplateMixture,
    crop_features,
    suppress,
)
from vehicle_detection.mixture_training.negatives import (
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
from vehicle_detection.mixture_training.positives import (
    cut_vehicles,
    mirror_boxes,
    moved_boxes,
    patch_features,
    turned,
    vehicle_features,
    whole_vehicles,
)
from vehicle_detection.mixture_training.rescoring import train_verification
from vehicle_detection.params import PyramidParams


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
    border_shapes
        Columns and rows of cells that the visible part of a vehicle fills which the left or right border of
        the frame cuts, for each template of such parts; () for none.
    cuts
        Shares of a frame's width at which it is taken to end, at the right and at the left: windows that end
        there are negatives of the templates at the border, beside those at the border itself.
    border_bias
        Added to the values of the templates at the border: less of a vehicle is seen there, so that it must
        be the clearer.
    near_gain, support_gain
        As in `TemplateMixture`.
    looks
        How often a box is corrected at most, as in `Refinement`.
    verification
        Share that the second opinion has in a vehicle's value, as in `Verification`; 0 for none.
    margin
        Cells of context on every side.
    C, border_C
        Inverse strength of the regularisation, as in ``LinearSVC``, of the templates of whole vehicles and of
        those at the border.
    vehicles
        Weight of all vehicles of a template together; a negative weighs 1.
    least_width
        Width in pixels of the narrowest box that is trained on.
    near
        A box trains every template whose logarithmic aspect ratio is this near, and the nearest.
    jitter
        Copies of each box, of which all but the first are moved by up to ``shake`` of its sides.
    border_jitter
        The same for each vehicle that a border cuts: they are few, and seen from another side than those that
        are cut on purpose.
    exposures
        Further copies of each box of a whole vehicle, each in a frame of another exposure and contrast.
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
    border_shapes: tuple[tuple[float, float], ...] = ((4, 7), (6, 6), (9, 5))
    cuts: tuple[float, ...] = (0.3, 0.5, 0.7)
    border_bias: float = -0.3
    near_gain: float = 0.03
    support_gain: float = 0.1
    looks: int = 2
    verification: float = 0.4
    margin: float = 1.0
    C: float = 2e-3
    border_C: float = 4e-3  # noqa: N815 - as C
    vehicles: float = 1500.0
    least_width: float = 28.0
    near: float = 0.2
    jitter: int = 2
    border_jitter: int = 8
    shake: float = 0.03
    exposures: int = 1
    rounds: tuple[float, ...] = (0.15, 0.3, 0.6, 1.0)
    per_frame: int = 30
    most_negatives: int = 12_000
    search: PyramidParams = PyramidParams(least_width=24.0, horizon=None)  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        shapes, facing = _shapes(self.shapes, "shapes"), entries(self.facing, "facing")
        border_shapes = _shapes(self.border_shapes, "border_shapes", least=0)
        cuts = entries(self.cuts, "cuts", least=0)
        for share in cuts:
            check_number(share, "cuts", above=0, high=1)
        if len(facing) != len(shapes) or not all(isinstance(each, (bool, np.bool_)) for each in facing):
            raise InvalidInputError(
                f"facing must be True or False for each of {len(shapes)} shapes; got {describe(facing)}"
            )
        check_number(self.border_bias, "border_bias")
        check_number(self.near_gain, "near_gain", low=0)
        check_number(self.support_gain, "support_gain", low=0)
        check_integer(self.looks, "looks", low=1, high=10)
        check_number(self.verification, "verification", low=0, high=1)
        check_number(self.margin, "margin", low=0, high=8)
        check_number(self.C, "C", above=0, high=1e6)
        check_number(self.border_C, "border_C", above=0, high=1e6)
        check_number(self.vehicles, "vehicles", above=0, high=1e9)
        check_number(self.least_width, "least_width", low=8, high=10_000)
        check_number(self.near, "near", low=0, high=10)
        check_integer(self.jitter, "jitter", low=1, high=100)
        check_integer(self.border_jitter, "border_jitter", low=1, high=100)
        check_number(self.shake, "shake", low=0, high=0.25)
        check_integer(self.exposures, "exposures", low=0, high=100)
        rounds = entries(self.rounds, "rounds")
        for share in rounds:
            check_number(share, "rounds", above=0, high=1)
        check_integer(self.per_frame, "per_frame", low=1)
        check_integer(self.most_negatives, "most_negatives", low=1)
        check_type(self.search, "search", PyramidParams, "it tells where negatives are looked for")
        held = {"shapes": shapes, "border_shapes": border_shapes, "facing": facing, "cuts": cuts}
        for name, values in (held | {"rounds": rounds}).items():
            object.__setattr__(self, name, values)


def entries(values: object, name: str, *, least: int = 1) -> tuple[Any, ...]:
    """Return the values of a tuple or list of `least` or more."""
    if not isinstance(values, (tuple, list)) or len(values) < least:
        count = " of at least one entry" if least else ""
        raise InvalidInputError(f"{name} must be a tuple{count}; got {describe(values)}")
    return tuple(values)


def _shapes(values: object, name: str, *, least: int = 1) -> tuple[tuple[float, float], ...]:
    shapes = entries(values, name, least=least)
    for shape in shapes:
        if not isinstance(shape, (tuple, list)) or len(shape) != 2:
            raise InvalidInputError(
                f"{name} must be (columns, rows) of cells each, such as ((7, 6),); got {describe(shape)}"
            )
        for cells in shape:
            check_number(cells, name, low=2, high=64)
    return tuple((columns, rows) for columns, rows in shapes)


__all__ = ["FrameSource", "MixtureParams", "train_mixture"]

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
log = logging.getLogger(__name__)

# Steps of the solver while negatives are still looked for, and in the end.
_FEW_STEPS, _MANY_STEPS = 50, 200


def train_mixture(
    sources: Sequence[FrameSource],
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
        Uncalibrated: its scores are the templates' values. See `judge_mixture`.

    Raises
    ------
    InvalidInputError
        If there is no source, no vehicle for one of the templates, or a patch is no image.

    Notes
    -----
    Linear SVMs on the vehicles and on windows without one, at random at first and then those that the
    templates so far wrongly like best: Felzenszwalb et al. (PAMI 2010), section 5. What they find then is
    corrected, and trains a second opinion (`Verification`).
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
            found, Refinement.none(), near_gain=params.near_gain, support_gain=params.support_gain
        )
        search = MixtureSearch(plain, n_jobs=1)
        refined = replace(plain, refinement=_fit_refinement(frames, rng, params, pool, search))
        search.close()
        search = MixtureSearch(refined, n_jobs=1)
        verification = train_verification(frames, search, params, rng, pool) if params.verification else None
        search.close()
    return replace(refined, verification=verification)


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
    cut = vehicle_features(cut_vehicles(frames, params, rng), at_border, params)
    for shape, rows in zip(params.shapes + params.border_shapes, found + cut):
        if not len(rows):
            raise InvalidInputError(
                f"sources must hold vehicles of every shape, got none like {shape[0]:g}x{shape[1]:g} that is "
                f"{params.least_width:g} pixels wide or more; leave that shape out of MixtureParams"
            )
    if len(patches):
        placing = _fit_refinement(frames, rng, params, pool)
        more = patch_features(patches, placing, templates, found, params)
        found = [np.concatenate(both) for both in zip(found, more)]
    for index in np.flatnonzero(params.facing).tolist():
        found[index] = turned(found[index], rng)
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
            C = self._params.border_C if templates[index].border else self._params.C
            return _solve(*rows, C, self._params.vehicles, self._vectors[index], steps)

        self._vectors = list(self._pool.map(solved, range(len(templates))))
        return [_filled(template, vector) for template, vector in zip(templates, self._vectors)]


def _blank(shape: tuple[float, float], margin: float, *, border: bool = False) -> MixtureTemplate:
    columns, rows = round(shape[0] + margin * (1 if border else 2)), round(shape[1] + 2 * margin)
    across = (columns - shape[0]) / (1 if border else 2)
    weights = np.zeros((rows, columns, PLANES), np.float32)
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


def _fit_refinement(
    frames: Sequence[Frame],
    rng: np.random.Generator,
    params: MixtureParams,
    pool: ThreadPoolExecutor,
    search: MixtureSearch | None = None,
) -> Refinement:
    """Learn how boxes that a search finds, and others moved at random, differ from the true ones.

    By ridge regression; without a search, from the moved ones alone.
    """
    from sklearn.linear_model import Ridge

    seeds = rng.integers(2**32, size=len(frames)).tolist()

    def pairs(frame: Frame, seed: int) -> tuple[NDArray[np.float32], Floats]:
        if not len(frame.boxes):
            return np.empty((0, CROP_LENGTH), np.float32), np.empty((0, 4))
        found = np.empty((0, 4))
        if search is not None:
            found = suppress(search.candidates(frame.image, params.search), least=-1.0)[0].boxes
        overlap = iou_matrix(found, frame.boxes)
        near = overlap.max(axis=1) >= 0.4
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.least_width]
        copies = np.tile(wide, (params.jitter, 1))
        boxes = np.concatenate([found[near], moved_boxes(copies, np.random.default_rng(seed))])
        true = np.concatenate([frame.boxes[overlap.argmax(axis=1)[near]], copies])
        shifts = (true - boxes) / np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        width = frame.image.shape[1]
        flipped, back = mirror_boxes(boxes, width), mirror_boxes(shifts, 0)
        features = np.concatenate([crop_features(frame.image, boxes), crop_features(mirrored, flipped)])
        return features, np.concatenate([shifts, back])

    found = list(pool.map(pairs, frames, seeds))
    features, shifts = (np.concatenate(side) for side in zip(*found))
    if not len(features):
        return Refinement.none()
    fitted = Ridge(alpha=30.0).fit(features.astype(np.float64), np.clip(shifts, -0.5, 0.5))
    weights, bias = fitted.coef_.T.astype(np.float32), fitted.intercept_.astype(np.float32)
    return Refinement(weights, bias, params.looks)
