"""Blurring of vehicles and plates."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_network
from vehicle_detection import Detections, FrameResult, Track, VehicleDetector, blur_boxes
from vehicle_detection.errors import InvalidInputError

NOISE = np.random.default_rng(0).integers(0, 256, (120, 200, 3), dtype=np.uint8)


def striped():
    """An image with characters of a plate: black and white columns, 4 pixels wide."""
    image = np.full((120, 200, 3), 90, np.uint8)
    image[:, (np.arange(200) // 4) % 2 == 0] = 240
    return image


def changed(first, second):
    """Rows and columns of the pixels that differ, as a box."""
    rows, columns = np.nonzero((first != second).any(axis=2))
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]


def test_the_whole_vehicle_is_blurred_and_nothing_else():
    before = NOISE.copy()
    blurred = blur_boxes(NOISE, [[50, 30, 100, 80]])
    assert changed(blurred, NOISE) == [46, 26, 104, 84]
    assert (before == NOISE).all()
    assert blurred[30:80, 50:100].std() < 0.4 * NOISE.std()


@pytest.mark.parametrize(
    ("box", "region"), [([50, 30, 100, 80], [52, 46, 98, 84]), ([40, 30, 140, 80], [32, 46, 148, 84])]
)
def test_the_region_of_the_plate_is_the_lower_part(box, region):
    blurred = blur_boxes(NOISE, [box], region="plates")
    assert changed(blurred, NOISE) == region


@pytest.mark.parametrize("region", ["vehicles", "plates"])
def test_characters_disappear(region):
    image = striped()
    plate = blur_boxes(image, [[40, 20, 110, 90]], region=region)[64:80, 60:90].astype(float)
    assert np.ptp(plate.mean(axis=(0, 2))) < 0.25 * 150
    # No pixel keeps its value by chance of alignment: neighboring columns are nearly equal.
    assert np.abs(np.diff(plate.mean(axis=2), axis=1)).max() < 8


@given(
    st.lists(st.tuples(*[st.floats(-300, 300)] * 2, *[st.floats(0, 400)] * 2), max_size=4),
    st.sampled_from(["vehicles", "plates"]),
)  # fmt: skip
def test_any_box_is_accepted(corners, region):
    boxes = [[x, y, x + width, y + height] for x, y, width, height in corners]
    assert blur_boxes(NOISE, boxes, region=region).shape == NOISE.shape


def track_at(box, **state):
    options = {"id": 1, "score": 1.0, "state": "confirmed", "shown": True, "age": 1.0, "misses": 0}
    options |= {"time_since_update": 0.0, "velocity": (0.0, 0.0)}
    return Track(box=np.array(box, float), **(options | state))


@pytest.mark.parametrize(
    "state",
    [{}, {"state": "coasting", "misses": 9, "shown": False}, {"id": 0, "state": "tentative", "shown": False}],
)
def test_every_track_is_blurred(state):
    none = Detections.empty()
    result = FrameResult(0, 0.0, none, none, (track_at([50, 30, 100, 80], **state),))
    with VehicleDetector(random_network(), blur="vehicles") as detector:
        drawn = detector.annotate(NOISE, result)
        assert drawn[40:70, 60:90].std() < 0.4 * NOISE.std()
        detected = dataclasses.replace(result, tracks=(), detections=Detections([[50, 30, 100, 80]], [1.0]))
        assert (detector.annotate(NOISE, detected) == blur_boxes(NOISE, [[50, 30, 100, 80]])).all()


def test_bad_arguments_are_refused():
    with pytest.raises(InvalidInputError, match="region must be one of 'vehicles', 'plates'; got 'faces'"):
        blur_boxes(NOISE, [], region="faces")
    with pytest.raises(InvalidInputError, match="blur must be one of 'vehicles', 'plates'; got 'all'"):
        VehicleDetector(random_network(), blur="all")
    with pytest.raises(InvalidInputError, match="image must be"):
        blur_boxes(NOISE[..., 0], [])
