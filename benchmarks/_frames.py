"""Detection and tracking on labelled frames: F1, IoU, jitter and identity switches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks._material import CLIP, Context, clip, data_folder, drawn_drive
from benchmarks._report import Row, Target, at_least, at_most
from vehicle_detection import (
    FrameResult,
    VehicleDetector,
    evaluate_detections,
    evaluate_tracks,
    load_frames,
    process_video,
    read_labels,
    write_labels,
)
from vehicle_detection.tables import TrackTable


def run(context: Context) -> list[Row]:
    """Score images by `detect` and clips by `process_video`; without the real data, a rendered drive."""
    folder = data_folder()
    if folder is None:
        source, material = clip(context.work)
        truth = context.work / "drive.csv"
        write_labels(drawn_drive().labels, truth)
        return [replace(row, target=None) for row in _clip_rows("drive", source, truth, material=material)]
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
    with VehicleDetector(model) as detector:
        found = TrackTable.from_detections(
            {name: detector.detect(image) for name, image in load_frames(folder)}
        )
    scores = evaluate_detections(found, read_labels(labels))
    name, details = f"{model}: test_images", scores.to_dict()
    return [
        Row(f"{name}: F1", scores.f1, target=at_least(1.0), material=material, details=details),
        Row(f"{name}: mean IoU", scores.mean_iou, target=at_least(0.80)),
    ]


def _clip_rows(
    name: str, source: Path, labels: Path, *, model: str = "default", min_f1: float = 1.0, material: str = ""
) -> list[Row]:
    """Track the vehicles of a clip and score the tracks that are drawn."""
    results: list[FrameResult] = []
    with VehicleDetector(model) as detector:
        process_video(source, None, detector, progress=False, on_result=results.append)
    scores = evaluate_tracks(
        TrackTable.from_results(results), read_labels(labels), frames=range(len(results))
    )
    false_run, details = scores.longest_false_positive_run, scores.to_dict()
    return [
        Row(f"{name}: F1", scores.f1, target=at_least(min_f1), material=material, details=details),
        Row(f"{name}: mean IoU", scores.mean_iou, target=at_least(0.80)),
        Row(f"{name}: jitter", scores.jitter, unit="px/frame", target=at_most(1.5)),
        Row(f"{name}: identity switches", scores.id_switches, target=Target("=", 0)),
        Row(f"{name}: longest false run", false_run, unit="frames", target=at_most(3)),
    ]
