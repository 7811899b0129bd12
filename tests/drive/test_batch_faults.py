"""Faults of batches: real processes that are killed, and what the next run does."""

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

from tests.drive.batch_helpers import check_whole, counts, files, records, run, unfinished
from tests.drive.conftest import TRIPS
from tests.drive.test_worker_pool import kill_this_process
from tests.helpers import ROOT, wait_until
from tests.video.clips import child_processes
from vehicle_detection import InvalidInputError, run_batch
from vehicle_detection.drive import batch_status, open_dask

pytestmark = pytest.mark.usefixtures("private_scratch")


def last_of(many):
    return max(many.iterdir())


def finish(process):
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


def wait_for_records(out, number):
    wait_until(lambda: len(records(out)) >= number, 300)


def processes_below(pid):
    """Worker processes that a batch has started."""
    if not Path("/proc/self/task").is_dir():
        pytest.skip("processes cannot be listed without /proc")
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found += [int(child) for child in (task / "children").read_text().split()]
    return [child for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def check_numbers(printed):
    """A worker that is killed between its record and its answer leaves a trip that is not done again."""
    found = re.search(rf"{TRIPS} trips: (\d+) done, 1 failed, 0 errors, (\d+) skipped", printed)
    assert found, printed
    assert int(found[1]) + int(found[2]) == TRIPS - 1


def test_a_killed_worker_is_replaced(many, model, tmp_path, out, start_batch):
    with unfinished(out, last_of(many)):
        process = start_batch(many, out, model, "--tracks-only", jobs=1)
        wait_for_records(out, 1)
        workers = processes_below(process.pid)
        assert workers
        for worker in workers:
            os.kill(worker, signal.SIGKILL)
    code, printed, errors = finish(process)
    assert code == 0, errors
    check_numbers(printed)
    assert "warning: " in errors
    assert "drive e.mp4 " in errors
    check_whole(out, done=TRIPS - 1, failed=1)


def test_a_killed_batch_is_resumed_by_the_same_command(many, model, tmp_path, out, start_batch):
    with unfinished(out, last_of(many)):
        process = start_batch(many, out, model, jobs=1)
        wait_for_records(out, 2)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    before = {path: stamp for path, stamp in files(out / "records", "*.json").items() if path.name[0] != "."}
    assert len(before) < TRIPS
    assert run(many, out, model).skipped >= len(before)
    check_whole(out, done=TRIPS - 1, failed=1)
    assert before.items() <= files(out / "records").items(), "a trip was done twice"


def test_a_disk_that_is_full_in_the_middle(many, model, tmp_path, out):
    """The first run writes to a disk of 120 kB, whose files the second one finds on a large disk."""
    kept = tmp_path / "kept"
    out.mkdir()
    mount = f"mount -t tmpfs -o size=120k tmpfs '{out}'"
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-rm", "sh", "-c", mount]).returncode:
        pytest.skip("a disk cannot be mounted here")
    command = [sys.executable, "-m", "vehicle_detection", "batch", many, "-o", out, "--model", model, "-q"]
    command += ["--jobs", 2]  # if all trips were published at once, no one would fit
    script = f"{mount} && {shlex.join(map(str, command))}; code=$?; cp -a '{out}' '{kept}'; exit $code"
    done = subprocess.run(["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1, done.stderr
    assert re.search(r"warning: .+drive \w\.mp4: .*No space left on device", done.stderr)
    before = {key: each for key, each in records(kept).items() if each["status"] == "done"}
    assert 0 < len(before) < TRIPS - 1
    shutil.copytree(kept, out, dirs_exist_ok=True)
    run(many, out, model)
    after = check_whole(out, done=TRIPS - 1, failed=1)
    assert before.items() <= after.items(), "a trip was done twice"


def test_two_batches_on_one_folder_share_the_work(many, model, out, start_batch):
    started = [start_batch(many, out, model, "--tracks-only", jobs=1) for _ in range(2)]
    printed = [finish(process) for process in started]
    assert [code for code, _, _ in printed] == [0, 0]
    check_whole(out, done=TRIPS - 1, failed=1)
    done = [int(text.split(" done")[0].rpartition(" ")[2]) for _, text, _ in printed]
    assert sum(done) == TRIPS - 1


def test_an_interrupt_ends_the_workers(many, model, tmp_path, out, start_batch):
    with unfinished(out, last_of(many)):
        process = start_batch(many, out, model, jobs=1)
        wait_for_records(out, 1)
        children = processes_below(process.pid)
        os.kill(process.pid, signal.SIGINT)
        code, _, errors = finish(process)
    assert code == 130
    # A trip whose record is written may not be reported yet.
    assert re.fullmatch(r"((done|warning): .*\n)*interrupted\n", errors), errors
    assert children
    assert not any(Path(f"/proc/{child}").exists() for child in children)


def test_a_worker_that_dies_in_every_attempt_is_an_error(card, model, out, monkeypatch):
    resource_tracker.ensure_running()
    before = child_processes()
    monkeypatch.setattr("vehicle_detection.drive.batch.run_trip", kill_this_process)
    report = run_batch(card / "20260131_093000_F.mp4", out, model=model, jobs=1, progress=False)
    assert counts(report) == (0, 0, 1, 0)
    assert "the worker process ended before its result, 3 times" in next(iter(report.messages.values()))
    assert batch_status(out).errors == 1
    assert child_processes() == before


def test_a_dask_cluster_that_loses_a_worker(many, model, out, start_batch):
    pytest.importorskip("distributed")
    with unfinished(out, last_of(many)):
        process = start_batch(many, out, model, "--dask", "local", "--tracks-only", jobs=1)
        wait_for_records(out, 1)
        os.kill(processes_below(process.pid)[0], signal.SIGKILL)
    code, printed, errors = finish(process)
    assert code == 0, errors
    assert printed.startswith("dashboard http")
    check_numbers(printed)
    check_whole(out, done=TRIPS - 1, failed=1)


def test_a_killed_scheduler_ends_the_run_and_the_next_one_does_the_rest(
    many, model, tmp_path, out, start, start_batch, monkeypatch
):
    pytest.importorskip("distributed")
    monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "3s")
    monkeypatch.setenv("VEHICLE_DETECTION_JOBS", "1")
    file = tmp_path / "scheduler.json"
    words = ["--scheduler-file", file, "--no-dashboard"]
    scheduler = start("-m", "distributed.cli.dask_scheduler", "--port", 0, *words)
    worker = start("-m", "distributed.cli.dask_worker", *words, "--nthreads", 1, "--death-timeout", 20)
    wait_until(lambda: file.exists() and file.read_text().endswith("}"), 300)
    address = json.loads(file.read_text())["address"]
    with unfinished(out, last_of(many)):
        process = start_batch(many, out, model, "--tracks-only", "--dask", address)
        wait_for_records(out, 1)
        scheduler.kill()
        code, _, errors = finish(process)
    assert code == 1, errors
    assert "the Dask scheduler does not answer any more" in errors
    assert "run_batch" not in errors, "a traceback of our own; Dask may log some"
    worker.terminate()
    before = files(out / "records", "[!.]*.json")
    code, _, errors = finish(start_batch(many, out, model, "--tracks-only"))
    assert code == 0, errors
    check_whole(out, done=TRIPS - 1, failed=1)
    assert before.items() <= files(out / "records").items(), "a trip was done twice"


def test_a_scheduler_that_does_not_answer(monkeypatch):
    pytest.importorskip("distributed")
    message = "dask must be local or the address of a scheduler"
    with pytest.raises(InvalidInputError, match=message), open_dask("nonsense://127.0.0.1:9"):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InvalidInputError, match=r"dask needs .*; pip install"), open_dask("local"):
        pass
