"""Threads, errors and interrupts."""

import contextlib
import gc
import os
import signal
import sys
import threading
import time
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers import StubDetector, start_interruptible
from tests.video.clips import (
    LEVELS,
    NTSC,
    child_processes,
    ffmpeg,
    frame_numbers,
    gray_frames,
    running_threads,
    write_clip,
)
from vehicle_detection import Detections, InvalidInputError, VideoError
from vehicle_detection.tracking import FrameResult, Track, TrackParams, interpolate_results
from vehicle_detection.video import (
    Encoding,
    FrameSource,
    engine,
    open_source,
    probe_video,
    process_video,
    read_frames,
    track,
    writing,
)
from vehicle_detection.video.engine import _QueuedFrame


def test_the_result_does_not_depend_on_the_number_of_workers(clip, tmp_path):
    outcomes = []
    for jobs in (1, 2, 5):
        target, results = tmp_path / f"{jobs}.mp4", []
        detector = StubDetector(pause=0.01)
        process_video(clip, target, detector, jobs=jobs, on_result=results.append)
        outcomes.append((target.read_bytes(), results))
    assert outcomes[0] == outcomes[1] == outcomes[2]


def test_memory_does_not_grow_with_the_length_of_the_video(tmp_path):
    source = write_clip(tmp_path / "long.mp4", gray_frames(20) * 4)
    alive, max_alive = 0, 0

    def freed():
        nonlocal alive
        alive -= 1

    class CountingDetector(StubDetector):
        def search(self, frame):
            nonlocal alive, max_alive
            alive += 1
            max_alive = max(max_alive, alive)
            weakref.finalize(frame, freed)
            return super().search(frame)

    process_video(source, tmp_path / "out.mp4", CountingDetector(), jobs=2)
    assert max_alive <= 6
    assert alive == 0


class ExpectedError(Exception):
    pass


@pytest.mark.parametrize("method", ["search", "track", "draw", "on_result"])
@pytest.mark.parametrize(("call", "jobs"), [(0, 3), (7, 1), (19, 2)])
def test_an_error_is_raised_unchanged_and_leaves_no_file(clip, tmp_path, method, call, jobs):
    target = tmp_path / "out.mp4"
    target.write_bytes(b"an existing file")
    error, calls = ExpectedError("unchanged"), []
    lock = threading.Lock()

    def fail(*args, **kwargs):
        with lock:
            calls.append(method)
            if len(calls) == call + 1:
                raise error
        return getattr(StubDetector, method)(stub, *args, **kwargs) if method != "on_result" else None

    stub = StubDetector()
    if method != "on_result":
        setattr(stub, method, fail)
    with pytest.raises(ExpectedError, match="unchanged") as caught:
        process_video(clip, target, stub, jobs=jobs, on_result=fail if method == "on_result" else None)
    assert caught.value is error
    assert os.listdir(tmp_path) == ["out.mp4"]
    assert target.read_bytes() == b"an existing file"


def test_a_killed_encoder_is_an_error(clip, tmp_path, monkeypatch):
    writers = []
    open_writer = writing.FrameWriter.__init__

    def remember(self, *args, **kwargs):
        writers.append(self)
        open_writer(self, *args, **kwargs)

    monkeypatch.setattr(writing.FrameWriter, "__init__", remember)

    def kill(result):
        if result.index == 5:
            os.kill(writers[0]._process._popen.pid, signal.SIGKILL)
            time.sleep(0.05)

    with pytest.raises(VideoError, match=r"out.mp4 cannot be written: another process .*SIGKILL"):
        process_video(clip, tmp_path / "out.mp4", StubDetector(), on_result=kill)
    assert os.listdir(tmp_path) == []


def test_an_encoder_that_does_not_start_is_an_error(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(Encoding, "_options", lambda *_: ["-c:v", "libx264", "-preset", "no such speed"])
    with pytest.raises(VideoError, match=r"out.mp4 cannot be written: ffmpeg reports"):
        process_video(clip, tmp_path / "out.mp4", StubDetector(), encoding=Encoding())
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("drawn", [None, np.zeros((48, 64), np.uint8), np.zeros((48, 64, 3))])
def test_a_drawing_of_another_shape_is_refused(clip, tmp_path, drawn):
    stub = StubDetector()
    stub.draw = lambda frame, result: drawn
    with pytest.raises(InvalidInputError, match=r"draw must return a \(48, 64, 3\) uint8 array"):
        process_video(clip, tmp_path / "out.mp4", stub)


def test_a_drawing_may_have_a_shape_of_its_own_and_any_order(clip, tmp_path):
    stub = StubDetector()
    stub.output_shape = lambda shape: (shape[0], shape[1] + 30, 3)
    stub.draw = lambda frame, result: np.asfortranarray(np.pad(frame, ((0, 0), (0, 30), (0, 0))))
    process_video(clip, tmp_path / "out.mp4", stub)
    assert probe_video(tmp_path / "out.mp4").shape == (48, 94, 3)
    with read_frames(tmp_path / "out.mp4") as frames:
        levels = [round((float(frame[8:-8, 8:56].mean()) - 10) / LEVELS) for _, _, frame in frames]
    assert levels == list(range(20))


INTERRUPTED = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
from tests.helpers import StubDetector
from vehicle_detection.video import process_video

def slow(result):
    if result.index == 3:
        tasks = Path("/proc/self/task").iterdir()
        print(*[(task / "children").read_text() for task in tasks], flush=True)
    time.sleep(0.3)

process_video(sys.argv[1], sys.argv[2], StubDetector(), on_result=slow)
"""


def test_ctrl_c_leaves_no_file_and_no_process(folder, tmp_path):
    # The frames do not all fit into the pipes, so both processes are running at the interrupt.
    source, target = folder / "large.mp4", tmp_path / "out.mp4"
    ffmpeg("-f", "lavfi", "-i", "testsrc=s=640x360:r=25", "-frames:v", 30, "-pix_fmt", "yuv420p", source)
    run = start_interruptible(sys.executable, "-c", INTERRUPTED, source, target)
    processes = [int(pid) for pid in run.stdout.readline().split()]
    names = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in processes]
    assert len(processes) == 2
    assert all(b"ffmpeg" in name for name in names), names
    os.killpg(run.pid, signal.SIGINT)  # to the process group, like a terminal
    _, errors = run.communicate(timeout=60)
    assert run.returncode == -signal.SIGINT
    assert errors.rstrip().endswith("KeyboardInterrupt")
    assert "Error" not in errors
    assert os.listdir(tmp_path) == []
    assert not [pid for pid in processes if Path(f"/proc/{pid}").exists()]


# Python ignores an interrupt inside a weak reference's callback.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_at_any_time_leaves_no_file_and_no_process(clip, tmp_path):
    # An alarm that raises the same as Ctrl-C: at another Exception, Thread.start would fail with a KeyError.
    def interrupt(number, frame):
        raise KeyboardInterrupt

    def nothing_is_left():
        unfinished = [name for name in os.listdir(tmp_path) if name != "out.mp4"]
        return child_processes() == before and not unfinished and not running_threads()

    before, earlier = child_processes(), signal.signal(signal.SIGALRM, interrupt)
    try:
        for step in range(15):
            with contextlib.suppress(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, 0.003 + 0.009 * step)
                process_video(clip, tmp_path / "out.mp4", StubDetector())
                signal.setitimer(signal.ITIMER_REAL, 0)
            deadline = time.monotonic() + 60
            while not nothing_is_left():  # nobody waits for a process that is being started
                assert time.monotonic() < deadline
                gc.collect()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, earlier)


class IntervalStub(StubDetector):
    """Need not search every frame; its results have no tracks to interpolate."""

    searches_every_frame = False

    def __init__(self):
        super().__init__()
        self.searched, self.steps = [], []

    def search(self, frame):
        found = super().search(frame)
        self.searched.append(round((found - 10) / LEVELS))
        return found

    def track(self, found, *, time, frames, cut):
        self.steps.append((frames, cut))
        result = super().track(found, time=time, frames=frames, cut=cut)
        return FrameResult(result.index, time, Detections.empty(), Detections.empty(), ())


class ReducingStub(StubDetector):
    """Searches frames of half the size; the result says by which factor they were reduced."""

    def reduction(self, shape):
        return 2

    def search(self, frame):
        brightness = super().search(frame)
        return SimpleNamespace(enlarged=lambda factor: brightness + factor)


@pytest.mark.parametrize("draw", [True, False])
def test_a_search_that_reduces_frames_gets_reduced_ones(clip, tmp_path, draw):
    detector, found = ReducingStub(), []
    target = tmp_path / "out.mp4" if draw else None
    process_video(clip, target, detector, on_result=lambda result: found.append(result.brightness))
    assert detector.shapes == {(24, 32, 3)}
    assert found == pytest.approx([12 + LEVELS * n for n in range(20)], abs=2)


@pytest.mark.parametrize("jobs", [1, 3])
@pytest.mark.parametrize("interval", [1, 2, 3, 50])
def test_frames_between_the_searched_ones_are_interpolated(clip, tmp_path, interval, jobs):
    target, results = tmp_path / "out.mp4", []
    detector = IntervalStub()
    report = process_video(clip, target, detector, every=interval, jobs=jobs, on_result=results.append)
    frames = report.frames
    assert sorted(detector.searched) == list(range(0, frames, interval))
    assert detector.steps == [(1, False)] + [(interval, False)] * (len(detector.searched) - 1)
    assert [result.index for result in results] == list(range(frames))
    assert [result.time for result in results] == pytest.approx(np.arange(frames) / float(NTSC))
    assert frame_numbers(target) == list(range(frames))
    assert [result.searched for result in results] == [n % interval == 0 for n in range(frames)]


@pytest.mark.parametrize(("fps", "interval"), [(10, 1), (NTSC, 2), (60, 5)])
def test_a_video_is_searched_twelve_times_a_second(tmp_path, fps, interval):
    source, detector = write_clip(tmp_path / "clip.mp4", gray_frames(11), fps=fps), IntervalStub()
    process_video(source, None, detector)
    assert sorted(detector.searched) == list(range(0, 11, interval))
    detector.searched.clear()
    detector.searches_every_frame = True
    process_video(source, None, detector)
    assert sorted(detector.searched) == list(range(11))


def test_the_first_frame_of_a_scene_is_searched(tmp_path):
    # Two scenes, each with a pattern of its own.
    patterns = {level: np.random.default_rng(level).permutation([-15, 15] * 24) for level in (20, 200)}
    scenes = {n: (n + each.reshape(6, 8, 1)).repeat(8, 0).repeat(8, 1) for n, each in patterns.items()}
    levels = [20] * 4 + [200] * 3 + [20] * 4
    frames = [scenes[level].repeat(3, axis=2).astype(np.uint8) for level in levels]
    detector = IntervalStub()
    detector.search = lambda frame: detector.searched.append(int(frame.mean())) or float(frame.mean())
    results = []
    source = write_clip(tmp_path / "cuts.mp4", frames)
    process_video(source, None, detector, jobs=1, every=3, on_result=results.append)
    # Frames 0 and 3; the cuts at 4 and 7; and 10.
    assert [round(level, -1) for level in detector.searched] == [20, 20, 200, 20, 20]
    assert [cut for _, cut in detector.steps] == [False, False, True, True, False]
    assert [result.index for result in results] == list(range(11))


def test_a_stop_before_the_first_frame_ends_the_run(clip):
    with track(clip, StubDetector()) as results:
        results.stop()
        assert list(results) == []


class DelayedDetector(StubDetector):
    """Confirms its track in the fourth searched frame, and lets a run hold three back."""

    track_params = TrackParams(backfill=0.21)  # 3.1 searched frames

    def track(self, found, *, time, frames, cut):
        index = super().track(found, time=time, frames=frames, cut=cut).index
        number = int(index >= 6)
        state = "confirmed" if number else "tentative"
        track = Track(
            id=number, key=1, box=np.array([5.0, 5, 9, 9]), score=1.0, state=state, shown=bool(number),
            age=time, misses=0, time_since_update=0.0, velocity=(0.0, 0.0),
        )  # fmt: skip
        return FrameResult(index, time, Detections.empty(), Detections.empty(), (track,))


@pytest.mark.parametrize("live", [False, True])
def test_searched_frames_are_held_back_for_tracks_that_are_confirmed_later(clip, monkeypatch, live):
    """Those of live sources are not."""
    monkeypatch.setattr(FrameSource, "live", live)
    with track(clip, DelayedDetector(), every=2) as results:
        shown = [len(result.shown) for result in results]
    assert shown == ([0] * 5 + [1] * 15 if live else [1] * 20)


@pytest.mark.parametrize("live", [False, True])
def test_a_live_frame_is_taken_when_its_search_can_begin(clip, monkeypatch, live):
    """While two searches run; until then, newer frames may take its place."""
    frames, during, released = [], [], threading.Event()

    class Counted(engine.SceneCuts):
        def update(self, frame):
            frames.append(frame)
            return super().update(frame)

    class Blocked(StubDetector):
        def search(self, frame):
            released.wait(60)
            return super().search(frame)

    def release():
        during.append(len(frames))
        released.set()

    monkeypatch.setattr(FrameSource, "live", live)
    monkeypatch.setattr(engine, "SceneCuts", Counted)
    timer = threading.Timer(1.0, release)
    timer.start()
    with track(clip, Blocked(), jobs=2) as results:
        assert len(list(results)) == 20
    assert during[0] <= 2 if live else during[0] > 2


def test_a_run_that_ends_before_its_first_frame_keeps_the_target(clip, tmp_path):
    target = tmp_path / "out.mp4"
    target.write_bytes(b"old")

    class Empty(FrameSource):
        def read(self, first=0, count=None):
            reader = open_source(clip).read()
            reader.kill()  # as the user does while a camera starts
            return reader

    with pytest.raises(VideoError, match="no frame was read, so no video was written"):
        process_video(Empty("camera", probe_video(clip)), target, StubDetector())
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.mp4"]


@pytest.mark.parametrize("draw", [True, False])
def test_frames_that_are_not_searched_are_kept_only_to_be_drawn(clip, tmp_path, monkeypatch, draw):
    def queued():
        frames = [each for each in gc.get_objects() if type(each) is _QueuedFrame]
        return sum(each.frame is not None for each in frames)

    def count(*arguments):
        nonlocal alive
        alive = queued() - earlier
        return interpolate_results(*arguments)

    gc.collect()
    alive, earlier = 0, queued()  # an interrupted run of another test may have left some

    monkeypatch.setattr(engine, "interpolate_results", count)
    report = process_video(clip, tmp_path / "out.mp4" if draw else None, IntervalStub(), every=1000)
    assert report.frames == 20
    assert alive == (19 if draw else 0)


def test_a_detector_that_another_run_has_taken_over_is_an_error(clip):
    detector = StubDetector()
    first, second = track(clip, detector), track(clip, detector)
    next(first)
    assert next(second).index == 0
    with pytest.raises(InvalidInputError, match=r"another run has begun .* pass copy.copy\(detector\)"):
        next(first)
    assert list(first) == []
    assert len(list(second)) == probe_video(clip).frames - 1
    assert len(list(track(clip, detector))) == probe_video(clip).frames
