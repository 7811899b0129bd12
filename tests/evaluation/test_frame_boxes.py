import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from tests.evaluation.cases import CAR, boxes_of, moved
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, evaluate_tracks, read_labels
from vehicle_detection.export import write_tracks


def test_rows_of_a_frame_and_frames_without_boxes():
    labels = boxes_of((2, 1, CAR), (0, 1, moved(5)), (2, 3, moved(300)), frame_keys=(0, 1, 2, 3))
    assert len(labels) == 3
    assert labels.frame_keys == (0, 1, 2, 3)
    assert labels.rows(2).tolist() == [0, 2]
    assert labels.frame(2).tracks.tolist() == [1, 3]
    assert len(labels.frame(1)) == len(labels.frame(99)) == 0
    assert labels[labels.tracks == 3].frame_keys == (0, 1, 2, 3)
    assert repr(labels) == "FrameBoxes(3 boxes in 4 frames)"


def test_frame_names_are_sorted_by_their_numbers():
    assert boxes_of(*((name, -1, CAR) for name in ("f10.png", "f2.png", "a.png"))).frame_keys == (
        "a.png",
        "f2.png",
        "f10.png",
    )
    assert all(type(key) is int for key in FrameBoxes(np.arange(2), None, [CAR, CAR]).frame_keys)
    assert FrameBoxes(np.array(["b", "a"]), None, [CAR, CAR]).frame_keys == ("a", "b")


def test_empty_frame_boxes_and_from_detections():
    assert len(FrameBoxes([], [], [])) == 0
    found = FrameBoxes.from_detections({"a": Detections([CAR], [0.5]), "b": Detections.empty()})
    assert found.scores.tolist() == [0.5]
    assert found.frame_keys == ("a", "b")
    assert found.tracks.tolist() == [-1]
    assert len(FrameBoxes.from_detections({})) == 0
    with pytest.raises(InvalidInputError, match=r"detections must be a Mapping, got .*dict\(enumerate"):
        FrameBoxes.from_detections([Detections.empty()])
    with pytest.raises(InvalidInputError, match=r"detections\['a'\] must be a Detections, got"):
        FrameBoxes.from_detections({"a": np.zeros((0, 4))})


def test_columns_are_copies():
    boxes = np.array([CAR])
    labels = FrameBoxes([0], [1], boxes)
    boxes[:] = 0
    assert labels.boxes.tolist() == [list(CAR)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": [0]}, "frames must be one key for each of the 2 boxes, got 1 keys"),
        ({"frames": [0, "a"]}, "frames must be all int or all str, got int, str"),
        ({"frames": [0.0, 1.0]}, "frames must be all int or all str, got float"),
        ({"frames": "ab"}, "frames must be a sequence of frame keys"),
        ({"frames": 5}, "frames must be a sequence of frame keys"),
        ({"boxes": [CAR, (5, 0, 4, 9)]}, "boxes must be .* x1 <= x2"),
        ({"tracks": [1]}, "tracks must be one value for each of the 2 boxes"),
        ({"tracks": [1.5, 2]}, "tracks must be one value .* dtype float64"),
        ({"tracks": [1, -2]}, "tracks must be numbers from 0, or -1"),
        ({"tracks": [1, 1]}, "frame 0 holds track 1 twice"),
        ({"occluded": [-1, 0]}, "occluded must be 0"),
        ({"truncated": [0, 1.5]}, "truncated must be a fraction from 0 to 1"),
        ({"ignore": [0, 1]}, "ignore must be one value .* dtype int64"),
        ({"scores": [1, math.nan]}, "scores must be finite"),
        ({"distance_m": [1]}, "distance_m must be one value for each of the 2 boxes"),
        ({"frame_keys": ["a"]}, "frame_keys must be all int or all str"),
    ],
)
def test_invalid_columns(change, message):
    columns = {"frames": [0, 0], "tracks": [1, 2], "boxes": [CAR, moved(200)]}
    with pytest.raises(InvalidInputError, match=message):
        FrameBoxes(**{**columns, **change})


def track_of(number, box, *, score=0.5, distance_m=None, speed_mps=None, shown=True):
    return SimpleNamespace(
        id=number, box=np.array(box), score=score, distance_m=distance_m, speed_mps=speed_mps, shown=shown
    )


def result_of(index, *tracks):
    return SimpleNamespace(index=index, tracks=tracks)


def test_from_results_equals_the_csv_file_of_the_same_run(tmp_path):
    rng = np.random.default_rng(0)
    results = []
    for index in (0, 1, 3):
        corners = rng.uniform(0, 500, (3, 2))
        boxes = np.hstack([corners, corners + rng.uniform(20, 90, (3, 2))])
        speeds = [None, 1.2345, -3.0]
        tracks = [
            track_of(number, box, score=rng.normal(), distance_m=rng.uniform(5, 50), speed_mps=speeds[number])
            for number, box in enumerate(boxes)
        ]
        results.append(result_of(index, *tracks, track_of(9, CAR, shown=False)))
    write_tracks(results, tmp_path / "tracks.csv")
    found, read = FrameBoxes.from_results(results), read_labels(tmp_path / "tracks.csv")
    assert (found.frames, found.frame_keys) == (read.frames, read.frame_keys)
    np.testing.assert_array_equal(found.tracks, read.tracks)
    np.testing.assert_allclose(found.boxes, read.boxes, atol=0.00501)
    np.testing.assert_allclose(found.scores, read.scores, atol=0.0000501)
    np.testing.assert_allclose(found.distance_m, read.distance_m, atol=0.00501)
    np.testing.assert_allclose(found.speed_mps, read.speed_mps, atol=0.00501)


def test_from_results_keeps_frames_without_tracks():
    found = FrameBoxes.from_results(iter([result_of(0, track_of(1, CAR)), result_of(1), result_of(2)]))
    assert (found.frames, found.frame_keys) == ((0,), (0, 1, 2))
    assert found.distance_m is found.speed_mps is None
    labels = boxes_of((0, 1, CAR), (1, 1, CAR))
    scores = evaluate_tracks(found, labels)
    assert (scores.frames, scores.tp, scores.fn) == (3, 1, 1)
    assert len(FrameBoxes.from_results([])) == 0


@pytest.mark.parametrize("results", [5, "results", [CAR], [{"index": 0, "tracks": []}]])
def test_from_results_rejects_other_objects(results):
    with pytest.raises(InvalidInputError, match="results must be"):
        FrameBoxes.from_results(results)


def test_frame_boxes_are_shown_as_a_table():
    found = boxes_of((2, 1, CAR, 0.5), (0, 3, moved(5), 1.5))
    table = found.to_pandas()
    assert list(table) == [
        "frame",
        "track_id",
        "x1",
        "y1",
        "x2",
        "y2",
        "occluded",
        "truncated",
        "ignore",
        "score",
    ]
    assert table["frame"].tolist() == [2, 0]
    np.testing.assert_array_equal(table[["x1", "y1", "x2", "y2"]], found.boxes)
    assert "<table" in found._repr_html_()
    assert "FrameBoxes(2 boxes in 2 frames)" in found._repr_html_()


def test_a_table_is_taken_back_whole(tmp_path):
    found = boxes_of(
        (2, 1, CAR, 0.5),
        (0, -1, moved(5), 1.5),
        occluded=[2, 0],
        truncated=[0.25, 0],
        ignore=[True, False],
        distance_m=[31.5, math.nan],
    )
    pd.testing.assert_frame_equal(FrameBoxes.from_pandas(found.to_pandas()).to_pandas(), found.to_pandas())
    labels = boxes_of(("a", 1, CAR), ("b", -1, CAR))
    assert FrameBoxes.from_pandas(labels.to_pandas()).scores is None
    # Files that pandas reads, with unknown tracks and speeds, are such tables as well.
    write_tracks([(0, 7, *CAR, 0.5), (4, 8, *CAR, 1.5, 20.0)], tmp_path / "tracks.csv")
    for table in (
        pd.read_csv(tmp_path / "tracks.csv"),
        pd.read_csv(tmp_path / "tracks.csv").convert_dtypes(),
    ):
        read = FrameBoxes.from_pandas(table)
        assert (read.frames, read.tracks.tolist(), read.scores.tolist()) == ((0, 4), [7, 8], [0.5, 1.5])
        np.testing.assert_array_equal(read.distance_m, [math.nan, 20])
    table = pd.DataFrame({"frame": ["a"], "x1": [1], "y1": [2], "x2": [3], "y2": [4], "track_id": [None]})
    assert FrameBoxes.from_pandas(table).tracks.tolist() == [-1]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (5, "table must be a pandas.DataFrame with the columns frame, x1, y1, x2, y2; got 5"),
        (pd.DataFrame({"frame": [0], "x1": [0]}), "it lacks y1, x2, y2"),
    ],
)
def test_from_pandas_rejects_other_tables(table, message):
    with pytest.raises(InvalidInputError, match=message):
        FrameBoxes.from_pandas(table)


def test_a_table_of_pyarrow_names_the_remedy():
    pyarrow = pytest.importorskip("pyarrow")
    with pytest.raises(InvalidInputError, match=r"got .*; convert it with table.to_pandas\(\)"):
        FrameBoxes.from_pandas(pyarrow.table({"frame": [0], "x1": [0], "y1": [0], "x2": [5], "y2": [5]}))


@pytest.mark.parametrize("name", ["class", "label", "category"])
def test_rows_of_other_classes_are_dropped_as_in_files(tmp_path, name):
    table = pd.DataFrame({"frame": [0, 0, 1, 2, 3], "track": range(5), "x1": 0, "y1": 0, "x2": 50, "y2": 40})
    table[name] = ["Car", "person", "tram", "person", None]
    table.to_csv(tmp_path / "labels.csv", index=False)
    read, taken = read_labels(tmp_path / "labels.csv"), FrameBoxes.from_pandas(table)
    pd.testing.assert_frame_equal(read.to_pandas(), taken.to_pandas())
    assert read.frame_keys == taken.frame_keys == (0, 1, 2, 3)
    assert taken.ignore.tolist() == [False, True]
    assert FrameBoxes.from_pandas(table.assign(score=1.0)).frames == (0,)  # predictions
    assert len(FrameBoxes.from_pandas(table.assign(**{name: [0, 1, 0, 2, 2]}))) == 5  # numbers are no names
    with pytest.raises(InvalidInputError, match=r"must have a class among car, .* got person, tram; select"):
        FrameBoxes.from_pandas(table[1:])


def test_missing_cells_of_a_table_are_the_usual_values():
    """As after a concatenation of tables with different columns."""
    table = pd.DataFrame({"frame": [0.0, 1.0], "x1": [0, 5], "y1": [0, 0], "x2": [50, 55], "y2": [40, 40]})
    table["ignore"], table["occluded"], table["track_id"] = [True, None], [1, np.nan], [np.nan, 7]
    labels = FrameBoxes.from_pandas(table)
    assert labels.frames == (0, 1)
    assert (labels.ignore.tolist(), labels.occluded.tolist()) == ([True, False], [1, 0])
    assert labels.tracks.tolist() == [-1, 7]
    table["ignore"] = ["false", "True"]
    assert FrameBoxes.from_pandas(table).ignore.tolist() == [False, True]


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("track_id", ["a", "b"], "table must hold numbers in the column track_id, got .*list"),
        ("x1", ["a", 1.0], "table must hold numbers in the column x1"),
        ("score", [1.0, None], "scores must be finite"),
        ("ignore", [2, 0], "table must hold 0 or 1 in the column ignore"),
        ("occluded", [0.5, 1], "table must hold whole numbers in the column occluded, got 0.5"),
    ],
)
def test_malformed_columns_of_a_table(column, values, message):
    table = pd.DataFrame({"frame": [0, 1], "x1": [0, 5], "y1": [0, 0], "x2": [50, 55], "y2": [40, 40]})
    table[column] = values
    with pytest.raises(InvalidInputError, match=message):
        FrameBoxes.from_pandas(table)


def test_single_rows():
    labels = FrameBoxes([0, 3], [7, 8], [[0, 0, 50, 40], [5, 0, 55, 40]])
    assert [row.frames for row in labels] == [(0,), (3,)]
    assert (labels[0].tracks.tolist(), labels[np.int64(-1)].tracks.tolist()) == ([7], [8])


def test_exact_tracks_and_unusual_columns():
    table = pd.DataFrame({"frame": [0, 1], "x1": [0, 5], "y1": [0, 0], "x2": [50, 55], "y2": [40, 40]})
    table["track_id"], table["ignore"] = [2**60 + 1, 2**53 + 1], [1.0, np.nan]
    labels = FrameBoxes.from_pandas(table)
    assert labels.tracks.tolist() == [2**60 + 1, 2**53 + 1]
    assert labels.ignore.tolist() == [True, False]
    table["track_id"] = [np.inf, 1]
    with pytest.raises(InvalidInputError, match="whole numbers in the column track_id, got inf"):
        FrameBoxes.from_pandas(table)
    table["track_id"] = pd.Categorical(["a", None])
    with pytest.raises(InvalidInputError, match="numbers in the column track_id"):
        FrameBoxes.from_pandas(table)
    del table["track_id"]
    with pytest.raises(InvalidInputError, match="each column once; got x1 more than once"):
        FrameBoxes.from_pandas(pd.concat([table, table[["x1"]]], axis=1))
    table["frame"] = [True, False]
    with pytest.raises(InvalidInputError, match="frames must be all int or all str, got bool"):
        FrameBoxes.from_pandas(table)
