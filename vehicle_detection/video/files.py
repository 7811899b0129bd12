"""The files of a source: one file, or those of a folder or pattern."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from pathlib import Path, PurePath

from vehicle_detection._common import check, check_regular_file, is_hidden, is_url, natural_key, without_query
from vehicle_detection.errors import InvalidInputError

VIDEO_SUFFIXES = {
    ".mp4", ".m4v", ".mov", ".mkv", ".avi", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp",
}  # fmt: skip
"""Suffixes of the videos that a folder is searched for."""
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
"""Suffixes of the images that a folder is searched for."""


def is_video_file(file: Path | str) -> bool:
    """Whether the name of a file, or a URL, has the suffix of a video, and is not hidden."""
    text = os.fspath(file)
    name = PurePath(without_query(text))
    return name.suffix.lower() in VIDEO_SUFFIXES and not name.name.startswith(".")


def list_files(source: str | os.PathLike[str]) -> list[Path]:
    """List the videos of a folder or pattern in the order of their paths, or else its images by their names.

    Empty if the source is anything else.
    """
    text = os.fsdecode(source)
    path = check.path(text, "source", kind="the path of a video file")
    if is_url(text):
        return []
    if path.is_dir():
        found = sorted(each for each in walk_files(path) if each.is_file())
    elif not path.exists() and glob.has_magic(text):
        found = sorted(Path(each) for each in glob.glob(text, recursive=True))
        found = [each for each in found if each.is_file()]
    else:
        return []
    images = [each for each in found if each.suffix.lower() in IMAGE_SUFFIXES]
    files = [each for each in found if is_video_file(each)]
    files = files or sorted(images, key=lambda image: natural_key(str(image)))
    if not files:
        raise InvalidInputError(f"source {path} holds no videos and no images; check the path")
    return files


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
    path = check.path(path, "source", kind="the path of a video file")
    check_regular_file(path, f"source {path}")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} is not readable; change its permissions")
    return path
