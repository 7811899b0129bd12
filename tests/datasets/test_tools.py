"""Files as the tools of today write them."""

import json

import pytest

from vehicle_detection import Detections, TrackTable, read_labels, write_labels
from vehicle_detection.errors import DatasetError, InvalidInputError

COCO = {
    "images": [{"id": 1, "file_name": "a.jpg"}, {"id": 2, "file_name": "b.jpg"}],
    "categories": [{"id": 1, "name": "Car", "supercategory": ""}],
}
BOX = {"image_id": 1, "category_id": 1, "bbox": [10, 20, 30, 40], "area": 1200, "segmentation": []}


def coco(tmp_path, **values):
    path = tmp_path / "instances_default.json"
    path.write_text(json.dumps(COCO | {"annotations": [{"id": 1} | BOX | values]}))
    return read_labels(path)


@pytest.mark.parametrize(
    ("values", "track", "occluded"),
    [
        pytest.param({"attributes": {"track_id": 3, "occluded": True, "keyframe": True}}, 3, 1, id="CVAT"),
        pytest.param({"attributes": {"occluded": False}}, -1, 0, id="CVAT, shapes"),
        pytest.param({"instance_id": 4, "occluded": True}, 4, 1, id="MMTracking"),
        pytest.param({"track_id": 5, "attributes": {"track_id": 3}}, 5, 0, id="both"),
        pytest.param({"track_id": None, "attributes": []}, -1, 0, id="none"),
    ],
)
def test_tracks_and_occlusion_in_coco(values, track, occluded, tmp_path):
    table = coco(tmp_path, **values)
    assert (table["track_id"].tolist(), table["occluded"].tolist()) == ([track], [occluded])
    assert table.boxes.tolist() == [[10, 20, 40, 60]]


MOT_LABELS = {
    "MOT17": "1,1,11,21,30,40,1,3,0.8\n1,2,11,21,30,40,0,3,1",
    "spaces": "1 1 11 21 30 40 1 3 0.8\n1 2 11 21 30 40 0 3 1",
    "VisDrone": "1,1,11,21,30,40,1,4,0,0\n1,2,11,21,30,40,0,4,1,2",
}
MOT_RESULTS = {
    "MOT": "1,1,11,21,30,40,0.9\n1,2,11,21,30,40,0.2",
    "numpy.savetxt": "1.0e+00 1.0e+00 1.1e+01 2.1e+01 3e+01 4e+01 9e-01\n1e+00 2e+00 11 21 3e+01 4e+01 2e-01",
    "eight": "1,1,11,21,30,40,0.9,2\n1,2,11,21,30,40,0.2,2",
    "BoxMOT": "1,1,11,21,30,40,0.9,2,-1\n1,2,11,21,30,40,0.2,2,-1",
    "TrackEval, CRLF and BOM": "\ufeff1,1,11,21,30,40,0.9,-1,-1,-1\r\n1,2,11,21,30,40,0.2,-1,-1,-1\r\n",
}


@pytest.mark.parametrize("text", MOT_LABELS.values(), ids=MOT_LABELS)
def test_labels_of_mot(text, tmp_path):
    (tmp_path / "gt.txt").write_text(text)
    table = read_labels(tmp_path / "gt.txt")
    assert "score" not in table.columns
    assert table["ignore"].tolist() == [False, True]
    assert table.boxes[0].tolist() == [10, 20, 40, 60]


@pytest.mark.parametrize("text", MOT_RESULTS.values(), ids=MOT_RESULTS)
def test_results_of_mot(text, tmp_path):
    (tmp_path / "a.txt").write_text(text, newline="")
    table = read_labels(tmp_path / "a.txt")
    assert table["score"].tolist() == [0.9, 0.2]
    assert (table["frame"].tolist(), table["ignore"].tolist()) == ([0, 0], [False, False])


@pytest.mark.parametrize(("flag", "visibility"), [("0", "-1"), ("1", "-1"), ("0.0", "7")])
def test_nine_columns_that_are_no_labels_are_not_ignored(flag, visibility, tmp_path):
    (tmp_path / "a.txt").write_text(f"1 1 110 200 100 50 {flag} 2 {visibility}")
    assert read_labels(tmp_path / "a.txt")["score"].tolist() == [float(flag)]


def test_labels_of_kitti_tracking(tmp_path):
    rest = "0 0 -1.57 10 20 90 60 1.5 1.6 4 1 2 30 -1.5"
    text = f"0 3 Car {rest}\n0 -1 DontCare {rest}\n2 3 Van {rest}\n2 5 Cyclist {rest}\n2 7 Tram {rest}\n"
    (tmp_path / "0001.txt").write_text(text)
    table = read_labels(tmp_path / "0001.txt")
    assert (table["frame"].tolist(), table["track_id"].tolist()) == ([0, 0, 2, 2], [3, -1, 3, 7])
    assert table["ignore"].tolist() == [False, True, False, True]
    assert len(read_labels(tmp_path)) == 4
    (tmp_path / "0002.txt").write_text(text)
    with pytest.raises(DatasetError, match="several drives; name one"):
        read_labels(tmp_path)


def test_yolo_of_cvat(tmp_path):
    folder = tmp_path / "obj_train_data"
    folder.mkdir()
    (tmp_path / "obj.names").write_text("person\r\ncar\r\n")
    for name in ("train.txt", "obj_train_data/val.txt"):
        (tmp_path / name).write_text("./data/a.jpg\n")
    (folder / "frame_000000.txt").write_text("1 0.5 0.5 0.2 0.4\n0 0.5 0.5 0.1 0.1\n")
    (folder / "frame_000001.txt").write_text("")
    for path in (tmp_path, folder):
        table = read_labels(path, shape=(100, 200))
        assert table.boxes.tolist() == [[80, 30, 120, 70]]
        assert table.frame_keys == ("frame_000000", "frame_000001")
    (folder / "frame_000001.txt").write_text("2 .5 .5 .2 .2")
    with pytest.raises(DatasetError, match="line 1: class 2 has no name"):
        read_labels(folder, shape=(100, 200))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", "1,1,9,9,30,40,0.9,0\n1,2,9,9,30,40,0.9,2"),
        ("a.txt", "1,1,9,9,30,40,0.9,0,-1\n1,2,9,9,30,40,0.2,2,-1"),
        ("labels/a.txt", "0 .5 .5 .2 .2\n9 .5 .5 .2 .2"),
    ],
)
def test_classes_that_are_numbers_are_read_with_a_warning(name, text, tmp_path, caplog):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    source = path if path.parent == tmp_path else path.parent
    assert len(read_labels(source, shape=(100, 200))) == 2
    assert "are read as vehicles" in caplog.text
    caplog.clear()
    assert len(read_labels(source, shape=(100, 200), classes=["0"])) == 1
    assert not caplog.text


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", {"shapes": [], "imagePath": "a.jpg"}, "Labelme or X-AnyLabeling, .* export COCO"),
        ("a.json", [{"name": "a", "labels": []}], "BDD100K"),
        ("a.json", [{"id": 1, "data": {"image": "a.jpg"}, "annotations": []}], "Label Studio"),
        ("a.json", [{"image": "a.jpg", "annotator": 1, "label": []}], "Label Studio"),
        ("a.json", {"a.jpg12": {"filename": "a.jpg", "regions": []}}, "VGG Image Annotator"),
        ("a.json", {"info": {}, "categories": {}, "items": []}, "Datumaro"),
        ("a.json", {}, "lacks the lists images, annotations, categories"),
        ("a.xml", "<?xml version='1.0'?><annotations/>", "CVAT or Pascal VOC, .* export COCO"),
        ("data.yaml", "names: [car]", "pass its folder of labels"),
        ("labels/a.txt", "0 .1 .1 .2 .1 .2 .2 .1 .2", "found 9 values; export boxes"),
        ("labels/a.txt", "0 .5 .5 .2 .2 7", "save_conf=True"),
        ("a.txt", "1,1,9,9,30,40,1,1,1.0\n1,2,9,9,30,40,1,1,x\n", "line 2: value must be a finite number"),
        ("labels/a.txt", "0 .5 .5 .2 .2 .9 1\n0 .5 .5 .2 .2 .9", "line 2: expected 7 values, as before"),
        ("labels/a.txt", "0 .5 .5 .2 .2 1\n", "tracks without confidences"),
    ],
)  # fmt: skip
def test_other_formats_and_damaged_rows_are_named(name, text, message, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    with pytest.raises(DatasetError, match=message):
        read_labels(path.parent if path.parent != tmp_path else path, shape=(100, 200))


@pytest.mark.parametrize(("name", "tool"), [("a.xml", "Pascal VOC"), ("a.json", "a file for each image")])
def test_folders_of_other_formats_are_named(name, tool, tmp_path):
    (tmp_path / name).write_text("")
    with pytest.raises(DatasetError, match=f"{tool}, which are not read; export one COCO file"):
        read_labels(tmp_path)


def test_names_that_spreadsheets_take_for_formulas(tmp_path):
    names = ["=1+1.jpg", "+a.jpg", "-b.jpg", "@c.jpg", "d.jpg"]
    table = TrackTable(names, None, [[0, 0, 9, 9]] * 5)
    write_labels(table, tmp_path / "a.csv")
    cells = [line.partition(",")[0] for line in (tmp_path / "a.csv").read_text().splitlines()[1:]]
    assert all(cell[0] not in "=+-@" for cell in cells)
    assert sorted(read_labels(tmp_path / "a.csv")["frame"].tolist()) == sorted(names)


@pytest.mark.parametrize("kind", ["kitti", "yolo"])
def test_a_frame_name_with_a_null_byte_is_no_file(kind, tmp_path):
    shape = {"shape": (20, 20)} if kind == "yolo" else {}
    with pytest.raises(InvalidInputError, match="labels name a frame with a null byte"):
        write_labels(TrackTable(["a\0b"], None, [[0, 0, 9, 9]]), tmp_path / "new", format=kind, **shape)


@pytest.mark.parametrize("number", ["1e200", "-1e200", "1e10"])
def test_corners_of_absurd_size_are_errors(number, tmp_path):
    (tmp_path / "a.csv").write_text(f"frame,track,x1,y1,x2,y2\n0,1,0,0,9,9\n1,1,{number},0,2e10,9\n")
    with pytest.raises(DatasetError, match="line 3: x1 must be a number of pixels"):
        read_labels(tmp_path / "a.csv")
    with pytest.raises(InvalidInputError, match="values beyond 1e"):
        Detections([[0, 0, 1e200, 9]], [1.0])
