"""Drawing into one image: boxes, labels, blurred vehicles, cells."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawing.cases import blank, changed_box
from vehicle_detection import Detections, blur_boxes, draw_boxes, draw_detections
from vehicle_detection.drawing import LabelPlacer, LabelRequest, blend, draw_cell_shares

BLUE = [0, 0, 255]


class TestBoxes:
    def test_lines_lie_inside_the_half_open_box(self):
        image = blank(50, 60, 0)
        drawn = draw_boxes(image, [[10, 5, 40, 35]], thickness=2)
        assert changed_box(drawn, image) == [10, 5, 40, 35]
        assert drawn[5:7, 10:40].tolist() == [[BLUE] * 30] * 2
        assert not drawn[7:33, 12:38].any()
        assert int(drawn.any(axis=2).sum()) == 30 * 30 - 26 * 26
        assert not image.any()

    def test_accepts_the_corner_pairs_of_the_course(self):
        image = blank(50, 60, 0)
        expected = draw_boxes(image, [[10, 5, 40, 35], [0, 0, 9, 9]], thickness=1)
        for pairs in ([((10, 5), (40, 35)), ((0, 0), (9, 9))], [((40, 35), (10, 5)), ((9, 0), (0, 9))]):
            np.testing.assert_array_equal(draw_boxes(image, pairs, thickness=1), expected)

    @given(
        st.lists(st.tuples(*[st.floats(-1e7, 1e7)] * 4), max_size=4),
        st.integers(1, 200),
        st.integers(2, 60),
        st.integers(2, 60),
    )
    def test_boxes_may_lie_partly_or_wholly_outside(self, corners, thickness, height, width):
        image = blank(height, width)
        boxes = [[min(a, c), min(b, d), max(a, c), max(b, d)] for a, b, c, d in corners]
        drawn = draw_boxes(image, boxes, thickness=thickness)
        assert drawn.shape == image.shape
        colors = {tuple(pixel) for pixel in drawn.reshape(-1, 3).tolist()}
        assert colors <= {(90, 90, 90), (0, 0, 255)}


class TestDetections:
    def test_writes_a_score_above_each_box(self):
        image, found = blank(), Detections([[600, 400, 700, 490], [200, 400, 300, 490]], [1.25, -0.5])
        drawn = draw_detections(image, found)
        np.testing.assert_array_equal(
            draw_detections(image, found, scores=False),
            draw_boxes(image, found.boxes, color=(230, 159, 0), thickness=2),
        )
        left, top, right, bottom = changed_box(drawn, image)
        assert (left, right, bottom) == (200, 700, 490)
        assert 10 < 400 - top < 40
        assert (image == 90).all()

    def test_the_labels_of_overlapping_boxes_hide_neither_box(self):
        image = blank()
        found = Detections([[600, 400, 700, 490], [640, 380, 720, 470]], [1.25, 2.0])
        bare, drawn = draw_detections(image, found, scores=False), draw_detections(image, found)
        changed = (drawn != bare).any(axis=2)
        assert changed.any()
        for x1, y1, x2, y2 in found.boxes:
            assert not changed[y1:y2, x1:x2].any()


class TestBlend:
    @pytest.mark.parametrize("dtype", [np.uint8, np.float64])
    def test_mixes_an_image_with_a_color_or_an_image(self, dtype):
        image = np.full((4, 6, 3), 100, dtype)
        mixed = blend(image, (200, 100, 0), 0.25)
        assert mixed.dtype == dtype
        assert (mixed == [125, 100, 75]).all()
        np.testing.assert_array_equal(mixed, blend(image, np.full_like(image, (200, 100, 0)), 0.25))
        assert (image == 100).all()


SHAPE = (720, 1280, 3)
FIELDS = ("#3", "24 m", "-1.2 m/s")


def request(key, x, y, width=100, height=80, fields=FIELDS):
    return LabelRequest(key, fields, (x, y, x + width, y + height))


def overlap(first, second):
    return max(min(first[2], second[2]) - max(first[0], second[0]), 0) * max(
        min(first[3], second[3]) - max(first[1], second[1]), 0
    )


@pytest.mark.parametrize(("width", "lines"), [(40, 2), (100, 2), (200, 1)])
def test_a_label_is_not_much_wider_than_its_box(width, lines):
    (label,) = LabelPlacer().place([request(1, 600, 400, width)], SHAPE)
    assert len(label.lines) == lines
    assert "  ".join(label.lines) == "  ".join(FIELDS)
    assert label.rectangle[2] - label.rectangle[0] <= max(width, 96)
    assert (label.rectangle[0], label.rectangle[3], label.leader) == (600, 400, None)  # above the box
    # The size does not depend on the digits.
    (other,) = LabelPlacer().place([request(1, 600, 400, width, fields=("#1", "88 m", "-0.8 m/s"))], SHAPE)
    assert other.rectangle == label.rectangle


@pytest.mark.parametrize(
    ("x", "y", "width", "height"),
    [(600, 0, 100, 80), (1200, 0, 80, 80), (0, 640, 100, 80), (1240, 680, 40, 40), (0, 0, 1280, 720)],
)
def test_labels_at_the_border_stay_in_the_image(x, y, width, height):
    box = request(1, x, y, width, height)
    (label,) = LabelPlacer().place([box], SHAPE)
    assert min(label.rectangle) >= 0
    assert label.rectangle[2] <= SHAPE[1]
    assert label.rectangle[3] <= SHAPE[0]
    if (width, height) != (1280, 720):
        assert overlap(label.rectangle, box.box) == 0


ROW = [request(key, 500 + 45 * key, 400 + 2 * key, 70, 60) for key in range(6)]
CROWD = [
    *(request(key, 560 + 45 * key, 300, 40, 30) for key in range(4)),
    *(request(key + 4, 300 + 100 * key, 330 + 5 * (key % 3), 120, 90) for key in range(6)),
]


@pytest.mark.parametrize("requests", [ROW, CROWD])
def test_labels_of_a_row_and_of_a_crowd_hide_nothing(requests):
    labels = LabelPlacer().place(requests, SHAPE)
    for label, box in itertools.product(labels, requests):
        assert overlap(label.rectangle, box.box) == 0
    for first, second in itertools.combinations(labels, 2):
        assert overlap(first.rectangle, second.rectangle) == 0
    assert all("  ".join(label.lines) == "  ".join(FIELDS) for label in labels)
    assert any(label.leader for label in labels)


def test_without_room_the_last_fields_are_left_out():
    blocked = [(0, 0, 1280, 385), (0, 490, 1280, 720)]
    boxes = [request(key, 100 + 250 * key, 400, fields=FIELDS) for key in range(4)]
    walls = [(box.box[2], 380, box.box[0] + 220, 500) for box in boxes]
    placer = LabelPlacer()
    labels = placer.place(boxes, SHAPE, blocked + walls)
    assert labels[0].lines == ("#3  24 m", "-1.2 m/s")  # free to the left
    assert {label.lines for label in labels[1:]} == {("#3",)}
    for label, other in itertools.product(labels, [*(box.box for box in boxes), *blocked, *walls]):
        assert overlap(label.rectangle, other) == 0
    assert placer.place(boxes, SHAPE, blocked + walls) == labels
    assert placer.place(boxes, SHAPE)[1].lines == labels[0].lines


def test_a_label_keeps_its_place_until_the_better_one_has_some_space():
    placer, blocker = LabelPlacer(), request(0, 560, 330, 250, 60, fields=())
    first = placer.place([blocker, request(1, 600, 400)], SHAPE)[1]
    assert first.rectangle[1] == 480  # below
    # One pixel is enough for a new label, but not to move a label.
    freed = request(0, 560, 300, 250, 400 - 300 - (first.rectangle[3] - first.rectangle[1]), fields=())
    assert placer.place([freed, request(1, 600, 400)], SHAPE)[1].rectangle[1] == 480
    assert LabelPlacer().place([freed, request(1, 600, 400)], SHAPE)[1].rectangle[3] == 400
    away = request(0, 560, 200, 250, 60, fields=())
    unlabelled, label = placer.place([away, request(1, 600, 400)], SHAPE)
    assert (unlabelled, label.rectangle[3]) == (None, 400)


def test_a_label_does_not_switch_to_and_fro_while_a_vehicle_passes():
    placer, tops = LabelPlacer(), []
    for step in range(120):
        tremor = step % 3  # of the boxes
        pair = [request(1, 600 + tremor, 400), request(2, 420 + 3 * step, 370 - tremor, 60, 50)]
        label = placer.place(pair, SHAPE)[0]
        tops.append(label.rectangle[1] - 400)
    changes = sum(first != second for first, second in itertools.pairwise(tops))
    assert 1 <= changes <= 2


@settings(max_examples=40)
@given(
    st.lists(st.tuples(*[st.integers(-200, 1500)] * 2, *[st.integers(1, 400)] * 2), max_size=6),
    st.integers(60, 800),
    st.integers(60, 1300),
)
def test_all_labels_stay_in_the_image_and_are_repeatable(boxes, height, width):
    requests = [request(key, *box, fields=("#1",)) for key, box in enumerate(boxes)]
    placer = LabelPlacer()
    labels = placer.place(requests, (height, width))
    for label in labels:
        assert 0 <= label.rectangle[0] < label.rectangle[2] <= width
        assert 0 <= label.rectangle[1] < label.rectangle[3] <= height
    assert LabelPlacer().place(requests, (height, width)) == labels
    assert placer.place(requests, (height, width)) == labels


NOISE = np.random.default_rng(0).integers(0, 256, (120, 200, 3), dtype=np.uint8)


def test_the_whole_vehicle_is_blurred_and_nothing_else():
    before = NOISE.copy()
    blurred = blur_boxes(NOISE, [[50, 30, 100, 80]])
    assert changed_box(blurred, NOISE) == [46, 26, 104, 84]
    assert (before == NOISE).all()
    assert blurred[30:80, 50:100].std() < 0.4 * NOISE.std()


@pytest.mark.parametrize(
    ("box", "region"), [([50, 30, 100, 80], [52, 46, 98, 84]), ([40, 30, 140, 80], [32, 46, 148, 84])]
)
def test_the_region_of_the_plate_is_the_lower_part(box, region):
    blurred = blur_boxes(NOISE, [box], region="plates")
    assert changed_box(blurred, NOISE) == region


@pytest.mark.parametrize("region", ["vehicles", "plates"])
def test_characters_disappear(region):
    image = np.full((120, 200, 3), 90, np.uint8)
    image[:, (np.arange(200) // 4) % 2 == 0] = 240  # strokes, 4 pixels wide
    plate = blur_boxes(image, [[40, 20, 110, 90]], region=region)[64:80, 60:90].astype(float)
    assert np.ptp(plate.mean(axis=(0, 2))) < 0.25 * 150
    # No pixel keeps its value by chance of alignment: neighboring columns are nearly equal.
    assert np.abs(np.diff(plate.mean(axis=2), axis=1)).max() < 8


def test_shares_of_cells_are_drawn_by_sign_and_amount():
    image = np.full((40, 60, 3), 90, np.uint8)
    drawn = draw_cell_shares(image, [10, 10, 50, 30], np.array([[1.0, -1.0], [0.5, 0.0]]))
    assert (image == 90).all()
    orange, blue, weak, none = drawn[12, 15], drawn[12, 45], drawn[28, 15], drawn[28, 45]
    assert orange[0] > orange[2]
    assert blue[2] > blue[0]
    assert 90 < weak[0] < orange[0]
    assert (none == 90).all()
    outside = draw_cell_shares(image, [-20, -20, 200, 100], np.zeros((3, 3)))
    np.testing.assert_array_equal(outside, image)
