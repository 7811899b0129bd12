"""Where a batch writes: a folder, or a URL of storage that fsspec knows, with a record of each trip.

A record is a small JSON file, written after the trip's outputs. Its ``status`` is ``"done"``; ``"failed"`` if
the source cannot be processed, which is not tried again before it changes; or ``"error"`` if the machine
failed (disk full, lost worker) or there was no access to the source, which the next run repeats.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vehicle_detection._common import (
    atomic_write,
    check,
    describe,
    encodable,
    hide_credentials,
    is_url,
    local_path,
    make_folder,
    open_locked,
    pluralize,
)
from vehicle_detection.errors import InvalidInputError, OutputError, VehicleDetectionError
from vehicle_detection.video import open_filesystem, with_retries

if TYPE_CHECKING:
    import pandas

Result = TypeVar("Result")

DONE, FAILED, ERROR = "done", "failed", "error"
COUNTS = {"done": DONE, "failed": FAILED, "errors": ERROR}
"""Status of the trips that `BatchReport` and `BatchStatus` count by these names."""

_FOLDER = "records"
# Values of a record by their kind, where they are given.
_NUMBERS = ("frames", "tracks", "video_seconds", "seconds")
_VALUES: dict[str, Any] = {
    **dict.fromkeys(("message", "camera", "date", "start", "damage"), str),
    **dict.fromkeys(_NUMBERS, (int, float)),
}
_MAX_NUMBER = 1e15
_MAX_RECORD_BYTES = 100_000_000
_OUTPUT = re.compile(r"(?:tracks|videos)/date=[^/\\]+/camera=[^/\\]+/([^/\\]+)\.(?:parquet|mp4)")
_SUMMARY_COLUMNS = (
    "key", "status", "camera", "date", "start", "first_file", "files", "frames", "video_seconds", "tracks",
    "work_seconds", "message", "damage", "tracks_file", "video_file",
)  # fmt: skip


def open_store(out: object, *, create: bool = False, exists: bool = True) -> Store:
    """Open the folder or URL of a batch; with `create`, make the folder, which otherwise must exist.

    Without `exists`, a missing folder is like an empty one.
    """
    text = local_path(os.fsdecode(out)) if isinstance(out, (str, os.PathLike)) else ""
    if not text:
        raise InvalidInputError(f"out must be a folder or a URL, got {describe(out)}; pass its path")
    if is_url(text):
        return Store(text.rstrip("/"))
    folder = Path(os.path.abspath(check.path(text, "out", kind="a folder or a URL")))
    if create:
        make_folder(folder, "out")
        if not os.access(folder, os.W_OK):
            raise InvalidInputError(
                f"out {folder} cannot be written; change its permissions, or choose another"
            )
    elif not folder.is_dir() and (exists or folder.exists()):
        raise InvalidInputError(f"out {text} is not a folder; pass the folder or URL of a batch")
    return Store(str(folder))


class Store:
    """The results of a batch: files by their path relative to a folder or URL, with ``/``.

    A written file is complete or absent: object stores show an uploaded file when it is complete, and in a
    folder it is renamed to its place. A request to remote storage is repeated if it fails.
    """

    def __init__(self, name: str) -> None:
        self.name = name  # path or URL, with which a worker opens the store
        self._folder = None if is_url(name) else Path(name)
        self._shown = hide_credentials(name)
        # A path may look like a URL with two schemes, "a::b".
        self._filesystem, root = open_filesystem("file://" if self._folder else name, "out")
        self._root = name if self._folder else root.rstrip("/")
        self._checked = set[str]()  # folders that no link leads to

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
        """Full path. A link to another folder, whose files are not the batch's, is refused."""
        parent = path.rpartition("/")[0]
        if self._folder and parent not in self._checked:
            if Path(os.path.realpath(self._folder / parent)) != Path(os.path.realpath(self._folder), parent):
                raise OutputError(f"{self._folder / parent} leads through a link; replace that by a folder")
            self._checked.add(parent)
        return f"{self._root}/{path}"

    def exists(self, path: str) -> bool:
        """Whether there is a file, which is not a link to one."""

        def find() -> Mapping[str, Any]:
            self._filesystem.invalidate_cache()
            info: Mapping[str, Any] = self._filesystem.info(self._path(path))
            return info

        try:
            info = self._request(f"/{path} cannot be found", find)
        except FileNotFoundError:
            return False
        return info["type"] == "file" and not info.get("islink")

    def read(self, path: str) -> bytes | None:
        """Content of a file; None if there is none."""
        # `cat_file` takes ten times as long for each of many thousand small local files.
        read_file = _read_file if self._folder else self._filesystem.cat_file
        try:
            data: bytes | None = self._request(f"/{path} cannot be read", lambda: read_file(self._path(path)))
        except FileNotFoundError:
            return None
        return data

    def read_many(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield paths and contents of files that exist; many storages read them in parallel."""
        wanted = list(paths)
        found: list[Any] = [None] * len(wanted)
        if wanted and not self._folder:
            # Not by `cat`, which would expand a path with brackets as a pattern.
            places = [self._path(path) for path in wanted]
            read_all = functools.partial(self._filesystem.cat_ranges, places, None, None)
            found = self._request(" cannot be read", read_all)
        for path, data in zip(wanted, found):
            if not isinstance(data, bytes):  # a local file, or one of many that has failed
                data = self.read(path)
            if data is not None:
                yield path, data

    def list_files(self, folder: str, prefix: str = "") -> list[str]:
        """Paths of the files in a folder and below, whose names start with `prefix` and are not hidden."""

        def find() -> list[str]:
            if self._folder:  # without a request for each file, as `find` makes
                walk = os.walk(self._path(f"{folder}/"), onerror=_raise)
                paths = (os.path.join(parent, name) for parent, _, names in walk for name in names)
                return sorted(path.replace(os.sep, "/") for path in paths)
            self._filesystem.invalidate_cache()
            return [str(name) for name in self._filesystem.find(self._path(f"{folder}/"))]

        try:
            names = self._request(f"/{folder} cannot be listed", find)
        except FileNotFoundError:
            return []
        start = self._root.lstrip("/") + "/"
        paths = (name.lstrip("/").removeprefix(start) for name in names)
        named = ((path, path.rpartition("/")[2]) for path in paths)
        return [path for path, name in named if name.startswith(prefix) and not name.startswith(".")]

    def put(self, path: str, content: Path | bytes) -> None:
        """Write a file, from a complete local file or from its content."""
        target, what = self._path(path), f"/{path} cannot be written"
        if self._folder:
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            if os.path.islink(target):  # replaced, not followed
                os.unlink(target)
            with atomic_write(target) as part:
                part.write_bytes(content) if isinstance(content, bytes) else shutil.copyfile(content, part)
            return
        if isinstance(content, bytes):
            upload = functools.partial(self._filesystem.pipe_file, target, content)
        else:
            upload = functools.partial(self._filesystem.put_file, str(content), target)
        try:
            self._request(what, upload)
        except FileNotFoundError:  # object stores need no folders, other storages do
            folder = target.rpartition("/")[0]
            self._request(what, lambda: self._filesystem.makedirs(folder, exist_ok=True))
            self._request(what, upload)

    def remove(self, path: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._request(f"/{path} cannot be removed", lambda: self._filesystem.rm_file(self._path(path)))

    def record_keys(self) -> list[str]:
        """Keys of all records."""
        paths = self.list_files(_FOLDER)
        return [path.rpartition("/")[2].removesuffix(".json") for path in paths if path.endswith(".json")]

    def read_records(self, keys: Iterable[str] | None = None) -> dict[str, dict[str, Any]]:
        """Read the records of trips, or of all, by their keys; missing or damaged ones are left out."""
        return {record["key"]: record for record in self.iterate_records(keys)}

    def iterate_records(self, keys: Iterable[str] | None = None) -> Iterator[dict[str, Any]]:
        """Yield the records of `read_records` one after the other, so that none has to be kept."""
        paths = {_record_path(key): key for key in (self.record_keys() if keys is None else keys)}
        for path, data in self.read_many(paths):
            if (record := _parse(paths[path], data)) is not None:
                yield record

    def write_record(self, record: Mapping[str, Any]) -> None:
        """Write the record of a trip."""
        self.put(_record_path(record["key"]), (json.dumps(record, indent=1) + "\n").encode())

    def remove_record(self, key: str) -> None:
        """Remove the record of a trip, if there is one."""
        self.remove(_record_path(key))

    @contextlib.contextmanager
    def lock(self, name: str) -> Iterator[bool]:
        """Lock a name against other processes during a block; yields False if another process holds it.

        The system unlocks the file when the process ends in any way. Remote storage and Windows have no
        locks: always True. Two runs may then do a trip twice, and each file is that of one of them.
        """
        if self._folder is None or sys.platform == "win32":
            yield True
            return
        path = Path(self._path(f"locks/{name}.lock"))
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            status = path.lstat()
            if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1 or status.st_size:
                raise OutputError(f"{path} is not the lock of a batch; remove it")
        with contextlib.ExitStack() as stack:
            locked = True
            try:
                handle = open_locked(path)
                if handle is not None:  # the file system has locks
                    # Last in, first out: removed while still locked.
                    stack.callback(os.close, handle)
                    stack.callback(path.unlink, missing_ok=True)
            except BlockingIOError:
                locked = False
            yield locked


def _read_file(path: str) -> bytes | None:
    """Content of a regular file; None for a pipe, which would block, and for a link."""
    if not stat.S_ISREG(os.lstat(path).st_mode):
        return None
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))  # in half the time of `open`
    try:  # the size of the opened file, as another process may replace it
        return os.read(handle, min(os.fstat(handle).st_size, _MAX_RECORD_BYTES))
    finally:
        os.close(handle)


def _raise(error: OSError) -> None:
    raise error


@dataclass(frozen=True, kw_only=True)
class BatchStatus:
    """Summary of the records of a batch.

    Attributes
    ----------
    done, failed, errors
        As in the `BatchReport` of a run.
    messages
        Message of each failed trip and each error, and what is damaged in other trips, by the first source.
    frames, tracks
        Number of frames and of tracks of the processed trips.
    video_seconds, work_seconds
        Length of the processed trips, and the time that their workers took.

    Examples
    --------
    >>> status = BatchStatus(
    ...     done=2, failed=1, errors=0, frames=3000, tracks=9, video_seconds=120.0, work_seconds=60.0,
    ...     messages={"cut.mp4": "cut.mp4 is incomplete"},
    ... )
    >>> print(status)
    2 trips done, 1 failed, 0 errors
    0.0 hours of video, 3,000 frames, 9 vehicles, 50.0 frames/s per worker
    cut.mp4 is incomplete
    """

    done: int
    failed: int
    errors: int
    frames: int
    tracks: int
    video_seconds: float
    work_seconds: float
    messages: Mapping[str, str]

    def __str__(self) -> str:
        rate = self.frames / self.work_seconds if self.work_seconds else 0.0
        lines = [
            f"{pluralize(self.done, 'trip')} done, {self.failed:,} failed, {pluralize(self.errors, 'error')}",
            f"{self.video_seconds / 3600:,.1f} hours of video, {pluralize(self.frames, 'frame')}, "
            f"{pluralize(self.tracks, 'vehicle')}, {rate:.1f} frames/s per worker",
        ]
        return "\n".join([*lines, *(with_source(*each) for each in self.messages.items())])


def with_source(source: str, message: str) -> str:
    """Put the name of a source before a message that lacks it."""
    return message if " ".join(source.split()) in message else f"{source}: {message}"


def _record_path(key: str) -> str:
    return f"{_FOLDER}/{key}.json"


def _is_output(key: str, path: str) -> bool:
    """Whether a path is that of a trip's output: those of a record may be removed, and nothing else."""
    parts = _OUTPUT.fullmatch(path)
    return parts is not None and parts[1] == key


def _parse(key: str, data: bytes) -> dict[str, Any] | None:
    """Record of a trip, from a file that anybody may have changed; None if it is of another shape."""
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or record.get("status") not in (DONE, FAILED, ERROR):
        return None
    sources, outputs = record.get("sources"), record.get("outputs")
    outputs = {} if outputs is None else outputs
    if not (isinstance(sources, list) and isinstance(outputs, dict) and sources):
        return None
    for source in sources:
        if not (isinstance(source, dict) and isinstance(source.get("uri"), str)):
            return None
    for path in outputs.values():
        if not (isinstance(path, str) and _is_output(key, path)):
            return None
    for name, kinds in _VALUES.items():
        value = record.get(name)
        if value is None:
            continue
        if not isinstance(value, kinds) or (kinds is not str and not 0 <= value < _MAX_NUMBER):
            return None
    record["key"], record["outputs"] = key, outputs
    return record


def is_complete(record: Mapping[str, Any] | None, exists: Callable[[str], bool]) -> bool:
    """Whether a trip need not be processed again: its outputs exist, or its source is known to be bad.

    The record of a bad source (`FAILED`) has no outputs, so that none can be missing.
    """
    if record is None or record["status"] == ERROR:
        return False
    return all(map(exists, record["outputs"].values()))


def batch_status(out: str | os.PathLike[str]) -> BatchStatus:
    """Summarize the records of a batch, also while it runs.

    `out` is the folder or URL of the batch.

    >>> import tempfile
    >>> print(batch_status(tempfile.mkdtemp()))
    0 trips done, 0 failed, 0 errors
    0.0 hours of video, 0 frames, 0 vehicles, 0.0 frames/s per worker
    """
    counts, sums = Counter[str](), Counter[str]()
    messages: dict[str, str] = {}
    for record in open_store(out).iterate_records():
        counts[record["status"]] += 1
        if record["status"] == DONE:
            for name in _NUMBERS:
                sums[name] += record.get(name) or 0
        message = record.get("damage" if record["status"] == DONE else "message") or ""
        if message or record["status"] != DONE:
            messages[record["sources"][0]["uri"]] = message
    return BatchStatus(
        **{name: counts[status] for name, status in COUNTS.items()},
        frames=sums["frames"],
        tracks=sums["tracks"],
        video_seconds=float(sums["video_seconds"]),
        work_seconds=float(sums["seconds"]),
        messages=dict(sorted(messages.items())),
    )


def batch_summary(out: str | os.PathLike[str]) -> pandas.DataFrame:
    """Summarize each trip of a batch in a row of a table, also while it runs.

    A trip whose changed source cannot be processed has a second row with its earlier results. Rows are in the
    order of date, camera and first file; values that a trip does not have are missing.

    >>> import tempfile
    >>> len(batch_summary(tempfile.mkdtemp()))
    0
    """
    import pandas

    rows = [_summary_row(record) for record in open_store(out).iterate_records()]
    rows.sort(key=lambda row: (row["date"] or "", row["camera"] or "", row["first_file"]))
    return pandas.DataFrame(rows, columns=_SUMMARY_COLUMNS)


def _summary_row(record: Mapping[str, Any]) -> dict[str, Any]:
    sources, outputs = record["sources"], record["outputs"]
    row = {**record, "first_file": sources[0]["uri"], "files": len(sources)}
    row |= {f"{kind}_file": outputs.get(kind) for kind in ("tracks", "video")}
    row["work_seconds"] = record.get("seconds")
    listed = {name: row.get(name) for name in _SUMMARY_COLUMNS}
    return {name: encodable(value) if isinstance(value, str) else value for name, value in listed.items()}
