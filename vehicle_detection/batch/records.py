"""Records of a batch: one small JSON file per trip, written after its outputs, and a summary of them.

A record's ``status`` is ``"done"``; ``"failed"`` if the source cannot be processed, which is not tried again
before it changes; or ``"error"`` if the machine failed (disk full, lost worker), which the next run repeats.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehicle_detection._common import (
    atomic_write,
    check_path,
)
from vehicle_detection.errors import InvalidInputError

DONE, FAILED, ERROR = "done", "failed", "error"
_FOLDER = "records"


@dataclass(frozen=True, kw_only=True)
class BatchStatus:
    """Summary of the records of a batch.

    Attributes
    ----------
    done, failed, errors
        Number of trips that were processed, whose source cannot be processed, and that the next run repeats.
    frames, tracks
        Number of frames and of tracks of the processed trips.
    video_seconds, work_seconds
        Length of the processed trips, and the time that their workers took.
    messages
        Message of each failed trip and each error, by its first source.

    Examples
    --------
    >>> status = BatchStatus(
    ...     done=2, failed=1, errors=0, frames=3000, tracks=9, video_seconds=120.0, work_seconds=60.0,
    ...     messages={"cut.mp4": "cut.mp4 is incomplete"},
    ... )
    >>> print(status)
    2 trips done, 1 failed, 0 errors
    0.0 hours of video, 3000 frames, 9 vehicles, 50.0 frames/s per worker
    cut.mp4: cut.mp4 is incomplete
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
            f"{self.done} trips done, {self.failed} failed, {self.errors} errors",
            f"{self.video_seconds / 3600:.1f} hours of video, {self.frames} frames, {self.tracks} vehicles, "
            f"{rate:.1f} frames/s per worker",
        ]
        return "\n".join([*lines, *(f"{source}: {text}" for source, text in self.messages.items())])


def record_path(out: Path, key: str) -> Path:
    """Path of the record of a trip."""
    return out / _FOLDER / f"{key}.json"


def read_record(out: Path, key: str) -> dict[str, Any] | None:
    """Read the record of a trip; None if there is none, or if it is damaged."""
    return _read(record_path(out, key))


def _read(path: Path | str) -> dict[str, Any] | None:
    try:
        with open(path, "rb") as file:
            record = json.loads(file.read())
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and "status" in record else None


def write_record(out: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a trip."""
    path = record_path(out, record["key"])
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def is_complete(out: Path, record: Mapping[str, Any] | None) -> bool:
    """Whether a trip need not be processed again: its outputs exist, or its source is known to be bad."""
    if record is None or record["status"] == ERROR:
        return False
    return all((out / path).exists() for path in record.get("outputs", {}).values())


def record_names(out: Path) -> Iterator[str]:
    """Keys of all records."""
    with contextlib.suppress(FileNotFoundError), os.scandir(out / _FOLDER) as entries:
        for entry in entries:
            if entry.name.endswith(".json") and not entry.name.startswith("."):
                yield entry.name.removesuffix(".json")


def batch_status(out: str | os.PathLike[str]) -> BatchStatus:
    """Summarize the records of a batch, also while it runs.

    Parameters
    ----------
    out
        Folder of the batch.

    Raises
    ------
    InvalidInputError
        If the folder does not exist.

    Examples
    --------
    >>> import tempfile
    >>> print(batch_status(tempfile.mkdtemp()))
    0 trips done, 0 failed, 0 errors
    0.0 hours of video, 0 frames, 0 vehicles, 0.0 frames/s per worker
    """
    folder = check_path(out, "out", kind="a folder")
    if not folder.is_dir():
        raise InvalidInputError(f"out {folder} is not a folder; pass the folder of a batch")
    counts: Counter[str] = Counter()
    sums: Counter[str] = Counter()
    messages = {}
    for key in record_names(folder):
        record = _read(f"{folder}/{_FOLDER}/{key}.json")
        if record is None:
            continue
        counts[record["status"]] += 1
        if record["status"] == DONE:
            for name in ("frames", "tracks", "video_seconds", "seconds"):
                sums[name] += record.get(name, 0)
        else:
            messages[record["sources"][0]["uri"]] = record.get("message", "")
    return BatchStatus(
        done=counts[DONE],
        failed=counts[FAILED],
        errors=counts[ERROR],
        frames=sums["frames"],
        tracks=sums["tracks"],
        video_seconds=float(sums["video_seconds"]),
        work_seconds=float(sums["seconds"]),
        messages=dict(sorted(messages.items())),
    )
