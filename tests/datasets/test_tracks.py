"""Files of the tracks of videos and of the detections in images."""

import csv
import json
import os
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection import Detections, InvalidInputError
from vehicle_detection.datasets import DIGITS, FORMATS, open_tracks, read_labels, write_tracks
from vehicle_detection.tables import BOX_COLUMNS, TRACK_COLUMNS, TrackTable

ROWS = [
    (0, 1, 10.0, 20.0, 50.25, 60.5, 1.5, 31.25, -0.5, 0.9, 2.5, None, "car"),
    (0, 2, 100.0, 20.0, 150.0, 60.0, -0.125, None, None, None, None, None, "vehicle"),
    (2, 1, 12.0, 21.0, 52.0, 61.0, 1.0625, 31.0, 0.0, 0.8, 2.25, 0.5, "car"),
]
NAMES = ("t.csv", "t.jsonl", "t.ndjson", "t.parquet", "t.txt", "t.json")


def track(row, *, shown=True):
    values = dict(zip(TRACK_COLUMNS[6:], row[6:]))
    return SimpleNamespace(id=row[1], box=np.array(row[2:6]), shown=shown, **values)


def results_of(rows):
    frames = {row[0]: [track(each) for each in rows if each[0] == row[0]] for row in rows}
    return [SimpleNamespace(index=index, tracks=tracks) for index, tracks in frames.items()]


TENTATIVE = track((0, 0, 0.0, 0.0, 9.0, 9.0, 0.1), shown=False)
RESULTS = [
    SimpleNamespace(index=0, tracks=(track(ROWS[0]), TENTATIVE, track(ROWS[1]))),
    SimpleNamespace(index=1, tracks=()),
    SimpleNamespace(index=2, tracks=(track(ROWS[2]),)),
]

number = st.floats(-1e5, 1e5)
boxes = st.tuples(number, number, st.floats(0, 1e4), st.floats(0, 1e4)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)
unknown, positive = st.none() | number, st.none() | st.floats(0, 1e4)
rows = st.lists(
    st.builds(
        lambda frame, vehicle, box, *others: (frame, vehicle, *box, *others), st.integers(0, 10**6),
        st.integers(1, 10**6), boxes, number, unknown, unknown, st.none() | st.floats(0, 1), positive,
        positive, st.sampled_from(["vehicle", "car", "motorcycle", "=bus"]),
    ),
    max_size=8,
    unique_by=lambda row: row[:2],
).map(lambda rows: sorted(rows, key=lambda row: row[0]))  # fmt: skip


def read_csv(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read_table(path):
    """Read rows back by any reader, None where a value is unknown."""
    if path.suffix == ".csv":
        table = pd.read_csv(path).astype({"label": str})
        return [tuple(None if value != value else value for value in row) for row in table.values.tolist()]
    if path.suffix == ".jsonl":
        return [tuple(json.loads(line).values()) for line in path.read_text(encoding="utf-8").splitlines()]
    table = pd.read_parquet(path)
    return [
        tuple(None if pd.isna(value) else value for value in row) for row in table.itertuples(index=False)
    ]


@given(rows)
def test_tables_hold_the_rows(tmp_path_factory, given_rows):
    folder = tmp_path_factory.mktemp("tables")
    for suffix in (".csv", ".jsonl", ".parquet"):
        path = folder / f"tracks{suffix}"
        assert write_tracks(results_of(given_rows), path) == len(given_rows)
        found = read_table(path)
        assert len(found) == len(given_rows)
        for row, wanted in zip(found, given_rows):
            assert row[:2] == wanted[:2]
            for name, value, want in zip(TRACK_COLUMNS[2:], row[2:], wanted[2:], strict=True):
                assert (value is None) == (want is None)
                if name == "label":
                    assert value.lstrip("'") == want
                elif want is not None:
                    assert value == pytest.approx(want, abs=0.50001 * 10 ** -DIGITS[name])
        # Written again, what was read is the same file: nothing creeps.
        again = folder / f"again{suffix}"
        write_tracks(read_labels(path), again)
        assert again.read_bytes() == path.read_bytes()


def test_csv_to_the_letter(tmp_path):
    assert write_tracks(RESULTS, tmp_path / "tracks.csv") == 3
    assert (tmp_path / "tracks.csv").read_bytes().decode() == (
        "frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps,"
        "label\n"
        "0,1,10.00,20.00,50.25,60.50,1.5000,31.25,-0.50,0.9000,2.50,,car\n"
        "0,2,100.00,20.00,150.00,60.00,-0.1250,,,,,,vehicle\n"
        "2,1,12.00,21.00,52.00,61.00,1.0625,31.00,0.00,0.8000,2.25,0.50,car\n"
    )


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_a_frame_rate_adds_the_time(tmp_path, suffix):
    path, without = tmp_path / f"tracks{suffix}", tmp_path / f"without{suffix}"
    for results in (RESULTS, TrackTable.from_results(RESULTS)):
        write_tracks(results, path, fps=30000 / 1001)
        write_tracks(results, without)
        assert [row[-1] for row in read_table(path)] == [0.0, 0.0, 0.067]
        assert [row[:-1] for row in read_table(path)] == read_table(without)
        assert read_labels(path).to_pandas().equals(read_labels(without).to_pandas())


@pytest.mark.parametrize("name", NAMES)
def test_results_tables_and_streams_give_the_same_file(tmp_path, name):
    path = tmp_path / name
    write_tracks(RESULTS, path, shape=(720, 1280))
    whole = path.read_bytes()
    for results in (iter(RESULTS), TrackTable.from_results(RESULTS)):
        assert write_tracks(results, path, shape=(720, 1280)) == 3
        assert path.read_bytes() == whole
    with open_tracks(path, shape=(720, 1280)) as write:
        for result in RESULTS:
            write(result)
    assert (write.rows, path.read_bytes()) == (3, whole)
    write_tracks(RESULTS, tmp_path / "named", format=FORMATS[path.suffix], shape=(720, 1280))
    assert (tmp_path / "named").read_bytes() == whole


def test_coco_is_a_data_set(tmp_path):
    write_tracks(RESULTS, tmp_path / "t.json", shape=(720, 1280, 3))
    data = json.loads((tmp_path / "t.json").read_text())
    assert [(image["id"], image["frame"]) for image in data["images"]] == [(1, 0), (2, 1), (3, 2)]
    assert all((image["height"], image["width"]) == (720, 1280) for image in data["images"])
    assert data["categories"] == [
        {"id": 1, "name": "vehicle", "supercategory": "vehicle"},
        {"id": 2, "name": "car", "supercategory": "vehicle"},
    ]
    first, second, third = data["annotations"]
    assert first == {
        "id": 1, "image_id": 1, "category_id": 2, "bbox": [10.0, 20.0, 40.25, 40.5], "area": 1630.12,
        "iscrowd": 0, "score": 1.5, "track_id": 1, "distance_m": 31.25, "speed_mps": -0.5, "confidence": 0.9,
        "distance_std_m": 2.5,
    }  # fmt: skip
    assert "distance_m" not in second
    # The ids of the images do not depend on which frames have rows.
    write_tracks(RESULTS[2:], tmp_path / "t.json")
    (alone,) = json.loads((tmp_path / "t.json").read_text())["images"]
    assert (third["id"], third["image_id"], alone["id"]) == (3, 3, 3)


def test_no_track_at_all_is_a_file_with_a_header(tmp_path):
    for name in NAMES:
        assert write_tracks([], tmp_path / name) == write_tracks(TrackTable(), tmp_path / name) == 0
    assert (tmp_path / "t.csv").read_text() == ",".join(TRACK_COLUMNS) + "\n"
    assert (tmp_path / "t.jsonl").read_text() == (tmp_path / "t.txt").read_text() == ""
    assert tuple(pd.read_parquet(tmp_path / "t.parquet").columns) == TRACK_COLUMNS
    assert json.loads((tmp_path / "t.json").read_text())["annotations"] == []


@pytest.mark.parametrize("name", ["t.csv", "t.json", "t.parquet"])
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_a_stream_appears_whole_or_not_at_all(tmp_path, error, name):
    path = tmp_path / name
    path.write_text("an earlier file")

    def run():
        with open_tracks(path) as write:
            write(RESULTS[0])
            assert path.read_text() == "an earlier file"
            raise error

    with pytest.raises(error):
        run()
    assert path.read_text() == "an earlier file"
    assert os.listdir(tmp_path) == [name]


def test_memory_does_not_grow_with_the_number_of_parquet_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("vehicle_detection._common.parquet._ROWS_PER_GROUP", 2)
    write_tracks(results_of([(frame, 1, 0, 0, 5, 5, 1.0) for frame in range(5)]), tmp_path / "t.parquet")
    parquet = pytest.importorskip("pyarrow.parquet")
    file = parquet.ParquetFile(tmp_path / "t.parquet")
    assert file.num_row_groups == 3
    assert file.read()["frame"].to_pylist() == [0, 1, 2, 3, 4]


def test_detections_in_images(tmp_path):
    found = TrackTable.from_detections(
        {
            "road, wet.jpg": Detections(
                [[10, 20, 50, 60], [1, 2, 3, 4]], [1.5, 0.25], [0.82, 0.56], ["bus", "car"]
            ),
            "empty.jpg": Detections.empty(),
            'é "quoted".png': Detections([[0, 0, 9.5, 9]], [2]),
        }
    )
    assert write_tracks(found, tmp_path / "b.csv") == 3
    assert (tmp_path / "b.csv").read_text(encoding="utf-8") == (
        "frame,track_id,x1,y1,x2,y2,score,confidence,label\n"
        '"road, wet.jpg",,10.00,20.00,50.00,60.00,1.5000,0.8200,bus\n'
        '"road, wet.jpg",,1.00,2.00,3.00,4.00,0.2500,0.5600,car\n'
        '"é ""quoted"".png",,0.00,0.00,9.50,9.00,2.0000,,vehicle\n'
    )
    for name in ("b.jsonl", "b.parquet", "b.json"):
        assert write_tracks(found, tmp_path / name) == 3
    last = json.loads((tmp_path / "b.jsonl").read_text(encoding="utf-8").splitlines()[2])
    columns = (*BOX_COLUMNS, "confidence", "label")
    assert last == dict(zip(columns, ('é "quoted".png', None, 0.0, 0.0, 9.5, 9.0, 2.0, None, "vehicle")))
    table = pd.read_parquet(tmp_path / "b.parquet")
    assert table["frame"].tolist() == [row["frame"] for row in read_csv(tmp_path / "b.csv")]
    assert table["track_id"].isna().all()
    data = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))
    names = {image["id"]: image["file_name"] for image in data["images"]}
    assert set(names.values()) == set(found.frame_keys)
    assert [names[entry["image_id"]] for entry in data["annotations"]] == table["frame"].tolist()
    write_tracks(found[2:].select(['é "quoted".png']), tmp_path / "b.json")
    (alone,) = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))["images"]
    assert names[alone["id"]] == alone["file_name"]
    with pytest.raises(InvalidInputError, match=r"path must end in .csv, .jsonl, .ndjson, .parquet, .json"):
        write_tracks(found, tmp_path / "b.txt")


def test_a_yolo_folder_has_a_file_for_each_frame(tmp_path):
    tracks = [(0, 7, 10, 20, 50, 60, 0.0), (0, 8, 0, 0, 100, 100, 3.0, None, None, 0.9)]
    write_tracks(results_of(tracks), tmp_path / "yolo", format="yolo", shape=(100, 200, 3))
    (file,) = (tmp_path / "yolo" / "labels").iterdir()
    assert file.name == "000000.txt"
    assert file.read_text().splitlines() == [
        "0 0.150000 0.400000 0.200000 0.400000 0.500000 7",
        "0 0.250000 0.500000 0.500000 1.000000 0.900000 8",
    ]
    found = Detections([[10, 20, 50, 60]], [0.0])
    images = TrackTable.from_detections({"a.jpg": found, "b.jpg": Detections.empty()})
    assert write_tracks(images, tmp_path / "boxes", format="yolo", shape=(100, 200)) == 1
    texts = {path.name: path.read_text() for path in (tmp_path / "boxes" / "labels").iterdir()}
    assert texts == {"a.txt": "0 0.150000 0.400000 0.200000 0.400000 0.500000\n", "b.txt": ""}
    twice = TrackTable.from_detections({"x/a.jpg": found, "y/a.jpg": found})
    with pytest.raises(InvalidInputError, match=r"the frames 'x/a.jpg' and 'y/a.jpg', which are one file"):
        write_tracks(twice, tmp_path / "c", format="yolo", shape=(9, 9))
    write_tracks(results_of([(0, 1, 0, 0, 5, 5, -1e4)]), tmp_path / "low", format="yolo", shape=(10, 10))
    assert (tmp_path / "low" / "labels" / "000000.txt").read_text().split()[5:] == ["0.000000", "1"]


# --- bad input ---


@pytest.mark.parametrize("name", NAMES)
def test_an_error_in_the_results_leaves_the_earlier_file(tmp_path, name):
    path = tmp_path / name
    path.write_text("an earlier file")
    for later in ([7], ROWS[:1], RESULTS[:1], [SimpleNamespace(index=3, tracks=[5])]):
        with pytest.raises(InvalidInputError, match=r"(results|tracks) must be|frame must be at least"):
            write_tracks([*RESULTS, *later], path)
    assert path.read_text() == "an earlier file"
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize(
    ("results", "options", "message"),
    [
        (RESULTS, {"path": "t.xlsx"}, r"path must end in .csv, .*, got 't.xlsx'; or set the format to 'csv'"),
        (7, {}, "results must be a list of FrameResult, got 7"),
        (pd.DataFrame({"frame": [0]}), {}, "TrackTable.from_pandas"),
        (TrackTable(["a"], None, [[0, 0, 9, 9]]), {"fps": 25}, "fps must be omitted for frames with names"),
        (RESULTS, {"path": "yolo", "format": "yolo"}, r"shape must be \(height, width\)"),
        (RESULTS, {"path": "f", "format": "yolo", "shape": (9, 9)}, "path must be a new or empty folder"),
        (RESULTS, {"path": ".", "format": "yolo", "shape": (9, 9)}, "path must be a new or empty folder"),
    ],
)
def test_bad_arguments(tmp_path, monkeypatch, results, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").touch()
    with pytest.raises(InvalidInputError, match=message):
        write_tracks(results, **{"path": "t.csv", **options})
    assert os.listdir(tmp_path) == ["f"]


def test_a_missing_pyarrow_is_reported_before_the_video(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with (
        pytest.raises(InvalidInputError, match=r"files need pyarrow; pip install pyarrow$"),
        open_tracks(tmp_path / "t.parquet"),
    ):
        pass
    assert os.listdir(tmp_path) == []
