"""Scores of detections: their scales, and the sigmoid that turns them into probabilities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection._common import Floats, check_array, check_choice, check_number, describe, store_number
from vehicle_detection.errors import InvalidInputError

ScoreScale = Literal["probability", "logit"] | tuple[float, float]
"""What the scores of another detector are: see `log_odds`."""

CERTAIN_SCORE = 3.0
"""Log-odds of a certain detection: 95%."""


def log_odds(scores: ArrayLike, score: ScoreScale, threshold: float | None = None) -> Floats:
    """Convert the scores of another detector to log-odds above its threshold, ``(N,)`` float64.

    Probabilities become ``log(p / (1 - p))`` minus that of the threshold, 0.5 by default; log-odds are
    reduced by the threshold, 0 by default; ``(low, high)`` maps low to 0 and high to `CERTAIN_SCORE`.
    """
    values = score_column(scores)
    if isinstance(score, tuple):
        low, high = score
        return (values - low) / (high - low) * CERTAIN_SCORE
    if score == "logit":
        return values - (0.0 if threshold is None else threshold)
    if values.size and (values.min() < 0 or values.max() > 1):
        raise InvalidInputError(
            f'scores must be 0 to 1 with score="probability", got {values.min():g} to {values.max():g}; pass '
            'score="logit" for log-odds, or score=(low, high)'
        )
    limit = 0.5 if threshold is None else threshold
    # Probabilities of exactly 0 and 1 have no finite log-odds.
    p = values.clip(1e-3, 1 - 1e-3)
    return np.asarray(np.log(p / (1 - p)) - logit(limit))


def logit(probability: float) -> float:
    """Return the log-odds of a probability in (0, 1)."""
    return math.log(probability / (1 - probability))


@dataclass(frozen=True)
class Platt:
    """The sigmoid that turns scores into probabilities, as `calibrate_scores` fits it.

    Attributes
    ----------
    a, b
        Of ``1 / (1 + exp(a * score + b))``; `a` is negative where higher scores are vehicles.

    Raises
    ------
    InvalidInputError
        If a number is not finite.

    Examples
    --------
    >>> platt = Platt(-2.0, 1.0)
    >>> platt.probability([0.0, 2.0]).round(2), platt.score(0.5)
    (array([0.27, 0.95]), 0.5)
    """

    a: float
    b: float

    def __post_init__(self) -> None:
        store_number(self, "a")
        store_number(self, "b")

    def probability(self, scores: ArrayLike) -> Floats:
        """Probability of a vehicle for each score, float64 in [0, 1], of the same shape."""
        values = check_array(scores, "scores")
        if values.dtype.kind not in "iuf" or np.isnan(values).any():
            raise InvalidInputError(f"scores must be numbers without NaN; got {describe(scores)}")
        exponent = np.asarray(self.a * values.astype(np.float64) + self.b)
        # Both branches avoid the overflow of exp, and keep small probabilities exact.
        small = np.exp(-np.abs(exponent))
        return np.asarray(np.where(exponent > 0, small, 1.0) / (1 + small))

    def score(self, probability: float) -> float:
        """Return the score that has this probability, in (0, 1), for use as a threshold."""
        value = check_number(probability, "probability", above=0)
        if value >= 1 or self.a == 0:
            raise InvalidInputError(
                f"probability must lie in (0, 1) and a must not be 0; got {value:g} and a={self.a:g}"
            )
        return (-logit(value) - self.b) / self.a


def check_score_scale(score: object, threshold: float | None) -> ScoreScale:
    """Return the scale of `log_odds` if it and the threshold are valid."""
    if isinstance(score, (tuple, list)) and len(score) == 2:
        low = check_number(score[0], "score[0]")
        if threshold is not None:
            raise InvalidInputError(
                f"threshold must be omitted with score=(low, high): low is the threshold; got {threshold}"
            )
        return low, check_number(score[1], "score[1]", above=low)
    check_choice(score, "score", ("probability", "logit"))
    if threshold is not None and score == "probability":
        check_number(threshold, "threshold", above=0, high=0.999)
    elif threshold is not None:
        check_number(threshold, "threshold")
    return score  # type: ignore[return-value]


def score_column(scores: ArrayLike, name: str = "scores") -> Floats:
    """Return finite scores as ``(N,)`` float64."""
    array = check_array(scores, name)
    if array.size == 0:
        return np.empty(0)
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise InvalidInputError(f"{name} must be one number for each box, got {describe(scores)}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name} must be finite, got NaN or infinity; drop those rows")
    return array.astype(np.float64)
