"""Train a model and judge it honestly: on several splits, each fitted on its training part alone."""

from __future__ import annotations

import dataclasses
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_integer, check_number, describe, resolve_jobs
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

SPLITS = {
    "random": "random fifth",
    "sequences": "last fifth of each folder",
    "gti_to_kitti": "KITTI and Extras, trained on GTI",
    "kitti_to_gti": "GTI, trained on KITTI and Extras",
}
"""The splits that a model is judged on, by what is tested."""


@dataclass(frozen=True, kw_only=True)
class SplitScore:
    """How a classifier does on patches it has not seen; means over the seeds, where there are several.

    Attributes
    ----------
    accuracies
        Share of right answers, one for each seed.
    missed
        Share of the tested vehicles that are taken for something else.
    false
        Share of the other tested patches that are taken for vehicles.
    train, test
        Number of patches on either side.
    leakage
        Share of the test patches with a near duplicate among the training patches: `split_leakage` of the first
        seed.
    """

    accuracies: tuple[float, ...]
    false_negative_rate: float
    false_positive_rate: float
    train: int
    test: int
    leakage: float

    @property
    def accuracy(self) -> float:
        """Mean share of right answers."""
        return float(np.mean(self.accuracies))


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """What `train_and_evaluate` found.

    Attributes
    ----------
    params, C, mirror, gamma, degraded, random_state
        What was trained.
    split
        The split whose accuracy stands for the model.
    sources
        Number of patches of each source folder.
    vehicles, non_vehicles
        Number of patches of each class.
    fingerprint
        That of the patches, see `PatchSet`.
    splits
        The score on each split of ``SPLITS`` that the patches allow.
    calibration_error
        That of probabilities on the split by sequences, 0-1 (see `calibration_error` in `evaluation`).
        Platt's sigmoid is fitted on the last fifth of the training part, with a classifier of the rest. None
        where the patches do not allow that split twice.
    skipped
        Why the others were left out.
    seconds
        Time of each step: ``"features"``, each split, ``"calibration"``, ``"leakage"`` and
        ``"final"``, the fit on all patches. Those that run side by side count each.
    """

    params: FeatureParams
    C: float
    mirror: bool
    gamma: float
    degraded: float
    random_state: int
    split: str
    sources: dict[str, int]
    vehicles: int
    non_vehicles: int
    fingerprint: str
    splits: dict[str, SplitScore]
    calibration_error: float | None
    skipped: dict[str, str]
    seconds: dict[str, float]

    @property
    def accuracy(self) -> float:
        """Accuracy on the split that stands for the model."""
        return self.splits[self.split].accuracy

    @property
    def balance(self) -> float:
        """Share of vehicles among the patches."""
        return self.vehicles / (self.vehicles + self.non_vehicles)

    @property
    def features(self) -> str:
        """Name of the feature preset, or the number of features where they are none."""
        known = (name for name in FeatureParams.PRESETS if FeatureParams.preset(name) == self.params)
        return next(known, f"{self.params.length} features")

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, ready for JSON."""
        plain = asdict(self) | {"accuracy": self.accuracy, "balance": self.balance, "features": self.features}
        plain["splits"] = {
            name: {"accuracy": score.accuracy, **asdict(score)} for name, score in self.splits.items()
        }
        return plain


def model_card(
    classifier: VehicleClassifier,
    report: TrainingReport,
    *,
    others: Sequence[TrainingReport] = (),
    command: str | None = None,
) -> str:
    """Write what a user of the model should know, as Markdown.

    Parameters
    ----------
    classifier, report
        What `train_and_evaluate` returned.
    others
        Reports of other features on the same patches, for a table beside them.
    command
        The command that trains the model.

    Returns
    -------
    str
        Data, licence, accuracy on each split, what flatters it, limits.
    """
    parts = [
        *_about(classifier, report, command),
        *_data(report),
        *_accuracy(report, others),
        "## Limits",
        "\n".join(_wrap(line, "- ") for line in _limits(report)),
    ]
    return "\n\n".join(parts) + "\n"


def _about(classifier: VehicleClassifier, report: TrainingReport, command: str | None) -> list[str]:
    params = report.params
    parts = f"{params.spatial_length} spatial bins, {params.hist_length} histogram, {params.hog_length} HOG"
    versions = ", ".join(f"{name} {text}" for name, text in classifier.metadata["versions"].items())
    mirrored = "with mirrored patches" if report.mirror else "without mirrored patches"
    mirrored += f" of other brightness (gamma {report.gamma:g})" if report.gamma else ""
    mirrored += f", and degraded ones of weight {report.degraded:g}" if report.degraded else ""
    facts = [
        f"Features: {report.features}, in {params.color_space}, {params.length} values ({parts})",
        f"Training: C = {report.C:g}, {mirrored}, seed {report.random_state}",
        f"Versions: {versions}",
    ]
    text = [
        "# Model card",
        "A linear SVM that tells 64x64 RGB patches with a vehicle from those without, to search images with.",
        "\n".join(_wrap(fact, "- ") for fact in facts),
    ]
    if command:
        text += [
            "Made by",
            f"```bash\n{command}\n```",
            "Again, with the same versions, it makes the same file.",
        ]
    return text


def _data(report: TrainingReport) -> list[str]:
    total = report.vehicles + report.non_vehicles
    counts = (
        f"{report.vehicles:,} patches of vehicles and {report.non_vehicles:,} of anything else "
        f"({report.balance:.1%} vehicles). The model is trained on all {total:,}."
    )
    if any(source.startswith(("GTI", "KITTI")) for source in report.sources):
        licence = (
            "Licence: the patches come from the GTI vehicle image database and the KITTI benchmark, both "
            "CC BY-NC-SA 3.0. The model is made of them and inherits the note: non-commercial use, with "
            "attribution."
        )
    else:
        licence = "Licence: the model inherits the terms of the patches it is made of."
    return [
        "## Data",
        _wrap(counts),
        _table(("source", "patches"), [(name, f"{count:,}") for name, count in report.sources.items()]),
        f"Fingerprint of the patches (SHA-256): `{report.fingerprint}`",
        _wrap(licence),
    ]


def _accuracy(report: TrainingReport, others: Sequence[TrainingReport]) -> list[str]:
    how = (
        "Scaler and SVM are fitted on the training part of a split alone and judged on the other. A "
        "near duplicate is a tested patch much like one of the training patches: the correlation of their 16x16 "
        "gray thumbnails is 0.95 or more."
    )
    if "random" in report.splits:
        seeds = len(report.splits["random"].accuracies)
        how += f" The random split is the mean of {seeds} seed{'s' * (seeds > 1)}."
    columns = (
        "tested on",
        "trained",
        "tested",
        "accuracy",
        "missed vehicles",
        "false vehicles",
        "near duplicates",
    )
    rows = [
        (
            SPLITS[name],
            f"{score.train:,}",
            f"{score.test:,}",
            f"{score.accuracy:.4f}",
            f"{score.false_negative_rate:.2%}",
            f"{score.false_positive_rate:.2%}",
            f"{score.leakage:.1%}",
        )
        for name, score in report.splits.items()
    ]
    text = ["## Accuracy", _wrap(how), _table(columns, rows)]
    if report.calibration_error is not None:
        text.append(
            _wrap(
                f"Probabilities: the expected calibration error is {report.calibration_error:.4f} on the "
                "last fifth of each folder, with Platt's sigmoid fitted on the last fifth of the rest."
            )
        )
    if others:
        names = [name for name in SPLITS if name in report.splits]
        accuracies = [
            (each.features, str(each.params.length), *(f"{each.splits[name].accuracy:.4f}" for name in names))
            for each in (report, *others)
        ]
        heads = ("features", "length", *(SPLITS[name] for name in names))
        text += ["Other features, trained and judged in the same way:", _table(heads, accuracies)]
    return text


def _limits(report: TrainingReport) -> list[str]:
    lines = [
        "The accuracy is that of patches, not of vehicles found in frames, where most windows show none."
    ]
    if "random" in report.splits:
        lines.append(
            "Neighboring patches show the same vehicle from one frame to the next: a random split tests on "
            "near duplicates of what it trained on, which flatters."
        )
    if "KITTI_extracted" in report.sources:
        lines.append(
            "The numbers of `KITTI_extracted` are shuffled: the split by sequences leaks there as the random "
            "one does. Only the cross-source rows test on another camera and other roads."
        )
    if "Extras" in report.sources:
        lines.append(
            "`Extras` holds crops of the road of the course's project video: scores on clips of that road "
            "are flattered."
        )
    lines.append(
        "The patches show mostly cars from behind, by day. Trucks, buses, motorcycles, vehicles straight "
        "from the side, night and heavy rain are rare among them or missing."
    )
    return lines


def _wrap(text: str, mark: str = "") -> str:
    return textwrap.fill(
        text, 110, initial_indent=mark, subsequent_indent=" " * len(mark), break_on_hyphens=False
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


__all__ = ["SPLITS", "SplitScore", "TrainingReport", "model_card", "train_and_evaluate"]

_OTHERS = ("KITTI", "Extras")


def train_and_evaluate(
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
    >>> from vehicle_detection.synthetic import render_patches
    >>> patches, labels = render_patches(20)
    >>> names = [f"{'vehicles' if label else 'others'}/drawn/{n}.png" for n, label in enumerate(labels)]
    >>> small = FeatureParams(hog_channel=0)
    >>> classifier, report = train_and_evaluate(PatchSet(patches, labels, names), params=small, seeds=2)
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
        false_negative_rate=float(np.mean(missed)),
        false_positive_rate=float(np.mean(false)),
        train=len(split.train),
        test=len(split.test),
        leakage=leakage,
    )


def _facts(report: TrainingReport) -> dict[str, Any]:
    """Choose what the model file tells: nothing that changes from one run to the next."""
    splits = {
        name: {
            "accuracy": round(score.accuracy, 5),
            "false_negative_rate": round(score.false_negative_rate, 5),
            "false_positive_rate": round(score.false_positive_rate, 5),
            "near_duplicates": round(score.leakage, 3),
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
