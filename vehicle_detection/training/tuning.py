"""Comparison of configurations on splits.

Every trial is one row of a table. With a store, each row is on disk as soon as it is measured, so an
interrupted run continues where it stopped, and a run with more configurations measures only the new ones.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_choice,
    check_integer,
    check_number,
    check_sequence,
    describe,
    is_listing,
    progress_bar,
)
from vehicle_detection.datasets import SEEDED_SPLITS, SPLIT_NAMES, PatchSet, Split, make_split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training.classifier import DEFAULT_C
from vehicle_detection.training.results import RowStore
from vehicle_detection.training.trials import (
    COLUMNS,
    Configuration,
    TrialOptions,
    Trials,
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
    - ``configuration`` (its name), the fields of `FeatureParams`, ``n_features``, ``C``, ``mirror``,
      ``positive_weight``, ``split`` and ``seed``.
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
        A ``.jsonl`` file to which each row is appended as soon as it is measured. Rows that it
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
                trials.add_impossible(candidate)
                continue
            for name, seed, split in parts:
                trials.run(candidate, split, seed, split_name=name)
    return trials.table()


def halve_configurations(
    patch_set: PatchSet,
    configurations: Sequence[Configuration],
    count: int,
    *,
    split: str = "sequences",
    random_state: int = 0,
    options: TrialOptions | None = None,
) -> list[dict[str, Any]]:
    """Select the `count` best configurations by successive halving, best first.

    All are ranked on few patches of a split, the best third continues with three times as many, and so on
    (scikit-learn's ``HalvingGridSearchCV``). Impossible ones are left out.
    """
    from sklearn.base import BaseEstimator, ClassifierMixin
    from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - enables the next import
    from sklearn.model_selection import HalvingGridSearchCV

    trials = Trials(patch_set, options, RowStore(None, COLUMNS))

    class Trial(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
        """An estimator over row numbers."""

        def __init__(self, candidate: Any = None) -> None:
            self.candidate = candidate

        def fit(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> Trial:
            self.classes_, self.model_ = np.unique(y), trials.train(self.candidate, X[:, 0], random_state)
            return self

        def score(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> float:
            return self.model_.score(trials.cache.rows(self.model_.params, X[:, 0]), y)

    possible = [each for each in dict.fromkeys(read_configurations(configurations)) if not each.error]
    if len(possible) <= count:
        return [each.options for each in possible]
    n_patches, n_rounds = len(patch_set), int(math.log(len(possible), 3) + 1e-9)
    search = HalvingGridSearchCV(
        Trial(),
        {"candidate": possible},  # one parameter that holds whole configurations
        cv=[tuple(make_split(patch_set, split, random_state=random_state))],
        min_resources=min(n_patches, max(n_patches // 3**n_rounds, _MIN_PATCHES)),
        error_score="raise",
        refit=False,
        random_state=random_state,
    )
    results = search.fit(np.arange(n_patches)[:, None], trials.labels).cv_results_
    order = np.lexsort((-results["mean_test_score"], -results["iter"]))
    best = dict.fromkeys(results["params"][row]["candidate"] for row in order)
    return [each.options for each in best][:count]


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
