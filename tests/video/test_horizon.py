"""The horizon of a video, from the vehicles of some of its frames."""

import numpy as np
import pytest

from tests.helpers import boxes_on_a_road
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import estimate_video_horizon


class Finder:
    """Finds the same boxes in every frame, and counts the frames."""

    def __init__(self, boxes):
        self.found = Detections(boxes, np.ones(len(boxes)))
        self.frames = 0

    def detect(self, frame):
        self.frames += 1
        return self.found


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    from moviepy import ImageSequenceClip

    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    frames = [np.full((720, 1280, 3), 90 + index, np.uint8) for index in range(24)]
    ImageSequenceClip(frames, fps=8).write_videofile(str(path), logger=None)
    return path


def test_two_frames_a_second_tell_the_horizon(clip):
    finder = Finder(boxes_on_a_road(0.55, 1.3, 20, 1, 0.01))
    found = estimate_video_horizon(clip, finder)
    assert finder.frames == 6
    assert found.horizon == pytest.approx(0.55, abs=0.01)
    assert estimate_video_horizon(clip, finder, start=1, end=2).n_boxes == 40


def test_no_more_frames_than_it_takes(clip):
    finder = Finder(boxes_on_a_road(0.55, 1.3, 80, 1, 0.01))
    estimate_video_horizon(clip, finder)
    assert finder.frames == 2


@pytest.mark.parametrize("boxes", [np.empty((0, 4)), np.tile([600, 400, 660, 450], (9, 1))])
def test_vehicles_that_do_not_tell(clip, boxes):
    assert estimate_video_horizon(clip, Finder(boxes)) is None


def test_a_guess_is_no_answer(clip):
    boxes = np.random.default_rng(0).uniform((0, 0, 300, 200), (200, 200, 1000, 700), (12, 4))
    assert estimate_video_horizon(clip, Finder(boxes), end=0.4) is None


def test_no_camera_lies_on_the_road(clip):
    assert estimate_video_horizon(clip, Finder(boxes_on_a_road(0.55, 0.3, 20, 1, 0.01))) is None


def test_a_missing_video_is_told(tmp_path):
    with pytest.raises(InvalidInputError, match=r"missing\.mp4 does not exist"):
        estimate_video_horizon(tmp_path / "missing.mp4", Finder(np.empty((0, 4))))
