"""The files of a source: one file, or those of a folder or pattern."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from pathlib import Path

from vehicle_detection._common import check_path, is_hidden, natural_key
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.probe import probe
from vehicle_detection.video.trips import find_trips, is_video_file

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
"""Suffixes of the images that a folder is searched for."""


def list_files(path: Path) -> list[Path]:
    """List the files of a source: a file, or the videos of one trip or images of a folder or pattern."""
    if path.is_dir():
        found = sorted(each for each in walk_files(path) if each.is_file())
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
        return sorted(images, key=lambda image: natural_key(str(image)))
    trips = find_trips(videos, duration=lambda each: probe(each).duration)
    if len(trips) > 1:
        listed = "; ".join(f"{trip} from {Path(trip.files[0]).name}" for trip in trips[:4])
        example = videos[0].parent / f"*{Path(trips[0].files[0]).name[-5:]}"
        raise InvalidInputError(
            f"source {path} holds {len(trips)} trips ({listed}{', ...' if len(trips) > 4 else ''}); select "
            f"one with a pattern such as '{example}', or process all with vehicle-detection batch"
        )
    return [Path(file) for file in trips[0].files]


def walk_files(folder: Path, name: str = "source") -> Iterator[Path]:
    """Yield the files of a folder and below that are not hidden, each once, also where links lead to folders.

    A folder that cannot be read is an error, not an empty one; `name` is that of the argument.
    """

    def refuse(error: OSError) -> None:
        raise InvalidInputError(
            f"{name} {error.filename} cannot be listed ({error.strerror}); change its permissions"
        ) from error

    visited = set[str]()
    for parent, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        place = os.path.realpath(parent)
        folders[:] = [] if place in visited else sorted(each for each in folders if not is_hidden(each))
        if place not in visited:
            yield from (Path(parent, each) for each in files if not is_hidden(each))
        visited.add(place)


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
