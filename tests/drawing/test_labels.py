"""Placement of labels."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection.drawing import (
    BLACK,
    TRACK_COLORS,
    WHITE,
    LabelPlacer,
    LabelRequest,
    ink_on,
)

SHAPE = (720, 1280, 3)
FIELDS = ("#3", "24 m", "-1.2 m/s")


def request(key, x, y, width=100, height=80, fields=FIELDS):
    return LabelRequest(key, fields, (x, y, x + width, y + height))


def overlap(first, second):
    return max(min(first[2], second[2]) - max(first[0], second[0]), 0) * max(
        min(first[3], second[3]) - max(first[1], second[1]), 0
    )


def test_a_label_lies_above_its_box():
    box = request(1, 600, 400)
    (label,) = LabelPlacer().place([box], SHAPE)
    assert label.rectangle[0] == 600
    assert label.rectangle[3] == 400
    assert label.leader is None


@pytest.mark.parametrize(("width", "lines"), [(40, 2), (100, 2), (200, 1)])
def test_a_label_is_not_much_wider_than_its_box(width, lines):
    (label,) = LabelPlacer().place([request(1, 600, 400, width)], SHAPE)
    assert len(label.lines) == lines
    assert "  ".join(label.lines) == "  ".join(FIELDS)
    assert label.rectangle[2] - label.rectangle[0] <= max(width, 96)


def test_the_size_does_not_depend_on_the_digits():
    sizes = set()
    for text in ("-1.1 m/s", "-0.8 m/s"):
        (label,) = LabelPlacer().place([request(1, 600, 400, fields=(text,))], SHAPE)
        sizes.add((label.rectangle[2], label.rectangle[1]))
    assert len(sizes) == 1


@pytest.mark.parametrize(
    ("x", "y", "width", "height"),
    [(600, 0, 100, 80), (1200, 0, 80, 80), (0, 640, 100, 80), (1240, 680, 40, 40), (0, 0, 1280, 720)],
)
def test_labels_at_the_border_stay_in_the_image(x, y, width, height):
    box = request(1, x, y, width, height)
    (label,) = LabelPlacer().place([box], SHAPE)
    assert label.rectangle[0] >= 0
    assert label.rectangle[1] >= 0
    assert label.rectangle[2] <= SHAPE[1]
    assert label.rectangle[3] <= SHAPE[0]
    if (width, height) != (1280, 720):
        assert overlap(label.rectangle, box.box) == 0


def test_a_row_of_vehicles_has_all_labels_outside_all_boxes():
    row = [request(key, 500 + 45 * key, 400 + 2 * key, 70, 60) for key in range(6)]
    labels = LabelPlacer().place(row, SHAPE)
    for label, box in itertools.product(labels, row):
        assert overlap(label.rectangle, box.box) == 0
    for first, second in itertools.combinations(labels, 2):
        assert overlap(first.rectangle, second.rectangle) == 0
    assert any(label.leader for label in labels)


def test_labels_of_a_crowd_hide_nothing():
    far = [request(key, 560 + 45 * key, 300, 40, 30) for key in range(4)]
    near = [request(key + 4, 300 + 100 * key, 330 + 5 * (key % 3), 120, 90) for key in range(6)]
    labels = LabelPlacer().place(far + near, SHAPE)
    for label, box in itertools.product(labels, far + near):
        assert overlap(label.rectangle, box.box) == 0
    for first, second in itertools.combinations(labels, 2):
        assert overlap(first.rectangle, second.rectangle) == 0
    assert all("  ".join(label.lines) == "  ".join(FIELDS) for label in labels)


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


def test_a_leader_line_may_run_down():
    box = request(1, 600, 100)
    around = [(0, 0, 1280, 100), (0, 100, 600, 300), (700, 100, 1280, 300), (0, 180, 1280, 182)]
    (label,) = LabelPlacer().place([box], SHAPE, around)
    (_, y), (end_x, end_y) = label.leader
    assert (y, end_y) == (box.box[3] - 1, label.rectangle[1])
    assert label.rectangle[0] <= end_x < label.rectangle[2]


def test_a_leader_line_runs_from_the_box_to_its_label():
    row = [request(key, 500 + 45 * key, 400 + 2 * key, 70, 60) for key in range(6)]
    for box, label in zip(row, LabelPlacer().place(row, SHAPE), strict=True):
        if label.leader:
            (x, y), (end_x, end_y) = label.leader
            assert box.box[0] <= x < box.box[2]
            assert y == box.box[1]
            assert label.rectangle[0] <= end_x < label.rectangle[2]
            assert end_y == label.rectangle[3]


def test_labels_avoid_blocked_areas():
    blocked = (500, 300, 800, 400)
    (label,) = LabelPlacer().place([request(1, 600, 400)], SHAPE, [blocked])
    assert overlap(label.rectangle, blocked) == 0


def test_a_label_keeps_its_place_until_the_better_one_has_some_space():
    placer, blocker = LabelPlacer(), request(0, 560, 330, 250, 60, fields=())
    first = placer.place([blocker, request(1, 600, 400)], SHAPE)[1]
    assert first.rectangle[1] == 480  # below
    # One pixel is enough for a new label, but not to move a label.
    freed = request(0, 560, 300, 250, 400 - 300 - (first.rectangle[3] - first.rectangle[1]), fields=())
    assert placer.place([freed, request(1, 600, 400)], SHAPE)[1].rectangle[1] == 480
    assert LabelPlacer().place([freed, request(1, 600, 400)], SHAPE)[1].rectangle[3] == 400
    away = request(0, 560, 200, 250, 60, fields=())
    assert placer.place([away, request(1, 600, 400)], SHAPE)[1].rectangle[3] == 400


def test_a_label_does_not_switch_to_and_fro_while_a_vehicle_passes():
    placer, tops = LabelPlacer(), []
    for step in range(120):
        tremor = step % 3  # of the boxes
        pair = [request(1, 600 + tremor, 400), request(2, 420 + 3 * step, 370 - tremor, 60, 50)]
        label = placer.place(pair, SHAPE)[0]
        tops.append(label.rectangle[1] - 400)
    changes = sum(first != second for first, second in itertools.pairwise(tops))
    assert 1 <= changes <= 2


@pytest.mark.parametrize("color", TRACK_COLORS)
def test_text_contrasts_with_its_label(color):
    """Level AA of the Web Content Accessibility Guidelines 2.2: 4.5."""
    assert contrast(ink_on(color), color) >= 4.5


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_text_is_black_or_white_whichever_contrasts_more(color):
    assert contrast(ink_on(color), color) == max(contrast(ink, color) for ink in (BLACK, WHITE))


def contrast(one, other):
    values = np.array([one, other]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    dark, light = sorted(linear @ [0.2126, 0.7152, 0.0722])
    return (light + 0.05) / (dark + 0.05)


def test_a_request_without_text_has_no_label():
    assert LabelPlacer().place([request(1, 600, 400, fields=())], SHAPE) == [None]


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


def test_the_fields_of_a_crowd_do_not_come_and_go():
    rng = np.random.default_rng(0)
    corners = rng.uniform([300, 300], [900, 450], (30, 2))
    sizes = rng.integers(40, 160, 30)
    placer, counts = LabelPlacer(), []
    for _ in range(50):
        moved = corners + rng.normal(0, 0.5, corners.shape)
        requests = [
            request(key, round(x), round(y), int(size), int(0.8 * size))
            for key, ((x, y), size) in enumerate(zip(moved, sizes))
        ]
        labels = placer.place(requests, SHAPE)
        assert placer.place(requests, SHAPE) == labels
        counts.append(["  ".join(label.lines).count("  ") for label in labels])
    changes = (np.diff(counts, axis=0) != 0).mean() * 25
    assert changes < 0.3  # for each label and second
