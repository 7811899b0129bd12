"""Successive halving over recipes by scikit-learn, on folds that do not leak.

`tuning` imports this module when it is needed: scikit-learn takes a second.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - switches the next two on
from sklearn.model_selection import HalvingGridSearchCV, HalvingRandomSearchCV, PredefinedSplit

from vehicle_detection.datasets import PatchSet, Split, split_groups, split_random, split_sequences
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tuning.grid import describe_params
from vehicle_detection.tuning.ledger import Ledger
from vehicle_detection.tuning.trials import Recipe

_FEWEST_PATCHES = 300  # With fewer, chance decides who stays.


def make_folds(patch_set: PatchSet, split: str, folds: int, seed: int) -> NDArray[np.intp]:
    """Fold of each patch, 0 to ``folds - 1``: each fold is what the split tests on, out of the rest.

    So ``"sequences"`` cuts each folder into runs of file numbers, and ``"groups"`` keeps near-copies
    together; groups too large for a fold come into the last one.
    """
    fold_of = np.full(len(patch_set), folds - 1, np.intp)
    rest = np.arange(len(patch_set))
    try:
        for fold in range(folds - 1):
            share = 1 / (folds - fold)
            if split == "sequences":
                parts = split_sequences(patch_set[rest], test_size=share)
            elif split == "groups":
                parts = split_groups(patch_set[rest], test_size=share, random_state=seed)
            else:
                parts = split_random(patch_set[rest], test_size=share, random_state=seed)
            fold_of[rest[parts.test]] = fold
            rest = rest[parts.train]
    except InvalidInputError as error:
        raise InvalidInputError(f"patch_set is too small for folds={folds}: {error}") from error
    for fold in range(folds):
        if any(len(np.unique(patch_set.labels[side])) < 2 for side in (fold_of == fold, fold_of != fold)):
            raise InvalidInputError(
                f"patch_set lacks vehicles or others in or beside fold {fold + 1} of folds={folds}; "
                "use fewer folds or another split"
            )
    return fold_of


def _make_estimator(ledger: Ledger, fold_of: NDArray[np.intp], split: str, seed: int) -> Any:
    """Build an estimator over row numbers that is a recipe, trained when it is scored.

    Only then both sides of the trial are known, and the ledger can tell whether it was run before.
    """

    class Trial(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
        def __init__(self, recipe: Recipe | None = None) -> None:
            self.recipe = recipe

        def fit(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> Trial:
            self.classes_ = np.unique(y)
            self.rows_ = X[:, 0]
            return self

        def score(self, X: NDArray[np.intp], y: NDArray[np.int64]) -> float:
            assert self.recipe is not None
            row = ledger.run(
                self.recipe,
                Split(np.sort(self.rows_), np.sort(X[:, 0])),
                seed,
                name=describe_params(self.recipe.params),
                split_name=f"{split}, fold {fold_of[X[0, 0]] + 1} of {fold_of.max() + 1}",
                stage="halving",
                on_frames=False,
            )
            return math.nan if row["accuracy"] is None else float(row["accuracy"])

    return Trial()


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
    # A recipe is one value, so that only the possible combinations of a grid are candidates.
    values: dict[str, Any] = {"recipe": list(recipes)}
    count = min(candidates or len(recipes), len(recipes))
    rounds = int(math.log(count, factor) + 1e-9)
    patches = len(fold_of)
    options: dict[str, Any] = {
        "estimator": _make_estimator(ledger, fold_of, split, seed),
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
