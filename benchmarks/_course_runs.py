"""The runs behind the course's tables, each kept in a file as soon as it is done."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.classifier import Template, VehicleClassifier
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)
from vehicle_detection.features import extract_features
from vehicle_detection.params import FeatureParams, SearchParams
from vehicle_detection.search import BandSearch
from vehicle_detection.synthetic import render_scene
from vehicle_detection.tuning import (
    FeatureCache,
    Recipe,
    ResultTable,
    RowStore,
    compare_configurations,
    digest_of,
    fit_features,
)

SEEDS = range(5)
_TIMED_RUNS = 15
COURSE_C, OUR_C = 1.0, 1e-4

FIRST, SECOND, THIRD = (FeatureParams.preset(name) for name in ("luv-2384", "ycrcb-6156", "ycrcb-8460"))

SPLITS = ("random", "sequences", "groups", "GTI to KITTI", "KITTI to GTI")

_EXTRA_COLUMNS = (
    "trial", "table", "model", "split", "seed", "accuracy", "milliseconds", "answers",
)  # fmt: skip


def _changed(params: FeatureParams, **changes: Any) -> FeatureParams:
    return FeatureParams(**{**asdict(params), **changes})


@dataclass(frozen=True)
class Plan:
    """Configurations of one table, the values of C and the splits that they are judged on."""

    configurations: Mapping[str, FeatureParams]
    C: Sequence[float]
    splits: Sequence[str]


PLANS = {
    "systems": Plan(
        {"first: LUV, 2384": FIRST, "second: YCrCb, 6156": SECOND, "third: YCrCb, 8460": THIRD},
        (COURSE_C, OUR_C),
        SPLITS,
    ),
    "third_configurations": Plan(
        {
            "(9, 8, 2, All)": THIRD,
            "(8, 8, 2, All)": _changed(THIRD, orient=8),
            "(9, 8, 2, Y)": _changed(THIRD, hog_channel=0),
            "(8, 16, 2, All)": _changed(THIRD, orient=8, pix_per_cell=16),
            "(12, 8, 2, Y)": _changed(THIRD, orient=12, hog_channel=0),
        },
        (COURSE_C,),
        SPLITS[:3],
    ),
    "second_ideas": Plan(
        {
            "YCrCb, all channels, 9 orientations": SECOND,
            "YCrCb, all channels, 8 orientations": _changed(SECOND, orient=8),
            "HLS, S channel, 9 orientations": _changed(SECOND, color_space="HLS", hog_channel=2),
            "HLS, S channel, 8 orientations": _changed(SECOND, color_space="HLS", hog_channel=2, orient=8),
        },
        (COURSE_C,),
        SPLITS[:3],
    ),
    "luv_channels": Plan(
        {"HOG of L": FIRST, "HOG of L, U and V": _changed(FIRST, hog_channel="ALL")},
        (COURSE_C,),
        SPLITS[:3],
    ),
}
"""Tables of linear SVMs by name."""


class Runs:
    """Patches, their splits, and what was measured on them.

    Parameters
    ----------
    patch_set
        The course's patches.
    folder
        Where the rows of finished runs are kept; a killed run goes on from there.
    """

    def __init__(self, patch_set: PatchSet, folder: Path) -> None:
        self.patch_set = patch_set
        self._svm_rows = folder / "rows.csv"
        self._extra = RowStore(folder / "extra_rows.csv", _EXTRA_COLUMNS)
        # One set of features at a time: the next configuration needs the room.
        self.cache = FeatureCache(patch_set.patches, memory_mb=0)
        self._splits = {
            "random": [split_random(patch_set, random_state=seed) for seed in SEEDS],
            "sequences": [split_sequences(patch_set)],
            "groups": [split_groups(patch_set, random_state=seed) for seed in SEEDS],
            "GTI to KITTI": [split_sources(patch_set)],
            "KITTI to GTI": [split_sources(patch_set, train=("KITTI", "Extras"), test=("GTI",))],
        }

    def parts(self, splits: Sequence[str]) -> Iterator[tuple[str, int, Split]]:
        """Name, seed and rows of each split; a random one once for each seed."""
        for name in splits:
            for seed, split in zip(SEEDS, self._splits[name]):
                yield name, seed, split

    def compare(self, plan: Plan) -> ResultTable:
        """All trials of linear SVMs that a plan asks for."""
        options: dict[str, Any] = {"C": plan.C, "mirror": False, "cache": self.cache}
        options |= {"store": self._svm_rows, "time_search": False}
        tables = [
            compare_configurations(
                self.patch_set, {name: params}, splits={part: split}, seeds=[seed], **options
            )
            for name, params in plan.configurations.items()
            for part, seed, split in self.parts(plan.splits)
        ]
        return ResultTable([row for table in tables for row in table])

    @cached_property
    def search_times(self) -> dict[FeatureParams, float]:
        """Milliseconds of the fast search of a 1280x720 frame, one core: the fastest of a few runs.

        The configurations take turns, so that a load on the machine meets all of them.
        """
        frame = render_scene(random_state=0).image
        search = SearchParams.preset()
        listed = {params for plan in PLANS.values() for params in plan.configurations.values()}
        with ExitStack() as stack:
            searches = {
                params: stack.enter_context(BandSearch(_any_classifier(params), n_jobs=1))
                for params in listed
            }
            turns = [
                {params: _seconds(partial(each.find, frame, search)) for params, each in searches.items()}
                for _ in range(_TIMED_RUNS + 1)  # The first one compiles kernels.
            ]
        return {params: min(turn[params] for turn in turns[1:]) * 1000 for params in listed}

    def bayes(self) -> ResultTable:
        """Gaussian naive Bayes on the second system's features."""
        rows = []
        for name, seed, split in self.parts(SPLITS[:3]):
            trial = digest_of(self.cache.digest, "bayes", split.train, split.test)
            if trial not in self._extra:
                accuracy = self._judge_bayes(split)
                self._add(trial, "bayes", "naive Bayes", split=name, seed=seed, accuracy=accuracy)
            rows.append({"configuration": "naive Bayes", "C": None, **self._extra[trial]})
        return ResultTable(rows)

    def _judge_bayes(self, split: Split) -> float:
        bayes = GaussianBayes()
        bayes.fit(*self._side(SECOND, split.train))
        features, labels = self._side(SECOND, split.test)
        return float((bayes.predict(features) == labels).mean())

    def first_answers(self, count: int = 15) -> ResultTable:
        """What the first test samples of the first random split are, and what both classifiers say."""
        split = self._splits["random"][0]
        chosen = np.random.default_rng(0).permutation(split.test)[:count]
        trial = digest_of(self.cache.digest, "answers", split.train, chosen)
        models = ("truth", "naive Bayes", "linear SVM")
        if f"{trial} {models[-1]}" not in self._extra:
            features, labels = self._side(SECOND, split.train)
            tested = self._side(SECOND, chosen)[0]
            bayes = GaussianBayes()
            bayes.fit(features.copy(), labels)
            svm = fit_features(features, labels, Recipe(params=SECOND, C=COURSE_C, mirror=False), 0)
            answers = (self._labels(chosen), bayes.predict(tested.copy()), svm.predict(tested))
            for model, says in zip(models, answers):
                text = "".join("V" if answer else "-" for answer in says)
                self._add(f"{trial} {model}", "answers", model, answers=text)
        return ResultTable([self._extra[f"{trial} {model}"] for model in models])

    def prediction_times(self) -> ResultTable:
        """Milliseconds that the first system takes for the test samples of a random split, run by run."""
        split = self._splits["random"][0]
        trial = digest_of(self.cache.digest, "prediction", split.train, split.test)
        names = (
            "scikit-learn, features scaled already",
            "scikit-learn, scaler and SVM",
            "VehicleClassifier",
            "VehicleClassifier, with the features",
        )
        if f"{trial} {names[-1]} {SEEDS[-1]}" not in self._extra:
            from sklearn.pipeline import make_pipeline

            classifier = fit_features(
                *self._side(FIRST, split.train), Recipe(params=FIRST, C=COURSE_C, mirror=False), 0
            )
            (_, scaler), (_, svm) = classifier.to_pipeline().steps[1:]
            both = make_pipeline(scaler, svm)
            patches = self.patch_set.patches[split.test]
            features = extract_features(patches, FIRST)
            scaled = scaler.transform(features)
            timed: tuple[Callable[[], object], ...] = (
                lambda: svm.predict(scaled),
                lambda: both.predict(features),
                lambda: classifier.predict(features),
                lambda: classifier.predict(patches),
            )
            for name, function in zip(names, timed):
                function()
                for run in SEEDS:
                    milliseconds = _seconds(function) * 1000
                    self._add(
                        f"{trial} {name} {run}", "prediction", name, seed=run, milliseconds=milliseconds
                    )
        rows = [self._extra[f"{trial} {name} {run}"] for name in names for run in SEEDS]
        return ResultTable([{**row, "samples": len(split.test)} for row in rows])

    def leakage(self, thresholds: Sequence[float] = (0.9, 0.95, 0.98)) -> ResultTable:
        """Share of each split's test patches that have a near duplicate among those trained on."""
        rows = []
        for name, seed, split in self.parts(SPLITS):
            shares = {
                f"leakage_{limit:g}": split_leakage(self.patch_set, split, threshold=limit)
                for limit in thresholds
            }
            rows.append(
                {"split": name, "seed": seed, "train": len(split.train), "test": len(split.test), **shares}
            )
        return ResultTable(rows)

    def _labels(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        return self.patch_set.labels[rows].astype(np.int64)

    def _side(
        self, params: FeatureParams, rows: NDArray[np.intp]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        return self.cache.rows(params, rows), self._labels(rows)

    def _add(self, trial: str, table: str, model: str, **cells: Any) -> None:
        self._extra.add(
            {**dict.fromkeys(_EXTRA_COLUMNS), "trial": trial, "table": table, "model": model, **cells}
        )


def _any_classifier(params: FeatureParams) -> VehicleClassifier:
    """A classifier that finds nothing: the time of a search does not depend on the weights."""
    ones = np.ones(params.length)
    return VehicleClassifier(params, (Template(0 * ones, ones, 0 * ones, -1.0),))


class GaussianBayes:
    """Scaler and Gaussian naive Bayes, as the second system tried it."""

    def __init__(self) -> None:
        from sklearn.naive_bayes import GaussianNB
        from sklearn.preprocessing import StandardScaler

        self._scaler = StandardScaler(copy=False)
        self._bayes = GaussianNB()

    def fit(self, features: NDArray[np.float32], labels: NDArray[np.int64]) -> None:
        """Fit both; the features are scaled in place."""
        self._bayes.fit(self._scaler.fit_transform(features), labels)

    def predict(self, features: NDArray[np.float32]) -> NDArray[np.int64]:
        """0 or 1 for each row; the features are scaled in place."""
        return np.asarray(self._bayes.predict(self._scaler.transform(features)), np.int64)


def _seconds(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return round(time.perf_counter() - began, 6)
