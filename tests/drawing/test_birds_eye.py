"""Positions on the road, and the bird's-eye view in a video."""

import dataclasses

import numpy as np
import pytest

from tests.drawing.cases import blank, changed_box, track
from vehicle_detection.annotator import (
    Annotator,
    BirdsEyePanel,
    DrawParams,
    Trails,
    road_position,
)
from vehicle_detection.camera import Camera
from vehicle_detection.drawing import TRACK_COLORS
from vehicle_detection.scenes import SceneVehicle, render_scene

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

    def test_where_the_frame_truncates_the_near_end(self):
        """The visible far end of the side gives the position: here 4.5 m behind the near end, at 150 px."""
        known = track((790, 380, 1280, 600), distance_m=4.0, distance_std_m=0.5)
        position = road_position(known, CAMERA, SHAPE)
        assert position.lateral_m == pytest.approx(0.150 * 8.5 + 0.9)
        mirrored = track((0, 380, 490, 600), distance_m=4.0, distance_std_m=0.5)
        assert road_position(mirrored, CAMERA, SHAPE).lateral_m == pytest.approx(-(0.150 * 8.5 + 0.9))

    def test_a_whole_box_of_a_fisheye_lens_is_not_truncated(self):
        camera = Camera.for_frame(SHAPE, lens="fisheye-120")
        camera = dataclasses.replace(camera, vehicle_length_m=9.0)
        known = track((761, 380, 1147, 600), distance_m=4.0, distance_std_m=0.5)
        assert road_position(known, camera, SHAPE).lateral_m == pytest.approx(3.5, abs=0.1)

    def test_the_error_is_larger_along_the_ray(self):
        position = road_position(track((600, 400, 680, 460), distance_std_m=2.0), CAMERA, SHAPE)
        assert position.radial_std_m == pytest.approx(2.0)
        assert 0.05 < position.tangential_std_m < 0.3

    def test_is_unknown_without_a_distance(self):
        assert road_position(track(distance_m=None, distance_std_m=None), CAMERA, SHAPE) is None


def test_trails_cover_a_time_and_drop_lost_tracks():
    trails = Trails()
    for step in range(100):
        result = trails.update(step / 25, {1: (step, 10), 2: None})
    times = [time for time, _ in result[1]]
    assert times == sorted(times)
    assert 3.96 - 1.5 <= times[0] < 3.96 - 1.3
    assert len(times) <= 20
    assert not result[2]
    assert trails.update(4.0, {2: None}).keys() == {2}


class TestPanel:
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

    def test_in_the_corner(self):
        drawn = Annotator(DrawParams(panel="corner", labels=()), camera=CAMERA).draw_tracks(blank(), [])
        left, top, right, bottom = changed_box(drawn, blank())
        assert (top, right) == (0, 1280)
        assert (bottom, right - left) == BirdsEyePanel.corner_size(SHAPE)
        assert bottom < 0.45 * 720

    def test_distances_in_feet(self):
        """Lines at 75, 150 and 225 ft instead of 20, 40 and 60 m."""
        drawn = Annotator(DrawParams(panel="side", labels=(), units="imperial")).draw_tracks(blank(), [])
        lines = [round((80 - feet * 0.3048) * 720 / 86) for feet in (75, 150, 225)]
        rows = (drawn[:, -4:] == drawn[lines[0], -4:]).all(axis=(1, 2))
        assert np.flatnonzero(rows).tolist() == sorted(lines)

    def test_labels_stay_outside_the_corner(self):
        _, width = BirdsEyePanel.corner_size(SHAPE)
        left = 1280 - width
        near_corner = track((left - 40, 320, left + 60, 400))
        drawn, empty = (
            Annotator(DrawParams(panel="corner"), camera=CAMERA).draw_tracks(blank(), tracks)
            for tracks in ([near_corner], [])
        )
        changed = (drawn != empty).any(axis=2)
        color = (drawn[:300, left:] == TRACK_COLORS[0]).all(axis=2) & changed[:300, left:]
        assert color.sum() < 400  # the vehicle in the view, no label

    def test_numbers_stay_in_the_view(self):
        """At each border; a small view has no room for numbers."""
        options = {"distance_std_m": 0.1, "speed_mps": None}
        boxes = {79.0: (600, 400, 680, 470), 20.0: (1000, 400, 1080, 470), 21.0: (200, 400, 280, 470)}
        for distance, box in boxes.items():
            tracks = [track(box, id=8, distance_m=distance, **options)]
            drawn = Annotator(SIDE, camera=CAMERA).draw_tracks(blank(), tracks)
            empty = Annotator(SIDE, camera=CAMERA).draw_tracks(blank(), [])
            white = ((drawn == 235).all(axis=2) & (empty != 235).any(axis=2))[:, 1280:]
            rows, columns = np.nonzero(white)
            assert np.ptp(rows) >= 8
            assert np.ptp(columns) >= 4
        image = blank(240, 320)
        small = [
            Annotator(DrawParams(panel="corner", labels=())).draw_tracks(image, each) for each in (tracks, [])
        ]
        assert ((small[0] == 235).all(axis=2) & (small[1] != 235).any(axis=2)).sum() == 0

    def test_lines_grow_with_the_frame(self):
        widths = []
        for height in (720, 2160):
            image = blank(height, height)
            drawn = Annotator(SIDE, camera=CAMERA).draw_tracks(image, [])
            widths.append((drawn[height // 2, height:] == (72, 78, 86)).all(axis=1).sum())
        assert widths[1] >= 3 * widths[0]

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

    def test_unknown_and_far_vehicles_are_left_out(self):
        empty = Annotator(DrawParams(panel="corner"), camera=CAMERA).draw_tracks(blank(), [])
        for known in (track(distance_m=None, distance_std_m=None), track(distance_m=90.0)):
            drawn = Annotator(DrawParams(panel="corner"), camera=CAMERA).draw_tracks(blank(), [known])
            np.testing.assert_array_equal(drawn[:300, 1150:], empty[:300, 1150:])

    def test_a_coasting_vehicle_is_hollow(self):
        sums = []
        for state in ("confirmed", "coasting"):
            ahead = track((600, 400, 680, 470), distance_std_m=0.1, speed_mps=None, state=state)
            drawn = Annotator(SIDE, camera=CAMERA).draw_tracks(blank(), [ahead])
            sums.append((drawn[:, 1280:] == TRACK_COLORS[0]).all(axis=2).sum())
        assert sums[1] < 0.6 * sums[0]

    def test_another_frame_size_gets_another_panel(self):
        drawer = Annotator(DrawParams(panel="corner"))
        drawer.draw_tracks(blank(), [track()], time=0.0)
        small = drawer.draw_tracks(blank(360, 640), [], time=1.0)
        assert changed_box(small, blank(360, 640))[3] == BirdsEyePanel.corner_size((360, 640))[0]
