"""Accuracy on held-out patches of classifiers trained like the shipped model."""

from __future__ import annotations

import numpy as np

from benchmarks._material import Context, if_real, is_real, patches
from benchmarks._report import Row, at_least
from vehicle_detection import TrainingOptions, load_classifier, train_classifier
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)

SEEDS = range(5)


def run(context: Context) -> list[Row]:
    """Train and test on random splits, on the sequence split and across sources."""
    found, material = patches()
    random = [split_random(found, random_state=seed) for seed in SEEDS]
    accuracies = [accuracy_of(found, split) for split in random]
    sequences = split_sequences(found)
    rows = [
        Row("patches", len(found), material=f"{material}, parameters of the shipped model"),
        Row(
            f"accuracy, random 80/20 split, mean of {len(SEEDS)} seeds",
            float(np.mean(accuracies)),
            target=if_real(at_least(0.997)),
            details={"accuracies": [round(value, 5) for value in accuracies]},
        ),
        Row("random split: minimum of the seeds", min(accuracies)),
        Row("random split: near duplicates among the test patches", split_leakage(found, random[0])),
        Row("accuracy, sequence split", accuracy_of(found, sequences), target=if_real(at_least(0.996))),
        Row("sequence split: near duplicates among the test patches", split_leakage(found, sequences)),
    ]
    if is_real():
        for train, test in ((("GTI",), ("KITTI", "Extras")), (("KITTI", "Extras"), ("GTI",))):
            split = split_sources(found, train=train, test=test)
            what = f"accuracy, trained on {' and '.join(train)}, tested on {' and '.join(test)}"
            rows.append(Row(what, accuracy_of(found, split)))
    return rows


def accuracy_of(found: PatchSet, split: Split) -> float:
    """Accuracy on the test part of a classifier trained on the training part like the shipped model."""
    shipped = load_classifier()
    training = shipped.metadata.get("training", {})
    names = ("C", "mirror", "gamma", "degraded")
    options = TrainingOptions(**{name: training[name] for name in names if name in training})
    train, test = found[split.train], found[split.test]
    classifier = train_classifier(train.patches, train.labels, params=shipped.params, options=options)
    return classifier.score(test.patches, test.labels)
