import csv
import importlib.util
from types import ModuleType

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import ROOT
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image
from vehicle_detection.synthetic import (
    Drive,
    SceneVehicle,
    VehicleTruth,
    render_drive,
    render_patches,
    render_scene,
    write_labels,
)
from vehicle_detection.synthetic import drive as synthetic
from vehicle_detection.synthetic.drive import LABEL_COLUMNS, Scene

SMALL = (216, 384)
TEST_IMAGES = ROOT / "test_images"

cars = st.builds(
    SceneVehicle,
    distance_m=st.floats(2.5, 90.0),
    lateral_m=st.floats(-12.0, 12.0),
    kind=st.sampled_from(["hatchback", "estate", "sedan", "mpv", "suv", "van", "truck"]),
    paint=st.sampled_from(["white", "red", "black"]),
    facing=st.sampled_from(["rear", "front"]),
    speed_mps=st.floats(-30.0, 30.0),
)


def paths(drive: Drive) -> dict[int, dict[int, VehicleTruth]]:
    """Truth by track, then by frame."""
    found: dict[int, dict[int, VehicleTruth]] = {}
    for frame, rows in enumerate(drive.truth):
        for row in rows:
            found.setdefault(row.track, {})[frame] = row
    return found


def middle(row: VehicleTruth) -> float:
    return (row.full_box[0] + row.full_box[2]) / 2


def check_invariants(scene: Scene) -> None:
    height, width = scene.image.shape[:2]
    for row in scene.truth:
        x1, y1, x2, y2 = row.box
        assert 0 <= x1 < x2 <= width
        assert 0 <= y1 < y2 <= height
        full = row.full_box
        assert full[0] <= x1
        assert full[1] <= y1
        assert full[2] >= x2
        assert full[3] >= y2
        np.testing.assert_allclose(clip_boxes([full], (height, width))[0], row.box, atol=1.0)
        assert 0 <= row.truncated < 1
        assert 0 <= row.hidden <= 1
        assert row.occluded == (2 if row.hidden > 0.5 else int(row.hidden >= 0.1))
        small, cut = x2 - x1 < 40, row.truncated > 0.7
        assert row.ignore >= (row.occluded == 2 or small or cut)
        seen = np.argwhere(scene.seen == row.track)
        if row.hidden == 0:
            # Nothing hides it, so what the picture shows of it is its box, to the pixel.
            assert (*seen.min(0)[::-1], *(seen.max(0)[::-1] + 1)) == row.box
        elif len(seen):
            assert (seen.min(0)[::-1] >= [x1, y1]).all()
            assert (seen.max(0)[::-1] < [x2, y2]).all()


class TestScene:
    def test_same_seed_gives_same_bytes(self):
        first, second = (render_scene(shape=SMALL, random_state=4) for _ in range(2))
        assert first.image.tobytes() == second.image.tobytes()
        assert first.truth == second.truth
        third = render_scene(shape=SMALL, random_state=5)
        assert third.image.tobytes() != first.image.tobytes()

    def test_generator_seeds_and_moves_on(self):
        rng = np.random.default_rng(4)
        first = render_scene(shape=SMALL, random_state=rng)
        assert (
            first.image.tobytes()
            == render_scene(shape=SMALL, random_state=np.random.default_rng(4)).image.tobytes()
        )
        assert first.image.tobytes() != render_scene(shape=SMALL, random_state=rng).image.tobytes()
        assert render_scene(shape=SMALL, random_state=None).image.shape == (*SMALL, 3)

    def test_global_random_state_is_left_alone(self):
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        render_scene(shape=SMALL)
        assert (np.random.get_state()[1] == before).all()  # noqa: NPY002

    @pytest.mark.parametrize("shape", [(540, 960), (1080, 1920), (64, 64), (300, 200)])
    def test_shape(self, shape):
        scene = render_scene(shape=shape, vehicles=2)
        assert scene.image.shape == (*shape, 3)
        assert scene.image.dtype == np.uint8
        assert scene.seen.shape == shape

    @pytest.mark.parametrize("light", ["day", "overcast", "dusk", "night"])
    @pytest.mark.parametrize("rain", [0.0, 0.7])
    def test_light_and_rain(self, light, rain):
        scene = render_scene(shape=SMALL, light=light, rain=rain, vehicles=2)
        check_invariants(scene)
        mean = scene.image.mean()
        assert (mean < 40) if light == "night" else (60 < mean < 200)
        assert scene.image.std() > 3

    @given(vehicles=st.lists(cars, max_size=4), horizon=st.floats(0.2, 0.8), seed=st.integers(0, 3))
    @settings(max_examples=20)
    def test_truth_invariants(self, vehicles, horizon, seed):
        scene = render_scene(shape=SMALL, vehicles=vehicles, horizon=horizon, random_state=seed)
        check_invariants(scene)
        assert scene.boxes.shape == (len(scene.truth), 4)
        for row in scene.truth:
            wanted = vehicles[row.track - 1]
            assert (row.distance_m, row.speed_mps) == (wanted.distance_m, wanted.speed_mps)

    @given(
        distance=st.floats(6.0, 40.0),
        lateral=st.floats(-1.5, 1.5),
        horizon=st.floats(0.3, 0.6),
        height=st.floats(1.0, 2.0),
        focal=st.floats(900.0, 1400.0),
        kind=st.sampled_from(["hatchback", "sedan", "suv", "van", "truck"]),
    )
    @settings(max_examples=12)
    def test_distance_follows_from_the_foot_row(self, distance, lateral, horizon, height, focal, kind):
        car = SceneVehicle(distance_m=distance, lateral_m=lateral, kind=kind)
        scene = render_scene(
            shape=(720, 1280), vehicles=[car], horizon=horizon, camera_height=height, focal=focal
        )
        foot = scene.truth[0].full_box[3]
        assert scene.camera.foot_row(distance) == pytest.approx(horizon * 720 + focal * height / distance)
        below = foot - scene.camera.horizon_px
        # 1% of the distance, and the rounding of the box to whole pixels.
        assert below == pytest.approx(focal * height / distance, abs=0.01 * focal * height / distance + 1.0)
        if scene.truth[0].box[3] < 720:
            assert scene.camera.distance(foot) == pytest.approx(distance, rel=0.01 + 1.0 / below)

    @pytest.mark.parametrize("random_state", range(4))
    def test_vehicle_changes_only_its_box_and_shadow(self, random_state):
        near = SceneVehicle(distance_m=14, lateral_m=-1.0)
        far = SceneVehicle(distance_m=30, lateral_m=3.6)
        both = render_scene(vehicles=[far, near], random_state=random_state)
        alone = render_scene(vehicles=[far], random_state=random_state)
        assert both.truth[0] == alone.truth[0]
        changed = (both.image != alone.image).any(-1)
        x1, y1, x2, y2 = both.truth[1].box
        inside = changed[y1:y2, x1:x2]
        assert inside.mean() > 0.6
        # Blur carries a change over the edge by a few pixels; the shadow lies on the road.
        margin = 6
        above = changed.copy()
        above[y1 - margin : y2 + margin, x1 - margin : x2 + margin] = False
        rows = np.flatnonzero(above.any(1))
        assert len(rows) == 0 or rows.min() >= both.camera.horizon_px
        # The silhouette itself: every pixel of it differs from the road, as good as.
        solid = both.seen == 2
        assert changed[solid].mean() > 0.95

    def test_vehicle_touches_each_side_of_its_box(self):
        car = SceneVehicle(distance_m=12, kind="sedan", paint="white")
        scene, empty = (render_scene(vehicles=v, light="overcast", random_state=2) for v in ([car], []))
        x1, y1, x2, y2 = scene.truth[0].box
        difference = cv2.absdiff(scene.image, empty.image).max(-1) > 25
        # Columns of the upper half: no shadow there.
        columns = np.flatnonzero(difference[y1 : (y1 + y2) // 2, x1 - 30 : x2 + 30].any(0)) + x1 - 30
        assert abs(columns.min() - x1) <= 3
        assert abs(columns.max() + 1 - x2) <= 3
        rows = np.flatnonzero(difference[: (y1 + y2) // 2, x1:x2].any(1))
        assert abs(rows.min() - y1) <= 3

    def test_nearer_vehicle_hides_the_farther_one(self):
        pair = [SceneVehicle(distance_m=30), SceneVehicle(distance_m=12, kind="van")]
        scene = render_scene(vehicles=pair)
        far, near = scene.truth
        assert (far.occluded, far.ignore, near.occluded, near.ignore) == (2, 1, 0, 0)
        assert far.hidden > 0.9
        side = [SceneVehicle(distance_m=30, lateral_m=3.0), SceneVehicle(distance_m=12, kind="van")]
        half = render_scene(vehicles=side).truth[0]
        assert half.occluded in (0, 1)
        # The box is the whole vehicle's, hidden or not.
        assert half.box == render_scene(vehicles=side[:1]).truth[0].box

    def test_truncation(self):
        shares = [
            render_scene(vehicles=[SceneVehicle(distance_m=9, lateral_m=x, kind="sedan")]).truth[0].truncated
            for x in (2.0, 4.0, 5.0, 5.6)
        ]
        assert shares[0] == 0
        assert shares == sorted(shares)
        assert shares[-1] > 0.4
        assert render_scene(vehicles=[SceneVehicle(distance_m=9, lateral_m=20)]).truth == ()

    def test_nearer_is_larger(self):
        widths = []
        for distance in (10, 20, 40):
            x1, _, x2, _ = (
                render_scene(vehicles=[SceneVehicle(distance_m=distance, kind="suv")], random_state=1)
                .truth[0]
                .box
            )
            widths.append(x2 - x1)
        assert widths[0] == pytest.approx(2 * widths[1], rel=0.06)
        assert widths[1] == pytest.approx(2 * widths[2], rel=0.06)

    def test_jpeg(self):
        plain, packed = (render_scene(shape=SMALL, jpeg_quality=q).image for q in (None, 60))
        assert (plain != packed).any()
        assert np.abs(plain.astype(int) - packed).mean() < 8

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"shape": (720,)}, r"shape must be \(height, width\) in pixels, got \(720,\)"),
            ({"shape": (20, 640)}, r"shape\[0\] must be an integer from 64"),
            ({"shape": (640.5, 640)}, r"shape\[0\] must be an integer"),
            ({"vehicles": -1}, "vehicles must be an integer from 0 to 60"),
            ({"vehicles": [20]}, r"vehicles\[0\] must be a SceneVehicle, got 20; make one with"),
            ({"lane": 3}, "lane must be an integer from 0 to 2"),
            ({"horizon": 1.2}, "horizon must be a number, at least 0.1 and at most 0.9"),
            ({"camera_height": 0.0}, "camera_height must be a number"),
            ({"focal": 10}, "focal must be a number"),
            ({"light": "noon"}, "light must be one of 'day', 'overcast', 'dusk', 'night'; got 'noon'"),
            ({"rain": 2}, "rain must be a number"),
            ({"jpeg_quality": 0}, "jpeg_quality must be an integer from 1 to 100"),
            ({"random_state": -1}, "random_state must be an integer at least 0"),
            ({"random_state": "x"}, "random_state must be an integer"),
        ],
    )
    def test_bad_options(self, options, message):
        with pytest.raises(InvalidInputError, match=message):
            render_scene(**options)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"distance_m": 1.0}, "distance_m must be a number, at least 2"),
            ({"distance_m": float("nan")}, "distance_m must be a number"),
            ({"distance_m": 9, "lateral_m": 1e6}, "lateral_m must be a number"),
            ({"distance_m": 9, "kind": "tank"}, "kind must be one of 'hatchback'"),
            ({"distance_m": 9, "paint": "pink"}, "paint must be one of 'white'"),
            ({"distance_m": 9, "facing": "left"}, "facing must be one of 'rear', 'front'"),
            ({"distance_m": 9, "speed_mps": "fast"}, "speed_mps must be a number"),
        ],
    )
    def test_bad_vehicle(self, options, message):
        with pytest.raises(InvalidInputError, match=message):
            SceneVehicle(**options)


class TestDrive:
    @pytest.mark.parametrize("scenario", ["highway", "overtaking", "crossing", "occlusion", "empty"])
    def test_frames_do_not_depend_on_each_other(self, scenario):
        first, second = (
            render_drive(frames=20, shape=SMALL, scenario=scenario, random_state=3) for _ in range(2)
        )
        late = first[14]
        frames = list(second)
        assert len(frames) == len(second) == 20
        assert late.image.tobytes() == frames[14].image.tobytes()
        assert first[-1].image.tobytes() == frames[19].image.tobytes()
        assert (first.fps, first.shape, first.scenario) == (25.0, SMALL, scenario)
        for frame in frames[::7]:
            check_invariants(frame)
        assert tuple(frame.truth for frame in frames) == first.truth

    @given(
        scenario=st.sampled_from(["highway", "overtaking", "crossing", "occlusion"]),
        seed=st.integers(0, 10_000),
        fps=st.sampled_from([10.0, 25.0, 29.97]),
    )
    @settings(max_examples=6)
    def test_motion_is_smooth_and_tracks_are_steady(self, scenario, seed, fps):
        drive = render_drive(frames=40, fps=fps, shape=SMALL, scenario=scenario, random_state=seed)
        for rows in drive.truth:
            assert len({row.track for row in rows}) == len(rows)
        for track in paths(drive).values():
            frames = sorted(track)
            assert frames == list(range(frames[0], frames[-1] + 1))
            distance = np.array([track[frame].distance_m for frame in frames])
            speed = np.array([track[frame].speed_mps for frame in frames])
            if len(frames) > 1:
                steps = np.diff(distance) * fps
                np.testing.assert_allclose(steps, (speed[1:] + speed[:-1]) / 2, atol=0.05)
                assert np.abs(np.diff(speed) * fps).max() < 3

    def test_vehicles_of_a_highway_do_not_overlap(self):
        for seed in range(5):
            drive = render_drive(frames=500, shape=(90, 160), random_state=seed)
            for time in range(0, 20, 2):
                spots = [(m.lateral(time), m.distance(time)) for m in drive._movers if not m.oncoming]
                for index, (x, z) in enumerate(spots):
                    for other_x, other_z in spots[index + 1 :]:
                        assert abs(x - other_x) > 2.0 or abs(z - other_z) > 5.5

    def test_highway_has_cars_ahead_and_oncoming_ones(self):
        drive = render_drive(frames=100, shape=SMALL, random_state=1)
        tracks = paths(drive)
        oncoming = [t for t, rows in tracks.items() if next(iter(rows.values())).speed_mps < -40]
        ahead = [t for t, rows in tracks.items() if abs(next(iter(rows.values())).speed_mps) < 5]
        assert len(ahead) >= 3
        assert oncoming
        assert set(ahead) | set(oncoming) == set(tracks)
        for track in oncoming:
            assert all(row.ignore for row in tracks[track].values())

    def test_overtaking_enters_at_an_edge_and_pulls_away(self):
        for seed in range(2):
            drive = render_drive(frames=100, shape=SMALL, scenario="overtaking", random_state=seed)
            rows = paths(drive)[1]
            first, last = rows[min(rows)], rows[max(rows)]
            assert first.box[0] == 0 or first.box[2] == SMALL[1]
            assert first.truncated > 0.3
            assert last.truncated == 0
            assert last.distance_m > 20
            assert all(row.speed_mps > 0 for row in rows.values())

    @pytest.mark.parametrize("scenario", ["crossing", "occlusion"])
    def test_two_cars_swap_sides(self, scenario):
        for seed in range(2):
            drive = render_drive(frames=60, fps=10, shape=SMALL, scenario=scenario, random_state=seed)
            tracks = paths(drive)
            apart = [middle(tracks[1][f]) - middle(tracks[2][f]) for f in range(60) if f in tracks[2]]
            assert apart[0] * apart[-1] < 0
            overlaps = [
                tracks[1][f].box[0] < tracks[2][f].box[2] and tracks[2][f].box[0] < tracks[1][f].box[2]
                for f in range(60)
            ]
            assert any(overlaps)
            assert not overlaps[0]
            assert not overlaps[-1]

    @pytest.mark.parametrize(("frames", "seed"), [(50, 0), (75, 1), (100, 2)])
    def test_occlusion_hides_a_car_for_a_second(self, frames, seed):
        drive = render_drive(frames=frames, shape=SMALL, scenario="occlusion", random_state=seed)
        hidden = [rows[1].occluded == 2 for rows in drive.truth]
        assert 0.8 <= sum(hidden) / drive.fps <= 2.5
        first = hidden.index(True)
        assert all(hidden[first : first + sum(hidden)])

    def test_empty(self):
        drive = render_drive(frames=5, shape=SMALL, scenario="empty")
        assert drive.truth == ((),) * 5
        assert (drive[0].image != drive[4].image).any()

    def test_pitch_jitter_moves_horizon_and_boxes_together(self):
        options = {"frames": 40, "shape": (360, 640), "scenario": "overtaking", "random_state": 2}
        still, nodding = render_drive(**options), render_drive(**options, pitch_jitter=4)
        offsets = set()
        for frame in (0, 9, 18, 39):
            one, other = still[frame], nodding[frame]
            nod = int(other.camera.horizon_px - one.camera.horizon_px)
            offsets.add(nod)
            assert abs(nod) <= 4
            for a, b in zip(one.truth, other.truth):
                if a.truncated == 0:
                    assert b.box == (a.box[0], a.box[1] + nod, a.box[2], a.box[3] + nod)
        assert len(offsets) > 1

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"frames": 0}, "frames must be an integer at least 1"),
            ({"fps": 0}, "fps must be a number, at least 1"),
            ({"scenario": "race"}, "scenario must be one of 'highway', 'overtaking', 'crossing'"),
            ({"pitch_jitter": -1}, "pitch_jitter must be an integer from 0 to 50"),
            ({"shape": "hd"}, "shape must be"),
            ({"light": 3}, "light must be one of"),
        ],
    )
    def test_bad_options(self, options, message):
        with pytest.raises(InvalidInputError, match=message):
            render_drive(**options)

    @pytest.mark.parametrize("index", [5, -6, 1.5, slice(0, 2)])
    def test_bad_index(self, index):
        drive = render_drive(frames=5, shape=SMALL, scenario="empty")
        with pytest.raises(InvalidInputError, match="frame number must be an integer from -5 to 4"):
            drive[index]


class TestLabels:
    def test_drive_labels_say_what_the_truth_says(self, tmp_path):
        drive = render_drive(frames=10, shape=SMALL, random_state=2)
        drive.write_labels(tmp_path / "labels.csv")
        with (tmp_path / "labels.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert tuple(rows[0]) == LABEL_COLUMNS
        truth = [(frame, row) for frame, found in enumerate(drive.truth) for row in found]
        assert len(rows) == len(truth)
        for row, (frame, true) in zip(rows, truth):
            assert (int(row["frame"]), int(row["track"])) == (frame, true.track)
            assert tuple(int(row[key]) for key in ("x1", "y1", "x2", "y2")) == true.box
            assert (int(row["occluded"]), int(row["ignore"])) == (true.occluded, true.ignore)
            assert float(row["truncated"]) == pytest.approx(true.truncated, abs=5e-4)
            assert float(row["distance_m"]) == pytest.approx(true.distance_m, abs=5e-3)
            assert float(row["speed_mps"]) == pytest.approx(true.speed_mps, abs=5e-3)

    def test_missing_folder(self, tmp_path):
        with pytest.raises(InvalidInputError, match="path needs an existing folder"):
            write_labels(tmp_path / "no" / "labels.csv", [])


class TestPatches:
    def test_shapes_labels_and_seed(self):
        patches, labels = render_patches(21, random_state=3)
        assert patches.shape == (21, 64, 64, 3)
        assert patches.dtype == np.uint8
        assert labels.dtype == bool
        assert labels.tolist() == [True] * 11 + [False] * 10
        again, _ = render_patches(21, random_state=3)
        assert patches.tobytes() == again.tobytes()
        other, _ = render_patches(21, random_state=4)
        assert patches.tobytes() != other.tobytes()

    def test_size(self):
        assert render_patches(1, size=32)[0].shape == (1, 32, 32, 3)

    def test_patches_differ_and_are_not_blank(self):
        patches, labels = render_patches(60, random_state=1)
        assert len({patch.tobytes() for patch in patches}) == 60
        contrast = patches.reshape(60, -1).std(1)
        assert contrast[labels].min() > 8
        assert contrast[labels].mean() > contrast[~labels].mean()

    @pytest.mark.parametrize(
        ("n", "options", "message"),
        [
            (0, {}, "n must be an integer at least 1"),
            (2, {"size": 8}, "size must be an integer from 16 to 512"),
            (2, {"random_state": 1.5}, "random_state must be an integer"),
        ],
    )
    def test_bad_input(self, n, options, message):
        with pytest.raises(InvalidInputError, match=message):
            render_patches(n, **options)


def load_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("regenerate", TEST_IMAGES / "regenerate.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


class TestTestImages:
    def test_pictures_are_those_of_the_script(self):
        script = load_script()
        assert {path.name for path in TEST_IMAGES.glob("*.jpg")} == set(script.SCENES)
        for name in ("road1.jpg", "road6.jpg"):
            # JPEG and another OpenCV may differ by a little, another drawing by a lot.
            difference = np.abs(read_image(TEST_IMAGES / name).astype(int) - script.draw(name).image)
            assert difference.mean() < 3

    def test_labels_are_those_of_the_script(self, tmp_path):
        script = load_script()
        script.main(tmp_path)
        assert (tmp_path / "labels.csv").read_text() == (TEST_IMAGES / "labels.csv").read_text()

    def test_pictures_are_small_and_one_is_empty(self):
        with (TEST_IMAGES / "labels.csv").open(newline="") as file:
            labelled = {row["frame"] for row in csv.DictReader(file)}
        shapes = {path.name: read_image(path).shape for path in TEST_IMAGES.glob("*.jpg")}
        assert len(shapes) == 6
        assert len(set(shapes) - labelled) == 1
        assert sorted(shape[:2] for shape in shapes.values()) == [(540, 960)] + [(720, 1280)] * 5
        assert all(path.stat().st_size < 250_000 for path in TEST_IMAGES.glob("*.jpg"))


def test_public_names():
    assert set(synthetic.__all__) <= set(dir(synthetic))
