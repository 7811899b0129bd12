"""One configuration at a time: trained on a part, judged on the rest, on frames, and by its cost."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_number
from vehicle_detection._kernels import fit_svm
from vehicle_detection.classifier import DEFAULT_C, Template, VehicleClassifier, check_labels
from vehicle_detection.datasets import PatchSet, Split
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import (
    FrameBoxes,
    LabelledFrames,
    best_f1,
    evaluate_detections,
    precision_recall_curve,
)
from vehicle_detection.params import FeatureParams, RegionParams, SearchParams
from vehicle_detection.search import BandSearch
from vehicle_detection.tuning.cache import FeatureCache, digest_of

_LOGGER = logging.getLogger(__name__)


FEATURE_FIELDS = tuple(field.name for field in dataclasses.fields(FeatureParams))

TRAINING_FIELDS = ("C", "mirror", "vehicle_weight")

FRAME_COLUMNS = ("frame_f1", "frame_best_f1", "frame_average_precision", "frame_iou", "frame_f1_each")

COLUMNS = (
    "status", "message", "stage", "configuration", *FEATURE_FIELDS, "features", *TRAINING_FIELDS, "split",
    "seed", "train_size", "test_size", "train_accuracy", "accuracy", *FRAME_COLUMNS, "search_ms",
    "fit_seconds", "trial",
)  # fmt: skip
"""Columns of a measured row."""

_TIMED_SHAPE = (720, 1280)
_TIMED_RUNS = 15


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that makes a classifier out of patches.

    Attributes
    ----------
    params
        The features.
    C
        Inverse strength of the regularisation.
    mirror
        Train on each patch mirrored left to right, too.
    vehicle_weight
        What a wrong vehicle costs in training, where a wrong non-vehicle costs 1.
    """

    params: FeatureParams
    C: float = DEFAULT_C
    mirror: bool = True
    vehicle_weight: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "C", check_number(self.C, "C", above=0, high=1e12))
        weight = check_number(self.vehicle_weight, "vehicle_weight", above=0, high=1e6)
        object.__setattr__(self, "vehicle_weight", weight)
        if not isinstance(self.mirror, bool):
            raise InvalidInputError(f"mirror must be True or False; got {self.mirror!r}")

    def to_cells(self) -> dict[str, Any]:
        """Return the columns that describe the recipe."""
        training = {name: getattr(self, name) for name in TRAINING_FIELDS}
        return {**dataclasses.asdict(self.params), "features": self.params.length, **training}


class Bench:
    """The patches, and if wanted the frames, that recipes are tried on.

    Parameters
    ----------
    patch_set
        The patches.
    cache
        Features of these patches.
    frames
        Sets of frames that each classifier is scored on; may be none.
    search, fit
        Parameters of the detector on these frames, and of the timed search.
    time_search
        Measure the fast search on one core.
    """

    def __init__(
        self,
        patch_set: PatchSet,
        cache: FeatureCache,
        *,
        frames: Sequence[LabelledFrames] = (),
        search: SearchParams | None = None,
        fit: RegionParams | None = None,
        time_search: bool = True,
    ) -> None:
        self.labels = patch_set.labels.astype(np.int64)
        self.cache = cache
        self.frames = tuple(frames)
        self.search = search or SearchParams.preset()
        self.region_params = fit or RegionParams()
        self.time_search = time_search
        self._milliseconds: dict[FeatureParams, float] = {}
        self._material = digest_of(cache.digest, self.labels)
        used: dict[str, Any] = {"search": dataclasses.asdict(self.search)} if time_search or frames else {}
        if frames:
            used["fit"] = dataclasses.asdict(self.region_params)
            used["frames"] = [_digest_frames(each) for each in self.frames]
        self._measured = digest_of(used, time_search)

    def trial(self, recipe: Recipe, split: Split, seed: int, *, on_frames: bool = True) -> str:
        """Name a trial by all that its result depends on."""
        return digest_of(
            self._material,
            recipe.to_cells(),
            split.train,
            split.test,
            seed,
            self._measured if on_frames else None,
        )

    def measure(self, recipe: Recipe, split: Split, seed: int, *, on_frames: bool = True) -> dict[str, Any]:
        """Train and judge; the columns from ``"status"`` on that a measurement fills.

        What cannot be measured at all has the status ``"refused"``, and what cannot be searched by the fast
        search ``"partial"``: its accuracy is measured, its frames and its cost are not.
        """
        cells: dict[str, Any] = {"train_size": len(split.train), "test_size": len(split.test)}
        began = time.perf_counter()
        try:
            classifier = self.train(recipe, split.train, seed)
        except InvalidInputError as error:
            return {"status": "refused", "message": str(error), **cells}
        cells["fit_seconds"] = round(time.perf_counter() - began, 3)
        cells["train_accuracy"] = self.accuracy(classifier, split.train)
        cells["accuracy"] = self.accuracy(classifier, split.test)
        if on_frames and (self.frames or self.time_search):
            try:
                BandSearch(classifier, n_jobs=1).close()
            except InvalidInputError as error:
                return {"status": "partial", "message": str(error), **cells}
            if self.time_search:
                cells["search_ms"] = self._time(classifier)
            if self.frames:
                cells |= self.score_frames(classifier)
        return {"status": "ok", "message": None, **cells}

    def train(self, recipe: Recipe, rows: NDArray[np.intp], seed: int) -> VehicleClassifier:
        """Train on some of the patches; equals `train_classifier` on them."""
        targets = check_labels(self.labels[rows], len(rows))
        copies = (False, True) if recipe.mirror else (False,)
        _check_memory(recipe.params.length, len(self.labels), len(rows), len(copies))
        parts = [self.cache.rows(recipe.params, rows, mirrored=copy) for copy in copies]
        features = np.concatenate(parts) if len(parts) > 1 else parts[0]
        del parts  # They fill as much memory again.
        return fit_features(features, np.tile(targets, len(copies)), recipe, seed)

    def accuracy(self, classifier: VehicleClassifier, rows: NDArray[np.intp]) -> float:
        """Share of right answers on some of the patches, 0-1."""
        return classifier.score(self.cache.rows(classifier.params, rows), self.labels[rows])

    def score_frames(self, classifier: VehicleClassifier) -> dict[str, Any]:
        """Score detections on every set of frames; the mean over the sets, each counts the same."""
        scores = [self._score_set(classifier, frames) for frames in self.frames]
        cells: dict[str, Any] = {
            name: _mean([score[name] for score in scores]) for name in FRAME_COLUMNS if name in scores[0]
        }
        each = (f"{frames.name} {score['frame_f1']:.4f}" for frames, score in zip(self.frames, scores))
        return {**cells, "frame_f1_each": "; ".join(each)}

    def _score_set(self, classifier: VehicleClassifier, frames: LabelledFrames) -> dict[str, float]:
        options: dict[str, Any] = {"search_params": self.search, "region_params": self.region_params}
        with VehicleDetector(classifier, horizon=frames.horizon, **options) as detector:
            found = FrameBoxes.from_detections({key: detector.detect(image) for key, image in frames})
        scores = evaluate_detections(found, frames.labels, frames=frames.keys)
        return {
            "frame_f1": scores.f1,
            "frame_best_f1": best_f1(*precision_recall_curve(found, frames.labels))[0],
            "frame_average_precision": scores.average_precision,
            "frame_iou": scores.mean_iou,
        }

    def _time(self, classifier: VehicleClassifier) -> float:
        """Milliseconds of the fast search of a 1280x720 frame on one core: the fastest of a few runs."""
        if classifier.params not in self._milliseconds:
            frame = np.random.default_rng(0).integers(0, 256, (*_TIMED_SHAPE, 3), np.uint8)
            with BandSearch(classifier, n_jobs=1) as bands:
                bands.find(frame, self.search)  # The first frame compiles kernels and lays out buffers.
                seconds = []
                for _ in range(_TIMED_RUNS):
                    began = time.perf_counter()
                    bands.find(frame, self.search)
                    seconds.append(time.perf_counter() - began)
            self._milliseconds[classifier.params] = round(min(seconds) * 1000, 3)
        return self._milliseconds[classifier.params]


def fit_features(
    features: NDArray[np.float32], targets: NDArray[np.int64], recipe: Recipe, seed: int
) -> VehicleClassifier:
    """Fit a scaler and a linear SVM on feature vectors, as `train_classifier` does."""
    costs = recipe.C * np.where(targets == 1, recipe.vehicle_weight, 1.0)
    fitted = fit_svm(features, targets, costs, gains=recipe.params.gains, random_state=seed)
    return VehicleClassifier(recipe.params, (Template(*fitted),))


def _digest_frames(frames: LabelledFrames) -> str:
    """Name a set by its frames' keys and labels; the pictures themselves take too long to read."""
    labels = frames.labels
    facts = [list(map(str, frames.keys)), list(map(str, labels.frames)), frames.horizon]
    return digest_of(frames.name, facts, labels.boxes, labels.ignore, labels.tracks)


def _mean(values: ArrayLike) -> float | None:
    """Mean of what was measured; None for nothing."""
    array = np.asarray(values, np.float64)
    array = array[~np.isnan(array)]
    return float(array.mean()) if array.size else None


def _check_memory(length: int, patches: int, rows: int, copies: int) -> None:
    """Refuse features that do not fit into this machine, instead of being ended by it."""
    # Features in float32 and the rows among them to train on, which are held twice while they are joined.
    needed = length * copies * (4 * patches + (4 + 4) * rows)
    try:
        present = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Not told by this system.
        return
    if needed > present:
        raise InvalidInputError(
            f"{length} features of {rows} patches need about {math.ceil(needed / 1e9)} GB to train on, this "
            f"machine has {present / 1e9:.0f}; choose coarser features or fewer patches"
        )
