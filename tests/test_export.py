import csv
import json
import os
import sys
import zipfile
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import read_labels
from vehicle_detection.export import (
    BOX_COLUMNS,
    DIGITS,
    FORMATS,
    STILL_COLUMNS,
    TRACK_COLUMNS,
    TrackWriter,
    write_boxes,
    write_tracks,
)

ROWS = [
    (0, 1, 10.0, 20.0, 50.25, 60.5, 1.5, 31.25, -0.5, 0.9, 2.5, None),
    (0, 2, 100.0, 20.0, 150.0, 60.0, -0.125, None, None, None, None, None),
    (2, 1, 12.0, 21.0, 52.0, 61.0, 1.0625, 31.0, 0.0, 0.8, 2.25, 0.5),
]


def track(row, *, shown=True):
    values = dict(zip(TRACK_COLUMNS[6:], row[6:]))
    return SimpleNamespace(id=row[1], box=np.array(row[2:6]), shown=shown, **values)


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
unknown = st.none() | number
rows = st.lists(
    st.builds(
        lambda frame, vehicle, box, *others: (frame, vehicle, *box, *others),
        st.integers(0, 10**6),
        st.integers(1, 10**6),
        boxes,
        number,
        unknown,
        unknown,
        st.none() | st.floats(0, 1),
        st.none() | st.floats(0, 1e4),
        st.none() | st.floats(0, 1e4),
    ),
    max_size=8,
    unique_by=lambda row: row[:2],
).map(lambda rows: sorted(rows, key=lambda row: row[0]))


def read_csv(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read_jsonl(path):
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def read_table(path):
    """Read rows back by any reader, None where a value is unknown."""
    if path.suffix == ".csv":
        return [tuple(None if text == "" else float(text) for text in row.values()) for row in read_csv(path)]
    if path.suffix == ".jsonl":
        return [tuple(row.values()) for row in read_jsonl(path)]
    table = pd.read_parquet(path)
    return [
        tuple(None if pd.isna(value) else value for value in row) for row in table.itertuples(index=False)
    ]


@given(rows)
def test_tables_hold_the_rows(tmp_path_factory, given_rows):
    folder = tmp_path_factory.mktemp("tables")
    for suffix in (".csv", ".jsonl", ".parquet"):
        path = folder / f"tracks{suffix}"
        assert write_tracks(given_rows, path) == len(given_rows)
        found = read_table(path)
        assert len(found) == len(given_rows)
        for row, wanted in zip(found, given_rows):
            assert row[:2] == wanted[:2]
            for name, value, want in zip(TRACK_COLUMNS[2:], row[2:], wanted[2:], strict=True):
                assert (value is None) == (want is None)
                if want is not None:
                    assert value == pytest.approx(want, abs=0.50001 * 10 ** -DIGITS[name])
        # Written again, what was read is the same file: nothing creeps.
        again = folder / f"again{suffix}"
        write_tracks([(int(row[0]), int(row[1]), *row[2:]) for row in found], again)
        assert again.read_bytes() == path.read_bytes()


def test_csv_to_the_letter(tmp_path):
    assert write_tracks(RESULTS, tmp_path / "tracks.csv") == 3
    assert (tmp_path / "tracks.csv").read_bytes().decode() == (
        "frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps,confidence,distance_std_m,speed_std_mps\n"
        "0,1,10.00,20.00,50.25,60.50,1.5000,31.25,-0.50,0.9000,2.50,\n"
        "0,2,100.00,20.00,150.00,60.00,-0.1250,,,,,\n"
        "2,1,12.00,21.00,52.00,61.00,1.0625,31.00,0.00,0.8000,2.25,0.50\n"
    )


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".parquet"])
def test_a_frame_rate_adds_the_time(tmp_path, suffix):
    path = tmp_path / f"tracks{suffix}"
    write_tracks(RESULTS, path, fps=30000 / 1001)
    without = tmp_path / f"without{suffix}"
    write_tracks(RESULTS, without)
    assert [row[-1] for row in read_table(path)] == [0.0, 0.0, 0.067]
    assert [row[:-1] for row in read_table(path)] == read_table(without)
    assert read_labels(path).to_pandas().equals(read_labels(without).to_pandas())


def test_other_formats_have_no_time(tmp_path):
    for name in ("t.txt", "t.json"):
        write_tracks(RESULTS, tmp_path / name, fps=25)
        write_tracks(RESULTS, tmp_path / f"without_{name}")
        assert (tmp_path / name).read_bytes() == (tmp_path / f"without_{name}").read_bytes()
    with pytest.raises(InvalidInputError, match="fps must be a number, greater than 0"):
        write_tracks(RESULTS, tmp_path / "t.csv", fps=0)


def test_pandas_reads_the_tables(tmp_path):
    for name in ("tracks.csv", "tracks.parquet", "tracks.jsonl"):
        write_tracks(RESULTS, tmp_path / name)
    tables = [
        pd.read_csv(tmp_path / "tracks.csv"),
        pd.read_parquet(tmp_path / "tracks.parquet"),
        pd.read_json(tmp_path / "tracks.jsonl", lines=True),
    ]
    for table in tables:
        assert tuple(table.columns) == TRACK_COLUMNS
        assert table["frame"].dtype == table["track_id"].dtype == "int64"
        assert table["distance_m"].isna().tolist() == [False, True, False]
        # A table of pandas is a list of rows as well, NaN for what is unknown.
        write_tracks(table, tmp_path / "again.csv")
        assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "tracks.csv").read_bytes()
    mapped = tables[0].convert_dtypes()  # pandas.NA for what is unknown
    write_tracks(mapped, tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "tracks.csv").read_bytes()


@pytest.mark.parametrize("name", ["t.csv", "t.jsonl", "t.ndjson", "t.parquet", "t.txt", "t.json"])
def test_results_and_rows_and_mappings_give_the_same_file(tmp_path, name):
    path = tmp_path / name
    contents = []
    for items in (
        RESULTS,
        ROWS,
        iter(ROWS),
        [dict(zip(TRACK_COLUMNS, row)) for row in ROWS],
        [[*row] for row in ROWS],
    ):
        assert write_tracks(items, path) == 3
        contents.append(path.read_bytes())
    if name == "t.json":  # the empty frame is known from the results alone
        assert [len(json.loads(text)["images"]) for text in contents] == [3, 2, 2, 2, 2]
        contents = contents[1:]
    assert len(set(contents)) == 1


def test_array_rows(tmp_path):
    write_tracks(np.array([row[:7] for row in ROWS]), tmp_path / "t.csv")
    assert len(read_csv(tmp_path / "t.csv")) == 3


def test_jsonl_has_an_object_a_line(tmp_path):
    write_tracks(RESULTS, tmp_path / "t.jsonl")
    lines = read_jsonl(tmp_path / "t.jsonl")
    assert [tuple(line) for line in lines] == [TRACK_COLUMNS] * 3
    assert tuple(lines[1].values()) == ROWS[1]


def test_mot_counts_from_one(tmp_path):
    write_tracks(RESULTS, tmp_path / "t.txt")
    lines = (tmp_path / "t.txt").read_text().splitlines()
    assert lines[0] == "1,1,11.0,21.0,40.25,40.5,1.5,-1,-1,-1"
    assert [line.split(",")[0] for line in lines] == ["1", "1", "3"]


@pytest.mark.filterwarnings("ignore:Operation with tuple")  # motmetrics and a new pandas
def test_the_tools_of_mot_read_it(tmp_path):
    metrics = pytest.importorskip("motmetrics")
    write_tracks(RESULTS, tmp_path / "t.txt")
    table = metrics.io.loadtxt(str(tmp_path / "t.txt"), fmt="mot15-2D", min_confidence=-10)
    assert table.index.tolist() == [(1, 1), (1, 2), (3, 1)]
    first = table.iloc[0]
    assert (first.X, first.Y, first.Width, first.Height) == (10.0, 20.0, 40.25, 40.5)


def test_coco_is_a_data_set(tmp_path):
    write_tracks(RESULTS, tmp_path / "t.json", shape=(720, 1280, 3))
    data = json.loads((tmp_path / "t.json").read_text())
    assert [(image["id"], image["frame"]) for image in data["images"]] == [(1, 0), (2, 1), (3, 2)]
    assert all((image["height"], image["width"]) == (720, 1280) for image in data["images"])
    assert data["categories"] == [{"id": 1, "name": "vehicle", "supercategory": "vehicle"}]
    first, second, third = data["annotations"]
    assert first == {
        "id": 1,
        "image_id": 1,
        "category_id": 1,
        "bbox": [10.0, 20.0, 40.25, 40.5],
        "area": 1630.12,
        "iscrowd": 0,
        "score": 1.5,
        "track_id": 1,
        "distance_m": 31.25,
        "speed_mps": -0.5,
        "confidence": 0.9,
        "distance_std_m": 2.5,
    }
    assert "distance_m" not in second
    # The ids of the images do not depend on which frames have rows.
    write_tracks(ROWS[2:], tmp_path / "t.json")
    data = json.loads((tmp_path / "t.json").read_text())
    assert (
        [entry["image_id"] for entry in data["annotations"]]
        == [image["id"] for image in data["images"]]
        == [3]
    )
    assert (third["id"], third["image_id"], third["speed_mps"]) == (3, 3, 0.0)


def test_no_track_at_all_is_a_file_with_a_header(tmp_path):
    for name in ("t.csv", "t.jsonl", "t.parquet", "t.txt", "t.json"):
        assert write_tracks([], tmp_path / name) == 0
    assert (tmp_path / "t.csv").read_text() == ",".join(TRACK_COLUMNS) + "\n"
    assert (tmp_path / "t.jsonl").read_text() == (tmp_path / "t.txt").read_text() == ""
    assert tuple(pd.read_parquet(tmp_path / "t.parquet").columns) == TRACK_COLUMNS
    assert json.loads((tmp_path / "t.json").read_text())["annotations"] == []


def test_the_format_may_be_named(tmp_path):
    write_tracks(ROWS, tmp_path / "tracks.data", format="csv")
    write_tracks(ROWS, tmp_path / "tracks.csv")
    assert (tmp_path / "tracks.data").read_bytes() == (tmp_path / "tracks.csv").read_bytes()
    with TrackWriter(tmp_path / "t.json", format="jsonl") as write:
        write(ROWS[0])
    assert len(read_jsonl(tmp_path / "t.json")) == 1
    assert set(FORMATS.values()) == {"csv", "jsonl", "parquet", "mot", "mot_zip", "coco"}


# --- streaming ---


def test_a_stream_is_the_same_file(tmp_path):
    for name in ("t.csv", "t.jsonl", "t.txt", "t.parquet", "t.json"):
        write_tracks(RESULTS, tmp_path / f"whole_{name}")
        with TrackWriter(tmp_path / name) as write:
            for result in RESULTS:
                write(result)
        assert write.rows == 3
        assert (tmp_path / name).read_bytes() == (tmp_path / f"whole_{name}").read_bytes()


@pytest.mark.parametrize("name", ["t.csv", "t.json"])
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_a_stream_appears_whole_or_not_at_all(tmp_path, error, name):
    path = tmp_path / name
    path.write_text("an earlier file")

    def run():
        with TrackWriter(path) as write:
            write(RESULTS[0])
            assert path.read_text() == "an earlier file"
            raise error

    with pytest.raises(error):
        run()
    assert path.read_text() == "an earlier file"
    assert os.listdir(tmp_path) == [name]


def test_an_error_in_the_rows_leaves_the_earlier_file(tmp_path):
    for name in ("t.csv", "t.jsonl", "t.parquet", "t.txt", "t.json"):
        path = tmp_path / name
        path.write_text("an earlier file")
        with pytest.raises(InvalidInputError, match=r"row 1 must have x1 <= x2"):
            write_tracks([ROWS[0], (1, 1, 5, 5, 4, 9, 1.0)], path)
        assert path.read_text() == "an earlier file"
    assert len(os.listdir(tmp_path)) == 5


def test_a_writer_can_be_used_again_but_only_inside_its_block(tmp_path):
    writer = TrackWriter(tmp_path / "t.csv")
    for _ in range(2):
        with writer as write:
            write(ROWS[0])
        with pytest.raises(InvalidInputError, match="must be called inside its with block"):
            write(ROWS[0])
        assert len(read_csv(tmp_path / "t.csv")) == writer.rows == 1


# --- stills ---


def test_boxes_of_stills(tmp_path):
    found = [
        ("road, wet.jpg", Detections([[10, 20, 50, 60], [1, 2, 3, 4]], [1.5, 0.25], [0.82, 0.56])),
        ("empty.jpg", Detections.empty()),
        ('é "quoted".png', Detections([[0, 0, 9.5, 9]], [2])),
    ]
    assert write_boxes(found, tmp_path / "b.csv") == 3
    assert (
        (tmp_path / "b.csv")
        .read_text(encoding="utf-8")
        .startswith(
            "frame,track_id,x1,y1,x2,y2,score,confidence\n"
            '"road, wet.jpg",,10.00,20.00,50.00,60.00,1.5000,0.8200\n'
        )
    )
    read = read_csv(tmp_path / "b.csv")
    assert tuple(read[0]) == STILL_COLUMNS
    assert [row["frame"] for row in read] == ["road, wet.jpg", "road, wet.jpg", 'é "quoted".png']
    assert {row["track_id"] for row in read} == {""}
    for name in ("b.jsonl", "b.parquet"):
        assert write_boxes(found, tmp_path / name) == 3
    assert read_jsonl(tmp_path / "b.jsonl")[2] == dict(
        zip(STILL_COLUMNS, ('é "quoted".png', None, 0.0, 0.0, 9.5, 9.0, 2.0, None))
    )
    table = pd.read_parquet(tmp_path / "b.parquet")
    assert table["frame"].tolist() == [row["frame"] for row in read]
    assert table["track_id"].isna().all()
    write_boxes(found, tmp_path / "b.json")
    data = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))
    assert {image["file_name"] for image in data["images"]} == {name for name, _ in found}
    names = {image["id"]: image["file_name"] for image in data["images"]}
    assert [names[a["image_id"]] for a in data["annotations"]] == [row["frame"] for row in read]
    write_boxes(found[2:], tmp_path / "b.json")
    (alone,) = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))["images"]
    assert names[alone["id"]] == alone["file_name"]


def test_rows_of_stills(tmp_path):
    rows_ = [("a.jpg", None, 1, 2, 3, 4, 0.5), ("a.jpg", 7, 1, 2, 3, 4, 0.5)]
    write_boxes(rows_, tmp_path / "b.csv")
    assert [row["track_id"] for row in read_csv(tmp_path / "b.csv")] == ["", "7"]
    write_boxes([dict(zip(BOX_COLUMNS, row)) for row in rows_], tmp_path / "c.csv")
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()
    write_boxes(pd.DataFrame(rows_, columns=BOX_COLUMNS), tmp_path / "c.csv")
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()


# --- bad input ---


@pytest.mark.parametrize("name", ["t.csv", "t.jsonl", "t.txt"])
def test_a_track_comes_once_in_a_frame(tmp_path, name):
    rows_ = [(0, 1, 2, 3, 4, 5, 6), (0, 2, 2, 3, 4, 5, 6), (1, 1, 2, 3, 4, 5, 6)]
    for given_rows in (rows_ + rows_[1:2], rows_ + rows_[2:], rows_[::-1]):
        with pytest.raises(
            InvalidInputError, match=r"row \d: frame must be greater than \d, the last one of"
        ):
            write_tracks(given_rows, tmp_path / name)
    assert os.listdir(tmp_path) == []
    by_track = [rows_[0], rows_[2], rows_[1]]
    assert write_tracks([*by_track, (0, -1, 2, 3, 4, 5, 6), (0, -1, 2, 3, 4, 5, 6)], tmp_path / name) == 5
    assert len(read_labels(tmp_path / name)) == 5
    writer = TrackWriter(tmp_path / name)
    for _ in range(2):
        with writer as write:
            write(rows_[0])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ((0, 1, 2, 3), "row 0 must be a FrameResult or the values frame, track_id"),
        ((0, 1, 2, 3, 4, 5, 6, 7, 8, 0.9, 1, 1, 1), "row 0 must be a FrameResult or the values"),
        (
            (0, 1, 2, 3, 4, 5, 6, 7, 8, 9),
            "row 0: confidence must be a number, at least 0 and at most 1; got 9",
        ),
        ("0,1,2,3,4,5,6", "row 0 must be a FrameResult or the values"),
        (7, "row 0 must be a FrameResult or the values"),
        ({"frame": 0, "track_id": 1}, "row 0 lacks x1, y1, x2, y2, score; its names must be frame"),
        ((-1, 1, 2, 3, 4, 5, 6), "row 0: frame must be a number, at least 0; got -1"),
        ((0.5, 1, 2, 3, 4, 5, 6), "row 0: frame must be a whole number"),
        (("a.jpg", 1, 2, 3, 4, 5, 6), "row 0: frame must be a number"),
        ((0, None, 2, 3, 4, 5, 6), "row 0: track_id must be a number, finite; got None"),
        ((0, True, 2, 3, 4, 5, 6), "row 0: track_id must be a number, finite; got True"),
        ((0, 1, "2", 3, 4, 5, 6), "row 0: x1 must be a number, finite"),
        ((0, 1, 2, float("nan"), 4, 5, 6), "row 0: y1 must be a number, finite"),
        ((0, 1, 2, 3, 4, 5, float("inf")), "row 0: score must be a number, finite"),
        ((0, 1, 2, 3, 1, 5, 6), r"row 0 must have x1 <= x2 and y1 <= y2, got \[2.0, 3.0, 1.0, 5.0\]"),
        ((0, 1, 2, 3, 4, 5, 6, "far"), "row 0: distance_m must be a number, finite"),
    ],
)
def test_bad_rows(tmp_path, row, message):
    with pytest.raises(InvalidInputError, match=message):
        write_tracks([row], tmp_path / "t.csv")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("items", "options", "message"),
    [
        (
            ROWS,
            {"path": "t.xlsx"},
            r"path must end in .csv, .jsonl, .ndjson, .parquet, .txt, .json, .zip, got 't.xlsx'",
        ),
        (ROWS, {"path": "t"}, r"path must end in"),
        (ROWS, {"format": "excel"}, "format must be one of 'csv', 'jsonl', 'parquet', 'mot', 'coco'"),
        (ROWS, {"path": None}, "path must be a file name"),
        (ROWS, {"path": "missing/t.csv"}, "path needs an existing folder"),
        (ROWS, {"path": "."}, "path must"),
        (ROWS[0][0], {}, "results must be a list of results or rows, got 0"),
        ("rows", {}, "results must be a list"),
        (dict(zip(TRACK_COLUMNS, ROWS[0])), {}, "results must be a list .*; wrap it in a list"),
    ],
)
def test_bad_arguments(tmp_path, monkeypatch, items, options, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidInputError, match=message):
        write_tracks(items, **{"path": "t.csv", **options})
    assert os.listdir(tmp_path) == []


def test_a_missing_pyarrow_is_reported_before_the_video(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InvalidInputError, match=r"files need pyarrow; pip install pyarrow$"):
        TrackWriter(tmp_path / "t.parquet").__enter__()
    assert os.listdir(tmp_path) == []


def test_yolo_needs_the_shape_and_a_new_folder(tmp_path):
    with pytest.raises(InvalidInputError, match=r"shape must be \(height, width\) of the frames for YOLO"):
        write_tracks(ROWS, tmp_path / "yolo", format="yolo")
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match="path must be a new or empty folder for YOLO"):
        write_tracks(ROWS, tmp_path, format="yolo", shape=(720, 1280))
    with pytest.raises(InvalidInputError, match="row 0 must be a FrameResult"):
        write_tracks([3], tmp_path / "yolo", format="yolo", shape=(720, 1280))
    assert os.listdir(tmp_path) == ["file"]


def test_the_archive_for_cvat(tmp_path):
    write_tracks(RESULTS, tmp_path / "t.zip")
    with zipfile.ZipFile(tmp_path / "t.zip") as archive:
        assert sorted(archive.namelist()) == ["gt/gt.txt", "gt/labels.txt"]
        assert archive.read("gt/labels.txt") == b"vehicle\n"
        lines = archive.read("gt/gt.txt").decode().splitlines()
    track = next(track for track in RESULTS[0].tracks if track.shown)
    # Frames count from 1 and pixels from 0; the flag, the class and the visible fraction are 1.
    x1, y1, x2, y2 = (round(float(side), 2) for side in track.box)
    sides = ",".join(str(round(value, 9)) for value in (x1, y1, x2 - x1, y2 - y1))
    assert lines[0] == f"{RESULTS[0].index + 1},{track.id},{sides},1,1,1.0"
    assert len(lines) == 3


def test_a_yolo_folder_has_a_file_for_each_frame(tmp_path):
    rows = [(0, 7, 10, 20, 50, 60, 0.0), (0, 8, 0, 0, 100, 100, 3.0, None, None, 0.9)]
    write_tracks(rows, tmp_path / "yolo", format="yolo", shape=(100, 200, 3))
    (file,) = (tmp_path / "yolo" / "labels").iterdir()
    assert file.name == "000000.txt"
    assert file.read_text().splitlines() == [
        "0 0.150000 0.400000 0.200000 0.400000 0.500000 7",
        "0 0.250000 0.500000 0.500000 1.000000 0.900000 8",
    ]
    found = Detections([[10, 20, 50, 60]], [0.0])
    boxes = [("a.jpg", found), ("b.jpg", Detections.empty())]
    assert write_boxes(boxes, tmp_path / "boxes", format="yolo", shape=(100, 200)) == 1
    texts = {path.name: path.read_text() for path in (tmp_path / "boxes" / "labels").iterdir()}
    assert texts == {"a.txt": "0 0.150000 0.400000 0.200000 0.400000 0.500000\n", "b.txt": ""}
    with pytest.raises(InvalidInputError, match=r"the frames 'x/a.jpg' and 'y/a.jpg', which are one file"):
        write_boxes([("x/a.jpg", found), ("y/a.jpg", found)], tmp_path / "c", format="yolo", shape=(9, 9))
    write_tracks([(0, 1, 0, 0, 5, 5, -1e4)], tmp_path / "low", format="yolo", shape=(10, 10))
    assert (tmp_path / "low" / "labels" / "000000.txt").read_text().split()[5:] == ["0.000000", "1"]


def test_memory_does_not_grow_with_the_number_of_parquet_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("vehicle_detection._common.parquet._ROWS_PER_GROUP", 2)
    write_tracks([(frame, 1, 0, 0, 5, 5, 1.0) for frame in range(5)], tmp_path / "t.parquet")
    parquet = pytest.importorskip("pyarrow.parquet")
    file = parquet.ParquetFile(tmp_path / "t.parquet")
    assert file.num_row_groups == 3
    assert file.read()["frame"].to_pylist() == [0, 1, 2, 3, 4]


def test_stills_have_no_mot_and_no_frame_numbers(tmp_path):
    with pytest.raises(
        InvalidInputError, match=r"path must end in .csv, .jsonl, .ndjson, .parquet, .json, got"
    ):
        write_boxes([], tmp_path / "b.txt")
    with pytest.raises(InvalidInputError, match="row 0: frame must be the image's file name, got 3"):
        write_boxes([(3, None, 1, 2, 3, 4, 0.5)], tmp_path / "b.csv")
    with pytest.raises(InvalidInputError, match="row 0 must be"):
        write_boxes([("a.jpg", [1, 2, 3, 4])], tmp_path / "b.csv")
    assert os.listdir(tmp_path) == []
