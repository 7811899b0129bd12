"""Tests of the cuts between the scenes of a video."""

import numpy as np
import pytest

from tests.helpers import ROOT
from vehicle_detection import read_image, render_drive
from vehicle_detection.tracking import SceneCuts

ROAD = read_image(ROOT / "test_images" / "road1.jpg")
OTHER = read_image(ROOT / "test_images" / "road4.jpg")


def find_cuts(frames):
    cuts = SceneCuts()
    return [index for index, frame in enumerate(frames) if cuts.update(frame)]


def brighten(image, by, contrast=1.0):
    return np.clip(image * contrast + by, 0, 255).astype(np.uint8)


def pan(image, step, count=6):
    """Views of an image that moves to the side by `step` pixels a frame, as in a turn."""
    return [image[:, index * step : image.shape[1] - (count - index) * step] for index in range(count)]


def test_the_first_frame_and_equal_ones_are_no_cuts():
    assert find_cuts([ROAD, ROAD, ROAD]) == []


@pytest.mark.parametrize("size", [(720, 1280), (360, 480), (640, 360), (90, 160), (6, 9)])
def test_another_scene_is_a_cut_at_any_size(size):
    rows, columns = (np.linspace(0, side - 1, count).astype(int) for side, count in zip(ROAD.shape, size))
    first, second = (np.ascontiguousarray(image[np.ix_(rows, columns)]) for image in (ROAD, OTHER[:, ::-1]))
    assert find_cuts([first, first, second, second, first]) == [2, 4]


@pytest.mark.parametrize("fps", [60, 25, 10, 5])
@pytest.mark.parametrize("seed", range(2))
def test_a_drive_has_no_cuts_at_any_rate(fps, seed):
    frames = [scene.image for scene in render_drive(frames=5, fps=fps, shape=(180, 320), random_state=seed)]
    assert find_cuts(frames) == []


@pytest.mark.parametrize("seed", range(2))
def test_two_drives_have_a_cut_between_them(seed):
    first, second = (
        [scene.image for scene in render_drive(frames=3, shape=(180, 320), random_state=2 * seed + index)]
        for index in range(2)
    )
    assert find_cuts(first + second) == [3]


def test_a_turn_is_no_cut():
    assert find_cuts(pan(ROAD, 60)) == []


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param([ROAD, brighten(ROAD, 60), ROAD], id="headlights"),
        pytest.param([ROAD, np.full_like(ROAD, 255), ROAD], id="flash"),
        pytest.param(
            [brighten(ROAD, 0, 1 - step / 10) for step in (*range(11), *range(10, -1, -1))], id="fade"
        ),
        pytest.param([brighten(ROAD, 0, 0.15), brighten(ROAD, 0, 0.6), ROAD], id="end of a tunnel"),
    ],
)
def test_changes_of_light_are_no_cuts(frames):
    assert find_cuts(frames) == []


def test_another_scene_after_a_black_frame_is_a_cut():
    assert find_cuts([ROAD, np.zeros_like(ROAD), OTHER[:, ::-1], OTHER[:, ::-1]]) == [2]


def test_noise_in_the_dark_is_no_cut():
    random = np.random.default_rng(0)
    assert find_cuts([random.integers(0, 24, (360, 640, 3), np.uint8) for _ in range(4)]) == []
