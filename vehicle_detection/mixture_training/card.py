"""The card of a mixture, written from its own measurements, and its precision and recall as a table."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vehicle_detection._common import atomic_write
from vehicle_detection.evaluation import precision_recall_curve
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.mixture_training.cross_validation import FoldDetections, FoldScore
from vehicle_detection.mixture_training.drawn_frames import DRAWN
from vehicle_detection.mixture_training.train import FrameDataset

_CARD = """# Model card: {name}

A mixture of {count} linear templates over road features, for vehicles on any road, trained by

```
vehicle-detection train-frames DATA --seed {seed} -o {name}.safetensors --card {name}.md --curves {name}.csv
```

Templates, in cells of the vehicle's box: {shapes}. {second}A vehicle is shown from log-odds\
 {threshold:.2f} on.

## On roads it was not trained on

Each source was left out of training in turn; single frames, searched as by default, IoU 0.5. F1 at the
threshold that is best for the other sources, then at the best one; AP is the average precision; false boxes a
frame, and on frames without any label. "Region F1" and "region AP" do not judge a box of which half or more
lies in an ignored box: where labels put one ignored box around a group of vehicles, the other columns count
each one found there as false.

| frames | images | vehicles | F1 | best F1 | AP | precision | recall | mean IoU | false | on empty |\
 region F1 | region AP |
|---|---|---|---|---|---|---|---|---|---|---|---|---|
{rows}

## Data

{data}

{terms}

## Limits

{places}Vehicles that are hidden, cut off
by the frame, seen from the side at close range or under 32 pixels wide are missed more often; scooters, signs
and shop fronts fire. Use it to explore and to annotate, not to drive.
"""
_SECOND = """On what they find, a support
vector machine with a Gaussian kernel ({vectors:,} vectors, edges and colors) has a share of {share:g} in the
vehicle's value. """
# What is known of the shipped model's sources; of others the card says nothing.
_SHIPPED_SOURCES = {"india", "camvid", "indonesia", "course"}
_TERMS = """The frames of India, of Cambridge (CamVid) and of Indonesia were published for research and other
non-commercial use, and the model inherits that; the course's images and clips are MIT licensed."""
_PATCH_TERMS = """
The patches come from the GTI vehicle image database and from KITTI (CC BY-NC-SA 3.0)."""
_PLACES = "Trained on daylight and dusk in three countries and on one American highway. "
_OTHER_TERMS = "The terms of these frames hold for the model as well."


def write_card(
    path: str | os.PathLike[str],
    mixture: TemplateMixture,
    scores: Sequence[FoldScore],
    sources: Sequence[FrameDataset],
    seed: int,
    patches: int = 0,
) -> None:
    """Write the model card."""
    rows = "\n".join(
        f"| {score.name} | {score.frames} | {score.vehicles} | {_or_dash(score.f1, 3)} | "
        f"{score.best_f1:.3f} | {_or_dash(score.average_precision, 3)} | {_or_dash(score.precision, 3)} | "
        f"{_or_dash(score.recall, 3)} | {_or_dash(score.mean_iou, 3)} | "
        f"{score.false_per_frame:.2f} | {_or_dash(score.false_per_empty_frame, 2)} | "
        f"{_or_dash(score.region_f1, 3)} | {_or_dash(score.region_average_precision, 3)} |"
        for score in scores
    )
    shapes = ", ".join(
        "{:g}x{:g}".format(*template.box_cells) + " at the border" * template.border
        for template in mixture.templates
    )
    data = "\n".join(
        f"- {source.name}: {sum(len(part) for part in source.sets)} frames, "
        f"{sum(int((~part.labels.ignore).sum()) for part in source.sets)} vehicles"
        for source in sources
    )
    if patches:
        data += f"\n- {patches} vehicles on the course's patches"
    second = mixture.rescorer
    known = {source.name for source in sources} - {DRAWN} == _SHIPPED_SOURCES
    text = _CARD.format(
        terms=(_TERMS if known else _OTHER_TERMS) + _PATCH_TERMS * (patches > 0),
        places=_PLACES if known else "",
        name=Path(path).stem,
        count=len(mixture.templates),
        seed=seed,
        shapes=shapes,
        second=_SECOND.format(vectors=len(second.weights), share=second.blend_weight)
        if second is not None
        else "",
        threshold=mixture.threshold,
        rows=rows,
        data=data,
    )
    with atomic_write(path, "path") as part:
        part.write_text(text, encoding="utf-8")


def _or_dash(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def write_curves(path: str | os.PathLike[str], held: Sequence[FoldDetections]) -> None:
    """Write precision and recall of every set left out, a row for each threshold."""
    with atomic_write(path, "path") as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frames", "value", "precision", "recall"])
        for one in held:
            for row in zip(*precision_recall_curve(one.found, one.truth)):
                precision, recall, value = row
                writer.writerow([one.frames.name, f"{value:.4f}", f"{precision:.4f}", f"{recall:.4f}"])
