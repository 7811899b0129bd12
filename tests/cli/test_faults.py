"""Faults while a command runs: signals, a full disk, targets that vanish, and unusual environments."""

import errno
import itertools
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numba
import numpy as np
import pytest

from tests.cli.commands import contents, finish, patches_of, refuse, run, start_changed, write_patches
from tests.helpers import ROOT, failing, wait_until
from tests.video.clips import gray_frames, write_clip
from vehicle_detection import detector, render_scene, write_image
from vehicle_detection._kernels.jit import jit
from vehicle_detection.drive import events
from vehicle_detection.drive import outputs as event_files

FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    # A size in which the default model is fast.
    noise = np.random.default_rng(0).integers(0, 40, (120, 160, 3), dtype=np.uint8)
    frames = [frame + noise for frame in gray_frames(10, width=160, height=120)]
    return write_clip(tmp_path_factory.mktemp("faults") / "clip.mp4", frames)


# --- signals ---

# The program reports that it writes, and then waits.
PAUSED = """
import time
from vehicle_detection.video import writing
put = writing._Sink.put
def pause(self, *args, **kwargs):
    put(self, *args, **kwargs)
    time.sleep(0.5)
    print("now", flush=True)
    time.sleep(1)
writing._Sink.put = pause
"""


def start_paused(code, *words):
    """Start a command that some code changes so that it prints "now" and waits."""
    process = start_changed(code, *words)
    assert process.stdout.readline() == "now\n", process.communicate()
    return process


def start_video(clip, folder):
    words = ["video", clip, "-o", folder / "out.mp4", "--tracks", folder / "out.csv", "--model", "highway"]
    return start_paused(PAUSED, *words)


@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_a_signal_ends_a_video_and_leaves_nothing(clip, tmp_path, name):
    number = getattr(signal, name)
    (tmp_path / "out.mp4").write_bytes(b"old")
    process = start_video(clip, tmp_path)
    process.send_signal(number)
    process.send_signal(number)  # does not interrupt the cleanup
    out, errors = process.communicate(timeout=60)
    note = f"note: {tmp_path / 'out.mp4'} will be replaced when the new file is complete\n"
    assert (process.returncode, errors) == (128 + number, f"{note}interrupted\n")
    assert set(out.split()) <= {"now"}
    assert contents(tmp_path) == ["out.mp4"]
    assert (tmp_path / "out.mp4").read_bytes() == b"old"


def test_a_killed_run_leaves_no_process_and_the_next_one_removes_its_files(clip, tmp_path):
    process = start_video(clip, tmp_path)
    process.kill()
    process.communicate()
    parts = contents(tmp_path)
    assert parts == [".out.0.part.csv", ".out.0.part.mp4"]
    wait_until(lambda: not processes_with(tmp_path))
    words = ["-o", tmp_path / "out.mp4", "--tracks", tmp_path / "out.csv", "--model", "highway", "-q"]
    assert run("video", clip, *words).exit_code == 0
    assert contents(tmp_path) == ["out.csv", "out.mp4"]


def processes_with(folder):
    """Processes that name a folder in their command."""
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            found += [line.parent.name] * (str(folder).encode() in line.read_bytes())
        except OSError:  # it has ended
            continue
    return found


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_an_early_interrupt_has_no_traceback(delay):
    code = (
        "import signal, sys\n"
        "original = signal.signal\n"
        "def note(number, handler):\n"
        "    before = original(number, handler)\n"
        "    if number == signal.SIGINT:\n"
        "        signal.signal = original\n"
        "        print('now', flush=True)\n"  # what Python prints at an earlier interrupt is not ours
        "    return before\n"
        "signal.signal = note"
    )
    process = start_paused(code, "info")
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    status, _, errors = finish(process)
    assert (status, errors) in ((130, "interrupted\n"), (0, ""))


def test_an_interrupt_after_a_command_changes_nothing():
    code = "import atexit, os, signal; atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))"
    status, out, errors = finish(start_changed(code, "info"))
    assert (status, errors) == (0, "")
    assert out.startswith("default: ")


def test_an_interrupt_does_not_wait_for_threads_that_compute(tmp_path):
    """Python joins the threads of an executor when it exits, also if their thread was abandoned."""
    write_patches(tmp_path, 4)
    code = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from vehicle_detection import training
def train(*_, **__):
    with ThreadPoolExecutor(1) as executor:
        print("now", flush=True)
        executor.submit(time.sleep, 600).result()
training.train_and_evaluate = train
"""
    process = start_paused(code, "train", *patches_of(tmp_path), "-o", tmp_path / "x.safetensors")
    process.send_signal(signal.SIGTERM)
    assert finish(process) == (143, "", "interrupted\n")


# --- outputs that cannot be written ---


def fill_after(monkeypatch, number):
    """Fill the disk at the rename of an output."""
    count, replace = itertools.count(1), Path.replace

    def fill(self, target):
        if next(count) == number:
            raise FULL
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", fill)


@pytest.mark.parametrize(
    ("number", "failed", "kept"),
    [(1, "out.mp4", []), (2, "out.csv", ["out.mp4"]), (3, "out.html", ["out.mp4", "out.csv"])],
)
def test_a_full_disk_names_the_output_and_what_was_kept(clip, tmp_path, monkeypatch, number, failed, kept):
    fill_after(monkeypatch, number)
    outputs = {"-o": "out.mp4", "--tracks": "out.csv", "--report": "out.html"}
    words = [word for option, name in outputs.items() for word in (option, tmp_path / name)]
    message = refuse("video", clip, *words, "--model", "highway", "-q")
    names = " and ".join(str(tmp_path / name) for name in kept)  # two at most
    end = f"; {names} {'is' if len(kept) == 1 else 'are'} complete and kept" if kept else ""
    assert message == (
        f"error: {tmp_path / failed} cannot be written (No space left on device); free some space{end}\n"
    )
    assert contents(tmp_path) == sorted(kept)


def test_an_interrupt_while_clips_are_cut_keeps_all_other_files(clip, tmp_path, monkeypatch):
    kinds = ("met", "cut_in", "closing", "cut_in")
    found = tuple(
        events.Event(kind=kind, track_id=number, frame=5, start_frame=4, end_frame=6, time_s=0.2)
        for number, kind in enumerate(kinds)
    )
    monkeypatch.setattr("vehicle_detection.find_events", lambda *_, **__: found)
    cut = event_files.cut_video

    def interrupt(source, target, **options):
        if "closing" in target.name:
            raise KeyboardInterrupt
        return cut(source, target, **options)

    monkeypatch.setattr(event_files, "cut_video", interrupt)
    outputs = {"-o": "o.mp4", "--tracks": "o.csv", "--report": "o.html", "--events": "o.json"}
    outputs["--srt"] = "o.srt"
    words = [word for option, name in outputs.items() for word in (option, tmp_path / name)]
    words += ["--clips", tmp_path / "clips", "--clips-of", "cut_in, closing"]
    result = run("video", clip, *words, "--model", "highway", "-q")
    *others, last = (str(tmp_path / name) for name in outputs.values())
    message = f"interrupted; {', '.join(others)} and {last} are complete and kept\n"
    assert (result.exit_code, result.stderr) == (130, message)
    assert contents(tmp_path) == sorted(["clips", "clips/0000.2s_cut_in_1.mp4", *outputs.values()])


def test_an_interrupted_batch_leaves_no_empty_folder(clip, tmp_path):
    code = """
import sys, time
from vehicle_detection import drive
drive.run_batch = lambda *_, **__: (print("now", flush=True), time.sleep(600))
"""
    process = start_paused(code, "batch", clip, "-o", tmp_path / "new" / "out")
    assert contents(tmp_path) == ["new", "new/out"]
    process.send_signal(signal.SIGINT)
    assert finish(process) == (130, "", "interrupted\n")
    assert contents(tmp_path) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps the current folder")
def test_a_current_folder_that_has_been_removed(clip, tmp_path):
    (tmp_path / "gone").mkdir()
    gone = shlex.quote(str(tmp_path / "gone"))
    script = f'cd {gone} && rmdir {gone} && exec "$@"'
    command = [sys.executable, "-m", "vehicle_detection", "video", str(clip), "-o", "out.mp4"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["sh", "-c", script, "sh", *command], env=environment, capture_output=True, text=True
    )
    message = "error: the current folder has been removed; change to another one\n"
    assert (done.returncode, done.stderr) == (2, message)


# --- arguments and environment ---


@pytest.mark.parametrize(
    ("variable", "value"),
    [("NUMBA_NUM_THREADS", "0"), ("NUMBA_NUM_THREADS", "many"), ("NUMBA_DISABLE_JIT", "1")],
)
def test_variables_that_numba_fails_with(variable, value):
    command = [sys.executable, "-m", "vehicle_detection", "info"]
    options = {"cwd": ROOT, "env": {**os.environ, variable: value}, "capture_output": True, "text": True}
    done = subprocess.run(command, **options)
    assert done.returncode == 2
    assert re.search(rf"^error: {variable} must be unset or .*; got '{value}'$", done.stderr, re.MULTILINE)
    assert "Traceback" not in done.stderr


def test_a_name_that_cannot_be_printed(tmp_path):
    image = tmp_path / os.fsdecode(b"\xff.png")
    write_image(image, render_scene(shape=(180, 320), vehicles=0, random_state=0).image)
    boxes = tmp_path / "boxes.jsonl"
    result = run("detect", image, "--model", "highway", "--boxes", boxes, "--conf", 0)
    assert result.exit_code == 0
    assert "/?.png: " in result.stdout
    if boxes.read_text():
        assert r'"\\udcff.png"' in boxes.read_text()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
@pytest.mark.parametrize(("closed", "words"), [(">&-", "info"), ("2>&-", "detect road.png --model highway")])
def test_closed_outputs(tmp_path, closed, words):
    write_image(tmp_path / "road.png", render_scene(shape=(180, 320), vehicles=0, random_state=0).image)
    command = f"{shlex.quote(sys.executable)} -m vehicle_detection {words} {closed}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["sh", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError(), "error: memory ran out; close other programs"),
        (RuntimeError("can't start new thread"), "error: the system refuses to start another thread; close"),
        (OSError(errno.EIO, "Input/output error", "disk"), "error: disk: Input/output error\n"),
    ],
)
def test_errors_of_the_system_are_one_line(monkeypatch, clip, tmp_path, error, message):
    monkeypatch.setattr(detector.Detector, "search", failing(error))
    result = run("video", clip, "-o", tmp_path / "out.mp4", "--model", "highway")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert result.stderr.startswith(message)
    assert contents(tmp_path) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full of Linux")
@pytest.mark.parametrize("option", ["--version", "--help"])
def test_a_standard_output_on_a_full_disk(option):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "vehicle_detection", option]
        done = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "error: No space left on device\n")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ulimit")
def test_no_home_no_terminal_an_ascii_locale_and_a_gigabyte_of_memory(tmp_path):
    write_image(tmp_path / "é.png", render_scene(shape=(180, 320), vehicles=0, random_state=0).image)
    variables = {"HOME": "/nonexistent", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    # Each of its threads takes memory, and a machine with many cores starts many.
    variables |= {"TERM": "dumb", "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "2"}
    words = ["-m", "vehicle_detection", "detect", tmp_path / "é.png", "-o", tmp_path / "out"]
    limit = ["bash", "-c", 'ulimit -v 1200000; exec "$@"', "bash"]
    done = subprocess.run(
        [*limit, sys.executable, *words, "--model", "highway"],
        cwd="/",
        env={**os.environ, **variables},
        capture_output=True,
        stdin=subprocess.DEVNULL,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.split(b": ")[0].endswith(b"/??.png")
    assert contents(tmp_path / "out") == ["é.png"]


def test_a_cache_of_kernels_that_is_not_writable(monkeypatch):
    error = RuntimeError("cannot cache function 'add': no locator available for file 'kernels.py'")
    monkeypatch.setattr(numba.core.caching.FunctionCache, "__init__", failing(error))
    assert jit(lambda x: x + 1)(2) == 3
