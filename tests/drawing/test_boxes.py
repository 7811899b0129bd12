import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from tests.drawing.cases import blank, changed_box
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing import (
    blend,
    draw_boxes,
    draw_detections,
    draw_labeled_bboxes,
)
from vehicle_detection.errors import InvalidInputError

BLUE = [0, 0, 255]


class TestBoxes:
    def test_lines_lie_inside_the_half_open_box(self):
        image = blank(50, 60, 0)
        drawn = draw_boxes(image, [[10, 5, 40, 35]], thickness=2)
        assert changed_box(drawn, image) == [10, 5, 40, 35]
        assert drawn[5:7, 10:40].tolist() == [[BLUE] * 30] * 2
        assert not drawn[7:33, 12:38].any()
        assert int(drawn.any(axis=2).sum()) == 30 * 30 - 26 * 26

    def test_draws_on_a_copy(self):
        image = blank(50, 60, 0)
        drawn = draw_boxes(image, [[10, 5, 40, 35]], color=(255, 0, 0))
        assert not image.any()
        assert drawn.shape == image.shape
        assert drawn[5, 10].tolist() == [255, 0, 0]

    def test_accepts_the_corner_pairs_of_the_course(self):
        image = blank(50, 60, 0)
        expected = draw_boxes(image, [[10, 5, 40, 35], [0, 0, 9, 9]], thickness=1)
        for pairs in ([((10, 5), (40, 35)), ((0, 0), (9, 9))], [((40, 35), (10, 5)), ((9, 0), (0, 9))]):
            np.testing.assert_array_equal(draw_boxes(image, pairs, thickness=1), expected)

    def test_no_boxes_draw_nothing(self):
        for none in ([], np.empty((0, 4))):
            np.testing.assert_array_equal(draw_boxes(blank(), none), blank())

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

    def test_rejects_malformed_arguments(self):
        with pytest.raises(InvalidInputError, match=r"image must be an \(H, W, 3\) uint8 RGB array"):
            draw_boxes(np.zeros((5, 5, 3)), [])
        with pytest.raises(InvalidInputError, match=r"boxes must be an \(N, 4\) number array"):
            draw_boxes(blank(), [[1, 2, 3]])
        with pytest.raises(InvalidInputError, match="thickness must be an integer from 1 to 10000"):
            draw_boxes(blank(), [], thickness=0)
        with pytest.raises(InvalidInputError, match=r"color must be \(red, green, blue\), 0-255 each"):
            draw_boxes(blank(), [], color="blue")
        with pytest.raises(InvalidInputError, match="color must be an integer from 0 to 255"):
            draw_boxes(blank(), [], color=(0, 0, 256))


class TestLabels:
    def test_each_region_gets_its_bounding_box(self):
        heat = np.zeros((100, 200))
        heat[20:40, 30:80] = heat[60:90, 120:190] = 2
        image = blank(100, 200, 0)
        drawn = draw_labeled_bboxes(image, ndimage.label(heat))
        np.testing.assert_array_equal(drawn, draw_boxes(image, [[30, 20, 80, 40], [120, 60, 190, 90]]))
        assert not image.any()

    def test_a_missing_label_is_skipped(self):
        labels = np.array([[1, 0, 3, 3]] * 4)
        image = blank(4, 4, 0)
        expected = draw_boxes(image, [[0, 0, 1, 4], [2, 0, 4, 4]])
        np.testing.assert_array_equal(draw_labeled_bboxes(image, (labels, 3)), expected)

    def test_no_region_draws_nothing(self):
        image = blank(10, 10)
        np.testing.assert_array_equal(draw_labeled_bboxes(image, ndimage.label(np.zeros((10, 10)))), image)

    def test_rejects_malformed_labels(self):
        with pytest.raises(InvalidInputError, match=r"labels must be the pair .*scipy.ndimage.label returns"):
            draw_labeled_bboxes(blank(), np.zeros((720, 1280), int))
        with pytest.raises(InvalidInputError, match=r"labels\[0\] must be integers of the image's shape"):
            draw_labeled_bboxes(blank(), (np.zeros((10, 10), int), 0))
        with pytest.raises(InvalidInputError, match=r"labels\[0\] must be integers"):
            draw_labeled_bboxes(blank(), (np.zeros((720, 1280)), 0))


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

    @pytest.mark.parametrize("dtype", [np.uint8, np.int64])
    def test_colors_may_be_arrays(self, dtype):
        found = Detections([[600, 400, 700, 490]], [1.25])
        expected = draw_detections(blank(), found, color=(255, 0, 0))
        color = np.array([255, 0, 0], dtype)
        np.testing.assert_array_equal(draw_detections(blank(), found, color=color), expected)

    def test_no_detections_draw_nothing(self):
        np.testing.assert_array_equal(draw_detections(blank(), Detections.empty()), blank())

    def test_rejects_malformed_arguments(self):
        found = Detections([[600, 400, 700, 490]], [1.25])
        with pytest.raises(InvalidInputError, match=r"detections must be a Detections.*pass what detect"):
            draw_detections(blank(), [[600, 400, 700, 490]])
        with pytest.raises(InvalidInputError, match="line_width must be an integer from 1"):
            draw_detections(blank(), found, line_width=0)


class TestBlend:
    @pytest.mark.parametrize("dtype", [np.uint8, np.float64])
    def test_mixes_an_image_with_a_color_or_an_image(self, dtype):
        image = np.full((4, 6, 3), 100, dtype)
        mixed = blend(image, (200, 100, 0), 0.25)
        assert mixed.dtype == dtype
        assert (mixed == [125, 100, 75]).all()
        np.testing.assert_array_equal(mixed, blend(image, np.full_like(image, (200, 100, 0)), 0.25))
        assert (image == 100).all()
