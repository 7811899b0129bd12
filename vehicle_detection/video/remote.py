"""Files on storage that fsspec knows, such as S3."""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from vehicle_detection._common import hide_credentials, is_web_address, read_http, without_query
from vehicle_detection.errors import InvalidInputError, TransientVideoError

Result = TypeVar("Result")

# Seconds before the second and the third attempt of a request.
_RETRY_DELAYS = (0.2, 1.0)
# Maximum length of a file name, in characters that may take four bytes each.
_MAX_NAME = 60
_FINAL_ERRORS = (FileNotFoundError, PermissionError, NotImplementedError, TypeError, AttributeError)


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
