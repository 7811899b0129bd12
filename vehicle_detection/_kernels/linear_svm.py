"""A linear SVM of standardised features, without a copy of them: dual coordinate descent."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels.jit import jit

Floats = NDArray[np.float64]

# Rows that are looked at in one piece for their mean and spread.
_CHUNK = 1024
# As liblinear's: the largest difference of two projected gradients, and the most sweeps.
_TOLERANCE, _MOST_SWEEPS = 0.002, 300


class LinearSVM(NamedTuple):
    """``score = (x - mean) / scale @ coef + intercept``, each ``(length,)`` float64 but for the last."""

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
    """Fit a scaler and a linear SVM with squared hinge loss on some rows.

    Parameters
    ----------
    features
        ``(N, length)`` float32; neither changed nor copied.
    labels
        ``(N,)`` zeros and ones.
    costs
        ``(N,)`` positive: what an error of each row costs, the `C` of ``LinearSVC`` times its weight.
    rows
        Rows to fit, each once; all if None. The others are not looked at.
    gains
        Factor of each scaled feature.
    random_state
        Seed of the order in which rows are visited.

    Returns
    -------
    LinearSVM
        The same for the same input and seed. The intercept is regularised as ``LinearSVC``'s is.

    Notes
    -----
    Hsieh et al., "A dual coordinate descent method for large-scale linear SVM" (ICML 2008), with its
    shrinking: the solver of ``LinearSVC(dual=True)``. Rows are centerd and scaled as they are read.
    """
    chosen = np.arange(len(features)) if rows is None else rows
    mean, scale = _moments(features, chosen)
    scale /= gains
    center, squares = mean.astype(np.float32), (scale**-2).astype(np.float32)
    weights = np.zeros(features.shape[1], np.float32)
    intercept = _descend(
        features,
        chosen,
        2.0 * labels[chosen] - 1,
        0.5 / costs[chosen],
        center,
        squares,
        weights,
        _TOLERANCE,
        _MOST_SWEEPS,
        np.random.default_rng(random_state),
    )
    coef = weights * scale
    # The center that the solver saw is the mean rounded to float32.
    return LinearSVM(mean, scale, coef, float(intercept + coef / scale @ (mean - center)))


def _moments(features: NDArray[np.float32], rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Mean and standard deviation of each column, which is 1 where a column is constant."""
    pieces = [rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK)]
    mean, squares = np.zeros(features.shape[1]), np.zeros(features.shape[1])
    for piece in pieces:
        mean += features[piece].sum(axis=0, dtype=np.float64)
    mean /= len(rows)
    center = mean.astype(np.float32)
    for piece in pieces:
        centerd = features[piece] - center
        squares += np.einsum("ij,ij->j", centerd, centerd)
    deviation: Floats = np.sqrt(squares / len(rows))
    # What a constant column has is the rounding of its mean.
    deviation[deviation <= 1e-6 * np.maximum(np.abs(mean), 1)] = 1.0
    return mean, deviation


_reordered = functools.partial(jit, reorder=True)


@_reordered
def _score(row, center, weights):
    total = np.float32(0)
    for index in range(row.shape[0]):
        total += (row[index] - center[index]) * weights[index]
    return total


@_reordered
def _length(row, center, squares):
    """Squared length of a row that is centerd and scaled."""
    total = np.float32(0)
    for index in range(row.shape[0]):
        apart = row[index] - center[index]
        total += apart * apart * squares[index]
    return total


@_reordered
def _add(step, row, center, squares, weights):
    for index in range(row.shape[0]):
        weights[index] += step * ((row[index] - center[index]) * squares[index])


@jit
def _descend(features, rows, signs, ridge, center, squares, weights, tolerance, most, rng):
    """Solve the dual; change `weights`, those of centerd rows, in place, and return the intercept."""
    count = rows.shape[0]
    curvature = np.empty(count)
    for index in range(count):
        curvature[index] = _length(features[rows[index]], center, squares) + 1.0 + ridge[index]
    multipliers = np.zeros(count)
    intercept = 0.0
    order, active = np.arange(count), count
    bound = np.inf
    for _ in range(most):
        highest, lowest = -np.inf, np.inf
        for place in range(active - 1):
            other = place + int(rng.random() * (active - place))
            order[place], order[other] = order[other], order[place]
        place = 0
        while place < active:
            index = order[place]
            row = features[rows[index]]
            score = _score(row, center, weights) + intercept
            slope = signs[index] * score - 1.0 + ridge[index] * multipliers[index]
            if multipliers[index] == 0.0:
                if slope > bound:
                    # Right by far: left alone until the others are done.
                    active -= 1
                    order[place], order[active] = order[active], order[place]
                    continue
                slope = min(slope, 0.0)
            highest, lowest = max(highest, slope), min(lowest, slope)
            if abs(slope) > 1e-12:
                before = multipliers[index]
                multipliers[index] = max(before - slope / curvature[index], 0.0)
                step = (multipliers[index] - before) * signs[index]
                _add(np.float32(step), row, center, squares, weights)
                intercept += step
            place += 1
        if highest - lowest <= tolerance:
            if active == count:
                break
            active, bound = count, np.inf
        else:
            bound = highest if highest > 0 else np.inf
    return intercept
