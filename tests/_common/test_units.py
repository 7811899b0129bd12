"""Units of distances and speeds in pictures and reports."""

import pytest

from vehicle_detection._common import UNITS


@pytest.mark.parametrize(
    ("name", "distance", "speed"), [("metric", "100 m", "+36 km/h"), ("imperial", "328 ft", "+22 mph")]
)
def test_distances_and_speeds(name, distance, speed):
    assert UNITS[name].distance_text(100.0, 5.0) == distance
    assert UNITS[name].speed_text(10.0, 0.5) == speed


def test_rough_distances_are_marked():
    metric = UNITS["metric"]
    assert metric.distance_text(20.0, 3.9) == "20 m"
    assert metric.distance_text(20.0, 4.1) == "~20 m"
    assert metric.distance_text(20.0, None) == "20 m"
    assert metric.distance_text(20.0, 4.1, with_std=True) == "20 ± 4 m"


def test_a_vehicle_at_the_same_speed_has_no_sign():
    assert UNITS["metric"].speed_text(-0.01, 0.2) == "0 km/h"
    assert UNITS["imperial"].speed_text(-5.0, 1.0, with_std=True) == "-11 ± 2 mph"
