"""Videos that decode in part: what is lost must not go unsaid."""

import logging
import os

import pytest

from tests.helpers import StubDetector
from tests.video.clips import damage_frames, damage_sizes, ffmpeg, gray_frames, write_clip
from vehicle_detection import VideoError, open_source, process_video, read_frames

LOST = r"lost.mp4 is damaged: 17 of 20 frames cannot be decoded; copy or record it again"


@pytest.fixture(scope="module")
def lost(clip):
    """A clip after whose third frame ffmpeg ends, without an error and with exit code 0."""
    return damage_sizes(clip, clip.with_name("lost.mp4"), entry=3, byte=0, flip=64)


def count(path, **options):
    with read_frames(path, **options) as frames:
        return sum(1 for _ in frames), frames.damage


def test_missing_frames_are_reported(lost, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        report = process_video(lost, tmp_path / "out.mp4", StubDetector())
    assert report.frames == 3
    assert report.damage.endswith(LOST)
    assert caplog.messages == [report.damage]


def test_strict_refuses_a_damaged_video_and_keeps_the_old_file(lost, tmp_path):
    target = tmp_path / "out.mp4"
    target.write_bytes(b"old")
    with pytest.raises(VideoError, match=LOST):
        process_video(open_source(lost, strict=True), target, StubDetector())
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.mp4"]
    with pytest.raises(VideoError, match=LOST):
        count(lost, strict=True)


def test_one_missing_frame_is_counted(clip, tmp_path):
    path = damage_sizes(clip, tmp_path / "one.mp4", entry=10)
    assert count(path)[0] == 19
    assert "1 of 20 frames cannot be decoded, and ffmpeg reports 5 decoding errors" in count(path)[1]


def test_damaged_pictures_are_reported(folder, tmp_path):
    whole = folder / "pictures.mp4"
    ffmpeg("-f", "lavfi", "-i", "testsrc2=s=160x90:r=25", "-frames:v", 20, "-pix_fmt", "yuv420p", whole)
    frames, damage = count(damage_frames(whole, tmp_path / "flipped.mp4"))
    assert frames == 20
    assert "flipped.mp4 is damaged: ffmpeg reports 3 decoding errors (error while decoding MB" in damage


def test_gaps_in_the_times_of_a_transport_stream_are_no_undecodable_frames(folder):
    source = write_clip(folder / "steady.mp4", gray_frames(20))
    gap = folder / "gap.ts"
    selected = ("-i", source, "-vf", "select='lt(n,5)+gt(n,14)'", "-fps_mode", "vfr", "-bf", 0)
    ffmpeg(*selected, gap)
    frames, damage = count(gap)
    assert frames == 10
    assert "gap.ts lacks 10 of 20 frames, or the times of its frames have gaps" in damage
    ffmpeg("-i", gap, "-c", "copy", copy := folder / "gap.mkv")
    ffmpeg(*selected, "-c:v", "mjpeg", "-pix_fmt", "yuvj420p", repeated := folder / "gap.avi")
    assert count(copy) == count(repeated) == (20, "")


@pytest.mark.parametrize(("suffix", "frames"), [("ts", 80), ("mp4", 40)])
def test_recordings_that_were_joined_byte_by_byte(tmp_path, caplog, suffix, frames):
    """Of MP4, only the first one can be read; the times of MPEG-TS begin again."""
    path = write_clip(tmp_path / f"a.{suffix}", gray_frames(20) * 2, options=("-g", 10))
    path.write_bytes(path.read_bytes() * 2)
    with open_source(path) as source:
        assert (source.info.frames, sum(1 for _ in source)) == (frames, frames)
    assert "seems to be joined of several" in caplog.text
    if suffix == "ts":
        with pytest.raises(VideoError, match="copy it first"):
            read_frames(path, start=1.0)


def test_an_empty_file_is_named(tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(VideoError, match=r"empty.mp4 is not a video .*\(it is empty\)"):
        read_frames(tmp_path / "empty.mp4")


def test_a_range_counts_its_own_frames(lost, clip):
    assert count(lost, end=0.1) == (3, "")
    assert "2 of 5 frames cannot be decoded" in count(lost, end=5 / 29.97)[1]
    assert "17 of 20 frames cannot be decoded" in count(lost, end=60)[1]
    assert count(clip, start=0.3, end=60) == (11, "")


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts", "avi"])
def test_whole_videos_with_longer_sound_are_not_damaged(folder, suffix):
    flat = write_clip(folder / f"flat_{suffix}.mp4", gray_frames(10))
    path = folder / f"long_sound.{suffix}"
    ffmpeg("-i", flat, "-f", "lavfi", "-t", 2, "-i", "sine=440", "-c:v", "copy", path)
    assert count(path)[1] == ""
    if suffix != "ts":  # ffmpeg cannot jump into so short a one
        assert count(path, start=0.2)[1] == ""


@pytest.mark.parametrize("options", ["-bf 3", "-vf setpts=PTS*1.001", "-r 59.94", "-f mpeg -c:v mpeg2video"])
def test_whole_videos_are_not_damaged(folder, options):
    path = write_clip(folder / "whole.mp4", gray_frames(20) * 2, options=options.split())
    assert count(path)[1] == ""


def test_frames_larger_than_the_limit_are_refused(clip, monkeypatch):
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_PIXELS", "3000")
    message = r"has frames of 64x48 pixels, more than 3,000; .* set VEHICLE_DETECTION_MAX_PIXELS"
    with pytest.raises(VideoError, match=message):
        read_frames(clip)
