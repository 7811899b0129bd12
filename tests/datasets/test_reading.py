import contextlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from vehicle_detection import (
    DatasetError,
    InvalidInputError,
    TrackTable,
    read_labels,
    write_image,
    write_labels,
)

HEADER = "frame,track,x1,y1,x2,y2,occluded,truncated,ignore"
CSV = f"{HEADER}\n0,-1,0,370,601.5,476,0,0,1\n0,-1,600,390,841,441,0,0,1\n2,1,5,6,70,80,1,0.25,0\n"


def written(folder, text, name="labels.csv"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_csv_of_labels(tmp_path):
    labels = read_labels(written(tmp_path, CSV))
    assert labels["frame"].tolist() == [0, 0, 2]
    assert labels["track_id"].tolist() == [-1, -1, 1]
    assert labels.boxes[0].tolist() == [0, 370, 601.5, 476]
    assert labels["occluded"].tolist() == [0, 0, 1]
    assert labels["truncated"].tolist() == [0, 0, 0.25]
    assert labels["ignore"].tolist() == [True, True, False]
    assert labels.columns == ("frame", "track_id", "x1", "y1", "x2", "y2", "occluded", "truncated", "ignore")


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbf" + CSV.encode(),
        CSV.replace("\n", "\r\n"),
        CSV.replace(",", ";"),
        CSV.replace(",", "\t"),
        CSV.replace(",", " , ") + "\n\n",
        CSV.replace("frame,track", "Frame,Track"),
        CSV.replace("\n", ",x\n"),
        CSV.replace("\n0,", "\n0.0,").replace("\n2,1,", "\n2.0,1.0,"),
        CSV.replace(",1\n", ",True\n").replace(",0\n", ",False\n"),
    ],
    ids=["bom", "windows", "semicolons", "tabs", "spaces", "capitals", "extra", "floats", "words"],
)
@pytest.mark.parametrize("name", ["labels.csv", "labels.txt"])
def test_csv_dialects_give_equal_labels(tmp_path, text, name):
    plain, other = read_labels(written(tmp_path, CSV)), read_labels(written(tmp_path, text, name))
    assert other["frame"].tolist() == plain["frame"].tolist()
    for column in ("x1", "y2", "track_id", "occluded", "truncated", "ignore"):
        np.testing.assert_array_equal(other[column], plain[column])


def test_csv_of_predictions(tmp_path):
    header = "frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps\n"
    text = header + "a.jpg,,1,2,3,4,0.5,,\nb.jpg,7,1,2,3,2,-1,30.5,\n"
    found = read_labels(written(tmp_path, text))
    assert found["frame"].tolist() == ["a.jpg", "b.jpg"]
    assert found["track_id"].tolist() == [-1, 7]
    assert found["score"].tolist() == [0.5, -1]
    np.testing.assert_array_equal(found["distance_m"], [np.nan, 30.5])
    assert np.isnan(found["speed_mps"]).all()
    assert len(read_labels(written(tmp_path, header))) == 0


@pytest.mark.parametrize("name", ["confidence", "conf"])
def test_a_confidence_is_a_score_where_there_is_no_other(tmp_path, name):
    text = f"frame,track_id,x1,y1,x2,y2,{name}\n0,1,0,0,9,9,0.5\n0,2,0,0,9,9,1\n"
    found = read_labels(written(tmp_path, text))
    np.testing.assert_allclose(found["score"], [0, 13.8], atol=0.1)
    assert found["confidence"].tolist() == [0.5, 1]
    with pytest.raises(DatasetError, match="line 4: some boxes have a score and some have none"):
        read_labels(written(tmp_path, f"{text}0,3,0,0,9,9,\n"))


@pytest.mark.parametrize("name", ["track", "track_id"])
def test_csv_labels_need_only_frames_tracks_and_boxes(tmp_path, name):
    labels = read_labels(written(tmp_path, f"frame,{name},x1,y1,x2,y2\n0,1,0,0,9,9\n1,1,1,0,9,9\n"))
    assert labels["track_id"].tolist() == [1, 1]
    assert "score" not in labels.columns
    assert not labels["ignore"].any()
    assert not labels["occluded"].any()
    ignored = read_labels(written(tmp_path, f"frame,{name},x1,y1,x2,y2,ignore\n0,1,0,0,9,9,1\n"))
    assert ignored["ignore"].tolist() == [True]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the columns frame, track, .* found an empty file"),
        ("frame,x1,y1,x2,y2\n", "lacks the columns track; found frame, x1, .*labels have .*; predictions"),
        ("frame,score,x1,y1,x2,y2\n", "lacks the columns track_id; found"),
        ("# exported\n0,1,2,3,4,5,0,0,0\n", "lacks the columns frame.* found # exported"),
        (HEADER + ",x1\n", "has the column x1 more than once"),
        (f"{HEADER}\n0,1,0,0,9\n", "line 2: expected 9 columns, found 5"),
        (f"{HEADER}\n\n0,1,0,0,nan,9,0,0,0\n", "line 3: x2 must be a finite number, got 'nan'"),
        (f"{HEADER}\n0,1,0,0,,9,0,0,0\n", "line 2: x2 must be a finite number, got ''"),
        (f"{HEADER}\n0,1,0,0,-9,9,0,0,0\n", r"line 2: a box needs x1 < x2 and y1 < y2, got \[0.0, 0.0, -9.0"),
        (f"{HEADER}\n0,1,0,5,9,5,0,0,0\n", "line 2: a box needs x1 < x2 and y1 < y2"),
        (f"{HEADER}\n4,1,0,0,9,9,0,0,0\n4,1,1,0,9,9,0,0,0\n", "line 3: track 1 comes twice in .* line 2"),
        (f"{HEADER}\n0,1,0,0,9,9,0,0,2\n", "line 2: ignore must be 0 or 1, got '2'"),
        pytest.param(f"{HEADER}\n0,1,0,0,{'9' * 130_000},9,0,0,2\n", r"got '9{76}\.\.\.$", id="long"),
        (f"{HEADER}\n0,1.5,0,0,9,9,0,0,0\n", "line 2: track must be a whole number, got '1.5'"),
        (f"{HEADER}\n0,-2,0,0,9,9,0,0,0\n", "line 2: track must be a number from 0, or -1 for none"),
        (f"{HEADER}\n0,1e99,0,0,9,9,0,0,0\n", "line 2: track must be a number"),
        (f"{HEADER}\n-1,1,0,0,9,9,0,0,0\n", "line 2: frame must be a whole number from 0 or a name, got -1"),
        (f"{HEADER}\n,1,0,0,9,9,0,0,0\n", "line 2: frame is empty"),
        (f"{HEADER}\n0,1,0,0,9,9,0,1.5,0\n", "line 2: truncated must be a fraction from 0 to 1, got '1.5'"),
        (f"{HEADER}\n0,1,0,0,9".replace(",", ";") + ",5;9;0;0;0\n", "use a decimal point"),
        (f'{HEADER}\n"0,1', "not CSV text"),
        (HEADER.encode() + b"\n\xff\xfe", "is not UTF-8 text; save it as UTF-8"),
    ],
)
def test_invalid_csv_files(tmp_path, text, message):
    with pytest.raises(DatasetError, match=message):
        read_labels(written(tmp_path, text))


def test_a_vehicle_that_is_labelled_twice_is_mentioned(tmp_path, caplog):
    read_labels(written(tmp_path, CSV.replace("\n2,", "\n0,-1,0,370,601.5,476,0,0,1\n2,")))
    assert not caplog.text
    assert len(read_labels(written(tmp_path, f"{CSV}2,-1,5,6,70,80,0,0,0\n"))) == 4
    assert "copies of other boxes of their frames: 1, the first at" in caplog.text
    read_labels(written(tmp_path, f"{HEADER}\n0,1,0.1,0.5,0.2,1,0,0,0\n"))
    assert "all boxes are within 1 pixel, as fractions of the frame are" in caplog.text


def test_boxes_are_clipped_to_the_shape(tmp_path):
    path = written(tmp_path, f"{HEADER}\n0,1,-5,10,700,90,0,0,0\n")
    assert read_labels(path, shape=(80, 640, 3)).boxes.tolist() == [[0, 10, 640, 80]]
    assert read_labels(path).boxes.tolist() == [[-5, 10, 700, 90]]
    with pytest.raises(DatasetError, match=r"line 2: box .* lies outside the 640x10 image; check that shape"):
        read_labels(path, shape=(10, 640))
    with pytest.raises(InvalidInputError, match="shape must be"):
        read_labels(path, shape=(640,))
    predicted = written(tmp_path, "frame,track_id,x1,y1,x2,y2,score\n0,,900,0,950,9,1\n")
    assert read_labels(predicted, shape=(80, 640)).boxes.tolist() == [[640, 0, 640, 9]]


KITTI = """Car 0.00 0 -1.57 599.41 156.40 649.25 189.25 2.85 2.63 12.34 0.47 1.49 69.44 -1.56
Van 0.80 1 0 10 10 60 60 1 1 1 1 1 1 1
Truck 0.00 3 0 100 10 160 60 1 1 1 1 1 1 1
Car 0.00 0 0 200 10 220 20 1 1 1 1 1 1 1
Tram 0.00 0 0 300 10 360 60 1 1 1 1 1 1 1
Cyclist 0.00 0 0 400 10 460 60 1 1 1 1 1 1 1
DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10
"""


def test_kitti_folder(tmp_path):
    written(tmp_path, KITTI, "000002.txt")
    written(tmp_path, "", "000010.txt")
    labels = read_labels(tmp_path)
    assert labels.frame_keys == ("000002", "000010")
    assert labels.boxes[0].tolist() == [599.41, 156.40, 649.25, 189.25]
    assert labels["ignore"].tolist() == [False, True, True, True, True, True]
    # KITTI has no tracks, but an ignored vehicle without one would be a region.
    assert labels["track_id"].tolist() == [-1, 1, 2, 3, 4, -1]
    assert len(read_labels(tmp_path / "000002.txt")) == 6
    assert (~read_labels(tmp_path, classes=["Tram"])["ignore"]).sum() == 1
    scored = written(tmp_path, "Car -1 -1 0 200 10 220 20 1 1 1 1 1 1 1 0.5\n", "000002.txt")
    result = read_labels(scored)
    assert (result["score"].tolist(), result["ignore"].tolist()) == ([0.5], [False])


def test_mot_file(tmp_path):
    assert read_labels(written(tmp_path, "1 -1 10 20 30 40\n", "bare.txt"))["track_id"].tolist() == [-1]
    by_class = written(tmp_path, "1,1,0,0,9,9,1,1,1\n2,2,0,0,9,9,1,3,0.5\n", "gt.txt")
    truth = read_labels(by_class, classes={3})
    assert (truth["track_id"].tolist(), truth["frame"].tolist()) == ([2], [1])


def coco(**changes):
    data = {
        "images": [{"id": 5, "file_name": "b.jpg"}, {"id": 6, "file_name": "a.jpg"}],
        "categories": [{"id": 1, "name": "Car"}, {"id": 2, "name": "person"}, {"id": 3, "name": "train"}],
        "annotations": [
            {"image_id": 5, "category_id": 1, "bbox": [10, 20, 30, 40]},
            {"image_id": 5, "category_id": 2, "bbox": [0, 0, 30, 40]},
            {"image_id": 5, "category_id": 3, "bbox": [0, 0, 60, 40]},
            {"image_id": 5, "category_id": 1, "bbox": [90, 0, 99, 40], "iscrowd": 1},
        ],
    }
    return json.dumps({**data, **changes})


BOX = {"image_id": 5, "category_id": 1, "bbox": [1, 2, 3, 4]}


def test_coco_file(tmp_path, caplog):
    labels = read_labels(written(tmp_path, coco(), "instances.json"))
    assert labels.frame_keys == ("a.jpg", "b.jpg")
    assert labels.boxes.tolist() == [[10, 20, 40, 60], [0, 0, 60, 40], [90, 0, 189, 40]]
    assert labels["ignore"].tolist() == [False, True, True]
    assert labels["track_id"].tolist() == [-1, 2, -1]
    assert len(read_labels(written(tmp_path, coco(), "coco.txt"), classes=["person"])) == 2
    entry = BOX | {"track_id": 9, "score": 0.5}
    found = read_labels(written(tmp_path, coco(annotations=[entry], images=[{"id": 5}]), "a.json"))
    assert [found[name].tolist() for name in ("frame", "track_id", "score")] == [[5], [9], [0.5]]
    # The number of an ignored box without a track is that of no other vehicle.
    entries = [BOX | {"ignore": 1}, BOX | {"track_id": 0}, BOX | {"track_id": 1}]
    found = read_labels(written(tmp_path, coco(annotations=entries), "b.json"))
    assert len(set(found["track_id"].tolist())) == 3
    names = dict(enumerate((" Car ", "Mid Trucks", "bus stop"), 1))
    spaced = coco(categories=[{"id": number, "name": name} for number, name in names.items()])
    assert set(read_labels(written(tmp_path, spaced, "c.json"))["label"]) == {"car"}
    assert "c.json: vehicles of class mid trucks are left out; classes= selects" in caplog.text


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "{", "line 1: not JSON text"),
        ("a.json", "[]", "is a list of COCO results, .* read it with truth=, and use the ground truth"),
        ("a.json", "[1]", "is not a COCO file: it lacks the lists images, annotations, categories"),
        ("a.json", coco(images=[{"file_name": "x"}]), "every image and category needs an id"),
        ("a.json", coco(images=[{"id": 5}, {"id": 6, "file_name": "a"}]), "give every image a file_name"),
        ("a.json", coco(images=[{"id": 5}, {"id": 5}]), "two images share an id"),
        ("a.json", coco(images=[]), "annotation 0: expected bbox .* image_id"),
        ("a.json", coco(annotations=[BOX | {"bbox": [1, 2]}]), "annotation 0: expected bbox"),
        ("a.json", coco(annotations=[BOX | {"bbox": [1, 2, 0, 5]}]), "annotation 0: a box needs x1 < x2"),
        ("a.json", coco(categories=[{"id": 1, "name": "boat"}]), "no category among bus, .* found 'boat'"),
        ("a.jsonl", '{"frame": 0}\n', "lacks the columns track, x1, .*; found frame"),
        ("a.jsonl", "{", "line 1: not a JSON object"),
        ("a.jsonl", "\n[]", "line 2: expected a JSON object, found"),
        ("a.parquet", "frame", "is not a Parquet file"),
        ("a.txt", "Car 0 0 0 1 2 3", "lacks the columns"),
        ("a.txt", KITTI.replace("69.44 ", ""), "lacks the columns"),
        ("a.txt", KITTI + "Car 0 0", "line 8: a KITTI object has 15 values .* found 3"),
        ("a.txt", "0,1,2,3,4,5\n", r"line 1: frame \(counted from 1\) must be at least 1"),
        ("a.txt", "1,1,2,3\n", "line 1: expected frame, id, x, y, width, height, found 4"),
        ("a.txt", "1,1,2,3,-4,5\n", "line 1: a box needs x1 < x2"),
        ("a.txt", "1,1,1e308,3,1.7e308,5\n", "line 1: x[12] must be a number of pixels"),
        ("a.txt", "1,1,2,3,4,5,0.5\n1,2,2,3,4,5\n", "line 2: expected 7 values, as before, found 6"),
    ],
)
def test_invalid_files_of_other_formats(tmp_path, name, text, message):
    with pytest.raises(DatasetError, match=message):
        read_labels(written(tmp_path, text, name))


def test_invalid_paths(tmp_path):
    for name, remedy in ((tmp_path / "none.csv", "check the path"), ("https://a.org/b.csv", "download it")):
        with pytest.raises(DatasetError, match=f"does not exist; {remedy}"):
            read_labels(name)
    for options, kind in (({}, "KITTI"), ({"format": "yolo", "shape": (9, 9)}, "folder of YOLO")):
        with pytest.raises(DatasetError, match=rf"holds no \.txt file; name a {kind} label"):
            read_labels(tmp_path, **options)
    with pytest.raises(DatasetError, match="is a folder, and csv labels are one file"):
        read_labels(tmp_path, format="csv")


FIELDS = st.sampled_from([*"012a", "-1", "0.5", "nan", "1e999", "1e308", "", "Car", '"', "\x00", "007"])


@given(
    kind=st.sampled_from(["csv", "kitti", "mot"]),
    lines=st.lists(st.lists(FIELDS, min_size=5, max_size=16), max_size=4),
    headed=st.booleans(),
)
@settings(max_examples=100)
def test_readers_raise_only_dataset_errors(tmp_path_factory, kind, lines, headed):
    separator = {"csv": ",", "kitti": " ", "mot": ","}[kind]
    text = (HEADER + "\n") * headed + "\n".join(
        separator.join(line[:9] if headed else line) for line in lines
    )
    path = written(tmp_path_factory.mktemp("fuzz"), text)
    try:
        assert isinstance(read_labels(path, format=kind), TrackTable)
    except DatasetError as error:
        assert len(str(error).splitlines()) == 1  # noqa: PT017


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-2, 6) | st.floats() | st.sampled_from(["car", "a.jpg", "x"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                ["id", "file_name", "name", "bbox", "image_id", "category_id", "score", "track_id", "iscrowd"]
            ),
            inner,
            max_size=5,
        )
    ),
    max_leaves=12,
)


@given(changes=st.dictionaries(st.sampled_from(["images", "categories", "annotations"]), JSON, max_size=2))
@settings(max_examples=100)
def test_coco_reader_raises_only_dataset_errors(tmp_path_factory, changes):
    path = written(tmp_path_factory.mktemp("fuzz"), coco(**changes), "a.json")
    with contextlib.suppress(DatasetError):
        assert isinstance(read_labels(path), TrackTable)


# --- archives of CVAT, YOLO ---


def write_zip(path, text, names=None):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        if text is not None:
            archive.writestr("gt/gt.txt", text)
        if names is not None:
            archive.writestr("gt/labels.txt", names)
    return path


def test_an_archive_of_cvat(tmp_path):
    text = "1,3,10,20,30,40,1,2,1.0\n2,4,10,20,30,40,0,2,0.5\n2,5,1,1,2,2,1,1,1.0\n"
    found = read_labels(write_zip(tmp_path / "t.zip", text, "person\nCar\n"))
    assert found["frame"].tolist() == [0, 1]
    assert found["track_id"].tolist() == [3, 4]
    assert found.boxes.tolist() == [[10, 20, 40, 60]] * 2
    assert found["ignore"].tolist() == [False, True]
    assert len(read_labels(tmp_path / "t.zip", classes=["Person"])) == 1
    zipfile.ZipFile(tmp_path / "t.zip").extractall(tmp_path)
    assert read_labels(tmp_path / "gt" / "gt.txt").to_pandas().equals(found.to_pandas())
    assert len(read_labels(write_zip(tmp_path / "u.zip", text))) == 3


@pytest.mark.parametrize(
    ("text", "names", "message"),
    [
        (None, "car", "is not an archive of CVAT: it lacks gt/gt.txt; export MOT 1.1"),
        ("1,3,10,20,30,40,1,2,1.0", "car", "line 1: class must be a whole number from 1 to 1, .* got 2"),
        ("1,3,10,20,30,40,1,1.5,1.0", "car", "class must be a whole number from 1 to 1, .* got 1.5"),
        ("1,3", "car", "line 1: expected frame, id"),
    ],
)
def test_invalid_archives(tmp_path, text, names, message):
    with pytest.raises(DatasetError, match=message):
        read_labels(write_zip(tmp_path / "t.zip", text, names))
    (tmp_path / "t.zip").write_bytes(b"PK no zip")
    with pytest.raises(DatasetError, match="is not a zip archive that can be read"):
        read_labels(tmp_path / "t.zip")


def test_an_archive_with_too_large_a_file(tmp_path, monkeypatch):
    path = write_zip(tmp_path / "t.zip", "1,3,10,20,30,40,1,1,1.0\n" * 1000)
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_TEXT_BYTES", "5000")
    with pytest.raises(DatasetError, match=r"gt/gt.txt is larger than 5,000 bytes; .* set VEHICLE"):
        read_labels(path)


def test_a_yolo_folder(tmp_path):
    (tmp_path / "labels").mkdir()
    (tmp_path / "data.yaml").write_text("names: ['person', \"car\"]\nnc: 2\n")
    (tmp_path / "labels" / "a.txt").write_text("1 0.5 0.5 0.2 0.4\n0 0.5 0.5 0.1 0.1\n")
    (tmp_path / "labels" / "b.txt").write_text("")
    found = read_labels(tmp_path, shape=(100, 200))
    assert found.frame_keys == ("a", "b")
    np.testing.assert_allclose(found.boxes, [[80, 30, 120, 70]])
    assert "score" not in found.columns
    assert len(read_labels(tmp_path, shape=(100, 200), classes=["person", "car"])) == 2


def test_a_yolo_folder_of_images_of_several_sizes(tmp_path):
    for folder in ("labels/train", "images/train"):
        (tmp_path / folder).mkdir(parents=True)
    labels, images = tmp_path / "labels" / "train", tmp_path / "images" / "train"
    for name, shape in {"000001.png": (40, 80, 3), "000002.jpg": (100, 200, 3)}.items():
        write_image(images / name, np.zeros(shape, np.uint8))
        written(labels, "0 0.5 0.5 0.2 0.4\n", f"{Path(name).stem}.txt")
    rotated = Image.new("RGB", (60, 30))
    exif = rotated.getexif()
    exif[274] = 6  # turned by a quarter
    rotated.save(images / "c.jpg", exif=exif)
    written(labels, "0 0.5 0.5 1.001 1\n", "c.txt")
    found = read_labels(labels, images=images)
    assert found["frame"].tolist() == ["000001.png", "000002.jpg", "c.jpg"]
    np.testing.assert_allclose(found.boxes, [[32, 12, 48, 28], [80, 30, 120, 70], [0, 0, 30, 60]])
    for folder, options in ((tmp_path, {"images": images}), (tmp_path / "labels", {})):
        with pytest.raises(DatasetError, match=r"labels holds no \.txt file; .* name .*labels.train"):
            read_labels(folder, **options)
    (images / "c.jpg").unlink()
    with pytest.raises(DatasetError, match=r"c\.txt has no image in .*train; pass the folder of its image"):
        read_labels(labels, images=images)


@pytest.mark.parametrize("line", ["0 0.5 0.5 0.2 0.4", "0 0.5 0.5 0.2 0.4 0.9", "0 0.5 0.5 0.2 0.4 0.9 7"])
def test_a_folder_of_text_files_is_yolo_by_the_number_of_values(tmp_path, line):
    written(tmp_path, "", "a.txt")
    written(tmp_path, f"{line}\n", "b.txt")
    assert len(read_labels(tmp_path, shape=(100, 200))) == 1


def test_a_yolo_folder_without_names(tmp_path):
    (tmp_path / "a.txt").write_text("1 0.5 0.5 0.2 0.4\n0 0.5 0.5 0.1 0.1\n")
    options = {"format": "yolo", "shape": (100, 200)}
    assert len(read_labels(tmp_path, **options)) == 2
    np.testing.assert_allclose(read_labels(tmp_path, **options, classes=["1"]).boxes, [[80, 30, 120, 70]])
    with pytest.raises(DatasetError, match="no class among car; found '0', '1'"):
        read_labels(tmp_path, **options, classes=["car"])
    for text in ("names: [", "names: !!bool car", "[" * 10_000):
        (tmp_path / "data.yaml").write_text(text)
        with pytest.raises(DatasetError, match="yaml is not YAML text: "):
            read_labels(tmp_path, **options)


@pytest.mark.parametrize(("kinds", "named"), [("car pedestrian", True), ("car tram", False)])
def test_a_table_like_those_written_here_may_hold_other_classes(tmp_path, caplog, kinds, named):
    """All its rows are vehicles, which a warning says of classes that are none by default."""
    head = "frame,track_id,x1,y1,x2,y2,occluded,truncated,ignore,label\n"
    rows = (f"0,{track},0,0,50,40,0,0,0,{kind}\n" for track, kind in enumerate(kinds.split()))
    labels = read_labels(written(tmp_path, head + "".join(rows), "a.csv"))
    assert labels["label"].tolist() == kinds.split()
    assert ("pedestrian are read as vehicles" in caplog.text) == named


def test_files_without_a_class_of_vehicles_are_refused(tmp_path):
    options = {"format": "yolo", "shape": (100, 200)}
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.2 0.4\n")
    (tmp_path / "classes.txt").write_text("auto\nlkw\n")
    message = r"no class among bus, car, .* found 'auto', 'lkw'; name those of vehicles with classes="
    with pytest.raises(DatasetError, match=message):
        read_labels(tmp_path, **options)
    assert len(read_labels(tmp_path, **options, classes=["Auto"])) == 1
    with pytest.raises(DatasetError, match=r"no class among foo; found 'auto', 'lkw'"):
        read_labels(tmp_path, **options, classes=["foo"])
    (tmp_path / "mot.txt").write_text("1,1,1,1,9,9,1,3,1\n")
    with pytest.raises(DatasetError, match=r"no class among car; found '3'"):
        read_labels(tmp_path / "mot.txt", classes=["car"])
    assert len(read_labels(tmp_path / "mot.txt", classes=["3"])) == 1
    (tmp_path / "mot.txt").write_text("1,1,1,1,9,9,0.5,-1,-1,-1\n")
    with pytest.raises(DatasetError, match="holds predictions, which have no classes; leave out classes="):
        read_labels(tmp_path / "mot.txt", classes=["3"])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0.5 0.5", r"a\.txt line 1: expected class, center and size, .*, found 3 values"),
        ("1 0.5 0.5 x 0.1", "side of the box must be a finite number, got 'x'"),
        ("1 0.5 0.5 0.1 0.1 1.5", "confidence must be from 0 to 1"),
        ("1 90 40 9 9 0.5", "the box 90 40 9 9 lies outside the image; center and size are fractions"),
    ],
)
def test_invalid_yolo_files(tmp_path, line, message):
    (tmp_path / "a.txt").write_text(line)
    with pytest.raises(DatasetError, match=message):
        read_labels(tmp_path, format="yolo", shape=(100, 200))
    with pytest.raises(InvalidInputError, match=r"shape must be \(height, width\) of the frames .* images="):
        read_labels(tmp_path, format="yolo")


@pytest.mark.parametrize(
    ("names", "text", "known"),
    [
        ("data.yaml", "names:\n  0: person\n  2: car  # sedans\n  7: truck\nnc: 8\n", True),
        ("dataset.yaml", "names: {0: person, 2: 'Car', 7: truck}\n", True),
        ("data.yaml", '{"names": {"0": "person", "2": "car", "7": "bus"}}', True),
        ("data.yaml", "names: [driver's seat, 'x [y]', car, x, x, x, x, bus]\n---\n- a\n", True),
        ("classes.txt", "person\nx\ncar\nx\nx\nx\nx\ntruck\n", True),
        ("other.txt", "", False),
    ],
)
def test_names_of_yolo_classes(tmp_path, names, text, known):
    (tmp_path / "labels" / "train").mkdir(parents=True)
    written(tmp_path, text, names)
    rows = "0 .2 .5 .1 .1\n2.0 .5 .5 .1 .1\n7 .8 .5 .1 .1\n"
    written(tmp_path / "labels" / "train", rows, "000000.txt")
    labels = read_labels(tmp_path / "labels" / "train", format="yolo", shape=(100, 100))
    assert labels.boxes[:, 0].round().tolist() == ([45, 75] if known else [15, 45, 75])


def test_numbers_that_only_python_reads(tmp_path):
    with pytest.raises(DatasetError, match="x1 must be a finite number, got '1_0'"):
        read_labels(written(tmp_path, "frame,track,x1,y1,x2,y2\n0,1,1_0,2,30,40\n"))
    for frame in ("{}", "[1]", "true"):
        row = f'{{"frame": {frame}, "track": 1, "x1": 1, "y1": 1, "x2": 9, "y2": 9}}'
        with pytest.raises(DatasetError, match="line 1: frame must be a whole number from 0 or a name"):
            read_labels(written(tmp_path, row, "a.jsonl"))
    for name in ("a.jsonl", "a.json"):
        with pytest.raises(DatasetError, match="a number has too many digits"):
            read_labels(written(tmp_path, '{"frame": ' + "9" * 5000 + "}", name))


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "txt"])
def test_tracks_with_large_ids_remain_distinct(tmp_path, suffix):
    ids = [2**53, 2**53 + 1, 2**62]
    boxes = [[100 * place, 0, 100 * place + 50, 40] for place in range(3)]
    write_labels(TrackTable([0, 1, 2], ids, boxes), tmp_path / f"a.{suffix}")
    assert read_labels(tmp_path / f"a.{suffix}")["track_id"].tolist() == ids


def test_an_empty_column_of_scores_is_one_of_labels(tmp_path):
    text = "frame,track,x1,y1,x2,y2,score\n0,3,1,2,30,40,\n"
    labels = read_labels(written(tmp_path, text))
    assert (labels["track_id"].tolist(), "score" in labels.columns) == ([3], False)
    with pytest.raises(DatasetError, match="line 2: some boxes have a score and some have none"):
        read_labels(written(tmp_path, f"{text}0,4,1,2,30,40,0.5\n"))
