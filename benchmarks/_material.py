"""The data of the benchmarks: real data if available, else rendered.

Functions also return a short description of the data.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Target
from vehicle_detection import (
    FeatureParams,
    VehicleClassifier,
    load_classifier,
    load_training_patches,
    read_frames,
    render_drive,
    render_patches,
    train_classifier,
)
from vehicle_detection._common import FORMAT_VERSION
from vehicle_detection.datasets import PatchSet
from vehicle_detection.scenes import Drive

DATA_VARIABLE = "VEHICLE_DETECTION_DATA"

CLIP = "project_clip"
SEARCHED_FRAME = 300
"""Frame of the clip that is searched: two cars on a road with shadows."""

DRAWN_FRAMES = 60

_STRIDE = 6
"""The searched classifier is trained on every sixth patch; its speed does not depend on the weights."""


@dataclass(frozen=True)
class Context:
    """Options of a run: a temporary folder, a folder for plots, whether to measure longer, and seeds.

    `seeds` is the number of drives of each kind, and `jobs` the number of processes that track them.
    `sequences` are folders with measured distances, and `fps` is their frame rate.
    """

    work: Path
    plots: Path | None = None
    long: bool = False
    seeds: int = 1
    jobs: int = 1
    sequences: Sequence[Path] = ()
    fps: float | None = None


def data_folder() -> Path | None:
    """Folder of the real data; None without it."""
    folder = os.environ.get(DATA_VARIABLE)
    return Path(folder) if folder and Path(folder).is_dir() else None


def is_real() -> bool:
    """Whether the real data is used."""
    return data_folder() is not None


def if_real(target: Target) -> Target | None:
    """Return a target that applies to the real data only; None without it."""
    return target if is_real() else None


def drawn_drive() -> Drive:
    """Return the rendered drive that replaces the project clip."""
    return render_drive(frames=DRAWN_FRAMES, random_state=1)


def clip(work: Path) -> tuple[Path, str]:
    """Video of 1280x720: the project clip, or the rendered drive."""
    folder = data_folder()
    if folder is not None:
        return folder / "videos" / f"{CLIP}.mp4", CLIP
    target = work / "drive.mp4"
    if not target.exists():
        write_video(target, (scene.image for scene in drawn_drive()))
    return target, "synthetic drive"


def repeated_clip(source: Path, frames: int, work: Path) -> Path:
    """Repeat a video to exactly `frames` frames, without encoding it again."""
    target = work / f"{source.stem}_{frames}.mp4"
    if not target.exists():
        options = ["-stream_loop", "-1", "-i", str(source), "-an", "-c:v", "copy", "-frames:v", str(frames)]
        subprocess.run([ffmpeg(), "-v", "error", "-y", *options, str(target)], check=True)
    return target


def write_video(target: Path, frames: Iterator[NDArray[np.uint8]], fps: int = 25) -> None:
    """Encode frames as H.264."""
    first = next(frames)
    size = f"{first.shape[1]}x{first.shape[0]}"
    raw = ["-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", size, "-framerate", str(fps), "-i", "-"]
    options = ["-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p", str(target)]
    with subprocess.Popen([ffmpeg(), "-v", "error", "-y", *raw, *options], stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write(first.tobytes())
        for frame in frames:
            process.stdin.write(frame.tobytes())
    if process.returncode:
        raise RuntimeError(f"ffmpeg could not write {target.name}")


def ffmpeg() -> str:
    """Path of the ffmpeg that moviepy uses."""
    from moviepy.config import FFMPEG_BINARY

    return str(FFMPEG_BINARY)


def searched_frame() -> tuple[NDArray[np.uint8], str]:
    """One 1280x720 frame with vehicles."""
    folder = data_folder()
    if folder is None:
        return drawn_drive()[0].image, "synthetic frame"
    source = folder / "videos" / f"{CLIP}.mp4"
    with read_frames(source, start=SEARCHED_FRAME / 25) as frames:
        return next(iter(frames))[2], f"frame {SEARCHED_FRAME} of {CLIP}"


def patches(*, synthetic: int = 600) -> tuple[PatchSet, str]:
    """Return the course's 17,760 patches, or `synthetic` rendered ones."""
    folder = data_folder()
    if folder is not None:
        found = load_training_patches(folder / "vehicles.zip", folder / "non-vehicles.zip")
        return found, f"{len(found):,} patches"
    images, labels = render_patches(synthetic, random_state=1)
    names = [f"{'vehicles' if label else 'non-vehicles'}/drawn/{i}.png" for i, label in enumerate(labels)]
    return PatchSet(images, labels, tuple(names)), f"{synthetic} synthetic patches"


def classifier_for_search(name: str = "ycrcb-8460") -> tuple[VehicleClassifier, str]:
    """Classifier with the features of a system of the course, cached in the temporary folder."""
    kind = "real" if is_real() else "synthetic"
    folder = Path(tempfile.gettempdir()) / "vehicle-detection-benchmarks"
    folder.mkdir(exist_ok=True)
    file = folder / f"{name}-{kind}-{FORMAT_VERSION}.safetensors"
    if not file.exists():
        found, _ = patches()
        part = found[::_STRIDE] if is_real() else found
        params = FeatureParams.preset(name)
        train_classifier(part.patches, part.labels, params=params).save(file)
    source = f"every {_STRIDE}th real patch" if is_real() else "synthetic patches"
    return load_classifier(file), f"{name} model trained on {source}"
