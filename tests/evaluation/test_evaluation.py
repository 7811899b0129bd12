"""Scores against hand-computed cases, against motmetrics, and by invariants; readers against bad files."""

import contextlib
import json
import math
from dataclasses import replace
from pathlib import Path

import motmetrics
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vehicle_detection.boxes import Detections, iou_matrix
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation import (
    FrameBoxes,
    calibration_error,
    evaluate_detections,
    evaluate_tracks,
    precision_recall_curve,
    read_labels,
)

CAR = (0.0, 0.0, 100.0, 60.0)


def moved(dx=0.0, dy=0.0, box=CAR):
    return (box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy)


def boxes_of(*rows, **columns):
    """Labels from (frame, track, box) or (frame, track, box, score) rows."""
    scores = [row[3] for row in rows] if rows and len(rows[0]) == 4 else None
    frames, tracks, boxes = ([row[index] for row in rows] for index in range(3))
    return FrameBoxes(frames, tracks, boxes, **{"scores": scores, **columns})


# --- Labels ---------------------------------------------------------------------------------------


def test_labels_give_rows_of_a_frame_and_keep_empty_frames():
    labels = boxes_of((2, 1, CAR), (0, 1, moved(5)), (2, 3, moved(300)), frame_keys=(0, 1, 2, 3))
    assert len(labels) == 3
    assert labels.frame_keys == (0, 1, 2, 3)
    assert labels.rows(2).tolist() == [0, 2]
    assert labels.frame(2).tracks.tolist() == [1, 3]
    assert len(labels.frame(1)) == len(labels.frame(99)) == 0
    assert labels[labels.tracks == 3].frame_keys == (0, 1, 2, 3)
    assert repr(labels) == "Labels(3 boxes in 4 frames)"


def test_labels_order_names_by_their_numbers_and_take_numpy_keys():
    assert boxes_of(*((name, -1, CAR) for name in ("f10.png", "f2.png", "a.png"))).frame_keys == (
        "a.png",
        "f2.png",
        "f10.png",
    )
    assert all(type(key) is int for key in FrameBoxes(np.arange(2), None, [CAR, CAR]).frame_keys)
    assert FrameBoxes(np.array(["b", "a"]), None, [CAR, CAR]).frame_keys == ("a", "b")


def test_labels_of_nothing_and_from_detections():
    assert len(FrameBoxes([], [], [])) == 0
    found = FrameBoxes.from_detections({"a": Detections([CAR], [0.5]), "b": Detections.empty()})
    assert found.scores.tolist() == [0.5]
    assert found.frame_keys == ("a", "b")
    assert found.tracks.tolist() == [-1]
    assert len(FrameBoxes.from_detections({})) == 0


def test_labels_do_not_share_memory_with_what_they_were_made_of():
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
        ({"truncated": [0, 1.5]}, "truncated must be a share from 0 to 1"),
        ({"ignore": [0, 1]}, "ignore must be one value .* dtype int64"),
        ({"scores": [1, math.nan]}, "scores must be finite"),
        ({"distance_m": [1]}, "distance_m must be one value for each of the 2 boxes"),
        ({"frame_keys": ["a"]}, "frame_keys must be all int or all str"),
    ],
)
def test_labels_refuse(change, message):
    columns = {"frames": [0, 0], "tracks": [1, 2], "boxes": [CAR, moved(200)]}
    with pytest.raises(InvalidInputError, match=message):
        FrameBoxes(**{**columns, **change})


# --- readers --------------------------------------------------------------------------------------

HEADER = "frame,track,x1,y1,x2,y2,occluded,truncated,ignore"
CSV = f"{HEADER}\n0,-1,0,370,601.5,476,0,0,1\n0,-1,600,390,841,441,0,0,1\n2,1,5,6,70,80,1,0.25,0\n"


def written(folder, text, name="labels.csv"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_csv_of_labels(tmp_path):
    labels = read_labels(written(tmp_path, CSV))
    assert labels.frames == (0, 0, 2)
    assert labels.tracks.tolist() == [-1, -1, 1]
    assert labels.boxes[0].tolist() == [0, 370, 601.5, 476]
    assert labels.occluded.tolist() == [0, 0, 1]
    assert labels.truncated.tolist() == [0, 0, 0.25]
    assert labels.ignore.tolist() == [True, True, False]
    assert labels.scores is labels.distance_m is labels.speed_mps is None


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
def test_csv_dialects_read_alike(tmp_path, text, name):
    plain, other = read_labels(written(tmp_path, CSV)), read_labels(written(tmp_path, text, name))
    assert other.frames == plain.frames
    for column in ("boxes", "tracks", "occluded", "truncated", "ignore"):
        np.testing.assert_array_equal(getattr(other, column), getattr(plain, column))


def test_csv_of_predictions(tmp_path):
    header = "frame,track_id,x1,y1,x2,y2,score,distance_m,speed_mps\n"
    text = header + "a.jpg,,1,2,3,4,0.5,,\nb.jpg,7,1,2,3,2,-1,30.5,\n"
    found = read_labels(written(tmp_path, text))
    assert found.frames == ("a.jpg", "b.jpg")
    assert found.tracks.tolist() == [-1, 7]
    assert found.scores.tolist() == [0.5, -1]
    np.testing.assert_array_equal(found.distance_m, [np.nan, 30.5])
    assert found.speed_mps is None
    assert len(read_labels(written(tmp_path, header))) == 0


def test_csv_frames_with_leading_zeros_are_names(tmp_path):
    text = f"{HEADER}\n007,1,0,0,9,9,0,0,0\n"
    assert read_labels(written(tmp_path, text)).frames == ("007",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the columns frame, track, .* found an empty file"),
        (
            "frame,track,x1,y1,x2,y2\n",
            "lacks the columns occluded, truncated, ignore; found frame, track, x1",
        ),
        ("frame,track_id,x1,y1,x2,y2\n", "lacks the columns score; found frame"),
        ("frame,score,x1,y1,x2,y2\n", "lacks the columns track_id; found"),
        ("0,1,2,3,4,5,0,0,0\n", "lacks the columns frame.* found 0, 1, 2"),
        (HEADER + ",x1\n", "has the column x1 more than once"),
        (f"{HEADER}\n0,1,0,0,9\n", "line 2: 9 columns are expected, found 5"),
        (f"{HEADER}\n\n0,1,0,0,nan,9,0,0,0\n", "line 3: x2 must be a finite number, got 'nan'"),
        (f"{HEADER}\n0,1,0,0,1e999,9,0,0,0\n", "line 2: x2 must be a finite number"),
        (f"{HEADER}\n0,1,0,0,,9,0,0,0\n", "line 2: x2 must be a finite number, got ''"),
        (f"{HEADER}\n0,1,0,0,-9,9,0,0,0\n", r"line 2: a box needs x1 < x2 and y1 < y2, got \[0.0, 0.0, -9.0"),
        (f"{HEADER}\n0,1,0,5,9,5,0,0,0\n", "line 2: a box needs x1 < x2 and y1 < y2"),
        (
            f"{HEADER}\n4,1,0,0,9,9,0,0,0\n4,1,1,0,9,9,0,0,0\n",
            "line 3: track 1 comes twice in frame 4, first at .* line 2",
        ),
        (f"{HEADER}\n0,1,0,0,9,9,0,0,2\n", "line 2: ignore must be 0 or 1, got '2'"),
        (f"{HEADER}\n0,1.5,0,0,9,9,0,0,0\n", "line 2: track must be a whole number, got '1.5'"),
        (f"{HEADER}\n0,-2,0,0,9,9,0,0,0\n", "line 2: track must be at least -1"),
        (f"{HEADER}\n0,1e99,0,0,9,9,0,0,0\n", "line 2: track must be at most"),
        (f"{HEADER}\n-1,1,0,0,9,9,0,0,0\n", "line 2: frame must be at least 0"),
        (f"{HEADER}\n,1,0,0,9,9,0,0,0\n", "line 2: frame is empty"),
        (f"{HEADER}\n0,1,0,0,9,9,0,1.5,0\n", "line 2: truncated must be at most 1"),
        (
            f"{HEADER}\n0,1,0,0,9,9,0,0,0\n".replace(",", ";").replace(";9;9;", ";9,5;9;"),
            "decimals with a point",
        ),
        (f'{HEADER}\n"0,1', "no CSV text"),
        (HEADER.encode() + b"\n\xff\xfe", "is no UTF-8 text; save it as UTF-8"),
    ],
)
def test_csv_refused(tmp_path, text, message):
    with pytest.raises(DatasetError, match=message):
        read_labels(written(tmp_path, text))


def test_shape_clips_and_reports(tmp_path):
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
    assert labels.ignore.tolist() == [False, True, True, True, True, True]
    assert (labels.tracks[:-1] >= 0).all()
    assert labels.tracks[-1] == -1
    assert len(read_labels(tmp_path / "000002.txt")) == 6
    assert (~read_labels(tmp_path, classes=["Tram"]).ignore).sum() == 1
    scored = written(tmp_path, "Car -1 -1 0 200 10 220 20 1 1 1 1 1 1 1 0.5\n", "000002.txt")
    result = read_labels(scored)
    assert (result.scores.tolist(), result.ignore.tolist()) == ([0.5], [False])


def test_mot_file(tmp_path):
    truth = read_labels(written(tmp_path, "1,3,10,20,30,40,1,1,1\n2,3,11,20,30,40,0,1,0.5\n", "gt.txt"))
    assert truth.frames == (0, 1)
    assert truth.boxes[0].tolist() == [10, 20, 40, 60]
    assert truth.ignore.tolist() == [False, True]
    assert truth.scores is None
    found = read_labels(written(tmp_path, "1, 3, 10, 20, 30, 40, 0.75, -1, -1, -1,\r\n", "mot.txt"))
    assert found.scores.tolist() == [0.75]
    assert read_labels(written(tmp_path, "1 -1 10 20 30 40\n", "bare.txt")).tracks.tolist() == [-1]
    by_class = written(tmp_path, "1,1,0,0,9,9,1,1,1\n1,2,0,0,9,9,1,3,1\n", "gt.txt")
    assert read_labels(by_class, classes={3}).tracks.tolist() == [2]


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


def test_coco_file(tmp_path):
    labels = read_labels(written(tmp_path, coco(), "instances.json"))
    assert labels.frame_keys == ("a.jpg", "b.jpg")
    assert labels.boxes.tolist() == [[10, 20, 40, 60], [0, 0, 60, 40], [90, 0, 189, 40]]
    assert labels.ignore.tolist() == [False, True, True]
    assert labels.tracks.tolist() == [0, 2, -1]
    assert len(read_labels(written(tmp_path, coco(), "coco.txt"), classes=["person"])) == 2
    entry = {"image_id": 5, "category_id": 1, "bbox": [1, 2, 3, 4], "track_id": 9, "score": 0.5}
    found = read_labels(written(tmp_path, coco(annotations=[entry], images=[{"id": 5}]), "a.json"))
    assert (found.frames, found.tracks.tolist(), found.scores.tolist()) == ((5,), [9], [0.5])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "{", "line 1: no JSON text"),
        ("a.json", "[]", "is no COCO file: it lacks the lists images, annotations, categories"),
        ("a.json", coco(images=[{"file_name": "x"}]), "every image and category needs an id"),
        ("a.json", coco(images=[{"id": 5}, {"id": 6, "file_name": "a"}]), "give every image its file_name"),
        ("a.json", coco(images=[{"id": 5}, {"id": 5}]), "two images share an id"),
        ("a.json", coco(images=[]), "annotation 0: it needs bbox .* image_id"),
        (
            "a.json",
            coco(annotations=[{"image_id": 5, "category_id": 1, "bbox": [1, 2]}]),
            "annotation 0: it needs",
        ),
        (
            "a.json",
            coco(annotations=[{"image_id": 5, "category_id": 1, "bbox": [1, 2, 0, 5]}]),
            "annotation 0: a box needs x1 < x2",
        ),
        ("a.json", coco(categories=[{"id": 1, "name": "boat"}]), "no category among car, .* found 'boat'"),
        ("a.txt", "Car 0 0 0 1 2 3", "lacks the columns"),
        ("a.txt", KITTI.replace("69.44 ", ""), "lacks the columns"),
        ("a.txt", KITTI + "Car 0 0", "line 8: a KITTI object has 15 values .* found 3"),
        ("a.txt", "0,1,2,3,4,5\n", r"line 1: frame \(counted from 1\) must be at least 1"),
        ("a.txt", "1,1,2,3\n", "line 1: frame, id, x, y, width, height are expected, found 4"),
        ("a.txt", "1,1,2,3,-4,5\n", "line 1: a box needs x1 < x2"),
        ("a.txt", "1,1,1e308,3,1.7e308,5\n", "line 1: a box needs finite corners"),
        ("a.txt", "1,1,2,3,4,5,0.5\n1,2,2,3,4,5\n", "line 2: some boxes have a score and some have none"),
    ],
)
def test_other_formats_refused(tmp_path, name, text, message):
    with pytest.raises(DatasetError, match=message):
        read_labels(written(tmp_path, text, name))


def test_paths_refused(tmp_path):
    with pytest.raises(DatasetError, match="does not exist; check the path"):
        read_labels(tmp_path / "none.csv")
    with pytest.raises(DatasetError, match=r"holds no \.txt file"):
        read_labels(tmp_path)
    with pytest.raises(DatasetError, match="is a folder, and csv labels are one file"):
        read_labels(tmp_path, format="csv")
    with pytest.raises(
        InvalidInputError, match="format must be one of 'csv', 'kitti', 'mot', 'coco'; got 'voc'"
    ):
        read_labels(written(tmp_path, CSV), format="voc")


FIELDS = st.sampled_from(
    ["0", "1", "2", "-1", "0.5", "nan", "1e999", "1e308", "", "a", "Car", '"', "\x00", "007"]
)


@given(
    kind=st.sampled_from(["csv", "kitti", "mot"]),
    lines=st.lists(st.lists(FIELDS, min_size=5, max_size=16), max_size=4),
    headed=st.booleans(),
)
@settings(max_examples=200)
def test_readers_raise_nothing_but_their_own_errors(tmp_path_factory, kind, lines, headed):
    separator = {"csv": ",", "kitti": " ", "mot": ","}[kind]
    text = (HEADER + "\n") * headed + "\n".join(
        separator.join(line[:9] if headed else line) for line in lines
    )
    path = written(tmp_path_factory.mktemp("fuzz"), text)
    try:
        assert isinstance(read_labels(path, format=kind), FrameBoxes)
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
@settings(max_examples=200)
def test_coco_reader_raises_nothing_but_its_own_errors(tmp_path_factory, changes):
    path = written(tmp_path_factory.mktemp("fuzz"), coco(**changes), "a.json")
    with contextlib.suppress(DatasetError):
        assert isinstance(read_labels(path), FrameBoxes)


# --- detections -----------------------------------------------------------------------------------


def test_counts_ratios_and_sizes_by_hand():
    small, large = (0, 100, 50, 140), (300, 0, 500, 100)
    labels = boxes_of((0, 1, CAR), (0, 2, small), (1, 1, large))
    found = boxes_of(
        (0, -1, CAR, 2.0), (0, -1, moved(20), 1.0), (1, -1, (300, 0, 500, 80), 0.5), (1, -1, small, 0.1)
    )
    scores = evaluate_detections(found, labels, frames=range(4))
    assert (scores.tp, scores.fp, scores.fn, scores.frames) == (2, 2, 1, 4)
    assert (scores.precision, scores.recall) == (0.5, 2 / 3)
    assert scores.f1 == 4 / 7
    assert scores.false_positives_per_frame == 0.5
    assert scores.mean_iou == pytest.approx(0.9)
    sizes = {name: (size.tp, size.fp, size.fn) for name, size in scores.by_size.items()}
    assert sizes == {"small": (0, 1, 1), "medium": (1, 1, 0), "large": (1, 0, 0)}
    assert scores.by_size["large"].mean_iou == pytest.approx(0.8)


def test_average_precision_by_hand():
    labels = boxes_of(*((0, index, moved(200 * index)) for index in range(3)))
    found = boxes_of(
        (0, -1, CAR, 0.9), (0, -1, moved(900), 0.8), (0, -1, moved(200), 0.7), (0, -1, moved(1200), 0.6)
    )
    precision, recall, thresholds = precision_recall_curve(found, labels)
    np.testing.assert_allclose(precision, [1, 1 / 2, 2 / 3, 1 / 2])
    np.testing.assert_allclose(recall, [1 / 3, 1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_allclose(thresholds, [0.9, 0.8, 0.7, 0.6])
    # A third of the recall at precision 1, the next third at 2/3.
    assert evaluate_detections(found, labels).average_precision == pytest.approx(1 / 3 + 2 / 9)


def test_scores_that_tie_are_one_point_of_the_curve():
    labels = boxes_of((0, 1, CAR))
    found = boxes_of((0, -1, moved(500), 1.0), (0, -1, CAR, 1.0))
    assert [part.tolist() for part in precision_recall_curve(found, labels)] == [[0.5], [1.0], [1.0]]
    assert evaluate_detections(found, labels).average_precision == 0.5


def test_the_higher_score_takes_the_vehicle_and_the_other_is_false():
    labels = boxes_of((0, 1, CAR))
    found = boxes_of((0, -1, CAR, 1.0), (0, -1, moved(10), 2.0))
    scores = evaluate_detections(found, labels)
    assert (scores.tp, scores.fp) == (1, 1)
    assert scores.mean_iou == pytest.approx(90 / 110)
    # Without scores the better fit comes first.
    assert evaluate_detections(FrameBoxes(found.frames, None, found.boxes), labels).mean_iou == 1


def test_overlap_at_the_threshold_matches():
    labels, half = boxes_of((0, 1, CAR)), boxes_of((0, -1, (0, 0, 50, 60), 1.0))
    assert evaluate_detections(half, labels, iou=0.5).tp == 1
    assert evaluate_detections(half, labels, iou=0.51).tp == 0


IGNORED = np.array([True])


@pytest.mark.parametrize(
    ("track", "ignored_box", "detection", "ignored"),
    [
        pytest.param(-1, (0, 0, 400, 200), CAR, True, id="center in a region"),
        pytest.param(-1, (10, 0, 50, 60), CAR, False, id="center on the open edge of a region"),
        pytest.param(-1, (50, 30, 90, 60), CAR, True, id="center on the closed edge of a region"),
        pytest.param(4, CAR, moved(20), True, id="covers an ignored box"),
        pytest.param(4, (0, 0, 400, 200), CAR, False, id="center in an ignored box, too little overlap"),
        pytest.param(4, CAR, moved(40), False, id="covers too little of an ignored box"),
    ],
)
def test_ignore_rules(track, ignored_box, detection, ignored):
    labels = boxes_of((0, track, ignored_box), ignore=IGNORED)
    found = boxes_of((0, 7, detection, 1.0))
    scores, tracked = evaluate_detections(found, labels), evaluate_tracks(found, labels)
    assert (scores.ignored, scores.fp) == (int(ignored), int(not ignored))
    assert (tracked.ignored, tracked.fp, tracked.fn) == (int(ignored), int(not ignored), 0)
    assert tracked.longest_false_positive_run == int(not ignored)


@pytest.mark.parametrize(
    ("ignored_box", "ignored"),
    [
        pytest.param((-100, -100, 400, 200), True, id="inside"),
        pytest.param((50, 0, 400, 60), True, id="half inside"),
        pytest.param((51, 0, 400, 60), False, id="less than half inside"),
        pytest.param((40, 20, 60, 40), False, id="around the ignored box"),
        pytest.param((100, 0, 400, 60), False, id="beside it"),
    ],
)
def test_ignored_boxes_as_regions(ignored_box, ignored):
    labels = boxes_of((0, 4, ignored_box), ignore=IGNORED)
    found = boxes_of((0, 7, CAR, 1.0))
    assert evaluate_detections(found, labels).fp == 1
    scores = evaluate_detections(found, labels, ignored_as_regions=True)
    assert (scores.ignored, scores.fp) == (int(ignored), int(not ignored))


def test_the_curve_with_ignored_boxes_as_regions():
    labels = boxes_of((0, 1, moved(500)), (0, 2, (0, 0, 300, 90)), ignore=np.array([False, True]))
    found = boxes_of((0, -1, CAR, 2.0), (0, -1, moved(500), 1.0))
    assert precision_recall_curve(found, labels)[0].tolist() == [0.0, 0.5]
    precision, recall, thresholds = precision_recall_curve(found, labels, ignored_as_regions=True)
    assert [each.tolist() for each in (precision, recall, thresholds)] == [[1.0], [1.0], [1.0]]


def test_a_usable_box_is_matched_before_the_ignore_rules():
    labels = boxes_of((0, 1, CAR), (0, -1, (0, 0, 500, 500)), ignore=np.array([False, True]))
    found = boxes_of((0, 1, CAR, 1.0), (0, 2, moved(20), 0.5))
    scores = evaluate_detections(found, labels)
    assert (scores.tp, scores.fp, scores.fn, scores.ignored) == (1, 0, 0, 1)
    assert scores == evaluate_detections(found, labels, ignored_as_regions=True)
    assert evaluate_tracks(found, labels).ignored == 1
    assert evaluate_detections(boxes_of((0, 1, moved(300), 1.0)), labels).fn == 1


def test_nothing_to_count_is_nan_and_none_in_json():
    labels = boxes_of((0, 1, CAR))
    empty = evaluate_detections(FrameBoxes([], [], []), labels)
    assert (empty.tp, empty.fn, empty.recall, empty.f1, empty.average_precision) == (0, 1, 0, 0, 0)
    assert math.isnan(empty.precision)
    nothing = evaluate_detections(FrameBoxes([], [], []), FrameBoxes([], [], []))
    assert nothing.frames == 0
    assert math.isnan(nothing.f1)
    tracked = evaluate_tracks(FrameBoxes([], [], []), FrameBoxes([], [], []))
    assert math.isnan(tracked.mota)
    for scores in (empty, nothing, tracked):
        assert "n/a" in str(scores)
        data = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
        assert data["mean_iou"] is None
    assert empty.to_dict()["by_size"]["small"]["f1"] is None
    assert math.isnan(evaluate_detections(labels, FrameBoxes([], [], [])).recall)


def test_summaries_are_aligned_lines():
    labels = boxes_of((0, 1, CAR))
    for scores in (evaluate_detections(labels, labels), evaluate_tracks(labels, labels)):
        title, *rows = str(scores).splitlines()
        assert "1 frames at IoU 0.5" in title
        column = max(len(row.split("  ")[1]) for row in rows) + 4
        assert all(row[column - 1] == " " and row[column] != " " for row in rows)
        assert str(scores) == scores.summary()


def test_predictions_marked_ignore_are_left_out():
    labels = boxes_of((0, 1, CAR), (0, -1, moved(500)), ignore=np.array([False, True]))
    assert evaluate_detections(labels, labels).ignored == 0
    assert evaluate_tracks(labels, labels).mota == 1


@pytest.mark.parametrize("evaluate", [evaluate_detections, evaluate_tracks])
def test_frames_are_checked(evaluate):
    labels, found = boxes_of((0, 1, CAR), (1, 1, CAR)), boxes_of((0, 1, CAR))
    assert evaluate(found, labels, frames=[0]).fn == 0
    assert evaluate(found, labels, frames=[0, 1, 2]).frames == 3
    with pytest.raises(InvalidInputError, match="predictions hold frame 0, which is not among the 2 frames"):
        evaluate(found, labels, frames=[1, 2])
    with pytest.raises(InvalidInputError, match="frames must differ, got 1 more than once"):
        evaluate(found, labels, frames=[0, 1, 1])
    with pytest.raises(
        InvalidInputError, match=r"frames must go by numbers or by names .* 'a\.jpg' in frames"
    ):
        evaluate(found, labels, frames=["a.jpg"])
    with pytest.raises(
        InvalidInputError, match=r"frames must go by numbers .* 'x' in predictions, 0 in labels"
    ):
        evaluate(boxes_of(("x", 1, CAR)), labels)
    with pytest.raises(InvalidInputError, match=r"name their frames differently: 'in/07\.png' and '07'"):
        evaluate(boxes_of(("in/07.png", 1, CAR)), boxes_of(("07", 1, CAR)))
    with pytest.raises(InvalidInputError, match=r"predictions must be Labels, got .*Labels\.from_detections"):
        evaluate(found.boxes, labels)
    with pytest.raises(InvalidInputError, match="labels must be Labels"):
        evaluate(found, {})
    with pytest.raises(InvalidInputError, match="iou must be a number, greater than 0"):
        evaluate(found, labels, iou=0)


def test_a_curve_needs_scores():
    labels = boxes_of((0, 1, CAR))
    with pytest.raises(InvalidInputError, match="predictions need scores for a curve"):
        precision_recall_curve(labels, labels)
    assert [part.size for part in precision_recall_curve(FrameBoxes([], [], []), labels)] == [0, 0, 0]


# --- tracks ---------------------------------------------------------------------------------------


def clip(tracks, *, step=4.0, offset=(0.0,)):
    """One vehicle a frame further right in every frame, followed by `tracks`; None where it is missed."""
    labels = boxes_of(*((frame, 1, moved(step * frame)) for frame in range(len(tracks))))
    rows = [
        (frame, track, moved(step * frame + offset[frame % len(offset)]))
        for frame, track in enumerate(tracks)
        if track is not None
    ]
    return (boxes_of(*rows) if rows else FrameBoxes([], [], [])), labels


@pytest.mark.parametrize(
    ("tracks", "switches", "fragmentations", "mota", "idf1"),
    [
        ([5, 5, 5, 5], 0, 0, 1, 1),
        ([5, 5, 6, 6], 1, 0, 3 / 4, 1 / 2),
        ([5, 6, 5, 5], 2, 0, 2 / 4, 3 / 4),
        ([5, None, 5, 5], 0, 1, 3 / 4, 6 / 7),
        ([5, None, 6, None], 1, 1, 1 / 4, 2 / 6),
        ([None, 5, 5, None], 0, 0, 2 / 4, 4 / 6),
        ([None, None, None, None], 0, 0, 0, 0),
    ],
)
def test_switches_and_fragmentations_by_hand(tracks, switches, fragmentations, mota, idf1):
    scores = evaluate_tracks(*clip(tracks))
    assert (scores.id_switches, scores.fragmentations) == (switches, fragmentations)
    assert scores.mota == pytest.approx(mota)
    assert scores.idf1 == pytest.approx(idf1)
    assert scores.vehicles == 1
    assert scores.tracks == len({*tracks} - {None})


def test_a_track_keeps_its_vehicle_though_another_fits_better():
    labels = boxes_of((0, 1, CAR), (1, 1, CAR))
    found = boxes_of((0, 5, CAR), (1, 5, moved(20)), (1, 6, CAR))
    scores = evaluate_tracks(found, labels)
    assert (scores.id_switches, scores.fp, scores.tp) == (0, 1, 2)


def test_vehicles_that_swap_their_tracks_switch_twice():
    labels = boxes_of(*((f, v, moved(300 * v)) for f in (0, 1) for v in (0, 1)))
    found = boxes_of(*((f, v ^ f, moved(300 * v)) for f in (0, 1) for v in (0, 1)))
    assert evaluate_tracks(found, labels).id_switches == 2


def test_jitter_by_hand():
    # Errors of 0, 2, 0: each step changes the left and right edge by 2, top and bottom not at all.
    assert evaluate_tracks(*clip([5, 5, 5], offset=(0, 2, 0))).jitter == 1
    assert evaluate_tracks(*clip([5, 5, 5], offset=(3,))).jitter == 0
    # Another track on the same vehicle jumps all the same; a gap is no pair of frames.
    assert evaluate_tracks(*clip([5, 6], offset=(0, 2))).jitter == 1
    assert math.isnan(evaluate_tracks(*clip([5, None, 5], offset=(0, 0, 2))).jitter)


def test_frames_follow_each_other_at_the_step_of_their_numbers():
    found, labels = clip([5, 5, 5, 5], offset=(0, 2))
    every_tenth = [side.renamed(lambda key: key * 10) for side in (found, labels)]
    assert evaluate_tracks(*every_tenth).jitter == 1
    gap = [side.renamed(lambda key: key + 90 * (key > 1)) for side in (found, labels)]
    assert evaluate_tracks(*gap).jitter == 1
    assert evaluate_tracks(gap[0], gap[1][:0]).longest_false_positive_run == 2
    names = [side.renamed(lambda key: f"{3 * key}.png") for side in (found, labels)]
    assert evaluate_tracks(*names).jitter == 1
    # Names given in another order follow each other in that order: errors of 0, 0, 2, 2.
    assert evaluate_tracks(*names, frames=[f"{3 * key}.png" for key in (0, 2, 1, 3)]).jitter == pytest.approx(
        1 / 3
    )


@pytest.mark.parametrize(
    ("frames", "longest"), [([], 0), ([3], 1), ([0, 1, 2], 3), ([0, 1, 3, 4, 5, 7], 3), ([0, 2, 4], 1)]
)
def test_longest_false_positive_run_by_hand(frames, longest):
    _, labels = clip([None] * 8)
    false = boxes_of(*((f, 9, moved(700)) for f in frames)) if frames else FrameBoxes([], [], [])
    assert evaluate_tracks(false, labels).longest_false_positive_run == longest


def test_a_false_run_belongs_to_one_track_and_ends_on_ignored_ground():
    rows = [(f, 9, moved(700)) for f in range(6)]
    labels = boxes_of(*((f, 1, CAR) for f in range(6)), (2, -1, (700, 0, 900, 90)), ignore=np.arange(7) == 6)
    assert evaluate_tracks(boxes_of(*rows), labels).longest_false_positive_run == 3
    taking_turns = boxes_of(*((f, 9 + f % 2, moved(700)) for f in range(6)))
    assert evaluate_tracks(taking_turns, labels).longest_false_positive_run == 1


def test_boxes_without_tracks_are_refused():
    labels, loose = boxes_of((0, 1, CAR)), boxes_of((0, -1, CAR))
    with pytest.raises(
        InvalidInputError, match="predictions must have a track for every box, row 0 in frame 0"
    ):
        evaluate_tracks(loose, labels)
    with pytest.raises(InvalidInputError, match="labels must have a track"):
        evaluate_tracks(labels, loose)


# --- invariants -----------------------------------------------------------------------------------


@st.composite
def drives(draw):
    """Vehicles in lanes of their own over a few frames, each seen in some of them."""
    count, length = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    rows = []
    for vehicle in range(count):
        width, height, speed = draw(st.integers(40, 160)), draw(st.integers(30, 90)), draw(st.integers(-9, 9))
        for frame in range(length):
            if draw(st.booleans()) or (vehicle, frame) == (0, 0):
                x, y = 500 + speed * frame, 200 * vehicle
                rows.append((frame, vehicle, (x, y, x + width, y + height)))
    return boxes_of(*rows, scores=np.arange(len(rows)) / 7, frame_keys=range(length))


@st.composite
def trials(draw):
    """A drive, and tracks on it that err in place, miss, invent, and change their names."""
    labels = draw(drives())
    rows = []
    for frame, vehicle, box in zip(labels.frames, labels.tracks.tolist(), labels.boxes):
        match = draw(st.sampled_from(["good", "good", "good", "shifted", "missed", "renamed"]))
        if match != "missed":
            shift = np.array(draw(st.tuples(*[st.integers(-6, 6)] * 4)))
            track = 20 + vehicle if match == "renamed" else vehicle
            rows.append((frame, track, tuple(box + shift + 200 * (match == "shifted"))))
        if draw(st.integers(0, 3)) == 0:
            rows.append((frame, 40 + vehicle, tuple(box + draw(st.integers(-20, 20)))))
    draws = st.floats(-2, 2, width=16)
    found = FrameBoxes(
        [row[0] for row in rows],
        [row[1] for row in rows],
        [row[2] for row in rows],
        scores=draw(st.lists(draws, min_size=len(rows), max_size=len(rows))),
        frame_keys=labels.frame_keys,
    )
    return found, labels


def same(first, second):
    """Equal scores; NaN equals NaN, and sums may run in another order."""
    one, two = first.to_dict(), second.to_dict()
    sizes = one.pop("by_size", {}), two.pop("by_size", {})
    assert one == pytest.approx(two)
    for name in sizes[0]:
        assert sizes[0][name] == pytest.approx(sizes[1][name])


@given(labels=drives())
def test_perfect_predictions_score_one(labels):
    scores, tracked = evaluate_detections(labels, labels), evaluate_tracks(labels, labels)
    assert scores.precision == scores.recall == scores.f1 == scores.average_precision == scores.mean_iou == 1
    assert tracked.mota == tracked.idf1 == tracked.f1 == 1
    assert tracked.id_switches == tracked.longest_false_positive_run == 0
    assert math.isnan(tracked.jitter) or tracked.jitter == 0


@given(trial=trials())
def test_scores_are_consistent(trial):
    scores, tracked = evaluate_detections(*trial), evaluate_tracks(*trial)
    for each in (scores, tracked):
        assert each.tp + each.fn == len(trial[1])
        assert each.tp + each.fp + each.ignored == len(trial[0])
        assert 0.5 <= each.mean_iou <= 1 or each.tp == 0
    for name in ("tp", "fp", "fn"):
        assert sum(getattr(size, name) for size in scores.by_size.values()) == getattr(scores, name)
    assert 0 <= scores.average_precision <= 1
    assert scores.average_precision <= scores.recall + 1e-12
    assert tracked.mota <= tracked.recall + 1e-12
    assert 0 <= tracked.idf1 <= 1


@given(trial=trials(), order=st.randoms(use_true_random=False))
def test_names_of_tracks_and_order_of_rows_change_nothing(trial, order):
    found, labels = trial
    names = list(range(60))
    order.shuffle(names)
    rows = [list(range(len(side))) for side in (found, labels)]
    for side in rows:
        order.shuffle(side)
    renamed = []
    for side, chosen in zip((found, labels), rows):
        part = side[chosen]
        tracks = np.array(names)[part.tracks]
        renamed.append(
            FrameBoxes(part.frames, tracks, part.boxes, scores=part.scores, frame_keys=side.frame_keys)
        )
    same(evaluate_tracks(found, labels), evaluate_tracks(*renamed))


@given(trial=trials())
def test_names_of_frames_change_nothing(trial):
    named = [side.renamed(lambda key: f"frame_{key}.jpg") for side in trial]
    same(evaluate_tracks(*trial), evaluate_tracks(*named))
    same(evaluate_detections(*trial), evaluate_detections(*named))


@given(labels=drives())
def test_mean_overlap_falls_with_the_shift(labels):
    last = 1.0
    for shift in range(0, 200, 3):
        found = FrameBoxes(labels.frames, labels.tracks, labels.boxes + np.array([shift, 0, shift, 0]))
        scores = evaluate_detections(found, labels, iou=0.01)
        if scores.tp < len(labels):
            break
        assert scores.mean_iou <= last + 1e-12
        last = scores.mean_iou
    assert shift > 3


@given(trial=trials(), box=st.tuples(st.integers(2000, 2200), st.integers(0, 80)))
def test_a_prediction_in_an_ignore_region_changes_nothing(trial, box):
    found, labels = trial
    region = FrameBoxes(
        [*labels.frames, 0],
        [*labels.tracks, -1],
        [*labels.boxes, (2000, 0, 2500, 300)],
        ignore=np.arange(len(labels) + 1) == len(labels),
        frame_keys=labels.frame_keys,
    )
    more = FrameBoxes(
        [*found.frames, 0],
        [*found.tracks, 55],
        [*found.boxes, (*box, box[0] + 90, box[1] + 60)],
        scores=[*found.scores, 9.0],
        frame_keys=found.frame_keys,
    )
    for evaluate in (evaluate_detections, evaluate_tracks):
        before, after = evaluate(found, region).to_dict(), evaluate(more, region).to_dict()
        assert after.pop("ignored") == before.pop("ignored") + 1
        assert after == before


@given(trial=trials(), data=st.data())
def test_ignored_boxes_as_regions_only_forgive(trial, data):
    found, labels = trial
    ignore = np.array(data.draw(st.lists(st.booleans(), min_size=len(labels), max_size=len(labels))), bool)
    labels = replace(labels, ignore=ignore)
    plain, lenient = (
        evaluate_detections(found, labels, ignored_as_regions=option) for option in (False, True)
    )
    assert (lenient.tp, lenient.fn) == (plain.tp, plain.fn)
    assert lenient.fp + lenient.ignored == plain.fp + plain.ignored
    assert lenient.fp <= plain.fp
    # NaN where nothing is left to find.
    assert not lenient.average_precision < plain.average_precision - 1e-12


@given(trial=trials(), data=st.data())
def test_dropping_predictions_never_raises_recall(trial, data):
    found, labels = trial
    kept = data.draw(st.lists(st.booleans(), min_size=len(found), max_size=len(found)))
    part = found[np.array(kept, bool)]
    assert evaluate_detections(part, labels).recall <= evaluate_detections(found, labels).recall
    perfect = labels[
        np.array(data.draw(st.lists(st.booleans(), min_size=len(labels), max_size=len(labels))), bool)
    ]
    scores = evaluate_detections(perfect, labels)
    assert scores.fp == 0
    assert scores.recall == len(perfect) / len(labels)


@given(trial=trials())
def test_the_curve_is_the_score_at_every_threshold(trial):
    found, labels = trial
    precision, recall, thresholds = precision_recall_curve(found, labels)
    assert (np.diff(thresholds) < 0).all()
    assert (np.diff(recall) >= 0).all()
    for index, threshold in enumerate(thresholds):
        scores = evaluate_detections(found[found.scores >= threshold], labels)
        assert (scores.precision, scores.recall) == (precision[index], recall[index])


@st.composite
def crowds(draw):
    """Vehicles that cross and hide each other, under tracks that go over from one to the other."""
    length = draw(st.integers(2, 8))
    sides = []
    for spread in (80, 30):
        rows = [
            (frame, track, moved(draw(st.integers(0, spread))))
            for frame in range(length)
            for track in range(3)
            if draw(st.integers(0, 5))
        ]
        sides.append(boxes_of(*rows, frame_keys=range(length)) if rows else FrameBoxes([], [], []))
    return sides[1], sides[0]


@given(trial=trials() | crowds())
@settings(max_examples=60)
def test_track_scores_equal_those_of_motmetrics(trial):
    found, labels = trial
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for key in labels.frame_keys:
        truth, here = labels.frame(key), found.frame(key)
        overlap = iou_matrix(truth.boxes, here.boxes)
        distance = np.where(overlap >= 0.5, 1 - overlap, np.nan)
        accumulator.update(truth.tracks, here.tracks, distance)
    names = ("mota", "idf1", "num_switches", "num_fragmentations", "num_misses", "num_false_positives")
    row = motmetrics.metrics.create().compute(accumulator, metrics=list(names), name="clip").iloc[0]
    scores = evaluate_tracks(found, labels)
    assert scores.mota == pytest.approx(row["mota"], nan_ok=True)
    assert scores.idf1 == pytest.approx(row["idf1"], nan_ok=True)
    assert (scores.id_switches, scores.fragmentations) == (row["num_switches"], row["num_fragmentations"])
    assert (scores.fn, scores.fp) == (row["num_misses"], row["num_false_positives"])


# --- calibration ----------------------------------------------------------------------------------


def test_calibration_error_by_hand():
    # Bin 0 holds 0.1 and 0.3 (mean 0.2, half of them vehicles), bin 1 holds 0.6 and 1.0 (0.8, all vehicles).
    assert calibration_error([0.1, 0.3, 0.6, 1.0], [0, 1, 1, 1], bins=2) == pytest.approx(0.25)
    assert calibration_error([0.0, 1.0], [False, True]) == 0


@given(
    pairs=st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=20),
    bins=st.integers(1, 20),
)
@example(pairs=[(1.0, False)], bins=15)
def test_calibration_error_is_a_share(pairs, bins):
    probabilities, labels = zip(*pairs)
    error = calibration_error(probabilities, labels, bins=bins)
    assert 0 <= error <= 1
    # Finer bins cannot hide what the whole shows.
    assert error >= abs(np.mean(probabilities) - np.mean(labels)) - 1e-9


@pytest.mark.parametrize(
    ("probabilities", "labels", "bins", "message"),
    [
        ([], [], 15, "probabilities must be a one-dimensional array"),
        ([1.5], [1], 15, "probabilities must be .* from 0 to 1"),
        ([math.nan], [1], 15, "probabilities must be"),
        ([[0.5]], [1], 15, "probabilities must be a one-dimensional"),
        (["a"], [1], 15, "probabilities must be"),
        ([0.5], [1, 0], 15, "labels must be 0 or 1 for each of the 1 probabilities"),
        ([0.5], [-1], 15, "labels of -1 and 1 convert with labels > 0"),
        ([0.5], [1], 0, "bins must be an integer at least 1"),
    ],
)
def test_calibration_error_refuses(probabilities, labels, bins, message):
    with pytest.raises(InvalidInputError, match=message):
        calibration_error(probabilities, labels, bins=bins)


# --- real labels ----------------------------------------------------------------------------------


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "frames", "usable", "shape"),
    [
        ("project_clip", 350, 380, (720, 1280)),
        ("test_video", 38, 76, (720, 1280)),
        ("test_images", 6, 9, (720, 1280)),
        ("india", 165, 509, None),
        ("camvid", 157, 148, (360, 480)),
        ("indonesia", 79, 242, None),
    ],
)
def test_real_labels(real_data: Path, name, frames, usable, shape):
    path = real_data / "labels" / f"{name}.csv"
    labels = read_labels(path, shape=shape)
    assert len(labels.frame_keys) == frames
    assert (~labels.ignore).sum() == usable
    scores = evaluate_detections(labels, labels)
    assert (scores.f1, scores.mean_iou, scores.tp) == (1, 1, usable)
    if shape is not None:
        np.testing.assert_array_equal(labels.boxes, read_labels(path).boxes)
    if name in ("project_clip", "test_video"):
        tracked = evaluate_tracks(labels, labels)
        assert (tracked.mota, tracked.jitter, tracked.vehicles) == (1, 0, 2)
