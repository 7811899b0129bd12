"""Annotated frames: tracks with labels, the bird's-eye view, blurred vehicles, diagnostics."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawing.cases import blank, changed_box, track
from vehicle_detection import Camera, Detections, FrameResult, InvalidInputError
from vehicle_detection.annotator import (
    LABEL_FIELDS,
    Annotator,
    BirdsEyePanel,
    DrawParams,
    draw_diagnostics,
    draw_tracks,
    road_position,
    track_fields,
)
from vehicle_detection.drawing import TRACK_COLORS, blur_boxes, color_index, track_color
from vehicle_detection.scenes import SceneVehicle, render_scene


def test_labels_become_a_tuple():
    assert DrawParams(labels=["id", "std"]).labels == ("id", "std")
    assert DrawParams(labels="id").labels == ("id",)
    assert DrawParams(labels=()).labels == ()
    assert DrawParams(labels=LABEL_FIELDS).labels == LABEL_FIELDS


SIZES = [(360, 480), (720, 1280), (1920, 1080), (2160, 3840)]


class TestTracks:
    def test_box_and_label_are_drawn_on_a_copy_in_the_tracks_color(self):
        image = blank()
        image.setflags(write=False)
        drawn = draw_tracks(image, [track(id=3)])
        assert drawn.flags.writeable
        assert tuple(drawn[489, 650].tolist()) == TRACK_COLORS[2]
        assert tuple(drawn[399, 601].tolist()) == TRACK_COLORS[2]

    def test_colors_follow_the_id_and_repeat_after_the_palette(self):
        count = len(TRACK_COLORS)
        assert [track_color(track(id=1 + k)) for k in range(count)] == list(TRACK_COLORS)
        assert track_color(track(id=1 + count)) == TRACK_COLORS[0]
        assert track_color(track(id=0, state="tentative")) not in TRACK_COLORS

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

        for side in (1, 2, 3, 5, 9):
            box = (600, 400, 600 + side, 400 + side)
            tiny = draw_tracks(image, [track(box, state="coasting")], labels=())
            assert changed_box(tiny, image) == list(box)

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
        sizes, at_corner = [], (corner[0] * (width - side_x), corner[1] * (height - side_y))
        for x, y in ((width // 2, height // 2), at_corner):
            tracks = [track((x, y, x + side_x, y + side_y))]
            bare = draw_tracks(blank(height, width), tracks, labels=())
            x1, y1, x2, y2 = changed_box(draw_tracks(blank(height, width), tracks), bare)
            sizes.append((x2 - x1, y2 - y1))
        # A label has the color of its box's lines, so a part over them does not differ.
        line = max(2, round(np.sqrt(height * width) / 320))
        assert np.abs(np.subtract(*sizes)).max() <= line

    def test_labels_of_neighbors_hide_neither_each_other_nor_a_vehicle(self):
        def labels_of(tracks):
            return (draw_tracks(blank(), tracks) != draw_tracks(blank(), tracks, labels=())).any(axis=2)

        pair = [track((600, 400, 700, 490)), track((610, 402, 712, 495), id=2)]
        changed = labels_of(pair)
        assert changed.sum() > 0.9 * sum(labels_of([one]).sum() for one in pair)
        assert not changed[402:490, 610:700].any()

    def test_colors_by_distance_run_from_near_to_far(self):
        near, middle, between, far, unknown = (
            track_color(track(distance_m=distance), "distance") for distance in (3.0, 20.0, 27.0, 80.0, None)
        )
        assert (near, middle, far) == (TRACK_COLORS[5], TRACK_COLORS[0], TRACK_COLORS[1])
        assert TRACK_COLORS[0][1] < between[1] < TRACK_COLORS[3][1]
        assert unknown not in TRACK_COLORS
        drawn = draw_tracks(blank(), [track(distance_m=3.0)], color_by="distance")
        assert tuple(drawn[489, 650].tolist()) == TRACK_COLORS[5]

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


def track_text(*arguments, **options):
    return "  ".join(track_fields(*arguments, **options))


def test_a_text_shows_the_requested_and_known_fields():
    assert track_text(track(), ("id", "distance", "speed")) == "#1  24 m  -6 km/h"
    assert track_text(track(), ("distance", "std")) == "24 ± 2 m"
    assert track_text(track(), LABEL_FIELDS) == "#1  1.2  24 ± 2 m  -6 ± 2 km/h"
    assert track_text(track(), ()) == ""
    assert track_text(track(), ("distance", "speed"), "imperial") == "77 ft  -4 mph"
    assert track_text(track(confidence=0.876), ("score",)) == "88%"
    assert track_text(track(distance_std_m=6.0), ("distance",)) == "~24 m"
    unknown = track(distance_m=None, distance_std_m=None, speed_mps=None, speed_std_mps=None)
    assert track_text(unknown, LABEL_FIELDS) == "#1  1.2"
    # The own speed gives speeds over ground.
    assert track_text(track(), ("speed",), own_mps=25.0) == "84 km/h"
    assert track_text(track(speed_mps=-45.0), ("speed", "std"), "imperial", 25.0) == "45 ± 1 mph"


class TestDrawer:
    """What is remembered from frame to frame."""

    def test_a_frame_drawn_again_is_drawn_alike(self):
        for panel in ("none", "corner", "side"):
            drawer = Annotator(DrawParams(panel=panel))
            drawer.draw_tracks(blank(), [track((580, 400, 680, 490), distance_m=30.0)], time=0.0)
            first, again = (drawer.draw_tracks(blank(), [track()], time=0.04) for _ in range(2))
            np.testing.assert_array_equal(first, again)

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


SHAPE = (720, 1280, 3)
CAMERA = Camera(focal_px=1000.0, horizon_px=400.0)
SIDE = DrawParams(panel="side", labels=())


class TestPosition:
    @pytest.mark.parametrize("distance", [12.0, 40.0])
    @pytest.mark.parametrize("lateral", [-3.6, 0.8, 3.6])
    def test_of_rendered_vehicles(self, distance, lateral):
        """From true boxes and distances: within 0.35 m, a tenth of a lane."""
        vehicle = SceneVehicle(distance_m=distance, lateral_m=lateral, kind="estate", color="white")
        scene = render_scene(shape=(360, 640), vehicles=[vehicle], lane=1)
        (truth,) = scene.truth
        known = track(truth.box, distance_m=distance, distance_std_m=1.0)
        position = road_position(known, scene.camera, scene.image.shape)
        assert position.distance_m == distance
        assert abs(position.lateral_m - lateral) < 0.35


class TestPanel:
    def test_trails_cover_a_time_and_drop_lost_tracks(self):
        """The last 1.5 s, which begin at 41 m; and a track that is found again starts anew."""
        drawer, scale = Annotator(SIDE, camera=CAMERA), 720 / 86
        empty = drawer.draw_tracks(blank(), [], time=0.0)
        for step in range(101):
            ahead = track(distance_m=10 + 0.5 * step, distance_std_m=0.1, speed_mps=None)
            drawn = drawer.draw_tracks(blank(), [ahead], time=step / 25)
        rows, _ = np.nonzero((drawn != empty).any(axis=2)[:, 1280:])
        assert 41 <= 80 - rows.max() / scale < 44
        drawer.draw_tracks(blank(), [], time=4.04)
        again, new = (
            each.draw_tracks(blank(), [ahead], time=4.08) for each in (drawer, Annotator(SIDE, camera=CAMERA))
        )
        np.testing.assert_array_equal(again, new)

    @pytest.mark.parametrize(
        "shape", [(720, 1280, 3), (1080, 1919, 3), (1920, 1080, 3), (270, 480, 3), (4, 5, 3)]
    )
    def test_beside_the_frame(self, shape):
        drawer, image = Annotator(DrawParams(panel="side"), camera=CAMERA), blank(*shape[:2])
        drawn = drawer.draw_tracks(image, [track()])
        assert drawn.shape == drawer.output_shape(shape)
        assert drawn.shape[0] == shape[0]
        assert drawn.shape[1] % 2 == 0
        plain = Annotator().draw_tracks(image, [track()])
        np.testing.assert_array_equal(drawn[:, : shape[1]], plain)
        assert Annotator().output_shape(shape) == shape

    def test_in_the_corner_of_frames_of_any_size(self):
        drawer = Annotator(DrawParams(panel="corner", labels=()), camera=CAMERA)
        for shape in (SHAPE, (360, 640, 3)):
            image = blank(*shape[:2])
            left, top, right, bottom = changed_box(drawer.draw_tracks(image, []), image)
            assert (top, right) == (0, shape[1])
            assert (bottom, right - left) == BirdsEyePanel.corner_size(shape)
            assert bottom < 0.45 * shape[0]

    @pytest.mark.parametrize(("distance", "shown"), [(75.0, True), (78.0, False), (90.0, False)])
    def test_a_vehicle_at_the_edge_is_left_out_whole(self, distance, shown):
        ahead = track((600, 400, 640, 430), distance_m=distance, distance_std_m=0.1, speed_mps=None)
        drawn = Annotator(SIDE, camera=CAMERA).draw_tracks(blank(), [ahead])
        assert (drawn[:, 1280:] == TRACK_COLORS[0]).all(axis=2).any() == shown

    def test_numbers_hide_neither_vehicles_nor_each_other(self):
        """A crowd: every pixel of the vehicles is as without numbers."""
        crowd = [
            track((560 + 9 * n, 400, 620 + 9 * n, 440), id=100 + n, distance_m=20.0 + n, distance_std_m=0.1)
            for n in range(8)
        ]
        crowd = [dataclasses.replace(each, speed_mps=None) for each in crowd]
        colors = [TRACK_COLORS[color_index(each.id)] for each in crowd]
        panel = BirdsEyePanel(SHAPE, "corner")
        with_numbers, without = blank(), blank()
        panel.draw(with_numbers, crowd, colors, CAMERA, SHAPE, 0.0)
        panel = BirdsEyePanel(SHAPE, "corner")
        panel._has_text = False
        panel.draw(without, crowd, colors, CAMERA, SHAPE, 0.0)
        vehicles = np.any([(without == color).all(axis=2) for color in colors], axis=0)
        assert vehicles.sum() > 200
        assert (with_numbers[vehicles] == without[vehicles]).all()
        assert (with_numbers != without).any()

    def test_a_vehicle_is_at_its_place(self):
        """A vehicle in the own lane: in the middle, and the farther the higher."""
        rows = []
        for distance in (10.0, 30.0, 60.0):
            ahead = track((600, 400, 680, 470), distance_m=distance, distance_std_m=0.1, speed_mps=None)
            drawn = Annotator(SIDE, camera=CAMERA).draw_tracks(blank(), [ahead])
            y, x = np.nonzero((drawn[:, 1280:] == TRACK_COLORS[0]).all(axis=2))
            assert abs(x.mean() - (drawn.shape[1] - 1280) / 2) < 3
            rows.append(y.max())
        scale = 720 / 86
        np.testing.assert_allclose(np.diff(rows), [-20 * scale, -30 * scale], atol=2)


@pytest.mark.parametrize(
    "state",
    [{}, {"state": "coasting", "misses": 9, "shown": False}, {"id": 0, "state": "tentative", "shown": False}],
)
def test_every_track_and_detection_is_blurred(state):
    noise = np.random.default_rng(0).integers(0, 256, (120, 200, 3), dtype=np.uint8)
    none, annotator = Detections.empty(), Annotator(blur="vehicles")
    result = FrameResult(0, 0.0, none, none, (track([50, 30, 100, 80], **state),))
    assert annotator.draw(noise, result)[45:70, 60:90].std() < 0.4 * noise.std()
    detected = dataclasses.replace(result, tracks=(), detections=Detections([[50, 30, 100, 80]], [1.0]))
    assert (annotator.draw(noise, detected) == blur_boxes(noise, [[50, 30, 100, 80]])).all()


class TestDiagnostics:
    @pytest.mark.parametrize(("height", "width"), [(720, 1280), (361, 481), (1920, 1080), (4, 5)])
    def test_has_the_shape_of_the_frame_whatever_the_heat(self, height, width):
        for heat in (np.zeros((height, width), np.float32), np.ones((90, 160), int), np.ones((9, 16), bool)):
            mosaic = draw_diagnostics(blank(height, width), np.empty((0, 4)), heat, [])
            assert (mosaic.shape, mosaic.dtype) == ((height, width, 3), np.uint8)

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


HEAT = np.zeros((720, 1280))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Annotator(own_speed=25.0), "own_speed must have a method at"),
        (lambda: draw_tracks(blank(), [[1, 2, 3, 4]]), "tracks must be Track objects.*what update returns"),
        (lambda: draw_diagnostics(blank(3, 9), [], HEAT, []), "frame must be at least 4x4 pixels"),
        (lambda: draw_diagnostics(blank(), [], blank(), []), r"heat must be an \(h, w\) array of numbers"),
        (lambda: draw_diagnostics(blank(), [], np.full((9, 16), np.nan), []), "heat must be finite"),
    ],
)
def test_malformed_arguments_are_refused(call, message):
    with pytest.raises(InvalidInputError, match=message):
        call()
