import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from vehicle_detection.boxes import Detections
from vehicle_detection.drawing import (
    LABEL_FIELDS,
    TRACK_COLORS,
    blend,
    draw_boxes,
    draw_diagnostics,
    draw_labeled_bboxes,
    draw_tracks,
    track_color,
    track_text,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import Track

BLUE = [0, 0, 255]
SIZES = [(360, 480), (720, 1280), (1920, 1080), (2160, 3840)]


def blank(height=720, width=1280, value=90):
    return np.full((height, width, 3), value, np.uint8)


def track(box=(600, 400, 700, 490), **changes):
    attributes = {
        "id": 1,
        "box": np.array(box, float),
        "score": 1.25,
        "state": "confirmed",
        "shown": True,
        "age": 2.0,
        "misses": 0,
        "time_since_update": 0.0,
        "velocity": (3.0, 0.0),
        "distance_m": 23.6,
        "distance_std_m": 2.2,
        "speed_mps": -1.75,
        "speed_std_mps": 0.5,
    }
    return Track(**(attributes | changes))


def changed_box(drawn, image):
    """Bounding box ``[x1, y1, x2, y2]`` of the pixels that differ; None if there are none."""
    rows, columns = np.nonzero((drawn != image).any(axis=2))
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] if len(rows) else None


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


class TestTracks:
    def test_draws_on_a_copy(self):
        image = blank()
        image.setflags(write=False)
        drawn = draw_tracks(image, [track()])
        np.testing.assert_array_equal(image, blank())
        assert drawn.flags.writeable

    def test_box_and_label_have_the_tracks_color(self):
        drawn = draw_tracks(blank(), [track(id=3)])
        assert tuple(drawn[489, 650].tolist()) == TRACK_COLORS[2]
        assert tuple(drawn[399, 601].tolist()) == TRACK_COLORS[2]

    def test_colors_follow_the_id_and_repeat_after_the_palette(self):
        count = len(TRACK_COLORS)
        assert [track_color(track(id=1 + k)) for k in range(count)] == list(TRACK_COLORS)
        assert track_color(track(id=1 + count)) == TRACK_COLORS[0]
        assert track_color(track(id=0, state="tentative")) not in TRACK_COLORS

    def test_color_blind_viewers_can_tell_the_colors_apart(self):
        """Machado et al. (2009), full protanopia, deuteranopia and tritanopia."""
        simulations = [
            [
                [0.152286, 1.052583, -0.204868],
                [0.114503, 0.786281, 0.099216],
                [-0.003882, -0.048116, 1.051998],
            ],
            [
                [0.367322, 0.860646, -0.227968],
                [0.280085, 0.672501, 0.047413],
                [-0.011820, 0.042940, 0.968881],
            ],
            [
                [1.255528, -0.076749, -0.178779],
                [-0.078411, 0.930809, 0.147602],
                [0.004733, 0.691367, 0.303900],
            ],
        ]
        linear = (np.array(TRACK_COLORS) / 255) ** 2.2
        for matrix in simulations:
            simulated = np.clip(linear @ np.array(matrix).T, 0, 1) ** (1 / 2.2) * 255
            nearest = min(np.linalg.norm(a - b) for a, b in itertools.combinations(simulated, 2))
            assert nearest > 25

    def test_tracks_that_are_not_shown_are_not_drawn(self):
        drawn = draw_tracks(blank(), [track(shown=False), track(id=0, state="tentative", shown=False)])
        np.testing.assert_array_equal(drawn, blank())

    def test_a_coasting_track_fades(self):
        contrast = []
        for time_since_update in (0.0, 0.1, 0.3, 5.0):
            drawn = draw_tracks(
                blank(), [track(time_since_update=time_since_update, misses=int(time_since_update * 25))]
            )
            contrast.append(np.abs(drawn[489, 650].astype(int) - 90).sum())
        assert contrast[0] > contrast[1] > contrast[2] > contrast[3] > 0

    @pytest.mark.parametrize(("height", "width"), SIZES)
    def test_the_label_grows_with_the_image_and_lies_above_its_box(self, height, width):
        image = blank(height, width)
        box = np.array([0.4, 0.5, 0.5, 0.6]) * [width, height, width, height]
        left, top, _, bottom = changed_box(draw_tracks(image, [track(box)]), image)
        label = round(box[1]) - top
        assert left == round(box[0])
        assert bottom == round(box[3])
        assert 0.012 < label / np.sqrt(height * width) < 0.05
        assert label >= 12

    @pytest.mark.parametrize(("height", "width"), SIZES)
    @pytest.mark.parametrize("corner", [(0, 0), (0, 1), (1, 0), (1, 1)])
    def test_labels_stay_inside_the_image(self, height, width, corner):
        side_x, side_y = width // 12, height // 12
        sizes = []
        for x, y in (
            (width // 2, height // 2),
            (corner[0] * (width - side_x), corner[1] * (height - side_y)),
        ):
            tracks = [track((x, y, x + side_x, y + side_y))]
            bare = draw_tracks(blank(height, width), tracks, show=())
            x1, y1, x2, y2 = changed_box(draw_tracks(blank(height, width), tracks), bare)
            sizes.append((x2 - x1, y2 - y1))
        # A label has the color of its box's lines, so a part over them does not differ.
        line = max(2, round(np.sqrt(height * width) / 320))
        assert np.abs(np.subtract(*sizes)).max() <= line

    def test_labels_of_neighbors_do_not_overlap(self):
        image = blank()
        pair = [track((600, 400, 700, 490)), track((610, 402, 712, 495), id=2)]
        bare = draw_tracks(image, pair, show=())
        areas = [
            int((draw_tracks(image, [one]) != draw_tracks(image, [one], show=())).any(axis=2).sum())
            for one in pair
        ]
        both = int((draw_tracks(image, pair) != bare).any(axis=2).sum())
        assert both > 0.9 * sum(areas)

    def test_a_long_label_shrinks_to_fit_a_narrow_image(self):
        image = blank(200, 60)
        box = changed_box(draw_tracks(image, [track((10, 80, 50, 120))], show=LABEL_FIELDS), image)
        assert box[0] >= 0
        assert box[2] <= 60

    def test_near_vehicles_are_drawn_over_far_ones(self):
        near, far = track((600, 400, 700, 500)), track((650, 380, 750, 470), id=2)
        for order in ([near, far], [far, near]):
            drawn = draw_tracks(blank(), order, show=())
            assert tuple(drawn[401, 670].tolist()) == TRACK_COLORS[0]
            assert tuple(drawn[450, 698].tolist()) == TRACK_COLORS[0]

    @settings(max_examples=40)
    @given(
        st.lists(st.tuples(*[st.floats(-3000, 3000)] * 4), max_size=4),
        st.integers(1, 300),
        st.integers(1, 300),
        st.floats(0, 2),
    )
    def test_tracks_may_lie_partly_outside_the_image(self, corners, height, width, time_since_update):
        image = blank(height, width)
        tracks = [
            track([min(a, c), min(b, d), max(a, c), max(b, d)], id=index, time_since_update=time_since_update)
            for index, (a, b, c, d) in enumerate(corners, 1)
        ]
        drawn = draw_tracks(image, tracks, show=LABEL_FIELDS)
        assert drawn.shape == image.shape
        assert drawn.dtype == np.uint8

    def test_rejects_malformed_arguments(self):
        with pytest.raises(InvalidInputError, match="show must be one of 'id', 'score'"):
            draw_tracks(blank(), [], show=("name",))
        with pytest.raises(
            InvalidInputError, match=r"tracks must be Track objects.*pass what update returns"
        ):
            draw_tracks(blank(), [[1, 2, 3, 4]])
        with pytest.raises(InvalidInputError, match="tracks must be Track objects"):
            draw_tracks(blank(), None)


class TestBlend:
    @pytest.mark.parametrize("dtype", [np.uint8, np.float64])
    def test_mixes_an_image_with_a_color_or_an_image(self, dtype):
        image = np.full((4, 6, 3), 100, dtype)
        mixed = blend(image, (200, 100, 0), 0.25)
        assert mixed.dtype == dtype
        assert (mixed == [125, 100, 75]).all()
        np.testing.assert_array_equal(mixed, blend(image, np.full_like(image, (200, 100, 0)), 0.25))
        assert (image == 100).all()


class TestText:
    def test_shows_the_requested_and_known_fields(self):
        assert track_text(track(), ("id", "distance", "speed")) == "#1  24 m  -1.8 m/s"
        assert track_text(track(), ("distance", "std")) == "24 +-2 m"
        assert track_text(track(), LABEL_FIELDS) == "#1  1.2  24 +-2 m  -1.8 +-0.5 m/s"
        assert track_text(track(), ()) == ""

    def test_omits_unknown_values(self):
        unknown = track(distance_m=None, distance_std_m=None, speed_mps=None, speed_std_mps=None)
        assert track_text(unknown, LABEL_FIELDS) == "#1  1.2"

    def test_is_ascii_as_the_font_has_no_other_characters(self):
        assert track_text(track(), LABEL_FIELDS).isascii()


class TestDiagnostics:
    @pytest.mark.parametrize(("height", "width"), [(720, 1280), (361, 481), (1920, 1080), (4, 5)])
    def test_has_the_shape_of_the_frame(self, height, width):
        heat = np.zeros((height, width), np.float32)
        mosaic = draw_diagnostics(blank(height, width), np.empty((0, 4)), heat, [])
        assert mosaic.shape == (height, width, 3)
        assert mosaic.dtype == np.uint8

    def test_shows_frame_windows_heat_and_tracks(self):
        frame, heat = blank(), np.zeros((720, 1280))
        heat[400:490, 600:700] = 7
        before = frame.copy()
        mosaic = draw_diagnostics(frame, Detections([[600, 400, 700, 490]], [1.0]), heat, [track()])
        np.testing.assert_array_equal(frame, before)
        panels = mosaic[:360, :640], mosaic[:360, 640:], mosaic[360:, :640], mosaic[360:, 640:]
        inside = [panel[200:245, 300:350] for panel in panels]
        assert (inside[0] == 90).all()
        assert (inside[1][0, 0] != 90).any()
        assert inside[2][20, 20].sum() > 500
        assert panels[2][300, 500].sum() < 20
        assert (inside[3][-1, 25] == TRACK_COLORS[0]).all()

    def test_heat_may_be_smaller_empty_boolean_or_of_integers(self):
        for heat in (np.zeros((90, 160)), np.ones((90, 160), int), np.ones((9, 16), bool), -np.ones((9, 16))):
            assert draw_diagnostics(blank(), [], heat, []).shape == (720, 1280, 3)

    def test_rejects_malformed_arguments(self):
        heat = np.zeros((720, 1280))
        with pytest.raises(InvalidInputError, match=r"frame must be an \(H, W, 3\)"):
            draw_diagnostics(heat, [], heat, [])
        with pytest.raises(InvalidInputError, match="frame must be at least 4x4 pixels"):
            draw_diagnostics(blank(3, 9), [], heat, [])
        with pytest.raises(InvalidInputError, match=r"heat must be an \(h, w\) array of numbers"):
            draw_diagnostics(blank(), [], blank(), [])
        with pytest.raises(InvalidInputError, match="heat must be finite"):
            draw_diagnostics(blank(), [], np.full((9, 16), np.nan), [])
