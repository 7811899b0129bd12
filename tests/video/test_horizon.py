"""Estimates of the horizon from the vehicles in some frames of a video."""

import numpy as np
import pytest

from tests.helpers import boxes_on_a_road
from vehicle_detection import Detections, InvalidInputError, VehicleDetector, open_source
from vehicle_detection.video import estimate_video_horizon


class StubImageDetector:
    """Detects the same boxes in every frame, and counts the frames."""

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


def test_the_horizon_from_fifteen_frames_of_a_short_video(clip):
    detector = StubImageDetector(boxes_on_a_road(0.55, 1.3, 8, 1, 0.01))
    found = estimate_video_horizon(clip, detector)
    assert detector.frames == 12
    assert found.horizon == pytest.approx(0.55, abs=0.01)
    assert estimate_video_horizon(clip, detector, start=1, end=2).n_boxes == 64


def test_a_source_of_the_caller_stays_open(clip):
    closed = []
    with open_source(clip) as source:
        source._on_close.callback(closed.append, True)
        for _ in range(2):
            estimate_video_horizon(source, StubImageDetector(np.empty((0, 4))), end=0.4)
        assert not closed
    assert closed


def test_no_more_frames_than_necessary(clip):
    detector = StubImageDetector(boxes_on_a_road(0.55, 1.3, 80, 1, 0.01))
    estimate_video_horizon(clip, detector)
    assert detector.frames == 2


def test_boxes_of_one_size_suffice(clip):
    found = estimate_video_horizon(clip, StubImageDetector(np.tile([600, 400, 660, 450], (9, 1))))
    assert found.horizon == pytest.approx(405 / 720, abs=0.01)


def test_too_few_boxes(clip):
    assert estimate_video_horizon(clip, StubImageDetector(np.empty((0, 4)))) is None


def test_an_uncertain_estimate_is_rejected(clip):
    corners = np.random.default_rng(0).uniform((50, 50), (1100, 600), (12, 2))
    boxes = np.hstack([corners, corners + np.array([70, 50])])
    assert estimate_video_horizon(clip, StubImageDetector(boxes), end=0.4) is None


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("lane_lines_960x540", 0.54, 0.59), ("project_clip", 0.56, 0.61), ("test_video", 0.56, 0.61)],
)
def test_the_horizon_of_real_clips(real_data, name, low, high):
    with VehicleDetector() as detector:
        found = estimate_video_horizon(real_data / "videos" / f"{name}.mp4", detector)
    assert low < found.horizon < high
    assert found.horizon_std < 0.03


def test_a_refused_pipe_is_not_read(clip):
    with open_source(clip) as source:
        source.rereadable = False
        source.read = None
        with pytest.raises(InvalidInputError, match="which is read only once; pass a fraction"):
            estimate_video_horizon(source, StubImageDetector(np.empty((0, 4))))
