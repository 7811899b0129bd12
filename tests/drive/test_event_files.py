"""Files of events, and clips."""

import csv
import json

import numpy as np
import pytest

from tests.video.clips import write_clip
from vehicle_detection import InvalidInputError, probe_video, write_events
from vehicle_detection.drive import EVENT_COLUMNS, Event, cut_clips

EVENTS = [
    Event(kind="cut_in", track_id=2, frame=20, start_frame=12, end_frame=24, time_s=0.8, side="left",
          distance_m=12.5, distance_std_m=1.5),
    Event(kind="met", track_id=3, frame=49, start_frame=44, end_frame=49, time_s=1.96),
]  # fmt: skip


def test_csv_and_json_hold_the_same(tmp_path):
    table, document = tmp_path / "events.csv", tmp_path / "events.json"
    assert write_events([], table) == 0
    assert table.read_text() == ",".join(EVENT_COLUMNS) + "\n"
    assert write_events(EVENTS, table) == write_events(EVENTS, document) == 2
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    objects = json.loads(document.read_text())
    assert tuple(rows[0]) == tuple(objects[0]) == EVENT_COLUMNS
    assert [Event(**each) for each in objects] == EVENTS
    assert [{k: "" if v is None else str(v) for k, v in each.items()} for each in objects] == rows


def test_other_objects_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="events must be an Event, got 1; pass what find_events"):
        write_events([1], tmp_path / "events.csv")


def test_clips_show_the_frames_around_each_event(tmp_path):
    video = tmp_path / "found.mp4"
    write_clip(video, [np.full((64, 96, 3), frame * 4, np.uint8) for frame in range(50)])
    (tmp_path / "clips").mkdir()
    first, second = cut_clips(EVENTS, video, tmp_path / "clips", fps=25, margin=0.2)
    assert [first.name, second.name] == ["0000.8s_cut_in_2.mp4", "0002.0s_met_3.mp4"]
    assert probe_video(first).frames == 12 + 1 + 10
    assert probe_video(second).frames == 5 + 1 + 5
    with pytest.raises(InvalidInputError, match=r"folder .* does not exist; create it"):
        cut_clips(EVENTS, video, tmp_path / "none", fps=25)
