"""Results folders in which somebody else has changed, linked or replaced files."""

import json
import os
from types import SimpleNamespace

import pytest

from vehicle_detection.drive import batch_status, batch_summary, batch_trip
from vehicle_detection.drive.batch_store import open_store
from vehicle_detection.drive.trips import Trip
from vehicle_detection.errors import OutputError

GOOD = {"status": "done", "sources": [{"uri": "a"}]}
ODD_RECORDS = [
    {"status": "done", "sources": [1]}, {"status": ["x"], "sources": [{"uri": "a"}]},
    {"status": "failed", "sources": {"a": 1}}, GOOD | {"frames": "x"}, GOOD | {"frames": 1e200},
    GOOD | {"seconds": -1}, GOOD | {"status": "failed", "message": {"a": 1}}, GOOD | {"date": 3},
    GOOD | {"outputs": {"tracks": "../victim"}},
    GOOD | {"outputs": {"tracks": "tracks/date=a/camera=b/c.parquet"}}, [],
]  # fmt: skip


@pytest.mark.parametrize("record", ODD_RECORDS, ids=json.dumps)
def test_records_of_another_shape_are_left_out(record, tmp_path):
    good = {"status": "done", "sources": [{"uri": "b.mp4"}], "frames": 3, "outputs": None}
    (tmp_path / "records").mkdir()
    for name, each in (("good", good), ("odd", record)):
        (tmp_path / "records" / f"{name}.json").write_text(json.dumps(each))
    assert (batch_status(tmp_path).done, batch_status(tmp_path).frames) == (1, 3)
    assert batch_summary(tmp_path)["key"].tolist() == ["good"]


def test_a_record_removes_its_own_files_only(tmp_path, out):
    victims = [tmp_path / "victim", out / "tracks" / "date=a" / "camera=b" / "2-2.parquet"]
    victims[1].parent.mkdir(parents=True)
    store = open_store(out)
    for victim, path in zip(victims, ("tracks/../../victim", "tracks/date=a/camera=b/2-2.parquet")):
        victim.write_text("precious")
        store.write_record(
            {"key": "1-1", "status": "done", "sources": [{"uri": "a"}], "outputs": {"tracks": path}}
        )
        batch_trip._remove_earlier(
            store, {"key": "1-3", "date": "c", "camera": "d", "replaces": ["1-1"]}, {"status": "done"}
        )
    assert [victim.read_text() for victim in victims] == ["precious"] * 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("kind", ["link", "hard link", "pipe", "file"])
def test_locks_and_records_of_others_are_neither_followed_nor_emptied(kind, tmp_path, out):
    victim, folder = tmp_path / "victim", out
    victim.write_text("precious")
    for path in (folder / "locks" / "1.lock", folder / "records" / "1-1.json"):
        path.parent.mkdir(parents=True)
        match kind:
            case "link":
                path.symlink_to(victim)
            case "hard link":
                path.hardlink_to(victim)
            case "pipe":
                os.mkfifo(path)
            case _:
                path.write_text("precious")
    store = open_store(folder)
    with pytest.raises(OutputError, match="not the lock of a batch"), store.lock("1"):
        pass
    assert batch_status(folder).done == 0
    if kind != "pipe":
        store.write_record({"key": "1-1"})
        assert (folder / "records" / "1-1.json").read_text() != "precious"
    assert victim.read_text() == "precious"


def test_a_linked_folder_in_the_results_is_refused(tmp_path, out):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.json").write_text("precious")
    (tmp_path / "real").mkdir()
    out.symlink_to(tmp_path / "real")  # the folder itself may be a link
    (out / "records").symlink_to(tmp_path / "elsewhere")
    store = open_store(out)
    for call in (lambda: store.remove("records/a.json"), lambda: store.put("records/a.json", b""),
                 lambda: store.list_files("records"), lambda: store.read("records/a.json")):  # fmt: skip
        with pytest.raises(OutputError, match="leads through a link"):
            call()
    store.put("tracks/a", b"x")
    assert (tmp_path / "real" / "tracks" / "a").read_bytes() == b"x"
    assert (tmp_path / "elsewhere" / "a.json").read_text() == "precious"


def test_a_damaged_time_of_a_file_is_no_date(tmp_path, monkeypatch):
    """As on a damaged card: beyond the year 9999."""
    file = tmp_path / "video.mp4"
    file.touch()
    monkeypatch.setattr(batch_trip.os, "stat", lambda path: SimpleNamespace(st_size=1, st_mtime_ns=10**21))
    assert batch_trip.plan_trip(Trip((file,), "front"), {}, {}, "")["date"] == "unknown"
