"""The command that scores boxes and tracks against labels."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.options import flag, option
from vehicle_detection.cli.output import check_targets, print_error, print_line
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.tables import FrameKey


def evaluate(
    predictions: Path = Argument(
        ...,
        metavar="PREDICTIONS.csv",
        help="Boxes or tracks: .csv, .jsonl, .parquet, .txt (MOT) or .json (COCO data set or results).",
    ),
    labels: Path = Argument(
        ..., metavar="LABELS.csv", help="True boxes, in one of these formats, or a folder of KITTI or YOLO."
    ),
    iou: float = option("F", "Minimum IoU of a correct box.", default=0.5),
    ignored_as_regions: bool = flag(
        "--ignored-as-regions", "Ignore boxes of which half lies in an ignored box."
    ),
    frames: str | None = option(
        "LIST|FILE",
        "Score only these frames: numbers, such as 0,6,12, 0-299 or 0-299:6 (every 6th), or a text file "
        "with the number or name of a frame in each line.",
    ),
    images: Path | None = option(
        "DIR", "Folder of the images, whose sizes YOLO folders need, such as images/val."
    ),
    json: Path | None = option("FILE", "File for all scores, such as scores.json."),
) -> None:
    """Score boxes, and tracks if there are any, against labels."""
    from json import dumps

    import numpy as np

    from vehicle_detection.evaluation import evaluate_distances
    from vehicle_detection.tables import NO_TRACK

    check_targets({"--json": json}, {"PREDICTIONS": predictions, "LABELS": labels})
    found = vd.read_labels(predictions, truth=labels, images=images)
    true = vd.read_labels(labels, images=images)
    # Equal scores may be flags of labels, as in MOTChallenge's ground truth.
    scored = "score" in true.columns and len(set(true["score"].tolist())) > 1
    if len(found) and "score" not in found.columns and scored:
        raise InvalidInputError(
            f"{labels} has scores and {predictions} has none, so they seem to be swapped; pass the "
            "predictions first, then the labels; if these are labels with scores, remove the scores"
        )
    found = vd.evaluation.match_names(found, true.frame_keys, (str(predictions), str(labels)))
    chosen = None
    if frames is not None:
        chosen = _parse_frames(frames, true.frame_keys)
        found, true = (each.select(chosen) for each in (found, true))
    options: dict[str, Any] = {"iou": iou, "ignored_as_regions": ignored_as_regions, "frames": chosen}
    scores: dict[str, Any] = {"detections": vd.evaluate_detections(found, true, **options)}
    unknown = [int(((boxes["track_id"] == NO_TRACK) & ~boxes["ignore"]).sum()) for boxes in (found, true)]
    if not any(unknown):
        scores["tracks"] = vd.evaluate_tracks(found, true, **options)
    if all(np.isfinite(boxes["distance_m"]).any() for boxes in (found, true)):
        scores["distances"] = evaluate_distances(found, true, iou=iou, frames=chosen)
    print_line("\n\n".join(each.summary() for each in scores.values()))
    if scored:
        print_error(f"note: {labels} has scores, as results do; its boxes are taken for true ones")
    _note_frames_of_one_file(found, true, chosen, predictions, labels)
    boxes = scores["detections"]
    if boxes.fp and boxes.fn and not boxes.tp:
        print_error("note: no box is on a label; check that image sizes and frame numbers agree")
    for side, count, file in zip((found, true), unknown, (predictions, labels)):
        if 0 < count < (~side["ignore"]).sum():
            noun = "box has" if count == 1 else "boxes have"
            print_error(f"note: the tracks are not scored: {count} {noun} no track in {file}")
    if json is not None:
        plain = {name: each.to_dict() for name, each in scores.items()}
        common.write_text(json, dumps(plain, indent=2) + "\n")


def _note_frames_of_one_file(
    found: vd.TrackTable,
    true: vd.TrackTable,
    chosen: Collection[FrameKey] | None,
    predictions: Path,
    labels: Path,
) -> None:
    """Print a note if many frames have labels and no boxes, or boxes and no labels."""
    labelled = set(true["frame"].tolist() if chosen is None else chosen)
    unseen = len(labelled - set(found["frame"].tolist()))
    if unseen > 0.5 * len(labelled):
        print_error(
            f"note: {unseen} of {len(labelled)} labelled frames have no box in {predictions}, so their "
            "vehicles count as missed; pass --frames if not all of them were searched"
        )
    searched = set(found["frame"][~found["ignore"]].tolist())
    unlabelled = len(searched - set(true.frame_keys if chosen is None else chosen))
    if unlabelled > 0.1 * len(searched):
        print_error(
            f"note: {unlabelled} of {len(searched)} frames with boxes have no row in {labels}, so their "
            "boxes count as false; pass --frames if not all of them are labelled"
        )


def _parse_frames(text: str, keys: Sequence[FrameKey]) -> list[FrameKey]:
    """Frames of numbers and ranges, or of a file with a frame in each line; some must be among the keys."""
    span = r"\s*(\d{1,9})(?:-(\d{1,9})(?::([1-9]\d{0,8}))?)?\s*"
    spans = [re.fullmatch(span, part) for part in text.split(",")]
    chosen: list[FrameKey] = []
    if all(spans):
        for first, last, step in (found.groups() for found in spans if found):
            chosen += range(int(first), int(last or first) + 1, int(step or 1))
    else:
        kind = "numbers such as 0,6,12 or 0-299 (0-299:6 for every 6th), or a file with a frame in each line"
        file = common.check.path(text, "--frames", kind=kind)
        if not file.exists():
            raise InvalidInputError(f"--frames must be {kind}, got {text!r}")
        data = common.read_regular_file(file, f"--frames {text}", common.Limit.TEXT_BYTES)
        lines = data.decode("utf-8-sig", "replace").splitlines()
        names = [line.strip() for line in lines if line.strip()]
        numbered = bool(keys) and isinstance(keys[0], int)
        chosen = [int(name) for name in names if name.isdecimal()] if numbered else [*names]
    if not set(chosen) & set(keys):
        example = f", such as {keys[0]}" if keys else ", which hold none"
        raise InvalidInputError(f"--frames {text} names no frame of the labels{example}")
    return list(dict.fromkeys(chosen))
