"""Comparison of configurations on splits, and the search of a grid by successive halving.

Every trial is one row of a table. With a store, each row is on disk as soon as it is measured, so an
interrupted run continues where it stopped, and a run with more configurations measures only the new ones.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Checked,
    check_choice,
    check_integer,
    check_number,
    check_sequence,
    check_type,
    describe,
    integer,
    is_listing,
    progress_bar,
)
from vehicle_detection.datasets import SEEDED_SPLITS, SPLIT_NAMES, PatchSet, Split, make_split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training.classifier import DEFAULT_C
from vehicle_detection.training.results import RowStore
from vehicle_detection.training.trials import (
    COLUMNS,
    Candidate,
    Configuration,
    TrialOptions,
    Trials,
    expand_grid,
    read_configurations,
)

if TYPE_CHECKING:
    from pandas import DataFrame

# Patches in the first round of successive halving: with fewer, scores are too noisy to rank candidates.
_MIN_PATCHES = 300


def compare_configurations(
    patch_set: PatchSet,
    configurations: Mapping[str, Configuration] | Sequence[Configuration],
    *,
    splits: str | Sequence[str] | Mapping[str, Split] = "sequences",
    seeds: Sequence[int] = (0,),
    C: float | Sequence[float] = DEFAULT_C,
    options: TrialOptions | None = None,
    store: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> DataFrame:
    """Train and evaluate every configuration with every C on every split.

    Returns one row per trial, with NaN for missing values:

    - ``status``: ``"ok"``; ``"partial"`` if the fast search does not support the features, so that
      neither frames nor speed are measured; ``"failed"`` if the combination is impossible.
      ``message`` gives the reason.
    - ``stage`` (``"compare"``), ``configuration`` (its name), the fields of `FeatureParams`,
      ``n_features``, ``C``, ``mirror``, ``positive_weight``, ``split`` and ``seed``.
    - ``train_size`` and ``test_size``, in patches; ``train_accuracy`` and ``accuracy``, fractions.
    - ``frame_f1`` (at the detector's thresholds), ``frame_best_f1`` (at the best score threshold),
      ``frame_average_precision`` and ``frame_iou``: means over the sets of frames;
      ``frame_f1_by_set``: text.
    - ``search_ms`` of the fast search of one frame and ``fit_seconds`` of the training.
    - ``trial``: a hash of patches, configuration, split, seed, and the frames' names and labels.

    Parameters
    ----------
    patch_set, configurations
        The patches; and `FeatureParams`, names of presets, or mappings of fields of `FeatureParams` and of
        ``C``, ``mirror`` and ``positive_weight`` of `TrainingOptions`, as a mapping from names or as a list.
    splits, seeds
        One or more of ``"sequences"``, ``"groups"``, ``"random"`` (near duplicates in both parts, like the
        course's split), ``"gti_to_kitti"`` (train on GTI, test on KITTI and Extras) and ``"kitti_to_gti"``;
        or a mapping from names to splits. ``"random"`` and ``"groups"`` give one row per seed; other splits
        use the first.
    C
        Regularization of configurations that do not set it; several values are all tried.
    options, progress
        What is measured besides the accuracy, by default ``TrialOptions()``; and whether to show a progress
        bar on standard error.
    store
        A ``.csv`` or ``.jsonl`` file to which each row is appended as soon as it is measured. Rows that it
        already holds are not measured again; an incomplete last line is dropped.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(40)
    >>> patch_set = PatchSet(patches, labels, [f"drawn/{number}.png" for number in range(40)])
    >>> untimed = TrialOptions(time_search=False)
    >>> grid = [{"orient": 4}, {"orient": 0}]
    >>> compare_configurations(patch_set, grid, splits="random", options=untimed)["status"].tolist()
    ['ok', 'failed']
    """
    values = [C] if isinstance(C, (int, float)) else check_sequence(C, "C", "numbers")
    if not values:
        raise InvalidInputError("C must be a number or several; got none")
    for value in values:
        check_number(value, "C")
    candidates = read_configurations(configurations, values)
    parts = list(make_splits(patch_set, splits, check_seeds(seeds)))
    trials = Trials(patch_set, options, RowStore(store, COLUMNS))
    # Candidates with the same features follow each other, so that a small cache computes them once.
    order = {name: place for place, name in enumerate(dict.fromkeys(each.name for each in candidates))}
    candidates.sort(key=lambda candidate: order[candidate.name])
    total = sum(1 if candidate.error else len(parts) for candidate in candidates)
    with progress_bar(progress, total, unit="trial") as trials.bar:
        for candidate in candidates:
            if candidate.error:
                trials.add_impossible(candidate, stage="compare")
                continue
            for name, seed, split in parts:
                trials.run(candidate, split, seed, split_name=name, stage="compare")
    return trials.table()


@dataclass(frozen=True, kw_only=True)
class Halving(Checked):
    """Numbers of a search by successive halving, in which one of `factor` candidates survives a round."""

    n_folds: int = integer(3, low=2, high=100)  # of the cross-validation
    n_candidates: int | None = integer(None, low=1)  # combinations to draw at random; None tries all
    factor: int = integer(3, low=2, high=100)  # the number of patches grows by it
    n_finalists: int = integer(3, low=0)  # best candidates to measure in full


def search_parameters(
    patch_set: PatchSet,
    grid: Mapping[str, Iterable[Any]],
    *,
    split: str = "sequences",
    halving: Halving | None = None,
    random_state: int = 0,
    options: TrialOptions | None = None,
    store: str | os.PathLike[str] | None = None,
    progress: bool = False,
) -> DataFrame:
    """Search a grid by successive halving, then measure the best candidates in full.

    All candidates are ranked on few patches, by cross-validation on folds without near duplicates between
    them; the best ``1 / factor`` of them continue with `factor` times the patches, and so on (scikit-learn's
    ``HalvingGridSearchCV``; Jamieson and Talwalkar, "Non-stochastic best arm identification", 2016). The
    finalists are then trained on the training part of the split and evaluated on its test part, on the
    frames, and by the time of their search.

    Returns the columns of `compare_configurations`. The stages are ``"grid"`` (impossible combinations),
    ``"halving"`` (one row per candidate, fold and number of patches) and ``"final"`` (the finalists, best
    first in the last round). Choose from ``pareto_front(table[table["stage"] == "final"])``.

    Parameters
    ----------
    patch_set, grid
        The patches; and lists of values by name: fields of `FeatureParams`, ``C``, ``mirror`` and
        ``positive_weight``. The others keep their defaults. Impossible combinations are reported and skipped.
    split, halving
        ``"sequences"``, ``"groups"`` or ``"random"``: how the folds and the finalists' split are made; and
        the numbers of the search, by default ``Halving()``.
    random_state
        Seed of the draw, the folds and the training. The same seed repeats the search, so that an
        interrupted one continues from its store.
    options, store, progress
        As in `compare_configurations`.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(60)
    >>> patch_set = PatchSet(patches, labels, [f"drawn/{number}.png" for number in range(60)])
    >>> grid, untimed = {"orient": [4], "C": [1e-5, 1e-3]}, TrialOptions(time_search=False)
    >>> halving = Halving(n_finalists=1)
    >>> table = search_parameters(patch_set, grid, split="random", halving=halving, options=untimed)
    >>> table["stage"].value_counts().to_dict()
    {'halving': 6, 'final': 1}
    """
    check_choice(split, "split", ("sequences", "groups", "random"))
    halving = Halving() if halving is None else halving
    check_type(halving, "halving", Halving, "omit it for the default")
    seed = check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    candidates = read_configurations(expand_grid(grid))
    possible = [each for each in candidates if not each.error]
    if not possible:
        raise InvalidInputError(f"grid holds no possible combination: {candidates[0].error}")
    trials = Trials(patch_set, options, RowStore(store, COLUMNS))
    fold_of = make_folds(patch_set, split, halving.n_folds, seed)
    with progress_bar(progress, unit="trial") as trials.bar:
        for candidate in candidates:
            if candidate.error:
                trials.add_impossible(candidate, stage="grid")
        ranked = _halve(trials, list(dict.fromkeys(possible)), fold_of, halving, split=split, seed=seed)
        if halving.n_finalists:
            ((name, _, parts),) = make_splits(patch_set, split, (seed,))
            for candidate in ranked[: halving.n_finalists]:
                trials.run(candidate, parts, seed, split_name=name, stage="final")
    return trials.table()


def make_folds(patch_set: PatchSet, split: str, n_folds: int, seed: int) -> NDArray[np.intp]:
    """Fold of each patch, from 0; each fold is the test part of a split of the remaining patches.

    Thus ``"sequences"`` cuts each folder into runs of file numbers, and ``"groups"`` keeps near duplicates
    together; groups that are too large for a fold go into the last one.
    """
    fold_of = np.full(len(patch_set), n_folds - 1, np.intp)
    rest = np.arange(len(patch_set))
    try:
        for fold in range(n_folds - 1):
            size = 1 / (n_folds - fold)
            parts = make_split(patch_set[rest], split, test_size=size, random_state=seed)
            fold_of[rest[parts.test]] = fold
            rest = rest[parts.train]
    except InvalidInputError as error:
        raise InvalidInputError(f"patch_set is too small for n_folds={n_folds}: {error}") from error
    for fold in range(n_folds):
        if any(len(np.unique(patch_set.labels[side])) < 2 for side in (fold_of == fold, fold_of != fold)):
            raise InvalidInputError(
                f"fold {fold + 1} of n_folds={n_folds}, or the rest of patch_set, lacks vehicles or "
                "non-vehicles; use fewer folds or another split"
            )
    return fold_of


def _halve(
    trials: Trials,
    candidates: list[Candidate],
    fold_of: NDArray[np.intp],
    halving: Halving,
    *,
    split: str,
    seed: int,
) -> list[Candidate]:
    """Drop the worse candidates round by round, on more and more patches; return them best first."""
    from sklearn.base import BaseEstimator, ClassifierMixin
    from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - enables the next import
    from sklearn.model_selection import HalvingGridSearchCV, HalvingRandomSearchCV, PredefinedSplit

    class Trial(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
        """An estimator over row numbers; its score runs the trial, as only then both sides are known."""

        def __init__(self, candidate: Candidate | None = None) -> None:
            self.candidate = candidate

        def fit(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> Trial:
            self.classes_, self.rows_ = np.unique(y), np.sort(X[:, 0])
            return self

        def score(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> float:
            assert self.candidate is not None
            parts = Split(self.rows_, np.sort(X[:, 0]))
            fold = f"{split}, fold {fold_of[parts.test[0]] + 1} of {halving.n_folds}"
            row = trials.run(self.candidate, parts, seed, split_name=fold, stage="halving")
            return math.nan if row["accuracy"] is None else float(row["accuracy"])

    count, n_patches = min(halving.n_candidates or len(candidates), len(candidates)), len(fold_of)
    n_rounds = int(math.log(count, halving.factor) + 1e-9)
    options: dict[str, Any] = {
        "factor": halving.factor,
        "min_resources": min(n_patches, max(n_patches // halving.factor**n_rounds, _MIN_PATCHES)),
        "cv": PredefinedSplit(fold_of),
        "error_score": "raise",
        "return_train_score": False,
        "refit": False,
        "random_state": seed,
    }
    # One parameter that holds whole candidates: impossible combinations are never among them.
    if count < len(candidates):
        search = HalvingRandomSearchCV(Trial(), {"candidate": candidates}, n_candidates=count, **options)
    else:
        search = HalvingGridSearchCV(Trial(), {"candidate": candidates}, **options)
    with warnings.catch_warnings():
        # A candidate that cannot be trained has no score; the message of its row gives the reason.
        warnings.filterwarnings("ignore", message="One or more of the test scores are non-finite")
        search.fit(np.arange(n_patches)[:, None], trials.labels)
    results = search.cv_results_
    # Order by the last round reached, then by score; NaN comes last.
    scores = np.nan_to_num(results["mean_test_score"], nan=-1.0)
    order = np.lexsort((-scores, -results["iter"]))
    return list(dict.fromkeys(results["params"][row]["candidate"] for row in order if scores[row] >= 0))


def make_splits(
    patch_set: PatchSet, splits: str | Sequence[str] | Mapping[str, Split], seeds: tuple[int, ...]
) -> Iterator[tuple[str, int, Split]]:
    """Name, seed and rows of each split."""
    if isinstance(splits, Mapping):
        if not splits or not all(isinstance(split, Split) for split in splits.values()):
            raise InvalidInputError(f"splits must map names to Split; got {describe(splits)}")
        for name, split in splits.items():
            last = max(int(split.train.max()), int(split.test.max()))
            if last >= len(patch_set):
                raise InvalidInputError(
                    f"splits[{name!r}] holds row {last}, but patch_set has {len(patch_set)} patches; "
                    "pass the set it was made from"
                )
            yield str(name), seeds[0], split
        return
    names = (splits,) if isinstance(splits, str) else check_sequence(splits, "splits", "names of splits")
    if not names:
        raise InvalidInputError(f"splits must name at least one of {', '.join(SPLIT_NAMES)}")
    for name in names:
        check_choice(name, "splits", SPLIT_NAMES)
        for seed in seeds if name in SEEDED_SPLITS else seeds[:1]:
            yield name, seed, make_split(patch_set, name, random_state=seed)


def check_seeds(seeds: object) -> tuple[int, ...]:
    """Return the seeds if they are different integers."""
    listed = seeds if is_listing(seeds) else ()
    checked = tuple(check_integer(seed, "seeds", low=0, high=2**32 - 1) for seed in listed)
    if not checked or len(set(checked)) < len(checked):
        raise InvalidInputError(
            f"seeds must be a list of different integers, such as range(5); got {describe(seeds)}"
        )
    return checked
