"""The work on one trip, in a worker process: read, track, publish the outputs, write the record."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vehicle_detection import __version__
from vehicle_detection._common import atomic_write
from vehicle_detection.batch.records import (
    DONE,
    ERROR,
    FAILED,
    is_complete,
    read_record,
    record_names,
    record_path,
    write_record,
)
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import TransientVideoError, VehicleDetectionError
from vehicle_detection.export import DIGITS, shown_tracks
from vehicle_detection.video import FrameSource, download, open_source, process_video

BUSY = "busy"
"""Status of a trip that another process is working on; it is not recorded."""

# Rows per group of the Parquet file, which bounds the memory.
_ROWS_PER_GROUP = 50_000
_COLUMNS = {
    "trip": "string", "frame": "int64", "time_s": "double", "track_id": "int64",
    **dict.fromkeys(DIGITS, "double"),
}  # fmt: skip


def warm_up(model: str, options: dict[str, Any]) -> None:
    """Load the model and compile the kernels in this process."""
    _detector({"model": model, "options": options}).warm_up((180, 320))


_of_thread = threading.local()


def _detector(settings: Mapping[str, Any]) -> VehicleDetector:
    """Detector of this thread, which keeps the last one: a detector holds the tracks of one video."""
    wanted = settings["model"], settings["options"]
    if getattr(_of_thread, "wanted", None) != wanted:
        _of_thread.detector, _of_thread.wanted = VehicleDetector(wanted[0], n_jobs=1, **wanted[1]), wanted
    detector: VehicleDetector = _of_thread.detector
    return detector


def run_trip(task: Mapping[str, Any]) -> dict[str, Any]:
    """Process a trip of `plan_trip` and return its record, with ``new`` telling whether it was done now.

    Only one process works on a trip at a time. Outputs are complete or absent, and the record is written
    last.
    """
    out, key = Path(task["out"]), task["key"]
    identity = key.partition("-")[0]
    with _lock(out / "locks" / f"{identity}.lock") as locked:
        if not locked:
            return {"key": key, "status": BUSY, "sources": task["sources"]}
        record = read_record(out, key)
        if record is not None and is_complete(out, record) and not task.get("again"):
            return record | {"new": False}
        started = time.time()
        record = {
            **{name: task[name] for name in ("key", "sources", "camera", "date", "start", "settings")},
            "version": __version__,
            "host": platform.node(),
            "started": started,
        }
        try:
            _remove_earlier(out, task)
            record |= _process(out, task)
        except Exception as error:
            record |= _failure(error)
        record["seconds"] = round(time.time() - started, 3)
        try:
            write_record(out, record)
        except OSError as error:  # the disk is full: the trip is missing, and the next run repeats it
            record |= {"status": ERROR, "message": str(error)}
    return record | {"new": True}


def _failure(error: Exception) -> dict[str, Any]:
    """Status and message of an error: of the source, or of the machine, which may go away."""
    message = " ".join(str(error).split())
    if not isinstance(error, VehicleDetectionError):
        return {"status": ERROR, "message": f"{type(error).__name__}: {message}"}
    passing = isinstance(error, (TransientVideoError, OSError))  # an OutputError is an OSError
    return {"status": ERROR if passing else FAILED, "message": message}


def _process(out: Path, task: Mapping[str, Any]) -> dict[str, Any]:
    """Write the outputs of a trip; return the facts for its record."""
    settings, key = task["settings"], task["key"]
    detector = _detector(settings)
    place = f"date={task['date']}/camera={task['camera']}/{key}"
    with _scratch(out, key) as folder:
        video = None if settings["tracks_only"] else folder / "video.mp4"
        with _open(task, folder) as source, _TrackTable(folder / "tracks.parquet", key) as write:
            report = process_video(
                source,
                video,
                detector,
                audio=settings["audio"],
                preset=settings["preset"],
                workers=1,
                progress=False,
                on_result=write,
            )
        outputs = {"tracks": f"tracks/{place}.parquet"}
        _publish(folder / "tracks.parquet", out / outputs["tracks"])
        if video is not None:
            outputs["video"] = f"videos/{place}.mp4"
            _publish(video, out / outputs["video"])
    return {
        "status": DONE,
        "frames": report.frames,
        "video_seconds": round(float(report.frames / report.fps), 3),
        "size": [report.shape[1], report.shape[0]],
        "tracks": report.tracks,
        "rows": write.rows,
        "outputs": outputs,
        **({"damage": report.damage} if report.damage else {}),
    }


def _open(task: Mapping[str, Any], folder: Path) -> FrameSource:
    """Open the files of a trip; several remote ones are copied first, which one source does itself."""
    uris = [source["uri"] for source in task["sources"]]
    if len(uris) == 1:
        return open_source(uris[0])
    paths = []
    for number, uri in enumerate(uris):
        if "://" in uri:
            (folder / str(number)).mkdir()
            paths.append(download(uri, folder / str(number)))
        else:
            paths.append(Path(uri))
    return open_source(paths)


class _TrackTable:
    """Writer of the shown tracks as a Parquet file, in groups of rows."""

    def __init__(self, path: Path, key: str) -> None:
        self._path, self._key = path, key
        self._waiting: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
        self.rows = 0

    def __enter__(self) -> _TrackTable:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError:
            raise OSError(
                "a batch needs pyarrow on every worker; pip install 'vehicle-detection[batch]'"
            ) from None
        self._arrow = pyarrow
        self._schema = pyarrow.schema(list(_COLUMNS.items()))
        self._writer = pyarrow.parquet.ParquetWriter(self._path, self._schema)
        return self

    def __call__(self, result: Any) -> None:
        """Add the shown tracks of a frame's result."""
        for track in shown_tracks(result):
            numbers = (*track.box, *(getattr(track, name) for name in tuple(DIGITS)[4:]))
            rounded = [
                None if value is None else round(float(value), digits) + 0.0
                for value, digits in zip(numbers, DIGITS.values(), strict=True)
            ]
            values = (self._key, result.index, round(result.time, 4), track.id, *rounded)
            for column, value in zip(self._waiting.values(), values, strict=True):
                column.append(value)
            self.rows += 1
        if len(self._waiting["frame"]) >= _ROWS_PER_GROUP:
            self._flush()

    def _flush(self) -> None:
        self._writer.write_table(self._arrow.table(self._waiting, schema=self._schema))
        for column in self._waiting.values():
            column.clear()

    def __exit__(self, *error: Any) -> None:
        try:
            if error[0] is None:
                self._flush()
        finally:
            self._writer.close()


@contextlib.contextmanager
def _scratch(out: Path, key: str) -> Iterator[Path]:
    """Empty folder on a local disk, where ffmpeg writes; what a killed process left there is removed."""
    batch = hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:8]
    folder = Path(tempfile.gettempdir()) / f"vehicle-batch-{batch}-{key}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _publish(path: Path, target: Path) -> None:
    """Copy a complete file to its place."""
    target.parent.mkdir(parents=True, exist_ok=True)
    # What a killed process left beside it.
    for left in target.parent.glob(f".{target.stem}.*"):
        left.unlink(missing_ok=True)
    with atomic_write(target) as part:
        shutil.copyfile(path, part)


def _remove_earlier(out: Path, task: Mapping[str, Any]) -> None:
    """Remove the results of this trip's files for other contents, parameters or trips."""
    for key in task.get("replaces", ()):
        record = read_record(out, key)
        if record is not None and key != task["key"]:
            for path in record.get("outputs", {}).values():
                (out / path).unlink(missing_ok=True)
            record_path(out, key).unlink(missing_ok=True)
    # Outputs whose record a killed process did not write any more.
    identity, place = task["key"].partition("-")[0], f"date={task['date']}/camera={task['camera']}"
    for kind in ("tracks", "videos"):
        for path in (out / kind / place).glob(f"{identity}-*"):
            path.unlink(missing_ok=True)


def earlier_keys(out: Path) -> dict[str, list[str]]:
    """Keys of all records by the identity of their trip."""
    found: dict[str, list[str]] = {}
    for key in record_names(out):
        found.setdefault(key.partition("-")[0], []).append(key)
    return found


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[bool]:
    """Lock a file, which the system unlocks when the process ends in any way; yield whether it succeeded."""
    try:
        import fcntl
    except ImportError:  # Windows: two runs on one folder may do a trip twice
        yield True
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with path.open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
                return
            except OSError:  # storage without locks: outputs are atomic, only work may be done twice
                yield True
                return
            with contextlib.suppress(FileNotFoundError):
                if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                    try:
                        yield True
                    finally:
                        path.unlink(missing_ok=True)
                    return
        # Another process has removed the file between opening and locking: try again.
