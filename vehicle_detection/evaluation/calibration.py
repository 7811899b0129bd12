"""Turn scores into probabilities with Platt's sigmoid, and measure their calibration error."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.boxes import Platt as Platt  # its result
from vehicle_detection.datasets import check_labels
from vehicle_detection.errors import InvalidInputError


def calibrate_scores(
    scores: ArrayLike, labels: ArrayLike, *, prior: bool = True, weights: ArrayLike | None = None
) -> Platt:
    """Fit the sigmoid that turns scores into probabilities, and back.

    Platt, "Probabilistic outputs for support vector machines" (1999); with the prior the sigmoid equals that
    of scikit-learn's ``CalibratedClassifierCV``.

    Parameters
    ----------
    scores, labels
        ``(N,)`` scores of samples that the model was not trained on; and the truth, 0 or 1 or bool, both
        present.
    prior
        Smooth the labels with Platt's prior on both classes. False fits plain logistic regression, whose
        slope has no useful limit if the scores separate the classes.
    weights
        ``(N,)`` positive weights of the samples in the fit, for example to give several data sets of
        different sizes the same influence. None: all the same.

    Examples
    --------
    >>> platt = calibrate_scores([-2.0, -1.0, 0.5, -0.5, 1.0, 2.0], [0, 0, 0, 1, 1, 1])
    >>> bool(platt.probability(1.5) > 0.5 > platt.probability(-1.5))
    True
    """
    check.boolean(prior, "prior")
    values = check.array(scores, "scores")
    if values.ndim != 1 or not values.size or values.dtype.kind not in "iuf":
        raise invalid("scores", "be a one-dimensional array of numbers", values)
    if not np.isfinite(values).all():
        raise InvalidInputError("scores must be finite, got NaN or infinity; drop those rows")
    truth = check_labels(labels, count=len(values), of="scores", both=True).astype(np.int64)
    sample_weight = _check_weights(weights, len(values))
    from sklearn.linear_model import LogisticRegression

    values = values.astype(np.float64)
    # The solver needs values of usual size; it does not converge for scores far from 0.
    center, scale = float(values.mean()), float(values.std()) or 1.0
    values = (values - center) / scale
    samples, classes, regression = values, truth, LogisticRegression(C=1e6, tol=1e-8)
    if prior:
        # Each sample is split between both classes.
        negatives, positives = np.bincount(truth, weights=sample_weight)
        target = np.where(truth == 1, (positives + 1) / (positives + 2), 1 / (negatives + 2))
        samples, classes = np.tile(values, 2), np.repeat([1, 0], len(values))
        sample_weight = np.concatenate([target, 1 - target]) * np.tile(sample_weight, 2)
        regression = LogisticRegression(C=np.inf, tol=1e-8, max_iter=1000)
    regression.fit(samples[:, None], classes, sample_weight=sample_weight)
    slope = -float(regression.coef_[0, 0]) / scale
    return Platt(slope, -float(regression.intercept_[0]) - slope * center)


def _check_weights(weights: ArrayLike | None, count: int) -> NDArray[np.float64]:
    """Weights with a mean of 1."""
    if weights is None:
        return np.ones(count)
    values = check.array(weights, "weights")
    if values.shape != (count,) or values.dtype.kind not in "iuf":
        raise invalid("weights", f"be one number for each of the {count} scores", values)
    if not (np.isfinite(values).all() and (values > 0).all()):
        raise InvalidInputError("weights must be positive and finite; drop the samples that are not to count")
    return np.asarray(values / values.mean(), np.float64)


def calibration_error(probabilities: ArrayLike, labels: ArrayLike, *, bins: int = 15) -> float:
    """Measure the expected calibration error (ECE): probabilities against the observed fraction of vehicles.

    The sum over `bins` equal bins of ``|mean label - mean probability|``, weighted by the bin's fraction of
    the samples (Naeini et al., "Obtaining well calibrated probabilities using Bayesian binning", 2015).
    It is in [0, 1]; 0 is perfect. The labels are 0 or 1 or bool.

    >>> round(calibration_error([0.9, 0.9, 0.1, 0.1], [1, 1, 0, 1]), 3)
    0.25
    """
    values = check.array(probabilities, "probabilities")
    inside = values.dtype.kind in "iuf" and bool(((values >= 0) & (values <= 1)).all())
    if values.ndim != 1 or not values.size or not inside:
        remedy = "convert scores with calibrate_scores(...).probability"
        raise invalid("probabilities", "be a one-dimensional array of numbers from 0 to 1", values, remedy)
    truth = check_labels(labels, count=len(values), of="probabilities")
    count = check.integer(bins, "bins", low=1, high=10**6)
    values = values.astype(np.float64)
    chosen = np.minimum((values * count).astype(np.intp), count - 1)
    gaps = np.bincount(chosen, weights=truth.astype(np.float64) - values, minlength=count)
    return float(np.abs(gaps).sum() / len(values))
