"""Records of a batch: one small JSON file per trip, written after its outputs, and a summary of them.

A record's ``status`` is ``"done"``; ``"failed"`` if the source cannot be processed, which is not tried again
before it changes; or ``"error"`` if the machine failed (disk full, lost worker) or there was no access to the
source, which the next run repeats.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vehicle_detection._common import encodable, pluralize
from vehicle_detection.drive.batch_store import Store, open_store

if TYPE_CHECKING:
    import pandas

DONE, FAILED, ERROR = "done", "failed", "error"
COUNTS = {"done": DONE, "failed": FAILED, "errors": ERROR}
"""Status of the trips that `BatchReport` and `BatchStatus` count by these names."""

_FOLDER = "records"
_SUMMARY_COLUMNS = (
    "key", "status", "camera", "date", "start", "first_file", "files", "frames", "video_seconds", "tracks",
    "work_seconds", "message", "damage", "tracks_file", "video_file",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class BatchStatus:
    """Summary of the records of a batch.

    Attributes
    ----------
    done, failed, errors, messages
        As in the `BatchReport` of a run.
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


def record_path(key: str) -> str:
    """Path of the record of a trip in its store."""
    return f"{_FOLDER}/{key}.json"


def read_record(store: Store, key: str) -> dict[str, Any] | None:
    """Read the record of a trip; None if there is none, or if it is damaged."""
    data = store.read(record_path(key))
    return None if data is None else _parse(data)


def read_records(store: Store, keys: Iterable[str] | None = None) -> dict[str, dict[str, Any]]:
    """Read the records of trips, or of all, by their keys; missing or damaged ones are left out."""
    found = store.read_many(record_path(key) for key in (record_keys(store) if keys is None else keys))
    parsed = ((_key(path), _parse(data)) for path, data in found)
    return {key: record for key, record in parsed if record is not None}


def _parse(data: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return None
    whole = isinstance(record, dict) and "status" in record and bool(record.get("sources"))
    return record if whole else None


def _key(path: str) -> str:
    return path.rpartition("/")[2].removesuffix(".json")


def write_record(store: Store, record: Mapping[str, Any]) -> None:
    """Write the record of a trip."""
    store.write(record_path(record["key"]), (json.dumps(record, indent=1) + "\n").encode())


def is_complete(record: Mapping[str, Any] | None, exists: Callable[[str], bool]) -> bool:
    """Whether a trip need not be processed again: its outputs exist, or its source is known to be bad."""
    if record is None or record["status"] == ERROR:
        return False
    return all(map(exists, record.get("outputs", {}).values()))


def record_keys(store: Store) -> list[str]:
    """Keys of all records."""
    return [_key(path) for path in store.list_files(_FOLDER) if path.endswith(".json")]


def batch_status(out: str | os.PathLike[str]) -> BatchStatus:
    """Summarize the records of a batch, also while it runs.

    `out` is the folder or URL of the batch.

    >>> import tempfile
    >>> print(batch_status(tempfile.mkdtemp()))
    0 trips done, 0 failed, 0 errors
    0.0 hours of video, 0 frames, 0 vehicles, 0.0 frames/s per worker
    """
    records = list(read_records(open_store(out)).values())
    done = [record for record in records if record["status"] == DONE]
    bad = [record for record in records if record["status"] != DONE]
    counts = Counter(record["status"] for record in records)
    names = ("frames", "tracks", "video_seconds", "seconds")
    sums = {name: sum(record.get(name, 0) for record in done) for name in names}
    return BatchStatus(
        **{name: counts[status] for name, status in COUNTS.items()},
        frames=sums["frames"],
        tracks=sums["tracks"],
        video_seconds=float(sums["video_seconds"]),
        work_seconds=float(sums["seconds"]),
        messages=dict(sorted((record["sources"][0]["uri"], record.get("message", "")) for record in bad)),
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

    rows = [_summary_row(key, record) for key, record in read_records(open_store(out)).items()]
    rows.sort(key=lambda row: (row["date"] or "", row["camera"] or "", row["first_file"]))
    return pandas.DataFrame(rows, columns=_SUMMARY_COLUMNS)


def _summary_row(key: str, record: Mapping[str, Any]) -> dict[str, Any]:
    sources, outputs = record["sources"], record.get("outputs", {})
    row: dict[str, Any] = {**dict.fromkeys(_SUMMARY_COLUMNS), **record}
    row |= {"key": key, "first_file": sources[0]["uri"], "files": len(sources)}
    row |= {f"{kind}_file": outputs.get(kind) for kind in ("tracks", "video")}
    row["work_seconds"] = record.get("seconds")
    listed = {name: row[name] for name in _SUMMARY_COLUMNS}
    return {name: encodable(value) if isinstance(value, str) else value for name, value in listed.items()}
