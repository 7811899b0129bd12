"""The demo: a drive is drawn, its vehicles are followed, and the result is scored against the truth."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.detector import VehicleDetector
from vehicle_detection.evaluation import TrackScores, evaluate_tracks, read_labels
from vehicle_detection.export import TrackWriter
from vehicle_detection.images import write_image
from vehicle_detection.synthetic import Drive, render_drive, write_labels
from vehicle_detection.video import VideoReport, process_video, read_frames

FILES = ("clip.mp4", "annotated.mp4", "tracks.csv", "labels.csv", "contact_sheet.png")
"""What the demo writes: drawn clip, annotated clip, tracks, truth, and some annotated frames."""

SHEET = (2, 3)
"""Rows and columns of the contact sheet."""

_TILE = (640, 360)


@dataclass(frozen=True)
class DemoResult:
    """What the demo found.

    Attributes
    ----------
    report
        The run over the clip, without the drawing of it.
    scores
        Its tracks against the truth.
    """

    report: VideoReport
    scores: TrackScores


def run_demo(
    folder: Path, detector: VehicleDetector, *, frames: int, random_state: int, progress: bool
) -> DemoResult:
    """Draw a drive, annotate it and score it; ``FILES`` appear in `folder` together or not at all."""
    drive = render_drive(frames=frames, random_state=random_state)
    with tempfile.TemporaryDirectory(prefix=".demo.", dir=folder) as temporary:
        clip, annotated, tracks, labels, sheet = (Path(temporary) / name for name in FILES)
        draw_clip(drive, clip, labels, progress=progress)
        # Compiling the kernels, after an installation, is not part of the speed.
        detector.warm_up(drive.shape)
        with TrackWriter(tracks) as write:
            report = process_video(clip, annotated, detector, progress=progress, on_result=write)
        scores = evaluate_tracks(read_labels(tracks), read_labels(labels), frames=range(len(drive)))
        write_image(sheet, contact_sheet(annotated))
        for name in FILES:
            (Path(temporary) / name).replace(folder / name)
    return DemoResult(report, scores)


def draw_clip(drive: Drive, clip: Path, labels: Path, *, progress: bool = False) -> None:
    """Write the frames of a drive as a video, and their truth as a table."""
    # moviepy, not `process_video`: there is no source to take frames from.
    from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
    from tqdm import tqdm

    height, width = drive.shape
    truth = []
    with FFMPEG_VideoWriter(str(clip), (width, height), drive.fps, preset="veryfast") as writer:
        for scene in tqdm(drive, desc="drawing", unit="frame", disable=None if progress else True):
            truth.append(scene.truth)
            writer.write_frame(scene.image)
    write_labels(labels, enumerate(truth))


def contact_sheet(video: Path) -> NDArray[np.uint8]:
    """Put frames of a video, from its first to its last in even steps, side by side: ``(H, W, 3)`` uint8."""
    rows, columns = SHEET
    with read_frames(video) as reader:
        # Small copies only: a list of whole frames fills the memory.
        tiles = [cv2.resize(frame, _TILE, interpolation=cv2.INTER_AREA) for _, _, frame in reader]
    chosen = [tiles[row] for row in np.linspace(0, len(tiles) - 1, rows * columns).round().astype(int)]
    return np.vstack([np.hstack(chosen[row * columns : (row + 1) * columns]) for row in range(rows)])
