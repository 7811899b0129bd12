import math
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.test_history import PRESENCE, table_of
from vehicle_detection.drive.motion import track_histories
from vehicle_detection.drive.report import TimeAxis, assign_rows, format_time


@given(st.integers(1, 2_000_000), st.sampled_from([5.0, 25.0, 29.97, 60.0]))
def test_ticks_of_a_time_axis_lie_in_the_video(frames, fps):
    axis = TimeAxis(frames, fps)
    ticks = axis.ticks()
    assert ticks[0] == 0
    assert 1 <= len(ticks) <= 7
    assert ticks[-1] <= axis.seconds + 1e-9
    assert math.ceil(frames / axis.bin_width) <= 2000


@given(PRESENCE)
def test_tracks_that_share_a_row_do_not_overlap(frames):
    tracks = track_histories(table_of(frames))
    rows = assign_rows(tracks, TimeAxis(max(len(frames), 1), 25.0))
    for (one, row), (other, same) in combinations(zip(tracks, rows), 2):
        assert row != same or one.last < other.first
    assert sorted(set(rows)) == list(range(len(set(rows))))


@given(st.floats(0, 1e5))
def test_times_carry_when_they_are_rounded(seconds):
    text = format_time(seconds)
    *hours, minutes, rest = text.split(":")
    assert float(rest) < 60
    total = sum(int(part) * unit for part, unit in zip([*hours[:1], minutes][::-1], (60, 3600)))
    assert total + float(rest) == pytest.approx(seconds, abs=0.051)
