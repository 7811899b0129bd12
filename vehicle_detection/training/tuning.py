"""Comparison of configurations of features and training, on patches, on frames and in time.

Every trial is one row of a table. With a store, each row is on disk as soon as it is measured, so an
interrupted run continues where it stopped, and a run with more configurations measures only the new ones.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import logging
import math
import os
import time
import timeit
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid, is_listing, progress_bar
from vehicle_detection.datasets import (
    SEEDED_SPLITS,
    SPLIT_NAMES,
    PatchSet,
    Split,
    check_labels,
    check_split,
    make_split,
)
from vehicle_detection.detector import Detector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, best_f1, evaluate_detections, precision_recall_curve
from vehicle_detection.features import FeatureParams
from vehicle_detection.regions import RegionParams
from vehicle_detection.search import SearchParams
from vehicle_detection.svm import VehicleClassifier
from vehicle_detection.tables import TrackTable
from vehicle_detection.training.classifier import DEFAULT_C, TrainingOptions, fit_features, train_classifier
from vehicle_detection.training.feature_cache import FeatureCache, digest_of
from vehicle_detection.training.results import RowStore, make_table

if TYPE_CHECKING:
    from pandas import DataFrame

_FEATURES = tuple(field.name for field in dataclasses.fields(FeatureParams))
_TRAINING: dict[str, Any] = {"C": DEFAULT_C, "mirror": True, "positive_weight": 1.0}
_FIELDS = (*_FEATURES, *_TRAINING)
_FRAME_METRICS = ("frame_f1", "frame_best_f1", "frame_average_precision", "frame_iou")

COLUMNS = (
    "status", "message", "configuration", *_FEATURES, "n_features", *_TRAINING, "split", "seed",
    "train_size", "test_size", "train_accuracy", "accuracy", *_FRAME_METRICS, "frame_f1_by_set", "search_ms",
    "fit_seconds", "trial",
)  # fmt: skip
"""Columns of a row; `compare_configurations` documents them."""

_TIMED_SHAPE, _TIMED_RUNS = (720, 1280), 15
_MAX_COMBINATIONS = 100_000
# Patches in the first round of successive halving: with fewer, scores are too noisy to rank candidates.
_MIN_PATCHES = 300
_BOOLEANS = {"true": True, "yes": True, "false": False, "no": False}

_LOGGER = logging.getLogger(__name__)

Configuration = FeatureParams | Mapping[str, Any] | str
"""`FeatureParams`, a preset's name, or a mapping of fields of `FeatureParams` and of training options."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialOptions:
    """What each trial measures besides the accuracy on patches, and its resources.

    >>> TrialOptions(time_search=False).frame_sets
    ()
    """

    #: Sets of labelled frames of different names, on which classifiers are evaluated without tracking.
    frames: LabelledFrames | Sequence[LabelledFrames] | None = None
    search_params: SearchParams = dataclasses.field(default_factory=SearchParams.preset)
    region_params: RegionParams = dataclasses.field(default_factory=RegionParams)
    #: Measure the time of the fast search of a 1280x720 frame with `search_params` on one core.
    time_search: bool = True
    #: Folder that keeps features between runs, or a `FeatureCache` of the same patches.
    cache: FeatureCache | str | os.PathLike[str] | None = None
    jobs: int | None = None  #: threads of the feature extraction

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", self.frame_sets)  # a generator can be read only once
        for each in self.frame_sets:
            check.instance(each, "frames", LabelledFrames, "pass LabelledFrames(name, images, labels)")
        if len({each.name for each in self.frame_sets}) < len(self.frame_sets):
            raise InvalidInputError("frames must have different names; pass name=")

    @property
    def frame_sets(self) -> tuple[LabelledFrames, ...]:
        """The sets of `frames` as a tuple."""
        if self.frames is None:
            return ()
        if isinstance(self.frames, LabelledFrames):
            return (self.frames,)
        return check.sequence(self.frames, "frames", "LabelledFrames")


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
    values = [C] if isinstance(C, (int, float)) else check.sequence(C, "C", "numbers")
    if not values:
        raise InvalidInputError("C must be a number or several; got none")
    for value in values:
        check.number(value, "C")
    candidates = read_configurations(configurations, values)
    parts: list[Any] = list(_make_splits(patch_set, splits, _check_seeds(seeds)))
    trials, stored, rows = Trials(patch_set, options), RowStore(store, COLUMNS), []
    # Those of one name follow each other; they have the same features, which the cache computes once.
    names = [*dict.fromkeys(each.name for each in candidates)]
    candidates.sort(key=lambda candidate: names.index(candidate.name))
    none: list[Any] = [(None, None, None)]  # an impossible candidate has one row
    plan = [(each, part) for each in candidates for part in (none if each.error else parts)]
    with progress_bar(progress, len(plan), unit="trial") as bar:
        for candidate, (name, seed, split) in plan:
            trial = trials.digest(candidate, split, seed)
            row = dict(stored.get(trial) or candidate.columns | trials.measure(candidate, split, seed))
            row |= {"configuration": candidate.name, "split": name, "seed": seed, "trial": trial}
            rows.append({column: row.get(column) for column in COLUMNS})
            bar.update()
            if trial not in stored:
                stored.add(rows[-1])
                level = logging.WARNING if row.get("accuracy") is None else logging.INFO
                outcome = row.get("message") or row["accuracy"]
                _LOGGER.log(level, "%s, C=%s: %s: %s", candidate.name, row["C"], row["status"], outcome)
    return make_table(rows, COLUMNS)


def halve_configurations(
    patch_set: PatchSet,
    configurations: Sequence[Configuration],
    count: int,
    *,
    split: str = "sequences",
    random_state: int = 0,
) -> list[dict[str, Any]]:
    """Select the `count` best configurations by successive halving, best first; all if there are no more.

    All are ranked on few patches of a split, the best third continues with three times as many, and so on
    (scikit-learn's ``HalvingGridSearchCV``). Impossible ones are left out.
    """
    import pandas as pd
    from sklearn.base import BaseEstimator
    from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - enables the next import
    from sklearn.model_selection import HalvingGridSearchCV

    class Trial(BaseEstimator):  # type: ignore[misc]
        """A candidate as an estimator of patches."""

        def __init__(self, candidate: Any = None) -> None:
            self.candidate = candidate

        def fit(self, X: NDArray[np.uint8], y: NDArray[np.int64]) -> Trial:
            options = dataclasses.replace(self.candidate.training, random_state=random_state)
            self.model_ = train_classifier(X, y, params=self.candidate.params, options=options)
            return self

        def score(self, X: NDArray[np.uint8], y: NDArray[np.int64]) -> float:
            return self.model_.score(X, y)

    check.integer(count, "count", low=1)
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
    results = pd.DataFrame(search.fit(patch_set.patches, patch_set.labels.astype(np.int64)).cv_results_)
    results = results.sort_values(["iter", "mean_test_score"], ascending=False)
    return [each.options for each in results["param_candidate"].drop_duplicates()[:count]]


def expand_grid(grid: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """List all combinations of a grid's values; the last name varies fastest.

    >>> expand_grid({"orient": [8, 9], "C": [1e-4]})
    [{'orient': 8, 'C': 0.0001}, {'orient': 9, 'C': 0.0001}]
    """
    given: object = grid
    if not isinstance(given, Mapping) or not given:
        raise invalid("grid", f"map option names ({', '.join(_FIELDS)}) to lists of values", given)
    _check_names(grid, "grid")
    lists = [list(values) if is_listing(values) else [] for values in grid.values()]
    for name, values in zip(grid, lists):
        if not values:
            raise invalid(f"grid[{name!r}]", "be a list of values, one or more", grid[name])
    count = math.prod(map(len, lists))
    if count > _MAX_COMBINATIONS:
        raise InvalidInputError(f"grid must have at most {_MAX_COMBINATIONS} combinations; got {count}")
    return [dict(zip(grid, values)) for values in itertools.product(*lists)]


def parse_grid(text: str) -> dict[str, list[Any]]:
    """Parse a grid from the command line.

    >>> parse_grid("orient=8,9 hog_channel=ALL,0 C=1e-4")
    {'orient': [8, 9], 'hog_channel': ['ALL', 0], 'C': [0.0001]}
    """
    grid: dict[str, list[Any]] = {}
    for part in text.split():
        name, sign, values = part.partition("=")
        if not sign or not name or not all(values.split(",")):
            raise InvalidInputError(
                "grid must look like 'orient=8,9 color_space=YCrCb,LAB', with commas and no spaces between "
                f"values; got {part!r}"
            )
        if name in grid:
            raise InvalidInputError(f"grid names {name} twice; put all its values into one list")
        grid[name] = [_BOOLEANS.get(each.lower(), _number_or_text(each)) for each in values.split(",")]
    if not grid:
        raise InvalidInputError("grid is empty; name at least one option, such as 'orient=8,9'")
    return grid


def _number_or_text(text: str) -> int | float | str:
    """Parse a text as an integer, else as a float, else return it unchanged."""
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


@dataclass(frozen=True)
class Candidate:
    """Features and training options of one classifier; an impossible combination has only an error."""

    name: str = dataclasses.field(compare=False)
    columns: dict[str, Any] = dataclasses.field(compare=False)  # of a row
    params: FeatureParams | None = None
    training: TrainingOptions | None = None
    error: str | None = None

    @property
    def options(self) -> dict[str, Any]:
        """The configuration as a mapping."""
        return {name: value for name, value in self.columns.items() if name != "n_features"}


def read_configurations(
    configurations: Mapping[str, Configuration] | Sequence[Configuration], C: Sequence[float] = (DEFAULT_C,)
) -> list[Candidate]:
    """Check each configuration; one that does not set `C` is a candidate with each of these values."""
    given: object = configurations
    if isinstance(given, Mapping):
        pairs: list[tuple[str | None, Any]] = list(given.items())
    else:
        pairs = [(None, each) for each in given] if is_listing(given) else []
    if not pairs:
        must = "be a mapping from names to FeatureParams or a list of them, with at least one entry"
        raise invalid("configurations", must, given)
    read = [(name, _read_options(configuration)) for name, configuration in pairs]
    return [
        _make_candidate(name, {**_TRAINING, "C": value, **options})
        for name, options in read
        for value in (C if "C" not in options else C[:1])
    ]


def _read_options(configuration: object) -> dict[str, Any]:
    """Options of a configuration in any of its forms."""
    if isinstance(configuration, str):
        configuration = FeatureParams.preset(configuration)
    if isinstance(configuration, FeatureParams):
        configuration = dataclasses.asdict(configuration)
    if not isinstance(configuration, Mapping):
        must = "be FeatureParams, a mapping of options or a preset's name"
        raise invalid("a configuration", must, configuration)
    _check_names(configuration, "configuration")
    return dict(configuration)


def _check_names(options: Mapping[str, Any], name: str) -> None:
    unknown = [key for key in options if key not in _FIELDS]
    if unknown:
        raise InvalidInputError(f"{name} has the unknown option {unknown[0]!r}; use {', '.join(_FIELDS)}")


def _make_candidate(name: str | None, options: Mapping[str, Any]) -> Candidate:
    features = {key: value for key, value in options.items() if key not in _TRAINING}
    try:
        params = FeatureParams(**features)
        training = TrainingOptions(**{key: options[key] for key in _TRAINING})
    except InvalidInputError as error:
        return Candidate(name or _join_options(features), dict(options), error=str(error))
    columns = {**dataclasses.asdict(params), "n_features": params.length}
    columns |= {key: getattr(training, key) for key in _TRAINING}
    return Candidate(name or _describe_params(params), columns, params, training)


def _describe_params(params: FeatureParams) -> str:
    """Name features by their preset, or else by the fields that differ from the defaults."""
    for preset in FeatureParams.PRESETS:
        if FeatureParams.preset(preset) == params:
            return preset
    defaults, values = dataclasses.asdict(FeatureParams()), dataclasses.asdict(params)
    return _join_options({key: value for key, value in values.items() if value != defaults[key]})


def _join_options(options: Mapping[str, Any]) -> str:
    return " ".join(f"{key}={value}" for key, value in options.items()) or "default"


def _make_splits(
    patch_set: PatchSet, splits: str | Sequence[str] | Mapping[str, Split], seeds: tuple[int, ...]
) -> Iterator[tuple[str, int, Split]]:
    """Name, seed and rows of each split."""
    if isinstance(splits, Mapping):
        if not splits:
            raise InvalidInputError("splits must map names to Split; got none")
        for name, split in splits.items():
            check_split(split, patch_set, f"splits[{name!r}]")
            yield str(name), seeds[0], split
        return
    names = (splits,) if isinstance(splits, str) else check.sequence(splits, "splits", "names of splits")
    if not names:
        raise InvalidInputError(f"splits must name at least one of {', '.join(SPLIT_NAMES)}")
    for name in names:
        check.choice(name, "splits", SPLIT_NAMES)
        for seed in seeds if name in SEEDED_SPLITS else seeds[:1]:
            yield name, seed, make_split(patch_set, name, random_state=seed)


def _check_seeds(seeds: object) -> tuple[int, ...]:
    """Return the seeds if they are different integers."""
    listed = seeds if is_listing(seeds) else ()
    checked = tuple(check.integer(seed, "seeds", low=0, high=2**32 - 1) for seed in listed)
    if not checked or len(set(checked)) < len(checked):
        raise invalid("seeds", "be a list of different integers, such as range(5)", seeds)
    return checked


class Trials:
    """Trains and measures candidates on patches."""

    def __init__(self, patch_set: PatchSet, options: TrialOptions | None) -> None:
        options = TrialOptions() if options is None else options
        check.instance(options, "options", TrialOptions, "omit it for the defaults")
        check.instance(patch_set, "patch_set", PatchSet, "read one with load_training_patches")
        cache = options.cache
        if not isinstance(cache, FeatureCache):
            cache = FeatureCache(patch_set.patches, folder=cache, jobs=options.jobs)
        elif cache.patches is not patch_set.patches:
            raise InvalidInputError(
                "cache must be a FeatureCache of the patches of patch_set; make one from patch_set.patches"
            )
        self._cache, self._options = cache, options
        self._labels = patch_set.labels.astype(np.int64)
        self._search_ms: dict[FeatureParams, float] = {}
        used: dict[str, Any] = {"timed": options.time_search}
        if options.time_search or options.frame_sets:
            used["search"] = dataclasses.asdict(options.search_params)
        if options.frame_sets:
            used["regions"] = dataclasses.asdict(options.region_params)
            used["frames"] = [_digest_frames(each) for each in options.frame_sets]
        self._digest = digest_of(cache.digest, self._labels, used)

    def digest(self, candidate: Candidate, split: Split | None, seed: int | None) -> str:
        """Hash of all that a trial depends on, but for the pixels of frames, the version and the machine."""
        return digest_of(self._digest, candidate.columns, *(split or ()), seed)

    def measure(self, candidate: Candidate, split: Split, seed: int) -> dict[str, Any]:
        """Train and measure; the columns that a measurement fills."""
        if candidate.error:
            return {"status": "failed", "message": candidate.error}
        options, row = self._options, {"train_size": len(split.train), "test_size": len(split.test)}
        start = time.perf_counter()
        try:
            classifier = self.train(candidate, split.train, seed)
        except InvalidInputError as error:
            return {"status": "failed", "message": str(error), **row}
        measured = {"fit_seconds": round(time.perf_counter() - start, 3)}
        features = self._features(candidate)
        for name, rows in (("train_accuracy", split.train), ("accuracy", split.test)):
            measured[name] = classifier.score(features[rows], self._labels[rows])
        if options.frame_sets or options.time_search:
            try:
                classifier.open_search(jobs=1).close()
            except InvalidInputError as error:
                return {"status": "partial", "message": str(error), **row, **measured}
            if options.time_search:
                measured["search_ms"] = self._time_search(classifier)
            if options.frame_sets:
                measured |= self._score_frames(classifier)
        return {"status": "ok", **row, **measured}

    def train(self, candidate: Candidate, rows: NDArray[np.intp], seed: int) -> VehicleClassifier:
        """Train on some of the patches; equal to `train_classifier` on them."""
        assert candidate.params is not None
        assert candidate.training is not None
        check_labels(self._labels[rows], both=True)
        options = dataclasses.replace(candidate.training, random_state=seed)
        return fit_features(self._features(candidate), self._labels, candidate.params, options, rows=rows)

    def _features(self, candidate: Candidate) -> NDArray[np.float32]:
        assert candidate.params is not None
        return self._cache.features(candidate.params, mirror=candidate.columns["mirror"])

    def _score_frames(self, classifier: VehicleClassifier) -> dict[str, Any]:
        """Mean of each metric over the sets of frames, and the F1 score of each set as text."""
        import pandas as pd

        rows = {}
        for frames in self._options.frame_sets:
            search = self._options.search_params.with_horizon(frames.horizon)
            regions = self._options.region_params
            with Detector(classifier, search_params=search, region_params=regions) as detector:
                found = TrackTable.from_detections({key: detector.detect(image) for key, image in frames})
            scores = evaluate_detections(found, frames.labels, frames=frames.keys)
            best, _ = best_f1(*precision_recall_curve(found, frames.labels))
            rows[frames.name] = scores.f1, best, scores.average_precision, scores.mean_iou
        by_set = "; ".join(f"{name} {f1:.4f}" for name, (f1, *_) in rows.items())
        # The mean of a metric without any value is NaN.
        return {**pd.DataFrame(rows, _FRAME_METRICS).mean(axis=1), "frame_f1_by_set": by_set}

    def _time_search(self, classifier: VehicleClassifier) -> float:
        """Milliseconds of the fast search of a 1280x720 frame on one core: the fastest of several runs."""
        if classifier.params not in self._search_ms:
            frame = np.random.default_rng(0).integers(0, 256, (*_TIMED_SHAPE, 3), np.uint8)
            with contextlib.closing(classifier.open_search(jobs=1)) as search:
                run = functools.partial(search.find, frame, self._options.search_params)
                # The first run compiles kernels and allocates buffers.
                _, *seconds = timeit.repeat(run, number=1, repeat=_TIMED_RUNS + 1)
            self._search_ms[classifier.params] = round(min(seconds) * 1000, 3)
        return self._search_ms[classifier.params]


def _digest_frames(frames: LabelledFrames) -> str:
    """Hash of a set's name, frame keys and labels; hashing the images would take too long."""
    labels = frames.labels
    keys = [list(map(str, frames.keys)), list(map(str, labels["frame"])), frames.horizon]
    return digest_of(frames.name, keys, labels.boxes, labels["ignore"], labels["track_id"])
