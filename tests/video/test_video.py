import contextlib
import gc
import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moviepy import VideoFileClip
from moviepy.config import FFMPEG_BINARY

from tests.helpers import ROOT, StubDetector
from vehicle_detection.errors import InvalidInputError, VideoError
from vehicle_detection.video import VideoReport, probe_video, process_video, read_frames
from vehicle_detection.video import ffmpeg as _ffmpeg
from vehicle_detection.video import process as video

LEVELS = 10  # gray levels between one frame of a test clip and the next: far beyond what the codec blurs
NTSC = Fraction(30000, 1001)


def ffmpeg(*options, data=None):
    command = [FFMPEG_BINARY, "-v", "error", "-y", *map(str, options)]
    return subprocess.run(command, input=data, capture_output=True, check=True).stdout


def write_clip(path, frames, *, fps=25, sound=False, before=(), options=()):
    height, width = frames[0].shape[:2]
    picture = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", fps, "-i", "pipe:0"]
    tone = ["-f", "lavfi", "-t", float(len(frames) / Fraction(fps)), "-i", "sine=440"] if sound else []
    coded = ["-c:v", "libx264", "-preset", "ultrafast", "-crf", 4, "-pix_fmt", "yuv420p"]
    ffmpeg(
        *picture, *before, *tone, *coded, *options, path, data=b"".join(frame.tobytes() for frame in frames)
    )
    return path


def gray_frames(count, width=64, height=48):
    return [np.full((height, width, 3), 10 + LEVELS * n, np.uint8) for n in range(count)]


def frame_numbers(path):
    """Tell which frames of `gray_frames` a video holds, from their brightness."""
    with read_frames(path) as frames:
        return [round((float(frame[8:-8, 8:-8].mean()) - 10) / LEVELS) for _, _, frame in frames]


def children():
    tasks = Path("/proc/self/task")
    if not tasks.is_dir():
        pytest.skip("no /proc here to look for processes in")
    found = set()
    for task in tasks.iterdir():
        with contextlib.suppress(FileNotFoundError):  # a thread that has ended meanwhile
            found.update((task / "children").read_text().split())
    return found


def workers_alive():
    return [thread for thread in threading.enumerate() if thread.name.startswith("vehicle-")]


def file_facts(path):
    """Return what ffmpeg says of a file."""
    command = [FFMPEG_BINARY, "-hide_banner", "-i", str(path)]
    return subprocess.run(command, capture_output=True, text=True).stderr


def sound_seconds(path):
    return len(ffmpeg("-i", path, "-map", "0:a:0", "-f", "s16le", "-ac", 1, "-ar", 8000, "-")) / 16000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("clips")


@pytest.fixture(scope="module")
def clip(folder):
    return write_clip(folder / "clip.mp4", gray_frames(20), fps=NTSC, sound=True)


@pytest.fixture(scope="module")
def picture():
    """A frame whose four corners differ."""
    image = np.full((48, 64, 3), 40, np.uint8)
    image[:24, :32], image[:24, 32:], image[24:, :32] = (220, 40, 40), (40, 200, 40), (40, 40, 220)
    return image


@pytest.fixture(autouse=True)
def nothing_left():
    before = children()
    yield
    gc.collect()
    assert children() == before
    assert not workers_alive()


# --- facts of a file ---


@pytest.mark.parametrize("fps", [NTSC, Fraction(60000, 1001), Fraction(24000, 1001), 25, 30, Fraction(25, 2)])
def test_probe_tells_the_exact_rate(folder, fps):
    info = probe_video(write_clip(folder / "rate.mp4", gray_frames(10), fps=fps))
    assert info.fps == fps
    assert float(info.fps) == pytest.approx(float(fps))
    assert (info.frames, info.shape, info.constant_rate) == (10, (48, 64, 3), True)


def test_probe_tells_sound(clip, folder):
    info = probe_video(clip)
    assert info.has_audio
    assert info.audio_codec == "aac"
    assert info.duration == pytest.approx(20 / NTSC, abs=0.05)
    assert not probe_video(write_clip(folder / "silent.mp4", gray_frames(3))).has_audio


@pytest.mark.parametrize(("degrees", "turns"), [(90, 1), (180, 2), (-90, 3)])
def test_rotated_video_is_read_and_written_upright(folder, picture, degrees, turns):
    flat = write_clip(folder / "flat.mp4", [picture] * 4)
    turned = folder / f"turned{turns}.mp4"
    ffmpeg("-display_rotation", degrees, "-i", flat, "-c", "copy", turned)
    upright = np.rot90(picture, turns)
    info = probe_video(turned)
    assert info.shape == upright.shape
    assert info.rotation == -degrees % 360
    stub, target = StubDetector(), folder / "upright.mp4"
    process_video(turned, target, stub)
    assert stub.shapes == {upright.shape}
    assert probe_video(target).rotation == 0
    for path in (turned, target):
        with read_frames(path) as frames:
            _, _, frame = next(frames)
        assert np.abs(frame[12::8, 12::8].astype(int) - upright[12::8, 12::8]).max() < 20


def test_portrait_video_of_a_phone(folder):
    flat = folder / "wide.mp4"
    ffmpeg("-f", "lavfi", "-i", "testsrc=s=160x90:r=30", "-frames:v", 10, "-pix_fmt", "yuv420p", flat)
    phone = folder / "phone.mov"
    ffmpeg("-display_rotation", -90, "-i", flat, "-c", "copy", phone)
    report = process_video(phone, folder / "phone.mp4", StubDetector())
    assert report.shape == (160, 90, 3)
    assert probe_video(folder / "phone.mp4").shape == (160, 90, 3)


def test_anamorphic_pixels_are_kept(folder):
    path = write_clip(folder / "wide_pixels.mp4", gray_frames(4), options=["-vf", "setsar=4/3"])
    assert probe_video(path).pixel_aspect == Fraction(4, 3)
    process_video(path, folder / "out.mp4", StubDetector())
    assert probe_video(folder / "out.mp4").pixel_aspect == Fraction(4, 3)


# --- frames out ---


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # moviepy leaves pipes open
def test_frames_equal_those_of_moviepy_but_for_its_rounding(folder):
    path = folder / "pattern.mp4"
    ffmpeg("-f", "lavfi", "-i", "testsrc2=s=160x90:r=25", "-frames:v", 12, "-pix_fmt", "yuv420p", path)
    with VideoFileClip(str(path), audio=False) as moviepy_clip, read_frames(path) as frames:
        for (index, seconds, frame), reference in zip(frames, moviepy_clip.iter_frames(), strict=True):
            assert seconds == index / 25
            assert frame.flags.owndata
            assert frame.flags.writeable
            # moviepy's ffmpeg rounds down, and a step in luma and two in chroma add up.
            difference = frame.astype(int) - reference
            assert np.abs(difference).max() <= 4
            assert -1 <= difference.mean() <= 2


@settings(max_examples=12)
@given(st.integers(0, 19), st.integers(0, 30), st.sampled_from([0.0, 0.3, 0.9]))
def test_a_span_holds_the_frames_of_its_time(clip, first, length, part):
    start = max(0.0, float((first - part) / NTSC))
    end = float((first + length + 0.5) / NTSC)
    with read_frames(clip, start=start, end=end) as frames:
        found = [(index, round((float(frame.mean()) - 10) / LEVELS)) for index, _, frame in frames]
    expected = [n for n in range(20) if start - 1e-6 <= n / NTSC < end]
    assert found == [(n, n) for n in expected]


def test_frames_of_a_video_that_starts_after_its_sound(folder):
    late = folder / "late.mp4"
    flat = write_clip(folder / "flat_late.mp4", gray_frames(10))
    tone = ["-f", "lavfi", "-t", 1, "-i", "sine=440"]
    ffmpeg("-itsoffset", 0.4, "-i", flat, *tone, "-map", "0:v", "-map", "1:a", "-c:v", "copy", late)
    assert probe_video(late).first_time == pytest.approx(0.4, abs=0.03)
    target = folder / "late_out.mp4"
    process_video(late, target, StubDetector())
    assert frame_numbers(target) == list(range(10))
    assert probe_video(target).first_time == pytest.approx(0.4, abs=0.03)
    with read_frames(late, start=0.2, end=0.3) as frames:
        assert [index for index, _, _ in frames] == [5, 6, 7]
    process_video(late, target, StubDetector(), start=0.2)
    assert frame_numbers(target) == [5, 6, 7, 8, 9]
    assert sound_seconds(target) == pytest.approx(0.4, abs=0.06)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_varying_rate_becomes_constant(folder, suffix):
    # Frames 0-9 of 10 a second, then every third: what a phone does in the dark.
    path = folder / f"vfr.{suffix}"
    thin = ["-vf", r"select=lt(n\,10)+not(mod(n\,3))", "-fps_mode", "vfr", "-bf", 0]
    write_clip(path, gray_frames(22), fps=10, options=thin)
    info = probe_video(path)
    assert not info.constant_rate
    assert info.fps == 10
    shown = [*range(10), 9, 9, 12, 12, 12, 15, 15, 15, 18, 18, 18, 21]
    report = process_video(path, folder / "cfr.mp4", StubDetector())
    assert frame_numbers(folder / "cfr.mp4") == shown
    assert report.frames == 22
    assert probe_video(folder / "cfr.mp4").constant_rate
    for start in (3, 10, 11, 12, 20):
        with read_frames(path, start=start / 10, end=start / 10 + 0.2) as frames:
            assert [index for index, _, _ in frames] == [start, start + 1]
        process_video(path, folder / "part.mp4", StubDetector(), start=start / 10)
        assert frame_numbers(folder / "part.mp4") == shown[start:]


def test_ffmpeg_ends_on_every_way_out(clip):
    before = children()
    for leave in ("break", "with", "close", "drop", "error"):
        frames = read_frames(clip)
        next(frames)
        assert len(children() - before) == 1
        if leave == "with":
            with frames:
                next(frames)
        elif leave == "close":
            frames.close()
            assert list(frames) == []
        elif leave == "break":
            for _ in frames:
                break
            del frames
            gc.collect()
        elif leave == "drop":
            del frames
            gc.collect()
        else:
            with pytest.raises(ZeroDivisionError), frames:
                raise ZeroDivisionError
        assert children() == before, leave


# --- video in, video out ---


def test_a_whole_video_keeps_frames_rate_and_sound(clip, tmp_path):
    target = tmp_path / "out.mp4"
    results = []
    stub = StubDetector()
    report = process_video(clip, target, stub, on_result=results.append)
    assert frame_numbers(target) == list(range(20))
    assert [result.index for result in results] == list(range(20))
    assert [result.time for result in results] == pytest.approx([float(n / NTSC) for n in range(20)])
    assert stub.fps == float(NTSC)
    info = probe_video(target)
    assert (info.fps, info.frames, info.shape) == (NTSC, 20, (48, 64, 3))
    facts = file_facts(target)
    assert re.search(r"Video: h264.*yuv420p\(tv, smpte170m/bt709/bt709, .*29\.97 fps, 29\.97 tbr", facts), (
        facts
    )
    sound = [ffmpeg("-i", path, "-map", "0:a", "-c", "copy", "-f", "md5", "-") for path in (clip, target)]
    assert sound[0] == sound[1]
    data = target.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with read_frames(target) as frames:
        assert all(frame[2, 2].min() > 200 for _, _, frame in frames)
    assert (report.frames, report.fps, report.shape, report.tracks) == (20, NTSC, (48, 64, 3), 4)
    assert list(report.stages) == ["decode", "search", "heat", "track", "draw", "encode"]
    assert report.stages["heat"] == pytest.approx(0.02)
    assert min(report.stages.values()) > 0
    assert sum(report.shares.values()) == pytest.approx(1)
    assert os.listdir(tmp_path) == ["out.mp4"]
    assert target.stat().st_mode & 0o444 == 0o444


@pytest.mark.parametrize("suffix", [".mov", ".mkv", ".MP4", ".m4v"])
def test_other_containers(clip, tmp_path, suffix):
    target = tmp_path / f"out{suffix}"
    process_video(clip, target, StubDetector())
    assert frame_numbers(target) == list(range(20))
    assert probe_video(target).has_audio


def test_a_part_of_a_video_with_its_sound(clip, tmp_path):
    target = tmp_path / "out.mp4"
    report = process_video(clip, target, StubDetector(), start=float(5 / NTSC), end=float(15 / NTSC))
    assert report.frames == 10
    assert frame_numbers(target) == list(range(5, 15))
    assert sound_seconds(target) == pytest.approx(float(10 / NTSC), abs=0.03)


def test_an_end_beyond_the_video_is_its_end(clip, tmp_path):
    assert process_video(clip, tmp_path / "out.mp4", StubDetector(), start=0.5, end=1e3).frames == 5


def test_sound_can_be_left_out(clip, tmp_path):
    process_video(clip, tmp_path / "out.mp4", StubDetector(), audio=False)
    assert not probe_video(tmp_path / "out.mp4").has_audio


def test_sound_that_mp4_cannot_hold_is_encoded(clip, tmp_path):
    source = tmp_path / "in.mkv"
    ffmpeg("-i", clip, "-c:v", "copy", "-c:a", "pcm_s16le", source)
    process_video(source, tmp_path / "out.mp4", StubDetector())
    assert probe_video(tmp_path / "out.mp4").audio_codec == "aac"
    assert sound_seconds(tmp_path / "out.mp4") == pytest.approx(20 / NTSC, abs=0.06)
    assert frame_numbers(tmp_path / "out.mp4") == list(range(20))


@pytest.mark.parametrize(("width", "height"), [(63, 48), (64, 47), (63, 47)])
def test_odd_sizes_grow_by_one_pixel(tmp_path, width, height):
    image = np.full((height, width, 3), (200, 120, 40), np.uint8)
    options = ["-pix_fmt", "yuv444p"]
    source = write_clip(tmp_path / "odd.mp4", [image] * 4, options=options)
    stub = StubDetector()
    report = process_video(source, tmp_path / "even.mp4", stub)
    assert report.shape == (height, width, 3)
    assert stub.shapes == {(height, width, 3)}
    with read_frames(tmp_path / "even.mp4") as frames:
        _, _, frame = next(frames)
    assert frame.shape == (height + height % 2, width + width % 2, 3)
    assert np.abs(frame[-1, 8:].astype(int) - (200, 120, 40)).max() < 10
    assert np.abs(frame[8:, -1].astype(int) - (200, 120, 40)).max() < 10


@pytest.mark.parametrize(
    ("pixels", "space", "range_"),
    [
        ("yuv420p", "bt709", "tv"),
        ("yuv420p", "smpte170m", "tv"),
        ("yuv420p", "bt2020nc", "tv"),
        ("yuvj420p", "bt709", "pc"),
        ("yuv444p", "bt709", "tv"),
        ("yuv420p", "smpte240m", "tv"),
    ],
)
def test_frames_have_the_colors_that_ffmpeg_sees(tmp_path, pixels, space, range_):
    # Smooth, so that a chroma value that is spread in another way changes nothing.
    y, x = np.mgrid[:96, :128]
    picture = np.stack([60 + x, 40 + 2 * y, 250 - x - y // 2], axis=2).astype(np.uint8)
    matrix = f"scale=out_color_matrix={space}:out_range={range_},format={pixels}"
    tags = ["-pix_fmt", pixels, "-colorspace", space, "-color_range", range_]
    source = write_clip(tmp_path / "in.mp4", [picture] * 2, options=["-vf", matrix, *tags])
    with read_frames(source) as frames:
        found = [frame for _, _, frame in frames]
    decoded = ffmpeg("-i", source, "-frames:v", 1, "-pix_fmt", "rgb24", "-f", "rawvideo", "-")
    expected = np.frombuffer(decoded, np.uint8).reshape(picture.shape)
    assert np.abs(found[0].astype(int) - expected).max() <= 4
    assert np.abs(found[0].astype(int) - picture).mean() < 3


def test_colors_survive(tmp_path):
    # Another matrix than the one that the file names would be off by 15 and more.
    colors = [(220, 40, 40), (40, 200, 40), (40, 40, 220), (230, 230, 30), (128, 128, 128)]
    source = write_clip(tmp_path / "in.mp4", [np.full((48, 64, 3), rgb, np.uint8) for rgb in colors])
    process_video(source, tmp_path / "out.mp4", StubDetector())
    with read_frames(tmp_path / "out.mp4") as frames:
        for (_, _, frame), rgb in zip(frames, colors, strict=True):
            assert np.abs(frame[16:, 16:].mean(axis=(0, 1)) - rgb).max() < 6


def test_without_a_target_only_results(clip, tmp_path):
    results = []
    stub = StubDetector()
    stub.annotate = lambda frame, result: pytest.fail("nothing is to be drawn")
    report = process_video(clip, None, stub, on_result=results.append)
    assert len(results) == report.frames == 20
    assert list(report.stages) == ["decode", "search", "heat", "track"]
    assert report.stages["search"] > 0


def test_the_number_of_workers_changes_nothing(clip, tmp_path):
    outcomes = []
    for workers in (1, 2, 5):
        target, results = tmp_path / f"{workers}.mp4", []
        detector = StubDetector(pause=0.01)
        process_video(clip, target, detector, workers=workers, on_result=results.append)
        outcomes.append((target.read_bytes(), results))
    assert outcomes[0] == outcomes[1] == outcomes[2]


def test_memory_does_not_grow_with_the_video(tmp_path):
    source = write_clip(tmp_path / "long.mp4", gray_frames(20) * 4)
    alive, most = 0, 0

    def gone():
        nonlocal alive
        alive -= 1

    class Watching(StubDetector):
        def search(self, frame):
            nonlocal alive, most
            alive += 1
            most = max(most, alive)
            weakref.finalize(frame, gone)
            return super().search(frame)

    process_video(source, tmp_path / "out.mp4", Watching(), workers=2)
    assert most <= 6
    assert alive == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # moviepy leaves pipes open
def test_an_image_transform_of_moviepy_can_be_a_detector(clip, tmp_path):
    target = tmp_path / "moviepy.mp4"
    with VideoFileClip(str(clip)) as source:
        source.image_transform(StubDetector()).write_videofile(
            str(target), preset="ultrafast", logger=None, temp_audiofile_path=str(tmp_path)
        )
    assert frame_numbers(target) == list(range(20))


def test_progress_shows_on_a_terminal_alone(clip, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    shown = {}
    for name, stream, progress in (("terminal", Terminal(), True), ("off", Terminal(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        process_video(clip, None, StubDetector(), progress=progress)
        shown[name] = stream.getvalue()
    monkeypatch.setattr(sys, "stderr", file := io.StringIO())
    process_video(clip, None, StubDetector())
    assert "20/20" in shown["terminal"]
    assert shown["off"] == file.getvalue() == ""


def test_a_report_without_frames_divides_by_nothing():
    report = VideoReport(
        frames=0, fps=Fraction(25), shape=(2, 2, 3), seconds=0.0, stages={"draw": 0.0}, tracks=1
    )
    assert report.shares == {"draw": 0.0}
    assert "1 vehicle" in str(report)


# --- errors on the way ---


class TroubleError(Exception):
    pass


@pytest.mark.parametrize("place", ["search", "follow", "annotate", "on_result"])
@pytest.mark.parametrize(("moment", "workers"), [(0, 3), (7, 1), (19, 2)])
def test_an_error_surfaces_as_it_is_and_leaves_nothing(clip, tmp_path, place, moment, workers):
    target = tmp_path / "out.mp4"
    target.write_bytes(b"an earlier file")
    trouble, calls = TroubleError("as it is"), []
    lock = threading.Lock()

    def fail(*args, **kwargs):
        with lock:
            calls.append(place)
            if len(calls) == moment + 1:
                raise trouble
        return getattr(StubDetector, place)(stub, *args, **kwargs) if place != "on_result" else None

    stub = StubDetector()
    if place != "on_result":
        setattr(stub, place, fail)
    with pytest.raises(TroubleError, match="as it is") as caught:
        process_video(clip, target, stub, workers=workers, on_result=fail if place == "on_result" else None)
    assert caught.value is trouble
    assert os.listdir(tmp_path) == ["out.mp4"]
    assert target.read_bytes() == b"an earlier file"
    assert not workers_alive()


def test_an_encoder_that_dies_is_an_error(clip, tmp_path, monkeypatch):
    writers = []
    opened = video.FrameWriter.__init__

    def remember(self, *args, **kwargs):
        writers.append(self)
        opened(self, *args, **kwargs)

    monkeypatch.setattr(video.FrameWriter, "__init__", remember)

    def kill(result):
        if result.index == 5:
            os.kill(writers[0]._process._popen.pid, signal.SIGKILL)
            time.sleep(0.05)

    with pytest.raises(VideoError, match="cannot be written: ffmpeg says"):
        process_video(clip, tmp_path / "out.mp4", StubDetector(), on_result=kill)
    assert os.listdir(tmp_path) == []


def test_an_encoder_that_refuses_is_an_error(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "PRESETS", ("no such speed",))
    with pytest.raises(VideoError, match="cannot be written: ffmpeg says"):
        process_video(clip, tmp_path / "out.mp4", StubDetector(), preset="no such speed")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("drawn", [None, np.zeros((48, 64), np.uint8), np.zeros((48, 64, 3))])
def test_a_drawing_of_another_shape_is_refused(clip, tmp_path, drawn):
    stub = StubDetector()
    stub.annotate = lambda frame, result: drawn
    with pytest.raises(InvalidInputError, match=r"annotate must return a \(48, 64, 3\) uint8 array"):
        process_video(clip, tmp_path / "out.mp4", stub)


def test_a_drawing_that_is_not_contiguous_is_taken(clip, tmp_path):
    stub = StubDetector()
    stub.annotate = lambda frame, result: np.asfortranarray(frame)
    process_video(clip, tmp_path / "out.mp4", stub)
    assert frame_numbers(tmp_path / "out.mp4") == list(range(20))


INTERRUPTED = """
import sys, time
from pathlib import Path
from vehicle_detection.video import process_video

def slow(result):
    if result.index == 3:
        tasks = Path("/proc/self/task").iterdir()
        print(*[(task / "children").read_text() for task in tasks], flush=True)
    time.sleep(0.3)

process_video(sys.argv[1], sys.argv[2], StubDetector(), on_result=slow)
"""


def test_ctrl_c_leaves_no_file_and_no_process(folder, tmp_path):
    # Frames that do not all fit into the pipes: both processes run when the signal comes.
    source, target = folder / "large.mp4", tmp_path / "out.mp4"
    ffmpeg("-f", "lavfi", "-i", "testsrc=s=640x360:r=25", "-frames:v", 30, "-pix_fmt", "yuv420p", source)
    run = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(source), str(target)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    processes = [int(pid) for pid in run.stdout.readline().split()]
    names = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in processes]
    assert len(processes) == 2
    assert all(b"ffmpeg" in name for name in names), names
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does: to the whole foreground group
    _, errors = run.communicate(timeout=10)
    assert run.returncode == -signal.SIGINT
    assert errors.rstrip().endswith("KeyboardInterrupt")
    assert "Error" not in errors
    assert os.listdir(tmp_path) == []
    assert not [pid for pid in processes if Path(f"/proc/{pid}").exists()]


def test_an_interrupt_at_any_moment_leaves_nothing(clip, tmp_path):
    # An alarm instead of Ctrl-C: pytest has its own way with that. Both raise in the main thread, anywhere.
    def ring(number, frame):
        raise TroubleError

    before, earlier = children(), signal.signal(signal.SIGALRM, ring)
    try:
        for step in range(15):
            with contextlib.suppress(TroubleError):
                signal.setitimer(signal.ITIMER_REAL, 0.003 + 0.009 * step)
                process_video(clip, tmp_path / "out.mp4", StubDetector())
                signal.setitimer(signal.ITIMER_REAL, 0)
            for _ in range(100):  # a process that was still being started is not waited for
                gc.collect()
                left = [name for name in os.listdir(tmp_path) if name != "out.mp4"]
                if children() == before and not left and not workers_alive():
                    break
                time.sleep(0.01)
            assert not left
            assert children() == before
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, earlier)


# --- bad input ---


@pytest.fixture
def cut(folder):
    pattern = ["-f", "lavfi", "-i", "testsrc2=s=160x90:r=25", "-frames:v", 100, "-pix_fmt", "yuv420p"]

    def make(name, *options):
        whole = folder / f"whole_{name}"
        ffmpeg(*pattern, *options, whole)
        path = folder / name
        path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 55 // 100])
        return path

    return make


@pytest.mark.parametrize(
    ("name", "options"), [("cut.mp4", ["-movflags", "+faststart", "-g", 10]), ("cut.mkv", [])]
)
def test_a_cut_file_tells_how_much_is_there(cut, tmp_path, name, options):
    source, target = cut(name, *options), tmp_path / "out.mp4"
    target.write_bytes(b"an earlier file")
    message = r"is cut off: (\d+) of about 100 frames can be decoded; .* pass end=([\d.]+)"
    with pytest.raises(VideoError, match=message) as caught:
        process_video(source, target, StubDetector())
    assert target.read_bytes() == b"an earlier file"
    frames, end = re.search(message, str(caught.value)).groups()
    assert 20 < int(frames) < 90
    # The remedy works, and takes all that is there.
    assert process_video(source, target, StubDetector(), end=float(end)).frames == int(frames)


def test_a_file_cut_off_before_its_index(cut):
    with pytest.raises(VideoError, match=r"its index is missing: .* was cut off"):
        probe_video(cut("cut_index.mp4"))


def test_content_that_is_no_video(folder, tmp_path, clip):
    text = folder / "text.mp4"
    text.write_text("not a video at all, but a text of some length\n" * 100)
    empty = folder / "empty.mp4"
    empty.write_bytes(b"")
    sound = folder / "sound.mp4"
    ffmpeg("-i", clip, "-vn", "-c:a", "copy", sound)
    no_frame = folder / "no_frame.mp4"
    ffmpeg("-i", clip, "-an", "-frames:v", 0, "-c:v", "libx264", no_frame)
    cover = folder / "cover.m4a"
    still = folder / "still.png"
    ffmpeg("-i", clip, "-frames:v", 1, still)
    ffmpeg(
        "-i", sound, "-i", still, "-map", 0, "-map", 1, "-c", "copy", "-disposition:v", "attached_pic", cover
    )
    for path, message in (
        (text, r"text.mp4 is no video that ffmpeg can read \(.*\); record or copy it again"),
        (empty, r"empty.mp4 is no video that ffmpeg can read"),
        (sound, r"sound.mp4 has no video track; pass"),
        (cover, r"cover.m4a has no video track; pass"),
        (no_frame, r"no_frame.mp4 (has no frame that can be decoded|has no video track|is no video)"),
    ):
        for call in (
            probe_video,
            read_frames,
            lambda p: process_video(p, tmp_path / "out.mp4", StubDetector()),
        ):
            with pytest.raises(VideoError, match=message):
                call(path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": -1}, "start must be a number, at least 0"),
        ({"end": "2"}, "end must be a number"),
        ({"start": float("nan")}, "start must be a number"),
        ({"start": 2, "end": 1}, "start must be before end, got start=2 and end=1"),
        ({"end": 0}, "start must be before end"),
        ({"start": 60}, r"start must lie inside the video, which is 0\.\d+ s long; got 60 s"),
        ({"start": 0.001, "end": 0.002}, "start and end must hold a frame, .* 29.97 a second"),
        ({"preset": "warp"}, "preset must be one of 'ultrafast'"),
        ({"workers": 0}, "workers must be an integer at least 1"),
        ({"on_result": 3}, "on_result must be a function"),
        ({"detector": object()}, "detector must have the methods .* without search; pass a VehicleDetector"),
        ({"source": "missing.mp4"}, "source missing.mp4 does not exist"),
        ({"source": "."}, "is a folder; name a video file"),
        ({"source": None}, "source must be the path of a video file"),
        ({"source": os.devnull}, "is no regular file"),
        ({"target": "missing/out.mp4"}, "target needs an existing folder"),
        ({"target": "."}, "target must be a file, got the folder"),
        ({"target": "out.gif"}, r"target must end in .mp4, .m4v, .mov, .mkv; got 'out.gif', write 'out.mp4'"),
        ({"target": 7}, "target must be the path"),
    ],
)
def test_bad_arguments(clip, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    given_ = {"source": clip, "target": "out.mp4", "detector": StubDetector(), **options}
    source, target, detector = (given_.pop(name) for name in ("source", "target", "detector"))
    with pytest.raises(InvalidInputError, match=message):
        process_video(source, target, detector, **given_)
    assert os.listdir(tmp_path) == []


def test_a_target_that_is_the_source(clip, tmp_path, monkeypatch):
    source = tmp_path / "in.mp4"
    source.write_bytes(clip.read_bytes())
    (tmp_path / "link.mp4").symlink_to(source)
    monkeypatch.chdir(tmp_path)
    for target in (source, "in.mp4", f"../{tmp_path.name}/in.mp4", "link.mp4"):
        with pytest.raises(InvalidInputError, match="is the source itself; choose another name"):
            process_video(source, target, StubDetector())
    assert source.read_bytes() == clip.read_bytes()


def test_a_read_only_folder_and_an_unreadable_file(clip, tmp_path, monkeypatch):
    # Root may do anything: what the system would say is put in its mouth.
    monkeypatch.setattr(os, "access", lambda path, mode: mode == os.R_OK)
    with pytest.raises(InvalidInputError, match="target needs a writable folder"):
        process_video(clip, tmp_path / "out.mp4", StubDetector())
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InvalidInputError, match="may not be read; change its permissions"):
        probe_video(clip)


def test_a_missing_ffmpeg_is_said(clip, monkeypatch):
    monkeypatch.setattr("moviepy.config.FFMPEG_BINARY", "/nowhere/ffmpeg")
    with pytest.raises(VideoError, match=r"ffmpeg cannot be started .* reinstall imageio-ffmpeg"):
        probe_video(clip)


@pytest.mark.parametrize("name", ["-dash.mp4", "a:b.mp4", "100%d.mp4", "spaced name é.mp4", "http:x.mp4"])
def test_any_file_name(clip, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(clip.read_bytes())
    process_video(name, f"out {name}", StubDetector())
    assert frame_numbers(f"out {name}") == list(range(20))


# --- the small parts ---


@pytest.mark.parametrize(
    ("exact", "printed", "rate", "constant"),
    [
        ("30000/1001", "29.97", NTSC, True),
        ("30/1", "29.83", Fraction(30), False),
        ("1000/1", "24.51", Fraction(2451, 100), False),
        ("90000/1", "1k", Fraction(90000), False),
        ("0/0", "15", Fraction(15), True),
        ("25/1", None, Fraction(25), True),
        ("0/0", None, Fraction(25), False),
    ],
)
def test_rates_as_ffmpeg_prints_them(exact, printed, rate, constant):
    line = f"  Stream #0:0: Video: vp8, {printed} fps, 1k tbr" if printed else "  Stream #0:0: Video: vp8"
    if printed == "1k":
        rate = Fraction(1000)
    assert _ffmpeg._frame_rate(f"config in time_base: 1/1000, frame_rate: {exact}", line) == (rate, constant)


# --- real data ---


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "frames", "sound"), [("test_video.mp4", 38, True), ("lane_lines_960x540.mp4", 221, True)]
)
def test_real_clips_keep_frames_and_sound(real_data, tmp_path, name, frames, sound):
    source, target = real_data / "videos" / name, tmp_path / "out.mp4"
    report = process_video(source, target, StubDetector(), preset="ultrafast")
    before, after = probe_video(source), probe_video(target)
    assert report.frames == frames
    assert (after.frames, after.fps, after.shape) == (before.frames, before.fps, before.shape)
    assert after.has_audio == sound
