import csv
import json
import re
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.commands import HEADER, contents, refuse, refuse_each, run, succeed
from tests.helpers import failing
from tests.video.clips import damage_sizes, write_clip
from vehicle_detection import (
    DrawParams,
    InvalidInputError,
    TrackTable,
    probe_video,
    read_frames,
    render_drive,
    video,
)
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.cli.horizon import warn_of_contradiction
from vehicle_detection.cli.options import parse_time
from vehicle_detection.cli.video import read_speed
from vehicle_detection.tracking import HorizonEstimate
from vehicle_detection.video import FrameSource, list_files


def test_the_segments_of_a_card_become_one_video(material, tmp_path):
    card = tmp_path / "card"
    card.mkdir()
    for second in range(3):
        shutil.copy(material / "clip.mp4", card / f"20260131_08150{second}_F.mp4")
    shutil.copy(material / "clip.mp4", card / "20260131_081500_R.mp4")
    error = refuse("video", card, "-o", tmp_path / "trip.mp4")
    assert "holds 2 trips (front" in error
    out = succeed("video", card / "*_F.mp4", "-o", tmp_path / "trip.mp4", "--tracks", tmp_path / "t.csv")
    assert out.startswith(f"{3 * probe_video(material / 'clip.mp4').frames} frames")
    assert contents(tmp_path)[-2:] == ["t.csv", "trip.mp4"]


def test_video_takes_the_camera(tmp_path):
    tables = {}
    clip = tmp_path / "clip.mp4"
    drive = render_drive(frames=8, shape=(360, 640), scenario="crossing", random_state=1)
    draw_clip(drive, clip, tmp_path / "labels.csv")
    camera = tmp_path / "camera.json"
    camera.write_text('{"fov": 120, "height_m": 1.3}')
    for words in ((), ("--fov", 58), ("--fov", 120, "--camera-height", 1.3), ("--camera", camera)):
        tracks = tmp_path / "tracks.csv"
        result = run("video", clip, "-o", tmp_path / "out.mp4", "--tracks", tracks, *words)
        assert result.exit_code == 0
        rows = [row for row in csv.DictReader(tracks.read_text().splitlines()) if row["distance_m"]]
        assert rows
        warned = "warning: distances assume a lens of 58 degrees" in result.stderr
        assert warned == (not words)
        tables[words] = {(row["frame"], row["track_id"]): float(row["distance_m"]) for row in rows}
    standard, wide, file = (tables[words] for words in list(tables)[1:])
    ratios = [wide[key] / standard[key] for key in wide.keys() & standard.keys()]
    assert np.median(ratios) == pytest.approx(0.32, abs=0.06)
    ratios = [wide[key] / file[key] for key in wide.keys() & file.keys()]
    assert ratios == pytest.approx([1.0] * len(ratios), rel=0.02)


def test_video_writes_an_annotated_copy_and_tracks(clip, tmp_path):
    target, tracks = tmp_path / "out.mp4", tmp_path / "tracks.csv"
    out = succeed("video", clip, "-o", target, "--tracks", tracks, "--preset", "ultrafast", "--profile")
    lines = out.splitlines()
    assert re.match(r"10 frames of 480x270 in \d+\.\d s: .* frames/s, .* real time, \d+ vehicle", lines[0])
    stages = ["stage", "decode", "search", "regions", "track", "draw", "encode"]
    assert [line.split()[0] for line in lines[1:8]] == stages
    assert lines[-1] == f"wrote {target}, {tracks}"
    assert tracks.read_text().splitlines()[0] == (
        f"{HEADER},distance_m,speed_mps,confidence,distance_std_m,speed_std_mps,label,time_s"
    )
    written, source = probe_video(target), probe_video(clip)
    assert (written.shape, written.fps, written.frames) == (source.shape, source.fps, source.frames)
    assert contents(tmp_path) == ["out.mp4", "tracks.csv"]


def test_video_prints_its_progress_where_no_bar_is_shown(clip, tmp_path, monkeypatch):
    words = ["video", clip, "--tracks", tmp_path / "t.parquet", "--fov", 58]
    result = run(*words)
    assert "frames/s" not in result.stderr  # shorter than a minute
    assert result.stdout.endswith(f"wrote {tmp_path / 't.parquet'}\n")
    assert contents(tmp_path) == ["t.parquet"]
    monkeypatch.setattr("vehicle_detection.video.engine._LOG_INTERVAL", 0.0)
    assert re.search(r"^note: 0:00 of 0:00, \d+ frames/s$", run(*words).stderr, re.MULTILINE)
    assert "frames/s" not in run(*words, "--quiet").stderr


def test_video_writes_a_page_and_diagnostics(clip, tmp_path):
    target, page = tmp_path / "out.mp4", tmp_path / "page.html"
    words = ["--report", page, "--diagnostics", "--preset", "ultrafast"]
    out = succeed("video", clip, "-o", target, *words)
    assert out.splitlines()[-1] == f"wrote {target}, {page}"
    text = page.read_text(encoding="utf-8")
    assert "data:video/mp4;base64," in text
    assert clip.name in text
    with read_frames(target) as frames:
        mosaic = next(frames)[2]
    # The heat map is black in an empty corner of the road; no frame of the clip is.
    assert mosaic[-8:, :8].max() < 40


def test_video_writes_events_and_a_summary(clip, tmp_path):
    target, events, clips = tmp_path / "out.mp4", tmp_path / "events.json", tmp_path / "clips"
    words = ["--events", events, "--clips", clips, "--own-speed", 100, "--preset", "ultrafast"]
    lines = succeed("video", clip, "-o", target, *words).splitlines()
    assert re.search(r"overtook \d+ vehicles?, was overtaken by \d+, met \d+ oncoming.* in view on", lines[1])
    assert lines[-1] == f"wrote {target}, {events}, {clips}"
    found = json.loads(events.read_text())
    assert [path.suffix for path in clips.iterdir()] == [".mp4"] * len(found)


def test_video_explains_each_vehicle_in_the_report(tmp_path):
    drive, page = tmp_path / "drive.mp4", tmp_path / "page.html"
    draw_clip(render_drive(frames=12, shape=(360, 640), scenario="traffic"), drive, tmp_path / "labels.csv")
    words = ["video", drive, "-o", tmp_path / "out.mp4", "--report", page, "--preset", "ultrafast"]
    succeed(*words, "--start", 0.2, "--why", "--blur", "vehicles")
    text = page.read_text()
    listed = re.findall(r'<th scope="row"><span class="dot c\d"></span>#(\d+)', text)
    explained = re.findall(r"<h3>#(\d+) at .*?</h3><p>A vehicle is found here: ", text)
    assert sorted(explained) == sorted(listed) != []
    succeed(*words)
    assert "Why these boxes" not in page.read_text()


def test_a_source_that_is_read_once_is_not_opened_again(clip, tmp_path, monkeypatch):
    """Such as a camera or a named pipe, whose path exists."""
    monkeypatch.setattr(FrameSource, "rereadable", False)
    words = ["video", clip, "-o", tmp_path / "out.mp4", "--preset", "ultrafast"]
    page = tmp_path / "page.html"
    assert "--why needs a source that can be read again" in refuse(*words, "--report", page, "--why")
    assert contents(tmp_path) == []
    result = run(*words, "--horizon", 0.95, "--model", "highway")
    assert result.exit_code == 0
    assert "no vehicle was found" not in result.stderr


def test_video_writes_subtitles_with_the_own_speed(clip, tmp_path):
    target, subtitles, speed = tmp_path / "out.mp4", tmp_path / "out.srt", tmp_path / "speed.csv"
    speed.write_text("time_s,speed_kmh\n100,90\n101,90\n")
    words = ["video", clip, "-o", target, "--srt", subtitles, "--gpx", speed, "--preset", "ultrafast"]
    assert run(*words, "--gpx-offset", 100).stderr.count("own speed") == 0
    assert "own speed 90 km/h" in subtitles.read_text()
    warning = "warning: the own speed is known for 0% of the video; check --gpx-offset"
    result = run(*words, "--units", "imperial")
    assert (result.exit_code, warning in result.stderr) == (0, True)
    assert "own speed" not in subtitles.read_text()
    assert "warning" not in run(*words, "--quiet").stderr


def test_a_damaged_video_has_an_exit_code_of_its_own(clip, tmp_path):
    lost, target = damage_sizes(clip, tmp_path / "lost.mp4", entry=3, byte=0, flip=64), tmp_path / "out.mp4"
    result = run("video", lost, "-o", target, "-q")
    assert result.exit_code == 3
    # Some versions of ffmpeg also report an error.
    assert result.stderr.startswith(f"warning: {lost} is damaged: 7 of 10 frames cannot be decoded")
    assert result.stderr.endswith("; copy or record it again\n")
    with read_frames(target) as frames:
        assert len(list(frames)) == 3
    target.unlink()
    assert "7 of 10 frames cannot be decoded" in refuse("video", lost, "-o", target, "--strict")
    assert contents(tmp_path) == ["lost.mp4"]


def test_video_can_be_quiet_and_take_a_part(clip, tmp_path):
    target = tmp_path / "out.mov"
    words = ["--start", 0.08, "--end", 0.2, "--horizon", 0.56, "--no-audio", "--quiet"]
    assert run("video", clip, "-o", target, *words).output == ""
    assert probe_video(target).frames == 3
    out = succeed("video", clip, "-o", target, *words, "--profile")
    assert out.startswith("3 frames of 480x270")
    assert "wrote" not in out


def test_video_draws_as_asked(clip, tmp_path, monkeypatch):
    drawn = []
    process = video.process_video

    def watch(source, target, detector, **options):
        drawn.append(detector.annotator.style)
        return process(source, target, detector, **options)

    monkeypatch.setattr("vehicle_detection.process_video", watch)
    target = tmp_path / "out.mp4"
    succeed("video", clip, "-o", target, "--end", 0.1)
    words = ["--labels", "id, score", "--line-width", 3, "--color-by", "distance", "--panel", "side"]
    succeed("video", clip, "-o", target, "--end", 0.1, *words)
    assert probe_video(target).shape == (270, 480 + 82, 3)
    succeed("video", clip, "-o", target, "--end", 0.1, "--labels", "none", "--panel", "corner")
    assert probe_video(target).shape == (270, 480, 3)
    wide = DrawParams(labels=("id", "score"), line_width=3, color_by="distance", panel="side")
    assert drawn == [DrawParams(), wide, DrawParams(labels=(), panel="corner")]


def test_video_estimates_the_horizon(clip, tmp_path, monkeypatch):
    words = ["video", clip, "-o", tmp_path / "out.mp4", "--end", 0.12, "--horizon", "auto"]
    found = HorizonEstimate(horizon=0.551, horizon_std=0.012, camera_height_m=1.3, n_boxes=40)
    monkeypatch.setattr(video, "estimate_video_horizon", lambda *_, **__: found)
    assert "horizon 0.551 (standard error 0.012, 40 boxes)" in succeed(*words)
    monkeypatch.setattr(video, "estimate_video_horizon", lambda *_, **__: None)
    result = run(*words)
    assert result.exit_code == 0
    assert "warning: --horizon auto: too few vehicles to estimate the horizon; searching" in result.stderr
    assert run(*words, "--quiet").output == ""


BAD_VIDEOS = {
    "missing.mp4 -o out.mp4": "SOURCE missing.mp4 does not exist",
    "{material}/empty -o out.mp4": "SOURCE .+empty holds no videos and no images",
    "{material}/text.mp4 -o out.mp4": "text.mp4 is a text file, not a video",
    "{material}/cut_clip.mp4 -o out.mp4": "cut_clip.mp4 is not a video .*its index is missing",
    "none.mp4 -o out.mp4": "none.mp4 (has no|is not a video)",
    "tiny.mp4 -o out.mp4 --model highway": "image of 32x32 pixels holds no search window",
    "{clip} -o {clip}": "--output .+clip.mp4 is also SOURCE",
    "{clip} -o none/out.mp4": "--output needs an existing folder",
    "{clip} -o out.gif": "--output must end in .mp4 or .* got 'out.gif'",
    "{clip} -o out.mp4 --start 3 --end 2": "--end must be later than the start; got 3 s to 2 s",
    "{clip} -o out.mp4 --start 1:00:06.5": "--start must be less .* 0.4 s; got 3606.5 s",
    "{clip} -o out.mp4 --end 1:2:": r"--end must be a time in seconds or as \[H:\]M:S, .*, got '1:2:'",
    "{clip} -o out.mp4 --panel side --diagnostics": "--panel .*--diagnostics; omit one of them",
    "{clip} -o out.mp4 --horizon high": "--horizon must be a fraction .* or auto, got 'high'",
    "{clip} -o out.mp4 --tracks t.doc": r"--tracks must end in .csv or .*, got 't.doc'; write 't.csv'\n",
    "{clip} -o out.mp4 --tracks none/t.csv": "--tracks needs an existing folder",
    "{clip} -o out.mp4 --report page.pdf": "--report must end in .html or .htm, got 'page.pdf'",
    "{clip} -o out.mp4 --report out.mp4": "--report .+ is also --output .+;",
    "http://host/a.mp4 --report r.html": "--output must name a video for --report, .* add it",
    "0 --show --clips clips": "--output must name a video for --clips, .* add it",
    "{clip} --tracks t.csv --blur plates": "--output must name a video for --blur",
    "0": "--output must name the video to write; or use --show",
    "{clip} -o out.mp4 --events e.txt": "--events must end in .csv or .json, got 'e.txt'",
    "{clip} -o out.mp4 --srt s.txt": "--srt must end in .srt or .ass, got 's.txt'",
    "{clip} -o out.mp4 --gpx {clip}": "--gpx must end in .gpx or .nmea or .csv, got 'clip.mp4'",
    "{clip} -o out.mp4 --gpx none.gpx": "--gpx none.gpx does not exist",
    "{clip} -o out.mp4 --own-speed 9 --gpx a.gpx": "--own-speed and --gpx both .* give one of them",
    "{clip} -o out.mp4 --gpx-offset 9": "--gpx-offset needs --gpx; give the file",
    "{clip} -o out.mp4 --why": "--why needs --report, .* add it",
    "{clip} -o out.mp4 --clips {clip}": "--clips must be a folder",
    "{clip} -o out.mp4 --clips-of met": "--clips-of needs --clips",
    "{clip} -o out.mp4 --clips clips --clips-of met,cutin": "--clips-of must be one of .*; got 'cutin'",
    "a.csv -o out.mp4 --tracks a.csv": "--tracks a.csv is also SOURCE a.csv;",
}
# Whatever the horizon, and refused before it is estimated.
BAD_CAMERAS = {
    "{clip} -o out.mp4 --camera wide-90 --fov 90": "--fov must be omitted with a camera",
    "{clip} -o out.mp4 --camera gopro": "--camera must be one of standard-58, .* or state the lens",
    "{clip} -o out.mp4 --camera lens.json": "--camera must be one for frames of 480x270",
}


def test_video_refuses_bad_input_and_changes_no_file(material, clip, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "estimate_video_horizon", failing(AssertionError("estimated")))
    monkeypatch.chdir(tmp_path)
    for name, size, frames in (("tiny.mp4", (32, 32), 3), ("none.mp4", (64, 64), 0)):
        writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"mp4v"), 25, size)
        for _ in range(frames):
            writer.write(np.zeros((*size, 3), np.uint8))
        writer.release()
    Path("lens.json").write_text('{"image_size": [640, 480], "focal_px": 600}')
    before, original = (contents(tmp_path), contents(material)), clip.read_bytes()
    files = {"material": material, "clip": clip}
    refuse_each("video", BAD_VIDEOS, **files)
    early = [line for line in BAD_VIDEOS if "--horizon" not in line and "tiny" not in line]
    cases = BAD_CAMERAS | {line: BAD_VIDEOS[line] for line in early[::12]}
    refuse_each("video", {f"{line} --horizon auto": text for line, text in cases.items()}, **files)
    assert (contents(tmp_path), contents(material)) == before
    assert clip.read_bytes() == original


@pytest.mark.realdata
def test_the_course_clip_by_command(real_data, tmp_path):
    source, target = real_data / "videos" / "test_video.mp4", tmp_path / "out.mp4"
    began = time.process_time()  # of this program, however busy the machine is
    succeed("video", source, "-o", target, "--tracks", tmp_path / "tracks.csv", "--preset", "ultrafast")
    assert time.process_time() - began < 60
    assert probe_video(target).has_audio
    labels = real_data / "labels" / "test_video.csv"
    scores = tmp_path / "scores.json"
    succeed("evaluate", tmp_path / "tracks.csv", labels, "--json", scores)
    track_scores = json.loads(scores.read_text())["tracks"]
    assert track_scores["f1"] == 1.0
    assert track_scores["mean_iou"] >= 0.7


def test_a_piped_video_whose_index_is_at_its_end_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (20, 180, 320, 3), np.uint8)
    clip = write_clip(tmp_path / "noise.mp4", list(noise))
    words = [sys.executable, "-m", "vehicle_detection", "video", "-", "-o", str(tmp_path / "out.mp4")]
    result = subprocess.run(words, input=clip.read_bytes(), capture_output=True, check=False)
    assert result.returncode == 2
    assert b"pass the file's path, because MP4 needs its index at the start" in result.stderr


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("12", 12), ("0.5", 0.5), ("-1", -1), ("12:00", 720), ("00:12:00", 720), (" 1:02:06.5", 3726.5)],
)
def test_times_in_seconds_or_as_players_show_them(text, seconds):
    assert parse_time(text, "--start") == seconds


@pytest.mark.parametrize("text", ["", "noon", "1:2:3:4", "-1:00", "1:200", "12.5:00", "5s"])
def test_times_that_cannot_be_read(text):
    with pytest.raises(InvalidInputError, match=r"^--end must be a time in seconds or as \[H:\]M:S"):
        parse_time(text, "--end")


@pytest.mark.parametrize(("text", "mps"), [("100", 100 / 3.6), ("62mph", 62 * 0.44704), ("90 km/h", 25.0)])
def test_own_speed_in_units(text, mps):
    assert read_speed(text, None, 0.0).at([1.0]) == pytest.approx(mps)


@pytest.mark.parametrize("text", ["fast", "-5", "501", "10 m/s"])
def test_own_speed_that_cannot_be_read(text):
    with pytest.raises(InvalidInputError, match="--own-speed must be a speed of at most 500, such as 100"):
        read_speed(text, None, 0.0)


def test_the_copy_is_named_after_its_source_and_replaces_no_file(clip, tmp_path, monkeypatch):
    source = tmp_path / "drive.mp4"
    shutil.copy(clip, source)
    (tmp_path / "other").mkdir()
    for words, written in (
        ((), "drive_tracked.mp4"),
        ((), "drive_tracked_2.mp4"),
        (("--report", tmp_path / "r.html"), "drive_tracked_3.mp4"),
        (("-o", tmp_path / "other"), "other/drive_tracked.mp4"),
    ):
        assert f"wrote {tmp_path / written}" in succeed("video", source, "--end", 0.1, *words)
    assert list_files(f"{tmp_path}/*") == [source]  # no copies
    before = contents(tmp_path)
    succeed("video", source, "--end", 0.1, "--tracks", tmp_path / "t.csv")
    assert contents(tmp_path) == sorted([*before, "t.csv"])
    monkeypatch.chdir(tmp_path / "other")
    assert f"wrote {tmp_path}/other_tracked.mp4" in succeed("video", ".", "--end", 0.1)


def test_a_stated_horizon_that_the_sizes_of_the_vehicles_contradict_is_named(capsys):
    height = np.repeat(np.arange(40.0, 200, 10), 25)
    middle, bottom = np.full(len(height), 600.0), 396 + 0.9 * height  # horizon 0.55
    boxes = np.stack([middle - height / 2, bottom - height, middle + height / 2, bottom], axis=1)
    table = TrackTable(np.arange(len(boxes)), np.ones(len(boxes), int), boxes)
    check = partial(warn_of_contradiction, table=table, shape=(720, 1280), fps=25, height_m=None)
    check(0.53)
    warn_of_contradiction(0.3, TrackTable(), (720, 1280), fps=25, height_m=None)
    assert capsys.readouterr().err == ""
    check(0.45)
    assert "suggest a horizon of 0.55 (standard error 0.01) instead of 0.45" in capsys.readouterr().err
