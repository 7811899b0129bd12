"""The trips of a batch: sources expanded to files, grouped into trips, each with a key."""

from __future__ import annotations

import datetime
import glob
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from vehicle_detection import __version__
from vehicle_detection._common import (
    check,
    hide_credentials,
    invalid,
    is_hidden,
    is_url,
    local_path,
    stable_url,
)
from vehicle_detection.drive.trips import Trip, find_trips
from vehicle_detection.errors import InvalidInputError, TransientVideoError
from vehicle_detection.video import is_video_file, open_filesystem, walk_files, with_retries

_ID_DIGITS = _HASH_DIGITS = 12
_HTTP_TIMEOUT = 10
# Answers to a HEAD request after which a GET may succeed, such as that of a URL signed for GET only.
_NO_HEAD = (400, 401, 403, 405, 501)

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
        files: Iterable[Path] = (each for each in walk_files(path, "sources") if is_video_file(each))
    elif path.exists():
        files = [path]
    elif glob.has_magic(str(path)):
        files = (Path(each) for each in glob.iglob(str(path), recursive=True))
        files = (each for each in files if is_video_file(each))
    else:
        raise InvalidInputError(f"sources {path} does not exist; check the path")
    return ((os.path.abspath(each), {}) for each in files if each.is_file())


def _list_remote(url: str) -> Iterator[tuple[str, Facts]]:
    if url.startswith(("http://", "https://")):
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
    if os.path.isfile(str(camera)):
        data += Path(camera).read_bytes()
    return hashlib.sha256(data).hexdigest()


def shipped_model(model: str) -> Traversable:
    """File of a shipped model, if `model` is its name."""
    suffix = ".onnx" if model == "default" else ".safetensors"
    return resources.files("vehicle_detection") / "models" / f"{model}{suffix}"


def _identify(uri: str, facts: Facts) -> dict[str, Any]:
    """Size of a file, and its modification time or entity tag; None and empty where it cannot be found."""
    try:
        if uri.startswith(("http://", "https://")):
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

    answer = requests.head(url, timeout=_HTTP_TIMEOUT, allow_redirects=True)
    if answer.status_code in _NO_HEAD:
        first_byte = {"Range": "bytes=0-0"}
        answer = requests.get(url, timeout=_HTTP_TIMEOUT, headers=first_byte, stream=True)
        answer.close()
    if answer.status_code >= 500:
        answer.raise_for_status()
    if not answer.ok:
        return {"size": None, "tag": ""}
    headers = answer.headers
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
        return datetime.datetime.fromtimestamp(int(tag) / 1e9, datetime.UTC).date().isoformat()
    return "unknown"
