"""The work on one trip, in a worker process: read, track, publish the outputs, write the record."""

from __future__ import annotations

import hashlib
import platform
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vehicle_detection import __version__
from vehicle_detection._common import (
    check,
    hide_credentials,
    import_pyarrow,
    is_url,
    open_parquet,
    temporary_folder,
)
from vehicle_detection.annotator import Annotator
from vehicle_detection.camera import open_camera
from vehicle_detection.detector import VehicleDetector, load_model
from vehicle_detection.drive.batch_plan import fingerprint_of, identity_of
from vehicle_detection.drive.batch_store import (
    DONE,
    ERROR,
    FAILED,
    Store,
    is_complete,
    open_store,
    read_records,
    record_path,
    write_record,
)
from vehicle_detection.errors import (
    InvalidInputError,
    OutputError,
    TransientVideoError,
    VehicleDetectionError,
    VideoError,
)
from vehicle_detection.formats import DIGITS, track_records
from vehicle_detection.network import Device
from vehicle_detection.video import Encoding, FrameSource, download, open_source, process_video

BUSY = "busy"
"""Status of a trip that another process is working on; it is not recorded."""

RECORDED = ("key", "sources", "camera", "date", "start", "settings")
"""What the record of a trip takes from its task."""

_COLUMNS = {
    "trip": "string", "frame": "int64", "time_s": "double", "track_id": "int64",
    **dict.fromkeys(DIGITS, "double"), "label": "string",
}  # fmt: skip


def warm_up(settings: dict[str, Any], fingerprint: str) -> None:
    """Load the model and compile the kernels in this process."""
    _detector(settings, fingerprint).detect(np.zeros((180, 320, 3), np.uint8))


_of_thread = threading.local()


def open_detector(
    model: str,
    *,
    classes: Collection[str | int] | None = None,
    device: Device = "cpu",
    conf: float | None = None,
    camera: str | None = None,
    fov: float | None = None,
    camera_height: float | None = None,
    horizon: float | None = None,
    every: int | None = None,
    blur: Literal["vehicles", "plates"] | None = None,
) -> VehicleDetector:
    """Open the detector of a model and the options of a batch, of which `every` is that of the video."""
    if every is not None:
        check.integer(every, "every", low=1, high=1000)
    return VehicleDetector(
        load_model(model, classes=classes, device=device),
        conf=conf,
        camera=open_camera(camera, fov=fov, height_m=camera_height, horizon=horizon),
        annotator=Annotator(blur=blur),
        jobs=1,
    )


def _detector(settings: Mapping[str, Any], fingerprint: str) -> VehicleDetector:
    """Detector of this thread, which keeps the last one: a detector holds the tracks of one video."""
    wanted = settings["model"], settings["options"], fingerprint
    if getattr(_of_thread, "wanted", None) != wanted:
        if fingerprint_of(settings) != fingerprint:
            raise TransientVideoError(
                f"the file of the model {settings['model']}, or of the camera, is not the one with which the "
                "batch was started; copy the same file to all machines, and start the batch again"
            )
        _of_thread.detector, _of_thread.wanted = open_detector(wanted[0], **wanted[1]), wanted
    detector: VehicleDetector = _of_thread.detector
    return detector


def run_trip(task: Mapping[str, Any]) -> dict[str, Any]:
    """Process a trip of `plan_trip` and return its record, in which ``new`` is True if it was processed now.

    Only one process works on a trip at a time. Outputs are complete or absent, and the record is written
    last.
    """
    try:
        return _run_locked(open_store(task["out"], create=True), task)
    except OutputError as error:  # no access, or a file in `out` that is not the batch's
        return {name: task[name] for name in RECORDED} | _failure(error) | {"new": True}


def _run_locked(store: Store, task: Mapping[str, Any]) -> dict[str, Any]:
    key = task["key"]
    with store.lock(identity_of(key)) as locked:
        if not locked:
            return {"key": key, "status": BUSY, "sources": task["sources"]}
        record = read_records(store, [key]).get(key)
        if record is not None and is_complete(record, store.exists) and not task.get("again"):
            return record | {"new": False}
        started = time.time()
        record = {name: task[name] for name in RECORDED}
        record |= {"version": __version__, "host": platform.node(), "started": started}
        try:
            record |= _replace(store, task)
        except Exception as error:
            record |= _failure(error)
        record["seconds"] = round(time.time() - started, 3)
        try:
            write_record(store, record)
        except (OSError, InvalidInputError) as error:  # a full disk, no access: the next run repeats the trip
            record |= {"status": ERROR, "message": str(error)}
    return record | {"new": True}


def _failure(error: Exception) -> dict[str, Any]:
    """Status and message of an error: of the source, or of the machine, which may go away."""
    message = hide_credentials(" ".join(str(error).split()))
    if not isinstance(error, VehicleDetectionError):
        return {"status": ERROR, "message": f"{type(error).__name__}: {message}"}
    passing = isinstance(error, (TransientVideoError, OSError))  # an OutputError is an OSError
    return {"status": ERROR if passing else FAILED, "message": message}


def remove_replaced(store: Store, task: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Remove what a complete trip has replaced, which another run may have written in the meantime."""
    with store.lock(identity_of(task["key"])) as locked:
        if locked:
            _remove_earlier(store, task, record)


def _replace(store: Store, task: Mapping[str, Any]) -> dict[str, Any]:
    """Process a trip, then remove what it replaces; an error of the machine removes nothing.

    A source that cannot be processed replaces no results.
    """
    try:
        facts = _process(store, task)
    except Exception as error:
        facts = _failure(error)
        if facts["status"] == ERROR:
            return facts
    _remove_earlier(store, task, facts)
    return facts


def _process(store: Store, task: Mapping[str, Any]) -> dict[str, Any]:
    """Write the outputs of a trip; return the facts for its record."""
    settings, key = task["settings"], task["key"]
    detector = _detector(settings, task["fingerprint"])
    place = f"date={task['date']}/camera={task['camera']}/{key}"
    # A folder on a local disk, where ffmpeg writes. Another process may work on the same trip of a store
    # without locks, and has its own.
    batch = hashlib.sha256(store.name.encode("utf-8", "surrogateescape")).hexdigest()[:8]
    scratch = f"vehicle-batch-{batch}-{key}"
    with temporary_folder(Path(tempfile.gettempdir()), scratch) as folder:
        video = None if settings["tracks_only"] else folder / "video.mp4"
        try:
            with _open(task, folder) as source, _open_tracks(folder / "tracks.parquet", key) as write:
                options = {"audio": settings["audio"], "encoding": Encoding(preset=settings["preset"])}
                options |= {"every": settings["options"].get("every"), "jobs": 1, "progress": False}
                report = process_video(source, video, detector, on_result=write, **options)
        except VideoError as error:
            message = str(error).replace(str(folder / "video.mp4"), f"the video in {folder.parent}")
            raise type(error)(_with_urls(message, task, folder)) from error
        damage = _with_urls(report.damage, task, folder)
        rows = import_pyarrow().parquet.read_metadata(folder / "tracks.parquet").num_rows
        outputs = {"tracks": f"tracks/{place}.parquet"}
        if video is not None:  # the larger file first, for which there may be no space
            outputs["video"] = f"videos/{place}.mp4"
            store.publish(video, outputs["video"])
        store.publish(folder / "tracks.parquet", outputs["tracks"])
    return {
        "status": DONE,
        "frames": report.frames,
        "video_seconds": round(float(report.frames / report.fps), 3),
        "size": [report.shape[1], report.shape[0]],
        "tracks": report.tracks,
        "rows": rows,
        "outputs": outputs,
        **({"damage": damage} if damage else {}),
    }


def _with_urls(message: str, task: Mapping[str, Any], folder: Path) -> str:
    """Replace the paths of local copies in a message by the URLs of the sources."""
    for number, source in enumerate(task["sources"]):
        for path in (folder / str(number)).glob("*"):
            message = message.replace(str(path), source["uri"])
    return message


def _open(task: Mapping[str, Any], folder: Path) -> FrameSource:
    """Open the files of a trip; remote ones are copied first, unless a single one can be read in place."""
    files = task["files"]
    if len(files) == 1 and files[0].startswith(("http://", "https://")):
        return open_source(files[0])
    paths = []
    for number, file in enumerate(files):
        if is_url(file):
            (folder / str(number)).mkdir()
            paths.append(_copy(file, folder / str(number), task["sources"][number]))
        else:
            _check_access(file)
            paths.append(Path(file))
    return open_source(paths)


def _copy(url: str, folder: Path, source: Mapping[str, Any]) -> Path:
    """Copy a remote file of a trip.

    Where the file was found when the batch started, any error is transient: a missing package, permissions
    that have been revoked, a file that has gone. Where it was not, the trip gets another key once it is.
    """
    try:
        return download(url, folder)
    except InvalidInputError as error:
        if source["size"] is None:
            raise
        raise TransientVideoError(str(error)) from error


def _check_access(file: str) -> None:
    """Raise a TransientVideoError if a local file cannot be opened: a change of its permissions helps."""
    try:
        with open(file, "rb") as opened:
            opened.read(1)
    except FileNotFoundError as error:
        raise TransientVideoError(f"{file} cannot be read (removed, renamed or unmounted)") from error
    except OSError as error:
        problem = f"{file} cannot be read ({error.strerror or error})"
        raise TransientVideoError(f"{problem}; check its permissions and its disk") from error


@contextmanager
def _open_tracks(path: Path, key: str) -> Iterator[Callable[[Any], None]]:
    """Open the Parquet file of a trip's tracks; yield a function that adds those of a frame's result."""
    try:
        import_pyarrow()
    except InvalidInputError as error:  # not the fault of the source
        raise OSError(f"this worker cannot write tracks: {error}") from None
    with open_parquet(path, _COLUMNS) as write:

        def write_result(result: Any) -> None:
            facts = {"trip": key, "time_s": round(result.time, 4)}
            write([facts | record for record in track_records(result)])

        yield write_result


def _remove_earlier(store: Store, task: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
    """Remove results of this trip's files for other contents, parameters or trips.

    `facts` are those of the trip's new record, whose outputs are kept. A failure replaces no results.
    """
    failed, outputs = facts["status"] != DONE, facts.get("outputs", {})
    for key, record in read_records(store, task.get("replaces", ())).items():
        if failed and record["status"] == DONE:
            continue
        for path in record["outputs"].values():
            store.remove(path)
        store.remove(record_path(key))
    if failed:
        return
    # Outputs of another run at the same time, or of a killed process that has not written their record.
    identity, place = identity_of(task["key"]), f"date={task['date']}/camera={task['camera']}"
    for kind in ("tracks", "videos"):
        for path in store.list_files(f"{kind}/{place}", f"{identity}-"):
            if path not in outputs.values():
                store.remove(path)
                store.remove(record_path(path.rpartition("/")[2].partition(".")[0]))
