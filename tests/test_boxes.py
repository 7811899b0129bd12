import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vehicle_detection import Detections, InvalidInputError, clip_boxes, iou_matrix, non_max_suppression
from vehicle_detection.boxes import box_areas, intersection_matrix, iter_nms, overlap_matrices


def corners_to_boxes(array):
    return np.concatenate([np.minimum(array[:, :2], array[:, 2:]), np.maximum(array[:, :2], array[:, 2:])], 1)


def boxes_of(elements, dtype, max_count=8):
    shapes = st.tuples(st.integers(0, max_count), st.just(4))
    return shapes.flatmap(lambda shape: hnp.arrays(dtype, shape, elements=elements)).map(corners_to_boxes)


integer_boxes = boxes_of(st.integers(-20, 30), np.int64)
float_boxes = boxes_of(st.floats(-1e4, 1e4, width=32), np.float64)
any_boxes = st.one_of(integer_boxes, float_boxes)


@st.composite
def detections(draw):
    boxes = draw(any_boxes)
    # Few distinct scores make ties likely.
    scores = draw(hnp.arrays(np.float64, len(boxes), elements=st.integers(-3, 3).map(float)))
    return Detections(boxes, scores)


def pixels(box):
    x1, y1, x2, y2 = (int(value) for value in box)
    return {(x, y) for x in range(x1, x2) for y in range(y1, y2)}


@given(integer_boxes, integer_boxes)
def test_areas_and_overlaps_count_pixels(first, second):
    inner = [[len(pixels(a) & pixels(b)) for b in second] for a in first]
    outer = [[len(pixels(a) | pixels(b)) for b in second] for a in first]
    shape = (len(first), len(second))
    assert box_areas(first).tolist() == [len(pixels(a)) for a in first]
    np.testing.assert_array_equal(intersection_matrix(first, second), np.reshape(inner, shape))
    expected = [[i / u if u else 0 for i, u in zip(*row)] for row in zip(inner, outer)]
    np.testing.assert_allclose(iou_matrix(first, second), np.reshape(expected, shape), rtol=1e-12)


@given(any_boxes, any_boxes)
def test_iou_is_symmetric_and_between_0_and_1(first, second):
    overlap = iou_matrix(first, second)
    assert overlap.shape == (len(first), len(second))
    assert overlap.dtype == np.float64
    assert ((overlap >= 0) & (overlap <= 1)).all()
    np.testing.assert_array_equal(overlap, iou_matrix(second, first).T)


@given(any_boxes, st.tuples(st.integers(1, 40), st.integers(1, 40)))
def test_clipped_boxes_lie_inside_the_image(boxes, shape):
    before = boxes.copy()
    clipped = clip_boxes(boxes, shape)
    height, width = shape
    assert ((clipped >= 0) & (clipped <= (width, height, width, height))).all()
    assert (clipped[:, 2:] >= clipped[:, :2]).all()
    assert clipped.dtype == boxes.dtype
    np.testing.assert_array_equal(clip_boxes(clipped, shape), clipped)
    # Clipping is the intersection with the image.
    image = np.array([[0, 0, width, height]], boxes.dtype)
    np.testing.assert_allclose(box_areas(clipped), intersection_matrix(boxes, image)[:, 0], atol=1e-6)
    np.testing.assert_array_equal(boxes, before)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint32, np.float32])
def test_clipping_keeps_the_dtype(dtype):
    clipped = clip_boxes(np.array([[0, 0, 200, 100]], dtype), (720, 1280))
    assert clipped.dtype == dtype
    assert clipped.tolist() == [[0, 0, 200, 100]]


def nms_by_definition(boxes, scores, max_iou, max_coverage=np.inf):
    kept = []
    for row in sorted(range(len(boxes)), key=lambda row: -scores[row]):
        overlaps = [overlap_matrices(boxes[[row]], boxes[[other]]) for other in kept]
        if all(iou <= max_iou and coverage <= max_coverage for iou, coverage in overlaps):
            kept.append(row)
    return kept


@given(detections(), st.floats(0, 1))
def test_nms_equals_its_definition(found, threshold):
    kept = non_max_suppression(found.boxes, found.scores, threshold=threshold)
    assert kept.tolist() == nms_by_definition(found.boxes, found.scores, threshold)


@given(float_boxes, st.floats(0, 1), st.floats(0, 1), st.randoms(use_true_random=False))
def test_iterative_nms_considers_the_listed_rows_and_yields_the_iou_with_all_boxes(
    boxes, max_iou, max_coverage, random
):
    order = [row for row in range(len(boxes)) if random.random() < 0.7]
    random.shuffle(order)
    kept = list(iter_nms(boxes, np.array(order, np.intp), max_iou=max_iou, max_coverage=max_coverage))
    scores = -np.arange(len(order))
    expected = [order[index] for index in nms_by_definition(boxes[order], scores, max_iou, max_coverage)]
    assert [row for row, _ in kept] == expected
    for row, iou in kept:
        np.testing.assert_array_equal(iou, iou_matrix(boxes[[row]], boxes)[0])


@given(float_boxes, float_boxes)
def test_coverage_is_the_covered_fraction_of_the_smaller_box(first, second):
    iou, coverage = overlap_matrices(first, second)
    np.testing.assert_array_equal(iou, iou_matrix(first, second))
    smaller = np.minimum(box_areas(first)[:, None], box_areas(second)[None])
    np.testing.assert_allclose(coverage * smaller, intersection_matrix(first, second), rtol=1e-12)
    assert ((coverage >= iou - 1e-12) & (coverage <= 1)).all()


def test_detections_are_columns():
    found = Detections([[0, 0, 10, 10], [5, 5, 9, 9]], [1, 2])
    assert len(found) == 2
    assert found.scores.dtype == np.float64
    assert [(box.tolist(), score) for box, score in found] == [([0, 0, 10, 10], 1.0), ([5, 5, 9, 9], 2.0)]
    assert found[1:].scores.tolist() == [2]
    assert found[found.scores < 2].boxes.tolist() == [[0, 0, 10, 10]]
    assert found[[1, 0]].scores.tolist() == [2, 1]
    assert len(found[[]]) == 0

    for index in (1, -1, np.int64(1)):
        assert (found[index].boxes.tolist(), found[index].scores.tolist()) == ([[5, 5, 9, 9]], [2.0])
    with pytest.raises(IndexError):
        found[2]


def test_empty_detections():
    for found in (Detections.empty(), Detections([], []), Detections(np.empty((0, 4)), np.empty((0, 1)))):
        assert len(found) == 0
        assert found.boxes.shape == (0, 4)
        assert found.scores.shape == (0,)
        assert list(found) == []


def test_confidences_are_probabilities():
    found = Detections(TWO, [1.0, 2.0], [0.0, 1.0])
    assert found.confidences.tolist() == [0, 1]
    for confidences in ([-0.01, 0.5], [0.5, 1.01], [0.5]):
        with pytest.raises(InvalidInputError, match=r"^confidences must be "):
            Detections(TWO, [1.0, 2.0], confidences)
    assert Detections(TWO, [1.0, 2.0], [np.nan, np.nan]).confidences is None
    with pytest.raises(InvalidInputError, match="confidences must be finite"):
        Detections(TWO, [1.0, 2.0], [0.5, np.nan])


@pytest.mark.parametrize(
    ("boxes", "scores", "message"),
    [
        ([[0, 0, 1, 1]], [[1]], r"scores must be one number for each of the 1 boxes"),
        ([], [1], "scores must be one number for each of the 0 boxes"),
        ([[0, 0, 1, 1]], [np.inf], "scores must be finite, got NaN or infinity"),
        ([[1, 0, 0, 1]], [1], r"boxes\[0\] must be .* x1 <= x2"),
    ],
)
def test_detections_reject_invalid_columns(boxes, scores, message):
    with pytest.raises(InvalidInputError, match=message):
        Detections(boxes, scores)


class StandIn:
    """What the library uses of supervision.Detections."""

    def __init__(self, xyxy, confidence=None, class_id=None, tracker_id=None, data=None):
        self.xyxy, self.confidence, self.class_id, self.tracker_id = xyxy, confidence, class_id, tracker_id
        self.data = data or {}


TWO = [[0, 0, 10, 10], [5, 5, 9, 9]]


def test_detections_are_joined():
    first, second = Detections(TWO, [1.0, 2.0]), Detections([[1.5, 0, 3, 3]], [3.0])
    joined = first + second
    np.testing.assert_array_equal(joined.boxes, [*TWO, [1.5, 0, 3, 3]])
    assert joined.scores.tolist() == [1, 2, 3]
    known = Detections(TWO, [1.0, 2.0], [0.5, 0.6])
    assert (known + first).confidences is None
    for joined in (Detections.empty() + known, known + Detections.empty()):
        assert joined.confidences.tolist() == [0.5, 0.6]
    with pytest.raises(TypeError, match="unsupported operand"):
        first + 1


def test_detections_of_supervision_are_converted():
    given_ = StandIn(np.array(TWO, np.float32), np.array([0.5, 0.9], np.float32), np.array([2, 7]))
    found = Detections.from_supervision(given_)
    np.testing.assert_array_equal(found.boxes, TWO)
    np.testing.assert_allclose(found.scores, [0, np.log(9)], atol=1e-6)
    lower = Detections.from_supervision(given_, threshold=0.25)
    np.testing.assert_allclose(lower.scores, [np.log(3), np.log(27)], atol=1e-6)
    assert Detections.from_supervision(given_, class_ids={7}).boxes.tolist() == [TWO[1]]
    assert Detections.from_supervision(given_, score="logit").scores[0] == 0.5
    assert Detections.from_supervision(given_, score=(0.1, 0.9)).scores.tolist() == pytest.approx([1.5, 3])
    assert Detections.from_supervision(StandIn(TWO)).scores.tolist() == [3, 3]
    assert len(Detections.from_supervision(StandIn(np.empty((0, 4)), np.empty(0)))) == 0


@pytest.mark.parametrize(
    ("given_", "options", "message"),
    [
        ([TWO], {}, "detections must have xyxy"),
        (StandIn(TWO, [0.5, 3.0]), {}, r'0 to 1 with score="probability", got 0.5 to 3; pass score="logit"'),
        (StandIn([[9, 9, 5, 5]], [0.5]), {}, "x1 <= x2"),
        (
            StandIn(TWO, [0.5, 0.5]),
            {"class_ids": [1]},
            "class_ids must come with an integer class for each of 2",
        ),
        (StandIn(TWO, [0.5, 0.5], [2, 7]), {"class_ids": 2}, "class_ids must be a sequence of integers"),
        (StandIn(TWO), {"score": (1, 1)}, r"score\[1\] must be a number, greater than 1"),
        (StandIn(TWO), {"score": (0, 1), "threshold": 0.5}, "threshold must be omitted"),
        (StandIn(TWO), {"score": "logit", "threshold": "0"}, "threshold must be a number"),
    ],
)
def test_invalid_detections_of_supervision_are_rejected(given_, options, message):
    with pytest.raises(InvalidInputError, match=message):
        Detections.from_supervision(given_, **options)


def test_detections_become_those_of_supervision(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=StandIn))
    found = Detections(TWO, [0.0, np.log(9)])
    converted = found.to_supervision(tracker_id=[4, 7])
    np.testing.assert_array_equal(converted.xyxy, TWO)
    np.testing.assert_allclose(converted.confidence, [0.5, 0.9], rtol=1e-6)
    assert converted.class_id.tolist() == [0, 0]
    assert converted.tracker_id.tolist() == [4, 7]
    assert found.to_supervision().tracker_id is None
    assert converted.xyxy.dtype == converted.confidence.dtype == np.float32
    assert converted.data["class_name"].tolist() == ["vehicle", "vehicle"]
    assert Detections.empty().to_supervision().xyxy.shape == (0, 4)


def test_the_way_to_supervision_and_back_changes_no_meaning(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=StandIn))
    found = Detections(TWO, [0.5, 2.5], [0.25, 0.875], ["bus", "car"], [5, 2])
    back = Detections.from_supervision(found.to_supervision())
    for name in ("boxes", "scores", "confidences", "labels", "class_ids"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))


def test_results_of_ultralytics_have_names():
    boxes = SimpleNamespace(xyxy=TWO, conf=[0.5, 0.9], cls=[2.0, 7.0])
    found = Detections.from_supervision(SimpleNamespace(boxes=boxes, names={2: "car", 7: "truck"}))
    assert found.labels.tolist() == ["car", "truck"]
    assert found.class_ids.tolist() == [2, 7]
    assert found.confidences.tolist() == [0.5, 0.9]


@pytest.mark.parametrize("name", ["labels", "class_ids"])
@pytest.mark.parametrize("value", [["car"], [1], "car", [1.5, None]])
def test_each_box_has_a_class(name, value):
    with pytest.raises(InvalidInputError, match=f"{name} must be"):
        Detections(TWO, [1, 2], **{name: value})


def test_classes_follow_their_boxes():
    found = Detections(TWO, [1, 2], labels=["car", "bus"], class_ids=[2, 5])
    assert found[[1]].labels.tolist() == ["bus"]
    assert (found + found[:1]).class_ids.tolist() == [2, 5, 2]
    assert (found + Detections(TWO, [1, 2])).labels is None
    assert "1 bus, 1 car" in repr(found)
    assert found.to_pandas()["label"].tolist() == ["car", "bus"]


def test_the_remedy_without_supervision(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(InvalidInputError, match="needs supervision; pip install supervision"):
        Detections(TWO, [1, 2]).to_supervision()


def test_a_table_of_detections():
    found = Detections([[0, 1, 50, 40], [2, 3, 60, 50]], [1.5, 0.5], [0.8, 0.6])
    table = found.to_pandas()
    assert list(table) == ["x1", "y1", "x2", "y2", "score", "confidence"]
    assert table.iloc[1].tolist() == [2, 3, 60, 50, 0.5, 0.6]
    assert list(Detections.empty().to_pandas()) == ["x1", "y1", "x2", "y2", "score"]
