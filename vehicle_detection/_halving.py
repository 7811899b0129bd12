"""Successive halving over recipes by scikit-learn, on folds that do not leak."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin

from vehicle_detection._configurations import describe_params
from vehicle_detection._download import natural_key, parent_folder
from vehicle_detection._ledger import Ledger
from vehicle_detection._near_copies import group_copies, make_thumbnails
from vehicle_detection._patch_set import PatchSet
from vehicle_detection._trials import Recipe
from vehicle_detection.datasets import Split
from vehicle_detection.errors import InvalidInputError

_FEWEST_PATCHES = 300  # With fewer, chance decides who stays.
_ALIKE = 0.95  # As in split_groups.


class Trial(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A recipe as an estimator over row numbers; it is trained when it is scored.

    Only then both sides of the trial are known, and a ledger can tell whether it was run before.
    """

    def __init__(
        self,
        *,
        ledger: Ledger | None = None,
        recipe: Recipe | None = None,
        folds: NDArray[np.intp] | None = None,
        split: str = "",
        seed: int = 0,
    ) -> None:
        self.ledger = ledger
        self.recipe = recipe
        self.folds = folds
        self.split = split
        self.seed = seed

    def fit(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> Trial:
        """Take note of the rows."""
        self.classes_ = np.unique(y)
        self.rows_ = X[:, 0]
        return self

    def score(self, X: NDArray[np.intp], y: NDArray[np.int64], sample_weight: None = None) -> float:
        """Train on the rows of `fit` and judge on these; NaN where that is impossible."""
        assert self.ledger is not None
        assert self.recipe is not None
        assert self.folds is not None
        row = self.ledger.run(
            self.recipe,
            Split(np.sort(self.rows_), np.sort(X[:, 0])),
            self.seed,
            name=describe_params(self.recipe.params),
            split_name=f"{self.split}, fold {self.folds[X[0, 0]] + 1} of {self.folds.max() + 1}",
            stage="halving",
            on_frames=False,
        )
        return math.nan if row["accuracy"] is None else float(row["accuracy"])


def make_folds(patch_set: PatchSet, split: str, folds: int, seed: int) -> NDArray[np.intp]:
    """Fold of each patch, 0 to ``folds - 1``, so that what belongs together is in one.

    ``"sequences"`` cuts each folder into runs of file numbers, ``"groups"`` keeps near-copies together,
    and ``"random"`` does neither.
    """
    if split == "sequences":
        return _sequence_folds(patch_set, folds)
    from sklearn.model_selection import StratifiedGroupKFold, StratifiedKFold

    copies = group_copies(make_thumbnails(patch_set), _ALIKE) if split == "groups" else None
    kind = StratifiedGroupKFold if split == "groups" else StratifiedKFold
    fold_of = np.zeros(len(patch_set), np.intp)
    try:
        parts = list(
            kind(folds, shuffle=True, random_state=seed).split(patch_set.labels, patch_set.labels, copies)
        )
    except ValueError as error:
        raise InvalidInputError(
            f"patch_set cannot be cut into folds={folds}: {error}; use fewer folds"
        ) from error
    for number, (_, rows) in enumerate(parts):
        fold_of[rows] = number
    return fold_of


def _sequence_folds(patch_set: PatchSet, folds: int) -> NDArray[np.intp]:
    folders: dict[str, list[int]] = {}
    for row, name in enumerate(patch_set.names):
        folders.setdefault(parent_folder(name), []).append(row)
    fold_of = np.zeros(len(patch_set), np.intp)
    for rows in folders.values():
        rows.sort(key=lambda row: natural_key(patch_set.names[row]))
        fold_of[rows] = np.arange(len(rows)) * folds // len(rows)
    for number in range(folds):
        for side, mask in (("on", fold_of == number), ("outside", fold_of != number)):
            if len(np.unique(patch_set.labels[mask])) < 2:
                raise InvalidInputError(
                    f"patch_set lacks a class {side} fold {number + 1} of folds={folds}; use fewer folds"
                )
    return fold_of


def halve(
    ledger: Ledger,
    recipes: Sequence[Recipe],
    fold_of: NDArray[np.intp],
    *,
    split: str,
    candidates: int | None,
    factor: int,
    seed: int,
) -> list[Recipe]:
    """Drop the worse recipes round by round, on ever more patches; return them best first."""
    # The halving searches of scikit-learn must be switched on by this import.
    from sklearn.experimental import enable_halving_search_cv  # noqa: F401
    from sklearn.model_selection import HalvingGridSearchCV, HalvingRandomSearchCV, PredefinedSplit

    # A recipe is one value, so that only the possible combinations of a grid are candidates.
    values: dict[str, Any] = {"recipe": list(recipes)}
    count = min(candidates or len(recipes), len(recipes))
    rounds = int(math.log(count, factor) + 1e-9)
    patches = len(fold_of)
    options: dict[str, Any] = {
        "estimator": Trial(ledger=ledger, folds=fold_of, split=split, seed=seed),
        "factor": factor,
        "min_resources": min(patches, max(patches // factor**rounds, _FEWEST_PATCHES)),
        "cv": PredefinedSplit(fold_of),
        "error_score": "raise",
        "return_train_score": False,
        "refit": False,
        "random_state": seed,
    }
    if count < len(recipes):
        search = HalvingRandomSearchCV(param_distributions=values, n_candidates=count, **options)
    else:
        search = HalvingGridSearchCV(param_grid=values, **options)
    with warnings.catch_warnings():
        # A recipe that cannot be trained has no score; its row says why.
        warnings.filterwarnings("ignore", message="One or more of the test scores are non-finite")
        search.fit(np.arange(patches)[:, None], ledger.bench.labels)
    results = search.cv_results_
    # Who came further is better; within a round the score decides, and NaN comes last.
    scores = np.nan_to_num(results["mean_test_score"], nan=-1.0)
    order = np.lexsort((-scores, -results["iter"]))
    ranked = [results["params"][index]["recipe"] for index in order if scores[index] >= 0]
    return list(dict.fromkeys(ranked))
