"""Subtitles of what a video shows."""

import dataclasses
import re
import subprocess

import numpy as np
import pytest

from tests.drawing.cases import track
from tests.video.clips import write_clip
from vehicle_detection import InvalidInputError, TrackTable, write_subtitles
from vehicle_detection.drive import Event, OwnSpeed
from vehicle_detection.video.ffmpeg import ffmpeg_binary

EVENT = Event(
    kind="cut_in", track_id=1, frame=15, start_frame=12, end_frame=20, time_s=1.5, side="left",
    distance_m=20.0, distance_std_m=2.0,
)  # fmt: skip


def drive(seconds=6, fps=10, *, first_time=0.0, **changes):
    """Log of a vehicle from second 1 to 4, and of a farther one from second 3 on."""
    table = TrackTable()
    for frame in range(round(seconds * fps)):
        time = frame / fps
        tracks = [track(id=1, distance_m=20.0, **changes)] if 1 <= time < 4 else []
        tracks += [track(id=2, distance_m=50.0, distance_std_m=20.0)] if time >= 3 else []
        table.append(frame, first_time + time, tracks)
    return table


def read_cues(path):
    """Times and lines of each subtitle of an .srt file."""
    blocks = path.read_text().strip().split("\n\n")
    assert [block.splitlines()[0] for block in blocks] == [str(n + 1) for n in range(len(blocks))]
    return {block.splitlines()[1]: block.splitlines()[2:] for block in blocks}


def test_each_second_says_what_is_shown(tmp_path):
    path = tmp_path / "found.srt"
    assert write_subtitles(drive(5.5), path, fps=10) == 4
    assert read_cues(path) == {
        "00:00:00,000 --> 00:00:01,000": ["no vehicle"],
        "00:00:01,000 --> 00:00:03,000": ["1 vehicle, nearest #1: 20 m, -6 km/h relative"],
        "00:00:03,000 --> 00:00:04,000": ["2 vehicles, nearest #1: 20 m, -6 km/h relative"],
        "00:00:04,000 --> 00:00:05,500": ["1 vehicle, nearest #2: ~50 m, -6 km/h relative"],
    }


def test_events_are_shown_for_three_seconds(tmp_path):
    path = tmp_path / "found.srt"
    write_subtitles(drive(), path, fps=10, events=[EVENT], units="imperial")
    shown = [times for times, lines in read_cues(path).items() if "cut-in" in lines[-1]]
    assert (shown[0][:12], shown[-1][-12:]) == ("00:00:01,000", "00:00:04,000")
    assert read_cues(path)[shown[0]] == [
        "1 vehicle, nearest #1: 66 ft, -4 mph relative",
        "vehicle 1 cut-in, on the left, distance 65.6 ± 6.6 ft",
    ]


def test_speeds_over_ground_where_the_own_speed_is_known(tmp_path):
    """The own speed counts from the start of the source, here 100 s before the first frame."""
    path = tmp_path / "found.srt"
    own = OwnSpeed([100.0, 101, 102, 103], [25.0] * 4)
    write_subtitles(drive(first_time=100.0), path, fps=10, own_speed=own)
    cues = list(read_cues(path).values())
    assert cues[0] == ["own speed 90 km/h", "no vehicle"]
    assert cues[1] == ["own speed 90 km/h", "1 vehicle, nearest #1: 20 m, 84 km/h"]
    assert cues[2] == ["2 vehicles, nearest #1: 20 m, -6 km/h relative"]


def test_oncoming_vehicles_and_unknown_values(tmp_path):
    path = tmp_path / "found.srt"
    own = OwnSpeed.constant(25.0)
    write_subtitles(drive(speed_mps=-45.0), path, fps=10, own_speed=own)
    second = "00:00:01,000 --> 00:00:03,000"
    assert read_cues(path)[second][1] == "1 vehicle, nearest #1: 20 m, 72 km/h, oncoming"
    write_subtitles(drive(speed_std_mps=9.0), path, fps=10)
    assert read_cues(path)[second] == ["1 vehicle, nearest #1: 20 m"]
    unknown = TrackTable()
    unknown.append(0, None, [dataclasses.replace(track(), distance_m=None)])
    write_subtitles(unknown, path, fps=10)
    assert list(read_cues(path).values()) == [["1 vehicle"]]


@pytest.mark.parametrize("suffix", [".srt", ".ass"])
def test_players_read_both_formats(tmp_path, suffix):
    clip, target = tmp_path / "clip.mp4", tmp_path / f"found{suffix}"
    write_clip(clip, [np.zeros((64, 96, 3), np.uint8)] * 10)
    write_subtitles(drive(), target, fps=10, events=[EVENT], own_speed=OwnSpeed.constant(20.0))
    command = [ffmpeg_binary(), "-v", "error", "-i", target, "-f", "srt", "-"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    text = re.sub(r"<[^>]*>", "", done.stdout)
    assert "own speed 72 km/h\n" in text
    assert "vehicle 1 cut-in, on the left, distance 20.0 ± 2.0 m" in text


def test_empty_and_long_videos(tmp_path):
    assert write_subtitles(TrackTable(), tmp_path / "a.srt", fps=25) == 0
    assert (tmp_path / "a.srt").read_text() == ""
    table = TrackTable()
    for frame in range(3700):
        table.append(frame, float(frame), [])
    write_subtitles(table, tmp_path / "a.srt", fps=1)
    assert "--> 01:01:40,000" in (tmp_path / "a.srt").read_text()
    write_subtitles(table, tmp_path / "a.ass", fps=1)
    assert "Dialogue: 0,0:00:00.00,1:01:40.00,Default,,0,0,0,,no vehicle" in (tmp_path / "a.ass").read_text()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": "found.txt"}, r"path must end in .srt or .ass, got 'found.txt'; write 'found.srt'"),
        ({"path": "none/found.srt"}, "path needs an existing folder"),
        ({"own_speed": 25.0}, "own_speed must be an OwnSpeed, got 25.0; pass what read_own_speed returns"),
    ],
)
def test_bad_arguments_are_refused(changes, message, tmp_path):
    options = {"table": TrackTable(), "path": "found.srt", "fps": 25} | changes
    with pytest.raises(InvalidInputError, match=message):
        write_subtitles(options.pop("table"), tmp_path / options.pop("path"), **options)
    assert list(tmp_path.iterdir()) == []
