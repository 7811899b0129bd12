"""Make the pictures of the README: ``python -m tools.pictures -o docs``.

A drive is rendered and annotated with the shipped default model. If a box is false or missing in any frame,
nothing is written and the errors are listed; choose another seed in `SCENE` then. `RECORD` keeps the drawn
boxes and the hashes of model and pictures, so that a test can compare them with the truth of the drive.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

import vehicle_detection
from vehicle_detection import DetectorError, FrameResult, VehicleDetectionError, VehicleDetector, iou_matrix
from vehicle_detection._common import atomic_write, progress_bar, write_text
from vehicle_detection.annotator import Annotator, DrawParams
from vehicle_detection.camera import Camera
from vehicle_detection.images import write_image
from vehicle_detection.scenes import VehicleTruth, render_drive

Image = NDArray[np.uint8]

SCENE: dict[str, Any] = {"scenario": "traffic", "frames": 75, "random_state": 23}
"""Options of `render_drive`."""

HERO, ANIMATION, GIF, RECORD = "picture.jpg", "animation.webp", "animation.gif", "pictures.json"
FILES = (HERO, ANIMATION, GIF)

MODEL = Path(vehicle_detection.__file__).parent / "models" / "default.onnx"

_HERO_FRAME = 0.5  # position in the drive
# Width of the frames in the animations, step of the frames in the GIF, and its number of colors.
_WEBP_WIDTH, _GIF_WIDTH, _GIF_STEP, _GIF_COLORS = 640, 480, 3, 128
# Changes of a pixel up to this many gray levels per channel are left out of the GIF.
_GIF_TOLERANCE = 12
_MIN_IOU = 0.5


def make_pictures(folder: Path, detector: VehicleDetector, scene: Mapping[str, Any] = SCENE) -> None:
    """Write `FILES` and `RECORD` into a folder, unless a box is false or missing."""
    drive = render_drive(**scene)
    detector.reset(fps=drive.fps)
    images, results = [], []
    with progress_bar(True, len(drive), unit="frame", desc="drawing", interactive_only=True) as bar:
        for index, rendered in enumerate(drive):
            images.append(rendered.image)
            results.append(detector.process(rendered.image, index / drive.fps))
            bar.update()
    boxes = [[track.box.round(1).tolist() for track in result.shown] for result in results]
    errors = find_errors(boxes, drive.truth)
    errors += _identity_errors(results)
    if errors:
        raise DetectorError("; ".join(errors[:10]) + "; choose another random_state of SCENE")
    _write_hero(folder / HERO, images, results)
    frames = _annotate_small(images, results, _WEBP_WIDTH)
    _write_animation(folder / ANIMATION, frames, 1 / drive.fps, quality=50, method=5)
    frames = _hold_pixels(_annotate_small(images, results, _GIF_WIDTH)[::_GIF_STEP])
    _write_animation(folder / GIF, _reduce_colors(frames), _GIF_STEP / drive.fps)
    record = {
        "scene": dict(scene),
        "model": file_hash(MODEL),
        "files": {name: file_hash(folder / name) for name in FILES},
        "boxes": boxes,
    }
    write_text(folder / RECORD, json.dumps(record) + "\n")


def find_errors(
    boxes: Iterable[Sequence[Sequence[float]]], truth: Iterable[Sequence[VehicleTruth]]
) -> list[str]:
    """List the false and missing boxes of each frame; every vehicle of the truth must have one box."""
    errors = []
    for index, (found, rows) in enumerate(zip(boxes, truth, strict=True)):
        overlap = iou_matrix(found, [row.box for row in rows]) >= _MIN_IOU
        false, missing = int((overlap.sum(axis=1) != 1).sum()), int((overlap.sum(axis=0) != 1).sum())
        if false or missing:
            errors.append(f"frame {index}: {false} false and {missing} missing boxes")
    return errors


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _identity_errors(results: Sequence[FrameResult]) -> list[str]:
    """List the frames in which other tracks are shown than in the first one."""
    first = {track.id for track in results[0].shown}
    return [
        f"frame {result.index}: other tracks than in the first frame"
        for result in results
        if {track.id for track in result.shown} != first
    ]


def _write_hero(path: Path, images: Sequence[Image], results: Sequence[FrameResult]) -> None:
    """Write the frame at `_HERO_FRAME`, with the trails of the frames before it."""
    drawer, last = Annotator(DrawParams(panel="corner")), int(_HERO_FRAME * len(images))
    for image, result in zip(images[: last + 1], results):
        drawn = drawer.draw_tracks(image, result.tracks, time=result.time)
    write_image(path, drawn)


def _annotate_small(
    images: Sequence[Image], results: Sequence[FrameResult], width: int
) -> list[PillowImage.Image]:
    """Downscale frames, then draw tracks and a bird's-eye view beside them, so that text stays readable."""
    scale = width / images[0].shape[1]
    size = (width, round(scale * images[0].shape[0]))
    camera = Camera.for_frame(size[::-1])
    drawer, drawn = Annotator(DrawParams(panel="side"), camera=camera), []
    for image, result in zip(images, results):
        small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        tracks = [dataclasses.replace(track, box=track.box * scale) for track in result.tracks]
        picture = drawer.draw_tracks(small, tracks, time=result.time)
        drawn.append(PillowImage.fromarray(picture))
    return drawn


def _hold_pixels(frames: Sequence[PillowImage.Image]) -> list[PillowImage.Image]:
    """Keep a pixel until it changes clearly, because unchanged pixels take no space in a GIF."""
    shown = np.asarray(frames[0], np.int16)
    held = []
    for frame in frames:
        new = np.asarray(frame, np.int16)
        changed = np.abs(new - shown).max(axis=2, keepdims=True) > _GIF_TOLERANCE
        shown = np.where(changed, new, shown)
        held.append(PillowImage.fromarray(shown.astype(np.uint8)))
    return held


def _reduce_colors(frames: Sequence[PillowImage.Image]) -> list[PillowImage.Image]:
    """Give all frames the palette of one in the middle, without dithering, which makes files large."""
    # The octree keeps the rare colors of labels and lights, unlike the median cut.
    palette = frames[len(frames) // 2].quantize(_GIF_COLORS, PillowImage.Quantize.FASTOCTREE)
    return [frame.quantize(palette=palette, dither=PillowImage.Dither.NONE) for frame in frames]


def _write_animation(path: Path, frames: Sequence[PillowImage.Image], seconds: float, **options: Any) -> None:
    """Write frames, each shown for some seconds, as an animation that repeats."""
    options |= {"save_all": True, "append_images": frames[1:], "duration": round(1000 * seconds), "loop": 0}
    with atomic_write(path) as part:
        frames[0].save(part, path.suffix[1:], **options)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, annotate, check and write the pictures."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.pictures", description="Make the README's pictures."
    )
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, default=Path("docs"), help="folder")
    folder = parser.parse_args(arguments).output
    try:
        with VehicleDetector(camera=Camera.dashcam(fov=58)) as detector:
            make_pictures(folder, detector)
    except VehicleDetectionError as error:
        parser.error(str(error))
    for name in FILES:
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
