"""Sources that cannot be read for a while, and URLs that are signed for a while."""

import contextlib
import os
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from types import SimpleNamespace
from urllib.parse import parse_qs, urlsplit

import pytest

from tests.drive.batch_helpers import check_whole, counts, files, records, run
from tests.helpers import answer, serve
from vehicle_detection import InvalidInputError, OutputError, run_batch
from vehicle_detection.drive import batch_trip as plan
from vehicle_detection.drive import batch_trip as trip
from vehicle_detection.drive.batch_trip import list_videos

pytestmark = pytest.mark.usefixtures("private_scratch")


@pytest.fixture
def one(card):
    return card / "20260131_093000_F.mp4"


@contextlib.contextmanager
def away(path):
    """A file that has gone, such as from a network drive that is not mounted."""
    hidden = path.with_suffix(".away")
    path.rename(hidden)
    yield
    hidden.rename(path)


@contextlib.contextmanager
def forbidden(path):
    path.chmod(0)
    if os.access(path, os.R_OK):
        path.chmod(0o600)
        pytest.skip("this user may read every file")
    yield
    path.chmod(0o600)


@pytest.mark.parametrize("fault", [away, forbidden])
def test_a_source_without_access_is_an_error_that_the_next_run_repeats(one, model, out, monkeypatch, fault):
    """It does not change when access is given again, so a failure would be recorded forever."""

    def without_access(task):
        with fault(one):
            return trip.run_trip(task)

    with monkeypatch.context() as patch:
        patch.setattr("vehicle_detection.drive.batch.run_trip", without_access)
        report = run(one, out, model, tracks_only=True)
    assert counts(report) == (0, 0, 1, 0)
    assert f"{one} cannot be read (" in next(iter(report.messages.values()))
    assert counts(run(one, out, model, tracks_only=True)) == (1, 0, 0, 0)
    check_whole(out, done=1, failed=0)


def test_an_error_keeps_the_results_of_earlier_runs(one, model, out, monkeypatch):
    run(one, out, model, tracks_only=True)
    before = files(out / "tracks")
    with monkeypatch.context() as patch:
        # The storage answers neither when the batch starts nor later.
        patch.setattr(plan, "_identify", lambda *_: {"size": None, "tag": ""})
        patch.setattr(trip, "process_video", None)
        assert counts(run(one, out, model, tracks_only=True)) == (0, 0, 1, 0)
    assert files(out / "tracks") == before
    assert sorted(each["status"] for each in records(out).values()) == ["done", "error"]
    # When it answers again, nothing is done twice, and the error is forgotten.
    assert counts(run(one, out, model, tracks_only=True)) == (0, 0, 0, 1)
    assert files(out / "tracks") == before
    check_whole(out, done=1, failed=0)


def test_a_source_that_is_bad_now_keeps_its_results(one, model, out):
    whole = one.read_bytes()
    run(one, out, model)
    for size in (3000, 2000):
        one.write_bytes(whole[:size])
        assert counts(run(one, out, model)) == (0, 1, 0, 0)
        check_whole(out, done=1, failed=1)
    one.write_bytes(whole)
    assert counts(run(one, out, model)) == (1, 0, 0, 0)
    check_whole(out, done=1, failed=0)


def test_videos_are_written_on_a_local_disk(one, model, tmp_path, out, monkeypatch):
    """ffmpeg moves the index of a finished video to its start, which network storage does slowly."""
    written = []
    original = trip.process_video

    def process_video(source, target, *words, **options):
        written.append(target)
        return original(source, target, *words, **options)

    monkeypatch.setattr(trip, "process_video", process_video)
    run(one, out, model)
    assert written[0].is_relative_to(tmp_path / "scratch")


def test_folders_that_cannot_be_read_are_errors(one, model, out, monkeypatch):
    out.mkdir()
    (out / "records").mkdir()

    def refuse(path):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(InvalidInputError, match=r"sources .+card cannot be listed \(Permission denied\)"):
        list_videos([one.parent])
    with pytest.raises(OutputError, match=r"records cannot be listed \(Permission denied\)"):
        run(one, out, model, tracks_only=True)


@pytest.fixture
def signed(clip):
    """A server with two segments of a trip and another drive; `url` signs the URL of a file.

    It answers GET requests with the current signature only.
    """
    names = [f"20260131_{time}_F.mp4" for time in ("081500", "081501", "093000")]
    server = SimpleNamespace(files={f"cam/{name}": clip.read_bytes() for name in names}, signature="ab12")

    def handle(request):
        parts = urlsplit(request.path)
        signature = parse_qs(parts.query).get("X-Amz-Signature")
        if request.command == "HEAD" or signature != [server.signature]:
            answer(request, 403)
            return
        data = server.files.get(parts.path[1:], b"")
        start, _, end = request.headers.get("Range", "bytes=0-").removeprefix("bytes=").partition("-")
        part = data[int(start) : int(end) + 1 if end else None]
        place = f"bytes {start}-{int(start) + len(part) - 1}/{len(data)}"
        headers = {"Content-Range": place, "ETag": f'"{hash(data):x}"'}
        answer(request, 206 if "Range" in request.headers else 200, part, headers)

    def url(name, signature):
        date = "X-Amz-Algorithm=AWS4&X-Amz-Date=20300101T120000Z"
        return f"{server.address}/cam/20260131_{name}_F.mp4?{date}&X-Amz-Signature={signature}"

    with serve(handle) as address:
        server.address, server.url = address, url
        yield server


def test_signed_urls_are_the_same_files_when_they_are_signed_again(signed, model, out):
    names = ("081500", "081501", "093000")
    assert counts(run([signed.url(name, "ab12") for name in names], out, model, tracks_only=True)) == (
        2, 0, 0, 0
    )  # fmt: skip
    found = check_whole(out, done=2, failed=0)
    assert {(each["camera"], each["date"]) for each in found.values()} == {("front", "2026-01-31")}
    assert sorted(each["frames"] for each in found.values()) == [12, 24]
    assert all(each["size"] for record in found.values() for each in record["sources"])
    before = files(out)
    signed.signature = "cd34"
    again = [signed.url(name, "cd34") for name in names]
    # An expired signature is an error, which keeps the results.
    expired = run([signed.url("093000", "ab12")], out, model, tracks_only=True)
    assert counts(expired) == (0, 0, 1, 0)
    ((name, message),) = expired.messages.items()
    assert name.endswith("/cam/20260131_093000_F.mp4")
    assert "Server returned 403 Forbidden" in message
    # Signed again, nothing is done twice, and the error is forgotten.
    assert counts(run(again, out, model, tracks_only=True)) == (0, 0, 0, 2)
    assert files(out) == before
    for path in files(out):
        assert b"ab12" not in path.read_bytes()
        assert b"cd34" not in path.read_bytes()


def test_two_urls_of_one_file_are_processed_once(signed, model, out):
    urls = [signed.url(name, "ab12") for name in ("093000", "081500")]
    urls.append(f"{urls[0]}&X-Amz-Expires=60")
    assert counts(run(urls, out, model, tracks_only=True, group="file")) == (2, 0, 0, 1)
    check_whole(out, done=2, failed=0)


def test_a_bad_segment_of_a_server_is_named(signed, model, out):
    signed.files["cam/20260131_081501_F.mp4"] = b"\0" * 3000
    urls = [signed.url(name, "ab12") for name in ("081500", "081501")]
    report = run(urls, out, model, tracks_only=True)
    assert counts(report) == (1, 0, 0, 0)
    (record,) = check_whole(out, done=1, failed=0).values()
    named = f"{signed.address}/cam/20260131_081501_F.mp4 is not a video"
    assert record["damage"].startswith(f"the last segment is left out: {named}")


def test_the_identity_of_a_url_does_not_depend_on_what_is_hidden_in_its_record():
    url = "ftp://anna:secret@host/20260131_093000_F.mp4"
    (found,) = plan.group_files([url], "trip")
    task = plan.plan_trip(found, {url: {"size": 1}}, {"options": {}}, "")
    assert task["key"].partition("-")[0] == plan.source_id(url) == plan.source_id(str(found.files[0]))
    assert "secret" not in task["sources"][0]["uri"]


def test_the_message_of_a_broken_executor_has_no_password(one, model, out):
    class Broken(ThreadPoolExecutor):
        def submit(self, *_):
            raise BrokenExecutor("tcp://anna:secret@host:8786 does not answer")

    report = run_batch(one, out, Broken(1), model=model, tracks_only=True, progress=False)
    assert counts(report) == (0, 0, 1, 0)
    (message,) = report.messages.values()
    assert "does not answer" in message
    assert "secret" not in message
    assert not records(out)
