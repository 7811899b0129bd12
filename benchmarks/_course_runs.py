"""The runs behind the course's tables; each is stored in a file as soon as it is done."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vehicle_detection.datasets import PatchSet, Split, make_split, split_leakage
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.scenes import render_scene
from vehicle_detection.search import SearchParams
from vehicle_detection.svm import Template, VehicleClassifier
from vehicle_detection.training import (
    FeatureCache,
    RowStore,
    TrainingOptions,
    TrialOptions,
    compare_configurations,
    digest_of,
    fit_features,
    make_table,
    to_pipeline,
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
    """Configurations of one table, the values of C and the splits on which they are evaluated."""

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
        {"HOG of L": FIRST, "HOG of L, U and V": _changed(FIRST, hog_channel="ALL")}, (COURSE_C,), SPLITS[:3]
    ),
}
"""Tables of linear SVMs by name."""


class Runs:
    """Patches, their splits, and the measurements on them.

    `folder` holds the rows of finished runs, so that a killed run continues.
    """

    def __init__(self, patch_set: PatchSet, folder: Path) -> None:
        self.patch_set = patch_set
        self._svm_rows = folder / "rows.jsonl"
        self._extra = RowStore(folder / "extra_rows.jsonl", _EXTRA_COLUMNS)
        self.cache = FeatureCache(patch_set.patches)
        seeds = {"random": SEEDS, "groups": SEEDS}
        self._splits = {
            name: [
                make_split(patch_set, name.lower().replace(" ", "_"), random_state=seed)
                for seed in seeds.get(name, SEEDS[:1])
            ]
            for name in SPLITS
        }

    def parts(self, splits: Sequence[str]) -> Iterator[tuple[str, int, Split]]:
        """Name, seed and rows of each split; random splits once for each seed."""
        for name in splits:
            for seed, split in zip(SEEDS, self._splits[name]):
                yield name, seed, split

    def compare(self, plan: Plan) -> pd.DataFrame:
        """All trials of linear SVMs of a plan."""
        options = TrialOptions(cache=self.cache, time_search=False)
        tables = [
            compare_configurations(
                self.patch_set,
                {name: {**asdict(params), "mirror": False}},
                splits={part: split},
                seeds=[seed],
                C=plan.C,
                options=options,
                store=self._svm_rows,
            )
            for name, params in plan.configurations.items()
            for part, seed, split in self.parts(plan.splits)
        ]
        return pd.concat(tables, ignore_index=True)

    @cached_property
    def search_times(self) -> dict[FeatureParams, float]:
        """Milliseconds of the fast search of a 1280x720 frame on one core: the fastest of several runs.

        The configurations alternate, so that other load on the machine affects all of them.
        """
        frame = render_scene(random_state=0).image
        search = SearchParams.preset()
        listed = {params for plan in PLANS.values() for params in plan.configurations.values()}
        with ExitStack() as stack:
            searches = {
                params: stack.enter_context(closing(_zero_classifier(params).open_search(jobs=1)))
                for params in listed
            }
            turns = [
                {params: _seconds(partial(each.find, frame, search)) for params, each in searches.items()}
                for _ in range(_TIMED_RUNS + 1)  # The first run compiles kernels.
            ]
        return {params: min(turn[params] for turn in turns[1:]) * 1000 for params in listed}

    def bayes(self) -> pd.DataFrame:
        """Gaussian naive Bayes on the second system's features."""
        from sklearn.naive_bayes import GaussianNB
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        rows = []
        for name, seed, split in self.parts(SPLITS[:3]):
            trial = digest_of(self.cache.digest, "bayes", split.train, split.test)
            if trial not in self._extra:
                model = make_pipeline(StandardScaler(), GaussianNB()).fit(*self._side(SECOND, split.train))
                accuracy = float(model.score(*self._side(SECOND, split.test)))
                self._add(trial, "bayes", "naive Bayes", split=name, seed=seed, accuracy=accuracy)
            rows.append({"configuration": "naive Bayes", "C": None, **self._extra[trial]})
        return make_table(rows)

    def first_predictions(self, count: int = 15) -> pd.DataFrame:
        """Labels and predictions of both classifiers for some test samples of the first random split."""
        split = self._splits["random"][0]
        chosen = np.random.default_rng(0).permutation(split.test)[:count]
        trial = digest_of(self.cache.digest, "answers", split.train, chosen)
        models = ("truth", "naive Bayes", "linear SVM")
        if f"{trial} {models[-1]}" not in self._extra:
            from sklearn.naive_bayes import GaussianNB
            from sklearn.pipeline import make_pipeline
            from sklearn.preprocessing import StandardScaler

            features, labels = self._side(SECOND, split.train)
            tested = self._side(SECOND, chosen)[0]
            bayes = make_pipeline(StandardScaler(copy=False), GaussianNB())
            bayes.fit(features.copy(), labels)
            svm = _fit_svm(SECOND, features, labels)
            answers = (self._labels(chosen), bayes.predict(tested.copy()), svm.predict(tested))
            for model, predicted in zip(models, answers):
                text = "".join("V" if answer else "-" for answer in predicted)
                self._add(f"{trial} {model}", "answers", model, answers=text)
        return make_table([self._extra[f"{trial} {model}"] for model in models], _EXTRA_COLUMNS)

    def prediction_times(self) -> pd.DataFrame:
        """Milliseconds of the first system for the test samples of a random split, run by run."""
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

            classifier = _fit_svm(FIRST, *self._side(FIRST, split.train))
            (_, scaler), (_, svm) = to_pipeline(classifier).steps[1:]
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
        return make_table({**row, "samples": len(split.test)} for row in rows)

    def leakage(self, thresholds: Sequence[float] = (0.9, 0.95, 0.98)) -> pd.DataFrame:
        """Fraction of each split's test patches with a near duplicate in the training part."""
        rows = []
        for name, seed, split in self.parts(SPLITS):
            fractions = {
                f"leakage_{limit:g}": split_leakage(self.patch_set, split, threshold=limit)
                for limit in thresholds
            }
            rows.append(
                {"split": name, "seed": seed, "train": len(split.train), "test": len(split.test), **fractions}
            )
        return make_table(rows)

    def _labels(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        return self.patch_set.labels[rows].astype(np.int64)

    def _side(
        self, params: FeatureParams, rows: NDArray[np.intp]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        return self.cache.features(params)[rows], self._labels(rows)

    def _add(self, trial: str, table: str, model: str, **cells: Any) -> None:
        self._extra.add(
            {**dict.fromkeys(_EXTRA_COLUMNS), "trial": trial, "table": table, "model": model, **cells}
        )


def summarize(
    table: pd.DataFrame,
    by: Sequence[str] = ("configuration", "C", "split"),
    values: Sequence[str] = ("accuracy",),
) -> pd.DataFrame:
    """Number of runs, mean and standard deviation of each group of rows, in the order of the rows."""
    groups = table.dropna(subset=list(values)).groupby(list(by), sort=False, dropna=False)
    columns = {"runs": groups.size()}
    for name in values:
        columns |= {name: groups[name].mean(), f"{name}_std": groups[name].std()}
    return pd.DataFrame(columns).reset_index()


def _fit_svm(
    params: FeatureParams, features: NDArray[np.float32], labels: NDArray[np.int64]
) -> VehicleClassifier:
    return fit_features(features, labels, params, TrainingOptions(C=COURSE_C, mirror=False))


def _zero_classifier(params: FeatureParams) -> VehicleClassifier:
    """A classifier without detections: the time of a search does not depend on the weights."""
    ones = np.ones(params.length)
    return VehicleClassifier(params, (Template(0 * ones, ones, 0 * ones, -1.0),))


def _seconds(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return round(time.perf_counter() - began, 6)
