import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawing.cases import blank, changed_box, track
from vehicle_detection.annotator import (
    LABEL_FIELDS,
    Annotator,
    DrawParams,
    draw_tracks,
    track_color,
    track_fields,
)
from vehicle_detection.drawing import (
    TRACK_COLORS,
    draw_text,
    text_size,
)
from vehicle_detection.errors import InvalidInputError

SIZES = [(360, 480), (720, 1280), (1920, 1080), (2160, 3840)]


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

    def test_a_coasting_track_is_dashed(self):
        image, box = blank(), (600, 400, 700, 490)
        solid = draw_tracks(image, [track(box)], labels=())
        dashed = draw_tracks(image, [track(box, state="coasting", misses=1)], labels=())
        assert changed_box(dashed, image) == list(box)
        drawn = (dashed != image).any(axis=2)
        assert not drawn[(solid == image).all(axis=2)].any()
        for line in (drawn[400, 600:700], drawn[489, 600:700], drawn[400:490, 600], drawn[400:490, 699]):
            assert 0.35 < line.mean() < 0.75
            assert line[0]
            assert line[-1]
            assert np.diff(line.astype(int)).clip(0).sum() >= 4

    @pytest.mark.parametrize("side", [1, 2, 3, 5, 9])
    def test_a_tiny_coasting_track_is_visible(self, side):
        image, box = blank(), (600, 400, 600 + side, 400 + side)
        drawn = draw_tracks(image, [track(box, state="coasting")], labels=())
        assert changed_box(drawn, image) == list(box)

    @pytest.mark.parametrize(("height", "width"), SIZES)
    def test_the_label_grows_with_the_image_and_lies_above_its_box(self, height, width):
        image = blank(height, width)
        box = np.array([0.4, 0.5, 0.5, 0.6]) * [width, height, width, height]
        left, top, _, bottom = changed_box(draw_tracks(image, [track(box)], labels=("id",)), image)
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
            bare = draw_tracks(blank(height, width), tracks, labels=())
            x1, y1, x2, y2 = changed_box(draw_tracks(blank(height, width), tracks), bare)
            sizes.append((x2 - x1, y2 - y1))
        # A label has the color of its box's lines, so a part over them does not differ.
        line = max(2, round(np.sqrt(height * width) / 320))
        assert np.abs(np.subtract(*sizes)).max() <= line

    def test_labels_of_neighbors_hide_neither_each_other_nor_a_vehicle(self):
        image = blank()
        pair = [track((600, 400, 700, 490)), track((610, 402, 712, 495), id=2)]
        bare = draw_tracks(image, pair, labels=())
        areas = [
            int((draw_tracks(image, [one]) != draw_tracks(image, [one], labels=())).any(axis=2).sum())
            for one in pair
        ]
        changed = (draw_tracks(image, pair) != bare).any(axis=2)
        assert int(changed.sum()) > 0.9 * sum(areas)
        assert not changed[402:490, 610:700].any()

    def test_the_line_width_is_given_or_grows_with_the_image(self):
        for width in (1, 5):
            drawn = draw_tracks(blank(), [track()], labels=(), line_width=width)
            assert int((drawn[450, 600:650] != 90).any(axis=1).sum()) == width
        widths = [
            int((draw_tracks(blank(*shape), [track((200, 100, 400, 300))], labels=())[200, 200:300] != 90)
                .any(axis=1).sum())
            for shape in SIZES
        ]  # fmt: skip
        assert widths == sorted(widths)
        assert widths[0] == 2

    def test_colors_by_distance_run_from_near_to_far(self):
        near, middle, far, unknown = (
            track_color(track(distance_m=distance), "distance") for distance in (3.0, 20.0, 80.0, None)
        )
        assert near == TRACK_COLORS[5]
        assert middle == TRACK_COLORS[0]
        assert far == TRACK_COLORS[1]
        assert unknown not in TRACK_COLORS
        between = track_color(track(distance_m=27.0), "distance")
        assert TRACK_COLORS[0][1] < between[1] < TRACK_COLORS[3][1]
        drawn = draw_tracks(blank(), [track(distance_m=3.0)], color_by="distance")
        assert tuple(drawn[489, 650].tolist()) == TRACK_COLORS[5]

    def test_a_long_label_shrinks_to_fit_a_narrow_image(self):
        image = blank(200, 60)
        box = changed_box(draw_tracks(image, [track((10, 80, 50, 120))], labels=LABEL_FIELDS), image)
        assert box[0] >= 0
        assert box[2] <= 60

    def test_near_vehicles_are_drawn_over_far_ones(self):
        near, far = track((600, 400, 700, 500)), track((650, 380, 750, 470), id=2)
        for order in ([near, far], [far, near]):
            drawn = draw_tracks(blank(), order, labels=())
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
        drawn = draw_tracks(image, tracks, labels=LABEL_FIELDS)
        assert drawn.shape == image.shape
        assert drawn.dtype == np.uint8

    def test_rejects_malformed_arguments(self):
        with pytest.raises(InvalidInputError, match="labels must be one of 'id', 'score'"):
            draw_tracks(blank(), [], labels=("name",))
        with pytest.raises(
            InvalidInputError, match=r"tracks must be Track objects.*pass what update returns"
        ):
            draw_tracks(blank(), [[1, 2, 3, 4]])
        with pytest.raises(InvalidInputError, match="tracks must be Track objects"):
            draw_tracks(blank(), None)


def track_text(*arguments, **options):
    return "  ".join(track_fields(*arguments, **options))


class TestText:
    def test_shows_the_requested_and_known_fields(self):
        assert track_text(track(), ("id", "distance", "speed")) == "#1  24 m  -6 km/h"
        assert track_text(track(), ("distance", "std")) == "24 ± 2 m"
        assert track_text(track(), LABEL_FIELDS) == "#1  1.2  24 ± 2 m  -6 ± 2 km/h"
        assert track_text(track(), ()) == ""
        assert track_text(track(), ("distance", "speed"), "imperial") == "77 ft  -4 mph"
        assert track_text(track(confidence=0.876), ("score",)) == "88%"
        assert track_text(track(distance_std_m=6.0), ("distance",)) == "~24 m"

    def test_the_own_speed_gives_speeds_over_ground(self):
        assert track_text(track(), ("speed",), own_mps=25.0) == "84 km/h"
        assert track_text(track(speed_mps=-45.0), ("speed", "std"), "imperial", 25.0) == "45 ± 1 mph"

    def test_omits_unknown_values(self):
        unknown = track(distance_m=None, distance_std_m=None, speed_mps=None, speed_std_mps=None)
        assert track_text(unknown, LABEL_FIELDS) == "#1  1.2"

    def test_holds_only_characters_that_are_drawn(self):
        assert track_text(track(), LABEL_FIELDS).replace("±", "").isascii()

    def test_the_font_has_a_plus_minus_sign(self):
        drawn = []
        for text in ("+", "±"):
            image = blank(40, 60)
            draw_text(image, [text], 5, 5, 1.0, (255, 255, 255))
            drawn.append((image != 90).any(axis=2))
        assert drawn[1][drawn[0]].all()
        assert drawn[1].sum() > drawn[0].sum()
        assert text_size(["±"], 1.0) == text_size(["+"], 1.0)


class TestDrawer:
    """What is remembered from frame to frame."""

    def test_a_frame_drawn_again_is_drawn_alike(self):
        for panel in ("none", "corner", "side"):
            drawer = Annotator(DrawParams(panel=panel))
            drawer.draw_tracks(blank(), [track((580, 400, 680, 490), distance_m=30.0)], time=0.0)
            first, again = (drawer.draw_tracks(blank(), [track()], time=0.04) for _ in range(2))
            np.testing.assert_array_equal(first, again)

    def test_the_first_frame_is_that_of_draw_tracks(self):
        tracks = [track(), track((650, 380, 750, 470), id=2, state="coasting")]
        np.testing.assert_array_equal(
            Annotator().draw_tracks(blank(), tracks, time=3.0), draw_tracks(blank(), tracks)
        )

    def test_an_earlier_frame_starts_anew(self):
        drawer = Annotator(DrawParams(panel="corner"))
        first = drawer.draw_tracks(blank(), [track()], time=1.0)
        for time in (1.1, 1.3, 1.6):
            drawer.draw_tracks(blank(), [track(distance_m=23.6 + 10 * time)], time=time)
        np.testing.assert_array_equal(drawer.draw_tracks(blank(), [track()], time=1.0), first)

    def test_frames_between_two_searches_are_dashed_like_the_last_searched_one(self):
        """A predicted box of a vehicle that the last search has found is not dashed."""
        solid, dashed = (draw_tracks(blank(), [track(state=state)]) for state in ("confirmed", "coasting"))
        drawer = Annotator()
        for state, expected in (("confirmed", solid), ("coasting", dashed)):
            np.testing.assert_array_equal(
                drawer.draw_tracks(blank(), [track(state=state)], time=0.0), expected
            )
            between = drawer.draw_tracks(blank(), [track(state="coasting")], time=0.0, searched=False)
            np.testing.assert_array_equal(between, expected)
