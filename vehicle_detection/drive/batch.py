"""`run_batch`: process many trips in parallel, and do only what is missing or has changed."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from vehicle_detection._common import (
    available_cores,
    check,
    hide_credentials,
    import_pyarrow,
    invalid,
    pluralize,
    progress_bar,
)
from vehicle_detection.drive.batch_store import COUNTS, DONE, ERROR, FAILED, Store, is_complete, open_store
from vehicle_detection.drive.batch_trip import (
    BUSY,
    RECORDED,
    Facts,
    fingerprint_of,
    group_files,
    identity_of,
    list_videos,
    open_detector,
    plan_trip,
    run_trip,
    shipped_model,
    source_id,
    trip_digest,
    warm_up,
)
from vehicle_detection.drive.trips import Trip, find_trips
from vehicle_detection.drive.worker_pool import WorkerPool
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import PRESETS

# What `BatchReport.planned` tells of a trip.
_PLANNED = ("files", "camera", "start", "replaces")
# Attempts at a trip whose worker is lost.
_ATTEMPTS = 3
# Files that are looked up at the same time: a server takes a while to answer for each.
_LOOKUPS = 16
# Seconds between looks at a trip that another run is working on.
_BUSY_INTERVAL = 0.5


@dataclass(frozen=True, kw_only=True)
class BatchReport:
    """What a run of `run_batch` did.

    Attributes
    ----------
    trips
        Number of trips of the sources (of this shard).
    done, failed, errors
        Numbers of trips that were processed; that failed because their source is bad; and that the next run
        repeats.
    skipped
        Number of trips that an earlier or another run completed or found to have failed.
    frames, seconds
        Number of frames that this run processed, and elapsed time.
    messages
        Message of each failed trip and each error, by its first source.
    planned
        With `dry_run`, the trips that would be processed: ``files``, ``camera``, ``start`` and ``replaces``,
        the keys of earlier results that the new ones would replace; otherwise None.

    Examples
    --------
    >>> print(
    ...     BatchReport(trips=4, done=2, failed=1, errors=0, skipped=1, frames=300, seconds=6.0, messages={})
    ... )
    4 trips: 2 done, 1 failed, 0 errors, 1 skipped; 300 frames in 6.0 s, 50.0 frames/s
    """

    trips: int
    done: int
    failed: int
    errors: int
    skipped: int
    frames: int
    seconds: float
    messages: Mapping[str, str]
    planned: tuple[Mapping[str, Any], ...] | None = None

    def __str__(self) -> str:
        if self.planned is not None:
            replaced = sum(len(each["replaces"]) for each in self.planned)
            earlier = f"{pluralize(replaced, 'earlier result')} to replace, " if replaced else ""
            return (
                f"{pluralize(self.trips, 'trip')}: {len(self.planned):,} to process, {earlier}"
                f"{self.skipped:,} skipped"
            )
        rate = self.frames / self.seconds if self.seconds else 0.0
        return (
            f"{pluralize(self.trips, 'trip')}: {self.done:,} done, {self.failed:,} failed, "
            f"{pluralize(self.errors, 'error')}, {self.skipped:,} skipped; "
            f"{pluralize(self.frames, 'frame')} in {self.seconds:.1f} s, {rate:.1f} frames/s"
        )


def run_batch(
    sources: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    executor: Executor | None = None,
    *,
    model: str | os.PathLike[str] = "default",
    options: Mapping[str, Any] | None = None,
    jobs: int | None = None,
    shard: str | None = None,
    group: str = "trip",
    tracks_only: bool = False,
    audio: bool = True,
    preset: str = "veryfast",
    retry_failed: bool = False,
    dry_run: bool = False,
    progress: bool = True,
    on_record: Callable[[Mapping[str, Any]], object] | None = None,
) -> BatchReport:
    """Track the vehicles of many videos in parallel; a second run does what is missing or changed.

    `out` gets, for each trip, ``tracks/date=D/camera=C/KEY.parquet``, the annotated video
    ``videos/date=D/camera=C/KEY.mp4``, and ``records/KEY.json``, which is written last. KEY depends on the
    trip's files (path or URL, size, modification time or entity tag), the model, the parameters and the
    version of the library. If one of them changes, the new results replace the old ones, unless the changed
    source cannot be processed.

    Parameters
    ----------
    sources
        Video files, folders, patterns and URLs. Consecutive segments are one trip, see `find_trips`. The
        annotated videos in `out` are left out.
    out
        Folder, or a URL that fsspec knows, such as ``"s3://bucket/results"``. Several runs, also on several
        machines, may share one; at a URL, which has no locks, two of them may both process a trip.
    executor
        A ``concurrent.futures`` executor, such as that of `open_dask`, whose workers see the same files.
        None: worker processes of this machine, which import the running script, so that a script calls this
        function below ``if __name__ == "__main__":``.
    model, options
        A model's name or file, and options of the command ``batch`` for the detector as JSON values: classes,
        device, conf, camera, fov, camera_height, horizon, every and blur.
    jobs
        Number of worker processes with one thread each; None: one per core.
    shard
        ``"3/200"``: process the third of 200 parts, which depend on nothing but the paths.
    group
        ``"trip"`` or ``"file"``: make consecutive segments one trip, or each file.
    tracks_only, audio, preset
        Write no videos; and as in `process_video`.
    retry_failed, dry_run
        Repeat also trips whose source could not be processed; only find out what is to be done.
    progress, on_record
        Show a progress bar in a terminal or a notebook; and call a function with each finished trip's record.

    Returns
    -------
    BatchReport
        Numbers of trips. A bad source, a lost worker or scheduler and a full disk are counted, not raised.

    Raises
    ------
    TransientVideoError, OutputError
        If remote sources, or the storage of `out`, do not answer when the batch starts.

    Examples
    --------
    >>> report = run_batch("card", "results", jobs=2)  # doctest: +SKIP
    >>> tracks = pandas.read_parquet("results/tracks")  # doctest: +SKIP
    """
    started = time.perf_counter()
    check.choice(group, "group", ("trip", "file"))
    part = _parse_shard(shard)
    check.flags(
        tracks_only=tracks_only, audio=audio, retry_failed=retry_failed, dry_run=dry_run, progress=progress
    )
    _check_callables(executor, on_record)
    workers = available_cores() if jobs is None else check.integer(jobs, "jobs", low=1, high=1024)
    check.choice(preset, "preset", PRESETS)
    if executor is None and not dry_run:
        import_pyarrow()  # an error now, not after the first trip
    settings = _settings(model, options, tracks_only=tracks_only, audio=audio, preset=preset)
    listed = list_videos(sources)
    store = open_store(out, create=not dry_run, exists=not dry_run)
    tasks = _plan(listed, store, settings, group, part)
    pending, superseded = _pending(tasks, store, retry_failed)
    counts = Counter(skipped=len(tasks) - len(pending))
    planned, messages = None, {}
    if dry_run:
        planned = tuple({name: task[name] for name in _PLANNED} for task in pending)
        pending, superseded, progress = [], [], False
    for task in superseded:
        run_trip(task)
    with contextlib.ExitStack() as stack:
        if executor is None and pending:
            warm = warm_up, (settings, fingerprint_of(settings))
            executor = stack.enter_context(WorkerPool(min(workers, len(pending)), warm))
        bar = stack.enter_context(progress_bar(progress, len(pending), unit="trip", interactive_only=True))
        for record in stack.enter_context(contextlib.closing(_run(executor, pending, store))):
            bar.update()
            if not record["new"]:
                counts["skipped"] += 1
                continue
            counts[record["status"]] += 1
            counts["frames"] += record.get("frames", 0)
            if record["status"] != DONE:
                messages[record["sources"][0]["uri"]] = record["message"]
            if on_record is not None:
                on_record(record)
    numbers = {name: counts[status] for name, status in COUNTS.items()}
    numbers |= {"trips": len(tasks), "skipped": counts["skipped"], "frames": counts["frames"]}
    return BatchReport(**numbers, seconds=time.perf_counter() - started, messages=messages, planned=planned)


def _check_callables(executor: object, on_record: object) -> None:
    if executor is not None and not hasattr(executor, "submit"):
        raise invalid("executor", "be an executor of concurrent.futures", executor, "omit it")
    check.function(on_record, "on_record", "a record")


def _parse_shard(shard: object) -> tuple[int, int]:
    if shard is None:
        return 1, 1
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", shard) if isinstance(shard, str) else None
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise invalid("shard", "be a number and a count, such as 3/200 for the third of 200", shard)
    return int(found[1]), int(found[2])


def _settings(model: object, options: Mapping[str, Any] | None, **others: Any) -> dict[str, Any]:
    """Parameters that the results depend on, as plain values."""
    if not isinstance(model, (str, os.PathLike)):
        raise invalid("model", "be a name or the path of a file", model, "save the model to a file")
    name = os.fspath(model)
    if not shipped_model(name).is_file() and Path(name).exists():
        name = os.path.abspath(name)
    check.instance(options, "options", Mapping | None, "pass a dictionary")
    given = dict(options or {})
    camera = given.get("camera")
    if isinstance(camera, (str, os.PathLike)) and os.path.isfile(camera):
        given["camera"] = os.path.abspath(camera)
    try:
        text = json.dumps({"model": name, "options": given, **others}, default=_plain)
        settings: dict[str, Any] = json.loads(text)
        open_detector(name, **settings["options"]).close()  # an error now, not in every worker
    except TypeError as error:
        names = "classes, device, conf, camera, fov, camera_height, horizon, every or blur"
        raise InvalidInputError(f"options must be values of JSON for {names}; {error}") from None
    return settings


def _plain(value: Any) -> Any:
    """Value of JSON for a number of NumPy or a path."""
    return value.item() if isinstance(value, np.generic) else os.fsdecode(value)


def _plan(
    listed: Mapping[str, Facts], store: Store, settings: Mapping[str, Any], group: str, part: tuple[int, int]
) -> list[dict[str, Any]]:
    """Describe the work on each trip of this shard."""
    files = [each for each in listed if not _is_result(each, store)]
    if not files:
        raise InvalidInputError("sources holds only videos that a batch wrote; pass the videos to process")
    trips = group_files(files, group)
    fingerprint = fingerprint_of(settings)
    earlier: dict[str, list[str]] = {}  # keys of records by the identity of their trip
    for key in store.record_keys():
        earlier.setdefault(identity_of(key), []).append(key)
    number, count = part
    mine = [trip for trip in trips if int(source_id(str(trip.files[0])), 16) % count == number - 1]
    with ThreadPoolExecutor(_LOOKUPS, thread_name_prefix="vehicle-plan") as pool:
        plans = list(pool.map(lambda trip: plan_trip(trip, listed, settings, fingerprint), mine))
    longer = _longer_records(plans, earlier, store)
    tasks = []
    for trip, plan in zip(mine, plans, strict=True):
        plan = _without_recorded(trip, plan, longer.get(plan["sources"][0]["uri"]), listed)
        # A trip replaces the earlier ones that began with one of its files.
        keys = [key for file in plan["files"] for key in earlier.get(source_id(file), ())]
        known = plan["key"] in earlier.get(identity_of(plan["key"]), ())
        replaced = [key for key in keys if key != plan["key"]]
        tasks.append(plan | {"out": store.name, "recorded": known, "replaces": replaced})
    return tasks


def _is_result(file: str, store: Store) -> bool:
    """Whether a file is an annotated video of this batch, or of another one in a folder."""
    found = re.fullmatch(r"(.+)[/\\]videos[/\\]date=[^/\\]+[/\\]camera=[^/\\]+[/\\]([^/\\]+)\.mp4", file)
    if found is None:
        return False
    return found[1] == store.name or os.path.isfile(f"{found[1]}/records/{found[2]}.json")


def _longer_records(
    plans: Iterable[Mapping[str, Any]], earlier: Mapping[str, Sequence[str]], store: Store
) -> dict[str, dict[str, Any]]:
    """Complete records of the same days and cameras, by each of their segments but the first.

    A trip that starts at such a segment may be the rest of a longer one: a camera that records in a loop
    deletes its oldest files.
    """
    new = [plan for plan in plans if identity_of(plan["key"]) not in earlier]
    if not new or not earlier:
        return {}
    # Records are read only of the same days and cameras: there may be very many.
    places = {f"tracks/date={plan['date']}/camera={plan['camera']}" for plan in new}
    outputs = (path.rpartition("/") for path in store.list_files("tracks"))
    keys = {name.partition(".")[0] for place, _, name in outputs if place in places}
    found: dict[str, dict[str, Any]] = {}
    for record in store.read_records(sorted(keys)).values():
        if record["status"] == DONE and is_complete(record, store.exists):
            found |= {source["uri"]: record for source in record["sources"][1:]}
    return found


def _without_recorded(
    trip: Trip, plan: dict[str, Any], record: Mapping[str, Any] | None, listed: Mapping[str, Facts]
) -> dict[str, Any]:
    """Leave out the first files of a trip that a longer record holds, if it has the same parameters."""
    settings, fingerprint = plan["settings"], plan["fingerprint"]
    if record is None or record["key"].partition("-")[2] != trip_digest(
        record["sources"], settings, fingerprint
    ):
        return plan
    held = sum(1 for _ in takewhile(record["sources"].__contains__, plan["sources"]))
    if held == len(trip.files):
        # All of it is held: with that key, `_pending` skips the trip.
        return plan | {"key": record["key"]}
    start = find_trips([trip.files[held]])[0].start  # of the first file that is left
    rest = replace(trip, files=trip.files[held:], start=start)
    return plan_trip(rest, listed, settings, fingerprint)


def _pending(
    tasks: Iterable[dict[str, Any]], store: Store, retry_failed: bool
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Select the trips that are missing, incomplete or, with `retry_failed`, have failed.

    Also returns complete trips that still have earlier results to be removed.
    """
    records = store.read_records(task["key"] for task in tasks if task["recorded"])
    outputs = {path for kind in ("tracks", "videos") for path in store.list_files(kind)} if records else set()
    pending, superseded = [], []
    for task in tasks:
        record = records.get(task["key"])
        again = retry_failed and record is not None and record["status"] == FAILED
        task["again"] = again
        if again or not is_complete(record, outputs.__contains__):
            pending.append(task)
        elif task["replaces"]:  # such as an error while the source was away
            superseded.append(task)
    return pending, superseded


def _run(
    executor: Executor | None, pending: Sequence[dict[str, Any]], store: Store
) -> Generator[dict[str, Any]]:
    """Yield the record of each trip; closing it cancels those that have not begun."""
    attempts: Counter[str] = Counter()
    left = {id(task): task for task in pending}  # two URLs of one file give the same key
    waiting, busy = list(pending), list[dict[str, Any]]()  # to be submitted; processed by other runs
    running: dict[Future[Any], dict[str, Any]] = {}
    finished: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
    try:
        while left:
            for task in waiting:
                assert executor is not None
                future = executor.submit(run_trip, task)
                running[future] = task
                future.add_done_callback(finished.put)
            waiting = []
            if not running:
                time.sleep(_BUSY_INTERVAL)
                waiting, busy = busy, []
                continue
            future = finished.get()
            task = running.pop(future)
            record = _outcome(future, task, attempts, store)
            if record is None:
                waiting.append(task)
            elif record["status"] == BUSY:
                busy.append(task)
            else:
                del left[id(task)]
                yield record
    except BrokenExecutor as error:  # such as a scheduler that was killed: the next run does the rest
        for task in left.values():
            # Not recorded: a trip without a record is repeated.
            yield _error_record(task, hide_credentials(f"{error}")) | {"new": True}
    finally:
        for future in running:
            future.cancel()


def _outcome(
    future: Future[Any], task: Mapping[str, Any], attempts: Counter[str], store: Store
) -> dict[str, Any] | None:
    """Record of a call that has ended; None to try again after it has lost its worker."""
    try:
        record: dict[str, Any] = future.result()
        return record
    except BrokenExecutor:  # all other calls fail as well
        raise
    except Exception as error:
        attempts[task["key"]] += 1
        if attempts[task["key"]] < _ATTEMPTS:
            return None
        record = _error_record(task, hide_credentials(f"{error}, {_ATTEMPTS} times"))
    try:
        store.write_record(record)
    except (OSError, InvalidInputError) as unwritten:
        record["message"] += f"; {unwritten}"
    return record | {"new": True}


def _error_record(task: Mapping[str, Any], message: str) -> dict[str, Any]:
    """Record of a trip without a result."""
    facts = {"status": ERROR, "message": message, "started": time.time()}
    return {name: task[name] for name in RECORDED} | facts
