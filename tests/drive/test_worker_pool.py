"""The worker processes of a batch, and the executor of a Dask cluster."""

import contextlib
import gc
import logging
import os
import signal
import sys
import time
from multiprocessing import resource_tracker
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.helpers import ROOT
from tests.video.clips import child_processes
from vehicle_detection.drive import open_dask, worker_pool
from vehicle_detection.drive.worker_pool import WorkerLost, WorkerPool

pytestmark = pytest.mark.usefixtures("private_scratch")


def kill_this_process(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def fail(*_):
    raise ValueError("no model")


def note_start(path):
    """Write when this process has started its work, and when it has ended it."""
    with open(path, "a") as file:
        file.write(f"{time.monotonic()} ")
        file.flush()
        time.sleep(0.3)
        file.write(f"{time.monotonic()}\n")


def warn(*texts):
    for text in texts:
        logging.getLogger("vehicle_detection.video").warning("%s is damaged", text)


def wait_and_note(path):
    Path(path).write_text("started")
    try:
        time.sleep(300)
    except KeyboardInterrupt:
        Path(path).write_text("interrupted")
        raise


def process_id(*_):
    time.sleep(0.3)
    return os.getpid()


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)


def open_files():
    folder = Path("/proc/self/fd")
    return len(os.listdir(folder)) if folder.is_dir() else 0


@pytest.mark.parametrize(
    ("initializer", "error", "message"),
    [(kill_this_process, WorkerLost, "worker process ended"), (fail, RuntimeError, "ValueError: no model")],
)
def test_a_worker_that_dies_at_its_start_leaves_nothing(initializer, error, message):
    gc.collect()  # files that earlier tests have left open
    resource_tracker.ensure_running()
    before = open_files(), child_processes()
    pool = WorkerPool(1, (initializer, ()))
    calls = [pool.submit(process_id) for _ in range(2)]
    for call in calls:
        with pytest.raises(error, match=message):
            call.result(300)
    pool.shutdown()
    assert (open_files(), child_processes()) == before


def test_the_first_worker_compiles_the_kernels_before_the_others_start(tmp_path):
    pool = WorkerPool(3, (note_start, (str(tmp_path / "starts"),)))
    calls = [pool.submit(process_id, number) for number in range(6)]
    assert len({call.result(300) for call in calls}) > 1
    pool.shutdown()
    times = [line.split() for line in (tmp_path / "starts").read_text().splitlines()]
    assert len(times) > 1
    first_end = float(times[0][1])
    assert all(float(begin) >= first_end for begin, _ in times[1:])


def test_the_call_of_a_worker_is_interrupted_when_its_batch_ends(tmp_path):
    pool = WorkerPool(1, (process_id, ()))
    call = pool.submit(wait_and_note, str(tmp_path / "note"))
    while not (tmp_path / "note").exists():
        time.sleep(0.05)
    pool.shutdown(cancel_futures=True)
    with pytest.raises(WorkerLost):
        call.result(60)
    assert (tmp_path / "note").read_text() == "interrupted"


def test_warnings_of_a_worker_are_logged_by_its_parent(caplog, capfd):
    with WorkerPool(1, (warn, ("first",))) as pool:
        pool.submit(warn, "a", "b").result(300)
        with pytest.raises(RuntimeError, match="no model"):
            pool.submit(fail).result(300)
    assert [record.getMessage() for record in caplog.records] == [
        f"{text} is damaged" for text in ("first", "a", "b")
    ]
    assert capfd.readouterr().err == ""


def test_files_in_the_current_folder_are_no_modules_of_a_worker(monkeypatch, tmp_path):
    for name in ("queue", "json", "numpy", "vehicle_detection"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('foreign code')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH")
    with WorkerPool(1, (worker_pool.worker_environment, ())) as pool:
        found = pool.submit(worker_pool.worker_environment).result(300)
    assert found["OMP_NUM_THREADS"] == "1"


def test_kernels_are_kept_on_a_local_disk(monkeypatch, tmp_path):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    folder = Path(worker_pool.worker_environment()["NUMBA_CACHE_DIR"])
    assert folder.parent == tmp_path / "scratch"
    assert worker_pool.worker_environment()["NUMBA_CACHE_DIR"] == str(folder)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/elsewhere")
    assert worker_pool.worker_environment()["NUMBA_CACHE_DIR"] == "/elsewhere"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has a private folder for temporary files")
@pytest.mark.parametrize("kind", ["shared", "link", "file"])
def test_kernels_of_another_user_are_not_loaded(monkeypatch, tmp_path, caplog, kind):
    """They are pickled objects."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    folder = tmp_path / "scratch" / f"vehicle-detection-kernels-{os.getuid()}"
    if kind == "shared":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "link":
        folder.symlink_to(tmp_path)
    else:
        folder.write_text("")
    assert "NUMBA_CACHE_DIR" not in worker_pool.worker_environment()
    assert "kernels are kept elsewhere" in caplog.text


def test_a_dask_cluster_has_single_threads_and_may_lose_workers(monkeypatch):
    """Dask blames a lost worker on all trips that were waiting there."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    seen = {}

    @contextlib.contextmanager
    def cluster(**options):
        seen.update(options, failures=dask.config.get("distributed.scheduler.allowed-failures"))
        yield "cluster"

    @contextlib.contextmanager
    def client(target):
        yield SimpleNamespace(dashboard_link=f"http://{target}")

    monkeypatch.setattr(distributed, "LocalCluster", cluster)
    monkeypatch.setattr(distributed, "Client", client)
    with open_dask("local", 3) as (_, dashboard):
        assert dashboard == "http://cluster"
    assert (seen["n_workers"], seen["threads_per_worker"], seen["processes"]) == (3, 1, True)
    assert seen["failures"] >= 20
    assert seen["env"]["VEHICLE_DETECTION_JOBS"] == "1"
