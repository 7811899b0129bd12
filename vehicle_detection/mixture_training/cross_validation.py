"""Cross-validation of a mixture by leaving out one source at a time, and its calibration from the folds."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import check_integer
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.mixture_training.train import train_mixture
from vehicle_detection.params import MixtureParams
from vehicle_detection.training import (
    FoldDetections,
    FoldScore,
    FrameDataset,
    best_threshold,
    check_sources,
    detect_in_source,
    fit_log_odds,
    score_fold,
)

log = logging.getLogger(__name__)

_MIN_MARGIN = -2.0  # of an evaluated box


def cross_validate_mixture(
    sources: Sequence[FrameDataset],
    params: MixtureParams | None = None,
    *,
    extra_sources: Sequence[FrameDataset] = (),
    patches: Sequence[NDArray[np.uint8]] = (),
    random_state: int = 0,
    n_jobs: int | None = None,
    on_step: Callable[[str], object] | None = None,
) -> tuple[TemplateMixture, list[FoldScore], list[FoldDetections]]:
    """Train a mixture on all sources, calibrated and evaluated by leaving out one source at a time.

    The threshold of the model has the best F-beta over all left-out sources together, so every vehicle has
    the same weight; a false box counts 1.4 times as much as a missed one, and ignored boxes are regions. The
    log-odds are fitted to the same detections (Platt, "Probabilistic outputs for support vector machines",
    1999).

    Parameters
    ----------
    sources, extra_sources
        Labelled frames of at least two sources; and sources that every model is trained on and none is
        evaluated on.
    params, patches, random_state, n_jobs, on_step
        As in `train_mixture`.

    Returns
    -------
    tuple
        The model trained on everything; a `FoldScore` for each set of frames, at the threshold that is best
        for the other sources; and the detections in each set.

    Raises
    ------
    InvalidInputError
        If there are fewer than two sources, or `train_mixture` finds too few vehicles without one of them.
    """
    sources = check_sources(sources, min_count=2)
    extra = check_sources((*sources, *check_sources(extra_sources, min_count=0)))[len(sources) :]
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    options: dict[str, Any] = {"patches": patches, "random_state": random_state, "n_jobs": n_jobs}
    folds: list[FoldDetections] = []
    report, total = on_step or log.info, len(sources) + 1
    for step, left_out in enumerate(sources, 1):
        report(f"step {step} of {total}: train without {left_out.name}")
        rest = [source for source in sources if source is not left_out]
        mixture = train_mixture([*rest, *extra], params, on_step=report, **options)
        report(f"step {step} of {total}: evaluate on {left_out.name}")
        folds += detect_in_source(mixture, left_out, min_score=_MIN_MARGIN, n_jobs=n_jobs)
    scores = []
    for fold in folds:
        others = [other for other in folds if other.source != fold.source]
        scores.append(score_fold(fold, best_threshold(others), fit_log_odds(others)))
    report(f"step {total} of {total}: train on all sources")
    mixture = train_mixture([*sources, *extra], params, on_step=report, **options)
    slope, offset = fit_log_odds(folds)
    threshold = slope * best_threshold(folds) + offset
    return replace(mixture, slope=slope, offset=offset, threshold=threshold), scores, folds


def training_metadata(
    scores: Sequence[FoldScore], sources: Sequence[FrameDataset], seed: int, patches: int = 0
) -> dict[str, Any]:
    """Metadata of a cross-validated model for its file."""
    data = {source.name: sum(len(part) for part in source.sets) for source in sources}
    return {
        "metrics": {"left_out": {score.name: score.to_dict() for score in scores}},
        "data": data | ({"patches": patches} if patches else {}),
        "training": {"random_state": seed},
        "versions": {"vehicle_detection": vehicle_detection.__version__},
    }
