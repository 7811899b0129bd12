"""Detection and tracking on labelled frames: F1, IoU, jitter and identity switches."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks._material import CLIP, Context, clip, data_folder, drawn_drive
from benchmarks._report import Row, Target, at_least, at_most
from vehicle_detection import (
    FrameResult,
    VehicleDetector,
    evaluate_detections,
    evaluate_tracks,
    load_frames,
    load_model,
    read_frames,
    read_labels,
)
from vehicle_detection.evaluation import FrameBoxes, TrackScores


def run(context: Context) -> list[Row]:
    """Score images by `detect` and clips by `process`; without the real data, a rendered drive."""
    folder = data_folder()
    if folder is None:
        source, material = clip(context.work)
        truth = context.work / "drive.csv"
        drawn_drive().write_labels(truth)
        return _clip_rows("drive", source, truth, material=material, has_targets=False)
    labels, videos = folder / "labels", folder / "videos"
    note = "IoU 0.5; both models were trained on images of this road, which favors them"
    rows: list[Row] = []
    for model in ("default", "highway"):
        rows += _image_rows(model, folder / "test_images", labels / "test_images.csv", note)
        for clip_name, min_f1 in (("test_video", 1.0), (CLIP, 0.99)):
            files = videos / f"{clip_name}.mp4", labels / f"{clip_name}.csv"
            rows += _clip_rows(f"{model}: {clip_name}", *files, model=model, min_f1=min_f1)
    return rows


def _image_rows(model: str, folder: Path, labels: Path, material: str) -> list[Row]:
    with VehicleDetector(load_model(model)) as detector:
        found = FrameBoxes.from_detections(
            {name: detector.detect(image) for name, image in load_frames(folder)}
        )
    scores = evaluate_detections(found, read_labels(labels))
    return [
        Row(
            f"{model}: test_images: F1",
            scores.f1,
            target=at_least(1.0),
            material=material,
            details=scores.to_dict(),
        ),
        Row(f"{model}: test_images: mean IoU", scores.mean_iou, target=at_least(0.80)),
    ]


def _clip_rows(
    name: str,
    source: Path,
    labels: Path,
    *,
    model: str = "default",
    min_f1: float = 1.0,
    material: str = "",
    has_targets: bool = True,
) -> list[Row]:
    scores = track_scores(source, labels, model)
    values: list[tuple[str, float, str, Target]] = [
        ("F1", scores.f1, "", at_least(min_f1)),
        ("mean IoU", scores.mean_iou, "", at_least(0.80)),
        ("jitter", scores.jitter, "px/frame", at_most(1.5)),
        ("identity switches", scores.id_switches, "", Target("=", 0)),
        ("longest false run", scores.longest_false_positive_run, "frames", at_most(3)),
    ]
    return [
        Row(
            f"{name}: {what}",
            value,
            unit=unit,
            target=target if has_targets else None,
            material=material,
            details=scores.to_dict() if what == "F1" else {},
        )
        for what, value, unit, target in values
    ]


def track_scores(source: Path, labels: Path, model: str = "default") -> TrackScores:
    """Track the vehicles of a clip and score the tracks that are drawn."""
    with VehicleDetector(load_model(model)) as detector, read_frames(source) as frames:
        detector.reset(fps=float(frames.info.fps))
        results = [detector.process(frame, time) for _, time, frame in frames]
    return evaluate_tracks(shown_boxes(results), read_labels(labels), frames=range(len(results)))


def shown_boxes(results: Iterable[FrameResult]) -> FrameBoxes:
    """Boxes of the tracks that are drawn, as predictions."""
    rows = [(result.index, track) for result in results for track in result.shown]
    return FrameBoxes(
        [index for index, _ in rows],
        np.array([track.id for _, track in rows], np.int64),
        np.array([track.box for _, track in rows], np.float64).reshape(-1, 4),
        scores=np.array([track.score for _, track in rows], np.float64),
    )
