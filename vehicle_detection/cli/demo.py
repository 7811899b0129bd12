"""The command that draws a drive, tracks its vehicles and scores the tracks against the ground truth."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.options import flag, option
from vehicle_detection.cli.output import option_names, output_folder, print_facts, print_line
from vehicle_detection.errors import OutputError, VehicleDetectionError, VideoError

if TYPE_CHECKING:
    from vehicle_detection.scenes import Drive, VehicleTruth
    from vehicle_detection.video import VideoReport

# Files that the demo writes, the report only if it is asked for.
FILES = ("clip.mp4", "annotated.mp4", "tracks.csv", "labels.csv", "contact_sheet.png")
REPORT = "report.html"
# Rows and columns of the contact sheet, and size of each frame in it.
SHEET, _TILE = (2, 3), (640, 360)


@option_names(random_state="--seed")
def demo(
    output: Path = option("DIR", "Folder to write.", "-o", "--output", default=Path("demo")),
    frames: int = option("N", "Number of frames.", default=120),
    seed: int = option("N", "Random seed of the scene.", default=0),
    report: bool = flag("--report", "Write a page with the video and its tracks."),
) -> None:
    """Draw a drive, annotate it with the default model and score it against the ground truth.

    Oncoming vehicles are scored too; boxes on vehicles that are under 40 pixels wide or largely hidden are
    neither right nor wrong.
    """
    files = (*FILES, REPORT) if report else FILES
    camera = vd.Camera.dashcam(fov=58)  # that of the rendering camera
    with output_folder(output, "--output"), vd.VehicleDetector(camera=camera) as detector:
        drive = vd.render_drive(frames=frames, random_state=seed)
        done, scores = _run(output, detector, drive, files)
    speed = done.frames_per_second / float(done.fps)
    print_facts(
        f"{scores.frames} rendered frames of 1280x720, {scores.vehicles} vehicles, {scores.tracks} tracks",
        {
            "F1": f"{scores.f1:.3f}",
            "mean IoU": f"{scores.mean_iou:.3f}",
            "MOTA": f"{scores.mota:.3f}",
            "boxes": f"{scores.tp} on a vehicle, {scores.fn} missed, {scores.fp} false",
            "identity switches": scores.id_switches,
            "speed": f"{done.frames_per_second:.1f} frames/s on this machine, {speed:.1f} times real time",
        },
    )
    if speed < 1:
        print_line(
            "slower than real time: video --every 4 searches fewer frames, and --tracks without -o writes no "
            "video; other programs that keep the processor busy slow it down"
        )
    print_line(f"wrote {', '.join(files)} in {output}")


def _run(
    folder: Path, detector: vd.VehicleDetector, drive: Drive, files: Sequence[str]
) -> tuple[VideoReport, vd.evaluation.TrackScores]:
    """Draw a drive, annotate and score it, oncoming vehicles too; an error leaves no file in the folder."""
    import numpy as np

    with common.temporary_folder(folder, "demo") as temporary, _named_in(folder, temporary):
        clip, annotated, tracks, labels, sheet = (temporary / name for name in FILES)
        page = vd.ReportWriter(temporary / REPORT, video=annotated, source=clip, detector=detector)
        draw_clip(drive, clip, labels, progress=True)
        # Compile the kernels now, so that the reported speed does not include it.
        detector.detect(np.zeros((*drive.shape, 3), np.uint8))
        with vd.open_tracks(tracks) as write:
            writers: list[Callable[[Any], object]] = [write, page]
            done = vd.process_video(
                clip, annotated, detector, on_result=lambda result: [each(result) for each in writers]
            )
        found, true = vd.read_labels(tracks), vd.read_labels(labels)
        scores = vd.evaluate_tracks(found, true, frames=range(len(drive)))
        vd.write_image(sheet, contact_sheet(annotated))
        if REPORT in files:
            page.finish(done)
        for name in files:
            (temporary / name).replace(folder / name)
    return done, scores


@contextlib.contextmanager
def _named_in(folder: Path, temporary: Path) -> Iterator[None]:
    """Replace a temporary folder in errors by the one for which its files are made."""
    try:
        yield
    except VehicleDetectionError as error:
        raise type(error)(str(error).replace(str(temporary), str(folder))) from error


def draw_clip(drive: Drive, clip: Path, labels: Path, *, progress: bool = False) -> None:
    """Write the frames of a drive as a video, and their ground truth as a table, with oncoming vehicles."""
    from vehicle_detection.scenes import truth_table

    height, width = drive.shape
    truth: dict[int | str, list[VehicleTruth]] = {}
    try:
        # moviepy, because `process_video` needs a source. It looks for ffmpeg when it is imported.
        from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter
    except RuntimeError:
        raise VideoError("no ffmpeg was found; install it, or set FFMPEG_BINARY to its path") from None
    try:
        with (
            FFMPEG_VideoWriter(str(clip), (width, height), drive.fps, preset="veryfast") as writer,
            common.progress_bar(progress, len(drive), unit="frame", interactive_only=True) as bar,
        ):
            for index, scene in enumerate(drive):
                truth[index] = scored_truth(scene.truth)
                writer.write_frame(scene.image)
                bar.update()
    except OSError as error:  # its text is ffmpeg's log
        full = "No space left" in str(error)
        reason = "the disk is full; free some space" if full else "ffmpeg failed; check the folder"
        raise OutputError(f"{clip} cannot be written: {reason}") from error
    vd.write_labels(truth_table(truth), labels)


def scored_truth(rows: Sequence[VehicleTruth]) -> list[VehicleTruth]:
    """Ground truth in which oncoming vehicles count as well."""
    return [replace(row, ignore=int(row.hard_to_see)) for row in rows]


def contact_sheet(video: Path) -> Any:
    """Arrange evenly spaced frames of a video in one ``(H, W, 3)`` uint8 image."""
    import cv2
    import numpy as np

    rows, columns = SHEET
    with vd.read_frames(video) as reader:
        # Downscaled at once: the full frames of a video may not fit into memory.
        tiles = [cv2.resize(frame, _TILE, interpolation=cv2.INTER_AREA) for _, _, frame in reader]
    chosen = [tiles[row] for row in np.linspace(0, len(tiles) - 1, rows * columns).round().astype(int)]
    return np.vstack([np.hstack(chosen[row * columns : (row + 1) * columns]) for row in range(rows)])
