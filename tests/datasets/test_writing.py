import json
import math

import motmetrics
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from scipy.special import expit

from tests.evaluation.cases import CAR, boxes_of, moved
from vehicle_detection import DatasetError, InvalidInputError, TrackTable, read_labels, write_labels
from vehicle_detection.evaluation import evaluate_detections, precision_recall_curve

corner = st.floats(-1e4, 1e4)
side = st.floats(0.01, 1e4)  # a label has an area
unknown = st.none() | st.floats(-1e3, 1e3)
numbers = st.integers(0, 10**6)
# Names with quotes, commas, line breaks and other scripts.
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12).filter(
    lambda name: name == name.strip() and not name.isdigit()
)
file_names = st.text("abc019.-_é ", min_size=1, max_size=12).map(lambda name: f"f{name}g")


@st.composite
def frame_boxes(draw, *kinds, scored=None):
    """Boxes whose frames are all numbers or all names, of one of these kinds; and frames without boxes."""
    kind = draw(st.sampled_from(kinds))
    frames = draw(st.lists(kind, max_size=6))
    rows = len(frames)
    predicted = draw(st.booleans()) if scored is None else scored
    first = draw(st.lists(st.tuples(corner, corner, side, side), min_size=rows, max_size=rows))

    def column(values):
        return draw(st.lists(values, min_size=rows, max_size=rows))

    def optional(values):
        filled = np.array(column(values), np.float64)
        return None if np.isnan(filled).all() else filled

    return TrackTable(
        frames,
        [row if has_track else -1 for row, has_track in enumerate(column(st.booleans()))],
        [(x, y, x + width, y + height) for x, y, width, height in first],
        occluded=column(st.integers(0, 2)),
        truncated=column(st.floats(0, 1)),
        ignore=np.array(column(st.booleans()), bool),
        score=column(st.floats(-50, 50)) if predicted else None,
        distance_m=optional(unknown),
        speed_mps=optional(unknown),
        frame_keys=draw(st.lists(kind, max_size=3)),
    )


def assert_equal(read, wanted, columns, *, tolerance=0.0):
    """Compare boxes and the named columns of two tables, row by row."""
    assert read["frame"].tolist() == wanted["frame"].tolist()
    np.testing.assert_allclose(read.boxes, wanted.boxes, rtol=0, atol=tolerance)
    for name in columns:
        np.testing.assert_array_equal(read[name], wanted[name], err_msg=name)


SCORED = ("track_id", "ignore", "score")
RANGES = ("distance_m", "speed_mps")
ALL = (*SCORED, "occluded", "truncated", *RANGES)


@given(frame_boxes(numbers, names))
def test_tables_hold_every_column(tmp_path_factory, boxes):
    folder = tmp_path_factory.mktemp("tables")
    for name in ("t.csv", "t.jsonl", "t.ndjson", "t.parquet"):
        assert write_labels(boxes, folder / name) == len(boxes)
        assert_equal(read_labels(folder / name), boxes, ALL)


@given(frame_boxes(numbers))
def test_mot_files_hold_tracks_flags_and_scores(tmp_path_factory, boxes):
    path = tmp_path_factory.mktemp("mot") / "t.txt"
    boxes = boxes if "score" not in boxes.columns else boxes[~boxes["ignore"]]
    write_labels(boxes, path)
    # The file has left, top, width and height with nine decimals.
    assert_equal(read_labels(path, format="mot"), boxes, SCORED, tolerance=1e-8)


@given(frame_boxes(numbers, names))
def test_coco_data_sets_hold_all_frames(tmp_path_factory, boxes):
    path = tmp_path_factory.mktemp("coco") / "t.json"
    write_labels(boxes, path, shape=(720, 1280))
    read = read_labels(path)
    assert_equal(read, boxes, (*SCORED, *RANGES), tolerance=1e-8)
    assert read.frame_keys == boxes.frame_keys
    assert all(image["width"] == 1280 for image in json.loads(path.read_text())["images"])


@given(frame_boxes(numbers, names, scored=True))
def test_coco_results_are_read_with_their_truth(tmp_path_factory, boxes):
    folder = tmp_path_factory.mktemp("results")
    boxes = boxes[~boxes["ignore"]]
    write_labels(boxes[:0], folder / "truth.json")
    found = {"path": folder / "found.json", "truth": folder / "truth.json"}
    write_labels(boxes, format="coco_results", **found)
    for form in (None, "coco_results"):
        read = read_labels(format=form, **found)
        assert_equal(read, boxes, (*SCORED, *RANGES), tolerance=1e-8)
        assert read.frame_keys == boxes.frame_keys


@given(frame_boxes(numbers))
def test_archives_for_cvat_hold_tracks_and_flags(tmp_path_factory, boxes):
    path = tmp_path_factory.mktemp("cvat") / "t.zip"
    write_labels(boxes, path)
    read = read_labels(path)
    assert "score" not in read.columns
    assert_equal(read, boxes, ("track_id", "ignore"), tolerance=1e-8)


@given(frame_boxes(st.integers(0, 999_999)))
def test_yolo_folders_hold_frames_and_confidences(tmp_path_factory, boxes):
    path = tmp_path_factory.mktemp("yolo") / "t"
    boxes = boxes[~boxes["ignore"]]
    # Inside the frame, and larger than the six decimals resolve.
    boxes.boxes[:, :2] = np.abs(boxes.boxes[:, :2])
    boxes.boxes[:, 2:] = np.add(boxes.boxes[:, :2], (1.0, 9.5))
    shape = (10_010, 10_010)
    write_labels(boxes, path, format="yolo", shape=shape)
    if not boxes.frame_keys:
        return
    read = read_labels(path, format="yolo", shape=shape)
    assert read.frame_keys == tuple(sorted(boxes.frame_keys))
    boxes = boxes[[row for key in read.frame_keys for row in boxes.rows(key)]]
    np.testing.assert_allclose(read.boxes, boxes.boxes, atol=0.1)
    if "score" in boxes.columns and len(boxes):
        assert read["track_id"].tolist() == boxes["track_id"].tolist()
        np.testing.assert_allclose(expit(read["score"]), expit(boxes["score"]), atol=2e-6)


@given(frame_boxes(file_names))
def test_kitti_folders_hold_frames_and_what_is_visible(tmp_path_factory, boxes):
    path = tmp_path_factory.mktemp("kitti") / "label_2"
    write_labels(boxes, path, format="kitti")
    if not boxes.frame_keys:
        with pytest.raises(DatasetError, match=r"holds no \.txt file"):
            read_labels(path)
        return
    read = read_labels(path)
    assert read.frame_keys == boxes.frame_keys
    # Each frame is a file, so that the rows are sorted by frame.
    order = [row for key in boxes.frame_keys for row in boxes.rows(key)]
    boxes = boxes[order]
    assert_equal(read, boxes, ("score",))
    cars = ~boxes["ignore"]
    np.testing.assert_array_equal(read["occluded"][cars], boxes["occluded"][cars])
    np.testing.assert_array_equal(read["truncated"][cars], boxes["truncated"][cars])
    assert (read["track_id"][~cars] == -1).all()
    assert read["ignore"][~cars].all()


KINDS = ["truck", "vehicle", "bus", "car", "auto rickshaw"]
WITH_CLASSES = [
    ("t.csv", None), ("t.jsonl", None), ("t.parquet", None),
    ("t.json", "coco"), ("t.zip", "mot_zip"), ("yolo", "yolo"), ("kitti", "kitti"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "form"), WITH_CLASSES)
@pytest.mark.parametrize("scored", [False, True])
def test_classes_are_read_back(tmp_path, caplog, name, form, scored):
    rows = [(row, row + 1, moved(3 * row), 0.5) if scored else (row, row + 1, CAR) for row in range(5)]
    boxes = boxes_of(*rows, label=KINDS, confidence=[0.6] * 5 if scored else None)
    boxes = boxes.renamed(lambda frame: f"{frame:06d}") if form == "kitti" else boxes
    shape = {"shape": (720, 1280)} if form == "yolo" else {}
    write_labels(boxes, tmp_path / name, format=form, **shape)
    expected = list(KINDS)
    if form == "kitti":  # it has no type of all vehicles, and no spaces in types
        expected[1], expected[4] = "car", "auto_rickshaw"
    assert read_labels(tmp_path / name, classes=set(expected), **shape)["label"].tolist() == expected
    # Classes of other names are kept where the file tells that they are vehicles, else a warning names them.
    read = read_labels(tmp_path / name, **shape)
    assert len(read[~read["ignore"]]) == (5 if form is None else 4)
    assert ("'auto rickshaw' are read back only if" in caplog.text) == (form is not None)


@pytest.mark.parametrize(("name", "form"), WITH_CLASSES[3:6])
def test_boxes_without_classes_get_none(tmp_path, name, form):
    write_labels(boxes_of((0, 1, CAR)), tmp_path / name, format=form, shape=(720, 1280))
    if form == "yolo":
        assert (tmp_path / "yolo" / "data.yaml").read_text() == "names:\n  0: vehicle\n"
    assert "label" not in read_labels(tmp_path / name, shape=(720, 1280)).columns


def test_results_take_the_categories_of_their_truth(tmp_path):
    labels = boxes_of((0, 1, CAR), (1, 1, CAR), label=["bus", "car"])
    truth, results = tmp_path / "truth.json", tmp_path / "results.json"
    write_labels(labels, truth)
    found = boxes_of((0, 1, CAR, 0.5), (1, 1, CAR, 0.25), label=["bus", "car"])
    write_labels(found, results, format="coco_results", truth=truth)
    assert [entry["category_id"] for entry in json.loads(results.read_text())] == [5, 2]
    assert read_labels(results, truth=truth)["label"].tolist() == ["bus", "car"]
    with pytest.raises(InvalidInputError, match="boxes, which include 'vehicle', got 'car', 'bus'"):
        write_labels(boxes_of((0, 1, CAR, 0.5)), results, format="coco_results", truth=truth)
    # Results of Ultralytics: numbers in the names of files are no ids.
    write_labels(labels.renamed(lambda frame: f"in/{frame}.jpg"), truth)
    for names in ({"image_id": "1"}, {"image_id": 0, "file_name": "1.jpg"}):
        results.write_text(json.dumps([{"category_id": 2, "bbox": [1, 2, 3, 4], "score": 0.5, **names}]))
        assert read_labels(results, truth=truth)["frame"].tolist() == ["in/1.jpg"]


# --- motmetrics ---


@pytest.mark.filterwarnings("ignore:Operation with tuple")  # motmetrics and a new pandas
@pytest.mark.parametrize("predicted", [False, True])
def test_motmetrics_reads_the_same_boxes_and_frames(tmp_path, predicted):
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 600, (40, 2))
    boxes = TrackTable(
        np.repeat(np.arange(20) * 3, 2),
        np.tile([1, 2], 20),
        np.hstack([corners, corners + rng.uniform(20, 90, (40, 2))]),
        score=rng.normal(size=40) if predicted else None,
        ignore=None if predicted else rng.random(40) < 0.3,
    )
    write_labels(boxes, tmp_path / "t.txt")
    least = -math.inf if predicted else 1  # motmetrics drops labels with the flag 0 so
    table = motmetrics.io.loadtxt(str(tmp_path / "t.txt"), fmt="mot15-2D", min_confidence=least)
    read = read_labels(tmp_path / "t.txt")
    for side in (boxes[~boxes["ignore"]], read[~read["ignore"]]):
        # motmetrics counts frames from 1.
        assert [frame - 1 for frame, _ in table.index] == side["frame"].tolist()
        assert [track for _, track in table.index] == side["track_id"].tolist()
        sizes = side.boxes[:, 2:] - side.boxes[:, :2]
        theirs = table[["X", "Y", "Width", "Height"]].to_numpy()
        np.testing.assert_allclose(theirs, np.hstack([side.boxes[:, :2], sizes]), rtol=0, atol=1e-8)


def test_mot_labels_estimate_the_visible_fraction(tmp_path):
    labels = boxes_of((0, 1, CAR), (0, 2, CAR), (0, 3, CAR), occluded=[0, 1, 2], truncated=[0.25, 0, 0])
    write_labels(labels, tmp_path / "gt.txt")
    ends = [line.split(",")[6:] for line in (tmp_path / "gt.txt").read_text().splitlines()]
    assert ends == [["1", "3", "0.75"], ["1", "3", "0.5"], ["1", "3", "0.0"]]


# --- pycocotools ---


def detection_trial(seed, names_=False):
    """Labels with ignored boxes, and noisy predictions; some frames lack the one, the other, or both."""
    rng = np.random.default_rng(seed)
    labels, found = [], []
    for frame in range(30):
        for car in range(rng.integers(0, 5) if frame % 7 else 0):
            width = rng.uniform(40, 150)
            box = np.array([250 * car, 0, 250 * car + width, 0.7 * width])
            labels.append((frame, -1, box, rng.random() < 0.25))
            if rng.random() < 0.75 and frame % 5:
                noisy = box + rng.normal(0, 0.12 * width, 4)
                found.append((frame, -1, noisy))
        for _ in range(rng.integers(0, 3) if frame % 5 else 0):
            x, y = rng.uniform(0, 1000, 2)
            found.append((frame, -1, (x, y, x + 80, y + 60)))
    ignore = np.array([row[3] for row in labels])
    truth = boxes_of(
        # An ignored vehicle has a track; a region would also ignore boxes that only have their center in it.
        *((frame, number if skip else -1, box) for number, (frame, _, box, skip) in enumerate(labels)),
        ignore=ignore,
        frame_keys=range(30),
    )
    result = boxes_of(*found, score=rng.permutation(len(found)) / 7)
    # Prefixes that change the order of the frames, too.
    rename = (lambda key: f"{'zax'[key % 3]}{key}.png") if names_ else (lambda key: key)
    return result.renamed(rename), truth.renamed(rename)


def coco_ap50(truth, results):
    """Average precision of pycocotools at IoU 0.5, its number of images, and the scores' ignored ones."""
    reference = COCO(str(truth))
    evaluation = COCOeval(reference, reference.loadRes(results), "bbox")
    evaluation.params.iouThrs = np.array([0.5])
    evaluation.evaluate()
    evaluation.accumulate()
    precision = evaluation.eval["precision"][0, :, 0, 0, -1]  # (101,) of all sizes, at most 100 detections
    return float(precision.mean()), len(reference.imgs)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_pycocotools_finds_our_average_precision(tmp_path, seed, named):
    found, truth = detection_trial(seed, named)
    write_labels(truth, tmp_path / "truth.json")
    results = tmp_path / "results.json"
    write_labels(found, results, format="coco_results", truth=tmp_path / "truth.json")
    theirs, images = coco_ap50(tmp_path / "truth.json", str(results))
    assert images == 30
    scores = evaluate_detections(found, truth, ignored_as_regions=True)
    assert 0.2 < theirs < 0.95
    assert scores.ignored > 3
    # COCO samples the same monotonic precision at 101 recalls instead of integrating it: at most 1/101 apart.
    assert scores.average_precision == pytest.approx(theirs, abs=1 / 101)
    precision, recall, _ = precision_recall_curve(found, truth, ignored_as_regions=True)
    monotonic = np.append(np.maximum.accumulate(precision[::-1])[::-1], 0)
    sampled = monotonic[np.searchsorted(recall, np.linspace(0, 1, 101))]
    assert sampled.mean() == pytest.approx(theirs, abs=1e-12)
    # The annotations of a data set that was written without knowing the truth have the same image ids.
    write_labels(found, tmp_path / "found.json")
    alone = json.loads((tmp_path / "found.json").read_text())["annotations"]
    assert coco_ap50(tmp_path / "truth.json", alone)[0] == theirs


def test_results_take_the_ids_of_a_foreign_ground_truth(tmp_path):
    document = {
        "images": [{"id": 900, "file_name": "b.png", "license": 4}, {"id": 17, "file_name": "a.png"}],
        "annotations": [{"id": 1, "image_id": 900, "category_id": 3, "bbox": [0, 0, 100, 60]}],
        "categories": [{"id": 1, "name": "person"}, {"id": 3, "name": "car"}],
    }
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps(document))
    found = boxes_of(("a.png", -1, CAR, 0.5), ("b.png", 4, moved(5), 1.5))
    results = tmp_path / "results.json"
    assert write_labels(found, results, format="coco_results", truth=truth) == 2
    assert json.loads(results.read_text()) == [
        {"image_id": 17, "category_id": 3, "bbox": [0.0, 0.0, 100.0, 60.0], "score": 0.5},
        {"image_id": 900, "category_id": 3, "bbox": [5.0, 0.0, 100.0, 60.0], "score": 1.5, "track_id": 4},
    ]
    # A data set keeps the images of the truth, with everything that they hold.
    write_labels(found[:1], tmp_path / "again.json", truth=truth)
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["images"] == document["images"]
    assert again["annotations"][0]["image_id"] == 17
    document["categories"].append({"id": 4, "name": "truck"})
    truth.write_text(json.dumps(document))
    with pytest.raises(InvalidInputError, match="truth must have one category of vehicles"):
        write_labels(found, results, format="coco_results", truth=truth)
    without = TrackTable.from_pandas(read_labels(truth).to_pandas().drop(columns="label"))
    write_labels(without, tmp_path / "vehicles.json", truth=truth)
    write_labels(found, results, format="coco_results", truth=tmp_path / "vehicles.json")
    assert [entry["image_id"] for entry in json.loads(results.read_text())] == [17, 900]


# --- invalid input ---


ONE, NAMED = boxes_of((0, 1, CAR)), boxes_of(("a", 1, CAR))
TWICE = boxes_of(("a.jpg", 1, CAR), ("a.png", 1, CAR))
WIDE = boxes_of((0, 1, CAR), (4, 1, [0, 0, 301, 60]))
YOLO = {"format": "yolo", "shape": (99, 200)}
KITTI, RESULTS = {"format": "kitti"}, {"format": "coco_results"}


@pytest.mark.parametrize(
    ("boxes", "name", "options", "message"),
    [
        ([], "t.csv", {}, "labels must be a TrackTable, got"),
        (ONE, "t.xlsx", {}, "path must end in .csv, .jsonl, .*or set the format to 'csv'"),
        (ONE, "t.csv", {"format": "voc"}, "format must be one of 'csv', .* 'kitti'"),
        (ONE, "missing/t.csv", {}, "path needs an existing folder"),
        (NAMED, "missing/t", KITTI, "path needs an existing folder"),
        (ONE, "t", KITTI, "frames that are file names for KITTI, got 0"),
        (boxes_of(("a/b", 1, CAR)), "t", KITTI, "frames that are file names for KITTI, got 'a/b'"),
        (boxes_of(("7", 1, CAR)), "t.csv", {}, "names that CSV does not tell from numbers, such as '7'"),
        (boxes_of((" a", 1, CAR)), "t.csv", {}, "labels name a frame ' a'; CSV drops the spaces"),
        (NAMED, "t.txt", {}, "labels must have numbered frames for MOT, got 'a'"),
        (NAMED, "t.zip", {}, "labels must have numbered frames for MOT, got 'a'"),
        (boxes_of((0, 1, CAR, 0.5), ignore=[True]), "t.txt", {}, "marked ignore, which the format 'mot'"),
        (ONE, "t.json", RESULTS, "labels need scores for COCO results"),
        (boxes_of((0, 1, CAR, 0.5)), "t.json", RESULTS, "truth must name the COCO ground"),
        (ONE, "t", {"format": "yolo"}, "shape must be .* for YOLO"),
        (boxes_of((0, 1, CAR), ignore=[True]), "t", YOLO, "labels hold boxes marked ignore, which YOLO"),
        (TWICE, "t", YOLO, "the frames 'a.jpg' and 'a.png', which are one file in YOLO; rename them"),
        (TWICE, "t", KITTI, "the frames 'a.jpg' and 'a.png', which are one file in KITTI; rename them"),
        (WIDE, "t", YOLO, r"box \[0.0, 0.0, 301.0, 60.0\] in frame 4, beyond the 200x99 .* clip_boxes"),
        (ONE, "t.csv", {"truth": "x.json"}, "truth must be None for the format 'csv'"),
    ],
)
def test_invalid_arguments(tmp_path, monkeypatch, boxes, name, options, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidInputError, match=message):
        write_labels(boxes, name, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["coco", "coco_results"])
def test_frames_that_the_truth_does_not_have(tmp_path, kind):
    truth = tmp_path / "truth.json"
    write_labels(boxes_of((0, 1, CAR)), truth)
    with pytest.raises(InvalidInputError, match=r"labels hold frame 3, which is not an image of truth\.json"):
        write_labels(boxes_of((3, 1, CAR, 0.5)), tmp_path / "t.json", format=kind, truth=truth)
    with pytest.raises(DatasetError, match=r"none.json does not exist; check the path"):
        write_labels(boxes_of((0, 1, CAR, 0.5)), tmp_path / "t.json", truth=tmp_path / "none.json")


def test_parquet_rows_name_their_place(tmp_path):
    import pyarrow
    from pyarrow import parquet

    columns = {name: [0] for name in ("frame", "track", "x1", "y1", "x2", "y2", "occluded", "truncated")}
    parquet.write_table(pyarrow.table({**columns, "ignore": [True]}), tmp_path / "t.parquet")
    with pytest.raises(DatasetError, match=r"t.parquet row 0: a box needs x1 < x2"):
        read_labels(tmp_path / "t.parquet")
    del columns["track"]
    parquet.write_table(pyarrow.table(columns), tmp_path / "t.parquet")
    with pytest.raises(DatasetError, match="lacks the columns track"):
        read_labels(tmp_path / "t.parquet")
