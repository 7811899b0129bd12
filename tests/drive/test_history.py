"""The tracks of a table, one by one."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.report_helpers import track
from vehicle_detection import TrackTable
from vehicle_detection.drive import OwnSpeed, own_speeds
from vehicle_detection.drive.motion import TrackHistory, bin_means, track_histories

PRESENCE = st.lists(st.sets(st.integers(1, 4)), max_size=40)


def table_of(frames):
    """Table of the ids of the tracks in each frame."""
    table = TrackTable()
    for index, numbers in enumerate(frames):
        table.append(index, None, [track(number, distance=index + number) for number in sorted(numbers)])
    return table


@given(PRESENCE)
def test_histories_have_the_frames_and_values_of_each_track(frames):
    table = table_of(frames)
    histories = track_histories(table)
    assert {each.id for each in histories} == set().union(*frames)
    for each in histories:
        assert each.frames.tolist() == [index for index, numbers in enumerate(frames) if each.id in numbers]
        assert each.columns["distance_m"].tolist() == [index + each.id for index in each.frames]
        spans = each.spans()
        assert [index for start, stop in spans for index in range(start, stop)] == each.frames.tolist()
        assert all(stop < start for (_, stop), (start, _) in pairwise(spans))
    order = [(each.first, each.id) for each in histories]
    assert order == sorted(order)


@given(st.sets(st.integers(0, 60), min_size=1), st.integers(1, 10), st.data())
def test_bins_hold_the_means_of_known_values(frames, width, data):
    frames = np.array(sorted(frames))
    size = {"min_size": len(frames), "max_size": len(frames)}
    values = np.array(data.draw(st.lists(st.floats(-100, 100) | st.just(math.nan), **size)))
    bins, means = bin_means(frames, values, width)
    groups = {}
    for frame, value in zip(frames, values):
        if not math.isnan(value):
            groups.setdefault(frame // width, []).append(value)
    assert bins.tolist() == sorted(groups)
    assert means == pytest.approx([np.mean(groups[number]) for number in sorted(groups)], abs=1e-9)


def history(frames, distances):
    columns = {name: np.full(len(frames), math.nan) for name in ("speed_mps", "speed_std_mps", "confidence")}
    columns["distance_m"] = np.array(distances, float)
    columns["distance_std_m"] = np.ones(len(frames))
    return TrackHistory(1, np.array(frames, np.int64), np.zeros((len(frames), 4)), columns)


def test_an_outlier_is_not_the_closest_approach():
    distances = [30.0 - index / 10 for index in range(100)]
    distances[3] = 1.0
    approach = history(range(100), distances).closest_approach(25.0)
    assert approach.distance_m == pytest.approx(20.5, abs=0.2)
    assert (approach.frame > 90, approach.std_m) == (True, 1.0)


def test_speeds_in_frames_that_are_not_evenly_spaced():
    table = TrackTable()
    for frame, time in enumerate((5.0, 5.1, None, 5.5)):
        table.append(frame, time, [track(1)])
    speed = OwnSpeed(np.array([5.0, 6.0]), np.array([10.0, 20.0]))
    assert own_speeds(speed, table, fps=25).tolist() == pytest.approx([10, 11, 13, 15])
