"""What training a model found."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

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
        Share of the test patches with a near-copy among the training patches: `split_leakage` of the first
        seed.
    """

    accuracies: tuple[float, ...]
    missed: float
    false: float
    train: int
    test: int
    leakage: float

    @property
    def accuracy(self) -> float:
        """Mean share of right answers."""
        return float(np.mean(self.accuracies))


@dataclass(frozen=True, kw_only=True)
class TrainingReport:
    """What `train_and_judge` found.

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
