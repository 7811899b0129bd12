"""Batches that read from and write to storage other than folders."""

import os
import shutil
import signal
from types import SimpleNamespace

import pytest

from tests.drive.batch_helpers import check_whole, counts, files, records, run
from tests.drive.conftest import TRIPS
from tests.drive.object_store import FOLDER, SITE, LoopbackFileSystem
from tests.helpers import failing, wait_until
from vehicle_detection.drive import batch_status
from vehicle_detection.drive import batch_trip as plan
from vehicle_detection.drive.batch_store import open_store
from vehicle_detection.drive.batch_trip import list_videos
from vehicle_detection.errors import InvalidInputError, OutputError, TransientVideoError

pytestmark = pytest.mark.usefixtures("private_scratch")

fsspec = pytest.importorskip("fsspec")


def test_remote_sources_are_listed():
    for name in ("a.mp4", "b.MP4", "c.txt"):
        with fsspec.open(f"memory://fleet/day/{name}", "wb") as file:
            file.write(b"x")
    expected = ["memory://fleet/day/a.mp4", "memory://fleet/day/b.MP4"]
    for source in ("memory://fleet/day/*", "memory://fleet"):
        assert list(list_videos([source])) == expected


def test_files_of_a_server_are_listed_with_its_name(monkeypatch):
    files = {"/cards/a.mp4": {"type": "file", "size": 3}, "/cards/note.txt": {"type": "file", "size": 1}}
    server = SimpleNamespace(
        invalidate_cache=lambda: None, isdir=lambda path: True, find=lambda path, detail: files
    )
    monkeypatch.setattr(plan, "open_filesystem", lambda url: (server, "/cards"))  # as that of FTP
    assert list(list_videos(["ftp://anna:word@nas/cards/"])) == ["ftp://anna:word@nas/cards/a.mp4"]


@pytest.fixture
def bucket(monkeypatch, tmp_path):
    """The folder of an object store of which every third request fails, also in processes of a test."""
    fsspec.register_implementation("loopback", LoopbackFileSystem, clobber=True)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(SITE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"), prepend=os.pathsep)
    monkeypatch.setattr("vehicle_detection.video.files._RETRY_DELAYS", (0, 0))
    folder = tmp_path / "bucket"
    (folder / "cam").mkdir(parents=True)
    monkeypatch.setenv(FOLDER, str(folder))
    return folder


def test_results_in_an_object_store_that_fails_every_third_request(clip, model, tmp_path, bucket):
    for name in ("20260131_081500_F", "20260131_093000_R"):
        shutil.copy(clip, bucket / "cam" / f"{name}.mp4")
    (bucket / "cam" / "20260131_103000_F.mp4").write_bytes(clip.read_bytes()[:3000])
    options = {"sources": "loopback://cam/*.mp4", "out": "loopback://results", "model": model}
    assert counts(run(**options)) == (2, 1, 0, 0)
    found = check_whole(bucket / "results", done=2, failed=1)
    assert {(each["camera"], each["date"]) for each in found.values()} == {
        ("front", "2026-01-31"), ("rear", "2026-01-31")
    }  # fmt: skip
    assert (bucket / "results" / "videos" / "date=2026-01-31" / "camera=rear").is_dir()
    # Nothing is done twice; a changed object is done again, and its old results are gone.
    before = files(bucket)
    assert counts(run(**options)) == (0, 0, 0, 3)
    assert files(bucket) == before
    with (bucket / "cam" / "20260131_093000_R.mp4").open("ab") as file:
        file.write(b"\0" * 8)
    assert counts(run(**options)) == (1, 0, 0, 2)
    status = batch_status("loopback://results")
    assert (status.done, status.failed, status.frames) == (2, 1, 24)
    assert len(files(bucket / "results" / "tracks")) == 2


def test_an_object_store_that_does_not_answer(clip, model, tmp_path, bucket, monkeypatch):
    monkeypatch.setattr(LoopbackFileSystem, "fails", lambda *_: True)
    with pytest.raises(OutputError, match=r"loopback://results/records cannot be listed \(.* 503\); check"):
        run(clip, "loopback://results", model)
    # Only the records answer: the next run repeats the trip.
    monkeypatch.setattr(LoopbackFileSystem, "fails", lambda *_: False)
    monkeypatch.setattr(LoopbackFileSystem, "put_file", failing(ConnectionResetError("no answer")))
    report = run(clip, "loopback://results", model)
    assert counts(report) == (0, 0, 1, 0)
    assert "cannot be written (no answer)" in next(iter(report.messages.values()))


def test_a_killed_batch_with_workers_and_an_object_store(many, model, tmp_path, bucket, start_batch):
    process = start_batch(many, "loopback://results", model, "--tracks-only")
    wait_until(lambda: len(files(bucket / "results" / "records")) >= 2, 300)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()  # until its workers have ended
    before = {key: each["started"] for key, each in records(bucket / "results").items()}
    run(many, "loopback://results", model, tracks_only=True)
    found = check_whole(bucket / "results", done=TRIPS - 1, failed=1)
    assert before.items() <= {key: each["started"] for key, each in found.items()}.items(), "done twice"


def test_a_store_is_the_same_for_a_folder_and_a_url(tmp_path, out, bucket):
    file = tmp_path / "file"
    file.write_bytes(b"whole")
    remote = "memory://store/a[1]", "loopback://store/a"
    for place in (out, (tmp_path / "o u t").as_uri(), *remote):
        opened = open_store(place, create=True)
        assert not opened.exists("tracks/x")
        assert opened.read("tracks/x") is None
        assert opened.list_files("tracks") == []
        opened.put("tracks/day/ab-1.txt", file)
        opened.put("tracks/day/cd-2.txt", b"small")
        opened.put("tracks/day/cd-2.txt", b"smaller")
        assert sorted(opened.list_files("tracks")) == ["tracks/day/ab-1.txt", "tracks/day/cd-2.txt"]
        assert opened.list_files("tracks/day", "ab-") == ["tracks/day/ab-1.txt"]
        paths = ["tracks/day/ab-1.txt", "tracks/missing", "tracks/day/cd-2.txt"]
        assert dict(opened.read_many(paths)) == {paths[0]: b"whole", paths[2]: b"smaller"}
        assert dict(opened.read_many([])) == {}
        opened.remove("tracks/day/ab-1.txt")
        opened.remove("tracks/missing")
        assert opened.list_files("tracks") == ["tracks/day/cd-2.txt"]
        with opened.lock("ab") as locked:
            assert locked


def test_passwords_are_neither_stored_nor_printed(clip, model, bucket, monkeypatch):
    """The user and password of sources and of the output, in records, errors and the summary."""
    monkeypatch.setattr(LoopbackFileSystem, "fails", lambda *_: False)
    shutil.copy(clip, bucket / "cam" / "drive.mp4")
    sources = ["loopback://anna:pa@ss@cam/drive.mp4", "loopback://anna:pa@ss@cam/missing.mp4"]
    out = "loopback://bob:word@results"
    report = run(sources, out, model, tracks_only=True)
    assert counts(report) == (1, 1, 0, 0)
    assert dict(report.messages) == {
        "loopback://***@cam/missing.mp4": (
            "source loopback://***@cam/missing.mp4 does not exist; check the URL"
        )
    }
    stored = b"".join(file.read_bytes() for file in files(bucket / "results"))
    for secret in (b"anna", b"ss@", b"bob", b"word"):
        assert secret not in stored
    # A new password changes nothing.
    changed = [source.replace("pa@ss", "new") for source in sources]
    assert counts(run(changed, out, model, tracks_only=True)) == (0, 0, 0, 2)
    monkeypatch.setattr(LoopbackFileSystem, "fails", lambda *_: True)
    with pytest.raises(OutputError, match=r"^loopback://\*\*\*@results/records cannot be listed"):
        batch_status(out)
    with pytest.raises(TransientVideoError, match=r"^loopback://\*\*\*@cam cannot be listed"):
        list_videos(["loopback://anna:pa@ss@cam"])


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(InvalidInputError, match="cannot be written; change its permissions"):
        open_store(tmp_path, create=True)
    assert open_store(tmp_path).name == str(tmp_path)
