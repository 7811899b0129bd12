"""The files of a source: one file, or those of a folder or pattern."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path
from typing import Any

from vehicle_detection._common import check_path, is_hidden
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.probe import probe
from vehicle_detection.video.trips import find_trips, is_video_file

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
"""Suffixes of the images that a folder is searched for."""


def list_files(path: Path) -> list[Path]:
    """List the files of a source: a file, or the videos of one trip or images of a folder or pattern."""
    if path.is_dir():
        found = sorted(each for each in path.rglob("*") if each.is_file())
        found = [each for each in found if not is_hidden(each.relative_to(path).as_posix())]
    elif not path.exists() and glob.has_magic(str(path)):
        found = sorted(Path(each) for each in glob.glob(str(path), recursive=True))
        found = [each for each in found if each.is_file()]
    else:
        return [check_file(path)]
    videos = [each for each in found if is_video_file(each)]
    if not videos:
        images = [each for each in found if each.suffix.lower() in IMAGE_SUFFIXES]
        if not images:
            raise InvalidInputError(f"source {path} holds no videos and no images; check the path")
        return sorted(images, key=_natural_order)
    trips = find_trips(videos, duration=lambda each: probe(each).duration)
    if len(trips) > 1:
        listed = "; ".join(f"{trip} from {Path(trip.files[0]).name}" for trip in trips[:4])
        example = videos[0].parent / f"*{Path(trips[0].files[0]).name[-5:]}"
        raise InvalidInputError(
            f"source {path} holds {len(trips)} trips ({listed}{', ...' if len(trips) > 4 else ''}); select "
            f"one with a pattern such as '{example}', or process all with vehicle-detection batch"
        )
    return [Path(file) for file in trips[0].files]


def _natural_order(path: Path) -> list[Any]:
    """Sorting key of file names in which 9 comes before 10."""
    parts = re.split(r"(\d+)", str(path))
    return [int(part) if part.isdecimal() else part for part in parts]


def check_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of a readable regular file."""
    path = check_path(path, "source", kind="the path of a video file")
    if path.is_dir():
        raise InvalidInputError(f"source {path} is a folder; choose a video file in it")
    if not path.exists():
        raise InvalidInputError(f"source {path} does not exist; check the path")
    if not path.is_file():
        raise InvalidInputError(f"source {path} is not a regular file; record the stream to a file first")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} is not readable; change its permissions")
    return path
