"""Clips, models and processes of the batch tests."""

import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.helpers import ROOT, start_interruptible, write_network
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.scenes import render_drive

TRIPS = 6
CUT = 4  # the trip with a damaged file


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batch")
    drive = render_drive(frames=12, shape=(180, 320), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    return folder / "clip.mp4"


@pytest.fixture(scope="session")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.onnx"
    write_network(path)
    return path


@pytest.fixture
def private_scratch(tmp_path, monkeypatch):
    """A folder for temporary files, in which no trip of a batch leaves any."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    # `tempfile` reads the variable once.
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    monkeypatch.setenv("TMPDIR", str(scratch))
    if "NUMBA_CACHE_DIR" not in os.environ:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(ROOT / ".pytest_cache" / "kernels"))
    yield
    assert not list(scratch.glob(".vehicle-*"))


@pytest.fixture
def out(tmp_path):
    """The folder of the results of a batch."""
    return tmp_path / "out"


@pytest.fixture
def card(clip, tmp_path):
    """Two cameras with one trip of two segments each, and another drive."""
    folder = tmp_path / "card"
    folder.mkdir()
    for name in ("081500_F", "081501_F", "081500_R", "081501_R", "093000_F"):
        shutil.copy(clip, folder / f"20260131_{name}.mp4")
    return folder


@pytest.fixture
def many(clip, tmp_path):
    """Six files, of which one is cut."""
    folder = tmp_path / "many"
    folder.mkdir()
    for number in range(TRIPS):
        shutil.copy(clip, folder / f"drive {chr(97 + number)}.mp4")
    cut = folder / f"drive {chr(97 + CUT)}.mp4"
    cut.write_bytes(cut.read_bytes()[:4000])
    return folder


@pytest.fixture
def in_process(monkeypatch):
    """Process the trips of the command in this process, without the start of a worker."""
    monkeypatch.setattr("vehicle_detection.drive.batch.WorkerPool", lambda *_: ThreadPoolExecutor(1))


@pytest.fixture
def start(tmp_path):
    """Start programs that end with the test: a function of their arguments."""
    started = []

    def start_python(*words, **options):
        started.append(start_interruptible(sys.executable, *words, **options))
        return started[-1]

    yield start_python
    for process in started:
        if process.poll() is None:  # a test has failed: end its workers as well
            process.send_signal(signal.SIGTERM)
        if not process.stdout.closed:
            try:
                process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


@pytest.fixture
def start_batch(start):
    """Start the command on sources, with an output, a model and further options."""

    def start_command(sources, out, model, *words, jobs=2, **options):
        command = ["batch", sources, "-o", out, "--model", model, "--jobs", jobs, *words]
        return start("-m", "vehicle_detection", *command, **options)

    return start_command
