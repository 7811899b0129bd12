"""Counts by minute."""

from tests.drive.report_helpers import track
from vehicle_detection import TrackTable, count_vehicles
from vehicle_detection.drive import Event


def event(kind, frame):
    frames = dict.fromkeys(("frame", "start_frame", "end_frame"), frame)
    return Event(kind=kind, track_id=1, time_s=frame / 2, **frames)


def test_counts_are_the_sums_of_their_minutes():
    table = TrackTable()
    for frame in range(290):  # 145 s
        table.append(frame, None, [track(number) for number in range(1, 2 + (frame >= 120))])
    events = [event("met", 10), event("met", 130), event("we_overtook", 119), event("overtook_us", 289)]
    events += [event("passed", 240), event("cut_in", 20)]
    counts = count_vehicles(events, table, fps=2)
    assert [(minute.start_s, minute.seconds) for minute in counts.minutes] == [(0, 60), (60, 60), (120, 25)]
    assert [minute.met for minute in counts.minutes] == [1, 1, 0]
    assert [minute.we_overtook for minute in counts.minutes] == [1, 0, 0]
    assert [minute.mean_in_view for minute in counts.minutes] == [1, 2, 2]
    for name in ("met", "we_overtook", "overtook_us", "passed", "seconds"):
        assert sum(getattr(minute, name) for minute in counts.minutes) == getattr(counts.total, name)
    assert (counts.vehicles, counts.total.max_in_view) == (2, 2)
    assert counts.summary().startswith(
        "overtook 1 vehicle, was overtaken by 1, met 2 oncoming, passed 1 other; 1.6 vehicles in view"
    )
