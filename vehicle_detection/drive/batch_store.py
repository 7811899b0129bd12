"""Where a batch writes: a folder, or a URL of storage that fsspec knows, such as ``s3://bucket/results``.

Paths are relative to it, with ``/``. A file that is published is complete or absent.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol, TypeVar

from vehicle_detection._common import atomic_write, check_path, describe, hide_credentials, is_url, local_path
from vehicle_detection.errors import InvalidInputError, OutputError, VehicleDetectionError
from vehicle_detection.video import open_filesystem, with_retries

Result = TypeVar("Result")


class Store(Protocol):
    """A folder or URL with the results of a batch."""

    name: str
    """Path or URL, with which a worker opens it."""

    def exists(self, path: str) -> bool:
        """Whether there is a file."""

    def read(self, path: str) -> bytes | None:
        """Content of a file; None if there is none."""

    def read_many(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield paths and contents of files; files that have gone are left out."""

    def list_files(self, folder: str, prefix: str = "") -> list[str]:
        """Paths of the files in a folder and below, whose names start with `prefix`."""

    def publish(self, file: Path, path: str) -> None:
        """Copy a complete local file."""

    def write(self, path: str, data: bytes) -> None:
        """Write a small file."""

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""

    def lock(self, name: str) -> contextlib.AbstractContextManager[bool]:
        """Lock a name against other processes during a block; yields whether that was possible."""


def open_store(out: str | os.PathLike[str], *, create: bool = False, exists: bool = True) -> Store:
    """Open the folder or URL of a batch; with `create`, make the folder, which otherwise must exist.

    Without `exists`, a missing folder is like an empty one.
    """
    if not isinstance(out, (str, os.PathLike)):
        raise InvalidInputError(f"out must be a folder or a URL, got {describe(out)}; pass its path")
    text = local_path(os.fsdecode(out))
    if not text:
        raise InvalidInputError("out must be a folder or a URL, got ''; pass its path")
    if is_url(text):
        return RemoteStore(text)
    folder = Path(os.path.abspath(check_path(text, "out", kind="a folder or a URL")))
    if create:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InvalidInputError(
                f"out must be a folder, {folder} cannot be created: {reason}; choose another"
            ) from error
        if not os.access(folder, os.W_OK):
            raise InvalidInputError(
                f"out {folder} cannot be written; change its permissions, or choose another"
            )
    elif not folder.is_dir() and (exists or folder.exists()):
        raise InvalidInputError(f"out {text} is not a folder; pass the folder or URL of a batch")
    return LocalStore(folder)


class LocalStore:
    """A folder, which may be network storage."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, str(folder)

    def exists(self, path: str) -> bool:
        """Whether there is a file."""
        return (self.folder / path).exists()

    def read(self, path: str) -> bytes | None:
        """Content of a file; None if there is none."""
        try:
            # Not pathlib, which takes half of the time of reading 10,000 records.
            with open(f"{self.folder}/{path}", "rb") as file:
                return file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _unreadable(error) from error

    def read_many(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield paths and contents of files; files that have gone are left out."""
        for path in paths:
            data = self.read(path)
            if data is not None:
                yield path, data

    def list_files(self, folder: str, prefix: str = "") -> list[str]:
        """Paths of the files in a folder and below, whose names start with `prefix`."""
        found = []
        for parent, _, names in os.walk(self.folder / folder, onerror=_check_listing):
            place = Path(parent).relative_to(self.folder).as_posix()
            found += [f"{place}/{name}" for name in names if name.startswith(prefix) and name[0] != "."]
        return found

    def publish(self, file: Path, path: str) -> None:
        """Copy a complete file beside its place, then rename it."""
        target = self.folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as part:
            shutil.copyfile(file, part)

    def write(self, path: str, data: bytes) -> None:
        """Write a small file."""
        target = self.folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(target) as part:
            part.write_bytes(data)

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""
        (self.folder / path).unlink(missing_ok=True)

    @contextlib.contextmanager
    def lock(self, name: str) -> Iterator[bool]:
        """Lock a name by a file, which the system unlocks when the process ends in any way."""
        path = self.folder / "locks" / f"{name}.lock"
        with contextlib.ExitStack() as stack:
            yield _lock_file(path, stack)


def _check_listing(error: OSError) -> None:
    """Raise an error of `os.walk`, except that of a folder that is not there."""
    if not isinstance(error, FileNotFoundError):
        raise _unreadable(error) from error


def _unreadable(error: OSError) -> OutputError:
    return OutputError(f"{error.filename} cannot be read ({error.strerror}); check its permissions")


def _lock_file(path: Path, stack: contextlib.ExitStack) -> bool:
    """Create and lock a file until `stack` closes, which removes it; False if another process has it."""
    try:
        import fcntl
    except ImportError:  # Windows: two runs on one folder may do a trip twice
        return True
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with contextlib.ExitStack() as on_retry:
            file = on_retry.enter_context(path.open("w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            except OSError:  # storage without locks: outputs are atomic, only work may be done twice
                return True
            # Another process may have removed the file between opening and locking: then try again.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    stack.push(on_retry.pop_all())
                    stack.callback(path.unlink, missing_ok=True)
                    return True


class RemoteStore:
    """Storage that fsspec knows. Object stores show an uploaded file when it is complete.

    Each request is repeated if it fails. There are no locks.
    """

    def __init__(self, url: str) -> None:
        self.name = url.rstrip("/")
        self._shown = hide_credentials(self.name)
        self._files, root = open_filesystem(self.name, "out")
        self._root = root.rstrip("/")

    def _request(self, what: str, request: Callable[[], Result]) -> Result:
        try:
            return with_retries(request)
        except (FileNotFoundError, VehicleDetectionError):
            raise
        except Exception as error:  # each storage has its own
            reason = hide_credentials(" ".join(str(error).split())) or type(error).__name__
            raise OutputError(
                f"{self._shown}{what} ({reason}); check the connection and permissions"
            ) from error

    def _path(self, path: str) -> str:
        return f"{self._root}/{path}"

    def exists(self, path: str) -> bool:
        """Whether there is a file."""
        try:
            self._request(f"/{path} cannot be found", lambda: self._info(path))
        except FileNotFoundError:
            return False
        return True

    def _info(self, path: str) -> object:
        self._files.invalidate_cache()
        return self._files.info(self._path(path))

    def read(self, path: str) -> bytes | None:
        """Content of a file; None if there is none."""
        try:
            data: bytes = self._request(
                f"/{path} cannot be read", lambda: self._files.cat_file(self._path(path))
            )
        except FileNotFoundError:
            return None
        return data

    def read_many(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield paths and contents of files, which many storages read in parallel."""
        wanted = {self._path(path): path for path in paths}
        if not wanted:
            return
        found = self._request(" cannot be read", lambda: self._files.cat([*wanted], on_error="return"))
        for place, path in wanted.items():
            data = found.get(place)
            if isinstance(data, Exception):  # one of many has failed
                data = self.read(path)
            if data is not None:
                yield path, data

    def list_files(self, folder: str, prefix: str = "") -> list[str]:
        """Paths of the files in a folder and below, whose names start with `prefix`."""

        def find() -> list[str]:
            self._files.invalidate_cache()
            return [str(name) for name in self._files.find(self._path(folder))]

        try:
            names = self._request(f"/{folder} cannot be listed", find)
        except FileNotFoundError:
            return []
        start = self._root.lstrip("/") + "/"
        paths = (name.lstrip("/").removeprefix(start) for name in names)
        return [path for path in paths if path.rpartition("/")[2].startswith(prefix)]

    def publish(self, file: Path, path: str) -> None:
        """Upload a complete file."""
        self._write(path, lambda target: self._files.put_file(str(file), target))

    def write(self, path: str, data: bytes) -> None:
        """Write a small file."""
        self._write(path, lambda target: self._files.pipe_file(target, data))

    def _write(self, path: str, request: Callable[[str], object]) -> None:
        """Write a file; object stores need no folders, other storages do."""
        target, what = self._path(path), f"/{path} cannot be written"
        try:
            self._request(what, lambda: request(target))
        except FileNotFoundError:
            folder = target.rpartition("/")[0]
            self._request(what, lambda: self._files.makedirs(folder, exist_ok=True))
            self._request(what, lambda: request(target))

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._request(f"/{path} cannot be removed", lambda: self._files.rm_file(self._path(path)))

    def lock(self, name: str) -> contextlib.AbstractContextManager[bool]:
        """Allow always: storage without locks; files are complete, only work may be done twice."""
        return contextlib.nullcontext(True)
