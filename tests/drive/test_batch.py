"""Batches: outputs, resuming, and trips that fail."""

import json
import os
import shutil
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas
import pytest
from typer.testing import CliRunner

from tests.drive.batch_helpers import check_whole, counts, files, records, run
from tests.helpers import FULL_DISK, failing, write_network
from tests.video.clips import damage_sizes
from vehicle_detection import VehicleDetector, open_tracks, process_video, run_batch
from vehicle_detection.cli.app import app
from vehicle_detection.drive import batch_status, batch_summary
from vehicle_detection.drive import batch_store as store
from vehicle_detection.drive import batch_trip as trip_module
from vehicle_detection.drive.batch_trip import list_videos, source_id
from vehicle_detection.errors import InvalidInputError, OutputError, TransientVideoError, VideoError

pytestmark = pytest.mark.usefixtures("private_scratch")

parquet = pytest.importorskip("pyarrow.parquet")


def test_outputs_are_partitioned_and_equal_process_video(card, model, tmp_path, out):
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
    assert {"trip", "frame", "time_s", "track_id", "x1", "score", "camera", "date"} <= set(table.column_names)
    expected = tmp_path / "expected.csv"
    single = card / "20260131_093000_F.mp4"
    with VehicleDetector(model, jobs=1) as detector, open_tracks(expected) as write:
        process_video(single, tmp_path / "expected.mp4", detector, jobs=1, on_result=write)
    (record,) = (each for each in found.values() if each["start"] == "2026-01-31T09:30:00")
    assert (out / record["outputs"]["video"]).read_bytes() == (tmp_path / "expected.mp4").read_bytes()
    rows = parquet.read_table(out / record["outputs"]["tracks"], partitioning=None).to_pylist()
    lines = expected.read_text().splitlines()[1:]
    assert [f"{row['frame']},{row['track_id']},{row['x1']:.2f},{row['y1']:.2f}" for row in rows] == [
        ",".join(line.split(",")[:4]) for line in lines
    ]
    assert batch_status(out).done == 3


def test_a_second_run_does_what_is_missing_or_changed(card, model, out):
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


def test_results_may_lie_beside_the_sources(card, model, tmp_path):
    above = tmp_path / "drive"
    folder = above / "videos"  # its name is that of a folder of results
    folder.mkdir(parents=True)
    shutil.copy2(next(card.glob("*.mp4")), folder / "20260131_081500_F.mp4")
    options = {"options": {"every": 10}}
    for out in (above, folder):
        assert counts(run(out, out, model, **options)) == (1, 0, 0, 0)
        assert counts(run(out, out, model, **options)) == (0, 0, 0, 1)
        assert len(records(out)) == 1
        if out == above:
            shutil.rmtree(next(folder.glob("date=*")))
    with pytest.raises(InvalidInputError, match="holds only videos that a batch wrote; pass the videos"):
        run(next(folder.glob("videos/date=*")), folder, model)


def test_another_camera_file_changes_the_results(card, model, tmp_path, out):
    camera, one = tmp_path / "camera.json", str(card / "*0930*")
    given = {"camera": camera, "conf": np.float32(0.5), "every": np.int64(3)}  # not JSON as they are
    options = {"tracks_only": True, "options": given}
    for angle, done in ((60, 1), (60, 0), (120, 1)):
        camera.write_text(json.dumps({"fov": angle}))
        assert counts(run(one, out, model, **options)) == (done, 0, 0, 1 - done)
    check_whole(out, done=1, failed=0)


def test_shards_are_disjoint_and_complete(card, model, out):
    options = {"tracks_only": True, "group": "file"}
    reports = [run(card, out, model, shard=f"{n}/3", **options) for n in (1, 2, 3)]
    assert sum(report.trips for report in reports) == sum(report.done for report in reports) == 5
    check_whole(out, done=5, failed=0)


def test_numbered_files_are_told_apart_by_their_times(clip, model, tmp_path, out):
    for number, end in ((1, 0), (2, 0.48), (3, 0.96), (4, 7000)):  # the clip lasts 0.48 s
        copy = shutil.copy(clip, tmp_path / f"GRMN000{number}.mp4")
        os.utime(copy, (1.77e9 + end, 1.77e9 + end))
    assert counts(run(tmp_path, out, model, tracks_only=True)) == (2, 0, 0, 0)
    assert sorted(each["frames"] for each in records(out).values()) == [12, 36]


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


def test_a_bad_file_is_recorded_once(many, model, out):
    source = str(many / "drive [de].mp4")
    report = run(source, out, model, tracks_only=True)
    assert counts(report) == (1, 1, 0, 0)
    ((name, message),) = report.messages.items()
    assert name.endswith("drive e.mp4")
    assert "is not a video that ffmpeg can read" in message
    assert counts(run(source, out, model, tracks_only=True)) == (0, 0, 0, 2)
    assert counts(run(source, out, model, tracks_only=True, retry_failed=True)) == (0, 1, 0, 1)
    status = batch_status(out)
    assert (status.done, status.failed, status.frames) == (1, 1, 12)
    assert "drive e.mp4 " in str(status)


def test_the_summary_has_a_row_for_each_trip(many, card, model, tmp_path, out):
    run([many / "drive a.mp4", many / "drive e.mp4", card], out, model, tracks_only=True)
    table = batch_summary(out)
    assert table["status"].value_counts().to_dict() == {"done": 4, "failed": 1}
    front = table[(table["camera"] == "front") & (table["files"] == 2)].iloc[0]
    assert (front["frames"], front["video_seconds"], front["start"]) == (24, 0.96, "2026-01-31T08:15:00")
    assert front["first_file"] == str(card / "20260131_081500_F.mp4")
    assert (out / front["tracks_file"]).is_file()
    (failed,) = table[table["status"] == "failed"].to_dict("records")
    assert "is not a video" in failed["message"]
    command = ["batch", "-o", str(out), "--status", "--summary", str(tmp_path / "trips.csv")]
    assert CliRunner().invoke(app, command).output.startswith("4 trips done, 1 failed")
    assert len(pandas.read_csv(tmp_path / "trips.csv")) == 5


def test_the_record_of_a_damaged_file_says_what_is_missing(clip, model, tmp_path, out):
    source = damage_sizes(clip, tmp_path / "lost.mp4", entry=3, byte=0, flip=64)
    assert counts(run(str(source), out, model, tracks_only=True)) == (1, 0, 0, 0)
    (record,) = records(out).values()
    assert "lost.mp4 is damaged: 9 of 12 frames cannot be decoded" in record["damage"]
    status = batch_status(out)
    assert (status.done, dict(status.messages)) == (1, {str(source): record["damage"]})


def test_a_full_disk_is_an_error_that_the_next_run_repeats(card, model, tmp_path, out, monkeypatch):
    source = str(card / "*0930*")
    with monkeypatch.context() as patch:
        patch.setattr(store.shutil, "copyfile", FULL_DISK)
        report = run(source, out, model)
    assert counts(report) == (0, 0, 1, 0)
    assert "No space left" in next(iter(report.messages.values()))
    assert batch_status(out).errors == 1
    assert counts(run(source, out, model)) == (1, 0, 0, 0)
    check_whole(out, done=1, failed=0)


NO_MEMORY = "echo 'x: Cannot allocate memory'; echo '  handler_name : SoundHandler'; exit 244"


@pytest.mark.parametrize(
    ("end", "limited", "status"),
    [
        ("kill -KILL $$", False, "error"),
        ("kill -XCPU $$", False, "error"),
        ("kill -SEGV $$", False, "failed"),
        ("echo '[h264 @ 0x1] pthread_create() failed: Resource temporarily unavailable'; exit 245", False,
         "error"),
        (NO_MEMORY, False, "failed"),  # a damaged table asks for any amount of memory, too
        (NO_MEMORY, True, "error"),
        ("exit 1", False, "failed"),
    ],
)  # fmt: skip
def test_an_ffmpeg_without_resources_is_an_error_and_a_crashed_one_a_failure(
    card, model, tmp_path, out, monkeypatch, end, limited, status
):
    """A stand-in for ffmpeg ends by a signal, or with an error about the machine or the file."""
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\nexec >&2\n{end}\n")
    program.chmod(0o755)
    monkeypatch.setattr("vehicle_detection.video.ffmpeg.ffmpeg_binary", lambda: str(program))
    monkeypatch.setattr("vehicle_detection.video.ffmpeg._is_memory_limited", lambda: limited)
    report = run(str(card / "*0930*"), out, model)
    assert [record["status"] for record in records(out).values()] == [status]
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
def test_what_the_machine_is_to_blame_for_is_an_error(card, model, out, monkeypatch, error, status):
    monkeypatch.setattr(trip_module, "process_video", failing(error))
    run(str(card / "*0930*"), out, model)
    assert [record["status"] for record in records(out).values()] == [status]


def test_a_trip_that_another_run_is_working_on_is_awaited(card, model, out, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    source = str(card / "*0930*")
    (out / "locks").mkdir(parents=True)
    identity = identity_of(source)
    with (out / "locks" / f"{identity}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        attempts = []

        def work(task):
            record = trip_module.run_trip(task)
            attempts.append(record["status"])
            if len(attempts) == 2:  # the other run ends
                fcntl.flock(file, fcntl.LOCK_UN)
            return record

        monkeypatch.setattr("vehicle_detection.drive.batch.run_trip", work)
        assert counts(run(source, out, model, tracks_only=True)) == (1, 0, 0, 0)
    assert attempts == ["busy", "busy", "done"]


def identity_of(pattern):
    return source_id(next(iter(list_videos([pattern]))))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sources": "missing"}, "sources missing does not exist"),
        ({"sources": ""}, "sources must be files, folders, patterns or URLs, got ''; pass their names"),
        ({"sources": "*.mp4"}, r"sources \*\.mp4 holds no videos"),
        ({"sources": 3}, "sources must be files"),
        ({"shard": "0/3"}, "shard must be a number and a count, such as 3/200"),
        ({"shard": "3"}, "shard must be a number and a count"),
        ({"group": "day"}, "group must be one of 'trip', 'file'"),
        ({"jobs": 0}, "jobs must be an integer"),
        ({"model": object()}, "model must be a name or the path of a file"),
        ({"options": {"camera": object()}}, "options must be values of JSON for classes"),
        ({"options": {"camera": str(Path(__file__))}}, r"camera file .+test_batch.py is not JSON"),
        ({"options": {"evry": 2}}, "options must be .* for classes, device.* 'evry'"),
        ({"options": {"every": 0}}, "every must be an integer"),
        ({"preset": "quick"}, "preset must be one of 'ultrafast'"),
        ({"sources": []}, "sources must name at least one video, got none"),
        ({"out": 3}, "out must be a folder or a URL, got"),
        ({"out": "warp://bucket/out"}, "out warp://bucket/out cannot be opened"),
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


def test_a_missing_pyarrow_is_reported_before_the_first_trip(card, model, out, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    arguments = ["batch", str(card), "-o", str(out), "--model", str(model)]
    planned = CliRunner().invoke(app, [*arguments, "--dry-run"])
    assert planned.exit_code == 0, planned.output
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 2
    assert refused.stderr == "error: .parquet files need pyarrow; pip install pyarrow\n"
    assert not out.exists()


def test_annotated_videos_are_no_sources(card, model, tmp_path):
    """Also those of another batch, and by another path."""
    options = {"options": {"every": 10}}
    assert counts(run(card, card / "results", model, **options)) == (3, 0, 0, 0)
    assert counts(run(card, card / "others", model, **options)) == (3, 0, 0, 0)
    (tmp_path / "link").symlink_to(card)
    assert counts(run(card, tmp_path / "link" / "results", model, **options)) == (0, 0, 0, 3)
    assert run(tmp_path / "link", tmp_path / "third", model, dry_run=True).trips == 3


def test_linked_folders_are_searched_once(card, tmp_path):
    folder = tmp_path / "cards"
    folder.mkdir()
    (folder / "a").symlink_to(card)
    (folder / "b").symlink_to(card)
    (card / "loop").symlink_to(folder)
    (card / "lost+found").mkdir()
    (card / ".Trash").mkdir()
    shutil.copy(card / "20260131_093000_F.mp4", card / ".Trash")
    shutil.copy(card / "20260131_093000_F.mp4", card / "lost+found")
    names = sorted(file.name for file in card.glob("*.mp4"))
    shutil.copy(card / "20260131_093000_F.mp4", card / "20260131_093000_F_tracked.mp4")
    assert [*list_videos([folder])] == [f"{folder}/a/{name}" for name in names]
    assert [*list_videos([card, folder])] == [f"{card}/{name}" for name in names]


@pytest.mark.parametrize("changed", [False, True])
def test_a_trip_whose_first_segment_is_gone(clip, model, tmp_path, out, changed):
    """A camera that records in a loop deletes the oldest segment."""
    card = tmp_path / "card"
    card.mkdir()
    for second in range(5):
        shutil.copy2(clip, card / f"20260131_08150{second}_F.mp4")
    assert counts(run(card, out, model, tracks_only=True)) == (1, 0, 0, 0)
    (card / "20260131_081500_F.mp4").unlink()
    options = {"every": 3} if changed else {}
    planned = run(card, out, model, tracks_only=True, options=options, dry_run=True).planned
    assert len(planned) == changed
    report = run(card, out, model, tracks_only=True, options=options)
    assert counts(report) == ((1, 0, 0, 0) if changed else (0, 0, 0, 1))
    # What was processed of a file that is gone stays.
    found = check_whole(out, done=1 + changed, failed=0)
    assert sorted(len(each["sources"]) for each in found.values()) == ([4, 5] if changed else [5])
    assert counts(run(card, out, model, tracks_only=True, options=options)) == (0, 0, 0, 1)
    for second in (5, 6):
        shutil.copy2(clip, card / f"20260131_08150{second}_F.mp4")
        assert counts(run(card, out, model, tracks_only=True, options=options)) == (1, 0, 0, 0)
    found = check_whole(out, done=2, failed=0)
    assert sorted(len(each["sources"]) for each in found.values()) == ([5, 6] if changed else [2, 5])
    if not changed:
        assert {each["start"] for each in found.values()} == {"2026-01-31T08:15:00", "2026-01-31T08:15:05"}


def test_another_model_in_the_same_file(card, tmp_path, out):
    """Workers that live longer than a run keep their detector."""
    one, path = card / "20260131_093000_F.mp4", tmp_path / "own.onnx"
    rows = []
    with ThreadPoolExecutor(1) as executor:
        for seed in (0, 1):
            write_network(path, seed)
            run_batch(one, out, executor, model=path, tracks_only=True, progress=False)
            rows.append(parquet.read_table(out / "tracks")["score"].to_pylist())
    write_network(path, 1)
    run(one, tmp_path / "fresh", path, tracks_only=True)
    assert parquet.read_table(tmp_path / "fresh" / "tracks")["score"].to_pylist() == rows[1] != rows[0]


def test_another_model_file_on_a_worker_is_an_error(card, tmp_path, out, monkeypatch):
    path = tmp_path / "own.onnx"
    write_network(path)

    def elsewhere(task):
        write_network(path, 1)
        return trip_module.run_trip(task)

    monkeypatch.setattr("vehicle_detection.drive.batch.run_trip", elsewhere)
    report = run(card / "20260131_093000_F.mp4", out, path, tracks_only=True)
    assert counts(report) == (0, 0, 1, 0)
    assert "is not the one with which the batch was started" in next(iter(report.messages.values()))


def test_records_of_runs_with_other_parameters_at_the_same_time(card, model, out):
    one = card / "20260131_093000_F.mp4"
    run(one, out, model, tracks_only=True)
    first = next((out / "records").iterdir()).read_text()
    (key,) = records(out)
    run(one, out, model, tracks_only=True, options={"every": 3})
    # As if the first run had planned before, and finished after the second one had listed the records.
    (out / "records" / f"{key}.json").write_text(first)
    place = out / json.loads(first)["outputs"]["tracks"]
    shutil.copy(next((out / "tracks").rglob("*.parquet")), place)
    task = {"key": next(other for other in records(out) if other != key), "replaces": []}
    record = records(out)[task["key"]]
    trip_module._remove_earlier(store.open_store(out), {**record, **task}, record)
    check_whole(out, done=1, failed=0)


def test_an_error_cancels_trips_that_have_not_begun(many, model, out):
    def stop(record):
        raise KeyError("stop")

    began, calls = [], []
    ended = threading.Event()

    class Counting(ThreadPoolExecutor):
        def submit(self, function, task):
            calls.append(super().submit(self.begin, function, task))
            return calls[-1]

        def begin(self, function, task):
            began.append(task)
            if len(began) == 2:  # it may begin before the error of the first one
                assert ended.wait(300)
            return function(task)

    with Counting(1) as executor:
        with pytest.raises(KeyError, match="stop"):
            run_batch(many, out, executor, model=model, progress=False, on_record=stop)
        ended.set()
    assert len(began) <= 2
    assert all(call.cancelled() for call in calls[2:])


@pytest.mark.usefixtures("in_process")
def test_an_unknown_lens_has_one_warning(card, model, out):
    words = ["batch", "-o", str(out), "--tracks-only", "--model", str(model)]
    source = str(card / "20260131_093000_F.mp4")
    assert "distances assume a lens of 58 degrees" in CliRunner().invoke(app, [*words, source]).stderr
    known = CliRunner().invoke(app, [*words, "--fov", "90", source])
    assert (known.exit_code, known.stderr) == (0, f"done: {source}, 12 frames\n")
    again = CliRunner().invoke(app, [*words, "--fov", "80", source, "-q"])
    assert (again.exit_code, again.stderr) == (0, "")


@pytest.mark.usefixtures("in_process")
def test_a_log_that_cannot_be_written_does_not_end_a_batch(card, model, out, monkeypatch):
    monkeypatch.setattr("vehicle_detection.cli.batch.print_error", FULL_DISK)
    words = ["batch", "-o", out, "--tracks-only", "--model", model, "--fov", 90, card]
    CliRunner().invoke(app, [str(word) for word in words])
    assert len(records(out)) == 3


def test_a_dry_run_changes_nothing(card, model, tmp_path, out, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "None").touch()  # no camera is given, hence no file of one
    options = {"tracks_only": True, "dry_run": True}
    report = run(card, out, model, **options)
    assert not out.exists()
    assert str(report) == "3 trips: 3 to process, 0 skipped"
    assert [(len(trip["files"]), trip["camera"]) for trip in report.planned] == [
        (2, "front"), (1, "front"), (2, "rear")
    ]  # fmt: skip
    run(card, out, model, tracks_only=True)
    before = files(out)
    os.utime(card / "20260131_093000_F.mp4", ns=(1, 2))
    words = ["batch", "-o", str(out), "--model", str(model), "--tracks-only", "--dry-run", str(card)]
    result = CliRunner().invoke(app, words)
    assert result.stdout.splitlines() == [
        f"2026-01-31 09:30:00  front  1 file from {card}/20260131_093000_F.mp4, replaces 1 earlier result",
        "3 trips: 1 to process, 1 earlier result to replace, 2 skipped",
    ]
    assert CliRunner().invoke(app, [*words, "--summary", "a.csv"]).exit_code == 2
    assert files(out) == before
    run(card, out, model, tracks_only=True)
    assert str(run(card, out, model, **options)) == "3 trips: 0 to process, 3 skipped"
    with pytest.raises(InvalidInputError, match="is not a folder"):
        run(card, card / "20260131_093000_F.mp4", model, **options)
