import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import check_truth
from vehicle_detection.datasets import read_labels, write_labels
from vehicle_detection.scenes import render_drive
from vehicle_detection.scenes.drive import SCENARIOS, make_traffic

SMALL = (216, 384)


def truth_by_track(drive, every=1):
    """Truth of every n-th frame by track, then by frame."""
    tracks = {}
    for frame in range(0, len(drive), every):
        for row in drive.truth_of(frame):
            tracks.setdefault(row.track, {})[frame] = row
    return tracks


@pytest.mark.parametrize("scenario", SCENARIOS[1:3])
def test_frames_do_not_depend_on_each_other(scenario):
    first, second = (render_drive(frames=7, shape=SMALL, scenario=scenario, random_state=3) for _ in range(2))
    late = first[4]
    frames = list(second)
    assert len(frames) == len(second) == 7
    assert late.image.tobytes() == frames[4].image.tobytes()
    assert first[-1].image.tobytes() == frames[6].image.tobytes()
    assert (first.fps, first.shape) == (25.0, SMALL)
    for frame in frames[::3]:
        check_truth(frame)
    assert tuple(frame.truth for frame in frames) == first.truth
    assert (first.truth_of(2), first.truth_of(-1)) == (first.truth[2], first.truth[6])


@given(scenario=st.sampled_from(SCENARIOS), seed=st.integers(0, 10_000), time=st.floats(0.0, 4.0))
def test_the_speed_is_the_rate_of_change_of_the_distance(scenario, seed, time):
    _, vehicles = make_traffic(scenario, 4.0, np.random.default_rng(seed))
    step = 0.01
    for vehicle in vehicles:
        change = (vehicle.distance(time + step) - vehicle.distance(time - step)) / (2 * step)
        assert vehicle.relative_speed(time) == pytest.approx(change, abs=1e-3)
        acceleration = (vehicle.relative_speed(time + step) - vehicle.relative_speed(time)) / step
        assert abs(acceleration) < 8


@pytest.mark.parametrize("scenario", ["highway", "passing"])
def test_tracks_are_continuous(scenario):
    drive = render_drive(frames=100, fps=25, shape=SMALL, scenario=scenario, random_state=2)
    for track in truth_by_track(drive, every=4).values():
        frames = sorted(track)
        assert frames == list(range(frames[0], frames[-1] + 1, 4))
    assert all(len({row.track for row in rows}) == len(rows) for rows in map(drive.truth_of, (0, 50, 99)))


def test_a_highway_has_vehicles_ahead_and_ignored_oncoming_ones():
    tracks = truth_by_track(render_drive(frames=100, shape=SMALL, random_state=1), every=8)
    speed = {track: next(iter(rows.values())).speed_mps for track, rows in tracks.items()}
    oncoming = {track for track in tracks if speed[track] < -40}
    ahead = {track for track in tracks if abs(speed[track]) < 5}
    assert len(ahead) >= 3
    assert oncoming
    assert ahead | oncoming == set(tracks)
    assert all(row.ignore for track in oncoming for row in tracks[track].values())


@pytest.mark.parametrize("seed", range(2))
def test_an_overtaking_car_enters_at_a_side_and_pulls_away(seed):
    drive = render_drive(frames=100, shape=SMALL, scenario="overtaking", random_state=seed)
    rows = truth_by_track(drive, every=9)[1]
    first, last = rows[min(rows)], rows[max(rows)]
    assert first.box[0] == 0 or first.box[2] == SMALL[1]
    assert first.truncated > 0.3
    assert last.truncated == 0
    assert last.distance_m > 20
    assert all(row.speed_mps > 0 for row in rows.values())


@pytest.mark.parametrize(("frames", "seed"), [(50, 0), (75, 1), (100, 2)])
def test_occlusion_hides_a_car_for_about_a_second(frames, seed):
    drive = render_drive(frames=frames, shape=SMALL, scenario="occlusion", random_state=seed)
    hidden = [drive.truth_of(frame)[1].occluded == 2 for frame in range(0, frames, 3)]
    assert 0.8 <= sum(hidden) * 3 / drive.fps <= 2.5
    first = hidden.index(True)
    assert all(hidden[first : first + sum(hidden)])


def test_labels_contain_the_truth(tmp_path):
    drive = render_drive(frames=10, shape=SMALL, random_state=2)
    write_labels(drive.labels, tmp_path / "labels.csv")
    labels = read_labels(tmp_path / "labels.csv")
    truth = [(frame, row) for frame, found in enumerate(drive.truth) for row in found]
    assert len(labels) == len(truth)
    assert list(zip(labels["frame"], labels["track_id"])) == [(frame, row.track) for frame, row in truth]
    assert labels.boxes.tolist() == [list(row.box) for _, row in truth]
    for name in ("occluded", "ignore", "truncated", "distance_m", "speed_mps"):
        assert labels[name] == pytest.approx([getattr(row, name) for _, row in truth])


def test_rough_drives_have_other_widths_a_rolling_camera_and_hills():
    options = {"frames": 30, "fps": 10, "shape": (180, 320), "scenario": "traffic", "random_state": 3}
    rough, level = render_drive(**options, rough=True), render_drive(**options)
    assert rough.truth != level.truth
    assert rough[29].truth == rough.truth_of(29)
    # A vehicle's pixels and its box move together when the camera rolls and pitches.
    for frame in (0, 29):
        scene = rough[frame]
        for row in scene.truth:
            if row.occluded_fraction == 0 and row.truncated == 0:
                rows, columns = np.nonzero(scene.instance_map == row.track)
                found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
                np.testing.assert_allclose(found, row.box, atol=1)
