"""Properties of video files."""

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import pytest
from imageio_ffmpeg import get_ffmpeg_exe

from tests.helpers import ROOT, StubDetector, failing, start_interruptible, wait_until
from tests.video.clips import NTSC, child_processes, ffmpeg, ffmpeg_log, gray_frames, write_clip
from vehicle_detection import TransientVideoError, VideoError, probe_video, process_video, read_frames
from vehicle_detection.video.ffmpeg import Process, check_resources, exit_reason, ffmpeg_binary
from vehicle_detection.video.probe import frame_rate


@pytest.mark.parametrize("fps", [NTSC, Fraction(60000, 1001), Fraction(24000, 1001), 25, 30, Fraction(25, 2)])
def test_probe_reads_the_exact_frame_rate(folder, fps):
    info = probe_video(write_clip(folder / "rate.mp4", gray_frames(10), fps=fps))
    assert info.fps == fps
    assert float(info.fps) == pytest.approx(float(fps))
    assert (info.frames, info.shape, info.constant_rate) == (10, (48, 64, 3), True)


def test_probe_reads_the_sound(clip, folder):
    info = probe_video(clip)
    assert (info.has_audio, info.audio_codec) == (True, "aac")
    assert info.duration == pytest.approx(20 / NTSC, abs=0.05)
    assert not probe_video(write_clip(folder / "silent.mp4", gray_frames(3))).has_audio


@pytest.mark.parametrize(
    ("aspect", "width"),
    [("4/3", 86), ("8/9", 56), ("3/1", 192), ("1/1", 64), ("4095/4096", 64), ("4/1", 64), ("0/1", 64)],
)
def test_frames_of_anamorphic_video_have_square_pixels(folder, aspect, width):
    path = write_clip(folder / "wide_pixels.mp4", gray_frames(4), options=["-vf", f"setsar={aspect}"])
    assert probe_video(path).shape == (48, width, 3)
    process_video(path, folder / "out.mp4", StubDetector())
    assert probe_video(folder / "out.mp4").shape == (48, width, 3)
    assert "SAR" not in ffmpeg_log(folder / "out.mp4").replace("SAR 1:1", "")


def test_anamorphic_video_is_turned_before_it_is_stretched(folder):
    flat = write_clip(folder / "flat.mp4", gray_frames(4), options=["-vf", "setsar=4/3"])
    ffmpeg("-display_rotation", 90, "-i", flat, "-c", "copy", folder / "turned.mp4")
    with read_frames(folder / "turned.mp4") as frames:
        assert {frame.shape for _, _, frame in frames} == {frames.info.shape} == {(64, 36, 3)}


@pytest.mark.parametrize(
    ("exact", "printed", "rate", "constant"),
    [
        ("30000/1001", "29.97", NTSC, True),
        ("30/1", "29.83", Fraction(30), False),
        ("1000/1", "24.51", Fraction(2451, 100), False),
        ("90000/1", "1k", Fraction(1000), False),
        ("0/0", "15", Fraction(15), True),
        ("25/1", None, Fraction(25), True),
        ("0/0", None, Fraction(25), False),
    ],
)
def test_frame_rates_from_the_log_of_ffmpeg(exact, printed, rate, constant):
    line = f"  Stream #0:0: Video: vp8, {printed} fps, 1k tbr" if printed else "  Stream #0:0: Video: vp8"
    assert frame_rate(f"config in time_base: 1/1000, frame_rate: {exact}", line) == (rate, constant)


def test_a_file_without_its_index(truncated):
    with pytest.raises(VideoError, match=r"its index is missing: .* is incomplete"):
        probe_video(truncated("cut_index.mp4"))


def test_files_without_video(folder, tmp_path, clip):
    names = "text.mp4", "empty.mp4", "sound.mp4", "no_frame.mp4", "cover.m4a", "still.png"
    text, empty, sound, no_frame, cover, still = (folder / name for name in names)
    text.write_text("not a video at all, but a text of some length\n" * 100)
    empty.touch()
    ffmpeg("-i", clip, "-vn", "-c:a", "copy", sound)
    ffmpeg("-i", clip, "-an", "-frames:v", 0, "-c:v", "libx264", no_frame)
    ffmpeg("-i", clip, "-frames:v", 1, still)
    both = ("-i", sound, "-i", still, "-map", 0, "-map", 1, "-c", "copy")
    ffmpeg(*both, "-disposition:v", "attached_pic", cover)
    for path, message in (
        (text, r"text.mp4 is a text file, not a video; choose the video"),
        (empty, r"empty.mp4 is not a video that ffmpeg can read"),
        (sound, r"sound.mp4 has no video track; choose"),
        (cover, r"cover.m4a has no video track; choose"),
        (no_frame, r"no_frame.mp4 (has no frame that can be decoded|has no video track|is not a video)"),
    ):
        with pytest.raises(VideoError, match=message):
            process_video(path, tmp_path / "out.mp4", StubDetector())
    assert os.listdir(tmp_path) == []


def test_a_missing_ffmpeg(clip, monkeypatch):
    monkeypatch.setattr("moviepy.config.FFMPEG_BINARY", "/nowhere/ffmpeg")
    with pytest.raises(VideoError, match=r"ffmpeg cannot be started .* reinstall imageio-ffmpeg"):
        probe_video(clip)


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), RuntimeError("can't start new thread")]
)
def test_an_ffmpeg_that_cannot_be_started_for_now(clip, monkeypatch, error):
    monkeypatch.setattr("subprocess.Popen", failing(error))
    with pytest.raises(TransientVideoError, match=r"ffmpeg cannot be started .*; close other programs, or"):
        probe_video(clip)


def test_a_platform_without_an_ffmpeg_of_imageio(clip, monkeypatch):
    monkeypatch.delitem(sys.modules, "moviepy.config", raising=False)
    monkeypatch.delenv("FFMPEG_BINARY", raising=False)
    fail = failing(RuntimeError("No ffmpeg exe could be found."))
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", fail)
    with pytest.raises(VideoError, match="no ffmpeg program was found; install ffmpeg, or set FFMPEG_BINARY"):
        probe_video(clip)


def test_the_ffmpeg_of_moviepy_is_used_without_importing_it(monkeypatch):
    monkeypatch.delitem(sys.modules, "moviepy.config", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: f"/found/{name}")
    monkeypatch.delenv("FFMPEG_BINARY", raising=False)
    assert ffmpeg_binary() == get_ffmpeg_exe()
    cases = {"ffmpeg-imageio": get_ffmpeg_exe(), "/own/ffmpeg": "/own/ffmpeg", "auto-detect": "/found/ffmpeg"}
    for variable, expected in cases.items():
        monkeypatch.setenv("FFMPEG_BINARY", variable)
        assert ffmpeg_binary() == expected
    assert "moviepy.config" not in sys.modules


@pytest.mark.skipif(sys.platform != "linux" or not shutil.which("setpriv"), reason="needs setpriv of Linux")
def test_ffmpeg_ends_with_a_killed_python(tmp_path):
    # An endless encoder that reads no pipe, as while ffmpeg writes the sound after the last frame.
    code = f"""
import signal, threading
from vehicle_detection.video.ffmpeg import Process
processes = []
def start():
    options = ("-re", "-f", "lavfi", "-i", "testsrc", {str(tmp_path / "out.mkv")!r})
    processes.append(Process(options))
thread = threading.Thread(target=start)
thread.start()
thread.join()  # the end of this thread must not end ffmpeg
print(processes[0]._popen.pid, flush=True)
signal.pause()
"""
    process = start_interruptible(sys.executable, "-c", code)
    child = int(process.stdout.readline())
    time.sleep(0.1)
    assert is_running(child)
    process.kill()
    process.communicate()
    wait_until(lambda: not is_running(child))


def is_running(number):
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_an_interrupt_while_ffmpeg_starts_leaves_no_process(clip, monkeypatch):
    def interrupt(self, timeout=None):
        monkeypatch.undo()
        raise KeyboardInterrupt

    probe_video(clip)
    before = child_processes()
    monkeypatch.setattr("concurrent.futures.Future.result", interrupt)
    with pytest.raises(KeyboardInterrupt):
        Process(("-f", "lavfi", "-i", "testsrc", "-f", "null", "-"))
    wait_until(lambda: child_processes() == before)


def test_a_full_folder_of_temporary_files_is_the_reason_for_an_empty_log(monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=4096))
    assert re.fullmatch("the folder of temporary files, .* is full; free some disk space", exit_reason(1, ""))
    assert exit_reason(1, "Invalid data") == "ffmpeg reports 'Invalid data'"


def test_reasons_of_signals():
    assert exit_reason(-signal.SIGKILL, "") == (
        "another process ended ffmpeg by the signal SIGKILL, perhaps because memory ran out"
    )
    if hasattr(signal, "SIGXFSZ"):
        assert "the limit of the system for the size of a file" in exit_reason(-signal.SIGXFSZ, "")


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of resources")
def test_a_crash_under_a_limit_of_memory_may_be_repeated(monkeypatch):
    import resource

    check_resources("clip.mp4", -signal.SIGSEGV, "")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10**9, 10**9))
    with pytest.raises(TransientVideoError, match=r"clip.mp4 cannot be read: ffmpeg has crashed .*ulimit"):
        check_resources("clip.mp4", -signal.SIGSEGV, "")


def test_a_title_that_looks_like_a_part_of_the_log(tmp_path):
    title = ["-metadata", "title=Stream mapping: demo"]
    path = write_clip(tmp_path / "clip.mp4", gray_frames(10), sound=True, options=title)
    info = probe_video(path)
    assert (info.frames, info.has_audio) == (10, True)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGCHLD")
def test_a_failed_encoder_whose_exit_code_the_system_drops(clip, tmp_path):
    """Files may not exceed 4 kB, so ffmpeg cannot write the video."""
    code = (
        "import resource, sys, vehicle_detection as vd; from tests.helpers import StubDetector;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096));"
        "vd.process_video(sys.argv[1], sys.argv[2], StubDetector(), progress=False)"
    )
    (tmp_path / "out.mp4").write_text("old")
    ignored = "signal.signal(signal.SIGCHLD, signal.SIG_IGN); signal.signal(signal.SIGXFSZ, signal.SIG_IGN)"
    start = f"import os, signal, sys; {ignored}; os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    command = [sys.executable, "-c", start, "-c", code, str(clip), str(tmp_path / "out.mp4")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert "out.mp4 cannot be written: ffmpeg" in done.stderr
    assert (tmp_path / "out.mp4").read_text() == "old"


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGCHLD")
def test_children_that_the_system_reaps(clip):
    """Some supervisors start programs with SIGCHLD ignored, so that no exit code is known."""
    code = "import sys, vehicle_detection; print(vehicle_detection.probe_video(sys.argv[1]).frames)"
    ignored = "signal.signal(signal.SIGCHLD, signal.SIG_IGN)"
    start = f"import os, signal, sys; {ignored}; os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    command = [sys.executable, "-c", start, "-c", code, str(clip)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("20\n", 0), done.stderr
