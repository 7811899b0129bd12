"""The model card of the shipped network, written from the measurements of its training."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from tools.measure_model import RIDES, by_light, format_rows
from vehicle_detection._common import write_text
from vehicle_detection.network import NetworkModel
from vehicle_detection.training import (
    FoldDetections,
    FrameDataset,
    fit_log_odds,
    markdown_table,
    markdown_text,
    score_logits,
)

PROBABILITIES = (0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Limits of the stated probabilities of boxes."""

_COMMAND = "python -m tools.train_default DATA -o {name}.onnx --card {name}.md --seed {seed}"
_WHAT = (
    "A small network that detects vehicles (cars, vans, buses, trucks) on any road, in single frames: an "
    "anchor-free, fully convolutional detector. A residual backbone of 16 to 128 channels and a feature "
    "pyramid of 64 channels at strides 8 to 64 feed one head of separable convolutions, which predicts at "
    "every cell a probability and the distances to the edges of a box."
)
_METHOD = (
    "The shipped network has seen every source. Its accuracy on other roads is therefore that of a second "
    "network, trained in the same way on the other rides of bdd, the course's frames and rendered frames "
    "alone: it has seen none of the frames below. Single frames were searched with the default parameters, "
    "and boxes matched at an IoU of 0.5, all at the one threshold that is best over all these sets "
    "together, where a false box counts 1.4 times as much as a missed vehicle. Best F1 is that of the best "
    'threshold of the set; "region F1" and "region AP50" do not score a box of which at least half lies in '
    "an ignored box. Recall is also that of vehicles that others partly occlude (by their labels), that the "
    "edge of the frame cuts, and under 32 px wide, with their number. ECE is the expected calibration "
    "error: the difference between the stated probability of a box and the fraction of right ones. The last "
    "two columns count false boxes per frame without any label, and per frame without a scored vehicle."
)
_STATED = (
    "Boxes of all these sets with a probability from 0.1 on, with the calibration fitted to the other "
    "sources. Slope, offset and threshold of the shipped network are those of the second network, fitted to "
    "all of them."
)
_DATA = {
    "bdd": "dash-cams and phones in the USA and Israel by day, dusk and night, one frame a ride, of BDD100K "
    "(research use); tight labels, also of far and parked cars; compressed more than once",
    "camvid": "a dash-cam in Cambridge, of CamVid (non-commercial use); boxes come from masks, and touching "
    "cars are ignored boxes",
    "dawn": "pictures in fog, rain and snow from many countries, of DAWN (research use); vehicles that can "
    "hardly be seen count",
    "dhaka": "phones in vehicles and beside roads in Bangladesh, of the Dhaka AI challenge (no licence "
    "stated); 5 of 100 vehicles have no label; three-wheelers are ignored",
    "india": "dash-cams in Hyderabad and Bangalore (research use); only cars, buses and trucks are labelled, "
    "some of them heavily occluded",
    "indonesia": "pictures at car height beside roads (research use); small cars in the background may have "
    "no label",
    "us_side": "a camera that looks out of the left side of a car in the USA (no licence stated); boxes "
    "tightened by a common fraction, so that fine positions have no meaning",
    "course": "the course's test images and clips (MIT), six frames per second: neighbors are similar",
    "rendered": "rendered scenes and drives of this library, with ground truth",
}
_LICENSES = (
    "Most of these frames may be used for research and other non-commercial purposes only; the model "
    "inherits these terms."
)
_LIMITS = (
    "Vehicles that others hide, that the edge of the frame cuts, that are narrower than 32 px, in fog or in "
    "the dark are missed more often; larger inputs (input_size) find more of the far ones.",
    "Walls and garage doors at the edge of the frame, motorcycles, three-wheelers, signs and painted letters "
    "can cause false boxes.",
    "Motorcycles, bicycles, three-wheelers, trams and trailers are not detected as vehicles, nor scored.",
    "Use the model to explore and to annotate, not to drive.",
)
_PRECISION = (
    "Weights of 7 bits and activations of 8 bits; the last convolution and the boxes in float32.",
    "onnxruntime computes products of 8-bit integers on every processor; OpenVINO, which is used where it "
    "is installed and the processor multiplies matrices (AMX), in 8 bits there and in bfloat16 or float32 "
    "for the rest. Boxes and confidences differ in the last digits between the two.",
)


def write_card(
    path: str | os.PathLike[str],
    model: NetworkModel,
    folds: Sequence[FoldDetections],
    sources: Sequence[FrameDataset],
    *,
    seed: int,
    trained_on: str = "",
) -> None:
    """Write the model card as Markdown.

    Parameters
    ----------
    path, model
        File to write, and the shipped network.
    folds
        Detections of the network for the measurements in frames that it has not seen; scores are log-odds
        without calibration.
    sources
        What the shipped network was trained on.
    seed, trained_on
        Seed of the training, and its hardware and duration.
    """
    name = Path(path).stem
    parts = [part for fold in folds for part in (fold, *(by_light(fold) if fold.source == RIDES else ()))]
    scores = [score_logits(part, model).to_dict() for part in parts]
    stated = [
        [f"{probability:.2f}", f"{right:.2f}", str(count)]
        for count, probability, right in calibration_rows(folds)
    ]
    text = [
        f"# Model card: {name}",
        markdown_text(f"{_WHAT} Created by"),
        f"```bash\n{_COMMAND.format(name=name, seed=seed)}\n```",
        _list(_facts(model, trained_on)),
        "## Accuracy on roads that it was not trained on",
        markdown_text(_METHOD),
        format_rows(scores),
        "### Stated and true probability",
        markdown_text(_STATED),
        markdown_table(["mean stated probability", "right", "boxes"], stated),
        "## Data",
        _list(map(_describe, sources)),
        markdown_text(_LICENSES),
        "## Limits",
        _list(_LIMITS),
        "## Precision",
        _list(_PRECISION),
    ]
    write_text(path, "\n\n".join(text) + "\n", "path")


def calibration_rows(folds: Sequence[FoldDetections]) -> list[tuple[int, float, float]]:
    """List the number of boxes, their mean probability and the fraction of right ones by `PROBABILITIES`.

    The log-odds of a fold are fitted to the other sources.
    """
    stated, right = [np.empty(0)], [np.empty(0, np.bool_)]
    for fold in folds:
        slope, offset = fit_log_odds([other for other in folds if other.source != fold.source])
        logits, hits = fold.hits
        stated.append(1 / (1 + np.exp(-(slope * logits + offset).clip(-500, 500))))
        right.append(hits)
    values, hits = np.concatenate(stated), np.concatenate(right)
    rows = []
    for low, high in itertools.pairwise(PROBABILITIES):
        here = (values >= low) & (values <= high if high == 1 else values < high)
        if here.any():
            rows.append((int(here.sum()), float(values[here].mean()), float(hits[here].mean())))
    return rows


def _list(lines: Iterable[str]) -> str:
    return "\n".join(markdown_text(line, "- ") for line in lines)


def _facts(model: NetworkModel, trained_on: str) -> list[str]:
    training = model.metadata.get("training", {})
    probability = 1 / (1 + math.exp(-model.threshold))
    facts = [
        f"File: {len(model.graph) / 1e6:.1f} MB; the longer side of the input has {model.input_size} px",
        f"Threshold: a confidence of {probability:.2f}",
        "Training: {steps} steps of {batch} samples of {size} px, seed {random_state}".format(**training),
    ]
    return facts + ([f"Hardware and time: {trained_on}"] if trained_on else [])


def _describe(source: FrameDataset) -> str:
    frames = sum(len(part) for part in source.sets)
    vehicles = sum(int((~part.labels["ignore"]).sum()) for part in source.sets)
    return f"{source.name}, {frames} frames, {vehicles} vehicles: {_DATA.get(source.name, 'no description')}"
