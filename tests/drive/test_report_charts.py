import math
from itertools import combinations, pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.drive.test_history import PRESENCE, table_of
from vehicle_detection.drive.motion import track_histories
from vehicle_detection.drive.report_charts import (
    Label,
    TimeAxis,
    ValueAxis,
    assign_rows,
    format_time,
    separate_labels,
)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.booleans())
def test_a_value_axis_covers_its_values_with_round_ticks(one, other, integers):
    low, high = min(one, other), max(one, other)
    assume(high - low > 1e-3)
    axis = ValueAxis.covering(low, high, 100, integers=integers)
    assert axis.low <= low + 1e-6 * (high - low)
    assert axis.high >= high - 1e-6 * (high - low)
    assert 2 <= len(axis.ticks) <= 7
    assert axis.ticks[0] == axis.low
    assert axis.ticks[-1] == axis.high
    assert all(after > before for before, after in pairwise(axis.ticks))
    assert axis.y(axis.low) == pytest.approx(100)
    assert axis.y(axis.high) == 0
    if integers:
        assert all(tick == round(tick) for tick in axis.ticks)


@given(st.integers(1, 2_000_000), st.sampled_from([5.0, 25.0, 29.97, 60.0]))
def test_ticks_of_a_time_axis_lie_in_the_video(frames, fps):
    axis = TimeAxis(frames, fps)
    ticks = axis.ticks()
    assert ticks[0] == 0
    assert 1 <= len(ticks) <= 7
    assert ticks[-1] <= axis.seconds + 1e-9
    assert math.ceil(frames / axis.bin_width) <= 2000


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(-10, 160)), max_size=20))
def test_labels_do_not_overlap(places):
    labels = [Label(x, y, number) for number, (x, y) in enumerate(places)]
    kept = separate_labels(labels, 150)
    for one, other in combinations(kept, 2):
        assert abs(one.x - other.x) >= 5 or abs(one.y - other.y) >= 13 - 1e-9
    assert all(0 < label.y <= 150 for label in kept)
    for label in kept:
        x, y = places[label.track]
        assert label.x == x
        assert abs(label.y - min(max(y, 13), 148)) <= 1.5 * 13
    assert len({label.track for label in kept}) == len(kept)


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
