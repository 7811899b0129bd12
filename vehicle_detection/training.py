"""Train a model and judge it honestly: on several splits, each fitted on its training part alone."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_integer, check_number, describe, resolve_jobs
from vehicle_detection._model_card import model_card
from vehicle_detection._training_report import SPLITS, SplitScore, TrainingReport
from vehicle_detection.classifier import (
    DEFAULT_C,
    VehicleClassifier,
    check_gamma,
    check_labels,
    fit_features,
    patch_features,
)
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import calibrate_scores, calibration_error
from vehicle_detection.params import FeatureParams

__all__ = ["SPLITS", "SplitScore", "TrainingReport", "model_card", "train_and_judge"]

_OTHERS = ("KITTI", "Extras")


def train_and_judge(
    patch_set: PatchSet,
    *,
    params: FeatureParams | None = None,
    C: float = DEFAULT_C,
    mirror: bool = True,
    gamma: float = 0.0,
    degraded: float = 0.0,
    random_state: int = 0,
    split: Literal["random", "sequences"] = "random",
    seeds: int = 5,
    n_jobs: int | None = None,
    progress: bool = False,
) -> tuple[VehicleClassifier, TrainingReport]:
    """Judge by splits, then train on all patches.

    On each split, scaler and SVM are fitted on its training part alone, mirrored and degraded patches
    included, and judged on its test part as it is. Features are computed once, and no fit copies them.

    Parameters
    ----------
    patch_set
        Patches of both classes.
    params
        Features; the default is ``FeatureParams()``.
    C, mirror, gamma, degraded
        As in `train_classifier`.
    random_state
        Seed of the solver, and first one of the random splits.
    split
        The split whose accuracy stands for the model. It must be possible; others that the patches do not
        allow are left out.
    seeds
        Number of random splits, each with its own seed.
    n_jobs
        Threads; the result is the same for any number.
    progress
        Show a bar on standard error if that is a terminal.

    Returns
    -------
    classifier : VehicleClassifier
        Trained on all patches: what `train_classifier` makes of them. Its metadata holds the accuracies, the
        counts and the fingerprint of the patches, and nothing that changes from one run to the next.
    report : TrainingReport
        The same and more, with the time of each step.

    Raises
    ------
    InvalidInputError
        If an argument is out of range, a class is missing, or `split` cannot be made.

    Examples
    --------
    >>> from vehicle_detection.synthetic.drive import render_patches
    >>> patches, labels = render_patches(20)
    >>> names = [f"{'vehicles' if label else 'others'}/drawn/{n}.png" for n, label in enumerate(labels)]
    >>> small = FeatureParams(hog_channel=0)
    >>> classifier, report = train_and_judge(PatchSet(patches, labels, names), params=small, seeds=2)
    >>> sorted(report.splits), len(report.splits["random"].accuracies), report.vehicles
    (['random', 'sequences'], 2, 10)
    """
    if not isinstance(patch_set, PatchSet):
        raise InvalidInputError(
            f"patch_set must be a PatchSet, got {describe(patch_set)}; read one with load_training_patches"
        )
    labels = check_labels(patch_set.labels, len(patch_set))
    params = params or FeatureParams()
    check_number(C, "C", above=0, high=1e12)
    check_gamma(gamma, mirror)
    check_number(degraded, "degraded", low=0, high=1)
    check_choice(split, "split", ("random", "sequences"))
    check_integer(seeds, "seeds", low=1, high=1000)
    check_integer(random_state, "random_state", low=0, high=2**32 - seeds)
    plans, skipped = _plan(patch_set, split, range(random_state, random_state + seeds))

    inner = _inner_split(patch_set, plans.get("sequences"))
    options: dict[str, Any] = {"mirror": mirror, "gamma": gamma, "degraded": degraded}
    seconds: dict[str, float] = {}
    fits = sum(map(len, plans.values())) + (inner is not None) + 1
    with ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool, _progress(progress, fits, seconds) as step:
        with step("features", fits=0):
            features = patch_features(patch_set.patches, params, n_jobs=n_jobs, **options)

        def train(name: str, rows: NDArray[np.intp] | None = None) -> VehicleClassifier:
            with step(name):
                return fit_features(
                    features, labels, params=params, C=C, random_state=random_state, rows=rows, **options
                )

        def judge(name: str, split: Split) -> NDArray[np.float64]:
            return train(name, split.train).decision_function(features[split.test])

        final = pool.submit(train, "final")
        running = {
            name: [pool.submit(judge, name, split) for split in splits] for name, splits in plans.items()
        }
        held = pool.submit(judge, "calibration", inner) if inner is not None else None
        scores = {}
        try:
            for name, splits in plans.items():
                with step("leakage", fits=0):
                    leakage = split_leakage(patch_set, splits[0])
                pairs = [
                    (each.result() > 0, labels[split.test]) for each, split in zip(running[name], splits)
                ]
                scores[name] = _score([_shares(*pair) for pair in pairs], splits[0], leakage)
            error = None
            if held is not None and inner is not None:
                platt = calibrate_scores(held.result(), labels[inner.test])
                tested = labels[plans["sequences"][0].test]
                error = calibration_error(platt.probability(running["sequences"][0].result()), tested)
            classifier = final.result()
        finally:
            pool.shutdown(cancel_futures=True)
    report = TrainingReport(
        params=params,
        C=C,
        mirror=mirror,
        gamma=gamma,
        degraded=degraded,
        random_state=random_state,
        split=split,
        sources=patch_set.counts(),
        vehicles=int(labels.sum()),
        non_vehicles=int((labels == 0).sum()),
        fingerprint=patch_set.fingerprint,
        splits=scores,
        calibration_error=error,
        skipped=skipped,
        seconds=seconds,
    )
    facts = {**classifier.metadata, **_facts(report)}
    return dataclasses.replace(classifier, metadata=facts), report


def _plan(patch_set: PatchSet, chosen: str, seeds: range) -> tuple[dict[str, list[Split]], dict[str, str]]:
    """Make the splits that the patches allow, and say why the others cannot be made."""
    makers: dict[str, Callable[[], list[Split]]] = {
        "random": lambda: [split_random(patch_set, random_state=seed) for seed in seeds],
        "sequences": lambda: [split_sequences(patch_set)],
        "gti_to_kitti": lambda: [split_sources(patch_set, train=("GTI",), test=_OTHERS)],
        "kitti_to_gti": lambda: [split_sources(patch_set, train=_OTHERS, test=("GTI",))],
    }
    plans: dict[str, list[Split]] = {}
    skipped: dict[str, str] = {}
    for name, make in makers.items():
        try:
            splits = make()
            for side in splits[0]:
                if len(np.unique(patch_set.labels[side])) < 2:
                    raise InvalidInputError("one side of the split lacks a class; pass more patches")
        except InvalidInputError as error:
            if name == chosen:
                raise
            skipped[name] = str(error)
        else:
            plans[name] = splits
    return plans, skipped


def _inner_split(patch_set: PatchSet, splits: list[Split] | None) -> Split | None:
    """Split the training part of the split by sequences once more, for the sigmoid of probabilities."""
    if not splits:
        return None
    rows = splits[0].train
    try:
        inner = split_sequences(patch_set[rows])
    except InvalidInputError:
        return None
    split = Split(rows[inner.train], rows[inner.test])
    return split if all(len(np.unique(patch_set.labels[side])) == 2 for side in split) else None


def _shares(predicted: NDArray[Any], labels: NDArray[np.int64]) -> tuple[float, float, float]:
    """Accuracy, share of vehicles missed, share of others taken for vehicles."""
    wrong = predicted != labels
    vehicle = labels == 1
    return float(1 - wrong.mean()), float(wrong[vehicle].mean()), float(wrong[~vehicle].mean())


def _score(answers: list[tuple[float, float, float]], split: Split, leakage: float) -> SplitScore:
    accuracies, missed, false = zip(*answers)
    return SplitScore(
        accuracies=accuracies,
        missed=float(np.mean(missed)),
        false=float(np.mean(false)),
        train=len(split.train),
        test=len(split.test),
        leakage=leakage,
    )


def _facts(report: TrainingReport) -> dict[str, Any]:
    """Choose what the model file tells: nothing that changes from one run to the next."""
    splits = {
        name: {
            "accuracy": round(score.accuracy, 5),
            "missed": round(score.missed, 5),
            "false": round(score.false, 5),
            "near_copies": round(score.leakage, 3),
            "test": score.test,
            "seeds": len(score.accuracies),
        }
        for name, score in report.splits.items()
    }
    metrics = {"accuracy": round(report.accuracy, 5), "split": report.split, "splits": splits}
    if report.calibration_error is not None:
        metrics["calibration_error"] = round(report.calibration_error, 5)
    return {
        "metrics": metrics,
        "data": {
            "fingerprint": report.fingerprint,
            "sources": report.sources,
            "balance": round(report.balance, 5),
        },
    }


@contextmanager
def _progress(show: bool, total: int, seconds: dict[str, float]) -> Iterator[Callable[..., Any]]:
    """Show a bar of fits; yield a context that times a step and counts it as so many fits."""
    from tqdm import tqdm

    lock = threading.Lock()
    # None: tqdm stays quiet unless its file is a terminal.
    with tqdm(total=total, unit="fit", disable=None if show else True) as bar:

        @contextmanager
        def step(name: str, fits: int = 1) -> Iterator[None]:
            bar.set_description(name)
            began = time.perf_counter()
            yield
            with lock:
                seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - began
                bar.update(fits)

        yield step
