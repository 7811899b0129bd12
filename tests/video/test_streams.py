"""Frames and sound read from files and written to files."""

import gc
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import StubDetector
from tests.video.clips import (
    LEVELS,
    NTSC,
    beeps,
    child_processes,
    ffmpeg,
    frame_numbers,
    gray_frames,
    sound_seconds,
    write_beep,
    write_clip,
)
from vehicle_detection import VideoError, open_source, probe_video, process_video, read_frames


@pytest.fixture(scope="module")
def corners():
    """A frame with four different corners."""
    image = np.full((48, 64, 3), 40, np.uint8)
    image[:24, :32], image[:24, 32:], image[24:, :32] = (220, 40, 40), (40, 200, 40), (40, 40, 220)
    return image


@pytest.mark.parametrize(("degrees", "turns"), [(90, 1), (180, 2), (-90, 3)])
def test_rotated_video_is_read_and_written_upright(folder, corners, degrees, turns):
    flat = write_clip(folder / "flat.mp4", [corners] * 4)
    rotated = folder / f"rotated{turns}.mp4"
    ffmpeg("-display_rotation", degrees, "-i", flat, "-c", "copy", rotated)
    upright = np.rot90(corners, turns)
    info = probe_video(rotated)
    assert info.shape == upright.shape
    assert info.rotation == -degrees % 360
    stub, target = StubDetector(), folder / "upright.mp4"
    process_video(rotated, target, stub)
    assert stub.shapes == {upright.shape}
    assert probe_video(target).rotation == 0
    for path in (rotated, target):
        with read_frames(path) as frames:
            _, _, frame = next(frames)
        assert np.abs(frame[12::8, 12::8].astype(int) - upright[12::8, 12::8]).max() < 20


@settings(max_examples=12)
@given(st.integers(0, 19), st.integers(0, 30), st.sampled_from([0.0, 0.3, 0.9]))
def test_a_time_range_selects_its_frames(clip, first, length, part):
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
    assert probe_video(late).start_time == pytest.approx(0.4, abs=0.03)
    target = folder / "late_out.mp4"
    process_video(late, target, StubDetector())
    assert frame_numbers(target) == list(range(10))
    assert probe_video(target).start_time == 0  # so that subtitles and reports are in time
    with read_frames(late, start=0.2, end=0.3) as frames:
        assert [index for index, _, _ in frames] == [5, 6, 7]


def numbers_from(path, first, count=1, fps=25):
    """Return which frames of `gray_frames` are read from the frame with the number `first` on."""
    with read_frames(path, start=first / fps, end=(first + count) / fps) as frames:
        return [round((float(frame.mean()) - 10) / LEVELS) for _, _, frame in frames]


CODECS = {"vob": ("mpeg2video", "-q:v", 2), "avi": ("mjpeg", "-q:v", 2), "wmv": ("wmv2", "-q:v", 2)}


@pytest.mark.parametrize("fps", [24, 25])
@pytest.mark.parametrize("suffix", ["ts", "m2ts", "vob", "flv", "avi", "wmv", "mkv", "mp4"])
def test_any_frame_of_any_container_can_be_the_first_one(tmp_path, suffix, fps):
    codec = CODECS.get(suffix, ("libx264",))
    path = write_clip(
        tmp_path / f"clip.{suffix}", gray_frames(24), fps=fps, options=("-g", 16, "-c:v", *codec)
    )
    for first in range(1, 20, 6):
        assert numbers_from(path, first, fps=fps) == [first]


@pytest.mark.parametrize(
    "options",
    [
        ("clip.mp4", "-movflags", "frag_keyframe+empty_moov", "-bf", 2, "-g", 8),
        ("clip.ts", "-x264-params", "intra-refresh=1:keyint=8", "-bf", 0),
        ("clip.mp4", "-x264-params", "intra-refresh=1:keyint=12", "-bf", 0),
        ("clip.ts", "-c:v", "mpeg4", "-q:v", 2, "-bf", 0, "-g", 8),
        ("clip.ts", "-bsf:v", "h264_metadata=tick_rate=25"),  # it states half of its rate
        ("clip.avi", "-c:v", "mpeg4", "-q:v", 2, "-bf", 2, "-g", 8),
        ("clip.h264", "-bf", 0, "-g", 8),
        ("clip.mjpeg", "-c:v", "mjpeg", "-q:v", 2),
    ],
)
def test_any_frame_of_streams_without_exact_key_frames_can_be_the_first_one(tmp_path, options):
    name, *options = options
    fps = 5 if name == "clip.mp4" else 25  # a refresh takes longer than the smallest step back
    path = write_clip(tmp_path / name, gray_frames(24, 256), fps=fps, options=options)
    for first in range(1, 20, 3):
        assert numbers_from(path, first, fps=fps) == [first]


def test_a_stream_cut_before_its_first_key_frame(tmp_path):
    clip = write_beep(tmp_path / "clip.ts", options=("-g", 8, "-bf", 0))
    data = clip.read_bytes()
    cut = tmp_path / "cut.ts"
    start = len(data) // 5 // 188 * 188
    cut.write_bytes(data[: 3 * 188] + data[start:])
    (begin,) = numbers_from(cut, 0, fps=24)
    assert begin == 8
    for first in range(1, 6):
        assert numbers_from(cut, first, fps=24) == [begin + first]
    target = tmp_path / "out.mp4"
    process_video(cut, target, StubDetector())
    assert beeps(target) == pytest.approx([0.6 - begin / 24], abs=0.02)


def test_frames_that_arrive_in_bursts_keep_a_usual_rate(tmp_path):
    bursts = ["-vf", "settb=1/1000,setpts='floor(N/3)*120+mod(N,3)'", "-fps_mode", "passthrough"]
    bursts += ["-enc_time_base", "1/1000", "-bf", 0]
    info = probe_video(write_clip(tmp_path / "bursts.mkv", gray_frames(24), options=bursts))
    assert not info.constant_rate
    assert info.fps <= 30


@pytest.mark.parametrize("sound", [False, True])
def test_matroska_whose_times_do_not_start_at_0(tmp_path, sound):
    clip = write_clip(tmp_path / "clip.mp4", gray_frames(20), sound=sound)
    path = tmp_path / "later.mkv"
    ffmpeg("-i", clip, "-c", "copy", "-output_ts_offset", 7, path)
    info = probe_video(path)
    assert info.constant_rate
    assert info.frames == pytest.approx(20, abs=1)
    with read_frames(path) as frames:
        assert len(list(frames)) == 20
    assert not frames.damage
    assert frame_numbers(path) == list(range(20))


def test_no_frame_is_lost_beside_a_gap_in_the_times(tmp_path):
    later = ["-vf", "setpts='if(gt(N,9),PTS+0.6/TB,PTS)'", "-fps_mode", "passthrough", "-bf", 0]
    clip = write_clip(tmp_path / "clip.mp4", gray_frames(20), options=later)
    ffmpeg("-i", clip, "-c", "copy", tmp_path / "gap.mkv")  # states the mean rate
    info = probe_video(tmp_path / "gap.mkv")
    assert not info.constant_rate
    assert info.fps == 25
    assert frame_numbers(tmp_path / "gap.mkv") == [*range(9), *[9] * 16, *range(10, 20)]


@pytest.mark.parametrize("delay", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize(("suffix", "target"), [("mp4", "out.mp4"), ("mkv", "out.mkv"), ("ts", "out.mp4")])
def test_sound_stays_with_its_frames(tmp_path, suffix, delay, target):
    source = write_beep(tmp_path / f"clip.{suffix}", delay=delay)
    process_video(source, tmp_path / target, StubDetector())
    assert beeps(tmp_path / target) == pytest.approx([0.6], abs=0.02)
    assert probe_video(tmp_path / target).start_time == 0
    process_video(source, tmp_path / target, StubDetector(), start=0.25)
    assert beeps(tmp_path / target) == pytest.approx([0.35], abs=0.02)
    process_video(source, tmp_path / target, StubDetector(), start=0.375, end=0.875)
    assert beeps(tmp_path / target) == pytest.approx([0.225], abs=0.02)
    process_video(source, tmp_path / target, StubDetector(), end=0.75)
    assert sound_seconds(tmp_path / target) == pytest.approx(0.75 - max(-delay, 0), abs=0.07)


def test_sound_of_a_video_that_was_trimmed_without_encoding(tmp_path):
    source, cut = write_beep(tmp_path / "clip.mp4", options=("-g", 12)), tmp_path / "cut.mp4"
    ffmpeg("-ss", 0.3, "-i", source, "-c", "copy", cut)
    process_video(cut, tmp_path / "out.mp4", StubDetector(), start=0.25)
    assert beeps(tmp_path / "out.mp4") == pytest.approx([0.05], abs=0.02)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_varying_rate_becomes_constant(folder, suffix):
    # Frames 0-9 at 10 frames/s, then every third one, as recorded by a phone in the dark.
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


@pytest.mark.parametrize("way", ["with", "close", "drop", "error"])
def test_ffmpeg_ends_however_reading_stops(clip, way):
    before = child_processes()
    frames = read_frames(clip)
    next(frames)
    assert len(child_processes() - before) == 1
    if way == "with":
        with frames:
            next(frames)
    elif way == "close":
        frames.close()
        assert list(frames) == []
    elif way == "drop":
        del frames
        gc.collect()
    else:
        with pytest.raises(ZeroDivisionError), frames:
            raise ZeroDivisionError
    assert child_processes() == before


@pytest.mark.parametrize("suffix", [".mov", ".mkv", ".MP4", ".m4v"])
def test_other_containers(clip, tmp_path, suffix):
    target = tmp_path / f"out{suffix}"
    process_video(clip, target, StubDetector())
    assert frame_numbers(target) == list(range(20))
    assert probe_video(target).has_audio


def test_sound_that_mp4_does_not_support_is_encoded(clip, tmp_path):
    source = tmp_path / "in.mkv"
    ffmpeg("-i", clip, "-c:v", "copy", "-c:a", "pcm_s16le", source)
    process_video(source, tmp_path / "out.mp4", StubDetector())
    assert probe_video(tmp_path / "out.mp4").audio_codec == "aac"
    assert sound_seconds(tmp_path / "out.mp4") == pytest.approx(20 / NTSC, abs=0.06)


@pytest.mark.parametrize(("width", "height"), [(63, 48), (64, 47), (63, 47)])
def test_odd_sizes_are_extended_by_one_pixel(tmp_path, width, height):
    image = np.full((height, width, 3), (200, 120, 40), np.uint8)
    source = write_clip(tmp_path / "odd.mp4", [image] * 4, options=["-pix_fmt", "yuv444p"])
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
    ("pixels", "space"),
    [
        *(("yuv420p", space) for space in ("bt709", "smpte170m", "bt2020nc", "smpte240m")),
        ("yuvj420p", "bt709"),
        ("yuv444p", "bt709"),
    ],
)
def test_frames_have_the_colors_of_ffmpeg(tmp_path, pixels, space):
    range_ = "pc" if pixels == "yuvj420p" else "tv"
    # A smooth image, for which the interpolation of chroma does not matter.
    y, x = np.mgrid[:96, :128]
    picture = np.stack([60 + x, 40 + 2 * y, 250 - x - y // 2], axis=2).astype(np.uint8)
    matrix = f"scale=out_color_matrix={space}:out_range={range_},format={pixels}"
    tags = ["-pix_fmt", pixels, "-colorspace", space, "-color_range", range_]
    source = write_clip(tmp_path / "in.mp4", [picture] * 2, options=["-vf", matrix, *tags])
    with read_frames(source) as frames:
        found = [frame for _, _, frame in frames]
    assert found[0].flags.owndata
    assert found[0].flags.writeable
    decoded = ffmpeg("-i", source, "-frames:v", 1, "-pix_fmt", "rgb24", "-f", "rawvideo", "-")
    expected = np.frombuffer(decoded, np.uint8).reshape(picture.shape)
    assert np.abs(found[0].astype(int) - expected).max() <= 4
    assert np.abs(found[0].astype(int) - picture).mean() < 3


def test_colors_are_unchanged_after_writing_and_reading(tmp_path):
    # The colors of a wrong matrix would differ by at least 15.
    colors = [(220, 40, 40), (40, 200, 40), (40, 40, 220), (230, 230, 30), (128, 128, 128)]
    source = write_clip(tmp_path / "in.mp4", [np.full((48, 64, 3), rgb, np.uint8) for rgb in colors])
    process_video(source, tmp_path / "out.mp4", StubDetector())
    with read_frames(tmp_path / "out.mp4") as frames:
        for (_, _, frame), rgb in zip(frames, colors, strict=True):
            assert np.abs(frame[16:, 16:].mean(axis=(0, 1)) - rgb).max() < 6


@pytest.mark.parametrize(
    ("name", "options"),
    [("cut.mp4", ["-movflags", "+faststart", "-g", 10]), ("cut.mkv", []), ("cut.avi", ["-c:v", "mjpeg"])],
)
def test_the_readable_part_of_an_incomplete_file_is_processed(truncated, tmp_path, name, options):
    source, target = truncated(name, *options), tmp_path / "out.mp4"
    target.write_bytes(b"an existing file")
    message = r"is incomplete: (\d+) of about 100 frames can be decoded; copy it again"
    with pytest.raises(VideoError, match=message) as caught:
        process_video(open_source(source, strict=True), target, StubDetector())
    assert target.read_bytes() == b"an existing file"
    frames = int(re.search(message, str(caught.value))[1])
    assert 20 < frames < 90
    report = process_video(source, target, StubDetector())
    assert report.frames == frames
    assert report.damage == str(caught.value)
    with read_frames(target) as written:
        assert len(list(written)) == frames
    assert not process_video(source, target, StubDetector(), end=0.2).damage


def test_only_the_last_segment_of_a_trip_may_be_cut_off(truncated, tmp_path):
    """After another one, the times and the sound of what follows would be wrong."""
    cut, target = truncated("cut.mkv"), tmp_path / "out.mp4"
    whole = cut.with_name("whole_cut.mkv")
    with pytest.raises(VideoError, match=r"cut\.mkv is incomplete: .*; copy it again, or leave it out"):
        process_video([cut, whole], target, StubDetector())
    assert not target.exists()
    report = process_video([whole, cut], target, StubDetector())
    assert 120 < report.frames < 190
    assert "cut.mkv is incomplete" in report.damage


def test_a_start_after_the_readable_part_says_that_the_file_is_incomplete(truncated, tmp_path):
    cut = truncated("cut_late.mkv")
    with pytest.raises(VideoError, match=r"is incomplete: no frame after 3\.8 s can be decoded; choose an"):
        process_video(cut, tmp_path / "out.mp4", StubDetector(), start=3.8)
