"""Linear SVMs without a copy of the features: a dual solver, and the loss for primal ones."""

from __future__ import annotations

import functools
import logging
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection._kernels.jit import jit

# Rows per chunk when computing means and standard deviations.
_CHUNK = 1024
# As in liblinear: maximum difference of two projected gradients, and maximum number of sweeps.
_TOLERANCE, _MAX_SWEEPS = 0.002, 300

_LOGGER = logging.getLogger(__name__)


class LinearSVM(NamedTuple):
    """``score = (x - mean) / scale @ coef + intercept``; the arrays are ``(length,)`` float64."""

    mean: Floats
    scale: Floats
    coef: Floats
    intercept: float


def fit_svm(
    features: NDArray[np.float32],
    labels: NDArray[np.int64],
    costs: Floats,
    *,
    rows: NDArray[np.intp] | None = None,
    gains: Floats | float = 1.0,
    random_state: int = 0,
) -> LinearSVM:
    """Fit a scaler and a linear SVM with squared hinge loss; the same input and seed give the same result.

    `features` is ``(N, length)`` float32 and neither changed nor copied, `labels` ``(N,)`` zeros and ones,
    `costs` ``(N,)`` the `C` of ``LinearSVC`` times the weight of each row, `rows` the rows to fit (default:
    all), and `gains` the factor of each scaled feature. Hsieh et al., "A dual coordinate descent method for
    large-scale linear SVM" (ICML 2008), with shrinking: the solver of ``LinearSVC(dual=True)``, which
    regularizes the intercept too. Rows are standardized as they are read.
    """
    chosen = np.arange(len(features)) if rows is None else rows
    mean, scale = _moments(features, chosen)
    scale /= gains
    center, squares = mean.astype(np.float32), (scale**-2).astype(np.float32)
    weights = np.zeros(features.shape[1], np.float32)
    problem = features, chosen, 2.0 * labels[chosen] - 1, 0.5 / costs[chosen]
    rng = np.random.default_rng(random_state)
    intercept, sweeps = _descend(*problem, center, squares, weights, _TOLERANCE, _MAX_SWEEPS, rng)
    if sweeps == _MAX_SWEEPS:
        _LOGGER.warning("the SVM has not converged after %d sweeps; use a smaller C", sweeps)
    coef = weights * scale
    # The solver used the mean rounded to float32.
    return LinearSVM(mean, scale, coef, float(intercept + coef / scale @ (mean - center)))


def _moments(features: NDArray[np.float32], rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Mean and standard deviation of each column; the deviation of a constant column is 1."""
    chunks = [rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK)]
    mean, squares = np.zeros(features.shape[1]), np.zeros(features.shape[1])
    for chunk in chunks:
        mean += features[chunk].sum(axis=0, dtype=np.float64)
    mean /= len(rows)
    center = mean.astype(np.float32)
    for chunk in chunks:
        centered = features[chunk] - center
        squares += np.einsum("ij,ij->j", centered, centered)
    deviation: Floats = np.sqrt(squares / len(rows))
    # The deviation of a constant column is the rounding error of its mean.
    deviation[deviation <= 1e-6 * np.maximum(np.abs(mean), 1)] = 1.0
    return mean, deviation


# Inlined: a function would be compiled on its own and within `_descend`, with different roundings, and which
# of the two runs would depend on the cache of kernels.
@register_jitable(inline="always")
def _score(row, center, weights):
    total = np.float32(0)
    for index in range(row.shape[0]):
        total += (row[index] - center[index]) * weights[index]
    return total


@register_jitable(inline="always")
def _squared_norm(row, center, squares):
    """Squared norm of the standardized row."""
    total = np.float32(0)
    for index in range(row.shape[0]):
        difference = row[index] - center[index]
        total += difference * difference * squares[index]
    return total


@register_jitable(inline="always")
def _add(step, row, center, squares, weights):
    for index in range(row.shape[0]):
        weights[index] += step * ((row[index] - center[index]) * squares[index])


@functools.partial(jit, reorder=True)
def _descend(features, rows, signs, ridge, center, squares, weights, tolerance, max_sweeps, rng):
    """Solve the dual problem: update `weights`, those of centered rows, in place.

    Returns the intercept, and the number of sweeps, which is `max_sweeps` if it has not converged.

    With the score ``f = x @ w + b``, the primal problem is the minimum of ``(|w|^2 + b^2) / 2`` plus the sum
    of ``C_i max(0, 1 - y_i f_i)^2`` over the rows. Its dual has a multiplier ``a_i >= 0`` for each row, with
    ``w = sum(a_i y_i x_i)`` and ``b = sum(a_i y_i)``. Its derivative by ``a_i`` is
    ``y_i f_i - 1 + ridge_i a_i`` with ``ridge_i = 1 / (2 C_i)``, and its second derivative
    ``|x_i|^2 + 1 + ridge_i``. A sweep takes one Newton step for each multiplier, in random order.
    """
    count = rows.shape[0]
    curvature = np.empty(count)
    for index in range(count):
        curvature[index] = _squared_norm(features[rows[index]], center, squares) + 1.0 + ridge[index]
    multipliers = np.zeros(count)
    intercept = 0.0
    order, active = np.arange(count), count
    bound = np.inf
    for sweep in range(max_sweeps):
        highest, lowest = -np.inf, np.inf
        for position in range(active - 1):  # shuffle the active rows
            other = position + int(rng.random() * (active - position))
            order[position], order[other] = order[other], order[position]
        position = 0
        while position < active:
            index = order[position]
            row = features[rows[index]]
            score = _score(row, center, weights) + intercept
            slope = signs[index] * score - 1.0 + ridge[index] * multipliers[index]
            # At the bound 0, only a negative slope can improve.
            if multipliers[index] == 0.0:
                if slope > bound:
                    # Shrinking: skip this row until the others have converged.
                    active -= 1
                    order[position], order[active] = order[active], order[position]
                    continue
                slope = min(slope, 0.0)
            highest, lowest = max(highest, slope), min(lowest, slope)
            if abs(slope) > 1e-12:
                before = multipliers[index]
                multipliers[index] = max(before - slope / curvature[index], 0.0)
                step = (multipliers[index] - before) * signs[index]
                _add(np.float32(step), row, center, squares, weights)
                intercept += step
            position += 1
        if highest - lowest <= tolerance:
            if active == count:
                return intercept, sweep
            # The active rows have converged: check the skipped ones as well.
            active, bound = count, np.inf
        else:
            bound = highest if highest > 0 else np.inf
    return intercept, max_sweeps
