"""Train a patch classifier, evaluate it on splits of its patches, and write its model card."""

from __future__ import annotations

import dataclasses
import re
import textwrap
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, pluralize, progress_bar, resolve_jobs
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    check_labels,
    make_split,
    split_leakage,
    split_sequences,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import calibrate_scores, calibration_error
from vehicle_detection.features import FeatureParams
from vehicle_detection.svm import VehicleClassifier
from vehicle_detection.training.classifier import (
    TrainingOptions,
    check_training,
    fit_features,
    patch_features,
)

SPLITS = {
    "random": "random fifth",
    "sequences": "last fifth of each folder",
    "gti_to_kitti": "KITTI and Extras, trained on GTI",
    "kitti_to_gti": "GTI, trained on KITTI and Extras",
}
"""Splits that a model is evaluated on, with a description of the test part."""

_COURSE_SPLITS = ("gti_to_kitti", "kitti_to_gti")


@dataclass(frozen=True, kw_only=True)
class SplitScore:
    """Scores of a classifier on the test part of a split; rates are means over the seeds."""

    accuracies: tuple[float, ...]  # Fraction of correct predictions, one for each seed.
    false_negative_rate: float  # Fraction of the tested vehicles that are missed.
    false_positive_rate: float  # Fraction of the tested non-vehicles that are taken for vehicles.
    train: int  # Number of training patches.
    test: int  # Number of test patches.
    leakage: float  # Fraction of test patches with a near duplicate in the training part, first seed.

    @property
    def accuracy(self) -> float:
        """Mean fraction of correct predictions."""
        return float(np.mean(self.accuracies))


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """Options and results of `train_and_evaluate`; `split` is the split whose accuracy is reported.

    `seconds`: work time per step; concurrent fits are summed, so the total may exceed the elapsed time.
    `calibration_error`: on the test part of ``"sequences"``, with the sigmoid fitted on a second such split
    of the training part; None if that split is impossible.

    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> names = [f"{'vehicles' if label else 'others'}/drawn/{n}.png" for n, label in enumerate(labels)]
    >>> _, report = train_and_evaluate(PatchSet(patches, labels, names), params=FeatureParams(hog_channel=0))
    >>> report.split, report.vehicles, report.sources
    ('random', 10, {'drawn': 20})
    """

    params: FeatureParams
    options: TrainingOptions
    split: str
    sources: dict[str, int]  # number of patches of each source folder
    vehicles: int
    non_vehicles: int
    fingerprint: str  # of the patches, see `PatchSet`
    splits: dict[str, SplitScore]
    calibration_error: float | None
    skipped: dict[str, str]  # splits that the patches do not allow, with the reason
    seconds: dict[str, float]

    @property
    def accuracy(self) -> float:
        """Accuracy on `split`."""
        return self.splits[self.split].accuracy

    @property
    def balance(self) -> float:
        """Fraction of vehicles among the patches."""
        return self.vehicles / (self.vehicles + self.non_vehicles)

    @property
    def features(self) -> str:
        """Name of the feature preset, or the number of features if they are no preset."""
        known = (name for name in FeatureParams.PRESETS if FeatureParams.preset(name) == self.params)
        return next(known, f"{self.params.length} features")

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON values."""
        derived = {"accuracy": self.accuracy, "balance": self.balance, "features": self.features}
        plain: dict[str, Any] = asdict(self) | derived | self.options.to_dict()
        del plain["options"]
        splits = {name: {"accuracy": score.accuracy, **asdict(score)} for name, score in self.splits.items()}
        return plain | {"splits": splits}


def train_and_evaluate(
    patch_set: PatchSet,
    *,
    params: FeatureParams | None = None,
    options: TrainingOptions | None = None,
    split: Literal["random", "sequences"] = "random",
    seeds: int = 5,
    jobs: int | None = None,
    progress: bool = False,
) -> tuple[VehicleClassifier, TrainingReport]:
    """Evaluate a classifier on several splits, then train it on all patches.

    On each split, scaler and SVM are fitted on the training part and its mirrored and degraded copies
    (`TrainingOptions`), and evaluated on the unchanged test part. Returns the classifier, whose metadata also
    hold the metrics and the patches' counts and fingerprint, and a report with all results and the time of
    each step.

    Parameters
    ----------
    patch_set
        Patches of both classes.
    params, options
        As in `train_classifier`; the seed is also that of the first random split.
    split
        Split whose accuracy is reported as the model's. Others are skipped if the patches do not allow them.
    seeds, jobs
        Number of random splits; and threads, on which the result does not depend.
    progress
        Show a progress bar if standard error is a terminal.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> names = [f"{'vehicles' if label else 'others'}/drawn/{n}.png" for n, label in enumerate(labels)]
    >>> small = FeatureParams(hog_channel=0)
    >>> classifier, report = train_and_evaluate(PatchSet(patches, labels, names), params=small, seeds=2)
    >>> sorted(report.splits), len(report.splits["random"].accuracies), report.vehicles
    (['random', 'sequences'], 2, 10)
    """
    check.instance(patch_set, "patch_set", PatchSet, "read one with load_training_patches")
    labels = check_labels(patch_set.labels, both=True).astype(np.int64)
    params, options = check_training(params, options)
    check.choice(split, "split", ("random", "sequences"))
    check.integer(seeds, "seeds", low=1, high=1000)
    random_state = check.integer(options.random_state, "random_state", low=0, high=2**32 - seeds)
    splits, skipped = _make_splits(patch_set, split, range(random_state, random_state + seeds))
    inner = _inner_split(patch_set, splits["sequences"][0]) if "sequences" in splits else None
    fits = [("final", None), *((name, part) for name, listed in splits.items() for part in listed)]
    fits += [("calibration", inner)] * (inner is not None)
    found: dict[str, list[Any]] = {name: [] for name, _ in fits}
    shown = progress_bar(progress, len(fits), unit="fit", interactive_only=True)
    with ThreadPoolExecutor(resolve_jobs(jobs)) as pool, shown as bar:
        features, spent = _timed(lambda: patch_features(patch_set.patches, params, options, jobs=jobs))
        seconds = defaultdict(float, features=spent)
        fit = partial(_fit, features, labels, params, options)
        running = [pool.submit(_timed, partial(fit, part)) for _, part in fits]
        for future in running:
            future.add_done_callback(lambda _: bar.update())
        try:
            leakage, seconds["leakage"] = _timed(partial(_find_leakage, patch_set, splits))
            for (name, _), future in zip(fits, running):
                result, spent = future.result()
                found[name].append(result)
                seconds[name] += spent
        finally:
            pool.shutdown(cancel_futures=True)
    (classifier,), error = found["final"], None
    if inner is not None:
        platt = calibrate_scores(found["calibration"][0], labels[inner.test])
        probability = platt.probability(found["sequences"][0])
        error = calibration_error(probability, labels[splits["sequences"][0].test])
    report = TrainingReport(
        params=params,
        options=options,
        split=split,
        sources=patch_set.counts(),
        vehicles=int(labels.sum()),
        non_vehicles=int((labels == 0).sum()),
        fingerprint=patch_set.fingerprint,
        splits={
            name: _score_split(listed, found[name], labels, leakage[name]) for name, listed in splits.items()
        },
        calibration_error=error,
        skipped=skipped,
        seconds=dict(seconds),
    )
    metadata = {**classifier.metadata, **_report_metadata(report)}
    return dataclasses.replace(classifier, metadata=metadata), report


def _fit(
    features: NDArray[np.float32],
    labels: NDArray[np.int64],
    params: FeatureParams,
    options: TrainingOptions,
    part: Split | None,
) -> Any:
    """Train on all patches; or on a part of them, and return the scores of the others."""
    rows = None if part is None else part.train
    trained = fit_features(features, labels, params, options, rows=rows)
    return trained if part is None else trained.decision_function(features[part.test])


def _find_leakage(patch_set: PatchSet, splits: dict[str, list[Split]]) -> dict[str, float]:
    """`split_leakage` of the first split of each kind."""
    return {name: split_leakage(patch_set, parts[0]) for name, parts in splits.items()}


def _make_splits(
    patch_set: PatchSet, required: str, seeds: range
) -> tuple[dict[str, list[Split]], dict[str, str]]:
    """Make the splits that the patches allow; return them, and the reasons why others are skipped."""
    splits: dict[str, list[Split]] = {}
    skipped: dict[str, str] = {}
    for name in SPLITS:
        if name in _COURSE_SPLITS and name != required and "GTI" not in patch_set.sources:
            continue  # not the course's patches
        try:
            chosen = seeds if name == "random" else seeds[:1]
            made = [make_split(patch_set, name, random_state=seed) for seed in chosen]
            if not _has_both_classes(patch_set, made[0]):
                raise InvalidInputError("one side of the split lacks a class; pass more patches")
        except InvalidInputError as error:
            if name == required:
                raise
            skipped[name] = str(error)
        else:
            splits[name] = made
    return splits, skipped


def _has_both_classes(patch_set: PatchSet, split: Split) -> bool:
    return all(len(np.unique(patch_set.labels[side])) == 2 for side in split)


def _inner_split(patch_set: PatchSet, split: Split) -> Split | None:
    """Split the training part by sequences again, to fit the sigmoid; None if that is impossible."""
    rows = split.train
    try:
        inner = Split(*(rows[part] for part in split_sequences(patch_set[rows])))
    except InvalidInputError:
        return None
    return inner if _has_both_classes(patch_set, inner) else None


def _score_split(
    splits: list[Split], found: list[NDArray[np.float64]], labels: NDArray[np.int64], leakage: float
) -> SplitScore:
    """Error rates on the test parts of the splits of one name; `found` are the scores of their patches."""
    tested = [labels[parts.test] for parts in splits]
    wrong = [(scores > 0) != truth for scores, truth in zip(found, tested)]
    return SplitScore(
        accuracies=tuple(float(1 - each.mean()) for each in wrong),
        false_negative_rate=float(np.mean([each[truth == 1].mean() for each, truth in zip(wrong, tested)])),
        false_positive_rate=float(np.mean([each[truth == 0].mean() for each, truth in zip(wrong, tested)])),
        train=len(splits[0].train),
        test=len(splits[0].test),
        leakage=leakage,
    )


def _report_metadata(report: TrainingReport) -> dict[str, Any]:
    """Part of the report that the model file keeps: nothing that differs between runs."""
    splits = {name: _split_metadata(score) for name, score in report.splits.items()}
    metrics = {"accuracy": round(report.accuracy, 5), "split": report.split, "splits": splits}
    if report.calibration_error is not None:
        metrics["calibration_error"] = round(report.calibration_error, 5)
    balance = round(report.balance, 5)
    data = {"fingerprint": report.fingerprint, "sources": report.sources, "balance": balance}
    return {"metrics": metrics, "data": data}


def _split_metadata(score: SplitScore) -> dict[str, Any]:
    return {
        "accuracy": round(score.accuracy, 5),
        "false_negative_rate": round(score.false_negative_rate, 5),
        "false_positive_rate": round(score.false_positive_rate, 5),
        "near_duplicates": round(score.leakage, 3),
        "test": score.test,
        "seeds": len(score.accuracies),
    }


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a function, and the seconds that it took."""
    start = time.perf_counter()
    return function(), time.perf_counter() - start


def model_card(
    classifier: VehicleClassifier,
    report: TrainingReport,
    *,
    name: str = "",
    others: Sequence[TrainingReport] = (),
    command: str | None = None,
) -> str:
    """Write the Markdown model card: data, license, accuracy on each split, limitations.

    `others` are reports of other features on the same patches, `command` trains the model.
    """
    from jinja2 import Environment, StrictUndefined

    names = [split for split in SPLITS if split in report.splits]
    accuracies = [
        (each.features, str(each.params.length), *(f"{each.splits[split].accuracy:.4f}" for split in names))
        for each in (report, *others)
    ]
    environment = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["plural"] = pluralize
    template = files("vehicle_detection.training").joinpath("model_card.md.j2").read_text(encoding="utf-8")
    text = environment.from_string(template).render(
        name=name,
        report=report,
        params=report.params,
        options=report.options,
        versions=[" ".join(each) for each in classifier.metadata["versions"].items()],
        command=command,
        sources=markdown_table(("source", "patches"), [(key, f"{n:,}") for key, n in report.sources.items()]),
        of_the_course=any(source.startswith(("GTI", "KITTI")) for source in report.sources),
        accuracy=markdown_table(*report_table(report)),
        others=others
        and markdown_table(("features", "length", *(SPLITS[split] for split in names)), accuracies),
    )
    return "\n\n".join(map(_wrap, re.split(r"\n{2,}", text.strip()))) + "\n"


def _wrap(part: str) -> str:
    """Wrap a paragraph or the items of a list; titles, tables and code are left as they are."""
    if part.startswith(("#", "|", "```")):
        return part
    items = re.split(r"^- ", part, flags=re.MULTILINE)
    return "\n".join(markdown_text(item, "- ") for item in items[1:]) if items[1:] else markdown_text(part)


def markdown_text(text: str, mark: str = "") -> str:
    """Wrap a paragraph, or a list item that starts with `mark`, to 110 columns."""
    indent = " " * len(mark)
    text = " ".join(text.split())
    return textwrap.fill(text, 110, initial_indent=mark, subsequent_indent=indent, break_on_hyphens=False)


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


_SPLIT_COLUMNS = {
    "train": ("trained", ","),
    "test": ("tested", ","),
    "accuracy": ("accuracy", ".4f"),
    "false_negative_rate": ("false negatives", ".2%"),
    "false_positive_rate": ("false positives", ".2%"),
    "near_duplicates": ("near duplicates", ".1%"),
}


def split_table(splits: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Column titles and rows of text for the scores of splits, as in a model's metadata.

    A model file may hold anything: unknown splits, and columns without a number, are left out.
    """

    def number(split: str, column: str) -> float | None:
        value = splits[split].get(column) if isinstance(splits[split], Mapping) else None
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            return None
        return value if abs(value) < 1e15 else None  # a longer one may not be convertible to float

    shown = [split for split in SPLITS if split in splits]
    columns = [name for name in _SPLIT_COLUMNS if any(number(split, name) is not None for split in shown)]
    rows = []
    for split in shown:
        values = ((number(split, name), _SPLIT_COLUMNS[name][1]) for name in columns)
        rows.append([SPLITS[split], *("" if value is None else f"{value:{form}}" for value, form in values)])
    return ["tested on", *(_SPLIT_COLUMNS[name][0] for name in columns)], rows


def report_table(report: TrainingReport) -> tuple[list[str], list[list[str]]]:
    """Column titles and rows of text for the splits of a report."""
    scores = report.splits.items()
    return split_table({name: {"train": score.train, **_split_metadata(score)} for name, score in scores})
