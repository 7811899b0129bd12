"""Annotated videos and their reports."""

import dataclasses
import io
import os
import re
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import pytest
from moviepy.config import FFMPEG_BINARY

from tests.helpers import StubDetector
from tests.video.clips import NTSC, ffmpeg, ffmpeg_log, frame_numbers
from vehicle_detection import (
    InvalidInputError,
    TransientVideoError,
    open_source,
    probe_video,
    process_video,
    read_frames,
)
from vehicle_detection.video import Encoding, VideoReport, engine, writing


def test_a_complete_video_keeps_frames_rate_and_sound(clip, tmp_path):
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
    facts = ffmpeg_log(target)
    assert re.search(r"Video: h264.*yuv420p\(tv, smpte170m/bt709/bt709, .*29\.97 fps, 29\.97 tbr", facts)
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
    assert report.waiting.keys() == {"decode", "search", "track", "encode"}
    assert all(0 <= seconds <= report.seconds for seconds in report.waiting.values())
    assert sum(report.stage_fractions.values()) == pytest.approx(1)
    assert os.listdir(tmp_path) == ["out.mp4"]
    assert target.stat().st_mode & 0o444 == 0o444


def test_sound_can_be_omitted_and_an_end_after_the_video_is_ignored(clip, tmp_path):
    report = process_video(clip, tmp_path / "out.mp4", StubDetector(), audio=False, start=0.5, end=1e3)
    assert report.frames == 5
    assert not probe_video(tmp_path / "out.mp4").has_audio


def test_without_a_target_nothing_is_drawn(clip, tmp_path):
    results = []
    stub = StubDetector()
    stub.draw = lambda frame, result: pytest.fail("a frame was drawn")
    report = process_video(clip, None, stub, on_result=results.append)
    assert len(results) == report.frames == 20
    assert list(report.stages) == ["decode", "search", "heat", "track"]
    assert report.stages["search"] > 0


def test_progress_is_shown_on_a_terminal_only(clip, monkeypatch):
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


def test_progress_is_shown_in_a_notebook(clip, monkeypatch, capsys):
    shell = SimpleNamespace(kernel=object(), config={})
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    process_video(clip, None, StubDetector())
    assert "20/20" in capsys.readouterr().err


def test_progress_is_logged_in_intervals(clip, monkeypatch, caplog):
    caplog.set_level("INFO", "vehicle_detection.video.engine")
    process_video(clip, None, StubDetector())
    assert caplog.messages == []
    monkeypatch.setattr(engine, "_LOG_INTERVAL", 0.0)
    process_video(clip, None, StubDetector(), progress=False)
    assert caplog.messages == []
    with open_source(clip) as source:
        for pattern in (r"0:00 of 0:00, \d+ frames/s", r"0:00, \d+ frames/s"):
            process_video(source, None, StubDetector())
            assert len(caplog.messages) == 20
            assert all(re.fullmatch(pattern, message) for message in caplog.messages)
            caplog.clear()
            source.info = dataclasses.replace(source.info, frames=0)  # as that of a pipe


def test_a_report_without_frames():
    report = VideoReport(frames=0, fps=Fraction(25), shape=(2, 2, 3), seconds=0, stages={"draw": 0}, tracks=1)
    assert report.stage_fractions == {"draw": 0.0}
    assert "1 vehicle" in str(report)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": float("nan")}, "start must be a number"),
        ({"start": 2, "end": 1}, "end must be later than the start; got 2 s to 1 s"),
        ({"end": 0}, "end must be later than the start; got 0 s to 0 s"),
        ({"start": 60}, r"start must be less than the video's length of 0\.\d+ s; got 60 s"),
        ({"start": 0.001, "end": 0.002}, "end must be at least one frame later than the start, at 29.97"),
        ({"detector": object()}, "detector must have the methods .* without search; pass a VehicleDetector"),
        ({"source": "."}, r"source \. holds no videos and no images; check the path"),
        ({"source": os.devnull}, "is a device or a pipe"),
        ({"target": "missing/out.mp4"}, "target needs an existing folder"),
        ({"target": "."}, "target must be a file, got the folder"),
        ({"target": "out.gif"}, r"target must end in .mp4 or .*, got 'out.gif'; write 'out.mp4'"),
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
        with pytest.raises(InvalidInputError, match="is the source; choose another name"):
            process_video(source, target, StubDetector())
    assert source.read_bytes() == clip.read_bytes()


def test_a_read_only_folder_and_an_unreadable_file(clip, tmp_path, monkeypatch):
    # The tests may run as root, to whom the system grants any access.
    monkeypatch.setattr(os, "access", lambda path, mode: mode == os.R_OK)
    with pytest.raises(InvalidInputError, match="target needs a writable folder"):
        process_video(clip, tmp_path / "out.mp4", StubDetector())
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InvalidInputError, match="is not readable; change its permissions"):
        probe_video(clip)


@pytest.mark.skipif(sys.platform == "win32", reason="the program in place of ffmpeg is a shell script")
@pytest.mark.parametrize("action", [":", "head -c 100 /dev/zero > ", "head -c 3000 {clip} > ", "cp {clip} "])
def test_an_encoder_that_writes_nothing_or_garbage_replaces_nothing(clip, tmp_path, monkeypatch, action):
    """It reads all frames, and ends with the exit code 0."""
    program, target = tmp_path / "ffmpeg.sh", tmp_path / "out.mp4"
    program.write_text(
        f"""#!/bin/sh
for last in "$@"; do last=${{last#file:}}; done
case "$*" in *libx264*) cat > /dev/null; {action.format(clip=clip)}"$last"; exit 0;; esac
exec "{FFMPEG_BINARY}" "$@"
"""
    )
    program.chmod(0o755)
    monkeypatch.setattr("moviepy.config.FFMPEG_BINARY", str(program))
    target.write_text("old")
    with pytest.raises(TransientVideoError, match=r"ffmpeg wrote \d+ of 12 frames.*nothing of it was kept"):
        process_video(clip, target, StubDetector(), end=0.4)
    assert target.read_text() == "old"


@pytest.mark.parametrize("name", ["-dash.mp4", "a:b.mp4", "100%d.mp4", "spaced name é.mp4", "http:x.mp4"])
def test_any_file_name(clip, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(clip.read_bytes())
    process_video(name, f"out {name}", StubDetector())
    assert frame_numbers(f"out {name}") == list(range(20))


def test_the_quality_is_chosen(clip, tmp_path):
    sizes = []
    for crf in (10, None, 40):
        target = tmp_path / f"{crf}.mp4"
        process_video(clip, target, StubDetector(), audio=False, encoding=Encoding(crf=crf))
        sizes.append(target.stat().st_size)
    assert sizes[0] > sizes[1] > sizes[2]


@pytest.mark.parametrize("name", writing.ENCODERS)
def test_x264_replaces_an_encoder_that_does_not_work(clip, tmp_path, caplog, monkeypatch, name):
    monkeypatch.setattr(writing, "_encoder_failure", lambda encoder: f"no {encoder}")
    assert process_video(clip, tmp_path / "out.mp4", StubDetector(), encoding=Encoding(encoder=name)).frames
    assert "libx264" in Encoding(encoder=name).options("null")
    replaced = name not in ("auto", "x264")
    assert (f"because {name} does not work here (no {name})" in caplog.text) == replaced


def test_the_first_encoder_that_works_is_chosen(monkeypatch):
    monkeypatch.setattr(writing, "_encoder_failure", lambda encoder: "" if encoder == "vaapi" else "missing")
    options = " ".join(Encoding(encoder="auto", crf=30).options("null"))
    assert "-vf null,format=nv12,hwupload -c:v h264_vaapi -qp 30" in options
    assert "nvenc" in Encoding(encoder="auto")._options("nvenc", "null")[3]
