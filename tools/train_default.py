"""Train the shipped network: ``python -m tools.train_default DATA -o default.onnx --card default.md``.

Two networks are trained on frames of DATA. The shipped one has seen all sources. The other one, for the
measurements, has seen neither the sources `LEFT_OUT` nor the rides of ``bdd`` that are kept out: its scores
are those of the card, and its probabilities set calibration and threshold of the shipped network.
``--weights`` and ``--held-out-weights`` take networks that are trained already; ``--held-out`` trains the
second one only.

DATA holds ``labels/NAME.csv`` with frames in ``frames/NAME/``, ``NAME/`` or ``videos/NAME.mp4``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tools.error_pictures import write_pictures
from tools.measure_model import RIDES, choose_sources
from tools.model_card import write_card
from tools.rendered import rendered_source
from tools.rides import kept_rides
from vehicle_detection._common import atomic_write, check_target
from vehicle_detection.errors import VehicleDetectionError
from vehicle_detection.network import NetworkModel
from vehicle_detection.training import (
    FoldDetections,
    FrameDataset,
    NetworkTraining,
    TrainingFrame,
    best_threshold,
    detect_logits,
    export_network,
    file_params,
    fingerprint,
    fit_log_odds,
    load_content,
    load_training_frames,
    package_versions,
    score_logits,
    select_frames,
    set_metadata,
    train_network,
    write_curves,
)

if TYPE_CHECKING:
    from vehicle_detection.training.architecture import Network

LEFT_OUT = ("camvid", "dawn", "dhaka", "india", "indonesia", "us_side")
"""Sources that the network for the measurements has not seen."""

COURSE_SETS = ("project_clip", "test_images", "test_video")
"""Sets of frames of one road, which together are the source ``"course"``."""

# Frames per second of the clips: neighbors show nearly the same.
_CLIP_RATE = 6.0
# Longer side to which frames are reduced, and that of the network's input (px).
_MAX_SIDE, _INPUT_SIZE = 720, 640
_STEPS, _NMS_IOU = 9000, 0.5
# By how much its boxes are too large: these fit the labels of the sources left out best.
_MARGINS = (1.5, -0.01, 0.5)


def load_sources(folder: Path, *, held_out: bool = False) -> list[FrameDataset]:
    """Read the frames to train the shipped network on, or with `held_out` the one for the measurements."""
    names = (RIDES, *COURSE_SETS) if held_out else (RIDES, *LEFT_OUT, *COURSE_SETS)
    found = {source.name: source for source in choose_sources(folder, names, clip_rate=_CLIP_RATE)}
    course = FrameDataset("course", tuple(part for name in COURSE_SETS for part in found[name].sets))
    if not held_out:
        return [*(found[name] for name in (RIDES, *LEFT_OUT)), course]
    (rides,) = found[RIDES].sets
    kept = set(kept_rides(rides.labels["frame"]))
    return [FrameDataset(RIDES, (select_frames(rides, set(rides.keys) - kept),)), course]


def evaluate_held_out(model: NetworkModel, folder: Path, *, jobs: int | None = None) -> list[FoldDetections]:
    """Detect vehicles with the network for the measurements in the frames that it has not seen."""
    rides, *sources = choose_sources(folder, (RIDES, *LEFT_OUT))
    (part,) = rides.sets
    kept = FrameDataset(RIDES, (select_frames(part, set(kept_rides(part.labels["frame"]))),))
    return detect_logits(model, [kept, *sources], jobs=jobs)


def make_file(
    network: Network,
    frames: Sequence[TrainingFrame],
    folds: Sequence[FoldDetections] = (),
    metadata: Mapping[str, Any] | None = None,
) -> bytes:
    """Return the model file of a network.

    Parameters
    ----------
    network, frames
        The network, and frames that set its 8-bit ranges.
    folds
        What `evaluate_held_out` returns: they set calibration and threshold, and their scores are stored.
    metadata
        Facts to store.
    """
    params: dict[str, Any] = {"input_size": _INPUT_SIZE, "slope": 1.0, "offset": 0.0, "threshold": 0.0}
    params |= {"nms_iou": _NMS_IOU, "margins": _MARGINS}
    facts = dict(metadata or {})
    if folds:
        slope, offset = fit_log_odds(folds)
        params |= {"slope": slope, "offset": offset, "threshold": slope * best_threshold(folds) + offset}
    content = export_network(network, frames, params, facts)
    if folds:
        model = load_content(content)
        facts["metrics"] = {
            "left_out": {fold.frames.name: score_logits(fold, model).to_dict() for fold in folds}
        }
        content = set_metadata(content, file_params(model), facts)
    return content


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, measure, and write the model, its card, its curves and pictures of its errors."""
    parser = argparse.ArgumentParser(prog="python -m tools.train_default", description="Train the network.")
    add = parser.add_argument
    add("data", metavar="DATA", type=Path, help="data folder")
    add("-o", "--output", metavar="FILE", type=Path, required=True, help="model file")
    add("--card", metavar="FILE.md", type=Path, help="model card")
    add("--curves", metavar="FILE.csv", type=Path, help="precision and recall of each set")
    add("--pictures", metavar="DIR", type=Path, help="folder for curves and worst errors")
    add("--steps", metavar="N", type=int, default=_STEPS, help="steps of 64 samples of each training")
    add("--init", metavar="FILE.safetensors", type=Path, help="weights to start from")
    add("--device", choices=("cpu", "cuda"), help="default: cuda where PyTorch offers it")
    add("--seed", metavar="N", type=int, default=0, help="random seed")
    add("--jobs", metavar="N", type=int, help="threads, and frames measured at once")
    add("--held-out", action="store_true", help="train only the network for the measurements, and write it")
    add("--weights", metavar="FILE.safetensors", type=Path, help="weights of the trained network")
    add("--held-out-weights", metavar="FILE.safetensors", type=Path, help="those for the measurements")
    add("--save-weights", metavar="FILE.safetensors", type=Path, help="write the weights to continue from")
    add("--trained-on", metavar="TEXT", default="", help="hardware and time, for the card")
    options = parser.parse_args(arguments)
    try:
        _train(options)
    except VehicleDetectionError as error:
        parser.error(str(error))


def _train(options: argparse.Namespace) -> None:
    for name in "output", "card", "curves", "save_weights":
        if getattr(options, name) is not None:
            check_target(getattr(options, name), f"--{name.replace('_', '-')}")
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    sources = load_sources(options.data, held_out=True)
    rendered = rendered_source(random_state=options.seed)
    parts = [*sources, rendered]
    frames = load_training_frames(parts, max_side=_MAX_SIDE)
    measured = _network(options, options.held_out_weights, frames, "held-out")
    folds = evaluate_held_out(load_content(make_file(measured, frames)), options.data, jobs=options.jobs)
    network, sources = measured, parts
    if not options.held_out:
        sources = [*load_sources(options.data), rendered]
        frames = load_training_frames(sources, max_side=_MAX_SIDE)
        network = _network(options, options.weights, frames, "shipped")
    content = make_file(network, frames, folds, _metadata(options, sources))
    with atomic_write(options.output, "--output") as part:
        part.write_bytes(content)
    if options.save_weights is not None:
        from safetensors.torch import save_model

        with atomic_write(options.save_weights, "--save-weights") as part:
            save_model(network, str(part))
    _write_reports(options, load_content(content), folds, sources)


def _load_weights(path: Path) -> Network:
    from safetensors.torch import load_model

    from vehicle_detection.training.architecture import Network

    network = Network()
    load_model(network, path)
    network.eval()
    return network


def _network(
    options: argparse.Namespace, weights: Path | None, frames: Sequence[TrainingFrame], name: str
) -> Network:
    """Read a network, or train it; an interrupted training is continued."""
    if weights is not None:
        return _load_weights(weights)
    checkpoint = options.output.with_name(f"{options.output.name}.{name}.checkpoint")
    network = train_network(
        frames,
        NetworkTraining(steps=options.steps, random_state=options.seed),
        initial=None if options.init is None else _load_weights(options.init),
        device=options.device,
        jobs=options.jobs,
        checkpoint=checkpoint,
        on_step=lambda _, line: print(f"{name} network, {line}", flush=True),
    )
    checkpoint.unlink(missing_ok=True)
    return network


def _metadata(options: argparse.Namespace, sources: Sequence[FrameDataset]) -> dict[str, Any]:
    training = NetworkTraining(steps=options.steps, random_state=options.seed)
    facts: dict[str, Any] = {
        name: getattr(training, name) for name in ("steps", "batch", "rate", "random_state")
    }
    facts["size"] = "x".join(map(str, training.size))
    data: dict[str, Any] = {source.name: sum(map(len, source.sets)) for source in sources}
    return {
        "data": data | {"sha256": fingerprint(sources)},
        "training": facts | ({"hardware": options.trained_on} if options.trained_on else {}),
        "versions": package_versions(),
    }


def _write_reports(
    options: argparse.Namespace,
    model: NetworkModel,
    folds: Sequence[FoldDetections],
    sources: Sequence[FrameDataset],
) -> None:
    scores = [score_logits(fold, model) for fold in folds]
    if options.card is not None:
        write_card(options.card, model, folds, sources, seed=options.seed, trained_on=options.trained_on)
    if options.curves is not None:
        write_curves(options.curves, folds)
    if options.pictures is not None:
        write_pictures(options.pictures, scores, folds)
    for score in scores:
        print(f"{score.name}: F1 {score.f1:.3f}, as regions {score.region_f1:.3f}")


if __name__ == "__main__":
    main()
