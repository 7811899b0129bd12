import functools
import importlib.util

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import ROOT, check_truth
from vehicle_detection import InvalidInputError, read_image, read_labels, render_scene
from vehicle_detection.scenes import SceneVehicle

SMALL = (216, 384)
TEST_IMAGES = ROOT / "test_images"

scene_vehicles = st.builds(
    SceneVehicle,
    distance_m=st.floats(2.5, 90.0),
    lateral_m=st.floats(-12.0, 12.0),
    kind=st.sampled_from(["hatchback", "estate", "sedan", "mpv", "suv", "van", "truck"]),
    color=st.sampled_from(["white", "red", "black"]),
    view=st.sampled_from(["rear", "front"]),
    speed_mps=st.floats(-30.0, 30.0),
)


def test_the_same_seed_gives_the_same_bytes():
    shape, before = (108, 192), np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = (render_scene(shape=shape, random_state=4) for _ in range(2))
    assert first.image.tobytes() == second.image.tobytes()
    assert first.truth == second.truth
    assert render_scene(shape=shape, random_state=5).image.tobytes() != first.image.tobytes()
    # A generator gives the same and advances; the global one does not.
    rng = np.random.default_rng(4)
    assert render_scene(shape=shape, random_state=rng).image.tobytes() == first.image.tobytes()
    assert render_scene(shape=shape, random_state=rng).image.tobytes() != first.image.tobytes()
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002


@pytest.mark.parametrize("light", ["day", "overcast", "dusk", "night"])
@pytest.mark.parametrize(("rain", "shape"), [(0.0, (300, 200)), (0.7, SMALL), (0.2, (64, 64))])
def test_light_rain_and_shape(light, rain, shape):
    scene = render_scene(shape=shape, light=light, rain=rain, vehicles=2)
    assert (scene.image.shape, scene.image.dtype) == ((*shape, 3), np.uint8)
    assert scene.instance_map.shape == shape
    check_truth(scene)
    mean = scene.image.mean()
    assert (mean < 40) if light == "night" else (60 < mean < 200)
    assert scene.image.std() > 3


@given(vehicles=st.lists(scene_vehicles, max_size=4), horizon=st.floats(0.2, 0.8), seed=st.integers(0, 3))
@settings(max_examples=6)
def test_truth_is_consistent(vehicles, horizon, seed):
    scene = render_scene(shape=SMALL, vehicles=vehicles, horizon=horizon, random_state=seed)
    check_truth(scene)
    assert scene.boxes.shape == (len(scene.truth), 4)
    for row in scene.truth:
        vehicle = vehicles[row.track - 1]
        # The nearest part is before the tires.
        assert 0.5 < vehicle.distance_m - row.distance_m < 2
        assert row.speed_mps == vehicle.speed_mps


@given(
    distance=st.floats(6.0, 40.0),
    lateral=st.floats(-1.5, 1.5),
    horizon=st.floats(0.3, 0.6),
    height=st.floats(1.0, 2.0),
    focal=st.floats(450.0, 700.0),
    kind=st.sampled_from(["hatchback", "sedan", "suv", "van", "truck"]),
)
@settings(max_examples=6)
def test_the_bottom_row_follows_from_the_distance(distance, lateral, horizon, height, focal, kind):
    vehicle = SceneVehicle(distance_m=distance, lateral_m=lateral, kind=kind)
    options = {"horizon": horizon, "camera_height_m": height, "focal_px": focal}
    scene = render_scene(shape=(360, 640), vehicles=[vehicle], **options)
    camera, (row,) = scene.camera, scene.truth
    assert (camera.focal_px, camera.horizon_px, camera.height_m) == (focal, horizon * 360, height)
    below_horizon = row.full_box[3] - camera.horizon_px
    expected = focal * height / distance
    # 1% of the distance, and the rounding of the box to whole pixels.
    assert below_horizon == pytest.approx(expected, abs=0.01 * expected + 1.0)
    if row.box[3] < 360:
        assert focal * height / below_horizon == pytest.approx(distance, rel=0.01 + 1.0 / below_horizon)


@pytest.mark.parametrize("random_state", range(2))
def test_a_vehicle_changes_only_its_box_and_its_shadow(random_state):
    near = SceneVehicle(distance_m=14, lateral_m=-1.0)
    far = SceneVehicle(distance_m=30, lateral_m=3.6)
    both = render_scene(shape=(360, 640), vehicles=[far, near], random_state=random_state)
    alone = render_scene(shape=(360, 640), vehicles=[far], random_state=random_state)
    assert both.truth[0] == alone.truth[0]
    changed = (both.image != alone.image).any(-1)
    x1, y1, x2, y2 = both.truth[1].box
    assert changed[y1:y2, x1:x2].mean() > 0.6
    assert changed[both.instance_map == 2].mean() > 0.95
    # Blur extends the change by a few pixels; the shadow lies on the road.
    margin = 6
    changed[y1 - margin : y2 + margin, x1 - margin : x2 + margin] = False
    rows = np.flatnonzero(changed.any(1))
    assert len(rows) == 0 or rows.min() >= both.camera.horizon_px


def test_a_nearer_vehicle_occludes_a_farther_one():
    near = SceneVehicle(distance_m=12, kind="van")
    render = functools.partial(render_scene, shape=(360, 640))
    far, front = render(vehicles=[SceneVehicle(distance_m=30), near]).truth
    assert (far.occluded, far.ignore, front.occluded, front.ignore) == (2, 1, 0, 0)
    assert far.occluded_fraction > 0.9
    beside = SceneVehicle(distance_m=30, lateral_m=3.0)
    row = render(vehicles=[beside, near]).truth[0]
    assert row.occluded in (0, 1)
    # The box covers the whole vehicle, occluded or not.
    assert row.box == render(vehicles=[beside]).truth[0].box


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        ({"shape": (20, 640)}, r"shape\[0\]"),
        ({"shape": (640.5, 640)}, r"shape\[0\]"),
        ({"vehicles": [20]}, r"vehicles\[0\] must be a SceneVehicle, got 20; make one with"),
    ],
)
def test_invalid_options(options, refused):
    with pytest.raises(InvalidInputError, match=f"^{refused}"):
        render_scene(**options)


@pytest.mark.parametrize(
    ("name", "value"),
    [("distance_m", 1.0), ("distance_m", float("nan")), ("lateral_m", 1e6), ("kind", "tank"),
     ("color", "pink"), ("view", "left"), ("speed_mps", "fast")],
)  # fmt: skip
def test_invalid_vehicles(name, value):
    with pytest.raises(InvalidInputError, match=f"^{name}"):
        SceneVehicle(**({"distance_m": 9} | {name: value}))


def test_the_test_images_are_those_of_their_script(tmp_path):
    spec = importlib.util.spec_from_file_location("regenerate", TEST_IMAGES / "regenerate.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    written, committed = (read_labels(folder / "labels.csv") for folder in (tmp_path, TEST_IMAGES))
    pd.testing.assert_frame_equal(written.to_pandas(), committed.to_pandas())
    names = {path.name for path in TEST_IMAGES.glob("*.jpg")}
    assert names == {path.name for path in tmp_path.glob("*.jpg")}
    for name in names:
        # Another OpenCV version changes the image slightly, another drawing changes it a lot.
        drawn, shipped = (read_image(folder / name).astype(int) for folder in (tmp_path, TEST_IMAGES))
        assert np.abs(drawn - shipped).mean() < 3
