"""Train a mixture of templates on labelled frames, with hard negatives mined from the same frames."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from vehicle_detection._common import Floats, check_image, check_integer, check_type, resolve_jobs
from vehicle_detection._kernels import hinge_loss
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import (
    N_CHANNELS,
    MixtureTemplate,
    TemplateMixture,
)
from vehicle_detection.mixture_training.negatives import (
    NegativePool,
    mine_windows,
    random_windows,
    with_mirrored,
)
from vehicle_detection.mixture_training.patches import fit_box_regressor, patch_features
from vehicle_detection.mixture_training.positives import (
    align_mirrored,
    truncated_vehicles,
    vehicle_features,
    whole_vehicles,
)
from vehicle_detection.mixture_training.rescoring import train_rescorer
from vehicle_detection.mixture_training.sources import (
    TrainingFrame,
    load_training_frames,
)
from vehicle_detection.params import MixtureParams
from vehicle_detection.training import FrameDataset, check_sources

Image = NDArray[np.uint8]
Rows = NDArray[np.float32]
Templates = list[MixtureTemplate]
log = logging.getLogger(__name__)

# Maximum number of solver iterations in mining rounds and at the end.
_MINING_ITERATIONS, _FINAL_ITERATIONS = 50, 200


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

    Linear SVMs on vehicles and on windows without one: random windows at first, then hard negatives of the
    current templates (Felzenszwalb et al., PAMI 2010, section 5). Their detections in the training frames
    then train the box regressor and the rescorer.

    Parameters
    ----------
    sources, params
        Labelled frames; and the shapes of the templates and how they are trained.
    patches
        Additional vehicles: ``(H, W, 3)`` uint8 RGB images of any size, each mostly filled by one vehicle,
        such as the course's patches. A box regressor locates the vehicle on its patch.
    random_state, n_jobs
        Seed of the jitter and of the first negatives; threads, on which the model does not depend.
    on_step
        Called with one line of text for each step. None: the lines are logged.

    Returns
    -------
    TemplateMixture
        Uncalibrated: its scores are SVM margins. `cross_validate_mixture` returns a calibrated one.

    Raises
    ------
    InvalidInputError
        If there is no source, no labelled vehicle that is wide enough, a box lies outside its image, or a
        patch is not an image.
    """
    check_sources(sources)
    params = params if params is not None else MixtureParams()
    check_type(params, "params", MixtureParams, "omit it for the defaults")
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    check_type(patches, "patches", (list, tuple, np.ndarray), "pass a list of images")
    for image in patches:
        check_image(image, "patches")
    # Threads of the linear algebra library would compete with those of the pool.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool:
        rng, frames = np.random.default_rng(random_state), load_training_frames(sources)
        return _Training(frames, params, rng, pool, on_step or log.info).run(patches)


@dataclass(frozen=True, eq=False)
class _Training:
    """The steps of a training, and what they share."""

    frames: Sequence[TrainingFrame]
    params: MixtureParams
    rng: np.random.Generator
    pool: ThreadPoolExecutor
    report: Callable[[str], object]

    def run(self, patches: Sequence[Image]) -> TemplateMixture:
        """Train the templates, then the rescorer on what they find."""
        params, rng = self.params, self.rng
        inner = [_blank(shape, params.padding) for shape in params.shapes]
        border = [_blank(shape, params.padding, border=True) for shape in params.border_shapes]
        whole = vehicle_features(whole_vehicles(self.frames, params, rng), inner, params)
        truncated = vehicle_features(truncated_vehicles(self.frames, params, rng), border, params)
        shown, shown_border = (np.flatnonzero([len(rows) for rows in each]) for each in (whole, truncated))
        if len(shown) + len(shown_border) < len(whole) + len(truncated):
            self.report_absent_shapes(shown.tolist(), shown_border.tolist())
            return replace(self, params=_with_shapes(params, shown.tolist(), shown_border.tolist())).run(
                patches
            )
        positives = self.with_patches(patches, inner, whole) + truncated
        self.report(f"vehicles per template: {', '.join(str(len(rows)) for rows in positives)}")
        mixture = TemplateMixture(
            tuple(self.train_templates([*inner, *border], positives)),
            size_prior_weight=params.size_prior_weight,
            vote_weight=params.vote_weight,
            count_weight=params.count_weight,
            perspective_weight=params.perspective_weight,
        )
        if params.blend_weight:
            self.report("templates trained; train the rescorer")
            with mixture.open_search(n_jobs=1) as search:
                rescorer = train_rescorer(self.frames, search, params, self.rng, self.pool)
            mixture = replace(mixture, rescorer=rescorer)
        return mixture

    def report_absent_shapes(self, shown: list[int], shown_border: list[int]) -> None:
        """Report the shapes that no labelled vehicle has; raise if no shape of whole vehicles is left."""
        params = self.params
        if not shown:
            raise InvalidInputError(
                f"sources must hold labelled vehicles that are whole and at least {params.min_width:g} "
                "pixels wide, got none; label more"
            )
        absent = [f"{w:g}x{h:g}" for n, (w, h) in enumerate(params.shapes) if n not in shown]
        absent += [
            f"{w:g}x{h:g} at the border"
            for n, (w, h) in enumerate(params.border_shapes)
            if n not in shown_border
        ]
        self.report(f"no labelled vehicle has the proportions {', '.join(absent)}: left out these templates")

    def with_patches(self, patches: Sequence[Image], inner: Templates, whole: list[Rows]) -> list[Rows]:
        """Features of whole vehicles with those on patches; mirrored templates show one side only."""
        params, rng = self.params, self.rng
        if len(patches):
            more = patch_features(
                patches, fit_box_regressor(self.frames, params, rng, self.pool), inner, whole, params
            )
            whole = [np.concatenate(both) for both in zip(whole, more)]
        for index in np.flatnonzero(params.mirrored).tolist():
            whole[index] = align_mirrored(whole[index], rng)
        return whole

    def train_templates(self, templates: Templates, positives: Sequence[Rows]) -> Templates:
        """Train the templates, mining hard negatives in rounds; mirrored templates are added at the end."""
        params, frames = self.params, self.frames
        mirrored = params.mirrored + (False,) * len(params.border_shapes)
        negatives = NegativePool([rows.shape[1] for rows in positives])

        def solve(
            templates: Templates, vectors: list[Floats], iterations: int
        ) -> tuple[Templates, list[Floats]]:
            def fit(template: MixtureTemplate, start: Floats, rows: Rows, others: Rows) -> Floats:
                C = params.border_C if template.border else params.C
                return _fit_svm(rows, others, C, params.positive_weight, start=start, iterations=iterations)

            vectors = list(self.pool.map(fit, templates, vectors, positives, negatives.rows))
            return [_with_vector(each, vector) for each, vector in zip(templates, vectors)], vectors

        seeds = self.rng.integers(2**32, size=len(frames)).tolist()
        draw = partial(random_windows, views=with_mirrored(templates, mirrored), params=params)
        negatives.add(enumerate(self.pool.map(draw, frames, seeds)))
        vectors = [np.zeros(rows.shape[1] + 1) for rows in positives]
        for step, fraction in enumerate(params.mining_schedule, 1):
            templates, vectors = solve(templates, vectors, _MINING_ITERATIONS)
            chosen = self.rng.permutation(len(frames))[: math.ceil(fraction * len(frames))].tolist()
            negatives.trim(templates, params.max_negatives)
            mine = partial(mine_windows, views=with_mirrored(templates, mirrored), params=params)
            new = negatives.add(zip(chosen, self.pool.map(mine, [frames[number] for number in chosen])))
            total = sum(map(len, negatives.rows))
            self.report(f"round {step}: {new} new of {total} negatives")
            if fraction == 1 and new < 0.01 * total:
                break
        templates, _ = solve(templates, vectors, _FINAL_ITERATIONS)
        biased = [replace(each, bias=each.bias + params.border_bias * each.border) for each in templates]
        return [view.template for view in with_mirrored(biased, mirrored)]


def _with_shapes(params: MixtureParams, inner: list[int], border: list[int]) -> MixtureParams:
    """Parameters with some of the shapes."""
    return replace(
        params,
        shapes=tuple(params.shapes[index] for index in inner),
        mirrored=tuple(params.mirrored[index] for index in inner),
        border_shapes=tuple(params.border_shapes[index] for index in border),
    )


def _blank(shape: tuple[float, float], padding: float, *, border: bool = False) -> MixtureTemplate:
    """Template with zero weights whose box has a shape of ``(columns, rows)`` cells."""
    sides = 1 if border else 2
    columns, rows = round(shape[0] + padding * sides), round(shape[1] + 2 * padding)
    weights = np.zeros((rows, columns, N_CHANNELS), np.float32)
    return MixtureTemplate(weights, 0.0, ((columns - shape[0]) / sides, (rows - shape[1]) / 2), border)


def _with_vector(template: MixtureTemplate, vector: Floats) -> MixtureTemplate:
    """Template with the weights and the bias of a solution."""
    weights = vector[:-1].astype(np.float32).reshape(template.weights.shape)
    return replace(template, weights=weights, bias=float(np.float32(vector[-1])))


def _fit_svm(
    positives: Rows, negatives: Rows, C: float, positive_weight: float, *, start: Floats, iterations: int
) -> Floats:
    """Weights and bias of a linear SVM with squared hinge loss, in the primal (Chapelle, 2007)."""
    from scipy.optimize import minimize

    classes = (positives, 1.0, positive_weight / len(positives)), (negatives, -1.0, 1.0)

    def loss(vector: Floats) -> tuple[float, Floats]:
        weights, bias = vector[:-1].astype(np.float32), float(vector[-1])
        value, gradient = 0.5 * float(vector[:-1] @ vector[:-1]), np.append(vector[:-1], 0.0)
        for rows, sign, weight in classes:
            slope = np.zeros_like(vector)
            value += C * weight * hinge_loss(rows, weights, bias, sign, slope)
            gradient += C * weight * slope
        return value, gradient

    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    return np.asarray(found.x, np.float64)
