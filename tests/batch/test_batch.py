"""Batches: outputs, resuming, and what happens when files, workers or runs fail."""

import contextlib
import json
import os
import re
import shutil
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.helpers import ROOT, random_mixture, start_interruptible
from tests.video.clips import child_processes, damage_sizes
from vehicle_detection import batch_status, open_dask, process_video, run_batch
from vehicle_detection.batch import trip as trip_module
from vehicle_detection.batch import workers
from vehicle_detection.batch.plan import list_videos
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError, OutputError, TransientVideoError, VideoError
from vehicle_detection.export import TrackWriter
from vehicle_detection.synthetic import render_drive
from vehicle_detection.video import probe_video

parquet = pytest.importorskip("pyarrow.parquet")

TRIPS = 10
CUT = 4  # the trip with a damaged file


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batch")
    drive = render_drive(frames=12, shape=(180, 320), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    return folder / "clip.mp4"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    random_mixture().save(path)
    return path


@pytest.fixture(autouse=True)
def private_scratch(tmp_path, monkeypatch):
    (tmp_path / "scratch").mkdir()
    # `tempfile` reads the variable once.
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    if "NUMBA_CACHE_DIR" not in os.environ:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(ROOT / ".pytest_cache" / "kernels"))


@pytest.fixture
def card(clip, tmp_path):
    """Two cameras with one trip of two segments each, and another drive."""
    folder = tmp_path / "card"
    folder.mkdir()
    seconds = probe_video(clip).duration
    for name in ("081500_F", "081501_F", "081500_R", "081501_R", "093000_F"):
        shutil.copy(clip, folder / f"20260131_{name}.mp4")
    assert round(seconds, 1) == 0.5
    return folder


@pytest.fixture
def many(clip, tmp_path):
    """Ten files, of which one is cut."""
    folder = tmp_path / "many"
    folder.mkdir()
    for number in range(TRIPS):
        shutil.copy(clip, folder / f"drive {chr(97 + number)}.mp4")
    cut = folder / f"drive {chr(97 + CUT)}.mp4"
    cut.write_bytes(cut.read_bytes()[:4000])
    return folder


def run(sources, out, model, **options):
    with ThreadPoolExecutor(1) as executor:
        return run_batch(sources, out, executor, model=model, progress=False, **options)


def counts(report):
    return report.done, report.failed, report.errors, report.skipped


def files(folder, pattern="*"):
    return {path: path.stat().st_mtime_ns for path in folder.rglob(pattern) if path.is_file()}


def records(out):
    return {path.stem: json.loads(path.read_text()) for path in (out / "records").glob("*.json")}


def check_whole(out, *, done, failed):
    """Assert that every record is complete, and that there is nothing else."""
    found = records(out)
    by_status = {status: [key for key, each in found.items() if each["status"] == status] for status in
                 ("done", "failed", "error")}  # fmt: skip
    assert {status: len(keys) for status, keys in by_status.items()} == {
        "done": done, "failed": failed, "error": 0
    }  # fmt: skip
    expected = {out / path for each in found.values() for path in each.get("outputs", {}).values()}
    expected |= {out / "records" / f"{key}.json" for key in found}
    assert set(files(out)) == expected
    for key in by_status["done"]:
        table = parquet.read_table(out / found[key]["outputs"]["tracks"], partitioning=None)
        assert table.num_rows == found[key]["rows"] > 0
        assert set(table["trip"].to_pylist()) == {key}
        if "video" in found[key]["outputs"]:
            assert probe_video(out / found[key]["outputs"]["video"]).frames == found[key]["frames"]
    return found


def test_outputs_are_partitioned_and_equal_process_video(card, model, tmp_path):
    out = tmp_path / "out"
    seen = []
    report = run(card, out, model, on_record=seen.append)
    # Neither segment follows the other one: it is half a second long, and names hold whole seconds.
    assert counts(report) == (3, 0, 0, 0)
    assert report.frames == 60 == sum(record["frames"] for record in seen)
    assert str(report).startswith("3 trips: 3 done, 0 failed, 0 errors, 0 skipped; 60 frames in ")
    found = check_whole(out, done=3, failed=0)
    places = sorted(each["outputs"]["tracks"].rpartition("/")[0] for each in found.values())
    day = "tracks/date=2026-01-31"
    assert places == [f"{day}/camera=front", f"{day}/camera=front", f"{day}/camera=rear"]
    table = parquet.read_table(out / "tracks")
    assert {"trip", "frame", "time_s", "track_id", "x1", "score", "distance_m", "camera", "date"} <= set(
        table.column_names
    )
    expected = tmp_path / "expected.csv"
    single = card / "20260131_093000_F.mp4"
    with VehicleDetector(model, n_jobs=1) as detector, TrackWriter(expected) as write:
        process_video(single, tmp_path / "expected.mp4", detector, workers=1, on_result=write)
    (record,) = (each for each in found.values() if each["start"] == "2026-01-31T09:30:00")
    assert (out / record["outputs"]["video"]).read_bytes() == (tmp_path / "expected.mp4").read_bytes()
    rows = parquet.read_table(out / record["outputs"]["tracks"], partitioning=None).to_pylist()
    lines = expected.read_text().splitlines()[1:]
    assert [f"{row['frame']},{row['track_id']},{row['x1']:.2f},{row['y1']:.2f}" for row in rows] == [
        ",".join(line.split(",")[:4]) for line in lines
    ]
    assert batch_status(out).done == 3


def test_a_second_run_does_what_is_missing_or_changed(card, model, tmp_path):
    out = tmp_path / "out"
    options = {"tracks_only": True, "group": "file"}
    assert counts(run(card, out, model, **options)) == (5, 0, 0, 0)
    before = files(out)
    assert counts(run(card, out, model, **options)) == (0, 0, 0, 5)
    assert files(out) == before
    # A changed source replaces its results.
    changed = card / "20260131_081500_F.mp4"
    os.utime(changed, ns=(1, 2))
    assert counts(run(card, out, model, **options)) == (1, 0, 0, 4)
    check_whole(out, done=5, failed=0)
    # So does another parameter, here for one of the files.
    one = str(card / "20260131_0930*.mp4")
    assert counts(run(one, out, model, options={"every": 3}, **options)) == (1, 0, 0, 0)
    check_whole(out, done=5, failed=0)
    # A missing output is made again.
    next((out / "tracks").rglob("camera=rear/*.parquet")).unlink()
    # The other one is the file with another parameter.
    assert counts(run(card, out, model, **options)) == (2, 0, 0, 3)
    # Another grouping of the same files replaces theirs.
    assert counts(run(card, out, model, tracks_only=True)) == (2, 0, 0, 1)
    check_whole(out, done=3, failed=0)


def test_shards_are_disjoint_and_complete(card, model, tmp_path):
    options = {"tracks_only": True, "group": "file"}
    reports = [run(card, tmp_path / "out", model, shard=f"{n}/3", **options) for n in (1, 2, 3)]
    assert sum(report.trips for report in reports) == sum(report.done for report in reports) == 5
    check_whole(tmp_path / "out", done=5, failed=0)


def test_numbered_files_are_told_apart_by_their_times(clip, model, tmp_path):
    for number, end in ((1, 0), (2, 60), (3, 120), (4, 7000)):
        copy = shutil.copy(clip, tmp_path / f"GRMN000{number}.mp4")
        os.utime(copy, (1.77e9 + end, 1.77e9 + end))
    assert counts(run(tmp_path, tmp_path / "out", model, tracks_only=True)) == (2, 0, 0, 0)
    assert sorted(each["frames"] for each in records(tmp_path / "out").values()) == [12, 36]


def test_threads_do_not_share_a_detector(card, model, tmp_path):
    options = {"model": model, "tracks_only": True, "group": "file", "progress": False}
    with ThreadPoolExecutor(4) as executor:
        run_batch(card, tmp_path / "threads", executor, **options)
    run(card, tmp_path / "one", model, tracks_only=True, group="file")
    tables = [
        {path.name: path.read_bytes() for path in (tmp_path / name).rglob("*.parquet")}
        for name in ("threads", "one")
    ]
    assert len(tables[0]) == 5
    assert tables[0] == tables[1]


def test_a_bad_file_is_recorded_once(many, model, tmp_path):
    source, out = str(many / "drive [de].mp4"), tmp_path / "out"
    report = run(source, out, model, tracks_only=True)
    assert counts(report) == (1, 1, 0, 0)
    ((name, message),) = report.messages.items()
    assert name.endswith("drive e.mp4")
    assert "is not a video that ffmpeg can read" in message
    assert counts(run(source, out, model, tracks_only=True)) == (0, 0, 0, 2)
    assert counts(run(source, out, model, tracks_only=True, retry_failed=True)) == (0, 1, 0, 1)
    status = batch_status(out)
    assert (status.done, status.failed, status.frames) == (1, 1, 12)
    assert "drive e.mp4: " in str(status)


def test_the_record_of_a_damaged_file_says_what_is_missing(clip, model, tmp_path):
    source = damage_sizes(clip, tmp_path / "lost.mp4", entry=3, byte=0, flip=64)
    assert counts(run(str(source), tmp_path / "out", model, tracks_only=True)) == (1, 0, 0, 0)
    (record,) = records(tmp_path / "out").values()
    assert "lost.mp4 is damaged: 9 of 12 frames cannot be decoded" in record["damage"]


def test_a_full_disk_is_an_error_that_the_next_run_repeats(card, model, tmp_path, monkeypatch):
    source, out = str(card / "*0930*"), tmp_path / "out"

    def fill(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(trip_module, "_publish", fill)
        report = run(source, out, model)
    assert counts(report) == (0, 0, 1, 0)
    assert "No space left" in next(iter(report.messages.values()))
    assert batch_status(out).errors == 1
    assert counts(run(source, out, model)) == (1, 0, 0, 0)
    check_whole(out, done=1, failed=0)
    assert not list((tmp_path / "scratch").iterdir())


@pytest.mark.parametrize(
    ("number", "status"), [("KILL", "error"), ("XCPU", "error"), ("SEGV", "failed"), (None, "failed")]
)
def test_a_killed_ffmpeg_is_an_error_and_a_crashed_one_a_failure(
    card, model, tmp_path, monkeypatch, number, status
):
    """A stand-in for ffmpeg ends by a signal, or with an error about the file."""
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{f'kill -{number} $$' if number else 'exit 1'}\n")
    program.chmod(0o755)
    monkeypatch.setattr("vehicle_detection.video.ffmpeg.ffmpeg_binary", lambda: str(program))
    report = run(str(card / "*0930*"), tmp_path / "out", model)
    assert [record["status"] for record in records(tmp_path / "out").values()] == [status]
    assert counts(report) == (0, status == "failed", status == "error", 0)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (VideoError("cut"), "failed"),
        (InvalidInputError("no such file"), "failed"),
        (TransientVideoError("no answer"), "error"),
        (OutputError("the disk is full"), "error"),
        (MemoryError(), "error"),
    ],
)
def test_what_the_machine_is_to_blame_for_is_an_error(card, model, tmp_path, monkeypatch, error, status):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(trip_module, "process_video", fail)
    run(str(card / "*0930*"), tmp_path / "out", model)
    assert [record["status"] for record in records(tmp_path / "out").values()] == [status]


def test_a_trip_that_another_run_is_working_on_is_awaited(card, model, tmp_path):
    import fcntl
    import threading

    source, out = str(card / "*0930*"), tmp_path / "out"
    (out / "locks").mkdir(parents=True)
    identity = trip_module_id(source)
    with (out / "locks" / f"{identity}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        timer = threading.Timer(1.5, fcntl.flock, (file, fcntl.LOCK_UN))
        timer.start()
        started = time.monotonic()
        assert counts(run(source, out, model, tracks_only=True)) == (1, 0, 0, 0)
        assert time.monotonic() - started > 1
        timer.join()


def trip_module_id(pattern):
    from vehicle_detection.batch.plan import source_id

    return source_id(list_videos([pattern])[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sources": "missing"}, "sources missing does not exist"),
        ({"sources": "*.mp4"}, r"sources \*\.mp4 holds no videos"),
        ({"sources": 3}, "sources must be files"),
        ({"shard": "0/3"}, "shard must be a number and a count, such as 3/200"),
        ({"shard": "3"}, "shard must be a number and a count"),
        ({"group": "day"}, "group must be one of 'trip', 'file'"),
        ({"jobs": 0}, "jobs must be an integer"),
        ({"model": object()}, "model must be a name or the path of a file"),
        ({"options": {"camera": object()}}, "options must hold numbers, strings, lists and None"),
        ({"out": "s3://bucket/out"}, "out must be a folder, got the URL"),
    ],
)
def test_bad_arguments(card, model, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    given = {"sources": card, "out": "out", "model": model, **options}
    sources = given.pop("sources")
    with pytest.raises(InvalidInputError, match=message):
        run_batch([sources] if sources == 3 else sources, given.pop("out"), progress=False, **given)
    with pytest.raises(InvalidInputError, match="out nowhere is not a folder"):
        batch_status("nowhere")


def test_remote_sources_are_listed():
    fsspec = pytest.importorskip("fsspec")
    for name in ("a.mp4", "b.MP4", "c.txt"):
        with fsspec.open(f"memory://fleet/day/{name}", "wb") as file:
            file.write(b"x")
    expected = ["memory:///fleet/day/a.mp4", "memory:///fleet/day/b.MP4"]
    assert list_videos(["memory://fleet/day/*"]) == list_videos(["memory://fleet"]) == expected


def test_storage_that_fails_every_other_request(clip, model, tmp_path, monkeypatch):
    fsspec = pytest.importorskip("fsspec")
    for name in "ab":
        with fsspec.open(f"memory://unsteady/{name}.mp4", "wb") as file:
            file.write(clip.read_bytes())
    memory = type(fsspec.filesystem("memory"))
    original, requests = memory.get_file, []

    def get_file(*args, **kwargs):
        requests.append(args)
        if len(requests) % 2:
            raise ConnectionResetError("connection reset by peer")
        return original(*args, **kwargs)

    monkeypatch.setattr("vehicle_detection.video.remote._RETRY_DELAYS", (0, 0))
    monkeypatch.setattr(memory, "get_file", get_file)
    out = tmp_path / "out"
    url = "memory://unsteady/*.mp4"
    assert counts(run(url, out, model, tracks_only=True)) == (2, 0, 0, 0)
    assert counts(run(url, out, model, tracks_only=True)) == (0, 0, 0, 2)
    assert len(requests) == 4
    check_whole(out, done=2, failed=0)


def test_the_status_of_ten_thousand_trips(tmp_path):
    folder = tmp_path / "records"
    folder.mkdir()
    source = {"uri": "/cards/1/20260131_081500_F.mp4", "size": 60_000_000, "tag": "1769847300000000000"}
    record = {"status": "done", "frames": 1500, "tracks": 7, "video_seconds": 60.0, "seconds": 30.0,
              "sources": [source] * 10, "settings": {"model": "default", "options": {}}}  # fmt: skip
    text = json.dumps(record, indent=1)
    for number in range(10_000):
        (folder / f"{number:012x}-0123456789ab.json").write_text(text)
    started = time.process_time()
    status = batch_status(tmp_path)
    assert time.process_time() - started < 2
    assert (status.done, status.frames, status.tracks) == (10_000, 15_000_000, 70_000)
    assert "166.7 hours of video" in str(status)


# --- real processes ---


def start_batch(sources, out, model, *words, jobs=2):
    command = ["-m", "vehicle_detection", "batch", sources, "-o", out, "--model", model, "--jobs", jobs]
    return start_interruptible(sys.executable, *command, *words)


def finish(process):
    out, errors = process.communicate(timeout=120)
    return process.returncode, out, errors


def wait_for_records(out, number):
    deadline = time.monotonic() + 60
    while len(records(out) if (out / "records").is_dir() else ()) < number:
        assert time.monotonic() < deadline
        time.sleep(0.02)


def processes_below(pid):
    """Worker processes that a batch has started."""
    tasks = Path(f"/proc/{pid}/task")
    if not tasks.is_dir():
        pytest.skip("processes cannot be listed without /proc")
    found = []
    for task in tasks.iterdir():
        with contextlib.suppress(FileNotFoundError):
            found += [int(child) for child in (task / "children").read_text().split()]
    return found


def check_numbers(printed):
    """A worker that is killed between its record and its answer leaves a trip that is not done again."""
    found = re.search(rf"{TRIPS} trips: (\d+) done, 1 failed, 0 errors, (\d+) skipped", printed)
    assert found, printed
    assert int(found[1]) + int(found[2]) == TRIPS - 1


def test_a_killed_worker_is_replaced(many, model, tmp_path):
    out = tmp_path / "out"
    process = start_batch(many, out, model, "--tracks-only")
    wait_for_records(out, 1)
    for worker in processes_below(process.pid):
        os.kill(worker, signal.SIGKILL)
    code, printed, errors = finish(process)
    assert code == 0, errors
    check_numbers(printed)
    assert "warning: " in errors
    assert "drive e.mp4: " in errors
    check_whole(out, done=TRIPS - 1, failed=1)
    assert not list((tmp_path / "scratch").glob("vehicle-batch*"))


def test_a_killed_batch_is_resumed_by_the_same_command(many, model, tmp_path):
    out = tmp_path / "out"
    process = start_batch(many, out, model)
    wait_for_records(out, 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    before = {path: stamp for path, stamp in files(out / "records", "*.json").items() if path.name[0] != "."}
    code, printed, errors = finish(start_batch(many, out, model))
    assert code == 0, errors
    check_whole(out, done=TRIPS - 1, failed=1)
    after = files(out / "records")
    assert before.items() <= after.items(), "a trip was done twice"
    assert len(before) < TRIPS
    skipped = int(printed.split(" skipped")[0].rpartition(" ")[2])
    assert skipped >= len(before)
    assert not list((tmp_path / "scratch").glob("vehicle-batch*"))


def test_two_batches_on_one_folder_share_the_work(many, model, tmp_path):
    out = tmp_path / "out"
    started = [start_batch(many, out, model, "--tracks-only", jobs=1) for _ in range(2)]
    printed = [finish(process) for process in started]
    assert [code for code, _, _ in printed] == [0, 0]
    check_whole(out, done=TRIPS - 1, failed=1)
    done = [int(text.split(" done")[0].rpartition(" ")[2]) for _, text, _ in printed]
    assert sum(done) == TRIPS - 1


def test_an_interrupt_ends_the_workers(many, model, tmp_path):
    out = tmp_path / "out"
    process = start_batch(many, out, model)
    wait_for_records(out, 1)
    children = processes_below(process.pid)
    os.kill(process.pid, signal.SIGINT)
    code, _, errors = finish(process)
    assert (code, errors) == (130, "interrupted\n")
    assert children
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    assert not list((tmp_path / "scratch").glob("vehicle-batch*"))


def test_a_worker_that_dies_in_every_attempt_is_an_error(card, model, tmp_path, monkeypatch):
    before = child_processes()
    monkeypatch.setattr("vehicle_detection.batch.run.run_trip", suicide)
    report = run_batch(card / "20260131_093000_F.mp4", tmp_path / "out", model=model, jobs=1, progress=False)
    assert counts(report) == (0, 0, 1, 0)
    assert "the worker process ended (signal 9), 3 times" in next(iter(report.messages.values()))
    assert batch_status(tmp_path / "out").errors == 1
    assert child_processes() == before


def suicide(task):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_dask_cluster_that_loses_a_worker(many, model, tmp_path):
    pytest.importorskip("distributed")
    out = tmp_path / "out"
    process = start_batch(many, out, model, "--dask", "local", "--tracks-only")
    wait_for_records(out, 1)
    children = processes_below(process.pid)
    spawned = [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(spawned[0], signal.SIGKILL)
    code, printed, errors = finish(process)
    assert code == 0, errors
    assert printed.startswith("dashboard http")
    check_numbers(printed)
    check_whole(out, done=TRIPS - 1, failed=1)


def test_a_scheduler_that_does_not_answer(monkeypatch):
    pytest.importorskip("distributed")
    message = "dask must be local or the address of a scheduler"
    with pytest.raises(InvalidInputError, match=message), open_dask("nonsense://127.0.0.1:9"):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InvalidInputError, match=r"dask needs dask\[distributed\]"), open_dask("local"):
        pass


def test_workers_keep_kernels_on_a_local_disk(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert Path(workers.worker_environment()["NUMBA_CACHE_DIR"]).parent == tmp_path / "scratch"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/elsewhere")
    assert workers.worker_environment()["NUMBA_CACHE_DIR"] == "/elsewhere"
