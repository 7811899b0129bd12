"""The files of a source: on a disk, on a web server, or on storage that fsspec knows, such as S3."""

from __future__ import annotations

import errno
import glob
import os
import re
import time
from collections.abc import Callable, Iterable
from pathlib import Path, PurePath
from typing import Any, TypeVar
from urllib.parse import unquote

from vehicle_detection._common import (
    check,
    check_regular_file,
    hide_credentials,
    is_url,
    is_web_address,
    natural_key,
    read_http,
    walk_files,
    without_query,
)
from vehicle_detection.errors import InvalidInputError, TransientVideoError
from vehicle_detection.images import IMAGE_SUFFIXES

Result = TypeVar("Result")

VIDEO_SUFFIXES = {
    ".mp4", ".m4v", ".mov", ".mkv", ".avi", ".webm", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp",
}  # fmt: skip
"""Suffixes of the videos that a folder is searched for."""

# Name of an annotated copy that the command `video` writes beside its source.
_COPY = re.compile(r"(.+)_tracked(_\d+)?\.mp4")
# Seconds before the second and the third attempt of a request.
_RETRY_DELAYS = (0.2, 1.0)
# Maximum length of a file name, in characters that may take four bytes each.
_MAX_NAME = 60
_FINAL_ERRORS = (FileNotFoundError, PermissionError, NotImplementedError, TypeError, AttributeError)


def is_video_file(file: Path | str) -> bool:
    """Whether the name of a file, or a URL, has the suffix of a video, and is not hidden."""
    name = PurePath(without_query(os.fspath(file)))
    return name.suffix.lower() in VIDEO_SUFFIXES and not name.name.startswith(".")


def list_files(source: str | os.PathLike[str]) -> list[Path]:
    """List the videos of a folder or pattern in the order of their paths, or else its images by their names.

    Empty if the source is anything else.
    """
    text = os.fsdecode(source)
    path = check.path(text, "source", kind="the path of a video file")
    if not text.strip():  # it would be the current folder
        raise InvalidInputError("source must be a file, a folder, a pattern or a URL, got an empty name")
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
    files = select_videos(found)
    files = files or sorted(images, key=lambda image: natural_key(str(image)))
    if not files:
        raise InvalidInputError(f"source {path} holds no videos and no images; check the path")
    return files


def select_videos(files: Iterable[Path]) -> list[Path]:
    """Select videos by their names; a copy such as ``drive_tracked.mp4`` only if its source is not there."""
    videos = [each for each in files if is_video_file(each)]
    sources = {each.with_suffix("") for each in videos}
    copies = ((each, _COPY.fullmatch(each.name)) for each in videos)
    return [each for each, copy in copies if copy is None or each.with_name(copy[1]) not in sources]


def check_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of a readable regular file."""
    path = check.path(path, "source", kind="the path of a video file")
    check_regular_file(path, f"source {path}")
    if not os.access(path, os.R_OK):
        raise InvalidInputError(f"source {path} is not readable; change its permissions")
    return path


def download(url: str, folder: Path) -> Path:
    """Copy a file from a web server, or from storage that fsspec knows, to a folder."""
    name = hide_credentials(url)
    path = folder / file_name(url)
    try:
        if is_web_address(url):
            with_retries(lambda: _download_http(url, path))
        else:
            filesystem, remote = open_filesystem(url)
            with_retries(lambda: filesystem.get_file(remote, str(path)))
    except InvalidInputError:
        raise
    except FileNotFoundError:
        raise InvalidInputError(f"source {name} does not exist; check the URL") from None
    except PermissionError as error:
        reason = hide_credentials(str(error))
        raise InvalidInputError(f"source {name} is not readable ({reason}); check its permissions") from None
    except Exception as error:  # each storage has its own
        reason = hide_credentials(str(error))
        is_full = getattr(error, "errno", None) == errno.ENOSPC
        remedy = "free some space" if is_full else "check the connection and permissions"
        raise TransientVideoError(f"{name} cannot be copied ({reason}); {remedy}") from error
    return path


def file_name(url: str) -> str:
    """Name of a local copy: the end of the URL's path, without what Windows does not allow in names."""
    name = unquote(without_query(url).rstrip("/").rpartition("/")[2])
    return re.sub(r'[\x00-\x1f/\\:?*"<>|]', "_", name)[-_MAX_NAME:] or "video"


def _download_http(url: str, path: Path) -> None:
    with path.open("wb") as file:
        for data in read_http(url):
            file.write(data)


def with_retries(request: Callable[[], Result]) -> Result:
    """Call a function of remote storage again if it fails, up to three times in all."""
    for delay in _RETRY_DELAYS:
        try:
            return request()
        except _FINAL_ERRORS:
            raise
        except Exception:  # not all storages raise an OSError
            time.sleep(delay)
    return request()


def open_filesystem(url: str, name: str = "source") -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it; `name` is the argument in errors."""
    shown = hide_credentials(url)
    try:
        import fsspec
    except ImportError:
        raise InvalidInputError(
            f"{name} {shown} needs fsspec; pip install fsspec, or use a local path"
        ) from None
    try:
        filesystem, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:  # an unknown scheme, or a missing package such as s3fs
        reason = hide_credentials(str(error))
        raise InvalidInputError(f"{name} {shown} cannot be opened ({reason}); check the URL") from None
    return filesystem, str(path)
