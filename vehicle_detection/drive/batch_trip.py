"""The trips of a batch: planned in the main process, each with a key, and processed by a worker."""

from __future__ import annotations

import datetime
import glob
import hashlib
import json
import os
import platform
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vehicle_detection import __version__
from vehicle_detection._common import (
    check,
    hide_credentials,
    import_pyarrow,
    invalid,
    is_hidden,
    is_url,
    is_web_address,
    local_path,
    open_parquet,
    stable_url,
    temporary_folder,
    walk_files,
)
from vehicle_detection.annotator import Annotator
from vehicle_detection.camera import open_camera
from vehicle_detection.datasets import DIGITS, track_records
from vehicle_detection.detector import VehicleDetector, load_model
from vehicle_detection.drive.batch_store import DONE, ERROR, FAILED, Store, is_complete, open_store
from vehicle_detection.drive.trips import Trip, find_trips
from vehicle_detection.errors import (
    InvalidInputError,
    OutputError,
    TransientVideoError,
    VehicleDetectionError,
    VideoError,
)
from vehicle_detection.network import Device
from vehicle_detection.video import (
    Encoding,
    FrameSource,
    download,
    is_video_file,
    open_filesystem,
    open_source,
    process_video,
    select_videos,
    with_retries,
)

_ID_DIGITS = _HASH_DIGITS = 12
_HTTP_TIMEOUT = 10

Facts = Mapping[str, Any]
"""What storage states about a file when it lists it, such as its size and entity tag; empty if unknown."""


def list_videos(sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> dict[str, Facts]:
    """Expand files, folders, patterns and URLs to absolute paths and URLs, sorted, each once."""
    found: dict[str, Facts] = {}
    single = isinstance(sources, (str, os.PathLike))
    given = (sources,) if single else check.sequence(sources, "sources", "files, folders, patterns or URLs")
    for source in given:
        if not isinstance(source, (str, os.PathLike)) or not str(source).strip():
            raise invalid("sources", "be files, folders, patterns or URLs", source, "pass their names")
        text = local_path(os.fspath(source))
        if not is_url(text):
            check.path(text, "sources", kind="a file, folder or pattern")
        files = dict(_list_remote(text) if is_url(text) else _list_local(Path(text)))
        if not files:
            raise InvalidInputError(f"sources {hide_credentials(text)} holds no videos; check the path")
        found.update(files)
    if not found:
        raise InvalidInputError("sources must name at least one video, got none; pass files or folders")
    # Two paths of one file are one source, the first of them; a link to a file has a name of its own.
    places: dict[str, str] = {}
    for file in sorted(found):
        folder, name = os.path.split(file)
        places.setdefault(file if is_url(file) else os.path.join(os.path.realpath(folder), name), file)
    return {file: found[file] for file in places.values()}


def _list_local(path: Path) -> Iterator[tuple[str, Facts]]:
    if path.is_dir():
        files: Iterable[Path] = select_videos(walk_files(path, "sources"))
    elif path.exists():
        files = [path]
    elif glob.has_magic(str(path)):
        files = select_videos(Path(each) for each in glob.iglob(str(path), recursive=True))
    else:
        raise InvalidInputError(f"sources {path} does not exist; check the path")
    return ((os.path.abspath(each), {}) for each in files if each.is_file())


def _list_remote(url: str) -> Iterator[tuple[str, Facts]]:
    if is_web_address(url):
        yield url, {}
        return
    filesystem, path = open_filesystem(url)
    filesystem.invalidate_cache()
    # `unstrip_protocol` omits the host of FTP and the like.
    whole = url.rstrip("/")
    start = whole.removesuffix(path.rstrip("/"))

    def url_of(name: str) -> str:
        return f"{start}{name}" if start != whole else str(filesystem.unstrip_protocol(name))

    try:
        if glob.has_magic(path):
            found = with_retries(lambda: filesystem.glob(path, detail=True))
        elif with_retries(lambda: filesystem.isdir(path)):
            found = with_retries(lambda: filesystem.find(path, detail=True))
        else:
            yield url_of(path), {}
            return
    except Exception as error:  # each storage has its own
        message = f"{url} cannot be listed ({error}); check the connection and permissions"
        raise TransientVideoError(hide_credentials(message)) from error
    for name, facts in found.items():
        inside = str(name).removeprefix(path)
        if is_video_file(name) and not is_hidden(inside) and facts.get("type") != "directory":
            yield url_of(name), facts


def group_files(files: Sequence[str], group: str) -> list[Trip]:
    """Group files into trips, or make each file a trip."""
    named = [file if is_url(file) else Path(file) for file in files]
    if group == "file":
        return [trip for file in named for trip in find_trips([file])]
    return find_trips(named)


def source_id(uri: str) -> str:
    """Identity of a file: a hash of its path or URL, which a new password or signature does not change."""
    named = stable_url(uri) if is_url(uri) else uri
    return hashlib.sha256(named.encode("utf-8", "surrogateescape")).hexdigest()[:_ID_DIGITS]


def plan_trip(
    trip: Trip, known: Mapping[str, Facts], settings: Mapping[str, Any], fingerprint: str
) -> dict[str, Any]:
    """Describe the work on a trip as plain values, for a worker on any machine.

    Its ``key`` is the trip's identity and a hash of everything that the results depend on. `known` are the
    facts of `list_videos`. The worker opens ``files``; the record gets ``sources``, without passwords and
    signatures.
    """
    files = [str(file) for file in trip.files]
    shown = [hide_credentials(stable_url(file)) if is_url(file) else file for file in files]
    facts = [_identify(file, known.get(file, {})) for file in files]
    sources = [{"uri": uri, **each} for uri, each in zip(shown, facts)]
    return {
        "key": f"{source_id(files[0])}-{trip_digest(sources, settings, fingerprint)}",
        "files": files,
        "sources": sources,
        "camera": trip.camera,
        "date": _date(trip, sources[0]),
        "start": None if trip.start is None else trip.start.isoformat(),
        "settings": dict(settings),
        "fingerprint": fingerprint,
    }


def identity_of(key: str) -> str:
    """Identity of the trip with a key: its first part, the `source_id` of the first file."""
    return key.partition("-")[0]


def trip_digest(sources: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], fingerprint: str) -> str:
    """Hash of everything that the results of a trip depend on: the second part of its key."""
    facts = [sources, dict(settings), fingerprint, __version__]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:_HASH_DIGITS]


def fingerprint_of(settings: Mapping[str, Any]) -> str:
    """Hash of the model's file, and of the camera's if there is one."""
    shipped, camera = shipped_model(settings["model"]), settings["options"].get("camera")
    data = shipped.read_bytes() if shipped.is_file() else Path(settings["model"]).read_bytes()
    if isinstance(camera, str) and os.path.isfile(camera):
        data += Path(camera).read_bytes()
    return hashlib.sha256(data).hexdigest()


def shipped_model(model: str) -> Traversable:
    """File of a shipped model, if `model` is its name."""
    suffix = ".onnx" if model == "default" else ".safetensors"
    return resources.files("vehicle_detection") / "models" / f"{model}{suffix}"


def _identify(uri: str, facts: Facts) -> dict[str, Any]:
    """Size of a file, and its modification time or entity tag; None and empty where it cannot be found."""
    try:
        if is_web_address(uri):
            return with_retries(lambda: _identify_http(uri))
        if is_url(uri):
            filesystem, path = open_filesystem(uri)
            info = facts or with_retries(lambda: filesystem.info(path))
            names = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "created")
            tag = next((str(info[name]) for name in names if info.get(name)), "")
            return {"size": info.get("size"), "tag": tag}
        stat = os.stat(uri)
    except Exception:  # each storage has its own; reported when its trip is processed
        return {"size": None, "tag": ""}
    return {"size": stat.st_size, "tag": str(stat.st_mtime_ns)}


def _identify_http(url: str) -> dict[str, Any]:
    import requests

    # Not a HEAD request: a URL may be signed for GET only.
    first_byte = {"Range": "bytes=0-0"}
    with requests.get(url, timeout=_HTTP_TIMEOUT, headers=first_byte, stream=True) as answer:
        headers = answer.headers
    if answer.status_code >= 500:
        answer.raise_for_status()
    if not answer.ok:
        return {"size": None, "tag": ""}
    length = headers.get("Content-Range", "").rpartition("/")[2] or headers.get("Content-Length", "")
    return {
        "size": int(length) if length.isdecimal() else None,
        "tag": headers.get("ETag") or headers.get("Last-Modified") or "",
    }


def _date(trip: Trip, source: Mapping[str, Any]) -> str:
    """Day of a trip by its name, else that of its file's modification time (UTC)."""
    if trip.start is not None:
        return trip.start.date().isoformat()
    tag = source["tag"]
    if tag and not is_url(source["uri"]):
        with suppress(ValueError, OverflowError):  # beyond the year 9999, as of a damaged card
            return datetime.datetime.fromtimestamp(int(tag) / 1e9, datetime.UTC).date().isoformat()
    return "unknown"


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
    last. What a complete trip replaces is removed.
    """
    key = task["key"]
    try:
        store = open_store(task["out"], create=True)
        with store.lock(identity_of(key)) as locked:
            if not locked:
                return {"key": key, "status": BUSY, "sources": task["sources"]}
            record = store.read_records([key]).get(key)
            if record is None or task["again"] or not is_complete(record, store.exists):
                return _run_locked(store, task) | {"new": True}
            _remove_earlier(store, task, record)
            return record | {"new": False}
    except OutputError as error:  # no access, or a file in `out` that is not the batch's
        return {name: task[name] for name in RECORDED} | _failure(error) | {"new": True}


def _run_locked(store: Store, task: Mapping[str, Any]) -> dict[str, Any]:
    """Process a trip, remove what it replaces, and write its record."""
    started = time.time()
    record = {name: task[name] for name in RECORDED}
    record |= {"version": __version__, "host": platform.node(), "started": started}
    try:
        record |= _process(store, task)
    except Exception as error:
        record |= _failure(error)
    record["seconds"] = round(time.time() - started, 3)
    try:
        if record["status"] != ERROR:  # an error of the machine replaces nothing
            _remove_earlier(store, task, record)
        store.write_record(record)
    except (OSError, InvalidInputError) as error:  # a full disk, no access: the next run repeats the trip
        record |= {"status": ERROR, "message": str(error)}
    return record


def _failure(error: Exception) -> dict[str, Any]:
    """Status and message of an error: of the source, or of the machine, which may go away."""
    message = hide_credentials(" ".join(str(error).split()))
    if not isinstance(error, VehicleDetectionError):
        return {"status": ERROR, "message": f"{type(error).__name__}: {message}"}
    passing = isinstance(error, (TransientVideoError, OSError))  # an OutputError is an OSError
    return {"status": ERROR if passing else FAILED, "message": message}


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
            store.put(outputs["video"], video)
        store.put(outputs["tracks"], folder / "tracks.parquet")
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
    if len(files) == 1 and is_web_address(files[0]):
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
    for key, record in store.read_records(task.get("replaces", ())).items():
        if failed and record["status"] == DONE:
            continue
        for path in record["outputs"].values():
            store.remove(path)
        store.remove_record(key)
    if failed:
        return
    # Outputs of another run at the same time, or of a killed process that has not written their record.
    identity, place = identity_of(task["key"]), f"date={task['date']}/camera={task['camera']}"
    for kind in ("tracks", "videos"):
        for path in store.list_files(f"{kind}/{place}", f"{identity}-"):
            if path not in outputs.values():
                store.remove(path)
                store.remove_record(path.rpartition("/")[2].partition(".")[0])
