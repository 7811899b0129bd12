"""The card of a dash-cam: many short segments of two cameras."""

import numpy as np
import pytest

from tests.drive.batch_helpers import check_whole, counts, run
from tests.video.clips import write_clip
from vehicle_detection import TrackTable, evaluate_tracks, probe_video, read_labels, render_drive
from vehicle_detection.drive import find_trips

pytestmark = pytest.mark.usefixtures("private_scratch")

FRAMES, SEGMENTS = 15, 4  # in each segment, which is a second long


def test_a_card_of_many_segments_is_one_trip_with_one_identity_per_vehicle(tmp_path, out):
    card = tmp_path / "card"
    card.mkdir()
    scenes = list(render_drive(frames=FRAMES, shape=(360, 640), scenario="traffic"))
    # A loop without a jump: forward, then backward.
    order = [*range(FRAMES), *reversed(range(FRAMES))] * (SEGMENTS // 2)
    for segment in range(SEGMENTS):
        frames = [scenes[number].image for number in order[segment * FRAMES :][:FRAMES]]
        write_clip(card / f"20260131_0815{segment:02}_F.mp4", frames, fps=FRAMES)
        if segment < 2:
            mirrored = [np.ascontiguousarray(frame[:, ::-1]) for frame in frames]
            write_clip(card / f"20260131_0815{segment:02}_R.mp4", mirrored, fps=FRAMES)
    trips = find_trips(card.iterdir(), duration=lambda file: probe_video(file).duration)
    assert [(trip.camera, len(trip.files)) for trip in trips] == [("front", SEGMENTS), ("rear", 2)]
    report = run(card, out, "default", tracks_only=True, options={"fov": 58})
    assert counts(report) == (2, 0, 0, 0)
    found = {record["camera"]: record for record in check_whole(out, done=2, failed=0).values()}
    assert found["front"]["frames"] == FRAMES * SEGMENTS
    assert found["rear"]["frames"] == FRAMES * 2

    rows = [(frame, row) for frame, number in enumerate(order) for row in scenes[number].truth]
    truth = TrackTable(
        [frame for frame, _ in rows],
        [row.track for _, row in rows],
        [row.box for _, row in rows],
        ignore=np.array([row.hard_to_see for _, row in rows], bool),
    )
    tracks = read_labels(out / found["front"]["outputs"]["tracks"])
    scores = evaluate_tracks(tracks, truth, frames=range(len(order)))
    # The same identities before and after each of the cuts.
    assert (scores.id_switches, scores.fragmentations) == (0, 0)
    assert len(set(tracks["track_id"].tolist())) == scores.tracks == found["front"]["tracks"] == 3
    assert scores.f1 > 0.99
