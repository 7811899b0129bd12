"""Where a batch writes: a folder, or a URL of storage that fsspec knows, such as ``s3://bucket/results``."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from vehicle_detection._common import atomic_write, check_path, describe, hide_credentials, is_url, local_path
from vehicle_detection.errors import InvalidInputError, OutputError, VehicleDetectionError
from vehicle_detection.video import open_filesystem, with_retries

Result = TypeVar("Result")


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
        return Store(text.rstrip("/"))
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
    return Store(str(folder))


class Store:
    """The results of a batch: files by their path relative to a folder or URL, with ``/``.

    A published file is complete or absent: object stores show an uploaded file when it is complete, and in a
    folder it is renamed to its place. A request to remote storage is repeated if it fails.
    """

    def __init__(self, name: str) -> None:
        self.name = name  # path or URL, with which a worker opens the store
        self._folder = None if is_url(name) else Path(name)
        self._shown = hide_credentials(name)
        # A path may look like a URL with two schemes, "a::b".
        self._files, root = open_filesystem("file://" if self._folder else name, "out")
        self._root = name if self._folder else root.rstrip("/")

    def _request(self, what: str, request: Callable[[], Result]) -> Result:
        try:
            return request() if self._folder else with_retries(request)
        except (FileNotFoundError, VehicleDetectionError):
            raise
        except Exception as error:  # each storage has its own
            reason = getattr(error, "strerror", None) or hide_credentials(" ".join(str(error).split()))
            raise OutputError(
                f"{self._shown}{what} ({reason or type(error).__name__}); "
                "check the connection and permissions"
            ) from error

    def _path(self, path: str) -> str:
        return f"{self._root}/{path}"

    def exists(self, path: str) -> bool:
        """Whether there is a file."""

        def find() -> None:
            self._files.invalidate_cache()
            self._files.info(self._path(path))

        try:
            self._request(f"/{path} cannot be found", find)
        except FileNotFoundError:
            return False
        return True

    def read(self, path: str) -> bytes | None:
        """Content of a file; None if there is none."""
        # `cat_file` takes ten times as long for each of many thousand small local files.
        read_file = _read_file if self._folder else self._files.cat_file
        try:
            data: bytes = self._request(f"/{path} cannot be read", lambda: read_file(self._path(path)))
        except FileNotFoundError:
            return None
        return data

    def read_many(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield paths and contents of files that exist; many storages read them in parallel."""
        wanted = {self._path(path): path for path in paths}
        found: dict[str, Any] = {}
        if wanted and not self._folder:
            found = self._request(" cannot be read", lambda: self._files.cat([*wanted], on_error="return"))
        for place, path in wanted.items():
            data = found.get(place)
            if not isinstance(data, bytes):  # one of many has failed
                data = self.read(path)
            if data is not None:
                yield path, data

    def list_files(self, folder: str, prefix: str = "") -> list[str]:
        """Paths of the files in a folder and below, whose names start with `prefix` and are not hidden."""
        # By default, a folder that cannot be read counts as empty.
        options = {"on_error": "raise"} if self._folder else {}

        def find() -> list[str]:
            self._files.invalidate_cache()
            return [str(name) for name in self._files.find(self._path(folder), **options)]

        try:
            names = self._request(f"/{folder} cannot be listed", find)
        except FileNotFoundError:
            return []
        start = self._root.lstrip("/") + "/"
        paths = (name.lstrip("/").removeprefix(start) for name in names)
        named = ((path, path.rpartition("/")[2]) for path in paths)
        return [path for path, name in named if name.startswith(prefix) and not name.startswith(".")]

    def publish(self, file: Path, path: str) -> None:
        """Copy a complete local file."""
        copy = functools.partial(shutil.copyfile, file)
        self._put(path, copy, functools.partial(self._files.put_file, str(file)))

    def write(self, path: str, data: bytes) -> None:
        """Write a small file."""
        self._put(
            path, lambda part: part.write_bytes(data), lambda target: self._files.pipe_file(target, data)
        )

    def _put(self, path: str, copy: Callable[[Path], object], upload: Callable[[str], object]) -> None:
        """Write a file: in a folder by `copy` to a temporary file, in remote storage by `upload`."""
        target, what = self._path(path), f"/{path} cannot be written"
        if self._folder:
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(target) as part:
                copy(part)
            return
        try:
            self._request(what, lambda: upload(target))
        except FileNotFoundError:  # object stores need no folders, other storages do
            folder = target.rpartition("/")[0]
            self._request(what, lambda: self._files.makedirs(folder, exist_ok=True))
            self._request(what, lambda: upload(target))

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._request(f"/{path} cannot be removed", lambda: self._files.rm_file(self._path(path)))

    @contextlib.contextmanager
    def lock(self, name: str) -> Iterator[bool]:
        """Lock a name against other processes during a block; yields whether that was possible.

        The system unlocks the file when the process ends in any way. Remote storage has no locks: two runs
        may do a trip twice, and each file is that of one of them.
        """
        with contextlib.ExitStack() as stack:
            yield self._folder is None or _lock_file(self._folder / "locks" / f"{name}.lock", stack)


def _read_file(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


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
