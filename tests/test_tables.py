import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.evaluation.cases import CAR, boxes_of, moved
from vehicle_detection import Detections, InvalidInputError, TrackTable
from vehicle_detection.tables import LABEL_COLUMNS, TRACK_COLUMNS

PRESENCE = st.lists(st.sets(st.integers(1, 4)), max_size=40)


def track(number, box=CAR, **values):
    return SimpleNamespace(**{"id": number, "box": np.array(box), "score": 0.5, "shown": True, **values})


def result(index, *tracks, time=None):
    return SimpleNamespace(index=index, time=time, tracks=tracks)


def test_rows_of_a_frame_and_frames_without_boxes():
    labels = boxes_of((2, 1, CAR), (0, 1, moved(5)), (2, 3, moved(300)), frame_keys=(0, 1, 2, 3))
    assert (len(labels), labels.frame_keys) == (3, (0, 1, 2, 3))
    assert labels.rows(2).tolist() == [0, 2]
    assert labels.frame(2)["track_id"].tolist() == [1, 3]
    assert len(labels.frame(1)) == len(labels.frame(99)) == 0
    assert labels[labels["track_id"] == 3].frame_keys == (0, 1, 2, 3)
    assert [(key, len(rows)) for key, rows in labels] == [(0, 1), (1, 0), (2, 2), (3, 0)]
    assert labels[0]["frame"].tolist() == labels[np.int64(-1)]["frame"].tolist() == [2]
    assert repr(labels) == "TrackTable(3 boxes in 4 frames)"


def test_frame_names_are_sorted_by_their_numbers():
    names = ("f10.png", "f2.png", "a.png")
    assert boxes_of(*((name, -1, CAR) for name in names)).frame_keys == ("a.png", "f2.png", "f10.png")
    assert all(type(key) is int for key in TrackTable(np.arange(2), None, [CAR, CAR]).frame_keys)
    assert TrackTable(np.array(["b", "a"]), None, [CAR, CAR]).frame_keys == ("a", "b")


def test_columns_and_their_defaults():
    labels = TrackTable([0], None, [CAR])
    assert labels.columns == (*TRACK_COLUMNS[:6], *LABEL_COLUMNS)
    assert [labels[name].tolist() for name in LABEL_COLUMNS] == [[0], [0.0], [False]]
    assert (labels["track_id"].tolist(), np.isnan(labels["score"]).all()) == ([-1], True)
    found = TrackTable([0], [3], [CAR], score=[1.5], confidence=[math.nan])
    assert found.columns == (*TRACK_COLUMNS[:7], "confidence")
    assert (found["ignore"].tolist(), found["x2"].tolist()) == ([False], [100.0])
    with pytest.raises(InvalidInputError, match=r"column must be one of .*'colour'"):
        found["colour"]
    boxes = np.array([CAR])
    copied = TrackTable([0], None, boxes)
    boxes[:] = 0
    assert copied.boxes.tolist() == [list(CAR)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": [0]}, "frame must be one key for each of the 2 boxes"),
        ({"frame": [0, "a"]}, "frame must be all int or all str, got int, str"),
        ({"track_id": [1]}, "track_id must be one value for each of the 2 boxes"),
        ({"track_id": [1, -2]}, "track_id must be a number from 0, or -1 for none; got -2"),
        ({"track_id": [1, 1]}, "frame 0 holds track 1 twice"),
        ({"occluded": [-1, 0]}, "occluded must be 0"),
        ({"truncated": [0, 1.5]}, "truncated must be a fraction from 0 to 1"),
        ({"score": [1, math.nan]}, "score must be finite"),
        ({"confidence": [1, 1.5]}, "confidence must be a probability"),
        ({"colour": [1, 2]}, "column must be one of"),
        ({"frame_keys": ["a"]}, "frame_keys must be all int or all str"),
    ],
)
def test_invalid_columns(change, message):
    columns = {"frame": [0, 0], "track_id": [1, 2], "boxes": [CAR, moved(200)]}
    with pytest.raises(InvalidInputError, match=message):
        TrackTable(**{**columns, **change})


def test_detections_of_each_frame():
    found = TrackTable.from_detections({"a": Detections([CAR], [0.5], [0.7]), "b": Detections.empty()})
    assert (found["score"].tolist(), found["confidence"].tolist()) == ([0.5], [0.7])
    assert (found.frame_keys, found["track_id"].tolist()) == (("a", "b"), [-1])
    assert len(TrackTable.from_detections({})) == 0
    with pytest.raises(InvalidInputError, match="detections must be a list or a dictionary, got"):
        TrackTable.from_detections(Detections.empty())
    with pytest.raises(InvalidInputError, match=r"detections\['a'\] must be a Detections, got"):
        TrackTable.from_detections({"a": np.zeros((0, 4))})


# --- tables that grow ---


@given(PRESENCE)
def test_appended_frames_and_their_tracks(frames):
    table = TrackTable()
    for index, numbers in enumerate(frames):
        table.append(index, None, [track(n, distance_m=index + n) for n in sorted(numbers)])
    assert table.counts().tolist() == [len(numbers) for numbers in frames]
    tracks = table.by_track()
    assert set(tracks) == set().union(*frames)
    for number, rows in tracks.items():
        assert rows["frame"].tolist() == [index for index, numbers in enumerate(frames) if number in numbers]
        assert rows["distance_m"].tolist() == [index + number for index in rows["frame"]]
    order = [(int(rows["frame"][0]), number) for number, rows in tracks.items()]
    assert order == sorted(order)


def test_results_are_appended():
    table = TrackTable.from_results(
        iter([result(0, track(1, speed_mps=2), track(9, shown=False)), *map(result, (1, 2))])
    )
    assert (len(table), table.frame_keys, table["speed_mps"].tolist()) == (1, (0, 1, 2), [2.0])
    assert np.isnan(table["distance_m"]).all()
    assert table.columns == TRACK_COLUMNS
    assert len(TrackTable.from_results([])) == 0


@pytest.mark.parametrize("results", [5, "results", [CAR], [{"index": 0, "tracks": []}]])
def test_from_results_rejects_other_objects(results):
    with pytest.raises(InvalidInputError, match="results must be"):
        TrackTable.from_results(results)


def test_times_of_frames_that_are_not_evenly_spaced():
    def times(*given_times):
        table = TrackTable()
        for frame, time in enumerate(given_times):
            table.append(frame, time)
        return None if table.times() is None else table.times().tolist()

    assert times(5.0, 5.1, None, 5.5) == pytest.approx([5.0, 5.1, 5.3, 5.5])
    assert times(1.0, 1.1, 1.1, 1.3) == pytest.approx([1.0, 1.1, 1.2, 1.3])
    for unusual in ((1.0, 1.0), (1.0, 0.5), (None, 1.0), (None, None), ()):
        assert times(*unusual) is None


def test_selections_have_the_times_of_their_frames():
    table = TrackTable()
    for frame in range(6):
        table.append(frame, 5 + frame / 10, [track(1)])
    first = table.select([0, 1])
    assert first.times() == pytest.approx([5.0, 5.1])
    assert table[:1].times() == pytest.approx(table.times())
    assert (table.frame(2).times(), table.select([]).times(), table.frame(2).first_time) == (None, None, 5.0)
    renamed = table.renamed(str)
    assert (renamed.times(), renamed.frame("2").times(), renamed.first_time) == (None, None, None)
    assert boxes_of(("a.png", 1, CAR)).times() is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "frame must be at least 1, as frames are added in order, got 0"),
        ((1, None, [5]), "tracks must be Track objects, got 5"),
        ((1, None, [track(1), track(1)]), "tracks must have unique ids, got 1; "),
    ],
)
def test_frames_that_cannot_be_appended(arguments, message):
    table = TrackTable()
    table.append(0)
    with pytest.raises(InvalidInputError, match=message):
        table.append(*arguments)
    assert table.frame_keys == (0,)


# --- pandas ---


def test_a_table_of_pandas_is_taken_back_whole():
    found = boxes_of(
        (2, 1, CAR, 0.5),
        (0, -1, moved(5), 1.5),
        occluded=[2, 0],
        truncated=[0.25, 0],
        ignore=[True, False],
        distance_m=[31.5, math.nan],
    )
    pd.testing.assert_frame_equal(TrackTable.from_pandas(found.to_pandas()).to_pandas(), found.to_pandas())
    labels = boxes_of(("a", 1, CAR), ("b", -1, CAR))
    again = TrackTable.from_pandas(labels.to_pandas())
    assert (again["frame"].tolist(), again.columns) == (["a", "b"], labels.columns)
    assert "<table" in found._repr_html_()


def test_missing_cells_of_a_table_are_the_usual_values():
    """As after a concatenation of tables with different columns."""
    table = pd.DataFrame({"frame": [0.0, 1.0], "x1": [0, 5], "y1": [0, 0], "x2": [50, 55], "y2": [40, 40]})
    table["ignore"], table["occluded"], table["track_id"] = [True, None], [1, np.nan], [np.nan, 7]
    for each in (table, table.convert_dtypes()):
        labels = TrackTable.from_pandas(each)
        assert labels["frame"].tolist() == [0, 1]
        assert (labels["ignore"].tolist(), labels["occluded"].tolist()) == ([True, False], [1, 0])
        assert labels["track_id"].tolist() == [-1, 7]
    table["ignore"], table["track_id"] = ["false", "True"], [2**60 + 1, 2**53 + 1]
    labels = TrackTable.from_pandas(table)
    assert (labels["ignore"].tolist(), labels["track_id"].tolist()) == ([False, True], [2**60 + 1, 2**53 + 1])


@pytest.mark.parametrize("name", ["class", "label", "category"])
def test_rows_of_other_classes_are_dropped(name, caplog):
    table = pd.DataFrame({"frame": [0, 0, 1, 2, 3], "track": range(5), "x1": 0, "y1": 0, "x2": 50, "y2": 40})
    table[name] = ["Car", "person", "tram", "person", None]
    labels = TrackTable.from_pandas(table)
    assert (labels.frame_keys, labels["ignore"].tolist()) == ((0, 1, 2, 3), [False, True])
    assert "boxes without a class are left out: 1" in caplog.text
    assert TrackTable.from_pandas(table.assign(score=1.0))["frame"].tolist() == [0]  # predictions
    numbers = table.assign(**{name: [0.0, 1, 0, 2, 2]})  # they are no names
    assert len(TrackTable.from_pandas(numbers)) == 5
    assert "boxes of class 0, 1, 2 are read as vehicles" in caplog.text
    assert len(TrackTable.from_pandas(numbers, classes=["2"])) == 2
    assert len(TrackTable.from_pandas(table, classes=["person"])) == 3
    with pytest.raises(InvalidInputError, match=r"no class among .*car.* found 'person', 'tram'; .*classes="):
        TrackTable.from_pandas(table[1:])
    with pytest.raises(InvalidInputError, match="table has no classes; leave out classes="):
        TrackTable.from_pandas(table.drop(columns=name), classes=["car"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"track_id": ["a", "b"]}, "table row 0: track_id must be a finite number, got 'a'"),
        ({"x1": [0, "4,5"]}, "table row 1: x1 must be .*; use a decimal point"),
        ({"x1": [0, None]}, "table row 1: x1 must be a finite number"),
        ({"score": [1.0, None]}, "table row 1: some boxes have a score and some have none"),
        ({"frame": [True, False]}, "frame must be a whole number from 0 or a name, got True"),
        ({"frame": ["a", 1]}, "table row 1: frame must be a number in every row, or a name"),
        ({"frame": [0, None]}, "table row 1: frame is empty"),
    ],
)
def test_malformed_columns_of_a_table(change, message):
    table = pd.DataFrame({"frame": [0, 1], "x1": [0, 5], "y1": [0, 0], "x2": [50, 55], "y2": [40, 40]})
    with pytest.raises(InvalidInputError, match=message):
        TrackTable.from_pandas(table.assign(**change))


def test_objects_that_are_no_table_of_boxes():
    table = pd.DataFrame({"frame": [0], "x1": [0]})
    for given_table, message in (
        (5, "table must be a pandas.DataFrame with the columns frame, x1, y1, x2, y2, got 5"),
        (table, "table lacks the columns y1, x2, y2"),
        (pd.concat([table, table[["x1"]]], axis=1), "each column once; got x1 more than once"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            TrackTable.from_pandas(given_table)
    pyarrow = pytest.importorskip("pyarrow")
    with pytest.raises(InvalidInputError, match=r"got .*; convert it with table.to_pandas\(\)"):
        TrackTable.from_pandas(pyarrow.table({"frame": [0]}))
