import itertools

import numpy as np
import pytest

from tools.rendered import _LANE, _traffic, rendered_source


@pytest.fixture(scope="module")
def source():
    return rendered_source(frames=12)


def test_rendered_frames_follow_from_the_seed(source):
    again, other = rendered_source(frames=2), rendered_source(frames=2, random_state=1)
    (frames,) = source.sets
    assert (source.name, frames.keys) == ("rendered", tuple(range(12)))
    for key in range(2):
        np.testing.assert_array_equal(again.sets[0].frames[key], frames.frames[key])
        assert (other.sets[0].frames[key] != frames.frames[key]).any()


def test_labels_of_rendered_frames(source):
    (frames,) = source.sets
    labels = frames.labels
    sides = {max(image.shape) for _, image in frames}
    assert sides <= {640, 1280}
    assert labels["truncated"].max() > 0.2
    assert labels["occluded"].max() > 0
    usable = labels[~labels["ignore"]]
    assert (usable.boxes[:, 2] - usable.boxes[:, 0]).min() >= 20
    assert usable["truncated"].max() <= 0.7
    assert usable["occluded"].max() < 2
    for key, image in frames:
        boxes = labels.frame(key).boxes
        assert (boxes[:, 2:] <= image.shape[1::-1]).all()


def test_the_traffic_of_single_scenes_is_varied_and_does_not_overlap():
    rng = np.random.default_rng(0)
    kinds, views = set(), set()
    for _ in range(60):
        lanes = {}
        for vehicle in _traffic(1, rng):
            kinds.add(vehicle.kind)
            views.add(vehicle.view)
            lanes.setdefault(round(vehicle.lateral_m / _LANE), []).append(vehicle)
        for lane in lanes.values():
            for near, far in itertools.pairwise(lane):
                assert far.distance_m - near.distance_m >= (11 if near.kind == "truck" else 7)
    assert {"truck", "van", "sedan"} <= kinds
    assert views == {"rear", "front"}
