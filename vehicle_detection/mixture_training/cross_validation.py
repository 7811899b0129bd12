"""How good a mixture is on roads it was not trained on, and the probabilities that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import check_integer, resolve_jobs
from vehicle_detection.boxes import Detections
from vehicle_detection.evaluation import (
    FrameBoxes,
    LabelledFrames,
    evaluate_detections,
    match_detections,
    precision_recall_curve,
)
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.mixture_training.negatives import check_sources
from vehicle_detection.mixture_training.train import FrameDataset, train_mixture
from vehicle_detection.params import MixtureParams

Floats = NDArray[np.float64]

# Least value of a box that is judged, and the thresholds that are tried.
_LOWEST = -1.0
_THRESHOLDS = np.arange(-1.0, 1.5, 0.02)


@dataclass(frozen=True, kw_only=True)
class FoldScore:
    """What a mixture finds in a set of frames whose source it was not trained on.

    Attributes
    ----------
    name, source
        Names of the set and of its source.
    frames, vehicles
        Number of frames, and of boxes that count.
    f1, precision, recall, mean_iou
        At the threshold that the other sources tell.
    false_per_frame, false_per_empty_frame
        False boxes a frame, and on frames without any label; NaN where there are none.
    threshold
        That threshold, a value of the templates.
    average_precision, best_f1
        Over all thresholds, and at the best one.
    region_f1, region_average_precision
        `f1` and `average_precision` where a box of which half or more lies in an ignored box is not judged,
        as ``evaluate_detections(..., ignored_as_regions=True)`` scores it. Some labels put one ignored box
        around a group of vehicles: then the plain figures count each one that is found there as false.
    """

    name: str
    source: str
    frames: int
    vehicles: int
    f1: float
    precision: float
    recall: float
    mean_iou: float
    false_per_frame: float
    false_per_empty_frame: float
    threshold: float
    average_precision: float
    best_f1: float
    region_f1: float
    region_average_precision: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, rounded to four digits; what is not known is left out."""
        values = asdict(self).items()
        return {
            name: round(value, 4) if isinstance(value, float) else value
            for name, value in values
            if value == value  # NaN is not
        }


@dataclass(frozen=True, eq=False)
class FoldDetections:
    """What models found in the frames of sources that they were not trained on.

    Attributes
    ----------
    source
        Name of the source.
    frames
        Labelled frames.
    found
        Boxes with the templates' values as scores.
    """

    source: str
    frames: LabelledFrames
    found: FrameBoxes

    @property
    def truth(self) -> FrameBoxes:
        """Labels with all frames as frames."""
        return replace(self.frames.labels, frame_keys=tuple(self.frames.keys))

    @property
    def scores(self) -> Floats:
        """Templates' value of each box."""
        assert self.found.scores is not None
        return self.found.scores

    def above(self, threshold: float) -> FrameBoxes:
        """Boxes from a threshold on."""
        return self.found[self.scores >= threshold]


def cross_validate_mixture(
    sources: Sequence[FrameDataset],
    params: MixtureParams | None = None,
    *,
    always: Sequence[FrameDataset] = (),
    patches: Sequence[NDArray[np.uint8]] = (),
    random_state: int = 0,
    n_jobs: int | None = None,
    on_step: Callable[[str], object] | None = None,
) -> tuple[TemplateMixture, list[FoldScore], list[FoldDetections]]:
    """Train a mixture on all sources, calibrated and judged by leaving out one source after the other.

    Parameters
    ----------
    sources
        Labelled frames of two sources or more.
    always
        Further sources, that every model is trained on and none is judged by.
    params, patches, random_state, n_jobs, on_step
        As for `train_mixture`.

    Returns
    -------
    tuple
        The model trained on everything; a score for each set of frames, at the threshold that is best for the
        other sources; what was found there.

    Raises
    ------
    InvalidInputError
        If there are not two sources, or `train_mixture` finds too few vehicles without one of them.

    Notes
    -----
    The threshold of the model is the best one over all sources left out, each vehicle with the same weight.
    Log-odds are fitted to the same boxes (Platt, "Probabilistic outputs for support vector machines", 1999).
    """
    sources = check_sources(sources, least=2)
    known = check_sources((*sources, *check_sources(always, least=0)))[len(sources) :]
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    tell = on_step or (lambda line: None)
    held: list[FoldDetections] = []
    for out in sources:
        rest = [source for source in sources if source is not out] + [*known]
        mixture = train_mixture(
            rest,
            params,
            patches=patches,
            random_state=random_state,
            n_jobs=n_jobs,
            on_step=lambda line: None,
        )
        held += detect_in_source(mixture, out, n_jobs=n_jobs)
        tell(f"{out.name}: judged by a model that does not know it")
    scores = [
        _score(part, _threshold([other for other in held if other.source != part.source])) for part in held
    ]
    slope, offset = _log_odds(held)
    threshold = slope * _threshold(held) + offset
    mixture = train_mixture(
        [*sources, *known],
        params,
        patches=patches,
        random_state=random_state,
        n_jobs=n_jobs,
        on_step=on_step,
    )
    calibrated = replace(mixture, slope=slope, offset=offset, threshold=threshold)
    return calibrated, scores, held


def detect_in_source(
    mixture: TemplateMixture, source: FrameDataset, *, n_jobs: int | None = None
) -> list[FoldDetections]:
    """Detect vehicles in all frames of a source, including weak ones; scores are margins."""
    with mixture.open_search(n_jobs=1) as search, ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool:

        def detect(pair: tuple[Any, NDArray[np.uint8]]) -> tuple[Any, Detections]:
            # An uncalibrated mixture has slope 1 and offset 0, so its scores are margins.
            found = search.find(pair[1], min_vehicle_score=_LOWEST).vehicles
            assert found is not None
            return pair[0], found

        return [
            FoldDetections(source.name, part, FrameBoxes.from_detections(dict(pool.map(detect, part))))
            for part in source.sets
        ]


def _score(part: FoldDetections, threshold: float) -> FoldScore:
    truth, kept = part.truth, part.above(threshold)
    scores = evaluate_detections(kept, truth)
    lenient = evaluate_detections(kept, truth, ignored_as_regions=True)
    precision, recall, _ = precision_recall_curve(part.found, truth)
    every = evaluate_detections(part.found, truth, ignored_as_regions=True)
    values, empty = _on_empty(part)
    return FoldScore(
        name=part.frames.name,
        source=part.source,
        frames=len(part.frames),
        vehicles=int((~truth.ignore).sum()),
        f1=scores.f1,
        precision=scores.precision,
        recall=scores.recall,
        mean_iou=scores.mean_iou,
        false_per_frame=scores.false_positives_per_frame,
        false_per_empty_frame=int((values >= threshold).sum()) / empty if empty else float("nan"),
        threshold=threshold,
        average_precision=evaluate_detections(part.found, truth).average_precision,
        best_f1=float(_f1(precision, recall).max(initial=0.0)),
        region_f1=lenient.f1,
        region_average_precision=every.average_precision,
    )


def _f1(precision: Floats, recall: Floats) -> Floats:
    """F1 for each threshold; 0 where no vehicle is labelled."""
    recall = np.nan_to_num(recall)
    return np.asarray(2 * precision * recall / np.maximum(precision + recall, 1e-9), np.float64)


def _on_empty(part: FoldDetections) -> tuple[Floats, int]:
    """Values of the boxes on frames without any label, all of them false, and the number of the frames."""
    empty = [key for key in part.frames.keys if not len(part.frames.labels.rows(key))]
    rows = np.concatenate([np.empty(0, np.intp), *(part.found.rows(key) for key in empty)])
    return part.scores[rows], len(empty)


def _threshold(held: Sequence[FoldDetections]) -> float:
    """Choose the threshold with the best F1 over all vehicles of these sets together.

    A mean of the sets' own F1 would let a few dozen vehicles decide as much as hundreds.
    """
    right, shown, vehicles = np.zeros(len(_THRESHOLDS)), np.zeros(len(_THRESHOLDS)), 0
    for part in held:
        match = match_detections(part.found, part.truth, list(part.frames.keys), 0.5)
        found = part.scores[~match.ignored][:, None] >= _THRESHOLDS
        right += found[match.match[~match.ignored] >= 0].sum(axis=0)
        shown += found.sum(axis=0)
        vehicles += int((~part.truth.ignore).sum())
    f1 = 2 * right / np.maximum(shown + vehicles, 1)
    return float(_THRESHOLDS[f1.argmax()])


def _log_odds(held: Sequence[FoldDetections]) -> tuple[float, float]:
    """Slope and offset that turn values into log-odds, by what was found in sources left out."""
    from sklearn.linear_model import LogisticRegression

    values, right = [], []
    for part in held:
        match = match_detections(part.found, part.truth, list(part.frames.keys), 0.5)
        judged = ~match.ignored
        values += part.scores[judged].tolist()
        right += (match.match[judged] >= 0).tolist()
    if len(set(right)) < 2:
        return 1.0, 0.0
    fitted = LogisticRegression(C=1e6).fit(np.array(values)[:, None], right)
    slope = float(fitted.coef_[0, 0])
    # Of a few boxes the better ones may be the wrong ones: such a line would turn the order round.
    return (slope, float(fitted.intercept_[0])) if slope > 0 else (1.0, 0.0)


def as_metadata(
    scores: Sequence[FoldScore], sources: Sequence[FrameDataset], seed: int, patches: int = 0
) -> dict[str, Any]:
    """Collect what a model file tells of its training."""
    data = {source.name: sum(len(part) for part in source.sets) for source in sources}
    return {
        "metrics": {"left_out": {score.name: score.to_dict() for score in scores}},
        "data": data | ({"patches": patches} if patches else {}),
        "training": {"random_state": seed},
        "versions": {"vehicle_detection": vehicle_detection.__version__},
    }
