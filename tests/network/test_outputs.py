"""Boxes that are known come out of the outputs of every kind of detector."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.network.graphs import constant_network
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.network import OutputFormat, load_network

SIZE = (96, 96)
CELLS = 12 * 12 + 6 * 6 + 3 * 3
FRAME = np.zeros((192, 192, 3), np.uint8)
# In pixels of the input, a 96x96 square: a car, and a person.
CAR, PERSON = (10.0, 20.0, 30.0, 34.0), (40.0, 30.0, 48.0, 60.0)
CENTERS = [((x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1) for x1, y1, x2, y2 in (CAR, PERSON)]
NAMES = {"names": "{0: 'person', 1: 'bicycle', 2: 'Car'}"}


def dense(count, classes=80, *, objectness=False, fraction=1.0):
    """Rows of ``[center, sides, objectness, classes]``; row 3 is a car, row 7 a person."""
    rows = np.zeros((count, 4 + objectness + classes), np.float32)
    rows[:, 2:4] = 1
    rows[:, :2] = 90.0
    rows[3, :4], rows[7, :4] = CENTERS
    rows[:, :4] *= fraction
    if objectness:
        rows[[3, 7], 4] = 0.9
    rows[3, 4 + objectness + 2] = rows[7, 4 + objectness] = 0.8
    return rows[None]


def yolox():
    rows = dense(CELLS, objectness=True)
    rows[0, :, :4] = 0
    # Cell (2, 1) of stride 8 at row 1 * 12 + 2, and cell (2, 2) of stride 32 in the last row.
    rows[0, [3, 7], 4:] = 0
    rows[0, 14, :4] = 20 / 8 - 2, 27 / 8 - 1, np.log(20 / 8), np.log(14 / 8)
    rows[0, 14, [4, 7]] = 0.9, 0.8
    rows[0, -1, :4] = 44 / 32 - 2, 45 / 32 - 2, np.log(8 / 32), np.log(30 / 32)
    rows[0, -1, [4, 5]] = 0.9, 0.8
    return rows


def final():
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :2] = (*CAR, 0.8, 2), (*PERSON, 0.8, 0)
    return rows


def detr(classes=80, car=2):
    boxes = np.full((1, 300, 4), 0.5, np.float32)
    boxes[0, [3, 7]] = np.array(CENTERS) / 96
    logits = np.full((1, 300, classes), -9, np.float32)
    logits[0, 3, car] = logits[0, 7, car - 2] = np.log(0.8 / 0.2)
    return boxes, logits


BOXES, LOGITS = detr()
KINDS = {
    "YOLOv8": ({"output0": dense(CELLS).transpose(0, 2, 1)}, {}, 0.8),
    "YOLOv8 with few classes": ({"output0": dense(CELLS, 3).transpose(0, 2, 1)}, NAMES, 0.8),
    "YOLOv8 by rows": ({"output0": dense(CELLS, 3)}, NAMES, 0.8),
    "YOLOv8 by rows, without names": ({"output0": dense(CELLS)}, {}, 0.8),
    "YOLOv5": ({"output0": dense(3 * CELLS, objectness=True)}, {}, 0.72),
    "YOLOv5 with names": ({"output0": dense(3 * CELLS, 3, objectness=True)}, NAMES, 0.72),
    "YOLOX": ({"output": yolox()}, {}, 0.72),
    "YOLOX, decoded": ({"output": dense(CELLS, objectness=True)}, {}, 0.72),
    "YOLOv10": ({"output0": final()}, NAMES, 0.8),
    "RT-DETR of Ultralytics": ({"output0": dense(300, fraction=1 / 96)}, {}, 0.8),
    "RT-DETR": ({"logits": LOGITS, "pred_boxes": BOXES}, {}, 0.8),
    "RF-DETR": (dict(zip(("dets", "labels"), detr(91, 3))), {}, 0.8),
    "labels, boxes, scores": (
        {
            "labels": np.array([[2, 0, 2]]),
            "boxes": np.array([[CAR, PERSON, (0, 0, 1, 1)]], np.float32),
            "scores": np.array([[0.8, 0.8, 0.0]], np.float32),
        },
        NAMES,
        0.8,
    ),
}


def load(tmp_path, graph, **options):
    file = tmp_path / "network.onnx"
    file.write_bytes(graph)
    return load_network(file, **options)


def find(model, frame=FRAME, params=None, **options):
    with model.open_search(jobs=1) as search:
        return search.find(frame, params, **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dynamic", [False, True])
def test_the_vehicle_is_found(tmp_path, kind, dynamic):
    outputs, metadata, probability = KINDS[kind]
    model = load(tmp_path, constant_network(outputs, metadata=metadata, dynamic=dynamic))
    found = find(model)
    np.testing.assert_allclose(found.vehicles.boxes, [np.array(CAR) * 2], atol=0.01)
    np.testing.assert_allclose(model.calibration.probability(found.vehicles.scores), probability, atol=1e-3)
    assert len(found.windows) == 1
    assert "ar" in model.summary()[1]["classes"]


@pytest.mark.parametrize("kind", ["YOLOv8", "RT-DETR"])
def test_other_classes(tmp_path, kind):
    outputs, metadata, _ = KINDS[kind]
    graph = constant_network(outputs, metadata=metadata)
    for classes in (["person"], [0], ["Person", 1]):
        found = find(load(tmp_path, graph, classes=classes))
        np.testing.assert_allclose(found.vehicles.boxes, [np.array(PERSON) * 2], atol=0.01)
    assert len(find(load(tmp_path, graph, classes=["car", "person"])).vehicles) == 2
    for wrong in (["lorry"], [80], [-1], [True], [1.5], []):
        with pytest.raises(InvalidInputError, match=r"^classes must"):
            load(tmp_path, graph, classes=wrong)
    with pytest.raises(InvalidInputError, match=r"it has person \(0\), bicycle \(1\), car"):
        load(tmp_path, graph, classes=["lorry"])
    with pytest.raises(InvalidInputError, match="wrap it in a list"):
        load(tmp_path, graph, classes="car")


def test_every_class_with_the_name_of_a_vehicle_counts(tmp_path, caplog):
    outputs = {"output0": dense(CELLS, 3).transpose(0, 2, 1)}
    assert len(find(load(tmp_path, constant_network(outputs))).vehicles) == 2
    assert "names no classes, so all are vehicles; classes= selects some" in caplog.text
    network = constant_network(outputs, metadata={"names": "['car', 'Pickup Truck', 'Car']"})
    for options in ({}, {"classes": ["car"]}):
        assert load(tmp_path, network, **options).class_ids.tolist() == [0, 2]
    assert caplog.text.count("vehicles of class pickup truck are left out") == 1


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        ({"output0": 5 * dense(CELLS).transpose(0, 2, 1)}, "scores are not probabilities, but up to 4;"),
        ({"boxes": 96 * BOXES, "scores": LOGITS}, "boxes are not fractions of the image;"),  # of YOLO-NAS
    ],
)
def test_outputs_of_another_kind_are_refused(tmp_path, outputs, message):
    with pytest.raises(ModelFileError, match=f"network.onnx computes invalid values: {message}"):
        find(load(tmp_path, constant_network(outputs)))


def test_a_network_whose_names_are_no_vehicles_needs_classes(tmp_path):
    names = {"names": "['Hund', 'Katze', 'Maus']"}
    network = constant_network({"output0": dense(CELLS, 3).transpose(0, 2, 1)}, metadata=names)
    with pytest.raises(InvalidInputError, match=r"classes must be given.*Hund, Katze, Maus"):
        load(tmp_path, network)
    assert len(find(load(tmp_path, network, classes=["Hund", "Katze", "Maus"])).vehicles) == 2


def test_the_size_of_the_image_as_a_second_input(tmp_path):
    outputs = dict(KINDS["labels, boxes, scores"][0])
    outputs["boxes"] = outputs["boxes"] / 96
    model = load(tmp_path, constant_network(outputs, metadata=NAMES, sizes=True))
    frame = np.zeros((96, 192, 3), np.uint8)
    found = find(model, frame)
    np.testing.assert_allclose(found.vehicles.boxes, [np.array(CAR) * (2, 1, 2, 1)], atol=0.01)


def test_scores_of_a_dynamic_graph(tmp_path):
    # Tried with 320x320, where the number of cells is known.
    cells = 40 * 40 + 20 * 20 + 10 * 10
    graph = constant_network({"output0": dense(cells, objectness=True)}, size=None, dynamic=True)
    assert load(tmp_path, graph).output_format.kind == "yolox"
    for count in (3 * cells, 3 * (cells + 25)):  # also with cells of stride 64
        graph = constant_network({"output0": np.zeros((1, count, 6), np.float32)}, size=None, dynamic=True)
        assert load(tmp_path, graph).output_format == OutputFormat("yolov5", 1)


@pytest.mark.parametrize(
    "outputs",
    [
        {"probabilities": np.zeros((1, 1000), np.float32)},
        {"maps": np.zeros((1, 5, 8, 8), np.float32)},
        {"one": np.zeros((1, 4, 84), np.float32)},
        {"boxes": np.zeros((1, 300, 4), np.float32), "scores": np.zeros((1, 200, 80), np.float32)},
        {name: np.zeros((1, 8, 8), np.float32) for name in "abcd"},
        {name: np.zeros((1, 300, 4), np.float32) for name in "abc"},
    ],
)
def test_unknown_outputs(tmp_path, outputs):
    with pytest.raises(ModelFileError, match=r"network\.onnx .*outputs that are not known: .*DETR"):
        load(tmp_path, constant_network(outputs))


@pytest.mark.parametrize("kind", ["columns", "rows", "yolov5", "yolox", "final", "detr"])
@given(seed=st.integers(0, 2**32 - 1), spread=st.floats(0, 1e4), low=st.floats(0, 1))
def test_candidates_are_sorted_and_above_the_minimum(kind, seed, spread, low):
    array = np.random.default_rng(seed).normal(0, spread, (1, CELLS, 9)).astype(np.float32)
    array[..., 4:] %= 1
    outputs, order = [array[..., :6]], (0,)
    if kind == "columns":
        outputs = [array.transpose(0, 2, 1)]
    if kind in ("yolov5", "yolox"):
        outputs = [array]
    if kind == "detr":
        outputs, order = [array[..., :4], array[..., 4:]], (0, 1)
    found = OutputFormat(kind, None, order=order).decode(outputs, SIZE, np.array([0, 1]), low)
    assert found.boxes.shape == (len(found.probabilities), 4)
    assert (found.probabilities >= low - 1e-6).all()
    assert (np.diff(found.probabilities) <= 0).all()
    assert np.isin(found.class_ids, [0, 1]).all()
