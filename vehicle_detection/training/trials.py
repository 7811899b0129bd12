"""Trials: configurations of features and training, measured on patches, on frames and in time."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_sequence, check_type, describe, is_listing
from vehicle_detection.datasets import PatchSet, Split
from vehicle_detection.detector import Detector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, best_f1, evaluate_detections, precision_recall_curve
from vehicle_detection.features import FeatureParams
from vehicle_detection.regions import RegionParams
from vehicle_detection.search import SearchParams
from vehicle_detection.svm import VehicleClassifier
from vehicle_detection.tables import TrackTable
from vehicle_detection.training.classifier import DEFAULT_C, TrainingOptions, check_labels, fit_features
from vehicle_detection.training.feature_cache import FeatureCache, digest_of
from vehicle_detection.training.results import RowStore, make_table

if TYPE_CHECKING:
    from pandas import DataFrame

FEATURE_FIELDS = tuple(field.name for field in dataclasses.fields(FeatureParams))
TRAINING_FIELDS = ("C", "mirror", "positive_weight")
_FIELDS = (*FEATURE_FIELDS, *TRAINING_FIELDS)

_FRAME_METRICS = ("frame_f1", "frame_best_f1", "frame_average_precision", "frame_iou")

COLUMNS = (
    "status", "message", "configuration", *FEATURE_FIELDS, "n_features", *TRAINING_FIELDS, "split",
    "seed", "train_size", "test_size", "train_accuracy", "accuracy", *_FRAME_METRICS, "frame_f1_by_set",
    "search_ms", "fit_seconds", "trial",
)  # fmt: skip
"""Columns of a row; `compare_configurations` documents them."""

_TIMED_SHAPE = (720, 1280)
_TIMED_RUNS = 15

_MAX_COMBINATIONS = 100_000

_BOOLEANS = {"true": True, "yes": True, "false": False, "no": False}

_LOGGER = logging.getLogger(__name__)


Configuration = FeatureParams | Mapping[str, Any] | str
"""`FeatureParams`, a preset's name, or a mapping of fields of `FeatureParams` and of training options."""


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
        raise InvalidInputError(
            "configurations must be a mapping from names to FeatureParams or a list of them, with at least "
            f"one entry; got {describe(given)}"
        )
    read = [(name, _read_options(configuration)) for name, configuration in pairs]
    return [
        _make_candidate(name, {**options, "C": value})
        for name, options in read
        for value in ([options["C"]] if "C" in options else C)
    ]


def _read_options(configuration: object) -> dict[str, Any]:
    """Options of a configuration in any of its forms."""
    if isinstance(configuration, str):
        configuration = FeatureParams.preset(configuration)
    if isinstance(configuration, FeatureParams):
        configuration = dataclasses.asdict(configuration)
    if not isinstance(configuration, Mapping):
        raise InvalidInputError(
            "a configuration must be FeatureParams, a mapping of options or a preset's name; "
            f"got {describe(configuration)}"
        )
    _check_names(configuration, "configuration")
    return dict(configuration)


def _make_candidate(name: str | None, options: Mapping[str, Any]) -> Candidate:
    values = {"mirror": True, "positive_weight": 1.0, **options}
    training = {key: values.pop(key) for key in TRAINING_FIELDS}
    try:
        params, fitting = FeatureParams(**values), TrainingOptions(**training)
    except InvalidInputError as error:
        return Candidate(name or _join_options(values), {**values, **training}, error=str(error))
    training = {key: getattr(fitting, key) for key in TRAINING_FIELDS}
    columns = {**dataclasses.asdict(params), "n_features": params.length, **training}
    return Candidate(name or describe_params(params), columns, params, fitting)


def expand_grid(grid: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """List all combinations of a grid's values; the last name varies fastest.

    >>> expand_grid({"orient": [8, 9], "C": [1e-4]})
    [{'orient': 8, 'C': 0.0001}, {'orient': 9, 'C': 0.0001}]
    """
    given: object = grid
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(
            f"grid must map option names ({', '.join(_FIELDS)}) to lists of values; got {describe(given)}"
        )
    _check_names(grid, "grid")
    lists = {}
    for name, values in grid.items():
        if not is_listing(values):
            raise InvalidInputError(f"grid[{name!r}] must be a list of values; got {describe(values)}")
        plain = [value.item() if isinstance(value, np.generic) else value for value in values]
        # Each value once; unlike in a set, True and 1 are two values.
        lists[name] = list({(type(value), repr(value)): value for value in plain}.values())
        if not lists[name]:
            raise InvalidInputError(f"grid[{name!r}] must hold at least one value; got none")
    count = math.prod(map(len, lists.values()))
    if count > _MAX_COMBINATIONS:
        raise InvalidInputError(f"grid must have at most {_MAX_COMBINATIONS} combinations; got {count}")
    return [dict(zip(lists, values)) for values in itertools.product(*lists.values())]


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


def _check_names(options: Mapping[str, Any], name: str) -> None:
    unknown = [key for key in options if key not in _FIELDS]
    if unknown:
        raise InvalidInputError(f"{name} has the unknown option {unknown[0]!r}; use {', '.join(_FIELDS)}")


def describe_params(params: FeatureParams) -> str:
    """Name features by their preset, or else by the fields that differ from the defaults."""
    for preset in FeatureParams.PRESETS:
        if FeatureParams.preset(preset) == params:
            return preset
    defaults, values = dataclasses.asdict(FeatureParams()), dataclasses.asdict(params)
    return _join_options({key: value for key, value in values.items() if value != defaults[key]})


def _join_options(options: Mapping[str, Any]) -> str:
    return " ".join(f"{key}={value}" for key, value in options.items()) or "default"


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
        for each in self.frame_sets:
            if not isinstance(each, LabelledFrames):
                raise InvalidInputError(f"frames must be LabelledFrames, one or more; got {describe(each)}")
        if len({each.name for each in self.frame_sets}) < len(self.frame_sets):
            raise InvalidInputError("frames must have different names; pass name=")

    @property
    def frame_sets(self) -> tuple[LabelledFrames, ...]:
        """The sets of `frames` as a tuple."""
        if self.frames is None or isinstance(self.frames, LabelledFrames):
            return () if self.frames is None else (self.frames,)
        return check_sequence(self.frames, "frames", "LabelledFrames")


class Trials:
    """Trains and measures candidates on patches; the rows are in the order in which they were requested.

    A trial that `store` holds is not measured again, and a new one is stored at once.
    """

    def __init__(self, patch_set: PatchSet, options: TrialOptions | None, store: RowStore) -> None:
        options = TrialOptions() if options is None else options
        check_type(options, "options", TrialOptions, "omit it for the defaults")
        check_type(patch_set, "patch_set", PatchSet, "read one with load_training_patches")
        cache = options.cache
        if not isinstance(cache, FeatureCache):
            cache = FeatureCache(patch_set.patches, folder=cache, jobs=options.jobs)
        elif cache.patches is not patch_set.patches:
            raise InvalidInputError(
                "cache must be a FeatureCache of the patches of patch_set; make one from patch_set.patches"
            )
        self.cache = cache
        self.labels = patch_set.labels.astype(np.int64)
        self.bar: Any = None  # progress bar of rows
        self._options, self._store = options, store
        self._rows: list[Mapping[str, Any]] = []
        self._search_ms: dict[FeatureParams, float] = {}
        self._patches_digest = digest_of(cache.digest, self.labels)
        used: dict[str, Any] = {}
        if options.time_search or options.frame_sets:
            used["search"] = dataclasses.asdict(options.search_params)
        if options.frame_sets:
            used["regions"] = dataclasses.asdict(options.region_params)
            used["frames"] = [_digest_frames(each) for each in options.frame_sets]
        self._options_digest = digest_of(used, options.time_search)

    def table(self) -> DataFrame:
        """Rows so far."""
        return make_table(self._rows, COLUMNS)

    def run(self, candidate: Candidate, split: Split, seed: int, *, split_name: str) -> None:
        """Add the row of a trial, from the store or measured now."""
        # Of the frames only the labels count, not the pixels; nor do the version and the machine.
        parts = split.train, split.test, seed, self._options_digest
        trial = digest_of(self._patches_digest, candidate.columns, *parts)
        labels = {"configuration": candidate.name, "split": split_name, "seed": seed}
        row = self._store.get(trial) or self.measure(candidate, split, seed) | candidate.columns
        self._add({**row, **labels, "trial": trial})

    def add_impossible(self, candidate: Candidate) -> None:
        """Record an impossible combination."""
        trial = digest_of(candidate.columns, candidate.error)
        error = {"status": "failed", "message": candidate.error}
        self._add({**candidate.columns, "configuration": candidate.name, **error, "trial": trial})

    def _add(self, cells: Mapping[str, Any]) -> None:
        row = {name: cells.get(name) for name in COLUMNS}
        self._rows.append(row)
        self.bar.update()
        if row["trial"] not in self._store:
            self._store.add(row)
            level = logging.WARNING if row["accuracy"] is None else logging.INFO
            outcome = row["message"] or row["accuracy"]
            _LOGGER.log(level, "%s, C=%s: %s: %s", row["configuration"], row["C"], row["status"], outcome)

    def measure(self, candidate: Candidate, split: Split, seed: int) -> dict[str, Any]:
        """Train and measure; the columns that a measurement fills."""
        options, row = self._options, {"train_size": len(split.train), "test_size": len(split.test)}
        start = time.perf_counter()
        try:
            classifier = self.train(candidate, split.train, seed)
        except InvalidInputError as error:
            return {"status": "failed", "message": str(error), **row}
        measured = {"fit_seconds": round(time.perf_counter() - start, 3)}
        for name, rows in (("train_accuracy", split.train), ("accuracy", split.test)):
            features = self.cache.rows(classifier.params, rows)
            measured[name] = classifier.score(features, self.labels[rows])
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
        labels = check_labels(self.labels[rows], len(rows))
        copies = (False, True) if candidate.training.mirror else (False,)
        _check_memory(candidate.params.length, len(self.labels), len(rows), len(copies))
        features = np.concatenate([self.cache.rows(candidate.params, rows, mirrored=copy) for copy in copies])
        options = dataclasses.replace(candidate.training, random_state=seed)
        return fit_features(features, labels, candidate.params, options)

    def _score_frames(self, classifier: VehicleClassifier) -> dict[str, Any]:
        """Mean of each metric over the sets of frames, and the F1 score of each set as text."""
        import pandas as pd

        scores = {each.name: self._score_set(classifier, each) for each in self._options.frame_sets}
        # The mean of a metric without any value is NaN.
        means = pd.DataFrame(scores, _FRAME_METRICS).mean(axis=1)
        by_set = "; ".join(f"{name} {f1:.4f}" for name, (f1, *_) in scores.items())
        return {**means, "frame_f1_by_set": by_set}

    def _score_set(self, classifier: VehicleClassifier, frames: LabelledFrames) -> tuple[float, ...]:
        """Values of `_FRAME_METRICS` on a set of frames."""
        search = self._options.search_params.with_horizon(frames.horizon)
        regions = self._options.region_params
        with Detector(classifier, search_params=search, region_params=regions) as detector:
            found = TrackTable.from_detections({key: detector.detect(image) for key, image in frames})
        scores = evaluate_detections(found, frames.labels, frames=frames.keys)
        best, _ = best_f1(*precision_recall_curve(found, frames.labels))
        return scores.f1, best, scores.average_precision, scores.mean_iou

    def _time_search(self, classifier: VehicleClassifier) -> float:
        """Milliseconds of the fast search of a 1280x720 frame on one core: the fastest of several runs."""
        if classifier.params not in self._search_ms:
            frame = np.random.default_rng(0).integers(0, 256, (*_TIMED_SHAPE, 3), np.uint8)
            seconds = []
            with contextlib.closing(classifier.open_search(jobs=1)) as search:
                # The first run compiles kernels and allocates buffers.
                for _ in range(_TIMED_RUNS + 1):
                    start = time.perf_counter()
                    search.find(frame, self._options.search_params)
                    seconds.append(time.perf_counter() - start)
            self._search_ms[classifier.params] = round(min(seconds[1:]) * 1000, 3)
        return self._search_ms[classifier.params]


def _digest_frames(frames: LabelledFrames) -> str:
    """Hash of a set's name, frame keys and labels; hashing the images would take too long."""
    labels = frames.labels
    keys = [list(map(str, frames.keys)), list(map(str, labels["frame"])), frames.horizon]
    return digest_of(frames.name, keys, labels.boxes, labels["ignore"], labels["track_id"])


def _check_memory(length: int, n_patches: int, n_rows: int, n_copies: int) -> None:
    """Raise if the features do not fit into memory, before the system kills the process."""
    # float32 features of all patches, and twice those of the training rows while they are joined.
    needed = length * n_copies * (4 * n_patches + (4 + 4) * n_rows)
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Not available on this system.
        return
    if needed > memory:
        raise InvalidInputError(
            f"training on {length} features of {n_rows} patches needs about {math.ceil(needed / 1e9)} GB, "
            f"but this machine has {memory / 1e9:.0f} GB; choose coarser features or fewer patches"
        )
