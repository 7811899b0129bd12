"""Fine-tune a network on labelled frames, and evaluate it on some of them that are held out."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vehicle_detection._common import check, pluralize
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, mean
from vehicle_detection.network import NetworkModel, load_network
from vehicle_detection.tables import FrameKey
from vehicle_detection.training.export import export_network, set_metadata
from vehicle_detection.training.frames import FrameDataset, check_sources, load_training_frames, select_frames
from vehicle_detection.training.network import NetworkTraining, train_network
from vehicle_detection.training.validation import (
    FoldDetections,
    FoldScore,
    best_threshold,
    detect_in_source,
    fit_log_odds,
    score_fold,
)
from vehicle_detection.training.weights import read_weights

# Each set is cut into so many blocks of neighboring frames; every fifth is held out.
_BLOCKS, _EVERY, _HELD = 10, 5, 2
# Vehicles in the held-out frames from which on they set calibration and threshold, and from which on they
# choose the margins: fewer, because both choices have boxes of the same vehicles.
_MIN_VEHICLES, _MIN_FOR_MARGINS = 50, 20
# Slope of a calibration above which scores separate right and false boxes: it has no best value.
_MAX_SLOPE = 10.0
# Longer side (px) to which frames are reduced in memory: about twice that of the samples.
_MAX_SIDE = 1280
_BATCH, _SIZE, _RATE = 8, (512, 320), 3e-4
# Steps per frame, and their limits: 10 to 20 minutes of two cores for 200 frames.
_STEPS_PER_FRAME, _MIN_STEPS, _MAX_STEPS = 5, 200, 1200
_PACKAGES = "torch", "onnx", "onnxruntime"


@dataclass(frozen=True, eq=False)
class FineTuning:
    """A fine-tuned network, and its scores on the held-out frames, if there are any."""

    model: NetworkModel
    before: list[FoldScore]  # of the initial network at its own threshold, for each set of held-out frames
    after: list[FoldScore]  # of the new one
    folds: list[FoldDetections]  # of the new one


def fine_tune_network(
    sources: Sequence[FrameDataset],
    *,
    initial: str | os.PathLike[str] = "default",
    steps: int | None = None,
    random_state: int = 0,
    jobs: int | None = None,
    device: str | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    on_step: Callable[[int, str], object] | None = None,
) -> FineTuning:
    """Continue the training of a network of this library on labelled frames.

    Every set of frames is cut into ten blocks of neighboring frames. Two of them are not trained on: the
    network is evaluated on these, before and after. If they show at least 50 vehicles, calibration and
    threshold are fitted to them, too; from 20 on, the margins of the initial network are left out if boxes
    fit better without.

    Parameters
    ----------
    sources
        Labelled frames.
    initial
        ``"default"`` or a file of this function or of the command ``train-frames``.
    steps
        Steps of 8 samples; None takes 5 for each frame, 200 to 1200. A step takes 0.6 s on two cores.
    random_state, jobs
        Seed of the samples; threads.
    device
        ``"cpu"`` or ``"cuda"``; None takes CUDA where PyTorch offers it. The same seed on the same kind of
        device, with the same number of threads, gives the same network.
    checkpoint
        File to which the training is saved every 30 s, and from which an interrupted training continues;
        removed at the end.
    on_step
        Called with the number of finished steps and a line with the time left, every 10 s.
    """
    checked = check_sources(sources)
    seed = check.integer(random_state, "random_state", low=0)
    place = _check_device(device)
    path = None if checkpoint is None else check.path(checkpoint, "checkpoint")
    model = load_network(initial)
    network = read_weights(model.graph, model.name)
    kept, held_out = hold_out(checked)
    frames = load_training_frames(kept, max_side=_MAX_SIDE)
    if held_out:
        load_training_frames(held_out)  # checks their boxes before the training
    count = min(max(_STEPS_PER_FRAME * len(frames), _MIN_STEPS), _MAX_STEPS)
    count = count if steps is None else check.integer(steps, "steps", low=1)
    training = NetworkTraining(
        steps=count,
        batch=_BATCH,
        size=_SIZE,
        rate=_RATE,
        random_state=seed,
        warm_up=max(1, count // 10),
        frozen_statistics=True,
        data=f"{fingerprint(kept)} {hashlib.sha256(model.graph).hexdigest()}",
    )
    before = [score_logits(fold, model) for fold in detect_logits(model, held_out, jobs=jobs)]
    trained = train_network(
        frames, training, initial=network, device=place, jobs=jobs, checkpoint=path, on_step=on_step
    )
    tuned = load_content(export_network(trained, frames, file_params(model), {}))
    tuned, folds = _choose_margins(tuned, held_out, jobs)
    tuned = _calibrate(tuned, folds)
    after = [score_logits(fold, tuned) for fold in folds]
    metadata = _metadata(checked, held_out, training, place, (before, after))
    content = set_metadata(tuned.graph, file_params(tuned), metadata)
    if path is not None:
        path.unlink(missing_ok=True)
    return FineTuning(load_content(content), before, after, folds)


def _choose_margins(
    model: NetworkModel, held_out: Sequence[FrameDataset], jobs: int | None
) -> tuple[NetworkModel, list[FoldDetections]]:
    """Leave out the margins of the initial network if boxes fit enough held-out vehicles better without.

    Returns the network and what it detects in the held-out frames.
    """
    plain = dataclasses.replace(model, margins=(0.0, 0.0, 0.0))
    choices = [model, plain] if any(model.margins) else [model]
    found = [(each, detect_logits(each, held_out, jobs=jobs)) for each in choices]
    if sum(len(fold.matches.usable) for fold in found[0][1]) < _MIN_FOR_MARGINS:
        return found[0]
    return max(found, key=lambda pair: mean([iou for fold in pair[1] for iou in fold.matched_iou]))


def _calibrate(model: NetworkModel, folds: Sequence[FoldDetections]) -> NetworkModel:
    """Fit calibration and threshold to the held-out frames if they show enough vehicles and false boxes."""
    if sum(len(fold.matches.usable) for fold in folds) < _MIN_VEHICLES:
        return model
    slope, offset = fit_log_odds(folds)
    if slope > _MAX_SLOPE:
        return model
    threshold = slope * best_threshold(folds) + offset
    return dataclasses.replace(model, slope=slope, offset=offset, threshold=threshold)


def hold_out(sources: Sequence[FrameDataset]) -> tuple[list[FrameDataset], list[FrameDataset]]:
    """Split every set of frames into one to train on and one to evaluate on.

    Neighboring frames, which may show the same vehicles, stay together: two of ten blocks are held out. At
    least one frame is, unless no vehicle would be left to train on.
    """
    parts = [part for source in sources for part in source.sets]
    if not any(map(_shows_vehicle, parts)):
        frames = pluralize(sum(map(len, parts)), "frame")
        raise InvalidInputError(
            f"sources must show at least one vehicle, got labels of {frames} without any; add frames with "
            "vehicles"
        )
    held = {id(part): _held_keys(part.keys) for part in parts}
    if not any(held.values()):
        held[id(parts[-1])] = {parts[-1].keys[-1]}
    kept = {id(part): set(part.keys) - held[id(part)] for part in parts}
    training, testing = (_select(sources, keys) for keys in (kept, held))
    if not any(_shows_vehicle(part) for source in training for part in source.sets):
        return list(sources), []
    return training, testing


def _shows_vehicle(part: LabelledFrames) -> bool:
    return bool((~part.labels["ignore"]).any())


def _held_keys(keys: Sequence[FrameKey]) -> set[FrameKey]:
    size = math.ceil(len(keys) / _BLOCKS)
    return {key for number, key in enumerate(keys) if number // size % _EVERY == _HELD}


def _select(sources: Sequence[FrameDataset], keys: Mapping[int, set[FrameKey]]) -> list[FrameDataset]:
    """Return the data sets with some frames of each set, by its id; those without any are left out."""
    sets = {
        source.name: tuple(select_frames(part, keys[id(part)]) for part in source.sets if keys[id(part)])
        for source in sources
    }
    return [FrameDataset(name, chosen) for name, chosen in sets.items() if chosen]


def fingerprint(sources: Sequence[FrameDataset]) -> str:
    """SHA-256 over the names of the frames and their boxes."""
    digest = hashlib.sha256()
    for source in sources:
        for part in source.sets:
            for key in part.keys:
                labels = part.labels.frame(key)
                digest.update(f"{source.name}/{part.name}/{key}\n".encode())
                digest.update(np.column_stack([labels.boxes, labels["ignore"]]).round(3).tobytes())
    return digest.hexdigest()


def package_versions() -> dict[str, str]:
    """Versions of the packages that a trained network depends on."""
    names = ("vehicle_detection", *_PACKAGES)
    return {name: importlib.metadata.version(name.replace("_", "-")) for name in names}


def file_params(model: NetworkModel) -> dict[str, Any]:
    """Return the parameters of a network for its file."""
    names = ("input_size", "slope", "offset", "threshold", "nms_iou", "margins")
    return {name: getattr(model, name) for name in names}


def load_content(content: bytes) -> NetworkModel:
    """Load a network from the content of its file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        path.write_bytes(content)
        return dataclasses.replace(load_network(path), name="the trained network")


def detect_logits(
    model: NetworkModel, sources: Sequence[FrameDataset], *, jobs: int | None = None
) -> list[FoldDetections]:
    """Detect vehicles in all frames; the scores are the log-odds of the network without calibration."""
    plain = dataclasses.replace(model, slope=1.0, offset=0.0, threshold=0.0)
    return [fold for source in sources for fold in detect_in_source(plain, source, jobs=jobs)]


def score_logits(fold: FoldDetections, model: NetworkModel) -> FoldScore:
    """Score detections of `detect_logits` with the threshold and the calibration of a network."""
    threshold = (model.threshold - model.offset) / model.slope
    return score_fold(fold, threshold, (model.slope, model.offset))


def _check_device(device: str | None) -> str:
    import torch

    available = torch.cuda.is_available()
    if device is None:
        return "cuda" if available else "cpu"
    check.choice(device, "device", ("cpu", "cuda"))
    if device == "cuda" and not available:
        raise InvalidInputError("device must be 'cpu', PyTorch finds no CUDA device; install its driver")
    return device


def _metadata(
    sources: Sequence[FrameDataset],
    held_out: Sequence[FrameDataset],
    training: NetworkTraining,
    device: str,
    scores: tuple[Sequence[FoldScore], Sequence[FoldScore]],
) -> dict[str, Any]:
    before, after = ({score.name: score.to_dict() for score in each} for each in scores)
    data: dict[str, Any] = {source.name: sum(map(len, source.sets)) for source in sources}
    data |= {"held_out": sum(len(part) for source in held_out for part in source.sets)}
    facts = {name: getattr(training, name) for name in ("steps", "batch", "rate", "random_state")}
    size, initial = "x".join(map(str, training.size)), training.data.split()[1]
    return {
        "metrics": {"held_out": after, "held_out_before": before},
        "data": data | {"sha256": fingerprint(sources)},
        "training": facts | {"size": size, "device": device, "initial": initial},
        "versions": package_versions(),
    }
