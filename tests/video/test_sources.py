"""Sources other than single files: segments, images, pipes, network streams and other storage."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from moviepy.config import FFMPEG_BINARY

from tests.helpers import StubDetector, answer, serve, start_interruptible
from tests.video.clips import (
    beeps,
    damage_sizes,
    ffmpeg,
    ffmpeg_log,
    frame_numbers,
    gray_frames,
    sound_seconds,
    write_beep,
    write_clip,
)
from vehicle_detection import InvalidInputError, TransientVideoError, VideoError, write_image
from vehicle_detection._common import web
from vehicle_detection.video import ffmpeg as ffmpeg_module
from vehicle_detection.video import files as files_module
from vehicle_detection.video import live, open_source, probe_video, process_video, read_frames, reading


def numbers(source, **options):
    """Frames of `gray_frames` that a source holds, and its indices and times."""
    with open_source(source, **options) as opened:
        rows = [(index, time, round((frame[8:-8, 8:-8].mean() - 10) / 10)) for index, time, frame in opened]
    return tuple(zip(*rows))


@pytest.fixture(scope="module")
def card(folder):
    """A card of three segments, which are cut from one clip, of two cameras."""
    home = folder / "card"
    home.mkdir()
    frames = gray_frames(20)
    for camera in "FR":
        for start, part in ((0, frames[:8]), (1, frames[8:16]), (2, frames[16:])):
            part = part if camera == "F" else part[::-1]
            write_clip(home / f"20260131_08150{start}_{camera}.mp4", part, fps=8, sound=True)
    (home / "._20260131_081500_F.mp4").write_text("not a video")
    return home


def test_segments_become_one_video(card, tmp_path):
    files = sorted(card.glob("2*F.mp4"))
    index, times, seen = numbers(files)
    assert index == seen == tuple(range(20))
    assert times == pytest.approx(np.arange(20) / 8)
    report = process_video(files, tmp_path / "trip.mp4", StubDetector(), jobs=2)
    assert frame_numbers(tmp_path / "trip.mp4") == list(range(20))
    assert report.frames == 20
    # One vehicle for six frames each, as in a single file: the state is kept at the cuts.
    assert report.tracks == 4
    assert sound_seconds(tmp_path / "trip.mp4") == pytest.approx(2.5, abs=0.15)
    assert os.listdir(tmp_path) == ["trip.mp4"]


@pytest.mark.parametrize(("start", "end"), [(0.5, 1.25), (1.0, 2.25), (2.0, None), (0, 9)])
def test_a_part_of_a_trip(card, tmp_path, start, end):
    target = tmp_path / "part.mp4"
    process_video(sorted(card.glob("2*F.mp4")), target, StubDetector(), start=start, end=end)
    expected = list(range(20))[int(start * 8) : None if end is None else int(end * 8)]
    assert frame_numbers(target) == expected
    assert sound_seconds(target) == pytest.approx(len(expected) / 8, abs=0.15)


@pytest.mark.parametrize(("suffix", "delay"), [("mp4", 0.0), ("mkv", 0.3), ("ts", 0.0), ("ts", 0.3)])
def test_sound_of_a_trip_stays_with_its_frames(tmp_path, suffix, delay):
    segments = [write_beep(tmp_path / f"{n}.{suffix}", delay=delay, longer=0.4) for n in range(3)]
    with open_source(segments) as source:
        assert source.info.frames == 72
    process_video(segments, tmp_path / "trip.mp4", StubDetector())
    assert frame_numbers(tmp_path / "trip.mp4") == [*range(24)] * 3
    assert beeps(tmp_path / "trip.mp4") == pytest.approx([0.6, 1.6, 2.6], abs=0.02)
    process_video(segments, tmp_path / "part.mp4", StubDetector(), start=1.25)
    assert frame_numbers(tmp_path / "part.mp4") == [*range(6, 24), *range(24)]
    assert beeps(tmp_path / "part.mp4") == pytest.approx([0.35, 1.35], abs=0.02)


def test_segments_with_different_sound_become_a_video_without(tmp_path, caplog):
    segments = [write_beep(tmp_path / f"{n}.mp4") for n in range(2)]
    with open_source(segments) as source:
        assert source.info.has_audio
    ffmpeg("-i", segments[0], "-c:v", "copy", "-ar", 22050, tmp_path / "other.mp4")
    mixed = [*segments, tmp_path / "other.mp4"]
    process_video(mixed, tmp_path / "silent.mp4", StubDetector(), audio=False)
    assert caplog.text == ""  # nobody asked for the sound
    process_video(mixed, tmp_path / "trip.mp4", StubDetector())
    assert not probe_video(tmp_path / "trip.mp4").has_audio
    assert "have sound of another format, or none; the video has none" in caplog.text


def test_segments_of_unknown_length(tmp_path):
    options = ("-c:v", "mjpeg", "-q:v", 2)
    segments = [write_clip(tmp_path / f"{n}.mjpeg", gray_frames(4), options=options) for n in range(2)]
    assert numbers(segments)[2] == (0, 1, 2, 3) * 2


def test_segments_with_a_line_break_in_the_name(tmp_path):
    clip = write_clip(tmp_path / "a.mp4", gray_frames(2))
    broken = clip.rename(tmp_path / "a\nb.mp4")
    with pytest.raises(InvalidInputError, match=r"a\\nb.mp4' has a line break in its name; rename"):
        open_source([broken, broken])


@pytest.mark.skipif(sys.platform != "linux", reason="names are UTF-8")
def test_segments_in_a_folder_whose_name_is_not_utf8(card, tmp_path):
    folder = tmp_path / os.fsdecode(b"stra\xdfe")
    shutil.copytree(card, folder)
    process_video(sorted(folder.glob("2*F.mp4")), tmp_path / "out.mp4", StubDetector())
    assert sound_seconds(tmp_path / "out.mp4") == pytest.approx(2.5, abs=0.15)


def test_segments_of_another_rate_and_size(tmp_path):
    first = write_clip(tmp_path / "a.mp4", gray_frames(4), fps=8)
    second = write_clip(tmp_path / "b.mp4", gray_frames(8, 128, 96), fps=16)
    with open_source([first, second]) as source:
        frames = list(source)
    assert [frame.shape for _, _, frame in frames] == [(48, 64, 3)] * 8
    assert not source.info.has_audio


@pytest.mark.parametrize("source", ["", "*F.mp4"])
def test_a_folder_or_pattern_with_several_videos_is_refused(card, source):
    with pytest.raises(InvalidInputError, match=r"source .* videos; open .* with open_trip"):
        open_source(str(card / source))


def test_missing_frames_of_a_segment_are_reported(card, tmp_path):
    files = sorted(card.glob("2*F.mp4"))
    lost = damage_sizes(files[1], tmp_path / "lost.mp4", entry=3, byte=0, flip=64)
    segments = [files[0], lost, files[2]]
    report = process_video(segments, None, StubDetector())
    assert report.frames == 8 + 3 + 4
    assert re.fullmatch(r".*lost.mp4 is damaged: 5 of 8 frames cannot be decoded; .*", report.damage)
    with pytest.raises(VideoError, match=r"lost.mp4 is damaged: 5 of 8 frames"):
        process_video(open_source(segments, strict=True), tmp_path / "out.mp4", StubDetector())
    assert os.listdir(tmp_path) == ["lost.mp4"]


def test_images_in_natural_order(tmp_path):
    for number, frame in enumerate(gray_frames(11)):
        write_image(tmp_path / f"frame{number}.png", frame)
    index, times, seen = numbers(tmp_path, fps=5)
    assert index == seen == tuple(range(11))
    assert times == pytest.approx(np.arange(11) / 5)
    process_video(str(tmp_path / "*.png"), tmp_path / "out.mp4", StubDetector(), start=0.08)
    assert frame_numbers(tmp_path / "out.mp4") == list(range(2, 11))
    with pytest.raises(InvalidInputError, match="must be videos or images, got both"):
        open_source([tmp_path / "frame0.png", tmp_path / "out.mp4"])
    write_image(tmp_path / "frame11.png", gray_frames(1, 32, 32)[0])
    with pytest.raises(InvalidInputError, match=r"images of one size; .+frame11.png is 32x32"):
        numbers(str(tmp_path / "*.png"))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ([], "at least one file"),
        ([np.zeros((32, 32, 3), np.uint8)], r"call detector.process\(frame, time\) with frames"),
        ("", "source must be a file, a folder, a pattern or a URL, got an empty name"),
        ("empty", "source empty holds no videos and no images"),
        ("*.mp4", r"source \*\.mp4 holds no videos"),
        ("-", "standard input, which is not a pipe"),
        ("97", "there is no camera /dev/video97"),
        *((name, "source must be the path of a video file, got") for name in ("a\0b", "a" * 5000, "\ud800")),
        ("warp://drive.mp4", r"source warp://drive.mp4 cannot be opened \(Protocol not known: warp"),
        ("memory://missing.mp4", "memory://missing.mp4 does not exist; check the URL"),
    ],
)
def test_bad_sources(tmp_path, monkeypatch, source, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InvalidInputError, match=message):
        open_source(source)
    with pytest.raises(InvalidInputError, match="fps must be a number"):
        open_source("x.mp4", fps=0)


RAW = [
    ("mjpeg", ("-c:v", "mjpeg", "-pix_fmt", "yuvj420p", "-f", "mjpeg"), None),
    ("h264", ("-f", "h264"), 12),
    ("m2v", ("-c:v", "mpeg2video", "-q:v", "2", "-r", "24", "-f", "mpeg2video"), 24),
    ("y4m", ("-c:v", "rawvideo", "-f", "yuv4mpegpipe"), "container"),
    ("ts", ("-f", "mpegts"), "container"),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "options", "rate"), RAW)
@pytest.mark.parametrize("fps", [None, 10, 12])
def test_the_rate_of_raw_streams_is_honoured_and_that_of_others_is_refused(
    tmp_path, caplog, suffix, options, rate, fps
):
    path = write_clip(tmp_path / f"raw.{suffix}", gray_frames(12), fps=12, options=options)
    frames = 24 if suffix == "m2v" else 12
    if rate == "container" and fps:
        with pytest.raises(InvalidInputError, match=r"fps must be omitted for .*\(12 frames/s\)"):
            open_source(path, fps=fps)
        return
    index, times, _ = numbers(path, **({} if fps is None else {"fps": fps}))
    used = fps or {None: 25, "container": 12}.get(rate, rate)
    assert index == tuple(range(frames))
    assert times == pytest.approx(np.arange(frames) / used)
    warned = "no frame rate" if fps is rate is None else "states" if fps and rate not in (None, fps) else ""
    assert warned in caplog.text
    assert bool(caplog.records) == bool(warned)
    with open_source(path, fps=fps) as source, source.read(5) as part:  # a jump, without times in the file
        levels = [round((frame[8:-8, 8:-8].mean() - 10) / 10) for _, _, frame in part]
    assert levels == [n * 12 // frames for n in range(5, frames)]


def test_the_rate_of_images_is_told_if_it_is_assumed(tmp_path, caplog):
    for number, frame in enumerate(gray_frames(2)):
        write_image(tmp_path / f"{number}.png", frame)
    for options, warned in (({"fps": 25}, False), ({}, True)):
        open_source(tmp_path, **options).close()
        assert ("no frame rate: 25 is assumed" in caplog.text) == warned
    with pytest.raises(InvalidInputError, match="stream must be omitted for images"):
        open_source(tmp_path, stream=1)


@pytest.mark.parametrize(
    ("marked", "frames", "chosen"),
    [
        ((0, 1), (8, 8), 1),  # the default one
        ((1, 0), (8, 8), 0),
        ((0, 0), (8, 8), 1),  # the largest one
        ((1, 1), (8, 8), 1),
        ((0, 0), (8, 1), 0),  # a picture is no video
        ((1, 0), (1, 8), 1),
    ],
)
def test_the_default_or_largest_of_several_video_streams(tmp_path, caplog, marked, frames, chosen):
    sizes = ((64, 48), (96, 64))
    parts = [
        write_clip(tmp_path / f"{n}.mkv", gray_frames(count, *size), fps=8)
        for n, (count, size) in enumerate(zip(frames, sizes))
    ]
    words = ["default" if mark else 0 for mark in marked]
    both, copied = tmp_path / "both.mkv", ("-map", 0, "-map", 1, "-c", "copy")
    marks = ("-disposition:v:0", words[0], "-disposition:v:1", words[1])
    ffmpeg("-i", parts[0], "-i", parts[1], *copied, *marks, both)
    for stream in (None, 0, 1):
        expected = chosen if stream is None else stream
        with open_source(both, stream=stream) as source:
            shapes = [frame.shape[1::-1] for _, _, frame in source]
            assert source.info.stream == expected
        assert set(shapes) == {sizes[expected]}
        assert len(shapes) in (8, frames[expected])
        other = f"not {1 - chosen} ({sizes[1 - chosen][0]}x"
        assert (other in caplog.text) == (stream is None)
        caplog.clear()
    with pytest.raises(VideoError, match=r"has the video streams [01, ]+ not 2; choose one"):
        open_source(both, stream=2)


@pytest.mark.parametrize("fault", ["empty", "no index", "no frame"])
def test_a_last_segment_that_cannot_be_read_costs_itself_only(tmp_path, caplog, fault):
    files = [tmp_path / f"20260131_08150{second}_F.mp4" for second in range(3)]
    for file in files:
        write_clip(file, gray_frames(8), fps=8, options=("-movflags", "+faststart") * (fault == "no frame"))
    data = files[2].read_bytes()
    kept = {"empty": 0, "no index": len(data) // 2, "no frame": data.find(b"mdat") + 30}[fault]
    files[2].write_bytes(data[:kept])
    report = process_video(files, tmp_path / "trip.mp4", StubDetector())
    assert frame_numbers(tmp_path / "trip.mp4") == [*range(8), *range(8)]
    assert f"the last segment is left out: {files[2]} " in report.damage
    assert "frame=" not in report.damage
    assert caplog.text.count("is left out") == 1
    with pytest.raises(VideoError, match=files[2].name):
        open_source(files, strict=True)
    with pytest.raises(VideoError, match=files[2].name):
        open_source([files[0], files[2], files[1]])
    with open_source(files) as source, source.read(0, 8) as reader:  # it was not asked for
        assert (len(list(reader)), reader.damage) == (8, "")


@pytest.mark.parametrize("change", ["truncated", "replaced"])
def test_a_source_that_changes_while_it_is_read_is_named(tmp_path, change):
    path = write_clip(tmp_path / "drive.mp4", gray_frames(20), sound=True)
    with open_source(path) as source:
        assert source.find_change() == ""
        with path.open("ab") as file:  # still recording
            file.write(b"more")
        assert source.find_change() == ""

        def spoil(result):
            if change == "truncated":
                os.truncate(path, 3000)
            elif result.index == 0:  # a later copy may get the inode of the first file
                shutil.copy(path, tmp_path / "copy.mp4")
                (tmp_path / "copy.mp4").replace(path)

        try:
            said = process_video(source, tmp_path / "out.mp4", StubDetector(), on_result=spoil).damage
        except VideoError as error:
            said = str(error)
        assert f"{path} was replaced or truncated while it was read" in said


def test_a_file_on_other_storage_is_copied(clip, tmp_path, monkeypatch):
    """Copies of killed processes are removed."""
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    left = tmp_path / ".vehicle-source.0.part.abc"
    left.mkdir()
    (left / "clip.mp4").write_bytes(b"x")
    with fsspec.open("memory://bucket/clip.mp4", "wb") as file:
        file.write(clip.read_bytes())
    with open_source("memory://bucket/clip.mp4") as source:
        assert (source.name, len(list(source))) == ("memory://bucket/clip.mp4", 20)
        assert source.files[0].is_relative_to(tmp_path)
        if sys.platform != "win32":
            assert not left.exists()
        with open_source("memory://bucket/clip.mp4") as other:
            assert source.files[0].exists()
            assert other.files[0] != source.files[0]
    assert not source.files[0].exists()


def test_without_fsspec(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(InvalidInputError, match="needs fsspec; pip install fsspec,"):
        files_module.open_filesystem("s3://bucket/x.mp4")


# --- standard input and pipes ---

FROM_STDIN = """
import sys
from tests.helpers import StubDetector
from vehicle_detection.video import process_video
print(process_video("-", sys.argv[1], StubDetector(pause=0.02)).frames)
"""


@pytest.fixture(scope="module")
def stream(clip):
    """The bytes of a stream of 20 frames."""
    return ffmpeg("-i", clip, "-c", "copy", "-an", "-f", "mpegts", "-")


def test_standard_input_waits_for_the_search(tmp_path):
    """Its anamorphic frames have square pixels in the video, like those of files."""
    stream = write_clip(tmp_path / "wide.ts", gray_frames(20), options=["-vf", "setsar=4/3"]).read_bytes()
    raw = write_clip(tmp_path / "raw.mjpeg", gray_frames(3), options=RAW[0][1]).read_bytes()
    command = [sys.executable, "-c", FROM_STDIN, tmp_path / "out.mp4"]
    for data, frames, told in ((raw, b"3\n", b"no frame rate: 25 is assumed"), (stream, b"20\n", b"")):
        done = subprocess.run(command, input=data, capture_output=True, check=True)
        assert (done.stdout, told in done.stderr) == (frames, True)
    assert frame_numbers(tmp_path / "out.mp4") == list(range(20))
    assert probe_video(tmp_path / "out.mp4").shape == (48, 86, 3)


@contextlib.contextmanager
def endless_pipe(path):
    """A named pipe that a camera of 50 frames per second writes to, until its reader ends."""
    os.mkfifo(path)
    pattern = ["-re", "-f", "lavfi", "-i", "testsrc2=s=64x48:r=50", "-pix_fmt", "yuv420p", "-f", "matroska"]
    options = ["-v", "quiet", "-y", *pattern, "-c:v", "libx264", "-preset", "ultrafast", "-g", "5", str(path)]
    camera = subprocess.Popen([FFMPEG_BINARY, *options], stdin=subprocess.DEVNULL)
    try:
        yield camera
    finally:
        camera.kill()
        camera.wait()


def test_a_live_source_drops_frames_rather_than_lag(tmp_path, monkeypatch):
    arrived, read = [], live.LiveStream.read

    def count(stream, planes):
        number = read(stream, planes)
        arrived.append(number)
        return number

    monkeypatch.setattr(live.LiveStream, "read", count)

    class Slow(StubDetector):
        def search(self, frame):
            enough = min(len(arrived) + 5, 75)  # as many frames arrive in the meantime, of all 75
            deadline = time.monotonic() + 60
            while len(arrived) < enough and time.monotonic() < deadline:
                time.sleep(0.005)
            return super().search(frame)

    results = []
    with endless_pipe(tmp_path / "pipe"), open_source(tmp_path / "pipe", live=True) as source:
        report = process_video(source, tmp_path / "o.mp4", Slow(), jobs=1, end=1.5, on_result=results.append)
        with pytest.raises(InvalidInputError, match="can be read only once"):
            source.read()
    assert 2 <= report.frames < 25  # on a busy machine, perhaps only the first one and the last one
    assert report.dropped > 50
    assert f"{report.dropped} frames dropped" in str(report)
    # Times are those of the source, and the video repeats frames in place of those that were dropped.
    times = [result.time - results[0].time for result in results]
    assert times == pytest.approx([result.index / 50 for result in results])
    assert probe_video(tmp_path / "o.mp4").frames == report.frames + report.dropped == results[-1].index + 1


def test_closing_a_live_source_leaves_no_process(tmp_path):
    with endless_pipe(tmp_path / "pipe") as camera:
        with open_source(tmp_path / "pipe", live=True) as source:
            for index, _, _ in source:
                if index > 3:
                    break
        camera.wait(60)  # its reader is gone


LIVE = """
import sys
from tests.helpers import StubDetector
from vehicle_detection.video import open_source, process_video
with open_source(sys.argv[1], live=True) as source:
    show = lambda result: print(result.index, flush=True)
    report = process_video(source, sys.argv[2], StubDetector(), on_result=show)
print("report", report.frames)
"""


def test_an_interrupt_completes_the_video_of_a_live_source(tmp_path):
    with endless_pipe(tmp_path / "pipe"):
        process = start_interruptible(sys.executable, "-c", LIVE, tmp_path / "pipe", tmp_path / "out.mp4")
        for _ in range(5):
            assert process.stdout.readline()
        os.kill(process.pid, signal.SIGINT)
        out, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert int(out.split()[-1]) >= 5
    assert probe_video(tmp_path / "out.mp4").frames >= 5


# --- the network ---


def test_a_file_on_a_web_server(folder):
    path = write_clip(folder / "web.mp4", gray_frames(20), options=("-movflags", "+faststart"))

    def handle(request):
        answer(request, 200 if request.path == "/web.mp4" else 404, path.read_bytes())

    with serve(handle) as address:
        index, _, seen = numbers(f"{address}/web.mp4")
        with pytest.raises(VideoError, match="404"):
            open_source(f"{address}/other.mp4")
    assert index == seen == tuple(range(20))


def test_a_server_that_sends_too_little_fails_at_a_deadline(folder, tmp_path, monkeypatch):
    """Each byte comes in time, but not enough of them."""
    path = write_clip(folder / "slow.mp4", gray_frames(20), options=("-movflags", "+faststart"))
    data = path.read_bytes()
    whole = [data.find(b"mdat") + 2000]

    def handle(request):
        begin = int((request.headers.get("Range") or "bytes=0-")[6:-1] or 0)
        request.send_response(206 if begin else 200)
        request.send_header("Accept-Ranges", "bytes")
        request.send_header("Content-Length", str(len(data) - begin))
        if begin:
            request.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        request.end_headers()
        request.wfile.write(data[begin : whole[0]])
        for place in range(max(whole[0], begin), len(data)):
            request.wfile.write(data[place : place + 1])
            time.sleep(0.2)

    monkeypatch.setattr(files_module, "_RETRY_DELAYS", (0,))
    for module in (ffmpeg_module, reading, web):
        monkeypatch.setattr(module, "NETWORK_DEADLINE", 1.0)
    with serve(handle) as address:
        with pytest.raises(TransientVideoError, match=r"slow.mp4 cannot be copied \(only"):
            files_module.download(f"{address}/slow.mp4", tmp_path)
        whole[0] = 100
        with pytest.raises(TransientVideoError, match="sends too little data for a frame"):
            open_source(f"{address}/slow.mp4")


def stream_of(data):
    """A function that sends a video as a stream of unknown length."""

    def stream(request):
        request.send_response(200)
        request.send_header("Content-Type", "video/mp2t")
        request.end_headers()
        for start in range(0, len(data), 4096):
            request.wfile.write(data[start : start + 4096])
            time.sleep(0.01)

    return stream


def test_a_stream_of_a_web_server_ends_with_it(clip, tmp_path):
    data = ffmpeg("-stream_loop", 2, "-i", clip, "-c", "copy", "-an", "-f", "mpegts", "-")
    with serve(stream_of(data)) as address, open_source(f"{address}/live.ts", reconnect=False) as source:
        assert source.live
        report = process_video(source, tmp_path / "out.mp4", StubDetector())
    assert report.frames + report.dropped == probe_video(tmp_path / "out.mp4").frames == 60


@pytest.mark.parametrize("read", [True, False])
def test_the_first_frame_of_a_live_source_waits_for_its_reader(stream, read):
    with (
        serve(stream_of(stream)) as address,
        open_source(f"{address}/live.ts", reconnect=False) as source,
        source.read() as reader,
    ):
        time.sleep(0.5)  # the other frames arrive
        indices = [index for index, _, _ in reader] if read else [0, 19]
    assert (indices[0], indices[-1]) == (0, 19)


@pytest.mark.parametrize("fault", ["ends", "stalls"])
def test_a_network_stream_that_breaks_off_is_opened_again(clip, tmp_path, monkeypatch, caplog, fault):
    monkeypatch.setattr(live, "_RECONNECT_DELAYS", (0.05, 0.1, 0.1))
    if fault == "stalls":
        monkeypatch.setattr(live, "NETWORK_TIMEOUT", 1.2)
    # ffmpeg reads seconds of a stream before it yields a frame.
    frames = 20 if fault == "ends" else 240
    loop = ("-stream_loop", frames // 20 - 1)
    data = ffmpeg(*loop, "-i", clip, "-c", "copy", "-an", "-f", "mpegts", "-")
    requests, over = [], threading.Event()

    def unsteady(request):
        requests.append(request.path)
        if len(requests) > 3:
            request.send_error(503)
            return
        stream_of(data)(request)
        if fault == "stalls":
            over.wait(20)

    results = []
    with serve(unsteady) as address:
        with open_source(f"{address}/live.ts", live=True) as source:
            report = process_video(source, tmp_path / "out.mp4", StubDetector(), on_result=results.append)
        over.set()
    times = [result.time for result in results]
    # Three connections, with gaps for the time without one; then three attempts in vain.
    assert sorted(set(times)) == times
    assert times[-1] >= (3 * frames - 1) / source.info.fps
    assert probe_video(tmp_path / "out.mp4").frames == report.frames + report.dropped
    assert len([text for text in caplog.messages if text.endswith("opening it again")]) >= 2
    assert re.search(r"opening it again has failed 3 times \(.*\)$", caplog.messages[-1])


def test_closing_a_stream_ends_its_attempts_to_reconnect(stream, monkeypatch):
    monkeypatch.setattr(live, "_RECONNECT_DELAYS", (600.0,))
    with serve(stream_of(stream)) as address, open_source(f"{address}/live.ts", live=True) as source:
        with source.read() as reader:
            assert next(reader)[0] >= 0
            time.sleep(0.3)
        started = time.monotonic()
    assert time.monotonic() - started < 60


@pytest.mark.parametrize("live", [True, None])
def test_a_server_that_is_away_is_a_transient_error_without_passwords(live):
    with pytest.raises(TransientVideoError, match="Connection refused") as error:
        open_source("http://user:sec@ret@127.0.0.1:9/x.ts", live=live)
    assert str(error.value).startswith("http://***@127.0.0.1:9/x.ts is not a video")
    assert "user" not in str(error.value)
    assert "ret@" not in str(error.value)


def test_an_unexpected_error_of_a_live_stream_reaches_its_reader(tmp_path, monkeypatch):
    with endless_pipe(tmp_path / "pipe"), open_source(tmp_path / "pipe", live=True) as source:
        original = live.LiveStream.read

        def read(stream, planes):
            if stream._number > 1:
                raise MemoryError("no memory for a frame")
            return original(stream, planes)

        monkeypatch.setattr(live.LiveStream, "read", read)
        with pytest.raises(MemoryError, match="no memory for a frame"):
            process_video(source, tmp_path / "out.mp4", StubDetector())
    assert not (tmp_path / "out.mp4").exists()


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("s3://bucket/day/a.mp4", "a.mp4"),
        ("http://nas/a%20b.mp4?X-Amz-Credential=AK/2026/us&sig=" + "a" * 900, "a b.mp4"),
        ("http://nas/" + "é" * 300 + ".mp4", "é" * 56 + ".mp4"),
        ("http://nas/..%2F..%2Fx.mp4", ".._.._x.mp4"),
        ("http://nas/08%3A15%3F.mp4", "08_15_.mp4"),  # Windows allows neither
        ("http://nas/", "nas"),
        ("HTTP://nas/a.mp4?X-Amz-Date=20300101", "a.mp4"),
    ],
)
def test_names_of_local_copies(url, name):
    assert files_module.file_name(url) == name


def test_hidden_folders_are_left_out(tmp_path):
    """The trash folders of memory cards hold deleted recordings."""
    for folder in ("", ".Trash-1000/files", "$RECYCLE.BIN"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        for number in range(2):
            write_image(tmp_path / folder / f"{number}.png", np.zeros((48, 64, 3), np.uint8))
    with open_source(tmp_path) as source:
        assert [path.name for path in source.files] == ["0.png", "1.png"]
    with open_source(f"FILE://{tmp_path}") as source:
        assert len(source.files) == 2


def test_times_may_be_numbers_of_numpy(tmp_path):
    clip = write_clip(tmp_path / "clip.mp4", gray_frames(10))
    with read_frames(clip, start=np.float32(0.2), end=np.int64(1)) as frames:
        assert [index for index, _, _ in frames] == [5, 6, 7, 8, 9]
    process_video(clip, None, StubDetector(), end=np.float32(0.2))


def test_side_outputs_of_a_live_source_that_drops_frames(tmp_path):
    """On most machines, the search of every frame by one worker is slower than the source."""
    noise = ["-f", "lavfi", "-i", "testsrc2=size=1920x1080:rate=60:duration=1", "-c:v", "libx264"]
    encoder = [FFMPEG_BINARY, "-v", "quiet", "-re", *noise, "-preset", "ultrafast", "-f", "mpegts", "pipe:1"]
    names = {"output": "a.mp4", "tracks": "a.csv", "srt": "a.srt", "report": "a.html", "events": "e.csv"}
    command = [sys.executable, "-m", "vehicle_detection", "video", "-", "--live", "--every=1", "--jobs=1"]
    command += [f"--{name}={tmp_path / file}" for name, file in names.items()]
    with subprocess.Popen(encoder, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL) as camera:
        done = subprocess.run(command, stdin=camera.stdout, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(os.listdir(tmp_path)) == sorted(names.values())


def test_an_annotated_copy_has_no_chapters_and_no_place(tmp_path):
    meta = tmp_path / "meta.txt"
    meta.write_text(";FFMETADATA1\ntitle=private\n[CHAPTER]\nTIMEBASE=1/1\nSTART=0\nEND=9\ntitle=one\n")
    clip = write_clip(tmp_path / "clip.mp4", gray_frames(20), sound=True)
    full = tmp_path / "full.mp4"
    ffmpeg("-i", clip, "-i", meta, "-map", 0, "-map_metadata", 1, "-map_chapters", 1, "-c", "copy", full)
    assert "private" in ffmpeg_log(full)
    for audio in (True, False):
        process_video(full, tmp_path / "out.mp4", StubDetector(), audio=audio, end=0.4)
        log = ffmpeg_log(tmp_path / "out.mp4")
        assert "private" not in log
        assert "Chapter" not in log
