"""Compare classifiers of scikit-learn, such as naive Bayes and a linear SVM, on the same features."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vehicle_detection._common import check_type, describe, progress_bar
from vehicle_detection.datasets import PatchSet, Split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import FeatureParams
from vehicle_detection.training.classifier import DEFAULT_C, check_labels
from vehicle_detection.training.feature_cache import FeatureCache
from vehicle_detection.training.results import make_table
from vehicle_detection.training.trials import TrialEvaluator, TrialOptions
from vehicle_detection.training.tuning import check_seeds, make_splits

if TYPE_CHECKING:
    from pandas import DataFrame


def compare_classifiers(
    patch_set: PatchSet,
    classifiers: Mapping[str, Any] | None = None,
    *,
    params: FeatureParams | None = None,
    splits: str | Sequence[str] | Mapping[str, Split] = "sequences",
    seeds: Sequence[int] = (0,),
    cache: FeatureCache | str | os.PathLike[str] | None = None,
    n_jobs: int | None = None,
    progress: bool = False,
) -> DataFrame:
    """Train and evaluate classifiers of scikit-learn on the same features and splits.

    The features are scaled by a ``StandardScaler`` that is fitted on the training part, as in the course.

    Parameters
    ----------
    patch_set
        The patches.
    classifiers
        Estimators of scikit-learn by name; they are copied, not changed. None compares Gaussian naive Bayes
        with a linear SVM.
    params
        The features; the default is ``FeatureParams()``.
    splits, seeds, progress
        As in `compare_configurations`.
    cache, n_jobs
        As in `TrialOptions`.

    Returns
    -------
    pandas.DataFrame
        One row for each classifier and split, with the columns ``classifier``, ``split``, ``seed``,
        ``train_size`` and ``test_size`` (patches), ``accuracy``, ``false_negative_rate``,
        ``false_positive_rate``, ``fit_seconds`` and ``predict_seconds`` (of all test patches).

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the training part of a split lacks a class.

    Examples
    --------
    >>> from sklearn.tree import DecisionTreeClassifier
    >>> from sklearn.naive_bayes import GaussianNB
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(60)
    >>> patch_set = PatchSet(patches, labels, [f"drawn/{number}.png" for number in range(60)])
    >>> models = {"naive Bayes": GaussianNB(), "tree": DecisionTreeClassifier(random_state=0)}
    >>> table = compare_classifiers(patch_set, models, splits="random", seeds=range(2))
    >>> table["classifier"].tolist()
    ['naive Bayes', 'naive Bayes', 'tree', 'tree']
    """
    from sklearn.base import clone
    from sklearn.preprocessing import StandardScaler

    models = _default_classifiers() if classifiers is None else _check_classifiers(classifiers)
    if params is not None:
        check_type(params, "params", FeatureParams, "pass FeatureParams() or a preset")
    chosen = params or FeatureParams()
    checked_seeds = check_seeds(seeds)
    evaluator = TrialEvaluator(patch_set, TrialOptions(cache=cache, n_jobs=n_jobs, time_search=False))
    trials = list(make_splits(patch_set, splits, checked_seeds))
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    with progress_bar(progress, len(models) * len(trials), unit="fit") as bar:
        for number, (split_name, seed, split) in enumerate(trials):
            labels = check_labels(evaluator.labels[split.train], len(split.train))
            tested = evaluator.labels[split.test]
            scaler = StandardScaler(copy=False)
            X = scaler.fit_transform(evaluator.cache.rows(chosen, split.train))
            X_test = scaler.transform(evaluator.cache.rows(chosen, split.test))
            for name, model in models.items():
                start = time.perf_counter()
                fitted = clone(model).fit(X, labels)
                fit_end = time.perf_counter()
                wrong = np.asarray(fitted.predict(X_test)) != tested
                rows[name, number] = {
                    "classifier": name,
                    "split": split_name,
                    "seed": seed,
                    "train_size": len(labels),
                    "test_size": len(tested),
                    "accuracy": float((~wrong).mean()),
                    "false_negative_rate": _mean(wrong[tested == 1]),
                    "false_positive_rate": _mean(wrong[tested == 0]),
                    "fit_seconds": round(fit_end - start, 3),
                    "predict_seconds": round(time.perf_counter() - fit_end, 3),
                }
                bar.update()
    # One classifier after the other, although the features of a split are computed once for all.
    return make_table(rows[name, number] for name in models for number in range(len(trials)))


def _default_classifiers() -> dict[str, Any]:
    from sklearn.naive_bayes import GaussianNB
    from sklearn.svm import LinearSVC

    return {"naive Bayes": GaussianNB(), "linear SVM": LinearSVC(C=DEFAULT_C, random_state=0)}


def _check_classifiers(classifiers: Mapping[str, Any]) -> dict[str, Any]:
    given: object = classifiers
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(
            "classifiers must map names to estimators of scikit-learn, at least one, such as "
            f"{{'naive Bayes': GaussianNB()}}; got {describe(given)}"
        )
    for name, model in given.items():
        # `sklearn.base.clone` needs get_params.
        if isinstance(model, type) or not all(
            hasattr(model, each) for each in ("fit", "predict", "get_params")
        ):
            raise InvalidInputError(
                f"classifiers[{name!r}] must be an estimator with fit, predict and get_params, got "
                f"{describe(model)}; pass an instance, such as GaussianNB()"
            )
    return {str(name): model for name, model in given.items()}


def _mean(wrong: Any) -> float | None:
    """Fraction of errors; None without patches of this class."""
    return float(wrong.mean()) if wrong.size else None
